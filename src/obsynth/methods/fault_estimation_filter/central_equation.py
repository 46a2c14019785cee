"""The Riccati equation of central H-infinity filters: gains of a `GainProblem` for each level g.

With ``h = [C; Z]``, ``k = [D; Zd]``, ``Y = A Y A' - (A Y h' + B k') (k k' - diag(0, g^2 I) + h Y h')^-1 (.)' + B B'``
has a stabilising solution with the right signs exactly when a filter of gain below g exists, and gives one. A little
artificial noise makes it regular; it can only raise the gain, and the true gain of the true problem decides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsynth.methods.fault_estimation_filter.injection_problem import GainProblem, Injection
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.doubling import MOST_JUMPS, doubled_riccati_solution, is_positive


@dataclass(frozen=True, eq=False)
class CentralEquation:
    """The equation of a problem with measurements for every level, in as few states as it takes; no limit on V.

    Where the disturbance is in no measurement, only the error on null C is left: with an orthonormal basis N of it, M
    one of its complement and ``F = A N`` (``lift``), ``Y = F K F' + B B'``, ``K = S - S N'Z' (Z N S N'Z' - g^2 I)^-1 Z
    N S``, where S solves the equation with ``N'F``, ``[M'F; ZN]``, ``N'BB'N``, ``diag(M'BB'M, -g^2 I)`` and ``[N'BB'M,
    0]``.
    """

    problem: GainProblem
    a: FloatArray
    h: FloatArray
    process: FloatArray
    weight: FloatArray
    cross: FloatArray
    full_process: FloatArray
    full_weight: FloatArray
    full_cross: FloatArray
    lift: FloatArray | None
    outputs: FloatArray
    last: FloatArray

    @classmethod
    def of(cls, problem: GainProblem, *, noise: float) -> CentralEquation:
        """Return the equation with artificial noise, relative to the disturbance."""
        n, m, q = problem.order, problem.measured, problem.Z.shape[0]
        size = float(np.linalg.norm(problem.B, 2)) if problem.B.size else 0.0
        h, k = np.vstack([problem.C, problem.Z]), np.vstack([problem.D, problem.Zd])
        last = np.diag([0.0] * m + [1.0] * q)
        process = problem.B @ problem.B.T + (noise * size) ** 2 * np.eye(n)
        if np.any(k) or not 0 < m < n or size == 0.0:
            seen = max(float(np.linalg.norm(part, 2)) if part.size else 0.0 for part in (problem.D, problem.C * size))
            weight = k @ k.T + np.diag([(noise * seen) ** 2] * m + [0.0] * q)
            cross = problem.B @ k.T
            return cls(problem, problem.A, h, process, weight, cross, process, weight, cross, None, h, last)
        basis = np.linalg.qr(problem.C.T, mode="complete")[0]
        hidden, known = basis[:, m:], basis[:, :m]
        lift = problem.A @ hidden
        moved = process @ basis
        weight = np.zeros((m + q, m + q))
        weight[:m, :m] = known.T @ moved[:, :m]
        return cls(
            problem,
            hidden.T @ lift,
            np.vstack([known.T @ lift, problem.Z @ hidden]),
            hidden.T @ moved[:, m:],
            weight,
            np.hstack([hidden.T @ moved[:, :m], np.zeros((n - m, q))]),
            process,
            np.zeros((m + q, m + q)),
            np.zeros((n, m + q)),
            lift,
            h,
            last,
        )

    def filter_at(self, level: float) -> Injection | None:
        """Return the gains of the central filter at ``level``, or ``None`` when the equation gives none."""
        return self.filter_and_margin(level)[0]

    def filter_and_margin(self, level: float) -> tuple[Injection | None, float]:
        """Return the gains of the central filter at ``level``, or ``None``, and how far the level is from the least.

        The least eigenvalue of what must be negative, relative to ``-g^2 I``: twice the relative distance, or more.
        """
        try:
            y = self.solution(level)
            if y is None:
                return None, 0.0
            found, left = self._gains(*self._sums(y, level))
        except np.linalg.LinAlgError:
            return None, 0.0
        if found is None or not (np.all(np.isfinite(found.R)) and np.all(np.isfinite(found.V))):
            return None, 0.0
        return found, float(np.linalg.eigvalsh(left)[0]) / level**2

    def solution(self, level: float) -> FloatArray | None:
        """Return Y ``(n, n)`` at ``level``, or ``None``; its signs are not looked at."""
        lowered = self.weight - level**2 * self.last
        s = doubled_riccati_solution(
            self.a,
            self.h,
            self.process,
            lowered,
            self.cross,
            possible=lambda y: self._is_possible(y, level),
            most_jumps=MOST_JUMPS,
        )
        return None if s is None else self._in_all_states(s, level)

    def _sums(self, y: FloatArray, level: float) -> tuple[FloatArray, FloatArray]:
        """Return ``k k' - diag(0, g^2 I) + h Y h'`` and ``A Y h' + B k'`` in all states."""
        seen = y @ self.outputs.T
        total = self.full_weight + self.outputs @ seen - level**2 * self.last
        return total, self.problem.A @ seen + self.full_cross

    def _in_all_states(self, s: FloatArray, level: float) -> FloatArray:
        if self.lift is None:
            return s
        shown = self.h[self.problem.measured :]
        through = s @ shown.T
        k = s - through @ np.linalg.solve(shown @ through - level**2 * np.eye(len(shown)), through.T)
        return np.asarray(self.lift @ k @ self.lift.T + self.full_process)

    def _is_possible(self, y: FloatArray, level: float) -> bool:
        """Whether what xi shows over finitely many steps is still below the level, with the current measurement."""
        m = self.problem.measured
        if self.problem.weight_is_free and self.lift is None:
            total = self.weight + self.h @ y @ self.h.T
            left = total[m:, :m] @ np.linalg.solve(total[:m, :m], total[:m, m:]) - total[m:, m:]
        else:
            shown = self.h[m:]
            left = -self.weight[m:, m:] - shown.dot(y).dot(shown.T)
        left.reshape(-1)[:: len(left) + 1] += level**2
        return is_positive(0.5 * (left + left.T))

    def _gains(self, total: FloatArray, through: FloatArray) -> tuple[Injection | None, FloatArray]:
        """Return the gains when the signs are right: m positive, q negative, and what must be positive of the q."""
        n, m, q = self.problem.order, self.problem.measured, self.problem.Z.shape[0]
        if self.problem.weight_is_free:
            # The estimate may use the measurement of the same sample.
            solved = np.linalg.solve(total[:m, :m], np.vstack([through[:, :m], total[m:, :m]]).T).T
            left = solved[n:] @ total[:m, m:] - total[m:, m:]
            left = 0.5 * (left + left.T)
            found = Injection(np.asarray(solved[:n]), np.asarray(-solved[n:]))
            return (found if is_positive(total[:m, :m]) and is_positive(left) else None), left
        left = -0.5 * (total[m:, m:] + total[m:, m:].T)
        change = np.linalg.solve(total[m:, m:], total[m:, :m])
        reduced = total[:m, :m] - total[:m, m:] @ change
        if not (is_positive(left) and is_positive(0.5 * (reduced + reduced.T))):
            return None, left
        gain = np.linalg.solve(reduced.T, (through[:, :m] - through[:, m:] @ change).T).T
        return Injection(np.asarray(gain), np.zeros((q, m))), left


def central_injection(problem: GainProblem, level: float, *, noise: float) -> Injection | None:
    """Return the gains of the central filter at ``level``, or ``None`` when the equation gives none."""
    return CentralEquation.of(problem, noise=noise).filter_at(level)
