"""The linear programme of a window: states, disturbances and constants that explain its data without a fault.

A product of a constant and a state is a variable between McCormick's planes.  ``t >= 0``, a share of the bounds,
relaxes every inequality: least above zero, nothing explains the data.  Powers of two scale variables and rows.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.methods.tracking import structure_of, tracking_of
from obsynth.monitoring.thresholds.adaptive_monitor import start_of
from obsynth.numerics.arguments import real_number
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.transformations.moving_disturbances import with_moving_disturbances
from obsynth.plants.transformations.uncertain_plant import AffinePlant, affine_plant
from obsynth.proofs.balls import gamma
from obsynth.results.design import ObserverDesign
from obsynth.verification.assumptions import Assumptions
from obsynth.verification.over_tolerances.adaptive_bound import adaptive_bound
from obsynth.verification.over_tolerances.adaptive_recursion import thresholds_of_records

#: Roundings of a computed right side beside those of its products and sums.
MORE_ROUNDINGS = 8

#: The largest value of t that is of interest, in bounds of the variables.
LARGEST_RELAXATION = 1e3

#: Bounds of the state are widened by this share: more than rounding can take from them.
WINDOW_OUTWARD = 1e-9

#: Where the bounds of the state come from.
REPLAY, STATED_BOUNDS = "replay from the start", "stated"


@dataclass(frozen=True, eq=False)
class WindowRows:
    """Sparse rows ``sum value * variable (= or <=) right`` of variables in ``scales``, powers of two; the last is t."""

    scales: FloatArray
    columns: list[list[int]] = field(default_factory=list)
    values: list[list[float]] = field(default_factory=list)
    right: list[float] = field(default_factory=list)

    def add(self, entries: Mapping[int, float], right: float, *, relaxed: bool = False) -> None:
        """Append a row for variables in their own units; t relaxes it by its largest entry."""
        scaled_entries = {
            column: float(value * self.scales[column]) for column, value in entries.items() if value != 0.0
        }
        unit = _power_of_two(max((abs(value) for value in scaled_entries.values()), default=1.0))
        columns, values = list(scaled_entries), [value / unit for value in scaled_entries.values()]
        if relaxed:
            columns.append(len(self.scales) - 1)
            values.append(-1.0)
        self.columns.append(columns)
        self.values.append(values)
        self.right.append(float(right) / unit)


@dataclass(frozen=True, eq=False)
class Programme:
    """The programme: equations, inequalities, bounds of all variables; the last variable is t."""

    equal: WindowRows
    below: WindowRows
    lower: FloatArray
    upper: FloatArray

    def matrices(self) -> tuple[object, object]:
        """Return both sets of rows as sparse matrices."""
        from scipy.sparse import csr_array

        matrices = []
        for rows in (self.equal, self.below):
            starts = np.cumsum([0, *(len(item) for item in rows.columns)])
            columns = np.array([j for item in rows.columns for j in item], dtype=np.int64)
            values = np.array([value for item in rows.values for value in item])
            matrices.append(csr_array((values, columns, starts), shape=(len(rows.right), len(self.lower))))
        return matrices[0], matrices[1]

    def proved_least(self, equal: FloatArray, below: FloatArray) -> Fraction:
        """Return a lower bound of the least t from any multipliers (of inequalities: 0 or less), in exact arithmetic.
        Neumaier, Shcherbina, "Safe bounds in linear and mixed-integer linear programming", Math. Prog. 99, 2004."""
        reduced: dict[int, Fraction] = {len(self.lower) - 1: Fraction(1)}
        total = Fraction(0)
        for rows, multipliers in ((self.equal, equal), (self.below, np.minimum(below, 0.0))):
            for i in np.flatnonzero(multipliers):
                weight = Fraction(float(multipliers[i]))
                total += weight * Fraction(rows.right[i])
                for j, entry in zip(rows.columns[i], rows.values[i], strict=True):
                    reduced[j] = reduced.get(j, Fraction(0)) - weight * Fraction(entry)
        for j, value in list(reduced.items()):
            end = self.lower[j] if value > 0 else self.upper[j]
            total += value * Fraction(float(end))
        return total


@dataclass(frozen=True, eq=False)
class WindowData:
    """What is known of a window of N samples: ``u (N, nu)``, ``y (N, ny)``, the state between ``low, high (N, n)``."""

    u: FloatArray
    y: FloatArray
    low: FloatArray
    high: FloatArray


def window_programme(plant: AffinePlant, bounds: FloatArray, data: WindowData) -> Programme:
    """Return the programme of a window; ``bounds (nd + nw,)`` of disturbances and noise."""
    builder, steps = _Builder(plant, bounds, data), len(data.y)
    for k in range(steps):
        builder.dynamics(k)
        builder.outputs(k)
        builder.planes(k)
        builder.states(k)
    # The bounds of the state are rows that t relaxes; the variables themselves have room for that.
    upper = np.full(builder.t + 1, LARGEST_RELAXATION)
    upper[builder.d : builder.q] = np.tile(bounds, steps) / builder.equal.scales[builder.d : builder.q]
    upper[builder.q : builder.products] = 1.0
    lower = -upper
    lower[builder.t] = 0.0
    return Programme(builder.equal, builder.below, lower, upper)


def _power_of_two(value: float) -> float:
    return math.ldexp(1.0, math.frexp(value)[1])


class _Builder:
    """Rows of one sample, and the places of the variables: x (N n), d (N nd), q, products (N m), t."""

    def __init__(self, plant: AffinePlant, bounds: FloatArray, data: WindowData) -> None:
        self.plant, self.data = plant, data
        self.n, self.nd, self.p = plant.A.shape[0], len(bounds), plant.count
        self.pairs = [
            (i, j)
            for i in range(self.p)
            for j in range(self.n)
            if plant.A.parts[i][:, j].any() or plant.E.parts[i][:, j].any() or plant.C.parts[i][:, j].any()
        ]
        steps, self.varying = len(data.y), plant.box.variation == "varying"
        self.d = steps * self.n
        self.q = self.d + steps * self.nd
        self.products = self.q + self.p * (steps if self.varying else 1)
        self.t = self.products + steps * len(self.pairs)
        self.size = np.maximum(np.abs(data.low), np.abs(data.high))
        scales = self._scales(bounds)
        self.equal, self.below = WindowRows(scales), WindowRows(scales)
        self.bd = np.hstack([plant.Bd.center, plant.plant.Bw])
        self.dd = np.hstack([plant.Dd.center, plant.plant.Dw])
        moving = np.abs(plant.E.center) + plant.E.spread + plant.E.radius
        self.algebraic = moving.max(axis=1, initial=0.0) == 0.0
        # A right side is computed: what rounding may have taken from it, relative to its terms, counts as remainder.
        self.rounding = gamma(plant.B.shape[1] + MORE_ROUNDINGS)
        nd = plant.Bd.center.shape[1]
        self.loose = (plant.Bd.spread + plant.Bd.radius) @ bounds[:nd]
        self.seen = (plant.Dd.spread + plant.Dd.radius) @ bounds[:nd]

    def _scales(self, bounds: FloatArray) -> FloatArray:
        """Return powers of two near the bounds of the variables; those of a state are the same at all samples."""
        steps, largest = len(self.size), self.size.max(axis=0, initial=0.0)
        least = float(min(largest[largest > 0.0], default=1.0))
        own = np.array([_power_of_two(value if value > 0.0 else least) for value in largest])
        scales = np.ones(self.t + 1)
        scales[: self.d] = np.tile(own, steps)
        scales[self.d : self.q] = np.tile([_power_of_two(value if value > 0.0 else 1.0) for value in bounds], steps)
        scales[self.products : self.t] = np.tile(own[[j for _, j in self.pairs]], steps)
        return scales

    def state(self, k: int, i: int) -> int:
        return k * self.n + i

    def disturbance(self, k: int, i: int) -> int:
        return self.d + k * self.nd + i

    def constant(self, k: int, i: int) -> int:
        return self.q + (k * self.p if self.varying else 0) + i

    def product(self, k: int, j: int) -> int:
        return self.products + k * len(self.pairs) + j

    def dynamics(self, k: int) -> None:
        """Add ``E x(k+1) - A x(k) - Bd d = B u``: exactly, or between bounds of the remainders."""
        plant, data = self.plant, self.data
        last = k + 1 == len(data.y)
        for r in range(self.n):
            if last and not self.algebraic[r]:
                continue
            entries = dict[int, float]()
            loose = float(self.loose[r] + plant.A.radius[r] @ self.size[k] + plant.B.radius[r] @ np.abs(data.u[k]))
            if not self.algebraic[r]:
                entries |= {self.state(k + 1, i): plant.E.center[r, i] for i in range(self.n)}
                entries |= {self.product(k + 1, j): plant.E.parts[i][r, c] for j, (i, c) in enumerate(self.pairs)}
                loose += float(plant.E.radius[r] @ self.size[k + 1])
            entries |= {self.state(k, i): -plant.A.center[r, i] for i in range(self.n)}
            entries |= {self.product(k, j): -plant.A.parts[i][r, c] for j, (i, c) in enumerate(self.pairs)}
            entries |= {self.constant(k, i): -float(plant.B.parts[i][r] @ data.u[k]) for i in range(self.p)}
            entries |= {self.disturbance(k, i): -self.bd[r, i] for i in range(self.nd)}
            right = float(plant.B.center[r] @ data.u[k])
            loose += self.rounding * float(plant.B.magnitude[r] @ np.abs(data.u[k]))
            if loose == 0.0:
                self.equal.add(entries, right)
            else:
                self.below.add(entries, right + loose)
                self.below.add({column: -value for column, value in entries.items()}, loose - right)

    def outputs(self, k: int) -> None:
        """Add ``y = C x + D u + Dd d``, relaxed by t."""
        plant, data = self.plant, self.data
        for r in range(len(plant.C.center)):
            entries = {self.state(k, i): plant.C.center[r, i] for i in range(self.n)}
            entries |= {self.product(k, j): plant.C.parts[i][r, c] for j, (i, c) in enumerate(self.pairs)}
            entries |= {self.disturbance(k, i): self.dd[r, i] for i in range(self.nd)}
            entries |= {self.constant(k, i): float(plant.D.parts[i][r] @ data.u[k]) for i in range(self.p)}
            right = float(data.y[k, r] - plant.D.center[r] @ data.u[k])
            loose = float(self.seen[r] + plant.C.radius[r] @ self.size[k] + plant.D.radius[r] @ np.abs(data.u[k]))
            loose += self.rounding * float(abs(data.y[k, r]) + plant.D.magnitude[r] @ np.abs(data.u[k]))
            for sign in (1.0, -1.0):
                row = {column: sign * value for column, value in entries.items()}
                self.below.add(row, sign * right + loose, relaxed=True)

    def states(self, k: int) -> None:
        """Add the bounds of the state, relaxed by t."""
        for i in range(self.n):
            place = self.state(k, i)
            self.below.add({place: 1.0}, float(self.data.high[k, i]), relaxed=True)
            self.below.add({place: -1.0}, -float(self.data.low[k, i]), relaxed=True)

    def planes(self, k: int) -> None:
        """Add the four planes of McCormick of each product, relaxed by t."""
        data = self.data
        for j, (i, c) in enumerate(self.pairs):
            low, high = float(data.low[k, c]), float(data.high[k, c])
            for q, s, sign in ((-1.0, low, -1.0), (1.0, high, -1.0), (1.0, low, 1.0), (-1.0, high, 1.0)):
                row = {self.product(k, j): sign, self.state(k, c): -sign * q, self.constant(k, i): -sign * s}
                self.below.add(row, -sign * q * s, relaxed=True)


def window_data(
    design: ObserverDesign, assumed: Assumptions, length: int, u: FloatArray, y: FloatArray
) -> tuple[AffinePlant, WindowData, str]:
    """Return the plant over its box, the last ``length`` samples with bounds of the state, and where these come from.
    Without stated ones they come from the observer run again from the start, and its error."""
    affine = affine_plant(design.linear[0])
    if assumed.moves:
        affine = with_moving_disturbances(affine)
    first = max(0, len(y) - length)
    if assumed.initial_set is None:
        low, high = _stated(affine, assumed.state_bounds or {}, len(y) - first)
        return affine, WindowData(u[first:], y[first:], low, high), STATED_BOUNDS
    _, observer = design.linear
    tracking = tracking_of(design, affine)
    structure = structure_of(
        design, affine, tracking, bounds=assumed.bounds, noise_bound=assumed.noise_bound, faults=False, states=True
    )
    start = start_of(affine, tracking, None, assumed.initial_set, np.zeros(observer.order))
    bound = adaptive_bound(structure, observer, start, varying=affine.box.variation == "varying")
    estimates = observer.run(y, u if u.shape[1] else None)
    rows = np.hstack([estimates.states, estimates.faults, estimates.residuals])
    read = rows @ structure.reading.T
    thresholds = thresholds_of_records(bound, read[None], u[None], y[None])
    middle = read - thresholds.shift[0]
    width = (thresholds.total - np.abs(thresholds.shift))[0] + WINDOW_OUTWARD * (np.abs(read) + thresholds.total[0])
    low, high = (middle - width)[first:], (middle + width)[first:]
    return affine, WindowData(u[first:], y[first:], low, high), REPLAY


def _stated(affine: AffinePlant, bounds: Mapping[str, Any], steps: int) -> tuple[FloatArray, FloatArray]:
    names = affine.plant.state_names
    missing = [name for name in names if name not in bounds]
    if missing:
        raise SpecError(
            f"Nothing bounds the state {missing[0]!r}: give initial_set (--initial), or its bound.", path="initial_set"
        )
    sizes = np.array(
        [
            real_number(bounds[name], f"The bound of {name!r}", "a number, 0 or more", least=0.0, path="state_bounds")
            for name in names
        ]
    )
    back = np.abs(2.0 * np.eye(len(names)) - affine.coordinates) @ sizes
    high = np.tile(back, (steps, 1))
    return -high, high
