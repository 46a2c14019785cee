"""The verb ``sweep``, and ``run`` for a folder of gain sets: one table and one picture of many cases."""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from obsynth.errors import SpecError
from obsynth.files.inputs import input_file
from obsynth.files.outputs import FileKind, made_folder, write_together
from obsynth.methods.registry import REGISTRY, method_class
from obsynth.monitoring.verbs.arguments import MONITOR_NAMES
from obsynth.numerics.suggestions import there_are
from obsynth.report.terminal.arguments import STREAM, numbers_of, refuse_given
from obsynth.report.terminal.output import output_file, print_json, stdout_console
from obsynth.report.terminal.stages import progress
from obsynth.specs.documents import read_yaml
from obsynth.studies.printed_cases import printed_cases, printed_runs

PICTURE = FileKind("a picture", rb"\A\x89PNG")

#: With more designs a sweep uses all processors; starting a process takes as long as several small designs.
FEW_DESIGNS = 10

#: Limit of Windows on the processes of an executor.
MOST_PROCESSES = 61


def run_sweep(options: argparse.Namespace) -> int:
    """Run ``sweep``; the exit code is 2 if all cases are malformed, else 0, whatever the results are."""
    from obsynth.studies.sweep import sweep
    from obsynth.studies.work import WORK_STATUSES

    if options.out.exists() and not options.out.is_dir():
        raise SpecError(f"{options.out} is no folder: give --out the name of one.", path="--out")
    listed = [_value_list(text) for text in options.set]
    parameters = dict(listed)
    if len(parameters) < len(listed):
        raise SpecError("Two lists of values (--set) are of the same entry: put them into one.", path="--set")
    for spec in options.system:
        input_file(Path(spec))  # an output that would overwrite it is refused now, and not after hours of work
    _require_claim(options, parameters)

    def work(executor: Executor | None, done: Callable[[int, int], None]) -> Any:
        return sweep(options.system, parameters, executor=executor, folder=options.out, progress=done)

    def draw(designed: Any) -> Any:
        claims = {name for result in designed.results for name in result.claims}
        if options.claim is not None and options.claim not in claims:
            known = there_are(options.claim, sorted(claims))
            print(
                f"Warning: no picture is written, as no design claims {options.claim!r}; {known}",
                file=sys.stderr,
            )
            return None
        return designed.plot(options.claim) if claims else None

    table = FileKind("the table of a sweep", rb"\Acase,")
    jobs = options.jobs
    if jobs is None and options.cluster is None:
        jobs = usual_jobs(len(options.system) * math.prod(map(len, parameters.values())))
    outcome, files = _carried_out(options, options.out, ("designs", table, "sweep.png"), work, draw, jobs=jobs)
    _print_outcome(options, outcome, files, "cases")
    malformed = WORK_STATUSES[SpecError.exit_code]
    return SpecError.exit_code if all(result.status == malformed for result in outcome.results) else 0


def _require_claim(options: argparse.Namespace, parameters: dict[str, list[Any]]) -> None:
    """Raise `SpecError` for a claim that no method of a sweep makes, before anything is designed."""
    if options.claim is None:
        return
    methods = list(parameters.get("method.id", ()))
    for section in parameters.get("method", [read_yaml(Path(spec)).get("method") for spec in options.system]):
        methods.append(section.get("id") if isinstance(section, dict) else None)
    # Where a case chooses its method itself, all methods are possible.
    known = REGISTRY if any(method not in REGISTRY for method in methods) else methods
    claims = sorted({claim for method in known for claim in method_class(method).claims})
    if options.claim not in claims:
        raise SpecError(
            f"No method of this sweep claims {options.claim!r}: give --claim one of {', '.join(claims)}.",
            path="--claim",
        )


