"""The signals of a scenario as arrays, for one plant and one sampling: what is known, and what is drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.dae.model import DAEModel
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.plants.validation import index_of
from obsynth.simulation.failures import LostEffectiveness, Random, Stuck
from obsynth.simulation.profiles import SAMPLE_SLACK, Profile, sampled
from obsynth.simulation.scenario import Scenario

#: A simulation holds every sample in memory: a typing error in a horizon must not fill it.
MAXIMUM_SAMPLES = 5_000_000

#: What the names of each group are, of such a plant.
_NAMES = {
    "inputs": "input_names", "faults": "parameter_names", "sensors": "output_names", "sensor_noise": "output_names",
    "initial_state": "state_names",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Drive:
    """A scenario for one plant, in arrays, apart from its random numbers.

    Fields: dt: Between samples; left, right: ``(steps, nu + nf + nd)``: [u, f, d] at both ends of each interval, linear
    in between; random: Column of each random disturbance, and its profile; sensors: Output and profile of each sensor
    fault; noise: Multiple of the plant's own noise; deviations: ``(ny,)``: further white noise of the sensors.
    """

    dt: float
    left: FloatArray
    right: FloatArray
    random: tuple[tuple[int, Random], ...]
    sensors: tuple[tuple[int, Profile], ...]
    noise: float
    deviations: FloatArray

    @property
    def steps(self) -> int:
        """Number of samples."""
        return len(self.left)

    def drawn(self, seeds: Sequence[int], nw: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return what the seeds add: signals, plant noise, sensor noise, ``(steps, runs, *)`` each."""
        steps, ny = self.steps, len(self.deviations)
        signals = np.zeros((steps, len(seeds), self.left.shape[1]))
        noise, sensors = np.zeros((steps, len(seeds), nw)), np.zeros((steps, len(seeds), ny))
        for run, seed in enumerate(seeds):
            rng = np.random.default_rng(seed)
            for column, profile in self.random:
                signals[:, run, column] += np.where(profile.active(steps, self.dt), profile.draw(rng, steps), 0.0)
            if self.noise and nw:
                noise[:, run] = self.noise * rng.standard_normal((steps, nw))
            if self.deviations.any():
                sensors[:, run] = self.deviations * rng.standard_normal((steps, ny))
        return signals, noise, sensors

    def measured(self, outputs: FloatArray) -> FloatArray:
        """Return outputs ``(steps, runs, ny)`` as the faulty sensors show them."""
        shown = outputs.copy()
        for column, profile in self.sensors:
            acts = profile.active(self.steps, self.dt)
            if isinstance(profile, LostEffectiveness):
                shown[acts, :, column] *= 1.0 - profile.share
            elif isinstance(profile, Stuck) and acts.any():
                first = shown[int(np.argmax(acts)), :, column] if profile.value is None else profile.value
                shown[acts, :, column] = first
            elif not isinstance(profile, Stuck):
                shown[:, :, column] += sampled(profile, self.steps, self.dt)[0][:, None]  # type: ignore[arg-type]
        return shown

    def first_fault(self, faults: slice) -> int | None:
        """Return the first sample at which a fault or a faulty sensor acts; `None` if there is none."""
        wrong = np.any(self.left[:, faults] != 0.0, axis=1)
        for _, profile in self.sensors:
            wrong |= profile.active(self.steps, self.dt)
        return int(np.argmax(wrong)) if wrong.any() else None


