"""From a record to a proof that it is not fault-free: the programme solved, its dual checked in exact arithmetic.

The linear programme of a window: states, disturbances and constants that explain its data without a fault.

A product of a constant and a state is a variable between McCormick's planes.  ``t >= 0``, a share of the bounds,
relaxes every inequality: least above zero, nothing explains the data.  Powers of two scale variables and rows.

The alarm of a guaranteed test, proved by one number for each equation of its window.

Each equation of the window is multiplied by its number, and all are added up.  States and free faults then cancel, to
the last digit; what is left says that a sum of disturbances and noise is a number which bounds do not allow.  The
numbers are fractions, so that nothing is rounded: an auditor needs no solver, and no trust in one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from obsynth.analysis.transformations.uncertain_plant import AffinePlant, affine_plant
from obsynth.errors import PreconditionError, SpecError, VerificationError
from obsynth.experiments.assumptions import Assumptions, Log
from obsynth.experiments.monitors.adaptive import start_of
from obsynth.experiments.monitors.guaranteed import refuse_bounds
from obsynth.experiments.monitors.options import WINDOW
from obsynth.files.outputs import FileKind, write_atomically
from obsynth.methods.guaranteed_test.checks import while_inside
from obsynth.methods.guaranteed_test.exact import Programmes
from obsynth.methods.guaranteed_test.method import is_guaranteed
from obsynth.methods.guaranteed_test.proofs import (
    columns_of_exact,
    down,
    exact_multipliers,
    exact_right_sides,
    sum_in_ellipsoids,
)
from obsynth.methods.guaranteed_test.result import GuaranteedTest
from obsynth.methods.guaranteed_test.windows import Window
from obsynth.methods.verifying import tracking_of, verify
from obsynth.numerics.arguments import FloatArray, real_number, require_no_overflow, whole_number
from obsynth.plants.constants import MOST_LISTED, shown
from obsynth.plants.descriptor import index_of
from obsynth.plants.noise_model import require_noise
from obsynth.proofs.balls import gamma
from obsynth.results.design import SHOWN_DIGITS, ObserverDesign, design_as_dict, plain, sealed
from obsynth.tolerances.robustness import structure_of
from obsynth.verification.adaptive_bound import adaptive_bound, thresholds_of_records

#: Roundings of a computed right side beside those of its products and sums.
MORE_ROUNDINGS = 8
#: The largest value of t that is of interest, in bounds of the variables.
LARGEST_RELAXATION = 1e3
#: Bounds of the state are widened by this share: more than rounding can take from them.
WINDOW_OUTWARD = 1e-9


@dataclass(frozen=True, eq=False)
class Rows:
    """Sparse rows ``sum value * variable (= or <=) right`` of variables in ``scales``, powers of two; the last is t."""

    scales: FloatArray
    columns: list[list[int]] = field(default_factory=list)
    values: list[list[float]] = field(default_factory=list)
    right: list[float] = field(default_factory=list)

    def add(self, entries: Mapping[int, float], right: float, *, relaxed: bool = False) -> None:
        """Append a row for variables in their own units; t relaxes it by its largest entry."""
        kept = {column: float(value * self.scales[column]) for column, value in entries.items() if value != 0.0}
        unit = _power_of_two(max((abs(value) for value in kept.values()), default=1.0))
        columns, values = list(kept), [value / unit for value in kept.values()]
        if relaxed:
            columns.append(len(self.scales) - 1)
            values.append(-1.0)
        self.columns.append(columns)
        self.values.append(values)
        self.right.append(float(right) / unit)


@dataclass(frozen=True, eq=False)
class Programme:
    """The programme: equations, inequalities, bounds of all variables; the last variable is t."""

    equal: Rows
    below: Rows
    lower: FloatArray
    upper: FloatArray

    def matrices(self) -> tuple[object, object]:
        """Return both sets of rows as sparse matrices."""
        from scipy.sparse import csr_array

        found = []
        for rows in (self.equal, self.below):
            starts = np.cumsum([0, *(len(item) for item in rows.columns)])
            columns = np.array([j for item in rows.columns for j in item], dtype=np.int64)
            values = np.array([value for item in rows.values for value in item])
            found.append(csr_array((values, columns, starts), shape=(len(rows.right), len(self.lower))))
        return found[0], found[1]

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
        self.equal, self.below = Rows(scales), Rows(scales)
        self.bd = np.hstack([plant.Bd.center, plant.plant.Bw])
        self.dd = np.hstack([plant.Dd.center, plant.plant.Dw])
        moving = np.abs(plant.E.center) + plant.E.spread + plant.E.radius
        self.algebraic = moving.max(axis=1, initial=0.0) == 0.0
        # A right side is computed: what rounding may have taken from it, relative to its terms, counts as remainder.
        self.rounding = gamma(plant.B.shape[1] + MORE_ROUNDINGS)
        nd = plant.Bd.shape[1]
        self.loose = (plant.Bd.spread + plant.Bd.radius) @ bounds[:nd]
        self.seen = (plant.Dd.spread + plant.Dd.radius) @ bounds[:nd]

    def _scales(self, bounds: FloatArray) -> FloatArray:
        """Return powers of two near the bounds of the variables; those of a state are the same at all samples."""
        steps, largest = len(self.size), self.size.max(axis=0, initial=0.0)
        least = float(min(largest[largest > 0.0], default=1.0))
        own = np.array([_power_of_two(value if value > 0.0 else least) for value in largest])
        found = np.ones(self.t + 1)
        found[: self.d] = np.tile(own, steps)
        found[self.d : self.q] = np.tile([_power_of_two(value if value > 0.0 else 1.0) for value in bounds], steps)
        found[self.products : self.t] = np.tile(own[[j for _, j in self.pairs]], steps)
        return found

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


#: Where the bounds of the state come from.
REPLAY, STATED_BOUNDS = "replay from the start", "stated"


def window_data(
    design: ObserverDesign, assumed: Assumptions, length: int, u: FloatArray, y: FloatArray
) -> tuple[AffinePlant, WindowData, str]:
    """Return the plant over its box, the last ``length`` samples with bounds of the state, and where these come from.
    Without stated ones they come from the observer run again from the start, and its error."""
    affine = affine_plant(design.linear[0])
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
    found = thresholds_of_records(bound, read[None], u[None], y[None])
    middle = read - found.shift[0]
    width = (found.total - np.abs(found.shift))[0] + WINDOW_OUTWARD * (np.abs(read) + found.total[0])
    low, high = (middle - width)[first:], (middle + width)[first:]
    return affine, WindowData(u[first:], y[first:], low, high), REPLAY


def _stated(affine: AffinePlant, given: Mapping[str, Any], steps: int) -> tuple[FloatArray, FloatArray]:
    names = affine.plant.state_names
    missing = [name for name in names if name not in given]
    if missing:
        raise SpecError(
            f"Nothing bounds the state {missing[0]!r}: give initial_set (--initial), or its bound.", path="initial_set"
        )
    sizes = np.array(
        [
            real_number(given[name], f"The bound of {name!r}", "a number, 0 or more", least=0.0, path="state_bounds")
            for name in names
        ]
    )
    back = np.abs(2.0 * np.eye(len(names)) - affine.coordinates) @ sizes
    high = np.tile(back, (steps, 1))
    return -high, high


def rows_of_test(test: GuaranteedTest) -> int:
    """Return the rows that a test looks at."""
    return test.linear[1].order + 1 - len(test.certificate.matrices.get("state_tracking", ()))


def refuted(design: ObserverDesign, u: FloatArray, y: FloatArray) -> tuple[int, int, dict[str, Any]] | None:
    """Return the proof with the largest margin of any test of a design, for the end of a record; ``None``: none.

    It is the number of the test, the rows that it looks at, and the numbers as plain data: fractions in words that
    Python's ``Fraction`` reads."""
    best: tuple[int, int, dict[str, Any]] | None = None
    largest = 0.0
    for place, test in enumerate(GuaranteedTest.of(design).tests):
        rows = rows_of_test(test)
        if len(y) < rows:
            continue
        programmes = Programmes.of(test)
        for guess in programmes.refuting(y[-rows:], u[-rows:]):
            values = exact_multipliers(programmes.window, guess)
            margin = np.nan if values is None else margin_of(programmes.window, values, y[-rows:], u[-rows:])
            if values is not None and margin > largest:
                largest, told = margin, [str(value) for value in values]
                best = place, rows, {"test": test.fault, "multipliers": told, "margin": margin}
    return best


