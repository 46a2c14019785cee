"""The problem of a guaranteed test, made from its options: windows of samples, and a linear programme for each row."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.methods.guaranteed_test.options import TestOptions
from obsynth.methods.guaranteed_test.window_bounds import bounds_of, by_name, fault_of, free_faults
from obsynth.methods.guaranteed_test.window_models import Bounds, TestProblem, disturbance_names, fault_names
from obsynth.methods.guaranteed_test.windows import Window, window_of
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import decide_rank
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.proofs.exact_pencils import ExactPencil
from obsynth.proofs.nonsingular import is_nonsingular_exactly

#: For each fault profile, the faults that it covers, and those that it does not.
COURSES: Mapping[str, str] = {
    "constant": "a fault that is constant over the window: the interval holds once it fills the window, an alarm is "
    "always right",
    "step": "a step after healthy samples: an alarm is right whatever the time course, but it ends once the fault "
    "fills the window, so latch it",
    "any": "a fault of any time course, at one sample: the interval holds at every row",
    "ramp": "a straight line over the window: the interval is of its value at one sample",
    "rate": "a fault that changes by at most fault_rate a sample: the interval is of its value at one sample",
}

#: Numbers of samples that ``samples="auto"`` tries; for a step, after its healthy samples.
CANDIDATE_LENGTHS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128)

#: Longer windows are not tried if they have more states than this.
MOST_WINDOW_STATES = 2500

#: ``samples="auto"`` takes the least number of samples with a threshold within this share of the one of the longest.
WITHIN = 0.05

#: Number of evenly spread rows that decide on the number of samples and the lag of a time-varying plant.
TRIED_ROWS = 8

#: Options for plants with constant matrices only, with the alternative for other plants.
REFUSED: Mapping[str, str] = {
    "isolate": "design one test for each fault, insensitive to the others (free: others)",
    "exact": "leave it out: the fixed tests, one a row, are proved",
    "missing": "leave it out (missing: wait)",
}


@dataclass(frozen=True, eq=False)
class WindowProblem:
    """A plant with bounds and a fault to be detected; number of samples, lag and row are still free.

    A time-varying plant, ``E_{k+1} x(k+1) = A_k x(k) + B_k u(k) + Phi_k f(k) + mu(k)`` and
    ``y(k+1) = C_{k+1} x(k+1) + Psi_k f(k) + nu(k)``, has a separate window for each row.
    """

    plant: DescriptorSystem | TimeVaryingDescriptorSystem
    bounds: Bounds
    test_problem: TestProblem  # with one sample more than the fault profile needs

    def window(self, samples: int, *, lag: int | None = None, row: int = 0) -> Window:
        """Return the stacked equations of a window of samples, the last one at k = ``row``."""
        lag = self.test_problem.lag if lag is None else lag
        start = 1 if self.horizon is None else row - samples + 1
        return window_of(self.plant, self.bounds, replace(self.test_problem, samples=samples, lag=lag), start)

    @property
    def horizon(self) -> int | None:
        """The last k of a time-varying plant; ``None`` for constant matrices."""
        return None if isinstance(self.plant, DescriptorSystem) else self.plant.horizon

    @property
    def fault(self) -> str:
        """Name of the fault to be detected."""
        return fault_names(self.plant)[self.test_problem.fault]

    @property
    def shortest(self) -> int:
        """The least number of samples for the fault profile."""
        return max(self.test_problem.before, self.test_problem.lag) + 1

    def enough(self, lag: int) -> int:
        """Return a number of samples that is enough: if it allows no test, no larger number does."""
        return self.test_problem.before + 2 * self.plant.nx + 2 + lag

    def ladder(self) -> tuple[int, ...]:
        """Return the numbers of samples to try; fewer for a large plant."""
        most = max(MOST_WINDOW_STATES // max(self.plant.nx, 1), self.shortest)
        most = most if self.horizon is None else min(most, self.horizon)
        lengths = [self.test_problem.before + rung for rung in CANDIDATE_LENGTHS]
        return tuple(rung for rung in lengths if self.shortest <= rung <= most) or (self.shortest,)

    def rows(self, samples: int) -> range:
        """Return the rows with a window of their own; without a horizon row 0, which represents all."""
        return range(1) if self.horizon is None else range(samples, self.horizon + 1)

    def tried(self, samples: int) -> list[int]:
        """Return some rows, evenly spread."""
        rows = self.rows(samples)
        return sorted({rows[int(k)] for k in np.linspace(0, len(rows) - 1, TRIED_ROWS)}) if len(rows) else []

    @cached_property
    def _continuing(self) -> np.ndarray:
        """For each k, whether every state that satisfies the equations up to k has a continuation to the horizon."""
        plant = self.plant
        if isinstance(plant, DescriptorSystem):
            # The window's equations contain the ones after it (`TestProblem.closing`).
            return np.ones(1, dtype=bool)
        last = 2 if plant.horizon is None else plant.horizon
        continuing = np.ones(last + 1, dtype=bool)
        for k in range(last - 1, 0, -1):
            continuing[k] = continuing[k + 1] and _continues(plant.E.at(k), plant.A.at(k), plant.E.at(k + 1))
        return continuing

    @cached_property
    def _preceded(self) -> np.ndarray:
        """For each k, whether every state has a past, so that equations before a window do not restrict its states.

        They do restrict them where A is singular, as for a delay, whose states are earlier inputs.
        """
        plant = self.plant
        if isinstance(plant, DescriptorSystem):
            return np.array([is_nonsingular_exactly(plant.A)])
        if plant.A.is_constant:
            return np.full((plant.horizon or 1) + 1, is_nonsingular_exactly(plant.A.at(0)))
        alone = [is_nonsingular_exactly(plant.A.at(k)) for k in range(plant.horizon or 1)]
        return np.array([True, *np.logical_and.accumulate(alone)])

    def has_past(self, row: int, samples: int) -> bool:
        """Whether a running plant can have every state at the first sample of a window.

        With bounds on the initial state the plant starts with the window, by assumption.
        """
        if np.isfinite(self.bounds.first).any():
            return True
        preceded = self._preceded
        return bool(preceded[0 if self.horizon is None else min(row - samples + 1, len(preceded) - 1)])

    def continues(self, window: Window, row: int) -> bool:
        """Whether every solution of a window's equations can be continued to the equations after it."""
        continuing = self._continuing
        after = 1 if self.horizon is None else row - window.test_problem.samples + 1 + window.equations
        return bool(continuing[min(after, len(continuing) - 1)])

    def is_of_a_running_plant(self, window: Window, row: int, point: FloatArray, radius: FloatArray) -> bool:
        """Whether a solution within a radius of this one ``(columns,)`` has a continuation before and after it."""
        first = [place for place, label in enumerate(window.labels) if label[:2] == ("x", 0)]
        # A plant that starts at rest, exactly, has been at rest.
        at_rest = not np.any(point[first]) and not np.any(radius[first])
        return self.continues(window, row) and (at_rest or self.has_past(row, window.test_problem.samples))


