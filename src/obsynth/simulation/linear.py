"""Simulation of linear descriptor systems of index 0 or 1: many runs ``(steps, runs, signals)`` at once.

Algebraic equations are solved first; continuous plants step by the matrix exponential, exact for signals that are
constant or linear between samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from obsynth.analysis.time_varying import algebraic_rows
from obsynth.errors import PreconditionError, SpecError
from obsynth.numerics.arguments import arguments_checked, real_array, real_vector, whole_number
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.continuous import first_order_hold
from obsynth.numerics.libraries import failed_computations
from obsynth.numerics.linear_recursions import driven
from obsynth.numerics.matrix_equations import continuous_riccati, discrete_riccati
from obsynth.numerics.ranks import decide_rank
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.plants.transformations.delays import absorb_delays
from obsynth.plants.transformations.elimination import eliminate_algebraic_states
from obsynth.plants.transformations.recovery import StateRecovery
from obsynth.plants.transformations.sampling import discretise
from obsynth.simulation.scenario import Scenario
from obsynth.simulation.signals import ScenarioSignals, resolve, signal_of, signals_of
from obsynth.simulation.trajectory import Trajectory

#: States, outputs as measured, inputs, faults and disturbances of several runs, ``(steps, runs, signals)`` each.
PlantRuns: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]


def simulate_plant(
    plant: DescriptorSystem,
    *,
    steps: int,
    u: ArrayLike | None = None,
    f: ArrayLike | None = None,
    d: ArrayLike | None = None,
    w: ArrayLike | None = None,
    initial_state: ArrayLike | None = None,
) -> Trajectory:
    """Simulate a discrete plant from ``initial_state (nx,)``; every row satisfies its equations up to rounding."""
    if not plant.is_discrete:
        raise SpecError(
            "The plant is continuous: sample it first, with obsynth.discretise or transform: {sample_time: ...}.",
            path="dt",
        )
    steps = whole_number(steps, "steps", "a whole number of samples")
    signals = signals_of(plant, steps, u=u, f=f, d=d, w=w)
    start = np.zeros(plant.nx) if initial_state is None else real_vector(initial_state, plant.nx, "initial_state")
    if plant.delays:
        return _with_delays(plant, steps, signals, start)
    elimination = eliminate_algebraic_states(plant)
    reduced, recovery = elimination.plant, elimination.recovery
    drive = _sum_of(signals, {"u": reduced.B, "f": reduced.Bf, "d": reduced.Bd, "w": reduced.Bw})
    dynamic = driven(reduced.A, dynamic_part(plant, recovery, start), drive)
    _require_finite(dynamic, "simulate fewer steps", "steps")
    following = {"u": recovery.from_input, "f": recovery.from_fault, "d": recovery.from_disturbance}
    states = dynamic @ recovery.from_state.T + _sum_of(signals, {**following, "w": recovery.from_noise})
    outputs = states @ plant.C.T + _sum_of(signals, {"u": plant.D, "f": plant.Df, "d": plant.Dd, "w": plant.Dw})
    inconsistency = 0.0 if initial_state is None else float(np.linalg.norm(states[0] - start))
    return Trajectory(
        states,
        outputs,
        signals["u"],
        signals["f"],
        signals["d"],
        signals["w"],
        time=plant.dt * np.arange(steps, dtype=np.float64),
        inconsistency=inconsistency,
    )


def _with_delays(plant: DescriptorSystem, steps: int, signals: dict[str, FloatArray], start: FloatArray) -> Trajectory:
    """Return what a plant with delays does; nothing is on its way at the start."""
    absorbed, elimination = absorb_delays(plant), eliminate_algebraic_states(plant)
    moving = dynamic_part(plant, elimination.recovery, start)
    augmented, recovery = absorbed.plant, absorbed.recovery
    first = np.concatenate([moving, np.zeros(augmented.nx - len(moving))])
    run = simulate_plant(augmented, steps=steps, initial_state=first, **signals)
    following = {
        "u": recovery.from_input,
        "f": recovery.from_fault,
        "d": recovery.from_disturbance,
        "w": recovery.from_noise,
    }
    states = run.states @ recovery.from_state.T + _sum_of(signals, following)
    inconsistency = float(np.linalg.norm(states[0] - start)) if np.any(start) else 0.0
    return replace(run, states=states, inconsistency=inconsistency)


def _sum_of(signals: dict[str, FloatArray], matrices: dict[str, FloatArray]) -> FloatArray:
    """Return the sum of ``signal @ matrix.T`` over all signals."""
    first, *more = (np.asarray(signals[name] @ matrix.T) for name, matrix in matrices.items())
    return sum(more, start=first)


def dynamic_part(plant: DescriptorSystem, recovery: StateRecovery, state: FloatArray) -> FloatArray:
    """Return the coordinates of the dynamic states with the same ``E x``; the rest of x adds nothing to it."""
    moving = plant.E @ recovery.from_state
    sizes = np.max(np.abs(moving), axis=1)
    sizes[sizes == 0.0] = 1.0
    # The equations are consistent, so weighting rows changes nothing but accuracy.
    q, r = np.linalg.qr(moving / sizes[:, None])
    return np.asarray(np.linalg.solve(r, q.T @ (plant.E @ state / sizes)))


def _require_finite(states: FloatArray, advice: str, path: str) -> None:
    """Raise `SpecError` where states ``(steps, ...)`` overflow."""
    finite = np.isfinite(states).reshape(len(states), -1).all(axis=1)
    if not finite.all():
        raise SpecError(
            f"The states outgrow double precision at sample {int(np.argmin(finite))}: the plant is unstable; {advice}.",
            path=path,
        )


@dataclass(frozen=True, eq=False)
class Stepper:
    """A plant that steps: ``x+ = transition x + held s + ramped (s_right - s_left) + noisy w``, s = [u; f; d]."""

    transition: FloatArray
    held: FloatArray
    ramped: FloatArray
    noisy: FloatArray
    state_of: tuple[FloatArray, FloatArray, FloatArray]  # plant states from x, s and w
    output_of: tuple[FloatArray, FloatArray, FloatArray]  # outputs from them
    start: FloatArray
    feedback: FloatArray | None  # (nu, n): u = s_u - feedback x, inside the other matrices

    def run(
        self, signals: FloatArray, differences: FloatArray, noise: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return states, outputs (free of sensor faults) and inputs' feedback part of all runs."""
        drive = signals @ self.held.T + differences @ self.ramped.T + noise @ self.noisy.T
        x = driven(self.transition, self.start, drive)
        _require_finite(x, "shorten the horizon, or set stabilise", "horizon")

        def output_of(parts: tuple[FloatArray, FloatArray, FloatArray]) -> FloatArray:
            return np.asarray(x @ parts[0].T + signals @ parts[1].T + noise @ parts[2].T)

        fed = np.zeros((*x.shape[:2], 0)) if self.feedback is None else -x @ self.feedback.T
        return output_of(self.state_of), output_of(self.output_of), fed


