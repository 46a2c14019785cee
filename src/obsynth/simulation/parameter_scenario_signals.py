"""The signals of a scenario for plants with parameters: time-varying ones and DAEs."""

from __future__ import annotations

import numpy as np

from obsynth.errors import SpecError
from obsynth.plants.dae.model import DAEModel
from obsynth.plants.names import index_of
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.simulation.failures import LostEffectiveness, Stuck
from obsynth.simulation.profiles import SAMPLE_SLACK, sampled
from obsynth.simulation.scenario import Scenario
from obsynth.simulation.scenario_signals import MAXIMUM_SAMPLES, Drive

#: What the names of each group are, of such a plant.
_NAMES = {
    "inputs": "input_names", "faults": "parameter_names", "sensors": "output_names", "sensor_noise": "output_names",
    "initial_state": "state_names",
}  # fmt: skip


def check_recursive(plant: TimeVaryingDescriptorSystem | DAEModel, scenario: Scenario) -> None:
    """Raise where a scenario says what a plant with parameters does not have."""
    for group, names in _NAMES.items():
        for name in getattr(scenario, group):
            try:
                index_of(name, getattr(plant, names), what="The plant")
            except SpecError as error:
                raise SpecError(str(error), path=f"{group}.{name}") from None
    for name, profiles in scenario.faults.items():
        if any(isinstance(profile, (Stuck, LostEffectiveness)) for profile in profiles):  # type: ignore[union-attr]
            raise SpecError(
                "A parameter neither sticks nor loses effectiveness: give a step or another profile, which is added to "
                "it.", path=f"faults.{name}",
            )  # fmt: skip
    for group, why in {
        "disturbances": "Such a plant has no disturbances: give noise, or make one of them a parameter.",
        "observer_state": "A recursive observer starts where its design says: leave observer_state out.",
        "stabilise": "No feedback is made for such a plant: give inputs that keep it where it should be.",
    }.items():
        if getattr(scenario, group):
            raise SpecError(why, path=group)


def resolve_recursive(plant: TimeVaryingDescriptorSystem | DAEModel, scenario: Scenario, *, dt: float) -> Drive:
    """Return the signals of ``scenario``: ``[u, theta]`` as they differ from their nominal values."""
    check_recursive(plant, scenario)
    if scenario.sample_time is not None and scenario.sample_time != dt:
        raise SpecError(
            f"sample_time is {scenario.sample_time:g} s, but the observer has {dt:g} s: leave it out.",
            path="sample_time",
        )
    if scenario.horizon / dt > MAXIMUM_SAMPLES:
        raise SpecError(
            f"{scenario.horizon:g} s are more than {MAXIMUM_SAMPLES:,} samples of {dt:g} s: shorten the horizon.",
            path="horizon",
        )
    steps = int(scenario.horizon / dt + SAMPLE_SLACK) + 1
    if isinstance(plant, TimeVaryingDescriptorSystem) and plant.horizon is not None and steps > plant.horizon:
        raise SpecError(
            f"The scenario has {steps} samples, but the plant is known for {plant.horizon} steps: its horizon must be "
            f"below {plant.horizon * dt:g} s.", path="horizon",
        )  # fmt: skip
    left = np.zeros((steps, plant.nu + plant.nq))
    for group, offset, names in (("inputs", 0, plant.input_names), ("faults", plant.nu, plant.parameter_names)):
        for name, profiles in getattr(scenario, group).items():
            for profile in profiles:
                left[:, offset + index_of(name, names, what=group)] += sampled(profile, steps, dt)[0]
    sensors = tuple(
        (index_of(name, plant.output_names, what="sensors"), profile)
        for name, profiles in scenario.sensors.items()
        for profile in profiles  # type: ignore[union-attr]
    )
    deviations = np.array([scenario.sensor_noise.get(name, 0.0) for name in plant.output_names])
    return Drive(dt, left, left, (), sensors, scenario.noise, deviations)
