"""Gain sets on disk: one JSON document with a schema version and a digest, floats bit for bit."""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from obsynth.errors import SpecError
from obsynth.files.inputs import input_file, json_data, path_of, read_json
from obsynth.numerics.arguments import arguments_checked, is_number
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.descriptor import DescriptorSystem, note_source
from obsynth.plants.transformations.recovery import StateRecovery
from obsynth.plants.transformations.recovery_operator import RecoveryOperator
from obsynth.results.design import Certificate, ObserverDesign
from obsynth.results.gain_set_writing import (
    ARRAYS,
    DESIGN_KINDS,
    DOCUMENT,
    GAIN_SET_KIND,
    GAIN_SET_VERSION,
    digest_of,
    restored,
    types_of,
)
from obsynth.results.plant_source import PlantSource
from obsynth.results.verification_report import VerificationReport

#: Larger files are refused before they fill the memory.
MAXIMUM_BYTES = 4_000_000_000

#: Larger gain sets are refused before they fill the memory.
MOST_GAIN_SET_CHARACTERS = 2_000_000_000

_HEAD_BYTES = 256

#: How names of gain sets end, as a rule, by which those in a folder are found.
GAIN_SET_SUFFIXES = (".gains.json",)

_Made = TypeVar("_Made")

#: What a file of proofs says it is.
PROOF_FORMAT = "obsynth-proof"

#: How a gain set comes to be: what to do about a file that is none.
HOW_WRITTEN = "Write one with obsynth design --system SPEC --output FILE, or ObserverDesign.save."

#: Kinds of results that are certified with the gain sets that they rest on.
ROBUSTNESS, STUDY, COMPARISON = "obsynth robustness", "obsynth tolerance study", "obsynth comparison"

#: The type of every part that a gain set has, in words and as a test.
_TYPES: Mapping[str, tuple[str, Callable[[Any], bool]]] = {
    **dict.fromkeys(("name", "method"), ("a text", lambda value: isinstance(value, str))),
    **dict.fromkeys(
        ("plant", "options", "observer", "solver", "report"), ("a mapping", lambda value: isinstance(value, dict))
    ),
    "gains": ("a mapping to arrays of numbers", lambda value: _is_mapping_to(value, _is_array)),
    "certificate": ("matrices and claims that are numbers", lambda value: _is_certificate(value)),
    "notes": ("a list of texts", lambda value: _is_texts(value)),
    "recovery": ("maps with the names of states, or nothing", lambda value: value is None or _is_recovery(value)),
}


def written_for(gains: Path) -> str | None:
    """Return the digest of the place of the spec for which a gain set was written, `None` where it is not known."""
    if not gains.is_file():  # a pipe would keep us waiting
        return None
    with gains.open("rb") as stream:
        match = re.search(rb'"written_for":\s*"([0-9a-f]+)"', stream.read(_HEAD_BYTES))
    return None if match is None else match.group(1).decode()


@arguments_checked
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

    Examples
    --------
    >>> import obsynth
    >>> from tempfile import TemporaryDirectory
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> with TemporaryDirectory() as folder:
    ...     _ = obsynth.fault_estimation_filter(plant).save(f"{folder}/my.gains.json")
    ...     print(obsynth.load(f"{folder}/my.gains.json").method)
    fault-estimation-filter
    """
    source = path_of(path)
    document, arrays = _read_members(source)
    return _design_of(document, arrays, str(source))


def is_packed(start: bytes) -> bool:
    """Whether a file that begins so is a zip."""
    return start.startswith(b"PK\x03\x04")


def _require_stored(archive: zipfile.ZipFile) -> None:
    """Raise `ValueError` for a zip that unpacks to more than it has, as no gain set does."""
    if any(item.compress_type != zipfile.ZIP_STORED for item in archive.infolist()):
        raise ValueError("it is compressed, as no gain set is")


def unpacked(content: bytes) -> tuple[str, bytes]:
    """Return the text of the document and the arrays; raise `ValueError` for any other zip."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            if sorted(archive.namelist()) != sorted([DOCUMENT, ARRAYS]):
                raise ValueError("it does not hold the two members of a gain set")
            _require_stored(archive)
            return archive.read(DOCUMENT).decode("utf-8"), archive.read(ARRAYS)
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError, OSError) as error:
        raise ValueError(f"it is damaged ({error})") from error


