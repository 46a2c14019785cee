"""Window, false alarms and change of a monitor, as they are given or by default, in their ranges."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from obsynth.monitoring.thresholds.options import CHANGE, FALSE_ALARMS, WINDOW, refuse_idle
from obsynth.numerics.arguments import real_number, whole_number
from obsynth.numerics.arrays import require_no_overflow


def checked_options(
    table: Mapping[str, tuple[str, ...]], kind: str, options: Mapping[str, Any], isolation_delay: int = 0
) -> tuple[int, float, float]:
    """Return window, false_alarms and change as they are given, or by default; raise `SpecError` where an option does
    nothing for a kind of monitor, or is out of range."""
    refuse_idle(table, kind, options)
    for name in ("noise_bound", "initial_error", "gamma"):
        value = options[name]
        if value is not None:
            require_no_overflow(real_number(value, name, "a number, 0 or more", least=0.0), name, name)
    defaults: dict[str, Any] = {"window": WINDOW, "false_alarms": FALSE_ALARMS, "change": CHANGE}
    window, false_alarms, change = (defaults[name] if options[name] is None else options[name] for name in defaults)
    for name, count, least in (("window", window, 1), ("isolation_delay", isolation_delay, 0)):
        whole_number(count, name, "a whole number of samples", least=least)
    real_number(false_alarms, "false_alarms", "a probability between 0 and 1", above=0.0, below=1.0)
    real_number(change, "change", "a positive number of deviations", above=0.0)
    return window, false_alarms, change
