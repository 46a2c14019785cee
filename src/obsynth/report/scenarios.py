"""Printed reports on simulations: errors of the estimates."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.text import Text

from obsynth.results.layout import headed_table, print_section, printed
from obsynth.results.number_texts import duration, number, point_in_time

if TYPE_CHECKING:
    from obsynth.simulation.simulate import Simulation


#: Errors below this share of the largest value of a signal are rounding, and shown as 0.
ROUNDING_SHARE = 1e-13

#: Rows of a table; of a large plant the worst estimates are shown.
SHOWN_ROWS = 12

#: Of which rows errors are where the record ends before the start is forgotten.
NOT_SETTLED = "the initial-condition response has not settled: errors of the whole record"


def worst_rows(title: str, rows: list[Any], size: Callable[[Any], float]) -> tuple[str, list[Any]]:
    """Return title and rows of a table; of many the worst."""
    if len(rows) <= SHOWN_ROWS:
        return title, rows
    return f"{title}: the worst {SHOWN_ROWS} of {len(rows)}", sorted(rows, key=lambda row: -size(row))[:SHOWN_ROWS]


def simulation_text(simulation: Simulation) -> str:
    """Return what ``print(simulation)`` shows."""
    return printed(lambda console: simulation_report("Simulation", simulation, console=console, units={}))


def simulation_report(
    name: str,
    simulation: Simulation,
    *,
    console: Console,
    units: Mapping[str, str],
    file: str | None = None,
) -> None:
    """Print errors of all estimates: after warm-up for linear designs, with the coverage of their bands for others."""
    from obsynth.simulation.benches import WARM_UP_SHARE

    summary = simulation.summary()
    length = point_in_time(float(simulation.time[-1]))
    console.print(Text(f"{name}: {summary['samples']} samples, {length}", style="bold"))
    console.print()
    linear = not simulation.estimates.has_deviations
    for kind, title in (
        ("faults", "Fault estimates" if linear else "Parameter estimates"),
        ("states", "State estimates"),
    ):
        if not summary[kind]:
            continue
        lasts, rounding = _last_column(simulation, kind), _rounding(simulation, kind)
        table = headed_table("signal", "RMSE", "largest error", next(lasts), "unit")
        title, rows = worst_rows(
            title, list(zip(summary[kind].items(), lasts, strict=True)), lambda row: row[0][1]["rmse"]
        )
        for (signal, row), last in rows:
            rmse, largest = (
                number(0.0 if row["largest"] <= rounding[signal] else row[key]) for key in ("rmse", "largest")
            )
            table.add_row(Text(signal), rmse, largest, last, Text(units.get(signal, "")))
        remark = "errors of the whole record"
        if linear and (end := summary[f"{kind[:-1]}_warm_up"]) is None:
            remark = NOT_SETTLED
        elif linear:
            remark = f"errors from {duration(end)} on, when less than {WARM_UP_SHARE * 100:g} % of the start is left"
        print_section(console, f"{title} ({remark})", table)
    for note in summary["notes"]:
        console.print(Text(note))
    if file is not None:
        console.print(Text(f"Written: {file}"))


def _rounding(simulation: Simulation, kind: str) -> dict[str, float]:
    """Return by signal the size of errors that are only rounding: a share of its largest value."""
    estimates = simulation.estimates
    if kind == "faults":
        names, truth, values = (
            estimates.fault_names,
            simulation.faults[:, list(simulation.fault_columns)],
            estimates.faults,
        )
    else:
        names, truth, values = estimates.state_names, simulation.states, estimates.states
    sizes = np.nanmax(np.abs(np.vstack([truth, np.nan_to_num(values)])), axis=0, initial=0.0)
    return dict(zip(names, (ROUNDING_SHARE * sizes).tolist(), strict=True))


def _last_column(simulation: Simulation, kind: str) -> Iterator[str]:
    """Yield a heading, and a cell for each signal: delays of a linear observer, coverage of a recursive one."""
    if not simulation.estimates.has_deviations:
        yield "delay (samples)"
        yield from map(
            str, simulation.estimates.fault_delays if kind == "faults" else simulation.estimates.state_delays
        )
    else:
        yield "in its 95 % band"
        yield from (f"{100.0 * row['within_band']:.0f} %" for row in simulation.summary()[kind].values())
