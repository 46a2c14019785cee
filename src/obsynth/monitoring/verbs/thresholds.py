"""The verb ``thresholds``: a gain set and a log without faults in, thresholds out."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from obsynth.errors import SpecError
from obsynth.files.outputs import require_distinct
from obsynth.monitoring.verbs.data_arguments import protect_inputs, with_input_delay
from obsynth.report.terminal.arguments import STREAM, columns_of, numbers_of
from obsynth.report.terminal.output import emit, gains_to_hand_on, output_file

if TYPE_CHECKING:
    from obsynth.monitoring.thresholds.learned import LearnedThresholds
    from obsynth.results.design import ObserverDesign


def run_thresholds(options: argparse.Namespace) -> int:
    """Run ``thresholds``: 0 whether the rows suffice for the rate or not, which is reported; failures are errors."""
    from obsynth.monitoring.thresholds.learning import FALSE_ALARM_RATE, SENSOR_DRIFT, learn_thresholds

    logs = options.data
    is_stream = logs == [STREAM]
    if STREAM in logs and not is_stream:
        raise SpecError("One of several logs cannot be a stream: give files.", path="--data")
    target = _target(options, is_stream=is_stream)
    design, _ = gains_to_hand_on(options.gains, unverified=options.unverified)
    learned = learn_thresholds(
        with_input_delay(design, options),
        sys.stdin if is_stream else Path(logs[0]) if len(logs) == 1 else [Path(log) for log in logs],
        false_alarms=options.false_alarms or FALSE_ALARM_RATE,
        rows=options.rows,
        columns=columns_of(options),
        time_zone=options.time_zone,
        time_unit=options.time_unit,
        scales=numbers_of(options.scale),
        gap=options.gap,
        warm_up=options.warm_up,
        units_as_is=options.units_as_is,
        sensor_drift=SENSOR_DRIFT if options.sensor_drift is None else options.sensor_drift,
    )
    file = None if target is None else learned.save(target)
    if not learned.holds:
        print(
            f"Warning: the rate needs {learned.needed} rows without faults, and {learned.rows} are given."
            if learned.rows < learned.needed
            else f"Warning: {100 * learned.healthy_time.expected:.2g} % of healthy time is in alarm.",
            file=sys.stderr,
        )
    payload = {"gains": options.gains, "file": file, **_payload(learned)}
    emit(options, payload, "\n".join(_lines(design, learned)))
    return 0


def _target(options: argparse.Namespace, *, is_stream: bool) -> Path | None:
    """Return the file to write, if one is: it is none of those that are read."""
    from obsynth.monitoring.thresholds.learned import LEARNED

    for log in options.data:
        require_distinct({"--gains": options.gains, "--out": options.out, "--data": None if is_stream else log})
        options.data = log
        protect_inputs(options)
    target = None if options.out is None else output_file(options.out, LEARNED, options)
    if target is not None and target.suffix.lower() != ".json":
        raise SpecError(f"{target}: thresholds are written as JSON (.json).", path="--out")
    return target


def _lines(design: ObserverDesign, learned: LearnedThresholds) -> Iterator[str]:
    """Yield the lines that are printed: what the thresholds mean, what is monitored, and what is left out."""
    from obsynth.monitoring.statement_lines import statement_lines
    from obsynth.monitoring.thresholds.learned_from_rows import expects_fault_profiles

    yield from statement_lines("", f"{learned.statement[0].upper()}{learned.statement[1:]}")
    yield f"Monitored: {', '.join(learned.columns)}."
    if learned.seldom:
        yield f"Left out (missing in most rows): {', '.join(learned.seldom)}."
    if dependent := [name for name in learned.left_out if name not in learned.seldom]:
        yield f"Left out (redundant or too slowly varying): {', '.join(dependent)}."
    estimates_are_left_out = not any(name.startswith("fhat[") for name in learned.columns)
    if learned.left_out and expects_fault_profiles(design) and estimates_are_left_out:
        yield (
            "Once the estimate follows a fault, these return to zero: an alarm comes at the onset of the fault or "
            "not at all. Give run a level for the estimate as well (--threshold)."
        )
    if learned.logs == 1:
        yield (
            "One log says nothing of what differs between logs: other starts, set points and drifts. Give three normal "
            "logs or more where they differ (--data a.csv b.csv c.csv)."
        )
    yield from learned.notes


def _payload(learned: LearnedThresholds) -> dict[str, Any]:
    """Return thresholds as they are printed with ``--json``."""
    return {
        "holds": learned.holds,
        "statement": learned.statement,
        "notes": list(learned.notes),
        "rows": learned.rows,
        "needed": learned.needed,
        "rows_per_alarm": learned.every,
        "watched": list(learned.columns),
        "left_out": list(learned.left_out),
        "levels": dict(zip(learned.statistics.names, learned.levels.tolist(), strict=True)),
        "logs": learned.logs,
        "sensor_drift": learned.sensor_drift,
        "without_drift": list(learned.without_drift),
        "drift_limits": dict(learned.drift_limits),
        "healthy_time": learned.healthy_time._asdict(),
    }