def _continues(before: FloatArray, a: FloatArray, after: FloatArray) -> bool:
    """Whether the algebraic equations of the next step restrict no value of ``E_k x``."""
    rank = decide_rank(after).rank
    if rank == len(after):
        return True
    without = np.linalg.svd(after)[0][:, rank:].T
    return decide_rank(np.vstack([before, without @ a])).rank == decide_rank(before).rank + len(without)


def test_problem_of(options: TestOptions, plant: DescriptorSystem | TimeVaryingDescriptorSystem) -> TestProblem:
    """Return fault, disturbances and profiles from the options, with one sample more than the fault profile needs."""
    names, before = fault_names(plant), options.before if options.course == "step" else 0
    fault, rates = fault_of(names, options.fault), np.zeros(0)
    if options.disturbance == "rate":
        rates = by_name(options.disturbance_rate, disturbance_names(plant), "disturbance_rate", every=True)
    index = None
    if isinstance(plant, DescriptorSystem) and not decide_rank(plant.E).full:
        index = ExactPencil.written(plant.E, plant.A).index
    return TestProblem(
        fault=fault,
        course=options.course,
        samples=before + 1,
        lag=options.lag or 0,
        before=before,
        free=free_faults(names, options.free, fault),
        free_course=options.free_course,
        disturbance=options.disturbance,
        disturbance_rate=rates,
        fault_rate=float(options.fault_rate or 0.0),
        ellipsoid=options.norm == "ellipsoid",
        closing=max((index or 0) - 1, 0),
    )


def problem_of(plant: DescriptorSystem | TimeVaryingDescriptorSystem, options: TestOptions) -> WindowProblem:
    """Return the problem that options pose for a plant.

    Raises
    ------
    SpecError
        An option is not for this kind of plant, a signal is unknown, a bound is missing, or a profile does not fit.
    """
    if isinstance(plant, TimeVaryingDescriptorSystem):
        for name, is_chosen in (
            ("isolate", options.isolate),
            ("exact", options.exact),
            ("missing", options.missing == "solve"),
        ):
            if is_chosen:
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
    test_problem = test_problem_of(options, plant)
    return WindowProblem(plant, bounds_of(plant, options), test_problem)


def require_linear_options(options: TestOptions) -> None:
    """Raise `SpecError` for options of nonlinear plants."""
    for option in ("region", "sample_time", "given", "model"):
        if getattr(options, option) is not None:
            raise SpecError(f"{option} is for nonlinear plants: leave it out.", path=f"method.options.{option}")


def samples_given(options: TestOptions) -> Any:
    """Return the number of samples, or ``auto``."""
    return options.before + options.after if options.after is not None else options.samples


@dataclass(frozen=True, eq=False)
class WindowProgrammes:
    """The distinct windows of all rows, the first row of each, and the index of each row's window ``(rows,)``."""

    windows: tuple[Window, ...]
    first: tuple[int, ...]
    of_row: np.ndarray

    @classmethod
    def of(cls, problem: WindowProblem, samples: int) -> WindowProgrammes:
        """Return the windows of a problem; windows with the same numbers count once."""
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


def problem_as_designed(plant: DescriptorSystem | TimeVaryingDescriptorSystem, options: TestOptions) -> WindowProblem:
    """Return the problem of the options of a finished design, which state the lag."""
    problem = problem_of(plant, options)
    return replace(problem, test_problem=replace(problem.test_problem, lag=options.lag or 0))


def window_as_designed(plant: DescriptorSystem, options: TestOptions) -> Window:
    """Return the stacked equations of a finished design, whose options state the number of samples and the lag."""
    return problem_as_designed(plant, options).window(int(options.samples))