def run_many(options: argparse.Namespace) -> int:
    """Run ``run`` for a folder of gain sets: write a table, a picture, and the estimates of each design on each log."""
    from obsynth.studies.fleet import run_fleet

    alone = ("system", "state", "prove", "smooth", "lag")
    refused = [name for name in alone if getattr(options, name)]
    if refused:
        names = ", ".join(f"--{name}" for name in refused)
        raise SpecError(f"{names}: for one gain set; --gains is a folder of many.", path=f"--{refused[0]}")
    of_each = ("normal", "no_sensor_faults")
    monitor_names = [name for name in MONITOR_NAMES if name not in of_each]
    refuse_given(options, ("state_every", "sample_time", *monitor_names), "one gain set: --gains is a folder of many")
    if options.monitor is None:
        refuse_given(options, of_each, "a monitor: name it with --monitor")
    folder = Path(options.out)
    if options.out == STREAM or (folder.exists() and not folder.is_dir()):
        raise SpecError("Many designs need a folder for their estimates: give one to --out.", path="--out")

    for path in (Path(options.gains), Path(options.data)):
        if path.is_file():
            input_file(path)  # registered, so that no output overwrites it, not even with --force
    settings = {
        "columns": dict(options.map) or None,
        "time_column": options.time_column,
        "time_zone": options.time_zone,
        "time_unit": options.time_unit,
        "outliers": options.outliers,
        "units_as_is": options.units_as_is or None,
        "monitor": options.monitor,
        "normal": options.normal,
        "sensor_faults": False if options.no_sensor_faults else None,
        "scales": numbers_of(options.scale) or None,
        "thresholds": numbers_of(options.threshold) or None,
        "gap": options.gap,
        "warm_up": options.warm_up,
        "recovered": options.recovered,
        "unverified": options.unverified or None,
    }

    def work(executor: Executor | None, done: Callable[[int, int], None]) -> Any:
        stated = {name: value for name, value in settings.items() if value is not None}
        return run_fleet(options.gains, options.data, folder, executor=executor, progress=done, **stated)

    table = FileKind("the table of many runs", rb"\Arun,status,")
    fleet, files = _carried_out(
        options,
        folder,
        ("runs", table, "fleet.png"),
        work,
        lambda fleet: fleet.plot() if "run" in fleet.counts else None,
        jobs=options.jobs,
    )
    if options.json or not options.quiet:
        _print_outcome(options, fleet, files, "runs")
    return 0


def _carried_out(
    options: argparse.Namespace,
    folder: Path,
    named: tuple[str, FileKind, str],
    work: Callable[[Executor | None, Callable[[int, int], None]], Any],
    draw: Callable[[Any], Any],
    *,
    jobs: int | None,
) -> tuple[Any, tuple[Path, ...]]:
    """Return the result of ``work``, and the files of its table and picture; after an error no new folder is left."""
    unit, kind, picture_name = named
    with made_folder(folder):
        table = output_file(folder / "table.csv", kind, options)
        picture = output_file(folder / picture_name, PICTURE, options)
        with progress(quiet=options.quiet) as report_stage, chosen_executor(jobs, options.cluster) as executor:
            outcome = work(executor, lambda done, total: report_stage(f"{done} of {total} {unit}"))
            contents: dict[Path, str | bytes] = {table: outcome.csv()}
            image = _png_of(lambda: draw(outcome))
            if image is not None:
                contents[picture] = image
            return outcome, write_together(contents)


def _print_outcome(options: argparse.Namespace, outcome: Any, files: tuple[Path, ...], unit: str) -> None:
    """Print the table of a sweep or of many runs, and the files."""
    header, rows = outcome.rows()
    if options.json:
        cases = [dict(zip(header, row, strict=True)) for row in rows]
        print_json({"command": options.verb, "counts": outcome.counts, unit: cases, "files": [str(f) for f in files]})
        return
    console = stdout_console()
    printed = printed_cases if unit == "cases" else printed_runs
    console.print(printed(outcome, console.width, rest="table.csv"))
    if unit == "cases":
        for case, status, message in _first_failures([dict(zip(header, row, strict=True)) for row in rows]):
            console.print(f"{case}: {status}: {message}", soft_wrap=True, markup=False, highlight=False)
    console.print(f"Written: {', '.join(map(str, files))}", soft_wrap=True)


def _first_failures(cases: Sequence[Mapping[str, Any]]) -> list[tuple[str, str, str]]:
    """Return the first case of each kind of failure, with its status and the reason."""
    firsts: dict[str, tuple[str, str, str]] = {}
    for case in cases:
        if case["message"]:
            firsts.setdefault(case["status"], (case["case"], case["status"], str(case["message"])))
    return list(firsts.values())


def usual_jobs(count: int) -> int:
    """Return the default number of processes for ``count`` designs: one for few, else one for each processor."""
    return 1 if count <= FEW_DESIGNS else min(usable_processors(), MOST_PROCESSES)


def usable_processors() -> int:
    """Return how many processors this process may use."""
    # sched_getaffinity does not exist on every platform.
    allowed = getattr(os, "sched_getaffinity", None)
    return len(allowed(0)) if allowed is not None else os.cpu_count() or 1


@contextmanager
def chosen_executor(jobs: int | None, cluster: str | None) -> Iterator[Executor | None]:
    """Yield the executor of the work: `None` for this process, a pool of processes, or a Dask cluster."""
    if jobs is not None and cluster is not None:
        raise SpecError("--jobs and --cluster are two places for the work: give one of them.", path="--jobs")
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
    if jobs in (None, 1):
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


def _png_of(plot: Callable[[], Any]) -> bytes | None:
    import matplotlib

    from obsynth.report.plots.panels import written

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure = plot()
    if figure is None:
        return None
    picture = written(figure)
    plt.close(figure)
    return picture
