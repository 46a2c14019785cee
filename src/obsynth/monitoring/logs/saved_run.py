"""The state of a run over a log as a file, from which a later run goes on."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.files.inputs import read_json
from obsynth.files.outputs import FileKind, write_atomically
from obsynth.monitoring.logs.log_run import LogRun, damaged_state
from obsynth.numerics.arguments import is_finite_number, is_number
from obsynth.observers.saved_states import BY_COLUMNS
from obsynth.results.certificate_files import sealed
from obsynth.results.gain_set_writing import digest_of, plain, restored

RUN_STATE_KIND = "obsynth run state"

RUN_STATE_VERSION = 1

STATE = FileKind("a saved state of obsynth", rb'\A\s*\{\s*"kind":\s*"obsynth run state"', suffix=".json")

#: Parts that are seconds, or nothing before the first row.
_TIME_PARTS = frozenset({"last", "longest"})


def save_state(path: Path, run: LogRun, digest: str) -> None:
    """Write what a run carries from row to row, atomically."""
    body = plain({"gains": digest, "state": run.as_dict()})
    write_atomically(path, sealed(RUN_STATE_KIND, RUN_STATE_VERSION, body, under="run"), kind=STATE)


def resume_state(path: Path, run: LogRun, digest: str) -> None:
    """Let a run go on from a saved state."""
    # The state is written again at the end, so it is no input that has to be kept.
    document = read_json(path, is_protected=False)
    is_run_state = isinstance(document, dict) and document.get("kind") == RUN_STATE_KIND
    if not is_run_state or document.get("schema_version") != RUN_STATE_VERSION:
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
    own = run.as_dict()
    try:
        state = restored(body.get("state"))
        run.resume(state)
        fits = _fits(own, state)
    except (AttributeError, LookupError, TypeError, ValueError, ArithmeticError):
        fits = False
    if not fits:
        raise damaged_state(path)
    run.resumed_from = path


def _fits(own: Any, saved: Any) -> bool:
    """Whether a saved state has the parts of a run's own one; what has no value yet may hold numbers and arrays."""
    if isinstance(own, np.ndarray):
        saved_array = saved.get(BY_COLUMNS) if isinstance(saved, dict) else saved
        return isinstance(saved_array, np.ndarray) and _alike(own.shape, saved_array.shape)
    if isinstance(own, Mapping):
        if not isinstance(saved, dict) or saved.keys() != own.keys():
            return False
        return all(
            _fits(own[key], saved[key])
            and (key not in _TIME_PARTS or saved[key] is None or is_finite_number(saved[key]))
            for key in own
        )
    if isinstance(own, (bool, np.bool_)):
        return isinstance(saved, bool)
    if isinstance(own, str):
        return isinstance(saved, str)
    if isinstance(own, (list, tuple)):
        return isinstance(saved, list)
    return saved is None or is_number(saved) or (own is None and isinstance(saved, (np.ndarray, dict, list)))


def _alike(own: tuple[int, ...], saved: tuple[int, ...]) -> bool:
    """Whether an array can stand for another one: windows fill up, and factors of covariances change their width."""
    if len(own) == 2 and len(saved) == 2:
        return own[0] == saved[0] or own[1] == saved[1]
    return own == saved
