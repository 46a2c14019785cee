"""The method by default: those that exist, designed; the best by closed-form figures on one clock."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any

import numpy as np

from obsynth.analysis.existence.condition import OPTIONS_PATH, without_opening
from obsynth.errors import ObsynthError, PreconditionError, SpecError
from obsynth.methods.fault_figures import FaultFigures, fault_figures, on_the_clock, without_algebraic_states
from obsynth.methods.functional_filter.rates import settling_time
from obsynth.methods.method import Method, Purpose
from obsynth.methods.registry import REGISTRY, kind_of, method_class, methods_for
from obsynth.numerics.arguments import field_types
from obsynth.numerics.suggestions import suggestion
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.linear.sampled import sample_observer
from obsynth.observers.recursive.steady_observer import steady_observer
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import ObserverDesign
from obsynth.simulation.scenario import Scenario
from obsynth.simulation.signals import resolve

#: Peak gain from an unknown input to a fault estimate, in fault per input, above which it is not decoupled.
DECOUPLED = 1e-3

#: Samples of a plant's settling time on a clock of its own.
SETTLING_SAMPLES = 200

#: An estimate that shows 90 % of a step later than this share of the plant's settling time comes after faster ones,
#: unless its noise times the root of its delay is so many times less.
SLOW_ESTIMATE, SLOW_GAIN = 0.25, 10.0

#: Deviations of an estimate that a fault of a scenario must be at least, so that noise does not hide it.
SEEN_DEVIATIONS = 2.0

#: The condition that a refusal names, and what stands between it and what was found.
_REFUSED_CONDITION = re.compile(r"(the condition '[^']+' fails) .*? Found: ")

#: Letters of a message to which further sentences are shown.
MOST_LETTERS = 160

#: How many settling times figures look ahead.
SETTLING_TIMES, MOST_FIGURE_SAMPLES = 8, 2000

Maker = Callable[[Any, str, Mapping[str, Any]], ObserverDesign]


@dataclass(frozen=True, eq=False)
class Expected:
    """What a scenario says of a plant on a clock: the plant with the scenario's noise, and sizes of faults by name."""

    plant: DescriptorSystem
    sizes: Mapping[str, float]


def expected_of(sampled: DescriptorSystem, scenario: Scenario | None) -> Expected | None:
    """Return what a scenario says of a sampled plant; nothing where there is none that fits it."""
    if scenario is None:
        return None
    try:
        signals = resolve(sampled, scenario.replace(sample_time=None))
    except ObsynthError:
        # A scenario that is none of this plant is refused where it is simulated.
        return None
    first = sampled.nu
    largest = np.abs(signals.at_begin[:, first : first + sampled.nf]).max(axis=0)
    sizes = {name: float(size) for name, size in zip(sampled.fault_names, largest, strict=True) if size > 0.0}
    factor, deviations = scenario.noise or 1.0, np.array(signals.deviations)
    plant = sampled
    if factor != 1.0 or deviations.any():
        plant = sampled.replace(
            Bw=np.hstack([factor * sampled.Bw, np.zeros((sampled.nx, sampled.ny))]),
            Dw=np.hstack([factor * sampled.Dw, np.diag(deviations)]),
            noise_names=None,
        )
    # Nothing is hidden by noise that nobody stated.
    return Expected(plant, sizes if plant.Bw.any() or plant.Dw.any() else {})


@dataclass(frozen=True, eq=False)
class Candidate:
    """A method for a plant: its design and figures, or why there is none."""

    method: str
    design: ObserverDesign | None
    observer: LinearObserver | None  # on the clock
    figures: tuple[FaultFigures, ...]  # of each fault
    milliseconds: float  # to design
    refused: str
    sizes: Mapping[str, float] = field(default_factory=dict)  # of faults, where a scenario states them

    @property
    def hidden(self) -> tuple[str, ...]:
        """Faults of a scenario that the noise of the estimate hides."""
        return tuple(
            figure.fault
            for figure in self.figures
            if figure.fault in self.sizes and not self.sizes[figure.fault] >= SEEN_DEVIATIONS * figure.deviation
        )

    def rank(self, has_unknown_inputs: bool, settling: float = np.inf) -> tuple[float, ...]:
        """Return what sorts candidates, best first; ``settling``: the plant's time (s); and whether the plant
        has unknown inputs."""
        if not self.figures:
            return (2.0, 0.0, 0.0, np.inf)
        missed = float(not all(fault.reaches for fault in self.figures))
        coupled = float(has_unknown_inputs and any(fault.unknown_input_gain > DECOUPLED for fault in self.figures))
        dt = self.observer.dt if self.observer is not None else 0.0
        # A mean over time T divides noise by the root of T: it cannot change deviation times the root of delay.
        prices = [fault.deviation * np.sqrt(max(fault.most, dt)) for fault in self.figures]
        price = float(np.prod(prices) ** (1.0 / len(prices))) if np.all(np.isfinite(prices)) else np.inf
        slow = any(fault.most > SLOW_ESTIMATE * settling for fault in self.figures)
        return (missed, coupled, float(len(self.hidden)), price * (SLOW_GAIN if slow else 1.0))


