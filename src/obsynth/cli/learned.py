"""The verb ``thresholds``: a gain set and a log without faults in, thresholds out."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from obsynth.cli.arguments import columns_of
from obsynth.cli.data_run import STREAM, numbers_of, with_input_delay
from obsynth.cli.output import answer, gains_to_hand_on, output_file
from obsynth.errors import SpecError
from obsynth.files.inputs import protect, protect_stream
from obsynth.files.outputs import require_distinct


def run_thresholds(options: argparse.Namespace) -> int:
    """Run ``thresholds``: 0 whether the rows suffice for the rate or not, which is told; every failure is an error."""
    from obsynth.data.normal_rows import FALSE_ALARM_RATE, learn_thresholds
    from obsynth.experiments.monitors.learned import LEARNED

    is_stream = options.data == STREAM
    require_distinct({"--gains": options.gains, "--out": options.out, "--data": None if is_stream else options.data})
    protect(options.gains)
    if is_stream:
        protect_stream(sys.stdin)
    else:
        protect(Path(options.data))
    target = None if options.out is None else output_file(options.out, LEARNED, options)
    if target is not None and target.suffix.lower() != ".json":
        raise SpecError(f"{target}: thresholds are written as JSON (.json).", path="--out")
    design, _ = gains_to_hand_on(options.gains, unverified=options.unverified)
    found = learn_thresholds(
        with_input_delay(design, options),
        sys.stdin if is_stream else Path(options.data),
        false_alarms=options.false_alarms or FALSE_ALARM_RATE,
        rows=options.rows,
        columns=columns_of(options),
        scales=numbers_of(options.scale),
        gap=options.gap,
        warm_up=options.warm_up,
    )
    file = None if target is None else found.save(target)
    levels = dict(zip(found.statistics.names, found.levels.tolist(), strict=True))
    if not found.holds:
        print(
            f"Warning: the rate needs {found.needed} rows without faults, and {found.rows} are given.", file=sys.stderr
        )
    lines = [f"{found.statement[0].upper()}{found.statement[1:]}.", f"Monitored: {', '.join(found.columns)}."]
    if found.left_out:
        lines.append(
            f"Not monitored, as they depend on the others or are correlated for too long: {', '.join(found.left_out)}."
        )
    answer(
        options,
        {
            "gains": options.gains,
            "file": file,
            "holds": found.holds,
            "statement": found.statement,
            "rows": found.rows,
            "needed": found.needed,
            "rows_per_alarm": found.every,
            "watched": list(found.columns),
            "left_out": list(found.left_out),
            "levels": levels,
        },
        "\n".join(lines),
    )
    return 0
