"""A recursive design on a scenario: its time-varying plant simulated, the recursion beside it."""

from __future__ import annotations

import math

import numpy as np

from obsynth.errors import SpecError
from obsynth.evaluation.simulating import CONSISTENCY_TOLERANCE, WARM_UP_SHARE, Simulation
from obsynth.models.sequences import MatrixSequence
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.numerics.covariances import covariance_factor
from obsynth.observers.linear import Estimates
from obsynth.observers.recursive import RecursiveObserver
from obsynth.observers.recursive_estimates import RecursiveEstimates
from obsynth.observers.transients import transient_steps
from obsynth.results.design import ObserverDesign
from obsynth.simulation.drive import resolve
from obsynth.simulation.scenario import Scenario
from obsynth.simulation.time_varying import signals_of, simulate_time_varying


def simulate_recursive(design: ObserverDesign, scenario: Scenario) -> Simulation:
    """Simulate the plant of a recursive design over a scenario; see `obsynth.simulate`.

    Parameters
    ----------
    design : ObserverDesign
        Recursive.
    scenario : Scenario
        What happens; its faults are the parameters.

    Returns
    -------
    Simulation
        Signals, estimates, and how well they agree.  Outputs begin with y(1).

    Raises
    ------
    SpecError
        An unknown name, a horizon beyond the model's, or something that only time-invariant plants have.
    PreconditionError
        The plant cannot be simulated step by step.
    """
    plant, observer = design.recursive
    if scenario.stabilise or scenario.observer_state is not None:
        name = "stabilise" if scenario.stabilise else "observer_state"
        raise SpecError(f"{name} is for linear designs; the start of a recursive one is among its options.", path=name)
    drive = resolve(signals_of(plant), scenario)
    steps = drive.steps
    if plant.horizon is not None and steps > plant.horizon:
        raise SpecError(
            f"The scenario has {steps} samples, but the model is good for {plant.horizon} steps: shorten the horizon.",
            path="horizon",
        )  # fmt: skip
    _, noise, sensors = drive.drawn([scenario.seed], plant.ne + plant.ny)
    inputs, faults = np.split(drive.left, [plant.nu], axis=1)
    start = np.array([scenario.initial_state.get(name, 0.0) for name in plant.state_names])
    found = simulate_time_varying(
        plant, samples=steps, parameters=faults, u=inputs, initial_state=start,
        equation_noise=_coloured(observer.Q, noise[:, 0, : plant.ne]),
        output_noise=_coloured(observer.R, noise[:, 0, plant.ne :])[: steps - 1],
    )  # fmt: skip
    outputs = drive.measured(found.outputs[:, None, :] + sensors)[:, 0]
    estimates = observer.run(outputs, inputs)
    forgotten = transient_steps(observer, WARM_UP_SHARE)
    warm_up = None if math.isinf(forgotten) or forgotten >= steps else int(forgotten)
    moved = float(np.linalg.norm(found.states[0] - start)) if scenario.initial_state else 0.0
    return Simulation(
        time=drive.dt * np.arange(steps, dtype=np.float64), states=found.states, outputs=outputs, inputs=inputs,
        faults=faults, disturbances=np.zeros((steps, 0)), estimates=as_estimates(observer, estimates),
        output_names=plant.output_names, input_names=plant.input_names, disturbance_names=(), inconsistency=moved,
        state_warm_up=warm_up, fault_warm_up=warm_up, notes=_notes(moved, start),
    )  # fmt: skip


def as_estimates(observer: RecursiveObserver, found: RecursiveEstimates) -> Estimates:
    """Return the estimates of a recursive observer in the form of a linear one's.

    Parameters
    ----------
    observer : RecursiveObserver
        That gave them.
    found : RecursiveEstimates
        Of a whole record; the residual is the whitened innovation at the parameters estimated one sample before.
    """
    residuals = found.innovations
    if observer.adaptation is not None and observer.adaptation.form != "random-walk":
        before = np.vstack([observer.adaptation.initial_parameters, found.parameters[:-1]])
        residuals = residuals - np.einsum("kmq,kq->km", found.regressors, before)
    return Estimates(
        found.states, found.parameters, read_only(residuals), found.state_names, found.parameter_names,
        tuple(f"innovation {i + 1}" for i in range(residuals.shape[1])), (0,) * len(found.state_names),
        (0,) * len(found.parameter_names),
    )  # fmt: skip


def _coloured(covariance: MatrixSequence, white: FloatArray) -> FloatArray:
    """Return white noise, one row for each k, with the covariance of each k."""
    if not white.any():
        return np.zeros_like(white)
    if covariance.is_constant:
        return np.asarray(white @ covariance_factor(covariance.at(0), "covariance").T)
    return np.array([covariance_factor(covariance.at(k), "covariance") @ row for k, row in enumerate(white)])


def _notes(moved: float, start: FloatArray) -> tuple[str, ...]:
    first = "The model begins with y(1): the first sample has no outputs."
    if moved <= CONSISTENCY_TOLERANCE * max(1.0, float(np.linalg.norm(start))):
        return (first,)
    return (
        first,
        f"The initial state did not satisfy the algebraic equations: it was projected, a change of {moved:.3g} (norm).",
    )
