"""The noise that an unknown-input PI observer is designed for: what sensors and states are believed to do.

Source: Share Pasand, Aliyari, Taghirad mention "the optimal estimation scheme of Kalman" and no noise; the weights are
ours.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.methods.placement.kalman import KalmanProblem
from obsynth.methods.ui_pi_observer.augmented_plant import AugmentedPlant
from obsynth.methods.ui_pi_observer.placement_problem import PlacementProblem
from obsynth.numerics.arrays import FloatArray

#: How strongly states are driven by default, beside fault models: a plant is better known than the course of a fault.
PROCESS_SHARE = 0.1
#: Noise on innovations that have none of their own, relative to the outputs' noise.
BACKGROUND_NOISE = 0.1


@dataclass(frozen=True)
class NoiseWeights:
    """What the Kalman filter believes, beside what the plant states.

    Fields: measurement: Standard deviation of each output's noise, one number or by name, in the output's unit (times
    the square root of a second in continuous time); the plant's own noise, or one in scaled units, by default; process,
    fault: How strongly states and fault models are driven, relative to the default.
    """

    measurement: Any = None
    process: float = 1.0
    fault: float = 1.0


def kalman_problem(problem: PlacementProblem, weights: NoiseWeights) -> KalmanProblem:
    """Return the observable part of the pair with its noise, in the coordinates of the split."""
    plant, split = problem.plant, problem.split
    order = problem.model.order
    bw, dw = _noise(problem, weights)
    augmented_bw = np.vstack([bw, np.zeros((order, bw.shape[1]))])
    injection = np.vstack([problem.decoupled.injection, np.zeros((order, plant.ny))])
    entering = problem.U @ augmented_bw - problem.F @ problem.D @ dw - problem.U @ injection @ dw
    shown = np.eye(plant.ny) - AugmentedPlant.of(plant, problem.model).C @ problem.D
    measured = problem.decoupled.seen @ shown @ dw
    size = float(np.sqrt(np.mean(np.sum(dw**2, axis=1)))) if dw.any() else 1.0
    if problem.free:
        # The free outputs carry the noise of derivatives; as a stand-in they get the size of the others.
        entering = np.hstack([entering, np.zeros((len(entering), problem.free))])
        measured = np.block([
            [np.zeros((problem.free, measured.shape[1])), size * np.eye(problem.free)],
            [measured, np.zeros((len(measured), problem.free))],
        ])  # fmt: skip
    per_step = problem.rate * (plant.dt if plant.dt > 0.0 else 1.0)
    strength = np.concatenate([np.full(plant.nx, PROCESS_SHARE * weights.process), np.full(order, weights.fault)])
    faults = np.hstack([np.zeros((plant.nf, plant.nx)), problem.model.Cw])
    return KalmanProblem(
        F=split.F,
        C=split.C,
        B=split.lower(entering),
        D=measured,
        drive=split.basis[:, : split.order].T @ np.diag(per_step * size * strength),
        background=BACKGROUND_NOISE * size * np.eye(len(problem.C)),
        estimates=split.shown(faults),
        dt=plant.dt,
    )


def _noise(problem: PlacementProblem, weights: NoiseWeights) -> tuple[FloatArray, FloatArray]:
    """Return the noise inputs of the scaled plant."""
    plant, units = problem.plant, problem.units
    if weights.measurement is None:
        if plant.Dw.any():
            return plant.Bw, plant.Dw
        return np.hstack([plant.Bw, np.zeros((plant.nx, plant.ny))]), np.hstack([
            np.zeros((plant.ny, plant.nw)), np.eye(plant.ny),
        ])  # fmt: skip
    given = weights.measurement
    deviations = np.array([given[name] if isinstance(given, Mapping) else given for name in plant.output_names])
    deviations = deviations * units.outputs / (1.0 if units.discrete else np.sqrt(units.time))
    return (
        np.hstack([plant.Bw, np.zeros((plant.nx, plant.ny))]),
        np.hstack([np.zeros((plant.ny, plant.nw)), np.diag(deviations)]),
    )
