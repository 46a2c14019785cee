"""Least sets of sensors for detecting, isolating or estimating faults.

Few sets are enumerated; of many, greedy choices find inclusion-minimal ones, and say so: with y = (d1, d2, d1 + f)
{1, 3} suffices, greedy takes three.  Screening at points s0 is by rows of ``[C, D] (s0 E - A)^-1 [Bd, Bf]``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from math import comb

import numpy as np
from numpy.typing import NDArray

from obsynth.analysis.diagnosis.candidate_sensors import Sensor, with_sensors
from obsynth.analysis.diagnosis.exact_fault_columns import DecoupledFaults
from obsynth.analysis.diagnosis.fault_columns import others
from obsynth.analysis.diagnosis.without_unknown_inputs import PencilUnits
from obsynth.numerics.arrays import SMALLEST, ComplexArray, FloatArray
from obsynth.numerics.ranks import CANCELLATION_TOLERANCE, RANK_TOLERANCE
from obsynth.plants.descriptor import DescriptorSystem

#: Points without meaning, in units of the plant's own time scale.
GENERIC_SCALED_POINTS = (0.7391 + 0.2j, 0.31 + 1.3247j)

#: Part of a fault's column outside the span of the others, relative to it, below which it does not show.
SHOWN_PART = 1e-9

#: Sets of one size are enumerated up to so many; the best of each size are confirmed until so many fail in a row.
MOST_ENUMERATED_SETS = 40_000

MOST_CONFIRMED = 400


@dataclass(frozen=True, eq=False)
class SensorResponses:
    """Rows: outputs, then candidates; columns: unknown inputs, then faults; ``tables (points, rows, nd + nf)``."""

    tables: ComplexArray
    outputs: int
    nd: int

    @classmethod
    def of(cls, plant: DescriptorSystem, sensors: Sequence[Sensor]) -> SensorResponses | None:
        """Return the tables, or ``None`` where the pencil is singular at a generic point."""
        units = PencilUnits.of(plant.E, plant.A)
        inputs = np.hstack([plant.Bd, plant.Bf])
        c = np.vstack([plant.C, *(sensor.C[None, :] for sensor in sensors)])
        direct = np.vstack(
            [np.hstack([plant.Dd, plant.Df]), *(np.hstack([sensor.Dd, sensor.Df])[None, :] for sensor in sensors)]
        )
        tables = []
        for point in GENERIC_SCALED_POINTS:
            pencil = units.rows[:, None] * (point * units.time * plant.E - plant.A) * units.columns
            values = np.linalg.svd(pencil, compute_uv=False) if pencil.size else np.ones(1)
            if values[-1] <= RANK_TOLERANCE * values[0]:
                return None
            states, terms = _solution(pencil, units.rows[:, None] * inputs)
            table = c @ (units.columns[:, None] * states) + direct
            terms = np.abs(c) @ (units.columns[:, None] * terms) + np.abs(direct)
            # What a sensor does not see would be rounding, and that as large as any response once rows have one size.
            table = np.where(np.abs(table) > CANCELLATION_TOLERANCE * terms, table, 0.0)
            for axis in (1, 0):
                sizes = np.linalg.norm(table, axis=axis, keepdims=True)
                table = table / np.where(sizes > 0.0, sizes, 1.0)
            tables.append(table)
        return cls(np.array(tables, dtype=np.complex128), plant.ny, plant.nd)

    def shows(self, sets: NDArray[np.int64], fault: int, beside: Sequence[int]) -> NDArray[np.float64]:
        """Return the share of a fault's column outside the span of d and ``beside``, for sets ``(N, k)``."""
        count = len(sets)
        fixed = np.broadcast_to(np.arange(self.outputs), (count, self.outputs))
        rows = np.hstack([fixed, self.outputs + sets])
        columns = [*range(self.nd), *(self.nd + j for j in beside)]
        shares = np.zeros(count)
        if rows.shape[1] == 0:
            return shares
        for table in self.tables:
            goal = table[:, self.nd + fault][rows]
            parts = _norm_outside(table[:, columns][rows], goal)
            size = np.linalg.norm(goal, axis=1)
            shares = np.maximum(shares, np.where(size > 0.0, parts / np.where(size > 0.0, size, 1.0), 0.0))
        return np.where(shares > SHOWN_PART, shares, 0.0)


