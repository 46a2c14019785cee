"""Whole records through an observer of a DAE: in stretches inside CasADi, with single steps where those fail."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from obsynth.models.dae_functions import Compiled
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.dae import DAEObserver
from obsynth.observers.dae_estimates import DAEEstimates, DAERow
from obsynth.observers.dae_running import RunningDAEObserver
from obsynth.observers.progress import shown_progress

#: Samples in one call.  After a step that had to be taken by itself the shorter stretch is tried first: hard steps
#: come together, and what follows one inside a stretch is lost.
STRETCHES = (16, 256)


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
    with shown_progress(progress, len(y), "samples") as note:
        return DAEEstimates.of(observer, list(advanced(running, y, u, note, stretches=compiled is not False)))


def advanced(
    running: RunningDAEObserver, y: FloatArray, u: FloatArray, note: Callable[[int], object], *, stretches: bool = True
) -> Iterator[DAERow]:
    """Lead an observer in motion through a record, and yield what it says.

    Parameters
    ----------
    running : RunningDAEObserver
        In motion.
    y, u : FloatArray
        ``(samples, ny)`` and ``(samples, nu)``, checked.
    note : callable
        Called with the number of samples that are done.
    stretches : bool, optional
        Whether several samples are taken in one call.
    """
    calls: dict[int, Compiled] = {}
    k, allowed = 0, STRETCHES[-1]
    while k < len(y):
        length = next((size for size in reversed(STRETCHES) if size <= min(allowed, len(y) - k)), 0)
        if running.k == 0 or not length or not stretches:
            yield running.raw_step(y[k], u[k])
            k += 1
        else:
            if length not in calls:
                calls[length] = Compiled(running.graph.over(length))
            rows = running.stretch(y[k : k + length], u[k : k + length], calls[length])
            taken = len(rows.memory)
            if taken:
                yield rows
            k += taken
            allowed = STRETCHES[-1]
            if taken < length:
                yield running.raw_step(y[k], u[k])
                k, allowed = k + 1, STRETCHES[0]
        note(k)
