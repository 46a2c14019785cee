"""Progress bars of long runs, and many runs on any executor."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, as_completed
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeVar

from obsynth.errors import SpecError

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID


_Item = TypeVar("_Item")

_Outcome = TypeVar("_Outcome")

#: Called with the number of runs done and their total.
RunsProgress = Callable[[int, int], None]

#: Seconds after which a bar appears.
PATIENCE = 2.0


@contextmanager
def shown_progress(
    progress: bool | Callable[[int], None] | None, total: int, unit: str
) -> Iterator[Callable[[int], object]]:
    """Show how much of a long run is done, by a bar that appears late and is gone at the end."""
    if callable(progress):
        yield progress
        return
    if progress is not None and not isinstance(progress, bool):
        raise SpecError(f"progress is {progress!r}: give True, False, None, or a function.", path="progress")
    if progress is False or (progress is None and not sys.stderr.isatty()):
        yield bool
        return
    begin = time.monotonic()
    bars: list[tuple[Progress, TaskID]] = []

    def update(done: int) -> None:
        if not bars:
            if time.monotonic() - begin < PATIENCE:
                return
            from rich.console import Console
            from rich.progress import Progress

            bar = Progress(console=Console(stderr=True), transient=True)
            bars.append((bar, bar.add_task(unit, total=total)))
            bar.start()
        bar, task = bars[0]
        bar.update(task, completed=done)

    try:
        yield update
    finally:
        for bar, _ in bars:
            bar.stop()


@contextmanager
def progress_of_runs(wanted: RunsProgress | bool | None) -> Iterator[RunsProgress | None]:
    """Yield what is to be called after each batch of runs."""
    if not isinstance(wanted, bool):
        yield wanted
        return
    if not wanted:
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = TextColumn("runs"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("runs", total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def as_they_come(
    work: Callable[[_Item], _Outcome], items: Sequence[_Item], executor: Executor | None
) -> Iterator[tuple[int, _Outcome]]:
    """Yield the place of each item with what comes of it, here one after another, or as an executor has them."""
    if executor is None:
        yield from ((place, work(item)) for place, item in enumerate(items))
        return
    waiting = {executor.submit(work, item): place for place, item in enumerate(items)}
    try:
        for future in as_completed(waiting):
            yield waiting[future], future.result()
    finally:
        for future in waiting:
            future.cancel()
