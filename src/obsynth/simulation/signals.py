"""Signals of a scenario as arrays: known inputs, faults and disturbances of one plant at one sample time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray, as_given, as_matrix
from obsynth.plants.dae import DAEModel
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.input_derivatives import derivative_of, difference_quotients
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.plants.signal_names import index_of
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.simulation.profiles import SAMPLE_SLACK, Additive, LostEffectiveness, Profile, Random, Stuck
from obsynth.simulation.scenario import FAILURES, Scenario, profiles_of

#: Most samples of a simulation, which keeps all of them in memory: a mistyped horizon must not fill it.
MAXIMUM_SAMPLES = 5_000_000


@dataclass(frozen=True, eq=False)
class ScenarioSignals:
    """The signals of a scenario for one plant, before random numbers are drawn.

    Parameters
    ----------
    dt : float
        Seconds between samples.
    at_begin, at_end : FloatArray
        ``[u, f, d]`` at the beginning and at the end of each interval, ``(steps, nu + nf + nd)``.
    random : tuple
        Column and profile of each random signal.
    sensors : tuple
        Output and profile of each faulty sensor.
    noise : float
        Factor of the plant's stated noise.
    deviations : FloatArray
        Standard deviations of additional sensor noise ``(ny,)``.
    """

    dt: float
    at_begin: FloatArray
    at_end: FloatArray
    random: tuple[tuple[int, Random], ...]
    sensors: tuple[tuple[int, Profile], ...]
    noise: float
    deviations: FloatArray

    @property
    def steps(self) -> int:
        """Number of samples."""
        return len(self.at_begin)

    def drawn(self, seeds: Sequence[int], nw: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return random signals, plant noise and sensor noise for these seeds, each ``(steps, runs, *)``."""
        steps, ny = self.steps, len(self.deviations)
        signals = np.zeros((steps, len(seeds), self.at_begin.shape[1]))
        noise, sensors = np.zeros((steps, len(seeds), nw)), np.zeros((steps, len(seeds), ny))
        for run, seed in enumerate(seeds):
            rng = np.random.default_rng(seed)
            for column, profile in self.random:
                signals[:, run, column] += np.where(profile.active(steps, self.dt), profile._draw(rng, steps), 0.0)
            if self.noise and nw:
                noise[:, run] = self.noise * rng.standard_normal((steps, nw))
            if self.deviations.any():
                sensors[:, run] = self.deviations * rng.standard_normal((steps, ny))
        return signals, noise, sensors

    def measured(self, outputs: FloatArray) -> FloatArray:
        """Return the measurements of faulty sensors from outputs ``(steps, runs, ny)``."""
        measurements = outputs.copy()
        for column, profile in self.sensors:
            acts = profile.active(self.steps, self.dt)
            if isinstance(profile, LostEffectiveness):
                measurements[acts, :, column] *= 1.0 - profile.share
            elif isinstance(profile, Stuck) and acts.any():
                first = measurements[int(np.argmax(acts)), :, column] if profile.value is None else profile.value
                measurements[acts, :, column] = first
            elif isinstance(profile, Additive):
                measurements[:, :, column] += profile.sampled(self.steps, self.dt)[0][:, None]
        return measurements

    def first_fault(self, faults: slice) -> int | None:
        """Return the first sample at which a fault or a faulty sensor acts; `None` if there is none."""
        wrong = np.any(self.at_begin[:, faults] != 0.0, axis=1)
        for _, profile in self.sensors:
            wrong |= profile.active(self.steps, self.dt)
        return int(np.argmax(wrong)) if wrong.any() else None


def resolve(plant: DescriptorSystem | PolytopicSystem, scenario: Scenario) -> ScenarioSignals:
    """Return the signals of ``scenario`` for ``plant``."""
    scenario.check_names(plant)
    return _resolved(plant, scenario, scenario.step_of(plant), plant.fault_names, plant.disturbance_names)


