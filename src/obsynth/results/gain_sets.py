"""Gain sets on disk: one JSON document with a schema version and a digest, floats bit for bit."""

from __future__ import annotations

import errno
import json
import os
import re
from pathlib import Path
from typing import Any

from obsynth.analysis.transformations.recovery import StateRecovery
from obsynth.analysis.transformations.recovery_operator import RecoveryOperator
from obsynth.errors import SpecError
from obsynth.files.inputs import input_file, json_data, read_json
from obsynth.results.design import Certificate, ObserverDesign
from obsynth.results.gain_set_parts import checked_parts, made
from obsynth.results.gain_set_writing import (
    GAIN_SET,
    KIND,
    KINDS,
    SCHEMA_VERSION,
    design_as_dict,
    gain_set_bytes,
    gain_set_digest,
    place_of,
    save,
    types_of,
)
from obsynth.results.plain_data import (
    digest_of,
    digest_of_both,
    is_packed,
    plain,
    restored,
    unpacked,
    with_arrays,
)
from obsynth.results.plant_source import PlantSource
from obsynth.results.report import VerificationReport

__all__ = [
    "GAIN_SET", "SCHEMA_VERSION", "design_as_dict", "digest_of", "gain_set_bytes", "gain_set_digest", "load", "loaded",
    "place_of", "plain", "restored", "save", "written_for",
]  # fmt: skip

#: Schema 1 holds no plant as written and no bounds of stored numbers: what it lacks is assumed, or least found.
READABLE = (1, 2)
#: Larger gain sets are refused before they fill the memory.
MAXIMUM_CHARACTERS = 2_000_000_000
_HEAD_BYTES = 256


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
    if not isinstance(document, dict) or document.get("kind") != KIND:
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
        parts = checked_parts(restored(body if arrays is None else with_arrays(body, arrays)))
        return _design_from(parts, document["sha256"])
    except (SpecError, AttributeError, LookupError, TypeError, ValueError, ArithmeticError, RecursionError) as error:
        raise SpecError(f"{source} is incomplete: {str(error).rstrip('.')}.", path=source) from error


def _recovery_from(**data: Any) -> StateRecovery:
    names = tuple(data.pop("names"))
    if "operator" not in data:
        return StateRecovery(names=names, **data)
    operator = RecoveryOperator.from_dict(data["operator"])
    if operator.dynamic.shape[0] != len(names):
        raise ValueError(f"the recovery has {len(names)} names for {operator.dynamic.shape[0]} states")
    return StateRecovery.from_operator(names, operator, data["noise_kept"], data["operating_point"])


def _design_from(data: dict[str, Any], digest: str) -> ObserverDesign:
    if not isinstance(data.get("kind"), (str, type(None))) or data.get("kind") not in KINDS:
        raise SpecError(f"A design of the kind {data['kind']!r} is unknown to this obsynth.", path="kind")
    plant, observer = types_of(data.get("kind"))
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
        file_digest=digest,
    )