def make_stepper(
    plant: DescriptorSystem, drive: ScenarioSignals, *, initial_state: FloatArray, stabilise: bool
) -> Stepper:
    """Return the stepper of ``plant`` for the sampling of ``drive``, from ``initial_state (nx,)``."""
    elimination = eliminate_algebraic_states(plant)
    reduced, recovery = elimination.plant, elimination.recovery
    start = dynamic_part(plant, recovery, initial_state)
    gain = stabilising_feedback(reduced) if stabilise else None
    closing = np.zeros((reduced.nu, reduced.nx)) if gain is None else gain
    a = reduced.A - reduced.B @ closing
    inputs = np.hstack([reduced.B, reduced.Bf, reduced.Bd])
    if plant.is_discrete:
        transition, held, ramped = a, inputs, np.zeros_like(inputs)
        noisy, measurement_noise = reduced.Bw, reduced.Dw
        state_noise = recovery.from_noise
    else:
        transition, held, ramped = first_order_hold(a, inputs, drive.dt)
        noisy, measurement_noise, state_noise = _sampled_noise(reduced, recovery, a, drive)
    direct = np.hstack([recovery.from_input, recovery.from_fault, recovery.from_disturbance])
    return Stepper(
        transition,
        held,
        ramped,
        noisy,
        (recovery.from_state - recovery.from_input @ closing, direct, state_noise),
        (reduced.C - reduced.D @ closing, np.hstack([reduced.D, reduced.Df, reduced.Dd]), measurement_noise),
        start,
        gain,
    )


def scenario_stepper(
    plant: DescriptorSystem, scenario: Scenario, initial_state: FloatArray
) -> tuple[ScenarioSignals, Stepper]:
    """Return what acts on a plant in a scenario, and the stepper for it from ``initial_state (nx,)``."""
    drive = resolve(plant, scenario)
    return drive, make_stepper(plant, drive, initial_state=initial_state, stabilise=scenario.stabilise)


def scenario_runs(drive: ScenarioSignals, stepper: Stepper, parts: tuple[int, int], seeds: Sequence[int]) -> PlantRuns:
    """Run a linear plant over a scenario; ``parts``: where faults and disturbances begin among its signals."""
    drawn, noise, sensor_noise = drive.drawn(seeds, stepper.noisy.shape[1])
    at_begin = drive.at_begin[:, None, :] + drawn
    difference = np.broadcast_to((drive.at_end - drive.at_begin)[:, None, :], at_begin.shape)
    states, clean, fed = stepper.run(at_begin, difference, noise)
    inputs, faults, disturbances = np.split(at_begin, parts, axis=2)
    if fed.shape[2]:
        inputs = inputs + fed
    return states, drive.measured(clean + sensor_noise), inputs, faults, disturbances


