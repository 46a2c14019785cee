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
from obsynth.results.gain_sets import digest_of, plain, restored

KIND = "obsynth run state"
SCHEMA_VERSION = 4
#: The schema before: states of recursive and nonlinear observers were laid out otherwise.
EARLIER = 3
STATE = FileKind("a saved state of obsynth", rb'\A\s*\{\s*"kind":\s*"obsynth run state"')

#: Parts that are seconds, or nothing before the first row.
_TIMES = frozenset({"last", "longest"})


def save_state(path: Path, job: Job, digest: str) -> None:
    """Write what a run carries from row to row, atomically."""
    body = plain({"gains": digest, "state": job.as_dict()})
    document = {"kind": KIND, "schema_version": SCHEMA_VERSION, "sha256": digest_of(body), "run": body}
    write_atomically(path, json.dumps(document, indent=1, allow_nan=False) + "\n")


def resume_state(path: Path, job: Job, digest: str, earlier: str = "") -> None:
    """Let a run go on from a saved state; ``earlier`` is the digest of a gain set of an earlier schema."""
    # The state is written again at the end, so it is no input that has to be kept.
    document = read_json(path, is_protected=False)
    known = isinstance(document, dict) and document.get("kind") == KIND
    version = document.get("schema_version") if known else None
    if version not in (EARLIER, SCHEMA_VERSION):
        raise SpecError(f"{path} is no saved state of a run.", path=str(path))
    body = document.get("run")
    try:
        intact = isinstance(body, dict) and document.get("sha256") == digest_of(body)
    except (ValueError, RecursionError):  # a number too large for a float
        intact = False
    if not intact:
        raise SpecError(f"{path} was changed after it was written: its digest does not match.", path=str(path))
    if body.get("gains") not in ((digest, earlier) if earlier else (digest,)):
        raise SpecError(f"{path} is the state of a run with another gain set.", path=str(path))
    own = job.as_dict()
    try:
        state = restored(body.get("state"))
        if version == EARLIER:
            state = _from_schema_3(state, own)
        job.resume(state)
        fits = _fits(own, state)
    except (AttributeError, LookupError, TypeError, ValueError, ArithmeticError):
        fits = False
    if not fits:
        raise damaged_state(path)
    job.resumed_from = path


def _from_schema_3(saved: dict[str, Any], own: dict[str, Any]) -> dict[str, Any]:
    """Return a state as it is laid out now; outliers were not counted then, and the warm-up was another one."""
    engine, like = saved["observer"], own["observer"]
    if "observer" not in like:
        return saved
    then, now = engine["observer"], like["observer"]
    found = {name: then.get(name, now[name]) for name in now}
    if "regressors" in now:
        reset = then["alarm"] or {"window": [], "resets": 0}
        surprises = np.array(reset["window"], dtype=np.float64).reshape(-1, 2)
        found |= {"regressors": then["window"], "surprises": surprises, "resets": reset["resets"]}
    return {**saved, "observer": {**engine, "observer": found, "warm_up": like["warm_up"]}}


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
