"""Missing known inputs: the last value is used, with a bound on its error from the input's past.

An input moves by no more from one sample to the next than it did before, and not out of its range.  In m samples it may
have moved that far all the time: as the same error acts in all of them, what it does is added up, and not its squares.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from obsynth.errors import SpecError, counted
from obsynth.numerics.arrays import FloatArray


class TakenInputs(NamedTuple):
    """What the inputs of a sample are taken as."""

    u: FloatArray  # ``(nu,)``: without gaps
    history: FloatArray  # after the sample, see `no_inputs`
    # ``(nu,)``, variances: of those that are missing, and of those of samples before that are known again and have
    # moved further than was thought of; ``None`` where there are none
    missing: FloatArray | None
    returned: FloatArray | None

    @property
    def variances(self) -> FloatArray | None:
        """Both together ``(nu,)``."""
        if self.missing is None or self.returned is None:
            return self.missing if self.returned is None else self.returned
        return np.asarray(self.missing + self.returned)


def no_inputs(count: int) -> FloatArray:
    """Return what is known of inputs before the first sample ``(5, nu)``: the lowest and the highest value, the largest
    change from one sample to the next, the samples in a row that are missing, and the sum of what these may be off
    by."""
    return np.zeros((5, count))


def require_inputs(u: FloatArray, names: tuple[str, ...], k: int) -> None:
    """Raise `SpecError` unless inputs ``u (nu,)`` are as many as their names; where one is infinite, or missing (NaN)
    before it was ever known."""
    if u.shape != (len(names),):
        raise SpecError(f"u must be {counted(len(names), 'finite number')} at k = {k}.", path="u")
    wrong = np.isinf(u) | (np.isnan(u) if k == 0 else False)
    if wrong.any():
        i = int(np.argmax(wrong))
        raise SpecError(
            f"The input {names[i]!r} is {u[i]} at k = {k}: inputs must be known at the first sample and finite later "
            "(NaN: missing). Begin where all are known, or make the signal a state with a sensor.",
            path="u",
        )


def held_inputs(held: FloatArray, u: FloatArray) -> FloatArray | None:
    """Return inputs with those before (``held (nu,)``) in the place of what is missing; ``None`` where nothing is."""
    return np.where(np.isnan(u), held, u) if math.isnan(u.dot(u)) else None


def taken_inputs(history: FloatArray, held: FloatArray, u: FloatArray, *, is_first: bool) -> TakenInputs:
    """Return what inputs ``u (nu,)`` are taken as, where NaN is what is missing; ``held (nu,)``: those before."""
    if is_first:
        return TakenInputs(u, np.stack((u, u, *np.zeros((3, len(u))))), None, None)
    used = held_inputs(held, u)
    # Lists of few numbers are compared in a tenth of the time of arrays.
    lowest_yet, highest_yet, change_yet, absent, _ = history.tolist()
    if used is None and not any(absent):
        histories = zip(lowest_yet, u.tolist(), highest_yet, held.tolist(), change_yet, strict=True)
        if all(low <= now <= high and abs(now - before) <= most for low, now, high, before, most in histories):
            return TakenInputs(u, history, None, None)
        after = history.copy()
        np.minimum(history[0], u, out=after[0])
        np.maximum(history[1], u, out=after[1])
        np.maximum(history[2], np.abs(u - held), out=after[2])
        return TakenInputs(u, after, None, None)
    gone, used = np.isnan(u), u if used is None else used
    lowest, highest, change, count, off = history
    moved = np.abs(used - held)
    reach = np.minimum((count + 1.0) * change, highest - lowest)
    total = off + reach
    missing = np.where(gone, total * total - off * off, 0.0)
    further = ~gone & (count > 0.0) & (moved > reach)
    returned = np.where(further, np.maximum((count * moved) ** 2 - off * off, 0.0), 0.0)
    after = np.stack(
        (
            np.minimum(lowest, used),
            np.maximum(highest, used),
            np.maximum(change, moved / (count + 1.0)),
            np.where(gone, count + 1.0, 0.0),
            np.where(gone, total, 0.0),
        )
    )
    return TakenInputs(used, after, missing, returned)


def over_samples(history: FloatArray, held: FloatArray, u: FloatArray) -> FloatArray:
    """Return the history after samples in which all inputs ``(samples, nu)`` are known."""
    moved = np.abs(np.diff(u, axis=0, prepend=held[None])).max(axis=0)
    return np.stack(
        (
            np.minimum(history[0], u.min(axis=0)),
            np.maximum(history[1], u.max(axis=0)),
            np.maximum(history[2], moved),
            history[3],
            history[4],
        )
    )
