"""A simulation for people: how far each estimate was off, and when the start was forgotten."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from rich.console import Console
from rich.text import Text

from obsynth.experiments.simulation import Simulation
from obsynth.report.layout import headed_table, number, print_section

#: Rows of a table; of a large plant the worst estimates are shown.
SHOWN = 12


def simulation_report(
    name: str,
    found: Simulation,
    *,
    console: Console,
    units: Mapping[str, str],
    file: str | None = None,
) -> None:
    """Print errors of all estimates: after warm-up for linear designs, with the coverage of their bands for others."""
    summary = found.summary()
    console.print(Text(f"{name}: {summary['samples']} samples, {found.time[-1]:g} s", style="bold"))
    console.print()
    linear = not found.estimates.has_deviations
    for kind, title in (
        ("faults", "Fault estimates" if linear else "Parameter estimates"),
        ("states", "State estimates"),
    ):
        if not summary[kind]:
            continue
        lasts = _last_column(found, kind)
        table = headed_table("signal", "RMSE", "largest error", next(lasts), "unit")
        rows = list(zip(summary[kind].items(), lasts, strict=True))
        if len(rows) > SHOWN:
            title = f"{title}: the worst {SHOWN} of {len(rows)}"
            rows = sorted(rows, key=lambda row: -row[0][1]["rmse"])[:SHOWN]
        for (signal, row), last in rows:
            table.add_row(Text(signal), number(row["rmse"]), number(row["largest"]), last, Text(units.get(signal, "")))
        if linear:
            end = summary[f"{kind[:-1]}_warm_up"]
            told = (
                "the start still shows at the end: errors are of the whole record"
                if end is None
                else f"warm-up ended at {end:g} s, errors are of what follows"
            )
        else:
            told = "errors are of the whole record, start included"
        print_section(console, f"{title} ({told})", table)
    for note in summary["notes"]:
        console.print(Text(note))
    if file is not None:
        console.print(Text(f"Written: {file}"))


def _last_column(found: Simulation, kind: str) -> Iterator[str]:
    """Yield a heading, and a cell for each signal: delays of a linear observer, coverage of a recursive one."""
    if not found.estimates.has_deviations:
        yield "delay (samples)"
        yield from map(str, found.estimates.fault_delays if kind == "faults" else found.estimates.state_delays)
    else:
        yield "in its 95 % band"
        yield from (f"{100.0 * row['within_band']:.0f} %" for row in found.summary()[kind].values())