def loaded(content: bytes, name: str = "the gain set") -> ObserverDesign:
    """Return the design in what `gain_set_bytes` returned."""
    try:
        text, arrays = unpacked(content) if is_packed(content) else (content.decode("utf-8"), None)
        document = json_data(text)
    except ValueError as error:
        raise SpecError(f"{name} is no gain set of obsynth ({error}). {HOW_WRITTEN}", path=name) from error
    return _design_of(document, arrays, name)


def _read_members(source: Path) -> tuple[Any, bytes | None]:
    """Return the document of a gain set and, where they are apart, its arrays."""
    file = input_file(source, suffixes=GAIN_SET_SUFFIXES)
    with file.open("rb") as stream:
        start = stream.read(_HEAD_BYTES)
    if not is_packed(start):
        return read_json(source, most=MOST_GAIN_SET_CHARACTERS), None
    try:
        if file.stat().st_size > MAXIMUM_BYTES:
            raise ValueError("it is too large")
        text, arrays = unpacked(file.read_bytes())
        return json_data(text), arrays
    except (ValueError, RecursionError) as error:
        raise SpecError(f"{source} is no gain set of obsynth: {error}. {HOW_WRITTEN}", path=str(source)) from error


def _design_of(document: Any, arrays: bytes | None, source: str) -> ObserverDesign:
    """Return the design in a document whose digest is right."""
    if isinstance(document, dict) and document.get("format") == PROOF_FORMAT:
        raise SpecError(
            f"{source} is a proof, not a gain set. Check it by `obsynth verify {source} --independent`.", path=source
        )
    if not isinstance(document, dict) or document.get("kind") != GAIN_SET_KIND:
        raise SpecError(f"{source} is no gain set of obsynth. {HOW_WRITTEN}", path=source)
    if document.get("schema_version") != GAIN_SET_VERSION:
        version = document.get("schema_version")
        raise SpecError(
            f"{source} has schema version {version!r}; this obsynth reads {GAIN_SET_VERSION}.",
            path=source,
        )
    body = document.get("design")
    try:
        intact = isinstance(body, dict) and document.get("sha256") == digest_of(body, arrays)
    except (ValueError, RecursionError):  # a number too large for a float
        intact = False
    if not intact:
        raise SpecError(f"{source} was changed after it was written: its digest does not match.", path=source)
    try:
        parts = _checked_parts(restored(body, None if arrays is None else _arrays_in(arrays)))
        return _design_from(parts)
    except (SpecError, AttributeError, LookupError, TypeError, ValueError, ArithmeticError, RecursionError) as error:
        raise SpecError(f"{source} is incomplete: {str(error).rstrip('.')}.", path=source) from error


def _arrays_in(content: bytes) -> dict[str, FloatArray]:
    """Return arrays by name; raise `ValueError` where they are damaged."""
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            _require_stored(archive.zip)
            return {name: np.asarray(archive[name], dtype=np.float64) for name in archive.files}
    except (zipfile.BadZipFile, EOFError, OSError) as error:
        raise ValueError(f"its arrays are damaged ({error})") from error


