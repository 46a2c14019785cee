"""A second route to the recursive estimates: one least-squares problem over the first steps as a whole."""

from __future__ import annotations

import numpy as np

from obsynth.methods.engines.recursive.consistency import data_deviations, state_terms
from obsynth.methods.engines.recursive.horizon_proof import natural_units
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import RANK_TOLERANCE, ROUNDED_BESIDE, numerical_rank, product_but_rounding
from obsynth.numerics.scaling import power_of_two_below
from obsynth.numerics.square_root_estimation import LeastSquaresStep, least_squares_step, rank_revealing_step
from obsynth.observers.recursive.gain_schedule_summary import examined_steps
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.recursive.step_model import StepMatrices

#: Steps in the batch: enough for every matrix to matter, few enough for one dense problem.
BATCH_STEPS = 6

#: Of many states fewer: as many as keep the problem to this many rows, but two at least.
MOST_BATCH_ROWS = 1500

#: Seed of the record that both are given; the estimators are linear, so any record will do.
RECORD_SEED = 2013


def batch_steps(stated: RecursiveObserver) -> int:
    """Return how many steps the size of a plant allows in one batch."""
    rows = len(stated.recursion.model.at(0).H)
    return min(BATCH_STEPS, examined_steps(stated), max(2, (MOST_BATCH_ROWS - stated.plant.nx) // rows))


def batch_residuals(stated: RecursiveObserver, shipped: RecursiveObserver) -> dict[str, float]:
    """Return how far the shipped recursion is from the batch solution of the stated problem."""
    steps = batch_steps(stated)
    y, u = _record(stated, steps + 1)
    running, reference = shipped.init(), stated.init()
    for k in range(steps + 1):
        before = reference.x, reference.factor, reference.Upsilon
        running, _ = shipped.advance(running, y[k], u[k])
        reference, _ = stated.advance(reference, y[k], u[k])
    exact, largest = _solved(stated, y, u)
    made_of = _terms(stated, stated.recursion.model.at(steps - 1), before, (y[-1], u[-2], u[-1]))
    covariance = exact.factor @ exact.factor.T
    size = made_of[:, 0] + np.abs(exact.estimate[:, 0]) + np.finfo(np.float64).tiny
    shipped_covariance = running.factor @ running.factor.T
    gaps = {
        "state": np.abs(running.x - exact.estimate[:, 0]) / size,
        "covariance": np.abs(shipped_covariance - covariance)
        / np.maximum(np.outer(size, size), np.finfo(np.float64).tiny),
    }
    if running.Upsilon.shape[1]:
        regressor = exact.estimate[:, 1:]
        # Without dynamics the last regressor is exactly zero, and what is found is the rounding of the others.
        sizes = largest[1:] + np.linalg.norm(made_of[:, 1:], axis=0) + np.finfo(np.float64).tiny
        gaps["regressor"] = np.abs(running.Upsilon - regressor) / sizes
    return {name: float(np.max(gap)) for name, gap in gaps.items()}


def _terms(
    observer: RecursiveObserver,
    step: StepMatrices,
    before: tuple[FloatArray, FloatArray, FloatArray],
    data: tuple[FloatArray, ...],
) -> FloatArray:
    """Return the terms of deviation and regressor ``(nx, 1 + nq)``: what tends to zero rounds as they do."""
    (x, factor, upsilon), (y, u, after) = before, data
    driven = np.abs(step.A) @ np.abs(x) + np.abs(step.B) @ np.abs(u)
    outputs = np.abs(y) + np.abs(step.D) @ np.abs(after)
    values = np.concatenate([driven, outputs, np.abs(step.Dn) @ np.abs(after)]) + data_deviations(step, factor)
    nq = upsilon.shape[1]
    regressors = np.vstack([np.abs(step.A) @ np.abs(upsilon) + np.abs(step.Phi[:, :nq]), np.abs(step.Psi[:, :nq])])
    # A parameter that is read where no state is has a regressor of zero, but for the rounding of that row's datum.
    rows = _row_sizes(observer, step.H, step.noise)[:, None]
    regressors += ROUNDED_BESIDE * rows * np.max(regressors / rows, axis=0, initial=0.0)
    return state_terms(step, np.hstack([values[:, None], regressors]))


def _record(observer: RecursiveObserver, samples: int) -> tuple[FloatArray, FloatArray]:
    """Return a random record, changed as little as is needed where equations without noise would contradict it."""
    from scipy.linalg import qr

    plant, rng = observer.plant, np.random.default_rng(RECORD_SEED)
    y, u = rng.standard_normal((samples, plant.ny)), rng.standard_normal((samples, plant.nu))
    H, S, data = _problem(observer, y, u)
    # Directions without noise, by two factorisations that cost a tenth of the singular values; in no unit.
    rows = _row_sizes(observer, H, S)
    moved = H * np.tile(natural_units(observer), samples)
    triangle = qr((np.hstack([moved, S[:, S.any(axis=0)]]) / rows[:, None]).T, mode="r")[0]
    basis, upper, _ = qr(triangle[: len(H)].T, pivoting=True)
    sizes = np.abs(np.diagonal(upper))
    perfect = basis[:, numerical_rank(sizes) :] / rows[:, None]
    if not perfect.shape[1]:
        return y, u
    # The data are affine in the record: a column of the map is the difference that one sample makes.
    zero = np.zeros(y.size + u.size)
    none = _data(observer, *_split(zero, y, u))[:, 0]
    unit = np.eye(zero.size)
    effect = np.array([perfect.T @ (_data(observer, *_split(sample, y, u))[:, 0] - none) for sample in unit]).T
    flat = np.concatenate([y.ravel(), u.ravel()])
    changed = flat - np.linalg.pinv(effect, rcond=RANK_TOLERANCE) @ (perfect.T @ data[:, 0])
    # A sensor without noise that reads nothing reads zero, not what rounding leaves of it.
    return _split(np.where(np.abs(changed) > RANK_TOLERANCE * np.abs(flat), changed, 0.0), y, u)


def _row_sizes(observer: RecursiveObserver, H: FloatArray, S: FloatArray) -> FloatArray:
    """Return the size of each row of ``[H S]`` with the states in natural units, a power of two."""
    units = np.tile(natural_units(observer), H.shape[1] // len(natural_units(observer)))
    return power_of_two_below(np.maximum(*(np.max(np.abs(part), axis=1, initial=0.0) for part in (H * units, S))))


def _split(flat: FloatArray, y: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
    return flat[: y.size].reshape(y.shape), flat[y.size :].reshape(u.shape)


def _solved(observer: RecursiveObserver, y: FloatArray, u: FloatArray) -> tuple[LeastSquaresStep, FloatArray]:
    """Return the last state of the solution over all states at once, and the largest norm of any state ``(1 + nq,)``;
    columns after the first belong to the parameters."""
    H, S, data = _problem(observer, y, u)
    n = H.shape[1] // len(y)
    # A factorisation adds rows: in units in which they are alike, which are powers of two, none loses its digits.
    rows = _row_sizes(observer, H, S)
    H, S, data = (part / rows[:, None] for part in (H, S, data))
    solution = least_squares_step(H, S, data) or rank_revealing_step(H, S, data, np.zeros((len(H), 0)))
    largest = np.linalg.norm(solution.estimate.reshape(len(y), n, -1), axis=1).max(axis=0)
    last = LeastSquaresStep(solution.estimate[-n:], solution.factor[-n:], solution.innovation, solution.diffuse[-n:])
    return last, np.asarray(largest)


def _data(observer: RecursiveObserver, y: FloatArray, u: FloatArray) -> FloatArray:
    """Return the data of `_problem`; further columns belong to the parameters."""
    start, model = observer.init(), observer.recursion.model
    n, nq = len(start.x), start.Upsilon.shape[1]
    parts = [np.hstack([start.x[:, None], np.zeros((n, nq))])]
    for k in range(len(y) - 1):
        step = model.at(k)
        outputs = product_but_rounding(-step.D, u[k + 1], y[k + 1])
        values = np.concatenate([step.B @ u[k], outputs, step.Dn @ u[k + 1]])
        parts.append(np.hstack([values[:, None], np.vstack([step.Phi, -step.Psi])[:, :nq]]))
    if (first := model.first()) is not None:
        parts.append(np.hstack([(first.Dn @ u[0])[:, None], -first.Psi[:, :nq]]))
    return np.vstack(parts)


def _problem(observer: RecursiveObserver, y: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return H, S and data of ``data = H x + S e`` for all states at once."""
    start, model, steps = observer.init(), observer.recursion.model, len(y) - 1
    n, listed = len(start.x), [model.at(k) for k in range(steps)]
    H = np.zeros((n + sum(len(step.H) for step in listed), n * (steps + 1)))
    roots = [start.factor, *(step.noise for step in listed)]
    H[:n, :n] = np.eye(n)
    top = n
    for k, step in enumerate(listed):
        H[top : top + len(step.H), (k + 1) * n : (k + 2) * n] = step.H
        H[top : top + len(step.A), k * n : (k + 1) * n] = -step.A
        top += len(step.H)
    if (first := model.first()) is not None:
        H = np.vstack([H, np.hstack([first.H[n:], np.zeros((len(model.late), n * steps))])])
        roots.append(first.noise[n:])
    S = np.zeros((len(H), max(sum(root.shape[1] for root in roots), len(H))))
    top = column = 0
    for root in roots:
        S[top : top + len(root), column : column + root.shape[1]] = root
        top, column = top + len(root), column + root.shape[1]
    return H, S, _data(observer, y, u)
