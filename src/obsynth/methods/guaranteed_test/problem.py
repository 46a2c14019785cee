"""What the options of a guaranteed test mean for a plant: bounds and questions; its weights as an observer."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.methods.guaranteed_test.options import TestOptions
from obsynth.methods.guaranteed_test.tolerant import side_by_side
from obsynth.methods.guaranteed_test.window_models import Bounds, TestProblem, disturbance_names, fault_names
from obsynth.methods.guaranteed_test.windows import Window, window_of
from obsynth.numerics.arrays import LARGEST, FloatArray, require_no_overflow
from obsynth.numerics.ranks import decide_rank
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.window.observer import WindowObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.plants.transformations.moving_disturbances import moving_columns
from obsynth.plants.transformations.remainders import continuous_model
from obsynth.proofs.exact_pencils import ExactPencil
from obsynth.proofs.nonsingular import is_nonsingular_exactly

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
CANDIDATE_LENGTHS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128)

#: The ladder ends where a window has more states than this.
MOST_WINDOW_STATES = 2500

#: The least number of samples whose threshold is within this share of the last one's is taken.
WITHIN = 0.05


#: Rows, evenly spread, whose windows decide on the number of samples and the lag where matrices change with k.
TRIED_ROWS = 8

#: What is for plants with constant matrices, and what to do instead.
REFUSED: Mapping[str, str] = {
    "isolate": "design one test for each fault, insensitive to the others (free: others)",
    "exact": "leave it out: the fixed tests, one a row, are proved",
    "missing": "leave it out (missing: wait)",
}


@dataclass(frozen=True, eq=False)
class WindowProblem:
    """A plant with its bounds and what is asked, but for the number of samples, the lag and the row.

    Of a plant that changes with k, ``E_{k+1} x(k+1) = A_k x(k) + B_k u(k) + Phi_k f(k) + mu(k)`` and
    ``y(k+1) = C_{k+1} x(k+1) + Psi_k f(k) + nu(k)``, each row has a window of its own.
    """

    plant: DescriptorSystem | TimeVaryingDescriptorSystem
    bounds: Bounds
    question: TestProblem  # of one sample more than its course needs

    def window(self, samples: int, *, lag: int | None = None, row: int = 0) -> Window:
        """Return the stacked equations of so many samples, of which the last is that of k = ``row``."""
        lag = self.question.lag if lag is None else lag
        start = 1 if self.horizon is None else row - samples + 1
        return window_of(self.plant, self.bounds, replace(self.question, samples=samples, lag=lag), start)

    @property
    def horizon(self) -> int | None:
        """The last k of a plant that changes with k."""
        return None if isinstance(self.plant, DescriptorSystem) else self.plant.horizon

    @property
    def fault(self) -> str:
        """Name of the fault that is looked for."""
        return fault_names(self.plant)[self.question.fault]

    @property
    def shortest(self) -> int:
        """The least number of samples that the course fits in."""
        return max(self.question.before, self.question.lag) + 1

    def enough(self, lag: int) -> int:
        """Return samples after which more of them make no test possible that there was none before."""
        return self.question.before + 2 * self.plant.nx + 2 + lag

    def ladder(self) -> tuple[int, ...]:
        """Return the numbers of samples to try; of a large plant fewer."""
        most = max(MOST_WINDOW_STATES // max(self.plant.nx, 1), self.shortest)
        most = most if self.horizon is None else min(most, self.horizon)
        asked = [self.question.before + rung for rung in CANDIDATE_LENGTHS]
        return tuple(rung for rung in asked if self.shortest <= rung <= most) or (self.shortest,)

    def rows(self, samples: int) -> range:
        """Return the rows that have a window; without a horizon 0, which stands for all."""
        return range(1) if self.horizon is None else range(samples, self.horizon + 1)

    def tried(self, samples: int) -> list[int]:
        """Return some rows, evenly spread."""
        rows = self.rows(samples)
        return sorted({rows[int(k)] for k in np.linspace(0, len(rows) - 1, TRIED_ROWS)}) if len(rows) else []

    @cached_property
    def _continuing(self) -> np.ndarray:
        """By k, whether every state that satisfies the equations up to it has a course to the horizon."""
        plant = self.plant
        if isinstance(plant, DescriptorSystem):
            # What follows the window is in its equations (`Question.closing`).
            return np.ones(1, dtype=bool)
        last = 2 if plant.horizon is None else plant.horizon
        found = np.ones(last + 1, dtype=bool)
        for k in range(last - 1, 0, -1):
            found[k] = found[k + 1] and _continues(plant.E.at(k), plant.A.at(k), plant.E.at(k + 1))
        return found

    @cached_property
    def _preceded(self) -> np.ndarray:
        """By k, whether every state there has a past: equations before a window of a running plant say nothing of it.

        They do where A is singular, as that of a delay: what it holds is what went into it.
        """
        plant = self.plant
        if isinstance(plant, DescriptorSystem):
            return np.array([is_nonsingular_exactly(plant.A)])
        if plant.A.is_constant:
            return np.full((plant.horizon or 1) + 1, is_nonsingular_exactly(plant.A.at(0)))
        alone = [is_nonsingular_exactly(plant.A.at(k)) for k in range(plant.horizon or 1)]
        return np.array([True, *np.logical_and.accumulate(alone)])

    def has_past(self, row: int, samples: int) -> bool:
        """Whether every state at the first sample of a window is one of a plant that has been running.

        With bounds of the first state the plant starts with the window, by assumption.
        """
        if np.isfinite(self.bounds.first).any():
            return True
        found = self._preceded
        return bool(found[0 if self.horizon is None else min(row - samples + 1, len(found) - 1)])

    def continues(self, window: Window, row: int) -> bool:
        """Whether what satisfies the equations of a window satisfies those after it, with some later states."""
        found = self._continuing
        after = 1 if self.horizon is None else row - window.question.samples + 1 + window.equations
        return bool(found[min(after, len(found) - 1)])

    def is_of_a_running_plant(self, window: Window, row: int, point: FloatArray, radius: FloatArray) -> bool:
        """Whether a point within a radius of this one ``(columns,)`` satisfies equations before and after a window."""
        first = [place for place, label in enumerate(window.labels) if label[:2] == ("x", 0)]
        # A plant that starts at rest, exactly, has been at rest.
        at_rest = not np.any(point[first]) and not np.any(radius[first])
        return self.continues(window, row) and (at_rest or self.has_past(row, window.question.samples))


def _continues(before: FloatArray, a: FloatArray, after: FloatArray) -> bool:
    """Whether a state with any ``E_k x`` can also satisfy those equations of the next step that E has no part in."""
    rank = decide_rank(after).rank
    if rank == len(after):
        return True
    without = np.linalg.svd(after)[0][:, rank:].T
    return decide_rank(np.vstack([before, without @ a])).rank == decide_rank(before).rank + len(without)


def question_of(asked: TestOptions, plant: DescriptorSystem | TimeVaryingDescriptorSystem) -> TestProblem:
    """Return what is looked for, of one sample more than its course needs."""
    names, before = fault_names(plant), asked.before if asked.course == "step" else 0
    fault, rates = fault_of(names, asked.fault), np.zeros(0)
    if asked.disturbance == "rate":
        rates = by_name(asked.disturbance_rate, disturbance_names(plant), "disturbance_rate", every=True)
    index = None
    if isinstance(plant, DescriptorSystem) and not decide_rank(plant.E).full:
        index = ExactPencil.written(plant.E, plant.A).index
    return TestProblem(
        fault=fault,
        course=asked.course,
        samples=before + 1,
        lag=asked.lag or 0,
        before=before,
        free=free_faults(names, asked.free, fault),
        free_course=asked.free_course,
        disturbance=asked.disturbance,
        disturbance_rate=rates,
        fault_rate=float(asked.fault_rate or 0.0),
        ellipsoid=asked.norm == "ellipsoid",
        closing=max((index or 0) - 1, 0),
    )


def problem_of(plant: DescriptorSystem | TimeVaryingDescriptorSystem, asked: TestOptions) -> WindowProblem:
    """Return what is asked of a plant; raise `SpecError` for what it cannot be asked, unknown signals, missing bounds
    and courses that do not fit."""
    if isinstance(plant, TimeVaryingDescriptorSystem):
        for name, given in (("isolate", asked.isolate), ("exact", asked.exact), ("missing", asked.missing == "solve")):
            if given:
                raise SpecError(
                    f"{name} is for plants whose matrices do not change with k: {REFUSED[name]}.",
                    path=f"method.options.{name}",
                )
        if plant.horizon is None and not plant.is_time_invariant:
            raise SpecError(
                "The plant changes with k and has no horizon, but each row has a programme of its own: give a horizon, "
                "as many steps as the log has.",
                path="plant.horizon",
            )
    question = question_of(asked, plant)
    return WindowProblem(plant, bounds_of(plant, asked), question)


def require_linear_options(asked: TestOptions) -> None:
    """Raise `SpecError` for options of nonlinear plants."""
    for option in ("region", "sample_time", "given", "model"):
        if getattr(asked, option) is not None:
            raise SpecError(f"{option} is for nonlinear plants: leave it out.", path=f"method.options.{option}")


def samples_given(asked: TestOptions) -> Any:
    """Return the number of samples, or ``auto``."""
    return asked.before + asked.after if asked.after is not None else asked.samples


@dataclass(frozen=True, eq=False)
class WindowProgrammes:
    """The different windows of all rows, the first row of each, and which window each row has ``(rows,)``."""

    windows: tuple[Window, ...]
    first: tuple[int, ...]
    of_row: np.ndarray

    @classmethod
    def of(cls, problem: WindowProblem, samples: int) -> WindowProgrammes:
        """Return them; those with the same numbers are one."""
        numbers: dict[bytes, int] = {}
        windows: list[Window] = []
        first: list[int] = []
        of_row = []
        for row in problem.rows(samples):
            window = problem.window(samples, row=row)
            digest = hashlib.blake2b(digest_size=32)
            for part in (window.i, window.j, window.value, window.times, window.bar, np.array([window.rows])):
                digest.update(np.ascontiguousarray(part).tobytes() + b"|")
            for _, _, inputs in window.model.equations:
                digest.update(np.ascontiguousarray(inputs).tobytes())
            key = digest.digest() + bytes([problem.continues(window, row), problem.has_past(row, samples)])
            if key not in numbers:
                numbers[key] = len(windows)
                windows.append(window)
                first.append(row)
            of_row.append(numbers[key])
        return cls(tuple(windows), tuple(first), np.array(of_row, dtype=np.int64))


def problem_as_designed(plant: DescriptorSystem | TimeVaryingDescriptorSystem, asked: TestOptions) -> WindowProblem:
    """Return the problem of options as a design ships them: with the lag."""
    problem = problem_of(plant, asked)
    return replace(problem, question=replace(problem.question, lag=asked.lag or 0))


def window_as_designed(plant: DescriptorSystem, asked: TestOptions) -> Window:
    """Return the stacked equations of options as a design ships them: with the number of samples and the lag."""
    return problem_as_designed(plant, asked).window(int(asked.samples))


def fault_of(names: tuple[str, ...], name: str | None) -> int:
    """Return the number of the fault that is looked for."""
    if name is None and len(names) == 1:
        return 0
    if name is None or name not in names:
        given = "No fault is named" if name is None else f"There is no fault {name!r}"
        listed = (
            f"name one of {', '.join(names)}"
            if names
            else "the plant has none (Bf, Df; for a plant that changes with k: Phi, Psi)"
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


def missing_bounds(plant: DescriptorSystem | TimeVaryingDescriptorSystem, asked: TestOptions) -> Iterator[str]:
    """Yield a sentence for each bound that is missing."""
    known, names = asked.disturbance_bounds, disturbance_names(plant)
    if isinstance(plant, TimeVaryingDescriptorSystem):
        if known is None:
            yield (
                "disturbance_bounds: the largest absolute value of mu(k) in each equation is missing: give it "
                f"for {', '.join(names)}, and 0 where an equation holds exactly."
            )
        if not isinstance(asked.noise_bound, Mapping):
            yield (
                "noise_bound: a plant that changes with k states no deviations; give the bound of each output by name: "
                f"{', '.join(plant.output_names)}."
            )
        return
    acting = np.any(plant.Bd != 0.0, axis=0) | np.any(plant.Dd != 0.0, axis=0)
    if known is None or isinstance(known, Mapping):
        lacking = [name for name, does in zip(names, acting, strict=True) if does and name not in (known or {})]
        if lacking:
            yield f"disturbance_bounds: the largest absolute value of {', '.join(lacking)} is missing."
    noisy = bool(plant.Bw.any() or plant.Dw.any())
    if asked.noise_bound and not isinstance(asked.noise_bound, Mapping) and not noisy:
        yield (
            "noise_bound: the plant states no noise of which this is a number of deviations; give sensor_noise, or the "
            "bound of each output by name."
        )
    if asked.noise_bound is None and noisy:
        yield (
            "noise_bound: a standard deviation is no bound; state how many of them the noise never exceeds, or the "
            "bound of each output by name."
        )


def bounds_of(plant: DescriptorSystem | TimeVaryingDescriptorSystem, asked: TestOptions) -> Bounds:
    """Return the bounds that are given; raise `SpecError` where some are missing."""
    lacking = list(missing_bounds(plant, asked))
    if lacking:
        first = lacking[0].partition(":")[0]
        raise SpecError("A guaranteed test needs bounds.", path=f"method.options.{first}", problems=lacking)
    every, names = isinstance(plant, TimeVaryingDescriptorSystem), disturbance_names(plant)
    disturbance, disturbance_middle = between(asked.disturbance_bounds, names, "disturbance_bounds", every=every)
    if isinstance(asked.noise_bound, Mapping) or not isinstance(plant, DescriptorSystem):
        state, output = np.zeros((plant.nx, plant.ny)), np.eye(plant.ny)
        noise, middle = between(asked.noise_bound, plant.output_names, "noise_bound", every=True)
        if isinstance(plant, DescriptorSystem) and plant.Bw.any():
            raise SpecError(
                "noise_bound is given by output, but noise enters the equations too: give a number of deviations.",
                path="method.options.noise_bound",
            )
    else:
        state, output, middle = plant.Bw, plant.Dw, np.zeros(plant.nw)
        noise = by_name(asked.noise_bound, plant.noise_names, "noise_bound", every=False)
    always = by_name(asked.state_bounds, plant.state_names, "state_bounds", every=False, missing=np.inf)
    at_first = by_name(asked.initial_bounds, plant.state_names, "initial_bounds", every=False, missing=np.inf)
    found = Bounds(disturbance, state, output, noise, always, at_first, disturbance_middle, middle)
    return _between_samples(plant, asked, found) if isinstance(plant, DescriptorSystem) else found


def _between_samples(plant: DescriptorSystem, asked: TestOptions, bounds: Bounds) -> Bounds:
    """Return bounds with what disturbances do between the samples of a plant whose continuous one is known."""
    if asked.disturbance not in ("any", "rate") or not bounds.disturbance.any():
        return bounds
    moving = moving_columns(plant, None if asked.model is None else continuous_model(plant, asked.model, asked.given))
    if moving is None:
        return bounds
    sizes = bounds.disturbance
    if asked.disturbance == "rate":
        # Beside its value at the sample before a disturbance has changed by no more than its rate.
        rates = by_name(asked.disturbance_rate, plant.disturbance_names, "disturbance_rate", every=True)
        sizes = np.minimum(rates, 2.0 * sizes)
    return replace(bounds, moving=moving, moving_bounds=sizes)


def between(given: Any, names: tuple[str, ...], option: str, *, every: bool) -> tuple[FloatArray, FloatArray]:
    """Return half widths, rounded up, and middles of bounds that are numbers, or ``[low, high]`` by name."""
    low, high = {}, {}
    for name, value in given.items() if isinstance(given, Mapping) else ():
        if isinstance(value, (list, tuple, np.ndarray)):
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
        require_no_overflow(value, f"{option} of {name}", path)
        if 0.0 < value < 1.0 / LARGEST:
            raise SpecError(
                f"{option} of {name} is {value:.3g}, which underflows where it is multiplied: give it in other units.",
                path=path,
            )
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


def observer_of_rows(
    problem: WindowProblem, programmes: WindowProgrammes, tested: np.ndarray, multipliers: list[FloatArray]
) -> WindowObserver:
    """Return the weights of all rows; ``tested``: which programmes have a test."""
    plant, question = problem.plant, programmes.windows[0].question
    weights = []
    for window, values, has_test in zip(programmes.windows, multipliers, tested, strict=True):
        on_y, on_u, _ = window.weights(values)
        both = np.hstack([on_u, on_y]).ravel()
        weights.append(both if has_test else np.zeros_like(both))
    constants = [
        window.constant(values) if has_test else 0.0
        for window, values, has_test in zip(programmes.windows, multipliers, tested, strict=True)
    ]
    estimated = question.course != "step"
    name = (problem.fault,)
    return WindowObserver(
        weights=np.array(weights),
        programmes=np.where(tested[programmes.of_row], programmes.of_row, -1).astype(np.float64),
        samples=question.samples,
        horizon=problem.horizon,
        dt=plant.dt,
        input_names=plant.input_names,
        output_names=plant.output_names,
        fault_names=name if estimated else (),
        residual_names=() if estimated else name,
        fault_delays=(question.lag,) if estimated else (),
        constants=np.array(constants),
    )


def rounding_of(window: Window, multipliers: FloatArray, radius: FloatArray) -> FloatArray:
    """Return what shipped weights may err for known signals of at most one ``(nu + ny,)``; the threshold lacks it."""
    return window.known_sizes(window.errors(multipliers, radius))
