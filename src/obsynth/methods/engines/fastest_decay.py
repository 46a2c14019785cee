r"""The fastest decay that inequalities at vertices allow, by Dinkelbach's iteration in place of a bisection.

At a Lyapunov matrix :math:`P_k` the fastest decay is a generalised eigenvalue.  The next problem maximises at that
decay the slack of the decay's inequality, in multiples of :math:`P_k`; its solution allows a faster one, or none does.

Reference: J.-P. Crouzeix, J. A. Ferland, S. Schaible, J. Optim. Theory Appl. 47 (1985).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.proofs.vertex_inequalities import Witness
from obsynth.verification.error_polytope import ErrorPolytope

#: Where the iteration ends at the latest; on random regions it took two to nine solutions.
MOST_STEPS = 12
#: Relative progress, of a rate or of the distance of a factor to one, at which it ends: it converges faster than
#: linearly, so that what is missing is less.
PROGRESS = 1e-3


def fastest_of(errors: ErrorPolytope, gains: Sequence[FloatArray], witness: Witness) -> float | None:
    """Return the fastest decay that Lyapunov matrices allow, in floating point; ``None`` where they allow none.

    A factor a sample in discrete time, else a rate in 1/s; not for remainders beside A.
    """
    if errors.ball:
        return None
    reached = []
    for now, then in witness.pairs_of(errors.count):
        M = errors.at(now, gains)[0]
        P, after = _mean(witness.P, now), _mean(witness.P, then)
        G = P if witness.G is None else _mean(witness.G, now)
        if errors.dt > 0.0:
            low = G + G.T - after
            crossed = G.T @ M
            squared = _largest(crossed.T @ np.linalg.solve(low, crossed), P)
            reached.append(None if squared is None else -float(np.sqrt(max(squared, 0.0))))
        else:
            flow = -(G.T @ M + M.T @ G)
            # flow - 2 a P stays positive definite until a is half the inverse of the largest eigenvalue of (P, flow).
            largest = _largest(P, flow)
            reached.append(None if largest is None or largest <= 0.0 else 0.5 / largest)
    if any(each is None for each in reached):
        return None
    least = min(each for each in reached if each is not None)
    return -least if errors.dt > 0.0 else least


def _largest(above: FloatArray, below: FloatArray) -> float | None:
    """Return the largest generalised eigenvalue of symmetric matrices; ``None`` where the second is not definite."""
    from scipy.linalg import eigh

    try:
        return float(eigh(0.5 * (above + above.T), 0.5 * (below + below.T), eigvals_only=True)[-1])
    except (np.linalg.LinAlgError, ValueError):
        return None


def faster(
    solved: Callable[[float, Any], tuple[float, Any] | None], rate: float, metric: Any, *, discrete: bool
) -> tuple[float, Any]:
    """Return the fastest decay that is reached, and the solution that reaches it.

    Parameters
    ----------
    solved : callable
        Of a decay and an earlier solution; it returns the decay that its own solution reaches, and this; ``None``
        where there is none.
    rate : float
        That of a first solution.
    metric : any
        The first solution.
    discrete : bool
        Whether decays are factors: the smaller the better.
    """
    for _ in range(MOST_STEPS):
        made = solved(rate, metric)
        if made is None:
            return rate, metric
        gained = rate - made[0] if discrete else made[0] - rate
        if gained <= 0.0:
            return rate, metric
        size = max(1.0 - rate, PROGRESS) if discrete else max(rate, PROGRESS)
        rate, metric = made
        if gained <= PROGRESS * size:
            break
    return rate, metric


def _mean(parts: Sequence[FloatArray], weights: FloatArray) -> FloatArray:
    if len(parts) == 1:
        return np.asarray(parts[0])
    return np.asarray(sum(weight * part for weight, part in zip(weights, parts, strict=True)))
