r"""Guaranteed thresholds of scheduled designs in continuous time: Lyapunov matrices in which errors stay small.

In the norm of any P in which errors decay like :math:`e^{-a t}` for every course, ``|e|`` stays below what drives it in
a second over a.  Candidates are those of the certificate, and ellipsoids of the middle of the region, along a line of
rates: :math:`(A + \alpha I) X + X (A + \alpha I)^T + B B^T = 0`, ``P = X^{-1}``.  The decay of each is proved at every
vertex before it is used; those with the least thresholds at rest are.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from obsynth.errors import SpecError
from obsynth.methods.registry import error_model
from obsynth.monitoring.thresholds.euler_bounds import EulerErrorBound, PlantMotion
from obsynth.monitoring.thresholds.euler_rule import EulerRule, ResidualBound
from obsynth.monitoring.thresholds.residual_monitor import with_stated_bounds
from obsynth.numerics.arrays import FloatArray, largest_singular_value, sums_of_column_norms
from obsynth.numerics.matrix_equations import continuous_lyapunov
from obsynth.numerics.ranks import decide_rank
from obsynth.observers.scheduled.observer import ScheduledObserver
from obsynth.plants.noise import require_noise
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.proofs.vertex_inequalities import Witness, prove_decay
from obsynth.results.design import ObserverDesign
from obsynth.verification.error_polytope import ErrorPolytope
from obsynth.verification.error_system import ErrorModel
from obsynth.verification.over_region import GAIN_WITNESSES, WITNESSES
from obsynth.verification.over_tolerances.responses import OUTWARD

#: Rates of the ellipsoids, as shares of the slowest mode in the middle of the region: of one state a half is best.
RATES = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
#: What is added to inputs that reach not all errors, as a share of the largest: an ellipsoid needs an interior.
INTERIORS = (1e-6, 1e-4, 1e-2)
#: Matrices that are followed along the rows.
MOST_FOLLOWED = 4
#: By how much slower a decay is claimed than it is computed, so that it can be proved.
DECAY_ROOM = 1e-6


class ContinuousRegionBound(NamedTuple):
    """A rule, the bounds of disturbances ``(nd,)``, and how far each fault estimate may be off at rest ``(nf,)``."""

    rule: EulerRule
    bounds: FloatArray
    fault_scales: FloatArray
    limit: float  # threshold at rest, for rows that are close
    errors: ErrorModel  # at a vertex
    C: FloatArray  # ``(nr, nz)``: from e to the residual


class _Inputs(NamedTuple):
    """What drives e and the residual, each input at most one."""

    flowing: FloatArray  # ``(N, nz, nd)``: through the plant, between rows too
    reading: FloatArray  # ``(N, nz, m)``: with the outputs of a row
    C: FloatArray  # ``(nr, nz)``
    D: FloatArray  # ``(nr, m)``


def continuous_region_bound(
    design: ObserverDesign,
    disturbance_bounds: Mapping[str, float] | None,
    noise_bound: float | None,
    initial_error: float | None,
) -> ContinuousRegionBound:
    """Return the rule whose threshold no course of the parameters passes without a fault.

    Parameters
    ----------
    design : ObserverDesign
        Over a region, in continuous time.
    disturbance_bounds, noise_bound, initial_error : optional
        As for `obsynth.online_monitor`.

    Raises
    ------
    SpecError
        A bound is missing, or the plant is of a kind for which none is known.
    """
    plant, observer = design.scheduled
    bounds = _stated_bounds(plant, disturbance_bounds)
    models = [
        error_model(design.replace(plant=vertex, observer=observer.before_division(place)))
        for place, vertex in enumerate(plant.vertices)
    ]
    _require_supported(plant)
    noisy = bool(plant.vertices[0].Dw.any())
    require_noise(noise_bound, noisy=noisy)
    if noisy and noise_bound is None:
        raise SpecError(
            "Gaussian noise has no pointwise bound: state noise_bound (--noise-bound), the number of standard "
            "deviations that yours never exceeds.",
            path="noise_bound",
        )
    motion, tracking, inputs = _parts(models, observer, bounds, noise_bound or 0.0)
    made = []
    for P, decay in _proved(design, models, inputs):
        root = np.asarray(np.linalg.cholesky(P).T)
        each = sums_of_column_norms(root @ inputs.flowing) + sums_of_column_norms(root @ inputs.reading)
        driven = float(np.max(each, initial=0.0))
        gain = largest_singular_value(np.linalg.solve(root.T, inputs.C.T))
        start = None if initial_error is None else initial_error * largest_singular_value(root)
        errors = EulerErrorBound(motion, tracking, root, decay, driven * OUTWARD)
        made.append(ResidualBound(errors, gain * OUTWARD, start))
    if not made:
        raise SpecError(
            f"The decay of the errors of design {design.name!r} over its region is not proved: there is no "
            "guaranteed threshold. Learn thresholds from rows without faults (kind 'learned' with normal=...).",
            path="kind",
        )
    made = sorted(made, key=lambda each: each.gain * each.errors.driven / each.errors.decay)[:MOST_FOLLOWED]
    direct = float(sums_of_column_norms(inputs.D))
    best = made[0].errors
    rows = np.linalg.norm(np.linalg.solve(best.root.T, models[0].output(observer.fault_rows)[0].T), axis=0)
    scales = rows * best.driven / best.decay
    limit = made[0].gain * best.driven / best.decay + direct
    return ContinuousRegionBound(
        EulerRule(observer, made, direct),
        bounds,
        np.where(scales > 0.0, scales, 1.0),
        limit,
        models[0],
        inputs.C,
    )


def _stated_bounds(plant: PolytopicSystem, stated: Mapping[str, float] | None) -> FloatArray:
    bounds = with_stated_bounds(np.full(plant.nd, np.inf), plant.disturbance_names, stated)
    reached = np.any([v.Bd.any(axis=0) | v.Dd.any(axis=0) for v in plant.vertices], axis=0)
    lacking = [plant.disturbance_names[place] for place in np.flatnonzero(reached & ~np.isfinite(bounds))]
    if lacking:
        raise SpecError(
            f"No bound is given on {', '.join(lacking)}: give disturbance_bounds (--disturbance). Also a disturbance "
            "that no error shows moves the plant between rows.",
            path="disturbance_bounds",
        )
    return np.where(reached, bounds, 0.0)


def _require_supported(plant: PolytopicSystem) -> None:
    vertices, problem = plant.vertices, ""
    first = vertices[0]
    basis, rank = np.linalg.svd(plant.E)[0], decide_rank(plant.E).rank
    algebraic = basis[:, rank:].T
    same = all(
        np.allclose(algebraic @ getattr(v, name), algebraic @ getattr(first, name), rtol=0.0, atol=0.0)
        for v in vertices
        for name in ("A", "B", "Bd")
    )
    if any(v.Bw.any() for v in vertices):
        problem = "has process noise, of which a plant in continuous time gathers without a bound between rows"
    elif any((getattr(v, name) != getattr(first, name)).any() for v in vertices for name in ("C", "D", "Dd", "Dw")):
        problem = "has outputs that change with the parameters"
    elif not same:
        problem = "has algebraic equations that change with the parameters, so that its states jump with these"
    elif not decide_rank(np.vstack([basis[:, :rank].T @ plant.E, algebraic @ first.A])).full:
        problem = "is of index 2 or more"
    if problem:
        raise SpecError(
            f"The plant {problem}: there is no guaranteed threshold of a design in continuous time for it. Learn "
            "thresholds from rows without faults (kind 'learned' with normal=...).",
            path="kind",
        )


def _parts(
    models: list[ErrorModel], observer: ScheduledObserver, bounds: FloatArray, noise_bound: float
) -> tuple[PlantMotion, FloatArray, _Inputs]:
    """Return the plant's motion in dynamic coordinates ``v = U1' E x``, the tracking map, and what drives e."""
    first = models[0].plant
    basis, rank = np.linalg.svd(first.E)[0], decide_rank(first.E).rank
    U1, U2 = basis[:, :rank], basis[:, rank:]
    solve = np.linalg.inv(np.vstack([U1.T @ first.E, U2.T @ first.A]))
    # x = Xv v + Xu u + Xd d
    Xv, Xu, Xd = solve[:, :rank], -solve[:, rank:] @ U2.T @ first.B, -solve[:, rank:] @ U2.T @ first.Bd
    plants = [model.plant for model in models]
    A = np.array([U1.T @ p.A @ Xv for p in plants])
    B = np.array([U1.T @ (p.B + p.A @ Xu) for p in plants])
    Bd = np.array([U1.T @ (p.Bd + p.A @ Xd) for p in plants]) * bounds
    tracking = models[0].own @ U1
    C, _, Dd, Dw = models[0].output(observer.state_rows)
    read = np.hstack([(first.Dd + first.C @ Xd) * bounds, first.Dw * noise_bound])
    into = U1.T @ first.E
    motion = PlantMotion(
        A,
        B,
        Bd,
        into,
        into @ C,
        into @ np.hstack([Dd * bounds, Dw * noise_bound]),
        _units(A),
    )
    Cr, _, Dd, Dw = models[0].output(observer.residual_rows)
    inputs = _Inputs(
        tracking @ Bd,
        np.array([model.observer.By @ read for model in models]),
        Cr,
        np.hstack([Dd * bounds, Dw * noise_bound]),
    )
    return motion, tracking, inputs


def _units(A: FloatArray) -> FloatArray:
    """Return units of the states in which their largest couplings are balanced."""
    from scipy.linalg import matrix_balance

    largest = np.max(np.abs(A), axis=0)
    _, (scale, _) = matrix_balance(largest, permute=False, separate=True)
    return np.asarray(scale)


def _proved(design: ObserverDesign, models: list[ErrorModel], inputs: _Inputs) -> list[tuple[FloatArray, float]]:
    """Return Lyapunov matrices with decays that are proved at every vertex."""
    stored, matrices = [model.Az for model in models], design.certificate.matrices
    n = len(stored[0])
    candidates = [
        np.asarray(P, dtype=np.float64)
        for name in (WITNESSES[0], GAIN_WITNESSES[0])
        for P in matrices.get(name, np.zeros((0, n, n)))
    ]
    candidates += _ellipsoids(np.mean(stored, axis=0), np.concatenate([inputs.flowing, inputs.reading], axis=2))
    closed = ErrorPolytope(stored, np.zeros((0, n))).closed([np.zeros((n, 0))])
    made = []
    for P in candidates:
        symmetric = 0.5 * (P + P.T) / np.max(np.abs(P))
        try:
            root = np.linalg.cholesky(symmetric).T
        except np.linalg.LinAlgError:
            continue
        moved = [root @ A @ np.linalg.inv(root) for A in stored]
        decay = -max(float(np.linalg.eigvalsh(0.5 * (M + M.T))[-1]) for M in moved) * (1.0 - DECAY_ROOM)
        if decay > 0.0 and prove_decay(closed, Witness([symmetric]), decay, discrete=False).proved:
            made.append((symmetric, decay))
    return made


def _ellipsoids(A: FloatArray, inputs: FloatArray) -> list[FloatArray]:
    """Return inverses of Gramians of the middle of the region, with rates along a line."""
    slowest = -float(np.max(np.linalg.eigvals(A).real)) if len(A) else 0.0
    if not slowest > 0.0:
        return []
    squares = np.mean(inputs @ inputs.transpose(0, 2, 1), axis=0)
    largest = float(np.max(np.abs(squares), initial=0.0)) or 1.0
    made = []
    for interior in INTERIORS:
        for share in RATES:
            rate = share * slowest
            X = continuous_lyapunov(A + rate * np.eye(len(A)), -(squares + interior * largest * np.eye(len(A))))
            try:
                made.append(np.asarray(np.linalg.inv(0.5 * (X + X.T))))
            except np.linalg.LinAlgError:
                continue
    return made
