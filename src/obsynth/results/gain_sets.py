"""Gain sets on disk: one JSON document with a schema version and a digest, floats bit for bit."""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import re
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from obsynth.analysis.transformations import StateRecovery
from obsynth.analysis.transformations.recovery_operator import RecoveryOperator
from obsynth.errors import SpecError
from obsynth.files.inputs import input_file, json_data, read_json
from obsynth.files.outputs import FileKind, write_atomically
from obsynth.observers.dae.observer import DAEObserver
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.plants.dae.model import DAEModel
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.results.binary_members import (
    MEMBER,
    count_of_numbers,
    digest_of_both,
    is_packed,
    packed,
    split,
    unpacked,
    with_arrays,
)
from obsynth.results.design import Certificate, ObserverDesign
from obsynth.results.gain_set_parts import checked_parts, made
from obsynth.results.plant_source import PlantSource
from obsynth.results.report import VerificationReport

SCHEMA_VERSION = 2
#: Schema 1 holds no plant as written and no bounds of stored numbers: what it lacks is assumed, or least found.
READABLE = (1, 2)
#: Larger gain sets are refused before they fill the memory.
MAXIMUM_CHARACTERS = 2_000_000_000
_KIND = "obsynth gain set"
_PLACE_DIGITS, _HEAD_BYTES = 16, 256
GAIN_SET = FileKind(
    "a gain set",
    rb'\A(PK\x03\x04[\s\S]{26}gain_set\.json)?\s*\{\s*"kind":\s*"obsynth gain set"',
    ending=".gains.json",
)
# Linear time-invariant designs have no tag.
_KINDS: dict[str | None, tuple[Any, Any]] = {
    None: (DescriptorSystem, LinearObserver), "recursive": (TimeVaryingDescriptorSystem, RecursiveObserver),
    "dae": (DAEModel, DAEObserver),
}  # fmt: skip
# What JSON does not have is marked by these sets of keys; a mapping that happens to have one of them is wrapped.
_ARRAY, _FLOAT, _MAPPING = {"shape", "data"}, {"float"}, {"mapping"}
_MARKS = (_ARRAY, _FLOAT, _MAPPING, MEMBER)
#: From so many numbers on, which are more than a megabyte as text, the arrays of a gain set are a binary member.
MANY_NUMBERS = 50_000


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


def design_as_dict(design: ObserverDesign) -> dict[str, Any]:
    """Return the whole gain set as JSON data, digest included."""
    body = plain(_body_of(design))
    return {"kind": _KIND, "schema_version": SCHEMA_VERSION, "sha256": digest_of(body), "design": body}


def _body_of(design: ObserverDesign) -> dict[str, Any]:
    """Return everything that a gain set holds, with arrays."""
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
        **_tag(design),
    }


def _tag(design: ObserverDesign) -> dict[str, str]:
    """Return the entry that tells of which kind plant and observer are."""
    kinds = [kind for kind, (_, observer) in _KINDS.items() if isinstance(design.observer, observer)]
    return {"kind": kinds[0]} if kinds and kinds[0] is not None else {}


def gain_set_bytes(design: ObserverDesign, *, spec: Path | None = None) -> bytes:
    """Return what a file with a gain set holds: JSON, or of a large one a zip with its arrays in binary.

    With ``spec`` it remembers the place of that spec.
    """
    place = {} if spec is None else {"written_for": place_of(spec)}
    body = _body_of(design)
    if count_of_numbers(body) < MANY_NUMBERS:
        written = plain(body)
        document = {"schema_version": SCHEMA_VERSION, "sha256": digest_of(written), "design": written}
        return (json.dumps({"kind": _KIND, **place, **document}, indent=1, allow_nan=False) + "\n").encode()
    written, arrays = split(body, plain)
    document = {"schema_version": SCHEMA_VERSION, "sha256": digest_of_both(written, arrays), "design": written}
    return packed({"kind": _KIND, **place, **document}, arrays)


def gain_set_digest(design: ObserverDesign) -> str:
    """Return the digest that the file of a design holds."""
    body = _body_of(design)
    if count_of_numbers(body) < MANY_NUMBERS:
        return digest_of(plain(body))
    return digest_of_both(*split(body, plain))


def save(design: ObserverDesign, path: str | Path) -> Path:
    """Write ``design`` to ``path`` atomically and return the path."""
    return write_atomically(path, gain_set_bytes(design))


def place_of(spec: Path) -> str:
    """Return a short digest of where a spec is, which tells two specs of one name apart."""
    return hashlib.sha256(os.fsencode(spec.resolve())).hexdigest()[:_PLACE_DIGITS]


def written_for(gains: Path) -> str | None:
    """Return the digest of the place of the spec for which a gain set was written, `None` where it is not known."""
    if not gains.is_file():  # a pipe would keep us waiting
        return None
    with gains.open("rb") as stream:
        found = re.search(rb'"written_for":\s*"([0-9a-f]+)"', stream.read(_HEAD_BYTES))
    return None if found is None else found.group(1).decode()