def _recovery_from(plant: Any, data: dict[str, Any]) -> StateRecovery:
    """Return the recovery of the states that ``plant`` was made from; its maps fit the signals of that plant."""
    names = tuple(data["names"])
    if "operator" in data:
        operator = RecoveryOperator.from_dict(data["operator"])
        if operator.dynamic.shape[0] != len(names):
            raise SpecError(f"it has {len(names)} names for {operator.dynamic.shape[0]} states")
        return StateRecovery.from_operator(names, operator, data["noise_kept"], data["operating_point"])
    recovery = StateRecovery(**{**data, "names": names})
    columns = {"state": plant.nx, "input": plant.nu}
    # A plant that changes with k has parameters and Q instead.
    if isinstance(plant, DescriptorSystem):
        columns |= {"fault": plant.nf, "disturbance": plant.nd, "noise": plant.nw}
    for signal, count in columns.items():
        rows, own = getattr(recovery, f"from_{signal}").shape
        if (rows, own) != (len(names), count):
            raise SpecError(f"from_{signal} is {rows} by {own}, but {len(names)} by {count} is needed")
    if "noise" in columns and recovery.noise_kept.shape[1] != plant.nw:
        raise SpecError(f"noise_kept has {recovery.noise_kept.shape[1]} columns, but {plant.nw} are needed")
    return recovery


def _design_from(data: dict[str, Any]) -> ObserverDesign:
    if not isinstance(data.get("kind"), (str, type(None))) or data.get("kind") not in DESIGN_KINDS:
        raise SpecError(f"A design of the kind {data['kind']!r} is unknown to this obsynth.", path="kind")
    kind, observer = types_of(data.get("kind"))
    plant, recovery = _made_from("plant", kind, **data["plant"]), data["recovery"]
    source = None if data.get("source") is None else _made_from("source", PlantSource.from_dict, data["source"])
    if source is not None and isinstance(plant, DescriptorSystem):
        # What a disturbance may do between samples follows from the plant as written; `verify` compares both.
        note_source(source.plant, plant, sample_time=source.sample_time)
    return ObserverDesign(
        name=data["name"],
        method=data["method"],
        plant=plant,
        options=data["options"],
        gains=data["gains"],
        observer=_made_from("observer", observer.from_dict, data["observer"]),
        certificate=_made_from("certificate", Certificate, **data["certificate"]),
        solver=data["solver"],
        notes=tuple(data["notes"]),
        recovery=None if recovery is None else _made_from("recovery", _recovery_from, plant, recovery),
        report=_made_from("report", VerificationReport.from_dict, data["report"]),
        source=source,
        input_delay=data.get("input_delay", 0),
    )


def _checked_parts(body: Any) -> dict[str, Any]:
    """Return the content of a gain set if it has every part, each of its type; raise `SpecError` for the first."""
    if not isinstance(body, dict):
        raise SpecError("it holds no design")
    for name, (expected, fits) in _TYPES.items():
        if name not in body:
            raise SpecError(f"{name!r} is missing")
        if not fits(body[name]):
            subject = f"{name} is {body[name]!r}, not" if name in ("name", "method") else f"its {name} must be"
            raise SpecError(f"{subject} {expected}")
    return body


def _made_from(part: str, make: Callable[..., _Made], *values: Any, **named: Any) -> _Made:
    """Return what a part describes; what cannot be made of it is a `SpecError`."""
    try:
        return make(*values, **named)
    except SpecError as error:
        raise SpecError(f"its {part} is refused: {str(error).rstrip('.')}") from error
    except KeyError as error:
        raise SpecError(f"its {part} has no {error}") from error
    except (AttributeError, IndexError, TypeError, ValueError, ArithmeticError) as error:
        raise SpecError(f"its {part} is damaged") from error


def _is_array(value: Any) -> bool:
    return isinstance(value, np.ndarray)


def _is_texts(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(item, str) for item in value)


def _is_mapping_to(value: Any, fits: Callable[[Any], bool]) -> bool:
    return isinstance(value, dict) and all(fits(item) for item in value.values())


def _is_certificate(value: Any) -> bool:
    return (
        isinstance(value, dict)
        and _is_mapping_to(value.get("matrices"), _is_array)
        and _is_mapping_to(value.get("claims"), is_number)
    )


def _is_recovery(value: Any) -> bool:
    if not isinstance(value, dict) or not _is_texts(value.get("names")):
        return False
    return all(_is_array(item) and item.ndim == 2 for key, item in value.items() if key.startswith(("from_", "noise_")))
