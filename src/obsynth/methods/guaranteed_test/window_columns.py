"""The columns of a window's linear programme: disturbances at and between the samples, and the fault."""

from __future__ import annotations

from typing import Any

import numpy as np

from obsynth.methods.guaranteed_test.window_models import Bounds, TestProblem
from obsynth.numerics.arrays import FloatArray


class Builder:
    """Collects the columns of a sparse matrix, their bounds, and its entries."""

    def __init__(self) -> None:
        #: By column: kind, sample and number of its signal.
        self.labels: list[tuple[Any, ...]] = []
        #: By column: the largest absolute value.
        self.bar: list[float] = []
        #: By column: the number of its ellipsoid, -1 without.
        self.group: list[int] = []
        #: By block: rows, columns and values of its entries, and the whole number by which each is multiplied.
        self.parts: list[tuple[np.ndarray, np.ndarray, FloatArray, np.ndarray]] = []

    def columns(self, labels: list[tuple[Any, ...]], bars: Any, group: int = -1) -> int:
        """Append columns with their bounds ``bars``; return the number of the first."""
        first = len(self.labels)
        self.labels += labels
        self.bar += [float(value) for value in bars]
        self.group += [group] * len(labels)
        return first

    def put(self, row: int, matrix: FloatArray, column: int, times: int = 1) -> None:
        """Enter ``times`` a block of the matrix, its upper left entry at ``(row, column)``."""
        i, j = np.nonzero(matrix)
        if i.size and times:
            self.parts.append((row + i, column + j, matrix[i, j], np.full(i.size, times, dtype=np.int64)))


def disturbance_columns(
    bounds: Bounds, test_problem: TestProblem, builder: Builder, acting: Any, span: range, rows: int
) -> int:
    """Enter the disturbances over ``span``, and with a bounded rate one more row for each change; return how many rows
    there are then."""
    entry = np.ones((1, 1))
    kind = "d at samples" if bounds.moving is not None and test_problem.disturbance == "any" else "d"
    for i in np.flatnonzero(bounds.disturbance > 0.0).tolist():
        signal, bar = np.array([i]), bounds.disturbance[i]
        column = before = -1
        for k in span:
            if test_problem.disturbance != "held" or column < 0:
                label = ("d", None if test_problem.disturbance == "held" else k, i)
                free = test_problem.disturbance in ("any", "jump")
                column = builder.columns([label], [bar], 2 * k + 1 if free else -1)
            acting(kind, signal, k, column)
            if test_problem.disturbance == "rate" and before >= 0:
                change = builder.columns([("change of d", k, i)], [test_problem.disturbance_rate[i]])
                for place, times in ((column, 1), (before, -1), (change, -1)):
                    builder.put(rows, entry, place, times)
                rows += 1
            before = column
    return rows


def moving_disturbances(bounds: Bounds, builder: Builder, equations: int, ne: int) -> None:
    """Enter what disturbances that move between samples put into the equations of each: columns of one time in one
    ellipsoid, and, where every course counts, one for each direction of what these columns leave."""
    columns = columns_between_samples(bounds)
    blocks = 1 + max((block for *_, block in columns if block is not None), default=0)
    for k in range(equations):
        for (kind, place), entries, bar, block in columns:
            # Groups 2 k and 2 k + 1 are those of noise and disturbances at the samples.
            group = -1 if block is None else 2 * (equations + 2 + k * blocks + block)
            column = builder.columns([(kind, k, place, block)], [bar], group)
            builder.put(k * ne, -entries[:, None], column)


def columns_between_samples(bounds: Bounds) -> list[tuple[tuple[str, int], FloatArray, float, int | None]]:
    """Return what disturbances that move between samples put into the states of each: kind and number of the signal,
    the column ``(nx,)``, its bound, and the number of its block, or none for what the blocks leave."""
    moving = bounds.moving
    if moving is None or bounds.moving_bounds is None:
        return []
    nd, sizes = len(bounds.moving_bounds), bounds.moving_bounds.tolist()
    columns = moving.columns if bounds.every else moving.resting
    listed: list[tuple[tuple[str, int], FloatArray, float, int | None]] = [
        (("moving d", i), columns[:, block * nd + i], sizes[i], block)
        for block in range(columns.shape[1] // nd)
        for i in range(nd)
        if sizes[i] > 0.0 and moving.moved[i]
    ]
    remainders = bounds.times_rest * moving.rest(bounds.moving_bounds) if bounds.every else np.zeros(0)
    for i in np.flatnonzero(remainders > 0.0).tolist():
        listed.append((("left by d", i), moving.directions[:, i], float(remainders[i]), None))
    return listed


def fault_columns(test_problem: TestProblem, builder: Builder, acting: Any, span: range) -> None:
    """Enter the fault: its size at the target sample is column 0, others hold what its course leaves free."""
    fault = np.array([test_problem.fault])
    target = test_problem.samples - 1 - test_problem.lag
    if test_problem.course in ("constant", "step"):
        for k in span:
            if k >= test_problem.before or test_problem.course == "constant":
                acting("f", fault, k, 0)
    elif test_problem.course == "ramp":
        slope = builder.columns([("slope", None, test_problem.fault)], [np.inf])
        for k in span:
            acting("f", fault, k, 0)
            acting("f", fault, k, slope, k - target)
    elif test_problem.course == "any":
        for k in span:
            column = 0 if k == target else builder.columns([("f", k, test_problem.fault)], [np.inf])
            acting("f", fault, k, column)
    else:
        for k in span:
            acting("f", fault, k, 0)
        for k in span[1:]:
            change = builder.columns([("change of f", k, test_problem.fault)], [test_problem.fault_rate])
            later = range(k, len(span)) if k > target else range(k)
            for later_sample in later:
                acting("f", fault, later_sample, change, 1 if k > target else -1)
