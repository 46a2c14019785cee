"""System norms of discrete-time realisations ``(A, B, C, D)``, with numpy and scipy alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsynth.numerics.arrays import ComplexArray, FloatArray
from obsynth.numerics.gain_levels import compared_gain
from obsynth.numerics.modal_response import ModalResponse, Modes, level_crossings, resolved
from obsynth.numerics.scaling import balancing_factors

#: Relative gap between the attained value and the certified level of an H-infinity norm.
NORM_TOLERANCE = 1e-9

#: Points of the starting frequency grid.
GRID_POINTS = 33

#: Relative difference of modal and true response from which modal coordinates are not believed.
MODAL_ERROR = 1e-3

#: Above so many states a Riccati equation takes the pencil's place, which takes no longer up to there and is exact:
#: relative gaps at which it is asked, in turn, and points of the grid.
STATES_OF_PENCIL = 80

WIDER_TOLERANCES = (1e-4, 1e-3)

MANY_GRID_POINTS = 257

#: Each round at least squares the relative error near the peak; more than this means trouble.
MAXIMUM_ROUNDS = 40

#: Variance of a state in the rest of an infinite sum, relative to what is summed, below which the sum is complete.
SUM_TOLERANCE = 1e-17

#: Each doubles the number of terms of that sum.
MAXIMUM_DOUBLINGS = 64


@dataclass(frozen=True)
class HinfNorm:
    """The H-infinity norm of a system: ``value`` is attained, at ``frequency`` in rad/s (infinite: feedthrough).

    In discrete time in radians per sample. ``upper``: level at which the symplectic pencil has no eigenvalue on the
    circle, or a Riccati equation a solution (computed, not proved).
    """

    value: float
    upper: float
    frequency: float


def spectral_radius(a: FloatArray) -> float:
    """Return the largest modulus of an eigenvalue of ``a (n, n)``; 0 for no states."""
    return float(np.max(np.abs(np.linalg.eigvals(a)))) if a.size else 0.0


def frequency_response(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, angles: FloatArray) -> ComplexArray:
    """Return ``C (e^{jw} I - A)^{-1} B + D`` for each angle, ``(len(angles), rows, cols)``."""
    return response(a, b, c, d, np.exp(1j * np.atleast_1d(angles)))


def response(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, points: ComplexArray) -> ComplexArray:
    """Return ``C (s I - A)^-1 B + D`` at each point s (z in discrete time), ``(len(points), rows, cols)``."""
    if a.shape[0] == 0:
        return np.broadcast_to(d.astype(complex), (len(points), *d.shape)).copy()
    parts = [c @ states for states in resolved(None, a, b, points)]
    return np.asarray(np.concatenate(parts) + d) if parts else np.zeros((0, *d.shape), dtype=complex)


def hinf_norm(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, *, modes: Modes | None = None) -> HinfNorm:
    """Return the H-infinity norm of a discrete-time system: Bruinsma and Steinbuch's iteration.

    Raise the level to the largest gain found and look between the crossings of that level, until there are none.
    """
    if b.shape[1] == 0 or c.shape[0] == 0:
        return HinfNorm(0.0, 0.0, 0.0)
    if not all(np.isfinite(part).all() for part in (a, b, c, d)):
        return HinfNorm(np.inf, np.inf, np.nan)
    modes = Modes.of(a) if modes is None else modes
    if modes.radius >= 1.0:
        return HinfNorm(np.inf, np.inf, np.nan)
    a, b, c, modes = _balanced(a, b, c, modes)
    if a.shape[0] > STATES_OF_PENCIL:
        norm = _norm_of_many_states(a, b, c, d, modes)
        if norm is not None:
            return norm
    best, angle = _highest_peak(a, b, c, d, modes)
    if best == 0.0 or not np.isfinite(best) or a.shape[0] == 0:
        return HinfNorm(best, best, angle)
    for _ in range(MAXIMUM_ROUNDS):
        level = best * (1.0 + NORM_TOLERANCE)
        crossings = level_crossings(a, b, c, d, level)
        if not crossings.size:
            return HinfNorm(best, level, angle)
        ordered = np.sort(np.concatenate([[0.0], crossings, [np.pi]]))
        candidates = np.concatenate([crossings, 0.5 * (ordered[1:] + ordered[:-1])])
        higher, where = _peak(a, b, c, d, candidates)
        if higher <= level:
            # The pencil's eigenvalues touch the circle only within rounding: no gain there exceeds the level.
            return HinfNorm(max(best, higher), level, angle)
        best, angle = higher, where
    return HinfNorm(best, np.inf, angle)


def norm_is_at_most(
    a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, level: float, *, modes: Modes | None = None
) -> bool:
    """Return whether the H-infinity norm is at most ``level``: by a Riccati equation, else by the norm."""
    if a.shape[0] == 0 or b.shape[1] == 0 or c.shape[0] == 0:
        return hinf_norm(a, b, c, d).upper <= level
    if not all(np.isfinite(part).all() for part in (a, b, c, d)):
        return False
    modes = Modes.of(a) if modes is None else modes
    if modes.radius >= 1.0:
        return False
    scaled = balanced_realisation(a, b, c)
    verdict = compared_gain(*scaled, d, level)
    if verdict is not None:
        return verdict
    # A gain above the level that is attained is cheaper to find than the norm.
    return (
        largest_peak(a, b, c, d, modes=modes, enough=level) <= level
        and hinf_norm(a, b, c, d, modes=modes).upper <= level
    )


def highest_gain_found(
    a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, *, modes: Modes | None = None
) -> float:
    """Return the H-infinity norm or, for many states, the largest gain that a modal response shows: attained."""
    many = a.shape[0] > STATES_OF_PENCIL
    return largest_peak(a, b, c, d, modes=modes) if many else hinf_norm(a, b, c, d, modes=modes).upper


def largest_peak(
    a: FloatArray,
    b: FloatArray,
    c: FloatArray,
    d: FloatArray,
    *,
    modes: Modes | None = None,
    enough: float = np.inf,
) -> float:
    """Return the largest gain that a modal response shows, the H-infinity norm where that is not to be believed.

    A gain above ``enough`` ends the search.
    """
    modes = Modes.of(a) if modes is None else modes
    if modes.radius >= 1.0:
        return float("inf")
    if all(part.size for part in (a, b, c)) and all(np.isfinite(part).all() for part in (b, c, d)):
        points = MANY_GRID_POINTS if a.shape[0] > STATES_OF_PENCIL else GRID_POINTS
        balanced = _balanced(a, b, c, modes)
        best, _ = _modal_peak(*balanced[:3], d, balanced[3], points=points, enough=enough)
        if np.isfinite(best):
            return best
    return hinf_norm(a, b, c, d, modes=modes).upper


def _norm_of_many_states(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, modes: Modes) -> HinfNorm | None:
    """Return the norm from the highest modal peak and a Riccati equation just above; ``None`` where that has none."""
    best, angle = _modal_peak(a, b, c, d, modes, points=MANY_GRID_POINTS)
    if not np.isfinite(best) or best == 0.0:
        return None
    for tolerance in WIDER_TOLERANCES:
        if compared_gain(a, b, c, d, best * (1.0 + tolerance)):
            return HinfNorm(best, best * (1.0 + tolerance), angle)
    return None


def _modal_peak(
    a: FloatArray,
    b: FloatArray,
    c: FloatArray,
    d: FloatArray,
    modes: Modes,
    *,
    points: int,
    enough: float = np.inf,
) -> tuple[float, float]:
    """Return the largest gain found in modal coordinates, and where; infinite where they are not to be believed.

    A gain above ``enough`` that is attained ends the search."""
    with np.errstate(all="ignore"):
        response = ModalResponse.of(modes, b, c, d)
        if response is None:
            return np.inf, np.nan
        rough, widths, sizes = response.rough_peaks(points)
        if (sizes[:1] > enough).any():
            best, angle = _peak(a, b, c, d, rough[:1])
            if enough < best < np.inf:
                return best, angle
        angles = response.refined(rough, widths)
        sizes = response.gains(angles)
        top = int(np.argmax(sizes))
    best, angle = _peak(a, b, c, d, angles[[top]])
    return (best, angle) if abs(best - sizes[top]) <= MODAL_ERROR * best else (np.inf, np.nan)


def _highest_peak(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, modes: Modes) -> tuple[float, float]:
    """Return the largest gain found, and where, of modal peaks or of a plain grid with the angles of the poles."""
    if a.shape[0]:
        best, angle = _modal_peak(a, b, c, d, modes, points=GRID_POINTS)
        if np.isfinite(best):
            return best, angle
    grid = np.linspace(0.0, np.pi, GRID_POINTS)
    return _peak(a, b, c, d, np.concatenate([grid, np.abs(np.angle(modes.values))]))


def balanced_realisation(a: FloatArray, b: FloatArray, c: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the realisation with its states scaled by powers of two, which is exact: units must not cost digits."""
    scale = state_units(a, b, c)
    return a * scale / scale[:, None], b / scale[:, None], c * scale