def margin_of(window: Window, values: list[Fraction], y: FloatArray, u: FloatArray) -> float:
    """Return by which share all bounds would have to be exceeded, at least; NaN where a free column is seen.

    All sums are exact, and the share is rounded down.
    """
    seen = columns_of_exact(window, values)
    if any(seen[j] for j in np.flatnonzero(window.free).tolist()):
        return np.nan
    right = exact_right_sides(window, y, u)
    total = abs(sum((value * side for value, side in zip(values, right, strict=True)), start=Fraction(0)))
    bounded = np.flatnonzero(window.bounded).tolist()
    parts = [Fraction(float(window.bar[j])) * abs(seen[j]) for j in bounded]
    allowed = sum(parts, start=Fraction(0))
    if window.question.ellipsoid:
        allowed = Fraction(sum_in_ellipsoids(window, parts))
    if allowed == 0:
        # No disturbance and no noise at all: the rounding of the samples themselves would be a proof.
        return 0.0
    return down(total / allowed - 1)


def statement_of(test: GuaranteedTest, group: tuple[str, ...], row: int, log: Log | None, gain_set: str) -> str:
    """Return what a proof says, with everything it rests on."""
    window = Programmes.of(test).window
    plant, question = window.plant, window.question
    source = "a record" if log is None else f"{log.name} (sha256 {log.sha256[:SHOWN_DIGITS]})"
    others = [plant.fault_names[k] for k in question.free]
    besides = f", whatever {' and '.join(others)} does" if others else ""
    one, bounds = " or ".join(group), window.bounds
    noise = np.abs(bounds.noise_output) @ bounds.noise
    d_middle = bounds.disturbance_middle
    v_middle = None if bounds.noise_middle is None else bounds.noise_output @ bounds.noise_middle
    parts = [
        _listed(plant.disturbance_names, bounds.disturbance, plant.units, "within", "disturbances", d_middle),
        _listed(plant.output_names, noise, plant.units, "noise of", "sensors", v_middle),
        "process noise within its bounds" if bounds.noise_state.any() else "",
        _listed(plant.state_names, bounds.state, plant.units, "within", "states"),
        _listed(plant.state_names, bounds.first, plant.units, "at first within", "states"),
        "" if question.disturbance == "jump" else f"disturbances that are {question.disturbance}",
    ]
    assumed = ", ".join(part for part in parts if part) or "any disturbances and noise"
    return (
        f"Proved: rows {row - rows_of_test(test) + 1} to {row} of {source} cannot occur without "
        f"{one}{besides}{while_inside(test)}, with {assumed}: {one} is present, or the model is not exact. "
        f"Gain set {gain_set[:SHOWN_DIGITS]}."
    )


