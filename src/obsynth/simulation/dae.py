"""Simulation of a DAE by its own equations, by default with Radau IIA, not with the observer's discretisation."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SolverError, SpecError
from obsynth.numerics import lazy_casadi as ca
from obsynth.numerics.arguments import Seed, arguments_checked, require_shape
from obsynth.numerics.arrays import FloatArray, as_given, as_matrix
from obsynth.numerics.ranks import covariance_factor
from obsynth.plants.dae import DAEModel
from obsynth.plants.dae_functions import Compiled, DAEFunctions, take_samples
from obsynth.plants.dae_signals import checked_inputs, finite_vector, step_length
from obsynth.plants.implicit_step import ImplicitStep, onto_constraint
from obsynth.simulation.trajectory import Trajectory


@arguments_checked
def simulate_dae(
    model: DAEModel,
    u: ArrayLike,
    *,
    dt: float,
    parameters: ArrayLike | None = None,
    initial_state: ArrayLike | None = None,
    Q: ArrayLike | None = None,
    R: ArrayLike | None = None,
    integration: str = "radau",
    seed: Seed = 0,
) -> Trajectory:
    """Simulate a plant whose inputs are constant during each step.

    Parameters
    ----------
    model : DAEModel
        The plant.
    u : array_like
        Inputs ``(samples, nu)``; ``u(k)`` holds during the step that ends at k.
    dt : float
        Seconds between samples.
    parameters : array_like, optional
        ``(nq,)``, or ``(samples, nq)`` for parameters that change; nominal values by default.
    initial_state : array_like, optional
        ``(nx,)``; nominal values by default.  Where it contradicts the algebraic equations at the first input, it is
        put onto them first, by a step so short that nothing else moves.
    Q : array_like, optional
        ``(nx, nx)``: covariance of noise on the right sides of the equations, taken to first order; none by default.
    R : array_like, optional
        ``(ny, ny)``: covariance of the sensors; none by default.
    integration : {"radau", "backward-euler"}, optional
        Fifth order by default.
    seed : int, optional
        Of the noise.

    Returns
    -------
    Trajectory
        States, outputs with noise, and the residual of every step.

    Raises
    ------
    SpecError
        Shapes do not fit, or something is not finite.
    SolverError
        A step has no solution; k, iteration and worst equation are named.

    Examples
    --------
    >>> import obsynth
    >>> import numpy as np
    >>> tank = obsynth.DAEModel(
    ...     {"balance": "der(level) = inflow - c * sqrt(level)"},
    ...     {"gauge": "level"},
    ...     states={"level": 1.0},
    ...     inputs={"inflow": 0.5},
    ...     parameters={"c": 0.5},
    ...     units={"level": "m", "inflow": "m/s", "c": "m0.5/s", "gauge": "m"},
    ... )
    >>> run = obsynth.simulate_dae(tank, np.full((20, 1), 0.5), dt=1.0)
    >>> run.outputs.shape, run.states[-1].round(6).tolist()
    ((20, 1), [1.0])
    """
    inputs, length = checked_inputs(model, u), step_length(dt)
    theta = _parameters(model, parameters, len(inputs))
    x = finite_vector(initial_state, model.state_names, model.nominal_state, "initial_state")
    rng = np.random.default_rng(seed)
    pushed = _noise(Q, model.nx, "Q", rng, len(inputs))
    measurement_noise = _noise(R, model.ny, "R", rng, len(inputs))
    if len(inputs):
        # From a start that is not on the algebraic equations the first step, which is longer, may still find a way.
        with suppress(SolverError):
            x = onto_constraint(model, x, inputs[0], theta[0], length)
    step = ImplicitStep(DAEFunctions(model, integration), length)
    states, outputs, residuals = _recorded(step, inputs, theta, pushed, x)
    time = length * np.arange(len(inputs), dtype=np.float64)
    return Trajectory(states, outputs + measurement_noise, inputs, theta, time=time, residuals=residuals)


def _parameters(model: DAEModel, value: ArrayLike | None, samples: int) -> FloatArray:
    """Return the parameters at each sample ``(samples, nq)``."""
    if value is None or as_given(value, "parameters", "parameters has rows of different lengths.").ndim < 2:
        theta = finite_vector(value, model.parameter_names, model.nominal_parameters, "parameters")
        return np.tile(theta, (samples, 1))
    theta = as_matrix(value, "parameters")
    if theta.shape != (samples, model.nq):
        raise SpecError(
            f"parameters is {theta.shape}, but ({model.nq},) or ({samples}, {model.nq}) is needed.", path="parameters"
        )
    return theta


def _recorded(
    step: ImplicitStep, inputs: FloatArray, theta: FloatArray, pushed: FloatArray, start: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return states, outputs and residuals of a record from a start."""
    functions, samples = step.functions, len(inputs)
    states, outputs = np.zeros((samples, functions.model.nx)), np.zeros((samples, functions.model.ny))
    residuals, calls = np.zeros(samples), dict[int, Compiled]()

    def note(span: slice, solved_states: FloatArray, misses: FloatArray | float = 0.0) -> None:
        states[span], residuals[span] = solved_states, misses
        for k in range(span.start, span.stop):
            outputs[k] = functions.outputs(states[k], theta[k])[0]

    def together(k: int, length: int) -> int:
        """Take several steps in one call; return how many of them were solved."""
        if length not in calls:
            graphs, key = functions.model.graphs, ("simulated", functions.method, step.dt, length)
            if key not in graphs:
                graphs[key] = _simulated(step).mapaccum(length)
            calls[length] = Compiled(graphs[key])
        span = slice(k, k + length)
        arriving = np.hstack([inputs[span], theta[span], pushed[span]])
        after, verdicts = (part.T for part in calls[length](states[k - 1], arriving.ravel()))
        good = (verdicts[:, 1] == 1.0) & np.isfinite(after).all(axis=1)
        count = length if good.all() else int(np.argmin(good))
        note(slice(k, k + count), after[:count], verdicts[:count, 0])
        return count

    def alone(k: int) -> None:
        """Take one step that needs care."""
        x, u = states[k - 1], inputs[k]
        solution = step.solve(x, u, theta[k], before=inputs[k - 1], k=k)
        moved = solution.x
        if pushed[k].any():
            moved = moved + step.sensitivities(solution, x, u, theta[k])[2] @ pushed[k]
        note(slice(k, k + 1), moved[None], solution.residual)

    if samples:
        note(slice(0, 1), start[None])
    take_samples(samples, together, alone)
    return states, outputs, residuals


def _simulated(step: ImplicitStep) -> Any:
    """Return one step with noise: from a state and ``[u; theta; noise]`` to a state, and residual and verdict."""
    model = step.functions.model
    x, arriving = ca.MX.sym("x", model.nx), ca.MX.sym("arriving", model.nu + model.nq + model.nx)
    u, theta, noise = ca.vertsplit(arriving, [0, model.nu, model.nu + model.nq, arriving.shape[0]])
    stages, residual, trusted = step.graph.step(x, u, theta)
    effect = step.graph.sensitivities(stages, x, u, theta)[2]
    moved = stages[stages.shape[0] - model.nx :] + effect @ noise
    return ca.Function("simulated", [x, arriving], [moved, ca.vertcat(residual, trusted)])


def _noise(value: ArrayLike | None, size: int, name: str, rng: np.random.Generator, samples: int) -> FloatArray:
    if value is None:
        return np.zeros((samples, size))
    covariance = as_matrix(value, name)
    require_shape(covariance.shape, (size, size), name)
    return np.asarray(rng.standard_normal((samples, size)) @ covariance_factor(covariance, name).T)
