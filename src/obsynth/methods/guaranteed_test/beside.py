"""Guaranteed tests of plants with tolerances: an observer of the state beside the test bounds what they do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from obsynth.analysis.transformations.uncertain_plant import affine_plant
from obsynth.errors import PreconditionError
from obsynth.methods.designing import design
from obsynth.methods.guaranteed_test.options import Asked
from obsynth.methods.guaranteed_test.problem import problem_of
from obsynth.methods.guaranteed_test.tolerant import Beside, noisy_as_bounded, thresholds_over_record
from obsynth.methods.tracking import tracking_of
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.simulation.linear import scenario_runs, scenario_stepper
from obsynth.simulation.scenario import Scenario
from obsynth.verification.error_structure import error_structure

#: The method whose observer runs beside a test: faults do not move its state estimate.
BESIDE = "fault-estimation-filter"
#: Samples of the scenario over which thresholds are compared, at most.
MOST_COMPARED_SAMPLES = 500


def observer_beside(
    asked: Asked, scenario: Scenario, plant: DescriptorSystem, progress: Callable[[str], None]
) -> Beside:
    """Return the observer of the state, and what it says of a scenario without its faults."""
    if asked.state_bounds or asked.initial_bounds:
        raise PreconditionError(
            "Bounds of states and tolerances do not go together: leave state_bounds and initial_bounds out.",
            condition="tolerances",
        )
    if asked.exact:
        raise PreconditionError(
            "exact is for an exact model: leave it out for a threshold over the tolerances.", condition="tolerances"
        )
    if list(problem_of(plant, asked).bounds.middles):
        raise PreconditionError(
            "Bounds [low, high] and tolerances do not go together: the effect of the constants on the middle is not "
            "known. Give the larger end.",
            condition="tolerances",
        )
    progress("designing the observer of the state beside the test")
    own = design(plant, BESIDE)
    affine = affine_plant(plant)
    tracking = tracking_of(own, affine)
    observer = own.linear[1]
    quiet = scenario.replace(faults={}, sensors={}, horizon=min(scenario.horizon, MOST_COMPARED_SAMPLES * plant.dt))
    nu = plant.nu
    start = np.array([quiet.initial_state.get(name, 0.0) for name in plant.state_names])
    _, outputs, inputs, _, _ = scenario_runs(
        *scenario_stepper(own.linear[0], quiet, start), (nu, nu + plant.nf), [quiet.seed]
    )
    record = np.hstack([inputs[:, 0], outputs[:, 0]])
    problem = problem_of(plant, asked)
    noisy = noisy_as_bounded(problem.window(problem.shortest + 1))
    bounded = replace(affine, plant=noisy)
    structure = error_structure(observer, bounded, tracking, problem.bounds.disturbance, 1.0, states=True)
    found, states = thresholds_over_record(structure, observer, record, varying=affine.box.variation == "varying")
    n = plant.nx
    return Beside(observer, tracking.T, tracking.T0[:n], affine, record, states[:, :n], found.total[0])
