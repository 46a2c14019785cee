"""From a design to the file that holds it: one JSON document with a schema version and a digest.

Designs are taken as they come (`obsynth.results.design` stands above this module, since a design saves itself).
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import fields
from pathlib import Path
from typing import Any

from obsynth.analysis.transformations.recovery import StateRecovery
from obsynth.files.outputs import FileKind, write_atomically
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.plain_data import count_of_numbers, digest_of, digest_of_both, packed, plain, split

SCHEMA_VERSION = 2
KIND = "obsynth gain set"
_PLACE_DIGITS = 16
GAIN_SET = FileKind(
    "a gain set",
    rb'\A(PK\x03\x04[\s\S]{26}gain_set\.json)?\s*\{\s*"kind":\s*"obsynth gain set"',
    ending=".gains.json",
)
#: Tags of kinds of designs; linear time-invariant ones have none.
KINDS = (None, "recursive", "dae")
#: From so many numbers on, which are more than a megabyte as text, the arrays of a gain set are a binary member.
MANY_NUMBERS = 50_000


def design_as_dict(design: Any) -> dict[str, Any]:
    """Return the whole gain set as JSON data, digest included."""
    body = plain(_body_of(design))
    return {"kind": KIND, "schema_version": SCHEMA_VERSION, "sha256": digest_of(body), "design": body}


def _body_of(design: Any) -> dict[str, Any]:
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


def types_of(kind: str | None) -> tuple[Any, Any]:
    """Return the types of plant and observer of a kind; only those asked for are loaded."""
    if kind == "recursive":
        from obsynth.observers.recursive.observer import RecursiveObserver
        from obsynth.plants.time_varying import TimeVaryingDescriptorSystem

        return TimeVaryingDescriptorSystem, RecursiveObserver
    if kind == "dae":
        from obsynth.observers.dae.observer import DAEObserver
        from obsynth.plants.dae.model import DAEModel

        return DAEModel, DAEObserver
    return DescriptorSystem, LinearObserver


def _tag(design: Any) -> dict[str, str]:
    """Return the entry that tells of which kind plant and observer are."""
    found = next((kind for kind in KINDS if isinstance(design.observer, types_of(kind)[1])), None)
    return {} if found is None else {"kind": found}


def gain_set_bytes(design: Any, *, spec: Path | None = None) -> bytes:
    """Return what a file with a gain set holds: JSON, or of a large one a zip with its arrays in binary.

    With ``spec`` it remembers the place of that spec.
    """
    place = {} if spec is None else {"written_for": place_of(spec)}
    body = _body_of(design)
    if count_of_numbers(body) < MANY_NUMBERS:
        written = plain(body)
        document = {"schema_version": SCHEMA_VERSION, "sha256": digest_of(written), "design": written}
        return (json.dumps({"kind": KIND, **place, **document}, indent=1, allow_nan=False) + "\n").encode()
    written, arrays = split(body, plain)
    document = {"schema_version": SCHEMA_VERSION, "sha256": digest_of_both(written, arrays), "design": written}
    return packed({"kind": KIND, **place, **document}, arrays)


def gain_set_digest(design: Any) -> str:
    """Return the digest that the file of a design holds."""
    body = _body_of(design)
    if count_of_numbers(body) < MANY_NUMBERS:
        return digest_of(plain(body))
    return digest_of_both(*split(body, plain))


def save(design: Any, path: str | Path) -> Path:
    """Write ``design`` to ``path`` atomically and return the path."""
    return write_atomically(path, gain_set_bytes(design))


def place_of(spec: Path) -> str:
    """Return a short digest of where a spec is, which tells two specs of one name apart."""
    return hashlib.sha256(os.fsencode(spec.resolve())).hexdigest()[:_PLACE_DIGITS]


def _fields_of(record: StateRecovery) -> dict[str, Any]:
    if (operator := record.by_operator) is not None:
        # Sparse equations take less room than the map that they stand for.
        return {
            "names": record.names, "noise_kept": record.noise_kept, "operating_point": record.operating_point,
            "operator": operator.as_dict(),
        }  # fmt: skip
    return {field.name: getattr(record, field.name) for field in fields(record)}
