r"""The equations of a plant over a window of samples, as one sparse matrix.

.. math::
    M_z z + m \theta + M_s s = b(y, u), \qquad |s_i| \le \bar s_i, \quad z \text{ free}

Rows are the equations ``E x_{k+1} - A x_k - ... = B u_k`` and the outputs ``C x_k + ... = y_k - D u_k``; theta is the
size of the fault.  Every entry is kept as a double times a whole number, so that claims can be checked exactly.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import decide_rank
from obsynth.plants.descriptor import DescriptorSystem

if TYPE_CHECKING:
    from scipy.sparse import csr_array

#: Entries below this power of two times the largest of their row or column do not count in its scale.
MOST_SPREAD = 30
#: Rounds of scaling rows and free columns by powers of two.
SCALING_ROUNDS = 4


@dataclass(frozen=True, eq=False)
class Bounds:
    """What keeps its bounds: disturbances, columns of noise, states.

    ``disturbance (nd,)``; ``noise_state (nx, n)``, ``noise_output (ny, n)`` and ``noise (n,)``: noise columns and their
    bounds; ``state`` and ``first`` ``(nx,)``: of the states at every and at the first sample, infinite without any.
    """

    disturbance: FloatArray
    noise_state: FloatArray
    noise_output: FloatArray
    noise: FloatArray
    state: FloatArray
    first: FloatArray


@dataclass(frozen=True, eq=False)
class Question:
    """What is asked of a window: the fault, its course, the samples, and what else may happen."""

    fault: int
    course: str
    samples: int
    lag: int = 0
    before: int = 0
    free: tuple[int, ...] = ()
    free_course: str = "any"
    disturbance: str = "jump"
    disturbance_rate: FloatArray = field(default_factory=lambda: np.zeros(0))
    fault_rate: float = 0.0
    ellipsoid: bool = False
    #: Equations after the last sample, without outputs: sound where the record goes on.
    closing: int = 0


class Builder:
    """Collects columns and entries."""

    def __init__(self) -> None:
        self.labels: list[tuple[Any, ...]] = []
        self.bar: list[float] = []
        self.group: list[int] = []
        self.parts: list[tuple[np.ndarray, np.ndarray, FloatArray, np.ndarray]] = []

    def columns(self, labels: list[tuple[Any, ...]], bars: Any, group: int = -1) -> int:
        """Append columns; return the number of the first."""
        first = len(self.labels)
        self.labels += labels
        self.bar += [float(value) for value in bars]
        self.group += [group] * len(labels)
        return first

    def put(self, row: int, matrix: FloatArray, column: int, times: int = 1) -> None:
        """Enter a block of the matrix."""
        i, j = np.nonzero(matrix)
        if i.size and times:
            self.parts.append((row + i, column + j, matrix[i, j], np.full(i.size, times, dtype=np.int64)))


@dataclass(frozen=True, eq=False)
class Window:
    """The stacked equations of a question; column 0 is theta."""

    plant: DescriptorSystem
    bounds: Bounds
    question: Question
    rows: int
    equations: int  # number of k for which there are equations
    labels: tuple[tuple[Any, ...], ...]
    bar: FloatArray
    group: np.ndarray
    i: np.ndarray
    j: np.ndarray
    value: FloatArray
    times: np.ndarray

    def with_columns(self, more: Builder) -> Window:
        """Return the same rows with more columns."""
        i, j, value, times = (np.concatenate(parts) for parts in zip(*more.parts, strict=True))
        return replace(
            self,
            labels=(*self.labels, *more.labels),
            bar=np.concatenate([self.bar, more.bar]),
            group=np.concatenate([self.group, more.group]),
            i=np.concatenate([self.i, i]),
            j=np.concatenate([self.j, j + len(self.labels)]),
            value=np.concatenate([self.value, value]),
            times=np.concatenate([self.times, times]),
        )

    @property
    def outputs_at(self) -> int:
        """First row of the outputs."""
        return self.equations * self.plant.nx

    @property
    def twice_is_hidden(self) -> bool:
        """Whether twice the fault of a witness and none give the same samples, not only the fault and its opposite.

        For that the states must be free to follow what the disturbances do without the fault: bounds may cut that off,
        as may equations without dynamics those of the first sample.
        """
        at_first = self.equations == self.question.samples - 1 or np.isinf(self.bounds.first).all()
        return bool(at_first and np.isinf(self.bounds.state).all())

    @cached_property
    def free(self) -> np.ndarray:
        """Which columns have no bound, theta not among them."""
        found = np.isinf(self.bar)
        found[0] = False
        return found

    @cached_property
    def bounded(self) -> np.ndarray:
        """Which columns have a bound."""
        return np.isfinite(self.bar)

    @cached_property
    def matrix(self) -> csr_array:
        """All columns, in double precision."""
        from scipy.sparse import csr_array

        shape = (self.rows, len(self.bar))
        return csr_array((self.value * self.times, (self.i, self.j)), shape=shape)

    @cached_property
    def scales(self) -> tuple[np.ndarray, np.ndarray]:
        """Exponents of the powers of two by which rows and columns are multiplied before anything is computed."""
        columns = np.where(self.bounded, _exponent(np.where(self.bounded, self.bar, 1.0)), 0)
        rows, size = np.zeros(self.rows, dtype=np.int64), _exponent(self.value * self.times)
        for _ in range(SCALING_ROUNDS):
            rows = -_middle(size + columns[self.j], self.i, self.rows)
            moved = -_middle(size + rows[self.i], self.j, len(self.bar))
            columns = np.where(self.bounded, columns, moved)
        return rows, columns

    def weights(self, multipliers: FloatArray) -> tuple[FloatArray, FloatArray, int]:
        """Return the weights of outputs and known inputs, newest sample first ``(n, ny)``, ``(n, nu)``, and the delay.

        ``multipliers (rows,)``: the test is their product with the right sides, at the last sample that has a weight.
        """
        plant, question = self.plant, self.question
        length = max(self.equations, question.samples)
        on_y, on_u = np.zeros((length, plant.ny)), np.zeros((length, plant.nu))
        per_sample = multipliers[self.outputs_at : self.outputs_at + question.samples * plant.ny]
        on_y[: question.samples] = per_sample.reshape(-1, plant.ny)
        equations = multipliers[: self.outputs_at].reshape(self.equations, plant.nx)
        on_u[: self.equations] += equations @ plant.B
        on_u -= on_y @ plant.D
        # The equations after the last sample that are used have known inputs, and a state that they lead to.
        later = np.flatnonzero(equations[question.samples :].any(axis=1))
        delay = int(later[-1]) + 1 if later.size else 0
        kept = question.samples + delay
        return on_y[:kept][::-1].copy(), on_u[:kept][::-1].copy(), delay

    def followed(self, multipliers: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return T ``(registers, nx)`` and T0 ``(1, nx)``: without a fault each register holds ``T E x``.

        A sum of weighted samples up to one of them telescopes to the multipliers of its equation times ``E x``.
        """
        equations = multipliers[: self.outputs_at].reshape(self.equations, self.plant.nx)
        length = len(self.weights(multipliers)[0])
        whole = np.zeros((length, self.plant.nx))
        kept = min(length, self.equations)
        whole[:kept] = equations[:kept]
        return whole[:-1][::-1].copy(), -whole[-1:]

    def data(self, y: FloatArray, u: FloatArray) -> FloatArray:
        """Return the right sides of a window: ``y (samples, ny)``, ``u (equations or more, nu)``."""
        plant, right = self.plant, np.zeros(self.rows)
        right[: self.outputs_at] = (u[: self.equations] @ plant.B.T).ravel()
        known = y - u[: len(y)] @ plant.D.T
        right[self.outputs_at : self.outputs_at + known.size] = known.ravel()
        return right


