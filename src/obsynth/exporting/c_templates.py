"""Observers of nonlinear DAEs, and thresholds over tolerances, as C99: templates filled with sizes and tables.

CasADi writes the equations of a DAE; the loop of Newton around them, its damping and its homotopy are those of
`obsynth.observers.dae.c_code`.

A nonlinear observer in single precision: its C, and what the header says of its error, which is measured.

No bound follows from the design alone, as the steps are solved: the C runs beside the observer in double precision over
records that are simulated from the design, with missing samples.
"""

from __future__ import annotations

import ctypes
import re
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from obsynth.data.log_estimator import SETTLING_SLACK
from obsynth.errors import ObsynthError, SpecError
from obsynth.experiments.monitors.learned import LearnedThresholds, watched_names
from obsynth.experiments.monitors.learned_levels import parameter_walk
from obsynth.exporting.c_source import (
    alarm_comments,
    c_identifier,
    comment,
    filled_table,
    in_precision,
    included,
    monitor_source,
    monitor_struct,
    quoted,
    status_lines,
    table_lines,
    template,
    with_c_linkage,
)
from obsynth.exporting.realisation import Alarms, verification_words
from obsynth.files.outputs import write_together
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.dae.c_code import FLAGS, compiler, observer_code, observer_struct, shared_library
from obsynth.observers.estimates import Estimates
from obsynth.observers.linear.derived import checked_warm_up
from obsynth.observers.running import changed
from obsynth.plants.dae.model import DAEModel
from obsynth.results.design import ObserverDesign
from obsynth.results.gain_sets import gain_set_digest
from obsynth.simulation.dae import simulate_dae
from obsynth.verification.adaptive_bound import THRESHOLD_ROUNDING, AdaptiveBound


def write_dae_c(
    design: ObserverDesign, target: Path, sample_time: float | None, alarms: Alarms, precision: str
) -> tuple[Path, ...]:
    """Write source and header."""
    if target.suffix.lower() != ".c":
        raise SpecError(
            f"{target}: the observer of a nonlinear plant is no matrices; it is exported as C (.c).", path=str(target)
        )
    require_no_sample_time(design, sample_time)
    prefix, header = c_identifier(target.stem), target.with_suffix(".h")
    source, declarations, _ = dae_c_texts(design, prefix, header.name, alarms)
    if precision == "float":
        source, declarations = in_floats(source), in_floats(declarations)
        said = float_error(design, prefix, source, declarations)
        declarations = f"{comment(quoted(said))}\n{declarations}"
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
    learned: LearnedThresholds | None,
) -> tuple[ObserverDesign, Alarms]:
    """Return the alarms of a nonlinear design, and the design as these want it: thresholds were learned from a run,
    which leaves outliers out where the design says nothing of them."""
    model, observer = design.nonlinear
    if learned is not None and observer.outliers == "none":
        design = design.replace(observer=changed(observer, outliers="gate"))
    columns = (*(f"fhat[{name}]" for name in model.parameter_names), *(f"r[{name}]" for name in model.output_names))
    seconds = checked_warm_up(warm_up, 0.0)
    found = Alarms.of(columns, model.parameter_names, thresholds, seconds, learned, more=("nis",))
    if learned is not None:
        # A run numbers innovations of any kind.
        found = replace(found, columns=watched_names(design), walk=parameter_walk(observer))
    return design, found


def dae_c_texts(design: ObserverDesign, prefix: str, header: str, alarms: Alarms) -> tuple[str, str, str]:
    """Return source, header and the digest of the gain set."""
    model, observer = design.nonlinear
    digest = alarms.learned.gains if alarms.learned is not None else gain_set_digest(design)
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
            monitor_source(alarms, prefix),
            _step_text(prefix, model, alarms),
        ]
    )
    declared = "\n".join(_header(design, prefix, digest, alarms)) + "\n"
    return in_precision(source, "double"), in_precision(declared, "double"), digest


