"""The verbs of designs: each makes one call into the package and prints one report."""

from __future__ import annotations

import argparse
import sys
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import obsynth
from obsynth.errors import PreconditionError, SolverError, SpecError, VerificationError
from obsynth.files.inputs import input_file, read_json
from obsynth.files.outputs import write_atomically
from obsynth.methods.registry import AUTO
from obsynth.numerics.libraries import failure_of
from obsynth.report.terminal.arguments import refuse_given
from obsynth.report.terminal.output import emit, print_json, stdout_console
from obsynth.report.terminal.specs import prepared, spec_output
from obsynth.report.terminal.stages import progress
from obsynth.results.calibration_files import CALIBRATION_KIND, box_row, verify_calibration
from obsynth.results.certificate_files import ALARM_KIND, RESULTS, kind_of_file
from obsynth.results.gain_set_writing import GAIN_SET, design_as_dict, gain_set_bytes, place_of, restored
from obsynth.results.gain_sets import written_for
from obsynth.specs.loader import design_of_spec, load_plant

if TYPE_CHECKING:
    from obsynth.analysis.structure import Structure


def run_design(options: argparse.Namespace) -> int:
    """Run ``design``: spec in, report and gain set out."""
    with progress(quiet=options.quiet) as report_stage:
        report_stage(f"reading {options.system}")
        spec = obsynth.load_spec(options.system)
        gains_file = default_gains(spec) if options.output is None else options.output
        target = spec_output(gains_file, GAIN_SET, spec, options, option="--output")
        _print_questions(spec)
        design = design_of_spec(spec, progress=report_stage)
        file = write_atomically(target, gain_set_bytes(design, spec=spec.path))
    from obsynth.report.summary import summary

    if options.json:
        print_json(
            {
                "command": "design",
                "spec": str(spec.path),
                "file": str(file),
                "passed": design.report.passed,
                "summary": summary(design, everything=True).as_dict(),
                "gain_set": {"written_for": place_of(spec.path), **design_as_dict(design)},
            },
            is_plain=True,
        )
        return 0
    _print_design(design, file, verbose=options.verbose)
    return 0


def _print_design(design: obsynth.ObserverDesign, file: Path, *, verbose: bool, is_read: bool = False) -> None:
    """Print the answer first; every claim and check if asked for, and what fails in any case."""
    from obsynth.report.designs import design_report
    from obsynth.report.summary import print_summary, summary
    from obsynth.results.layout import checks_table

    console = stdout_console()
    if verbose:
        design_report(design, console=console, is_read=is_read)
        console.print()
    print_summary(summary(design, file=file, everything=verbose, is_read=is_read), console=console)
    if not verbose and not design.report.passed:
        console.print(checks_table(design.report.failures, width=console.width))


def default_gains(spec: obsynth.Spec) -> Path:
    """Return ``<name>.gains.json``, or a name with that of the spec's file where the first is another spec's."""
    names = (f"{spec.name}.gains.json", f"{spec.name}.{spec.path.stem}.gains.json")
    for name in names:
        target = Path(name)
        if not target.is_file() or written_for(target) in (None, place_of(spec.path)):
            return target
    raise SpecError(f"{' and '.join(names)} are of other specs called {spec.name!r}: give --output.", path=names[0])


