"""The verbs: thin, each one call into the package and one report.

``design``, ``check``, ``sensors`` and ``verify``; those that take a gain set further: run on data, thresholds, proved
alarms, exports, pictures and pages.

The verbs that run a scenario: ``simulate``, ``evaluate``, and ``compare``, which does so for every method.

``sweep``, and ``run`` for many gain sets: many cases in, one table and one picture out.

The verbs between equations, logs and designs: ``linearise``, ``calibrate`` and ``validate``.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np

import obsynth
from obsynth.analysis.transformations.linear_plants import linear_plant
from obsynth.cli.output import (
    MONITOR_NAMES,
    STREAM,
    answer,
    columns_of,
    flag_of,
    gains_to_hand_on,
    numbers_of,
    output_file,
    pair,
    print_json,
    progress,
    ranges_of,
    refuse_given,
    stated_settings,
    stdout_console,
    verified_again,
)
from obsynth.errors import PreconditionError, SolverError, SpecError, VerificationError
from obsynth.experiments.monitors.options import (
    CHANGE,
    FALSE_ALARMS,
    LINEAR_OPTIONS,
    PARAMETER_OPTIONS,
    WINDOW,
    refuse_idle,
)
from obsynth.files.outputs import (
    FileKind,
    input_file,
    made_folder,
    protect,
    protect_stream,
    read_json,
    require_distinct,
    write_atomically,
    write_together,
)
from obsynth.files.tables import text_table
from obsynth.methods.registry import AUTO, REGISTRY, method_class
from obsynth.numerics.libraries import failure_of
from obsynth.plants.noise_model import offset_state
from obsynth.results.design import (
    CALIBRATION_KIND,
    GAIN_SET,
    RESULT_FILE,
    RESULTS,
    box_row,
    calibration_text,
    design_as_dict,
    gain_set_bytes,
    place_of,
    plain,
    restored,
    unverified_mark,
    verify_calibration,
    written_for,
)
from obsynth.spec.loader import design_of_spec, load_model, load_plant, read_yaml

if TYPE_CHECKING:
    from obsynth.analysis.structure import Structure


def run_design(options: argparse.Namespace) -> int:
    """Run ``design``: spec in, report and gain set out."""
    with progress(quiet=options.quiet) as report_stage:
        report_stage(f"reading {options.system}")
        spec = obsynth.load_spec(options.system)
        wanted = default_gains(spec) if options.output is None else options.output
        target = spec_output(wanted, GAIN_SET, spec, options, option="--output")
        _ask(spec)
        design = design_of_spec(spec, progress=report_stage)
        file = write_atomically(target, gain_set_bytes(design, spec=spec.path))
    from obsynth.report.tables import summary

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


def _print_design(design: obsynth.ObserverDesign, file: Path, *, verbose: bool) -> None:
    """Print the answer first; every claim and check if asked for, and what fails in any case."""
    from obsynth.report.tables import design_report, print_summary, summary
    from obsynth.results.layout import checks_table

    console = stdout_console()
    if verbose:
        design_report(design, console=console)
        console.print()
    print_summary(summary(design, file=file, everything=verbose), console=console)
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


def designed_or_loaded(
    spec: obsynth.Spec, gains: Path | None, report_stage: Any, *, unverified: bool = False
) -> obsynth.ObserverDesign:
    """Return the design that a spec asks for, or a saved one of the same plant, verified again."""
    if gains is None:
        return design_of_spec(spec, progress=report_stage)
    design, _ = gains_to_hand_on(gains, unverified=unverified)
    require_same_signals(design, gains, spec)
    return design


#: Constants of a gain set that differ from those of a spec and are told.
MOST_TOLD_CONSTANTS = 4


def require_same_signals(design: obsynth.ObserverDesign, gains: Path, spec: obsynth.Spec) -> None:
    """Raise `SpecError` unless a gain set is for a plant with the inputs and outputs of a spec's plant."""
    # States may differ: a method may have eliminated some.
    if any(getattr(design.plant, name) != getattr(spec.plant, name) for name in ("input_names", "output_names")):
        raise SpecError(f"{gains} is for a plant with other signals than that of {spec.path}.", path=str(gains))
    own, stated = (getattr(plant, "constants", None) or {} for plant in (design.plant, spec.plant))
    others = [name for name, value in own.items() if stated.get(name, value) != value]
    if others:
        told = ", ".join(f"{name} {own[name]:.6g} for {stated[name]:.6g}" for name in others[:MOST_TOLD_CONSTANTS])
        print(
            f"Warning: {gains} is for a plant with other constants than that of {spec.path} ({told}"
            f"{', ...' if len(others) > MOST_TOLD_CONSTANTS else ''}): the plant of the gain set is used.",
            file=sys.stderr,
        )


def spec_output(
    wanted: Path, kind: FileKind | None, spec: obsynth.Spec, options: argparse.Namespace, *, option: str
) -> Path:
    """Return where to write what a spec asks for; refuse a hopeless place before any work is done."""
    if wanted.exists() and wanted.samefile(spec.path):
        raise SpecError(f"{wanted} is the spec itself: give another file to {option}.", path=str(wanted))
    return output_file(wanted, kind, options, option=option)


def run_check(options: argparse.Namespace) -> int:
    """Run ``check``: structure, and the existence conditions of every method."""
    spec = obsynth.load_spec(options.system)
    _ask(spec)
    from obsynth.report.tables import check_report, diagnosis_report, is_unclear, print_methods

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
        structures = {"as written": obsynth.analyse_structure(spec.transformation.source), **structures}
    done = "" if spec.transformation is None else spec.transformation.description
    methods = obsynth.check(spec.plant, {spec.method: spec.options})
    own = methods.values() if spec.method == AUTO else [methods[spec.method]]
    passed = any(report.passed for report in own)

    def told() -> None:
        console = stdout_console()
        if diagnosis is not None:
            diagnosis_report(diagnosis, console=console, everything=options.verbose)
            console.print()
        if not_known:
            console.print(f"{not_known}\n")
        if options.verbose:
            check_report(spec.plant, structures, methods, console=console, transformation=done)
            console.print()
        print_methods(methods, own=spec.method, console=console)

    answer(
        options,
        {
            "spec": spec.path,
            "method": spec.method,
            "passed": passed,
            "transformation": done,
            "diagnosis": None if diagnosis is None else diagnosis.to_dict(),
            "structure": {name.replace(" ", "_"): _structure_as_dict(found) for name, found in structures.items()},
            "methods": {name: report.as_dict() for name, report in methods.items()},
        },
        told,
    )
    # What double precision cannot decide is no impossibility: it is inconclusive.
    undecided = any(is_unclear(report.failures) for report in own)
    return 0 if passed else SolverError.exit_code if undecided else PreconditionError.exit_code


def _ask(spec: obsynth.Spec) -> None:
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