def _listed(
    names: tuple[str, ...],
    sizes: FloatArray,
    units: Mapping[str, str],
    word: str,
    kind: str,
    middles: FloatArray | None = None,
) -> str:
    about = np.zeros(len(sizes)) if middles is None else middles
    known = [
        (name, size, middle)
        for name, size, middle in zip(names, sizes.tolist(), about.tolist(), strict=True)
        if np.isfinite(size) and (size > 0.0 or middle)
    ]
    if len(known) > MOST_LISTED:
        return f"{len(known)} {kind} {word} their bounds"
    return ", ".join(_told(name, size, middle, units.get(name, ""), word) for name, size, middle in known)


def _told(name: str, size: float, middle: float, unit: str, word: str) -> str:
    noise = word == "noise of"
    if middle:
        # Ends are told as they were given, which half width and middle are to some digits.
        low, high = (float(f"{end:.12g}") for end in (middle - size, middle + size))
        within = f"{shown(low)} to {shown(high, unit)}"
    else:
        within = shown(float(f"{size:.6g}") if noise else size, unit)
    return f"noise of {name} within {within}" if noise else f"{name} {word} {within}"


def checked(design: ObserverDesign, body: Mapping[str, Any], u: FloatArray, y: FloatArray) -> Iterator[Any]:
    """Yield the test of a certificate, the group of faults, and the margin that is proved again."""
    whole = GuaranteedTest.of(design)
    place = [test.fault for test in whole.tests].index(body["test"])
    test = whole.tests[place]
    window = Programmes.of(test).window
    values = [Fraction(text) for text in body["multipliers"]]
    fits = len(values) == window.rows and len(y) == len(u) == rows_of_test(test)
    yield test, whole.groups[place], margin_of(window, values, y, u) if fits else np.nan