def run_check(options: argparse.Namespace) -> int:
    """Run ``check``: structure, and the existence conditions of every method."""
    spec = obsynth.load_spec(options.system)
    _print_questions(spec)
    from obsynth.report.plants import check_report, diagnosis_report, is_unclear, print_methods

    if not isinstance(spec.plant, obsynth.DescriptorSystem):
        refuse_given(options, ("whole_bank",), "linear plants with constant matrices")
    # A pencil, its eigenvalues and its index are those of one matrix pair: a plant that changes with k has none.
    structures, diagnosis, not_known = {}, None, ""
    if isinstance(spec.plant, obsynth.DescriptorSystem):
        structures = {"as the method sees it": obsynth.analyse_structure(spec.plant)}
        model = spec.options.get("fault_model", "step")
        try:
            diagnosis = obsynth.diagnose(spec.plant, fault_model=model, whole_bank=options.whole_bank)
        except (SolverError, MemoryError) as error:  # the methods are asked all the same
            not_known = f"What can be diagnosed is not known. {failure_of(error) or error}"
    if spec.transformation is not None:
        source, name = spec.transformation.source, "as written"
        if getattr(source, "delays", None):  # a plant with delays has no pencil
            source, name = source.replace(delays=None), "as written without delays"
        structures = {name: obsynth.analyse_structure(source), **structures}
    done = "" if spec.transformation is None else spec.transformation.description
    methods = obsynth.check(spec.plant, {spec.method: spec.options})
    own = methods.values() if spec.method == AUTO else [methods[spec.method]]
    passed = any(report.passed for report in own)

    def reported() -> None:
        console = stdout_console()
        if diagnosis is not None:
            diagnosis_report(diagnosis, console=console, everything=options.verbose)
            console.print()
        if not_known:
            console.print(f"{not_known}\n")
        if options.verbose:
            check_report(spec.plant, structures, methods, console=console, own=spec.method, transformation=done)
            console.print()
        over_region = isinstance(spec.plant, obsynth.PolytopicSystem)
        print_methods(methods, own=spec.method, over_region=over_region, console=console)

    emit(
        options,
        {
            "spec": spec.path,
            "method": spec.method,
            "passed": passed,
            "transformation": done,
            "diagnosis": None if diagnosis is None else diagnosis.to_dict(),
            "structure": {
                name.replace(" ", "_"): _structure_as_dict(structure) for name, structure in structures.items()
            },
            "methods": {name: report.as_dict() for name, report in methods.items()},
        },
        reported,
    )
    # What double precision cannot decide is no impossibility: it is inconclusive.
    undecided = any(is_unclear(report.failures) for report in own)
    return 0 if passed else SolverError.exit_code if undecided else PreconditionError.exit_code


def _print_questions(spec: obsynth.Spec) -> None:
    """Ask on stderr what may not be meant, as it may be the reason for all that follows."""
    from obsynth.analysis.structure import questions

    for text in questions(spec.plant) if isinstance(spec.plant, obsynth.DescriptorSystem) else ():
        print(f"Question: {text}", file=sys.stderr)


def _structure_as_dict(structure: Structure) -> dict[str, Any]:
    """Return the structure as plain data, eigenvalues as ``[real, imaginary]``."""
    facts: dict[str, Any] = {field.name: getattr(structure, field.name) for field in fields(structure)}
    for name in ("finite_eigenvalues", "unobservable_modes", "undetectable_modes"):
        facts[name] = [[float(np.real(value)), float(np.imag(value))] for value in facts[name]]
    facts["rank_of_E"] = structure.rank_of_E.rank
    facts["decisions"] = {
        name: {"rank": decision.rank, "expected": decision.expected, "gap": decision.gap, "clear": decision.clear}
        for name, decision in structure.decisions.items()
    }
    return facts


def run_verify(options: argparse.Namespace) -> int:
    """Run ``verify``: recheck any certificate, without a solver, to the end of what it rests on."""

    options.gains = options.gains or options.file
    if options.independent:
        return _verify_independently(options)
    # A pipe would keep us waiting; who reads a gain set says what is wrong with it.
    file_kind = kind_of_file(options.gains) if options.gains.is_file() else ""
    kind = {ALARM_KIND: "alarm", CALIBRATION_KIND: "calibration"}.get(file_kind, file_kind.removeprefix("obsynth "))
    if file_kind not in (ALARM_KIND, CALIBRATION_KIND, *RESULTS):
        _require_fitting(options, "gain set")
        return _verify_gain_set(options)
    _require_fitting(options, kind)
    from obsynth.results.layout import print_checks

    if file_kind == CALIBRATION_KIND:
        report = verify_calibration(options.gains, None if options.data is None else _calibrated_again(options))
    else:
        from obsynth.studies.certificates import verify_certificate

        report = verify_certificate(options.gains, data=options.data)
    if options.calibration is not None and report.passed:
        from obsynth.studies.certificates import designs_inside

        for design in designs_inside(options.gains):
            report = _with_calibration(report, design, options.calibration)
    statement = next((row.claim for row in report.checks if row.name == "statement"), "")
    emit(
        options,
        {
            "file": str(options.gains),
            "kind": kind,
            "passed": report.passed,
            "statement": statement,
            "report": report.as_dict(),
        },
        lambda: print_checks(report.checks, console=stdout_console()),
    )
    return 0 if report.passed else VerificationError.exit_code


