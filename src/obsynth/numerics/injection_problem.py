"""The convex core: bound the gain from a disturbance to an output by output injection R, with a weight V free or zero:

``e+ = (A - R C) e + (B - R D) d + (Bn - R Dn) w``, ``xi = (Z + V C) e + (Zd + V D) d + (Zn + V Dn) w``.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np

from obsynth.errors import SolverError, counted
from obsynth.numerics.arrays import FloatArray, largest_singular_value
from obsynth.numerics.matrix_equations import bounded_real_matrix, normalising_change, stabilising_gain
from obsynth.numerics.modal_response import Modes
from obsynth.numerics.norms import (
    highest_gain_found,
    largest_peak,
    norm_is_at_most,
    output_covariance,
    spectral_radius,
    state_units,
)
from obsynth.numerics.ranks import decide_rank
from obsynth.numerics.thin_doubling import FEWEST_STATES

#: Slack of the bounded real matrix that normalises, relative to the squared norm of what is shown.
NORMALISING_SLACK = 1e-6

#: The normalising Riccati solution is taken at this multiple of the starting filter's norm.
NORMALISING_LEVEL = 1.3

#: From so many states on most filters that are asked how fast they are are too slow: eigenvectors are then for nothing.
STATES_FOR_RADIUS_ALONE = 200

#: A share that norms are certain to, and no one misses.
NORM_ROUNDING = 1e-12


@dataclass(frozen=True, eq=False)
class WeightLimit:
    """A positive bound on the spectral norm of the weight ``fixed (q, ny) + V free (m, ny)``."""

    fixed: FloatArray
    free: FloatArray
    bound: float

    def norm(self, v: FloatArray) -> float:
        """Return the norm of the weight."""
        return largest_singular_value(self.fixed + v @ self.free)

    def within_bound(self, v: FloatArray) -> FloatArray:
        """Return V, drawn towards zero by as much as a solver's rounding has let the weight out of the bound."""
        least, size = largest_singular_value(self.fixed), self.norm(v)
        if size <= self.bound or least >= self.bound:
            return v
        return np.asarray((1.0 - NORM_ROUNDING) * (self.bound - least) / (size - least) * v)