def resolve_parameters(
    plant: TimeVaryingDescriptorSystem | DAEModel, scenario: Scenario, *, dt: float
) -> ScenarioSignals:
    """Return the signals of ``scenario`` for a plant with parameters: ``[u, theta]``, as differences from nominal."""
    check_parameters(plant, scenario)
    if scenario.sample_time is not None and scenario.sample_time != dt:
        raise SpecError(
            f"sample_time is {scenario.sample_time:g} s, but the observer has {dt:g} s: leave it out.",
            path="sample_time",
        )
    drive = _resolved(plant, scenario, dt, plant.parameter_names, ())
    if isinstance(plant, TimeVaryingDescriptorSystem) and plant.horizon is not None and drive.steps > plant.horizon:
        raise SpecError(
            f"The scenario has {drive.steps} samples, but the plant is known for {plant.horizon} steps: its horizon "
            f"must be below {plant.horizon * dt:g} s.",
            path="horizon",
        )
    return drive


def check_parameters(plant: TimeVaryingDescriptorSystem | DAEModel, scenario: Scenario) -> None:
    """Raise `SpecError` where a scenario has something that plants with parameters do not have."""
    scenario.check_names(plant)
    for name, profile in profiles_of(scenario, "faults"):
        if isinstance(profile, FAILURES):
            raise SpecError(
                "A parameter neither sticks nor loses effectiveness: give a step or another profile, which is added to "
                "it.",
                path=f"faults.{name}",
            )
    for group, why in {
        "disturbances": "Such a plant has no disturbances: give noise, or make one of them a parameter.",
        "observer_state": "A recursive observer starts where its design says: leave observer_state out.",
        "stabilise": "No feedback is designed for such a plant: give inputs that keep it near its operating point.",
    }.items():
        if getattr(scenario, group):
            raise SpecError(why, path=group)


def _resolved(
    plant: DescriptorSystem | PolytopicSystem | TimeVaryingDescriptorSystem | DAEModel,
    scenario: Scenario,
    dt: float,
    faults: tuple[str, ...],
    disturbances: tuple[str, ...],
) -> ScenarioSignals:
    if scenario.horizon / dt > MAXIMUM_SAMPLES:
        raise SpecError(
            f"{scenario.horizon:g} s are {scenario.horizon / dt:.3g} samples of {dt:g} s, more than "
            f"{MAXIMUM_SAMPLES:,}: shorten the horizon.",
            path="horizon",
        )
    steps, before = int(scenario.horizon / dt + SAMPLE_SLACK) + 1, 0
    groups = {"inputs": plant.input_names, "faults": faults, "disturbances": disturbances}
    at_begin, at_end = np.zeros((2, steps, sum(map(len, groups.values()))))
    random: list[tuple[int, Random]] = []
    for group, names in groups.items():
        for name, profile in profiles_of(scenario, group):
            column = before + index_of(name, names, what=group)
            if isinstance(profile, Random):
                random.append((column, profile))
            elif isinstance(profile, Additive):
                for ends, values in zip((at_begin, at_end), profile.sampled(steps, dt), strict=True):
                    ends[:, column] += values
            elif isinstance(plant, (DescriptorSystem, PolytopicSystem)):
                actuator, acts = _actuator(plant, name, scenario), profile.active(steps, dt)
                for ends in (at_begin, at_end):
                    added = _lost_command(profile, ends[:, actuator], acts, at_begin[:, actuator])
                    ends[:, column] += np.where(acts, added, 0.0)
        before += len(names)
    _form_derivatives(plant.input_names, scenario, at_begin, at_end, dt)
    random.sort(key=lambda item: item[0])
    uncertain = plant.uncertainty if isinstance(plant, DescriptorSystem) else None
    if uncertain is not None and uncertain.shift and uncertain.shift not in scenario.inputs:
        # The input through which the shift of the equilibrium enters is always one.
        column = plant.input_names.index(uncertain.shift)
        at_begin[:, column] = at_end[:, column] = 1.0
    sensors = [
        (index_of(name, plant.output_names, what="sensors"), profile)
        for name, profile in profiles_of(scenario, "sensors")
    ]
    deviations = np.array([scenario.sensor_noise.get(name, 0.0) for name in plant.output_names])
    return ScenarioSignals(dt, at_begin, at_end, tuple(random), tuple(sensors), scenario.noise, deviations)


