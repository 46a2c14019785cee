"""What a design does to faults, unknown inputs and noise, in closed form on one clock; no random numbers.

The plant is sampled, with faults and unknown inputs held between samples; the error of an estimate is followed from
one impulse at each input, so that plants with modes on the boundary need no stationary covariance.

The method by default: those that exist, designed; the best by closed-form figures on one clock.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obsynth.analysis.transformations.linear_plants import discretise, eliminate_algebraic_states
from obsynth.errors import ObsynthError, PreconditionError, SpecError
from obsynth.methods.functional_filter.kalman_gain import settling_time
from obsynth.methods.method import Method, Purpose
from obsynth.methods.registry import REGISTRY, kind_of, method_class, methods_for
from obsynth.numerics.arguments import FloatArray, field_types
from obsynth.observers.linear.observer import LinearObserver, sample_observer
from obsynth.observers.recursive.gain_schedule import steady_observer
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import ObserverDesign
from obsynth.simulation.linear import stabilising_feedback

#: Samples of a plant's settling time on a clock of its own.
SETTLING_SAMPLES = 200
#: Shares of a step at which its delay is read.
DELAY_SHARE, NEARLY_ALL = 0.5, 0.9
#: A fault estimate off its step by more than this at the horizon did not reach it.
REACHED_STEP = 0.1
#: Peak gain from an unknown input to a fault estimate, in fault per input, above which it is not decoupled.
DECOUPLED = 1e-3
#: An unstable plant that grows by more than this is held by a feedback; one without inputs is followed until it has
#: grown by the second, beyond which differences of its outputs are rounding.
HELD_GROWTH, LARGEST_STEP_GROWTH = 1e3, 1e6


@dataclass(frozen=True)
class FaultFigures:
    """What becomes of a unit step of one fault, of noise and of unknown inputs, in its estimate.

    Parameters
    ----------
    fault : str
        The fault.
    half, most : float, seconds
        Time until the estimate of a unit step first shows 50 and 90 % of it; infinite where it never does.
    at_horizon, peak : float
        The estimate of a unit step at the horizon, and its largest absolute value before.
    horizon : float, seconds
        How long the step was followed: a shorter time where the plant is unstable and nothing holds it.
    deviation : float
        Standard deviation under the stated noise.
    unknown_input_gain : float
        Largest gain of a held sinusoidal unknown input to the estimate, per unit of the input.
    """

    fault: str
    half: float
    most: float
    at_horizon: float
    peak: float
    horizon: float
    deviation: float
    unknown_input_gain: float

    @property
    def leak(self) -> float:
        """Deprecated: `unknown_input_gain`."""
        warnings.warn("leak is now unknown_input_gain.", DeprecationWarning, stacklevel=2)
        return self.unknown_input_gain

    @property
    def reaches(self) -> bool:
        """Whether a step is there at the horizon."""
        return bool(abs(self.at_horizon - 1.0) <= REACHED_STEP and np.isfinite(self.most))


def on_the_clock(plant: DescriptorSystem, sample_time: float) -> DescriptorSystem:
    """Return the plant sampled, in its own time where it is so already, without algebraic states."""
    if plant.dt > 0.0:
        return eliminate_algebraic_states(plant).plant
    return discretise(plant, sample_time).plant


def held(plant: DescriptorSystem, steps: int) -> tuple[int, FloatArray]:
    """Return for how many samples, and with which ``feedback (nu, nx)``, ``u = -feedback x``, a sampled plant
    ``(E = I)`` is kept in bounds: with none where it hardly grows; with no input, for a shorter time."""
    nothing = np.zeros((plant.nu, plant.nx))
    rate = float(np.log(max(float(np.max(np.abs(np.linalg.eigvals(plant.A)), initial=0.0)), 1.0)))
    if rate * steps <= np.log(HELD_GROWTH):
        return steps, nothing
    try:
        found = stabilising_feedback(plant)
        if float(np.max(np.abs(np.linalg.eigvals(plant.A - plant.B @ found)))) < 1.0:
            return steps, found
    except PreconditionError:
        pass
    return max(int(np.log(LARGEST_STEP_GROWTH) / rate), 2), nothing


def step_responses(
    plant: DescriptorSystem, observer: LinearObserver, steps: int, feedback: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return responses to impulses ``(steps, faults, nf + nd + nw)`` and to steps ``(steps, faults, nf)``."""
    order, rows = observer.order, observer.fault_rows
    # Where no noise is stated, every output has one of its own, of deviation one.
    silent = not plant.Dw.any() and not plant.Bw.any()
    driven, measured = (np.zeros((plant.nx, plant.ny)), np.eye(plant.ny)) if silent else (plant.Bw, plant.Dw)
    inputs = np.hstack([plant.Bf, plant.Bd, driven])
    direct = np.hstack([plant.Df, plant.Dd, measured])
    # A feedback u = -feedback x is known to the observer: it changes no estimate, and keeps numbers small.
    gain = np.zeros((plant.nu, plant.nx)) if feedback is None else feedback
    seen = plant.C - plant.D @ gain
    moved, into = plant.A - plant.B @ gain, observer.By @ seen - observer.Bu @ gain
    a = np.block([[moved, np.zeros((plant.nx, order))], [into, observer.Az]])
    b = np.vstack([inputs, observer.By @ direct])
    c = np.hstack([observer.Dy[rows] @ seen - observer.Du[rows] @ gain, observer.Cz[rows]])
    found = np.empty((steps, len(c), b.shape[1]))
    found[0] = observer.Dy[rows] @ direct
    state = b
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(1, steps):
            found[k] = c @ state
            state = a @ state
    return found, np.cumsum(found[:, :, : plant.nf], axis=0)