@dataclass(frozen=True, eq=False)
class GainProblem:
    """Find R (and V) so that the gain d -> xi is small; noise has unit covariance.

    With ``judged_exactly`` the norms of filters are told (of many states, that they are below a level), else the
    largest peaks found. A, C, Z: ``(n, n)``, ``(m, n)``, ``(q, n)``; B, D, Zd of the disturbance and Bn, Dn, Zn of the
    noise likewise.
    """

    A: FloatArray
    C: FloatArray
    Z: FloatArray
    B: FloatArray
    D: FloatArray
    Zd: FloatArray
    Bn: FloatArray
    Dn: FloatArray
    Zn: FloatArray
    free_weight: bool
    weight_limit: WeightLimit | None = None
    judged_exactly: bool = True
    _modes: WeakKeyDictionary[Injection, Modes] = field(default_factory=WeakKeyDictionary, init=False, repr=False)
    _radii: WeakKeyDictionary[Injection, float] = field(default_factory=WeakKeyDictionary, init=False, repr=False)
    _gains: WeakKeyDictionary[Injection, float] = field(default_factory=WeakKeyDictionary, init=False, repr=False)
    _variances: WeakKeyDictionary[Injection, float] = field(default_factory=WeakKeyDictionary, init=False, repr=False)

    @property
    def order(self) -> int:
        """Number of states n."""
        return int(self.A.shape[0])

    @property
    def measured(self) -> int:
        """Number of free measurements m."""
        return int(self.C.shape[0])

    @property
    def disturbances(self) -> int:
        """Number of disturbances nd."""
        return int(self.B.shape[1])

    @property
    def weight_is_free(self) -> bool:
        """Whether there is a V to choose at all."""
        return self.free_weight and self.measured > 0

    @cached_property
    def states_noise(self) -> bool:
        """Whether there is a noise model; without one the noise is a unit one on the free measurements alone."""
        return bool(self.Bn.any() or self.Zn.any())

    @cached_property
    def disturbance_size(self) -> float:
        """What the disturbance could do to xi at most in one step, whatever cancels: the scale of a gain."""
        state, direct = np.vstack([self.B, self.D]), float(np.linalg.norm(self.Zd))
        return float(np.linalg.norm(self.Z) * np.linalg.norm(state)) + direct

    def noise_as_disturbance(self) -> GainProblem:
        """Return the problem with its noise in the disturbance's place."""
        return replace(self, B=self.Bn, D=self.Dn, Zd=self.Zn)

    def with_state_noise(self, size: float) -> GainProblem:
        """Return the problem with independent noise of this size on each state besides its own."""
        n, m, q = self.order, self.measured, self.Z.shape[0]
        return replace(
            self,
            Bn=np.hstack([self.Bn, size * np.eye(n)]),
            Dn=np.hstack([self.Dn, np.zeros((m, n))]),
            Zn=np.hstack([self.Zn, np.zeros((q, n))]),
        )

    def closed_loop(self, solution: Injection) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return ``(A, B, Z, Zd)`` of the error system d -> xi with the given gains."""
        r, v = solution.R, solution.V
        return self.A - r @ self.C, self.B - r @ self.D, self.Z + v @ self.C, self.Zd + v @ self.D

    def noise_variance(self, solution: Injection) -> float:
        """Return the true total variance of xi under the noise of the problem, with the given gains."""
        if solution not in self._variances:
            r, v = solution.R, solution.V
            # Of the closed loop with the noise in the disturbance's place; its modes are known or asked for anyway.
            system = self.A - r @ self.C, self.Bn - r @ self.Dn, self.Z + v @ self.C, self.Zn + v @ self.Dn
            covariance = output_covariance(*system, is_stable=self.radius(solution) < 1.0)
            self._variances[solution] = float(np.trace(covariance))
        return self._variances[solution]

    def modes(self, solution: Injection) -> Modes:
        """Return the modes of the closed loop; those of the last filter are kept."""
        if solution not in self._modes:
            self.knows(solution, Modes.of(self.A - solution.R @ self.C))
        return self._modes[solution]

    def knows(self, solution: Injection, modes: Modes) -> None:
        """Note the modes of the closed loop, found in other coordinates."""
        self._modes.clear()
        self._modes[solution], self._radii[solution] = modes, modes.radius

    def radius(self, solution: Injection) -> float:
        """Return the spectral radius of the closed loop; asked for once, as it takes all eigenvalues."""
        if solution not in self._radii:
            if self.order < STATES_FOR_RADIUS_ALONE:
                self.modes(solution)
            else:
                self._radii[solution] = spectral_radius(self.A - solution.R @ self.C)
        return self._radii[solution]

    def reaches(self, solution: Injection, level: float) -> bool:
        """Return whether the norm d -> xi is at most ``level``."""
        if not self.judged_exactly:
            if solution not in self._gains:
                peak = largest_peak(*self.closed_loop(solution), modes=self.modes(solution), enough=level)
                if peak > level:
                    return False  # some gain that is attained: which is the largest is not known
                self._gains[solution] = peak
            return self._gains[solution] <= level
        return norm_is_at_most(*self.closed_loop(solution), level, modes=self.modes(solution))

    def achieved_gain(self, solution: Injection) -> float:
        """Return the H-infinity norm d -> xi with the given gains: the largest peak found, or the norm itself."""
        if solution not in self._gains:
            judge = highest_gain_found if self.judged_exactly else largest_peak
            self._gains[solution] = judge(*self.closed_loop(solution), modes=self.modes(solution))
        return self._gains[solution]


@dataclass(frozen=True, eq=False)
class Injection:
    """Gains of the error system, R ``(n, m)`` and V ``(q, m)``, zero when the weight is fixed."""

    R: FloatArray
    V: FloatArray

    @property
    def parts(self) -> tuple[FloatArray, FloatArray]:
        """R and V."""
        return self.R, self.V


@dataclass(frozen=True, eq=False)
class NormalisedProblem:
    """A `GainProblem` whose inequality is solved near the identity: old state = ``states`` times the new one.

    ``measurements (m, m)`` maps old ones to orthonormal ones, and old gains are ``gain`` times new ones (1 without
    disturbance). ``start``: a stable filter in the original coordinates; ``start_gain``: its true gain (0 without).
    """

    problem: GainProblem
    states: FloatArray
    measurements: FloatArray
    gain: float
    start: Injection
    start_gain: float

    def restore(self, solution: Injection) -> Injection:
        """Return gains for the original coordinates."""
        return Injection(self.states @ solution.R @ self.measurements, solution.V @ self.measurements)

    def restored_modes(self, modes: Modes) -> Modes:
        """Return the modes of a closed loop in the original coordinates."""
        return Modes(modes.values, np.asarray(self.states @ modes.vectors))

    def contracted(self, solution: Injection) -> Injection:
        """Return gains of the original coordinates in the normalised ones."""
        inverse = np.linalg.inv(self.measurements) if self.measurements.size else self.measurements
        return Injection(np.linalg.solve(self.states, solution.R) @ inverse, solution.V @ inverse)


def normalise(problem: GainProblem, *, start: Injection | None = None, gain: float | None = None) -> NormalisedProblem:
    """Return the problem in coordinates in which a solution of its inequality is near the identity.

    ``gain`` is that of ``start``, where known.
    """
    start = start if start is not None else _starting_filter(problem)
    # As a scale, a gain that is attained is as good as the largest one, and for many states much cheaper.
    gain = problem.achieved_gain(start) if gain is None else gain
    size = gain if np.isfinite(gain) and gain > 0.0 else 1.0
    a, b, z, zd = problem.closed_loop(start)
    states = _natural_states(a, b, z, zd, NORMALISING_LEVEL * size)
    inverse = np.linalg.inv(states)
    c = problem.C @ states
    measurements = _orthonormalising(c, problem.D / size) if problem.measured else np.zeros((0, 0))
    # With P near I in units of gain^2: B is scaled by 1/gain, and x by the root of P.
    limit = problem.weight_limit
    changed = replace(
        problem,
        weight_limit=None if limit is None else replace(limit, free=measurements @ limit.free),
        A=inverse @ problem.A @ states,
        C=measurements @ c,
        Z=problem.Z @ states,
        B=inverse @ problem.B / size,
        D=measurements @ problem.D / size,
        Zd=problem.Zd / size,
        Bn=inverse @ problem.Bn,
        Dn=measurements @ problem.Dn,
    )
    return NormalisedProblem(changed, states, measurements, size, start, gain)


def _orthonormalising(c: FloatArray, d: FloatArray) -> FloatArray:
    """Return the inverse of the Cholesky factor of ``c c'`` without that product, which loses rows in other units; of
    ``c c' + d d'`` where some measurement shows disturbances alone."""
    shown = c if decide_rank(c, expected=len(c)).full else np.hstack([c, d])
    factor = np.linalg.qr(shown.T, mode="r")
    return np.asarray(np.linalg.inv((np.copysign(1.0, np.diag(factor))[:, None] * factor).T))


def _natural_states(a: FloatArray, b: FloatArray, z: FloatArray, zd: FloatArray, level: float) -> FloatArray:
    """Return S ``(n, n)``, ``S'PS = I``, for a P of the bounded real inequality at a level, or of Lyapunov's."""
    if len(a) >= FEWEST_STATES and 0 < len(z) <= b.shape[1]:
        # The level squared times the inverse of a solution of the transposed system, which takes less time.
        units = state_units(a, b, z)[:, None]
        moved, driven = a / units * units.T, b / units
        tail = NORMALISING_SLACK * largest_singular_value(driven) ** 2
        y = bounded_real_matrix(moved.T, units * z.T, driven.T, zd.T, level, slack=tail)
        if y is not None:
            return np.asarray(units * np.linalg.cholesky(y)) / level
    tail = NORMALISING_SLACK * max(largest_singular_value(z) ** 2, np.finfo(np.float64).tiny)
    p = bounded_real_matrix(a, b, z, zd, level, slack=tail)
    if p is None:
        p = bounded_real_matrix(a, b[:, :0], z, zd[:, :0], 1.0, slack=tail)
    return np.eye(len(a)) if p is None else normalising_change(p)


def null_basis(matrix: FloatArray) -> FloatArray:
    """Return an orthonormal basis ``(cols, cols - rows)`` of the null space of a matrix of full row rank."""
    rows, columns = matrix.shape
    if rows == 0:
        return np.eye(columns)
    return np.asarray(np.linalg.qr(matrix.T, mode="complete")[0][:, rows:])


def _starting_filter(problem: GainProblem) -> Injection:
    noise, through = np.hstack([problem.B, problem.Bn]), np.hstack([problem.D, problem.Dn])
    gain = stabilising_gain(problem.A, problem.C, noise, through)
    if gain is None:
        raise SolverError(
            "No stable starting filter was found, although the existence conditions hold. Without feedback the error "
            f"grows by a factor of up to {spectral_radius(problem.A):.3g} per sample, with "
            f"{counted(problem.measured, 'free measurement')} against it: a fault that moves the outputs little "
            "within its delay makes it grow fast, and many unstable modes need more outputs. The result is "
            "inconclusive."
        )
    return Injection(gain, np.zeros((problem.Z.shape[0], problem.measured)))
