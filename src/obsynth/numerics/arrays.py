"""Conversion of input into checked, read-only float arrays."""

from __future__ import annotations

import copyreg
import math
from collections.abc import Callable, Mapping
from functools import wraps
from inspect import Parameter, signature
from types import MappingProxyType
from typing import Any, Concatenate, ParamSpec, TypeAlias, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from obsynth.errors import SpecError, counted
from obsynth.numerics.quantities import require_plain, unit_of

FloatArray: TypeAlias = NDArray[np.float64]

ComplexArray: TypeAlias = NDArray[np.complex128]

#: A vector with at most this many entries is written as a matrix in a message.
LONGEST_EXAMPLE = 6

#: Stands for a size that may be zero, where something is divided by it.
SMALLEST = 1e-300

#: Numbers of plants and scenarios are at most this: products of three of them, as in gains, norms and covariances of
#: what was scaled, stay within double precision.
LARGEST = 1e100

KEYWORD = Parameter.KEYWORD_ONLY

Given = ParamSpec("Given")

Made = TypeVar("Made")

#: More entries of matrices are not taken: of one in a file (of a sparse one, those that are stored), and along a
#: horizon of all that change.
MAXIMUM_ENTRIES = 50_000_000


def remembered(make: Callable[Concatenate[Any, Given], Made]) -> Callable[Concatenate[Any, Given], Made]:
    """Return a function that makes something of an object once and keeps it for as long as the object lives.

    The object never changes, and what is made must not hold it; the other arguments are part of the key: hashable."""
    known: WeakKeyDictionary[Any, dict[object, Made]] = WeakKeyDictionary()
    usual = {name: option.default for name, option in signature(make).parameters.items() if option.kind == KEYWORD}

    @wraps(make)
    def once(item: Any, /, *arguments: Given.args, **named: Given.kwargs) -> Made:
        cache, key = known.setdefault(item, {}), (arguments, frozenset((usual | named).items()))
        if key not in cache:
            cache[key] = make(item, *arguments, **named)
        return cache[key]

    return once


def read_only(array: NDArray[Any], dtype: Any = np.float64) -> NDArray[Any]:
    """Return a private copy of ``array`` that nobody can write to."""
    copy = np.array(array, dtype=dtype, order="C", copy=True)
    copy.setflags(write=False)
    return copy


def read_only_mapping(items: Mapping[str, Any]) -> MappingProxyType[str, Any]:
    """Return a private mapping that nobody can write to, nor to the arrays in it."""
    for value in items.values():
        if isinstance(value, np.ndarray):
            value.setflags(write=False)
    return MappingProxyType(dict(items))


# Python does not pickle read-only mappings, nor copy them deeply: records that hold some go to other processes.
copyreg.pickle(MappingProxyType, lambda mapping: (read_only_mapping, (dict(mapping),)))


def restore(record: Any, state: Mapping[str, Any]) -> None:
    """Give a record that was pickled, or copied deeply, its fields; arrays are read-only again."""
    for name, value in state.items():
        if isinstance(value, np.ndarray):
            value.setflags(write=False)
        object.__setattr__(record, name, value)


def freeze(record: Any, *names: str, **values: Any) -> None:
    """Make fields of a frozen record private and read-only: its own arrays and mappings by name, or new values."""
    for name, value in ({name: getattr(record, name) for name in names} | values).items():
        frozen = MappingProxyType(dict(value)) if isinstance(value, Mapping) else read_only(value)
        object.__setattr__(record, name, frozen)


def largest_singular_value(matrix: NDArray[Any]) -> float:
    """Return the spectral norm; zero of an empty matrix."""
    # `numpy.linalg.norm` takes the same decomposition and half of its time again.
    return float(np.linalg.svd(matrix, compute_uv=False)[0]) if matrix.size else 0.0


def sums_of_column_norms(matrices: NDArray[Any]) -> FloatArray:
    """Return the sum of the norms of the columns of each of matrices ``(..., m, n)``."""
    return np.asarray(np.linalg.norm(matrices, axis=-2).sum(axis=-1))


