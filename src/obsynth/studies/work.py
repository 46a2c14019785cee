"""Cases on any executor: results are stored in a folder, finished cases are skipped, and a table has all of them."""

from __future__ import annotations

import io
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar, cast

from obsynth.errors import SpecError
from obsynth.files.outputs import write_atomically
from obsynth.files.tables import table_writer
from obsynth.observers.progress import as_they_come
from obsynth.results.certificate_files import RESULT_VERSION, opened, sealed
from obsynth.results.gain_set_writing import plain, restored
from obsynth.verification.assumptions import file_digest

if TYPE_CHECKING:
    import pandas as pd


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
        statuses = [result.status for result in self._results]
        return {status: statuses.count(status) for status in ("run", *WORK_STATUSES.values()) if status in statuses}

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
    keep: Callable[[Work, _Outcome], _Result],
    progress: Callable[[int, int], object] | None,
    at_start: bool = False,
) -> tuple[_Result, ...]:
    """Return each item's result, in order: no work is done for ``known`` ones, ``keep`` takes others as they come."""
    results = {i: result for i, item in enumerate(items) if (result := known(item)) is not None}
    waiting = [i for i in range(len(items)) if i not in results]
    if progress is not None and at_start:
        progress(len(results), len(items))
    for place, outcome in as_they_come(work, [items[i] for i in waiting], executor):
        results[waiting[place]] = keep(items[waiting[place]], outcome)
        if progress is not None:
            progress(len(results), len(items))
    return tuple(results[i] for i in range(len(items)))


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

    def keep(self, item: Work, result: _Result, content: bytes | str | None) -> _Result:
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
            _, contents, intact = opened(
                written, (self.kind,), RESULT_VERSION, "result", "", under="result", is_protected=False
            )
            body, digest = restored(contents), contents.get("file")
            result: _Result = TypeAdapter(self.record).validate_python({name: body[name] for name in self.fields})
        except (SpecError, LookupError, TypeError, ValueError, RecursionError):
            return None
        if not intact or contents.get("key") != item.key:
            return None
        if digest is not None and (not file.is_file() or file_digest(file) != digest):
            return None
        return replace(result, **own, file=None if digest is None else file)  # type: ignore[type-var]
