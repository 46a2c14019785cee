r"""The equations of a plant over a window of samples, as one sparse matrix.

.. math::
    M_z z + m \theta + M_s s = b(y, u), \qquad |s_i| \le \bar s_i, \quad z \text{ free}

Rows are the equations ``E x_{k+1} - A x_k - ... = B u_k`` and the outputs ``C x_k + ... = y_k - D u_k``; theta is the
size of the fault.  Every entry is kept as a double times a whole number, so that claims can be checked exactly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.methods.guaranteed_test.window_columns import (
    Builder,
    columns_between_samples,
    disturbance_columns,
    fault_columns,
    moving_disturbances,
)
from obsynth.methods.guaranteed_test.window_models import (
    Bounds,
    Model,
    TestProblem,
    constant_model,
    disturbance_names,
    fault_names,
    varying_model,
)
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.proofs.balls import UNIT_ROUNDOFF

if TYPE_CHECKING:
    from scipy.sparse import csr_array


#: Entries below this power of two times the largest of their row or column do not count in its scale.
MOST_SPREAD = 30

#: Rounds of scaling rows and free columns by powers of two.
SCALING_ROUNDS = 4

#: Room for the sums that bound what rounding does to a running test.
SUM_ROOM = 1.01


def disturbances_in_words(window: Window) -> str:
    """Return what is assumed of disturbances beside their bounds; empty where there are none."""
    bounds, kind = window.bounds, window.test_problem.disturbance
    if not bounds.disturbance.any():
        return ""
    if bounds.moving is not None:
        return {
            "any": "disturbances of any time course, between samples too",
            "rate": "disturbances that change within a sample's time by their stated rates at most",
        }[kind]
    jump = "disturbances that are held between samples"
    return {
        "any": jump,
        "jump": jump,
        "held": "disturbances that are held over the window",
        "rate": "disturbances that are held between samples and change by their stated rates at most",
    }[kind]


@dataclass(frozen=True, eq=False)
class Window:
    """The stacked equations of a test problem; column 0 is theta."""

    model: Model
    bounds: Bounds
    test_problem: TestProblem
    rows: int
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
    def plant(self) -> DescriptorSystem:
        """The plant of a window whose matrices do not change."""
        if not isinstance(self.model.plant, DescriptorSystem):
            raise SpecError("This test is for plants whose matrices do not change with k.", path="plant")
        return self.model.plant

    @property
    def equations(self) -> int:
        """For how many k there are equations."""
        return len(self.model.equations)

    @cached_property
    def outer(self) -> Window:
        """The same rows with columns that count every course of disturbances: what a test promises holds for these.
        The window's own columns are of disturbances that rest in each piece of a sample."""
        if self.bounds.moving is None or self.bounds.every:
            return self
        outer = window_of(self.model.plant, replace(self.bounds, every=True), self.test_problem)
        lost = [label[2] for label in self.labels if label[0] == "missing"]
        return outer.without(np.array(lost, dtype=np.int64)) if lost else outer

    @cached_property
    def outer_with_room(self) -> Window:
        """The same with twice what the columns leave, so that another machine finds no more."""
        outer = self.outer
        return (
            outer
            if outer is self
            else window_of(self.model.plant, replace(outer.bounds, times_rest=2.0), self.test_problem)
        )

    @cached_property
    def inner(self) -> Window:
        """The same rows for courses that disturbances may have for certain: a fault that these hide is hidden.

        Of a rate that is bounded those are of disturbances that are held between samples."""
        if self.bounds.moving is None or self.test_problem.disturbance == "any":
            return self
        return window_of(self.model.plant, replace(self.bounds, moving=None), self.test_problem)

    @property
    def moving_columns(self) -> list[tuple[tuple[str, int], FloatArray, float, int | None]]:
        """What disturbances that move between samples put into the states of each (`columns_between_samples`)."""
        return columns_between_samples(self.bounds)

    @property
    def replaced(self) -> list[int]:
        """Numbers of the disturbances whose values at the samples enter outputs alone."""
        moving = self.bounds.moving
        if moving is None or self.test_problem.disturbance != "any":
            return []
        return [int(i) for i in np.flatnonzero(moving.moved)]

    def without(self, rows: np.ndarray) -> Window:
        """Return a window some rows of which say nothing: each has a free column of its own, which no test may see."""
        columns = len(self.bar)
        return replace(
            self,
            labels=(*self.labels, *(("missing", None, int(row)) for row in rows)),
            bar=np.append(self.bar, np.full(len(rows), np.inf)),
            group=np.append(self.group, np.full(len(rows), -1)),
            i=np.append(self.i, rows),
            j=np.append(self.j, columns + np.arange(len(rows))),
            value=np.append(self.value, np.ones(len(rows))),
            times=np.append(self.times, np.ones(len(rows), dtype=np.int64)),
        )

    @property
    def outputs_at(self) -> int:
        """First row of the outputs."""
        return self.equations * self.model.sizes[1]

    @property
    def twice_is_hidden(self) -> bool:
        """Whether twice the fault of a witness and none give the same samples, not only the fault and its opposite.

        For that the states must be free to follow what the disturbances do without the fault: bounds may cut that off,
        as may equations without dynamics those of the first sample.
        """
        at_first = self.model.regular or np.isinf(self.bounds.first).all()
        return bool(at_first and np.isinf(self.bounds.state).all())

    @cached_property
    def free(self) -> np.ndarray:
        """Which columns have no bound, theta not among them."""
        free = np.isinf(self.bar)
        free[0] = False
        return free

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
        columns, size = (
            np.frexp(part)[1].astype(np.int64)
            for part in (np.where(self.bounded, self.bar, 1.0), self.value * self.times)
        )
        columns, rows = np.where(self.bounded, columns, 0), np.zeros(self.rows, dtype=np.int64)
        for _ in range(SCALING_ROUNDS):
            rows = -_middle(size + columns[self.j], self.i, self.rows)
            moved = -_middle(size + rows[self.i], self.j, len(self.bar))
            columns = np.where(self.bounded, columns, moved)
        return rows, columns

    @cached_property
    def standing(self) -> tuple[Fraction, ...]:
        """What the middles of all bounds put into each row, exactly ``(rows,)``; empty where they are zero."""
        middles = list(self.bounds.middles)
        if not middles:
            return ()
        standing = [Fraction(0)] * self.rows
        _, ne, _, ny = self.model.sizes
        for kind, i, middle in middles:
            exact = Fraction(middle)
            for k in range(max(self.equations, self.test_problem.samples)):
                equation, state, output = self.model.columns[kind][k]
                if 0 <= equation < self.equations:
                    for row in np.flatnonzero(state[:, i]).tolist():
                        standing[equation * ne + row] -= exact * Fraction(float(state[row, i]))
                if k < self.test_problem.samples:
                    for row in np.flatnonzero(output[:, i]).tolist():
                        standing[self.outputs_at + k * ny + row] += exact * Fraction(float(output[row, i]))
        return tuple(standing)

    @cached_property
    def moved(self) -> FloatArray:
        """The same, rounded ``(rows,)``; zeros where all middles are zero."""
        return np.array([float(value) for value in self.standing]) if self.standing else np.zeros(self.rows)

    def constant(self, multipliers: FloatArray) -> float:
        """Return what a test adds for the middles of the bounds: the double next to it."""
        if not self.standing:
            return 0.0
        known = zip(multipliers.tolist(), self.standing, strict=True)
        return -float(sum((Fraction(value) * side for value, side in known if value and side), start=Fraction(0)))

    def weights(self, multipliers: FloatArray) -> tuple[FloatArray, FloatArray, int]:
        """Return the weights of outputs and known inputs, newest sample first ``(n, ny)``, ``(n, nu)``, and the delay.

        ``multipliers (rows,)``: the test is their product with the right sides, at the last sample that has a weight.
        """
        model, test_problem = self.model, self.test_problem
        _, ne, nu, ny = model.sizes
        length = max(self.equations, test_problem.samples)
        on_y, on_u = np.zeros((length, ny)), np.zeros((length, nu))
        per_sample = multipliers[self.outputs_at : self.outputs_at + test_problem.samples * ny]
        on_y[: test_problem.samples] = per_sample.reshape(-1, ny)
        equations = multipliers[: self.outputs_at].reshape(self.equations, ne)
        for k, part in enumerate(equations):
            on_u[k] += part @ model.equations[k][2]
        on_u -= on_y @ model.D
        # The equations after the last sample that are used have known inputs, and a state that they lead to.
        later = np.flatnonzero(equations[test_problem.samples :].any(axis=1))
        delay = int(later[-1]) + 1 if later.size else 0
        used = test_problem.samples + delay
        return on_y[:used][::-1].copy(), on_u[:used][::-1].copy(), delay

    def errors(self, multipliers: FloatArray, radius: FloatArray) -> FloatArray:
        """Return what shipped multipliers and sums of their products may err, in each row ``(rows,)``."""
        nx, _, nu, ny = self.model.sizes
        share = (len(multipliers) + nu + ny + nx + 8) * UNIT_ROUNDOFF
        return np.asarray((radius + share * np.abs(multipliers)) * SUM_ROOM)

    def standing_room(self, multipliers: FloatArray, radius: FloatArray) -> float:
        """Return what these may err for the middles of the bounds: it is in the threshold."""
        if not self.standing:
            return 0.0
        return float(self.errors(multipliers, radius) @ np.abs(self.moved)) * SUM_ROOM

    def known_sizes(self, sizes: FloatArray) -> FloatArray:
        """Return what errors of multipliers of at most these sizes ``(rows,)`` do to known signals of one
        ``(nu + ny,)``."""
        model, at, samples = self.model, self.outputs_at, self.test_problem.samples
        _, ne, nu, ny = model.sizes
        outputs = sizes[at : at + samples * ny].reshape(samples, ny).sum(axis=0)
        parts = zip(model.equations, sizes[:at].reshape(self.equations, ne), strict=True)
        on_inputs = sum((np.abs(inputs).T @ part for (_, _, inputs), part in parts), start=np.zeros(nu))
        return np.concatenate([on_inputs + np.abs(model.D).T @ outputs, outputs])

    def followed(self, multipliers: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return T ``(registers, nx)`` and T0 ``(1, nx)``: without a fault each register holds ``T E x``.

        A sum of weighted samples up to one of them telescopes to the multipliers of its equation times ``E x``.
        """
        equations = multipliers[: self.outputs_at].reshape(self.equations, self.plant.nx)
        length = len(self.weights(multipliers)[0])
        registers = np.zeros((length, self.plant.nx))
        filled = min(length, self.equations)
        registers[:filled] = equations[:filled]
        return registers[:-1][::-1].copy(), -registers[-1:]

    def data(self, y: FloatArray, u: FloatArray) -> FloatArray:
        """Return the right sides of a window: ``y (samples, ny)``, ``u (equations or more, nu)``."""
        plant, right = self.plant, np.zeros(self.rows)
        right[: self.outputs_at] = (u[: self.equations] @ plant.B.T).ravel()
        known = y - u[: len(y)] @ plant.D.T
        right[self.outputs_at : self.outputs_at + known.size] = known.ravel()
        return right - self.moved if self.standing else right


def courses_of(window: Window, point: FloatArray) -> dict[str, FloatArray]:
    """Return states, disturbances and faults of a point ``(columns,)`` over the samples of a window, by name."""
    plant, test_problem = window.model.plant, window.test_problem
    length = max(window.equations + 1, test_problem.samples)
    names = {"x": plant.state_names, "d": disturbance_names(plant), "f": fault_names(plant)}
    signals: dict[str, FloatArray] = {}
    own = np.zeros(length)
    own[test_problem.before :] = point[0]
    signals[names["f"][test_problem.fault]] = own
    for label, value in zip(window.labels, point, strict=True):
        if label[0] == "moving d" and window.bounds.moving is not None:
            # The mean over the sample.
            signal = signals.setdefault(names["d"][label[2]], np.zeros(length))
            signal[label[1]] += value * window.bounds.moving.shares[label[3]]
        elif label[0] in names:
            signal = signals.setdefault(names[label[0]][label[2]], np.zeros(length))
            signal[slice(None) if label[1] is None else label[1]] = value
        elif label[0] == "slope":
            own += value * (np.arange(length) - (test_problem.samples - 1 - test_problem.lag))
        elif label[0] == "change of f":
            target = test_problem.samples - 1 - test_problem.lag
            own[label[1] :] += value if label[1] > target else 0.0
            own[: label[1]] -= value if label[1] <= target else 0.0
    if test_problem.course == "any":
        # Column 0 is the sample that is reported, the others have columns of their own.
        target = test_problem.samples - 1 - test_problem.lag
        own[np.arange(length) == target] = point[0]
        own_samples = {label[1] for label in window.labels if label[0] == "f" and label[2] == test_problem.fault}
        own[[k for k in range(length) if k != target and k not in own_samples]] = 0.0
    return signals


def window_of(
    plant: DescriptorSystem | TimeVaryingDescriptorSystem, bounds: Bounds, test_problem: TestProblem, start: int = 1
) -> Window:
    """Return the stacked equations of a test; ``start``: k of its first sample, where matrices change with it."""
    if isinstance(plant, DescriptorSystem):
        model = constant_model(plant, bounds, test_problem)
    else:
        model = varying_model(plant, test_problem.samples, start)
    builder, samples = Builder(), test_problem.samples
    equations = len(model.equations)
    nx, ne, _, ny = model.sizes
    rows = equations * ne + samples * ny
    builder.columns([("theta",)], [np.inf])

    def acting(kind: str, signals: np.ndarray, k: int, column: int, times: int = 1) -> None:
        """Enter columns that act at sample k, in both kinds of rows."""
        equation, state, output = model.columns[kind][k]
        if 0 <= equation < equations:
            builder.put(equation * ne, -state[:, signals], column, times)
        if k < samples:
            builder.put(equations * ne + k * ny, output[:, signals], column, times)

    first = builder.columns(
        [("x", k, i) for k in range(equations + 1) for i in range(nx)],
        np.concatenate([np.minimum(bounds.state, bounds.first), *[bounds.state] * equations]),
    )
    for k, (after, before, _) in enumerate(model.equations):
        builder.put(k * ne, after, first + (k + 1) * nx)
        builder.put(k * ne, -before, first + k * nx)
    for k in range(samples):
        builder.put(equations * ne + k * ny, model.output_maps[k], first + k * nx)
    span = range(len(model.columns["f"]))
    moving = np.flatnonzero(bounds.noise > 0.0)
    for k in range(max(equations, samples)):
        if moving.size:
            column = builder.columns([("w", k, int(i)) for i in moving], bounds.noise[moving], 2 * k)
            acting("w", moving, k, column)
    rows = disturbance_columns(bounds, test_problem, builder, acting, range(max(equations, samples)), rows)
    moving_disturbances(bounds, builder, equations, ne)
    fault_columns(test_problem, builder, acting, span)
    for fault in test_problem.free:
        column = -1
        for k in span:
            if test_problem.free_course == "any" or column < 0:
                column = builder.columns([("f", k if test_problem.free_course == "any" else None, fault)], [np.inf])
            acting("f", np.array([fault]), k, column)
    entries = [np.concatenate(parts) for parts in zip(*builder.parts, strict=True)]
    return Window(
        model,
        bounds,
        test_problem,
        rows,
        tuple(builder.labels),
        np.array(builder.bar),
        np.array(builder.group),
        *entries,
    )


def _middle(exponents: np.ndarray, at: np.ndarray, count: int) -> np.ndarray:
    """Return for each place the middle between the largest and the least exponent there; 0 where there is none."""
    low, high = np.full(count, np.iinfo(np.int64).max), np.full(count, np.iinfo(np.int64).min)
    np.maximum.at(high, at, exponents)
    # What is much smaller, such as what far states of a network do within a sample, does not count.
    large = exponents >= high[at] - MOST_SPREAD
    np.minimum.at(low, at[large], exponents[large])
    return np.where(low <= high, (low // 2 + high // 2), 0)
