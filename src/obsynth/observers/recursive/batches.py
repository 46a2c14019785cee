"""Many trials of a recursive observer at once: its gains do not depend on data."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.estimates import Estimates
from obsynth.observers.records import batch_record, require_horizon
from obsynth.observers.recursive.gain_schedule import gain_steps
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.running import named_estimates


def run_batch(observer: RecursiveObserver, y: ArrayLike, u: ArrayLike | None = None) -> Estimates:
    """Run many trials at once: the gains do not depend on data, so a step is one product for all trials.

    Shapes: ``y (trials, samples, ny)``.
    """
    if observer.adaptation is not None and observer.adaptation.reset:
        raise SpecError("Resets depend on the data of each trial: run them one by one, or without reset.", path="reset")
    outputs, given_inputs = batch_record(y, u, observer.plant.ny, observer.plant.input_names)
    trials, samples = outputs.shape[:2]
    if not np.isfinite(outputs[:, 1:]).all():
        raise SpecError("A batch must be complete: run trials with missing samples one by one.", path="y")
    require_horizon(observer.plant.horizon, samples, early=observer.early_constraints)
    inputs = np.broadcast_to(given_inputs, (trials, *given_inputs.shape[-2:]))
    start = observer.init()
    early = observer.recursion.model.first() is not None
    x = np.broadcast_to(start.x, (trials, len(start.x)))
    theta = np.broadcast_to(start.parameters.theta, (trials, len(start.parameters.theta)))
    nx, nq = observer.plant.nx, len(observer.fault_names)
    states, parameters = np.empty((trials, samples, nx)), np.empty((trials, samples, nq))

    def keep(k: int, Upsilon: FloatArray) -> None:
        """Keep states and parameters: of a walk they are parts of x, else the states follow the parameters."""
        walks = x.shape[1] > nx
        states[:, k] = x[:, :nx] if walks else x + theta @ Upsilon.T
        parameters[:, k] = x[:, nx:] if walks else theta

    innovations: list[FloatArray] = []
    if not early:
        keep(0, np.zeros((nx, theta.shape[1])))
        innovations.append(np.full((trials, 0), np.nan))
    for k, gains in enumerate(gain_steps(observer, samples - 1), 0 if early else 1):
        step, arriving = gains.step, outputs[:, k] if k else outputs[:, k, :0]
        before = inputs[:, k - 1] if k else np.zeros((trials, observer.plant.nu))
        measured = arriving - inputs[:, k] @ step.D.T
        data = np.concatenate((x @ step.A.T + before @ step.B.T, measured, inputs[:, k] @ step.Dn.T), axis=1)
        x, theta = data @ gains.gain.T, theta @ gains.retain.T + data @ gains.learn.T
        keep(k, gains.Upsilon)
        innovations.append(data @ gains.parity.T)
    padded = np.full((trials, samples, max(rows_of_step.shape[1] for rows_of_step in innovations)), np.nan)
    for k, rows_of_step in enumerate(innovations):
        padded[:, k, : rows_of_step.shape[1]] = rows_of_step
    return named_estimates(observer, states=states, faults=parameters, innovations=padded)
