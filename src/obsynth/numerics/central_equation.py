"""The Riccati equation of central H-infinity filters: gains of a `GainProblem` for each level g.

With ``h = [C; Z]``, ``k = [D; Zd]``, ``Y = A Y A' - (A Y h' + B k') (k k' - diag(0, g^2 I) + h Y h')^-1 (.)' + B B'``
has a stabilising solution with the right signs exactly when a filter of gain below g exists, and gives one.  A little
artificial noise makes it regular; it can only raise the gain, and the true gain of the true problem decides.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from obsynth.numerics.arrays import FloatArray, largest_singular_value
from obsynth.numerics.doubling import MOST_JUMPS, doubled_riccati_solution
from obsynth.numerics.gain_levels import is_positive
from obsynth.numerics.injection_problem import GainProblem, Injection


class Whitened(NamedTuple):
    """Measurements ``D d + s v`` with unit noise v, in units ``L`` in which they are white, and what they leave.

    A disturbance that they show but for a little noise would cancel to rounding in ``B B' - B D' (D D' + s^2 I)^-1 D
    B'``: with ``[D, s I] = L U'``, orthonormal U, that is the square of ``[B, 0] (I - U U')``.
    """

    factor: FloatArray
    known: FloatArray
    direct: FloatArray
    state_left: FloatArray
    output_left: FloatArray

    @classmethod
    def of(cls, d: FloatArray, noise: float, b: FloatArray, zd: FloatArray) -> Whitened:
        """Return L ``(m, m)``, ``[B, 0] U``, ``[Zd, 0] U`` and what is left of both; ``noise`` is s."""
        m, nd = d.shape
        u, triangle = np.linalg.qr(np.vstack([d.T, noise * np.eye(m)]))
        known, direct = b @ u[:nd], zd @ u[:nd]
        state_left, output_left = -known @ u.T, -direct @ u.T
        state_left[:, :nd] += b
        output_left[:, :nd] += zd
        return cls(triangle.T, known, direct, state_left, output_left)

    def blocks(self, own: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return process, weight and cross of the equation of what is left; ``own``: noise of each state, squared."""
        m, q = len(self.factor), len(self.direct)
        process = self.state_left @ self.state_left.T
        process.reshape(-1)[:: len(process) + 1] += own
        weight = np.eye(m + q)
        weight[m:, m:] = self.output_left @ self.output_left.T
        return process, weight, np.hstack([np.zeros_like(self.known), self.state_left @ self.output_left.T])


@dataclass(frozen=True, eq=False)
class CentralEquation:
    """The equation of a problem with measurements for every level, in as few states as it takes; no limit on V.

    Where the disturbance is in no measurement, only the error on null C is left: with an orthonormal basis N of it, M
    one of its complement and ``F = A N`` (``lift``), ``Y = F K F' + B B'``, ``K = S - S N'Z' (Z N S N'Z' - g^2 I)^-1 Z
    N S``, where S solves the equation with ``N'F``, ``[M'F; ZN]``, ``N'BB'N``, ``diag(M'BB'M, -g^2 I)`` and ``[N'BB'M,
    0]``.  Each is solved for what the measurements leave of the noise (`Whitened`); their units are ``factor``.
    """

    problem: GainProblem
    a: FloatArray
    h: FloatArray
    process: FloatArray
    weight: FloatArray
    cross: FloatArray
    outputs: FloatArray
    full_weight: FloatArray
    full_cross: FloatArray
    factor: FloatArray
    lift: FloatArray | None

    @classmethod
    def of(cls, problem: GainProblem, *, noise: float) -> CentralEquation:
        """Return the equation with artificial noise, relative to the disturbance."""
        size = largest_singular_value(problem.B)
        if problem.D.any() or problem.Zd.any() or not 0 < problem.measured < problem.order or size == 0.0:
            return cls._of_all_states(problem, noise, size)
        return cls._of_hidden_states(problem, noise * size)

    @classmethod
    def _of_all_states(cls, problem: GainProblem, noise: float, size: float) -> CentralEquation:
        output_size = max(largest_singular_value(part) for part in (problem.D, problem.C * size))
        white = Whitened.of(problem.D, noise * (output_size or 1.0), problem.B, problem.Zd)
        white_c = np.linalg.solve(white.factor, problem.C)
        return cls(
            problem,
            problem.A - white.known @ white_c,
            np.vstack([white_c, problem.Z - white.direct @ white_c]),
            *white.blocks((noise * size) ** 2),
            np.vstack([white_c, problem.Z]),
            _bordered(white.direct, problem.Zd @ problem.Zd.T),
            np.hstack([white.known, problem.B @ problem.Zd.T]),
            white.factor,
            None,
        )

    @classmethod
    def _of_hidden_states(cls, problem: GainProblem, noise: float) -> CentralEquation:
        m, a, b, z = problem.measured, problem.A, problem.B, problem.Z
        basis, triangle = np.linalg.qr(problem.C.T, mode="complete")
        known, hidden = basis[:, :m], basis[:, m:]
        lift = a @ hidden
        white = Whitened.of(known.T @ b, noise, hidden.T @ b, problem.Zd)
        white_c = np.linalg.solve(white.factor, known.T @ lift)
        # What the measurements of a sample say of the noise before it, and all that this does.
        measured_noise = known @ white.factor + hidden @ white.known
        done = b @ (z @ b).T + noise**2 * z.T
        return cls(
            problem,
            hidden.T @ lift - white.known @ white_c,
            np.vstack([white_c, z @ hidden]),
            *white.blocks(noise**2),
            np.vstack([np.linalg.solve(white.factor, known.T), z]),
            _bordered(z @ measured_noise, z @ done),
            np.hstack([a @ measured_noise, a @ done]),
            triangle[:m].T @ white.factor,
            lift,
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
            gains, remainder = self._gains(*self._sums(y, level))
        except np.linalg.LinAlgError:
            return None, 0.0
        if gains is None or not (np.isfinite(gains.R).all() and np.isfinite(gains.V).all()):
            return None, 0.0
        return gains, float(np.linalg.eigvalsh(remainder)[0]) / level**2

    def solution(self, level: float) -> FloatArray | None:
        """Return Y ``(n, n)`` at ``level``, or ``None``, of hidden states ``F K F'``; its signs are not looked at."""
        lowered = self._lowered(self.weight, level)
        s = doubled_riccati_solution(
            self.a,
            self.h,
            self.process,
            lowered,
            self.cross,
            possible=lambda y: self._is_possible(y, level),
            most_jumps=MOST_JUMPS,
        )
        if s is None or self.lift is None:
            return s
        error_rows = self.h[self.problem.measured :]
        through = s @ error_rows.T
        k = s - through @ np.linalg.solve(error_rows @ through - level**2 * np.eye(len(error_rows)), through.T)
        return np.asarray(self.lift @ k @ self.lift.T)

    def _sums(self, y: FloatArray, level: float) -> tuple[FloatArray, FloatArray]:
        """Return ``k k' - diag(0, g^2 I) + h Y h'`` and ``A Y h' + B k'`` in all states; white measurements."""
        covariance = y @ self.outputs.T
        total = self._lowered(self.full_weight + self.outputs @ covariance, level)
        return total, self.problem.A @ covariance + self.full_cross

    def _lowered(self, weight: FloatArray, level: float) -> FloatArray:
        lowered = weight.copy()
        lowered.reshape(-1)[self.problem.measured * (len(weight) + 1) :: len(weight) + 1] -= level**2
        return lowered

    def _is_possible(self, y: FloatArray, level: float) -> bool:
        """Whether what xi shows over finitely many steps is still below the level, with the current measurement."""
        m = self.problem.measured
        if self.problem.weight_is_free and self.lift is None:
            total = self.weight + self.h @ y @ self.h.T
            remainder = total[m:, :m] @ np.linalg.solve(total[:m, :m], total[:m, m:]) - total[m:, m:]
        else:
            # Without a free weight xi knows nothing of the current measurement.
            h, weight = (self.outputs, self.full_weight) if self.lift is None else (self.h, self.weight)
            remainder = -weight[m:, m:] - h[m:].dot(y).dot(h[m:].T)
        remainder.reshape(-1)[:: len(remainder) + 1] += level**2
        return is_positive(0.5 * (remainder + remainder.T))

    def _gains(self, total: FloatArray, through: FloatArray) -> tuple[Injection | None, FloatArray]:
        """Return the gains when the signs are right: m positive, q negative, and what must be positive of the q."""
        n, m, q = self.problem.order, self.problem.measured, self.problem.Z.shape[0]
        if self.problem.weight_is_free:
            # The estimate may use the measurement of the same sample.
            solved = np.linalg.solve(total[:m, :m], np.vstack([through[:, :m], total[m:, :m]]).T).T
            remainder = solved[n:] @ total[:m, m:] - total[m:, m:]
            remainder = 0.5 * (remainder + remainder.T)
            solved = np.linalg.solve(self.factor.T, solved.T).T
            injection = Injection(np.asarray(solved[:n]), np.asarray(-solved[n:]))
            return (injection if is_positive(total[:m, :m]) and is_positive(remainder) else None), remainder
        remainder = -0.5 * (total[m:, m:] + total[m:, m:].T)
        change = np.linalg.solve(total[m:, m:], total[m:, :m])
        reduced = total[:m, :m] - total[:m, m:] @ change
        if not (is_positive(remainder) and is_positive(0.5 * (reduced + reduced.T))):
            return None, remainder
        gain = np.linalg.solve(self.factor.T, np.linalg.solve(reduced.T, (through[:, :m] - through[:, m:] @ change).T))
        return Injection(np.asarray(gain.T), np.zeros((q, m))), remainder


def _bordered(border: FloatArray, corner: FloatArray) -> FloatArray:
    """Return ``[I, border'; border, corner]``."""
    m = border.shape[1]
    matrix = np.eye(m + len(border))
    matrix[m:, :m], matrix[:m, m:], matrix[m:, m:] = border, border.T, corner
    return matrix


def central_injection(problem: GainProblem, level: float, *, noise: float) -> Injection | None:
    """Return the gains of the central filter at ``level``, or ``None`` when the equation gives none."""
    return CentralEquation.of(problem, noise=noise).filter_at(level)