def fault_figures(plant: DescriptorSystem, observer: LinearObserver, steps: int) -> tuple[FaultFigures, ...]:
    """Return the figures of every fault that a sampled observer estimates on a sampled plant ``(E = I)``."""
    impulse, step = step_responses(plant, observer, *held(plant, steps))
    unknown = impulse[:, :, plant.nf : plant.nf + plant.nd]
    noise = impulse[:, :, plant.nf + plant.nd :]
    # An observer that runs away has figures beyond all numbers, and needs no warning besides.
    with np.errstate(over="ignore", invalid="ignore"):
        return tuple(_figures(plant, observer, step, unknown, noise))


def _figures(
    plant: DescriptorSystem, observer: LinearObserver, step: FloatArray, unknown: FloatArray, noise: FloatArray
) -> Iterator[FaultFigures]:
    for row, name in enumerate(observer.fault_names):
        own = step[:, row, plant.fault_names.index(name)]
        gains = np.abs(np.fft.rfft(unknown[:, row], axis=0))
        yield FaultFigures(
            name,
            _first(own >= DELAY_SHARE, plant.dt),
            _first(own >= NEARLY_ALL, plant.dt),
            float(own[-1]),
            float(np.max(np.abs(own))),
            len(own) * plant.dt,
            float(np.sqrt(np.sum(noise[:, row] ** 2))),
            float(np.max(gains, initial=0.0)),
        )


def _first(reached: NDArray[np.bool_], dt: float) -> float:
    return float(np.argmax(reached)) * dt if np.any(reached) else float("inf")


#: An estimate that shows 90 % of a step later than this share of the plant's settling time comes after faster ones.
SLOW_ESTIMATE = 0.25


