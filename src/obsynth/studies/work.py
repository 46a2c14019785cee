"""Much work on any executor: the cases of a sweep with digests of all they read, results kept in a folder, tables."""

from __future__ import annotations

import hashlib
import io
import itertools
import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar, cast

from obsynth.errors import SpecError, a_kind
from obsynth.files.inputs import input_file
from obsynth.files.outputs import write_atomically
from obsynth.files.tables import table_writer
from obsynth.methods.designing import design
from obsynth.methods.registry import Plant
from obsynth.numerics.arguments import require_kind
from obsynth.observers.progress import as_they_come
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.signal_names import index_of
from obsynth.results.certificate_files import RESULT_VERSION, opened, sealed
from obsynth.results.design import ObserverDesign
from obsynth.results.gain_set_writing import plain, restored
from obsynth.specs.documents import read_yaml
from obsynth.specs.loader import changed_document, design_of_spec, spec_of
from obsynth.verification.assumptions import file_digest

if TYPE_CHECKING:
    import pandas as pd


#: Keys of a spec; a parameter that begins with none of them is an option of the method.
_SECTIONS = ("plant", "method", "scenario", "name", "description")

#: What a section ``plant`` may hold beside a reference to a file; everything else is changed in that file.
_REFERENCE = ("file", "transform")

#: More cases than this are taken for a slip.
MOST_CASES = 100_000


#: What a piece of work came to, by the exit code of its error.
WORK_STATUSES = {0: "designed", 2: "malformed", 3: "impossible", 4: "infeasible", 5: "unknown", 6: "unverified"}

#: Digits of the digest of a piece of work in the names of its files.
DIGEST_DIGITS = 16

#: Letters of its name there.
LONGEST_STEM = 60

_Outcome = TypeVar("_Outcome")

_Result = TypeVar("_Result")


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
    said = [f"{path.rpartition('.')[2]} = {_cell_text(value)}" for path, value in chosen.items()]
    return ", ".join([stem, *said])


def _cell_text(value: Any) -> str:
    text = f"{value:g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 40 else f"{text[:36]} ..."


def _distinct(cases: list[Work]) -> list[Work]:
    """Return the cases without repetitions: the same design is made once."""
    return list({case.key: case for case in reversed(cases)}.values())[::-1]


class ResultTable(ABC):
    """Results with a row each."""

    @property
    @abstractmethod
    def _results(self) -> Sequence[Any]:
        """The results, each with a status."""

    def __len__(self) -> int:
        return len(self._results)

    @property
    def counts(self) -> dict[str, int]:
        """Number of results by what they came to."""
        found = [result.status for result in self._results]
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
