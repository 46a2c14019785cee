"""Functions of the verbs that read a spec: the design, made or loaded, its scenario, and output files."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from obsynth.errors import SpecError
from obsynth.files.inputs import protect
from obsynth.files.outputs import FileKind
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.input_derivatives import derivative_of
from obsynth.plants.pencil import structure_of
from obsynth.plants.transformations.exact_elimination import EXACT_ELIMINATION_UP_TO
from obsynth.report.terminal.arguments import refuse_given
from obsynth.report.terminal.output import gains_to_hand_on, output_file
from obsynth.specs.loader import design_of_spec

if TYPE_CHECKING:
    from obsynth.results.design import ObserverDesign
    from obsynth.simulation.scenario import Scenario
    from obsynth.specs.loader import Spec


#: Constants of a gain set that differ from those of a spec and are reported.
MOST_TOLD_CONSTANTS = 4


def designed_or_loaded(
    spec: Spec, gains: Path | None, report_stage: Any, *, unverified: bool = False
) -> ObserverDesign:
    """Return the design that a spec asks for, or a saved one of the same plant, verified again."""
    if gains is None:
        return design_of_spec(spec, progress=report_stage)
    design, _ = gains_to_hand_on(gains, unverified=unverified)
    require_same_signals(design, gains, spec)
    return design


def require_same_signals(design: ObserverDesign, gains: Path, spec: Spec) -> None:
    """Raise `SpecError` unless a gain set is for a plant with the inputs and outputs of a spec's plant."""
    # States may differ: a method may have eliminated some, and then derivatives of known inputs are inputs as well, and
    # outputs that need those of other signals are left out.
    inputs, outputs = spec.plant.input_names, design.plant.output_names
    own_inputs = tuple(
        name for name in design.plant.input_names if name in inputs or derivative_of(name, inputs) is None
    )
    omitted_outputs = set(spec.plant.output_names) - set(outputs) if _is_of_high_index(spec.plant) else set()
    if (
        own_inputs != inputs
        or tuple(name for name in spec.plant.output_names if name not in omitted_outputs) != outputs
    ):
        raise SpecError(f"{gains} is for a plant with other signals than that of {spec.path}.", path=str(gains))
    own, stated = (getattr(plant, "constants", None) or {} for plant in (design.plant, spec.plant))
    others = [name for name, value in own.items() if stated.get(name, value) != value]
    if others:
        changes = ", ".join(f"{name} {own[name]:.6g} for {stated[name]:.6g}" for name in others[:MOST_TOLD_CONSTANTS])
        print(
            f"Warning: {gains} is for a plant with other constants than that of {spec.path} ({changes}"
            f"{', ...' if len(others) > MOST_TOLD_CONSTANTS else ''}): the plant of the gain set is used.",
            file=sys.stderr,
        )


def spec_output(wanted: Path, kind: FileKind | None, spec: Spec, options: argparse.Namespace, *, option: str) -> Path:
    """Return where to write what a spec asks for; refuse a hopeless place before any work is done."""
    if wanted.exists() and wanted.samefile(spec.path):
        raise SpecError(f"{wanted} is the spec itself: give another file to {option}.", path=str(wanted))
    return output_file(wanted, kind, options, option=option)


def required_scenario(spec: Spec) -> Scenario:
    """Return the scenario of a spec."""
    if spec.scenario is None:
        raise SpecError(
            f"{spec.path} has no scenario: add one, for example scenario: {{horizon: 100}}.", path="scenario"
        )
    return spec.scenario


def prepared(
    options: argparse.Namespace, report_stage: Callable[[str], None], kind: FileKind | None = None
) -> tuple[Spec, Scenario, Path | None, ObserverDesign]:
    """Return spec, scenario, where to write a file of some kind, and the design, made or loaded."""
    from obsynth.specs.loader import load_spec

    report_stage(f"reading {options.system}")
    spec = load_spec(options.system)
    scenario = required_scenario(spec)
    if options.gains is not None:
        protect(options.gains)
    else:
        refuse_given(options, ("unverified",), "a gain set: give --gains, as what is designed here is verified")
    target = None if options.out is None else spec_output(options.out, kind, spec, options, option="--out")
    return spec, scenario, target, designed_or_loaded(spec, options.gains, report_stage, unverified=options.unverified)


def _is_of_high_index(plant: Any) -> bool:
    """Whether a plant is a linear one of index 2 or more, whose design may be for other signals."""
    small = isinstance(plant, DescriptorSystem) and plant.nx <= EXACT_ELIMINATION_UP_TO
    return small and (structure_of(plant).index or 0) > 1
