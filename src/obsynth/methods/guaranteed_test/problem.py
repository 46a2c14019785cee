"""What the options of a guaranteed test mean for a plant: bounds and questions; its weights as an observer."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.methods.guaranteed_test.options import Asked
from obsynth.methods.guaranteed_test.tolerant import side_by_side
from obsynth.methods.guaranteed_test.windows import Bounds, Question, Window, window_of
from obsynth.numerics.arguments import is_finite_number
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import decide_rank
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.exact_pencils import ExactPencil

#: What each course covers, and what not.
COURSES: Mapping[str, str] = {
    "constant": "a fault that is constant over the window: the interval holds once it fills the window, an alarm is "
    "always right",
    "step": "a step after healthy samples: an alarm is right whatever the time course, but it ends once the fault "
    "fills the window, so latch it",
    "any": "a fault of any time course, at one sample: the interval holds at every row",
    "ramp": "a straight line over the window: the interval is of its value at one sample",
    "rate": "a fault that changes by at most fault_rate a sample: the interval is of its value at one sample",
}
#: Samples that are tried for ``samples="auto"``; for a step, those after its healthy past.
LADDER = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128)
#: The ladder ends where a window has more states than this.
MOST_STATES = 2500
#: The least number of samples whose threshold is within this share of the last one's is taken.
WITHIN = 0.05


@dataclass(frozen=True, eq=False)
class Problem:
    """A plant with its bounds and what is asked, but for the number of samples and the lag."""

    plant: DescriptorSystem
    bounds: Bounds
    question: Question  # of one sample more than its course needs
    before: int

    def window(self, samples: int, *, lag: int | None = None) -> Window:
        """Return the stacked equations of so many samples."""
        lag = self.question.lag if lag is None else lag
        return window_of(self.plant, self.bounds, replace(self.question, samples=samples, lag=lag))

    @property
    def shortest(self) -> int:
        """The least number of samples that the course fits in."""
        return max(self.before, self.question.lag) + 1

    def enough(self, lag: int) -> int:
        """Return samples after which more of them make no test possible that there was none before."""
        return self.before + 2 * self.plant.nx + 2 + lag

    def ladder(self) -> tuple[int, ...]:
        """Return the numbers of samples to try; of a large plant fewer."""
        most = max(MOST_STATES // max(self.plant.nx, 1), self.shortest)
        asked = [self.before + rung for rung in LADDER] if self.question.course == "step" else list(LADDER)
        return tuple(rung for rung in asked if self.shortest <= rung <= most) or (self.shortest,)


def question_of(
    asked: Asked, fault_names: tuple[str, ...], disturbance_names: tuple[str, ...], *, closing: int = 0
) -> Question:
    """Return what is looked for, of one sample more than its course needs."""
    fault, before = fault_of(fault_names, asked.fault), asked.before if asked.course == "step" else 0
    rates = np.zeros(0)
    if asked.disturbance == "rate":
        rates = by_name(asked.disturbance_rate, disturbance_names, "disturbance_rate", every=True)
    return Question(
        fault,
        asked.course,
        before + 1,
        asked.lag or 0,
        before,
        free_faults(fault_names, asked.free, fault),
        asked.free_course,
        asked.disturbance,
        rates,
        float(asked.fault_rate or 0.0),
        asked.norm == "ellipsoid",
        closing,
    )


def problem_of(plant: DescriptorSystem, asked: Asked) -> Problem:
    """Return what is asked of a plant; raise `SpecError` for unknown signals, missing bounds and courses that do not
    fit."""
    regular = decide_rank(plant.E).full
    index = 0 if regular else ExactPencil.written(plant.E, plant.A).index
    closing = 0 if index is None else max(index - 1, 0)
    question = question_of(asked, plant.fault_names, plant.disturbance_names, closing=closing)
    return Problem(plant, bounds_of(plant, asked), question, question.before)


def window_as_designed(plant: DescriptorSystem, asked: Asked) -> Window:
    """Return the stacked equations of options as a design ships them: with the number of samples and the lag."""
    problem = problem_of(plant, asked)
    return replace(problem, question=replace(problem.question, lag=asked.lag or 0)).window(int(asked.samples))


def fault_of(names: tuple[str, ...], name: str | None) -> int:
    """Return the number of the fault that is looked for."""
    if name is None and len(names) == 1:
        return 0
    if name is None or name not in names:
        given = "No fault is named" if name is None else f"There is no fault {name!r}"
        listed = (
            f"name one of {', '.join(names)}"
            if names
            else "the plant has none (Bf, Df; of one that changes with k Phi, Psi)"
        )
        raise SpecError(f"{given}: {listed}.", path="method.options.fault")
    return names.index(name)


def free_faults(names: tuple[str, ...], given: Any, fault: int) -> tuple[int, ...]:
    """Return the numbers of the faults that may do anything besides."""
    if isinstance(given, str) and given not in names:
        if given not in ("others", "none"):
            raise SpecError(
                f"free is {given!r}: use others, none, or a list of {', '.join(names)}.", path="method.options.free"
            )
        return tuple(k for k in range(len(names)) if k != fault) if given == "others" else ()
    listed = [given] if isinstance(given, str) else list(given or ())
    wrong = [str(name) for name in listed if name not in names or names.index(name) == fault]
    if wrong:
        raise SpecError(
            f"free names {', '.join(wrong)}: no other fault of the plant is called so; there are: {', '.join(names)}.",
            path="method.options.free",
        )
    return tuple(sorted({names.index(name) for name in listed}))


def missing_bounds(plant: DescriptorSystem, asked: Asked) -> Iterator[str]:
    """Yield a sentence for each bound that is missing."""
    acting = np.any(plant.Bd != 0.0, axis=0) | np.any(plant.Dd != 0.0, axis=0)
    known = asked.disturbance_bounds
    names = plant.disturbance_names
    if known is None or isinstance(known, Mapping):
        lacking = [name for name, does in zip(names, acting, strict=True) if does and name not in (known or {})]
        if lacking:
            yield f"disturbance_bounds: the largest absolute value of {', '.join(lacking)} is missing."
    if asked.noise_bound is None and np.any(np.hstack([plant.Bw.ravel(), plant.Dw.ravel()])):
        yield (
            "noise_bound: a standard deviation is no bound; state how many of them the noise never exceeds, or the "
            "bound of each output by name."
        )


def require_bounds(missing: Iterable[str]) -> None:
    """Raise `SpecError` where bounds are missing, as sentences that begin with an option."""
    lacking = list(missing)
    if lacking:
        first = lacking[0].partition(":")[0]
        raise SpecError("A guaranteed test needs bounds.", path=f"method.options.{first}", problems=lacking)


def bounds_of(plant: DescriptorSystem, asked: Asked) -> Bounds:
    """Return the bounds that are given."""
    require_bounds(missing_bounds(plant, asked))
    names, middle = plant.disturbance_names, np.zeros(plant.nw)
    disturbance, disturbance_middle = between(asked.disturbance_bounds, names, "disturbance_bounds", every=False)
    if isinstance(asked.noise_bound, Mapping):
        output = np.eye(plant.ny)
        noise, middle = between(asked.noise_bound, plant.output_names, "noise_bound", every=True)
        state, kept = np.zeros((plant.nx, plant.ny)), np.any(plant.Bw != 0.0, axis=0)
        if kept.any():
            raise SpecError(
                "noise_bound is given by output, but noise enters the equations too: give a number of deviations.",
                path="method.options.noise_bound",
            )
    else:
        state, output = plant.Bw, plant.Dw
        noise = by_name(asked.noise_bound, plant.noise_names, "noise_bound", every=False)
    always = by_name(asked.state_bounds, plant.state_names, "state_bounds", every=False, missing=np.inf)
    at_first = by_name(asked.initial_bounds, plant.state_names, "initial_bounds", every=False, missing=np.inf)
    return Bounds(disturbance, state, output, noise, always, at_first, disturbance_middle, middle)


def between(given: Any, names: tuple[str, ...], option: str, *, every: bool) -> tuple[FloatArray, FloatArray]:
    """Return half widths, rounded up, and middles of bounds that are numbers, or ``[low, high]`` by name."""
    path = f"method.options.{option}"
    low, high = {}, {}
    for name, value in given.items() if isinstance(given, Mapping) else ():
        if not isinstance(value, (list, tuple, np.ndarray)):
            continue
        if len(value) != 2 or not all(map(is_finite_number, value)) or not value[0] <= value[1]:
            raise SpecError(
                f"{option} of {name} is {value!r}: give one number, or two finite ones, [low, high], low first.",
                path=path,
            )
        low[name], high[name] = float(value[0]), float(value[1])
    plain = {name: 0.0 if name in low else value for name, value in given.items()} if low else given
    half, middle = by_name(plain, names, option, every=every), np.zeros(len(names))
    for place, name in enumerate(names):
        if name in low:
            middle[place] = 0.5 * low[name] + 0.5 * high[name]
            ends = [abs(Fraction(end) - Fraction(middle[place])) for end in (low[name], high[name])]
            half[place] = rounded_outward(max(ends))
    return half, middle


def rounded_outward(value: Fraction) -> float:
    """Return a double that is not below a rational number."""
    found = float(value)
    return found if Fraction(found) >= value else float(np.nextafter(found, np.inf))


def by_name(given: Any, names: tuple[str, ...], option: str, *, every: bool, missing: float = 0.0) -> FloatArray:
    """Return a number, 0 or more, for each name, from one number for all or a mapping."""
    path = f"method.options.{option}"
    if given is None:
        if every and names:
            raise SpecError(f"{option} is missing: give a number for each of {', '.join(names)}.", path=path)
        return np.full(len(names), missing)
    by_name = dict(given) if isinstance(given, Mapping) else dict.fromkeys(names, given)
    unknown = [str(name) for name in by_name if name not in names]
    lacking = [name for name in names if name not in by_name] if every else []
    if unknown or lacking:
        parts = [f"unknown: {', '.join(unknown)}"] if unknown else []
        parts += [f"missing: {', '.join(lacking)}"] if lacking else []
        raise SpecError(f"{option} must name {', '.join(names) or 'nothing'}; {'; '.join(parts)}.", path=path)
    for name, value in by_name.items():
        if isinstance(value, (list, tuple)):
            raise SpecError(
                f"{option} of {name} is {value!r}: one bound holds on both sides of the operating point: take the "
                "larger end.",
                path=path,
            )
        if not (is_finite_number(value) and value >= 0.0):
            raise SpecError(f"{option} of {name} is {value!r}: give a finite number, 0 or more.", path=path)
    return np.array([float(by_name.get(name, missing)) for name in names])


def delay_in_samples(window: Window, delay: int) -> int:
    """Return after how many samples at the latest a fault of twice the threshold alarms."""
    question = window.question
    if question.course == "step":
        return question.samples - 1 - question.before + delay
    # The fault must have followed its course over the whole window; one of any time course needs only its own sample.
    return (question.lag if question.course == "any" else question.samples - 1) + delay


def observer_of(window: Window, multipliers: FloatArray, beside: LinearObserver | None = None) -> LinearObserver:
    """Return the weights of multipliers as a linear observer with one register for each sample but the last.

    ``beside``: an observer of the state, which runs along where constants have tolerances.
    """
    on_y, on_u, delay = window.weights(multipliers)
    plant, count = window.plant, len(on_y) - 1
    name = (plant.fault_names[window.question.fault],)
    estimated = window.question.course != "step"
    late = (window.question.lag + delay,) if estimated else ()
    first = np.zeros((1, count))
    first[0, :1] = 1.0
    test = LinearObserver(
        Az=np.eye(count, k=1),
        Bu=on_u[1:],
        By=on_y[1:],
        Cz=first,
        Du=on_u[:1],
        Dy=on_y[:1],
        dt=plant.dt,
        input_names=plant.input_names,
        output_names=plant.output_names,
        state_names=(),
        fault_names=name if estimated else (),
        residual_names=() if estimated else name,
        state_delays=(),
        fault_delays=late,
        constant=np.array([window.constant(multipliers)]),
    )
    return test if beside is None else side_by_side(test, beside)


def rounding_of(window: Window, multipliers: FloatArray, radius: FloatArray) -> FloatArray:
    """Return what shipped weights may err for known signals of at most one ``(nu + ny,)``; the threshold lacks it."""
    return window.known_sizes(window.errors(multipliers, radius))