def _step_text(prefix: str, model: DAEModel, alarms: Alarms) -> str:
    """Return the two functions of the header; without inputs, C has no array for them."""
    parts = {
        "ARGUMENTS": "const double u[NU], " if model.nu else "",
        "INPUT": "u" if model.nu else "s->u",
        "MONITOR_RESET": "monitor_reset(&s->monitor);" if alarms.learned is not None else "",
        "WAITING_STEP": (
            "double shown[UPPER_WATCHED];\n"
            "    for (i = 0; i < UPPER_WATCHED; i++) {\n"
            "        shown[i] = NAN;\n"
            "    }\n"
            "    monitor_take(&s->monitor, shown, NULL, 0, -1);".replace("UPPER", prefix.upper())
            if alarms.learned is not None
            else ""
        ),
        "MONITOR_STEP": (
            "monitor_take(&s->monitor, shown, MONITOR_ESTIMATES > 0 ? after + AT_SPREAD : NULL, is_deciding,\n"
            "                 sqrt(estimates->nis));\n"
            "    shown[NQ + NY + 1] = s->monitor.statistic;"
            if alarms.learned is not None
            else ""
        ),
    }
    text = template("dae_step.c").replace("PREFIX", prefix).replace("UPPER", prefix.upper())
    for word, value in parts.items():
        text = text.replace(f"    {word}\n", f"    {value}\n" if value else "").replace(word, value)
    return text


def _header(design: ObserverDesign, prefix: str, digest: str, alarms: Alarms) -> Iterator[str]:
    model, observer = design.nonlinear
    guard, upper = f"{prefix.upper()}_H", prefix.upper()
    sizes = {
        "states": model.nx,
        "state_deviations": model.nx,
        "faults": model.nq,
        "fault_deviations": model.nq,
        "residuals": model.ny,
    }
    watched = max(len(alarms.levels), 1)
    yield comment(f"Observer {quoted(design.name)} by {quoted(design.method)}, written by obsynth.")
    yield comment(quoted(verification_words(design)))
    yield from map(comment, alarm_comments(alarms))
    yield from (f"#ifndef {guard}", f"#define {guard}", "", comment("sha256 of the gain set"))
    yield from (f'#define {upper}_SHA256 "{digest}"', comment("seconds between samples"))
    yield from (f"#define {upper}_DT {observer.dt!r}", comment("outputs that may be watched"))
    yield from (f"#define {upper}_WATCHED {len(alarms.levels)}", "", *status_lines(prefix), "")
    yield from (*observer_struct(observer.steps, f"{prefix}_observer"), *monitor_struct(alarms, prefix))
    yield from ("typedef struct {", comment("Read these after a step: what the row was, what passed its level."))
    yield from ("    int status;", f"    int alarm[{watched}];", "    int any_alarm;")
    yield comment("Set these after the reset: levels (0 for none), and seconds without alarms after the start.")
    yield from (f"    double level[{watched}];", "    double warm_up;")
    if alarms.learned is not None:
        yield f"    {prefix}_monitor monitor;"
    yield from (comment("Everything else is the observer's own."), f"    struct {prefix}_observer running;")
    yield from (f"    double u[{max(model.nu, 1)}];", "    double time, from;", "    long k;")
    yield from ("    int is_started, phase;", f"}} {prefix}_state;", "")
    yield comment("States after the measurement, parameters, their standard deviations; innovations (NaN where y is);")
    yield comment("their square in units of their covariance; the residual of the step in sizes of the states.")
    yield "typedef struct {"
    yield from (f"    double {name}[{max(size, 1)}];" for name, size in sizes.items())
    yield from ("    double nis;", "    double step_residual;", f"}} {prefix}_estimates;", "")
    yield from (comment("Start as the design does."), f"void {prefix}_reset({prefix}_state *state);", "")
    yield comment("Take one sample: y at this sample, and u during the step that ends at it; what is missing is NaN.")
    yield comment("A missing output is replaced by its prediction, a missing input by its last value. Returns 0; 1 if")
    yield comment("inputs are missing (status GAP; estimates are NaN before all of them have been known); 2 if the")
    yield comment("step has no solution: state and estimates are left as they were then.")
    for array, column, names in (
        ("u", "", model.input_names),
        ("y", "", model.output_names),
        ("states", "xhat", model.state_names),
        ("faults", "fhat", model.parameter_names),
        ("state_deviations", "sd xhat", model.state_names),
        ("fault_deviations", "sd fhat", model.parameter_names),
        ("residuals", "r", model.output_names),
    ):
        for i, name in enumerate(names):
            unit = model.units.get(name)
            told = quoted(f"{column}[{name}]" if column else name)
            yield comment(f"{array}[{i}]: {told}" + (f", {quoted(unit)}" if unit else ""))
    taken = [f"{prefix}_state *state", f"const double y[{model.ny}]", f"{prefix}_estimates *estimates"]
    taken[1:1] = [f"const double u[{model.nu}]"] if model.nu else []
    yield f"int {prefix}_step({', '.join(taken)});"
    yield from ("", "#endif")


