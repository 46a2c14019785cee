"""Many designs at once: specs or plants, operating points, sensor sets and options, on any executor.

Much work on any executor: the cases of a sweep with digests of all they read, results kept in a folder, tables.

Many designs on many logs: every gain set of a folder on the logs that are for it, on any executor.
"""

from __future__ import annotations

import hashlib
import io
import itertools
import json
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar, cast, get_args

import numpy as np

from obsynth.data.run import DataRun, run_on_data
from obsynth.errors import ObsynthError, SpecError, a_kind
from obsynth.experiments.assumptions import file_digest
from obsynth.files.outputs import input_file, write_atomically
from obsynth.files.tables import table_writer
from obsynth.methods.designing import design
from obsynth.methods.registry import Plant
from obsynth.methods.verifying import verify
from obsynth.numerics.arguments import FloatArray, arguments_checked, require_kind
from obsynth.observers.progress import RunsProgress, as_they_come, progress_of_runs
from obsynth.plants.descriptor import DescriptorSystem, index_of
from obsynth.plotting.panels import tidy
from obsynth.results.design import (
    RESULT_VERSION,
    ObserverDesign,
    gain_set_bytes,
    load,
    loaded,
    opened,
    plain,
    require_verified,
    restored,
    sealed,
)
from obsynth.spec.loader import changed_document, design_of_spec, read_yaml, spec_of
from obsynth.version import __version__

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

#: Keys of a spec; a parameter that begins with none of them is an option of the method.
_SECTIONS = ("plant", "method", "scenario", "name", "description")
#: What a section ``plant`` may hold beside a reference to a file; everything else is changed in that file.
_REFERENCE = ("file", "transform")
#: More cases than this are taken for a slip.
MOST_CASES = 100_000


@dataclass(frozen=True, eq=False)
class Work:
    """A piece of work, which may be done in another process."""

    name: str
    key: str  # digest of all that the result depends on
    make: Callable[[], Any]
    parameters: Mapping[str, Any] = field(default_factory=dict)  # what a sweep puts in place, by name


def spec_cases(specs: Sequence[Path], parameters: Mapping[str, Sequence[Any]], version: str) -> list[Work]:
    """Return a design to be made for each spec and each combination of values."""
    cases: list[Work] = []
    stems = [path.stem if [other.stem for other in specs].count(path.stem) == 1 else str(path) for path in specs]
    for path, stem in zip(specs, stems, strict=True):
        document = read_yaml(path)
        for chosen in _combinations(parameters, len(specs)):
            own, of_plant = _sorted_out(document, chosen)
            changed = changed_document(document, own)
            name, digest = _named(stem, chosen), _digest(version, changed, of_plant, path)
            cases.append(Work(name, digest, partial(_case_of_spec, name, path, changed, of_plant), chosen))
    return _distinct(cases)


def _case_of_spec(
    name: str, path: Path, document: Mapping[str, Any], plant_changes: Mapping[str, Any]
) -> ObserverDesign:
    """Return the design of a spec, and of changes to the plant in the file that it refers to."""
    return design_of_spec(spec_of(document, path, plant_changes=plant_changes), name=name)


def plant_cases(
    plants: Mapping[str, Plant], method: str, parameters: Mapping[str, Sequence[Any]], version: str
) -> list[Work]:
    """Return a design to be made for each plant and each combination of values: of its fields (``plant.C``) or of
    options."""
    cases: list[Work] = []
    for stem, plant in plants.items():
        for chosen in _combinations(parameters, len(plants)):
            changes = {key.removeprefix("plant."): value for key, value in chosen.items() if key.startswith("plant.")}
            options = {
                key.removeprefix("method.options."): value
                for key, value in chosen.items()
                if not key.startswith("plant.")
            }
            if changes and not isinstance(plant, DescriptorSystem):
                raise SpecError(f"Fields of {a_kind(plant)} cannot be varied in a sweep.", path="parameters")
            varied = _varied(plant, changes) if changes and isinstance(plant, DescriptorSystem) else plant
            written = varied.dense() if isinstance(varied, DescriptorSystem) else varied
            body = json.dumps(plain([version, method, options, written.as_dict()]), sort_keys=True)
            name, digest = _named(stem, chosen), hashlib.sha256(body.encode()).hexdigest()
            cases.append(Work(name, digest, partial(design, varied, method, name=name, **options), chosen))
    return _distinct(cases)


