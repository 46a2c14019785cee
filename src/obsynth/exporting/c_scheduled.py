"""Scheduled observers as C99: means of the matrices at the vertices, no allocation, rows outside the region marked.

Those in continuous time take from row to row the step of implicit Euler that a run on a log takes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.exporting.alarms import Alarms
from obsynth.exporting.c_source import (
    alarm_comments,
    alarm_fields,
    comment,
    filled_table,
    filled_template,
    included,
    quoted,
    signal_comments,
    table_lines,
)
from obsynth.numerics.arguments import real_number
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.expressions import Expression, step_function
from obsynth.observers.linear.modes import SETTLING_SLACK
from obsynth.observers.scheduled.observer import ScheduledObserver
from obsynth.plants.scheduling import WEIGHT_TOLERANCE
from obsynth.results.design import ObserverDesign, unverified_mark
from obsynth.results.gain_set_writing import gain_set_digest

#: A known input counts as it last was where it is missing.
_TAKEN = "if (isfinite(u[i])) {\n            s->u[i] = u[i];\n        } else {\n            whole = 0;\n        }"
#: Rows of a warm-up at most: whole numbers of C reach as far.
MOST_ROWS = 1e9
#: What a row is called.
STATUSES = ("OK", "WARM_UP", "GAP", "RECOVERING", "OUT")

#: Operations in C, by numpy's.
_C_FUNCTIONS: dict[Callable[..., Any], str] = {
    np.negative: "(-{})",
    np.add: "({} + {})",
    np.subtract: "({} - {})",
    np.multiply: "({} * {})",
    np.divide: "({} / {})",
    np.power: "pow({}, {})",
    np.minimum: "fmin({}, {})",
    np.maximum: "fmax({}, {})",
    np.sin: "sin({})",
    np.cos: "cos({})",
    np.tan: "tan({})",
    np.arcsin: "asin({})",
    np.arccos: "acos({})",
    np.arctan: "atan({})",
    np.sinh: "sinh({})",
    np.cosh: "cosh({})",
    np.tanh: "tanh({})",
    np.exp: "exp({})",
    np.log: "log({})",
    np.log10: "log10({})",
    np.sqrt: "sqrt({})",
    np.abs: "fabs({})",
    np.floor: "floor({})",
    np.ceil: "ceil({})",
}


def seconds_between_rows(observer: ScheduledObserver, sample_time: float | None) -> float:
    """Return the seconds between the samples of a file: those of the observer, or stated ones in continuous time."""
    if observer.dt > 0.0:
        if sample_time is not None:
            raise SpecError(
                f"The design is sampled already (dt = {observer.dt:g} s): leave the sample time out.",
                path="sample_time",
            )
        return observer.dt
    if sample_time is None:
        raise SpecError(
            "The observer is continuous in time: give the sample time (sample_time, --sample-time), in seconds, for C "
            "and for an FMU.",
            path="sample_time",
        )
    return real_number(sample_time, "sample_time", "seconds, above 0", above=0.0)


def scheduled_c_texts(
    design: ObserverDesign, prefix: str, header: str, alarms: Alarms, seconds: float
) -> tuple[str, str]:
    """Return source and header of an observer that takes a sample after so many seconds each."""
    plant, observer = design.scheduled
    nu, ny, digest = observer.inputs, len(observer.output_names), gain_set_digest(design)
    upper, mark = prefix.upper(), unverified_mark(design.report)
    signature = f"int {prefix}_step({', '.join(_arguments(observer, prefix))})"
    listed = ", ".join(f"{upper}_{name}" for name in STATUSES)
    declared = [
        comment(f"Observer {quoted(design.name)} by {quoted(design.method)}, written by obsynth."),
        *([comment(quoted(mark))] if mark else []),
        *(comment(line) for line in alarm_comments(alarms)),
        f"#ifndef {upper}_H",
        f"#define {upper}_H",
        "",
        comment("sha256 of the gain set"),
        f'#define {upper}_SHA256 "{digest}"',
        comment("seconds between samples; rows without a claim after one outside the region"),
        f"#define {upper}_DT {seconds!r}",
        f"#define {upper}_FORGETTING {observer.rows_without_claim(seconds)}",
        comment("outputs that may be watched"),
        f"#define {upper}_WATCHED {len(alarms.levels)}",
        "",
        comment(f"The region: {quoted(plant.scheduling.sentence())}"),
        comment("OUT: a parameter is missing, outside its range or too fast, or was so until recently: no claim."),
        f"enum {{ {listed} }};",
        "",
        *alarms.struct_lines(prefix),
        "typedef struct {",
        comment("Read these after a step: what the row was, and which outputs passed their levels (if OK)."),
        *alarm_fields(alarms, prefix),
        comment("Everything else is the observer's own."),
        f"    REAL z[{max(observer.order, 1)}], weights[{observer.count}], unclaimed;",
        f"    REAL parameters[{len(observer.scheduling.names)}];",
        f"    REAL u[{max(nu, 1)}], y[{ny}];",
        "    int settling, is_started, is_recovering;",
        f"}} {prefix}_state;",
        "",
        comment("Start at rest."),
        f"void {prefix}_reset({prefix}_state *state);",
        "",
        comment("Take one sample: deviations from the operating point, parameters as they are; NaN: missing."),
        comment("Returns 0 for rows that are OK, else 1. Missing signals count as they last were; estimates are NaN."),
        *signal_comments("u", "", observer.input_names, None, plant.units),
        *signal_comments("y", "", observer.output_names, None, plant.units),
        *signal_comments("states", "xhat", observer.state_names, None, plant.units, observer.state_delays),
        *signal_comments("faults", "fhat", observer.fault_names, None, plant.units, observer.fault_delays),
        *signal_comments("residuals", "r", observer.residual_names, None, plant.units),
        f"{signature};",
        "",
        "#endif",
    ]
    return _source(design, prefix, header, digest, alarms, seconds), "\n".join(declared) + "\n"


def _source(design: ObserverDesign, prefix: str, header: str, digest: str, alarms: Alarms, seconds: float) -> str:
    _, observer = design.scheduled
    lines = [
        comment(f"sha256 of the gain set: {digest}"),
        f'#include "{included(header)}"',
        "",
        "#include <math.h>",
        "",
        *_constants(observer, alarms, seconds),
        "",
        *(line for name, table in _tables(observer, seconds).items() for line in table_lines(name, table)),
        *table_lines("levels", filled_table(np.array([list(alarms.levels.values())]))),
        "",
        alarms.source(prefix),
        _step(observer, prefix),
    ]
    return "\n".join(lines)


def _constants(observer: ScheduledObserver, alarms: Alarms, seconds: float) -> list[str]:
    """Return the lines that define sizes and constants."""
    is_continuous = observer.dt == 0.0
    recovering = math.ceil(observer.forgetting / seconds - SETTLING_SLACK) if is_continuous else observer.forgetting
    held = observer.scheduling
    nx, nf, nr = len(observer.state_names), len(observer.fault_names), len(observer.residual_names)
    sizes = {
        "Z_COUNT": observer.order,
        "Y_COUNT": len(observer.output_names),
        "VERTICES": observer.count,
        "PARAMETERS": len(held.names),
        "FUNCTIONS": max(len(held.functions), 1),
        "STATE_COUNT": nx,
        **({} if observer.correction is None else {"RESIDUAL_COUNT": nr}),
        "ROW_COUNT": nx + nf + nr,
        "RECOVERING_ROWS": int(min(recovering, MOST_ROWS)),
    }
    # These stand in conditions of the preprocessor too.
    defined = {
        "U_COUNT": observer.inputs,
        "FAULT_COUNT": nf,
        "DIVIDES": int(not observer.effectiveness_is_one),
        "CORRECTS": int(observer.correction is not None),
        "IS_CONTINUOUS": int(is_continuous),
        "MONITORS": int(alarms.monitor is not None),
        "MONITOR_FOLLOWS": int(alarms.monitor is not None and alarms.monitor.follows_rows),
        "WATCHED": len(alarms.levels),
        "GIVES_WEIGHTS": int(held.gives_weights),
    }
    return [
        "enum { " + ", ".join(f"{name} = {size}" for name, size in sizes.items()) + " };",
        *(f"#define {name} {size}" for name, size in defined.items()),
        f"#define FORGETTING ((REAL){float(observer.forgetting)!r})",
        f"#define FORGOTTEN ((REAL){observer.forgotten_in(seconds)!r})",
        f"#define WEIGHT_TOLERANCE {WEIGHT_TOLERANCE!r}",
        f"#define WARM_UP_SECONDS {alarms.warm_up!r}",
        f"#define SETTLING_SLACK {SETTLING_SLACK!r}",
        f"#define MOST_ROWS {MOST_ROWS!r}",
        "#define LENGTH(n) ((n) > 0 ? (n) : 1)",
    ]


def _step(observer: ScheduledObserver, prefix: str) -> str:
    """Return the functions that start the observer and take a row."""
    held = observer.scheduling
    nx, nf, nr = len(observer.state_names), len(observer.fault_names), len(observer.residual_names)
    groups = [("states", nx, 0), ("faults", nf, nx), ("residuals", nr, nx + nf)]
    copied = " ".join(f"for (i = 0; i < {n}; i++) {{ {to}[i] = rows[{at} + i]; }}" for to, n, at in groups if n)
    taken = "for (i = 0; i < U_COUNT; i++) {\n        TAKE_ONE\n    }".replace("TAKE_ONE", _TAKEN)
    values = "\n        ".join(f"a[{i}] = {_c_text(text, held.names)};" for i, text in enumerate(held.expressions))
    return filled_template(
        "scheduled_step.c",
        prefix,
        {
            "STEP_ARGUMENTS": ", ".join(_arguments(observer, prefix)).replace("*state", "*s", 1),
            "COPY_U": taken if observer.inputs else "",
            "COPY_ROWS": copied,
            "FUNCTION_VALUES": values,
        },
    )


def _tables(observer: ScheduledObserver, seconds: float) -> dict[str, FloatArray]:
    """Return the numbers of the observer and of its region, by their names in C."""
    held = observer.scheduling
    tables: dict[str, FloatArray] = {
        "first_weights": observer.init().weights[None],
        "lowest": held.low[None],
        "highest": held.high[None],
        "middle": observer.middle[None],
        "steps": np.minimum(observer.steps_in(seconds), np.finfo(np.float64).max)[None],
        "Cz": observer.Cz,
        "Dy": observer.Dy,
        "Az": np.vstack(list(observer.Az)),
        "By": np.vstack(list(observer.By)),
    }
    if observer.inputs:
        tables |= {"Du": observer.Du, "Bu": np.vstack(list(observer.Bu))}
    if not observer.effectiveness_is_one:
        tables["effectiveness"] = np.vstack(list(observer.effectiveness))
    if observer.correction is not None:
        tables["correction"] = np.vstack(list(observer.correction))
    if not held.gives_weights:
        tables["bounds"] = held.bounds
    return tables


def _arguments(observer: ScheduledObserver, prefix: str) -> list[str]:
    counts = {
        "states": len(observer.state_names),
        "faults": len(observer.fault_names),
        "residuals": len(observer.residual_names),
    }
    return [
        f"{prefix}_state *state",
        f"const REAL u[{len(observer.input_names)}]",
        f"const REAL y[{len(observer.output_names)}]",
        *(f"REAL {name}[{n}]" for name, n in counts.items() if n),
    ]


def _c_text(expression: Expression, names: tuple[str, ...]) -> str:
    """Return an expression of parameters ``p[i]`` as C; those with jumps are no functions of a region."""

    def operation(function: Callable[..., Any]) -> Callable[..., Any]:
        if function not in _C_FUNCTIONS or function is step_function:
            raise SpecError(f"{expression.text!r} has a function that is not written as C.", path="scheduling")
        return lambda *parts: _C_FUNCTIONS[function].format(*(_operand(part) for part in parts))

    return _operand(expression.translated({name: f"p[{i}]" for i, name in enumerate(names)}, operation))


def _operand(part: Any) -> str:
    return part if isinstance(part, str) else repr(float(part))
