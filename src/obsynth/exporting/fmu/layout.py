"""``layout.h`` of an FMU: sizes, start values, and how the observer's C takes one sample."""

from __future__ import annotations

from obsynth.exporting.c_source import comment, integer_table
from obsynth.exporting.fmu.description import fmu_variables
from obsynth.exporting.fmu.signals import FmuSignals
from obsynth.observers.nonlinear.observer import DAEObserver
from obsynth.observers.scheduled.observer import ScheduledObserver
from obsynth.results.design import ObserverDesign

#: Prefix of every name in the C of the observer inside an FMU.
PREFIX = "observer"


def layout_header(design: ObserverDesign, signals: FmuSignals, token: str) -> str:
    """Return ``layout.h``: sizes, start values, and how one sample is taken."""
    numbers = [variable for variable in fmu_variables(signals) if variable.is_number]  # by value reference
    starts = [variable.start_and_unit.get("start", "0.0") for variable in numbers]
    input_points = [
        signals.point_index(signal if signals.points and name not in signals.parameters else None)
        for name, signal in zip(signals.inputs, signals.input_signals, strict=True)
    ]
    output_points = [signals.point_index(output.signal) for output in signals.outputs]
    sizes = {
        "N_IN": len(signals.inputs),
        "N_OUT": len(signals.outputs),
        "N_POINT": len(signals.points),
        "N_WATCHED": len(signals.alarms.levels),
    }
    if isinstance(design.observer, DAEObserver):
        body = _dae_sample(design, signals)
    elif isinstance(design.observer, ScheduledObserver):
        body = _scheduled_sample(design, signals)
    else:
        body = _linear_sample(design, signals)
    return "\n".join(
        [
            comment("Sizes and start values of this observer, written by obsynth."),
            "#ifndef OBSYNTH_FMU_LAYOUT_H",
            "#define OBSYNTH_FMU_LAYOUT_H",
            "",
            f'#include "{PREFIX}.h"',
            "",
            f'#define TOKEN "{token}"',
            f"#define DT {signals.dt!r}",
            *(f"#define {name} {size}" for name, size in sizes.items()),
            "",
            f"typedef {PREFIX}_state observer_memory;",
            "",
            *integer_table("start_values", starts, "double"),
            *integer_table("point_of_in", input_points),
            *integer_table("point_of_out", output_points),
            "",
            "static void begin_observer(observer_memory *memory)",
            "{",
            f"    {PREFIX}_reset(memory);",
            "}",
            "",
            "static int take_sample(observer_memory *memory, const double *in, double *out)",
            "{",
            *body,
            "}",
            "",
            "#endif",
            "",
        ]
    )


def _linear_sample(design: ObserverDesign, signals: FmuSignals) -> list[str]:
    """Return the body that hands one sample to the linear observer; empty groups are no arguments there."""
    known = len(signals.inputs) - len(design.plant.output_names)
    counts = (("in", known), (f"in + {known}", len(signals.inputs) - known))
    groups, place = _output_groups(signals)
    arguments = ", ".join(text for text, count in (*counts, *groups) if count)
    return [
        f"    int failed = {PREFIX}_step(memory, {arguments});",
        *_monitor_lines(signals, place),
        "    return failed;",
    ]


def _scheduled_sample(design: ObserverDesign, signals: FmuSignals) -> list[str]:
    """Return the body that hands one sample to a scheduled observer, with an input that is one in every row."""
    plant, observer = design.scheduled
    known, names = len(signals.inputs) - len(plant.output_names), observer.input_names
    groups, place = _output_groups(signals)
    arguments = ", ".join(text for text, count in groups if count)
    given, lines = "in", []
    if plant.shift in names:
        given, at = "u", names.index(plant.shift)
        lines = [f"    double u[{len(names)}];", f"    memcpy(u, in, {at} * sizeof *u);", f"    u[{at}] = 1.0;"]
        lines.append(f"    memcpy(u + {at + 1}, in + {at}, {known - at} * sizeof *u);")
    return [
        "    int failed;",
        *lines,
        f"    failed = {PREFIX}_step(memory, {given}, in + {known}, {arguments});",
        f"    out[{place}] = memory->status;",
        *_monitor_lines(signals, place + 1),
        "    return failed;",
    ]


def _output_groups(signals: FmuSignals) -> tuple[list[tuple[str, int]], int]:
    """Return where states, faults and residuals are written, with their numbers; and how many there are."""
    kinds = [output.name.partition("[")[0] for output in signals.outputs]
    groups, place = [], 0
    for kind in ("xhat", "fhat", "r"):
        groups.append((f"out + {place}", kinds.count(kind)))
        place += kinds.count(kind)
    return groups, place


def _monitor_lines(signals: FmuSignals, place: int) -> list[str]:
    """Return the lines that copy a monitor's variables to the outputs, if there is a monitor."""
    variables = () if signals.alarms.monitor is None else signals.alarms.monitor.variables
    return [f"    out[{place + i}] = memory->monitor.{item.expression};" for i, item in enumerate(variables)]


def _dae_sample(design: ObserverDesign, signals: FmuSignals) -> list[str]:
    """Return the body that hands one sample to the observer of a nonlinear plant."""
    model, _ = design.nonlinear
    parts = (
        ("states", model.nx),
        ("state_deviations", model.nx),
        ("faults", model.nq),
        ("fault_deviations", model.nq),
        ("residuals", model.ny),
    )
    lines = [f"    {PREFIX}_estimates said;", "    int i;"]
    inputs = "in, " if model.nu else ""
    lines += [
        f"    int failed = {PREFIX}_step(memory, {inputs}in + {model.nu}, &said);",
        "    if (failed == 2) {",
        "        return 2;",
        "    }",
    ]
    place = 0
    for name, size in parts:
        if size:
            lines += [f"    for (i = 0; i < {size}; i++) {{", f"        out[{place} + i] = said.{name}[i];", "    }"]
        place += size
    lines.append(f"    out[{place}] = said.nis;")
    return [*lines, *_monitor_lines(signals, place + 1), "    return failed;"]
