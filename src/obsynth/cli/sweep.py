"""The verb ``sweep``: specs and lists of values in, designs, one table and one picture out."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from obsynth.cli.arguments import add_force, add_json, add_quiet, output_file
from obsynth.cli.output import print_json, progress, stdout_console
from obsynth.errors import SpecError
from obsynth.files.inputs import input_file
from obsynth.files.outputs import FileKind, made_folder, write_together

if TYPE_CHECKING:
    from concurrent.futures import Executor

_SWEEP = "Design and verify for every combination of specs and values; what fails is a row of the table."
_HELP = """\
A value list is a YAML list: --set gamma='[0.1, 0.2]' --set plant.transform.sample_time='[0.01, 0.02]'
--set plant.C.outputs='[[omega 1], [omega 1, omega 2]]'.  A name that begins with no section of a spec is an option of
its method.  The folder keeps every gain set and result: the same command goes on where another was stopped.
"""
TABLE = FileKind("the table of a sweep", rb"\Acase,")
RUNS_TABLE = FileKind("the table of many runs", rb"\Arun,status,")
PICTURE = FileKind("a picture", rb"\A\x89PNG")


def add_sweep_verb(verbs: Any) -> None:
    """Add the parser."""
    parser = verbs.add_parser(
        "sweep", help=_SWEEP, description=_SWEEP, epilog=_HELP, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--system", type=Path, required=True, nargs="+", metavar="FILE", help="a spec (YAML), or several"
    )
    parser.add_argument(
        "--set", action="append", default=[], metavar="PATH=LIST", help="an entry of the specs and its values"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="for gain sets, results, table.csv")
    parser.add_argument("--claim", metavar="NAME", help="what the picture shows (default: the most frequent claim)")
    add_executors(parser)
    add_json(parser)
    add_force(parser)
    add_quiet(parser)
    parser.set_defaults(verb="sweep")


def add_executors(parser: argparse.ArgumentParser) -> None:
    """Add ``--jobs`` and ``--cluster``."""
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes (default: 1)")
    parser.add_argument("--cluster", metavar="ADDRESS", help="of the scheduler of a Dask cluster, instead of --jobs")


def run_sweep(options: argparse.Namespace) -> int:
    """Run ``sweep``; the exit code is 0 when every case was decided, whatever it came to."""
    if options.out.exists() and not options.out.is_dir():
        raise SpecError(f"{options.out} is no folder: give --out the name of one.", path="--out")
    listed = [_value_list(text) for text in options.set]
    parameters = dict(listed)
    if len(parameters) < len(listed):
        raise SpecError("Two lists of values (--set) are of the same entry: put them into one.", path="--set")
    for spec in options.system:
        input_file(Path(spec))  # what is designed for hours is not refused in the end
    with made_folder(options.out):
        return _swept(options, parameters)


def _swept(options: argparse.Namespace, parameters: dict[str, list[Any]]) -> int:
    """Run ``sweep`` in its folder."""
    from obsynth.sweeps.sweep import sweep

    table = output_file(options.out / "table.csv", TABLE, options)
    picture = output_file(options.out / "sweep.png", PICTURE, options)
    with progress(quiet=options.quiet) as report_stage, chosen_executor(options.jobs, options.cluster) as executor:
        found = sweep(
            options.system, parameters, executor=executor, folder=options.out,
            progress=lambda done, total: report_stage(f"{done} of {total} designs"),
        )  # fmt: skip
        contents: dict[Path, str | bytes] = {table: found.csv()}
        if any(result.claims for result in found.results):
            contents[picture] = _png_of(lambda: found.plot(options.claim))
        files = write_together(contents)
    if options.json:
        header, rows = found.rows()
        print_json({
            "command": "sweep", "counts": found.counts, "cases": [dict(zip(header, row, strict=True)) for row in rows],
            "files": [str(file) for file in files],
        })  # fmt: skip
        return 0
    console = stdout_console()
    console.print(_shown(found))
    console.print(f"Written: {', '.join(map(str, files))}", soft_wrap=True)
    return 0


def run_many(options: argparse.Namespace) -> int:
    """Run ``run`` for a folder of gain sets: a table, a picture, and the estimates of each design on each log."""
    alone = ("system", "state", "prove", "monitor", "smooth", "lag")
    given = [name for name in alone if getattr(options, name)]
    if given:
        names = ", ".join(f"--{name}" for name in given)
        raise SpecError(f"{names}: for one gain set; --gains is a folder of many.", path=f"--{given[0]}")
    folder = Path(options.out)
    if options.out == "-" or (folder.exists() and not folder.is_dir()):
        raise SpecError("Many designs need a folder for their estimates: give one to --out.", path="--out")
    with made_folder(folder):
        return _run_in(folder, options)


def _run_in(folder: Path, options: argparse.Namespace) -> int:
    """Run ``run`` for a folder of gain sets into a folder."""
    from obsynth.cli.data_run import numbers_of
    from obsynth.sweeps.fleet import run_fleet

    for path in (Path(options.gains), Path(options.data)):
        if path.is_file():
            input_file(path)  # what is read is never written, by force or not
    table = output_file(folder / "table.csv", RUNS_TABLE, options)
    picture = output_file(folder / "fleet.png", PICTURE, options)
    asked = {
        "columns": dict(options.map) or None, "time_column": options.time_column, "outliers": options.outliers,
        "scales": numbers_of(options.scale) or None, "thresholds": numbers_of(options.threshold) or None,
        "gap": options.gap, "warm_up": options.warm_up, "recovered": options.recovered,
    }  # fmt: skip
    with progress(quiet=options.quiet) as report_stage, chosen_executor(options.jobs, options.cluster) as executor:
        found = run_fleet(
            options.gains, options.data, folder, executor=executor,
            progress=lambda done, total: report_stage(f"{done} of {total} runs"),
            **{name: value for name, value in asked.items() if value is not None},
        )  # fmt: skip
        contents: dict[Path, str | bytes] = {table: found.csv()}
        if "run" in found.counts:
            contents[picture] = _png_of(found.plot)
        files = write_together(contents)
    if options.json:
        header, rows = found.rows()
        cases = [dict(zip(header, row, strict=True)) for row in rows]
        print_json({"command": "run", "counts": found.counts, "runs": cases, "files": [str(file) for file in files]})
    elif not options.quiet:
        stdout_console().print(_shown_runs(found))
        print(f"Written: {', '.join(map(str, files))}")
    return 0


@contextmanager
def chosen_executor(jobs: int, cluster: str | None) -> Iterator[Executor | None]:
    """Yield where work goes: nowhere else, processes, or a Dask cluster."""
    if jobs < 1:
        raise SpecError(f"--jobs is {jobs}: give a number of processes, 1 or more.", path="--jobs")
    if cluster is not None:
        from dask import distributed

        connect: Any = distributed.Client
        try:
            client = connect(cluster, timeout="10s")
        except OSError as error:
            raise SpecError(f"There is no Dask scheduler at {cluster}: {error}.", path="--cluster") from error
        with client:
            yield client.get_executor()
        return
    if jobs == 1:
        yield None
        return
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as executor:
        try:
            yield executor
        except BaseException:
            executor.shutdown(wait=False, cancel_futures=True)
            raise


def _value_list(text: str) -> tuple[str, list[Any]]:
    """Return the path and the values of ``PATH=LIST``."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    name, sign, listed = text.partition("=")
    try:
        values = YAML(typ="safe", pure=True).load(listed) if sign else None
    except (YAMLError, ValueError) as error:
        raise SpecError(f"--set {text}: {listed!r} is no YAML list.", path="--set") from error
    if not name or not isinstance(values, list):
        raise SpecError(f"--set {text!r}: give PATH=[value, value, ...].", path="--set")
    return name.strip(), values


