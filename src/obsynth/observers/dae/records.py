"""Whole records through an observer of a DAE: in stretches inside CasADi, with single steps where those fail."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from obsynth.errors import SolverError
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.dae.estimates import DAEEstimates, DAERow, GatheredRows
from obsynth.observers.dae.observer import DAEObserver
from obsynth.observers.dae.steps import DAEState
from obsynth.observers.progress import shown_progress
from obsynth.observers.running import RunningObserver
from obsynth.plants.dae.functions import Compiled
from obsynth.plants.dae.stretches import take_samples

#: Samples in one call of the C: a tenth of a second or less, so that progress shows and memory stays small.
SAMPLES_PER_CALL = 10_000


def run_record(
    observer: DAEObserver, y: FloatArray, u: FloatArray, *, compiled: bool | None,
    progress: bool | Callable[[int], None] | None,
) -> DAEEstimates:  # fmt: skip
    """Run over a whole record.

    Shapes: ``y (samples, ny)``, ``u (samples, nu)``.
    """
    found = GatheredRows(observer)
    found.add(_nothing(observer))
    with shown_progress(progress, len(y), "samples") as note:
        if compiled:
            _in_c(observer, y, u, found.add_regular, note)
        elif compiled is None:
            advanced(observer, y, u, found.add_regular, note)
        else:
            running = RunningObserver(observer)
            for k in range(len(y)):
                found.add_regular(running.raw_step(y[k], u[k]))
                note(k + 1)
    return found.estimates()


def _nothing(observer: DAEObserver) -> DAERow:
    """Return rows of no samples, so that an empty record has estimates of the right shape."""
    graph, model = observer.graph, observer.model
    memory, said = np.zeros((0, graph.memory.size)), np.zeros((0, graph.row.size))
    return DAERow(graph, 0, memory, said, np.zeros((0, model.ny), dtype=bool), np.zeros(model.nx))


def _in_c(
    observer: DAEObserver, y: FloatArray, u: FloatArray, keep: Callable[[DAERow], object],
    note: Callable[[int], object],
) -> None:  # fmt: skip
    library, moved = observer.library, np.zeros(0)
    state = library.started()
    for begin in range(0, len(y), SAMPLES_PER_CALL):
        heard = y[begin : begin + SAMPLES_PER_CALL]
        after, said = library.record(state, heard, u[begin : begin + SAMPLES_PER_CALL])
        if len(after) < len(heard):
            # Go there again where the message is written.
            advanced(observer, y, u, bool, note)
            raise SolverError(f"The C stops at k = {begin + len(after)}, but CasADi goes on: leave compiled=True out.")
        if begin == 0:
            moved = observer.steps.projected(observer.init(), u[0])[1]
        keep(DAERow(observer.graph, begin, after, said, ~np.isnan(heard[: len(after)]), moved))
        note(begin + len(heard))


def advanced(
    observer: DAEObserver, y: FloatArray, u: FloatArray, keep: Callable[[DAERow], object],
    note: Callable[[int], object] = bool,
) -> DAEState:  # fmt: skip
    """Lead an observer from its start through a record; return its state at the end.

    Shapes: ``y (samples, ny)``, ``u (samples, nu)``.
    """
    calls: dict[int, Compiled] = {}
    running = RunningObserver(observer)

    def alone(k: int) -> None:
        keep(running.raw_step(y[k], u[k]))

    def together(k: int, length: int) -> int:
        if length not in calls:
            calls[length] = Compiled(observer.graph.over(length))
        running.state, rows = observer.steps.stretch(running.state, y[k : k + length], u[k : k + length], calls[length])
        keep(rows)
        return len(rows.memory)

    if len(y):
        alone(0)
    take_samples(1, len(y), together, alone, note)
    return running.state