ALARM_VERSION = 2
ALARM_KIND = "obsynth alarm certificate"
CERTIFICATE = FileKind("an alarm certificate", b'"kind": "obsynth alarm certificate"', suffix=".json")
#: The solver of linear programmes may take so long; without an answer nothing is proved.
SOLVER_SECONDS = 60.0
#: Multipliers are kept to this many significant digits: any numbers prove a bound, and few digits stay readable.
MULTIPLIER_DIGITS = 12
#: The stated margin is smaller than the one found by this share: matrices are made anew where it is checked.
MARGIN_SHARE = 1e-3


@dataclass(frozen=True, eq=False)
class AlarmProof:
    """Whether a record up to a row is proved not to be fault-free; see `obsynth.prove_alarm`.

    Parameters
    ----------
    proved : bool
        Whether nothing explains the data without a fault since the start.
    row : int
        Last row of the window, from 1.
    window : int
        Samples of the window.
    margin : float
        Proved lower bound of the share by which all bounds at once would have to be exceeded; 0 or less: no proof.
    statement : str
        What is proved, or why it cannot be.
    origin : str
        Where the bounds of the state come from.
    certificate : mapping
        Everything that `obsynth verify` needs; empty without a proof.
    """

    proved: bool
    row: int
    window: int
    margin: float
    statement: str
    origin: str
    certificate: Mapping[str, Any]

    def save(self, path: str | Path) -> Path:
        """Write the certificate as one JSON document, atomically.

        Parameters
        ----------
        path : str or Path
            Where to write.

        Raises
        ------
        SpecError
            There is no proof to write, or the file cannot be written.
        """
        if not self.proved:
            raise SpecError("There is no proof to write: the alarm cannot be proved.", path="certificate")
        return write_atomically(path, sealed(ALARM_KIND, ALARM_VERSION, self.certificate))

    def __repr__(self) -> str:
        return self.statement