def _form_derivatives(
    inputs: Sequence[str], scenario: Scenario, at_begin: FloatArray, at_end: FloatArray, dt: float
) -> None:
    """Fill in derivatives of known inputs that have no profile, by the differences that runs on logs use."""
    times = np.arange(len(at_begin), dtype=np.float64) * float(dt)
    for column, name in enumerate(inputs):
        base = None if name in scenario.inputs else derivative_of(name, inputs)
        if base is not None:
            if scenario.stabilise:
                raise SpecError(
                    f"A stabilising feedback moves {base[0]!r}, of which {name!r} is needed and no profile is given: "
                    "leave stabilise out, or take a plant without it.",
                    path="stabilise",
                )
            quotients, _ = difference_quotients(times, at_begin[:, inputs.index(base[0])], base[1], None)
            at_begin[:, column] = at_end[:, column] = quotients


def _lost_command(profile: Profile, commanded: FloatArray, acts: np.ndarray, before: FloatArray) -> FloatArray:
    """Return the signal that a failing actuator adds to its command."""
    if isinstance(profile, LostEffectiveness):
        return np.asarray(-profile.share * commanded)
    value = profile.value if isinstance(profile, Stuck) else None
    return np.asarray((before[int(np.argmax(acts))] if value is None else value) - commanded)


def _actuator(plant: DescriptorSystem | PolytopicSystem, fault: str, scenario: Scenario) -> int:
    """Return the index of the input whose columns of B and D are those of the fault."""
    where = f"faults.{fault}"
    if scenario.stabilise:
        raise SpecError(
            "With a stabilising feedback the commands depend on the fault, and such a failure is no function of time: "
            "give a step or another profile.",
            path=where,
        )
    column = plant.fault_names.index(fault)
    everywhere = plant.vertices if isinstance(plant, PolytopicSystem) else (plant,)
    of_fault = np.concatenate([part for at in everywhere for part in (at.Bf[:, column], at.Df[:, column])])
    of_inputs = np.vstack([part for at in everywhere for part in (at.B, at.D)])
    inputs = [i for i in range(plant.nu) if np.array_equal(of_inputs[:, i], of_fault)]
    if len(inputs) != 1:
        raise SpecError(
            f"Fault {fault!r} must enter exactly where one input does to be a failing actuator, but "
            f"{len(inputs)} inputs have its columns.",
            path=where,
        )
    return inputs[0]


def signals_of(
    plant: DescriptorSystem | PolytopicSystem, steps: int, **values: ArrayLike | None
) -> dict[str, FloatArray]:
    """Return inputs u, faults f, disturbances d and noise w of a plant over a record, each ``(steps, signals)``."""
    sizes = {"u": plant.nu, "f": plant.nf, "d": plant.nd, "w": plant.nw}
    return {name: signal_of(values[name], name, (steps, size)) for name, size in sizes.items()}


def signal_of(value: ArrayLike | None, name: str, shape: tuple[int, int]) -> FloatArray:
    """Return a signal ``(steps, size)`` over a record: zeros for `None`, one column for a list of numbers."""
    if value is None or (0 in shape and not np.size(value)):
        return np.zeros(shape)
    array = as_given(value, name, f"{name} has rows of different lengths: give a full matrix.")
    matrix = as_matrix(array.reshape(-1, 1) if array.ndim == 1 and shape[1] == 1 else array, name)
    if matrix.shape != shape:
        raise SpecError(f"{name} has shape {matrix.shape}, but {shape} is needed (samples by signals).", path=name)
    return matrix