def threshold_header(bound: AdaptiveBound, prefix: str) -> str:
    """Return the declarations, for the end of the header."""
    p, nz, *_ = bound.counts
    no = bound.counts[4]
    sizes = (max(p * nz, 1), bound.length * bound.width, bound.length * nz, bound.rounding.shape[1])
    lines = [
        comment("Thresholds over the tolerances of the plant: of the faults, then of the residuals."),
        "typedef struct {",
        *(f"    double {name}[{size}];" for name, size in zip(("psi", "ring", "eps", "largest"), sizes, strict=True)),
        "    int at;",
        "    long k;",
        f"}} {prefix}_thresholds;",
        "",
        f"void {prefix}_thresholds_reset({prefix}_thresholds *state);",
        "",
        comment("After each step of the observer: u, y, and its states, faults and residuals one after the other;"),
        comment(f"total gets {no} numbers."),
        f"void {prefix}_thresholds_step({prefix}_thresholds *state, const double *u, const double *y,",
        "                               const double *rows, double *total);",
        "",
    ]
    return "\n".join(lines) + "\n"


def threshold_source(bound: AdaptiveBound, prefix: str) -> str:
    """Return tables and functions, for the end of the source; `SpecError` for constants that vary."""
    if bound.varying:
        raise SpecError(
            "Thresholds are written as C for constants that stay the same (variation: constant).", path="monitor"
        )
    p, nz, rows, m, no = bound.counts
    structure = bound.structure
    n, out = structure.reading.shape
    nv = bound.drive.shape[2]
    ny = bound.rounding.shape[1] - 1 - nv
    theta, later = bound.start_later
    sizes = {
        "P": p,
        "NZ": nz,
        "ROWS": rows,
        "M": m,
        "NO": no,
        "N": n,
        "NU": nv - n,
        "NY": ny,
        "NV": nv,
        "OUT": out,
        "W": bound.width,
        "L": bound.length,
        "NR": bound.rounding.shape[1],
        "SINGLE": structure.single,
        "OWN": len(structure.owner),
        "DRIVEN": len(bound.remainder_inputs),
        "START": len(bound.start),
    }
    tables = {
        "Az": structure.Az,
        "reading": structure.reading,
        "drive": bound.drive.reshape(-1, nv),
        "shown": bound.shown,
        "offsets": structure.offsets[None],
        "channels": structure.channel_rows,
        "kernels": bound.kernels,
        "same": bound.same,
        "solved": bound.solved,
        "tail": bound.tail,
        "nominal": bound.nominal[None],
        "rounding": bound.rounding,
        "start": bound.start,
        "later": later[None],
        "driven": np.array([bound.remainder_inputs], dtype=np.float64),
    }
    text = template("adaptive_threshold.c")
    enumerated = ", ".join(f"{name} = {value}" for name, value in sizes.items())
    lines = [
        "",
        f"enum {{ {enumerated} }};",
        f"static const double THETA = {theta!r};",
        f"static const double ROUNDED = {THRESHOLD_ROUNDING!r};",
        "",
        *(line for name, table in tables.items() for line in table_lines(f"thresholds_{name}", filled_table(table))),
    ]
    return in_precision("\n".join(lines) + "\n" + text.replace("PREFIX", prefix), "double")


