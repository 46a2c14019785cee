"""Beside every method's threshold the least that any test can have: same bounds, same delay, same faults left out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from obsynth.errors import ObsynthError
from obsynth.methods.automatic import SETTLING_TIMES
from obsynth.methods.fault_figures import held, on_the_clock, step_responses
from obsynth.methods.functional_filter.rates import settling_time
from obsynth.methods.guaranteed_test.method import GuaranteedTestMethod
from obsynth.methods.guaranteed_test.problem import MOST_WINDOW_STATES, problem_of
from obsynth.methods.guaranteed_test.programs import largest_hidden_fault
from obsynth.monitoring.thresholds.residual_model import largest_disturbances
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import ObserverDesign
from obsynth.simulation.scenario import Scenario
from obsynth.studies.comparison import LONGEST_WINDOW

#: Noise counts as within so many deviations.
DEVIATIONS = 3.0

#: What a response may differ from one sample of the fault, and be taken as it.
SAME_RESPONSE = 1e-6

#: A response is followed for `SETTLING_TIMES`, and for so many steps at most.
MOST_RESPONSE_STEPS = 6000


def thresholds_beside_least(
    plant: DescriptorSystem, impulses: FloatArray, faults: Sequence[str], bounds: FloatArray
) -> list[tuple[float, float]]:
    """Return for each estimate what it never passes without a fault, and the least that any test with its delay has.

    ``plant`` sampled, disturbances held between its samples; ``impulses (steps, estimates, nf + nd + nw)`` as of
    `step_responses`; ``bounds (nd,)`` of the disturbances, noise within `DEVIATIONS`.  The first is a sum of absolute
    values; NaN where none is known.
    """
    noisy = bool(plant.Dw.any() or plant.Bw.any())
    noise = np.full(impulses.shape[2] - plant.nf - plant.nd, DEVIATIONS if noisy else 0.0)
    found = []
    for row, name in enumerate(faults):
        gains = np.abs(impulses[:, row]).sum(axis=0)
        bound = float(gains[plant.nf :] @ np.concatenate([bounds, noise]))
        seen = impulses[:, row, plant.fault_names.index(name)]
        lag = int(np.argmax(np.abs(seen) > SAME_RESPONSE))
        alone = abs(seen[lag] - 1.0) <= SAME_RESPONSE and float(np.abs(seen).sum() - abs(seen[lag])) <= SAME_RESPONSE
        blind = [other for k, other in enumerate(plant.fault_names) if other != name and gains[k] <= SAME_RESPONSE]
        found.append((bound, _least(plant, name, bounds, noisy=noisy, lag=lag if alone else None, blind=blind)))
    return found


def _least(
    plant: DescriptorSystem, fault: str, bounds: FloatArray, *, noisy: bool, lag: int | None, blind: list[str]
) -> float:
    """Return the least threshold: of a fault of any time course told after a lag, else of a constant one."""
    course = {"course": "constant"} if lag is None else {"course": "any", "lag": lag}
    samples = max(min(LONGEST_WINDOW, MOST_WINDOW_STATES // max(plant.nx, 1)), (lag or 0) + 2)
    try:
        asked = GuaranteedTestMethod.of(
            {
                "fault": fault,
                "samples": samples,
                "free": blind,
                "noise_bound": DEVIATIONS if noisy else None,
                "disturbance_bounds": dict(zip(plant.disturbance_names, bounds.tolist(), strict=True)),
                "disturbance": "jump",
                **course,
            }
        )
        size = largest_hidden_fault(problem_of(plant, asked).window(samples)).size
    except ObsynthError:
        return float("nan")
    return size if np.isfinite(size) else float("nan")


def in_words(fault: str, bound: float, least: float, unit: str = "") -> str:
    """Return a sentence on one fault."""
    size = f"{bound:.3g}{f' {unit}' if unit else ''}"
    own = (
        f"Fault-free, if the model is exact and disturbances are held between samples, |estimate of {fault}| <= {size}"
    )
    if not np.isfinite(least):
        return f"{own}. The smallest possible threshold is not known."
    if least <= SAME_RESPONSE * bound:
        return f"{own}. A test immune to disturbances and noise exists (guaranteed-test)."
    return (
        f"{own}, {bound / least:.2f} times the optimum of all tests with its delay on at most {LONGEST_WINDOW} "
        f"samples ({least:.4g})."
    )


def design_beside_least(design: ObserverDesign, scenario: Scenario) -> dict[str, tuple[float, float]]:
    """Return the same by fault for a linear design that estimates faults, on a scenario; empty for others."""
    if not isinstance(design.observer, LinearObserver) or not isinstance(design.plant, DescriptorSystem):
        return {}
    plant, observer = design.linear
    if not plant.is_discrete or not observer.fault_names:
        return {}
    try:
        sampled = on_the_clock(plant, plant.dt)
        steps = int(min(max(SETTLING_TIMES * settling_time(plant) / plant.dt, observer.order + 2), MOST_RESPONSE_STEPS))
        steps, feedback = held(sampled, steps)
        impulses, _ = step_responses(sampled, observer, steps, feedback)
        bounds = largest_disturbances(scenario, sampled.disturbance_names, steps, plant.dt)
    except ObsynthError:
        return {}
    pairs = thresholds_beside_least(sampled, impulses, observer.fault_names, bounds)
    return dict(zip(observer.fault_names, pairs, strict=True))