def all_finite(vector: FloatArray) -> bool:
    """Whether every entry of a short vector ``(n,)`` is finite; what is not is left in a sum of them."""
    return math.isfinite(sum(vector.tolist())) or bool(np.isfinite(vector).all())


def unmasked(value: Any) -> Any:
    """Return masked numbers with NaN for what lies under the mask, and anything else as it is."""
    # Asked first, since numpy loads its masked arrays when they are named.
    if not hasattr(value, "mask") or not np.ma.isMaskedArray(value) or value.dtype.kind not in "fiu":
        return value
    return np.where(np.ma.getmaskarray(value), np.nan, np.ma.getdata(value))


def holds_truth(value: Any) -> bool:
    """Whether a list has True or False among its entries, which numpy would take for 1 and 0 beside numbers."""
    return isinstance(value, (bool, np.bool_)) or (isinstance(value, (list, tuple)) and any(map(holds_truth, value)))


def kind_of_entries(dtype: np.dtype[Any]) -> str:
    """Return what an array holds that does not hold real numbers, for a message."""
    return {"b": "booleans", "c": "complex numbers", "U": "text"}.get(dtype.kind, "entries that are no numbers")


def require_no_overflow(numbers: Any, what: str, path: str) -> None:
    """Raise `SpecError` where one of some finite numbers is beyond `LARGEST`; ``what`` has it, as a message says."""
    entries = np.ravel(np.asarray(numbers, dtype=np.float64))
    if entries.size and np.abs(entries).max() > LARGEST:
        raise SpecError(
            f"{what} {'has' if np.ndim(numbers) else 'is'} {entries[int(np.argmax(np.abs(entries)))]:.3g}, but numbers "
            f"beyond {LARGEST:g} overflow where they are multiplied: give it in other units.",
            path=path,
        )


def as_given(value: Any, name: str, ragged: str) -> NDArray[Any]:
    """Return what a caller gives as an array of any kind; raise `SpecError` where it is none, ``ragged`` where its rows
    have different lengths."""
    value = require_plain(value, name)
    try:
        return np.asarray(unmasked(value))
    except ValueError:
        raise SpecError(ragged, path=name) from None
    except (TypeError, RuntimeError) as error:
        # Arrays of other libraries may refuse, with a reason of their own.
        raise SpecError(f"{name} is a {type(value).__name__} that is no array: {error}.", path=name) from error


def dimensions_of(value: Any, name: str) -> int:
    """Return how many dimensions an array has that a caller gives; raise `SpecError` where it is none."""
    return as_given(value, name, f"{name} has rows of different lengths: give a full matrix.").ndim


def require_readable(entries: float) -> None:
    """Raise `ValueError` for more entries of a file than are read."""
    if entries > MAXIMUM_ENTRIES:
        raise ValueError(f"it is too large ({entries:.1e} entries)")


def identity_missed(product: FloatArray, size: FloatArray) -> float:
    """Return by how much a product misses the identity, beside the sizes ``(n, n)`` of its terms."""
    return float(np.max(np.abs(product - np.eye(len(product))) / np.maximum(size, 1.0), initial=0.0))


def as_matrix(value: Any, name: str) -> FloatArray:
    """Convert nested lists, an array or a scalar to a finite, read-only real matrix; raise `SpecError` naming it."""
    raw = real_entries(as_given(value, name, f"{name} has rows of different lengths: give a full matrix."))
    truths = holds_truth(value)
    if raw.dtype.kind not in "fiu" or truths:
        if raw.size == 0:
            raw = raw.astype(np.float64)
        else:
            kind = "booleans" if truths else kind_of_entries(raw.dtype)
            raise SpecError(f"{name} holds {kind}: every entry must be a real number.", path=name)
    if raw.ndim == 0:
        raw = raw.reshape(1, 1)
    if raw.ndim != 2:
        raise SpecError(f"{name} has {counted(raw.ndim, 'dimension')}: {_as_rows(raw, name)}.", path=name)
    matrix = raw.astype(np.float64)
    finite = np.isfinite(matrix)
    if not finite.all():
        row, column = (int(i) + 1 for i in np.argwhere(~finite)[0])
        entry = matrix[row - 1, column - 1]
        raise SpecError(f"{name} has {entry} in row {row}, column {column}: every entry must be finite.", path=name)
    return read_only(matrix)


