"""Observers of nonlinear DAEs, and thresholds over tolerances, as C99: templates filled with sizes and tables.

CasADi writes the equations of a DAE; the loop of Newton around them, its damping and its homotopy are those of
`obsynth.observers.dae.c_code`.
"""

from __future__ import annotations

from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path

import numpy as np

from obsynth.errors import SpecError
from obsynth.experiments.monitors.adaptive_bound import THRESHOLD_ROUNDING, AdaptiveBound
from obsynth.exporting.c_source import c_identifier, comment, included, quoted, table_lines, with_c_linkage
from obsynth.files.outputs import write_together
from obsynth.methods.handing_on import unverified_mark
from obsynth.observers.dae.c_code import observer_code, observer_struct
from obsynth.plants.dae.model import DAEModel
from obsynth.results.design import ObserverDesign
from obsynth.results.gain_sets import gain_set_digest


def _template(name: str) -> str:
    return files("obsynth.exporting").joinpath("templates", name).read_text(encoding="utf-8")


def write_dae_c(design: ObserverDesign, target: Path, sample_time: float | None) -> tuple[Path, ...]:
    """Write source and header."""
    if target.suffix.lower() != ".c":
        raise SpecError(
            f"{target}: the observer of a nonlinear plant is no matrices; it is exported as C (.c).", path=str(target)
        )
    require_no_sample_time(design, sample_time)
    prefix, header = c_identifier(target.stem), target.with_suffix(".h")
    source, declarations, _ = dae_c_texts(design, prefix, header.name)
    return write_together({target: source, header: with_c_linkage(declarations, prefix)})


def require_no_sample_time(design: ObserverDesign, sample_time: float | None) -> None:
    """Raise `SpecError` where a sample time is given for an observer that is sampled."""
    if sample_time is not None:
        dt = design.nonlinear[1].dt
        raise SpecError(
            f"The design is sampled already (dt = {dt:g} s): leave the sample time out.", path="sample_time"
        )


def dae_c_texts(design: ObserverDesign, prefix: str, header: str) -> tuple[str, str, str]:
    """Return source, header and the digest of the gain set."""
    _, observer = design.nonlinear
    digest = gain_set_digest(design)
    inner = f"{prefix}_observer" if observer.timing.is_plain else f"{prefix}_observer_memory"
    source = "\n".join(
        [
            comment(f"sha256 of the gain set: {digest}"),
            f'#include "{included(header)}"',
            "",
            f"#define observer {inner}",
            *([f"#define waiting {prefix}_observer"] if inner != f"{prefix}_observer" else []),
            "",
            observer_code(observer.steps),
            _step_text(prefix, design.nonlinear[0]),
        ]
    )
    return source, "\n".join(_header(design, prefix, digest)) + "\n", digest


def _step_text(prefix: str, model: DAEModel) -> str:
    """Return the two functions of the header; without inputs, C has no array for them."""
    arguments, given, nothing = (
        ("const double u[NU], ", "u", "")
        if model.nu
        else ("", "nothing", "    static const double nothing[1] = {0.0};\n")
    )
    text = _template("dae_step.c").replace("PREFIX", prefix).replace("ARGUMENTS", arguments)
    return text.replace("NOTHING", nothing).replace("INPUT", given)


def _header(design: ObserverDesign, prefix: str, digest: str) -> Iterator[str]:
    model, observer = design.nonlinear
    guard, upper = f"{prefix.upper()}_H", prefix.upper()
    sizes = {
        "states": model.nx,
        "state_deviations": model.nx,
        "parameters": model.nq,
        "parameter_deviations": model.nq,
        "innovations": model.ny,
    }
    yield comment(f"Observer {quoted(design.name)} by {quoted(design.method)}, written by obsynth.")
    if mark := unverified_mark(design.report):
        yield comment(quoted(mark))
    yield from (f"#ifndef {guard}", f"#define {guard}", "", comment("sha256 of the gain set"))
    yield from (f'#define {upper}_SHA256 "{digest}"', comment("seconds between samples"))
    yield from (f"#define {upper}_DT {observer.dt!r}", "", *observer_struct(observer.steps, f"{prefix}_observer"))
    yield from (f"typedef struct {prefix}_observer {prefix}_state;", "")
    yield comment("States after the measurement, parameters, their standard deviations; innovations (NaN where y is);")
    yield comment("their square in units of their covariance; the residual of the step in sizes of the states.")
    yield "typedef struct {"
    yield from (f"    double {name}[{max(size, 1)}];" for name, size in sizes.items())
    yield from ("    double nis;", "    double residual;", f"}} {prefix}_estimates;", "")
    yield from (comment("Start as the design does."), f"void {prefix}_reset({prefix}_state *state);", "")
    yield comment("Take one sample: y at this sample, NaN where it is missing, and u during the step that ends at it.")
    yield comment("Returns 0; 1 if an input is not finite or an output infinite; 2 if the step has no solution:")
    yield comment("state and estimates are left as they were then.")
    for array, names in (
        ("u", model.input_names),
        ("y", model.output_names),
        ("states", model.state_names),
        ("parameters", model.parameter_names),
    ):
        for i, name in enumerate(names):
            unit = model.units.get(name)
            yield comment(f"{array}[{i}]: {quoted(name)}" + (f", {quoted(unit)}" if unit else ""))
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
    text = _template("adaptive_threshold.c")
    enumerated = ", ".join(f"{name} = {value}" for name, value in sizes.items())
    lines = [
        "",
        f"enum {{ {enumerated} }};",
        f"static const double THETA = {theta!r};",
        f"static const double ROUNDED = {THRESHOLD_ROUNDING!r};",
        "",
        *(line for name, table in tables.items() for line in table_lines(f"thresholds_{name}", _filled(table))),
    ]
    return "\n".join(lines) + "\n" + text.replace("PREFIX", prefix)


def _filled(table: np.ndarray) -> np.ndarray:
    """Return a table without an empty side, which C has not."""
    found = np.zeros(tuple(max(size, 1) for size in table.shape))
    found[: table.shape[0], : table.shape[1]] = table
    return found
