"""Writing of gain sets: a design as a JSON document with a schema version and a digest.

Large ones are a zip of the document and its arrays as ``.npz``, uncompressed and with a fixed date: the same design
gives the same bytes.  Designs are taken as they come (`obsynth.results.design` stands above this module).
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import zipfile
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.files.outputs import FileKind, write_atomically
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.nonlinear.observer import DAEObserver
from obsynth.observers.nonlinear.region_observer import RegionObserver
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.scheduled.observer import ScheduledObserver
from obsynth.observers.window.observer import WindowObserver
from obsynth.plants.dae import DAEModel
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.plants.transformations.recovery import StateRecovery

GAIN_SET_VERSION = 1

GAIN_SET_KIND = "obsynth gain set"

_PLACE_DIGITS = 16

GAIN_SET = FileKind(
    "a gain set",
    rb'\A(PK\x03\x04[\s\S]{26}gain_set\.json)?\s*\{\s*"kind":\s*"obsynth gain set"',
    ending=".gains.json",
    suffix=".json",
)

#: Tags of kinds of designs; linear time-invariant ones have none.
DESIGN_KINDS = (None, "recursive", "dae", "window", "scheduled", "region")

#: From so many numbers on, which are more than a megabyte as text, the arrays of a gain set are a binary member.
MANY_NUMBERS = 50_000

DOCUMENT, ARRAYS = "gain_set.json", "arrays.npz"

#: Arrays with fewer numbers stay in the document of a packed gain set, where they can be read.
SMALL_ARRAY = 64

_DATE = (1980, 1, 1, 0, 0, 0)

# What JSON does not have is marked by these sets of keys; a mapping that happens to have one of them is wrapped.
_ARRAY, _FLOAT, _MAPPING, _MEMBER = {"shape", "data"}, {"float"}, {"mapping"}, {"member"}

_MARKS = (_ARRAY, _FLOAT, _MAPPING, _MEMBER)


def design_as_dict(design: Any) -> dict[str, Any]:
    """Return the whole gain set as JSON data, digest included."""
    body = plain(_body_of(design))
    return {"kind": GAIN_SET_KIND, "schema_version": GAIN_SET_VERSION, "sha256": digest_of(body), "design": body}


def gain_set_bytes(design: Any, *, spec: Path | None = None) -> bytes:
    """Return what a file with a gain set holds; with ``spec`` it remembers the place of that spec."""
    body, arrays, digest = _written(design)
    place = {} if spec is None else {"written_for": place_of(spec)}
    document = {"kind": GAIN_SET_KIND, **place, "schema_version": GAIN_SET_VERSION, "sha256": digest, "design": body}
    text = json.dumps(document, indent=1, allow_nan=False) + "\n"
    return text.encode() if arrays is None else _zipped({DOCUMENT: text, ARRAYS: arrays})


def gain_set_digest(design: Any) -> str:
    """Return the digest that the file of a design holds."""
    return _written(design)[2]


def _written(design: Any) -> tuple[Any, bytes | None, str]:
    """Return what a gain set says, its arrays where they are apart, and the digest of both."""
    body = _body_of(design)
    apart: dict[str, FloatArray] | None = {} if count_of_numbers(body) >= MANY_NUMBERS else None
    document, arrays = plain(body, apart), None
    if apart is not None:
        members: dict[str, bytes] = {}
        for name, array in apart.items():
            part = io.BytesIO()
            np.lib.format.write_array(part, np.ascontiguousarray(array), allow_pickle=False)
            members[f"{name}.npy"] = part.getvalue()
        arrays = _zipped(members)
    return document, arrays, digest_of(document, arrays)


def _zipped(members: Mapping[str, str | bytes]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, content in members.items():
            archive.writestr(zipfile.ZipInfo(name, _DATE), content)
    return stream.getvalue()


def _body_of(design: Any) -> dict[str, Any]:
    """Return everything that a gain set holds, with arrays."""
    kind = next((kind for kind in DESIGN_KINDS if isinstance(design.observer, types_of(kind)[1])), None)
    return {
        "name": design.name,
        "method": design.method,
        "plant": design.plant.as_dict(),
        "options": design.options,
        "gains": design.gains,
        "observer": design.observer.as_dict(),
        "certificate": {"matrices": design.certificate.matrices, "claims": design.certificate.claims},
        "solver": design.solver,
        "notes": design.notes,
        "recovery": None if design.recovery is None else _fields_of(design.recovery),
        "report": design.report.as_dict(),
        "source": None if design.source is None else design.source.as_dict(),
        **({"input_delay": design.input_delay} if design.input_delay else {}),
        **({} if kind is None else {"kind": kind}),
    }


def types_of(kind: str | None) -> tuple[Any, Any]:
    """Return the types of plant and observer of a kind."""
    types: dict[str | None, tuple[Any, Any]] = {
        "recursive": (TimeVaryingDescriptorSystem, RecursiveObserver),
        "window": (TimeVaryingDescriptorSystem, WindowObserver),
        "dae": (DAEModel, DAEObserver),
        "scheduled": (PolytopicSystem, ScheduledObserver),
        "region": (DAEModel, RegionObserver),
    }
    return types.get(kind, (DescriptorSystem, LinearObserver))


def _fields_of(record: StateRecovery) -> dict[str, Any]:
    if (operator := record.by_operator) is not None:
        # Sparse equations take less room than the map that they stand for.
        return {
            "names": record.names,
            "noise_kept": record.noise_kept,
            "operating_point": record.operating_point,
            "operator": operator.as_dict(),
        }
    return {field.name: getattr(record, field.name) for field in fields(record)}


def save(design: Any, path: str | Path) -> Path:
    """Write ``design`` to ``path`` atomically and return the path."""
    return write_atomically(path, gain_set_bytes(design), kind=GAIN_SET)


def place_of(spec: Path) -> str:
    """Return a short digest of where a spec is, which tells two specs of one name apart."""
    return hashlib.sha256(os.fsencode(spec.resolve())).hexdigest()[:_PLACE_DIGITS]


def count_of_numbers(value: Any) -> int:
    """Return how many numbers the arrays in nested data hold."""
    if isinstance(value, np.ndarray):
        return int(value.size)
    if isinstance(value, Mapping):
        return sum(map(count_of_numbers, value.values()))
    return sum(map(count_of_numbers, value)) if isinstance(value, (list, tuple)) else 0


def plain(value: Any, arrays: dict[str, FloatArray] | None = None) -> Any:
    """Return ``value`` as JSON data, arrays (large ones in ``arrays``), NaN, infinities marked for `restored`."""
    kind = type(value)
    if kind is str or (kind is float and math.isfinite(value)):
        # Most values by far, and asking whether one is a mapping takes longest.
        return value
    if isinstance(value, np.ndarray):
        if arrays is not None and value.size >= SMALL_ARRAY and value.dtype == np.float64:
            name = f"array{len(arrays):05d}"
            arrays[name] = value
            return {"member": name}
        data = value.ravel().tolist()
        finite = value.dtype == np.float64 and bool(np.isfinite(value).all())
        return {"shape": list(value.shape), "data": data if finite else [plain(x) for x in data]}
    if isinstance(value, (np.floating, np.integer, np.bool_)):
        return plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return {"float": str(value)}
    if isinstance(value, Mapping):
        entries = {str(key): plain(item, arrays) for key, item in value.items()}
        return {"mapping": entries} if entries.keys() in _MARKS else entries
    if isinstance(value, (list, tuple)):
        return [plain(item, arrays) for item in value]
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise SpecError(f"A value of type {type(value).__name__} cannot be saved: only data can.")


def restored(value: Any, arrays: Mapping[str, FloatArray] | None = None) -> Any:
    """Return what `plain` wrote, with arrays and special floats restored."""
    if isinstance(value, dict):
        if value.keys() == _ARRAY:
            data = [restored(item) for item in value["data"]]
            if not {type(item) for item in data} <= {float, int}:
                raise TypeError("an array holds something that is no number")
            # A length of -1 is whatever fits, for numpy.
            if not all(type(length) is int and length >= 0 for length in value["shape"]):
                raise ValueError("an array has a shape that is none")
            return np.array(data, dtype=np.float64).reshape(value["shape"])
        if value.keys() == _MEMBER and arrays is not None:
            return arrays[value["member"]]
        if value.keys() == _FLOAT:
            return float(value["float"])
        if value.keys() == _MAPPING:
            value = value["mapping"]
        return {key: restored(item, arrays) for key, item in value.items()}
    return [restored(item, arrays) for item in value] if isinstance(value, list) else value


def digest_of(body: Any, arrays: bytes | None = None) -> str:
    """Return the sha256 digest of the canonical JSON of ``body``, and of its arrays where they are apart."""
    text = json.dumps(body, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()
    return hashlib.sha256(text if arrays is None else hashlib.sha256(arrays).digest() + text).hexdigest()