def _balanced(
    a: FloatArray, b: FloatArray, c: FloatArray, modes: Modes
) -> tuple[FloatArray, FloatArray, FloatArray, Modes]:
    """Return the realisation of `balanced_realisation` and its modes."""
    scale = state_units(a, b, c)
    moved = Modes(modes.values, modes.vectors / scale[:, None])
    return a * scale / scale[:, None], b / scale[:, None], c * scale, moved


def state_units(a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    """Return powers of two ``(n,)``, the units of the states in which a realisation is balanced."""
    n, inputs, outputs = a.shape[0], b.shape[1], c.shape[0]
    system = np.zeros((n + inputs + outputs, n + inputs + outputs))
    system[:n, :n], system[:n, n : n + inputs], system[n + inputs :, :n] = a, b, c
    return balancing_factors(system)[:n]


def _peak(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, angles: FloatArray) -> tuple[float, float]:
    with np.errstate(over="ignore", invalid="ignore"):
        responses = frequency_response(a, b, c, d, angles)
    if not np.isfinite(responses).all():
        return np.inf, np.nan
    gains = np.linalg.svd(responses, compute_uv=False)[:, 0]
    top = int(np.argmax(gains))
    return float(gains[top]), float(angles[top])


def output_covariance(
    a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, *, is_stable: bool = False
) -> FloatArray:
    """Return the covariance ``(p, p)`` of the output under unit white noise; infinite if unstable or on overflow.

    ``is_stable``: that ``a`` is stable is known, and its eigenvalues are not computed again."""
    infinite = np.full((c.shape[0], c.shape[0]), np.inf)
    if not is_stable and (not np.all(np.isfinite(a)) or spectral_radius(a) >= 1.0):
        return infinite
    with np.errstate(over="ignore", invalid="ignore"):
        states, power = b @ b.T, a
        for _ in range(MAXIMUM_DOUBLINGS):
            # The sum of A^k B B' A'^k over the first k, doubled: every term is positive semidefinite.
            later = power @ states @ power.T
            states, power = states + later, power @ power
            if not np.all(np.isfinite(states)):
                return infinite
            if np.all(np.diag(later) <= SUM_TOLERANCE * np.diag(states)):
                break
        else:
            return infinite
        covariance = np.asarray(c @ states @ c.T + d @ d.T)
    return covariance if np.all(np.isfinite(covariance)) else infinite
