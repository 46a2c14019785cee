"""Frequency responses by modes: peaks, and frequencies at which a level is crossed, by a symplectic pencil."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from obsynth.numerics.arrays import SMALLEST, ComplexArray, FloatArray

#: Poles of at least this modulus may make a peak of their own.
NEAR = 0.5

#: How many peaks are refined, by how many points on either side, and how often.
MOST_PEAKS = 3

POINTS_BESIDE = 4

MODE_REFINEMENTS = 3

#: Rows or columns up to which the largest singular value has a formula.
TWO = 2

#: From so many states on, steps of power iteration take the place of eigenvalues.
STATES_FOR_POWER_ITERATION = 60

POWER_STEPS, ROUGH_STEPS = 8, 4

#: Entries of the matrices (complex, 16 bytes each) that responses are computed with at once.
MOST_ENTRIES_AT_ONCE = 2_000_000

#: Eigenvalues of the symplectic pencil this close to the unit circle are looked at as crossings: a false one costs
#: one more look, a missed one would cost the bound.
CIRCLE_TOLERANCE = 1e-3

#: Reciprocal condition number down to which a matrix may be inverted on the way to those eigenvalues.
SAFE_RECIPROCAL_CONDITION = 1e-7


def pencils_at(e: FloatArray | None, a: FloatArray, points: ComplexArray) -> ComplexArray:
    """Return ``s E - A`` at points, ``(count, n, m)``; E is the identity where it is not given."""
    pencils = np.empty((len(points), *a.shape), dtype=np.complex128)
    if e is not None:
        pencils[:] = np.ascontiguousarray(e)
        pencils *= points[:, None, None]
        pencils -= np.ascontiguousarray(a)
        return pencils
    pencils[:] = -a
    diagonal = np.arange(len(a))
    pencils[:, diagonal, diagonal] += points[:, None]
    return pencils


def resolved(e: FloatArray | None, a: FloatArray, b: FloatArray, points: ComplexArray) -> Iterator[ComplexArray]:
    """Yield ``(s E - A)^-1 B`` at the points, as many at once as take little memory, ``(count, n, m)`` each."""
    at_once = max(1, MOST_ENTRIES_AT_ONCE // max(a.size, 1))
    for start in range(0, len(points), at_once):
        pencils = pencils_at(e, a, np.asarray(points)[start : start + at_once])
        yield np.asarray(np.linalg.solve(pencils, np.broadcast_to(b.astype(complex), (len(pencils), *b.shape))))


class Modes(NamedTuple):
    """Eigenvalues ``(n,)`` and eigenvectors of a matrix, as columns."""

    values: ComplexArray
    vectors: ComplexArray

    @classmethod
    def of(cls, a: FloatArray) -> Modes:
        """Return those of ``a (n, n)``; of a matrix that is not finite, infinite ones."""
        if not np.isfinite(a).all():
            return cls(np.full(len(a), np.inf, dtype=np.complex128), np.eye(len(a), dtype=np.complex128))
        values, vectors = np.linalg.eig(a)
        return cls(np.asarray(values, dtype=np.complex128), np.asarray(vectors, dtype=np.complex128))

    @property
    def radius(self) -> float:
        """Largest modulus of an eigenvalue; 0 for no states."""
        return float(np.abs(self.values).max(initial=0.0))


@dataclass(frozen=True, eq=False)
class ModalResponse:
    """``C (z I - A)^-1 B + D``, ``A = V diag(poles) V^-1``: ``c_modes`` is C V ``(p, n)``, ``b_modes`` V^-1 B."""

    poles: ComplexArray
    c_modes: ComplexArray
    b_modes: ComplexArray
    direct: FloatArray

    @classmethod
    def of(cls, modes: Modes, b: FloatArray, c: FloatArray, d: FloatArray) -> ModalResponse | None:
        """Return the response; ``None`` where the eigenvectors are no basis."""
        try:
            b_modes = np.asarray(np.linalg.solve(modes.vectors, b.astype(np.complex128)), dtype=np.complex128)
        except np.linalg.LinAlgError:
            return None
        return (
            cls(modes.values, np.asarray(c @ modes.vectors, dtype=np.complex128), b_modes, d)
            if np.isfinite(b_modes).all()
            else None
        )

    def gains(self, angles: FloatArray, *, roughly: bool = False) -> FloatArray:
        """Return the largest singular value at each angle, zero where it is no number; an estimate for many states.

        Roughly: at most the eighth root of the sum of the eighth powers of all singular values.
        """
        factors = 1.0 / (np.exp(1j * angles)[:, None] - self.poles)
        order = min(self.direct.shape)
        if order <= TWO or len(self.poles) < STATES_FOR_POWER_ITERATION:
            sizes = self._by_gram_matrices(factors, roughly=roughly)
        else:
            sizes = self._by_power_iteration(factors, roughly=roughly)
        finite = np.isfinite(sizes)
        return sizes if finite.all() else np.asarray(np.where(finite, sizes, 0.0))

    def _by_gram_matrices(self, factors: ComplexArray, *, roughly: bool) -> FloatArray:
        inner, outer, direct = self.c_modes, self.b_modes, self.direct
        if direct.shape[0] > direct.shape[1]:
            inner, outer, direct = outer.T, inner.T, direct.T
        response = (inner * factors[:, None, :]).reshape(-1, factors.shape[1]) @ outer
        response = response.reshape(len(factors), *direct.shape) + direct
        if len(direct) > TWO:
            gram = response @ response.conj().transpose(0, 2, 1)
            if roughly:
                # In units of the largest, since eighth powers outgrow double precision.
                unit = np.max(np.abs(gram), initial=np.finfo(np.float64).tiny)
                gram = gram / unit
                return np.asarray(np.sqrt(unit) * np.sum(np.abs(gram @ gram) ** 2, axis=(1, 2)) ** 0.125)
            return np.asarray(np.sqrt(np.linalg.eigvalsh(np.where(np.isfinite(gram), gram, 0.0))[:, -1]))
        squares = (response.real**2 + response.imag**2).sum(axis=2)
        if len(direct) == 1:
            return np.asarray(np.sqrt(squares[:, 0]))
        beside = np.abs((response[:, 0] * response[:, 1].conj()).sum(axis=1))
        middle, half = 0.5 * (squares[:, 0] + squares[:, 1]), 0.5 * (squares[:, 0] - squares[:, 1])
        return np.asarray(np.sqrt(middle + np.hypot(half, beside)))

    def _by_power_iteration(self, factors: ComplexArray, *, roughly: bool) -> FloatArray:
        parts: tuple[NDArray[Any], ...] = (self.c_modes, self.b_modes, self.direct)
        unit = 1.0
        if roughly:
            # Where a peak may be single precision tells as well, in half of the time; in units in which it can.
            inner, outer, beside = (float(np.max(np.abs(part), initial=SMALLEST)) for part in parts)
            unit = max(inner * outer, beside)
            scaled = (self.c_modes / inner, self.b_modes * (inner / unit), self.direct / unit)
            with np.errstate(under="ignore"):
                parts = tuple(part.astype(np.complex64) for part in scaled)
        kind, steps = (np.complex64, ROUGH_STEPS) if roughly else (np.complex128, POWER_STEPS)
        c_modes, b_modes, direct = parts
        back, through, turned = c_modes.conj().T, b_modes.conj().T, factors.T.astype(kind)
        start = np.random.default_rng(0).normal(size=(direct.shape[1], 1))
        u, size = np.repeat(start.astype(kind), len(factors), axis=1), np.zeros(len(factors))
        for _ in range(steps):
            u = u / np.maximum(np.linalg.norm(u, axis=0), np.finfo(kind).tiny)
            y = c_modes @ (turned * (b_modes @ u)) + direct @ u
            size = np.linalg.norm(y, axis=0)
            u = through @ (turned.conj() * (back @ y)) + direct.T @ y
        return np.asarray(unit * size.astype(np.float64))

    def rough_peaks(self, points: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the highest peaks on a grid of so many points and the poles, the highest first: angles in [0, pi],
        how far they may be off, and sizes, at most the eighth root of a sum of eighth powers."""
        near = self.poles[(self.poles.imag >= 0.0) & (np.abs(self.poles) > NEAR)]
        grid = np.arange(points) * (np.pi / (points - 1))
        grid[-1] = np.pi
        angles = np.concatenate([grid, np.arctan2(near.imag, near.real)])
        order = np.argsort(angles, kind="stable")
        angles = angles[order]
        sizes = self.gains(angles, roughly=True)
        beside = np.concatenate([[-1.0], sizes, [-1.0]])
        tops = np.flatnonzero((sizes >= beside[:-2]) & (sizes >= beside[2:]))
        tops = tops[np.argsort(-sizes[tops], kind="stable")[:MOST_PEAKS]]
        centres, neighbours = angles[tops], np.concatenate([[0.0], angles, [np.pi]])
        widths = np.maximum(centres - neighbours[tops], neighbours[tops + 2] - centres)
        # A peak that a pole makes is as wide as the pole is far from the circle.
        reaches = np.concatenate([np.full(points, np.pi), 2.0 * (1.0 - np.abs(near))])[order]
        return centres, np.minimum(widths, reaches[tops]), sizes[tops]

    def refined(self, centres: FloatArray, widths: FloatArray) -> FloatArray:
        """Return the angles of peaks, refined from angles that may be off by the widths."""
        steps = np.arange(-POINTS_BESIDE, POINTS_BESIDE + 1) / POINTS_BESIDE
        for _ in range(MODE_REFINEMENTS):
            tried = np.minimum(np.maximum(centres[:, None] + widths[:, None] * steps, 0.0), np.pi)
            gains: NDArray[Any] = self.gains(tried.ravel()).reshape(tried.shape)
            widths = widths / POINTS_BESIDE
            # Of a few peaks numbers are faster than arrays.
            peaks = zip(tried.tolist(), gains.tolist(), widths.tolist(), strict=True)
            centres = np.array([_peak_angle(angles, sizes, step) for angles, sizes, step in peaks])
        return np.asarray(np.minimum(np.maximum(centres, 0.0), np.pi))


