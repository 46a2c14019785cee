r"""Guaranteed thresholds of scheduled designs, for every trajectory of their parameters.

With bounded inputs w (each at most one) the residual of ``e+ = M(mu) e + B(mu) w``, ``r = C e + D w`` after k samples

.. math::
    r_k = C M_{k-1} \cdots M_0 e_0 + D w_k + \sum_j C M_{k-1} \cdots M_{k-j+1} B_{k-j} w_{k-j}

is bounded by the sum of the norms of the columns.  That is convex in the weights of each sample, with those of the
others fixed: its largest value is at a course of vertices.  The courses of the latest samples are enumerated; what is
older is bounded in the norm of the certificate, in which errors shrink along every course of as many samples:
:math:`|e_{k+J}|_P \le c |e_k|_P + \beta`.  The decay is proved again from the stored matrices before it is used.

A filter of faults that turn corrects its states by ``K(mu) r`` with the weights of the sample before.  Its corrected
errors :math:`\epsilon = e - K r` obey

.. math::
    \epsilon_{k+1} = (I - K(\mu_k) C) (M(\mu_k) \epsilon_k + B(\mu_k) w_k) - K(\mu_k) D w_{k+1}, \qquad
    r_{k+1} = C (M(\mu_k) \epsilon_k + B(\mu_k) w_k) + D w_{k+1},

all of which is the mean, with weights ``mu_i^2`` and ``2 mu_i mu_j``, of what it is at pairs of vertices: these are
the vertices of the same enumeration.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from obsynth.analysis.existence.turning_filter import pairs_of_vertices
from obsynth.errors import SpecError
from obsynth.monitoring.thresholds.residual_model import ResidualModel, residual_model
from obsynth.monitoring.thresholds.residual_monitor import bounds_of
from obsynth.monitoring.thresholds.residual_norm_bounds import (
    REMAINDER_AFTER_TABLE,
    UnlimitedHorizonBound,
    scaled_inputs,
)
from obsynth.numerics.arrays import FloatArray, sums_of_column_norms
from obsynth.observers.scheduled.observer import ScheduledObserver
from obsynth.proofs.vertex_inequalities import pairs_of, prove_decay
from obsynth.results.design import ObserverDesign
from obsynth.simulation.scenario import Scenario
from obsynth.verification.error_polytope import ErrorPolytope
from obsynth.verification.over_region import WITNESSES, witness_of_certificate
from obsynth.verification.over_tolerances.responses import OUTWARD

#: Courses that are enumerated: some milliseconds for each sample of them.
MOST_COURSES = 4096
#: Entries of the products along all courses: 32 MB of doubles.
MOST_ENTRIES = 4_194_304
#: Rows of a table while the effect of a start settles.
MOST_TABLE = 16_384
#: Samples of which courses are enumerated at most; one vertex has one course.
MOST_SAMPLES = 64


class ErrorsAtVertices(NamedTuple):
    """The error system at each vertex, every input scaled to at most one.

    ``e+ = M e + B w + K w+`` with the inputs ``w+`` of the next sample; ``r = C e + D w``, or with a first sample
    of its own ``r+ = C e + D w + F w+``.
    """

    M: FloatArray  # ``(N, n, n)``
    B: FloatArray  # ``(N, n, m)``
    C: FloatArray  # ``(N or 1, nr, n)``
    D: FloatArray  # ``(N or 1, nr, m)``
    K: FloatArray  # ``(N or 1, n, m)``
    first: FirstSample | None = None


class FirstSample(NamedTuple):
    """What a later output has of the first sample, before any course: the corrected start, and its own residual."""

    start: FloatArray  # ``(n, n)``: from the error at the start
    start_inputs: FloatArray  # ``(n, m)``: from the inputs of the first sample
    C: FloatArray  # ``(nr, n)``
    F: FloatArray  # ``(nr, m)``


def region_bound(
    design: ObserverDesign,
    disturbance_bounds: Mapping[str, float] | None,
    noise_bound: float | None,
    initial_error: float | None,
) -> tuple[UnlimitedHorizonBound, ResidualModel, FloatArray]:
    """Return a table of bounds from the first row on and one for ever after; the model at a vertex, and the bounds of
    disturbances.

    Without ``initial_error`` there is no table: the bound holds once the effect of the start has settled.
    """
    errors, model, bounds = _errors_at_vertices(design, disturbance_bounds, noise_bound)
    P, decay = _lyapunov_matrices(design, errors), design.certificate.claims["region_decay"]
    return _bound(errors, P, decay, initial_error), model, bounds


def _errors_at_vertices(
    design: ObserverDesign, disturbance_bounds: Mapping[str, float] | None, noise_bound: float | None
) -> tuple[ErrorsAtVertices, ResidualModel, FloatArray]:
    plant, observer = design.scheduled
    _require_certificate(design)
    made, model, bounds = [], None, np.zeros(0)
    for place, vertex in enumerate(plant.vertices):
        own = design.replace(plant=vertex, observer=observer.before_division(place))
        scenario = Scenario(horizon=2.0 * plant.dt, noise=1.0 if vertex.nw else 0.0)
        model = residual_model(own, scenario, endless=True)
        bounds = np.full(plant.nd, np.inf)
        stated = list(disturbance_bounds or {})
        known = bounds_of(own, model, disturbance_bounds)
        bounds = np.where([name in stated for name in plant.disturbance_names], known, bounds)
        inputs = scaled_inputs(model, bounds, noise_bound, plant)
        made.append((model.A, inputs.B, model.C, inputs.D))
    if model is None:  # a plant has a vertex
        raise SpecError("The plant has no vertex.", path="plant")
    M, B, C, D = (np.array(part) for part in zip(*made, strict=True))
    if (C[0] != C).any() or (D[0] != D).any():
        raise SpecError(
            "The residual of this design changes with the parameters: learn thresholds from rows without faults (kind "
            "'learned' with normal=...).",
            path="kind",
        )
    if observer.correction is not None:
        return _corrected(M, B, C[0], D[0], observer), model, bounds
    return ErrorsAtVertices(M, B, C[:1], D[:1], np.zeros((1, *B.shape[1:]))), model, bounds


def _corrected(
    M: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray, observer: ScheduledObserver
) -> ErrorsAtVertices:
    """Return the corrected errors at pairs of vertices."""
    K = np.zeros((0,)) if observer.correction is None else observer.correction
    eye, pairs = np.eye(M.shape[1]), pairs_of_vertices(len(M))

    def means(left: FloatArray, right: FloatArray) -> FloatArray:
        return np.array([0.5 * (left[i] @ right[j] + left[j] @ right[i]) for i, j in pairs])

    free, same = eye - K @ C, np.array([C] * len(M))
    middle = np.tensordot(observer.init().weights, K, 1)
    first = FirstSample(eye - middle @ C, -middle @ D, C, D)
    corrections = np.array([-0.5 * (K[i] + K[j]) @ D for i, j in pairs])
    return ErrorsAtVertices(means(free, M), means(free, B), means(same, M), means(same, B), corrections, first)


def _require_certificate(design: ObserverDesign) -> None:
    if not {"tracking", WITNESSES[0]} <= set(design.certificate.matrices):
        raise SpecError(
            f"Design {design.name!r} has no certificate of decay: there is no guaranteed threshold over a region for "
            "it. Learn thresholds from rows without faults (kind 'learned' with normal=...).",
            path="kind",
        )


def _lyapunov_matrices(design: ObserverDesign, errors: ErrorsAtVertices) -> list[FloatArray]:
    """Return the matrices of the certificate in whose norm the stated decay is proved again."""
    plant, _ = design.scheduled
    matrices = design.certificate.matrices
    steps = plant.scheduling.step_of(plant.dt) if WITNESSES[1] in matrices else None
    witness = witness_of_certificate(matrices, None if steps is None else pairs_of(plant.count, steps))
    n = errors.M.shape[1]
    closed = ErrorPolytope(list(errors.M), np.zeros((0, n)), dt=plant.dt).closed([np.zeros((n, 0))])
    decay = design.certificate.claims.get("region_decay", np.nan)
    proved = witness is not None and 0.0 <= decay < 1.0 and prove_decay(closed, witness, decay, discrete=True).proved
    if witness is None or not proved:
        raise SpecError(
            f"The decay of the errors of design {design.name!r} over its region is not proved below one: there is no "
            "guaranteed threshold. Learn thresholds from rows without faults (kind 'learned' with normal=...).",
            path="kind",
        )
    return list(witness.P)


def _bound(
    errors: ErrorsAtVertices, P: list[FloatArray], decay: float, initial_error: float | None
) -> UnlimitedHorizonBound:
    # In these coordinates errors shrink: the norm of one P, or that of the middle of several.
    root = np.asarray(np.linalg.cholesky(np.mean(P, axis=0)).T)
    inverse = np.asarray(np.linalg.inv(root))
    own, depth = _in_coordinates(errors, root, inverse), _depth(*errors.M.shape[:2])
    start, first = _start(errors, root, initial_error)
    at_first = 0.0 if errors.first is None else float(sums_of_column_norms(errors.first.F))
    residual = _Courses(own.C, own.D, np.full(len(own.C), at_first))
    error = _Courses(np.eye(len(root))[None], np.zeros((1, *own.B.shape[1:])), np.zeros(1))
    table, shrunk, reached = first, list[float](), list[float]()
    for step in range(depth + 1):
        shrunk.append(float(np.max(_norms(error.products))))
        reached.append(error.largest(0.0))
        if step == depth:
            break
        table.append(residual.largest(start or 0.0))
        residual, error = residual.one_earlier(own), error.one_earlier(own)
    # From so many samples before: at most a share of the error then, and what acts since.
    share, since = shrunk[-1], reached[-1]
    if len(P) == 1:
        share = min(share, decay**depth)
        each = float(np.max(sums_of_column_norms(own.B)) + np.max(sums_of_column_norms(own.K)))
        since = min(since, each * (1.0 - decay**depth) / (1.0 - decay))
    settled = since / (1.0 - share) if share < 1.0 else np.inf
    if not np.isfinite(settled):
        raise SpecError(
            "The errors decay too slowly for a guaranteed threshold over the region: learn thresholds from rows "
            "without faults (kind 'learned' with normal=...).",
            path="kind",
        )
    if start is None:
        return np.zeros(0), residual.largest(settled) * OUTWARD
    sizes = [g * start + b for g, b in zip(shrunk[:-1], reached[:-1], strict=True)]
    while max(sizes[-depth:]) > settled * (1.0 + REMAINDER_AFTER_TABLE) and len(sizes) < MOST_TABLE:
        sizes.append(share * sizes[-depth] + since)
    table += [residual.largest(size) for size in sizes[:-depth]]
    return np.array(table) * OUTWARD, residual.largest(max(settled, *sizes[-depth:])) * OUTWARD


def _in_coordinates(errors: ErrorsAtVertices, root: FloatArray, inverse: FloatArray) -> ErrorsAtVertices:
    return errors._replace(M=root @ errors.M @ inverse, B=root @ errors.B, C=errors.C @ inverse, K=root @ errors.K)


def _start(errors: ErrorsAtVertices, root: FloatArray, initial_error: float | None) -> tuple[float | None, list[float]]:
    """Return how large the error is at the start, and what the residual of the first row is where that is another."""
    if initial_error is None:
        return None, []
    first = errors.first
    if first is None:
        return initial_error * float(np.linalg.norm(root, 2)), []
    by_inputs = float(sums_of_column_norms(root @ first.start_inputs))
    size = initial_error * float(np.linalg.norm(root @ first.start, 2)) + by_inputs
    return size, [initial_error * float(np.linalg.norm(first.C, 2)) + float(sums_of_column_norms(first.F))]


class _Courses(NamedTuple):
    """What an output is made of along courses of the latest samples."""

    products: FloatArray  # ``(courses, rows, n)``: from the error before them
    pending: FloatArray  # ``(courses, rows, m)``: from the inputs of the sample of that error, but by the error itself
    sums: FloatArray  # ``(courses,)``: norms of the columns of all later inputs

    def one_earlier(self, errors: ErrorsAtVertices) -> _Courses:
        """Return the courses that begin a sample earlier, at every vertex."""
        corrections = errors.K if len(errors.K) == len(errors.M) else [errors.K[0]] * len(errors.M)
        sums = [self.sums + sums_of_column_norms(self.pending + self.products @ k) for k in corrections]
        pending, products = ([self.products @ each for each in part] for part in (errors.B, errors.M))
        return _Courses(np.concatenate(products), np.concatenate(pending), np.concatenate(sums))

    def largest(self, size: float) -> float:
        """Return the largest output after an error of a size before the courses."""
        return float(np.max(self.sums + sums_of_column_norms(self.pending) + _norms(self.products) * size))


def _norms(matrices: FloatArray) -> FloatArray:
    """Return the spectral norms of matrices ``(K, m, n)``."""
    return np.asarray(np.linalg.norm(matrices, 2, axis=(1, 2)))


def _depth(vertices: int, order: int) -> int:
    """Return of how many samples the courses are enumerated, one at least."""
    courses = min(MOST_COURSES, MOST_ENTRIES // max(order, 1) ** 2)
    if vertices == 1:
        return MOST_SAMPLES
    return max((depth for depth in range(1, MOST_SAMPLES) if vertices**depth <= courses), default=1)
