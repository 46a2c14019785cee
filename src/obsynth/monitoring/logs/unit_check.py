"""Whether the first rows of a log are in the units of the plant, or would be after a usual change of unit."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from obsynth.errors import ObsynthError, SpecError
from obsynth.monitoring.logs.signals import LogSignals
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.changed_options import plain_recursion
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.nonlinear.observer import DAEObserver
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.results.design import ObserverDesign

#: Rows that are looked at, and how many a log has at least for that.
FIRST_ROWS, LEAST_ROWS = 20, 5

#: Mean squares of innovations in units of their variances: above the first the log is not explained, below the second
#: a change of unit explains it. A start that is not the design's is no change of unit: noise is scaled with the signal.
UNEXPLAINED, EXPLAINED = 100.0, 4.0

#: Shares of an operating point: signals further away are not explained, and nearer than the second are, in every row.
FAR, NEAR = 0.9, 0.2


class ChangeOfUnit(NamedTuple):
    """What values of a log are multiplied by, what is then added, and where that comes from."""

    factor: float
    shift: float
    words: str


CHANGES = (
    ChangeOfUnit(1.0, -273.15, "kelvin for degrees Celsius"),
    ChangeOfUnit(1.0, 273.15, "degrees Celsius for kelvin"),
    ChangeOfUnit(1e-5, 0.0, "Pa for bar"),
    ChangeOfUnit(1e5, 0.0, "bar for Pa"),
    ChangeOfUnit(1e-3, 0.0, "thousandths, such as g for kg"),
    ChangeOfUnit(1e3, 0.0, "thousands, such as kg for g"),
    ChangeOfUnit(1e-2, 0.0, "percent for shares of one"),
    ChangeOfUnit(1e2, 0.0, "shares of one for percent"),
    ChangeOfUnit(1.0 / 60.0, 0.0, "per minute for per second, or s for min"),
    ChangeOfUnit(60.0, 0.0, "per second for per minute, or min for s"),
    ChangeOfUnit(1.0 / 3600.0, 0.0, "per hour for per second, or s for h"),
    ChangeOfUnit(3600.0, 0.0, "per second for per hour, or h for s"),
    ChangeOfUnit(-1.0, 0.0, "the other sign"),
)

#: Factors that differ by less are the same: each is a product of two.
SAME_FACTOR = 1e-9

#: A signal that is zero.
NOTHING = ChangeOfUnit(0.0, 0.0, "")


class UnitCheck:
    """Gathers the first rows of a log, and stops one that a change of unit of one signal explains."""

    def __init__(self, design: ObserverDesign, signals: LogSignals) -> None:
        self._design, self._signals = design, signals
        self._rows = list[FloatArray]()
        self._done = False

    def take(self, deviations: FloatArray) -> None:
        """Take rows ``(n, nu + ny)``; raise `SpecError` when the first ones show another unit."""
        if self._done:
            return
        self._rows += list(deviations[: FIRST_ROWS - len(self._rows)])
        if len(self._rows) >= FIRST_ROWS:
            self.finish()

    def finish(self) -> None:
        """Judge the rows that there are."""
        if self._done:
            return
        self._done = True
        if len(self._rows) < LEAST_ROWS:
            return
        explanation = self.explanation(np.array(self._rows))
        if explanation is None:
            return
        raise SpecError(
            f"{self.words(*explanation)}; or go on as it is (--units-as-is, units_as_is=True).",
            path=f"columns.{explanation[0]}",
        )

    def words(self, name: str, change: ChangeOfUnit) -> str:
        """Return that a signal is likely in another unit, and what to do about it.

        A factor that is stated stands instead of the unit in a header, which the values were converted from."""
        stated = self._signals.in_header.get(name)
        factor, shift = change.factor, change.shift
        if stated is not None:
            factor, shift = change.factor * stated.factor, change.factor * stated.shift + change.shift
        quoted = shlex.quote(name)
        scale = f"(--scale {quoted}={factor:.15g}, scales={{{name!r}: {factor:.15g}}})"
        made = f"adding {change.shift:g}" if change.shift else f"multiplying by {change.factor:.6g}"
        intro = f"The first rows of {name} do not fit the design, but would after {made} ({change.words})"
        if (
            stated is not None
            and abs(factor - 1.0) < SAME_FACTOR
            and abs(shift) < SAME_FACTOR * abs(stated.shift or 1.0)
        ):
            scale = f"(--scale {quoted}=1, scales={{{name!r}: 1}})"
            plants = self._signals.units[name]
            return (
                f"{intro}: its header says {stated.unit}, and the values are in {plants} already; correct the header, "
                f"or read them as they are {scale}"
            )
        if shift or change.shift:
            known = (
                "name its unit in the header and in the plant" if stated is None else "correct the unit in its header"
            )
            return f"{intro}: convert its column, or {known}: {name} (K)"
        return f"{intro}: give the factor {scale}"

    def explanation(self, rows: FloatArray) -> tuple[str, ChangeOfUnit] | None:
        """Return the signal and the change of its unit that explain the first of ``rows (n, nu + ny)``, which are not
        explained as they are."""
        rows = rows[:FIRST_ROWS]
        if len(rows) < LEAST_ROWS:
            return None
        observer = self._design.observer
        if isinstance(observer, (RecursiveObserver, DAEObserver)):
            return None if observer.timing.longest else self._by_innovations(plain_recursion(observer), rows)
        return self._by_operating_point(rows) if isinstance(observer, LinearObserver) else None

    def _changed(self, rows: FloatArray) -> Iterator[tuple[int, ChangeOfUnit, FloatArray]]:
        """Yield each signal with each change of unit, and the rows after it."""
        for i in range(rows.shape[1]):
            if i == self._signals.constant_signal or not np.any(rows[:, i] + self._signals.offset[i]):
                continue
            for change in CHANGES:
                yield i, change, self._after(rows, i, change)

    def _after(self, rows: FloatArray, i: int, change: ChangeOfUnit) -> FloatArray:
        """Return the rows with a signal, which are deviations of its operating point, in another unit."""
        new, offset = rows.copy(), self._signals.offset[i]
        new[:, i] = change.factor * (rows[:, i] + offset) + change.shift - offset
        return new

    def _by_innovations(self, observer: Any, rows: FloatArray) -> tuple[str, ChangeOfUnit] | None:
        """Compare mean squares of innovations, of inputs that are all there."""
        nu = self._signals.names.index(observer.plant.output_names[0])
        if not np.isfinite(rows[:, :nu]).all() or not _mean_square(observer, rows, nu) > UNEXPLAINED:
            return None
        squares = [(_mean_square(observer, new, nu), i, change) for i, change, new in self._changed(rows)]
        if not squares:
            return None
        value, i, change = min(squares, key=lambda one: one[0])
        # What would be explained without the signal, too, shows no unit: a small factor makes anything as good as zero.
        if not value < EXPLAINED or not _mean_square(observer, self._after(rows, i, NOTHING), nu) > EXPLAINED:
            return None
        return self._signals.names[i], change

    def _by_operating_point(self, rows: FloatArray) -> tuple[str, ChangeOfUnit] | None:
        """Compare with operating points that are stated and not zero."""
        for i, change, new in self._changed(rows):
            # A sensor that is stuck is a fault.
            if (rows[:, i] == rows[0, i]).all() and i >= rows.shape[1] - self._design.plant.ny:
                continue
            point = abs(float(self._signals.offset[i]))
            with np.errstate(invalid="ignore"):
                far, near = np.abs(rows[:, i]) > FAR * point, np.abs(new[:, i]) < NEAR * point
            if point > 0.0 and far.all() and near.all():
                return self._signals.names[i], change
        return None


def _mean_square(observer: Any, rows: Sequence[FloatArray] | FloatArray, nu: int) -> float:
    """Return the mean square of innovations per output, without the row where it is largest; infinite where a sample
    cannot be taken."""
    state, squares = observer.init(), []
    for row in rows:
        try:
            with np.errstate(all="ignore"):
                state, estimate = observer.accept(state, row[nu:], row[:nu])
        except (ObsynthError, np.linalg.LinAlgError, ValueError):
            return np.inf
        degrees = int(np.isfinite(row[nu:]).sum())
        if degrees and state.k > 1:
            squares.append(float(estimate.nis) / degrees)
    without_largest = sorted(squares)[:-1]
    return float(np.mean(without_largest)) if without_largest and np.isfinite(without_largest).all() else np.inf
