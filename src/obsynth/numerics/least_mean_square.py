"""The least mean-square error of all causal linear filters in continuous time, and a filter that attains it.

The plant is ``x' = a x + b w + m Y`` with outputs ``rho Y = c x + d w`` and white noise w; ``l x + d1 w`` is estimated.
Outputs without noise of their own give some states exactly, and their derivatives measure the other states with the
noise of the states (Bryson and Johansen 1965).  Removing the exact states leaves the same problem with fewer states.
After one such step the filter needs no derivative.  If more steps are needed, the least error is approached to any
accuracy by filters for a little noise on the outputs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from obsynth.errors import PreconditionError
from obsynth.numerics.arrays import SMALLEST, FloatArray
from obsynth.numerics.decoupling_windows import NEAR_INFINITY, EstimationProblem, Model
from obsynth.numerics.least_estimation import STABLE_RADIUS, UNSTABLE_ZERO
from obsynth.numerics.matrix_equations import continuous_lyapunov, continuous_riccati, discrete_solution
from obsynth.numerics.ranks import ROUNDED_ZERO, WINDOW_RANK_TOLERANCE
from obsynth.numerics.standard_form import uncayley

#: Modes of the Cayley transform within this distance of -1 are infinite modes of the plant.
INFINITE_MODE = 1e-10
#: Multiple infinite modes are farther from -1.  The limit is this factor times the n-th root of the precision for n
#: modes; in 24 random plants of index 3 the farthest mode was at a tenth of it.
MOVED_MODES = 1e3
#: Direct feedthrough of white noise to the error below this share is rounding.
WHITE_SHARE = 1e-9
#: That feedthrough is a difference of products; this share of them is rounding.
WHITE_ROUNDING = 1e3 * float(np.finfo(float).eps)
#: Noise added to the outputs, relative to the effect of the state noise on them, largest first.
ADDED_NOISES = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
#: The added noise is reduced until the root mean square is within this factor of the least one.
NEAR_THE_LEAST = 1.01
#: Where the least one is zero: until the root mean square is this share of that with the largest added noise.
NEARLY_ZERO = 1e-3
#: A least root mean square below this share of the filter's is rounding: the square root of that of a covariance.
ROUNDING_SHARE = 1e-5
#: So is one below this share of the states that w excites: a few times the root of the double precision.
ROUNDED_ROOT = 1e-7


class ContinuousFilter(NamedTuple):
    """A filter ``chi' = A chi + B Y``, ``ehat = C chi + D Y``, the root mean square of its error, and the least one."""

    filter: Model
    deviation: float
    least: float
    added_noise: float


