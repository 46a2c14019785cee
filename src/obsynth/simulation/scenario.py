"""Scenarios: inputs, faults, disturbances, sensor failures, noise, initial state and length of a simulation."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, replace
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arguments import is_number, real_array, real_number, require_kind, whole_number
from obsynth.numerics.arrays import FloatArray, require_no_overflow
from obsynth.numerics.suggestions import fields_suggested, suggestion
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.plants.signal_names import index_of
from obsynth.results.number_texts import point_in_time
from obsynth.simulation.profiles import (
    Additive,
    Drift,
    Gaussian,
    Intermittent,
    LostEffectiveness,
    Profile,
    Ramp,
    Random,
    Sine,
    Step,
    Stuck,
    TimeTable,
    Uniform,
)

#: The profiles by their names in a spec.
PROFILE_KINDS: dict[str, type[Profile]] = {
    "step": Step,
    "ramp": Ramp,
    "sine": Sine,
    "drift": Drift,
    "intermittent": Intermittent,
    "time-table": TimeTable,
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
    "scheduling": _ADDITIVE,
}

#: Arguments of a scenario by what they are called elsewhere.
OTHER_NAMES = {
    **dict.fromkeys(("duration", "length", "end", "t_end", "tf", "stop_time", "until", "time"), "horizon"),
    **dict.fromkeys(("dt", "ts", "h", "step", "step_size"), "sample_time"),
    **dict.fromkeys(("x0", "initial", "start"), "initial_state"),
    **dict.fromkeys(("parameters", "fault"), "faults"),
    **dict.fromkeys(("unknown_inputs", "disturbance"), "disturbances"),
    **dict.fromkeys(("z0", "initial_observer_state"), "observer_state"),
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


def _name_meant(name: str, known: Iterable[str], given: Iterable[str]) -> str:
    """Return a question with the argument of a scenario that a wrong name means, or nothing."""
    meant = OTHER_NAMES.get(name.casefold(), "")
    return f" Did you mean {meant!r}?" if meant in known and meant not in given else suggestion(name, known)


@partial(fields_suggested, meant=_name_meant)
@dataclass(frozen=True, kw_only=True, repr=False)
class Scenario:
    """The inputs, faults, disturbances and noise of a simulation, by signal; several profiles of one signal add up.

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
    scheduling : mapping, optional
        How the scheduling parameters of a plant over a region move: profiles by their names, added to the middle of
        their ranges, which they may not leave.
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
        A number is out of range, a profile is of a kind that its signal cannot have, or it begins after the horizon.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(A=[[0.9]], B=[[1]], C=[[1]], Bf=[[1]], dt=1, fault_names=["pump"])
    >>> scenario = obsynth.Scenario(horizon=60.0, faults={"pump": obsynth.Step(size=0.5, start=20.0)})
    >>> simulation = obsynth.simulate(obsynth.fault_estimation_filter(plant), scenario)
    >>> simulation.faults[[19, 20]]
    array([[0. ],
           [0.5]])
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
    scheduling: Profiles = field(default_factory=dict)

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
        _require_begun(self)
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

    def __repr__(self) -> str:
        """Return the arguments that are not the defaults: the others say nothing."""
        stated = {}
        for each in fields(self):
            value, usual = getattr(self, each.name), each.default
            if value != ({} if usual is MISSING else usual):
                stated[each.name] = dict(value) if isinstance(value, Mapping) else value
        return f"Scenario({', '.join(f'{name}={value!r}' for name, value in stated.items())})"

    def __reduce__(self) -> tuple[Any, ...]:
        """Return what makes it again in another process: read-only mappings do not travel."""
        arguments: dict[str, Any] = {
            name: dict(value) if isinstance(value, Mapping) else value for name, value in vars(self).items()
        }
        return partial(Scenario, **arguments), ()

    @property
    def is_random(self) -> bool:
        """Whether noise or a signal is drawn, so that another seed gives another run."""
        profiles = (each for group in _ALLOWED for own in getattr(self, group).values() for each in own)
        noisy = self.noise > 0.0 or any(self.sensor_noise.values())
        return noisy or any(isinstance(each, Random) for each in profiles)

    def replace(self, **changes: Any) -> Scenario:
        """Return the scenario with some fields changed, such as its seed; one that ends earlier is without what would
        begin after that.

        Parameters
        ----------
        **changes
            Any argument of the constructor.
        """
        horizon = changes.get("horizon", self.horizon)
        if not (is_number(horizon) and horizon < self.horizon):
            return replace(self, **changes)
        begun: dict[str, Any] = {group: _begun(getattr(self, group), horizon) for group in _ALLOWED}
        return replace(self, **{**begun, **changes})

    def as_dict(self) -> dict[str, Any]:
        """Return the scenario as plain data, as `scenario_from` reads it."""
        kinds = {kind: name for name, kind in PROFILE_KINDS.items()}
        data = dict(vars(self))
        for group in _ALLOWED:
            data[group] = {
                name: [{"kind": kinds[type(profile)], **vars(profile)} for profile in profiles]
                for name, profiles in getattr(self, group).items()
            }
        return {name: dict(value) if isinstance(value, Mapping) else value for name, value in data.items()}

    def step_of(self, plant: DescriptorSystem | PolytopicSystem) -> float:
        """Return the seconds between samples.

        Parameters
        ----------
        plant : DescriptorSystem or PolytopicSystem
            Whose ``dt`` counts, where it has one.

        Raises
        ------
        SpecError
            The plant is of another kind, it is continuous and the scenario has no sample time, or both have different
            ones.
        """
        require_kind(plant, (DescriptorSystem, PolytopicSystem), "plant", "a DescriptorSystem or a PolytopicSystem")
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
        plant : DescriptorSystem, PolytopicSystem, TimeVaryingDescriptorSystem or DAEModel
            The plant that is to be simulated.

        Raises
        ------
        SpecError
            An unknown name, with the closest ones; ``path`` says where.
        """
        for group, names in _GROUP_NAMES.items():
            if group == "faults" and not isinstance(plant, (DescriptorSystem, PolytopicSystem)):
                names = "parameter_names"
            known: Sequence[str] = getattr(plant, names, ())
            for name in getattr(self, group) if hasattr(plant, names) else ():
                try:
                    index_of(name, known, what="The plant")
                except SpecError as error:
                    raise SpecError(str(error), path=f"{group}.{name}") from None
        scheduled = plant.scheduling.names if isinstance(plant, PolytopicSystem) else ()
        if self.scheduling and not scheduled:
            raise SpecError(
                "The plant has no scheduling parameters: scheduling is for plants over a region.", path="scheduling"
            )
        for name in self.scheduling:
            try:
                index_of(name, scheduled, what="scheduling")
            except SpecError as error:
                raise SpecError(str(error), path=f"scheduling.{name}") from None


def scenario_from(data: Mapping[str, Any]) -> Scenario:
    """Return the scenario that `Scenario.as_dict` described."""
    arguments = dict(data)
    for group in _ALLOWED:
        arguments[group] = {
            name: [
                PROFILE_KINDS[item["kind"]](**{key: value for key, value in item.items() if key != "kind"})
                for item in profiles
            ]
            for name, profiles in arguments.get(group, {}).items()
        }
    return Scenario(**arguments)


def profiles_of(scenario: Scenario, group: str) -> list[tuple[str, Profile]]:
    """Return name and profile of everything that happens in a group of signals."""
    return [(name, profile) for name, profiles in getattr(scenario, group).items() for profile in profiles]


def observer_start(scenario: Scenario, order: int) -> FloatArray:
    """Return ``z(0)`` of an observer ``(order,)``."""
    state = scenario.observer_state
    if state is not None and len(state) != order:
        raise SpecError(f"observer_state needs {order} numbers, not {len(state)}.", path="observer_state")
    return np.zeros(order) if state is None else np.array(state)


def _as_tuple(value: Any) -> tuple[Any, ...]:
    """Return one profile, or some, as a tuple; an empty one for anything else."""
    return (value,) if isinstance(value, Profile) else tuple(value) if isinstance(value, (list, tuple)) else ()


def _checked_profiles(
    profiles_by_signal: Any, group: str, kinds: tuple[type[Profile], ...]
) -> dict[str, tuple[Profile, ...]]:
    require_kind(profiles_by_signal, Mapping, group, "profiles by the names of signals")
    checked = {}
    for name, value in profiles_by_signal.items():
        profiles = _as_tuple(value)
        where = f"{group}.{name}"
        if not profiles or not all(isinstance(profile, Profile) for profile in profiles):
            size = float(value) if is_number(value) else 1.0
            raise SpecError(
                f"{name!r} needs a profile, such as obsynth.Step(size={size:g}), or a list of them.", path=where
            )
        for profile in profiles:
            if not isinstance(profile, kinds):
                raise SpecError(
                    f"{type(profile).__name__} has no meaning among the {group}: use "
                    f"{', '.join(kind.__name__ for kind in kinds)}.",
                    path=where,
                )
        if len(profiles) > 1 and any(isinstance(profile, FAILURES) for profile in profiles):
            raise SpecError("Stuck and LostEffectiveness must be a signal's only profile.", path=where)
        checked[str(name)] = profiles
    return checked


def _begun(profiles_by_signal: Profiles, horizon: float) -> dict[str, list[Profile]]:
    """Return the profiles that begin by some time, seconds, without signals that have none of these."""
    begun = {
        name: [profile for profile in _as_tuple(value) if profile.start <= horizon]
        for name, value in profiles_by_signal.items()
    }
    return {name: profiles for name, profiles in begun.items() if profiles}


def _require_begun(scenario: Scenario) -> None:
    """Raise `SpecError` for a profile that begins after the horizon: it would be absent without a word."""
    for group in _ALLOWED:
        for name, profile in profiles_of(scenario, group):
            if profile.start > scenario.horizon:
                raise SpecError(
                    f"{name!r} among the {group} begins at {point_in_time(profile.start)}, and the scenario ends at "
                    f"{point_in_time(scenario.horizon)}: begin earlier, or give a longer horizon.",
                    path=f"{group}.{name}",
                )


def _checked_numbers(numbers: Any, name: str) -> dict[str, float]:
    require_kind(numbers, Mapping, name, "numbers by the names of signals")
    for key, value in numbers.items():
        real_number(value, repr(key), "a finite number", path=f"{name}.{key}")
        require_no_overflow(value, f"{name}[{key!r}]", f"{name}.{key}")
    return {str(key): float(value) for key, value in numbers.items()}
