"""The saved state of a run, so that it can stop and go on."""

from __future__ import annotations

import json
from pathlib import Path

from obsynth.data.job import Job
from obsynth.errors import SpecError
from obsynth.files.inputs import read_json
from obsynth.files.outputs import FileKind, write_atomically
from obsynth.results.design import ObserverDesign
from obsynth.results.gain_sets import digest_of, gain_set_digest, plain, restored

KIND = "obsynth run state"
SCHEMA_VERSION = 4
STATE = FileKind("a saved state of obsynth", rb'\A\s*\{\s*"kind":\s*"obsynth run state"')


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
    try:
        job.resume(restored(body["state"]))
    except (AttributeError, LookupError, TypeError, ValueError, ArithmeticError) as error:
        raise SpecError(f"{path} is incomplete: {error}.", path=str(path)) from error
