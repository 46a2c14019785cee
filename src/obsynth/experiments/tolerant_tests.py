"""Guaranteed tests of plants with tolerances: an observer of the state beside the test bounds what they do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from obsynth.analysis.transformations.uncertain_plant import affine_plant
from obsynth.errors import ObsynthError, PreconditionError
from obsynth.experiments.benches import make_bench
from obsynth.experiments.monitors.adaptive_bound import Start, adaptive_bound
from obsynth.experiments.monitors.adaptive_record import Thresholds, thresholds_of_records
from obsynth.methods.designing import design
from obsynth.methods.guaranteed_test.method import GuaranteedTestMethod
from obsynth.methods.guaranteed_test.problem import problem_of
from obsynth.methods.guaranteed_test.synthesis import synthesise
from obsynth.methods.guaranteed_test.tolerant import Beside, noisy_as_bounded
from obsynth.methods.method import Synthesis
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.simulation.scenario import Scenario
from obsynth.tolerances.error_structure import ErrorStructure, error_structure
from obsynth.tolerances.exact_plant import Tracking, tracking_of

#: The method whose observer runs beside a test: faults do not move its state estimate.
BESIDE = "fault-estimation-filter"
#: Samples of the scenario over which thresholds are compared, at most.
MOST_SAMPLES = 500
#: What a bank says of tolerances, and what to do instead.
NOMINAL_BANK = (
    "The thresholds are those of the nominal plant: tolerances are not in them. Design each test alone, with its "
    "fault, the others free and this scenario, for thresholds over them."
)


def synthesise_over_tolerances(
    asked: GuaranteedTestMethod, scenario: Scenario, plant: DescriptorSystem, *, progress: Callable[[str], None]
) -> Synthesis:
    """Return the test whose threshold over the tolerances is least in the mean over a scenario without its faults."""
    if asked.isolate:
        found: Synthesis = asked.synthesise(plant, progress=progress)
        return replace(found, notes=(*found.notes, NOMINAL_BANK))
    try:
        beside = _beside(asked, scenario, plant, progress)
    except ObsynthError as error:
        found = asked.synthesise(plant, progress=progress)
        return replace(found, notes=(*found.notes, f"There is no threshold over the tolerances: {error}"))
    return synthesise(plant, asked, progress=progress, beside=beside)


def _beside(
    asked: GuaranteedTestMethod, scenario: Scenario, plant: DescriptorSystem, progress: Callable[[str], None]
) -> Beside:
    """Return the observer of the state, and what it says of a scenario."""
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
            "Bounds [low, high] and tolerances do not go together: what constants make of the middle is not known. "
            "Give the larger end.",
            condition="tolerances",
        )
    progress("designing the observer of the state beside the test")
    own = design(plant, BESIDE)
    affine = affine_plant(plant)
    tracking = tracking_of(own, affine)
    observer = own.linear[1]
    quiet = scenario.replace(faults={}, sensors={}, horizon=min(scenario.horizon, MOST_SAMPLES * plant.dt))
    runs = make_bench(own, quiet).run([quiet.seed])
    record = np.hstack([runs.inputs[:, 0], runs.outputs[:, 0]])
    problem = problem_of(plant, asked)
    noisy = noisy_as_bounded(problem.window(problem.shortest + 1))
    bounded = replace(affine, plant=noisy)
    structure = error_structure(observer, bounded, tracking, problem.bounds.disturbance, 1.0, states=True)
    found, states = _over_record(structure, observer, record, varying=affine.box.variation == "varying")
    n = plant.nx
    return Beside(observer, tracking.T, tracking.T0[:n], affine, record, states[:, :n], found.total[0])


def _over_record(
    structure: ErrorStructure, observer: LinearObserver, record: FloatArray, *, varying: bool
) -> tuple[Thresholds, FloatArray]:
    """Return thresholds on a record ``(steps, nu + ny)`` and what the observer says, as the error system reads it."""
    nu = len(observer.input_names)
    u, y = record[:, :nu], record[:, nu:]
    said = observer.run(y, u)
    rows = np.hstack([said.states, said.faults, said.residuals])
    states = rows @ structure.reading.T
    bound = adaptive_bound(structure, observer, Start(observer.order), varying=varying)
    return thresholds_of_records(bound, states[None], u[None], y[None]), states


def thresholds_over_tolerances(
    plant: DescriptorSystem,
    observer: LinearObserver,
    tracking: tuple[FloatArray, FloatArray],
    bounds: FloatArray,
    record: FloatArray,
) -> FloatArray:
    """Return thresholds ``(steps, rows)`` on a record ``(steps, nu + ny)``; noise columns of the plant within one."""
    affine = affine_plant(plant)
    structure = error_structure(observer, affine, Tracking(*tracking), bounds, 1.0)
    found, _ = _over_record(structure, observer, record, varying=affine.box.variation == "varying")
    return np.asarray(found.total[0])
