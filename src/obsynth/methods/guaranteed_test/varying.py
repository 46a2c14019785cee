"""Guaranteed tests of plants whose matrices change with k: the equations of the window before each row.

``E_{k+1} x(k+1) = A_k x(k) + B_k u(k) + Phi_k f(k) + mu(k)`` and ``y(k+1) = C_{k+1} x(k+1) + Psi_k f(k) + nu(k)``.

A fault of k acts on the way to sample k + 1, and shows in its outputs; of a window it is that of this sample.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.methods.guaranteed_test.options import Asked
from obsynth.methods.guaranteed_test.problem import LADDER, MOST_STATES, between, by_name, question_of, require_bounds
from obsynth.methods.guaranteed_test.windows import Bounds, Question, Window, stacked
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import decide_rank
from obsynth.observers.windows import WindowObserver
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem

#: Rows, evenly spread, whose windows decide on the number of samples and the lag.
TRIED_ROWS = 8
#: What is for plants with constant matrices, and what to do instead.
REFUSED: Mapping[str, str] = {
    "isolate": "design one test for each fault, insensitive to the others (free: others)",
    "exact": "leave it out: the fixed tests, one a row, are proved",
    "missing": "leave it out (missing: wait)",
}


class Varying:
    """The matrices of a window whose first sample is ``start``, 1 or more."""

    later = 1

    def __init__(self, plant: TimeVaryingDescriptorSystem, start: int, samples: int) -> None:
        self._plant, self._start = plant, start
        self.sizes = (plant.nx, plant.ne, plant.nu, plant.ny)
        self.state_names, self.fault_names = plant.state_names, plant.parameter_names
        self.disturbance_names = disturbance_names(plant)
        self.D = np.zeros((plant.ny, plant.nu))
        last = start + samples
        # An equation whose state is determined by nothing else says something where E loses rows only.
        more = (plant.horizon is None or last <= plant.horizon) and not _full(plant.E.at(last))
        self._count = samples - 1 + int(more)
        self.regular = all(_full(plant.E.at(start + k + 1)) for k in range(self._count))

    def equations(self, question: Question) -> int:
        """Return for how many k there are equations."""
        del question
        return self._count

    def at(self, k: int) -> tuple[FloatArray, FloatArray]:
        """Return what multiplies the states after and before equation k."""
        return self._plant.E.at(self._start + k + 1), self._plant.A.at(self._start + k)

    def seen(self, k: int) -> FloatArray:
        """Return what multiplies the state in the outputs of sample k."""
        return self._plant.C.at(self._start + k)

    def acting(self, kind: str, which: np.ndarray, k: int) -> tuple[int, FloatArray, FloatArray]:
        """Return what columns of a kind do at sample k."""
        _, ne, _, ny = self.sizes
        if kind == "w":
            return -1, np.zeros((ne, len(which))), np.eye(ny)[:, which]
        if kind == "d":
            return k, np.eye(ne)[:, which], np.zeros((ny, len(which)))
        before = self._start + k - 1
        return k - 1, self._plant.Phi.at(before)[:, which], self._plant.Psi.at(before)[:, which]

    def inputs(self, k: int) -> FloatArray:
        """Return what known inputs do in equation k."""
        return self._plant.B.at(self._start + k)


def _full(matrix: FloatArray) -> bool:
    """Whether rows are independent: a state then satisfies them whatever stands on the right."""
    return matrix.shape[0] <= matrix.shape[1] and decide_rank(matrix).rank == len(matrix)


def disturbance_names(plant: TimeVaryingDescriptorSystem) -> tuple[str, ...]:
    """Return the names of what disturbs each equation: ``mu1``, ``mu2``, ..."""
    return tuple(f"mu{i + 1}" for i in range(plant.ne))


@dataclass(frozen=True, eq=False)
class VaryingProblem:
    """A plant with its bounds and what is asked, but for samples, lag and row."""

    plant: TimeVaryingDescriptorSystem
    bounds: Bounds
    question: Question

    def window(self, row: int, samples: int, lag: int) -> Window:
        """Return the equations of the window that ends at k = row."""
        model = Varying(self.plant, row - samples + 1, samples)
        return stacked(model, self.bounds, replace(self.question, samples=samples, lag=lag))

    @property
    def shortest(self) -> int:
        """The least number of samples that the course fits in."""
        return max(self.question.before, self.question.lag) + 1

    def rows(self, samples: int) -> range:
        """Return the rows that have a window; without a horizon, of constant matrices, one that stands for all."""
        last = samples if self.plant.horizon is None else self.plant.horizon
        return range(samples, last + 1)

    def tried(self, samples: int) -> list[int]:
        """Return some rows, evenly spread."""
        rows = self.rows(samples)
        return sorted({rows[int(k)] for k in np.linspace(0, len(rows) - 1, TRIED_ROWS)}) if len(rows) else []

    def ladder(self) -> tuple[int, ...]:
        """Return the numbers of samples to try."""
        most = max(MOST_STATES // self.plant.nx, self.shortest)
        most = most if self.plant.horizon is None else min(most, self.plant.horizon)
        asked = [self.question.before + rung for rung in LADDER]
        return tuple(rung for rung in asked if self.shortest <= rung <= most) or (self.shortest,)

    @cached_property
    def _continuing(self) -> np.ndarray:
        """By k, whether every state that satisfies the equations up to it has a course to the horizon."""
        plant = self.plant
        last = 2 if plant.horizon is None else plant.horizon
        found = np.ones(last + 1, dtype=bool)
        for k in range(last - 1, 0, -1):
            found[k] = found[k + 1] and _continues(plant.E.at(k), plant.A.at(k), plant.E.at(k + 1))
        return found

    def continues(self, window: Window, row: int) -> bool:
        """Whether what satisfies the equations of a window satisfies those after it, with some later states."""
        after = row - window.question.samples + 1 + window.equations
        found = self._continuing
        return bool(found[1] if self.plant.horizon is None else found[min(after, len(found) - 1)])


def _continues(before: FloatArray, a: FloatArray, after: FloatArray) -> bool:
    """Whether a state with any ``E_k x`` can also satisfy those equations of the next step that E has no part in."""
    rank = decide_rank(after).rank
    if rank == len(after):
        return True
    without = np.linalg.svd(after)[0][:, rank:].T
    return decide_rank(np.vstack([before, without @ a])).rank == decide_rank(before).rank + len(without)


def varying_problem(plant: TimeVaryingDescriptorSystem, asked: Asked) -> VaryingProblem:
    """Return what is asked of a plant; raise `SpecError` for what it cannot be asked, and for missing bounds."""
    for name, given in (("isolate", asked.isolate), ("exact", asked.exact), ("missing", asked.missing == "solve")):
        if given:
            raise SpecError(
                f"{name} is for plants whose matrices do not change with k: {REFUSED[name]}.",
                path=f"method.options.{name}",
            )
    if plant.horizon is None and not plant.is_time_invariant:
        raise SpecError(
            "The plant changes with k and has no horizon, but each row has a programme of its own: give a horizon, as "
            "many steps as the log has.",
            path="plant.horizon",
        )
    require_bounds(missing_varying_bounds(plant, asked))
    names = disturbance_names(plant)
    question = question_of(asked, plant.parameter_names, names)
    disturbance, disturbance_middle = between(asked.disturbance_bounds, names, "disturbance_bounds", every=True)
    noise, noise_middle = between(asked.noise_bound, plant.output_names, "noise_bound", every=True)
    bounds = Bounds(
        disturbance,
        np.zeros((plant.ne, plant.ny)),
        np.eye(plant.ny),
        noise,
        by_name(asked.state_bounds, plant.state_names, "state_bounds", every=False, missing=np.inf),
        by_name(asked.initial_bounds, plant.state_names, "initial_bounds", every=False, missing=np.inf),
        disturbance_middle,
        noise_middle,
    )
    return VaryingProblem(plant, bounds, question)


def missing_varying_bounds(plant: TimeVaryingDescriptorSystem, asked: Asked) -> Iterator[str]:
    """Yield a sentence for each bound that is missing."""
    names = disturbance_names(plant)
    if asked.disturbance_bounds is None:
        yield (
            "disturbance_bounds: the largest absolute value of mu(k) in each equation is missing: of "
            f"{', '.join(names)}, 0 where an equation holds exactly."
        )
    if not isinstance(asked.noise_bound, Mapping):
        yield (
            "noise_bound: a plant that changes with k states no deviations; give the bound of each output by name: "
            f"{', '.join(plant.output_names)}."
        )


def key_of(window: Window) -> bytes:
    """Return what windows have in common that have one programme and one test."""
    digest = hashlib.blake2b(digest_size=32)
    for part in (window.i, window.j, window.value, window.times, window.bar, np.array([window.rows])):
        digest.update(np.ascontiguousarray(part).tobytes() + b"|")
    for k in range(window.equations):
        digest.update(np.ascontiguousarray(window.model.inputs(k)).tobytes())
    return digest.digest()


@dataclass(frozen=True, eq=False)
class Programmes:
    """The different windows of all rows, the first row of each, and which window each row has ``(rows,)``."""

    windows: tuple[Window, ...]
    first: tuple[int, ...]
    of_row: np.ndarray

    @classmethod
    def of(cls, problem: VaryingProblem, samples: int, lag: int) -> Programmes:
        """Return them; those with the same numbers are one."""
        numbers: dict[bytes, int] = {}
        windows: list[Window] = []
        first: list[int] = []
        of_row = []
        for row in problem.rows(samples):
            window = problem.window(row, samples, lag)
            key = key_of(window) + bytes([problem.continues(window, row)])
            if key not in numbers:
                numbers[key] = len(windows)
                windows.append(window)
                first.append(row)
            of_row.append(numbers[key])
        return cls(tuple(windows), tuple(first), np.array(of_row, dtype=np.int64))


def observer_of_rows(
    problem: VaryingProblem, programmes: Programmes, told: np.ndarray, multipliers: list[FloatArray]
) -> WindowObserver:
    """Return the weights of all rows; ``told``: which programmes have a test."""
    plant, question = problem.plant, programmes.windows[0].question
    weights = []
    for window, values, has_test in zip(programmes.windows, multipliers, told, strict=True):
        on_y, on_u, _ = window.weights(values)
        both = np.hstack([on_u, on_y]).ravel()
        weights.append(both if has_test else np.zeros_like(both))
    constants = [
        window.constant(values) if has_test else 0.0
        for window, values, has_test in zip(programmes.windows, multipliers, told, strict=True)
    ]
    estimated = question.course != "step"
    name = (plant.parameter_names[question.fault],)
    return WindowObserver(
        weights=np.array(weights),
        programmes=np.where(told[programmes.of_row], programmes.of_row, -1).astype(np.float64),
        samples=question.samples,
        horizon=plant.horizon,
        dt=plant.dt,
        input_names=plant.input_names,
        output_names=plant.output_names,
        fault_names=name if estimated else (),
        residual_names=() if estimated else name,
        fault_delays=(question.lag,) if estimated else (),
        constants=np.array(constants),
    )


def programmes_as_designed(plant: TimeVaryingDescriptorSystem, asked: Any) -> tuple[VaryingProblem, Programmes]:
    """Return the windows of options as a design ships them: with the number of samples and the lag."""
    problem = varying_problem(plant, asked)
    lag = asked.lag or 0
    problem = replace(problem, question=replace(problem.question, lag=lag))
    return problem, Programmes.of(problem, int(asked.samples), lag)