def _varied(plant: DescriptorSystem, changes: Mapping[str, Any]) -> DescriptorSystem:
    """Return a plant with some fields changed; ``outputs`` picks some of its own by name."""
    changes = dict(changes)
    if "outputs" in changes:
        picked = changes.pop("outputs")
        names = [picked] if isinstance(picked, str) else list(picked)
        rows = [index_of(name, plant.output_names, what="The plant") for name in names]
        for name in ("C", "D", "Df", "Dd", "Dw"):
            changes.setdefault(name, getattr(plant, name)[rows])
        changes.setdefault("output_names", names)
    unknown = sorted(set(changes) - {item.name for item in fields(plant)})
    if unknown:
        raise SpecError(f"A plant has no field {', '.join(map(repr, unknown))}.", path=f"parameters.plant.{unknown[0]}")
    return plant.replace(**changes)


def _combinations(parameters: Mapping[str, Sequence[Any]], sources: int) -> Iterator[dict[str, Any]]:
    count = sources
    for name, values in parameters.items():
        require_kind(name, str, f"The parameter {name!r}", "its name", path="parameters")
        if isinstance(values, (str, Mapping)) or not isinstance(values, Sequence) or not len(values):
            raise SpecError(f"The parameter {name!r} is {values!r}: give a list of values.", path=f"parameters.{name}")
        count *= len(values)
    if count > MOST_CASES:
        raise SpecError(f"The sweep has {count} cases, more than {MOST_CASES}: give fewer values.", path="parameters")
    for values in itertools.product(*parameters.values()):
        yield dict(zip(parameters, values, strict=True))