def _require_fitting(options: argparse.Namespace, kind: str) -> None:
    """Refuse options that do nothing for a kind of certificate."""
    kinds_of_option = {
        "data": ("alarm", "comparison", "calibration"),
        "calibration": ("gain set", "alarm", "robustness"),
        "system": ("calibration",),
        "printed_digits": ("gain set",),
    }
    for name, kinds in kinds_of_option.items():
        if getattr(options, name) is not None and kind not in kinds:
            option = f"--{name.replace('_', '-')}"
            raise SpecError(
                f"{options.gains} is a certificate of the kind {kind!r}: {option} is for {' and '.join(kinds)}.",
                path=option,
            )
    if kind == "calibration" and (options.data is None) != (options.system is None):
        raise SpecError(
            "A calibration is done again from plant and log: give both --system and --data.", path="--system"
        )


def _calibrated_again(options: argparse.Namespace) -> dict[str, Any]:
    """Return what the same calibration of the given plant and log comes to."""
    plant, _ = load_plant(options.system)
    calibration_options = read_json(options.gains).get("asked")
    if not isinstance(calibration_options, dict):
        raise SpecError(
            f"{options.gains} does not hold the options of its calibration: calibrate again.", path=str(options.gains)
        )
    return obsynth.calibrate(plant, options.data, **restored(calibration_options)).to_dict()


def _with_calibration(
    report: obsynth.VerificationReport, design: obsynth.ObserverDesign, path: Path
) -> obsynth.VerificationReport:
    """Return a report with the row that the box of a design is that of a calibration file."""
    uncertain = design.plant.uncertainty if isinstance(design.plant, obsynth.DescriptorSystem) else None
    if uncertain is None:
        raise SpecError(f"{design.name!r} has no tolerances, which a calibration could give.", path="--calibration")
    return obsynth.VerificationReport.of((*report.checks, box_row(uncertain.box, path)))


def _verify_independently(options: argparse.Namespace) -> int:
    """Have the program without obsynth check a gain set, an alarm or a proof file."""
    from obsynth.exporting.independent import (
        HEAD_BYTES,
        check_alarm_independently,
        check_design_independently,
        check_independently,
        is_proof_file,
    )

    for name in ("data", "calibration", "system", "printed_digits"):
        if getattr(options, name) is not None:
            option = f"--{name.replace('_', '-')}"
            raise SpecError(f"--independent looks at one file alone: leave {option} out.", path=option)
    file = input_file(options.gains)
    with file.open("rb") as stream:
        is_proof = is_proof_file(stream.read(HEAD_BYTES))
    if is_proof:
        outcome = check_independently(file)
    elif kind_of_file(options.gains) == ALARM_KIND:
        outcome = check_alarm_independently(read_json(options.gains))
    else:
        outcome = check_design_independently(obsynth.load(options.gains))
    emit(options, {"file": str(options.gains), "passed": outcome.passed, "text": outcome.text}, outcome.text)
    return 0 if outcome.passed else VerificationError.exit_code


def _verify_gain_set(options: argparse.Namespace) -> int:
    design = obsynth.load(options.gains)
    report = obsynth.verify(design, printed_digits=options.printed_digits)
    if options.calibration is not None:
        report = _with_calibration(report, design, options.calibration)
    emit(
        options,
        {
            "file": str(options.gains),
            "name": design.name,
            "method": design.method,
            "passed": report.passed,
            "report": report.as_dict(),
        },
        lambda: _print_design(design.replace(report=report), options.gains, verbose=options.verbose, is_read=True),
    )
    return 0 if report.passed else VerificationError.exit_code


def run_simulate(options: argparse.Namespace) -> int:
    """Run ``simulate``: spec in, table of errors out, and every signal in a file if asked."""
    with progress(quiet=options.quiet) as report_stage:
        from obsynth.simulation.simulate import SIMULATED_SIGNALS, simulate

        spec, scenario, target, design = prepared(options, report_stage, SIMULATED_SIGNALS)
        report_stage("simulating")
        simulation = simulate(design, scenario)
        # A log as run reads it; a bias of a sensor is a deviation of its own.
        point = {**getattr(design.plant, "operating_point", {})}
        point = {name: value for name, value in point.items() if name not in getattr(design.plant, "sensor_faults", ())}
        written = None if target is None else str(simulation.write_csv(target, operating_point=point))
    from obsynth.report.scenarios import simulation_report

    emit(
        options,
        {"spec": spec.path, "file": written, **simulation.summary()},
        lambda: simulation_report(
            design.name, simulation, console=stdout_console(), units=design.plant.units, file=written
        ),
    )
    return 0
