"""Rows without faults: what a design says of them, and the thresholds that are learned from that."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from obsynth.data.log_estimator import DECIDING, STALE
from obsynth.data.log_run import LogRun
from obsynth.data.log_tables import parsed_rows
from obsynth.data.signals import TIME_HEADER, Stamps
from obsynth.data.sources import CHUNK_ROWS, Data, chunks
from obsynth.errors import SpecError
from obsynth.experiments.monitors.learned import (
    LEAST_NORMAL,
    LearnedThresholds,
    rows_per_alarm,
    settling_rows,
    thresholds_from_rows,
    watched_names,
    watched_values,
)
from obsynth.experiments.monitors.learned_levels import AGES
from obsynth.numerics.arguments import require_kind
from obsynth.numerics.arrays import FloatArray
from obsynth.results.design import ObserverDesign

#: One false alarm in so many rows, where nothing else is asked for.
FALSE_ALARM_RATE = "1 per 1000 rows"


def learn_thresholds(
    design: ObserverDesign,
    data: Data,
    *,
    false_alarms: str | float = FALSE_ALARM_RATE,
    rows: str | slice | Sequence[int] | None = None,
    columns: Mapping[str, str] | None = None,
    time_column: str | None = None,
    scales: Mapping[str, float] | None = None,
    gap: float | None = None,
    warm_up: float | None = None,
    seed: int = 0,
) -> LearnedThresholds:
    """Learn the thresholds of a design from rows of its plant without faults.

    Offsets, covariance and colour of the fault estimates and residuals are taken from the rows, whatever the design
    assumes of them: they are whitened by a fitted autoregression and watched by Hotelling's T2, exponentially weighted
    means and likelihood ratios of steps.  Levels come from a bootstrap of all that is estimated, so that a short log
    gives higher ones.

    Parameters
    ----------
    design : ObserverDesign
        Of any method.
    data : path, text stream or pandas.DataFrame
        As for `obsynth.run_on_data`: a log without faults.
    false_alarms : str or float, optional
        Rate of false alarms, such as ``"1 per week"`` or ``"2 per 1000 rows"``, or a number of them per row.  Alarms
        closer than 20 rows are one.
    rows : str, slice or pair of int, optional
        Rows of the log that are free of faults, as Python counts; all by default.  The observer runs over all before.
    columns, time_column, scales, gap, warm_up
        As for `obsynth.run_on_data`.
    seed : int, optional
        Of the bootstrap.

    Returns
    -------
    LearnedThresholds
        For `obsynth.online_monitor`; ``statement`` says what they mean, and ``holds`` whether the rows suffice.

    Raises
    ------
    SpecError
        The log cannot be read, holds too few rows, or nothing moves in it; the rate is none.

    References
    ----------
    Alwan & Roberts (1988), Lowry et al. (1992), Willsky & Jones (1976), Politis & Romano (1994), Gandy & Kvaloy (2013).
    """
    require_kind(design, ObserverDesign, "design", "an ObserverDesign, such as obsynth.load(path)")
    rows_per_alarm(false_alarms, 1.0 if design.observer.dt == 0.0 else design.observer.dt)
    if time_column is not None:
        columns = {**(columns or {}), TIME_HEADER: time_column}
    numbers, times, found = _said(design, data, columns, scales, gap, warm_up)
    first, last = parsed_rows(rows, int(numbers[-1]) + 1)
    chosen = (first <= numbers) & (numbers < last)
    times, found = times[chosen], found[chosen]
    dt = design.observer.dt or float(np.median(np.diff(times)))
    return thresholds_from_rows(design, found, every=rows_per_alarm(false_alarms, dt), dt=dt, seed=seed)


def _said(
    design: ObserverDesign,
    data: Data,
    columns: Mapping[str, str] | None,
    scales: Mapping[str, float] | None,
    gap: float | None,
    warm_up: float | None,
) -> tuple[NDArray[np.int64], FloatArray, FloatArray]:
    """Return numbers from 0 and times ``(n,)`` of rows, and what is watched ``(n, m)``: NaN where nothing is decided,
    or rows are missing."""
    run = LogRun(design, columns, scales, gap=gap, warm_up=warm_up)
    nothing = np.full(len(watched_names(design)), np.nan)
    residuals = [i for i, name in enumerate(run.observer.columns) if name.startswith("r[")]
    numbers, times, rows = list[int](), list[float](), list[FloatArray]()
    count, settling = 0, settling_rows(design)
    for chunk in chunks(data, run.signals, Stamps(), CHUNK_ROWS):
        for row in run.read(chunk):
            if row.status in STALE:
                count += 1
                continue
            said = watched_values(row.values[residuals], row.evidence)
            if row.status not in DECIDING or count < settling:
                said = None
            # Longer gaps than the statistics look back are all the same.
            missing = min(row.skipped, max(AGES))
            rows += [nothing] * missing + [nothing if said is None else said]
            times += [row.time] * (missing + 1)
            numbers += [count] * (missing + 1)
            count += 1
    if count < LEAST_NORMAL:
        raise SpecError(f"The log has {count} rows: give {LEAST_NORMAL} and more.", path="normal")
    return np.array(numbers), np.array(times), np.array(rows)
