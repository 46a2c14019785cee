"""Least threshold of any test compared with each method's: the same bounds, delay and decoupled faults."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from obsynth.errors import ObsynthError
from obsynth.methods.candidates import SETTLING_TIMES
from obsynth.methods.fault_figures import on_the_clock, step_responses, steps_in_bounds
from obsynth.methods.functional_filter.rates import settling_time
from obsynth.methods.guaranteed_test.method import GuaranteedTestMethod
from obsynth.methods.guaranteed_test.problem import MOST_WINDOW_STATES, problem_of
from obsynth.methods.guaranteed_test.programs import largest_hidden_fault
from obsynth.monitoring.thresholds.residual_model import largest_disturbances
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.transformations.moving_disturbances import moving_columns
from obsynth.results.design import ObserverDesign
from obsynth.results.number_texts import upper_number
from obsynth.simulation.scenario import Scenario
from obsynth.studies.comparison import DEVIATIONS, LONGEST_WINDOW

#: What a response may differ from one sample of the fault, and be taken as it.
SAME_RESPONSE = 1e-6

#: A response is followed for `SETTLING_TIMES` and until its slowest mode is below this share, far below what is
#: printed, and for so many steps at most.
DECAYED, MOST_RESPONSE_STEPS = 1e-12, 20_000

#: No bound is known where the rest of a response, which is estimated, is more than this share of it.
LARGEST_REST = 1e-6


def thresholds_beside_least(
    plant: DescriptorSystem,
    impulses: FloatArray,
    faults: Sequence[str],
    bounds: FloatArray,
    radius: float,
    moving: FloatArray | None = None,
) -> list[tuple[float, float]]:
    """Return for each estimate what it never passes without a fault, and the least that any test with its delay has.

    ``plant`` sampled; ``impulses (steps, estimates, nf + nd + nw)`` as of `step_responses`, which shrink from step to
    step by ``radius`` in the end; ``bounds (nd,)`` of the disturbances, noise within `DEVIATIONS`.  Disturbances are
    held between samples, or move with the gains ``moving (estimates, nd)`` of `moving_gains`.  The first is a sum of
    absolute values; NaN where none is known.
    """
    noisy = bool(plant.Dw.any() or plant.Bw.any())
    noise = np.full(impulses.shape[2] - plant.nf - plant.nd, DEVIATIONS if noisy else 0.0)
    sizes = np.concatenate([np.zeros(plant.nf), bounds, noise])
    quarter = -(-len(impulses) // 4)
    later = radius**quarter / (1.0 - radius**quarter)
    pairs = []
    for row, name in enumerate(faults):
        gains = np.abs(impulses[:, row]).sum(axis=0)
        followed = float(gains[plant.nf :] @ sizes[plant.nf :])
        rest = later * float(np.abs(impulses[-quarter:, row, plant.nf :]).sum(axis=0) @ sizes[plant.nf :])
        if moving is not None:
            gains[plant.nf : plant.nf + plant.nd] = moving[row]
        bound = float(gains[plant.nf :] @ sizes[plant.nf :])
        # What comes after the steps that were followed is a part of the bound.
        share = rest / followed if followed > 0.0 else 0.0
        bound = bound * (1.0 + share) if share <= LARGEST_REST else float("nan")
        response = impulses[:, row, plant.fault_names.index(name)]
        lag = int(np.argmax(np.abs(response) > SAME_RESPONSE))
        alone = (
            abs(response[lag] - 1.0) <= SAME_RESPONSE
            and float(np.abs(response).sum() - abs(response[lag])) <= SAME_RESPONSE
        )
        blind = [other for k, other in enumerate(plant.fault_names) if other != name and gains[k] <= SAME_RESPONSE]
        pairs.append(
            (
                bound,
                _least(
                    plant, name, bounds, noisy=noisy, lag=lag if alone else None, blind=blind, moves=moving is not None
                ),
            )
        )
    return pairs


def response_steps(
    plant: DescriptorSystem, observer: LinearObserver, steps: int
) -> tuple[tuple[int, FloatArray], float]:
    """Return for how many steps, ``steps`` at least, and with which feedback responses of a sampled plant are followed,
    as of `steps_in_bounds`, and the radius of the slowest mode of plant and observer that decays."""
    sizes = np.abs(np.concatenate([np.linalg.eigvals(part) for part in (plant.A, observer.Az)]))
    radius = float(np.max(sizes[sizes < 1.0], initial=0.0))
    more = observer.order + 2
    if radius > 0.0:
        more += int(min(np.log(DECAYED) / np.log(radius), MOST_RESPONSE_STEPS))
    return steps_in_bounds(plant, max(steps, min(more, MOST_RESPONSE_STEPS))), radius


def moving_gains(
    plant: DescriptorSystem, observer: LinearObserver, steps: int, feedback: FloatArray
) -> FloatArray | None:
    """Return what a disturbance of any course within one does to each estimate at most ``(estimates, nd)``; ``None``
    where nothing is known of a sampled plant between its samples."""
    moving = moving_columns(plant)
    if moving is None:
        return None
    nx, nd = plant.nx, plant.nd
    # Sums over a sample by columns, and the value at the sample, which outputs show at once.
    columns, values = np.hstack([moving.columns, moving.directions]), np.where(moving.moved, 0.0, plant.Bd)
    count = columns.shape[1]
    driven = plant.replace(
        Bd=np.hstack([columns, values]),
        Dd=np.hstack([np.zeros((plant.ny, count)), plant.Dd]),
        disturbance_names=None,
        units={},
        operating_point={},
    )
    impulses, _ = step_responses(driven, observer, steps, feedback)
    gains = np.abs(impulses[:, :, plant.nf : plant.nf + count + nd]).sum(axis=0)
    moved, turned, direct = np.split(gains, [count - nx, count], axis=1)
    return np.asarray(moved.reshape(len(moved), -1, nd).sum(axis=1) + turned @ moving.sizes + direct)


def _least(
    plant: DescriptorSystem,
    fault: str,
    bounds: FloatArray,
    *,
    noisy: bool,
    lag: int | None,
    blind: list[str],
    moves: bool,
) -> float:
    """Return the least threshold: of a fault of any time course told after a lag, else of a constant one."""
    time_course = {"course": "constant"} if lag is None else {"course": "any", "lag": lag}
    samples = max(window_length(plant), (lag or 0) + 2)
    try:
        test = GuaranteedTestMethod.of(
            {
                "fault": fault,
                "samples": samples,
                "free": blind,
                "noise_bound": DEVIATIONS if noisy else None,
                "disturbance_bounds": dict(zip(plant.disturbance_names, bounds.tolist(), strict=True)),
                "disturbance": "any" if moves else "jump",
                **time_course,
            }
        )
        size = largest_hidden_fault(problem_of(plant, test).window(samples)).size
    except ObsynthError:
        return float("nan")
    return size if np.isfinite(size) else float("nan")


def window_length(plant: DescriptorSystem) -> int:
    """Return how many samples of inputs and outputs tests have, whose least is computed."""
    return min(LONGEST_WINDOW, MOST_WINDOW_STATES // max(plant.nx, 1))


def in_words(
    fault: str,
    bound: float,
    least: float,
    unit: str = "",
    *,
    disturbed: bool = True,
    moving: bool = False,
    noisy: bool = False,
    samples: int = LONGEST_WINDOW,
) -> str:
    """Return a sentence on one fault; ``disturbed``: whether plant and scenario have disturbances; ``moving``: whether
    those move between samples; ``noisy``: whether the plant has noise, which counts as within `DEVIATIONS`;
    ``samples``: of the tests, see `window_length`."""
    size = f"{upper_number(bound, digits=3)}{f' {unit}' if unit else ''}"
    motion = f"{'move within their bounds' if moving else 'are held'} between samples"
    assumed = f" and disturbances {motion} (those of the scenario)" if disturbed else ""
    noise = f", with noise within {DEVIATIONS:g} standard deviations" if noisy else ""
    own = (
        f"Fault-free, once the start has died out, if the model is exact{assumed}{noise}, |estimate of {fault}| "
        f"<= {size}"
    )
    acting = [name for name, acts in (("disturbances", disturbed), ("noise", noisy)) if acts]
    if not acting:
        return f"{own}: the scenario has neither disturbances nor noise."
    if not np.isfinite(least):
        return f"{own}. The smallest possible threshold is not known."
    if bound == 0.0:
        return f"{own}: the {' and '.join(acting)} of the scenario do not reach it."
    if least <= SAME_RESPONSE * bound:
        return f"{own}. A test immune to the {' and '.join(acting)} of the scenario exists (guaranteed-test)."
    if bound < least:
        return (
            f"{own}: less than any test with its delay on at most {samples} samples of inputs and outputs has "
            f"({least:.4g}{f' {unit}' if unit else ''}), as the observer remembers more of them."
        )
    return (
        f"{own}, {bound / least:.2f} times the optimum of all tests with its delay on at most {samples} "
        f"samples of inputs and outputs ({least:.4g}{f' {unit}' if unit else ''})."
    )


def design_beside_least(design: ObserverDesign, scenario: Scenario) -> dict[str, tuple[float, float]]:
    """Return the same by fault for a linear design that estimates faults, on a scenario; empty for others.

    Disturbances move between samples where the plant in continuous time is known."""
    if not isinstance(design.observer, LinearObserver) or not isinstance(design.plant, DescriptorSystem):
        return {}
    plant, observer = design.linear
    if not plant.is_discrete or not observer.fault_names:
        return {}
    try:
        sampled = on_the_clock(plant, plant.dt)
        steps = int(min(max(SETTLING_TIMES * settling_time(plant) / plant.dt, observer.order + 2), MOST_RESPONSE_STEPS))
        (steps, feedback), radius = response_steps(sampled, observer, steps)
        impulses, _ = step_responses(sampled, observer, steps, feedback)
        bounds = largest_disturbances(scenario, sampled.disturbance_names, plant.dt)
        moving = moving_gains(sampled, observer, steps, feedback)
        pairs = thresholds_beside_least(sampled, impulses, observer.fault_names, bounds, radius, moving)
    except ObsynthError:
        return {}
    return {name: pair for name, pair in zip(observer.fault_names, pairs, strict=True) if np.isfinite(pair[0])}


def is_disturbed(design: ObserverDesign, scenario: Scenario) -> bool:
    """Whether the scenario has a disturbance of the plant of a design."""
    plant, _ = design.linear
    return bool(plant.nd) and bool(largest_disturbances(scenario, plant.disturbance_names, plant.dt).any())


def is_moving(design: ObserverDesign) -> bool:
    """Whether the bounds of `design_beside_least` count disturbances that move between samples."""
    return isinstance(design.plant, DescriptorSystem) and moving_columns(design.plant) is not None
