"""Matrices in files beside a spec: ``.mtx``, ``.npz``, ``.mat`` and ``.csv``.

The reader of Matrix Market is ours, since that of scipy (1.17) crashes the interpreter on some damaged files.
"""

from __future__ import annotations

import math
import warnings
import zipfile
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from obsynth.errors import SpecError, counted
from obsynth.files.inputs import READING_ERRORS, input_file
from obsynth.numerics.arguments import number_in_text
from obsynth.numerics.arrays import MAXIMUM_ENTRIES, FloatArray, as_matrix, read_only, require_readable
from obsynth.numerics.sparse import as_sparse_matrix, is_sparse

#: Smaller matrices become arrays: nothing is gained by sparsity.
SPARSE_FROM = 300

#: A sparse matrix needs memory for each row and column as well: this many entries' worth, generously.
ENTRIES_PER_LINE = 1000

#: Whole numbers with more digits are damage.
MOST_DIGITS = 15

#: Endings of files that hold matrices.
MATRIX_SUFFIXES = (".csv", ".mat", ".mtx", ".npz")

#: What to do with matrices in other common files.
_CONVERSIONS = {
    ".npy": "save it by numpy.savez, as .npz",
    ".txt": "name it .csv",
    ".tsv": "name it .csv",
    ".dat": "name it .csv",
    ".xlsx": "save the sheet as .csv",
    ".xls": "save the sheet as .csv",
}

#: What separates the numbers of a row of a text, in the order in which they are tried; else blanks do.
_SEPARATORS = (";", "\t", ",")


def read_matrix(path: Path, *, variable: str | None = None, where: str, keep_sparse: bool = False) -> Any:
    """Return the matrix in a file; a CSR array where it is stored by coordinates and may stay sparse."""
    return _checked(_read_array(path, variable=variable, where=where, keep_sparse=keep_sparse), path.name, where)


def _checked(raw: Any, name: str, where: str) -> Any:
    try:
        matrix = as_sparse_matrix(raw, name) if is_sparse(raw) else as_matrix(raw, name)
    except SpecError as error:
        raise SpecError(str(error), path=where) from error
    if 0 in matrix.shape:
        raise SpecError(f"{name} holds an empty matrix.", path=where)
    return matrix


