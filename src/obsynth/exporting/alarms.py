"""Alarms of an exported observer: levels of its outputs, and a monitor that was learned from rows without faults."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from obsynth.errors import SpecError
from obsynth.exporting.realisation import Realisation
from obsynth.monitoring.thresholds.learned import LearnedThresholds
from obsynth.numerics.arguments import real_number, require_mapping
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.derived import checked_warm_up, transient

#: What the largest statistic of a learned monitor is called, in units of its level.
STATISTIC = "statistic"

#: Seconds, about thirty years.
_NEVER = 1e9


@dataclass(frozen=True, eq=False)
class Alarms:
    """What raises an alarm: ``levels`` by watched output, 0 for none; ``columns``: all outputs that a learned monitor
    may take, fault estimates first; ``warm_up`` in seconds; ``walk (nf, nf)``: by which faults walk between samples."""

    levels: Mapping[str, float]
    columns: tuple[str, ...]
    fault_names: tuple[str, ...]
    warm_up: float
    learned: LearnedThresholds | None = None
    walk: FloatArray | None = None

    @classmethod
    def of(
        cls,
        columns: Sequence[str],
        fault_names: Sequence[str],
        thresholds: Mapping[str, float] | None,
        warm_up: float,
        learned: LearnedThresholds | None,
        more: Sequence[str] = (),
    ) -> Alarms:
        """Return alarms; ``more``: what may be watched besides the columns.  Raise `SpecError` for another name."""
        require_mapping(thresholds, "thresholds")
        watched = [*columns, *more]
        for name, level in (thresholds or {}).items():
            if name not in watched:
                raise SpecError(
                    f"There is no output {name!r} to monitor: there are {', '.join(watched)}.", path="thresholds"
                )
            real_number(level, f"The threshold of {name!r}", "a positive number", above=0.0, path="thresholds")
        levels = {name: float((thresholds or {}).get(name, 0.0)) for name in watched}
        if learned is not None:
            levels[STATISTIC] = 1.0
        return cls(levels, tuple(columns), tuple(fault_names), warm_up, learned)


def linear_alarms(
    found: Realisation,
    thresholds: Mapping[str, float] | None,
    warm_up: float | None,
    learned: LearnedThresholds | None,
) -> Alarms:
    """Return the alarms of a linear observer."""
    observer = found.observer
    columns = (*observer.row_names[observer.fault_rows], *observer.row_names[observer.residual_rows])
    # That of the design itself, as runs have it: sampling changes no mode.
    seconds = checked_warm_up(warm_up, transient(found.running))
    # A file may hold finite numbers alone: an observer that never settles raises no alarm.
    seconds = seconds if math.isfinite(seconds) else _NEVER
    return Alarms.of(columns, observer.fault_names, thresholds, seconds, learned)
