"""Thresholds over the tolerances of the plant as C99, beside the observer."""

from __future__ import annotations

from importlib.resources import files

import numpy as np

from obsynth.errors import SpecError
from obsynth.experiments.monitors.adaptive_bound import THRESHOLD_ROUNDING, AdaptiveBound
from obsynth.exporting.c_source import comment, table_lines

_TEMPLATE = "adaptive_threshold.c"


def threshold_header(bound: AdaptiveBound, prefix: str) -> str:
    """Return the declarations, for the end of the header."""
    p, nz, *_ = bound.counts
    no = bound.counts[4]
    sizes = (max(p * nz, 1), bound.length * bound.width, bound.length * nz, bound.rounding.shape[1])
    lines = [
        comment("Thresholds over the tolerances of the plant: of the faults, then of the residuals."),
        "typedef struct {",
        *(f"    double {name}[{size}];" for name, size in zip(("psi", "ring", "eps", "largest"), sizes, strict=True)),
        "    int at;", "    long k;", f"}} {prefix}_thresholds;", "",
        f"void {prefix}_thresholds_reset({prefix}_thresholds *state);", "",
        comment("After each step of the observer: u, y, and its states, faults and residuals one after the other;"),
        comment(f"total gets {no} numbers."),
        f"void {prefix}_thresholds_step({prefix}_thresholds *state, const double *u, const double *y,",
        "                               const double *rows, double *total);", "",
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


def threshold_source(bound: AdaptiveBound, prefix: str) -> str:
    """Return tables and functions, for the end of the source; `SpecError` for constants that vary."""
    if bound.varying:
        raise SpecError("Thresholds are written as C for constants that stay the same (variation: constant).",
                        path="monitor")  # fmt: skip
    p, nz, rows, m, no = bound.counts
    structure = bound.structure
    n, out = structure.reading.shape
    nv = bound.drive.shape[2]
    ny = bound.rounding.shape[1] - 1 - nv
    theta, later = bound.start_later
    sizes = {
        "P": p, "NZ": nz, "ROWS": rows, "M": m, "NO": no, "N": n, "NU": nv - n, "NY": ny, "NV": nv, "OUT": out,
        "W": bound.width, "L": bound.length, "NR": bound.rounding.shape[1], "SINGLE": structure.single,
        "OWN": len(structure.owner), "DRIVEN": len(bound.remainder_inputs), "START": len(bound.start),
    }  # fmt: skip
    tables = {
        "Az": structure.Az, "reading": structure.reading, "drive": bound.drive.reshape(-1, nv), "shown": bound.shown,
        "offsets": structure.offsets[None], "channels": structure.channel_rows, "kernels": bound.kernels,
        "same": bound.same, "solved": bound.solved, "tail": bound.tail, "nominal": bound.nominal[None],
        "rounding": bound.rounding, "start": bound.start, "later": later[None],
        "driven": np.array([bound.remainder_inputs], dtype=np.float64),
    }  # fmt: skip
    text = files("obsynth.exporting").joinpath("templates", _TEMPLATE).read_text(encoding="utf-8")
    enumerated = ", ".join(f"{name} = {value}" for name, value in sizes.items())
    lines = [
        "", f"enum {{ {enumerated} }};",
        f"static const double THETA = {theta!r};", f"static const double ROUNDED = {THRESHOLD_ROUNDING!r};", "",
        *(line for name, table in tables.items() for line in table_lines(f"thresholds_{name}", _filled(table))),
    ]  # fmt: skip
    return "\n".join(lines) + "\n" + text.replace("PREFIX", prefix)


def _filled(table: np.ndarray) -> np.ndarray:
    """Return a table without an empty side, which C has not."""
    found = np.zeros(tuple(max(size, 1) for size in table.shape))
    found[: table.shape[0], : table.shape[1]] = table
    return found
