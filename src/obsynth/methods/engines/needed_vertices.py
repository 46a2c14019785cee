"""Problems with many vertices in continuous time, solved at those that bind: a cutting-plane method.

With one Lyapunov matrix and one gain every vertex is an inequality in the same variables, and few of them bind.  A
problem is solved at some vertices; where its solution fails at others, the worst of these join, until it holds at all.
The least level at some vertices is no larger than that at all of them: a claim loses nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from obsynth.methods.engines.fastest_decay import PROGRESS, fastest_allowed_decay
from obsynth.methods.engines.vertex_certificates import VertexCertificate
from obsynth.numerics.arrays import FloatArray
from obsynth.proofs.balls import Ball
from obsynth.proofs.vertex_inequalities import Vertex, Witness, prove_decay, prove_gain, prove_mean_square
from obsynth.verification.error_polytope import ErrorPolytope

#: Up to so many vertices are taken at once: the solver needs seconds for these, and choosing saves little.
MOST_AT_ONCE = 32
#: Vertices at first, and the most that join in a round.
FIRST, JOINING = 16, 16
_PARTS = ("A", "B", "C", "D", "Cz", "Dz")
Solution = TypeVar("Solution")


def solved_at_needed(
    errors: ErrorPolytope,
    solve: Callable[[ErrorPolytope], Solution],
    lack: Callable[[Solution], Sequence[float]],
    progress: Callable[[str], None],
) -> Solution:
    """Return a solution that holds at every vertex, of a problem at some of them.

    Parameters
    ----------
    errors : ErrorPolytope
        All vertices.
    solve : callable
        Takes some of the vertices and returns a solution.
    lack : callable
        Takes a solution and returns by how much it fails at every vertex: above zero where it does.
    progress : callable
        Takes a sentence on each round.
    """
    if errors.count <= MOST_AT_ONCE:
        return solve(errors)
    used = _far_apart(errors)
    while True:
        progress(f"solving the inequalities at {len(used)} of {errors.count} corners")
        solution = solve(_some(errors, used))
        lacking = np.asarray(lack(solution))
        joining = [i for i in map(int, np.argsort(-lacking)) if lacking[i] > 0.0 and i not in used][:JOINING]
        if not joining:
            return solution
        used = sorted({*used, *joining})


def lack_of_level(errors: ErrorPolytope, made: VertexCertificate, goal: str, decay: float | None) -> list[float]:
    """Return by how much a certificate of a level (and a decay) fails at every vertex, in floating point; 0 where it is
    proved."""
    prover = prove_gain if goal == "gain" else prove_mean_square
    lacking = []
    for vertex in errors.closed(made.gains):
        proved = prover([vertex], made.witness, made.level, discrete=False).proved
        if proved and decay is not None:
            proved = prove_decay([vertex], made.witness, decay, discrete=False).proved
        # Where only rounding is between a vertex and its proof it joins, too.
        least = float(np.finfo(np.float64).tiny)
        lacking.append(0.0 if proved else max(_excess(vertex, made.witness, made.level, goal), least))
    return lacking


def lack_of_decay(errors: ErrorPolytope, rate: float, witness: Witness, gains: Sequence[FloatArray]) -> list[float]:
    """Return by how much the decay that a certificate allows is slower than ``rate`` at every vertex."""
    allowed = [fastest_allowed_decay(_some(errors, [i]), gains, witness) for i in range(errors.count)]
    return [np.inf if each is None else (1.0 - PROGRESS) * rate - each for each in allowed]


def _excess(vertex: Vertex, witness: Witness, level: float, goal: str) -> float:
    """Return the largest eigenvalue of what has to be negative, or the mean square above the level."""
    M, B, Cz, _ = (part.midpoint for part in vertex(Ball))
    P, G = witness.P[0], witness.P[0] if witness.G is None else witness.G[0]
    flow, driven = G.T @ M + M.T @ G + Cz.T @ Cz, G.T @ B
    if goal == "gain":
        flow = flow + driven @ driven.T / level**2
    largest = float(np.linalg.eigvalsh(flow)[-1])
    return largest if goal == "gain" else max(largest, float(np.trace(B.T @ P @ B)) - level**2)


def _far_apart(errors: ErrorPolytope) -> list[int]:
    """Return the first vertices: each is the farthest from those before it."""
    points = np.array([np.concatenate([a.ravel(), c.ravel()]) for a, c in zip(errors.A, errors.C, strict=True)])
    used, distance = [0], np.full(len(points), np.inf)
    while len(used) < FIRST:
        distance = np.minimum(distance, np.linalg.norm(points - points[used[-1]], axis=1))
        used.append(int(np.argmax(distance)))
    return sorted(set(used))


def _some(errors: ErrorPolytope, used: Sequence[int]) -> ErrorPolytope:
    parts: dict[str, Any] = {name: [getattr(errors, name)[i] for i in used] for name in _PARTS}
    return replace(errors, **parts)