def candidate(
    method: str,
    plant: DescriptorSystem,
    sampled: DescriptorSystem,
    steps: int,
    maker: Callable[[DescriptorSystem, str, Mapping[str, Any]], ObserverDesign],
    options: Mapping[str, Any],
    *,
    continuous: bool = False,
    expected: Expected | None = None,
) -> Candidate:
    """Return one method for a plant; on the sampled plant where it can be, or else (or if asked) sampled afterwards;
    with figures of what is expected of the plant."""
    known = method_class(method)
    if "time-invariant" not in known.plants:
        return _refused(method, "for nonlinear plants")
    begun = perf_counter()
    try:
        in_own_time = continuous or known.time == "continuous"
        designed_for: Any = plant if in_own_time else sampled
        if not in_own_time and plant.dt > 0.0 and plant.nx > sampled.nx:
            # With the way back to the algebraic states, which are estimated as well.
            designed_for = without_algebraic_states(plant)
        made = maker(designed_for, method, options)
        observer = _sampled(made, sampled.dt)
    except ObsynthError as error:
        return _refused(method, one_line(str(error)), 1e3 * (perf_counter() - begun))
    spent = 1e3 * (perf_counter() - begun)
    if not observer.fault_names or any(name not in sampled.fault_names for name in observer.fault_names):
        why = "estimates the state, but no fault" if observer.state_names else "detects faults, but estimates none"
        return _refused(method, why, spent)
    judged, sizes = (sampled, {}) if expected is None else (expected.plant, expected.sizes)
    return Candidate(method, made, observer, fault_figures(judged, observer, steps), spent, "", sizes)


def _sampled(design: ObserverDesign, dt: float) -> LinearObserver:
    if isinstance(design.observer, LinearObserver):
        return design.observer if design.observer.dt > 0.0 else sample_observer(design.observer, dt)
    return steady_observer(design.recursive[1]).observer


def _refused(method: str, reason: str, spent: float = 0.0) -> Candidate:
    return Candidate(method, None, None, (), spent, reason)


def one_line(text: str) -> str:
    """Return the start of a message in one line, with what would help, which stands at its end."""
    flat = _REFUSED_CONDITION.sub(r"\1: ", " ".join(text.replace("\n  - ", " ").split()))
    for mark in ("Measure one of:", "Leave out one of:"):
        head, separator, tail = flat.rpartition(mark)
        if separator:
            return f"{_first_sentences(head)} {mark}{tail}"
    return _first_sentences(flat)


def _first_sentences(text: str) -> str:
    """Return so many whole sentences of a text as have room, and the first in any case."""
    first, *sentences = re.split(r"(?<=[.]) (?=[A-Z])", (without_opening(text) or text).strip())
    for sentence in sentences:
        if len(first) + len(sentence) >= MOST_LETTERS:
            break
        first += f" {sentence}"
    return first


def linear_methods() -> Sequence[type[Method]]:
    """Return the methods that take linear plants with constant matrices."""
    return [method for method in map(method_class, REGISTRY) if "time-invariant" in method.plants]


def _methods_with(purpose: Purpose, among: Iterable[str]) -> list[str]:
    """Return the methods of a list that serve a purpose."""
    return [method for method in among if purpose in method_class(method).purposes]


def _no_method_with(options: Iterable[str]) -> SpecError:
    known = {name for method in linear_methods() for name in field_types(method)}
    unknown = next((name for name in sorted(options) if name not in known), None)
    text = (
        f"No single method has the options {', '.join(sorted(options))}: name the method they are for."
        if unknown is None
        else f"No method has the option {unknown!r}.{suggestion(unknown, sorted(known))}"
    )
    return SpecError(text, path=OPTIONS_PATH)


