"""Plants of index 0 or 1, many runs at once, and exact between samples.

The algebraic equations are solved first; what is left steps by a recursion (discrete plants) or by the matrix
exponential over a sampling interval (continuous ones), which is exact for signals that are constant or linear between
samples.  All arrays of runs are ``(steps, runs, signals)``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsynth.analysis.transformations import StateRecovery, discretise, eliminate_algebraic_states
from obsynth.errors import PreconditionError, SpecError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.holds import first_order_hold
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.simulation.linear import dynamic_part
from obsynth.simulation.scenario_signals import Drive


@dataclass(frozen=True, eq=False)
class Stepper:
    """A plant as what steps from sample to sample; plain arrays, so that it can go to another process.

    Fields: transition, held, ramped, noisy: ``x+ = transition x + held s + ramped (s_right - s_left) + noisy w``, with
    s = [u; f; d] and x the dynamic states; state_of, output_of: Plant states and outputs from x, s and w; start:
    Dynamic states at the start; feedback: ``(nu, n)``: ``u = s_u - feedback x``, already inside the other matrices.
    """

    transition: FloatArray
    held: FloatArray
    ramped: FloatArray
    noisy: FloatArray
    state_of: tuple[FloatArray, FloatArray, FloatArray]
    output_of: tuple[FloatArray, FloatArray, FloatArray]
    start: FloatArray
    feedback: FloatArray | None

    def run(
        self, signals: FloatArray, differences: FloatArray, noise: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return states, outputs (free of sensor faults) and inputs' feedback part of all runs.

        Shapes: ``signals (steps, runs, nu + nf + nd)``, ``differences (steps, runs, nu + nf + nd)``, ``noise (steps,
        runs, nw)``.
        """
        drive = signals @ self.held.T + differences @ self.ramped.T + noise @ self.noisy.T
        x = np.empty_like(drive)
        x[0] = self.start
        turned = np.ascontiguousarray(self.transition.T)
        with np.errstate(over="ignore", invalid="ignore"):
            for k in range(len(drive) - 1):
                x[k + 1] = x[k] @ turned + drive[k]
        finite = np.isfinite(x).all(axis=(1, 2))
        if not finite.all():
            raise SpecError(
                f"The states outgrow double precision at sample {int(np.argmin(finite))}: the plant is unstable; "
                "shorten the horizon, or set stabilise.", path="horizon",
            )  # fmt: skip

        def seen(parts: tuple[FloatArray, FloatArray, FloatArray]) -> FloatArray:
            return np.asarray(x @ parts[0].T + signals @ parts[1].T + noise @ parts[2].T)

        fed = np.zeros((*x.shape[:2], 0)) if self.feedback is None else -x @ self.feedback.T
        return seen(self.state_of), seen(self.output_of), fed


def make_stepper(plant: DescriptorSystem, drive: Drive, *, initial_state: FloatArray, stabilise: bool) -> Stepper:
    """Return the stepper of ``plant`` for the sampling of ``drive``.

    Shapes: ``initial_state (nx,)``.
    """
    elimination = eliminate_algebraic_states(plant)
    reduced, recovery = elimination.plant, elimination.recovery
    start = dynamic_part(plant, recovery, initial_state)
    gain = _stabilising(reduced) if stabilise else None
    closing = np.zeros((reduced.nu, reduced.nx)) if gain is None else gain
    a = reduced.A - reduced.B @ closing
    inputs = np.hstack([reduced.B, reduced.Bf, reduced.Bd])
    if plant.is_discrete:
        transition, held, ramped = a, inputs, np.zeros_like(inputs)
        noisy, heard = reduced.Bw, reduced.Dw
        shown = recovery.from_noise
    else:
        transition, held, ramped = first_order_hold(a, inputs, drive.dt)
        noisy, heard, shown = _sampled_noise(reduced, recovery, a, drive)
    direct = np.hstack([recovery.from_input, recovery.from_fault, recovery.from_disturbance])
    return Stepper(
        transition, held, ramped, noisy,
        (recovery.from_state - recovery.from_input @ closing, direct, shown),
        (reduced.C - reduced.D @ closing, np.hstack([reduced.D, reduced.Df, reduced.Dd]), heard),
        start, gain,
    )  # fmt: skip


def _sampled_noise(
    reduced: DescriptorSystem, recovery: StateRecovery, a: FloatArray, drive: Drive
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return noise matrices over a sample: process noise gathered in it, sensor noise as it is."""
    if not drive.noise:
        return np.zeros((reduced.nx, 0)), np.zeros((reduced.ny, 0)), np.zeros((len(recovery.names), 0))
    if recovery.from_noise.any():
        raise PreconditionError(
            "Process noise enters an algebraic equation, where continuous white noise has infinite variance: filter it "
            "by a state, or leave the noise out (noise: 0).", condition="noise without a direct path",
        )  # fmt: skip
    sampled = discretise(reduced.replace(A=a), drive.dt).plant
    return sampled.Bw, sampled.Dw, np.zeros((len(recovery.names), sampled.nw))


def _stabilising(plant: DescriptorSystem) -> FloatArray:
    """Return the linear-quadratic state feedback with unit weights of a plant with ``E = I``."""
    from scipy.linalg import solve_continuous_are, solve_discrete_are

    weights = np.eye(plant.nx), np.eye(plant.nu)
    try:
        if not plant.nu:
            raise np.linalg.LinAlgError("no input")
        if plant.is_discrete:
            cost = solve_discrete_are(plant.A, plant.B, *weights)
            gain = np.linalg.solve(weights[1] + plant.B.T @ cost @ plant.B, plant.B.T @ cost @ plant.A)
        else:
            gain = plant.B.T @ solve_continuous_are(plant.A, plant.B, *weights)
    except np.linalg.LinAlgError as error:
        raise PreconditionError(
            f"No state feedback stabilises this plant ({error}): its known inputs must reach every unstable mode.",
            condition="stabilisability",
        ) from error
    return np.asarray(gain, dtype=np.float64)
