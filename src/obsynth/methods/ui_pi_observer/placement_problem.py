"""The placement problem of an unknown-input PI observer: decoupled inputs, movable poles, and the noise.

Share Pasand, Aliyari, Taghirad, Lemma 5, procedure 1; ours are the weights and the joint design over K and Z: their
free matrix G is itself an output injection, from the rows ``N_U A`` that the decoupling leaves over.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.analysis.existence.augmented_pencils import AugmentedPlant
from obsynth.conditions.augmented_plant import Decoupled, decouple, direct_part, paper_decoupling, with_faults
from obsynth.errors import SpecError
from obsynth.methods.engines.kalman_problem import KalmanProblem
from obsynth.numerics.arrays import ComplexArray, FloatArray, as_matrix, largest_singular_value
from obsynth.numerics.observable_part import ObservableSplit, observable_split
from obsynth.numerics.pencils import finite_zeros
from obsynth.numerics.ranks import product_but_rounding
from obsynth.numerics.spectra import DEAD_BEAT, eigenvalues, moving_speeds
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.faults import Exosystem
from obsynth.plants.pencil import shown_modes, structure_of
from obsynth.plants.plant_units import PlantUnits, noise_inputs

#: Where all modes are slower than this share of the pair's size, they are integrators that rounding has scattered.
INTEGRATOR_SCATTER = 3e-5

#: Poles of sampled plants are not asked to decay by more than this exponent in one sample: nearer to zero they cannot
#: be distinguished, and printed gains miss them.
MOST_PER_SAMPLE = 2.0

#: How strongly states are driven by default, beside fault models: a plant is better known than the course of a fault.
PROCESS_SHARE = 0.1

#: Noise on innovations that have none of their own, relative to the outputs' noise.
INNOVATION_NOISE = 0.1


@dataclass(frozen=True, eq=False)
class PlacementProblem:
    """A decoupled plant in units of its own, and the pair whose poles are to be placed."""

    plant: DescriptorSystem
    model: Exosystem  # of its faults, scaled
    units: PlantUnits  # between the user's plant and the scaled one
    decoupled: Decoupled
    U: FloatArray  # (na, na), of the scaled augmented plant, without the free part
    D: FloatArray  # (na, ny)
    F: FloatArray  # (na, na)
    C: FloatArray  # (rows, na); its first ``free`` rows are those of the free part Z
    free: int  # 0 unless K and Z are designed together
    split: ObservableSplit  # of the pair
    rate: float  # median of abs(s) over the plant's modes, in scaled time

    def gains(self, placed: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return U, D and K in the user's units for one of the observable part ``(no, rows)``."""
        k = self.split.lift(placed)
        u, d, k = _completed(self, k)
        states, outputs = self.units.augmented_states[:, None], self.units.outputs
        return states * u * self.units.augmented_equations, states * d * outputs, states * k * outputs / self.units.rate

    @property
    def fixed_modes(self) -> ComplexArray:
        """Poles that no gain moves, in the user's time."""
        return self.units.eigenvalues(self.split.fixed_modes)


def placement_problem(
    plant: DescriptorSystem,
    model: Exosystem,
    fixed_modes: ComplexArray,
    *,
    joint: bool = False,
    paper_matrices: Mapping[str, Any] | None = None,
) -> PlacementProblem:
    """Return the pair to place; the existence conditions must hold."""
    units = PlantUnits.of(plant, model).for_decoupling(plant)
    if paper_matrices is not None:
        # Powers of two: the given numbers come back as they are.
        units = units.rounded()
    scaled, model = units.scaled_plant(plant), units.scaled_model(model)
    decoupled = decouple(scaled) if paper_matrices is None else _given_decoupling(plant, units, paper_matrices)
    u, d = with_faults(decoupled.U, decoupled.Dhat, scaled, model)
    augmented = AugmentedPlant.of(scaled, model)
    injection = np.vstack([decoupled.injection, np.zeros((model.order, plant.ny))])
    injected = product_but_rounding(-injection, augmented.C, augmented.A)
    f, c = product_but_rounding(u, injected), product_but_rounding(decoupled.undisturbed, augmented.C)
    fixed_modes = units.rate * fixed_modes
    free = 0
    if joint:
        more, _ = _free_part(decoupled, scaled, model)
        c, free = np.vstack([more @ injected, c]), len(more)
    if paper_matrices is not None:
        # Another U may have other unobservable modes than the plant's pencil.
        n = len(f)
        fixed_modes = finite_zeros(np.vstack([np.eye(n), np.zeros((len(c), n))]), np.vstack([f, c])).values
    split = observable_split(f, c, fixed_modes, dt=scaled.dt, exact_rows=model.order)
    return PlacementProblem(
        plant=scaled,
        model=model,
        units=units,
        decoupled=decoupled,
        U=u,
        D=d,
        F=f,
        C=c,
        free=free,
        split=split,
        rate=_own_rate(scaled, split),
    )


