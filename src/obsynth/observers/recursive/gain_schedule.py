"""Everything a recursive observer computes that does not depend on data, and whole batches of trials run with it."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.least_squares_step import least_squares_step, rank_revealing_step
from obsynth.numerics.recursive_least_squares import update
from obsynth.observers.estimates import Estimates, named_estimates
from obsynth.observers.records import batch_record, require_horizon
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.recursive.parameter_steps import posterior_residual
from obsynth.observers.recursive.step_model import (
    EarlyConstraintSteps,
    PreparedStep,
    StepMatrices,
    spreads,
)


class GainStep(NamedTuple):
    """The gains of one step; data are the rows ``[A x + B u; outputs]``."""

    step: StepMatrices  # of the model as it is run
    gain: FloatArray  # ``[L K] (nx, rows)`` of (11)
    parity: FloatArray  # ``(m, rows)``: from data to the whitened innovation
    G: FloatArray  # ``(m, nq)``: its regressor
    Upsilon: FloatArray  # ``(nx, nq)``, after the step
    factor: FloatArray  # ``(nx, nx)``: square root of the covariance of the state, the parameters being known
    learn: FloatArray  # ``(nq, rows)``: from data to the correction of the parameters
    forget: FloatArray  # ``(nq, nq)``: ``theta^+ = forget theta + learn data``
    spread: FloatArray  # ``(nq, nq)``: square root of the covariance of the parameters


def gain_steps(
    observer: RecursiveObserver, steps: int, *, received: NDArray[np.bool_] | None = None
) -> Iterator[GainStep]:
    """Yield the gains of the first steps: ``received (samples, ny)``."""
    recursion = observer.recursion
    start = recursion.first
    factor, Upsilon, parameters, diffuse = start.factor, start.Upsilon, start.parameters, start.diffuse
    adaptation, model = observer.adaptation, recursion.model
    first = [model.first()] if isinstance(model, EarlyConstraintSteps) else []
    prepared: PreparedStep | None = None
    for k, step in enumerate(chain(first, (model.at(k) for k in range(steps))), 1 - len(first)):
        ne, rows, nq = len(step.A), len(step.H), Upsilon.shape[1]
        right = np.eye(rows)
        if nq:
            right = np.hstack([right, np.vstack([step.A @ Upsilon + step.Phi, -step.Psi])])
        complete = received is None or not k or bool(received[k].all())
        found = None
        if complete and not diffuse.shape[1]:
            prepared = PreparedStep.of(step, prepared)
            found = prepared.taken(factor, right if nq else None)
        # The literal form asks for the noise itself.
        if found is None or recursion.literal:
            S, unknown = spreads(step, factor, diffuse, k, observer.state_names)
            H = step.H
            if not complete and received is not None:
                kept = np.concatenate([np.ones(ne, dtype=bool), received[k], np.ones(len(step.Dn), dtype=bool)])
                H, S, right, unknown = H[kept], S[kept], right[kept], unknown[kept]
            if found is None and not unknown.shape[1] and not complete:
                found = least_squares_step(H, S, right)
            found = found or rank_revealing_step(H, S, right, unknown, mapped=rows)
        diffuse = found.diffuse
        gain, Upsilon, factor = found.estimate[:, :rows], found.estimate[:, rows:], found.factor
        parity, G = found.innovation[:, :rows], -found.innovation[:, rows:]
        learn, forget = np.zeros((nq, rows)), np.eye(nq)
        if adaptation is not None and nq:
            seen, regressor, noise = parity, G, None
            if recursion.literal and len(H) > ne:
                seen, regressor, noise = posterior_residual(found, H, S, right, ne, unknown=unknown, columns=rows)
            parameters, theta_gain = update(
                parameters, np.zeros(len(regressor)), regressor, forgetting=adaptation.forgetting,
                regular=recursion.regular, directional=recursion.directional, noise=noise,
            )  # fmt: skip
            learn, forget = theta_gain @ seen, np.eye(nq) - theta_gain @ regressor
        yield GainStep(step, gain, parity, G, Upsilon, factor, learn, forget, parameters.spread)


def run_batch(observer: RecursiveObserver, y: ArrayLike, u: ArrayLike | None = None) -> Estimates:
    """Run many trials at once: the gains do not depend on data, so a step is one product for all trials.

    Shapes: ``y (trials, samples, ny)``.
    """
    if observer.adaptation is not None and observer.adaptation.reset:
        raise SpecError("Resets depend on the data of each trial: run them one by one, or without reset.", path="reset")
    outputs, known = batch_record(y, u, observer.plant.ny, observer.plant.input_names)
    trials, samples = outputs.shape[:2]
    if not np.isfinite(outputs[:, 1:]).all():
        raise SpecError("A batch must be complete: run trials with missing samples one by one.", path="y")
    require_horizon(observer.plant.horizon, samples, early=observer.early_constraints)
    inputs = np.broadcast_to(known, (trials, *known.shape[-2:]))
    start = observer.init()
    early = isinstance(observer.recursion.model, EarlyConstraintSteps)
    x = np.broadcast_to(start.x, (trials, len(start.x)))
    theta = np.broadcast_to(start.parameters.theta, (trials, len(start.parameters.theta)))
    nx = observer.plant.nx
    states: list[FloatArray] = []
    parameters: list[FloatArray] = []
    innovations: list[FloatArray] = []
    if not early:
        _note(states, parameters, x, theta, np.zeros((nx, theta.shape[1])), nx)
        innovations.append(np.full((trials, 0), np.nan))
    for k, gains in enumerate(gain_steps(observer, samples - 1), 0 if early else 1):
        step, arriving = gains.step, outputs[:, k] if k else outputs[:, k, :0]
        before = inputs[:, k - 1] if k else np.zeros((trials, observer.plant.nu))
        data = np.concatenate(
            (x @ step.A.T + before @ step.B.T, arriving, inputs[:, k] @ step.Dn.T), axis=1
        )  # fmt: skip
        x, theta = data @ gains.gain.T, theta @ gains.forget.T + data @ gains.learn.T
        _note(states, parameters, x, theta, gains.Upsilon, nx)
        innovations.append(data @ gains.parity.T)
    most = max(found.shape[1] for found in innovations)
    padded = np.full((trials, samples, most), np.nan)
    for k, found in enumerate(innovations):
        padded[:, k, : found.shape[1]] = found
    return named_estimates(
        observer, states=np.stack(states, axis=1), faults=np.stack(parameters, axis=1), innovations=padded
    )


def _note(
    states: list[FloatArray], parameters: list[FloatArray], x: FloatArray, theta: FloatArray,
    Upsilon: FloatArray, nx: int,
) -> None:  # fmt: skip
    """Keep states and parameters: of a walk they are parts of x, else the states follow the parameters."""
    if x.shape[1] > nx:
        states.append(x[:, :nx])
        parameters.append(x[:, nx:])
    else:
        states.append(x + theta @ Upsilon.T)
        parameters.append(theta)