def run_sensors(options: argparse.Namespace) -> int:
    """Run ``sensors``: spec in, least sets of sensors to add out; 3 where nothing reaches the goal."""
    with progress(quiet=options.quiet) as report_stage:
        spec = obsynth.load_spec(options.system)
        plant = linear_plant(spec.plant)
        given: dict[str, Any] = {"goal": options.goal, "noise": options.noise, "largest": options.largest}
        if options.goal == "threshold":
            own = dict(spec.options) if spec.method == "guaranteed-test" else {}
            fault = options.fault or own.pop("fault", None)
            if fault is None and plant.nf == 1:
                fault = plant.fault_names[0]
            own = {name: value for name, value in own.items() if name != "fault"}
            given |= {"fault": fault, "below": options.below, "sample_time": options.sample_time, "test": own}
        else:
            refuse_given(options, ("below", "sample_time"), "--goal threshold")
            given |= {"faults": None if options.fault is None else [options.fault]}
        found = obsynth.sensor_sets(plant, progress=report_stage, **given)
    answer(options, {"spec": spec.path, **found.to_dict()}, lambda: stdout_console().print(str(found), highlight=False))
    return 0


def run_verify(options: argparse.Namespace) -> int:
    """Run ``verify``: recheck any certificate, without a solver, to the end of what it rests on."""
    from obsynth.comparison.certificates import kind_of_file, verify_certificate
    from obsynth.experiments.alarm_proof import ALARM_KIND

    options.gains = options.gains or options.file
    # A pipe would keep us waiting; who reads a gain set says what is wrong with it.
    found = kind_of_file(options.gains) if options.gains.is_file() else ""
    kind = {ALARM_KIND: "alarm", CALIBRATION_KIND: "calibration"}.get(found, found.removeprefix("obsynth "))
    if found not in (ALARM_KIND, CALIBRATION_KIND, *RESULTS):
        _require_fitting(options, "gain set")
        return _verify_gain_set(options)
    _require_fitting(options, kind)
    from obsynth.results.layout import print_checks

    if found == CALIBRATION_KIND:
        report = verify_calibration(options.gains, None if options.data is None else _calibrated_again(options))
    else:
        report = verify_certificate(options.gains, data=options.data)
    if options.calibration is not None and report.passed:
        from obsynth.comparison.certificates import designs_inside

        for design in designs_inside(options.gains):
            report = _with_calibration(report, design, options.calibration)
    told = next((row.claim for row in report.checks if row.name == "statement"), "")
    answer(
        options,
        {
            "file": str(options.gains), "kind": kind, "passed": report.passed, "statement": told,
            "report": report.as_dict(),
        },
        lambda: print_checks(report.checks, console=stdout_console()),
    )  # fmt: skip
    return 0 if report.passed else VerificationError.exit_code


def _require_fitting(options: argparse.Namespace, kind: str) -> None:
    """Refuse options that do nothing for a kind of certificate."""
    meant = {"data": ("alarm", "comparison", "calibration"), "calibration": ("gain set", "alarm", "robustness"),
             "system": ("calibration",), "printed_digits": ("gain set",)}  # fmt: skip
    for name, kinds in meant.items():
        if getattr(options, name) is not None and kind not in kinds:
            option = f"--{name.replace('_', '-')}"
            raise SpecError(f"{options.gains} is a certificate of the kind {kind!r}: {option} is for "
                            f"{' and '.join(kinds)}.", path=option)  # fmt: skip
    if kind == "calibration" and (options.data is None) != (options.system is None):
        raise SpecError("A calibration is done again from plant and log: give both --system and --data.",
                        path="--system")  # fmt: skip


def _calibrated_again(options: argparse.Namespace) -> dict[str, Any]:
    """Return what the same calibration of the given plant and log comes to."""
    plant, _ = load_plant(options.system)
    asked = read_json(options.gains).get("asked")
    if not isinstance(asked, dict):
        raise SpecError(
            f"{options.gains} does not hold the options of its calibration: calibrate again.", path=str(options.gains)
        )
    return obsynth.calibrate(plant, options.data, **restored(asked)).to_dict()


def _with_calibration(
    report: obsynth.VerificationReport, design: obsynth.ObserverDesign, path: Path
) -> obsynth.VerificationReport:
    """Return a report with the row that the box of a design is that of a calibration file."""
    uncertain = design.plant.uncertainty if isinstance(design.plant, obsynth.DescriptorSystem) else None
    if uncertain is None:
        raise SpecError(f"{design.name!r} has no tolerances, which a calibration could give.", path="--calibration")
    return obsynth.VerificationReport.of((*report.checks, box_row(uncertain.box, path)))


def _verify_gain_set(options: argparse.Namespace) -> int:
    design = obsynth.load(options.gains)
    report = obsynth.verify(design, printed_digits=options.printed_digits)
    if options.calibration is not None:
        report = _with_calibration(report, design, options.calibration)
    answer(
        options,
        {
            "file": str(options.gains), "name": design.name, "method": design.method, "passed": report.passed,
            "report": report.as_dict(),
        },
        lambda: _print_design(design.replace(report=report), options.gains, verbose=options.verbose),
    )  # fmt: skip
    return 0 if report.passed else VerificationError.exit_code


def protect_inputs(options: argparse.Namespace) -> None:
    """Refuse to write over what is read."""
    log = None if options.data in (None, STREAM) else Path(options.data)
    for file in (options.gains, getattr(options, "system", None), log):
        if file is not None:
            protect(file)
    if options.data == STREAM:
        protect_stream(sys.stdin)


def run_of(
    design: obsynth.ObserverDesign,
    options: argparse.Namespace,
    watched: obsynth.types.Monitor | None,
    out: Path | TextIO | None = None,
    **more: Any,
) -> obsynth.types.DataRun:
    """Return a run of a design on the data of the command line, with its table where it is not written to ``out``."""
    design = with_input_delay(design, options)
    with rows_done(options.data, quiet=getattr(options, "quiet", True) or out is sys.stdout) as progress:
        found = obsynth.run_on_data(
            design,
            sys.stdin if options.data == STREAM else Path(options.data),
            out,
            columns=columns_of(options),
            scales=numbers_of(options.scale),
            thresholds=numbers_of(options.threshold),
            monitor=watched,
            gap=options.gap,
            warm_up=options.warm_up,
            progress=progress,
            **more,
        )
    for text in found.warnings:
        print(f"Warning: {text}", file=sys.stderr)
    return found


def stated_delay(options: argparse.Namespace) -> int | None:
    """Return by how many rows the inputs of a log act later, as the command line says it."""
    if options.input_delay == "auto":
        raise SpecError("--input-delay auto is for calibrate: give a number of rows.", path="--input-delay")
    rows: int | None = options.input_delay
    return rows


def with_input_delay(design: obsynth.ObserverDesign, options: argparse.Namespace) -> obsynth.ObserverDesign:
    """Return a design for a log whose inputs act as many rows later as the command line says."""
    rows = stated_delay(options)
    return design if rows is None else design.replace(input_delay=rows)


def own_tolerances(design: obsynth.ObserverDesign, kind: str | None) -> obsynth.types.Uncertainty | None:
    """Return the tolerances of a design's plant, which its pointwise threshold holds for."""
    # Continuous designs with known inputs must be asked for it: the inputs have to be held between rows.

    plant = design.plant
    if design.method == "guaranteed-test" and not design.observer.state_names:
        # Nothing beside the test follows the state: its threshold is that of an exact model, and says so.
        return None
    if kind != "pointwise" or not isinstance(plant, obsynth.DescriptorSystem) or (plant.nu and not plant.is_discrete):
        return None
    own = plant.uncertainty if isinstance(design.observer, obsynth.LinearObserver) else None
    # Constants without a tolerance leave nothing to adapt to: the model is exact.
    return own if own is not None and own.box.names else None


