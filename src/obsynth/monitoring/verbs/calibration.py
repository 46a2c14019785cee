"""The verbs between equations, logs and designs: ``linearise``, ``calibrate`` and ``validate``."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from obsynth.errors import SpecError, VerificationError
from obsynth.files.inputs import protect
from obsynth.files.outputs import FileKind, write_atomically
from obsynth.monitoring.verbs.data_arguments import with_input_delay
from obsynth.plants.noise import offset_state
from obsynth.report.terminal.arguments import columns_of, numbers_of, pair, refuse_given
from obsynth.report.terminal.output import emit, gains_to_hand_on, output_file
from obsynth.report.terminal.stages import progress
from obsynth.results.calibration_files import CALIBRATION_KIND, calibration_text
from obsynth.results.gain_set_writing import plain
from obsynth.specs.loader import load_model, load_plant

if TYPE_CHECKING:
    from obsynth.specs.loader import Spec

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
    arguments = {"rows": options.rows, "columns": columns_of(options), "scales": dict(numbers_of(options.scale))}
    return {name: value for name, value in arguments.items() if value}


def run_linearise(options: argparse.Namespace) -> int:
    """Run ``linearise``: spec or plant in, matrices and operating point out."""
    from obsynth.monitoring.calibration.validity import validity
    from obsynth.plants.descriptor import DescriptorSystem
    from obsynth.plants.transformations.linearisation import linearise
    from obsynth.report.plants import linear_plant_text, plant_document

    model, spec = load_model(options.system)
    if options.data is None:
        refuse_given(options, ("rows", "map", "scale", "time_column"), "a log: give --data")
    else:
        protect(options.data)
    target = None if options.out is None else output_file(options.out, PLANT, options)
    free: Any = [name for name in options.free if "=" not in name]
    bounded = dict(pair(name) for name in options.free if "=" in name)
    if bounded:
        unbounded = (float("-inf"), float("inf"))
        free = {name: unbounded for name in free} | {name: _range(name, text) for name, text in bounded.items()}
    own = (options.at, options.given, options.free, options.fault, options.disturbance, options.drift)
    if spec is not None and isinstance(spec.plant, DescriptorSystem) and not any(own):
        # The point that the spec states, with its tolerances and noise.
        linear = spec.plant if spec.transformation is None else spec.transformation.source
    else:
        linear = linearise(
            model,
            at=options.at or "equilibrium",
            given=numbers_of(options.given),
            free=free,
            faults=options.fault,
            disturbances=options.disturbance,
            drift=options.drift,
        )
    comparison = None
    if options.data is not None:
        comparison = validity(model, linear, options.data, **_log_arguments(options))
    if target is not None:
        write_atomically(target, plant_document(linear, options.system.name))
    summary = linear_plant_text(linear) if comparison is None else f"{linear_plant_text(linear)}\n{comparison}"
    emit(
        options,
        {
            "system": options.system,
            "file": target,
            "operating_point": dict(linear.operating_point),
            "validity": None if comparison is None else comparison.to_dict(),
            **{name: getattr(linear, name) for name in ("E", "A", "B", "C", "Bf", "Df", "Bd")},
            **{
                name: list(getattr(linear, name))
                for name in ("state_names", "input_names", "output_names", "fault_names", "disturbance_names")
            },
        },
        summary,
    )
    return 0


def run_calibrate(options: argparse.Namespace) -> int:
    """Run ``calibrate``: spec and log in, constants with their box and a verdict out."""
    from obsynth.monitoring.calibration.calibrating import calibrate
    from obsynth.monitoring.calibration.spec_writing import CALIBRATED_SPEC, calibrated_spec

    with progress(quiet=options.quiet) as report_stage:
        report_stage(f"reading {options.system}")
        plant, spec = load_plant(options.system)
        arguments = _asked(spec, options)
        log, digest = arguments.pop("log"), arguments.pop("digest", None)
        if log is None:
            raise SpecError("There is no log: give --data, or calibrate.log in the spec.", path="calibrate.log")
        protect(log)
        if options.out is not None and options.out.suffix.lower() in (".yaml", ".yml"):
            raise SpecError(
                f"--out is for the calibration itself (.json): --write-spec {options.out} writes the calibrated spec.",
                path=str(options.out),
            )
        target = None if options.out is None else output_file(options.out, CALIBRATION, options)
        written = None if options.write_spec is None else output_file(options.write_spec, CALIBRATED_SPEC, options)
        if written is not None and written.resolve().parent != options.system.resolve().parent:
            raise SpecError(
                f"{written} is in another folder than {options.system}, whose files it refers to: write it to that "
                "folder.", path="write-spec",
            )  # fmt: skip
        calibration = calibrate(plant, log, progress=report_stage, **arguments)
        if digest is not None and digest != calibration.box.digest:
            raise SpecError(
                f"The log {log} is not the one that the spec names: its digest is {calibration.box.digest}, and "
                f"calibrate.digest {digest}.", path="calibrate.digest",
            )  # fmt: skip
    stated = {name: value for name, value in arguments.items() if name not in ("log", "digest")}
    data = {"kind": CALIBRATION_KIND, "system": options.system.name, **calibration.to_dict()}
    if target is not None:
        write_atomically(target, calibration_text({**data, "asked": plain(stated)}))
    if written is not None:
        beside = target if target is not None and target.parent == written.parent else None
        write_atomically(written, calibrated_spec(options.system, calibration, calibration=beside))
    emit(options, {"file": target, **data}, f"{calibration}\n  digest of the log: {calibration.box.digest}")
    return 0


def _asked(spec: Spec | None, options: argparse.Namespace) -> dict[str, Any]:
    """Return the arguments of `calibrate`: of the spec, those of its nonlinear method, and of the command line."""
    from obsynth.plants.dae import DAEModel

    arguments: dict[str, Any] = {"log": None}
    if spec is not None:
        if isinstance(spec.plant, DAEModel):
            method = spec.options
            if isinstance(method.get("Q"), dict):
                arguments["noisy"] = [name for name, variance in method["Q"].items() if variance > 0.0]
            for name in ("dt", "initial_state", "initial_covariance"):
                if method.get(name) is not None:
                    arguments[name] = _without_offsets(method[name], spec)
        arguments |= spec.noise or {}
        if "sensor_noise" in arguments:
            # White noise is calibrated anew.
            coloured = {name: item for name, item in arguments["sensor_noise"].items() if isinstance(item, dict)}
            arguments["sensor_noise"] = coloured if coloured or not arguments["sensor_noise"] else None
        arguments |= dict(spec.calibrate or {})
        if arguments["log"] is not None:
            arguments["log"] = spec.path.parent / arguments["log"]
    if options.data is not None:
        arguments["log"] = options.data
    arguments |= _log_arguments(options)
    arguments["unknown"] = dict(arguments.get("unknown", {})) | {
        name: _range(name, text) for name, text in options.unknown
    }
    late = None if spec is None or spec.inputs is None else spec.input_delay(spec.model or spec.plant)
    if late is not None:
        arguments["input_delay"] = late
    for name in ("input_delay", "level"):
        if getattr(options, name) is not None:
            arguments[name] = getattr(options, name)
    return arguments


def _without_offsets(stated: Any, spec: Spec) -> Any:
    """Return what is said of a start without the offsets that another log has shown: this log shows its own."""
    offsets = {offset_state(name) for name in (spec.noise or {}).get("offset") or ()}
    if not (offsets and isinstance(stated, Mapping)):
        return stated
    return {name: value for name, value in stated.items() if name not in offsets} or None


def run_validate(options: argparse.Namespace) -> int:
    """Run ``validate``: gain set and log in, verdict out; the exit code is 6 where they do not agree."""
    from obsynth.monitoring.calibration.validating import validate

    design, _ = gains_to_hand_on(options.gains, unverified=options.unverified)
    protect(options.data)
    with progress(quiet=options.quiet) as report_stage:
        report_stage(f"running {options.gains} over {options.data}")
        validation = validate(
            with_input_delay(design, options), options.data, progress=report_stage, **_log_arguments(options)
        )
    emit(options, {"gains": options.gains, "data": options.data, **validation.to_dict()}, str(validation))
    return 0 if validation.passed else VerificationError.exit_code
