"""Whole records through an observer of a DAE: in stretches inside CasADi, with single steps where those fail."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from obsynth.models.dae_functions import Compiled
from obsynth.models.dae_stretches import take_samples
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.dae import DAEObserver
from obsynth.observers.dae_estimates import DAEEstimates, DAERow, require_regular
from obsynth.observers.dae_running import RunningDAEObserver
from obsynth.observers.progress import shown_progress


def run_record(
    observer: DAEObserver, y: FloatArray, u: FloatArray, *, compiled: bool | None,
    progress: bool | Callable[[int], None] | None,
) -> DAEEstimates:  # fmt: skip
    """Run over a whole record.

    Parameters
    ----------
    observer : DAEObserver
        At rest.
    y, u : FloatArray
        ``(samples, ny)`` and ``(samples, nu)``, checked.
    compiled, progress
        See `DAEObserver.run`.
    """
    running = observer.start()
    if not len(y):
        graph, nx = observer.graph, observer.model.nx
        memory, said = np.zeros((0, graph.memory.size)), np.zeros((0, graph.row.size))
        return DAEEstimates.of(observer, [DAERow(graph, 0, memory, said, ~np.isnan(y), np.zeros(nx))])
    with shown_progress(progress, len(y), "samples") as note:
        if compiled is False:
            rows = []
            for k in range(len(y)):
                rows.append(running.raw_step(y[k], u[k]))
                note(k + 1)
        else:
            rows = _in_c(observer, y, u, running) if compiled else advanced(running, y, u, note)
    return require_regular(observer, DAEEstimates.of(observer, rows), rows)


def _in_c(observer: DAEObserver, y: FloatArray, u: FloatArray, running: RunningDAEObserver) -> list[DAERow]:
    """Run as C: a million steps take seconds, so that there is no progress to show."""
    after, said = observer.library.record(y, u)
    if len(after) < len(y):
        # The message is written there.
        return advanced(running, y, u)
    return [DAERow(observer.graph, 0, after, said, ~np.isnan(y), running.projected(u[0])[1])]


def advanced(
    running: RunningDAEObserver, y: FloatArray, u: FloatArray, note: Callable[[int], object] = bool
) -> list[DAERow]:
    """Lead an observer that was just started through a record, and return what it says.

    Parameters
    ----------
    running : RunningDAEObserver
        At k = 0.
    y, u : FloatArray
        ``(samples, ny)`` and ``(samples, nu)``, checked.
    note : callable, optional
        Called with the number of samples that are done.
    """
    calls: dict[int, Compiled] = {}
    found: list[DAERow] = []

    def alone(k: int) -> None:
        found.append(running.raw_step(y[k], u[k]))

    def together(k: int, length: int) -> int:
        if length not in calls:
            calls[length] = Compiled(running.graph.over(length))
        rows = running.stretch(y[k : k + length], u[k : k + length], calls[length])
        found.append(rows)
        return len(rows.memory)

    alone(0)
    take_samples(1, len(y), together, alone, note)
    return found
