"""Observers of nonlinear DAEs, and thresholds over tolerances, as C99: templates filled with sizes and tables.

CasADi writes the equations of a DAE; the loop of Newton around them, its damping and its homotopy are those of
`obsynth.observers.nonlinear.c_code`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from obsynth.errors import SpecError
from obsynth.exporting.alarms import Alarms, ExportedMonitor
from obsynth.exporting.c_precision import in_floats, in_precision
from obsynth.exporting.c_source import (
    alarm_comments,
    c_identifier,
    comment,
    filled_table,
    filled_template,
    included,
    quoted,
    signal_comments,
    status_lines,
    table_lines,
    with_c_linkage,
)
from obsynth.exporting.dae_float import float_error
from obsynth.exporting.realisation import verification_words
from obsynth.files.outputs import write_together
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.changed_options import as_run, rule_of_outliers
from obsynth.observers.linear.modes import SETTLING_SLACK, checked_warm_up
from obsynth.observers.nonlinear.c_code import observer_code, observer_struct
from obsynth.plants.dae import DAEModel
from obsynth.results.design import ObserverDesign
from obsynth.results.gain_set_writing import gain_set_digest
from obsynth.verification.over_tolerances.adaptive_bound import AdaptiveBound
from obsynth.verification.over_tolerances.adaptive_recursion import THRESHOLD_ROUNDING


def write_dae_c(
    design: ObserverDesign,
    target: Path,
    sample_time: float | None,
    alarms: Alarms,
    precision: str,
    outliers: str | None,
) -> tuple[Path, ...]:
    """Write source and header."""
    if target.suffix.lower() != ".c":
        raise SpecError(
            f"{target}: a recursive observer of a nonlinear plant has no constant matrices. Export it as C (.c) or "
            "an FMU (.fmu).",
            path=str(target),
        )
    require_no_sample_time(design, sample_time)
    prefix, header = c_identifier(target.stem), target.with_suffix(".h")
    source, declarations, _ = dae_c_texts(design, prefix, header.name, alarms, outliers)
    if precision == "float":
        source, declarations = in_floats(source), in_floats(declarations)
        error_note = float_error(design, prefix, source, declarations)
        declarations = f"{comment(quoted(error_note))}\n{declarations}"
    return write_together({target: source, header: with_c_linkage(declarations, prefix)})


def require_no_sample_time(design: ObserverDesign, sample_time: float | None) -> None:
    """Raise `SpecError` where a sample time is given for an observer that is sampled."""
    if sample_time is not None:
        dt = design.nonlinear[1].dt
        raise SpecError(
            f"The design is sampled already (dt = {dt:g} s): leave the sample time out.", path="sample_time"
        )


def dae_alarms(
    design: ObserverDesign,
    thresholds: Mapping[str, float] | None,
    warm_up: float | None,
    monitor: ExportedMonitor | None,
) -> Alarms:
    """Return the alarms of a nonlinear design."""
    model, _ = design.nonlinear
    columns = (*(f"fhat[{name}]" for name in model.parameter_names), *(f"r[{name}]" for name in model.output_names))
    seconds = checked_warm_up(warm_up, 0.0)
    return Alarms.of((*columns, "nis"), model.parameter_names, thresholds, seconds, monitor)


def dae_c_texts(
    design: ObserverDesign, prefix: str, header: str, alarms: Alarms, outliers: str | None = None
) -> tuple[str, str, str]:
    """Return source, header and the digest of the gain set. Outliers are left out where neither the design nor
    ``outliers`` says anything of them, as `run` leaves them out."""
    model, observer = design.nonlinear
    digest = gain_set_digest(design)
    observer = as_run(observer, outliers, stated=rule_of_outliers(design))
    if alarms.monitor is not None:
        observer = alarms.monitor.watched_observer(observer)
    inner = f"{prefix}_observer" if observer.timing.is_plain else f"{prefix}_observer_memory"
    source = "\n".join(
        [
            comment(f"sha256 of the gain set: {digest}"),
            f'#include "{included(header)}"',
            "",
            f"#define observer {inner}",
            *([f"#define waiting {prefix}_observer"] if inner != f"{prefix}_observer" else []),
            f"#define WARM_UP_SECONDS {alarms.warm_up!r}",
            f"#define SETTLING_SLACK {SETTLING_SLACK!r}",
            "",
            observer_code(observer.steps),
            "#include <stddef.h>",
            "#define ABS fabs",
            *table_lines("levels", np.array([list(alarms.levels.values())])),
            alarms.source(prefix),
            _dae_step_text(prefix, model, alarms),
        ]
    )
    declared = _dae_header(design, prefix, digest, alarms)
    return in_precision(source, "double"), in_precision(declared, "double"), digest


def _dae_step_text(prefix: str, model: DAEModel, alarms: Alarms) -> str:
    """Return the two functions of the header; without inputs, C has no array for them."""
    watched = alarms.monitor is not None
    waiting = (
        f"double shown[{prefix.upper()}_WATCHED];\n"
        f"    for (i = 0; i < {prefix.upper()}_WATCHED; i++) {{\n"
        "        shown[i] = NAN;\n"
        "    }\n"
        "    monitor_take(&s->monitor, shown, NULL, 0, 1, -1);"
    )
    taking = (
        "monitor_take(&s->monitor, shown, MONITOR_ESTIMATES > 0 ? after + AT_SPREAD : NULL, is_deciding, 0,\n"
        "                 sqrt(estimates->nis));\n"
        "    shown[NQ + NY + 1] = s->monitor.statistic;"
    )
    return filled_template(
        "dae_step.c",
        prefix,
        {
            "ARGUMENTS": "const double u[NU], " if model.nu else "",
            "INPUT": "u" if model.nu else "s->u",
            "MONITOR_RESET": "monitor_reset(&s->monitor);" if watched else "",
            "WAITING_STEP": waiting if watched else "",
            "MONITOR_UNREPEAT": "monitor_range(&s->monitor, used);\n    monitor_unrepeat(&s->monitor, seen);"
            if watched
            else "",
            "MONITOR_STEP": taking if watched else "",
        },
    )


def _dae_header(design: ObserverDesign, prefix: str, digest: str, alarms: Alarms) -> str:
    """Return the header of the observer of a nonlinear plant."""
    model, observer = design.nonlinear
    signals = (
        ("u", "", model.input_names),
        ("y", "", model.output_names),
        ("states", "xhat", model.state_names),
        ("faults", "fhat", model.parameter_names),
        ("state_deviations", "sd xhat", model.state_names),
        ("fault_deviations", "sd fhat", model.parameter_names),
        ("residuals", "r", model.output_names),
    )
    listed = [
        line for array, column, names in signals for line in signal_comments(array, column, names, None, model.units)
    ]
    structs = [*observer_struct(observer.steps, f"{prefix}_observer"), *alarms.struct_lines(prefix)]
    words = {
        "OBSERVER": f"Observer {quoted(design.name)} by {quoted(design.method)}, written by obsynth.",
        "VERIFIED": quoted(verification_words(design)),
        "ALARMS": "\n".join(map(comment, alarm_comments(alarms))),
        "DIGEST": digest,
        "SECONDS": repr(observer.dt),
        "COUNT_OF_LEVELS": str(len(alarms.levels)),
        "SOME_LEVELS": str(max(len(alarms.levels), 1)),
        "STATUSES": "\n".join(status_lines(prefix)),
        "STRUCTS": "\n".join(structs),
        "MONITOR": f"{prefix}_monitor monitor;" if alarms.monitor is not None else "",
        "INPUTS": f"const double u[{model.nu}], " if model.nu else "",
        "SIGNALS": "\n".join(listed),
        **{word: str(size) for word, size in (("NX", model.nx), ("NY", model.ny))},
        **{word: str(max(size, 1)) for word, size in (("SOME_NU", model.nu), ("SOME_NQ", model.nq))},
    }
    return filled_template("dae.h", prefix, words)


def threshold_header(bound: AdaptiveBound, prefix: str) -> str:
    """Return the declarations, for the end of the header."""
    p, nz, *_ = bound.counts
    no = bound.counts[4]
    sizes = (max(p * nz, 1), bound.length * bound.width, bound.length * nz, bound.rounding.shape[1])
    lines = [
        comment("Thresholds over the tolerances of the plant: of the faults, then of the residuals."),
        "typedef struct {",
        *(f"    double {name}[{size}];" for name, size in zip(("psi", "ring", "eps", "largest"), sizes, strict=True)),
        "    int at, again;",
        "    long k;",
        f"}} {prefix}_thresholds;",
        "",
        f"void {prefix}_thresholds_reset({prefix}_thresholds *state);",
        "",
        comment("After each step of the observer: u, y, and its states, faults and residuals one after the other;"),
        comment(
            f"total gets {no} numbers. A number that is not finite, as residuals in a gap, begins them again: total"
        ),
        comment("is infinite in that row, and bounds the others where the status of the observer is OK."),
        f"void {prefix}_thresholds_step({prefix}_thresholds *state, const double *u, const double *y,",
        "                               const double *rows, double *total);",
        "",
    ]
    return "\n".join(lines) + "\n"


def threshold_source(bound: AdaptiveBound, after: AdaptiveBound, prefix: str) -> str:
    """Return tables and functions, for the end of the source, with the bound from the first start on and that ``after``
    a later one; `SpecError` for constants that vary."""
    if bound.varying:
        raise SpecError(
            "Thresholds are written as C for constants that stay the same (variation: constant).", path="monitor"
        )
    same = np.array_equal(bound.start, after.start) and np.array_equal(bound.start_later[1], after.start_later[1])
    sizes = _threshold_sizes(bound, after, same=same)
    tables = _threshold_tables(bound, after, same=same)
    enumerated = ", ".join(f"{name} = {value}" for name, value in sizes.items())
    lines = [
        "",
        f"enum {{ {enumerated} }};",
        f"static const double THETA = {max(bound.start_later[0], after.start_later[0])!r};",
        f"static const double ROUNDED = {THRESHOLD_ROUNDING!r};",
        "",
        *(line for name, table in tables.items() for line in table_lines(f"thresholds_{name}", filled_table(table))),
    ]
    return in_precision("\n".join(lines) + "\n" + filled_template("adaptive_threshold.c", prefix, {}), "double")


def _threshold_sizes(bound: AdaptiveBound, after: AdaptiveBound, *, same: bool) -> dict[str, int]:
    """Return the sizes of the tables, and where those of a later start begin: ``same`` ones are there once."""
    p, nz, rows, m, no = bound.counts
    structure = bound.structure
    n, out = structure.reading.shape
    nv = bound.drive.shape[2]
    return {
        "P": p,
        "NZ": nz,
        "ROWS": rows,
        "M": m,
        "NO": no,
        "N": n,
        "NU": nv - n,
        "NY": bound.rounding.shape[1] - 1 - nv,
        "NV": nv,
        "OUT": out,
        "W": bound.width,
        "L": bound.length,
        "NR": bound.rounding.shape[1],
        "SINGLE": structure.single,
        "OWN": len(structure.owner),
        "DRIVEN": len(bound.remainder_inputs),
        "START": len(bound.start),
        "AGAIN": len(after.start),
        "AGAIN_AT": 0 if same else len(bound.start),
        "LATER_AT": 0 if same else 1,
    }


def _threshold_tables(bound: AdaptiveBound, after: AdaptiveBound, *, same: bool) -> dict[str, FloatArray]:
    """Return the tables by name, the starts of both bounds one below the other unless they are the ``same``."""
    structure = bound.structure
    starts, later = bound.start, bound.start_later[1][None]
    if not same:
        starts, later = np.vstack([starts, after.start]), np.vstack([later, after.start_later[1]])
    return {
        "Az": structure.Az,
        "reading": structure.reading,
        "drive": bound.drive.reshape(-1, bound.drive.shape[2]),
        "shown": bound.output_rows,
        "offsets": structure.offsets[None],
        "channels": structure.channel_rows,
        "kernels": bound.kernels,
        "same": bound.same,
        "solved": bound.solved,
        "tail": bound.tail,
        "nominal": bound.nominal[None],
        "rounding": bound.rounding,
        "start": starts,
        "later": later,
        "driven": np.array([bound.remainder_inputs], dtype=np.float64),
    }