def monitor_settings(design: obsynth.ObserverDesign, options: argparse.Namespace) -> dict[str, Any]:
    """Return what the monitor of a design that is asked for is made of, by the names of the arguments of
    `obsynth.monitor`."""
    table = LINEAR_OPTIONS if isinstance(design.observer, obsynth.LinearObserver) else PARAMETER_OPTIONS
    given = stated_settings(options)
    if getattr(options, "prove", None) is not None:
        del given["window"]  # it is that of the proof
    refuse_idle(table, options.monitor, given, called=flag_of)
    given["constants"] = own_tolerances(design, options.monitor)
    acting = table.get(options.monitor, ())
    settings = {name: value for name, value in given.items() if name in acting and value is not None}
    return {**settings, "unverified": options.unverified}


def monitor_of(
    design: obsynth.ObserverDesign, options: argparse.Namespace, *, has_scenario: bool = False
) -> obsynth.types.Monitor | None:
    """Return the monitor that is asked for."""
    if options.monitor is None:
        of_monitors = (*(() if has_scenario else ("system",)), "sample_time", *MONITOR_NAMES)
        refuse_given(options, of_monitors, "a monitor: name it with --monitor")
        return None

    linear, scenario = isinstance(design.observer, obsynth.LinearObserver), None
    if not linear:
        refuse_given(options, ("sample_time", *(() if has_scenario else ("system",))), "monitors of linear designs")
    # Of other designs, and beside thresholds that were learned, a scenario is there for the pictures alone.
    if options.system is not None and not (has_scenario and (not linear or options.monitor == "learned")):
        spec = obsynth.load_spec(options.system)
        require_same_signals(design, options.gains, spec)
        scenario = required_scenario(spec)
    return obsynth.online_monitor(
        design,
        options.monitor,
        scenario=scenario,
        sample_time=options.sample_time,
        **monitor_settings(design, options),
    )


def summary_of_run(found: obsynth.types.DataRun, watched: obsynth.types.Monitor | None) -> str:
    """Return what a run was, in a few lines."""
    from obsynth.data.alarm_events import alarm_notes, alarm_rows, silence

    counts = ", ".join(f"{count} {status}" for status, count in found.statuses.items())
    lines = [f"{found.rows} rows: {counts}."]
    if found.recovered:
        kinds = Counter(found.recovered.values())
        told = ", ".join(f"{count} {kind.replace('needs', 'with')}" for kind, count in kinds.items())
        count = len(found.recovered)
        states = "states of the plant as written are" if count > 1 else "state of the plant as written is"
        lines.append(f"{count} {states} recovered as well: {told}.")
    if found.outliers:
        told = ", ".join(f"{count} of {name}" for name, count in found.outliers.items())
        count = sum(found.outliers.values())
        lines.append(f"{count} outlier{'s' if count != 1 else ''}: {told}.")
    for name, time in found.alarms.items():
        first = next((event for event in found.events if event.by == name), None)
        clear = watched is not None and name == watched.kind and first is not None and first.clear
        fault = f"; it points to {first.fault}" if clear and first is not None else ""
        lines.append(f"Alarm: {name} first above its threshold at {found.stamps.shown(time)}{fault}.")
    rows, more = alarm_rows(found.events, found.stamps.shown)
    table = [*(text_table(rows) if rows else []), *([f"and {more} more"] if more else [])]
    lines += [*(f"  {line}" for line in table), *alarm_notes(found.events)]
    if watched is not None or found.thresholds:
        lines += silence(found, watched.kind if watched else "any threshold")
    if watched is not None:
        lines.append(f"The {watched.kind} threshold: {watched.statement}.")
    return "\n".join(lines)


