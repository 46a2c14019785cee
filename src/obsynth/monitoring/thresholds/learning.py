"""Learning thresholds from logs without faults: the observer runs on the logs, and levels follow from its residuals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.monitoring.logs.long_warm_up import LONG_SHARE, advice_on_warm_up, cause_of_warm_up
from obsynth.monitoring.logs.signals import TIME_HEADER, LogSignals
from obsynth.monitoring.logs.sources import Logs
from obsynth.monitoring.thresholds.alarm_rates import rows_per_alarm
from obsynth.monitoring.thresholds.learned import FOLLOWED_ROWS, LearnedThresholds
from obsynth.monitoring.thresholds.learned_from_rows import (
    divided_at_starts,
    left_out_estimates,
    raised_levels,
    thresholds_from_rows,
    watched_rows,
)
from obsynth.monitoring.thresholds.learned_ranges import LearnedRanges, ranges_of_rows
from obsynth.monitoring.thresholds.normal_logs import NormalLogs, read_normal_logs
from obsynth.monitoring.thresholds.normal_notes import (
    notes_of_left_out,
    notes_of_normal_rows,
    notes_of_sizes,
    notes_of_starts,
)
from obsynth.monitoring.thresholds.normal_output import NormalRuns, ObserverOutput, output_of_log, output_of_normal_logs
from obsynth.monitoring.thresholds.range_rates import range_rates
from obsynth.monitoring.thresholds.sensor_drifts import (
    DRIFT_ROWS,
    LIMIT_ROWS,
    SensorDrifts,
    drift_limits,
    drifts_by_runs,
    linear_drifts,
    sensor_deviations,
)
from obsynth.monitoring.thresholds.watched_columns import watched_names
from obsynth.numerics.arguments import NonNegative, Seed, arguments_checked
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.observer import LinearObserver
from obsynth.results.design import ObserverDesign
from obsynth.results.number_texts import duration

#: An offset of a sensor that causes an alarm is reported if it is less than so many deviations of its noise: for
#: thresholds from one log, and from several.  Sensors of healthy logs have offsets of this size, and logs with such
#: offsets raise the levels above their effects.
FEW_DEVIATIONS, USUAL_DEVIATIONS = 1.0, 4.0

#: Default rate of false alarms.
FALSE_ALARM_RATE = "1 per 1000 rows"

#: Default of the drift that each sensor may have, in deviations of its noise.
SENSOR_DRIFT = 0.0


@arguments_checked
def learn_thresholds(
    design: ObserverDesign,
    data: Logs,
    *,
    false_alarms: str | float = FALSE_ALARM_RATE,
    rows: str | slice | Sequence[int] | None = None,
    columns: Mapping[str, str] | None = None,
    time_column: str | None = None,
    time_zone: str | None = None,
    time_unit: str | None = None,
    scales: Mapping[str, float] | None = None,
    gap: float | None = None,
    warm_up: float | None = None,
    seed: Seed = 0,
    units_as_is: bool = False,
    sensor_drift: NonNegative = SENSOR_DRIFT,
) -> LearnedThresholds:
    """Learn the thresholds of a design from rows of its plant without faults.

    Offsets, covariance and colour of the fault estimates and residuals are estimated from the rows, and not taken from
    the design.  A fitted autoregression whitens them.  An alarm is raised by Hotelling's T2, by exponentially weighted
    means or by likelihood ratios of steps and ramps.  If the design models the faults as random walks, likelihood
    ratios of a change of each fault and the fault's estimate are tested as well.  The bootstrap of the levels repeats
    every estimation, so that a short log gives higher levels.

    Parameters
    ----------
    design : ObserverDesign
        Of any method.
    data : path, text stream, pandas.DataFrame or list of these
        As for `obsynth.run_on_data`: a log without faults, several logs, each of which is a run of its own, or the
        folder with these logs.  Starts, set points and offsets of sensors differ from log to log; three or more logs
        show how much.
    false_alarms : str or float, optional
        Rate of false alarms, such as ``"1 per week"`` or ``"2 per 1000 rows"``, or their number per row.  Alarms less
        than 20 rows apart count as one.
    rows : str, slice or pair of int, optional
        Rows of each log that are free of faults, counted as in Python; all by default.  The observer also runs over the
        rows before them.
    columns, time_column, time_zone, time_unit, scales, gap, warm_up
        As for `obsynth.run_on_data`.
    seed : int, optional
        Seed of the bootstrap.
    units_as_is : bool, optional
        As for `obsynth.run_on_data`: by default a log is refused if one of its signals is likely in another unit than
        that of the plant, since the levels would be in the wrong unit.
    sensor_drift : float, optional
        Slow drift that each sensor may have without an alarm, in deviations of its noise, whether or not the logs show
        such drifts; 0: none.  The noise is that of the design, or else that of the log.  The statement names sensors
        for which neither is known; no drift of these is allowed for.

    Returns
    -------
    LearnedThresholds
        For `obsynth.online_monitor`.  ``statement`` says what the thresholds mean, and ``holds`` whether the rows
        suffice.  ``notes`` name what a user should look at: events that raise the levels, outputs that are stuck, and
        errors of the model where inputs move.

    Raises
    ------
    SpecError
        The log cannot be read, has too few rows, or no signal changes in it; ``false_alarms`` is not a rate; a signal
        is likely in another unit than that of the plant; ``sensor_drift`` is positive, but no sensor has noise, or the
        design integrates.

    References
    ----------
    Alwan & Roberts (1988), Lowry et al. (1992), Willsky & Jones (1976), Politis & Romano (1994), Gandy & Kvaloy (2013).

    Examples
    --------
    >>> import pandas as pd
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]],
    ...     C=[[1, 0], [0, 1]],
    ...     Bf=[[1], [0]],
    ...     Bd=[[0], [1]],
    ...     dt=1.0,
    ...     sensor_noise={"y1": 0.1, "y2": 0.1},
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> log = obsynth.simulate(design, obsynth.Scenario(horizon=2000, noise=1.0)).outputs
    >>> normal = pd.DataFrame({"time": range(len(log)), "y1": log[:, 0], "y2": log[:, 1]})
    >>> learned = obsynth.learn_thresholds(design, normal, false_alarms="1 per 100 rows")
    >>> learned.columns
    ('fhat[f1]',)
    """
    # A design or a rate that is refused is refused before the log is read.
    watched_names(design)
    rows_per_alarm(false_alarms, 1.0 if design.observer.dt == 0.0 else design.observer.dt)
    if time_column is not None:
        columns = {**(columns or {}), TIME_HEADER: time_column}
    runs = NormalRuns(design, columns, scales, gap, warm_up)
    signals = runs.begun().signals
    logs = read_normal_logs(design, data, signals, time_zone=time_zone, time_unit=time_unit, units_as_is=units_as_is)
    chosen = logs.chosen(rows)
    normal = output_of_normal_logs(runs, logs, false_alarms, chosen)
    output, deviations = normal.output, signals.deviations(logs.rows)
    offsets = sensor_deviations(design, deviations[:, signals.inputs :])
    drifts = _drifts(normal.runs, logs, sensor_drift * offsets) if sensor_drift else None
    options: dict[str, Any] = {
        "every": normal.every, "dt": normal.dt, "seed": seed, "pairs": normal.pairs,
        "logs": logs.slices_of(output.numbers), "repeats": logs.repeats,
        "drifts": drifts, "sensor_drift": sensor_drift,
    }  # fmt: skip
    learned = thresholds_from_rows(
        design,
        output.watched,
        scores=output.scores,
        innovation=output.innovation_size(),
        outlier_sizes=normal.runs.outlier_sizes,
        initial_covariance=normal.runs.initial_covariance,
        missing=logs.missing(signals) + _long_warm_up(runs, logs),
        **options,
    )
    white = learned.statistics.model.whitened(watched_rows(design, learned, output.watched))
    without_room = np.flatnonzero([] if drifts is None else drifts.sensors_without())
    learned = replace(learned, memory=_memory(learned, logs))
    return replace(
        learned,
        notes=(
            *logs.notes_of_cells(signals),
            *_notes_of_output(design, output, logs, chosen, learned, options),
            *notes_of_sizes(white, logs.rows[output.numbers, 1 : 1 + signals.inputs]),
            *_notes_of_starts(design, output, learned),
        ),
        without_drift=tuple(signals.names[signals.inputs + i] for i in without_room),
        drift_limits=_drift_limits(normal.runs, logs, offsets, learned) if drifts is None else {},
        ranges=_ranges(signals, deviations, output, white, learned, options["logs"]),
    )


def _long_warm_up(runs: NormalRuns, logs: NormalLogs) -> str:
    """Return how much of the logs is warm-up, as a sentence with a blank before it; empty where it is less than half
    of them."""
    run = runs.begun()
    warm_up = run.observer.warm_up
    parts = [logs.rows[a:b] for a, b in logs.ends if a < b]
    rows = sum(int(np.sum(part[:, 0] - part[0, 0] < warm_up)) for part in parts)
    if rows < LONG_SHARE * len(logs.rows):
        return ""
    cause = cause_of_warm_up(run.observer)
    spans = [(float(part[-1, 0] - part[0, 0]), run.signals.deviations(part[:1])[0]) for part in parts]
    advice = advice_on_warm_up(runs.design, run.observer, spans) if cause else ""
    return (
        f" {rows} of the {len(logs.rows)} rows are warm-up: this lasts {duration(warm_up)} from the start of each log"
        f"{f', {cause}' if cause else ''}. Give longer logs, or a shorter warm-up (--warm-up) where logs begin near "
        f"the operating point of the design.{f' {advice}' if advice else ''}"
    )


def _memory(learned: LearnedThresholds, logs: NormalLogs) -> float:
    """Return over how many rows slow offsets of residuals are followed; zero: they are not.

    They are followed if there is one log only, which does not distinguish faults from drifts, and if no sensor drift is
    allowed for or changes of faults are tested.
    """
    return FOLLOWED_ROWS if len(logs.ends) == 1 and (learned.statistics.estimates or not learned.sensor_drift) else 0.0


def _notes_of_output(
    design: ObserverDesign,
    output: ObserverOutput,
    logs: NormalLogs,
    chosen: list[tuple[int, int]],
    learned: LearnedThresholds,
    options: Mapping[str, Any],
) -> list[str]:
    """Return notes on ``chosen`` rows of logs that raise levels, on outputs that are stuck, and on estimates that are
    not watched."""
    raised = raised_levels(design, learned, output.watched, output.scores, **options)
    return [
        *notes_of_normal_rows(
            raised, output.numbers, logs.rows[:, 0], chosen, logs.stuck, logs.ends, list(logs.stamps)
        ),
        *notes_of_left_out(left_out_estimates(design, learned, output.watched), learned, design.plant.units),
    ]


def _notes_of_starts(design: ObserverDesign, output: ObserverOutput, learned: LearnedThresholds) -> tuple[str, ...]:
    """Return notes on faults whose estimates hardly change after the start of a log."""
    scores = output.scores if learned.statistics.estimates else None
    return notes_of_starts(divided_at_starts(design.observer, scores))


def _ranges(
    signals: LogSignals,
    deviations: FloatArray,
    output: ObserverOutput,
    white: FloatArray,
    learned: LearnedThresholds,
    logs: Sequence[slice],
) -> LearnedRanges:
    """Return the ranges of signals in the rows without faults, with the rates at which levels grow beyond them."""
    ranges = ranges_of_rows(signals, deviations[np.unique(output.numbers)], signals.inputs)
    distances = ranges.distances(deviations[output.numbers, : signals.inputs])
    return ranges._replace(rates=range_rates(distances, white, learned, output.scores, logs))


def _drifts(runs: NormalRuns, logs: NormalLogs, offsets: FloatArray, most: int = DRIFT_ROWS) -> SensorDrifts:
    """Return the effects of sensor drifts by ``offsets (ny,)`` on the watched columns.

    For a nonlinear observer they are computed by running it on ``most`` rows of the longest log.
    """
    if not offsets.any():
        raise SpecError(
            "No noise of any sensor is stated, and the log shows none: a drift in deviations of it is nothing. State "
            "the noise (sensor_noise), or leave sensor_drift at 0.",
            path="sensor_drift",
        )
    if isinstance(runs.design.observer, LinearObserver):
        return linear_drifts(runs.design.observer, offsets)
    signals, ny = runs.begun().signals, len(offsets)
    first, last = max(logs.ends, key=lambda ends: ends[1] - ends[0])
    log = logs.rows[first : min(last, first + most)]

    def run(added: FloatArray) -> ObserverOutput:
        moved = log.copy()
        moved[:, -ny:] += added / signals.scale[-ny:]
        return output_of_log(runs, moved, first)

    return drifts_by_runs(run, offsets)


def _drift_limits(
    runs: NormalRuns, logs: NormalLogs, offsets: FloatArray, learned: LearnedThresholds
) -> dict[str, float]:
    """Return the slow drift of each sensor that causes an alarm for as long as it lasts, in units of ``offsets (ny,)``.

    Only small ones are returned: one log does not show the drifts of other logs, and several logs show none if they
    have none.
    """
    try:
        drifts = _drifts(runs, logs, offsets, LIMIT_ROWS)
    except SpecError:
        return {}
    columns = [watched_names(runs.design).index(name) for name in learned.columns]
    most = FEW_DEVIATIONS if len(logs.ends) == 1 else USUAL_DEVIATIONS
    limits = drift_limits(learned.statistics, learned.levels, drifts, columns, most=most)
    signals = runs.begun().signals
    names = signals.names[signals.inputs :]
    return {name: float(limit) for name, limit in zip(names, limits, strict=True) if np.isfinite(limit)}
