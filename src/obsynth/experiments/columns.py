"""Signals of a simulation as named columns of a table, and how large errors are."""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from obsynth.files.outputs import FileKind, write_atomically
from obsynth.files.tables import TableWriter
from obsynth.numerics.arrays import FloatArray

#: A table that `Simulation.write_csv` has written: signals of the plant beside time, and no status of rows.
SIGNALS = FileKind("a table of simulated signals", rb"\Atime,(?!status,)[^\n]*x(hat)?\[")


def named_columns(time: FloatArray, groups: Iterable[tuple[str, Sequence[str], FloatArray]]) -> dict[str, FloatArray]:
    """Return every column by name; inputs and outputs go by their own names, unless those are taken."""
    found = {"time": time}
    for form, names, values in groups:
        for i, name in enumerate(names):
            plain = form[0] in "uy" and name not in found
            found[name if plain else form.format(name)] = values[:, i]
    return found


def write_columns(table: Mapping[str, FloatArray], path: str | Path) -> Path:
    """Write columns as comma-separated text, atomically, floats with all their digits; NaN is an empty cell."""
    text = io.StringIO()
    TableWriter(text, table).write(zip(*(column.tolist() for column in table.values()), strict=True))
    return write_atomically(path, text.getvalue())


def root_mean_square(errors: FloatArray) -> float:
    """Return the root mean square of what is not NaN."""
    known = errors[~np.isnan(errors)]
    return float(np.sqrt(np.mean(known**2))) if known.size else float("nan")
