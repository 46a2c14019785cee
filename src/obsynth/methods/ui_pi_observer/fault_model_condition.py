"""Whether a fault model can be told from states and unknown inputs: (D3), and the order of the model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obsynth.analysis.conditions import Condition
from obsynth.analysis.existence.distance import ROUNDING_LEVEL, least_share
from obsynth.analysis.existence.named_pencils import named_augmented, unclear
from obsynth.analysis.existence.numbers import numbers_of
from obsynth.analysis.existence.verdicts import DECIDER, settled_rank
from obsynth.analysis.existence.witnesses import Unclear
from obsynth.analysis.plant_units import PlantUnits, sized_plant
from obsynth.analysis.zeros import is_outside, leading_names, system_pencil
from obsynth.methods.ui_pi_observer.augmented_plant import AugmentedPlant
from obsynth.methods.ui_pi_observer.pencils import (
    MOST_NAMES,
    equilibrated,
    exact_loss,
    in_disturbances,
    independent_disturbances,
    kept_disturbances,
    kernel,
    number,
)
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.pencils import finite_zeros
from obsynth.numerics.ranks import RANK_TOLERANCE, RankDecision, decide_rank
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.fault_models import Exosystem


def model_conditions(
    given: DescriptorSystem, courses: Exosystem, plant: DescriptorSystem, model: Exosystem, units: PlantUnits
) -> list[Condition]:
    """Test (D3) at each unstable eigenvalue of the fault model, upper half plane only."""
    terms = sized_plant(given)
    sizes = None if terms is None else units.scaled_plant(terms)
    unstable = [complex(value) for value in model.eigenvalues if value.imag >= 0.0 and is_outside(value, plant.dt)]
    found = []
    for value in sorted(unstable, key=lambda value: (value.real, value.imag)):
        lost = exact_loss(given, courses, units.eigenvalue(value))
        condition, decision = _model_condition(plant, model, value, units, lost, sizes)
        if decision.means == "unclear":
            point = units.eigenvalue(value)
            other = f"hides a fault that follows its model at {number(point)}, and no observer estimates it"
            condition = condition.in_doubt(_model_doubt(given, courses, units, point, other=other), given)
        found.append(condition)
        if not found[-1].holds:
            break
    return found


@dataclass(frozen=True, eq=False)
class _ModelPencil:
    """The matrix of (D3) at one eigenvalue, scaled, with what its columns stand for."""

    scaled: NDArray[Any]
    columns: FloatArray
    courses: NDArray[Any]
    inputs: FloatArray
    direct: FloatArray
    share: float = np.inf

    @classmethod
    def of(
        cls, plant: DescriptorSystem, model: Exosystem, value: complex, sizes: DescriptorSystem | None
    ) -> _ModelPencil:
        """Return the matrix; ``sizes`` of the terms that the entries of the plant are sums of."""
        inputs, direct = independent_disturbances(plant)
        courses = model.Cw @ kernel(model.Phi - value * np.eye(model.order))
        matrix = np.block([
            [value * plant.E - plant.A, -plant.Bf @ courses, -inputs],
            [plant.C.astype(complex), plant.Df @ courses, direct],
        ])  # fmt: skip
        if sizes is None:
            return cls(*equilibrated(matrix), courses, inputs, direct)
        # Disturbances that are combinations of others are judged as those: their own terms are not known.
        own = inputs.shape == plant.Bd.shape
        whole = np.block([
            [abs(value) * sizes.E + sizes.A, sizes.Bf @ np.abs(courses), sizes.Bd if own else np.abs(inputs)],
            [sizes.C, sizes.Df @ np.abs(courses), sizes.Dd if own else np.abs(direct)],
        ])  # fmt: skip
        return cls(*equilibrated(matrix), courses, inputs, direct, least_share(matrix, whole))

    def decision(self, lost: int | None) -> RankDecision:
        width = self.scaled.shape[1]
        found = decide_rank(self.scaled, expected=width, equilibrated=False)
        return settled_rank(found, None if lost is None else width - lost, self.share)


def _model_condition(
    plant: DescriptorSystem, model: Exosystem, value: complex, units: PlantUnits, lost: int | None,
    sizes: DescriptorSystem | None,
) -> tuple[Condition, RankDecision]:  # fmt: skip
    pencil = _ModelPencil.of(plant, model, value, sizes)
    decision = pencil.decision(lost)
    scaled, columns, courses = pencil.scaled, pencil.columns, pencil.courses
    inputs, direct, width = pencil.inputs, pencil.direct, courses.shape[1]
    own = units.eigenvalue(value)
    where = f"{'s' if plant.dt == 0.0 else 'z'} = {number(own)}"
    signals: tuple[str, ...] = ()
    detail = decision.describe()
    if not decision.full:
        direction = columns * np.linalg.svd(scaled)[2][-1].conj()
        faults = leading_names(np.abs(courses @ direction[plant.nx : plant.nx + width]), plant.fault_names)
        shares = in_disturbances(plant, inputs, direct, direction[plant.nx + width :])
        disturbances = _masking(scaled, plant, width, shares)
        signals = (*faults, *disturbances)
        masked = f" is masked by the unknown input {', '.join(map(repr, disturbances))}" if disturbances else ""
        alone = len(faults) == 1
        who = f"the fault {faults[0]!r}" if alone else f"a combination of the faults {', '.join(map(repr, faults))}"
        detail += (
            f": at {where} {who}{masked or ' is output-nulling'}: no output shows it, so no observer can estimate "
            f"{'it' if alone else 'them'}. Measure another signal, or leave one of them out."
        )
    return Condition(
        f"(D3) fault model at {number(own)}",
        f"rank [lambda E - A, -Bf Cw V, -Bd; C, Df Cw V, Dd] full at {where}, an eigenvalue of Phi",
        decision.full,
        float(decision.rank),
        float(decision.expected),
        "in place of Share Pasand, Theorems 1 and 2, which are false",
        detail,
        mode=None if decision.full else own,
        signals=signals,
    ), decision


def _model_doubt(
    plant: DescriptorSystem, model: Exosystem, units: PlantUnits, value: complex, *, other: str,
    decider: str = DECIDER, of_the_model: bool = False, tolerance: float = ROUNDING_LEVEL, moving: bool = False,
) -> Unclear:  # fmt: skip
    """Return why it is unclear whether plant and fault model hide something at a point, in the plant's own time."""
    kept = kept_disturbances(plant, numbers_of(plant))
    named = named_augmented(plant, model, units, kept=kept, of_the_model=of_the_model)
    return unclear(
        plant, named, tolerance=tolerance, point=value, dt=plant.dt if moving else None, other=other, decider=decider
    )