def _free_part(decoupled: Decoupled, plant: DescriptorSystem, model: Exosystem) -> tuple[FloatArray, FloatArray]:
    return np.hstack([decoupled.free_U, -decoupled.free_D @ plant.Df @ model.Cw]), decoupled.free_D


def _completed(problem: PlacementProblem, k: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return U_a, D_a, K_a of the scaled plant: the gain of the pair is ``[-Z K]``."""
    decoupled, plant, model = problem.decoupled, problem.plant, problem.model
    u, d = problem.U, problem.D
    if problem.free:
        more_u, more_d = _free_part(decoupled, plant, model)
        z = -k[:, : problem.free]
        u, d = u + z @ more_u, d + z @ more_d
    injection = np.vstack([decoupled.injection, np.zeros((model.order, plant.ny))])
    return u, d, k[:, problem.free :] @ decoupled.undisturbed + u @ injection


def _given_decoupling(plant: DescriptorSystem, units: PlantUnits, paper_matrices: Mapping[str, Any]) -> Decoupled:
    if plant.Dd.any():
        raise SpecError("E_sharp, C_sharp and G are for plants without Dd: leave them out.", path="E_sharp")
    matrices = [as_matrix(paper_matrices[name], name) for name in ("E_sharp", "C_sharp", "G")]
    _, u, d = paper_decoupling(plant, e_sharp=matrices[0], c_sharp=matrices[1], g=matrices[2])
    undisturbed, injection, _ = direct_part(plant)
    u = u / units.states[:, None] / units.equations
    d = d / units.states[:, None] / units.outputs
    return Decoupled(u, d, np.zeros((0, plant.nx)), np.zeros((0, plant.ny)), undisturbed, injection)


def _own_rate(plant: DescriptorSystem, split: ObservableSplit) -> float:
    """Return the median speed of the modes that the outputs show; of the pair's where there are none; or its size."""
    size = largest_singular_value(split.F)
    # A plant's mode that no output shows is fixed: without fixed modes there is none.
    shown = shown_modes(plant) if split.fixed_modes.size else structure_of(plant).finite_eigenvalues
    for values in (shown, eigenvalues(split.F)):
        speeds = moving_speeds(values, plant.dt, 1.0 / plant.dt if plant.dt > 0.0 else 0.0)
        speeds = speeds[speeds > DEAD_BEAT]
        if speeds.size and (plant.dt > 0.0 or np.max(speeds) > INTEGRATOR_SCATTER * size):
            median = float(np.median(speeds))
            return min(median, MOST_PER_SAMPLE / plant.dt) if plant.dt > 0.0 else median
        if plant.dt > 0.0 and values.size and np.all(np.abs(values) <= DEAD_BEAT):
            # A plant that stops within its order of samples; those of the pair depend on coordinates and sensors.
            return MOST_PER_SAMPLE / plant.dt
    return 1.0 / plant.dt if plant.dt > 0.0 else size or 1.0


def kalman_problem(problem: PlacementProblem, weights: Mapping[str, Any]) -> KalmanProblem:
    """Return the observable part of the pair with its noise, in the coordinates of the split.

    ``weights``: what the Kalman filter believes beside what the plant states: ``measurement``, the deviation of each
    output's noise (a number or by name; continuous time: times the root of a second), and ``process`` and ``fault``,
    relative to the default.
    """
    plant, split = problem.plant, problem.split
    order = problem.model.order
    bw, dw = noise_inputs(problem.plant, problem.units, weights.get("measurement"))
    augmented_bw = np.vstack([bw, np.zeros((order, bw.shape[1]))])
    injection = np.vstack([problem.decoupled.injection, np.zeros((order, plant.ny))])
    driving = problem.U @ augmented_bw - problem.F @ problem.D @ dw - problem.U @ injection @ dw
    innovation_map = np.eye(plant.ny) - AugmentedPlant.of(plant, problem.model).C @ problem.D
    measured = problem.decoupled.undisturbed @ innovation_map @ dw
    size = float(np.sqrt(np.mean(np.sum(dw**2, axis=1)))) if dw.any() else 1.0
    if problem.free:
        # The free outputs carry the noise of derivatives; as a stand-in they get the size of the others.
        driving = np.hstack([driving, np.zeros((len(driving), problem.free))])
        measured = np.block(
            [
                [np.zeros((problem.free, measured.shape[1])), size * np.eye(problem.free)],
                [measured, np.zeros((len(measured), problem.free))],
            ]
        )
    per_step = problem.rate * (plant.dt if plant.dt > 0.0 else 1.0)
    strength = np.concatenate(
        [np.full(plant.nx, PROCESS_SHARE * weights.get("process", 1.0)), np.full(order, weights.get("fault", 1.0))]
    )
    faults = np.hstack([np.zeros((plant.nf, plant.nx)), problem.model.Cw])
    return KalmanProblem(
        F=split.F,
        C=split.C,
        B=split.observable_rows(driving),
        D=measured,
        drive=split.basis[:, : split.order].T @ np.diag(per_step * size * strength),
        background=INNOVATION_NOISE * size * np.eye(len(problem.C)),
        estimates=split.observable_columns(faults),
        dt=plant.dt,
    )
