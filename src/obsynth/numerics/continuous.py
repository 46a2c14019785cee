"""Continuous time: H-infinity norms by the bilinear transform, peak (l1) gains from above, exact steps.

The peak gain bounds ``int |C e^{At} b| dt``: on an interval of length h the response is off the line between its ends
by at most ``s (h - s) / 2`` times the largest second derivative, known at the start in a Lyapunov norm; what is left
decays with the transition over all intervals. Everything but rounding is accounted for.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import scipy

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray, largest_singular_value, reachable
from obsynth.numerics.matrix_equations import continuous_lyapunov
from obsynth.numerics.modal_response import Modes
from obsynth.numerics.norms import HinfNorm, hinf_norm
from obsynth.numerics.scaling import balanced_matrix, power_of_two_below
from obsynth.numerics.spectra import abscissa

#: Intervals of each length; the length doubles after them, as fast modes have decayed by then.
INTERVALS_PER_LENGTH = 64

#: First length, in units of one over the norm of A.
FIRST_LENGTH = 0.02

#: The intervals end when no more than this share of the response can be left.
RESPONSE_LEFT_SHARE = 1e-4

#: Doublings of the length before the response is held to have ended.
MOST_LENGTHS = 60


@dataclass(frozen=True, eq=False)
class ContinuousNorms:
    """H-infinity norms of continuous-time systems with one ``A (n, n)``: what depends on that alone is found once.

    By ``s = w (z - 1) / (z + 1)``, which keeps every gain; w is the geometric mean of the moduli of the eigenvalues."""

    a: FloatArray
    _known: list[tuple[tuple[FloatArray, ...], HinfNorm]] = field(default_factory=list, init=False, repr=False)

    @cached_property
    def _in_discrete_time(self) -> tuple[float, FloatArray, FloatArray, Modes] | None:
        """w, ``(w I - A)^-1``, the matrix in discrete time and its modes; ``None`` where A is not stable."""
        a, identity = self.a, np.eye(len(self.a))
        own = Modes.of(a)
        values = own.values
        if np.max(values.real) >= 0.0:
            return None
        w = float(np.exp(np.mean(np.log(np.abs(values)))))
        resolvent: FloatArray = np.asarray(np.linalg.inv(w * identity - a), dtype=np.float64)
        turned = resolvent @ (w * identity + a)
        return w, resolvent, turned, Modes((w + values) / (w - values), own.vectors)

    def between(self, b: FloatArray, c: FloatArray, d: FloatArray) -> HinfNorm:
        """Return the norm with other matrices ``(n, m)``, ``(p, n)``, ``(p, m)``."""
        if b.shape[1] == 0 or c.shape[0] == 0:
            return HinfNorm(0.0, 0.0, 0.0)
        if not all(np.all(np.isfinite(part)) for part in (self.a, b, c, d)):
            return HinfNorm(np.inf, np.inf, np.nan)
        if not len(self.a):
            size = largest_singular_value(d)
            return HinfNorm(size, size, 0.0)
        # What drives nothing adds nothing; and systems that differ in that alone have one norm.
        acting = np.any(b, axis=0) | np.any(d, axis=0)
        system = (b, c, d) if acting.all() or not acting.any() else (b[:, acting], c, d[:, acting])
        for known, norm in self._known:
            if all(map(np.array_equal, known, system)):
                return norm
        self._known.append((system, self._between(*system)))
        return self._known[-1][1]

    def _between(self, b: FloatArray, c: FloatArray, d: FloatArray) -> HinfNorm:
        if self._in_discrete_time is None:
            return HinfNorm(np.inf, np.inf, np.nan)
        w, resolvent, turned, modes = self._in_discrete_time
        through = resolvent @ b
        norm = hinf_norm(
            turned, np.sqrt(2.0 * w) * through, np.sqrt(2.0 * w) * c @ resolvent, d + c @ through, modes=modes
        )
        frequency = np.inf if norm.frequency >= np.pi else w * float(np.tan(0.5 * norm.frequency))
        return HinfNorm(norm.value, norm.upper, float(frequency))


def peak_gain(a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    """Return an upper bound on the integral of the Euclidean norm of the response to each input."""
    if not a.size or not b.shape[1]:
        return np.zeros(b.shape[1])
    if not abscissa(a, 0.0) < 0.0:
        raise SpecError("The observer is not stable: its residual has no bound.", path="observer")
    a, b, c = _in_lyapunov_norm(a, b, c)
    second = a @ a
    step = FIRST_LENGTH / largest_singular_value(a)
    transition = np.asarray(scipy.linalg.expm(a * step))
    # Columns of b at the start of the interval, and the whole state transition, for what is left in the end.
    columns = np.hstack([b, np.eye(len(a))])
    total = np.zeros(columns.shape[1])
    for _ in range(MOST_LENGTHS):
        for _ in range(INTERVALS_PER_LENGTH):
            after = transition @ columns
            ends = np.linalg.norm(c @ columns, axis=0) + np.linalg.norm(c @ after, axis=0)
            bend = largest_singular_value(c) * np.linalg.norm(second @ columns, axis=0)
            total += step / 2.0 * ends + step**3 / 12.0 * bend
            columns = after
        inputs = b.shape[1]
        contraction = largest_singular_value(columns[:, inputs:])
        if contraction < 1.0:
            # Each further stretch as long as all so far: the response of what is left of the columns of b.
            per_state = float(np.linalg.norm(total[inputs:]))
            tail = per_state * np.linalg.norm(columns[:, :inputs], axis=0) / (1.0 - contraction)
            if np.all(tail <= RESPONSE_LEFT_SHARE * total[:inputs]):
                return np.asarray(total[:inputs] + tail)
        step, transition = 2.0 * step, transition @ transition
    raise SpecError("Errors of the observer decay too slowly for a bound on its residual.", path="observer")


def _in_lyapunov_norm(a: FloatArray, b: FloatArray, c: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the system in coordinates in which the Euclidean norm of a free motion never grows."""

    # a' p + p a = -q: with q of the size of a, p is near the identity for a normal matrix.
    lyapunov = continuous_lyapunov(a.T, -np.eye(len(a)))
    values, vectors = np.linalg.eigh((lyapunov + lyapunov.T) / 2.0)
    if not (values > 0.0).all():
        raise SpecError("The observer is too close to instability for a bound on its residual.", path="observer")
    root, inverse = (vectors * np.sqrt(values)).T, vectors / np.sqrt(values)
    return root @ a @ inverse, root @ b, c @ inverse


