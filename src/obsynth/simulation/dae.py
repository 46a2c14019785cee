"""Simulating a DAE on its own equations, by default with Radau IIA: not with the observer's discretisation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.models.dae import DAEModel
from obsynth.models.dae_functions import DAEFunctions
from obsynth.models.dae_step import ImplicitStep
from obsynth.models.time_varying_checks import positive_dt
from obsynth.numerics.arrays import FloatArray, as_matrix, read_only
from obsynth.numerics.covariances import covariance_factor


@dataclass(frozen=True, eq=False)
class DAETrajectory:
    """A simulated record.

    Parameters
    ----------
    states : FloatArray
        ``(samples, nx)``.
    outputs : FloatArray
        ``(samples, ny)``, with noise.
    residuals : FloatArray
        ``(samples,)``: scaled Newton residual of each step.
    """

    states: FloatArray
    outputs: FloatArray
    residuals: FloatArray


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
    seed: int = 0,
) -> DAETrajectory:
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
        ``(nx,)``; nominal values by default.  It is taken as it is: the first step leads onto the constraint.
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
    DAETrajectory
        States, outputs with noise, and the residual of every step.

    Raises
    ------
    SpecError
        Shapes do not fit, or something is not finite.
    SolverError
        A step has no solution; k, iteration and worst equation are named.
    """
    inputs = as_matrix(u, "u") if model.nu else np.zeros((len(np.asarray(u)), 0))
    theta = model.nominal_parameters if parameters is None else np.asarray(parameters, dtype=np.float64)
    theta = np.tile(theta, (len(inputs), 1)) if theta.ndim == 1 else theta
    x = np.array(model.nominal_state if initial_state is None else initial_state, dtype=np.float64)
    if inputs.shape[1] != model.nu or theta.shape != (len(inputs), model.nq) or x.shape != (model.nx,):
        raise SpecError(
            f"u must be (samples, {model.nu}), parameters ({model.nq},) or (samples, {model.nq}), and initial_state "
            f"({model.nx},).", path="u",
        )  # fmt: skip
    rng = np.random.default_rng(seed)
    pushed = _noise(Q, model.nx, "Q", rng, len(inputs))
    heard = _noise(R, model.ny, "R", rng, len(inputs))
    functions = DAEFunctions(model, integration)
    step = ImplicitStep(functions, positive_dt(dt))
    states, outputs, residuals = [x], [functions.outputs(x, theta[0])[0]], [0.0]
    for k in range(1, len(inputs)):
        solution = step.solve(x, inputs[k], theta[k], before=inputs[k - 1], k=k)
        moved = solution.x
        if Q is not None:
            moved = moved + step.sensitivities(solution, x, inputs[k], theta[k]).noise @ pushed[k]
        x = moved
        states.append(x)
        outputs.append(functions.outputs(x, theta[k])[0])
        residuals.append(solution.residual)
    return DAETrajectory(
        read_only(np.array(states)), read_only(np.array(outputs) + heard), read_only(np.array(residuals))
    )


def _noise(value: ArrayLike | None, size: int, name: str, rng: np.random.Generator, samples: int) -> FloatArray:
    if value is None:
        return np.zeros((samples, size))
    covariance = as_matrix(value, name)
    if covariance.shape != (size, size):
        raise SpecError(f"{name} must be ({size}, {size}).", path=name)
    return np.asarray(rng.standard_normal((samples, size)) @ covariance_factor(covariance, name).T)