def _sampled_noise(
    reduced: DescriptorSystem, recovery: StateRecovery, a: FloatArray, drive: ScenarioSignals
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return noise matrices over a sample: process noise gathered in it, sensor noise as it is."""
    if not drive.noise:
        return np.zeros((reduced.nx, 0)), np.zeros((reduced.ny, 0)), np.zeros((len(recovery.names), 0))
    if recovery.from_noise.any():
        raise PreconditionError(
            "Process noise enters an algebraic equation, where continuous white noise has infinite variance: filter it "
            "by a state, or leave the noise out (noise: 0).",
            condition="noise without a direct path",
        )
    sampled = discretise(reduced.replace(A=a), drive.dt).plant
    return sampled.Bw, sampled.Dw, np.zeros((len(recovery.names), sampled.nw))


@failed_computations()
def stabilising_feedback(plant: DescriptorSystem) -> FloatArray:
    """Return the linear-quadratic state feedback with unit weights of a plant with ``E = I``."""

    weights = np.eye(plant.nx), np.eye(plant.nu)
    try:
        if not plant.nu:
            raise np.linalg.LinAlgError("no input")
        if plant.is_discrete:
            cost = discrete_riccati(plant.A, plant.B, *weights)
            gain = np.linalg.solve(weights[1] + plant.B.T @ cost @ plant.B, plant.B.T @ cost @ plant.A)
        else:
            gain = plant.B.T @ continuous_riccati(plant.A, plant.B, *weights)
    except np.linalg.LinAlgError as error:
        raise PreconditionError(
            f"No state feedback stabilises this plant ({error}): its known inputs must reach every unstable mode.",
            condition="stabilisability",
        ) from error
    return np.asarray(gain, dtype=np.float64)


@arguments_checked
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

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.TimeVaryingDescriptorSystem(
    ...     E=None, A=[["0.9 + 0.05 * sin(k)"]], C=[[1.0]], Phi=[[1.0]], dt=1.0, parameter_names=["leak"]
    ... )
    >>> run = obsynth.simulate_time_varying(plant, samples=50, parameters=[0.1])
    >>> run.outputs.shape
    (50, 1)
    """
    nq, samples = plant.nq, whole_number(samples, "samples", "the length of the record")
    values = np.zeros(nq) if parameters is None else real_array(parameters, "parameters")
    record = np.broadcast_to(values, (samples, nq)) if values.shape == (nq,) else values
    theta = signal_of(record, "parameters", (samples, nq))
    inputs = signal_of(u, "u", (samples, plant.nu))
    mu = signal_of(equation_noise, "equation_noise", (samples, plant.ne))
    nu = signal_of(output_noise, "output_noise", (samples - 1, plant.ny))
    start = np.zeros(plant.nx) if initial_state is None else real_vector(initial_state, plant.nx, "initial_state")
    states, outputs = varying_runs(
        plant,
        parameters=theta,
        inputs=inputs,
        initial_state=start,
        equation_noise=mu[:, None],
        output_noise=nu[:, None],
    )
    time = plant.dt * np.arange(samples, dtype=np.float64)
    return Trajectory(states[:, 0], outputs[:, 0], inputs, theta, time=time)


def varying_runs(
    plant: TimeVaryingDescriptorSystem,
    *,
    parameters: FloatArray,
    inputs: FloatArray,
    initial_state: FloatArray,
    equation_noise: FloatArray,
    output_noise: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Simulate many runs with ``equation_noise (samples, runs, ne)`` and ``output_noise (samples - 1, runs, ny)``."""
    if plant.ne != plant.nx:
        raise SpecError(f"{plant.ne} equations do not determine {plant.nx} states.", path="E")
    samples, runs = equation_noise.shape[:2]
    algebraic = algebraic_rows(plant, plant.horizon or samples)
    dynamic_rows = np.setdiff1d(np.arange(plant.ne), algebraic)

    def drive(k: int) -> FloatArray:
        """Return ``B u + Phi theta + mu``, ``(ne, runs)``."""
        known = plant.B.at(k) @ inputs[k] + plant.Phi.at(k) @ parameters[k]
        return np.asarray(known[:, None] + equation_noise[k].T)

    x = np.repeat(initial_state[:, None], runs, axis=1)
    if algebraic.size:
        constraint = plant.A.at(0)[algebraic]
        x = x - np.linalg.pinv(constraint) @ (constraint @ x + drive(0)[algebraic])
    states, outputs = np.empty((samples, runs, plant.nx)), np.full((samples, runs, plant.ny), np.nan)
    states[0] = x.T
    for k in range(samples - 1):
        matrix, value = plant.E.at(k + 1)[dynamic_rows], (plant.A.at(k) @ x + drive(k))[dynamic_rows]
        if algebraic.size:
            matrix = np.vstack([matrix, plant.A.at(k + 1)[algebraic]])
            value = np.concatenate([value, -drive(k + 1)[algebraic]])
        decision = decide_rank(matrix)
        if not decision.full:
            raise PreconditionError(
                f"The plant cannot be simulated step by step: at k = {k + 1} its equations do not determine the state "
                f"({decision.describe()}), so its index is higher than one there.",
                condition="index one",
            )
        x = np.asarray(np.linalg.solve(matrix, value), dtype=np.float64)
        states[k + 1] = x.T
        known = plant.Psi.at(k) @ parameters[k] + plant.D.at(k + 1) @ inputs[k + 1]
        outputs[k + 1] = (plant.C.at(k + 1) @ x + known[:, None]).T + output_noise[k]
    return states, outputs
