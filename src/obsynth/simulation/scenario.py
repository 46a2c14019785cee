"""What happens to a plant in a simulation: inputs, faults, disturbances, sensors, noise, start and length.

How one signal goes with time is a profile; between samples it is held or linear, so that simulations are exact.

Signals over a record: those of a scenario for one plant and one sampling, given ones, and what a plant did.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from types import MappingProxyType
from typing import Annotated, Any, ClassVar

import numpy as np
from annotated_types import Gt, Le
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.numerics.arguments import (
    FloatArray,
    OpenUnitInterval,
    Positive,
    as_given,
    as_matrix,
    check_fields,
    freeze,
    is_finite_number,
    is_number,
    real_array,
    real_number,
    require_kind,
    require_no_overflow,
    shown,
    whole_number,
)
from obsynth.plants.dae import DAEModel
from obsynth.plants.descriptor import DescriptorSystem, TimeVaryingDescriptorSystem, index_of

#: Share of a sample by which rounding may move a start or an end.
SAMPLE_SLACK = 1e-6


@dataclass(frozen=True, kw_only=True)
class Profile:
    """What all profiles have: ``start`` and ``end``, seconds, between which they act; without end by default."""

    #: Whether the signal is held between samples; else it is linear there.
    held: ClassVar[bool] = True
    start: float = 0.0
    end: float = math.inf

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if value is None and item.name == "value":
                continue
            if not is_finite_number(value) and not (item.name == "end" and is_number(value) and value == math.inf):
                raise SpecError(f"{item.name} is {shown(value)}: give a finite number.", path=item.name)
            if item.name != "end":
                require_no_overflow(value, item.name, item.name)
        check_fields(self, type(self))
        if not self.end > self.start:
            raise SpecError(f"end ({self.end:g} s) is not after start ({self.start:g} s).", path="end")

    def active(self, steps: int, dt: float) -> np.ndarray:
        """Return which of the samples 0 to ``steps - 1`` it acts on."""
        place = np.arange(steps) + SAMPLE_SLACK
        return np.asarray((place >= self.start / dt) & (place < self.end / dt))


class Additive(Profile, ABC):
    """A function of time, which is added to its signal."""

    @abstractmethod
    def _at(self, time: FloatArray) -> FloatArray:
        """Return its values at ``time``, seconds."""

    def sampled(self, steps: int, dt: float) -> tuple[FloatArray, FloatArray]:
        """Return its values at the left and right end of each interval between samples, ``(steps,)`` each."""
        acts, values = self.active(steps, dt), self._at(dt * np.arange(steps + 1, dtype=np.float64))
        left = np.where(acts, values[:-1], 0.0)
        return left, left.copy() if self.held else np.where(acts, values[1:], 0.0)


@dataclass(frozen=True, kw_only=True)
class Step(Additive):
    """A constant; on a sensor, its bias.

    Parameters
    ----------
    size : float
        In the signal's unit.
    start, end : float, optional, seconds
        When it acts.
    """

    size: float

    def _at(self, time: FloatArray) -> FloatArray:
        return np.full(time.shape, float(self.size))


@dataclass(frozen=True, kw_only=True)
class Ramp(Additive):
    """A straight line from zero at ``start``; linear between samples.

    Parameters
    ----------
    rate : float
        Per second.
    start, end : float, optional, seconds
        When it acts.
    """

    held: ClassVar[bool] = False
    rate: float

    def _at(self, time: FloatArray) -> FloatArray:
        return np.asarray(self.rate * (time - self.start))


@dataclass(frozen=True, kw_only=True)
class Sine(Additive):
    """``amplitude sin(frequency t + phase)``, t the scenario's time; linear between samples.

    Parameters
    ----------
    amplitude : float
        In the signal's unit.
    frequency : float, rad/s
        Angular frequency.
    phase : float, optional, rad
        At t = 0.
    start, end : float, optional, seconds
        When it acts.
    """

    held: ClassVar[bool] = False
    amplitude: float
    frequency: float
    phase: float = 0.0

    def _at(self, time: FloatArray) -> FloatArray:
        return np.asarray(self.amplitude * np.sin(self.frequency * time + self.phase))


@dataclass(frozen=True, kw_only=True)
class Drift(Additive):
    """A slow approach to ``size``, with a time constant; linear between samples.

    Parameters
    ----------
    size : float
        Where it ends.
    time_constant : float, seconds
        After which 63 % are reached.
    start, end : float, optional, seconds
        When it acts.
    """

    held: ClassVar[bool] = False
    size: float
    time_constant: Positive

    def _at(self, time: FloatArray) -> FloatArray:
        # Before the start it is masked; there the exponential must not overflow.
        return np.asarray(-self.size * np.expm1(-np.maximum(time - self.start, 0.0) / self.time_constant))


@dataclass(frozen=True, kw_only=True)
class Intermittent(Additive):
    """A constant that comes and goes.

    Parameters
    ----------
    size : float
        While it is there.
    period : float, seconds
        From one coming to the next.
    duty : float, optional
        Share of the period during which it is there, between 0 and 1.
    start, end : float, optional, seconds
        When it acts.
    """

    size: float
    period: Positive
    duty: OpenUnitInterval = 0.5

    def _at(self, time: FloatArray) -> FloatArray:
        turn = (time - self.start) / self.period + SAMPLE_SLACK
        return np.where(turn - np.floor(turn) < self.duty, float(self.size), 0.0)


@dataclass(frozen=True, kw_only=True)
class Stuck(Profile):
    """An actuator or a sensor that stays where it is.

    Parameters
    ----------
    value : float, optional
        Where; by default where it is when this begins.
    start, end : float, optional, seconds
        When it acts.
    """

    value: float | None = None


@dataclass(frozen=True, kw_only=True)
class LostEffectiveness(Profile):
    """An actuator or a sensor that gives only a share of its signal.

    Parameters
    ----------
    share : float
        What is lost, between 0 (nothing) and 1 (all).
    start, end : float, optional, seconds
        When it acts.
    """

    share: Annotated[float, Gt(0.0), Le(1.0)]


class Random(Profile, ABC):
    """Independent samples, held between samples."""

    @abstractmethod
    def _draw(self, rng: np.random.Generator, steps: int) -> FloatArray:
        """Return ``steps`` samples, drawn with ``rng``."""

    @abstractmethod
    def moments(self) -> tuple[float, float, float]:
        """Return the largest absolute value (infinite if there is none), the mean and the variance."""


@dataclass(frozen=True, kw_only=True)
class Uniform(Random):
    """Independent samples, uniform between two limits (a bias is their mean), held between samples.

    Parameters
    ----------
    low, high : float
        The limits.
    start, end : float, optional, seconds
        When it acts.
    """

    low: float
    high: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.high > self.low:
            raise SpecError("high must be greater than low.", path="high")

    def _draw(self, rng: np.random.Generator, steps: int) -> FloatArray:
        return np.asarray(rng.uniform(self.low, self.high, steps))

    def moments(self) -> tuple[float, float, float]:
        """Return the same as `Random.moments`."""
        return max(abs(self.low), abs(self.high)), (self.low + self.high) / 2, (self.high - self.low) ** 2 / 12


@dataclass(frozen=True, kw_only=True)
class Gaussian(Random):
    """Independent normal samples, held between samples.

    Parameters
    ----------
    deviation : float
        Standard deviation.
    mean : float, optional
        Their mean.
    start, end : float, optional, seconds
        When it acts.
    """

    deviation: Positive
    mean: float = 0.0

    def _draw(self, rng: np.random.Generator, steps: int) -> FloatArray:
        return np.asarray(rng.normal(self.mean, self.deviation, steps))

    def moments(self) -> tuple[float, float, float]:
        """Return the same as `Random.moments`."""
        return math.inf, self.mean, self.deviation**2


#: The profiles by their names in a spec.
PROFILE_KINDS: dict[str, type[Profile]] = {
    "step": Step,
    "ramp": Ramp,
    "sine": Sine,
    "drift": Drift,
    "intermittent": Intermittent,
    "stuck": Stuck,
    "lost-effectiveness": LostEffectiveness,
    "uniform": Uniform,
    "gaussian": Gaussian,
}


_ADDITIVE = tuple(kind for kind in PROFILE_KINDS.values() if issubclass(kind, Additive))
#: A failing actuator or sensor: no function of time, and a signal's only profile.
FAILURES = (Stuck, LostEffectiveness)
_RANDOM = tuple(kind for kind in PROFILE_KINDS.values() if issubclass(kind, Random))
#: What each group of signals may do.
_ALLOWED: dict[str, tuple[type[Profile], ...]] = {
    "inputs": _ADDITIVE,
    "faults": (*_ADDITIVE, *FAILURES),
    "disturbances": (*_ADDITIVE, *_RANDOM),
    "sensors": (*_ADDITIVE, *FAILURES),
}
#: The names of a plant's signals that each group speaks of; the faults of a plant with parameters are these.
_GROUP_NAMES = {
    "inputs": "input_names",
    "faults": "fault_names",
    "disturbances": "disturbance_names",
    "sensors": "output_names",
    "sensor_noise": "output_names",
    "initial_state": "state_names",
}
Profiles = Mapping[str, Profile | Sequence[Profile]]


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """What happens to a plant, signal by signal; profiles of one signal add up.

    Parameters
    ----------
    horizon : float, seconds
        Length; samples are at 0, dt, 2 dt, ... up to it.
    sample_time : float, optional, seconds
        Between samples; needed for a continuous plant, and a discrete one has its own.
    inputs, faults, disturbances : mapping, optional
        Profile, or list of them, by name of the signal; zero by default.  `Uniform` and `Gaussian` are for
        disturbances.  `Stuck` and `LostEffectiveness` are for faults that enter where an input does.
    sensors : mapping, optional
        What is wrong with a sensor, by name of the output: a bias (`Step`), a `Ramp`, ..., `Stuck`,
        `LostEffectiveness`.  The plant's model does not know of it.
    noise : float, optional
        The plant's own noise (``Bw, Dw``), as a multiple of what it states; 0 for none.
    sensor_noise : mapping, optional
        Standard deviation of more white noise by output, per sample.
    seed : int, optional
        Of `numpy.random.default_rng`.
    initial_state : mapping, optional
        Values at the start by name of the state; the others are zero.
    observer_state : sequence of float, optional
        ``z(0)`` of the observer; zero by default.
    stabilise : bool, optional
        Add a state feedback that stabilises the plant, for the simulation only (linear-quadratic, unit weights).

    Raises
    ------
    SpecError
        A number is out of range, or a profile stands where it cannot be.
    """

    horizon: float
    sample_time: float | None = None
    inputs: Profiles = field(default_factory=dict)
    faults: Profiles = field(default_factory=dict)
    disturbances: Profiles = field(default_factory=dict)
    sensors: Profiles = field(default_factory=dict)
    noise: float = 0.0
    sensor_noise: Mapping[str, float] = field(default_factory=dict)
    seed: int = 0
    initial_state: Mapping[str, float] = field(default_factory=dict)
    observer_state: Sequence[float] | None = None
    stabilise: bool = False

    def __post_init__(self) -> None:
        for name in ("horizon", "sample_time"):
            value = getattr(self, name)
            if value is not None or name != "sample_time":
                real_number(value, name, "seconds, a positive number", above=0.0)
        real_number(self.noise, "noise", "a factor, 0 or more", least=0.0)
        require_no_overflow(self.noise, "noise", "noise")
        whole_number(self.seed, "seed", least=0)
        for group, kinds in _ALLOWED.items():
            object.__setattr__(self, group, MappingProxyType(_checked_profiles(getattr(self, group), group, kinds)))
        for name in ("sensor_noise", "initial_state"):
            object.__setattr__(self, name, MappingProxyType(_checked_numbers(getattr(self, name), name)))
        if any(value < 0.0 for value in self.sensor_noise.values()):
            raise SpecError("A standard deviation is negative.", path="sensor_noise")
        if self.observer_state is not None:
            state = real_array(self.observer_state, "observer_state")
            if state.ndim != 1 or not np.isfinite(state).all():
                raise SpecError("observer_state must be a list of finite numbers.", path="observer_state")
            require_no_overflow(state, "observer_state", "observer_state")
            object.__setattr__(self, "observer_state", tuple(state.tolist()))

    def __reduce__(self) -> tuple[Any, ...]:
        """Return what makes it again in another process: read-only mappings do not travel."""
        given: dict[str, Any] = {
            name: dict(value) if isinstance(value, Mapping) else value for name, value in vars(self).items()
        }
        return partial(Scenario, **given), ()

    def replace(self, **changes: Any) -> Scenario:
        """Return the scenario with some fields changed, such as its seed.

        Parameters
        ----------
        **changes
            Any argument of the constructor.
        """
        return replace(self, **changes)

    def as_dict(self) -> dict[str, Any]:
        """Return the scenario as plain data, as `scenario_from` reads it."""
        kinds = {kind: name for name, kind in PROFILE_KINDS.items()}
        found = dict(vars(self))
        for group in _ALLOWED:
            found[group] = {
                name: [{"kind": kinds[type(profile)], **vars(profile)} for profile in profiles]
                for name, profiles in getattr(self, group).items()
            }
        return {name: dict(value) if isinstance(value, Mapping) else value for name, value in found.items()}

    def step_of(self, plant: DescriptorSystem) -> float:
        """Return the seconds between samples.

        Parameters
        ----------
        plant : DescriptorSystem
            Whose ``dt`` counts, where it has one.

        Raises
        ------
        SpecError
            The plant is of another kind, it is continuous and the scenario has no sample time, or both have different
            ones.
        """
        require_kind(plant, DescriptorSystem, "plant", "a DescriptorSystem")
        if plant.is_discrete:
            if self.sample_time is not None and self.sample_time != plant.dt:
                raise SpecError(
                    f"sample_time is {self.sample_time:g} s, but the plant has {plant.dt:g} s: leave it out.",
                    path="sample_time",
                )
            return plant.dt
        if self.sample_time is None:
            raise SpecError("The plant is continuous: the scenario needs a sample_time.", path="sample_time")
        return float(self.sample_time)

    def check_names(self, plant: Any) -> None:
        """Raise where a name is no signal of ``plant``.

        Parameters
        ----------
        plant : DescriptorSystem, TimeVaryingDescriptorSystem or DAEModel
            The plant that is to be simulated.

        Raises
        ------
        SpecError
            An unknown name, with the closest ones; ``path`` says where.
        """
        for group, names in _GROUP_NAMES.items():
            if group == "faults" and not isinstance(plant, DescriptorSystem):
                names = "parameter_names"
            known: Sequence[str] = getattr(plant, names, ())
            for name in getattr(self, group) if hasattr(plant, names) else ():
                try:
                    index_of(name, known, what="The plant")
                except SpecError as error:
                    raise SpecError(str(error), path=f"{group}.{name}") from None


def scenario_from(data: Mapping[str, Any]) -> Scenario:
    """Return the scenario that `Scenario.as_dict` described."""
    given = dict(data)
    for group in _ALLOWED:
        given[group] = {
            name: [
                PROFILE_KINDS[item["kind"]](**{key: value for key, value in item.items() if key != "kind"})
                for item in profiles
            ]
            for name, profiles in given[group].items()
        }
    return Scenario(**given)


def profiles_of(scenario: Scenario, group: str) -> list[tuple[str, Profile]]:
    """Return name and profile of everything that happens in a group of signals."""
    return [(name, profile) for name, profiles in getattr(scenario, group).items() for profile in profiles]


def observer_start(scenario: Scenario, order: int) -> FloatArray:
    """Return ``z(0)`` of an observer ``(order,)``."""
    given = scenario.observer_state
    if given is not None and len(given) != order:
        raise SpecError(f"observer_state needs {order} numbers, not {len(given)}.", path="observer_state")
    return np.zeros(order) if given is None else np.array(given)


def _checked_profiles(given: Any, group: str, kinds: tuple[type[Profile], ...]) -> dict[str, tuple[Profile, ...]]:
    require_kind(given, Mapping, group, "profiles by the names of signals")
    found = {}
    for name, value in given.items():
        profiles = (value,) if isinstance(value, Profile) else tuple(value) if isinstance(value, (list, tuple)) else ()
        where = f"{group}.{name}"
        if not profiles or not all(isinstance(profile, Profile) for profile in profiles):
            raise SpecError(f"{name!r} needs a profile, or a list of them.", path=where)
        for profile in profiles:
            if not isinstance(profile, kinds):
                raise SpecError(
                    f"{type(profile).__name__} has no meaning among the {group}: use "
                    f"{', '.join(kind.__name__ for kind in kinds)}.",
                    path=where,
                )
        if len(profiles) > 1 and any(isinstance(profile, FAILURES) for profile in profiles):
            raise SpecError("Stuck and LostEffectiveness must be a signal's only profile.", path=where)
        found[str(name)] = profiles
    return found


def _checked_numbers(given: Any, name: str) -> dict[str, float]:
    require_kind(given, Mapping, name, "numbers by the names of signals")
    for key, value in given.items():
        real_number(value, repr(key), "a finite number", path=f"{name}.{key}")
        require_no_overflow(value, f"{name}[{key!r}]", f"{name}.{key}")
    return {str(key): float(value) for key, value in given.items()}


#: A simulation holds every sample in memory: a typing error in a horizon must not fill it.
MAXIMUM_SAMPLES = 5_000_000


@dataclass(frozen=True, eq=False)
class ScenarioSignals:
    """A scenario for one plant, in arrays, apart from its random numbers: column and profile of each of those."""

    dt: float
    left: FloatArray  # (steps, nu + nf + nd): [u, f, d] where each interval begins
    right: FloatArray  # where it ends
    random: tuple[tuple[int, Random], ...]
    sensors: tuple[tuple[int, Profile], ...]
    noise: float
    deviations: FloatArray  # (ny,) of more noise

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
                signals[:, run, column] += np.where(profile.active(steps, self.dt), profile._draw(rng, steps), 0.0)
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
            elif isinstance(profile, Additive):
                shown[:, :, column] += profile.sampled(self.steps, self.dt)[0][:, None]
        return shown

    def first_fault(self, faults: slice) -> int | None:
        """Return the first sample at which a fault or a faulty sensor acts; `None` if there is none."""
        wrong = np.any(self.left[:, faults] != 0.0, axis=1)
        for _, profile in self.sensors:
            wrong |= profile.active(self.steps, self.dt)
        return int(np.argmax(wrong)) if wrong.any() else None


def resolve(plant: DescriptorSystem, scenario: Scenario) -> ScenarioSignals:
    """Return the signals of ``scenario`` for ``plant``."""
    scenario.check_names(plant)
    return _resolved(plant, scenario, scenario.step_of(plant), plant.fault_names, plant.disturbance_names)


def resolve_parameters(
    plant: TimeVaryingDescriptorSystem | DAEModel, scenario: Scenario, *, dt: float
) -> ScenarioSignals:
    """Return the signals of ``scenario`` for a plant with parameters: ``[u, theta]``, less their nominal values."""
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
    """Raise where a scenario says what a plant with parameters does not have."""
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
    plant: DescriptorSystem | TimeVaryingDescriptorSystem | DAEModel,
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
    left, right = np.zeros((2, steps, sum(map(len, groups.values()))))
    random: list[tuple[int, Random]] = []
    for group, names in groups.items():
        for name, profile in profiles_of(scenario, group):
            column = before + index_of(name, names, what=group)
            if isinstance(profile, Random):
                random.append((column, profile))
            elif isinstance(profile, Additive):
                for ends, values in zip((left, right), profile.sampled(steps, dt), strict=True):
                    ends[:, column] += values
            elif isinstance(plant, DescriptorSystem):
                actuator, acts = _actuator(plant, name, scenario), profile.active(steps, dt)
                for ends in (left, right):
                    added = _missing(profile, ends[:, actuator], acts, left[:, actuator])
                    ends[:, column] += np.where(acts, added, 0.0)
        before += len(names)
    random.sort(key=lambda item: item[0])
    uncertain = plant.uncertainty if isinstance(plant, DescriptorSystem) else None
    if uncertain is not None and uncertain.shift and uncertain.shift not in scenario.inputs:
        # What the equilibrium's motion enters through is one, always.
        left[:, plant.input_names.index(uncertain.shift)] = right[:, plant.input_names.index(uncertain.shift)] = 1.0
    sensors = [
        (index_of(name, plant.output_names, what="sensors"), profile)
        for name, profile in profiles_of(scenario, "sensors")
    ]
    deviations = np.array([scenario.sensor_noise.get(name, 0.0) for name in plant.output_names])
    return ScenarioSignals(dt, left, right, tuple(random), tuple(sensors), scenario.noise, deviations)


def _missing(profile: Profile, commanded: FloatArray, acts: np.ndarray, before: FloatArray) -> FloatArray:
    """Return what a failing actuator adds to the command."""
    if isinstance(profile, LostEffectiveness):
        return np.asarray(-profile.share * commanded)
    value = profile.value if isinstance(profile, Stuck) else None
    return np.asarray((before[int(np.argmax(acts))] if value is None else value) - commanded)


def _actuator(plant: DescriptorSystem, fault: str, scenario: Scenario) -> int:
    """Return the input whose columns of B and D are those of the fault."""
    where = f"faults.{fault}"
    if scenario.stabilise:
        raise SpecError(
            "With a stabilising feedback the commands depend on the fault, and such a failure is no function of time: "
            "give a step or another profile.",
            path=where,
        )
    column = plant.fault_names.index(fault)
    of_fault = np.concatenate([plant.Bf[:, column], plant.Df[:, column]])
    of_inputs = np.vstack([plant.B, plant.D])
    found = [i for i in range(plant.nu) if np.array_equal(of_inputs[:, i], of_fault)]
    if len(found) != 1:
        raise SpecError(
            f"Fault {fault!r} must enter exactly where one input does to be a failing actuator, but "
            f"{len(found)} inputs have its columns.",
            path=where,
        )
    return found[0]


def _none() -> FloatArray:
    return np.zeros((0, 0))


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A simulated record, one row per sample; arrays are read-only, and empty where such a plant has none.

    Parameters
    ----------
    states, outputs : FloatArray
        ``(samples, nx)`` and ``(samples, ny)``, with noise; the outputs of a time-varying plant begin with y(1): their
        first row is NaN.
    inputs, faults, disturbances, noise : FloatArray
        ``(samples, nu)``, ``(samples, nf)``, ``(samples, nd)``, ``(samples, nw)``: what drove a plant; the faults of a
        plant with parameters are these, ``(samples, nq)``.
    time : FloatArray
        ``(samples,)``, seconds; starts at zero.
    residuals : FloatArray
        ``(samples,)``, nonlinear plants: scaled Newton residual of each step.
    inconsistency : float
        Linear plants: norm of the change that the given initial state needed to satisfy the algebraic equations at
        k = 0; only rounding for a consistent one.
    """

    states: FloatArray
    outputs: FloatArray
    inputs: FloatArray
    faults: FloatArray
    disturbances: FloatArray = field(default_factory=_none)
    noise: FloatArray = field(default_factory=_none)
    time: FloatArray = field(default_factory=_none)
    inconsistency: float = 0.0
    residuals: FloatArray = field(default_factory=_none)

    def __post_init__(self) -> None:
        freeze(self, *(name for name, value in vars(self).items() if isinstance(value, np.ndarray)))


def signal_of(value: ArrayLike | None, name: str, shape: tuple[int, int]) -> FloatArray:
    """Return a signal over a record, zero where none is given; a list of numbers is a single one."""
    if value is None or (0 in shape and not np.size(value)):
        return np.zeros(shape)
    array = as_given(value, name, f"{name} has rows of different lengths: give a full matrix.")
    matrix = as_matrix(array.reshape(-1, 1) if array.ndim == 1 and shape[1] == 1 else array, name)
    if matrix.shape != shape:
        raise SpecError(f"{name} has shape {matrix.shape}, but {shape} is needed (samples by signals).", path=name)
    return matrix
