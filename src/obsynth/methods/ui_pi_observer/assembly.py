"""Realisation and certificate of the gains of an unknown-input PI observer, computed or given."""

from __future__ import annotations

from typing import Any

import numpy as np

from obsynth.conditions.augmented_plant import measured_combinations, realise, with_faults
from obsynth.methods.method import Synthesis, plain
from obsynth.numerics.arguments import require_shape
from obsynth.numerics.arrays import ComplexArray, FloatArray, as_matrix
from obsynth.numerics.spectra import (
    PRINTED_DIGITS,
    abscissa,
    as_printed,
    decay_rates,
    digits_needed,
    eigenvalues,
    farthest_pole,
    rounding_of_eigenvalues,
)
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.faults import Exosystem, exosystem
from obsynth.proofs.covariances import certain_noise_covariance
from obsynth.proofs.extended_balls import enclosed_eigenvalues, middle_of
from obsynth.results.design import Certificate
from obsynth.verification.inequalities import slowest_decay, stability_factor

#: Poles of what is shipped that are this close to those asked for, relative to their size, are claimed as asked.
SAME_AS_ASKED = 5e-5

#: Poles that a rounding of Ahat moves by more than this, relative to their size, are claimed as they are enclosed: what
#: an algorithm finds of them another processor does not find again to the share that is allowed.
KNOWN_POLES = 1e-6


def synthesis_from_gains(plant: DescriptorSystem, *, U: Any, D: Any, K: Any, F: Any, fault_model: Any) -> Synthesis:
    """Return the realisation of given gains; see `obsynth.design_from_gains`."""
    model = exosystem(fault_model, plant.fault_names, plant.dt)
    nx, ny, count = plant.nx, plant.ny, model.order
    matrices = {name: as_matrix(value, name) for name, value in (("U", U), ("D", D), ("K", K), ("F", F))}
    shapes = {"U": (nx, nx), "D": (nx, ny), "K": (nx, ny), "F": (count, ny)}
    for name, shape in shapes.items():
        require_shape(matrices[name].shape, shape, name)
    u, d = with_faults(matrices["U"], matrices["D"], plant, model)
    gains = u, d, np.vstack([matrices["K"], matrices["F"]])
    options = {"from_gains": True, "fault_model": plain(fault_model)}
    synthesis = assembled(plant, model, gains, None, {}, structured=True)
    return Synthesis(options, synthesis.gains, synthesis.observer, synthesis.certificate)


def assembled(
    plant: DescriptorSystem,
    model: Exosystem,
    gains: tuple[FloatArray, FloatArray, FloatArray],
    poles: ComplexArray | None,
    claims: dict[str, float],
    *,
    structured: bool,
) -> Synthesis:
    """Return realisation and certificate of gains in the plant's units; poles that were not asked for are computed."""
    observer, letters = realise(plant, model, gains, measured_combinations(plant))
    nx, (u, d, k) = plant.nx, gains
    if structured:
        letters |= {"U": u[:nx, :nx], "D": d[:nx], "K": k[:nx], "F": k[nx:]}
        letters["Hhat"] = letters["U"] @ plant.Bf
    letters |= {"Phi": model.Phi, "Cw": model.Cw}
    poles = _shipped_poles(observer, poles)
    order = np.lexsort((poles.imag, poles.real))
    matrices = {
        "tracking": u,
        "Phi": model.Phi,
        "Cw": model.Cw,
        "poles": np.column_stack([poles.real, poles.imag])[order] if poles.size else np.zeros((0, 2)),
        "stability": stability_factor(observer),
    }
    slowest = slowest_decay(observer.Az, plant.dt)
    claims = {"decay": slowest, "noise_amplification": noise_amplification(observer), **claims}
    if not abscissa(as_printed(observer.Az, PRINTED_DIGITS), plant.dt) < (1.0 if plant.dt > 0.0 else 0.0):
        claims["digits"] = float(digits_needed(observer.Az, plant.dt))
    finite = {name: value for name, value in claims.items() if np.isfinite(value)}
    return Synthesis({}, letters, observer, Certificate(matrices, finite))


def _shipped_poles(observer: LinearObserver, stated: ComplexArray | None) -> ComplexArray:
    """Return the poles as asked for where the stored numbers have them, else those that they have: what is shipped."""
    computed = eigenvalues(observer.Az)
    if stated is not None and farthest_pole(computed, stated, observer.dt) <= SAME_AS_ASKED:
        return stated
    if (
        stated is None
        and len(computed)
        and rounding_of_eigenvalues(observer.Az) <= KNOWN_POLES
        and slowest_decay(observer.Az, observer.dt) == np.min(decay_rates(computed, observer.dt), initial=np.inf)
    ):
        return computed
    enclosed = enclosed_eigenvalues(observer.Az)
    if enclosed is None:
        return computed
    exact = np.array([middle_of(ball) for ball in enclosed])
    return stated if stated is not None and farthest_pole(exact, stated, observer.dt) <= SAME_AS_ASKED else exact


def noise_amplification(observer: LinearObserver) -> float:
    """Return the largest H2 norm from unit white noise on every output to a fault estimate, the direct part left out.

    NaN where rounding leaves no digit of it.  For dt = 0 times the root of the time for which noise is held.
    """
    rows = observer.Cz[observer.fault_rows]
    direct = observer.Dy[observer.fault_rows] * (observer.dt > 0.0)
    stable = abscissa(observer.Az, observer.dt) < (1.0 if observer.dt > 0.0 else 0.0)
    if not len(rows) or not stable:
        return 0.0 if not len(rows) else float("inf")
    covariance = certain_noise_covariance(observer.Az, observer.By, rows, direct, observer.dt)
    return float(np.sqrt(np.max(np.maximum(np.diag(covariance), 0.0))))
