"""The saved state of a run, so that it can stop and go on."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from obsynth.data.job import Job
from obsynth.errors import SpecError
from obsynth.results.design import ObserverDesign
from obsynth.results.files import write_atomically
from obsynth.results.gain_sets import design_as_dict, digest_of, plain, restored

KIND = "obsynth run state"
SCHEMA_VERSION = 4


def digest_of_gains(design: ObserverDesign) -> str:
    """Return the sha256 digest of a gain set, as in its file."""
    return str(design_as_dict(design)["sha256"])


def save_state(path: Path, job: Job, digest: str) -> None:
    """Write what a run carries from row to row, atomically."""
    body = plain({"gains": digest, "state": job.as_dict()})
    document = {"kind": KIND, "schema_version": SCHEMA_VERSION, "sha256": digest_of(body), "run": body}
    write_atomically(path, json.dumps(document, indent=1, allow_nan=False) + "\n")


def resume_state(path: Path, job: Job, digest: str) -> None:
    """Let a run go on from a saved state."""
    try:
        document: Any = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise SpecError(f"{path} cannot be read: {error.strerror}.", path=str(path)) from error
    except (ValueError, RecursionError) as error:
        raise SpecError(f"{path} is no JSON document ({error}).", path=str(path)) from error
    known = isinstance(document, dict) and document.get("kind") == KIND
    if not known or document.get("schema_version") != SCHEMA_VERSION:
        raise SpecError(f"{path} is no saved state of a run.", path=str(path))
    body = document.get("run")
    if not isinstance(body, dict) or document.get("sha256") != digest_of(body):
        raise SpecError(f"{path} was changed after it was written: its digest does not match.", path=str(path))
    if body.get("gains") != digest:
        raise SpecError(f"{path} is the state of a run with another gain set.", path=str(path))
    job.resume(restored(body["state"]))
