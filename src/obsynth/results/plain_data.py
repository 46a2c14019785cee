"""Large gain sets as a zip of two members: the JSON document, and its arrays as ``.npz``; no pickles.

Both members are stored uncompressed, with a fixed date: the same design gives the same bytes.

Numbers, arrays and mappings as JSON data and back, bit for bit, and the digest of such data.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import zipfile
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from obsynth.errors import SpecError

DOCUMENT, ARRAYS = "gain_set.json", "arrays.npz"
#: Marks an array that is a member, by its name; see the marks of `obsynth.results.gain_sets`.
MEMBER = {"member"}
#: Arrays with fewer numbers stay in the document, where they can be read.
SMALL_ARRAY = 64
#: Larger members are refused before they fill the memory.
MAXIMUM_BYTES = 4_000_000_000
_DATE = (1980, 1, 1, 0, 0, 0)


def is_packed(start: bytes) -> bool:
    """Whether a file that begins so is a zip."""
    return start.startswith(b"PK\x03\x04")


def count_of_numbers(value: Any) -> int:
    """Return how many numbers the arrays in nested data hold."""
    if isinstance(value, np.ndarray):
        return int(value.size)
    if isinstance(value, Mapping):
        return sum(map(count_of_numbers, value.values()))
    return sum(map(count_of_numbers, value)) if isinstance(value, (list, tuple)) else 0


def split(body: Mapping[str, Any], plain: Callable[[Any], Any]) -> tuple[Any, bytes]:
    """Return plain data in which large arrays are named, and the ``.npz`` that holds them."""
    arrays: dict[str, np.ndarray] = {}

    def named(value: Any) -> Any:
        if isinstance(value, np.ndarray) and value.size >= SMALL_ARRAY and value.dtype == np.float64:
            name = f"array{len(arrays):05d}"
            arrays[name] = value
            return {"member": name}
        if isinstance(value, Mapping):
            entries = {str(key): named(item) for key, item in value.items()}
            return {"mapping": entries} if entries.keys() in _escaped() else entries
        return [named(item) for item in value] if isinstance(value, (list, tuple)) else plain(value)

    document = named(body)
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, array in arrays.items():
            part = io.BytesIO()
            np.lib.format.write_array(part, np.ascontiguousarray(array), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy", _DATE), part.getvalue())
    return document, stream.getvalue()


def _escaped() -> tuple[set[str], ...]:
    return ({"shape", "data"}, {"float"}, {"mapping"}, MEMBER)


def digest_of_both(document: Any, arrays: bytes) -> str:
    """Return the sha256 digest of the canonical JSON and of the arrays."""
    text = json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(hashlib.sha256(arrays).digest() + text.encode()).hexdigest()


def packed(document: Mapping[str, Any], arrays: bytes) -> bytes:
    """Return the zip of both members."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr(zipfile.ZipInfo(DOCUMENT, _DATE), json.dumps(document, indent=1, allow_nan=False) + "\n")
        archive.writestr(zipfile.ZipInfo(ARRAYS, _DATE), arrays)
    return stream.getvalue()


def unpacked(content: bytes) -> tuple[str, bytes]:
    """Return the text of the document and the arrays; raise `ValueError` for any other zip."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            if sorted(archive.namelist()) != sorted([DOCUMENT, ARRAYS]):
                raise ValueError("it does not hold the two members of a gain set")
            if sum(item.file_size for item in archive.infolist()) > MAXIMUM_BYTES:
                raise ValueError("it is too large")
            return archive.read(DOCUMENT).decode("utf-8"), archive.read(ARRAYS)
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError, OSError) as error:
        raise ValueError(f"it is damaged ({error})") from error


def with_arrays(value: Any, arrays: bytes) -> Any:
    """Return plain data with named arrays put back; raise `ValueError` where one is missing or damaged."""
    try:
        with np.load(io.BytesIO(arrays), allow_pickle=False) as archive:
            found = {name: np.asarray(archive[name], dtype=np.float64) for name in archive.files}
    except (zipfile.BadZipFile, EOFError, OSError) as error:
        raise ValueError(f"its arrays are damaged ({error})") from error

    def restored(part: Any) -> Any:
        if isinstance(part, dict):
            if part.keys() == MEMBER:
                return found[part["member"]]
            if part.keys() == {"mapping"}:
                # Its keys only look like a mark.
                return {"mapping": {key: restored(item) for key, item in part["mapping"].items()}}
            return {key: restored(item) for key, item in part.items()}
        return [restored(item) for item in part] if isinstance(part, list) else part

    return restored(value)


# What JSON does not have is marked by these sets of keys; a mapping that happens to have one of them is wrapped.
_ARRAY, _FLOAT, _MAPPING = {"shape", "data"}, {"float"}, {"mapping"}
_MARKS = (_ARRAY, _FLOAT, _MAPPING, MEMBER)


def plain(value: Any) -> Any:
    """Return ``value`` as JSON data; arrays, NaN and infinities are marked so that `restored` finds them."""
    if isinstance(value, np.ndarray):
        return {"shape": list(value.shape), "data": [plain(x) for x in value.ravel().tolist()]}
    if isinstance(value, (np.floating, np.integer, np.bool_)):
        return plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return {"float": str(value)}
    if isinstance(value, Mapping):
        entries = {str(key): plain(item) for key, item in value.items()}
        return {"mapping": entries} if entries.keys() in _MARKS else entries
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise SpecError(f"A value of type {type(value).__name__} cannot be saved: only data can.")


def restored(value: Any) -> Any:
    """Return what `plain` wrote, with arrays and special floats restored."""
    if isinstance(value, dict):
        if value.keys() == _ARRAY:
            data = [restored(item) for item in value["data"]]
            if not {type(item) for item in data} <= {float, int}:
                raise TypeError("an array holds something that is no number")
            return np.array(data, dtype=np.float64).reshape(value["shape"])
        if value.keys() == _FLOAT:
            return float(value["float"])
        if value.keys() == _MAPPING:
            value = value["mapping"]
        return {key: restored(item) for key, item in value.items()}
    if isinstance(value, list):
        return [restored(item) for item in value]
    return value


def digest_of(body: Mapping[str, Any]) -> str:
    """Return the sha256 digest of the canonical JSON of ``body``."""
    text = json.dumps(body, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()
