"""Search for the certificate of given gains: a Lyapunov matrix that proves the bounded real inequality."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice, product

import numpy as np

from obsynth.numerics import lapack
from obsynth.numerics.arrays import FloatArray, largest_singular_value
from obsynth.numerics.matrix_equations import bounded_real_matrix, normalising_change
from obsynth.numerics.norms import output_covariance, state_units
from obsynth.numerics.thin_doubling import FEWEST_STATES
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.verification.error_system import ErrorModel
from obsynth.verification.inequalities import prove_bounded_real

#: Sequences of levels, relative to the claimed one, at which coordinates are improved before a proof at the claimed
#: level is tried.
APPROACHES = ((1.05,), (1.5, 1.05, 1.001))

#: Weights of all states in the Riccati equation, relative to the output's weight, tried in turn.
TAIL_WEIGHTS = (1e-2, 1e-4, 1e-6, 1e-9, 1e-12, 1e-16, 1e-20)

#: Slack of the Riccati equation relative to the output weight.  The first, hence largest, one with a proof is taken.
FILTER_SLACKS = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10)

#: Pairs, tried in turn: the share by which A and B are enlarged, and the variance of a noise on every state relative
#: to that of the disturbance, which keeps states in the solution that the disturbance hardly moves.  The first pair
#: leaves a hundred times the rounding errors of matrices of order 2,000.
ROOMS = ((1e-4, 1e-7), (1e-5, 1e-8))

#: Most changes of coordinates towards ones in which the norm of the error dynamics is near one.
MOST_CONTRACTIONS = 60

#: Each change aims at the norm to this power, or at half the norm where that is less: larger steps are ill-conditioned.
STEP_POWER = 0.75

#: The norm of the error dynamics at which the changes of coordinates end.
CONTRACTED_NORM = 1.05


def bounded_real_certificate(
    plant: DescriptorSystem,
    observer: LinearObserver,
    tracking: FloatArray,
    gain: float,
    *,
    core: int,
    lag: int,
    tries: int | None = None,
) -> tuple[FloatArray, bool]:
    """Return Q ``(core, core)``, upper triangular with P = Q'Q, for the level ``gain``, and whether it is a proof.

    Q is the Riccati solution with the largest slack that proves the level, or else the last one.  At most ``tries``
    changes of coordinates are tried.
    """
    errors = ErrorModel(plant, observer, tracking, lag=lag)
    a, b = observer.Az[:core, :core], errors.disturbance[:core] / gain
    c, d = -errors.fault_output[0][:, :core], errors.fault_output[2] / gain
    best, spare = np.eye(core), None
    # For many states one Riccati solution of an enlarged system is usually enough, and takes a fifth of the time.
    for more, noise in ROOMS if core >= FEWEST_STATES and 0 < len(c) <= b.shape[1] else ():
        factor = _with_room(a, b, c, d, 1.0 + more, noise)
        if factor is None:
            continue
        if prove_bounded_real(plant, observer, tracking, factor, gain).in_double_precision:
            return factor, True
    for change in islice(_changes(a, b, c, d), tries):
        inverse = np.asarray(np.linalg.inv(change))
        moved_a, moved_b, moved_c = inverse @ a @ change, inverse @ b, c @ change
        weight = max(1.0, largest_singular_value(moved_c) ** 2)
        for slack in FILTER_SLACKS:
            p = bounded_real_matrix(moved_a, moved_b, moved_c, d, 1.0, slack=slack * weight)
            if p is None:
                continue
            best = np.asarray(np.triu(np.linalg.qr(np.asarray(np.linalg.cholesky(p)).T @ inverse, mode="r")))
            proof = prove_bounded_real(plant, observer, tracking, best, gain)
            if proof.in_double_precision:
                return best, True
            spare = best if proof.proved and spare is None else spare
    return (best, False) if spare is None else (spare, True)


def _with_room(
    a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, more: float, noise: float
) -> FloatArray | None:
    """Return an upper triangular Q from the dual Riccati equation of an enlarged system; ``None`` where it has none.

    If ``Y = A Y A' + B B' + r I + (A Y C' + B D')(I - D D' - C Y C')^-1 (.)'``, then P = Y^-1 satisfies the bounded
    real inequality with a slack that grows with r.  A and B are enlarged by the factor ``more``, so that the slack is
    a share of P in each direction, even for slow states.  For systems with at most as many outputs as inputs.
    """
    scale = state_units(a, b, c)
    a, b, c = a * scale / scale[:, None], b / scale[:, None], c * scale
    y = bounded_real_matrix(more * a.T, c.T, more * b.T, d.T, 1.0, slack=noise * largest_singular_value(b) ** 2)
    if y is None:
        return None
    # From the last state to the first: Y = U U', U upper triangular.
    factor, failed = lapack.dpotrf(y[::-1, ::-1], lower=1, clean=1)
    inverse, singular = (factor, failed) if failed else lapack.dtrtri(factor, lower=1)
    return None if singular else np.asarray(inverse[::-1, ::-1] / scale)


def _changes(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> Iterator[FloatArray]:
    """Yield changes of state in which a Riccati solution may be a proof in double precision, the cheapest first."""
    for begin in (_balanced, _contracted, _unchanged):
        start = begin(a, b, c)
        inverse = np.asarray(np.linalg.inv(start))
        moved = (inverse @ a @ start, inverse @ b, c @ start)
        for path, tail in product(APPROACHES, TAIL_WEIGHTS):
            change = _coordinates(*moved, d, path=path, tail=tail)
            if change is not None:
                yield start @ change


def _balanced(a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    """Return a diagonal change of state, by powers of two, that balances the units of the states."""
    return np.diag(state_units(a, b, c))


def _unchanged(a: FloatArray, _b: FloatArray, _c: FloatArray) -> FloatArray:
    """Return the identity: its other rounding errors may allow a proof at the limit of double precision."""
    return np.eye(a.shape[0])


def _contracted(a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    """Return a change of state in which the norm of ``a`` is about one, where it is far above the spectral radius.

    In coordinates in which the Lyapunov matrix of ``a / s`` is the identity the norm of ``a`` is below s.  The level
    s is lowered in steps, so that each change is well conditioned.
    """
    change, identity = _balanced(a, b, c), np.eye(a.shape[0])
    moved = np.linalg.solve(change, a @ change)
    norm = largest_singular_value(moved)
    for _ in range(MOST_CONTRACTIONS):
        level = max(min(0.5 * norm, norm**STEP_POWER), 1.0)
        p = output_covariance(moved.T / level, identity, identity, np.zeros_like(a))  # the sum of A'^k A^k
        if norm <= CONTRACTED_NORM or not np.all(np.isfinite(p)):
            break
        change = change @ normalising_change(p)
        moved = np.linalg.solve(change, a @ change)
        norm = largest_singular_value(moved)
    return change


def _coordinates(
    a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, *, path: tuple[float, ...], tail: float
) -> FloatArray | None:
    """Return a change of state in which an approximate Riccati solution is the identity.

    The levels of ``path`` are solved one after the other, each in the coordinates of the one before; ``None`` where
    one has no solution.  ``tail`` is the weight of all states, which conditions those that the output does not show.
    """
    change = np.eye(a.shape[0])
    for level in path:
        inverse = np.asarray(np.linalg.inv(change))
        output_map = c @ change
        size = max(largest_singular_value(output_map) ** 2, np.finfo(np.float64).tiny)
        p = bounded_real_matrix(inverse @ a @ change, inverse @ b, output_map, d, level, slack=tail * size)
        if p is None:
            return None
        change = change @ normalising_change(p)
    return change