@dataclass(frozen=True, eq=False)
class _Measured:
    """A plant ``x' = a x + b w`` with outputs ``c x + d w``.

    ``units``: sizes of the terms whose differences are the rows of d.  ``reach``: size of the states that w excites.
    """

    a: FloatArray
    b: FloatArray
    c: FloatArray
    d: FloatArray
    units: FloatArray
    reach: float

    def covariance(self) -> FloatArray:
        """Return the least error covariance of x; raise `PreconditionError` where there is none."""
        a, b, c, d = self.a, self.b, self.c, self.d
        if not len(a):
            return np.zeros_like(a)
        if not len(c):
            # Without outputs there is one filter.
            if np.any(np.linalg.eigvals(a).real >= -0.5 * (1.0 - STABLE_RADIUS) * np.linalg.norm(a)):
                raise PreconditionError(UNSTABLE_ZERO, condition="zeros")
            return continuous_lyapunov(a, -b @ b.T)
        try:
            return continuous_riccati(a.T, c.T, b @ b.T, d @ d.T, s=b @ d.T)
        except (np.linalg.LinAlgError, ValueError) as error:
            raise PreconditionError(
                "The faults have a zero that is not strictly stable, or what the noise does to the outputs has one on "
                f"the imaginary axis: the filter of least mean square has no Riccati equation ({error}). State the "
                "noise of every sensor (sensor_noise).",
                condition="zeros",
            ) from None

    def gain(self) -> FloatArray:
        """Return the gain of the filter of least covariance."""
        if not len(self.c):
            return np.zeros((len(self.a), 0))
        covariance = self.covariance()
        return np.asarray(
            np.linalg.solve(self.d @ self.d.T, self.c @ covariance + self.d @ self.b.T).T, dtype=np.float64
        )

    def deviation(self, gain: FloatArray, wanted: FloatArray) -> float:
        """Return the root mean square of ``wanted @ error`` of the filter with this gain."""
        closed, driven = self.a - gain @ self.c, self.b - gain @ self.d
        spread = continuous_lyapunov(closed, -driven @ driven.T) if len(closed) else np.zeros_like(closed)
        return float(np.sqrt(max(np.trace(wanted @ spread @ wanted.T), 0.0)))

    def informative(self) -> NDArray[np.bool_]:
        """Return which outputs contain more than rounding."""
        own = np.linalg.norm(self.d, axis=1) + np.linalg.norm(self.c, axis=1) * self.reach
        return np.asarray(own > WINDOW_RANK_TOLERANCE * self.units)

    def of_rows(self, rows: NDArray[np.bool_]) -> _Measured:
        """Return the plant with some of its outputs."""
        return replace(self, c=self.c[rows], d=self.d[rows], units=self.units[rows])

    def with_noise(self, share: float) -> _Measured:
        """Return the plant with noise added to every output: a share of the effect of the state noise on it."""
        rows, rate = len(self.c), max(float(np.linalg.norm(self.a)), SMALLEST)
        size = share * (float(np.linalg.norm(self.c) * np.linalg.norm(self.b)) / rate + float(np.linalg.norm(self.d)))
        b = np.hstack([self.b, np.zeros((len(self.b), rows))])
        return _Measured(self.a, b, self.c, np.hstack([self.d, size * np.eye(rows)]), self.units, self.reach)


class _Split(NamedTuple):
    """The states ``x1 = N' x`` that the outputs do not give exactly, as a problem of their own, and the way back to x.

    ``shown @ c x`` is measured exactly, ``noisy @ c x`` with noise; ``x = N x1 + known (shown @ c x)``.
    """

    rest: _Measured
    N: FloatArray
    noisy: FloatArray
    shown: FloatArray
    known: FloatArray


def least_mean_square(problem: EstimationProblem, *, noises: Sequence[float] = (0.0,)) -> ContinuousFilter:
    """Return the continuous-time filter of least mean square error.

    The problem is transformed back from its Cayley transform, which does not preserve the H2 norm.  The first of
    ``noises`` is added to every output; if it is zero, as much noise as the problem needs.

    Raises `PreconditionError` if every filter passes white noise directly to the error, or no filter is stable.
    """
    problem = _without_derivatives(problem)
    rows = len(problem.C)
    a, b, outputs, direct = uncayley(
        problem.A,
        problem.B,
        np.vstack([problem.C, problem.L]),
        np.vstack([problem.D, problem.D1]),
        problem.alpha,
    )
    half = np.linalg.solve(np.eye(len(problem.A)) + problem.A, problem.G)
    moved, through = np.sqrt(2.0 * problem.alpha) * half, np.vstack([problem.C, problem.L]) @ half
    residual, estimate = problem.V + through[:rows], problem.F + through[rows:]
    c, wanted, d1 = outputs[:rows], outputs[rows:], direct[rows:]
    reach = float(np.linalg.norm(np.linalg.inv(np.eye(len(a)) + problem.A)) * np.linalg.norm(problem.B))
    units = np.linalg.norm(problem.D, axis=1) + np.linalg.norm(problem.C, axis=1) * reach
    # Outputs that depend on others contain nothing but rounding.
    kept = units > WINDOW_RANK_TOLERANCE * np.linalg.norm(residual, axis=1)
    c, direct, residual, units = c[kept], direct[:rows][kept], residual[kept], units[kept]
    measured = _Measured(a, b, c, direct, units, reach)
    split, added = _split(measured), noises[0]
    noisy = measured.d if split is None else split.noisy @ measured.d
    Z0 = d1 @ np.linalg.pinv(noisy)
    cancelled = float(np.linalg.norm(problem.L) * np.linalg.norm(problem.B))
    if np.linalg.norm(d1 - Z0 @ noisy) > WHITE_SHARE * (1.0 + np.linalg.norm(d1)) + WHITE_ROUNDING * cancelled:
        raise PreconditionError(
            "White noise passes to the error whatever the filter: its mean square is infinite. Give a reference model "
            "of higher order, or norm hinf.",
            condition="finite mean square",
        )
    if split is None:
        K, error_rows = (measured.with_noise(added) if added else measured).gain(), wanted - Z0 @ c
        filter_ = a - K @ c, moved + K @ residual, -error_rows, estimate - Z0 @ residual
        deviation = measured.deviation(K, error_rows)
        least = _least(measured, error_rows) if added else deviation
        return ContinuousFilter(filter_, deviation, least, added)
    return _of_the_rest(split, measured, (moved, residual, estimate), (Z0 @ split.noisy, wanted), added)


