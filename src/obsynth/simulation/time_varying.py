"""Consistent simulation of time-varying descriptor plants of index one."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from obsynth.analysis.time_varying import algebraic_rows
from obsynth.errors import PreconditionError, SpecError
from obsynth.numerics.arguments import real_array, real_vector, whole_number
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import decide_rank
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.simulation.trajectory import Trajectory, signal_of


def simulate_time_varying(
    plant: TimeVaryingDescriptorSystem,
    *,
    samples: int,
    parameters: ArrayLike | None = None,
    u: ArrayLike | None = None,
    initial_state: ArrayLike | None = None,
    equation_noise: ArrayLike | None = None,
    output_noise: ArrayLike | None = None,
) -> Trajectory:
    """Simulate a plant whose algebraic equations (rows of E that are zero for every k) determine the rest of the state.

    Parameters
    ----------
    plant : TimeVaryingDescriptorSystem
        As many equations as states; its horizon must reach ``samples`` steps, one more than the record, where it has
        algebraic equations (that of the last sample holds too).
    samples : int
        Length of the record, the start included.
    parameters : array_like, optional
        ``(samples, nq)``, or ``(nq,)`` for constant ones; zero by default.
    u : array_like, optional
        Known inputs ``(samples, nu)``.
    initial_state : array_like, optional
        ``(nx,)``: taken to the nearest state that satisfies the algebraic equations of k = 0.
    equation_noise, output_noise : array_like, optional
        mu ``(samples, ne)`` and nu ``(samples - 1, ny)``.  In an algebraic equation mu(k) acts on x(k) itself.

    Returns
    -------
    Trajectory
        States and outputs, and what drove them.

    Raises
    ------
    SpecError
        A record has the wrong shape.
    PreconditionError
        The state is not determined at some k: the index is higher than one there.
    """
    if plant.ne != plant.nx:
        raise SpecError(f"{plant.ne} equations do not determine {plant.nx} states.", path="E")
    nq, samples = plant.nq, whole_number(samples, "samples", "the length of the record")
    given = np.zeros(nq) if parameters is None else real_array(parameters, "parameters")
    whole = np.broadcast_to(given, (samples, nq)) if given.shape == (nq,) else given
    theta = signal_of(whole, "parameters", (samples, nq))
    inputs = signal_of(u, "u", (samples, plant.nu))
    mu = signal_of(equation_noise, "equation_noise", (samples, plant.ne))
    nu = signal_of(output_noise, "output_noise", (samples - 1, plant.ny))
    start = np.zeros(plant.nx) if initial_state is None else real_vector(initial_state, plant.nx, "initial_state")
    states, outputs = varying_runs(
        plant, parameters=theta, inputs=inputs, initial_state=start, equation_noise=mu[:, None],
        output_noise=nu[:, None],
    )  # fmt: skip
    time = plant.dt * np.arange(samples, dtype=np.float64)
    return Trajectory(states[:, 0], outputs[:, 0], inputs, theta, time=time)


def varying_runs(
    plant: TimeVaryingDescriptorSystem, *, parameters: FloatArray, inputs: FloatArray, initial_state: FloatArray,
    equation_noise: FloatArray, output_noise: FloatArray,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Simulate many runs at once, which differ in their noise: one factorisation a step serves all of them.

    ``equation_noise (samples, runs, ne)``, ``output_noise (samples - 1, runs, ny)``; the rest as one run has it.
    """
    if plant.ne != plant.nx:
        raise SpecError(f"{plant.ne} equations do not determine {plant.nx} states.", path="E")
    samples, runs = equation_noise.shape[:2]
    late = algebraic_rows(plant, plant.horizon or samples)
    others = np.setdiff1d(np.arange(plant.ne), late)

    def drive(k: int) -> FloatArray:
        """Return ``B u + Phi theta + mu``, ``(ne, runs)``."""
        known = plant.B.at(k) @ inputs[k] + plant.Phi.at(k) @ parameters[k]
        return np.asarray(known[:, None] + equation_noise[k].T)

    x = np.repeat(initial_state[:, None], runs, axis=1)
    if late.size:
        constraint = plant.A.at(0)[late]
        x = x - np.linalg.pinv(constraint) @ (constraint @ x + drive(0)[late])
    states, outputs = np.empty((samples, runs, plant.nx)), np.full((samples, runs, plant.ny), np.nan)
    states[0] = x.T
    for k in range(samples - 1):
        matrix, value = plant.E.at(k + 1)[others], (plant.A.at(k) @ x + drive(k))[others]
        if late.size:
            matrix = np.vstack([matrix, plant.A.at(k + 1)[late]])
            value = np.concatenate([value, -drive(k + 1)[late]])
        decision = decide_rank(matrix)
        if not decision.full:
            raise PreconditionError(
                f"The plant cannot be simulated step by step: at k = {k + 1} its equations do not determine the state "
                f"({decision.describe()}), so its index is higher than one there.", condition="index one",
            )  # fmt: skip
        x = np.asarray(np.linalg.solve(matrix, value), dtype=np.float64)
        states[k + 1] = x.T
        known = plant.Psi.at(k) @ parameters[k]
        outputs[k + 1] = (plant.C.at(k + 1) @ x + known[:, None]).T + output_noise[k]
    return states, outputs
