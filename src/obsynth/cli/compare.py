"""The verb ``compare``: every method that exists for a spec's plant, side by side."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from obsynth.cli.arguments import add_force, add_json, add_quiet, add_system, output_file
from obsynth.cli.output import print_json, progress, stdout_console
from obsynth.errors import PreconditionError, SpecError

if TYPE_CHECKING:
    from obsynth.plants.descriptor import DescriptorSystem
    from obsynth.spec.loader import Spec

_COMPARE = "Design by every method that exists for a spec's plant, and show them side by side on its scenario."


def add_compare_verb(verbs: Any) -> None:
    """Add the parser."""
    compare = verbs.add_parser("compare", help=_COMPARE, description=_COMPARE)
    add_system(compare)
    compare.add_argument("--data", type=Path, metavar="FILE", help="a log (CSV) to replay through every method")
    compare.add_argument("--out", type=Path, metavar="FILE", help="write a page (HTML) with table and picture")
    compare.add_argument("--runs", type=int, default=20, metavar="N", help="drawn runs of the scenario (default: 20)")
    compare.add_argument(
        "--tolerance", type=float, default=0.0, metavar="T", help="relative error of parameters that is drawn (0.05)"
    )
    compare.add_argument(
        "--within", type=float, metavar="SECONDS", help="90 %% of a step must be shown within this time"
    )
    compare.add_argument("--sample-time", type=float, metavar="SECONDS", help="the clock of a continuous plant")
    add_force(compare)
    add_json(compare)
    add_quiet(compare)
    compare.set_defaults(verb="compare")


def run_compare(options: argparse.Namespace) -> int:
    """Run ``compare``: spec in, table and recommendation out; 3 where no method exists."""
    from obsynth.comparison.comparing import compare
    from obsynth.comparison.result import COMPARISON_PAGE
    from obsynth.files.outputs import write_atomically
    from obsynth.spec import load_spec

    with progress(quiet=options.quiet) as report_stage:
        report_stage(f"reading {options.system}")
        spec = load_spec(options.system)
        if options.out is not None:
            output_file(options.out, COMPARISON_PAGE, options)
        plant, clock = _plant_and_clock(spec, options.sample_time)
        given = {} if spec.method == "auto" else {spec.method: spec.options}
        found = compare(
            plant, scenario=spec.scenario, options=given, sample_time=clock, within=options.within,
            tolerance=options.tolerance, runs=options.runs, data=options.data, progress=report_stage,
        )  # fmt: skip
        if options.out is not None:
            report_stage(f"writing {options.out}")
            write_atomically(options.out, found.page())
    if options.json:
        print_json({"command": "compare", "spec": str(spec.path), **found.to_dict()})
    else:
        from obsynth.report.comparison import comparison_report

        comparison_report(found, console=stdout_console(), file=options.out)
    return 0 if found.recommended else PreconditionError.exit_code


def _plant_and_clock(spec: Spec, sample_time: float | None) -> tuple[DescriptorSystem, float | None]:
    """Return the plant before it was sampled, and the clock: some methods are continuous, and so are tolerances."""
    from obsynth.plants.descriptor import DescriptorSystem

    plant = spec.plant
    if not isinstance(plant, DescriptorSystem):
        raise SpecError("compare is for linear plants with constant matrices.", path="plant")
    if spec.transformation is None:
        return plant, sample_time
    source = spec.transformation.source
    # Faults and unknown inputs are those of the plant as written.
    return source, sample_time if sample_time is not None else (plant.dt or None)