def zero_order_hold(
    a: FloatArray,
    inputs: FloatArray,
    step: float,
    *,
    exponential: Callable[[FloatArray, float], FloatArray | None] | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Return ``exp(A h)`` and its integral times ``inputs``, from one balanced block exponential, as it is given
    or by a library."""
    n, m = inputs.shape
    balanced, scale, scaled, sizes = _in_like_sizes(a, inputs)
    block = np.zeros((n + m, n + m))
    block[:n, :n], block[:n, n:] = balanced, scaled
    transition = None if exponential is None else exponential(block, step)
    row = (_exponential(block, step) if transition is None else transition)[:n]
    return scale[:, None] * row[:, :n] / scale, scale[:, None] * row[:, n:] * sizes


def first_order_hold(a: FloatArray, inputs: FloatArray, step: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return Phi, Gamma0 and Gamma1 of ``x(h) = Phi x(0) + Gamma0 s(0) + Gamma1 (s(h) - s(0))``."""
    n, m = inputs.shape
    balanced, scale, scaled, sizes = _in_like_sizes(a, inputs)
    chain = np.zeros((n + 2 * m, n + 2 * m))
    chain[:n, :n], chain[:n, n : n + m], chain[n : n + m, n + m :] = balanced * step, scaled * step, np.eye(m)
    row = _exponential(chain, 1.0)[:n]
    held, ramped = (scale[:, None] * block * sizes for block in (row[:, n : n + m], row[:, n + m :]))
    return scale[:, None] * row[:, :n] / scale, held, ramped


def _exponential(block: FloatArray, step: float) -> FloatArray:
    """Return ``exp(A h)`` without what rounding leaves where no power of A has an entry."""
    return np.where(reachable(block), np.asarray(scipy.linalg.expm(block * step), dtype=np.float64), 0.0)


def _in_like_sizes(a: FloatArray, inputs: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return both matrices balanced, with the units of the states between, and of the inputs last."""
    balanced, scale = balanced_matrix(a)
    scaled = inputs / scale[:, None]
    # Large inputs would make the exponential square more often than the dynamics need.
    sizes = power_of_two_below(np.max(np.abs(scaled), axis=0, initial=0.0))
    return balanced, scale, scaled / sizes, sizes