def _without_derivatives(problem: EstimationProblem) -> EstimationProblem:
    """Return an equivalent problem in which no output contains derivatives of white noise.

    Such an output is filtered by a lag, as in every filter with a finite mean square error.  Derivatives are modes at
    -1 of the Cayley transform.  ``chi+ = A chi + G Y + K r`` with a K that moves these modes alone excludes no filter
    of finite mean square: r passes a stable filter whose zeros are the moved modes.
    """
    a, size = problem.A, len(problem.A)
    count = int(np.sum(np.abs(1.0 + np.linalg.eigvals(a)) < NEAR_INFINITY))
    near = min(max(INFINITE_MODE, MOVED_MODES * float(np.finfo(float).eps) ** (1.0 / max(count, 1))), NEAR_INFINITY)

    def is_infinite(x: Any, y: Any = 0.0) -> Any:
        return np.hypot(x + 1.0, y) < near

    schur, vectors, count = scipy.linalg.schur(a, output="real", sort=is_infinite) if size else (a, a, 0)
    if not count:
        return problem
    modes, own = schur[:count, :count], vectors[:, :count]
    rows = problem.C @ own
    shown = float(np.linalg.norm(rows)) or 1.0
    solution = discrete_solution(modes, rows / shown, np.eye(count), np.eye(len(rows))) if len(rows) else None
    if solution is None:
        raise PreconditionError(
            "The error shows derivatives of noise or of faults whatever the filter, and white noise has none. Give a "
            "reference model of higher order, or norm hinf.",
            condition="finite mean square",
        )
    moved = np.linalg.solve(rows @ solution @ rows.T / shown**2 + np.eye(len(rows)), rows @ solution @ modes.T / shown)
    gain = own @ moved.T / shown
    return replace(problem, A=a - gain @ problem.C, B=problem.B - gain @ problem.D, G=problem.G + gain @ problem.V)


def _of_the_rest(
    split: _Split,
    measured: _Measured,
    inputs: tuple[FloatArray, FloatArray, FloatArray],
    wanted: tuple[FloatArray, FloatArray],
    added: float,
) -> ContinuousFilter:
    """Return the filter of the states that no output gives exactly: its states are ``N' x - K2 (shown @ c x)``."""
    (moved, residual, estimate), N, a, c = inputs, split.N, measured.a, measured.c
    Z0, rows = wanted
    error_rows = rows - Z0 @ c
    least = _least(split.rest, error_rows @ N)
    K, noise = _gain_of_the_rest(split.rest, error_rows @ N, least, added=added)
    K1, K2 = K[:, : len(split.noisy)], K[:, len(split.noisy) :]
    driven = N.T @ a - K1 @ split.noisy @ c - K2 @ split.shown @ c @ a
    exact = (N @ K2 + split.known) @ split.shown @ residual
    filter_ = (
        driven @ N,
        driven @ exact + K1 @ split.noisy @ residual + (N.T - K2 @ split.shown @ c) @ moved,
        -error_rows @ N,
        estimate - Z0 @ residual - error_rows @ exact,
    )
    deviation = split.rest.deviation(K, error_rows @ N)
    return ContinuousFilter(filter_, deviation, least if least > ROUNDING_SHARE * deviation else 0.0, noise)


