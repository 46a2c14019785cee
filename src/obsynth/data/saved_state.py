"""The saved state of a run, so that it can stop and go on."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from obsynth.data.job import Job, damaged_state
from obsynth.errors import SpecError
from obsynth.files.inputs import read_json
from obsynth.files.outputs import FileKind, write_atomically
from obsynth.numerics.arguments import is_finite_number, is_number
from obsynth.observers.running import BY_COLUMNS
from obsynth.results.design import ObserverDesign
from obsynth.results.gain_sets import digest_of, gain_set_digest, plain, restored

KIND = "obsynth run state"
SCHEMA_VERSION = 4
STATE = FileKind("a saved state of obsynth", rb'\A\s*\{\s*"kind":\s*"obsynth run state"')

#: Parts that are seconds, or nothing before the first row.
_TIMES = frozenset({"last", "longest"})


def digest_of_gains(design: ObserverDesign) -> str:
    """Return the sha256 digest of a gain set, as in its file."""
    return gain_set_digest(design)


def save_state(path: Path, job: Job, digest: str) -> None:
    """Write what a run carries from row to row, atomically."""
    body = plain({"gains": digest, "state": job.as_dict()})
    document = {"kind": KIND, "schema_version": SCHEMA_VERSION, "sha256": digest_of(body), "run": body}
    write_atomically(path, json.dumps(document, indent=1, allow_nan=False) + "\n")


def resume_state(path: Path, job: Job, digest: str) -> None:
    """Let a run go on from a saved state."""
    # The state is written again at the end, so it is no input that has to be kept.
    document = read_json(path, is_protected=False)
    known = isinstance(document, dict) and document.get("kind") == KIND
    if not known or document.get("schema_version") != SCHEMA_VERSION:
        raise SpecError(f"{path} is no saved state of a run.", path=str(path))
    body = document.get("run")
    try:
        intact = isinstance(body, dict) and document.get("sha256") == digest_of(body)
    except (ValueError, RecursionError):  # a number too large for a float
        intact = False
    if not intact:
        raise SpecError(f"{path} was changed after it was written: its digest does not match.", path=str(path))
    if body.get("gains") != digest:
        raise SpecError(f"{path} is the state of a run with another gain set.", path=str(path))
    own = job.as_dict()
    try:
        state = restored(body.get("state"))
        job.resume(state)
        fits = _fits(own, state)
    except (AttributeError, LookupError, TypeError, ValueError, ArithmeticError):
        fits = False
    if not fits:
        raise damaged_state(path)
    job.resumed_from = path


def _fits(own: Any, saved: Any) -> bool:
    """Whether a saved state has the parts of a run's own one; what has no value yet may hold numbers and arrays."""
    if isinstance(own, np.ndarray):
        found = saved.get(BY_COLUMNS) if isinstance(saved, dict) else saved
        return isinstance(found, np.ndarray) and _alike(own.shape, found.shape)
    if isinstance(own, Mapping):
        if not isinstance(saved, dict) or saved.keys() != own.keys():
            return False
        return all(_fits(own[key], saved[key]) and _is_time(key, saved[key]) for key in own)
    if isinstance(own, (bool, np.bool_)):
        return isinstance(saved, bool)
    if isinstance(own, str):
        return isinstance(saved, str)
    if isinstance(own, (list, tuple)):
        return isinstance(saved, list)
    return saved is None or is_number(saved) or (own is None and isinstance(saved, (np.ndarray, dict, list)))


def _is_time(key: str, saved: Any) -> bool:
    return key not in _TIMES or saved is None or is_finite_number(saved)


def _alike(own: tuple[int, ...], saved: tuple[int, ...]) -> bool:
    """Whether an array can stand for another one: windows fill up, and factors of covariances change their width."""
    if len(own) == 2 and len(saved) == 2:
        return own[0] == saved[0] or own[1] == saved[1]
    return own == saved