def _solution(matrix: ComplexArray | FloatArray, right: FloatArray) -> tuple[ComplexArray, FloatArray]:
    """Return a solution, refined once, and the sizes of the terms of each entry: ``|M^-1| (|M| |x| + |b|)``.

    An entry errs by a few roundings of its own terms then, whatever units rows and columns have ([Higham2002]_, 12.2).

    .. [Higham2002] N. J. Higham, Accuracy and Stability of Numerical Algorithms, 2nd ed., SIAM, 2002.
    """
    solved = np.linalg.solve(matrix, np.hstack([right, np.eye(len(matrix))]))
    x, inverse = solved[:, : right.shape[1]], solved[:, right.shape[1] :]
    x = x + inverse @ (right - matrix @ x)
    return x, np.abs(inverse) @ (np.abs(matrix) @ np.abs(x) + np.abs(right))


def _norm_outside(span: ComplexArray, vector: ComplexArray) -> NDArray[np.float64]:
    """Return the norm of the part of each vector ``(N, m)`` outside the span of columns ``(N, m, c)``."""
    if span.shape[2] == 0:
        return np.asarray(np.linalg.norm(vector, axis=1))
    left_vectors, values, _ = np.linalg.svd(span, full_matrices=False)
    directions = left_vectors * (values > RANK_TOLERANCE * np.maximum(values[:, :1], SMALLEST))[:, None, :]
    for _ in range(2):
        vector = vector - np.einsum("nij,nj->ni", directions, np.einsum("nij,ni->nj", directions.conj(), vector))
    return np.asarray(np.linalg.norm(vector, axis=1))


@dataclass(frozen=True)
class Task:
    """One thing to be reached: a fault, free of the unknown inputs and of the faults ``beside``."""

    fault: int
    beside: tuple[int, ...]
    goal: str


