"""Decomposition of a pair into its observable part and its fixed modes: Share Pasand et al., procedure 1, step 7.

Their Lemma 6 (the pair is always observable) is false.  A staircase of rank decisions fails on large stiff pairs.  The
fixed modes, however, are zeros of the plant's pencil, so that the unobservable part is split off one eigenspace at a
time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsynth.errors import PreconditionError
from obsynth.numerics.arrays import ComplexArray, FloatArray, largest_singular_value
from obsynth.numerics.invariant_zeros import is_outside
from obsynth.numerics.logarithmic_balance import LogBalance
from obsynth.numerics.ranks import CANCELLATION_TOLERANCE, HIDDEN_MODE_TOLERANCE, RANK_TOLERANCE
from obsynth.numerics.spectra import eigenvalues

#: Fixed modes closer than this, relative to their size, are split off together, at their mean: rounding moves a double
#: mode by about the square root of the unit roundoff.
SAME_MODE = 1e-5

#: Entries below this share of the largest one count as zero when states are balanced: units of the plant have relative
#: errors of about 1e-9, which leave so much of products that would be zero.
LEAST_LINK = 1e-8


@dataclass(frozen=True, eq=False)
class ObservableSplit:
    """``x = units * basis @ [observable; hidden]``: ``F = [F_o 0; F_ho F_h]`` and ``C = [C_o 0]``."""

    basis: FloatArray  # (n, n), orthogonal
    units: FloatArray  # (n,), of the balanced states
    F: FloatArray  # F_o (no, no)
    C: FloatArray  # C_o (ny, no)
    fixed_modes: ComplexArray  # of the hidden part

    @property
    def order(self) -> int:
        """Number of observable states."""
        return int(self.F.shape[0])

    def lift(self, gain: FloatArray) -> FloatArray:
        """Return the gain ``(n, ny)`` of the whole pair that belongs to a gain ``(no, ny)`` of the observable part."""
        return np.asarray(self.units[:, None] * (self.basis[:, : self.order] @ gain))

    def observable_rows(self, matrix: FloatArray) -> FloatArray:
        """Return the observable rows of an input matrix ``(n, *)`` of the whole pair."""
        return np.asarray(self.basis[:, : self.order].T @ (matrix / self.units[:, None]))

    def observable_columns(self, matrix: FloatArray) -> FloatArray:
        """Return the observable columns of an output matrix ``(*, n)`` of the whole pair."""
        return np.asarray((matrix * self.units) @ self.basis[:, : self.order])


def observable_split(
    f: FloatArray, c: FloatArray, fixed_modes: ComplexArray, *, dt: float, exact_rows: int = 0
) -> ObservableSplit:
    """Return the observable part of the pair ``(F, C)``, from its known fixed modes.

    ``f (n, n)``, ``c (ny, n)``; the last ``exact_rows`` rows of F are no rounded products.

    By rounding a fixed mode may be observable in the pair.  If it is stable, it stays in the observable part, where it
    decays with or without a gain.  If it is unstable, `PreconditionError` is raised.
    """
    n = f.shape[0]
    units = _balancing(f, c, exact_rows)
    work_f, work_c, basis = f * units / units[:, None], c * units, np.eye(n)
    size = max(largest_singular_value(work_f), largest_singular_value(work_c)) if n else 1.0
    modes: list[complex] = []
    for mode in map(complex, fixed_modes):
        if 0.0 < abs(mode.imag) <= SAME_MODE * max(1.0, abs(mode)):
            modes.append(complex(mode.real, 0.0))
        elif mode.imag >= 0.0:
            modes.append(mode)
    visible = n
    while modes:
        value = modes[0]
        cluster = [other for other in modes if abs(other - value) <= SAME_MODE * max(1.0, abs(value))]
        kernel = _hidden_directions(work_f[:visible, :visible], work_c[:, :visible], sum(cluster) / len(cluster), size)
        count = kernel.shape[1] // (2 if value.imag > 0.0 else 1)
        if count == 0 and not any(is_outside(other, dt) for other in cluster):
            modes = [other for other in modes if other not in cluster]
            continue
        if count == 0 or (count > len(cluster) and is_outside(value, dt)):
            raise PreconditionError(
                f"By the zeros of plant and fault model {value:.6g} is a fixed mode, but it is observable in the pair "
                "(U A, C): double precision cannot decide. Lower the order of the fault model, or rescale the plant.",
                condition="fixed modes",
                mode=value,
            )
        turn = np.eye(n)
        # Observable directions come first, the unobservable ones of this mode last.
        directions = np.linalg.svd(kernel)[0]
        turn[:visible, :visible] = np.hstack([directions[:, kernel.shape[1] :], directions[:, : kernel.shape[1]]])
        work_f, work_c, basis = turn.T @ work_f @ turn, work_c @ turn, basis @ turn
        visible -= kernel.shape[1]
        for other in cluster[:count]:
            modes.remove(other)
    hidden = eigenvalues(work_f[visible:, visible:])
    return ObservableSplit(basis, units, work_f[:visible, :visible], work_c[:, :visible], hidden)


def _hidden_directions(f: FloatArray, c: FloatArray, value: complex, size: float) -> FloatArray:
    """Return a real orthonormal basis of the unobservable eigenspace of a mode and its conjugate."""
    shifted = f - (value if value.imag else value.real) * np.eye(f.shape[0])
    _, values, right = np.linalg.svd(np.vstack([shifted, c]))
    kernel = right[values <= HIDDEN_MODE_TOLERANCE * max(size, abs(value))].conj().T
    if value.imag == 0.0:
        return np.asarray(kernel.real)
    parts = np.hstack([kernel.real, kernel.imag])
    if parts.shape[1] == 0:
        return parts
    directions, lengths, _ = np.linalg.svd(parts, full_matrices=False)
    return np.asarray(directions[:, lengths > RANK_TOLERANCE])


def _balancing(f: FloatArray, c: FloatArray, exact_rows: int) -> FloatArray:
    """Return scale factors of the states that balance the entries of F and the columns of C; the scale of F is free."""
    n = f.shape[0]
    problem = LogBalance(n + 2)
    states = range(n)
    links = np.where(np.eye(n, dtype=bool), 0.0, f)
    # The norms of C's columns, so that the units do not depend on the choice of output combinations.
    output_sizes = np.linalg.norm(c, axis=0, keepdims=True)
    largest_f, largest_c = (float(np.max(np.abs(part), initial=0.0)) for part in (f, output_sizes))
    floors = np.full((n, 1), LEAST_LINK * largest_f)
    floors[n - exact_rows :] = CANCELLATION_TOLERANCE * largest_f
    problem.add(np.where(np.abs(links) > floors, f, 0.0), states, states, signs=(-1, 1), common=n)
    problem.add(
        np.where(output_sizes > CANCELLATION_TOLERANCE * largest_c, output_sizes, 0.0), range(n + 1, n + 2), states
    )
    for state in states:
        problem.wish(state, 0.0)
    return np.asarray(np.exp2(problem.solve()[:n]))