#: Newton in floats: a last step whose square is rounding, and a residual of some roundings of its terms.
FLOAT_LAST_STEP, FLOAT_RESIDUAL = 3e-4, 1e-5
#: A projection that moves no state by more than rounding moves none, and bounds that dependent rows miss are kept.
FLOAT_PROJECTION_NOTICE, FLOAT_DEPENDENT, FLOAT_SLACK = 1e-4, 1e-5, 1e-4
#: What a sample adds to the information on faults is a difference of inverses of covariances.
FLOAT_LEAST_ADDED = 1e-5
#: What is larger has no square in a float.
FLOAT_OVERFLOW = 1e18
#: Samples of each record that errors are measured on, their seeds, and the samples without outputs.
RECORD_SAMPLES, SEEDS = 400, (1, 2)
MISSING_SAMPLES = slice(200, 205)
#: Errors beyond this share of an estimate's own deviation: single precision does not carry the observer.
LARGEST_ERROR_SHARE = 0.5
_FLOAT_CONSTANTS = {
    "LAST_STEP": FLOAT_LAST_STEP,
    "LARGEST_RESIDUAL": FLOAT_RESIDUAL,
    "PROJECTION_NOTICE": FLOAT_PROJECTION_NOTICE,
    "DEPENDENT": FLOAT_DEPENDENT,
    "SLACK": FLOAT_SLACK,
    "OVERFLOW_LIMIT": FLOAT_OVERFLOW,
    "MONITOR_LEAST": FLOAT_LEAST_ADDED,
}
_HARNESS = """
#include "HEADER"
int run(const float *in, double *out, int samples)
{
    static PREFIX_state state;
    PREFIX_estimates found;
    int k, i;
    PREFIX_reset(&state);
    for (k = 0; k < samples; k++) {
        if (PREFIX_step(&state, ARGUMENTS, &found) == 2) {
            return k;
        }
        for (i = 0; i < STATES; i++) {
            out[i] = found.states[i];
        }
        for (i = 0; i < FAULTS; i++) {
            out[STATES + i] = found.faults[i];
        }
        in += TAKEN;
        out += STATES + FAULTS;
    }
    return samples;
}
"""


def in_floats(text: str) -> str:
    """Return C with floats in place of doubles; seconds stay doubles, as they are counted up."""
    for name, value in _FLOAT_CONSTANTS.items():
        text = re.sub(rf"^#define {name} .*$", f"#define {name} {value!r}f", text, flags=re.MULTILINE)
    lines = [
        line if re.search(r"\b(time|warm_up)\b", line) else re.sub(r"\bdouble\b", "float", line)
        for line in text.split("\n")
    ]
    return in_precision("\n".join(lines), "float")