@contextmanager
def rows_done(data: str, *, quiet: bool) -> Iterator[Callable[[int], None] | None]:
    """Show a bar on a terminal: how many rows are done, of how many where that can be known."""
    if quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("rows"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("rows", total=None if data == STREAM else _rows_in(Path(data)))
        yield lambda rows: bar.update(task, completed=rows)


def _rows_in(path: Path) -> int | None:
    """Return how many rows a file of data has, about; `None` where that cannot be told without reading it whole."""
    try:
        if path.suffix.lower() == ".parquet":
            import pyarrow.parquet

            return int(pyarrow.parquet.ParquetFile(path).metadata.num_rows)
        with path.open("rb") as stream:
            sample = stream.read(1 << 20)
        # The rows of the beginning stand for all.
        lines = sample.count(b"\n")
        return round(path.stat().st_size / len(sample) * lines) - 1 if lines > 1 else None
    except (OSError, ImportError, ValueError):
        return None


def required_scenario(spec: obsynth.Spec) -> obsynth.Scenario:
    """Return the scenario of a spec."""
    if spec.scenario is None:
        raise SpecError(
            f"{spec.path} has no scenario: add one, for example scenario: {{horizon: 100}}.", path="scenario"
        )
    return spec.scenario


#: Rows from the alarm on at whose windows a proof is tried, in windows.
_LATER = (0.0, 0.1, 0.25, 0.5, 0.95)


def certificate_target(options: argparse.Namespace) -> Path | None:
    """Return where ``run --prove`` writes its certificate; refuse what cannot be proved before any work is done."""
    if options.prove is None:
        return None
    from obsynth.experiments.alarm_proof import CERTIFICATE

    if options.monitor != "pointwise":
        raise SpecError("--prove is for alarms of --monitor pointwise.", path="--prove")
    if options.data == STREAM or options.state is not None:
        raise SpecError(
            "--prove reads the data again from their first row on: give --data a file, and no --state.", path="--prove"
        )
    return output_file(options.prove, CERTIFICATE, options, option="--prove")


def alarm_of_run(
    design: obsynth.ObserverDesign, options: argparse.Namespace, found: obsynth.types.DataRun, target: Path
) -> dict[str, Any]:
    """Return whether the first alarm of a run is proved, in words, and the certificate's file."""
    row = found.alarm_rows.get("pointwise")
    if row is None:
        return {"proved": False, "row": None, "statement": "No alarm: there is nothing to prove.", "file": None}
    window = options.window or WINDOW
    tried = [min(row + int(share * window), found.rows) for share in _LATER]
    for last in dict.fromkeys(max(number, 2) for number in tried):
        proof = proof_of(design, options, last)
        if proof.proved:
            return {"proved": True, "row": last, "statement": proof.statement, "file": str(proof.save(target))}
    return {"proved": False, "row": row, "statement": proof.statement, "file": None}


def proof_of(
    design: obsynth.ObserverDesign, options: argparse.Namespace, row: int, **more: Any
) -> obsynth.types.AlarmProof:
    """Return the proof, or why there is none, that the window up to a row of the data is not free of faults."""
    return obsynth.prove_alarm(
        with_input_delay(design, options),
        Path(options.data),
        row,
        window=options.window or WINDOW,
        columns=columns_of(options),
        scales=numbers_of(options.scale),
        disturbance_bounds=numbers_of(options.disturbance),
        noise_bound=options.noise_bound,
        initial_set=ranges_of(options.initial) or None,
        unverified=options.unverified,
        **more,
    )


def run_thresholds(options: argparse.Namespace) -> int:
    """Run ``thresholds``: 0 whether the rows suffice for the rate or not, which is told; every failure is an error."""
    from obsynth.data.online_monitor import FALSE_ALARM_RATE, learn_thresholds
    from obsynth.experiments.monitors.learned import LEARNED, expects_fault_courses

    is_stream = options.data == STREAM
    require_distinct({"--gains": options.gains, "--out": options.out, "--data": None if is_stream else options.data})
    protect_inputs(options)
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
    if found.seldom:
        lines.append(f"Not monitored, as most rows lack them: {', '.join(found.seldom)}.")
    if dependent := [name for name in found.left_out if name not in found.seldom]:
        lines.append(
            f"Not monitored, as they depend on the others or are correlated for too long: {', '.join(dependent)}."
        )
    estimates_are_left_out = not any(name.startswith("fhat[") for name in found.columns)
    if found.left_out and expects_fault_courses(design) and estimates_are_left_out:
        lines.append(
            "Once the estimate follows a fault, these return to zero: an alarm comes at the onset of the fault or "
            "not at all. Give run a level for the estimate as well (--threshold)."
        )
    lines += found.notes
    answer(
        options,
        {
            "gains": options.gains,
            "file": file,
            "holds": found.holds,
            "statement": found.statement,
            "notes": list(found.notes),
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


def run_run(options: argparse.Namespace) -> int:
    """Run ``run``: gain set and data in, estimates out."""
    if options.gains.is_dir():
        if options.input_delay is not None:
            raise SpecError(
                "--input-delay is for one gain set: state inputs.hold in the specs of a folder.", path="--input-delay"
            )
        return run_many(options)
    for name, given in (("--jobs", options.jobs is not None), ("--cluster", options.cluster is not None)):
        if given:
            raise SpecError(
                f"{name} spreads the gain sets of a folder: {options.gains} is one gain set. Leave {name} out.",
                path=name,
            )
    if options.state is None:
        refuse_given(options, ("state_every",), "the file of --state")
    if options.json and options.out == STREAM:
        raise SpecError("--json and the estimates cannot both go to stdout: give --out a file.", path="--json")
    out = _target(options)
    certificate = certificate_target(options)
    design, mark = gains_to_hand_on(options.gains, unverified=options.unverified)
    watched = monitor_of(design, options)
    found = run_of(
        design,
        options,
        watched,
        out,
        recovered=_recovered(options.recovered),
        outliers=options.outliers,
        smooth=options.smooth,
        lag=options.lag,
        state=options.state,
        **({} if options.state_every is None else {"state_every": options.state_every}),
    )
    proof = None if certificate is None else alarm_of_run(design, options, found, certificate)
    if options.json:
        print_json(
            {
                "command": "run",
                **({} if proof is None else {"proof": proof}),
                "gains": str(options.gains),
                "file": str(out),
                **found.as_dict(),
                **({"unverified": mark} if mark else {}),
                "monitor": None if watched is None else {"kind": watched.kind, "statement": watched.statement},
            }
        )
    elif not options.quiet:
        # The estimates themselves may be on stdout.
        stream = sys.stderr if out is sys.stdout else sys.stdout
        print(*([mark] if mark else []), summary_of_run(found, watched), sep="\n", file=stream)
        if proof is not None:
            print(proof["statement"], *(["Certificate:", proof["file"]] if proof["file"] else []), file=stream)
    return 0


def _recovered(names: list[str] | None) -> str | list[str] | None:
    return names[0] if names in (["all"], ["none"]) else names


def run_export(options: argparse.Namespace) -> int:
    """Run ``export``: gain set in, file for another program out."""
    from obsynth.exporting.files import export, exported_files

    design, mark = gains_to_hand_on(options.gains, unverified=options.unverified)
    for file, kind in exported_files(options.to).items():
        output_file(file, kind, options, option="--to")
    monitor = None
    if options.normal is not None:
        monitor = obsynth.online_monitor(design, "learned", normal=options.normal, unverified=options.unverified)
    files = export(
        design,
        options.to,
        sample_time=options.sample_time,
        **({} if options.fmi is None else {"fmi": options.fmi}),
        thresholds=numbers_of(options.threshold) or None,
        warm_up=options.warm_up,
        monitor=monitor,
        precision=options.precision,
        outliers=options.outliers,
        unverified=options.unverified,
    )
    answer(options, {"gains": options.gains, "files": files, **({"unverified": mark} if mark else {})}, mark)
    return 0


def run_prove_alarm(options: argparse.Namespace) -> int:
    """Run ``prove-alarm``: 0 whether there is a proof or not; every failure is an error."""
    from obsynth.experiments.alarm_proof import CERTIFICATE

    design = obsynth.load(options.gains)  # `prove_alarm` verifies it
    target = None if options.out is None else output_file(options.out, CERTIFICATE, options)
    found = proof_of(design, options, options.row, state_bounds=numbers_of(options.state_bound) or None)
    file = str(found.save(target)) if found.proved and target is not None else None
    answer(
        options,
        {
            "gains": options.gains,
            "proved": found.proved,
            "row": found.row,
            "window": found.window,
            "margin": found.margin,
            "statement": found.statement,
            "origin": found.origin,
            "file": file,
        },
        found.statement + (f"\nCertificate: {file}" if file else ""),
    )
    return 0


def run_report(options: argparse.Namespace) -> int:
    """Run ``report``: gain set in, verified again, one HTML page out."""
    require_distinct({"--gains": options.gains, "--system": options.system, "--out": options.out})
    if options.out.suffix.lower() == ".json":
        return _run_robustness(options)
    if options.data is None:
        own = ("gains", "unverified", "system", "out", "force", "json")
        refuse_given(options, [name for name in vars(options) if name not in own], "a log: give --data")
    from obsynth.report.page import PAGE, html_report

    scenario = None if options.system is None else required_scenario(obsynth.load_spec(options.system))
    system = None if options.system is None else str(options.system)
    output_file(options.out, PAGE, options)
    design, report = verified_again(options.gains)
    design = design if report.passed else design.replace(report=report)
    run, watched = None, None
    if options.data is not None:
        protect_inputs(options)
        output_file(options.out, PAGE, options)
        watched = monitor_of(design, options, has_scenario=True)
        run = run_of(design, options, watched)
    file = html_report(
        design,
        options.out,
        report=report,
        gains_file=options.gains.name,
        scenario=scenario,
        system_file=system,
        run=run,
        data_file=options.data,
        statement="" if watched is None else watched.statement,
        rows=options.rows,
    )
    if mark := unverified_mark(report):
        print(f"Warning: {options.gains}: {mark}", file=sys.stderr)
    answer(options, {"gains": options.gains, "file": file, "passed": report.passed})
    return 0 if report.passed else VerificationError.exit_code


def _run_robustness(options: argparse.Namespace) -> int:
    """Write what holds for every plant within its tolerances as a certificate."""
    refuse_given(
        options,
        [name for name in vars(options) if name not in ("gains", "out", "force", "json")],
        "the page: a certificate (.json) is of the gain set alone",
    )
    output_file(options.out, RESULT_FILE, options)
    design, _ = gains_to_hand_on(options.gains, unverified=False)
    found = obsynth.robustness(design)
    file = found.save(options.out)
    told = {"gains": options.gains, "file": file, "statement": found.statement, **found.as_dict()}
    answer(options, told, found.statement)
    return 0


def _target(options: argparse.Namespace) -> Path | TextIO:
    """Return where estimates go; refuse a hopeless place before any work is done."""
    from obsynth.data.run import ESTIMATES, STATE
    from obsynth.data.sources import check_suffix

    named = {"--gains": options.gains, "--system": options.system, "--state": options.state}
    streams = {"--data": options.data, "--out": options.out}
    require_distinct({**named, **{name: file for name, file in streams.items() if file != STREAM}})
    protect_inputs(options)
    if options.state is not None:
        output_file(options.state, STATE, options, option="--state")
    if options.out == STREAM:
        return sys.stdout
    target = Path(options.out)
    check_suffix(target)
    return output_file(target, ESTIMATES, options)


#: Formats of pictures, with the mark by which an older one may be replaced.
PICTURES = {".png": rb"\A\x89PNG", ".svg": rb"<svg", ".pdf": rb"\A%PDF"}


def run_plot(options: argparse.Namespace) -> int:
    """Run ``plot``: gain set and data in, a picture or a window out."""
    target: Path | None = options.out
    if target is not None:
        kind = picture_kind(target)
        protect_inputs(options)
        output_file(target, kind, options)
    parts = [part.strip() for part in options.show.split(",") if part.strip()]
    design, mark = gains_to_hand_on(options.gains, unverified=options.unverified)
    watched = monitor_of(design, options, has_scenario=True)
    found = run_of(design, options, watched)
    from obsynth.plotting.estimates import panel_count, plot_data

    if target is not None:
        count = panel_count(found, parts, design=design)
        written_picture(target, count, lambda axes: plot_data(found, design=design, show=parts, axes=axes))
    else:
        import matplotlib as mpl
        import matplotlib.pyplot as plt

        if mpl.get_backend().lower() == "agg":
            raise SpecError(
                "There is no screen to open a window on: give --out a file (.png, .svg or .pdf).", path="--out"
            )
        plot_data(found, design=design, show=parts)
        plt.show()
    if options.json or not options.quiet:
        told = "\n".join([*([mark] if mark else []), summary_of_run(found, watched)])
        unverified = {"unverified": mark} if mark else {}
        answer(options, {"gains": options.gains, "file": target, **found.as_dict(), **unverified}, told)
    return 0


def picture_kind(target: Path) -> FileKind:
    """Return what kind of picture a file is to be, by its suffix."""
    suffix = target.suffix.lower()
    if suffix not in PICTURES:
        raise SpecError(f"{target} has an unknown suffix: use one of {', '.join(PICTURES)}.", path=str(target))
    return FileKind(f"a picture ({suffix})", PICTURES[suffix])


def written_picture(target: Path, count: int, draw: Callable[[list[Any]], Any]) -> None:
    """Write a picture of so many panels, one above the other; ``draw`` fills them."""
    from obsynth.plotting.panels import image_of

    write_atomically(target, image_of(count, draw, kind=target.suffix[1:].lower()))


def _prepared(
    options: argparse.Namespace, report_stage: Callable[[str], None], kind: FileKind | None = None
) -> tuple[obsynth.Spec, obsynth.Scenario, Path | None, obsynth.ObserverDesign]:
    """Return spec, scenario, where to write a file of some kind, and the design, made or loaded."""
    report_stage(f"reading {options.system}")
    spec = obsynth.load_spec(options.system)
    scenario = required_scenario(spec)
    if options.gains is not None:
        protect(options.gains)
    else:
        refuse_given(options, ("unverified",), "a gain set: give --gains, as what is designed here is verified")
    target = None if options.out is None else spec_output(options.out, kind, spec, options, option="--out")
    return spec, scenario, target, designed_or_loaded(spec, options.gains, report_stage, unverified=options.unverified)


def run_simulate(options: argparse.Namespace) -> int:
    """Run ``simulate``: spec in, table of errors out, and every signal in a file if asked."""
    with progress(quiet=options.quiet) as report_stage:
        from obsynth.experiments.simulation import SIMULATED_SIGNALS, simulate

        spec, scenario, target, design = _prepared(options, report_stage, SIMULATED_SIGNALS)
        report_stage("simulating")
        found = simulate(design, scenario)
        # A log as run reads it; a bias of a sensor is a deviation of its own.
        point = {**getattr(design.plant, "operating_point", {})}
        point = {name: value for name, value in point.items() if name not in getattr(design.plant, "sensor_faults", ())}
        written = None if target is None else str(found.write_csv(target, operating_point=point))
    from obsynth.report.tables import simulation_report

    answer(
        options,
        {"spec": spec.path, "file": written, **found.summary()},
        lambda: simulation_report(design.name, found, console=stdout_console(), units=design.plant.units, file=written),
    )
    return 0


def _run_tolerances(options: argparse.Namespace) -> int:
    """Run ``evaluate --tolerances``: spec in, a table and a picture out."""
    if options.monitor not in (None, "pointwise"):
        raise SpecError("--tolerances compares two pointwise monitors: leave out --monitor.", path="--tolerances")
    unused = ("plants", "confidence", "jobs", "initial_error", "initial", "false_alarms", "window", "change")
    refuse_given(options, unused, "one monitor on many runs, and --tolerances compares two on plants that it draws")
    with progress(quiet=options.quiet) as report_stage:
        kind = None if options.out is None else RESULT_FILE if _is_json(options.out) else picture_kind(options.out)
        spec, scenario, target, design = _prepared(options, report_stage, kind)

        found = obsynth.tolerance_study(
            design,
            scenario,
            tolerances=[_tolerance(item) for item in options.tolerances.split(",")],
            runs=options.runs,
            disturbance_bounds=numbers_of(options.disturbance) or None,
            noise_bound=options.noise_bound,
            progress=report_stage,
        )
    if target is not None and _is_json(target):
        found.save(target)
    elif target is not None:
        from obsynth.plotting.estimates import plot_tolerances

        written_picture(target, 2, lambda axes: plot_tolerances(found, axes=axes))
    answer(
        options,
        {"spec": spec.path, "file": target, "statement": found.statement, **found.as_dict()},
        f"{found}\n{found.statement}",
    )
    return 0


def _is_json(path: Path) -> bool:
    return path.suffix.lower() == ".json"


def _tolerance(text: str) -> float | str:
    """Return a tolerance as a share, or as a text with its per cent."""
    try:
        return float(text)
    except ValueError:
        return text.strip()


def run_evaluate(options: argparse.Namespace) -> int:
    """Run ``evaluate``: spec in, table of rates and errors out."""
    if options.tolerances is not None:
        return _run_tolerances(options)
    refuse_given(options, ("out", "force"), "the picture or certificate of --tolerances")
    if options.monitor is None:
        refuse_given(options, MONITOR_NAMES, "a monitor: name it with --monitor")
    with progress(quiet=options.quiet) as report_stage:
        spec, scenario, _, design = _prepared(options, report_stage)
        report_stage("running")

        watched: obsynth.types.Monitor | obsynth.ParameterMonitor | None = None
        if options.monitor is not None and isinstance(design.observer, obsynth.LinearObserver):
            watched = obsynth.monitor(design, scenario, options.monitor, **monitor_settings(design, options))
        elif options.monitor is not None:
            table = {**PARAMETER_OPTIONS, "glr": ("false_alarms",)}
            refuse_idle(table, options.monitor, stated_settings(options), called=flag_of)
            watched = obsynth.ParameterMonitor(
                options.monitor,
                false_alarms=options.false_alarms or FALSE_ALARMS,
                change=(options.change or CHANGE) if options.monitor == "cusum" else None,
            )
        with chosen_executor(options.jobs, None) as executor:
            found = obsynth.evaluate(
                design,
                scenario,
                runs=options.runs,
                monitor=watched,
                executor=executor,
                progress=lambda done, total: report_stage(f"{done} of {total} runs"),
                plants=options.plants,
                **({} if options.confidence is None else {"confidence": options.confidence}),
            )
    from obsynth.comparison.comparing import design_beside_least, in_words
    from obsynth.report.tables import described, evaluation_report, final_threshold

    least = design_beside_least(design, scenario)
    sentences = [in_words(name, *pair, design.plant.units.get(name, "")) for name, pair in least.items()]
    told: dict[str, Any] | None = None
    if watched is not None:
        kind, statement = described(watched)
        told = {"kind": kind, "statement": statement, "final_threshold": final_threshold(watched)}
    answer(
        options,
        {
            "spec": spec.path,
            "monitor": told,
            "least_thresholds": {name: {"bound": pair[0], "least": pair[1]} for name, pair in least.items()},
            **found.as_dict(),
        },
        lambda: evaluation_report(
            design.name, found, monitor=watched, console=stdout_console(), units=design.plant.units, beside=sentences
        ),
    )
    return 0


def run_compare(options: argparse.Namespace) -> int:
    """Run ``compare``: spec in, table and recommendation out; 3 where no method exists."""
    from obsynth.comparison.comparing import COMPARISON_PAGE

    with progress(quiet=options.quiet) as report_stage:
        report_stage(f"reading {options.system}")
        spec = obsynth.load_spec(options.system)
        if options.data is None:
            refuse_given(options, ("map", "scale", "time_column", "input_delay"), "a log: give --data")
        if options.out is not None:
            output_file(options.out, RESULT_FILE if _is_json(options.out) else COMPARISON_PAGE, options)
        given = {} if spec.method == "auto" else {spec.method: spec.options}
        rows = stated_delay(options)
        found = obsynth.compare(
            spec.transformation or linear_plant(spec.plant),
            scenario=spec.scenario,
            options=given,
            sample_time=options.sample_time,
            within=options.within,
            tolerance=options.tolerance,
            runs=options.runs,
            data=options.data,
            columns=columns_of(options),
            scales=numbers_of(options.scale),
            input_delay=(spec.input_delay(spec.plant) if rows is None else rows) or 0,
            progress=report_stage,
        )
        if options.out is not None:
            report_stage(f"writing {options.out}")
            if _is_json(options.out):
                found.save(options.out)
            else:
                write_atomically(options.out, found.page())
    from obsynth.report.tables import comparison_report

    answer(
        options,
        {"spec": spec.path, "statement": found.statement, **found.to_dict()},
        lambda: comparison_report(found, console=stdout_console(), file=options.out),
    )
    return 0 if found.recommended else PreconditionError.exit_code


PICTURE = FileKind("a picture", rb"\A\x89PNG")


def run_sweep(options: argparse.Namespace) -> int:
    """Run ``sweep``; the exit code is 0 when every case was decided, whatever it came to."""
    if options.out.exists() and not options.out.is_dir():
        raise SpecError(f"{options.out} is no folder: give --out the name of one.", path="--out")
    listed = [_value_list(text) for text in options.set]
    parameters = dict(listed)
    if len(parameters) < len(listed):
        raise SpecError("Two lists of values (--set) are of the same entry: put them into one.", path="--set")
    for spec in options.system:
        input_file(Path(spec))  # what is designed for hours is not refused in the end
    _require_claim(options, parameters)

    def work(executor: Executor | None, done: Callable[[int, int], None]) -> Any:
        return obsynth.sweep(options.system, parameters, executor=executor, folder=options.out, progress=done)

    def draw(found: Any) -> Any:
        claims = {name for result in found.results for name in result.claims}
        if options.claim is not None and options.claim not in claims:
            known = ", ".join(sorted(claims)) or "none"
            print(
                f"Warning: no picture is written, as no design claims {options.claim!r}; there are: {known}.",
                file=sys.stderr,
            )
            return None
        return found.plot(options.claim) if claims else None

    table = FileKind("the table of a sweep", rb"\Acase,")
    found, files = _carried_out(options, options.out, ("designs", table, "sweep.png"), work, draw)
    _tell(options, found, files, "cases")
    return 0


def _require_claim(options: argparse.Namespace, parameters: dict[str, list[Any]]) -> None:
    """Refuse a claim that no method of a sweep can make before anything is designed."""
    if options.claim is None:
        return
    methods = list(parameters.get("method.id", ()))
    for section in parameters.get("method", [read_yaml(Path(spec)).get("method") for spec in options.system]):
        methods.append(section.get("id") if isinstance(section, dict) else None)
    # What chooses its method may come to any.
    known = REGISTRY if any(method not in REGISTRY for method in methods) else methods
    claims = sorted({claim for method in known for claim in method_class(method).claims})
    if options.claim not in claims:
        raise SpecError(
            f"No method of this sweep claims {options.claim!r}: give --claim one of {', '.join(claims)}.",
            path="--claim",
        )


def run_many(options: argparse.Namespace) -> int:
    """Run ``run`` for a folder of gain sets: a table, a picture, and the estimates of each design on each log."""
    alone = ("system", "state", "prove", "monitor", "smooth", "lag")
    given = [name for name in alone if getattr(options, name)]
    if given:
        names = ", ".join(f"--{name}" for name in given)
        raise SpecError(f"{names}: for one gain set; --gains is a folder of many.", path=f"--{given[0]}")
    refuse_given(options, ("state_every", "sample_time", *MONITOR_NAMES), "one gain set: --gains is a folder of many")
    folder = Path(options.out)
    if options.out == STREAM or (folder.exists() and not folder.is_dir()):
        raise SpecError("Many designs need a folder for their estimates: give one to --out.", path="--out")

    for path in (Path(options.gains), Path(options.data)):
        if path.is_file():
            input_file(path)  # what is read is never written, by force or not
    asked = {
        "columns": dict(options.map) or None,
        "time_column": options.time_column,
        "outliers": options.outliers,
        "scales": numbers_of(options.scale) or None,
        "thresholds": numbers_of(options.threshold) or None,
        "gap": options.gap,
        "warm_up": options.warm_up,
        "recovered": options.recovered,
        "unverified": options.unverified or None,
    }

    def work(executor: Executor | None, done: Callable[[int, int], None]) -> Any:
        stated = {name: value for name, value in asked.items() if value is not None}
        return obsynth.run_fleet(options.gains, options.data, folder, executor=executor, progress=done, **stated)

    table = FileKind("the table of many runs", rb"\Arun,status,")
    found, files = _carried_out(
        options,
        folder,
        ("runs", table, "fleet.png"),
        work,
        lambda found: found.plot() if "run" in found.counts else None,
    )
    if options.json or not options.quiet:
        _tell(options, found, files, "runs")
    return 0


def _carried_out(
    options: argparse.Namespace,
    folder: Path,
    named: tuple[str, FileKind, str],
    work: Callable[[Executor | None, Callable[[int, int], None]], Any],
    draw: Callable[[Any], Any],
) -> tuple[Any, tuple[Path, ...]]:
    """Return what ``work`` comes to, and the files of its table and picture; nothing is left of a folder in vain."""
    what, kind, picture_name = named
    with made_folder(folder):
        table = output_file(folder / "table.csv", kind, options)
        picture = output_file(folder / picture_name, PICTURE, options)
        with progress(quiet=options.quiet) as report_stage, chosen_executor(options.jobs, options.cluster) as executor:
            found = work(executor, lambda done, total: report_stage(f"{done} of {total} {what}"))
            contents: dict[Path, str | bytes] = {table: found.csv()}
            image = _png_of(lambda: draw(found))
            if image is not None:
                contents[picture] = image
            return found, write_together(contents)


def _tell(options: argparse.Namespace, found: Any, files: tuple[Path, ...], what: str) -> None:
    """Print the table of a sweep or of many runs, and the files."""
    header, rows = found.rows()
    if options.json:
        cases = [dict(zip(header, row, strict=True)) for row in rows]
        print_json({"command": options.verb, "counts": found.counts, what: cases, "files": [str(f) for f in files]})
        return
    console = stdout_console()
    shown = _shown_cases if what == "cases" else _shown_runs
    console.print(shown(found, console.width))
    console.print(f"Written: {', '.join(map(str, files))}", soft_wrap=True)


@contextmanager
def chosen_executor(jobs: int | None, cluster: str | None) -> Iterator[Executor | None]:
    """Yield where work goes: nowhere else, processes, or a Dask cluster."""
    if jobs is not None and cluster is not None:
        raise SpecError("--jobs and --cluster are two places for the work: give one of them.", path="--jobs")
    if cluster is not None:
        from dask import distributed

        connect: Any = distributed.Client
        try:
            client = connect(cluster, timeout="10s")
        except OSError as error:
            raise SpecError(f"There is no Dask scheduler at {cluster}: {error}.", path="--cluster") from error
        with client:
            yield client.get_executor()
        return
    if jobs in (None, 1):
        yield None
        return
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as executor:
        try:
            yield executor
        except BaseException:
            executor.shutdown(wait=False, cancel_futures=True)
            raise


def _value_list(text: str) -> tuple[str, list[Any]]:
    """Return the path and the values of ``PATH=LIST``."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    name, sign, listed = text.partition("=")
    try:
        values = YAML(typ="safe", pure=True).load(listed) if sign else None
    except (YAMLError, ValueError) as error:
        raise SpecError(f"--set {text}: {listed!r} is no YAML list.", path="--set") from error
    if not name or not isinstance(values, list):
        raise SpecError(f"--set {text!r}: give PATH=[value, value, ...].", path="--set")
    return name.strip(), values


def _png_of(plot: Callable[[], Any]) -> bytes | None:
    import matplotlib

    from obsynth.plotting.panels import written

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure = plot()
    if figure is None:
        return None
    picture = written(figure)
    plt.close(figure)
    return picture


#: Blanks between columns.
_BLANKS_BETWEEN = 2


def _shown(found: Any, header: Sequence[str], rows: Iterable[Sequence[str]], width: int) -> Any:
    """Return a table for people, below what became of the cases, what is the same in all, and what has no room."""
    from rich.console import Group
    from rich.text import Text

    from obsynth.results.layout import headed_table

    listed = [tuple("" if cell == "nan" else cell for cell in row) for row in rows]
    columns = dict(zip(header, zip(*listed, strict=True), strict=True)) if listed else {}
    filled = {name: column for name, column in columns.items() if any(column)}
    same = {name: column[0] for name, column in filled.items() if len(listed) > 1 and len(set(column)) == 1}
    shown, widths, missing, room = dict[str, tuple[str, ...]](), dict[str, int](), list[str](), width + _BLANKS_BETWEEN
    for name, column in filled.items():
        if name not in same:
            # Texts fold at blanks; a number that is cut is another number.
            words = [word for text in (name.replace(".", ". "), *column) for word in text.split()]
            wide = max(map(len, words)) + _BLANKS_BETWEEN
            if wide <= room:
                shown[name], widths[name], room = column, wide - _BLANKS_BETWEEN, room - wide
            else:
                missing.append(name)
    lines = [", ".join(f"{count} {status}" for status, count in found.counts.items())]
    if same:
        lines.append(f"In all of them: {', '.join(f'{name} {value}' for name, value in same.items())}.")
    if missing:
        lines.append(f"In table.csv alone: {', '.join(missing)}.")
    table = headed_table(*(name.replace(".", ". ") for name in shown))
    for place, (name, cells) in zip(table.columns, shown.items(), strict=True):
        # What room is left goes to the first texts that could use it.
        more = min(max(map(len, cells)) - widths[name], room)
        place.width, room = widths[name] + max(more, 0), room - max(more, 0)
    for row in zip(*shown.values(), strict=True):
        table.add_row(*(Text(cell or "-") for cell in row))
    return Group(*map(Text, lines), Text(), table)


def _shown_cases(found: Any, width: int) -> Any:
    """Return the table of a sweep for people: without message and file."""
    header, rows = found.rows()
    kept = [i for i, name in enumerate(header) if name not in ("message", "file")]
    told = ([f"{row[i]:.4g}" if isinstance(row[i], float) else str(row[i]) for i in kept] for row in rows)
    return _shown(found, [header[i] for i in kept], told, width)


def _shown_runs(found: Any, width: int) -> Any:
    """Return the table of runs for people: the first alarm of each, and why one was not made."""
    rows = []
    for run in found.runs:
        first = min(run.alarms, key=lambda name: run.alarms[name], default="")
        alarm = f"{first} at {run.alarms[first]:g} s" if first else "-"
        rows.append((run.name, run.status, str(run.rows), str(run.statuses.get("ok", 0)), alarm, run.message))
    return _shown(found, ("run", "status", "rows", "ok", "first alarm", "why not"), rows, width)


#: Written by ``linearise`` and ``calibrate``.
PLANT = FileKind("a plant that obsynth has linearised", rb"\A# Linearised by obsynth", suffix=".yaml")
CALIBRATION = FileKind("a calibration of obsynth", rb'\A\s*\{\s*"kind":\s*"obsynth calibration"', suffix=".json")


def _range(name: str, text: str) -> tuple[float, float]:
    low, mark, high = text.partition(":")
    try:
        return float(low), float(high if mark else "")
    except ValueError:
        raise SpecError(f"{name}={text}: give LOW:HIGH, such as 0.5:2.", path=name) from None


def _log_arguments(options: argparse.Namespace) -> dict[str, Any]:
    given = {"rows": options.rows, "columns": columns_of(options), "scales": dict(numbers_of(options.scale))}
    return {name: value for name, value in given.items() if value}


def run_linearise(options: argparse.Namespace) -> int:
    """Run ``linearise``: spec or plant in, matrices and operating point out."""
    from obsynth.report.tables import linear_plant_text, plant_document

    model, spec = load_model(options.system)
    if options.data is None:
        refuse_given(options, ("rows", "map", "scale", "time_column"), "a log: give --data")
    else:
        protect(options.data)
    target = None if options.out is None else output_file(options.out, PLANT, options)
    free: Any = [name for name in options.free if "=" not in name]
    bounded = dict(pair(name) for name in options.free if "=" in name)
    if bounded:
        whole = (float("-inf"), float("inf"))
        free = {name: whole for name in free} | {name: _range(name, text) for name, text in bounded.items()}
    own = (options.at, options.given, options.free, options.fault, options.disturbance, options.drift)
    if spec is not None and isinstance(spec.plant, obsynth.DescriptorSystem) and not any(own):
        # The point that the spec states, with its tolerances and noise.
        linear = spec.plant if spec.transformation is None else spec.transformation.source
    else:
        linear = obsynth.linearise(
            model,
            at=options.at or "equilibrium",
            given=numbers_of(options.given),
            free=free,
            faults=options.fault,
            disturbances=options.disturbance,
            drift=options.drift,
        )
    found = None
    if options.data is not None:
        found = obsynth.validity(model, linear, options.data, **_log_arguments(options))
    if target is not None:
        write_atomically(target, plant_document(linear, options.system.name))
    told = linear_plant_text(linear) if found is None else f"{linear_plant_text(linear)}\n{found}"
    answer(
        options,
        {
            "system": options.system,
            "file": target,
            "operating_point": dict(linear.operating_point),
            "validity": None if found is None else found.to_dict(),
            **{name: getattr(linear, name) for name in ("E", "A", "B", "C", "Bf", "Df", "Bd")},
            **{
                name: list(getattr(linear, name))
                for name in ("state_names", "input_names", "output_names", "fault_names", "disturbance_names")
            },
        },
        told,
    )
    return 0


def run_calibrate(options: argparse.Namespace) -> int:
    """Run ``calibrate``: spec and log in, constants with their box and a verdict out."""
    from obsynth.calibration.spec_writing import CALIBRATED_SPEC, calibrated_spec

    with progress(quiet=options.quiet) as report_stage:
        report_stage(f"reading {options.system}")
        plant, spec = load_plant(options.system)
        asked = _asked(spec, options)
        log, digest = asked.pop("log"), asked.pop("digest", None)
        if log is None:
            raise SpecError("There is no log: give --data, or calibrate.log in the spec.", path="calibrate.log")
        protect(log)
        target = None if options.out is None else output_file(options.out, CALIBRATION, options)
        written = None if options.write_spec is None else output_file(options.write_spec, CALIBRATED_SPEC, options)
        if written is not None and written.resolve().parent != options.system.resolve().parent:
            raise SpecError(
                f"{written} is in another folder than {options.system}, whose files it refers to: write it to that "
                "folder.", path="write-spec",
            )  # fmt: skip
        found = obsynth.calibrate(plant, log, progress=report_stage, **asked)
        if digest is not None and digest != found.box.digest:
            raise SpecError(
                f"The log {log} is not the one that the spec names: its digest is {found.box.digest}, and "
                f"calibrate.digest {digest}.", path="calibrate.digest",
            )  # fmt: skip
    told = {name: value for name, value in asked.items() if name not in ("log", "digest")}
    data = {"kind": CALIBRATION_KIND, "system": options.system.name, **found.to_dict()}
    if target is not None:
        write_atomically(target, calibration_text({**data, "asked": plain(told)}))
    if written is not None:
        beside = target if target is not None and target.parent == written.parent else None
        write_atomically(written, calibrated_spec(options.system, found, calibration=beside))
    answer(options, {"file": target, **data}, f"{found}\n  digest of the log: {found.box.digest}")
    return 0


def _asked(spec: obsynth.Spec | None, options: argparse.Namespace) -> dict[str, Any]:
    """Return the arguments of `calibrate`: of the spec, those of its nonlinear method, and of the command line."""
    asked: dict[str, Any] = {"log": None}
    if spec is not None:
        if isinstance(spec.plant, obsynth.DAEModel):
            method = spec.options
            if isinstance(method.get("Q"), dict):
                asked["noisy"] = [name for name, variance in method["Q"].items() if variance > 0.0]
            for name in ("dt", "initial_state", "initial_covariance"):
                if method.get(name) is not None:
                    asked[name] = _without_offsets(method[name], spec)
        asked |= spec.noise or {}
        if "sensor_noise" in asked:
            # White noise is calibrated anew.
            coloured = {name: item for name, item in asked["sensor_noise"].items() if isinstance(item, dict)}
            asked["sensor_noise"] = coloured or None
        asked |= dict(spec.calibrate or {})
        if asked["log"] is not None:
            asked["log"] = spec.path.parent / asked["log"]
    if options.data is not None:
        asked["log"] = options.data
    asked |= _log_arguments(options)
    asked["unknown"] = dict(asked.get("unknown", {})) | {name: _range(name, text) for name, text in options.unknown}
    late = None if spec is None or spec.inputs is None else spec.input_delay(spec.model or spec.plant)
    if late is not None:
        asked["input_delay"] = late
    for name in ("input_delay", "level"):
        if getattr(options, name) is not None:
            asked[name] = getattr(options, name)
    return asked


def _without_offsets(stated: Any, spec: obsynth.Spec) -> Any:
    """Return what is said of a start without the offsets that another log has shown: this log shows its own."""
    offsets = {offset_state(name) for name in (spec.noise or {}).get("offset") or ()}
    if not (offsets and isinstance(stated, Mapping)):
        return stated
    return {name: value for name, value in stated.items() if name not in offsets} or None


def run_validate(options: argparse.Namespace) -> int:
    """Run ``validate``: gain set and log in, verdict out; the exit code is 6 where they do not agree."""
    design, _ = gains_to_hand_on(options.gains, unverified=options.unverified)
    protect(options.data)
    with progress(quiet=options.quiet) as report_stage:
        report_stage(f"running {options.gains} over {options.data}")
        found = obsynth.validate(
            with_input_delay(design, options), options.data, progress=report_stage, **_log_arguments(options)
        )
    answer(options, {"gains": options.gains, "data": options.data, **found.to_dict()}, str(found))
    return 0 if found.passed else VerificationError.exit_code
