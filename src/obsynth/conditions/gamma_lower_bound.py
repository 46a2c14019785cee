"""Lower bounds on the gain of every filter, from dual points of the inequalities that pass our own check.

No gain has an effect on the output-nulling pairs (`obsynth.numerics.output_nulling`): the dual variables weight them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from obsynth.conditions import lazy_cvxpy as cp
from obsynth.conditions import lmi
from obsynth.errors import SolverError
from obsynth.numerics.arrays import FloatArray, largest_singular_value
from obsynth.numerics.injection_problem import GainProblem, Injection, NormalisedProblem, normalise
from obsynth.numerics.output_nulling import (
    growing_states,
    invisible_pairs,
    null_space,
    range_space,
    reached_from_rest,
    strict_point,
)
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.rational_matrices import nearest_doubles
from obsynth.verification.least_gain_proof import (
    ALONE,
    LAST,
    LEAST_GAIN_PAIRS,
    MOST_EXAMINED_STATES,
    PROVED_SHARE,
    InvisiblePairs,
)

#: A dual point must be positive definite by this margin, where the point of `strict_point` is the identity, and beat
#: the level by this relative one.
DUAL_MARGIN = 1e-8

BOUND_MARGIN = 1e-6

#: Disturbances smaller than these, relative to the largest, may be left out of the proof.
NEGLIGIBLE_DISTURBANCES = (1e-3, 3e-2)

#: Errors that invisible disturbances reach from rest: with more of them the inequalities take seconds.
MOST_REACHED = 24

#: Where two steps show less than this share of the gain in double precision, they prove nothing exactly either.
PROMISING_SHARE = 0.99

#: Filters of so many states are examined in any case: exact null spaces cost next to nothing there.
CHEAP_STATES = 8

#: Runs from rest have at most so many unknowns, and are long enough when less than this share of the gain is missing.
MOST_RUN_UNKNOWNS = 96

LONG_ENOUGH = 1e-5

_BOUND_PARTS = ("S", "top", "bottom", "image", "shown", "Z", "Zd")


def proved_lower_bound(
    problem: GainProblem, *, solver: str, best: Injection | None = None, enough: float = np.inf
) -> float:
    """Return a lower bound on the gain of every filter, from a dual point that passes our own check; 0 without one.

    For ``Z1 >= 0`` in the null basis N of [C D] with ``Q = G N Z1 N'G' - Nx Z1 Nx' >= 0`` and, for a fixed weight, ``Z2
    = [Q, *; *, *] >= 0``, ``g^2 (tr Nd Z1 Nd' + tr Z2_22) > tr H N Z1 N'H' + tr H Z2 H'``: the eliminated inequalities
    times Z1, Z2.
    """
    bound = 0.0
    for work, start in product(_with_fewer_disturbances(problem), (None,) if best is None else (None, best)):
        bound = max(bound, _bound_in(normalise(work, start=start), solver))
        if bound > enough:
            break
    return bound


def _with_fewer_disturbances(problem: GainProblem) -> Iterator[GainProblem]:
    """Yield the problem, and the problem without small disturbances: a gain for fewer of them is not larger."""
    yield problem
    sizes = np.linalg.norm(np.vstack([problem.B, problem.D, problem.Zd]), axis=0)
    count = len(sizes)
    for share in NEGLIGIBLE_DISTURBANCES:
        large = sizes > share * np.max(sizes, initial=0.0)
        if 0 < np.sum(large) < count:
            count = int(np.sum(large))
            yield replace(problem, B=problem.B[:, large], D=problem.D[:, large], Zd=problem.Zd[:, large])


def _bound_in(normalised: NormalisedProblem, solver: str) -> float:
    # On the states that matter: outside the dual inequalities have no strict solution.
    full = normalised.problem
    top, _, image = invisible_pairs(full)
    reached = reached_from_rest(top, image)
    subspace = range_space(np.hstack([reached, growing_states(top, image, reached)]))
    t = subspace.T
    work = replace(
        full,
        A=t @ full.A @ subspace,
        C=full.C @ subspace,
        Z=full.Z @ subspace,
        B=t @ full.B,
        Bn=t @ full.Bn,
    )
    if work.disturbances == 0:
        return 0.0
    if work.order == 0:
        direct = work.Zd @ null_space(work.D) if work.weight_is_free else work.Zd
        return normalised.gain * largest_singular_value(direct) * (1.0 - BOUND_MARGIN)
    try:
        dual = _DualProblem.of(work)
        point = _best_dual_point(dual, solver=solver)
    except (SolverError, np.linalg.LinAlgError):
        return 0.0
    return normalised.gain * _checked_bound(dual, *point)


@dataclass(frozen=True, eq=False)
class _DualProblem:
    """Dual inequalities, ``Q = image Z1 image' - top Z1 top'``, where a strictly feasible point is near the identity.

    ``errors``, ``bottom``: xi and d on the output-nulling directions; ``outputs``: xi on states and disturbance.
    """

    top: FloatArray
    bottom: FloatArray
    image: FloatArray
    errors: FloatArray
    outputs: FloatArray
    free_weight: bool

    @classmethod
    def of(cls, work: GainProblem) -> _DualProblem:
        return cls.on(*invisible_pairs(work), work.Z, work.Zd, work.weight_is_free)[0]

    @classmethod
    def on(
        cls, top: FloatArray, bottom: FloatArray, image: FloatArray, z: FloatArray, zd: FloatArray, free_weight: bool
    ) -> tuple[_DualProblem, FloatArray, FloatArray]:
        """Return the problem on given pairs, and the factors of its coordinates of pairs and of states."""
        point = strict_point(top, image)
        slack = image @ point @ image.T - top @ point @ top.T
        invisible, states = np.linalg.cholesky(point), np.linalg.cholesky(0.5 * (slack + slack.T))
        back, outputs = np.linalg.inv(states), np.hstack([z @ states, zd])
        errors = (z @ top + zd @ bottom) @ invisible
        moved = (back @ top @ invisible, bottom @ invisible, back @ image @ invisible)
        return cls(*moved, errors, outputs, free_weight), np.asarray(invisible), np.asarray(states)


def _best_dual_point(dual: _DualProblem, *, solver: str) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return ``Z1``, and corner and last block of ``Z2``, that maximise what is shown at disturbance energy one."""
    (n, size), nd = dual.top.shape, dual.bottom.shape[0]
    z1 = lmi.symmetric_variable(size)
    q = dual.image @ z1 @ dual.image.T - dual.top @ z1 @ dual.top.T
    error_energy = cp.trace(dual.errors @ z1 @ dual.errors.T)
    energy = cp.trace(dual.bottom @ z1 @ dual.bottom.T)
    second, corner, last = q, np.zeros((nd, n)), np.zeros((nd, nd))
    if not dual.free_weight:
        corner, last = lmi.matrix_variable(nd, n), lmi.symmetric_variable(nd)
        second = lmi.symmetric_blocks([[q], [corner, last]])
        error_energy, energy = error_energy + cp.trace(dual.outputs @ second @ dual.outputs.T), energy + cp.trace(last)
    constraints = [
        lmi.at_least(z1, DUAL_MARGIN * 2),
        lmi.at_least(second, DUAL_MARGIN * 2),
        lmi.at_most(cp.reshape(energy, (1, 1), order="C"), 1.0),
    ]
    lmi.minimise(-error_energy, constraints, what="lower bound on the gain", solver=solver)
    return lmi.value_of(z1), lmi.value_of(corner), lmi.value_of(last)


def _checked_bound(dual: _DualProblem, z1: FloatArray, corner: FloatArray, last: FloatArray) -> float:
    """Recompute the bound of a dual point from the data; 0 unless it is strictly feasible.

    What the solver left short of that is made up for by a little of the strict point, the identity.
    """
    z1, last = 0.5 * (z1 + z1.T), 0.5 * (last + last.T)
    short = 0.0
    for _ in range(2):
        z1, last = z1 + short * np.eye(len(z1)), last + short * np.eye(len(last))
        q = dual.image @ z1 @ dual.image.T - dual.top @ z1 @ dual.top.T
        second = q if dual.free_weight else np.block([[q, corner.T], [corner, last]])
        second = 0.5 * (second + second.T)
        least = min(float(np.linalg.eigvalsh(matrix)[0]) for matrix in (z1, second) if matrix.size)
        short = max(0.0, 2.0 * DUAL_MARGIN - least)
    if least < DUAL_MARGIN:
        return 0.0
    error_energy = float(np.trace(dual.errors @ z1 @ dual.errors.T))
    energy = float(np.trace(dual.bottom @ z1 @ dual.bottom.T))
    if not dual.free_weight:
        error_energy += float(np.trace(dual.outputs @ second @ dual.outputs.T))
        energy += float(np.trace(last))
    return float(np.sqrt(max(error_energy, 0.0) / energy)) * (1.0 - BOUND_MARGIN) if energy > 0.0 else 0.0


def least_gain_certificate(
    problem: GainProblem,
    work: DescriptorSystem,
    gains: Mapping[str, FloatArray],
    factor: FloatArray,
    *,
    gain: float,
    free_weight: bool,
    solver: str,
    thorough: bool,
) -> tuple[dict[str, FloatArray], float]:
    """Return a proof that no such filter has a gain below ``gain``, and what it proves; else none.

    ``factor (n, n)`` maps errors to coordinates in which they are of natural sizes.  What is not thorough is tried
    where it costs little, and takes no semidefinite solver.  ``free_weight``: of all W, though the search may have
    ended in a problem with a fixed one.
    """
    if _is_hopeless(problem, gain, thorough=thorough):
        return {}, 0.0
    pairs = InvisiblePairs.of(work, gains)
    if pairs is None:
        return {}, 0.0
    s, top, bottom, image, errors, z, zd = (nearest_doubles(getattr(pairs, name)) for name in _BOUND_PARTS)
    # Orthonormal coordinates: of the errors in the given sizes, of the pairs as they come.
    back = np.linalg.pinv(np.linalg.qr(factor @ s, mode="r")) if s.shape[1] else np.zeros((0, 0))
    stacked = np.vstack([np.linalg.pinv(back) @ top, bottom]) if s.shape[1] else bottom
    turn = np.linalg.pinv(np.linalg.qr(stacked, mode="r")) if stacked.shape[1] else np.zeros((0, 0))
    if not all(np.all(np.isfinite(part)) for part in (back, turn)):
        return {}, 0.0
    forth = np.linalg.pinv(back)
    moved = (forth @ top @ turn, bottom @ turn, forth @ image @ turn)
    attempts: list[Callable[[], tuple[FloatArray, FloatArray, FloatArray]]] = [
        lambda: _two_steps(*moved, errors @ turn, z @ back, zd, free_weight)
    ]
    if np.any(top):
        attempts.append(lambda: _mixture(*moved, z @ back, zd, free_weight, lambda dual: _best_run(dual, gain)))
        if thorough and s.shape[1] <= MOST_REACHED:
            attempts.append(
                lambda: _mixture(*moved, z @ back, zd, free_weight, lambda dual: _best_dual_point(dual, solver=solver))
            )
    best: dict[str, FloatArray] = {}
    least = 0.0
    for attempt in attempts:
        if least >= gain * (1.0 - PROVED_SHARE):
            break
        try:
            f, last, alone = attempt()
        except (SolverError, np.linalg.LinAlgError):
            continue
        made = {LEAST_GAIN_PAIRS: turn @ f, LAST: last @ forth, ALONE: alone}
        matrices = {name: matrix for name, matrix in made.items() if np.any(matrix)}
        bound = pairs.bound(matrices, free_weight=free_weight)
        if bound > least:
            best, least = matrices, bound
    return (best, least) if least >= gain * (1.0 - PROVED_SHARE) else ({}, 0.0)


def _is_hopeless(problem: GainProblem, gain: float, *, thorough: bool) -> bool:
    """Return whether two steps show too little in double precision, and more would cost much or is not tried."""
    if not (MOST_REACHED if thorough else CHEAP_STATES) < problem.order <= MOST_EXAMINED_STATES:
        return False
    top, bottom, image = invisible_pairs(problem)
    if thorough and reached_from_rest(top, image).shape[1] <= MOST_REACHED:
        return False
    _, two_steps = _first_two(top, bottom, image, problem.Z @ top + problem.Zd @ bottom, problem.Z, problem.Zd)
    most = two_steps[:, : two_steps.shape[1] - problem.Zd.shape[1]] if problem.weight_is_free else two_steps
    return not most.size or largest_singular_value(most) < PROMISING_SHARE * gain


def _best_run(dual: _DualProblem, enough: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return, as a dual point, the invisible run from rest, of some samples, that shows most for its energy.

    Where W is fixed one more disturbance follows it.  A longer run shows no less: it may begin with rest.
    """
    top, nd = dual.top, dual.bottom.shape[0]
    forth, starts = np.linalg.pinv(top), null_space(top)
    outside = null_space(top.T).T
    d = np.zeros((nd, 0)) if dual.free_weight else np.eye(nd)
    run = [starts]
    while True:
        width = run[0].shape[1]
        if width == 0:
            raise np.linalg.LinAlgError("every disturbance from zero initial state has an effect on the outputs")
        sizes = np.linalg.inv(np.linalg.qr(np.vstack([dual.bottom @ pair for pair in run]), mode="r"))
        run = [pair @ sizes for pair in run]
        blocks = [[dual.errors @ pair, np.zeros((len(dual.errors), d.shape[1]))] for pair in run]
        if not dual.free_weight:
            blocks.append([dual.outputs[:, : len(top)] @ dual.image @ run[-1], dual.outputs[:, len(top) :]])
        _, values, vectors = np.linalg.svd(np.block(blocks), full_matrices=False)
        ratio, strongest = float(values[0]), vectors[0]
        long_enough = ratio >= enough * (1.0 - LONG_ENOUGH)
        if long_enough or width + starts.shape[1] > MOST_RUN_UNKNOWNS or len(run) >= MOST_RUN_UNKNOWNS:
            break
        # Pairs that go on: what leads out of the states of all pairs is left out.
        further = null_space(outside @ dual.image @ run[-1]) if len(outside) else np.eye(width)
        run = [np.hstack([pair @ further, np.zeros((len(pair), starts.shape[1]))]) for pair in run]
        run.append(np.hstack([forth @ dual.image @ run[-1][:, : further.shape[1]], starts]))
    pairs = np.array([pair @ strongest[:width] for pair in run]).T
    reached, later = dual.image @ pairs[:, -1], strongest[width:] if d.size else np.zeros(nd)
    return pairs @ pairs.T, np.outer(later, reached), np.outer(later, later)


def _first_two(
    top: FloatArray, bottom: FloatArray, image: FloatArray, errors: FloatArray, z: FloatArray, zd: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the invisible pairs at rest in units of d, and what they (at once, then later) and one more d show."""
    starts = null_space(top) if top.shape[0] else np.eye(bottom.shape[1])
    sizes = np.linalg.pinv(np.linalg.qr(bottom @ starts, mode="r")) if starts.shape[1] else np.zeros((0, 0))
    starts = starts @ sizes
    first = errors @ starts
    return starts, np.block([[first, np.zeros((len(first), zd.shape[1]))], [z @ (image @ starts), zd]])


def _two_steps(
    top: FloatArray,
    bottom: FloatArray,
    image: FloatArray,
    errors: FloatArray,
    z: FloatArray,
    zd: FloatArray,
    free_weight: bool,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the best disturbance of one sample from rest that no gain sees, with one more where W is fixed."""
    starts, two_steps = _first_two(top, bottom, image, errors, z, zd)
    nd, s = zd.shape[1], top.shape[0]
    if free_weight:
        return starts @ _strongest(errors @ starts)[:, None], np.zeros((nd, s)), np.zeros((nd, 1))
    strongest = _strongest(two_steps)
    f, later = starts @ strongest[: starts.shape[1]], strongest[starts.shape[1] :]
    reached = image @ f
    size = float(reached @ reached)
    last = np.outer(later, reached) / size if size > 0.0 else np.zeros((nd, s))
    return f[:, None], last, np.zeros((nd, 1)) if size > 0.0 else later[:, None]


def _strongest(matrix: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.svd(matrix)[2][0]) if matrix.size else np.zeros(matrix.shape[1])


def _mixture(
    top: FloatArray,
    bottom: FloatArray,
    image: FloatArray,
    z: FloatArray,
    zd: FloatArray,
    free_weight: bool,
    best: Callable[[_DualProblem], tuple[FloatArray, FloatArray, FloatArray]],
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a mixture of pairs of all kinds that comes from a point of the dual inequalities."""
    dual, invisible, states = _DualProblem.on(top, bottom, image, z, zd, free_weight)
    z1, corner, last = best(dual)
    z1 = 0.5 * (z1 + z1.T) + DUAL_MARGIN * np.eye(len(z1))
    f = invisible @ np.linalg.cholesky(z1)
    nd, s = zd.shape[1], top.shape[0]
    if free_weight:
        return f, np.zeros((nd, s)), np.zeros((nd, 1))
    q = dual.image @ z1 @ dual.image.T - dual.top @ z1 @ dual.top.T
    later = corner @ np.linalg.inv(0.5 * (q + q.T))
    values, vectors = np.linalg.eigh(0.5 * (last + last.T) - later @ q @ later.T)
    return f, later @ np.linalg.inv(states), vectors * np.sqrt(np.maximum(values, 0.0))