def proved_alarm(
    design: ObserverDesign,
    u: FloatArray,
    y: FloatArray,
    *,
    window: int = WINDOW,
    disturbance_bounds: Mapping[str, float] | None = None,
    noise_bound: float | None = None,
    initial_set: Mapping[str, Any] | None = None,
    state_bounds: Mapping[str, Any] | None = None,
    log: Log | None = None,
    unverified: bool = False,
) -> AlarmProof:
    """Return the proof for the last sample of a record ``u (steps, nu)``, ``y (steps, ny)`` of deviations.
    A design that fails its own verification proves nothing: `VerificationError`, unless ``unverified``, and then no
    alarm is proved."""
    if is_guaranteed(design):
        given = {
            "disturbance_bounds": disturbance_bounds, "noise_bound": noise_bound, "initial_set": initial_set,
            "state_bounds": state_bounds,
        }  # fmt: skip
        refuse_bounds(given)
        return _proved_by_test(design, u, y, log, unverified=unverified)
    assumed = assumptions_of(design, disturbance_bounds, noise_bound, initial_set, state_bounds, window)
    row, length = len(y), min(window, len(y))
    if (failing := _failing(design, unverified=unverified)) is not None:
        return AlarmProof(False, row, length, 0.0, failing, "", {})
    try:
        programme, origin = programme_of(design, assumed, window, u, y)
    except PreconditionError as error:
        return AlarmProof(False, row, length, 0.0, f"Cannot be proved: {error}", "", {})
    found = solved(programme)
    if found is None:
        text = "Cannot be proved: the linear-programming solver returned no multipliers."
        return AlarmProof(False, row, length, 0.0, text, origin, {})
    equal, below = found
    margin = float(programme.proved_least(equal, below))
    if not margin > 0.0:
        text = (
            f"Cannot be proved: with {assumed.phrase()}, some plant may produce the last "
            f"{length} samples without a fault (the relaxed linear programme has a solution)."
        )
        return AlarmProof(False, row, length, margin, text, origin, {})
    margin *= 1.0 - MARGIN_SHARE
    gain_set = design_as_dict(design)
    text = statement(assumed, window, row, origin, log, gain_set["sha256"])
    certificate = {
        "bounds": assumed.bounds,
        "noise_bound": assumed.noise_bound,
        "window": window,
        "initial_set": None if initial_set is None else _as_lists(initial_set),
        "state_bounds": None if state_bounds is None else _as_lists(state_bounds),
        "u": u,
        "y": y,
        "row": row,
        "equal": equal,
        "below": below,
        "margin": margin,
        "origin": origin,
        "statement": text,
        "log": None if log is None else log.as_dict(),
    }
    return AlarmProof(True, row, length, margin, text, origin, {**plain(certificate), "gain_set": gain_set})


def _failing(design: ObserverDesign, *, unverified: bool) -> str | None:
    """Return why a design that fails its own verification proves nothing; raise it unless ``unverified``."""
    report = verify(design)
    if report.passed:
        return None
    failing = ", ".join(check.name for check in report.failures)
    if not unverified:
        raise VerificationError(
            f"The gain set {design.name!r} fails its own verification ({failing}): no alarm can be proved by it.",
            report=report,
        )
    return f"Cannot be proved: the gain set is unverified ({failing} fails)."


def _proved_by_test(
    design: ObserverDesign, u: FloatArray, y: FloatArray, log: Log | None, *, unverified: bool
) -> AlarmProof:
    """Return the proof of a guaranteed test: a fraction for each equation of its window."""
    whole, row = GuaranteedTest.of(design), len(y)
    most = max(map(rows_of_test, whole.tests))
    if (failing := _failing(design, unverified=unverified)) is not None:
        return AlarmProof(False, row, most, 0.0, failing, "", {})
    found = refuted(design, u, y)
    if found is None:
        text = f"Cannot be proved: within the bounds of the design, the last {most} samples may be without a fault."
        return AlarmProof(False, row, most, 0.0, text, "", {})
    place, rows, numbers = found
    gain_set = design_as_dict(design)
    text = statement_of(whole.tests[place], whole.groups[place], row, log, gain_set["sha256"])
    certificate = {
        **numbers, "u": u[-rows:], "y": y[-rows:], "row": row, "statement": text,
        "log": None if log is None else log.as_dict(),
    }  # fmt: skip
    return AlarmProof(True, row, rows, numbers["margin"], text, "", {**plain(certificate), "gain_set": gain_set})


def statement(assumed: Assumptions, window: int, row: int, origin: str, log: Log | None, gain_set: str) -> str:
    """Return what a proof says, with everything it rests on."""
    uncertain = assumed.plant.uncertainty
    linear = (
        "" if assumed.box is None or uncertain is None or not uncertain.not_covered else f"; {uncertain.not_covered}"
    )
    outside = "a model that is not exact" if assumed.box is None else assumed.box.sentence
    since = "since row 1" if assumed.initial_set is not None else "in these rows"
    source = "a record" if log is None else f"{log.name} (sha256 {log.sha256[:SHOWN_DIGITS]})"
    first = row - min(window, row) + 1
    return (
        f"Proved: rows {first} to {row} of {source} cannot occur without a fault {since}, with {assumed.phrase()}: "
        f"there is a fault, or {outside}{linear}. Bounds of the state: {origin}. Assumptions "
        f"{assumed.digest[:SHOWN_DIGITS]}, gain set {gain_set[:SHOWN_DIGITS]}."
    )


