"""The identities (19) of a shipped unknown-input PI observer, at one plant.

Source of the claims: Share Pasand, Aliyari, Taghirad, eq. (19).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from obsynth.analysis.existence.augmented_pencils import AugmentedPlant
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.faults import Exosystem
from obsynth.plants.plant_units import PlantUnits
from obsynth.verification.identities import Residual, residual

_PAPER = "Share Pasand, eq. (19)"


def identities(
    plant: DescriptorSystem, observer: LinearObserver, model: Exosystem, tracking: FloatArray
) -> Iterator[tuple[str, str, Residual, str]]:
    """Yield the identities (19) of the shipped realisation: name, claim, residual, source."""
    augmented = AugmentedPlant.of(plant, model)
    az, bu, by, cz, du, dy = observer.Az, observer.Bu, observer.By, observer.Cz, observer.Du, observer.Dy
    ve = tracking @ augmented.E
    # A row that is nothing but rounding is judged in the units of what it stands for, not against itself.
    scaling = PlantUnits.of(plant, model)
    units = scaling.augmented_states
    own_u = np.outer(units, scaling.augmented_equations)
    own_dy = np.outer(np.max(np.abs(cz) * units, axis=1, initial=0.0), scaling.outputs)
    # Bhat = Ahat D + K may cancel: what it is formed of says how well it can be known.
    formed = (az[:, : plant.nx], dy[observer.state_rows], augmented.C)
    yield (
        "Sylvester",
        "Ahat U_a E_a + Bhat C_a = U_a A_a",
        residual(
            az @ ve,
            by @ augmented.C,
            -tracking @ augmented.A,
            factors=((az, tracking, augmented.E), (by, augmented.C), (tracking, augmented.A), formed),
            units=units,
        ),
        _PAPER,
    )
    yield (
        "inputs",
        "Jhat = U_a B_a (and Bhat D, where u reaches y)",
        residual(bu, by @ plant.D, -tracking @ augmented.B, factors=((by, plant.D), (tracking, augmented.B))),
        _PAPER,
    )
    yield (
        "disturbance in the error",
        "U_a Bd_a = 0 (Bhat Dd, where d reaches y)",
        residual(
            tracking @ augmented.Bd,
            -by @ plant.Dd,
            factors=((tracking, augmented.Bd), (by, plant.Dd), (own_u, augmented.Bd)),
        ),
        _PAPER,
    )
    yield (
        "disturbance in the estimates",
        "D_a Dd = 0: d has no direct effect on any estimate",
        residual(dy @ plant.Dd, factors=((dy, plant.Dd), (own_dy, plant.Dd))),
        "our extension",
    )
    goals = _goals(observer, model, augmented)
    for name, (rows, goal, claim) in goals.items():
        factors = ((cz[rows], tracking, augmented.E), (dy[rows], augmented.C), (own_dy[rows], augmented.C))
        yield name, claim, residual(cz[rows] @ ve, dy[rows] @ augmented.C, -goal, factors=factors, units=units), _PAPER
    yield (
        "feedthrough",
        "the input has no direct effect on any estimate (Du + Dy D = 0)",
        residual(du, dy @ plant.D, factors=((dy, plant.D),)),
        "our extension",
    )


def _goals(
    observer: LinearObserver, model: Exosystem, augmented: AugmentedPlant
) -> dict[str, tuple[slice, FloatArray, str]]:
    """Return what each kind of rows stands for in the augmented state: rows, matrix, claim."""
    nx = augmented.order - model.order
    return {
        "state": (observer.state_rows, np.eye(nx, augmented.order), "U_a E_a + D_a C_a = I, rows of the state"),
        "fault": (
            observer.fault_rows,
            np.hstack([np.zeros((len(model.Cw), nx)), model.Cw]),
            "Cw (U_a E_a + D_a C_a) = Cw: the fault estimate follows the fault model",
        ),
        "residual": (
            observer.residual_rows,
            np.zeros((len(observer.residual_names), augmented.order)),
            "neither the state nor a modelled fault has an effect on the residual",
        ),
    }