@dataclass(frozen=True, eq=False)
class Candidate:
    """A method for a plant: its design and figures, or why there is none."""

    method: str
    design: ObserverDesign | None
    observer: LinearObserver | None  # on the clock
    figures: tuple[FaultFigures, ...]  # of each fault
    milliseconds: float  # to design
    refused: str

    def rank(self, has_unknown_inputs: bool, settling: float = np.inf) -> tuple[float, ...]:
        """Return what sorts candidates, best first; ``settling``: the plant's time (s); and whether the plant
        has unknown inputs."""
        if not self.figures:
            return (2.0, 0.0, 0.0, np.inf)
        missed = float(not all(found.reaches for found in self.figures))
        coupled = float(has_unknown_inputs and any(found.unknown_input_gain > DECOUPLED for found in self.figures))
        slow = float(any(found.most > SLOW_ESTIMATE * settling for found in self.figures))
        dt = self.observer.dt if self.observer is not None else 0.0
        # A mean over time T divides noise by the root of T: it cannot change deviation times the root of delay.
        prices = [found.deviation * np.sqrt(max(found.most, dt)) for found in self.figures]
        price = float(np.prod(prices) ** (1.0 / len(prices))) if np.all(np.isfinite(prices)) else np.inf
        return (missed, coupled, slow, price)


def candidate(
    method: str,
    plant: DescriptorSystem,
    sampled: DescriptorSystem,
    steps: int,
    maker: Callable[[DescriptorSystem, str, Mapping[str, Any]], ObserverDesign],
    options: Mapping[str, Any],
    *,
    continuous: bool = False,
) -> Candidate:
    """Return one method for a plant; on the sampled plant where it can be, or else (or if asked) sampled afterwards."""
    known = method_class(method)
    if "time-invariant" not in known.plants:
        return _refused(method, "for nonlinear plants")
    begun = perf_counter()
    try:
        made = maker(plant if continuous or known.time == "continuous" else sampled, method, options)
        observer = _sampled(made, sampled.dt)
    except ObsynthError as error:
        return _refused(method, one_line(str(error)), 1e3 * (perf_counter() - begun))
    spent = 1e3 * (perf_counter() - begun)
    if not observer.fault_names or any(name not in sampled.fault_names for name in observer.fault_names):
        what = "estimates the state, but no fault" if observer.state_names else "detects faults, but estimates none"
        return _refused(method, what, spent)
    return Candidate(method, made, observer, fault_figures(sampled, observer, steps), spent, "")


def _sampled(design: ObserverDesign, dt: float) -> LinearObserver:
    if isinstance(design.observer, LinearObserver):
        return design.observer if design.observer.dt > 0.0 else sample_observer(design.observer, dt)
    return steady_observer(design.recursive[1]).observer


def _refused(method: str, reason: str, spent: float = 0.0) -> Candidate:
    return Candidate(method, None, None, (), spent, reason)


#: The condition that a refusal names, and what stands between it and what was found.
_REFUSED_CONDITION = re.compile(r"(the condition '[^']+' fails) .*? Found: ")
#: Letters of a message to which further sentences are shown.
MOST_LETTERS = 160


def one_line(text: str) -> str:
    """Return the start of a message in one line, with what would help, which stands at its end."""
    flat = _REFUSED_CONDITION.sub(r"\1: ", " ".join(text.replace("\n  - ", " ").split()))
    for mark in ("Measure one of:", "Leave out one of:"):
        head, found, tail = flat.rpartition(mark)
        if found:
            return f"{_cut(head)} {mark}{tail}"
    return _cut(flat)


def _cut(text: str) -> str:
    """Return so many whole sentences of a text as have room, and the first in any case."""
    first, *others = re.split(r"(?<=[.]) (?=[A-Z])", text.removeprefix("No observer of this kind exists: ").strip())
    for sentence in others:
        if len(first) + len(sentence) >= MOST_LETTERS:
            break
        first += f" {sentence}"
    return first


def linear_methods() -> Sequence[type[Method]]:
    """Return the methods that take linear plants with constant matrices."""
    return [found for found in map(method_class, REGISTRY) if "time-invariant" in found.plants]


