"""Signals of a simulation as named columns of a table."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from obsynth.numerics.arrays import FloatArray
from obsynth.results.serialise import write_atomically


def named_columns(time: FloatArray, groups: Iterable[tuple[str, Sequence[str], FloatArray]]) -> dict[str, FloatArray]:
    """Return every column by name; inputs and outputs go by their own names, unless those are taken.

    Parameters
    ----------
    time : FloatArray
        ``(steps,)``, seconds.
    groups : iterable of (str, sequence of str, FloatArray)
        Form such as ``u[{}]``, names, and values ``(steps, len(names))``.
    """
    found = {"time": time}
    for form, names, values in groups:
        for i, name in enumerate(names):
            plain = form[0] in "uy" and name not in found
            found[name if plain else form.format(name)] = values[:, i]
    return found


def write_columns(table: Mapping[str, FloatArray], path: str | Path) -> Path:
    """Write columns as comma-separated text, atomically, floats with all their digits; NaN is an empty cell.

    Parameters
    ----------
    table : mapping of str to FloatArray
        ``(steps,)`` each, by name.
    path : str or Path
        Where; an existing file is replaced.

    Raises
    ------
    SpecError
        The file cannot be written.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(table)
    for row in zip(*(column.tolist() for column in table.values()), strict=True):
        writer.writerow(["" if value != value else value for value in row])
    return write_atomically(path, text.getvalue())