def _png_of(plot: Callable[[], Any]) -> bytes:
    import io

    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, stream = plot(), io.BytesIO()
    figure.savefig(stream, format="png", dpi=150)
    plt.close(figure)
    return stream.getvalue()


def _shown(found: Any) -> Any:
    """Return the table for people: without message and file."""
    from rich.table import Table

    header, rows = found.rows()
    kept = [i for i, name in enumerate(header) if name not in ("message", "file")]
    table = Table(title=", ".join(f"{count} {status}" for status, count in found.counts.items()), title_justify="left")
    for i in kept:
        table.add_column(header[i], overflow="fold")
    for row in rows:
        table.add_row(*(f"{row[i]:.4g}" if isinstance(row[i], float) else str(row[i]) for i in kept))
    return table


def _shown_runs(found: Any) -> Any:
    """Return the table of runs for people: the first alarm of each, and why one was not made."""
    from rich.table import Table

    table = Table(title=", ".join(f"{count} {status}" for status, count in found.counts.items()), title_justify="left")
    for name in ("run", "status", "rows", "ok", "first alarm", "why not"):
        table.add_column(name)
    for run in found.runs:
        first = min(run.alarms, key=lambda name: run.alarms[name], default="")
        alarm = f"{first} at {run.alarms[first]:g} s" if first else "-"
        table.add_row(run.name, run.status, str(run.rows), str(run.statuses.get("ok", 0)), alarm, run.message)
    return table