#: How many settling times figures look ahead.
SETTLING_TIMES, MOST_FIGURE_SAMPLES = 8, 2000


Maker = Callable[[Any, str, Mapping[str, Any]], ObserverDesign]


def _methods_with(purpose: Purpose, among: Iterable[str]) -> list[str]:
    """Return the methods of a list that serve a purpose."""
    return [method for method in among if purpose in method_class(method).purposes]


def automatic_design(plant: Any, options: Mapping[str, Any], maker: Maker, refusing: Maker) -> ObserverDesign:
    """Return the design of the method chosen; ``maker(plant, method, options)``; ``refusing`` says what would help."""
    if not isinstance(plant, DescriptorSystem):
        purpose: Purpose = "parameters" if plant.parameter_names else "state despite noise"
        known = methods_for(kind_of(plant))
        return maker(plant, next(iter(_methods_with(purpose, known)), known[0]), options)
    possible = [method.id for method in linear_methods() if set(options) <= set(field_types(method))]
    if not possible:
        raise SpecError(
            f"No single method has the options {', '.join(sorted(options))}: name the method they are for.",
            path="method.options",
        )
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
    return _chosen(plant, options, possible, maker, refusing)


def _chosen(
    plant: DescriptorSystem, options: Mapping[str, Any], possible: list[str], maker: Maker, refusing: Maker
) -> ObserverDesign:
    found = [entry for entry in designed(plant, options, possible, maker) if entry.design is not None]
    if not found:
        # What forbids the one that needs least forbids the fault.
        purposes: tuple[Purpose, ...] = ("faults under the weakest conditions", "faults")
        last = next((name for purpose in purposes for name in _methods_with(purpose, possible)), possible[0])
        return refusing(plant, last, options)
    settling = settling_time(plant)
    best, *others = sorted(found, key=lambda entry: entry.rank(plant.nd > 0, settling))
    if best.design is None:
        raise PreconditionError("No method exists for this plant.", condition="existence")
    return _with_note(best.design, reason(best, others, plant))


def designed(plant: DescriptorSystem, options: Mapping[str, Any], methods: list[str], maker: Maker) -> list[Candidate]:
    """Return every method for a plant in its own time, with figures on one clock."""
    step = plant.dt if plant.dt > 0.0 else settling_time(plant) / SETTLING_SAMPLES
    steps = int(min(max(SETTLING_TIMES * settling_time(plant) / step, 50), MOST_FIGURE_SAMPLES))
    try:
        sampled = on_the_clock(plant, step)
    except ObsynthError:
        # Not of index one: only methods that need no elimination are left, and nothing to compare on.
        return []
    own_time = plant.dt == 0.0
    taken = [
        method
        for method in _methods_with("faults", methods)
        if not (plant.dt > 0.0 and method_class(method).time == "continuous")
    ]
    return [candidate(method, plant, sampled, steps, maker, options, continuous=own_time) for method in taken]


def reason(best: Candidate, others: list[Candidate], plant: DescriptorSystem) -> str:
    """Return in one sentence why a candidate is first."""
    if not others:
        return "no other method exists for this plant"
    gain = max(found.unknown_input_gain for found in best.figures)
    words = ["its estimates reach every step"] if best.rank(False)[0] == 0.0 else []
    if plant.nd:
        words.append(f"gain from the unknown inputs {gain:.1e}")
    deviation = ", ".join(f"{found.deviation:.3g}" for found in best.figures)
    delay = ", ".join(f"{found.most:.3g}" for found in best.figures)
    words.append(f"90 % of a step after {delay} s, with a deviation of {deviation}")
    below = ", ".join(other.method for other in others)
    return f"{'; '.join(words)}; ranked below it: {below}; obsynth compare ranks by errors over a scenario instead"


def _with_note(design: ObserverDesign, why: str) -> ObserverDesign:
    return design.replace(notes=(f"Method chosen by auto: {design.method} ({why}).", *design.notes))