def resolve(plant: DescriptorSystem, scenario: Scenario) -> Drive:
    """Return the signals of ``scenario`` for ``plant``."""
    scenario.check_names(plant)
    dt = scenario.step_of(plant)
    steps = _steps(scenario, dt)
    names = (*plant.input_names, *plant.fault_names, *plant.disturbance_names)
    left, right = np.zeros((steps, len(names))), np.zeros((steps, len(names)))
    offsets = {"inputs": 0, "faults": plant.nu, "disturbances": plant.nu + plant.nf}
    known = {"inputs": plant.input_names, "faults": plant.fault_names, "disturbances": plant.disturbance_names}
    random: list[tuple[int, Random]] = []
    for group, offset in offsets.items():
        for name, profiles in getattr(scenario, group).items():
            column = offset + index_of(name, known[group], what=group)
            for profile in profiles:
                if isinstance(profile, Random):
                    random.append((column, profile))
                elif isinstance(profile, (Stuck, LostEffectiveness)):
                    actuator = _actuator(plant, name, scenario)
                    acts = profile.active(steps, dt)
                    for ends, commanded in ((left, left), (right, right)):
                        value = _failing(profile, commanded[:, actuator], acts, left[:, actuator])
                        ends[:, column] += np.where(acts, value, 0.0)
                else:
                    for ends, values in zip((left, right), sampled(profile, steps, dt), strict=True):
                        ends[:, column] += values
    random.sort(key=lambda item: item[0])
    shift = None if plant.uncertainty is None else plant.uncertainty.shift
    if shift and shift not in scenario.inputs:
        # What the equilibrium's motion enters through is one, always.
        for ends in (left, right):
            ends[:, plant.input_names.index(shift)] = 1.0
    return Drive(dt, left, right, tuple(random), *_sensors(plant.output_names, scenario))


def resolve_parameters(plant: TimeVaryingDescriptorSystem | DAEModel, scenario: Scenario, *, dt: float) -> Drive:
    """Return the signals of ``scenario`` for a plant with parameters: ``[u, theta]``, less their nominal values."""
    check_parameters(plant, scenario)
    if scenario.sample_time is not None and scenario.sample_time != dt:
        raise SpecError(
            f"sample_time is {scenario.sample_time:g} s, but the observer has {dt:g} s: leave it out.",
            path="sample_time",
        )
    steps = _steps(scenario, dt)
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
    return Drive(dt, left, left, (), *_sensors(plant.output_names, scenario))


def check_parameters(plant: TimeVaryingDescriptorSystem | DAEModel, scenario: Scenario) -> None:
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


def _steps(scenario: Scenario, dt: float) -> int:
    if scenario.horizon / dt > MAXIMUM_SAMPLES:
        raise SpecError(
            f"{scenario.horizon:g} s are {scenario.horizon / dt:.3g} samples of {dt:g} s, more than "
            f"{MAXIMUM_SAMPLES:,}: shorten the horizon.", path="horizon",
        )  # fmt: skip
    return int(scenario.horizon / dt + SAMPLE_SLACK) + 1


def _sensors(names: tuple[str, ...], scenario: Scenario) -> tuple[tuple[tuple[int, Profile], ...], float, FloatArray]:
    """Return faulty sensors, the multiple of the plant's noise, and further white noise ``(ny,)``."""
    sensors = tuple(
        (index_of(name, names, what="sensors"), profile)
        for name, profiles in scenario.sensors.items()
        for profile in profiles  # type: ignore[union-attr]
    )
    return sensors, scenario.noise, np.array([scenario.sensor_noise.get(name, 0.0) for name in names])


def _failing(
    profile: Stuck | LostEffectiveness, commanded: FloatArray, acts: np.ndarray, before: FloatArray
) -> FloatArray:
    """Return what a failing actuator adds to the command."""
    if isinstance(profile, LostEffectiveness):
        return np.asarray(-profile.share * commanded)
    held = before[int(np.argmax(acts))] if profile.value is None else profile.value
    return np.asarray(held - commanded)


def _actuator(plant: DescriptorSystem, fault: str, scenario: Scenario) -> int:
    """Return the input whose columns of B and D are those of the fault."""
    where = f"faults.{fault}"
    if scenario.stabilise:
        raise SpecError(
            "With a stabilising feedback the commands depend on the fault, and such a failure is no signal of time: "
            "give a step or another profile.", path=where,
        )  # fmt: skip
    column = plant.fault_names.index(fault)
    of_fault = np.concatenate([plant.Bf[:, column], plant.Df[:, column]])
    of_inputs = np.vstack([plant.B, plant.D])
    found = [i for i in range(plant.nu) if np.array_equal(of_inputs[:, i], of_fault)]
    if len(found) != 1:
        raise SpecError(
            f"Fault {fault!r} must enter exactly where one input does to be a failing actuator, but "
            f"{len(found)} inputs have its columns.", path=where,
        )  # fmt: skip
    return found[0]
