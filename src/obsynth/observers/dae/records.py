"""Whole records through an observer of a DAE: in stretches inside CasADi, with single steps where those fail."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from obsynth.errors import SolverError, SpecError
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.dae.compiled_library import DAELibrary
from obsynth.observers.dae.estimates import DAERow, GatheredRows
from obsynth.observers.dae.steps import DAEState, Steps
from obsynth.observers.estimates import Estimates
from obsynth.observers.progress import shown_progress
from obsynth.plants.dae.functions import Compiled, take_samples

#: Samples in one call of the C: a tenth of a second or less, so that progress shows and memory stays small.
SAMPLES_PER_CALL = 10_000


def run_record(
    steps: Steps, y: FloatArray, u: FloatArray, *, compiled: bool | None, library: DAELibrary | None,
    progress: bool | Callable[[int], None] | None,
) -> Estimates:  # fmt: skip
    """Run over a whole record: ``y (samples, ny)``, ``u (samples, nu)``."""
    alone = steps.settings.outside_graph
    if library is not None and alone:
        raise SpecError(f"The C knows no {alone}: leave compiled=True out, or leave {alone} out.", path="compiled")
    found = GatheredRows(steps.settings)
    found.add(_nothing(steps))
    with shown_progress(progress, len(y), "samples") as note:
        if library is not None:
            _in_c(steps, library, y, u, found.add_regular, note)
        elif compiled is None and not alone:
            advanced(steps, y, u, found.add_regular, note)
        else:
            state = steps.first
            for k in range(len(y)):
                state, row = steps.advance(state, y[k], u[k])
                found.add_regular(row)
                note(k + 1)
    return found.estimates()


def _nothing(steps: Steps) -> DAERow:
    """Return rows of no samples, so that an empty record has estimates of the right shape."""
    graph, model = steps.graph, steps.settings.model
    memory, said = np.zeros((0, graph.memory.size)), np.zeros((0, graph.row.size))
    return DAERow(graph, 0, memory, said, np.zeros((0, model.ny), dtype=bool), np.zeros(model.nx))


def _in_c(
    steps: Steps, library: DAELibrary, y: FloatArray, u: FloatArray, keep: Callable[[DAERow], object],
    note: Callable[[int], object],
) -> None:  # fmt: skip
    moved = np.zeros(0)
    state = library.started()
    for begin in range(0, len(y), SAMPLES_PER_CALL):
        heard = y[begin : begin + SAMPLES_PER_CALL]
        after, said = library.record(state, heard, u[begin : begin + SAMPLES_PER_CALL])
        if len(after) < len(heard):
            # Go there again where the message is written.
            advanced(steps, y, u, bool, note)
            raise SolverError(f"The C stops at k = {begin + len(after)}, but CasADi goes on: leave compiled=True out.")
        if begin == 0:
            moved = steps.projected(steps.first, u[0])[1]
        keep(DAERow(steps.graph, begin, after, said, ~np.isnan(heard[: len(after)]), moved))
        note(begin + len(heard))


def advanced(
    steps: Steps, y: FloatArray, u: FloatArray, keep: Callable[[DAERow], object],
    note: Callable[[int], object] = bool,
) -> DAEState:  # fmt: skip
    """Lead an observer from its start through a record; return its state at the end: ``y (samples, ny)``, ``u (samples,
    nu)``."""
    calls: dict[int, Compiled] = {}
    state = steps.first

    def alone(k: int) -> None:
        nonlocal state
        state, row = steps.advance(state, y[k], u[k])
        keep(row)

    def together(k: int, length: int) -> int:
        nonlocal state
        if length not in calls:
            calls[length] = Compiled(steps.graph.over(length))
        state, rows = steps.stretch(state, y[k : k + length], u[k : k + length], calls[length])
        keep(rows)
        return len(rows.memory)

    if len(y):
        alone(0)
    take_samples(1, len(y), together, alone, note)
    return state
