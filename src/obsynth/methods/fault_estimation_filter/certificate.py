"""Finding a certificate for gains in hand: a Lyapunov matrix with which the shipped inequality can be proved."""

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

#: Levels, relative to the claimed one, at which coordinates are improved on the way to it.
APPROACHES = ((1.05,), (1.5, 1.05, 1.001))

#: Weights of what the output does not show, relative to the output's, tried in turn.
TAIL_WEIGHTS = (1e-2, 1e-4, 1e-6, 1e-9, 1e-12, 1e-16, 1e-20)

#: Slack of the Riccati equation relative to the output weight, largest first: the first that proves is taken.
FILTER_SLACKS = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10)

#: What A and B are enlarged by, and noise on every state besides the disturbance, squared, as a share of that, which
#: keeps states that it hardly moves from getting lost: most first.  The first leaves a hundred times the rounding of
#: matrices of order 2,000; that one exceeds the level shows in part of a solution.
ROOMS = ((1e-4, 1e-7), (1e-5, 1e-8))

#: Steps towards coordinates in which the norm of the error dynamics is near one: how many, and down to which power.
MOST_CONTRACTIONS = 60

STEP_POWER = 0.75

GAMMA_ABOVE_ONE = 1.05


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
    """Return Q ``(core, core)``, upper triangular with P = Q'Q, at level ``gain``, and whether it proves.

    The Riccati solution with the largest slack that does, else the last try; at most ``tries`` coordinates are tried.
    """
    errors = ErrorModel(plant, observer, tracking, lag=lag)
    a, b = observer.Az[:core, :core], errors.disturbance[:core] / gain
    c, d = -errors.fault_output[0][:, :core], errors.fault_output[2] / gain
    best, spare = np.eye(core), None
    # Of many states, one solution without other coordinates has room enough, and takes a fifth of the time.
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
    """Return Q, upper triangular, from the transposed system with noise on every state; of no more outputs than inputs.

    Where ``Y = A Y A' + B B' + r I + (A Y C' + B D')(I - D D' - C Y C')^-1 (.)'``, the inverse of Y is a P of the
    bounded real inequality, as strictly as r is large.  With A and B ``more`` times as large it has a share of each
    direction's own size left, however slow the states are.
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
    """Yield state changes in which a Riccati solution may prove something, the cheapest first."""
    for begin in (_balanced, _contracted, _unchanged):
        start = begin(a, b, c)
        inverse = np.asarray(np.linalg.inv(start))
        moved = (inverse @ a @ start, inverse @ b, c @ start)
        for path, tail in product(APPROACHES, TAIL_WEIGHTS):
            change = _coordinates(*moved, d, path=path, tail=tail)
            if change is not None:
                yield start @ change


def _balanced(a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    """Return a diagonal state change, powers of two, in which units cost no digits."""
    return np.diag(state_units(a, b, c))


def _unchanged(a: FloatArray, _b: FloatArray, _c: FloatArray) -> FloatArray:
    """Return no change: at the edge of what can be proved in double precision, other rounding errors may do."""
    return np.eye(a.shape[0])


def _contracted(a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    """Return a state change in which the norm of ``a``, far above its spectral radius, is at most about one.

    Where the Lyapunov matrix of ``a / s`` is the identity it is below s; s shrinks in steps, each well conditioned.
    """
    change, identity = _balanced(a, b, c), np.eye(a.shape[0])
    moved = np.linalg.solve(change, a @ change)
    norm = largest_singular_value(moved)
    for _ in range(MOST_CONTRACTIONS):
        level = max(min(0.5 * norm, norm**STEP_POWER), 1.0)
        p = output_covariance(moved.T / level, identity, identity, np.zeros_like(a))  # the sum of A'^k A^k
        if norm <= GAMMA_ABOVE_ONE or not np.all(np.isfinite(p)):
            break
        change = change @ normalising_change(p)
        moved = np.linalg.solve(change, a @ change)
        norm = largest_singular_value(moved)
    return change


def _coordinates(
    a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, *, path: tuple[float, ...], tail: float
) -> FloatArray | None:
    """Return a change in which a rough Riccati solution is the identity, over the levels of ``path``; else ``None``.

    ``tail`` weighs states that the output does not show: as much as possible, short of what d does to them.
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
