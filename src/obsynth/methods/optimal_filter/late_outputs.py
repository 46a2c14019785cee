"""Delayed outputs: a sampled plant with delayed outputs, and how many samples a filter looks ahead in the inputs."""

from __future__ import annotations

import numpy as np
from scipy.linalg import block_diag

from obsynth.methods.optimal_filter.weights import in_series
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.decoupling_windows import Model, first_responses
from obsynth.numerics.standard_form import standard_form
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.plant_units import PlantUnits

#: A response to later inputs is more than rounding above this share of the terms that cancel in it.
LATER_SHARE = 1e-6


def later_inputs(plant: DescriptorSystem, filter_: Model) -> int:
    """Return by how many samples the estimates of a filter precede the latest inputs g that they depend on.

    In ``E x+ = A x + g``, outputs of a plant of index 2 or more depend on later samples of g.  A filter may cancel
    these terms.
    """
    units = PlantUnits.of(plant).rounded()
    equations, outputs = units.equations[:, None], units.outputs[:, None]
    e, a, c = equations * plant.E * units.states, equations * plant.A * units.states, outputs * plant.C * units.states
    form = standard_form(e, a, np.eye(plant.nx), c, np.zeros((plant.ny, plant.nx)), plant.dt)
    own = filter_[0], filter_[1] / units.outputs, filter_[2], filter_[3] / units.outputs
    shown = first_responses(in_series(form[:4], own), form.shift)
    sizes = [
        sum(float(np.linalg.norm(part)) for part in first_responses(model, form.shift)) for model in (own, form[:4])
    ]
    reached = [float(np.linalg.norm(part)) > LATER_SHARE * sizes[0] * sizes[1] for part in shown]
    return form.shift - reached.index(True) if any(reached) else 0


def with_late_outputs(plant: DescriptorSystem, samples: int) -> DescriptorSystem:
    """Return a sampled plant whose outputs are delayed by some samples; the delayed ones are additional last states."""
    ny, count = plant.ny, plant.ny * samples
    late = np.zeros((count, plant.nx))
    late[:ny] = plant.C

    def below(columns: FloatArray, through: FloatArray) -> FloatArray:
        entering = np.zeros((count, columns.shape[1]))
        entering[:ny] = through
        return np.vstack([columns, entering])

    return DescriptorSystem(
        E=block_diag(plant.E, np.eye(count)),
        A=np.block([[plant.A, np.zeros((plant.nx, count))], [late, np.eye(count, k=-ny)]]),
        C=np.hstack([np.zeros((ny, plant.nx + count - ny)), np.eye(ny)]),
        B=below(plant.B, plant.D),
        Bf=below(plant.Bf, plant.Df),
        Bd=below(plant.Bd, plant.Dd),
        Bw=below(plant.Bw, plant.Dw),
        dt=plant.dt,
        input_names=plant.input_names,
        output_names=plant.output_names,
        fault_names=plant.fault_names,
        disturbance_names=plant.disturbance_names,
        noise_names=plant.noise_names,
    )
