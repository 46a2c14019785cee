"""Output-nulling pairs (x, d), ``C x + D d = 0``, and the states that they reach: ``A x + B d`` whatever the gains.

Two kinds of states decide about the gain of a filter: those reached from rest, and those that grow with zero outputs
(zeros from d outside the unit circle).
"""

from __future__ import annotations

import numpy as np

from obsynth.numerics.arrays import FloatArray, largest_singular_value
from obsynth.numerics.injection_problem import GainProblem
from obsynth.numerics.matrix_equations import lyapunov_solution
from obsynth.numerics.ranks import RANK_TOLERANCE

#: An invariant zero must have a modulus above one by this much to count as growing.
GROWTH_MARGIN = 1e-6


def _rank(values: FloatArray) -> int:
    """Return how many singular values, largest first, count; data are normalised, so that one is a natural size."""
    return int(np.sum(values > RANK_TOLERANCE * max(1.0, float(values[0])))) if values.size else 0


def null_space(matrix: FloatArray) -> FloatArray:
    """Return an orthonormal null basis of a matrix of any rank."""
    _, values, right = np.linalg.svd(matrix)
    return np.asarray(right[_rank(values) :].T)


def range_space(matrix: FloatArray) -> FloatArray:
    """Return an orthonormal basis of the range."""
    left_vectors, values, _ = np.linalg.svd(matrix, full_matrices=False)
    return np.asarray(left_vectors[:, : _rank(values)])


def invisible_pairs(problem: GainProblem) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the states, the disturbances and the next states of a basis of the output-nulling pairs."""
    basis = null_space(np.hstack([problem.C, problem.D]))
    return basis[: problem.order], basis[problem.order :], np.hstack([problem.A, problem.B]) @ basis


def reached_from_rest(top: FloatArray, image: FloatArray) -> FloatArray:
    """Return a basis of the least subspace with the next state of each output-nulling pair whose state is in it."""
    subspace = np.zeros((top.shape[0], 0))
    while True:
        pairs = null_space(np.hstack([top, -subspace]))[: top.shape[1]]
        larger = range_space(np.hstack([subspace, image @ pairs]))
        if larger.shape[1] == subspace.shape[1]:
            return subspace
        subspace = larger


def growing_states(top: FloatArray, image: FloatArray, reached: FloatArray) -> FloatArray:
    """Return the states, outside of those reached from rest, that grow invisibly."""
    from scipy.linalg import schur

    outside = null_space(reached.T) if reached.shape[1] else np.eye(top.shape[0])
    pairs = range_space((outside.T @ top).T)  # one pair for each state outside; the other pairs stay inside
    while True:
        states, following = outside.T @ top @ pairs, outside.T @ image @ pairs
        inverse = np.linalg.pinv(states)
        further = null_space(following - states @ inverse @ following)
        if further.shape[1] == pairs.shape[1]:
            break
        pairs = pairs @ further
    if pairs.shape[1] == 0:
        return np.zeros((top.shape[0], 0))
    _, vectors, count = schur(
        inverse @ following, output="real", sort=lambda re, im: np.hypot(re, im) > 1.0 + GROWTH_MARGIN
    )
    return np.asarray(top @ pairs @ vectors[:, :count])


def strict_point(top: FloatArray, image: FloatArray) -> FloatArray:
    """Return ``Z1 > 0`` with ``image Z1 image' - top Z1 top' > 0``, from pairs of all kinds."""
    n, size = top.shape
    # Sequences from rest of every length, summed up: half of what is reached goes on unseen, the other half is slack.
    point, reached = np.zeros((size, size)), np.zeros((n, 0))
    for _ in range(n + 1):
        unseen = null_space(np.hstack([top, -reached]))[:size]
        point = point + 0.5 * unseen @ unseen.T
        left_vectors, values, _ = np.linalg.svd(image @ unseen * np.sqrt(0.5), full_matrices=False)
        rank = _rank(values)
        reached = left_vectors[:, :rank] * values[:rank]
    point, reached = 0.5 * (point + point.T), range_space(reached)
    outside = null_space(reached.T) if reached.shape[1] else np.eye(top.shape[0])
    if outside.shape[1] == 0:
        return point
    # Pairs on the growing states, and as many from rest as make up for what those do to the reached states.
    pairs = np.linalg.pinv(outside.T @ top)
    back = np.linalg.inv(outside.T @ image @ pairs)
    grown = lyapunov_solution(back.T, back @ back.T)
    if grown is None or not np.all(np.isfinite(grown)):
        raise np.linalg.LinAlgError("the growing states are too close to the boundary")
    growing = pairs @ grown @ pairs.T
    if reached.shape[1] == 0:
        return np.asarray(growing)
    slack = [image @ item @ image.T - top @ item @ top.T for item in (point, growing)]
    inside = float(np.linalg.eigvalsh(reached.T @ slack[0] @ reached)[0])
    # On the growing states the slack is the identity, so this Schur complement is all there is to fear.
    spoilt = largest_singular_value(reached.T @ slack[1] @ reached)
    spoilt += largest_singular_value(reached.T @ slack[1] @ outside) ** 2
    return np.asarray((1.0 + spoilt / inside) * point + growing)