def assumptions_of(
    design: ObserverDesign,
    disturbance_bounds: Mapping[str, float] | None,
    noise_bound: float | None,
    initial_set: Mapping[str, Any] | None,
    state_bounds: Mapping[str, Any] | None,
    window: int,
) -> Assumptions:
    """Return what is assumed of all that is unknown to a discrete linear design, checked, as is the window's length."""
    plant, _ = design.linear
    if not plant.is_discrete:
        raise SpecError("A window is proved for sampled designs: this one is continuous in time.", path="gains")
    whole_number(window, "window", "a whole number of samples", least=2)
    bounds = np.full(plant.nd, np.nan)
    for name, value in (disturbance_bounds or {}).items():
        bounds[index_of(name, plant.disturbance_names, what="disturbance_bounds")] = value
    if not np.all(bounds >= 0.0) or not np.isfinite(bounds).all():
        missing = [name for name, bound in zip(plant.disturbance_names, bounds, strict=True) if not bound >= 0.0]
        raise SpecError(
            f"The disturbance {(missing or ['?'])[0]!r} has no bound: give disturbance_bounds "
            "(--disturbance), finite and 0 or more.",
            path="disturbance_bounds",
        )
    if initial_set is not None and state_bounds is not None:
        raise SpecError("Bounds of the state follow from initial_set: leave state_bounds out.", path="state_bounds")
    if plant.nw and noise_bound is None:
        raise SpecError(
            "Noise has no bound: give noise_bound (--noise-bound), in standard deviations.", path="noise_bound"
        )
    require_noise(noise_bound, noisy=bool(plant.Bw.any() or plant.Dw.any()))
    if initial_set is None and state_bounds is None:
        raise SpecError("Nothing bounds the state: give initial_set (--initial), or state_bounds.", path="initial_set")
    require_no_overflow(noise_bound or 0.0, "noise_bound", "noise_bound")
    return Assumptions(plant, bounds, float(noise_bound or 0.0) if plant.nw else 0.0, initial_set, state_bounds)


def programme_of(
    design: ObserverDesign, assumed: Assumptions, window: int, u: FloatArray, y: FloatArray
) -> tuple[Programme, str]:
    """Return the programme of the last samples of a record, and where its bounds of the state come from."""
    affine, data, origin = window_data(design, assumed, window, u, y)
    bounds = np.concatenate([assumed.bounds, np.full(affine.plant.nw, assumed.noise_bound)])
    return window_programme(affine, bounds, data), origin


def _as_lists(given: Mapping[str, Any]) -> dict[str, Any]:
    return {name: list(value) if isinstance(value, (list, tuple)) else value for name, value in given.items()}


def solved(programme: Programme) -> tuple[FloatArray, FloatArray] | None:
    """Return multipliers of equations and inequalities (0 or less) by HiGHS; `None` where it gives none."""
    from scipy.optimize import linprog

    equal, below = programme.matrices()
    cost = np.zeros(len(programme.lower))
    cost[-1] = 1.0
    given = {"A_eq": equal, "b_eq": programme.equal.right} if programme.equal.right else {}
    found = linprog(
        cost,
        A_ub=below,
        b_ub=programme.below.right,
        bounds=np.stack([programme.lower, programme.upper], axis=1),
        method="highs",
        options={"time_limit": SOLVER_SECONDS},
        **given,
    )
    if found.status != 0:
        return None
    multipliers = (found.eqlin.marginals if programme.equal.right else (), np.minimum(found.ineqlin.marginals, 0.0))
    equal, below = (np.array([float(f"{value:.{MULTIPLIER_DIGITS}g}") for value in part]) for part in multipliers)
    return equal, below