def automatic_design(
    plant: Any, options: Mapping[str, Any], maker: Maker, refusing: Maker, scenario: Scenario | None = None
) -> ObserverDesign:
    """Return the design of the method chosen; ``maker(plant, method, options)``; ``refusing`` says what would help; a
    ``scenario`` says the noise and how large faults are."""
    if not isinstance(plant, DescriptorSystem):
        purpose: Purpose = "parameters" if plant.parameter_names else "state despite noise"
        known = methods_for(kind_of(plant))
        return maker(plant, next(iter(_methods_with(purpose, known)), known[0]), options)
    possible = [method.id for method in linear_methods() if set(options) <= set(field_types(method))]
    if not possible:
        raise _no_method_with(options)
    if plant.nf == 0:
        order: list[Purpose] = ["state despite unknown inputs", "state despite noise"]
        if plant.nw and not plant.nd:
            order.reverse()
        refusals = []
        for each in [name for purpose in order for name in _methods_with(purpose, possible)]:
            try:
                return _with_note(maker(plant, each, options), "there are no faults to estimate")
            except ObsynthError as error:
                refusals.append(error)
        if refusals:
            raise refusals[0]
        raise SpecError("The plant has no faults, and the options are for methods that estimate some.", path="method")
    return _chosen(plant, options, possible, maker, refusing, scenario)


def _chosen(
    plant: DescriptorSystem,
    options: Mapping[str, Any],
    possible: list[str],
    maker: Maker,
    refusing: Maker,
    scenario: Scenario | None,
) -> ObserverDesign:
    candidates = [entry for entry in designed(plant, options, possible, maker, scenario) if entry.design is not None]
    if not candidates:
        # What forbids the one that needs least forbids the fault.
        purposes: tuple[Purpose, ...] = ("faults under the weakest conditions", "faults")
        last = next((name for purpose in purposes for name in _methods_with(purpose, possible)), possible[0])
        return refusing(plant, last, options)
    settling = settling_time(plant)
    best, *ranked_below = sorted(candidates, key=lambda entry: entry.rank(plant.nd > 0, settling))
    if best.design is None:
        raise PreconditionError("No method exists for this plant.", condition="existence")
    return _with_note(best.design, reason(best, ranked_below, plant))


def designed(
    plant: DescriptorSystem,
    options: Mapping[str, Any],
    methods: list[str],
    maker: Maker,
    scenario: Scenario | None = None,
) -> list[Candidate]:
    """Return every method for a plant in its own time, with figures on one clock: its own, or that of a scenario."""
    stated = None if scenario is None else scenario.sample_time
    step = plant.dt if plant.dt > 0.0 else stated or settling_time(plant) / SETTLING_SAMPLES
    steps = int(min(max(SETTLING_TIMES * settling_time(plant) / step, 50), MOST_FIGURE_SAMPLES))
    try:
        sampled = on_the_clock(plant, step)
    except ObsynthError:
        # Not of index one: only methods that need no elimination are left, and nothing to compare on.
        return []
    own_time, expected = plant.dt == 0.0, expected_of(sampled, scenario)
    fitting = [
        method
        for method in _methods_with("faults", methods)
        if not (plant.dt > 0.0 and method_class(method).time == "continuous")
    ]
    return [
        candidate(method, plant, sampled, steps, maker, options, continuous=own_time, expected=expected)
        for method in fitting
    ]


def reason(best: Candidate, ranked_below: list[Candidate], plant: DescriptorSystem) -> str:
    """Return in one sentence why a candidate is first."""
    if not ranked_below:
        return "no other method exists for this plant"
    gain = max(fault.unknown_input_gain for fault in best.figures)
    words = ["its estimates reach every step"] if best.rank(False)[0] == 0.0 else []
    if plant.nd:
        words.append(f"gain from the unknown inputs {gain:.1e}")
    deviation = ", ".join(f"{fault.deviation:.3g}" for fault in best.figures)
    delay = ", ".join(f"{fault.most:.3g}" for fault in best.figures)
    words.append(f"90 % of a step after {delay} s, with a deviation of {deviation}")
    below = ", ".join(
        f"{other.method} (its noise hides {' and '.join(other.hidden)} of the scenario)"
        if other.hidden and not best.hidden
        else other.method
        for other in ranked_below
    )
    if best.hidden:
        words.append(f"its noise hides {' and '.join(best.hidden)} of the scenario")
    return f"{'; '.join(words)}; ranked below it: {below}; obsynth compare ranks by errors over a scenario instead"


def _with_note(design: ObserverDesign, why: str) -> ObserverDesign:
    return design.replace(notes=(f"Method chosen by auto: {design.method} ({why}).", *design.notes))
