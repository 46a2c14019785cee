"""Which options act on which kind of monitor; what would do nothing is refused by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from obsynth.errors import SpecError

_BOUNDED = ("disturbance_bounds", "noise_bound", "initial_error", "scenario", "sample_time", "disturbance")

#: What disturbances do between the samples of a plant that was sampled from a continuous one.
DISTURBANCES = ("any", "held")

_STATISTICAL = ("window", "false_alarms", "scenario", "sample_time")

#: Options that act on the monitors of linear designs, by kind.
LINEAR_OPTIONS: Mapping[str, tuple[str, ...]] = {
    "pointwise": (*_BOUNDED, "initial_set", "constants"),
    "window": (*_BOUNDED, "window"),
    "paper": ("disturbance_bounds", "initial_error", "gamma", "scenario", "sample_time"),
    "chi-square": _STATISTICAL,
    "cusum": (*_STATISTICAL, "change"),
    "learned": ("normal", "sensor_faults"),
}

#: The same of designs that estimate parameters.
PARAMETER_OPTIONS: Mapping[str, tuple[str, ...]] = {
    "chi-square": ("nominal", "false_alarms"),
    "cusum": ("nominal", "false_alarms", "change"),
    "nis": ("nominal", "false_alarms"),
    "learned": ("normal", "sensor_faults"),
}

#: Samples that are looked back; probability of a false alarm in a whole run; the change that sums are tuned for.
WINDOW, FALSE_ALARMS, CHANGE = 20, 0.01, 1.0


def refuse_idle(
    table: Mapping[str, tuple[str, ...]], kind: str, options: Mapping[str, Any], *, called: Callable[[str], str] = str
) -> None:
    """Raise `SpecError` where an option is given that does nothing for a kind of monitor, by what it is ``called``."""
    used = table.get(kind)
    if used is None:
        return  # who makes the monitor says which kinds there are
    for name, value in options.items():
        # The command line gives a mapping without entries where nothing is stated.
        if value is None or (isinstance(value, Mapping) and not value) or name in used:
            continue
        kinds = [other_kind for other_kind, names in table.items() if name in names]
        where = f"the monitor {' or '.join(kinds)}" if kinds else "designs of another kind"
        raise SpecError(f"{called(name)} is for {where}, not for {kind}: leave it out.", path=called(name))
