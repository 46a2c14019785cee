"""A plant alone over a scenario: what it does and what its sensors show, without an observer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.dae import DAEModel
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.simulation.dae import simulate_dae
from obsynth.simulation.linear import PlantRuns, scenario_runs, scenario_stepper, simulate_plant, simulate_time_varying
from obsynth.simulation.over_region import scenario_runs_over_region, scheduled_parameters
from obsynth.simulation.scenario import Scenario
from obsynth.simulation.signals import ScenarioSignals, resolve, resolve_parameters
from obsynth.simulation.trajectory import Trajectory

#: A plant that is simulated by itself.
PlantAlone = DescriptorSystem | PolytopicSystem | TimeVaryingDescriptorSystem | DAEModel


def simulate_scenario(plant: PlantAlone, scenario: Scenario) -> Trajectory:
    """Return what a plant does in a scenario; where an observer starts plays no role."""
    scenario = scenario.replace(observer_state=None)
    if isinstance(plant, DAEModel):
        return _nonlinear(plant, scenario)
    if isinstance(plant, TimeVaryingDescriptorSystem):
        return _time_varying(plant, scenario)
    start = np.array([scenario.initial_state.get(name, 0.0) for name in plant.state_names])
    if isinstance(plant, PolytopicSystem):
        if scenario.stabilise:
            raise SpecError(
                "No feedback is designed over a region: give inputs that keep the plant near its operating point.",
                path="stabilise",
            )
        drive = resolve(plant, scenario)
        parameters = scheduled_parameters(plant, scenario, drive.steps, drive.dt)
        return _of_one_run(scenario_runs_over_region(plant, drive, parameters, start, [scenario.seed]), drive)
    if plant.delays:
        return _with_delays(plant, scenario, start)
    drive, stepper = scenario_stepper(plant, scenario, start)
    runs = scenario_runs(drive, stepper, (plant.nu, plant.nu + plant.nf), [scenario.seed])
    # A start that nobody stated is at rest, as the inputs let it.
    change = float(np.linalg.norm(runs[0][0, 0] - start)) if scenario.initial_state else 0.0
    return _of_one_run(runs, drive, inconsistency=change)


def _of_one_run(runs: PlantRuns, drive: ScenarioSignals, *, inconsistency: float = 0.0) -> Trajectory:
    states, outputs, inputs, faults, disturbances = (part[:, 0] for part in runs)
    time = drive.dt * np.arange(drive.steps, dtype=np.float64)
    return Trajectory(states, outputs, inputs, faults, disturbances, time=time, inconsistency=inconsistency)


def _with_delays(plant: DescriptorSystem, scenario: Scenario, start: FloatArray) -> Trajectory:
    if scenario.stabilise:
        raise SpecError("No feedback is designed for a plant with delays: leave stabilise out.", path="stabilise")
    drive = resolve(plant, scenario)
    drawn, noise, sensor_noise = drive.drawn([scenario.seed], plant.nw)
    u, f, d = np.split((drive.at_begin[:, None] + drawn)[:, 0], (plant.nu, plant.nu + plant.nf), axis=1)
    run = simulate_plant(plant, steps=drive.steps, u=u, f=f, d=d, w=noise[:, 0], initial_state=start)
    return replace(run, outputs=drive.measured(run.outputs[:, None] + sensor_noise)[:, 0])


def _nonlinear(model: DAEModel, scenario: Scenario) -> Trajectory:
    """Return what a nonlinear plant does, from its nominal values where a scenario says nothing else."""
    if scenario.sample_time is None:
        raise SpecError("A nonlinear plant is simulated in steps: give the scenario a sample_time.", path="sample_time")
    drive = resolve_parameters(model, scenario, dt=scenario.sample_time)
    inputs, parameters, sensor_noise = _of_parameters(drive, scenario, len(model.input_names))
    run = simulate_dae(
        model,
        model.nominal_input + inputs,
        dt=drive.dt,
        parameters=model.nominal_parameters + parameters,
        initial_state=np.array([scenario.initial_state.get(name, value) for name, value in model.states.items()]),
    )
    return replace(run, outputs=drive.measured(run.outputs[:, None] + sensor_noise)[:, 0])


def _time_varying(plant: TimeVaryingDescriptorSystem, scenario: Scenario) -> Trajectory:
    """Return what a time-varying plant does; its outputs begin with y(1)."""
    drive = resolve_parameters(plant, scenario, dt=plant.dt)
    inputs, parameters, sensor_noise = _of_parameters(drive, scenario, plant.nu)
    run = simulate_time_varying(
        plant,
        samples=drive.steps,
        parameters=parameters,
        u=inputs,
        initial_state=np.array([scenario.initial_state.get(name, 0.0) for name in plant.state_names]),
        output_noise=sensor_noise[1:, 0],
    )
    return replace(run, outputs=drive.measured(run.outputs[:, None])[:, 0])


def _of_parameters(drive: ScenarioSignals, scenario: Scenario, nu: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return inputs and parameters, as differences from nominal, and the noise of the sensors ``(steps, 1, ny)``."""
    if scenario.noise:
        raise SpecError(
            "noise multiplies the deviations that a design states, and such a plant states none: give sensor_noise.",
            path="noise",
        )
    drawn, _, sensor_noise = drive.drawn([scenario.seed], 0)
    inputs, parameters = np.split(drive.at_begin + drawn[:, 0], (nu,), axis=1)
    return inputs, parameters, sensor_noise