def read_matrices(path: Path, *, variable: str | None = None, count: int | None = None, where: str) -> FloatArray:
    """Return the matrix in a file, or a stack of matrices ``(entries, rows, columns)``."""
    array = _read_array(path, variable=variable, where=where)
    if np.ndim(array) != 3:
        matrix: FloatArray = _checked(array, path.name, where)
        if count is None:
            return matrix
        rows, columns = matrix.shape
        if rows % count:
            raise SpecError(
                f"{path.name} has {rows} rows, which cannot be shared out among {count} matrices.", path=where
            )
        return read_only(matrix.reshape(count, rows // count, columns))
    stack = np.moveaxis(array, -1, 0) if path.suffix.lower() == ".mat" else array
    if not stack.size:
        raise SpecError(f"{path.name} holds an empty stack of matrices.", path=where)
    if count is not None and len(stack) != count:
        raise SpecError(f"{path.name} holds a stack of {len(stack)} matrices, not {count}.", path=where)
    named = ((f"{path.name}, matrix {k} of the stack,", matrix) for k, matrix in enumerate(stack, 1))
    return read_only(np.array([_checked(matrix, name, where) for name, matrix in named]))


def _read_array(path: Path, *, variable: str | None, where: str, keep_sparse: bool = False) -> Any:
    """Return what a file holds as an array of any kind, or as a sparse one."""
    readers: dict[str, Callable[[Path], Any]] = {
        ".mtx": partial(read_matrix_market, maximum_entries=MAXIMUM_ENTRIES, keep_sparse=keep_sparse),
        ".csv": read_table_of_numbers,
    }
    archives: dict[str, Callable[[Path], Mapping[str, Any]]] = {".npz": _numpy_archive, ".mat": _matlab_archive}
    suffix = path.suffix.lower()
    if suffix not in readers and suffix not in archives:
        known, advice = ", ".join(MATRIX_SUFFIXES), _CONVERSIONS.get(suffix)
        raise SpecError(
            f"{path.name} has an unknown suffix: matrices are read from {known} files{f' ({advice})' if advice else ''}"
            ".",
            path=where,
        )
    if variable is not None and suffix in readers:
        raise SpecError(f"{path.name} holds one matrix only: remove 'variable'.", path=where)
    input_file(path, where=where)
    try:
        with warnings.catch_warnings(action="error", category=UserWarning):
            content = readers[suffix](path) if suffix in readers else archives[suffix](path)
            raw = content if suffix in readers else _selected(content, variable, path, where)
            return raw if keep_sparse and is_sparse(raw) and suffix == ".mtx" else _as_dense(raw)
    except READING_ERRORS as error:
        raise SpecError(f"{path} cannot be read as a matrix: {_reason(error)}", path=where) from error


def _numpy_archive(path: Path) -> dict[str, Any]:
    # Opened here, because numpy leaves a damaged file open.
    with path.open("rb") as stream:
        if not zipfile.is_zipfile(stream):
            raise ValueError("it is no .npz archive")
        stream.seek(0)
        with np.load(stream, allow_pickle=False) as archive:
            # A small file may unpack to more than the memory holds.
            require_readable(sum(item.file_size for item in archive.zip.infolist()) / np.float64().nbytes)
            return dict(archive)


def _matlab_archive(path: Path) -> dict[str, Any]:
    from obsynth.plants.importing.matlab_models import mat_arrays

    return mat_arrays(path)


def _selected(content: Mapping[str, Any], variable: str | None, path: Path, where: str) -> Any:
    known = ", ".join(map(repr, content)) or "none"
    if variable is not None:
        if variable not in content:
            raise SpecError(f"{path} has no array {variable!r}; it has: {known}.", path=where)
        return content[variable]
    if len(content) != 1:
        raise SpecError(f"{path} must say which array is meant ('variable: name'); it has: {known}.", path=where)
    return next(iter(content.values()))


def _as_dense(raw: Any) -> Any:
    """Return an array for whatever a reader gave; a damaged sparse matrix must not reach scipy's loops."""
    require_readable(math.prod(int(length) for length in getattr(raw, "shape", ())))
    if not hasattr(raw, "toarray"):
        return raw
    if hasattr(raw, "check_format"):
        raw.check_format(full_check=True)
    return raw.toarray()


def _reason(error: BaseException) -> str:
    if isinstance(error, OSError) and error.strerror:
        return f"{error.strerror}."
    text = str(error).strip().splitlines()
    return f"{text[0].rstrip('.')}." if text else f"{type(error).__name__}."


def read_table_of_numbers(path: Path) -> FloatArray:
    """Return the matrix in a text, a row a line, its numbers separated by commas, semicolons, tabs or blanks.

    Numbers may have a decimal comma where semicolons or tabs separate them and no number has a point.  What follows
    ``#`` in a line is a remark.  `ValueError` names the line and column of what is no number."""
    lines = path.read_text(encoding="utf-8-sig").splitlines()
    rows = [(i, text) for i, line in enumerate(lines, 1) if (text := line.partition("#")[0].strip(" \r\n"))]
    if not rows:
        raise ValueError("it is empty")
    separator = next((mark for mark in _SEPARATORS if mark in rows[0][1]), None)
    has_decimal_comma = separator not in (None, ",") and not any("." in text for _, text in rows)
    texts = [text.replace(",", ".") if has_decimal_comma else text for _, text in rows]
    try:
        return np.loadtxt(texts, delimiter=separator, ndmin=2, comments=None)
    except ValueError as error:
        width = len(texts[0].split(separator))
        for row, ((line, _), text) in enumerate(zip(rows, texts, strict=True)):
            cells = text.split(separator)
            if len(cells) != width or not all(map(_is_number, cells)):
                raise ValueError(_damage_in_row(line, cells, width, is_first=row == 0)) from error
        raise


def _damage_in_row(line: int, cells: list[str], width: int, *, is_first: bool) -> str:
    """Return what is wrong with a line of a table of numbers, and what to do."""
    wrong = [k for k, cell in enumerate(cells) if not _is_number(cell)]
    if is_first and len(wrong) == len(cells):
        return f"line {line} holds names ({cells[0].strip()[:20]!r}), and only numbers are read: remove this line"
    if not wrong:
        return f"line {line} has {counted(len(cells), 'number')}, but the first row has {width}"
    cell = cells[wrong[0]].strip()
    if not cell:
        remedy = ": remove the separator at the end of the line" if wrong == [len(cells) - 1] else ""
        return f"line {line}, column {wrong[0] + 1} is empty{remedy}"
    return f"line {line}, column {wrong[0] + 1} holds {cell[:20]!r}, which is no number"


def _is_number(text: str) -> bool:
    try:
        number_in_text(text)
    except ValueError:
        return False
    return True


def read_matrix_market(path: Path, *, maximum_entries: int, keep_sparse: bool = False) -> Any:
    """Return the matrix in a Matrix Market file: an array, or a CSR array of a large one that may stay sparse."""
    with path.open(encoding="utf-8") as stream:
        layout, field, symmetry = _checked_header(stream.readline(200))
        lines = (line for line in stream if line.strip() and not line.startswith("%"))
        size = next(lines, "").split()
        tokens = [token for line in lines for token in line.split()]
    counts = [_whole(token, "the sizes") for token in size]
    if len(counts) != (3 if layout == "coordinate" else 2) or min(counts) < 0:
        raise ValueError("the line with the sizes is damaged")
    rows, columns = counts[:2]
    sparse = keep_sparse and layout == "coordinate" and max(rows, columns) >= SPARSE_FROM
    entries = max(rows, columns) * ENTRIES_PER_LINE if sparse else rows * columns
    if max(entries, *counts) > maximum_entries:
        raise ValueError(f"it is too large ({max(rows * columns, *counts):.1e} entries)")
    if symmetry != "general" and rows != columns:
        raise ValueError(f"it is {symmetry}, but {rows} by {columns}")
    if field == "complex":
        tokens, field = _real_parts(tokens, 2 if layout == "coordinate" else 0), "real"
    if layout == "array":
        return _from_array(tokens, rows, columns, symmetry)
    return _from_coordinates(tokens, (rows, columns, counts[2]), field, symmetry, sparse=sparse)


def _checked_header(line: str) -> tuple[str, str, str]:
    words = line.lower().split()
    if len(words) != 5 or words[:2] != ["%%matrixmarket", "matrix"]:
        raise ValueError("its first line is no Matrix Market header")
    _, _, layout, field, symmetry = words
    # A matrix of real numbers is hermitian where it is symmetric.
    if symmetry == "hermitian":
        symmetry = "symmetric"
    known = (
        layout in ("coordinate", "array")
        and field in ("real", "double", "integer", "unsigned-integer", "pattern", "complex")
        and symmetry in ("general", "symmetric", "skew-symmetric")
        and (layout, field) != ("array", "pattern")
    )
    if not known:
        raise ValueError(f"'{' '.join(words[2:])}' is no known kind of Matrix Market file")
    return layout, field, symmetry


def _from_array(tokens: list[str], rows: int, columns: int, symmetry: str) -> FloatArray:
    values = _numbers(tokens)
    if symmetry == "general":
        _require_count(len(values), rows * columns)
        return values.reshape(columns, rows).T
    # The lower triangle, column by column.
    column, row = np.triu_indices(rows, 1 if symmetry == "skew-symmetric" else 0)
    _require_count(len(values), len(row))
    matrix = np.zeros((rows, columns))
    (row, column), values = _both_triangles([row, column], values, symmetry)
    matrix[row, column] = values
    return matrix


def _from_coordinates(tokens: list[str], size: tuple[int, int, int], field: str, symmetry: str, *, sparse: bool) -> Any:
    rows, columns, stored = size
    width = 2 if field == "pattern" else 3
    _require_count(len(tokens), width * stored)
    positions = [_indices(tokens[k::width]) - 1 for k in (0, 1)]
    for position, limit in zip(positions, (rows, columns), strict=True):
        if np.any(position < 0) or np.any(position >= limit):
            raise ValueError("an index is outside the matrix")
    values = np.ones(stored) if field == "pattern" else _numbers(tokens[2::width])
    if symmetry != "general":
        positions, values = _both_triangles(positions, values, symmetry)
    # Entries that are given twice are added, as the format says.
    from scipy.sparse import coo_array

    matrix = coo_array((values, (positions[0], positions[1])), shape=(rows, columns))
    return matrix.tocsr() if sparse else matrix.toarray()


def _both_triangles(positions: list[Any], values: FloatArray, symmetry: str) -> tuple[list[Any], FloatArray]:
    """Return the coordinates of a lower triangle and of what it stands for above the diagonal."""
    row, column = positions
    if np.any(column[values != 0.0] > row[values != 0.0]):
        raise ValueError(f"it is {symmetry}, but has entries above the diagonal")
    sign, below = (-1.0 if symmetry == "skew-symmetric" else 1.0), row > column
    mirrored = [np.concatenate([row, column[below]]), np.concatenate([column, row[below]])]
    return mirrored, np.concatenate([values, sign * values[below]])


def _real_parts(tokens: list[str], positions: int) -> list[str]:
    """Return the tokens of a file of complex numbers without the imaginary parts, which must all be zero; ``positions``
    tokens of each entry go before its number."""
    width = positions + 2
    if len(tokens) % width:
        raise ValueError("the entries of a matrix of complex numbers have a real and an imaginary part each")
    if np.any(_numbers(tokens[width - 1 :: width]) != 0.0):
        raise ValueError("it holds complex numbers")
    return [token for place, token in enumerate(tokens) if place % width != width - 1]


def _numbers(tokens: list[str]) -> FloatArray:
    return np.fromiter(map(_number, tokens), dtype=np.float64, count=len(tokens))


def _number(token: str) -> float:
    """Return the number of a token; Fortran marks the exponent of double precision by D."""
    try:
        return number_in_text(token)
    except ValueError:
        return number_in_text(token.replace("D", "e").replace("d", "e"))


def _indices(tokens: list[str]) -> Any:
    if not all(map(str.isdecimal, tokens)) or max(map(len, tokens), default=0) > MOST_DIGITS:
        return np.array([_whole(token, "an index") for token in tokens], dtype=np.int64)
    return np.fromiter(map(int, tokens), dtype=np.int64, count=len(tokens))


def _whole(token: str, what: str) -> int:
    if not token.isdecimal() or len(token) > MOST_DIGITS:
        raise ValueError(f"{what} must be whole numbers, not {token[:20]!r}")
    return int(token)


def _require_count(actual: int, expected: int) -> None:
    if actual != expected:
        raise ValueError(f"it has {actual} numbers after the sizes, but {expected} are needed")