def float_error(design: ObserverDesign, prefix: str, source: str, declared: str) -> str:
    """Return what the header of an export in floats says of its error; raise `SpecError` where it is too large."""
    model = design.nonlinear[0]
    names = [*(f"xhat[{name}]" for name in model.state_names), *(f"fhat[{name}]" for name in model.parameter_names)]
    worst, shares = np.zeros(len(names)), np.zeros(len(names))
    with tempfile.TemporaryDirectory(prefix="obsynth-", ignore_cleanup_errors=True) as folder:
        library = _compiled(Path(folder), prefix, source, declared, model.nu, model.ny, (model.nx, model.nq))
        for seed in SEEDS:
            u, y, expected = _record(design, seed)
            wanted = np.hstack([expected.states, expected.faults])
            deviations = np.hstack([expected.state_deviations, expected.fault_deviations])
            found = _taken(library, u, y, wanted.shape[1])
            error = np.abs(found - wanted)
            worst = np.maximum(worst, error.max(axis=0))
            with np.errstate(divide="ignore", invalid="ignore"):
                share = np.where(error > 0.0, error / deviations, 0.0)[1:]
            shares = np.maximum(shares, share.max(axis=0))
    if not (np.isfinite(worst).all() and (shares <= LARGEST_ERROR_SHARE).all()):
        at = int(np.argmax(np.where(np.isfinite(shares), shares, np.inf)))
        raise SpecError(
            f"Single precision does not carry this observer: {names[at]} is off by {worst[at]:.2g}, "
            f"{shares[at]:.2g} of its own standard deviation. Leave precision at double.",
            path="precision",
        )
    listed = ", ".join(f"{name} {error:.2g}" for name, error in zip(names, worst, strict=True))
    return (
        f"Floats: measured, not proved: the largest error against double precision in {len(SEEDS)} records of "
        f"{RECORD_SAMPLES} samples simulated from the design (5 of them missing): {listed}; at most "
        f"{shares.max(initial=0.0):.2g} of an estimate's own standard deviation"
    )


def _record(design: ObserverDesign, seed: int) -> tuple[FloatArray, FloatArray, Estimates]:
    """Return inputs and outputs, as floats hold them, of the plant with the noise that the observer assumes, and what
    the observer says of them in doubles."""
    model, observer = design.nonlinear
    u = np.tile(model.nominal_input, (RECORD_SAMPLES, 1)).reshape(RECORD_SAMPLES, model.nu)
    try:
        found = simulate_dae(
            model,
            u,
            dt=observer.dt,
            parameters=observer.initial_parameters,
            initial_state=observer.initial_state,
            Q=observer.Q,
            R=observer.R,
            integration=observer.integration,
            seed=seed,
        )
        y = np.array(found.outputs)
        y[MISSING_SAMPLES] = np.nan
        u, y = (given.astype(np.float32).astype(np.float64) for given in (u, y))
        return u, y, observer.run(y, u)
    except ObsynthError as error:
        raise SpecError(
            "The error of single precision is measured on a record that is simulated from the design, which fails: "
            f"{error} Leave precision at double.",
            path="precision",
        ) from error


def _compiled(
    folder: Path, prefix: str, source: str, declared: str, nu: int, ny: int, counts: tuple[int, int]
) -> ctypes.CDLL:
    command = compiler()
    if command is None:
        raise SpecError(
            "The error of a nonlinear observer in floats is measured by running it: this needs a C compiler (cc, gcc "
            "or clang, or what CC in the environment names). Install one, or leave precision at double.",
            path="precision",
        )
    parts = {
        "HEADER": "observer.h", "PREFIX": prefix, "ARGUMENTS": "in, in + " + str(nu) if nu else "in",
        "STATES": str(counts[0]), "FAULTS": str(counts[1]), "TAKEN": str(nu + ny),
    }  # fmt: skip
    harness = _HARNESS
    for word, value in parts.items():
        harness = harness.replace(word, value)
    own = re.sub(r'^#include ".*"$', '#include "observer.h"', source, count=1, flags=re.MULTILINE)
    texts = {"observer.h": declared, "observer.c": own, "run.c": harness}
    return ctypes.CDLL(str(shared_library(folder, texts, [*command, *FLAGS], path="precision")))


def _taken(library: ctypes.CDLL, u: FloatArray, y: FloatArray, width: int) -> FloatArray:
    given = np.ascontiguousarray(np.hstack([u, y]), dtype=np.float32)
    out = np.zeros((len(y), width))
    count = library.run(
        given.ctypes.data_as(ctypes.POINTER(ctypes.c_float)),
        out.ctypes.data_as(ctypes.POINTER(ctypes.c_double)),
        len(y),
    )
    if count < len(y):
        raise SpecError(
            f"Single precision does not carry this observer: its step {count} has no solution there. Leave precision "
            "at double.",
            path="precision",
        )
    return out
