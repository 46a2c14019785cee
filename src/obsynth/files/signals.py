"""Signals that end a process as exceptions, so that unfinished files are removed and states are saved."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, NoReturn

#: The system's ways to end a process; there is no hang-up on Windows.
ENDING = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))


@contextmanager
def ending_signals() -> Iterator[None]:
    """Let SIGTERM and SIGHUP raise `SystemExit` (128 + number), unless the program has said what they do."""
    with _handlers({number: _end for number in ENDING if signal.getsignal(number) == signal.SIG_DFL}):
        yield


class HeldSignals:
    """A context in which a row of a stream is finished before a signal ends the run; a second signal acts at once."""

    def __init__(self) -> None:
        self._is_held = False
        self._waiting: Callable[[], Any] | None = None

    @contextmanager
    def installed(self) -> Iterator[None]:
        """Take over what SIGINT, SIGTERM and SIGHUP do."""
        before = {number: signal.getsignal(number) for number in (signal.SIGINT, *ENDING)}

        def held(number: int, then: Callable[[int, FrameType | None], Any]) -> Any:
            def handler(_: int, frame: FrameType | None) -> Any:
                if self._is_held and self._waiting is None:
                    self._waiting = lambda: then(number, frame)
                    return None
                return then(number, frame)

            return handler

        with _handlers({number: held(number, then) for number, then in before.items() if callable(then)}):
            yield

    def __enter__(self) -> None:
        self._is_held = True

    def __exit__(self, kind: object, *_: object) -> None:
        self._is_held = False
        waiting, self._waiting = self._waiting, None
        # An error ends the run already.
        if waiting is not None and kind is None:
            waiting()


def _end(number: int, _: FrameType | None) -> NoReturn:
    raise SystemExit(128 + number)


@contextmanager
def _handlers(handlers: dict[Any, Any]) -> Iterator[None]:
    """Set handlers, and the ones from before afterwards; only the main thread may."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
