"""The method by default: those that exist, designed; the best by closed-form figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from obsynth.errors import ObsynthError, PreconditionError, SpecError
from obsynth.methods.choosing.candidates import CONTINUOUS_ONLY, Candidate, candidate, linear_methods
from obsynth.methods.choosing.figures import on_the_clock
from obsynth.methods.functional_filter.rates import settling_time
from obsynth.plants.dae.model import DAEModel
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.results.design import ObserverDesign

#: Samples of the plant's settling time, and how many settling times figures look ahead.
SAMPLES, SETTLING_TIMES, MOST_STEPS = 200, 8, 2000
Maker = Callable[[Any, str, Mapping[str, Any]], ObserverDesign]
#: Linear methods whose estimates of faults are compared; the recursive ones estimate parameters, or no fault.
FAULT_METHODS = ("fault-estimation-filter", "pd-observer", "ui-pi-observer", "functional-filter")


def automatic_design(plant: Any, options: Mapping[str, Any], maker: Maker, refusing: Maker) -> ObserverDesign:
    """Return the design of the method chosen, with a note that says why.

    ``maker(plant, method, options)`` designs; ``refusing`` does too, and says what would help where it refuses.
    """
    if isinstance(plant, DAEModel):
        return maker(plant, "dae-adaptive-observer", options)
    if isinstance(plant, TimeVaryingDescriptorSystem):
        method = "adaptive-observer" if plant.parameter_names else "descriptor-kalman"
        return maker(plant, method, options)
    possible = [spec.id for spec in linear_methods() if set(options) <= set(spec.option_names)]
    if not possible:
        raise SpecError(
            f"No single method has the options {', '.join(sorted(options))}: name the method they are for.",
            path="method.options",
        )
    if plant.nf == 0:
        return _for_the_state(plant, options, possible, maker)
    return _chosen(plant, options, possible, maker, refusing)


def _for_the_state(
    plant: DescriptorSystem, options: Mapping[str, Any], possible: list[str], maker: Maker
) -> ObserverDesign:
    """Return an observer of the state: there are no faults."""
    order = (
        ["ui-pi-observer", "descriptor-kalman"]
        if plant.nd or not plant.nw
        else [
            "descriptor-kalman",
            "ui-pi-observer",
        ]
    )
    refusals = []
    for method in [name for name in order if name in possible]:
        try:
            return _with_note(maker(plant, method, options), "there are no faults to estimate")
        except ObsynthError as error:
            refusals.append(error)
    if refusals:
        raise refusals[0]
    raise SpecError("The plant has no faults, and the options are for methods that estimate some.", path="method")


def _chosen(
    plant: DescriptorSystem, options: Mapping[str, Any], possible: list[str], maker: Maker, refusing: Maker
) -> ObserverDesign:
    found = [entry for entry in designed(plant, options, possible, maker) if entry.design is not None]
    if not found:
        # The functional filter needs least: what forbids it forbids the fault.
        last = next((name for name in ("functional-filter", *FAULT_METHODS) if name in possible), possible[0])
        return refusing(plant, last, options)
    settling = settling_time(plant)
    best, *others = sorted(found, key=lambda entry: entry.rank(plant.nd > 0, settling))
    if best.design is None:
        raise PreconditionError("No method exists for this plant.", condition="existence")
    return _with_note(best.design, reason(best, others, plant))


def designed(plant: DescriptorSystem, options: Mapping[str, Any], methods: list[str], maker: Maker) -> list[Candidate]:
    """Return every method for a plant in its own time, with figures on one clock."""
    step = plant.dt if plant.dt > 0.0 else settling_time(plant) / SAMPLES
    steps = int(min(max(SETTLING_TIMES * settling_time(plant) / step, 50), MOST_STEPS))
    try:
        sampled = on_the_clock(plant, step)
    except ObsynthError:
        # Not of index one: only methods that need no elimination are left, and nothing to compare on.
        return []
    own_time = plant.dt == 0.0
    taken = [m for m in methods if m in FAULT_METHODS and not (plant.dt > 0.0 and m in CONTINUOUS_ONLY)]
    return [candidate(method, plant, sampled, steps, maker, options, continuous=own_time) for method in taken]


def reason(best: Candidate, others: list[Candidate], plant: DescriptorSystem) -> str:
    """Return in one sentence why a candidate is first."""
    if not others:
        return "no other method exists for this plant"
    worst_leak = max(found.leak for found in best.figures)
    words = ["it reaches every step"] if best.rank(False)[0] == 0.0 else []
    if plant.nd:
        words.append(f"unknown inputs leak by {worst_leak:.1e}")
    deviation = ", ".join(f"{found.deviation:.3g}" for found in best.figures)
    delay = ", ".join(f"{found.most:.3g}" for found in best.figures)
    words.append(f"deviation {deviation} at 90 % of a step after {delay} s")
    return f"{'; '.join(words)}; after it: {', '.join(other.method for other in others)}"


def _with_note(design: ObserverDesign, why: str) -> ObserverDesign:
    return design.replace(notes=(f"Method chosen by auto: {design.method} ({why}).", *design.notes))