def load(path: str | Path) -> ObserverDesign:
    """Read a gain set and check its digest.

    Parameters
    ----------
    path : str or Path
        A file written by `ObserverDesign.save`.

    Returns
    -------
    ObserverDesign
        Equal to the saved one, bit for bit; its report is the saved one, run `verify` for a new one.

    Raises
    ------
    SpecError
        The file is missing, is no gain set, has an unknown schema version, or was changed.
    """
    if not isinstance(path, (str, os.PathLike)):
        raise SpecError(f"path is {path!r}: give the name of a file that a design was saved to.", path="path")
    source = Path(path)
    if source.is_dir() or not source.exists():
        why = os.strerror(errno.EISDIR if source.is_dir() else errno.ENOENT)
        raise SpecError(f"{source} cannot be read: {why}.", path=str(source))
    document, arrays = _read_members(source)
    return _design_of(document, arrays, str(source))


def loaded(content: bytes, name: str = "the gain set") -> ObserverDesign:
    """Return the design in what `gain_set_bytes` returned."""
    try:
        text, arrays = unpacked(content) if is_packed(content) else (content.decode("utf-8"), None)
        document = json.loads(text)
    except ValueError as error:
        raise SpecError(f"{name} is no gain set of obsynth ({error}).", path=name) from error
    return _design_of(document, arrays, name)


def _read_members(source: Path) -> tuple[Any, bytes | None]:
    """Return the document of a gain set and, where they are apart, its arrays."""
    file = input_file(source)
    with file.open("rb") as stream:
        start = stream.read(_HEAD_BYTES)
    if not is_packed(start):
        return read_json(source, most=MAXIMUM_CHARACTERS), None
    try:
        text, arrays = unpacked(file.read_bytes())
        return json_data(text), arrays
    except (ValueError, RecursionError) as error:
        raise SpecError(f"{source} is no gain set of obsynth: {error}.", path=str(source)) from error


def _design_of(document: Any, arrays: bytes | None, source: str) -> ObserverDesign:
    """Return the design in a document whose digest is right."""
    if not isinstance(document, dict) or document.get("kind") != _KIND:
        raise SpecError(f"{source} is no gain set of obsynth.", path=source)
    if document.get("schema_version") not in READABLE:
        version = document.get("schema_version")
        raise SpecError(
            f"{source} has schema version {version!r}; this obsynth reads {' and '.join(map(str, READABLE))}.",
            path=source,
        )
    body = document.get("design")
    try:
        digest = (
            None if not isinstance(body, dict) else digest_of(body) if arrays is None else digest_of_both(body, arrays)
        )
        intact = digest is not None and document.get("sha256") == digest
    except (ValueError, RecursionError):  # a number too large for a float
        intact = False
    if not intact:
        raise SpecError(f"{source} was changed after it was written: its digest does not match.", path=source)
    try:
        return _design_from(checked_parts(restored(body if arrays is None else with_arrays(body, arrays))))
    except (SpecError, AttributeError, LookupError, TypeError, ValueError, ArithmeticError, RecursionError) as error:
        raise SpecError(f"{source} is incomplete: {str(error).rstrip('.')}.", path=source) from error


def _fields_of(record: StateRecovery) -> dict[str, Any]:
    if (operator := record.by_operator) is not None:
        # Sparse equations take less room than the map that they stand for.
        return {
            "names": record.names, "noise_kept": record.noise_kept, "operating_point": record.operating_point,
            "operator": operator.as_dict(),
        }  # fmt: skip
    return {field.name: getattr(record, field.name) for field in fields(record)}


def _recovery_from(**data: Any) -> StateRecovery:
    names = tuple(data.pop("names"))
    if "operator" not in data:
        return StateRecovery(names=names, **data)
    operator = RecoveryOperator.from_dict(data["operator"])
    if operator.dynamic.shape[0] != len(names):
        raise ValueError(f"the recovery has {len(names)} names for {operator.dynamic.shape[0]} states")
    return StateRecovery.from_operator(names, operator, data["noise_kept"], data["operating_point"])


def _design_from(data: dict[str, Any]) -> ObserverDesign:
    if not isinstance(data.get("kind"), (str, type(None))) or data.get("kind") not in _KINDS:
        raise SpecError(f"A design of the kind {data['kind']!r} is unknown to this obsynth.", path="kind")
    plant, observer = _KINDS[data.get("kind")]
    recovery = data["recovery"]
    return ObserverDesign(
        name=data["name"],
        method=data["method"],
        plant=made("plant", plant, **data["plant"]),
        options=data["options"],
        gains=data["gains"],
        observer=made("observer", observer.from_dict, data["observer"]),
        certificate=made("certificate", Certificate, **data["certificate"]),
        solver=data["solver"],
        notes=tuple(data["notes"]),
        recovery=None if recovery is None else made("recovery", _recovery_from, **recovery),
        report=made("report", VerificationReport.from_dict, data["report"]),
        source=None if data.get("source") is None else made("source", PlantSource.from_dict, data["source"]),
    )
