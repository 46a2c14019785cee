"""The saved state of a run, so that it can stop and go on."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from obsynth.data.running import DataObserver
from obsynth.errors import SpecError
from obsynth.results.design import ObserverDesign
from obsynth.results.serialise import design_as_dict, digest_of, plain, restored, write_atomically

KIND = "obsynth run state"


def digest_of_gains(design: ObserverDesign) -> str:
    """Return the sha256 digest of a gain set, as in its file."""
    return str(design_as_dict(design)["sha256"])


def save_state(path: Path, observer: DataObserver, digest: str) -> None:
    """Write what a run carries from row to row, atomically.

    Parameters
    ----------
    path : Path
        The file.
    observer : DataObserver
        In motion.
    digest : str
        Of the gain set.
    """
    body = plain({"gains": digest, "state": observer.as_dict()})
    document = {"kind": KIND, "schema_version": 1, "sha256": digest_of(body), "run": body}
    write_atomically(path, json.dumps(document, indent=1, allow_nan=False) + "\n")


def resume_state(path: Path, observer: DataObserver, digest: str) -> None:
    """Let an observer go on from a saved state.

    Parameters
    ----------
    path : Path
        The file.
    observer : DataObserver
        At its start.
    digest : str
        Of the gain set.

    Raises
    ------
    SpecError
        The file cannot be read, is no saved state, was changed, or belongs to another gain set.
    """
    try:
        document: Any = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise SpecError(f"{path} cannot be read: {error.strerror}.", path=str(path)) from error
    except (ValueError, RecursionError) as error:
        raise SpecError(f"{path} is no JSON document ({error}).", path=str(path)) from error
    if not isinstance(document, dict) or document.get("kind") != KIND or document.get("schema_version") != 1:
        raise SpecError(f"{path} is no saved state of a run.", path=str(path))
    body = document.get("run")
    if not isinstance(body, dict) or document.get("sha256") != digest_of(body):
        raise SpecError(f"{path} was changed after it was written: its digest does not match.", path=str(path))
    if body.get("gains") != digest:
        raise SpecError(f"{path} is the state of a run with another gain set.", path=str(path))
    observer.resume(restored(body["state"]))