def matrix_or_multiple_of_identity(value: Any, size: int, name: str) -> FloatArray:
    """Return a matrix as `as_matrix` does; a number stands for so many times the identity ``(size, size)``."""
    matrix = as_matrix(value, name)
    return float(matrix[0, 0]) * np.eye(size) if np.ndim(value) == 0 else matrix


def whole_numbers(values: Any, name: str, *, below: float = math.inf) -> NDArray[np.int64]:
    """Return stored counts, or positions below a limit; raise `SpecError` for negative numbers and fractions, which
    another reader might take in another way."""
    stored = np.asarray(values)
    truths = isinstance(values, list) and any(isinstance(entry, bool) for entry in values)
    if stored.size and (
        stored.ndim != 1
        or stored.dtype.kind not in "iuf"
        or truths
        or not ((stored >= 0) & (stored < below) & (stored % 1 == 0)).all()
    ):
        raise SpecError(f"{name}: whole numbers from 0 on{'' if below == math.inf else f', below {below}'}.", path=name)
    return stored.ravel().astype(np.int64)


def require_entries_once(rows: NDArray[np.int64], columns: NDArray[np.int64], values: FloatArray, width: int) -> None:
    """Raise `SpecError` unless entries of a stored matrix have one value each, and none is stored twice."""
    if not rows.shape == columns.shape == values.shape:
        raise SpecError("Entries of a matrix: as many rows and columns as values.", path="values")
    if len(np.unique(rows * width + columns)) < len(rows):
        raise SpecError("Entries of a matrix: one is stored twice.", path="rows")


def real_entries(raw: NDArray[Any]) -> NDArray[Any]:
    """Return an array of fractions, decimals or numbers of sympy in double precision, and one of complex numbers
    without imaginary parts as its real part; any other as it is."""
    if raw.dtype.kind == "c" and not np.any(raw.imag):
        return np.asarray(raw.real)
    if raw.dtype.kind != "O" or not raw.size or any(map(_is_no_real_number, raw.flat)):
        return raw
    # Symbols without a value and complex numbers of sympy refuse, each in its own words.
    try:
        return np.array([float(entry) for entry in raw.flat if hasattr(entry, "__float__")]).reshape(raw.shape)
    except (TypeError, ValueError, OverflowError):
        return raw


def _is_no_real_number(entry: Any) -> bool:
    """Whether numpy makes a number of an entry that is none: truths, texts, complex numbers, and quantities."""
    return isinstance(entry, (bool, np.bool_, str, np.complexfloating)) or unit_of(entry) is not None


def _as_rows(vector: NDArray[Any], name: str) -> str:
    """Return how an array that is no matrix is written as one: a short vector as a column, a row or a diagonal."""
    if vector.ndim != 1 or not 0 < vector.size <= LONGEST_EXAMPLE:
        return "give a matrix (a list of rows)"
    entries = [str(entry) for entry in vector.tolist()]
    column = ", ".join(f"[{entry}]" for entry in entries)
    listed = ", ".join(entries)
    diagonal = f", or {name}=numpy.diag([{listed}]) for a diagonal" if vector.size > 1 else ""
    return f"give a list of rows, {name}=[{column}] for a column or {name}=[[{listed}]] for a row{diagonal}"


def reachable(matrix: FloatArray) -> NDArray[np.bool_]:
    """Return which entries some power of a matrix ``(n, n)`` may have, by its pattern alone; the power zero counts."""
    reached: NDArray[np.bool_] = np.eye(len(matrix), dtype=bool) | (matrix != 0.0)
    while not reached.all():
        # Paths of twice the length.
        further = reached.astype(np.float64) @ reached > 0.0
        if np.array_equal(further, reached):
            break
        reached = further
    return reached
