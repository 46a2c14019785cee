"""Many designs on many logs: every gain set of a folder on its logs, on any executor."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from obsynth.errors import ObsynthError, SpecError
from obsynth.files.inputs import input_file
from obsynth.methods.verifying import verify
from obsynth.monitoring.logs.run import DataRun, run_on_data
from obsynth.monitoring.logs.sources import LOG_SUFFIXES
from obsynth.monitoring.logs.unpacked_logs import log_suffix
from obsynth.monitoring.thresholds.online_monitor import online_monitor
from obsynth.numerics.arguments import arguments_checked, require_kind
from obsynth.report.plots.panels import tidy
from obsynth.results.design import ObserverDesign, require_verified
from obsynth.results.gain_sets import load
from obsynth.studies.work import WORK_STATUSES, ResultFolder, ResultTable, Work, all_of, carried_out
from obsynth.verification.assumptions import file_digest
from obsynth.version import __version__

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_FLEET_KIND = "obsynth fleet result"

#: What ends the name of a gain set.
GAINS_ENDING = ".gains.json"

#: Runs that a picture shows.
MOST_SHOWN = 12


@dataclass(frozen=True)
class FleetRun:
    """One design on one log.

    Parameters
    ----------
    name : str
        ``design on log``, by the names of their files.
    status : str
        ``run``, or ``malformed`` and its like where the design could not be run on the log.
    message : str
        Why not; empty otherwise.
    rows : int
        Rows of data.
    statuses : mapping of str to int
        How many rows were ``ok``, ``warm-up``, ``partial``, ``gap`` and ``recovering``.
    alarms : mapping of str to float
        Time in seconds at which each column first passed its threshold.
    largest : mapping of str to float
        Largest absolute value of each fault estimate and residual, the warm-up left out.
    file : Path or None
        The estimates.
    fault : str
        What the first alarm of a monitor that names a fault points to; empty without one.

    Examples
    --------
    >>> import obsynth
    >>> from tempfile import TemporaryDirectory
    >>> import pandas as pd
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> with TemporaryDirectory() as folder:
    ...     _ = design.save(f"{folder}/a.gains.json")
    ...     pd.DataFrame({"time": range(20), "y1": 0.0, "y2": 0.0}).to_csv(f"{folder}/log.csv", index=False)
    ...     run = obsynth.run_fleet(f"{folder}/a.gains.json", f"{folder}/log.csv", f"{folder}/results").runs[0]
    >>> run.rows, dict(run.alarms)
    (20, {})
    """

    name: str
    status: str
    message: str = ""
    rows: int = 0
    statuses: Mapping[str, int] = field(default_factory=dict)
    alarms: Mapping[str, float] = field(default_factory=dict)
    largest: Mapping[str, float] = field(default_factory=dict)
    file: Path | None = None
    fault: str = ""


@dataclass(frozen=True)
class Fleet(ResultTable):
    """All runs of a fleet, in the order of designs and logs.

    Parameters
    ----------
    runs : tuple of FleetRun
        One for each design and log.

    Examples
    --------
    >>> import obsynth
    >>> from tempfile import TemporaryDirectory
    >>> import pandas as pd
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> with TemporaryDirectory() as folder:
    ...     _ = design.save(f"{folder}/a.gains.json")
    ...     pd.DataFrame({"time": range(20), "y1": 0.0, "y2": 0.0}).to_csv(f"{folder}/log.csv", index=False)
    ...     fleet = obsynth.run_fleet(f"{folder}/a.gains.json", f"{folder}/log.csv", f"{folder}/results")
    >>> len(fleet), fleet.runs[0].status
    (1, 'run')
    """

    runs: tuple[FleetRun, ...]

    def __repr__(self) -> str:
        """Return the table as text."""
        from obsynth.results.layout import printed
        from obsynth.studies.printed_cases import printed_runs

        return printed(lambda console: console.print(printed_runs(self, console.width, rest="table()")))

    @property
    def _results(self) -> Sequence[FleetRun]:
        return self.runs

    def rows(self) -> tuple[list[str], list[list[Any]]]:
        """Return the table as a header and rows: one column for each alarm and each largest value of any run."""
        alarms = all_of(run.alarms for run in self.runs)
        largest = all_of(run.largest for run in self.runs)
        named = ["fault"] if any(run.fault for run in self.runs) else []
        header = [
            "run",
            "status",
            "rows",
            "ok",
            *(f"alarm {n}, s" for n in alarms),
            *named,
            *(f"largest {n}" for n in largest),
            "file",
            "message",
        ]
        body = [
            [
                run.name,
                run.status,
                run.rows,
                run.statuses.get("ok", 0),
                *(run.alarms.get(n, "") for n in alarms),
                *(run.fault for _ in named),
                *(run.largest.get(n, "") for n in largest),
                "" if run.file is None else run.file.name,
                run.message,
            ]
            for run in self.runs
        ]
        return header, body

    def plot(self) -> Figure:
        """Draw the estimates (of residual filters the residuals) of the first runs over time, one panel each."""
        import matplotlib.pyplot as plt
        import pandas as pd

        drawn = [(run, run.file) for run in self.runs if run.file is not None][:MOST_SHOWN]
        if not drawn:
            raise SpecError("No design was run on any log: there is nothing to draw.", path="runs")
        figure, axes = plt.subplots(
            len(drawn), 1, figsize=(8.0, 1.2 + 1.3 * len(drawn)), squeeze=False, layout="constrained"
        )
        for axis, (run, file) in zip(axes[:, 0], drawn, strict=True):
            table = pd.read_csv(file)
            times = table["time"] if pd.api.types.is_numeric_dtype(table["time"]) else np.arange(len(table))
            estimates = [name for name in run.largest if not name.startswith("r[")]
            for name in estimates or run.largest:
                axis.plot(times, table[name], label=name, linewidth=0.9)
            for alarm in run.alarms.values():
                axis.axvline(alarm, color="0.4", linestyle="--", linewidth=0.8)
            axis.set_title(run.name, fontsize=9, loc="left", parse_math=False)
            if axis.get_legend_handles_labels()[0]:  # rows of warm-up alone show nothing
                axis.legend(fontsize=7, loc="upper left")
            axis.tick_params(labelsize=8)
            tidy(axis)
        axes[-1, 0].set_xlabel("time, s", fontsize=9)
        return figure


@arguments_checked
def run_fleet(
    gains: str | Path | Sequence[str | Path],
    data: str | Path | Sequence[str | Path],
    folder: str | Path,
    *,
    executor: Executor | None = None,
    progress: Callable[[int, int], None] | None = None,
    **options: Any,
) -> Fleet:
    """Run many designs on many logs: here, on processes, or on a cluster; results are the same everywhere.

    A log with the name of a gain set (``pump.csv`` beside ``pump.gains.json``) is for that one alone; every other log
    is for every gain set, so that one stream can be watched by many designs.  The folder keeps estimates and results:
    the same call continues one that was interrupted.

    Parameters
    ----------
    gains : path or sequence of paths
        Gain sets, or folders of them (``*.gains.json``).
    data : path or sequence of paths
        Logs as for `run_on_data`, or folders of them.
    folder : path
        For the estimates (CSV) and results.
    executor : concurrent.futures.Executor, optional
        Processes, threads, or ``dask.distributed.Client(...).get_executor()``; workers must see the files.
    progress : callable, optional
        Called with the number of runs done and their total.
    **options
        As for `run_on_data`: ``columns, time_column, time_zone, time_unit, scales, thresholds, gap, warm_up,
        recovered, outliers, units_as_is``; and ``unverified``: whether designs that fail their verification are run
        all the same.  ``monitor``: the kind of a monitor of `online_monitor` that needs nothing but the design, such as
        ``nis``; or ``learned``, with ``normal``: a folder of thresholds, each called as its gain set (``pump.json``
        for ``pump.gains.json``), a file of thresholds, or a log without faults from which each design learns its own;
        ``sensor_faults`` as there.

    Returns
    -------
    Fleet
        One row for each run; a log that does not fit a design is a row that says why.

    Raises
    ------
    SpecError
        There is no gain set or no log, an option is unknown, or the folder cannot be used.

    Examples
    --------
    >>> import numpy as np
    >>> import pandas as pd
    >>> import obsynth
    >>> from tempfile import TemporaryDirectory
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> with TemporaryDirectory() as folder:
    ...     _ = obsynth.fault_estimation_filter(plant).save(f"{folder}/a.gains.json")
    ...     log = pd.DataFrame({"time": range(50), "y1": np.zeros(50), "y2": np.zeros(50)})
    ...     log.to_csv(f"{folder}/log.csv", index=False)
    ...     fleet = obsynth.run_fleet(f"{folder}/a.gains.json", f"{folder}/log.csv", f"{folder}/found")
    ...     print(len(fleet))
    1
    """
    known = (
        *("columns", "time_column", "time_zone", "time_unit", "scales", "thresholds", "gap", "warm_up", "recovered"),
        "outliers",
        "units_as_is",
        "unverified",
        *("monitor", "normal", "sensor_faults"),
    )
    wrong = sorted(set(options) - set(known))
    if wrong:
        raise SpecError(f"{', '.join(wrong)}: use some of {', '.join(known)}.", path=wrong[0])
    if options.get("normal") is not None:
        if options.get("monitor") != "learned":
            raise SpecError("normal is for the monitor learned: name it (monitor, --monitor).", path="normal")
        options["normal"] = Path(options["normal"])
    pairs = _pairs(_files(gains, (GAINS_ENDING,), "gains"), _files(data, LOG_SUFFIXES, "data"), options)
    place = ResultFolder(folder, _FLEET_KIND, FleetRun, ending=".csv")
    return Fleet(
        carried_out(
            pairs,
            _run,
            executor=executor,
            progress=progress,
            known=place.known,
            keep=lambda pair, outcome: place.keep(pair, *outcome),
        )
    )


def _files(paths: Any, endings: tuple[str, ...], argument: str) -> list[Path]:
    listed = [paths] if isinstance(paths, (str, Path)) else list(paths)
    for name in listed:
        require_kind(name, (str, Path), argument, "names of files or of folders")
    files: list[Path] = []
    for path in map(Path, listed):
        files += sorted(p for p in path.iterdir() if p.name.endswith(endings)) if path.is_dir() else [path]
    if not files:
        raise SpecError(f"{', '.join(map(str, listed))}: there is no file *{' or *'.join(endings)}.", path=argument)
    missing = [str(path) for path in files if not path.is_file()]
    if missing:
        raise SpecError(f"{', '.join(missing)}: no such file.", path=argument)
    return files


def _pairs(gains: Sequence[Path], logs: Sequence[Path], options: Mapping[str, Any]) -> list[Work]:
    names = {path: path.name.removesuffix(GAINS_ENDING).removesuffix(".json") for path in gains}
    digests = {path: file_digest(input_file(path)) for path in (*gains, *logs)}
    called = {log: log.name[: -len(log_suffix(log))] for log in logs}
    own = {log: name for log, name in called.items() if name in names.values()}
    settings = json.dumps(options, sort_keys=True, default=str)
    if options.get("normal") is not None:
        # Thresholds that were learned anew are others.
        normal = options["normal"]
        files = sorted(normal.glob("*.json")) if normal.is_dir() else [normal]
        settings += "".join(file_digest(input_file(file)) for file in files)
    return [
        Work(
            f"{names[gain]} on {called[log]}",
            hashlib.sha256(f"{__version__} {digests[gain]} {digests[log]} {settings}".encode()).hexdigest(),
            partial(_estimates, gain, log, **options),
        )
        for gain in gains
        for log in logs
        if own.get(log, names[gain]) == names[gain]
    ]


@lru_cache(maxsize=1)
def _verified(path: Path, digest: str, *, unverified: bool) -> ObserverDesign:
    """Return a design that was verified once for all its logs; ``digest`` is that of its file."""
    design = load(path)
    require_verified(design.replace(report=verify(design)), unverified=unverified)
    return design


def _estimates(gains: Path, log: Path, *, unverified: bool = False, **options: Any) -> tuple[DataRun, str]:
    """Return the run of a design on a log, and its estimates as CSV."""
    stream, design = io.StringIO(), _verified(gains, file_digest(gains), unverified=bool(unverified))
    monitor_options = {name: options.pop(name) for name in ("monitor", "normal", "sensor_faults") if name in options}
    kind, normal = monitor_options.pop("monitor", None), monitor_options.get("normal")
    if kind is not None:
        if normal is not None and normal.is_dir():
            monitor_options["normal"] = normal / f"{gains.name.removesuffix(GAINS_ENDING).removesuffix('.json')}.json"
        options["monitor"] = online_monitor(design, kind, unverified=bool(unverified), **monitor_options)
    return run_on_data(design, log, stream, **options), stream.getvalue()


def _run(pair: Work) -> tuple[FleetRun, str]:
    """Return what a run comes to, and its estimates as CSV; errors of the package are results."""
    try:
        data_run, text = pair.make()
    except ObsynthError as error:
        return FleetRun(pair.name, WORK_STATUSES[error.exit_code], str(error)), ""
    return FleetRun(
        pair.name, "run", "", data_run.rows, dict(data_run.statuses), dict(data_run.alarms), _largest(text),
        fault=data_run.isolated,
    ), text  # fmt: skip


def _largest(text: str) -> dict[str, float]:
    """Return the largest absolute value of each fault estimate and residual after the warm-up."""
    import pandas as pd

    table = pd.read_csv(io.StringIO(text))
    settled = table if "status" not in table else table[table["status"] != "warm-up"]
    chosen = [name for name in table.columns if name.startswith(("fhat[", "r["))]
    values = {name: pd.to_numeric(settled[name], errors="coerce").abs().max() for name in chosen}
    return {name: float(value) for name, value in values.items() if np.isfinite(value)}