def courses_of(window: Window, point: FloatArray) -> dict[str, FloatArray]:
    """Return states, disturbances and faults of a point ``(columns,)`` over the samples of a window, by name."""
    plant, question = window.plant, window.question
    length = max(window.equations + 1, question.samples)
    names = {"x": plant.state_names, "d": plant.disturbance_names, "f": plant.fault_names}
    found: dict[str, FloatArray] = {}
    own = np.zeros(length)
    own[question.before :] = point[0]
    found[plant.fault_names[question.fault]] = own
    for label, value in zip(window.labels, point, strict=True):
        if label[0] in names:
            course = found.setdefault(names[label[0]][label[2]], np.zeros(length))
            course[slice(None) if label[1] is None else label[1]] = value
        elif label[0] == "slope":
            own += value * (np.arange(length) - (question.samples - 1 - question.lag))
        elif label[0] == "change of f":
            target = question.samples - 1 - question.lag
            own[label[1] :] += value if label[1] > target else 0.0
            own[: label[1]] -= value if label[1] <= target else 0.0
    if question.course == "any":
        # Column 0 is the sample that is told, the others have columns of their own.
        target = question.samples - 1 - question.lag
        own[np.arange(length) == target] = point[0]
        told = {label[1] for label in window.labels if label[0] == "f" and label[2] == question.fault}
        own[[k for k in range(length) if k != target and k not in told]] = 0.0
    return found


