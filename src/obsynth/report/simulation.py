"""A simulation for people: how far each estimate was off, and when the start was forgotten."""

from __future__ import annotations

from collections.abc import Mapping

from rich.console import Console
from rich.text import Text

from obsynth.evaluation.simulating import Simulation
from obsynth.report.layout import headed_table, number, print_section

#: Rows of a table; of a large plant the worst estimates are shown.
SHOWN = 12


def simulation_report(
    name: str, found: Simulation, *, console: Console, units: Mapping[str, str], file: str | None = None
) -> None:
    """Print errors of all estimates after warm-up.

    Parameters
    ----------
    name : str
        Of the design.
    found : Simulation
        The simulation.
    console : Console
        Where to.
    units : mapping
        Unit of signals by name.
    file : str, optional
        Where every signal was written.
    """
    summary = found.summary()
    console.print(Text(f"{name}: {summary['samples']} samples, {found.time[-1]:g} s", style="bold"))
    console.print()
    for kind, title in (("faults", "Fault estimates"), ("states", "State estimates")):
        if not summary[kind]:
            continue
        end = summary[f"{kind[:-1]}_warm_up"]
        delays = found.estimates.fault_delays if kind == "faults" else found.estimates.state_delays
        table = headed_table("signal", "RMSE", "largest error", "delay (samples)", "unit")
        rows = list(zip(summary[kind].items(), delays, strict=True))
        if len(rows) > SHOWN:
            title = f"{title}: the worst {SHOWN} of {len(rows)}"
            rows = sorted(rows, key=lambda row: -row[0][1]["rmse"])[:SHOWN]
        for (signal, row), delay in rows:
            table.add_row(
                Text(signal), number(row["rmse"]), number(row["largest"]), str(delay), Text(units.get(signal, ""))
            )
        told = (
            "the start still shows at the end: errors are of the whole record"
            if end is None
            else f"warm-up ended at {end:g} s, errors are of what follows"
        )
        print_section(console, f"{title} ({told})", table)
    for note in summary["notes"]:
        console.print(Text(note))
    if file is not None:
        console.print(Text(f"Written: {file}"))
