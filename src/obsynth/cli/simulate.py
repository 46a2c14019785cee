"""The verb ``simulate``: a spec's design on the spec's scenario."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from obsynth.cli.output import print_json, progress, stdout_console
from obsynth.errors import SpecError
from obsynth.files.inputs import protect

if TYPE_CHECKING:
    from obsynth.simulation.scenario import Scenario
    from obsynth.spec import Spec


def required_scenario(spec: Spec) -> Scenario:
    """Return the scenario of a spec."""
    if spec.scenario is None:
        raise SpecError(
            f"{spec.path} has no scenario: add one, for example scenario: {{horizon: 100}}.", path="scenario"
        )
    return spec.scenario


def run_simulate(options: argparse.Namespace) -> int:
    """Run ``simulate``: spec in, table of errors out, and every signal in a file if asked."""
    from obsynth.cli.commands import designed_or_loaded, spec_output
    from obsynth.experiments.columns import SIGNALS
    from obsynth.spec import load_spec

    with progress(quiet=options.quiet) as report_stage:
        report_stage(f"reading {options.system}")
        spec = load_spec(options.system)
        scenario = required_scenario(spec)
        if options.gains is not None:
            protect(options.gains)
        target = None if options.out is None else spec_output(options.out, SIGNALS, spec, options, option="--out")
        design = designed_or_loaded(spec, options.gains, report_stage)
        report_stage("simulating")
        from obsynth.experiments.simulation import simulate

        found = simulate(design, scenario)
        written = None if target is None else str(found.write_csv(target))
    if options.json:
        print_json({"command": "simulate", "spec": str(spec.path), "file": written, **found.summary()})
        return 0
    from obsynth.report.scenarios import simulation_report

    simulation_report(design.name, found, console=stdout_console(), units=design.plant.units, file=written)
    return 0
