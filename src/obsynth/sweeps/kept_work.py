"""Much work on any executor, its results kept in a folder, so that what is there is not done again; and its table."""

from __future__ import annotations

import io
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, as_completed
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from obsynth.errors import SpecError
from obsynth.files.inputs import read_json
from obsynth.files.tables import TableWriter

if TYPE_CHECKING:
    import pandas as pd

#: What a piece of work came to, by the exit code of its error.
STATUSES = {0: "designed", 2: "malformed", 3: "impossible", 4: "infeasible", 5: "unknown", 6: "unverified"}
#: Digits of the digest of a piece of work in the names of its files.
DIGITS = 16

_Item = TypeVar("_Item")
_Outcome = TypeVar("_Outcome")
_Result = TypeVar("_Result")


class ResultTable(ABC):
    """Results with a row each."""

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
        TableWriter(stream, header).write(rows)
        return stream.getvalue()


def all_of(mappings: Iterable[Mapping[str, Any]]) -> list[str]:
    """Return every key once, in order of appearance."""
    return list(dict.fromkeys(name for mapping in mappings for name in mapping))


def carried_out(
    items: Sequence[_Item], work: Callable[[_Item], _Outcome], *, executor: Executor | None,
    known: Callable[[_Item], _Result | None], kept: Callable[[_Item, _Outcome], _Result],
    told: Callable[[int, int], object] | None, at_start: bool = False,
) -> tuple[_Result, ...]:  # fmt: skip
    """Return the result of every item, in their order; ``known`` ones are not worked on, others ``kept`` as they come."""
    found = {i: result for i, item in enumerate(items) if (result := known(item)) is not None}
    waiting = [i for i in range(len(items)) if i not in found]
    if told is not None and at_start:
        told(len(found), len(items))
    for place, outcome in _each(work, [items[i] for i in waiting], executor):
        found[waiting[place]] = kept(items[waiting[place]], outcome)
        if told is not None:
            told(len(found), len(items))
    return tuple(found[i] for i in range(len(items)))


def _each(
    work: Callable[[_Item], _Outcome], items: Sequence[_Item], executor: Executor | None
) -> Iterator[tuple[int, _Outcome]]:
    """Yield the place of each item with what comes of it, as they come."""
    if executor is None:
        for place, item in enumerate(items):
            yield place, work(item)
        return
    waiting = {executor.submit(work, item): place for place, item in enumerate(items)}
    try:
        for future in as_completed(waiting):
            yield waiting[future], future.result()
    finally:
        for future in waiting:
            future.cancel()


def folder_for(folder: Path) -> Path:
    """Return a folder for results, made where there is none."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SpecError(f"{folder} cannot be used as a folder: {error.strerror}.", path=str(folder)) from error
    return folder


def file_stem(name: str, key: str, *, most: int) -> str:
    """Return how the files of a piece of work begin: its name in letters that every file may have, and its digest."""
    stem = "".join(letter if letter.isalnum() or letter in "-_." else "-" for letter in name)[:most]
    return f"{stem}-{key[:DIGITS]}"


def result_in(file: Path, kind: str, key: str) -> dict[str, Any] | None:
    """Return the result in a file, `None` where it is missing, damaged, or of other work."""
    try:
        body = read_json(file, where=str(file)) if file.is_file() else None
    except SpecError:
        return None
    whole = isinstance(body, dict) and body.get("kind") == kind and body.get("key") == key
    return body if whole else None
