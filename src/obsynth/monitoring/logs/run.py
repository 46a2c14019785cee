"""A design on measured data: a log or a stream in, estimates out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence, Sized
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from obsynth.errors import ObsynthError, SpecError
from obsynth.files.outputs import check_output, remove_left_parts, require_distinct
from obsynth.files.signals import HeldSignals, ending_signals
from obsynth.methods.guaranteed_test.method import is_guaranteed
from obsynth.methods.guaranteed_test.result import GuaranteedTest
from obsynth.methods.guaranteed_test.tolerant import rows_before
from obsynth.monitoring.alarms.events import AlarmEvent, rows_in_alarm
from obsynth.monitoring.logs.clock import STALE
from obsynth.monitoring.logs.followed import FollowedLog
from obsynth.monitoring.logs.log_observer import GAP, WARM_UP
from obsynth.monitoring.logs.log_run import LogRun
from obsynth.monitoring.logs.long_warm_up import LONG_SHARE, advice_on_warm_up, cause_of_warm_up
from obsynth.monitoring.logs.measured_columns import never_measured
from obsynth.monitoring.logs.saved_run import resume_state, save_state
from obsynth.monitoring.logs.signals import TIME_HEADER
from obsynth.monitoring.logs.sinks import FrameSink, Sink, sink_for
from obsynth.monitoring.logs.smoothing import LaterRows
from obsynth.monitoring.logs.sources import CHUNK_ROWS, Data, chunks
from obsynth.monitoring.logs.stamps import Stamps
from obsynth.monitoring.logs.stuck_sensors import stuck_texts
from obsynth.monitoring.logs.unpacked_logs import as_frame
from obsynth.monitoring.thresholds.monitor import Monitor
from obsynth.numerics.arguments import arguments_checked, require_kind, whole_number
from obsynth.numerics.arrays import FloatArray
from obsynth.results.design import ObserverDesign
from obsynth.results.gain_set_writing import gain_set_digest
from obsynth.results.number_texts import duration
from obsynth.results.registered import registered

if TYPE_CHECKING:
    import pandas as pd


#: Rows of a stream after which its state is saved.
STATE_ROWS = 100


@dataclass(frozen=True, eq=False)
class DataRun:
    """The summary of a run on measured data.

    Parameters
    ----------
    rows : int
        Number of rows of data.
    statuses : mapping of str to int
        Number of rows by status: ``ok``, ``warm-up``, ``partial``, ``gap``, ``recovering``, ``repeated stamp`` and
        ``out of order``.
    alarms : mapping of str to float
        Time in seconds at which each column, or the monitor, first exceeded its threshold.
    isolated : str
        The first fault that the monitor named; empty without a monitor, or if the evidence does not distinguish faults.
    recovered : mapping of str to str
        States of the original plant that were recovered from the estimates, with the kind of each: ``exact``, ``needs
        the fault estimate`` (which is used) or ``biased by the disturbance``.
    outliers : mapping of str to int
        Number of samples of each output that were left out or limited; for recursive and nonlinear designs.
    warnings : tuple of str
        Warnings on the data and the run.
    digest : str
        sha256 of the gain set.
    table : pandas.DataFrame or None
        The estimates, if they were not written to a file or stream.
    measured : pandas.DataFrame or None
        Time and measured signals in their units, for the rows of that table.
    stamps : Stamps
        Format of the times of the log, in seconds or as dates: ``stamps.shown(time)`` is a time in this format.
    thresholds : mapping of str to float
        The given thresholds.
    alarm_rows : mapping of str to int
        Numbers of the rows of these alarms, from 1.
    events : tuple of AlarmEvent
        All alarms with their times, faults and sizes.  Rows above a threshold that are less than 20 rows apart,
        counting missing ones, are one alarm.
    silent : mapping of str to int
        Number of rows without a decision by status; ``undecided`` where the monitor does not decide.
    statement : str
        Guarantee of the monitor's threshold, with its assumptions; empty without a monitor.
    warm_up : float, seconds
        Time after the start in which nothing is decided.
    stuck : mapping of str to tuple of (int, int)
        First and last rows, from 1, in which an output repeats one value for improbably long.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> log = {"time": list(range(20)), "y1": [0.0] * 10 + [1.0] * 10, "y2": [0.0] * 20}
    >>> run = obsynth.run_on_data(design, log, thresholds={"fhat[f1]": 0.5})
    >>> run.rows, run.alarms, run.alarm_rows
    (20, {'fhat[f1]': 10.0}, {'fhat[f1]': 11})
    """

    rows: int
    statuses: Mapping[str, int]
    alarms: Mapping[str, float]
    isolated: str
    recovered: Mapping[str, str]
    outliers: Mapping[str, int]
    warnings: tuple[str, ...]
    digest: str
    table: pd.DataFrame | None = field(default=None, repr=False)
    measured: pd.DataFrame | None = field(default=None, repr=False)
    stamps: Stamps = field(default_factory=Stamps, repr=False)
    thresholds: Mapping[str, float] = field(default_factory=dict, repr=False)
    alarm_rows: Mapping[str, int] = field(default_factory=dict)
    events: tuple[AlarmEvent, ...] = ()
    silent: Mapping[str, int] = field(default_factory=dict)
    statement: str = ""
    warm_up: float = 0.0
    stuck: Mapping[str, tuple[tuple[int, int], ...]] = field(default_factory=dict)

    def __repr__(self) -> str:
        """Return rows, alarms and warnings in a few lines."""
        return str(registered("text_of_run")(self))

    def as_dict(self) -> dict[str, Any]:
        """Return the summary as plain data, without the table."""
        return {
            "rows": self.rows,
            "statuses": dict(self.statuses),
            "alarms": dict(self.alarms),
            "alarm_rows": dict(self.alarm_rows),
            "alarm_stamps": {name: self.stamps.written(time) for name, time in self.alarms.items()},
            "events": [event.as_dict() for event in self.events],
            "rows_in_alarm": rows_in_alarm(self.events),
            "silent": dict(self.silent),
            "warm_up": self.warm_up,
            "isolated": self.isolated,
            "recovered": dict(self.recovered),
            "outliers": dict(self.outliers),
            "stuck": {name: [list(run) for run in runs] for name, runs in self.stuck.items()},
            "warnings": list(self.warnings),
            "gains_sha256": self.digest,
        }


@arguments_checked
def run_on_data(
    design: ObserverDesign,
    data: Data,
    out: str | Path | TextIO | None = None,
    *,
    columns: Mapping[str, str] | None = None,
    time_column: str | None = None,
    time_zone: str | None = None,
    time_unit: str | None = None,
    scales: Mapping[str, float] | None = None,
    thresholds: Mapping[str, float] | None = None,
    monitor: Monitor | None = None,
    gap: float | None = None,
    warm_up: float | None = None,
    outliers: str | None = None,
    smooth: bool = False,
    lag: int | None = None,
    recovered: str | Sequence[str] | None = None,
    state: str | Path | None = None,
    state_every: int = STATE_ROWS,
    chunk_rows: int = CHUNK_ROWS,
    progress: Callable[[int], None] | None = None,
    units_as_is: bool = False,
) -> DataRun:
    """Run a design on measured data, in constant memory.

    Each row of data gives one row of estimates.  The operating point is subtracted from the data and added back to
    the estimates.  An estimate with a delay has a column ``time of ...`` with the time that it is for.  If the design
    is for a plant whose algebraic states were eliminated, these are recovered and have columns as well.

    Parameters
    ----------
    design : ObserverDesign
        Of any method.
    data : path, text stream, pandas.DataFrame, or mapping of columns
        With a column ``time`` and a column for each known input and output.  Files are text (``.csv``, ``.tsv``, also
        with ``.gz``), ``.xlsx``, Parquet, TDMS, MDF (``.mf4``, ``.mdf``, ``.dat``), ``.npz`` or ``.mat`` by their
        suffix; a stream is text, and each of its rows gives a row of output at once.  Frames of polars and tables of
        pyarrow are accepted as well.
        Units in a second row of the header of a frame, or in ``attrs["units"]``, are read as ``name [unit]``.
        Columns of text are separated by commas, semicolons, tabs or bars, and numbers may have a decimal comma where
        commas separate nothing.  The time is in seconds, or dates and times of ISO 8601 with or without a zone (taken
        as UTC without one), which are written back as such; the index of a frame is the time where it is a
        DatetimeIndex.
    out : path or text stream, optional
        CSV or Parquet file, written whole or not at all; or a stream for CSV.  By default a data frame is returned.
    columns : mapping, optional
        Column of a signal (or of ``time``) if their names differ.
    time_column : str, optional
        Column of the time, the same as ``columns={"time": ...}``.
    time_zone : str, optional
        Zone of dates without a zone, such as ``Europe/Berlin`` or ``+01:00``; they are written back in this zone.  The
        order of the rows distinguishes the two occurrences of the repeated hour in autumn.
    time_unit : {"s", "ms", "us", "ns", "min", "h", "d"}, optional
        Unit of numerical stamps if the log does not state it; ``"d"`` (or ``"days"``) for serial days of spreadsheets
        and of MATLAB.  All times are then in seconds.
    scales : mapping, optional, signal's unit per column's unit
        Factor of a signal's column; by default the plant's.
    thresholds : mapping, optional
        Level of the absolute value by column of the output, such as ``fhat[actuator]`` or ``r[speed]`` (for faults with
        an operating point, of the deviation).  The column ``alarm`` names the columns above their level.  Alarms are
        suspended in rows that are not ``ok`` or ``partial``.  While the standard deviation of a fault estimate is
        larger than before samples were missing, its level is higher by the same factor.
    monitor : Monitor, optional
        From `obsynth.online_monitor`: adds the columns ``statistic`` and ``threshold``, and its alarms in ``alarm``,
        with the named fault.
    gap : float, optional, seconds
        Continuous-time designs: longer intervals are gaps; by default those ten times the longest one before.
    warm_up : float, optional, seconds
        Time without decisions after the start, and at most after gaps; by default until the slowest mode has decayed to
        2 %, and zero for recursive and nonlinear designs, whose deviations are valid from the start.
    outliers : {"gate", "huber", "none"}, optional
        Recursive and nonlinear designs: treatment of samples that contradict their prediction; by default that of the
        design, or a gate of six deviations if the design states none.
    smooth : bool, optional
        Recursive and nonlinear designs: return estimates from the whole log, as `obsynth.smooth` does, instead of those
        of the filter.  Residuals, outliers, monitors and statuses remain those of the filter.  All rows are written at
        the end, and the log is held in memory.
    lag : int, optional
        The same with the ``lag`` samples after each row; each row is written with its own time once these are there.
    recovered : {"all", "none"} or list of str, optional
        States of the original plant, before its algebraic states were eliminated, that are returned as well; by default
        all if there are at most 300, and otherwise none.
    state : path, optional
        A saved state to continue from, if the file exists; the state at the end is written to it.
    state_every : int, optional
        Number of rows of a stream after which the state is written again, atomically: at most so many rows are lost if
        the process is killed.
    chunk_rows : int, optional
        Number of rows that are read and written at a time; the results do not depend on it.
    progress : callable, optional
        Called with the number of processed rows after each chunk.
    units_as_is : bool, optional
        Whether to accept a signal that contradicts the design in the first 20 rows, but would agree after a usual
        change of unit: kelvin for degrees Celsius, Pa for bar, g for kg, percent, minutes, hours, or the other sign.
        By default such a log is refused, with the likely factor.  Recursive and nonlinear designs are checked by their
        innovations, and linear ones by operating points that are not zero.

    Returns
    -------
    DataRun
        A summary, with the estimates if ``out`` is not given.

    Raises
    ------
    SpecError
        Columns are missing or likely in another unit, a cell is not a number, a time is missing, repeated, decreasing
        or inconsistent with the design's dt (the row is named), or a file cannot be read or written.

    Notes
    -----
    Continuous-time observers are advanced from row to row by a first-order hold over the actual interval, which is
    exact for signals that are linear between rows.  In a row with a missing sample, and in a gap, the outputs of the
    plant's model replace the measured ones.  The model starts from the last state estimate, with faults held at their
    last estimate and unknown inputs of zero.  Fault estimates are then held, residuals are empty and the status is
    ``gap``.  The observer starts again after a gap of more than 10,000 samples; after a gap in which the model has lost
    the plant, as an unstable one finally does (its outputs are wrong by more than their size before and after the gap,
    and the effect does not become usual within a warm-up); and after every gap of a plant of index 2 or more, whose
    model cannot be propagated.  Intervals are rounded to the resolution of the time stamps.

    Recursive and nonlinear designs process missing outputs themselves, and the columns ``sd ...`` (standard deviations)
    show their effect.  A row without some outputs is ``partial``; one without all of them, or without an input, is a
    ``gap``.  The first row is k = 0, at which recursive designs do not use the outputs.  Missing inputs are held, and
    deviations grow according to the largest earlier changes of these inputs; the rows after that are ``recovering``
    until the warm-up is over.  ``r`` is the innovation at the parameters estimated one sample before (whitened, for
    recursive designs).

    Examples
    --------
    >>> import numpy as np
    >>> import pandas as pd
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> log = pd.DataFrame({"time": range(50), "y1": np.zeros(50), "y2": np.zeros(50)})
    >>> run = obsynth.run_on_data(design, log, thresholds={"fhat[f1]": 0.5})
    >>> run.rows, len(run.alarms)
    (50, 0)
    """
    whole_number(chunk_rows, "chunk_rows")
    whole_number(state_every, "state_every")
    _require_files(state=state, out=out, data=data)
    if time_column is not None:
        columns = {**(columns or {}), TIME_HEADER: time_column}
    stamps = Stamps(time_zone, time_unit)
    run = LogRun(
        design,
        columns,
        scales,
        gap=gap,
        warm_up=warm_up,
        outliers=outliers,
        thresholds=thresholds or {},
        monitor=monitor,
        recovered=recovered,
        stamps=stamps,
        units_as_is=units_as_is,
    )
    _smoothed(run, data, smooth=smooth, lag=lag, state=state)
    digest = gain_set_digest(design)
    resumed = state is not None and Path(state).exists()
    if resumed:
        resume_state(Path(str(state)), run, digest)
    data = data if isinstance(data, str | Path) or hasattr(data, "readline") else as_frame(data)
    room = len(data) if isinstance(data, Sized) and not isinstance(data, str) else CHUNK_ROWS
    measured = FrameSink((TIME_HEADER, *run.signals.names), stamps, room) if out is None else None
    # Output of a stream cannot be taken back, so that there the state is saved however the run ends.
    save = None
    if not (state is None or out is None or isinstance(out, str | Path)):
        save = partial(save_state, Path(state), run, digest)
    rows = _rows_to_run(data, run, stamps, chunk_rows, resumed=resumed)
    estimates = FrameSink(run.header, stamps, room)
    for file in (out, state):
        if isinstance(file, str | Path):
            remove_left_parts(Path(file))
    with nullcontext(estimates) if out is None else sink_for(out, run.header, stamps) as sink:
        _run_rows(run, rows, sink, measured, save, progress or bool, state_every)
        if state is None and not hasattr(data, "readline"):
            _require_a_window(design, run.rows)
            _require_estimates(run, stamps)
    if state is not None:
        save_state(Path(state), run, digest)
    return replace(
        _summary_of(run, design, digest, stamps, resumed=resumed),
        table=estimates.frame() if out is None else None,
        measured=None if measured is None else measured.frame(),
        thresholds=dict(thresholds or {}),
        statement="" if monitor is None else monitor.statement,
    )


def _rows_to_run(data: Data, run: LogRun, stamps: Stamps, chunk_rows: int, *, resumed: bool) -> Iterator[FloatArray]:
    """Return the rows of a log in chunks.

    The first chunk of a file is read at once, so that a header is only written if the file can be read.
    """
    # A followed log begins with the rows before the saved state, which may be many.
    after = run.clock.stamp if resumed and isinstance(data, FollowedLog) else None
    rows = chunks(data, run.signals, stamps, chunk_rows, after=after)
    # For a stream the header is written before the first row is read.
    return rows if hasattr(data, "readline") else chain(list(islice(rows, 1)), rows)


def _summary_of(run: LogRun, design: ObserverDesign, digest: str, stamps: Stamps, *, resumed: bool) -> DataRun:
    """Return the summary of a run that has ended: numbers of rows, alarms, outliers, stuck sensors and warnings."""
    runs_by_output = zip(run.observer.output_names, run.repeated.stuck(), strict=True)
    stuck = {name: tuple((first + 1, last + 1) for first, last in runs) for name, runs in runs_by_output if runs}
    start = () if resumed else run.first.alarm_of_the_start(design, run.events.events(), warm_up=run.observer.warm_up)
    return DataRun(
        rows=run.rows,
        statuses=dict(run.statuses),
        alarms=dict(run.alarms),
        isolated=run.isolated,
        recovered={} if run.recovered is None else dict(run.recovered.flags),
        outliers=dict(getattr(run.observer, "outliers", {})),
        warnings=(
            *run.observer.notes,
            *run.observer.warnings(),
            *stamps.warnings(),
            *run.first.warnings(),
            *stamps.measured.notes(run.signals.columns_and_signals(), run.signals.inputs),
            *start,
            *(() if resumed else _long_warm_up(run, design)),
            *stuck_texts(stuck),
            *(() if run.beyond is None else run.beyond.texts(run.rows)),
            *run.taken_for_usual(),
            *run.swinging(),
        ),
        digest=digest,
        stamps=stamps,
        alarm_rows=dict(run.alarm_rows),
        events=run.events.events(),
        silent=dict(run.events.silent),
        warm_up=run.observer.warm_up,
        stuck=stuck,
    )


def _long_warm_up(run: LogRun, design: ObserverDesign) -> tuple[str, ...]:
    """Return a text if a large share of the rows is warm-up."""
    rows = run.events.silent[WARM_UP]
    if not rows or rows < LONG_SHARE * run.rows:
        return ()
    cause = cause_of_warm_up(run.observer)
    if not cause:
        return ()
    guarantees = run.monitor is not None and run.monitor.guarantees
    advice = "" if guarantees else advice_on_warm_up(design, run.observer, [run.first.log_until(run.clock.stamp)])
    return (
        f"{rows} of {run.rows} rows have no decision, as the warm-up lasts {duration(run.observer.warm_up)}: {cause}. "
        f"{advice or 'Longer logs have decisions.'}",
    )


def _require_files(*, state: Any, out: Any, data: object) -> None:
    """Refuse arguments of `run_on_data` that name the same file, or one that cannot be written."""
    if out is not None and not hasattr(out, "write"):
        require_kind(out, (str, Path), "out", "the name of a file, or a text stream")
    require_distinct(
        {
            "state": state,
            "data": data if isinstance(data, str | Path) else None,
            "out": out if isinstance(out, str | Path) else None,
        }
    )
    if state is not None:
        check_output(state)


def _require_a_window(design: ObserverDesign, rows: int) -> None:
    """Raise `SpecError` if a log is shorter than the window of a guaranteed test, so that no row has a verdict."""
    if not is_guaranteed(design):
        return
    needed = max(map(rows_before, GuaranteedTest.of(design).tests)) + 1
    if rows < needed:
        raise SpecError(
            f"The log has {rows} rows, but a window of {design.name!r} has {needed} samples: none of them has a "
            "verdict. Design the test with fewer samples.",
            path="samples",
        )


def _require_estimates(run: LogRun, stamps: Stamps) -> None:
    """Raise `SpecError` if no row of a log has an estimate since one of its columns is empty."""
    empty = stamps.measured.empty(run.signals.columns_and_signals())
    if empty and not run.statuses.keys() - {GAP, *STALE}:
        column, signal = empty[0]
        raise SpecError(never_measured(column, signal), path=f"columns.{signal}")


def _smoothed(run: LogRun, data: Data, *, smooth: bool, lag: int | None, state: str | Path | None) -> None:
    """Add a smoother to the run if ``smooth`` or ``lag`` is given."""
    if not smooth and lag is None:
        return
    if smooth and lag is not None:
        raise SpecError("smooth takes the whole record, and lag some samples of it: give one of them.", path="lag")
    if smooth and hasattr(data, "readline"):
        raise SpecError("A stream has no end to smooth from: give a lag, or the log as a file.", path="smooth")
    if smooth and state is not None:
        raise SpecError(
            "smooth needs the whole record, but a saved state continues a part of it: give a lag, or "
            "leave the state out.",
            path="smooth",
        )
    run.later = LaterRows(run.observer, lag)


def _run_rows(
    run: LogRun,
    rows: Iterator[FloatArray],
    sink: Sink,
    measured: FrameSink | None,
    save: Callable[[], None] | None,
    progress: Callable[[int], object],
    state_every: int = STATE_ROWS,
) -> None:
    """Run over all rows: in chunks, or one by one where the state is to be saved after a stream."""
    held, is_whole = HeldSignals(), True
    if save is None:
        for chunk in rows:
            output_rows = run.take(chunk)  # refuses rows without a time
            if measured is not None:
                measured.keep([chunk[:, 0].tolist(), *run.signals.measured(chunk).T], len(chunk))
            sink(output_rows)
            progress(run.rows)
        sink(run.finish())
        return
    with ending_signals(), held.installed():
        try:
            for chunk in rows:
                for row in chunk:
                    with held:
                        is_whole = False
                        output_rows = run.take(row[None])
                        is_whole = True
                        sink(output_rows)
                        if run.rows % state_every == 0:
                            save()
                progress(run.rows)
        except ObsynthError:
            # A refused row has changed nothing.
            is_whole = True
            raise
        finally:
            if is_whole and run.rows:
                save()
                sink(run.finish())
