"""The exact interval of a fault that the samples of a window allow, and the least test with missing samples.

Both are linear programmes, solved by HiGHS from the basis of the window without data, so that a row is the same
wherever a run begins.  Only what is then proved of their multipliers counts: with multipliers mu that give the fault
weight one and every free signal weight zero, the fault lies within ``T(mu)`` of ``mu' b``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Self

import numpy as np

from obsynth.methods.guaranteed_test.method import GuaranteedTestMethod
from obsynth.methods.guaranteed_test.problem import window_as_designed
from obsynth.methods.guaranteed_test.programs import TOLERANCE
from obsynth.methods.guaranteed_test.proofs import proved_threshold, repaired_multipliers
from obsynth.methods.guaranteed_test.tolerant import rows_before
from obsynth.methods.guaranteed_test.window_observers import rounding_of
from obsynth.methods.guaranteed_test.windows import Window, window_of
from obsynth.numerics.arrays import FloatArray
from obsynth.proofs.balls import UNIT_ROUNDOFF, gamma, rounded_up
from obsynth.proofs.nearby_solutions import NearbySolution, SquarePart
from obsynth.results.design import ObserverDesign

#: Patterns of missing rows whose programmes are kept: those of a gap that moves through a window.
KEPT_PATTERNS = 256

#: Where nothing satisfies a window to the tightest tolerance it is tried with this one: only proofs count.
LOOSE = 1e-7

#: A ray that refutes a window is added so many times to a test: it moves the test without bound.
TIMES_OF_A_RAY = 1e3


def known_rows(window: Window, y: FloatArray, u: FloatArray) -> tuple[FloatArray, np.ndarray]:
    """Return the right sides of a window, zero where a missing sample (NaN) enters, and the numbers of those rows."""
    plant, at = window.plant, window.outputs_at
    without = np.isnan(u)
    lost = np.zeros(window.rows, dtype=bool)
    lost[:at] = (without[: window.equations] @ (plant.B.T != 0.0)).ravel()
    measured = np.isnan(y) | (without[: len(y)] @ (plant.D.T != 0.0))
    lost[at : at + measured.size] = measured.ravel()
    right = window.data(np.nan_to_num(y), np.nan_to_num(u))
    return np.where(lost, 0.0, right), np.flatnonzero(lost)


class Programmes:
    """The programmes of a test: one for each pattern of missing rows, made when it is first met."""

    def __init__(self, window: Window, delay: int) -> None:
        if window.test_problem.closing > delay:
            # What follows the last known input is not known when the row is prescribed.
            window = window_of(window.plant, window.bounds, replace(window.test_problem, closing=delay))
        self.window, self.delay = window, delay
        self._kept: dict[bytes, _Programme] = {}

    @classmethod
    def of(cls, design: ObserverDesign) -> Self:
        """Return the programmes of a single test."""
        window = window_as_designed(design.linear[0], GuaranteedTestMethod.of(design.options))
        return cls(window, rows_before(design) + 1 - window.test_problem.samples)

    def __reduce__(self) -> Any:
        # HiGHS cannot be pickled: programmes are made again.
        return Programmes, (self.window, self.delay)

    def _programme(self, y: FloatArray, u: FloatArray) -> tuple[_Programme, FloatArray, FloatArray]:
        """Return the programme, the right sides, and the largest known signals ``(nu + ny,)``."""
        outputs = np.array(y)
        # After the last sample of the window only inputs count.
        right, lost = known_rows(self.window, outputs[: self.window.test_problem.samples], u)
        key = lost.tobytes()
        if key not in self._kept:
            if len(self._kept) == KEPT_PATTERNS:
                del self._kept[next(iter(self._kept))]
            self._kept[key] = _Programme(self.window.without(lost) if lost.size else self.window)
        known = np.nan_to_num(np.abs(np.hstack([u, outputs])))
        return self._kept[key], right, known.max(axis=0, initial=0.0)

    def interval(self, y: FloatArray, u: FloatArray) -> tuple[float, float]:
        """Return both ends for ``y, u (samples + delay, ...)``, NaN where missing; infinite where nothing is proved."""
        programme, right, largest = self._programme(y, u)
        return programme.end(right, largest, -1.0), programme.end(right, largest, 1.0)

    def refuting(self, y: FloatArray, u: FloatArray) -> list[FloatArray]:
        """Return multipliers that show that nothing explains these samples without the fault, the best ones first."""
        programme, right, _ = self._programme(y, u)
        tests = [
            programme.test,
            *(programme.proved(multipliers) for s in (1.0, -1.0) for multipliers in programme.answers(right, s)),
        ]
        ratios = [
            (abs(float(test.values @ right)) / (width or 1.0), test.values) for test, width in filter(None, tests)
        ]
        best = max((share for share, _ in ratios), default=0.0)
        return [values for share, values in ratios if share == best and share > 1.0]

    def least_test(self, y: FloatArray, u: FloatArray) -> tuple[float, float]:
        """Return residual and threshold of the least test of what is there; NaN and infinite where none is proved."""
        programme, right, largest = self._programme(y, u)
        if programme.test is None:
            return np.nan, np.inf
        test, threshold = programme.test
        rounding = rounding_of(programme.window, test.values, test.radius)
        rounding_of_middles = programme.window.standing_room(test.values, test.radius)
        return float(test.values @ right), threshold + float(rounding @ largest) + rounding_of_middles


class _Programme:
    """The programmes of one window: with fixed matrices, for changing right sides."""

    def __init__(self, window: Window) -> None:
        self.window = window
        matrix = window.matrix
        prescribed = np.flatnonzero(window.free | (np.arange(len(window.bar)) == 0))
        rows, _ = window.scales
        # The programme is about disturbances that rest in pieces of a sample, what is proved about every one.
        outer = window.outer
        self.prescribed, self.bounded = matrix[:, prescribed].T.tocsr(), outer.matrix[:, outer.bounded].T.tocsr()
        self.bars = outer.bar[outer.bounded]
        self.prescribed_sizes, self.bounded_sizes = abs(self.prescribed), abs(self.bounded)
        self.target = np.eye(1, len(prescribed)).ravel()
        # Entries that are products with a whole number have been rounded once.
        self.share = gamma(window.rows + 8) + 2.0 * UNIT_ROUNDOFF
        dense = self.prescribed.toarray()
        self.square = SquarePart.of(dense, 2.0 * UNIT_ROUNDOFF * np.abs(dense), np.ldexp(1.0, rows), rows)
        self.highs, self.bases, self.known = _highs(window), {}, np.zeros(window.rows)
        self.test: tuple[NearbySolution, float] | None = None
        at_rest = np.zeros(window.rows)
        for sign in (1.0, -1.0):
            tests = [self.proved(multipliers) for multipliers in self.answers(at_rest, sign)]
            self.bases[sign] = self.highs.getBasis()
            self.test = self.test or next((test for test in tests if test is not None), None)

    def answers(self, right: FloatArray, sign: float) -> Iterator[FloatArray]:
        """Yield multipliers for the largest (``sign`` -1: least) fault, as HiGHS gives them; none where it has none."""
        import highspy

        rows, _ = self.window.scales
        known = np.ldexp(right, rows)
        # One by one: older versions of HiGHS take no more at once.
        for row in np.flatnonzero(known != self.known).tolist():
            self.highs.changeRowBounds(row, known[row], known[row])
        self.known = known
        self.highs.changeColCost(0, -sign)
        for tolerance in (TOLERANCE, LOOSE):
            self.highs.setOptionValue("primal_feasibility_tolerance", tolerance)
            if sign in self.bases:
                # Nothing of the rows before counts, not even in the last digit: a run that goes on is the same run.
                self.highs.clearSolver()
                self.highs.setBasis(self.bases[sign])
            self.highs.run()
            status = self.highs.getModelStatus()
            if status == highspy.HighsModelStatus.kOptimal:
                multipliers = np.ldexp(np.asarray(self.highs.getSolution().row_dual), rows)
                scale = float((self.prescribed[[0]] @ multipliers)[0])
                if abs(scale) > 0.0:
                    yield multipliers / scale
                return
            if status == highspy.HighsModelStatus.kInfeasible and self.test is not None:
                # It says that nothing explains the window: its ray, if it proves that, moves the test out of the way.
                _, has_ray, ray = self.highs.getDualRay()
                direction = np.ldexp(np.asarray(ray), rows) if has_ray else np.zeros(1)
                size = float(np.max(np.abs(direction), initial=0.0))
                if size > 0.0:
                    direction *= TIMES_OF_A_RAY * float(np.max(np.abs(self.test[0].values))) / size
                    yield self.test[0].values - sign * np.copysign(1.0, float(direction @ right)) * direction

    def proved(self, multipliers: FloatArray) -> tuple[NearbySolution, float] | None:
        """Return multipliers with the distance to exact ones, and what bounds can do to these."""
        if self.square is None or not self.square.contraction < 1.0:
            repaired = repaired_multipliers(self.window, multipliers, refine=True)
            return None if repaired is None else (repaired, proved_threshold(self.window.outer, repaired))
        values = np.array(multipliers)
        values[self.square.chosen] += self.square.step(self.target - self.prescribed @ values)
        missed = np.abs(self.target - self.prescribed @ values)
        missed = rounded_up(missed + self.share * (self.prescribed_sizes @ np.abs(values) + self.target), 4)
        radius = np.zeros(len(values))
        radius[self.square.chosen] = self.square.bounded_step(missed)
        sizes = self.bounded_sizes @ rounded_up(self.share * np.abs(values) + radius, 2)
        responses = np.abs(self.bounded @ values) + rounded_up(sizes, self.window.rows)
        total = float(rounded_up(self.bars @ responses, len(responses) + 4))
        return (NearbySolution(values, radius), total) if np.isfinite(total) else None

    def end(self, right: FloatArray, largest: FloatArray, sign: float) -> float:
        """Return the upper (``sign`` 1) or lower end of the fault for these right sides; infinite without a proof."""
        tests = [self.test, *map(self.proved, self.answers(right, sign))]
        ends = [sign * np.inf]
        for test, width in (proof for proof in tests if proof is not None):
            rounding = float(rounding_of(self.window, test.values, test.radius) @ largest)
            rounding += self.window.standing_room(test.values, test.radius)
            ends.append(float(test.values @ right) + sign * (width + rounding))
        return sign * min(sign * end for end in ends)


def _highs(window: Window) -> Any:
    """Return HiGHS with the equations of a window, scaled by powers of two."""
    import highspy
    from scipy.sparse import diags_array

    rows, columns = window.scales
    matrix = (diags_array(np.ldexp(1.0, rows)) @ window.matrix @ diags_array(np.ldexp(1.0, columns))).tocsc()
    ends = np.ldexp(window.bar, -columns)
    model = highspy.HighsLp()
    model.num_row_, model.num_col_ = matrix.shape
    model.col_cost_, model.col_lower_, model.col_upper_ = np.zeros(len(ends)), -ends, ends
    model.row_lower_ = model.row_upper_ = np.zeros(window.rows)
    model.a_matrix_.format_ = highspy.MatrixFormat.kColwise
    model.a_matrix_.start_, model.a_matrix_.index_ = matrix.indptr, matrix.indices
    model.a_matrix_.value_ = matrix.data

    class Silent(highspy.Highs):
        """HiGHS without a word: its newer versions print one where callbacks are enabled, while it is made."""

        def enableCallbacks(self) -> None:
            self.silent()
            super().enableCallbacks()  # type: ignore[no-untyped-call]

    solver = Silent()  # type: ignore[no-untyped-call]
    solver.silent()
    for name in ("primal_feasibility_tolerance", "dual_feasibility_tolerance"):
        solver.setOptionValue(name, TOLERANCE)
    solver.setOptionValue("threads", 1)
    solver.passModel(model)
    return solver