def _sorted_out(document: Mapping[str, Any], chosen: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the changes to a spec, and those to the plant in the file that it refers to."""
    plant = document.get("plant")
    by_reference = isinstance(plant, Mapping) and "file" in plant
    own, of_plant = {}, {}
    for path, value in chosen.items():
        first, _, rest = path.partition(".")
        if first not in _SECTIONS:
            own[f"method.options.{path}"] = value
        elif first == "plant" and by_reference and rest.partition(".")[0] not in _REFERENCE:
            of_plant[rest] = value
        else:
            own[path] = value
    return own, of_plant


def _digest(version: str, document: Mapping[str, Any], plant_changes: Mapping[str, Any], source: Path) -> str:
    """Return the digest of a changed spec and of every file that it refers to."""
    found = hashlib.sha256(version.encode())

    def read(part: Any, folder: Path) -> None:
        found.update(json.dumps(part, sort_keys=True, default=str).encode())
        for name in _files_in(part):
            file = folder / name
            found.update(input_file(file, where=name).read_bytes())
            if file.suffix.lower() in (".yaml", ".yml"):
                read(changed_document(read_yaml(file), plant_changes), file.parent)

    read([document, plant_changes], source.parent)
    return found.hexdigest()


def _files_in(part: Any) -> Iterator[str]:
    """Return every ``file`` in nested data."""
    if isinstance(part, Mapping):
        if isinstance(part.get("file"), str):
            yield part["file"]
        for value in part.values():
            yield from _files_in(value)
    elif isinstance(part, list):
        for value in part:
            yield from _files_in(value)


def _named(stem: str, chosen: Mapping[str, Any]) -> str:
    said = [f"{path.rpartition('.')[2]} = {_said(value)}" for path, value in chosen.items()]
    return ", ".join([stem, *said])


def _said(value: Any) -> str:
    text = f"{value:g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 40 else f"{text[:36]} ..."


def _distinct(cases: list[Work]) -> list[Work]:
    """Return the cases without repetitions: the same design is made once."""
    return list({case.key: case for case in reversed(cases)}.values())[::-1]


#: What a piece of work came to, by the exit code of its error.
WORK_STATUSES = {0: "designed", 2: "malformed", 3: "impossible", 4: "infeasible", 5: "unknown", 6: "unverified"}
#: Digits of the digest of a piece of work in the names of its files.
DIGEST_DIGITS = 16
#: Letters of its name there.
LONGEST_STEM = 60
_Outcome = TypeVar("_Outcome")
_Result = TypeVar("_Result")


class ResultTable(ABC):
    """Results with a row each."""

    @property
    @abstractmethod
    def _found(self) -> Sequence[Any]:
        """The results, each with a status."""

    def __len__(self) -> int:
        return len(self._found)

    @property
    def counts(self) -> dict[str, int]:
        """Number of results by what they came to."""
        found = [result.status for result in self._found]
        return {status: found.count(status) for status in ("run", *WORK_STATUSES.values()) if status in found}

    @abstractmethod
    def rows(self) -> tuple[list[str], list[list[Any]]]:
        """Return the header and the rows of the table; what does not apply is empty."""

    def table(self) -> pd.DataFrame:
        """Return the table as a data frame."""
        import pandas as pd

        header, rows = self.rows()
        return pd.DataFrame(rows, columns=header)

    def csv(self) -> str:
        """Return the table as CSV."""
        header, rows = self.rows()
        stream = io.StringIO()
        table_writer(stream, header)(rows)
        return stream.getvalue()


def all_of(mappings: Iterable[Mapping[str, Any]]) -> list[str]:
    """Return every key once, in order of appearance."""
    return list(dict.fromkeys(name for mapping in mappings for name in mapping))


def carried_out(
    items: Sequence[Work],
    work: Callable[[Work], _Outcome],
    *,
    executor: Executor | None,
    known: Callable[[Work], _Result | None],
    kept: Callable[[Work, _Outcome], _Result],
    told: Callable[[int, int], object] | None,
    at_start: bool = False,
) -> tuple[_Result, ...]:
    """Return the result of every item, in order; ``known`` ones are not worked on, others ``kept`` as they come."""
    found = {i: result for i, item in enumerate(items) if (result := known(item)) is not None}
    waiting = [i for i in range(len(items)) if i not in found]
    if told is not None and at_start:
        told(len(found), len(items))
    for place, outcome in as_they_come(work, [items[i] for i in waiting], executor):
        found[waiting[place]] = kept(items[waiting[place]], outcome)
        if told is not None:
            told(len(found), len(items))
    return tuple(found[i] for i in range(len(items)))


class ResultFolder(Generic[_Result]):
    """Results of pieces of work with a name and a digest each, and what they made: two files of a folder for each.

    The fields of a result but ``file`` and ``content`` are kept; what was made has the name that ``ending`` ends.
    """

    def __init__(self, folder: str | Path, kind: str, record: type[_Result], *, ending: str) -> None:
        self.folder, self.kind, self.ending = Path(folder), kind, ending
        self.record = cast(Any, record)
        self.fields = [item.name for item in fields(self.record) if item.name not in ("file", "content")]
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else error  # a name with the character zero
            raise SpecError(f"{folder!s:.60} cannot be used as a folder: {reason}.", path=str(folder)) from error

    def _file(self, item: Work, ending: str) -> Path:
        """Return a file of a piece of work: its name in letters that every file may have, and its digest."""
        stem = "".join(letter if letter.isalnum() or letter in "-_." else "-" for letter in item.name)[:LONGEST_STEM]
        return self.folder / f"{stem}-{item.key[:DIGEST_DIGITS]}{ending}"

    def kept(self, item: Work, result: _Result, content: bytes | str | None) -> _Result:
        """Write what was made, then the result; return the result with the file."""
        file = write_atomically(self._file(item, self.ending), content) if content else None
        known = {"key": item.key, "file": None if file is None else file_digest(file)}
        body = plain({**known, **{name: getattr(result, name) for name in self.fields}})
        text = sealed(self.kind, RESULT_VERSION, body, under="result")
        write_atomically(self._file(item, ".result.json"), text)
        return replace(result, file=file)  # type: ignore[type-var]

    def known(self, item: Work, **own: Any) -> _Result | None:
        """Return a result that is there already, whole and of the same work; `None` where it is to be made again."""
        from pydantic import TypeAdapter

        written, file = self._file(item, ".result.json"), self._file(item, self.ending)
        try:
            # What does not do is written anew.
            _, kept, intact = opened(
                written, (self.kind,), RESULT_VERSION, "result", "", under="result", is_protected=False
            )
            body, digest = restored(kept), kept.get("file")
            found: _Result = TypeAdapter(self.record).validate_python({name: body[name] for name in self.fields})
        except (SpecError, LookupError, TypeError, ValueError, RecursionError):
            return None
        if not intact or kept.get("key") != item.key:
            return None
        if digest is not None and (not file.is_file() or file_digest(file) != digest):
            return None
        return replace(found, **own, file=None if digest is None else file)  # type: ignore[type-var]


_SWEEP_KIND = "obsynth sweep result"
_PLANT_TYPES = get_args(Plant)


@dataclass(frozen=True, eq=False)
class SweepResult:
    """What one case of a sweep came to.

    Parameters
    ----------
    name : str
        Of the case: its spec or plant, and what was varied.
    parameters : mapping
        Value of each varied parameter.
    status : str
        ``designed``, ``impossible`` (a condition fails), ``infeasible`` (proved), ``unknown`` (a solver gave up),
        ``unverified`` or ``malformed``.
    message : str
        Why there is no design; empty otherwise.
    condition : str
        The existence condition that fails; empty otherwise.
    signals : tuple of str
        The signals it names.
    claims : mapping of str to float
        Claims of the certificate; empty without a design.
    facts : mapping
        Method, numbers of states, faults and disturbances, and checks passed.
    seconds : float
        Processor time of the design and its verification, where it was made.
    file : Path or None
        The gain set, where the sweep has a folder.
    content : bytes or None
        The gain set, where it has none.
    """

    name: str
    parameters: Mapping[str, Any]
    status: str
    message: str = ""
    condition: str = ""
    signals: tuple[str, ...] = ()
    claims: Mapping[str, float] = field(default_factory=dict)
    facts: Mapping[str, Any] = field(default_factory=dict)
    seconds: float = 0.0
    file: Path | None = None
    content: bytes | None = field(default=None, repr=False)

    @property
    def design(self) -> ObserverDesign:
        """The design, read back.

        Raises
        ------
        SpecError
            There is none; the message says why.
        """
        if self.file is not None:
            return load(self.file)
        if self.content is None:
            raise SpecError(f"The case {self.name!r} has no design: {self.message or self.status}", path="design")
        return loaded(self.content, self.name)


@dataclass(frozen=True, eq=False)
class Sweep(ResultTable):
    """All results of a sweep, in the order of its cases.

    Parameters
    ----------
    results : tuple of SweepResult
        One for each case.
    """

    results: tuple[SweepResult, ...]

    @property
    def _found(self) -> Sequence[SweepResult]:
        return self.results

    def rows(self) -> tuple[list[str], list[list[Any]]]:
        """Return the header and the rows of the table; what does not apply is empty."""
        parameters = all_of(result.parameters for result in self.results)
        claims = all_of(result.claims for result in self.results)
        facts = all_of(result.facts for result in self.results)
        # An option may have the name of what is claimed of it, and every column has its own.
        claimed = [f"certified {name}" if name in parameters else name for name in claims]
        header = ["case", *parameters, "status", *facts, *claimed, "condition", "signals", "message", "seconds", "file"]
        rows = [
            [
                result.name,
                *(_cell(result.parameters.get(name, "")) for name in parameters),
                result.status,
                *(result.facts.get(name, "") for name in facts),
                *(result.claims.get(name, float("nan")) for name in claims),
                result.condition,
                ", ".join(result.signals),
                result.message,
                result.seconds,
                "" if result.file is None else result.file.name,
            ]
            for result in self.results
        ]
        return header, rows

    def values(self, name: str) -> FloatArray:
        """Return a claim, or the value of a row of the report, of each case; NaN where there is none.

        Parameters
        ----------
        name : str
            Of the claim or of the row, such as ``"gain"``.
        """
        found = np.full(len(self.results), np.nan)
        for i, result in enumerate(self.results):
            if name in result.claims:
                found[i] = result.claims[name]
            elif result.status == WORK_STATUSES[0]:
                found[i] = next((row.value for row in result.design.report.checks if row.name == name), np.nan)
        return found

    def plot(self, claim: str | None = None, *, parameter: str | None = None) -> Figure:
        """Draw a claim of every case over a parameter; cases without a design are marked by what they came to.

        Parameters
        ----------
        claim : str, optional
            A claim of the certificates; by default the first that most designs have.
        parameter : str, optional
            Along the horizontal axis; by default the varied number with most values, or the cases in their order.

        Raises
        ------
        SpecError
            No design claims that, or no such parameter was varied.
        """
        from obsynth.plotting.trade_off import plot_sweep

        return plot_sweep(self.results, claim, parameter=parameter)


@arguments_checked
def sweep(
    cases: str | Path | Sequence[str | Path] | Plant | Mapping[str, Plant],
    parameters: Mapping[str, Sequence[Any]] | None = None,
    *,
    method: str | None = None,
    executor: Executor | None = None,
    folder: str | Path | None = None,
    progress: RunsProgress | bool | None = None,
) -> Sweep:
    """Design and verify for every combination of plants and parameters; what fails is a row, not an error.

    Parameters
    ----------
    cases : path, sequence of paths, plant, or mapping of str to plant
        Specs; or plants in memory, with ``method``.
    parameters : mapping of str to sequence, optional
        Values by name; all combinations are taken.  Of a spec, the dotted path of an entry, such as
        ``plant.transform.sample_time``, ``plant.C.outputs`` or ``plant.file`` (a plant in a file of its own is changed
        as well); of a plant in memory ``plant.A`` and the like, or ``plant.outputs`` (names of its outputs).  Any
        other name is an option of the method.
    method : str, optional
        For plants in memory.
    executor : concurrent.futures.Executor, optional
        Where designs are made: processes, threads, or ``dask.distributed.Client(...).get_executor()``; by default here,
        one after the other.  The results do not depend on it.
    folder : str or Path, optional
        Where each gain set and result is written as soon as it is there; what is there already, from the same data and
        options, is not designed again.  It is made if need be.
    progress : callable or bool, optional
        Called with the number of cases done and their total; `True` shows a bar on standard error.

    Returns
    -------
    Sweep
        Results in the order of the cases; equal cases are designed once.

    Raises
    ------
    SpecError
        The cases or parameters are malformed, or the folder cannot be written.
    """
    made = _cases(cases, parameters or {}, method)
    place = None if folder is None else ResultFolder(folder, _SWEEP_KIND, SweepResult, ending=".gains.json")
    with progress_of_runs(progress) as told:
        return Sweep(
            carried_out(
                made,
                run_case,
                executor=executor,
                told=told,
                at_start=True,
                known=lambda case: None if place is None else place.known(case, parameters=case.parameters),
                kept=lambda case, result: (
                    result if place is None else place.kept(case, replace(result, content=None), result.content)
                ),
            )
        )


def _cases(cases: Any, parameters: Mapping[str, Sequence[Any]], method: str | None) -> list[Work]:
    if not isinstance(parameters, Mapping):
        raise SpecError("parameters must be a mapping of names to lists of values.", path="parameters")
    if isinstance(cases, _PLANT_TYPES):
        cases = {"plant": cases}
    if isinstance(cases, Mapping):
        wrong = [name for name, plant in cases.items() if not isinstance(plant, _PLANT_TYPES)]
        if wrong or not cases:
            raise SpecError(f"{wrong or 'nothing'}: give a mapping of names to plants.", path="cases")
        if method is None:
            raise SpecError("Plants in memory need a method: give method='...'.", path="method")
        return plant_cases(dict(cases), method, parameters, __version__)
    if method is not None:
        raise SpecError("The specs name their methods: vary 'method.id' instead of giving one.", path="method")
    paths = [cases] if isinstance(cases, (str, Path)) else list(cases)
    if not paths or not all(isinstance(path, (str, Path)) for path in paths):
        raise SpecError("Give one spec or several, or plants.", path="cases")
    return spec_cases([Path(path) for path in paths], parameters, __version__)


def run_case(case: Work) -> SweepResult:
    """Return what a case comes to; errors of the package are results."""
    started = time.process_time()
    result = partial(SweepResult, case.name, case.parameters)
    try:
        made = case.make()
    except ObsynthError as error:
        told = error.as_dict()
        return result(
            WORK_STATUSES[error.exit_code],
            message=str(error),
            condition=str(told.get("condition") or ""),
            signals=tuple(told.get("signals", ())),
            seconds=time.process_time() - started,
        )
    checks = made.report.checks
    facts = {
        "method": made.method,
        "nx": made.plant.nx,
        "ny": made.plant.ny,
        "checks": f"{sum(check.passed for check in checks)} of {len(checks)}",
    }
    return result(
        WORK_STATUSES[0],
        claims={name: float(value) for name, value in made.certificate.claims.items()},
        facts=facts,
        content=gain_set_bytes(made),
        seconds=time.process_time() - started,
    )


def _cell(value: Any) -> Any:
    if isinstance(value, (bool, str)) or value is None:
        return str(value)
    return value if isinstance(value, (int, float, np.number)) else json.dumps(plain(value))


_FLEET_KIND = "obsynth fleet result"
#: What ends the name of a gain set; logs by their suffix.
GAINS_ENDING = ".gains.json"
LOG_ENDINGS = (".csv", ".tsv", ".parquet", ".tdms", ".mf4", ".mdf", ".dat")
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
    """

    name: str
    status: str
    message: str = ""
    rows: int = 0
    statuses: Mapping[str, int] = field(default_factory=dict)
    alarms: Mapping[str, float] = field(default_factory=dict)
    largest: Mapping[str, float] = field(default_factory=dict)
    file: Path | None = None


@dataclass(frozen=True)
class Fleet(ResultTable):
    """All runs of a fleet, in the order of designs and logs.

    Parameters
    ----------
    runs : tuple of FleetRun
        One for each design and log.
    """

    runs: tuple[FleetRun, ...]

    @property
    def _found(self) -> Sequence[FleetRun]:
        return self.runs

    def rows(self) -> tuple[list[str], list[list[Any]]]:
        """Return the table as a header and rows: one column for each alarm and each largest value of any run."""
        alarms = all_of(run.alarms for run in self.runs)
        largest = all_of(run.largest for run in self.runs)
        header = [
            "run",
            "status",
            "rows",
            "ok",
            *(f"alarm {n}, s" for n in alarms),
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

        shown = [(run, run.file) for run in self.runs if run.file is not None][:MOST_SHOWN]
        if not shown:
            raise SpecError("No design was run on any log: there is nothing to draw.", path="runs")
        figure, axes = plt.subplots(
            len(shown), 1, figsize=(8.0, 1.2 + 1.3 * len(shown)), squeeze=False, layout="constrained"
        )
        for axis, (run, file) in zip(axes[:, 0], shown, strict=True):
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
        As for `run_on_data`: ``columns, time_column, scales, thresholds, gap, warm_up, recovered, outliers``; and
        ``unverified``: whether designs that fail their verification are run all the same.

    Returns
    -------
    Fleet
        One row for each run; a log that does not fit a design is a row that says why.

    Raises
    ------
    SpecError
        There is no gain set or no log, an option is unknown, or the folder cannot be used.
    """
    known = ("columns", "time_column", "scales", "thresholds", "gap", "warm_up", "recovered", "outliers", "unverified")
    wrong = sorted(set(options) - set(known))
    if wrong:
        raise SpecError(f"{', '.join(wrong)}: use some of {', '.join(known)}.", path=wrong[0])
    pairs = _pairs(_files(gains, (GAINS_ENDING,), "gains"), _files(data, LOG_ENDINGS, "data"), options)
    place = ResultFolder(folder, _FLEET_KIND, FleetRun, ending=".csv")
    return Fleet(
        carried_out(
            pairs,
            _run,
            executor=executor,
            told=progress,
            known=place.known,
            kept=lambda pair, outcome: place.kept(pair, *outcome),
        )
    )


def _files(given: Any, endings: tuple[str, ...], what: str) -> list[Path]:
    listed = [given] if isinstance(given, (str, Path)) else list(given)
    for name in listed:
        require_kind(name, (str, Path), what, "names of files or of folders")
    found: list[Path] = []
    for path in map(Path, listed):
        found += sorted(p for p in path.iterdir() if p.name.endswith(endings)) if path.is_dir() else [path]
    if not found:
        raise SpecError(f"{', '.join(map(str, listed))}: there is no file *{' or *'.join(endings)}.", path=what)
    missing = [str(path) for path in found if not path.is_file()]
    if missing:
        raise SpecError(f"{', '.join(missing)}: no such file.", path=what)
    return found


def _pairs(gains: Sequence[Path], logs: Sequence[Path], options: Mapping[str, Any]) -> list[Work]:
    names = {path: path.name.removesuffix(GAINS_ENDING).removesuffix(".json") for path in gains}
    digests = {path: file_digest(input_file(path)) for path in (*gains, *logs)}
    own = {log: log.stem for log in logs if log.stem in names.values()}
    said = json.dumps(options, sort_keys=True, default=str)
    return [
        Work(
            f"{names[gain]} on {log.stem}",
            hashlib.sha256(f"{__version__} {digests[gain]} {digests[log]} {said}".encode()).hexdigest(),
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
    return run_on_data(design, log, stream, **options), stream.getvalue()


def _run(pair: Work) -> tuple[FleetRun, str]:
    """Return what a run comes to, and its estimates as CSV; errors of the package are results."""
    try:
        found, text = pair.make()
    except ObsynthError as error:
        return FleetRun(pair.name, WORK_STATUSES[error.exit_code], str(error)), ""
    return FleetRun(pair.name, "run", "", found.rows, dict(found.statuses), dict(found.alarms), _largest(text)), text


def _largest(text: str) -> dict[str, float]:
    """Return the largest absolute value of each fault estimate and residual after the warm-up."""
    import pandas as pd

    table = pd.read_csv(io.StringIO(text))
    settled = table if "status" not in table else table[table["status"] != "warm-up"]
    chosen = [name for name in table.columns if name.startswith(("fhat[", "r["))]
    values = {name: pd.to_numeric(settled[name], errors="coerce").abs().max() for name in chosen}
    return {name: float(value) for name, value in values.items() if np.isfinite(value)}