@dataclass(frozen=True, eq=False)
class SensorSearch:
    """A search over sets of candidate sensors, for the columns ``faults``."""

    plant: DescriptorSystem
    sensors: tuple[Sensor, ...]
    goal: str
    faults: tuple[int, ...]
    may_fail: bool  # an added sensor brings a fault of its own, to be reported as well
    copies: int  # how often a sensor may be taken

    @cached_property
    def responses(self) -> SensorResponses | None:
        """What outputs and candidates show of unknown inputs and faults at generic points."""
        return SensorResponses.of(self.plant, self.sensors)

    def tasks(self, plant: DescriptorSystem, faults: Sequence[int]) -> list[Task]:
        """Return everything that the goal asks of a plant."""
        if self.goal == "detect":
            return [Task(i, (), self.goal) for i in faults]
        if self.goal == "isolate":
            pairs = [Task(i, (j,), self.goal) for i in faults for j in others(plant, i)]
            return [*(Task(i, (), self.goal) for i in faults), *pairs]
        return [Task(i, others(plant, i), self.goal) for i in faults]

    @cached_property
    def had(self) -> list[Task]:
        """The tasks that the plant reaches with no sensor added."""
        return [task for task in self.tasks(self.plant, self.faults) if reached(self._without_candidates, task)]

    @cached_property
    def _without_candidates(self) -> DecoupledFaults:
        return DecoupledFaults(self.plant, exactly=False)

    def reachable(self) -> list[Task]:
        """Return the tasks that all candidates together reach: no set can do more, and no sensor takes one away."""
        equipped, had = DecoupledFaults(with_sensors(self.plant, self.sensors), exactly=False), set(self.had)
        return [task for task in self.tasks(self.plant, self.faults) if task in had or reached(equipped, task)]

    def equipped(self, chosen: Sequence[int]) -> DescriptorSystem:
        """Return the plant with a set of candidates, each with a fault of its own where sensors may fail."""
        picked = []
        names = [self.sensors[index].name for index in chosen]
        for place, (index, name) in enumerate(zip(chosen, names, strict=True)):
            again = names[: place + 1].count(name)
            picked.append(replace(self.sensors[index], name=name if again == 1 else f"{name} ({again})"))
        plant = with_sensors(self.plant, picked)
        if not self.may_fail or not picked:
            return plant
        count = len(picked)
        own = np.vstack([np.zeros((self.plant.ny, count)), np.eye(count)])
        return plant.replace(
            Bf=np.hstack([plant.Bf, np.zeros((plant.nx, count))]),
            Df=np.hstack([plant.Df, own]),
            fault_names=[*plant.fault_names, *(f"sensor {sensor.name}" for sensor in picked)],
        )

    def feasible(self, chosen: Sequence[int], tasks: Sequence[Task]) -> bool:
        """Whether a set reaches all that is wanted (and all about its own faults)."""
        if not chosen:
            return set(tasks) <= set(self.had)
        plant = self.equipped(chosen)
        faults = DecoupledFaults(plant, exactly=False)
        if not all(reached(faults, task) for task in tasks):
            return False
        if not self.may_fail:
            return True
        known = self.plant.nf
        more = self.tasks(plant, [*self.faults, *range(known, plant.nf)])
        return all(reached(faults, task) for task in more if max(task.fault, *task.beside, -1) >= known)

    def minimal_sets(self, tasks: Sequence[Task], largest: int, most: int) -> tuple[list[tuple[int, ...]], bool]:
        """Return inclusion-minimal sets by size, and whether these are all of them up to the largest size."""
        responses = None if self.may_fail else self.responses
        minimal: list[tuple[int, ...]] = []
        count = len(self.sensors)
        for size in range(largest + 1):
            if comb(count * self.copies, size) > MOST_ENUMERATED_SETS:
                return minimal, False
            every = dict.fromkeys(combinations([i for i in range(count) for _ in range(self.copies)], size))
            sets = [chosen for chosen in every if not any(Counter(f) <= Counter(chosen) for f in minimal)]
            new: list[tuple[int, ...]] = []
            for tried, chosen in enumerate(self._promising(sets, tasks, responses), start=1):
                if self.feasible(chosen, tasks):
                    new.append(chosen)
                if len(minimal) + len(new) >= most or tried >= MOST_CONFIRMED:
                    return [*minimal, *new], False
            minimal += new
            if () in minimal:  # every other set holds it
                break
        return minimal, True

    def _promising(
        self, sets: Sequence[tuple[int, ...]], tasks: Sequence[Task], responses: SensorResponses | None
    ) -> list[tuple[int, ...]]:
        """Return the sets that pass the rank test, those that show most first."""
        if responses is None or not sets or self.copies > 1:
            return list(sets)
        table = np.array(sets, dtype=np.int64).reshape(len(sets), -1)
        strength = np.full(len(sets), np.inf)
        for task in tasks:
            strength = np.minimum(strength, responses.shows(table, task.fault, task.beside))
        order = np.argsort(-strength, kind="stable")
        return [sets[i] for i in order if strength[i] > 0.0]

    def greedy_set(self, tasks: Sequence[Task]) -> tuple[int, ...] | None:
        """Return one inclusion-minimal set: the sensor that reaches most, again and again; then what is not needed."""
        chosen: list[int] = []
        candidates = list(range(len(self.sensors)))
        while not self.feasible(chosen, tasks):
            if not candidates:
                return None
            scores = [self._score([*chosen, i], tasks) for i in candidates]
            chosen.append(candidates.pop(int(np.argmax(scores))))
        for index in list(chosen):
            fewer = [i for i in chosen if i != index]
            if self.feasible(fewer, tasks):
                chosen = fewer
        return tuple(sorted(chosen))

    def _score(self, chosen: Sequence[int], tasks: Sequence[Task]) -> float:
        responses = self.responses
        if responses is None:
            faults = DecoupledFaults(self.equipped(chosen), exactly=False)
            return float(sum(reached(faults, task) for task in tasks))
        table = np.array([chosen], dtype=np.int64)
        shares = [float(responses.shows(table, task.fault, task.beside)[0]) for task in tasks]
        return sum(value > 0.0 for value in shares) + min([value for value in shares if value > 0.0], default=0.0) / 2.0


def reached(faults: DecoupledFaults, task: Task) -> bool:
    """Whether a plant reaches a task, decided by taking out what must not show: once for all faults that stay."""
    decoupled = faults.of(task.beside, task.fault)
    if task.goal == "estimate":
        return decoupled.estimable
    return decoupled.shows_at_rest if task.goal == "estimate-step" else decoupled.visible
