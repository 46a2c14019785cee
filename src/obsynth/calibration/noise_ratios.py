"""Which variances of a design a log contradicts: likeliest ones beside those that were designed with."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from obsynth.calibration.logs import Log, quantum
from obsynth.calibration.maximum import Objective, greatest_likelihood
from obsynth.calibration.plants import NonlinearPlant
from obsynth.calibration.problem import Problem
from obsynth.calibration.simulation_error import Fit
from obsynth.calibration.step_graphs import sample_graphs
from obsynth.errors import PreconditionError
from obsynth.observers.dae.observer import DAEObserver

#: Nats that a variance of the design must cost, the others being free, before its ratio is told.
CLEAR_NATS = 3.0
#: Ratios nearer to one than this factor are not told: nobody knows a variance better.
TOLD_FACTOR = 1.5


def noise_ratios(observer: DAEObserver, log: Log) -> Mapping[str, float]:
    """Return likeliest over designed variance for each that the log contradicts, parameters at their start."""
    model = observer.model
    held = model.replace(parameters=dict(zip(model.parameter_names, observer.initial_parameters, strict=True)))
    designed_Q, designed_R = np.diag(observer.Q), np.diag(observer.R)
    noisy = tuple(name for name, variance in zip(model.equation_names, designed_Q, strict=True) if variance > 0.0)
    names = (*noisy, *model.output_names)
    designed = np.concatenate([designed_Q[designed_Q > 0.0], designed_R])
    nothing, free_Q = np.zeros(0), np.full(len(noisy), np.nan)
    plant = NonlinearPlant(held)
    graphs = sample_graphs(plant, (), log.dt, integration=observer.integration, substeps=1, samples=log.samples)
    quanta = np.array([quantum(column) for column in log.y.T])
    problem = Problem(
        plant, log, log.u, (), nothing, nothing, nothing, nothing, nothing, noisy, free_Q, np.full(model.ny, np.nan),
        np.array(observer.initial_state), np.array(observer.initial_covariance), quanta, 1e-6 * designed_R, graphs,
        observer.integration, 1,
    )  # fmt: skip
    fit = Fit(nothing, np.array(observer.initial_state), np.sqrt(designed_R), 0.0, np.zeros((0, 0)))
    objective = Objective(problem, fit)
    try:
        best = greatest_likelihood(objective, [fit], lambda text: None)
    except PreconditionError:
        # Without a likelihood nothing can be told of its variances.
        return {}
    found = {}
    for i, (name, variance) in enumerate(zip(names, designed, strict=True)):
        ratio = float(np.exp(best.z[i]) / variance)
        z = best.z.copy()
        z[i] = np.log(variance)
        if max(ratio, 1.0 / ratio) > TOLD_FACTOR and objective(z)[0] - best.value > CLEAR_NATS:
            found[name] = ratio
    return found
