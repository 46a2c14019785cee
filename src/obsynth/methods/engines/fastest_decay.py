r"""The fastest decay that inequalities at vertices allow, by Dinkelbach's iteration in place of a bisection.

For a Lyapunov matrix :math:`P_k` the fastest decay is a generalised eigenvalue.  The next problem fixes that decay and
maximises the slack of its inequality, in multiples of :math:`P_k`.  Its solution :math:`P_{k+1}` allows a faster decay
unless no matrix does.

Reference: J.-P. Crouzeix, J. A. Ferland, S. Schaible, J. Optim. Theory Appl. 47 (1985).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.gain_levels import is_positive
from obsynth.proofs.vertex_inequalities import Witness
from obsynth.verification.error_polytope import ErrorPolytope

#: Largest number of steps; on random regions the iteration took two to nine.
MOST_STEPS = 12
#: The next step tries a decay that is faster than the last one by this multiple of the last progress.  Without it the
#: iteration creeps where the best P is nearly singular.  Its solution reaches some decay even if its slack is negative.
OVERSHOOT = 0.5
#: The iteration ends at this progress, relative to a rate or to the distance of a factor to one.  It converges faster
#: than linearly, so that far less is missing (3e-6 on random regions, in a quarter less time than with 3e-4).
PROGRESS = 3e-3
#: Shipped gains are slower than the fastest by these shares of a rate, or of the distance of a factor to one: at the
#: fastest decay P is nearly singular, and gains are as large as its inverse.
MARGINS = (2e-3, 0.02, 0.1, 0.3)


def fastest_allowed_decay(errors: ErrorPolytope, gains: Sequence[FloatArray], witness: Witness) -> float | None:
    """Return the fastest decay that given Lyapunov matrices allow, in floating point; ``None`` where they allow none.

    The decay is a factor per sample in discrete time, and a rate in 1/s in continuous time.
    """
    t = witness.multiplier
    if errors.ball and not t > 0.0:
        return None
    reached = []
    for now, then in witness.pairs_of(errors.count):
        M = errors.at(now, gains)[0]
        P, after = _mean(witness.P, now), _mean(witness.P, then)
        G = P if witness.G is None else _mean(witness.G, now)
        if errors.dt > 0.0:
            crossed, low, rest = G.T @ M, G + G.T - after, 0.0 * P
            if errors.ball:
                low, rest = low - G.T @ G / t, errors.ball**2 * t * np.eye(len(P))
            squared = _largest(rest + crossed.T @ np.linalg.solve(low, crossed), P) if is_positive(low) else None
            reached.append(None if squared is None else -float(np.sqrt(max(squared, 0.0))))
        else:
            flow = -(G.T @ M + M.T @ G)
            if errors.ball:
                flow = flow - errors.ball**2 * t * np.eye(len(P)) - P @ P / t
            reached.append(fastest_rate(flow, P))
    if any(each is None for each in reached):
        return None
    least = min(each for each in reached if each is not None)
    return -least if errors.dt > 0.0 else least


def fastest_rate(flow: FloatArray, P: FloatArray) -> float | None:
    """Return the largest a with ``flow - 2 a P`` positive semidefinite; ``None`` where ``flow`` is not definite."""
    largest = _largest(P, flow)
    return None if largest is None or largest <= 0.0 else 0.5 / largest


def _largest(above: FloatArray, below: FloatArray) -> float | None:
    """Return the largest generalised eigenvalue of symmetric matrices; ``None`` where the second is not definite."""
    from scipy.linalg import eigh

    try:
        return float(eigh(0.5 * (above + above.T), 0.5 * (below + below.T), eigvals_only=True)[-1])
    except (np.linalg.LinAlgError, ValueError):
        return None


def improved_decays(
    solved: Callable[[float, Any], tuple[float, Any] | None], rate: float, metric: Any, *, discrete: bool
) -> list[tuple[float, Any]]:
    """Return pairs of a decay and the solution that reaches it, each faster than the one before.

    Parameters
    ----------
    solved : callable
        Takes a decay and an earlier solution, solves the problem at that decay, and returns the decay that the new
        solution reaches with this solution; ``None`` where the solver finds none.
    rate : float
        The decay that a first solution reaches.
    metric : any
        The first solution.
    discrete : bool
        Whether decays are factors per sample, where smaller is faster.
    """
    reached, beyond = [(rate, metric)], 0.0
    for _ in range(MOST_STEPS):
        rate, metric = reached[-1]
        made = solved(max(rate - beyond, 0.0) if discrete else rate + beyond, metric)
        gained = 0.0 if made is None else rate - made[0] if discrete else made[0] - rate
        if made is not None and gained > 0.0:
            reached.append(made)
        if gained > PROGRESS * max(1.0 - rate if discrete else rate, PROGRESS):
            beyond = OVERSHOOT * gained
        elif beyond:
            beyond = 0.0
        else:
            break
    return reached


def slower_decays(fastest: float, shares: Sequence[float], slowest: float | None) -> list[float]:
    """Return decays that are slower by given shares of the way to ``slowest``.

    ``slowest`` is a factor per sample; ``None`` means rates, for which the slowest is zero.
    """
    if slowest is None:
        return [fastest * (1.0 - share) for share in shares]
    return [fastest + share * (slowest - fastest) for share in shares]


def _mean(parts: Sequence[FloatArray], weights: FloatArray) -> FloatArray:
    """Return the weighted mean of matrices; a single matrix counts for all vertices."""
    if len(parts) == 1:
        return np.asarray(parts[0])
    return np.asarray(sum(weight * part for weight, part in zip(weights, parts, strict=True)))
