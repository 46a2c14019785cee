"""The progress of a run on data on the terminal: a bar of rows, or a line a minute on a log that grows."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from time import monotonic

from obsynth.report.terminal.arguments import STREAM

#: Seconds between the lines in which a run on a log that grows says that it is alive.
HEALTH_SECONDS = 60.0


def health() -> Callable[[int], None]:
    """Return a function that prints the number of rows done on stderr, every `HEALTH_SECONDS` as long as rows come."""
    begun = monotonic()
    next_time = begun

    def report_rows(rows: int) -> None:
        nonlocal next_time
        if monotonic() >= next_time:
            next_time = monotonic() + HEALTH_SECONDS
            print(f"{rows} rows in {monotonic() - begun:.0f} s.", file=sys.stderr, flush=True)

    return report_rows


@contextmanager
def rows_done(data: str, *, quiet: bool) -> Iterator[Callable[[int], None] | None]:
    """Show a bar on a terminal: how many rows are done, of how many where that is known."""
    if quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("rows"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("rows", total=None if data == STREAM else _rows_in(Path(data)))
        yield lambda rows: bar.update(task, completed=rows)


def _rows_in(path: Path) -> int | None:
    """Return about how many rows a file of data has; `None` where only reading all of it would tell."""
    from obsynth.monitoring.logs.sources import TEXT_SUFFIXES
    from obsynth.monitoring.logs.unpacked_logs import log_suffix

    try:
        if path.suffix.lower() == ".parquet":
            import pyarrow.parquet

            return int(pyarrow.parquet.ParquetFile(path).metadata.num_rows)
        if log_suffix(path) not in TEXT_SUFFIXES:
            return None
        with path.open("rb") as stream:
            sample = stream.read(1 << 20)
        # All rows are taken to be as long as those of the beginning.
        lines = sample.count(b"\n")
        return round(path.stat().st_size / len(sample) * lines) - 1 if lines > 1 else None
    except (OSError, ImportError, ValueError):
        return None