def _peak_angle(angles: list[float], sizes: list[float], step: float) -> float:
    """Return the angle of the largest of some sizes, or of the top of a parabola through three points next to it."""
    best = sizes.index(max(sizes))
    if not 0 < best < len(sizes) - 1:
        return angles[best]
    # Close to the response once the points are close to each other; less than one step away.
    low, middle, high = sizes[best - 1 : best + 2]
    bend = 2.0 * middle - low - high
    return angles[best] + (0.5 * (high - low) / bend * step if bend > 0.0 else 0.0)


def level_crossings(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, level: float) -> FloatArray:
    """Return the angles in [0, pi] at which a singular value equals ``level``.

    There ``z [I 0; C'C + C'D R^-1 D'C, A' + C'D R^-1 B'] - [A + B R^-1 D'C, B R^-1 B'; 0 I]``, ``R = g^2 I - D'D``, is
    singular.
    """
    root = np.sqrt(level)
    b, c, d = b / root, c / root, d / level
    n = a.shape[0]
    weight = np.eye(d.shape[1]) - d.T @ d
    solved = np.linalg.solve(weight, np.hstack([d.T @ c, b.T]))
    through, back = solved[:, :n], solved[:, n:]
    leading, constant = np.eye(2 * n), np.eye(2 * n)
    leading[n:, :n], leading[n:, n:] = c.T @ c + c.T @ d @ through, a.T + c.T @ d @ back
    constant[:n, :n], constant[:n, n:] = a + b @ through, b @ back
    alpha, beta = _pencil_eigenvalues(constant, leading)
    size = np.abs(alpha) + np.abs(beta)
    # |alpha| and |beta| are compared, not divided: infinite eigenvalues need no special case.
    miss = np.abs(np.abs(alpha) - np.abs(beta)) / np.where(size == 0.0, 1.0, 0.5 * size)
    miss[size == 0.0] = 0.0
    near = miss < CIRCLE_TOLERANCE
    return np.asarray(np.abs(np.angle(alpha[near] * np.conj(beta[near]))))


def _pencil_eigenvalues(constant: FloatArray, leading: FloatArray) -> tuple[ComplexArray, ComplexArray]:
    """Return alpha and beta of the eigenvalues ``z = alpha / beta`` of ``constant - z leading``.

    With ``z = (1 + s) / (1 - s)`` ordinary ones, of ``(constant + leading)^-1 (constant - leading)``, where none is
    close to -1; or with ``-leading``, -z and +1. The circle becomes the imaginary axis.
    """
    from obsynth.numerics.lapack import dgecon, dgetrf, dgetrs, pencil_eigenvalues

    for sign in (1.0, -1.0):
        total = np.asarray_chkfinite(constant + sign * leading)
        factors, pivots, failed = dgetrf(total)
        if not failed and dgecon(factors, np.max(np.sum(np.abs(total), axis=0)))[0] > SAFE_RECIPROCAL_CONDITION:
            s = np.linalg.eigvals(dgetrs(factors, pivots, constant - sign * leading)[0])
            return np.asarray(sign * (1.0 + s), dtype=np.complex128), np.asarray(1.0 - s, dtype=np.complex128)
    alpha, size = pencil_eigenvalues(constant, leading)
    return alpha, size.astype(np.complex128)