def _gain_of_the_rest(rest: _Measured, wanted: FloatArray, least: float, *, added: float) -> tuple[FloatArray, float]:
    """Return the gain and the added noise: ``added``, or if that is zero as much as the problem needs.

    Outputs that contain nothing but rounding have a gain of zero.
    """
    kept = rest.informative()
    live = rest.of_rows(kept)
    if added:
        own, noise = live.with_noise(added).gain(), added
    elif _split(live) is None:
        own, noise = live.gain(), 0.0
    else:
        own, noise = _noisy_gain(live, wanted, least)
    gain = np.zeros((len(rest.a), len(rest.c)))
    gain[:, kept] = own
    return gain, noise


def _noisy_gain(measured: _Measured, wanted: FloatArray, least: float) -> tuple[FloatArray, float]:
    """Return the gain for the largest added noise whose mean square error is near the least one, and that noise."""
    enough, best = NEAR_THE_LEAST * least, None
    for share in ADDED_NOISES:
        try:
            gain = measured.with_noise(share).gain()
        except PreconditionError:
            continue
        deviation = measured.deviation(gain, wanted)
        if best is None:
            enough = max(enough, NEARLY_ZERO * deviation)
        if best is None or deviation < best[0]:
            best = deviation, gain, share
        if deviation <= enough:
            break
    if best is None:
        raise PreconditionError(UNSTABLE_ZERO, condition="zeros")
    return best[1], best[2]


def _least(measured: _Measured, wanted: FloatArray) -> float:
    """Return the least root mean square of any filter, from the problem without the states that are known exactly."""
    while (split := _split(measured.of_rows(measured.informative()))) is not None:
        measured, wanted = split.rest, wanted @ split.N
    covariance = measured.of_rows(measured.informative()).covariance()
    own = float(np.sqrt(max(np.trace(wanted @ covariance @ wanted.T), 0.0)))
    return own if own > ROUNDED_ROOT * float(np.linalg.norm(wanted)) * measured.reach else 0.0


def _split(measured: _Measured) -> _Split | None:
    """Return the problem of the states that are not measured exactly; ``None`` where every output has its own noise."""
    a, b, c, d = measured.a, measured.b, measured.c, measured.d
    if not len(c):
        return None
    left, sizes, _ = np.linalg.svd(d / measured.units[:, None])
    rank = int(np.sum(sizes > ROUNDED_ZERO))
    if rank == len(c):
        return None
    noisy, quiet = left[:, :rank].T / measured.units, left[:, rank:].T / measured.units
    turned, shown_sizes, directions = np.linalg.svd(quiet @ c)
    count = int(np.sum(shown_sizes * measured.reach > WINDOW_RANK_TOLERANCE))
    shown, N = turned[:, :count].T @ quiet, directions[count:].T
    known = directions[:count].T / shown_sizes[:count]
    rows, through = np.vstack([noisy @ c, shown @ c @ a]), np.vstack([noisy @ d, shown @ c @ b])
    moved = np.linalg.norm(shown @ c, axis=1) * np.linalg.norm(b)
    units = np.concatenate([np.ones(rank), np.where(moved > 0.0, moved, 1.0)])
    return _Split(_Measured(N.T @ a @ N, N.T @ b, rows @ N, through, units, measured.reach), N, noisy, shown, known)
