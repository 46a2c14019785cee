"""What a command is doing, on stderr: a line as a stage begins, and again while one takes long."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

#: Processor seconds after which a command that has said nothing says that it is at work, and what share of its time so
#: far it is silent later on. Waiting for input, or for a machine that is busy with other things, takes none.
SILENCE, SHARE = 5.0, 0.1

#: Seconds between two looks at the clock.
LOOK = 0.5


class Stages:
    """The stage that a command has reached; `look` prints a line where that takes long."""

    def __init__(self, text: str) -> None:
        self.begun, self.spent = time.monotonic(), time.process_time()
        self.is_shown = False  # on a terminal, by a line that moves
        self.enter(text)

    def enter(self, text: str) -> None:
        """Begin the next stage."""
        self.text, self.since, self.last = text, time.monotonic(), time.process_time()

    @property
    def seconds(self) -> float:
        """Seconds since the command began."""
        return time.monotonic() - self.begun

    def look(self) -> None:
        """Print the stage and its time, where nothing was printed for long."""
        now = time.process_time()
        if self.is_shown or now - self.last < max(SILENCE, SHARE * (now - self.spent)):
            return
        self.last = now
        told = f"[{self.seconds:5.1f} s] {self.text}: {time.monotonic() - self.since:.0f} s so far"
        with suppress(OSError, ValueError):  # who closed stderr is told nothing
            print(told, file=sys.stderr, flush=True)


#: The stages of the command that runs, if one does.
_WATCHED: list[Stages] = []


@contextmanager
def watched_stages(text: str, *, quiet: bool) -> Iterator[None]:
    """Watch a command, of which ``text`` is said until it tells its stages; nothing is where ``quiet``."""
    if quiet:
        yield
        return
    stages, done = Stages(text), threading.Event()

    def watch() -> None:
        while not done.wait(LOOK):
            stages.look()

    watcher = threading.Thread(target=watch, name="stages", daemon=True)
    _WATCHED.append(stages)
    watcher.start()
    try:
        yield
    finally:
        _WATCHED.remove(stages)
        done.set()
        watcher.join()


@contextmanager
def progress(*, quiet: bool) -> Iterator[Callable[[str], None]]:
    """Show the stages of a long run on stderr, each with the time that has gone."""
    if quiet:
        yield lambda text: None
        return
    stages = _WATCHED[-1] if _WATCHED else Stages("")
    before = stages.text
    try:
        if sys.stderr.isatty():
            with _moving_line(stages) as show:
                yield show
        else:
            yield lambda text: _printed(stages, text)
    finally:
        stages.enter(before)


def _printed(stages: Stages, text: str) -> None:
    stages.enter(text)
    print(f"[{stages.seconds:5.1f} s] {text}", file=sys.stderr, flush=True)


@contextmanager
def _moving_line(stages: Stages) -> Iterator[Callable[[str], None]]:
    """Show one line on a terminal: the stage, and the time since the command began."""
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}", markup=False), TimeElapsedColumn())
    stages.is_shown = True
    try:
        with Progress(*columns, console=Console(stderr=True), transient=True) as line:
            task = line.add_task("reading", total=None)
            yield lambda text: line.update(task, description=text)
    finally:
        stages.is_shown = False
