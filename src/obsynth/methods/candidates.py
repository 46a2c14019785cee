"""Candidate methods for a plant: each method's design with figures of its fault estimates, at one sample time."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any

import numpy as np

from obsynth.analysis.existence.condition import without_opening
from obsynth.errors import ObsynthError
from obsynth.methods.fault_figures import FaultFigures, fault_figures, on_the_clock, without_algebraic_states
from obsynth.methods.functional_filter.rates import settling_time
from obsynth.methods.method import Method, Purpose
from obsynth.methods.registry import REGISTRY, method_class
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.linear.sampled import sample_observer
from obsynth.observers.recursive.steady_observer import steady_observer
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import ObserverDesign
from obsynth.simulation.scenario import Scenario
from obsynth.simulation.signals import resolve

#: A fault estimate counts as decoupled if an unknown input shows in it as at most this share of the fault that moves
#: the outputs as much.
DECOUPLED = 1e-3

#: Number of samples in the settling time of a continuous plant, where no sample time is stated.
SETTLING_SAMPLES = 200

#: An estimate is slow if it shows 90 % of a step only after this share of the plant's settling time.  A slow estimate
#: ranks below a fast one unless its noise, times the root of its delay, is less by the factor SLOW_GAIN.
SLOW_ESTIMATE, SLOW_GAIN = 0.25, 10.0

#: Noise hides a fault of a scenario that is smaller than this many standard deviations of its estimate.
SEEN_DEVIATIONS = 2.0

#: In a message of refusal: the name of the failing condition, its statement, and the words before what was computed.
_REFUSED_CONDITION = re.compile(r"(the condition '[^']+' fails) .*? Found: ")

#: Further sentences of a refusal are shown up to this number of letters.
MOST_LETTERS = 160

#: The horizon of figures: so many settling times, but not more than so many samples.
SETTLING_TIMES, MOST_FIGURE_SAMPLES = 8, 2000

#: Makes a design: ``maker(plant, method, options)``.
Maker = Callable[[Any, str, Mapping[str, Any]], ObserverDesign]


@dataclass(frozen=True, eq=False)
class ScenarioFigures:
    """A sampled plant with the noise that a scenario states, and the sizes of the scenario's faults by name."""

    plant: DescriptorSystem
    sizes: Mapping[str, float]


def scenario_figures(sampled: DescriptorSystem, scenario: Scenario | None) -> ScenarioFigures | None:
    """Return noise and fault sizes of a scenario for a sampled plant; ``None`` without a scenario that fits it."""
    if scenario is None:
        return None
    try:
        signals = resolve(sampled, scenario.replace(sample_time=None))
    except ObsynthError:
        # A scenario of another plant raises its error where it is simulated.
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
    # Without any stated noise no fault is hidden.
    return ScenarioFigures(plant, sizes if plant.Bw.any() or plant.Dw.any() else {})


@dataclass(frozen=True, eq=False)
class Candidate:
    """A method for a plant: its design and figures, or the reason why there is no design.

    Parameters
    ----------
    method : str
        The method's id.
    design : ObserverDesign or None
        The design in the plant's own time.
    observer : LinearObserver or None
        The observer at the sample time of the figures.
    figures : tuple of FaultFigures
        One for each fault.
    milliseconds : float
        Time that the design took.
    refused : str
        Why there is no design; empty where there is one.
    sizes : mapping
        Sizes of the faults by name, where a scenario states them.
    """

    method: str
    design: ObserverDesign | None
    observer: LinearObserver | None
    figures: tuple[FaultFigures, ...]
    milliseconds: float
    refused: str
    sizes: Mapping[str, float] = field(default_factory=dict)

    @property
    def hidden(self) -> tuple[str, ...]:
        """Faults of a scenario that the noise of the estimate hides."""
        return tuple(
            figure.fault
            for figure in self.figures
            if figure.fault in self.sizes and not self.sizes[figure.fault] >= SEEN_DEVIATIONS * figure.deviation
        )

    def rank(self, has_unknown_inputs: bool, settling: float = np.inf) -> tuple[float, ...]:
        """Return a key that sorts candidates, best first; ``settling``: the plant's settling time in s."""
        if not self.figures:
            return (2.0, 0.0, 0.0, np.inf)
        missed = float(not all(fault.reaches for fault in self.figures))
        coupled = float(has_unknown_inputs and sum(fault.unknown_input_share > DECOUPLED for fault in self.figures))
        dt = self.observer.dt if self.observer is not None else 0.0
        # A mean over time T divides the deviation by the root of T and delays by T: averaging keeps this product.
        products = [fault.deviation * np.sqrt(max(fault.most, dt)) for fault in self.figures]
        cost = float(np.prod(products) ** (1.0 / len(products))) if np.all(np.isfinite(products)) else np.inf
        slow = any(fault.most > SLOW_ESTIMATE * settling for fault in self.figures)
        return (missed, coupled, float(len(self.hidden)), cost * (SLOW_GAIN if slow else 1.0))