def window_of(plant: DescriptorSystem, bounds: Bounds, question: Question) -> Window:
    """Return the stacked equations of a question."""
    builder, samples = Builder(), question.samples
    regular = decide_rank(plant.E).full
    equations = samples - 1 if regular else samples + question.closing
    nx, ny = plant.nx, plant.ny
    rows = equations * nx + samples * ny
    builder.columns([("theta",)], [np.inf])

    def both(k: int, state: FloatArray, output: FloatArray, column: int, times: int = 1) -> None:
        """Enter what acts at sample k in both kinds of rows."""
        if k < equations:
            builder.put(k * nx, -state, column, times)
        if k < samples:
            builder.put(equations * nx + k * ny, output, column, times)

    first = builder.columns(
        [("x", k, i) for k in range(equations + 1) for i in range(nx)],
        np.concatenate([np.minimum(bounds.state, bounds.first), *[bounds.state] * equations]),
    )
    for k in range(equations):
        builder.put(k * nx, plant.E, first + (k + 1) * nx)
        builder.put(k * nx, -plant.A, first + k * nx)
    for k in range(samples):
        builder.put(equations * nx + k * ny, plant.C, first + k * nx)
    span = range(max(equations, samples))
    moving = np.flatnonzero(bounds.noise > 0.0)
    for k in span:
        if moving.size:
            column = builder.columns([("w", k, int(i)) for i in moving], bounds.noise[moving], 2 * k)
            both(k, bounds.noise_state[:, moving], bounds.noise_output[:, moving], column)
    rows = _disturbances(plant, bounds, question, builder, both, span, rows)
    _course(plant, question, builder, both, span)
    for fault in question.free:
        state, output = plant.Bf[:, [fault]], plant.Df[:, [fault]]
        column = -1
        for k in span:
            if question.free_course == "any" or column < 0:
                column = builder.columns([("f", k if question.free_course == "any" else None, fault)], [np.inf])
            both(k, state, output, column)
    whole = [np.concatenate(parts) for parts in zip(*builder.parts, strict=True)]
    return Window(
        plant,
        bounds,
        question,
        rows,
        equations,
        tuple(builder.labels),
        np.array(builder.bar),
        np.array(builder.group),
        *whole,
    )


def _disturbances(
    plant: DescriptorSystem, bounds: Bounds, question: Question, builder: Builder, both: Any, span: range, rows: int
) -> int:
    """Enter the disturbances; return the number of rows."""
    acting = [i for i in range(plant.nd) if bounds.disturbance[i] > 0.0]
    one = np.ones((1, 1))
    for i in acting:
        state, output, bar = plant.Bd[:, [i]], plant.Dd[:, [i]], bounds.disturbance[i]
        column = before = -1
        for k in span:
            if question.disturbance != "held" or column < 0:
                label = ("d", None if question.disturbance == "held" else k, i)
                column = builder.columns([label], [bar], 2 * k + 1 if question.disturbance == "jump" else -1)
            both(k, state, output, column)
            if question.disturbance == "rate" and before >= 0:
                change = builder.columns([("change of d", k, i)], [question.disturbance_rate[i]])
                for place, times in ((column, 1), (before, -1), (change, -1)):
                    builder.put(rows, one, place, times)
                rows += 1
            before = column
    return rows


def _course(plant: DescriptorSystem, question: Question, builder: Builder, both: Any, span: range) -> None:
    """Enter the fault that is looked for."""
    state, output = plant.Bf[:, [question.fault]], plant.Df[:, [question.fault]]
    target = question.samples - 1 - question.lag
    if question.course in ("constant", "step"):
        for k in span:
            if k >= question.before or question.course == "constant":
                both(k, state, output, 0)
    elif question.course == "ramp":
        slope = builder.columns([("slope", None, question.fault)], [np.inf])
        for k in span:
            both(k, state, output, 0)
            both(k, state, output, slope, k - target)
    elif question.course == "any":
        for k in span:
            both(k, state, output, 0 if k == target else builder.columns([("f", k, question.fault)], [np.inf]))
    else:
        for k in span:
            both(k, state, output, 0)
        for k in span[1:]:
            change = builder.columns([("change of f", k, question.fault)], [question.fault_rate])
            later = range(k, len(span)) if k > target else range(k)
            for there in later:
                both(there, state, output, change, 1 if k > target else -1)


def _exponent(values: FloatArray) -> np.ndarray:
    """Return the exponents of the powers of two next to absolute values."""
    return np.frexp(values)[1].astype(np.int64)


def _middle(exponents: np.ndarray, at: np.ndarray, count: int) -> np.ndarray:
    """Return for each place the middle between the largest and the least exponent there; 0 where there is none."""
    low, high = np.full(count, np.iinfo(np.int64).max), np.full(count, np.iinfo(np.int64).min)
    np.maximum.at(high, at, exponents)
    # What is much smaller, such as what far states of a network do within a sample, does not count.
    large = exponents >= high[at] - MOST_SPREAD
    np.minimum.at(low, at[large], exponents[large])
    return np.where(low <= high, (low // 2 + high // 2), 0)
