"""The verb ``sensors``: smallest sets of sensors to add to a plant."""

from __future__ import annotations

import argparse
from typing import Any

from obsynth.plants.transformations.delays import linear_plant
from obsynth.report.terminal.arguments import refuse_given
from obsynth.report.terminal.output import emit, stdout_console
from obsynth.report.terminal.stages import progress


def run_sensors(options: argparse.Namespace) -> int:
    """Run ``sensors``: print the smallest sets of sensors that reach a goal; raise an error where none does."""
    from obsynth.specs.loader import load_spec
    from obsynth.studies.sensor_sets import sensor_sets

    with progress(quiet=options.quiet) as report_stage:
        spec = load_spec(options.system)
        plant = linear_plant(spec.plant)
        arguments: dict[str, Any] = {"goal": options.goal, "noise": options.noise, "largest": options.largest}
        if options.goal == "threshold":
            own = dict(spec.options) if spec.method == "guaranteed-test" else {}
            fault = options.fault or own.pop("fault", None)
            if fault is None and plant.nf == 1:
                fault = plant.fault_names[0]
            own = {name: value for name, value in own.items() if name != "fault"}
            arguments |= {"fault": fault, "below": options.below, "sample_time": options.sample_time, "test": own}
        else:
            refuse_given(options, ("below", "sample_time"), "--goal threshold")
            arguments |= {"faults": None if options.fault is None else [options.fault]}
        sets = sensor_sets(plant, progress=report_stage, **arguments)
    emit(options, {"spec": spec.path, **sets.to_dict()}, lambda: stdout_console().print(str(sets), highlight=False))
    return 0