def candidate(
    method: str,
    plant: DescriptorSystem,
    sampled: DescriptorSystem,
    steps: int,
    maker: Maker,
    options: Mapping[str, Any],
    *,
    continuous: bool = False,
    expected: ScenarioFigures | None = None,
) -> Candidate:
    """Return the candidate of one method, with figures over ``steps`` samples.

    The method designs for the ``sampled`` plant.  Where it is a method for continuous time, or ``continuous`` asks for
    it, it designs for ``plant`` and the observer is sampled afterwards.  ``expected`` has noise and fault sizes of a
    scenario.
    """
    known = method_class(method)
    if "time-invariant" not in known.plants:
        return _refused(method, "for nonlinear plants")
    begun = perf_counter()
    try:
        in_own_time = continuous or known.time == "continuous"
        design_plant: Any = plant if in_own_time else sampled
        if not in_own_time and plant.dt > 0.0 and plant.nx > sampled.nx:
            # A transformation, so that the design estimates the eliminated algebraic states as well.
            design_plant = without_algebraic_states(plant)
        design = maker(design_plant, method, options)
        observer = _sampled(design, sampled.dt)
    except ObsynthError as error:
        return _refused(method, one_line(str(error)), 1e3 * (perf_counter() - begun))
    spent = 1e3 * (perf_counter() - begun)
    if not observer.fault_names or any(name not in sampled.fault_names for name in observer.fault_names):
        why = "estimates the state, but no fault" if observer.state_names else "detects faults, but estimates none"
        return _refused(method, why, spent)
    noisy_plant, sizes = (sampled, {}) if expected is None else (expected.plant, expected.sizes)
    return Candidate(method, design, observer, fault_figures(noisy_plant, observer, steps), spent, "", sizes)


def _sampled(design: ObserverDesign, dt: float) -> LinearObserver:
    if isinstance(design.observer, LinearObserver):
        return design.observer if design.observer.dt > 0.0 else sample_observer(design.observer, dt)
    return steady_observer(design.recursive[1]).observer


def _refused(method: str, reason: str, spent: float = 0.0) -> Candidate:
    return Candidate(method, None, None, (), spent, reason)


def one_line(text: str) -> str:
    """Return the first sentences of an error message in one line, with the suggestion at its end, if any."""
    flat = _REFUSED_CONDITION.sub(r"\1: ", " ".join(text.replace("\n  - ", " ").split()))
    for mark in ("Measure one of:", "Leave out one of:"):
        head, separator, tail = flat.rpartition(mark)
        if separator:
            return f"{_first_sentences(head)} {mark}{tail}"
    return _first_sentences(flat)


def _first_sentences(text: str) -> str:
    """Return the first sentence of a text, and further whole ones up to `MOST_LETTERS` letters."""
    first, *sentences = re.split(r"(?<=[.]) (?=[A-Z])", (without_opening(text) or text).strip())
    for sentence in sentences:
        if len(first) + len(sentence) >= MOST_LETTERS:
            break
        first += f" {sentence}"
    return first


def candidate_designs(
    plant: DescriptorSystem,
    options: Mapping[str, Any],
    methods: list[str],
    maker: Maker,
    scenario: Scenario | None = None,
) -> list[Candidate]:
    """Return a candidate for each of some methods that estimate faults, designed in the plant's own time.

    All figures are at one sample time: the plant's own, the scenario's, or a share of the plant's settling time.
    """
    stated = None if scenario is None else scenario.sample_time
    step = plant.dt if plant.dt > 0.0 else stated or settling_time(plant) / SETTLING_SAMPLES
    steps = int(min(max(SETTLING_TIMES * settling_time(plant) / step, 50), MOST_FIGURE_SAMPLES))
    try:
        sampled = on_the_clock(plant, step)
    except ObsynthError:
        # The plant has no proper sampled form, so there are no figures by which to compare.
        return []
    own_time, expected = plant.dt == 0.0, scenario_figures(sampled, scenario)
    fitting = [method for method in methods if not (plant.dt > 0.0 and method_class(method).time == "continuous")]
    return [
        candidate(method, plant, sampled, steps, maker, options, continuous=own_time, expected=expected)
        for method in fitting
    ]


def linear_methods() -> Sequence[type[Method]]:
    """Return the methods for linear time-invariant plants."""
    return [method for method in map(method_class, REGISTRY) if "time-invariant" in method.plants]


def methods_with(purpose: Purpose, among: Iterable[str]) -> list[str]:
    """Return the methods of a list that serve a purpose."""
    return [method for method in among if purpose in method_class(method).purposes]