def order_conditions(
    given: DescriptorSystem, courses: Exosystem, plant: DescriptorSystem, model: Exosystem, units: PlantUnits
) -> list[Condition]:
    """Test that the fault model is not lost in rounding: at a zero z0 order n shows with about abs(z0)^(n + 1) only."""
    inputs, direct = np.hstack([plant.Bf, plant.Bd]), np.hstack([plant.Df, plant.Dd])
    wide_e, wide_a = system_pencil(plant.E, plant.A, inputs, plant.C, direct)
    zeros = finite_zeros(wide_e, wide_a)
    if zeros.normal_rank < wide_e.shape[1]:
        return []
    points = [complex(value) for value in zeros.values if value.imag >= 0.0 and is_outside(value, plant.dt)]
    augmented = AugmentedPlant.of(plant, model)
    own, shown = independent_disturbances(plant)
    below = np.vstack([own, np.zeros((model.order, own.shape[1]))])
    worst: tuple[RankDecision, complex] | None = None
    for point in points:
        matrix = np.block([[point * augmented.E - augmented.A, -below], [augmented.C.astype(complex), shown]])
        scaled, _ = equilibrated(matrix)
        decision = decide_rank(scaled, expected=matrix.shape[1], equilibrated=False)
        if worst is None or (decision.rank, decision.smallest_kept) < (worst[0].rank, worst[0].smallest_kept):
            worst = (decision, point)
    if worst is None:
        return []
    decision, point = worst[0], units.eigenvalue(worst[1])
    lost = (
        f": at the zero {number(point)} of (f, d) -> y the fault model (order {model.order}) cannot be told from "
        "nothing in double precision. Lower its order."
    )
    found = Condition(
        "order of the fault model",
        "the augmented plant is observable in double precision where faults can hide longest",
        decision.full,
        float(decision.rank),
        float(decision.expected),
        "ours: observable on paper is not enough",
        f"{decision.describe()} at {number(point)}" + ("" if decision.full else lost),
        mode=None if decision.full else point,
        signals=() if decision.full else plant.fault_names,
    )
    return [found if decision.full else found.in_doubt(_order_doubt(given, courses, units, point), given)]


def _order_doubt(plant: DescriptorSystem, model: Exosystem, units: PlantUnits, point: complex) -> Unclear:
    return _model_doubt(
        plant, model, units, point, of_the_model=True, tolerance=RANK_TOLERANCE, moving=True,
        other=f"hides a motion of plant and fault model at {number(point)}, and no observer sees it",
        decider="A fault model of lower order, or an output nearer to the fault, would decide it.",
    )  # fmt: skip


def lost_in_rounding(
    plant: DescriptorSystem, model: Exosystem, units: PlantUnits, mode: complex, order: int
) -> Condition:
    """Return the failing condition for a mode that seems fixed and unstable, against all other conditions."""
    found = Condition(
        "fault model in double precision",
        "no mode of plant and fault model seems hidden by rounding alone",
        False,
        order - 1.0,
        float(order),
        "ours: observable on paper is not enough",
        f"plant and fault model (order {model.order}) seem to hide an unstable mode at {number(mode)}, which the "
        "conditions above exclude: in double precision the model is too long a chain. Lower its order.",
        mode=mode,
        signals=plant.fault_names,
    )
    return found.in_doubt(_order_doubt(plant, model, units, mode), plant)


def _masking(scaled: NDArray[Any], plant: DescriptorSystem, width: int, shares: FloatArray) -> tuple[str, ...]:
    """Return the disturbances of a null vector; none where states alone already hide the fault."""
    without = scaled[:, : plant.nx + width]
    alone = decide_rank(without, expected=plant.nx + width, equilibrated=False)
    return leading_names(shares, plant.disturbance_names, most=MOST_NAMES) if alone.full else ()
