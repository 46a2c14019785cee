"""Estimates of a recursive observer over many samples: deviations, covariances, excitation."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.numerics.ranks import UNDETERMINED_SHARE
from obsynth.observers.estimates import Estimates
from obsynth.observers.recursive.sample import RawEstimate
from obsynth.observers.recursive.settings import RecursiveSettings
from obsynth.observers.running import named_estimates

#: Rows whose arrays are put together at once: more would leave the processor's cache, and their room be made anew.
ROWS_TOGETHER = 256


def recursive_estimates(
    observer: RecursiveSettings, rows: Sequence[RawEstimate], *, window: Sequence[FloatArray] | None = None
) -> Estimates:
    """Return the estimates in rows of a recursive observer: ``window (any, nq)``: regressors of the latest samples,
    when only the last row is given."""
    length = 1 if observer.adaptation is None else observer.adaptation.window
    levels = excitation_levels([row.regressor for row in rows] if window is None else list(window), length)
    levels = levels[len(levels) - len(rows) :]
    if observer.form == "random-walk":
        levels = np.full(len(rows), np.nan)
    nx, nq = observer.plant.nx, len(observer.fault_names)
    most = max((len(row.innovation) for row in rows), default=0)
    innovations, padded = np.full((len(rows), most), np.nan), np.full((len(rows), most, nq), np.nan)
    degrees, nis = np.zeros(len(rows)), np.zeros(len(rows))
    for chosen, part in _alike(rows, "innovation"):
        innovations[chosen, : part.shape[1]], degrees[chosen] = part, part.shape[1]
    for chosen, part in _alike(rows, "regressor"):
        padded[chosen, : part.shape[1]] = part
    for chosen, part in _alike(rows, "gap"):
        # A matrix product for each row, as for a single one.
        nis[chosen] = np.matmul(part[:, None, :], part[:, :, None])[:, 0, 0]
    return named_estimates(
        observer,
        states=np.array([row.x for row in rows]).reshape(len(rows), nx),
        **_spreads(rows, nx, nq),
        innovations=innovations,
        regressors=padded,
        nis=nis,
        nis_degrees=degrees,
        excitation=levels,
        received=read_only(~np.isnan(np.array([row.y for row in rows])).reshape(len(rows), observer.plant.ny), bool),
    )


def excitation_levels(regressors: Sequence[FloatArray], window: int) -> FloatArray:
    """Return the least eigenvalue of ``sum G' G`` over the last ``window`` samples, zero while the window fills:
    ``regressors (any, nq)``."""
    nq = regressors[0].shape[1] if regressors else 0
    levels = np.zeros(len(regressors))
    if not nq or len(regressors) < window:
        return levels
    squares = np.empty((len(regressors), nq, nq))
    for chosen, part in _groups(regressors):
        squares[chosen] = np.matmul(part.transpose(0, 2, 1), part)
    # Each window is summed anew: differences of cumulated sums would leave rounding of early, strong excitation.
    count = len(regressors) - window + 1
    totals = squares[:count].copy()
    for later in range(1, window):
        totals += squares[later : later + count]
    levels[window - 1 :] = np.linalg.eigvalsh(totals)[:, 0]
    return np.maximum(levels, 0.0)


def _alike(rows: Sequence[RawEstimate], name: str) -> Iterator[tuple[NDArray[np.intp], FloatArray]]:
    """Yield places of rows with arrays of one shape, and these as one array."""
    return _groups([getattr(row, name) for row in rows])


def _groups(arrays: Sequence[FloatArray]) -> Iterator[tuple[NDArray[np.intp], FloatArray]]:
    places = defaultdict[tuple[int, ...], list[int]](list)
    for place, array in enumerate(arrays):
        places[array.shape].append(place)
    for alike in places.values():
        for begin in range(0, len(alike), ROWS_TOGETHER):
            chosen = alike[begin : begin + ROWS_TOGETHER]
            yield np.array(chosen), np.array([arrays[place] for place in chosen])


def _spreads(rows: Sequence[RawEstimate], nx: int, nq: int) -> dict[str, FloatArray]:
    """Return parameters, and the deviations and covariances of states and parameters, infinite where one is open."""
    count = len(rows)
    states, parameters, cross = (np.zeros((count, *shape)) for shape in ((nx, nx), (nq, nq), (nx, nq)))
    deviations = np.zeros((count, nx))
    spreads = [row.parameters.spread for row in rows]
    for chosen, factor in _alike(rows, "factor"):
        deviations[chosen] = np.sqrt(np.einsum("kij,kij->ki", factor, factor))
        states[chosen] = np.matmul(factor, factor.transpose(0, 2, 1))
        for spread_of, spread in _groups([spreads[place] for place in chosen] if nq else []):
            shared = factor[spread_of][:, :, factor.shape[2] - spread.shape[2] :]
            parameters[chosen[spread_of]] = np.matmul(spread, spread.transpose(0, 2, 1))
            cross[chosen[spread_of]] = np.matmul(shared, spread.transpose(0, 2, 1))
    for place, row in enumerate(rows):
        if row.diffuse.shape[1]:
            unknown = (np.abs(row.diffuse) > UNDETERMINED_SHARE).any(axis=1)
            deviations[place, unknown] = np.inf
            states[place, unknown], states[place][:, unknown] = np.nan, np.nan
            states[place, unknown, unknown] = np.inf
    for made in (deviations, states, cross):
        made.setflags(write=False)
    return {
        "state_deviations": deviations,
        "faults": np.array([row.theta for row in rows]).reshape(count, nq),
        "fault_covariances": parameters,
        "state_covariances": states,
        "cross_covariances": cross,
    }
