"""Certificates on disk: a kind, a version, a digest and what is certified, as one JSON document."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.files.inputs import read_json
from obsynth.files.outputs import FileKind
from obsynth.results.design import ObserverDesign
from obsynth.results.gain_set_writing import design_as_dict, digest_of, plain, restored
from obsynth.results.gain_sets import COMPARISON, ROBUSTNESS, STUDY

RESULTS = (ROBUSTNESS, STUDY, COMPARISON)

RESULT_FILE = FileKind(
    "a certificate of a result",
    rb'\A\s*\{\s*"kind":\s*"obsynth (robustness|tolerance study|comparison)"',
    suffix=".json",
)

RESULT_VERSION = 1

#: Digits of a digest that a sentence shows.
SHOWN_DIGITS = 12

#: Figures that are found again agree to this share of themselves, or of the largest of their unit beside them.
SAME_FIGURE, FIGURE_ROUNDING_SHARE = 1e-6, 1e-9

#: Figures without a unit, beside which one is the size of all; those of a fault's estimate that have a unit together:
#: seconds, the fault's own.
SHARES = frozenset({"at_horizon", "peak", "relative_error", "unknown_input_share", "loop_radius", "largest_factor"})
SAME_UNIT = (
    frozenset({"detection_delay", "half", "horizon", "most"}),
    frozenset({"bias", "bound", "deviation", "least", "rms", "size", "smallest_found", "threshold"}),
)
#: A mapping of constants, each in a unit of its own: ohms beside farads.
CONSTANTS = "breaking"

#: Bytes in which a file says its kind.
_CERTIFICATE_HEAD_BYTES = 200

#: What the file of a proof of an alarm calls itself.
ALARM_KIND = "obsynth alarm certificate"


def sealed(kind: str, version: int, body: Any, *, under: str = "certificate") -> str:
    """Return the text of a file that holds a body, plain data, with its digest."""
    document = {"kind": kind, "schema_version": version, "sha256": digest_of(body), under: body}
    return json.dumps(document, indent=1, allow_nan=False) + "\n"


def opened(
    path: Path,
    kinds: tuple[str, ...],
    version: int,
    what: str,
    again: str,
    *,
    under: str = "certificate",
    is_protected: bool = True,
) -> tuple[str, dict[str, Any], bool]:
    """Return kind and body of what `sealed` wrote, and whether its digest is right; ``again`` says how to make one."""
    document = read_json(path, is_protected=is_protected)
    if not isinstance(document, dict) or document.get("kind") not in kinds:
        raise SpecError(f"{path} is no {what}.", path=str(path))
    body = document.get(under)
    if document.get("schema_version") != version or not isinstance(body, dict):
        raise SpecError(
            f"{path} has the schema version {document.get('schema_version')!r}, and this obsynth reads {version}: "
            f"{again}.",
            path=str(path),
        )
    try:
        return document["kind"], body, document.get("sha256") == digest_of(body)
    except RecursionError as error:
        raise SpecError(f"{path} is nested too deeply to be a {what}: {again}.", path=str(path)) from error


def result_text(
    kind: str,
    designs: Mapping[str, ObserverDesign],
    options: Mapping[str, Any],
    result: Mapping[str, Any],
    statement: str,
    log: Mapping[str, Any] | None = None,
) -> str:
    """Return the certificate of a result: what was asked, the figures, the sentence, and every gain set inside."""
    body = plain({"statement": statement, "asked": options, "result": result, "log": log})
    inside = {name: design_as_dict(design) for name, design in designs.items()}
    return sealed(kind, RESULT_VERSION, {**body, "gain_sets": inside})


def differences(stored: Any, again: Any, where: str = "") -> list[str]:
    """Return the places at which two results differ, numbers by more than rounding."""
    if isinstance(again, Mapping):
        if not isinstance(stored, Mapping) or stored.keys() != again.keys():
            return [where or "names"]
        items = [(str(name), stored[name], again[name]) for name in again]
    elif isinstance(again, (list, tuple)):
        if not isinstance(stored, (list, tuple)) or len(stored) != len(again):
            return [where]
        items = [(str(i + 1), before, after) for i, (before, after) in enumerate(zip(stored, again, strict=True))]
    else:
        return [] if _same_figure(stored, again, 0.0) else [where]
    if where == CONSTANTS:
        return [f"{where}, {name}" for name, before, after in items if not _same_figure(before, after, 0.0)]
    figures = {name: abs(float(after)) for name, _, after in items if _is_figure(after) and abs(after) < float("inf")}
    wrong = []
    for name, before, after in items:
        place = f"{where}, {name}" if where else name
        if not _is_figure(after):
            wrong += differences(before, after, place)
        elif not _same_figure(before, after, FIGURE_ROUNDING_SHARE * _size_beside(name, figures)):
            wrong.append(place)
    return wrong


def _size_beside(name: str, figures: Mapping[str, float]) -> float:
    """Return the size beside which a figure may be nothing but rounding: that of the figures of its unit."""
    if name in SHARES:
        return 1.0
    if name == "unknown_input_gain" and figures.get("unknown_input_share"):
        # What a share of one would be.
        return figures[name] / figures["unknown_input_share"]
    own = next((names for names in SAME_UNIT if name in names), figures.keys())
    return max((size for other, size in figures.items() if other in own), default=0.0)


def _is_figure(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _same_figure(before: Any, after: Any, rounding: float) -> bool:
    if not (_is_figure(before) and _is_figure(after)):
        return bool(type(before) is type(after) and before == after)
    if before == after or (before != before and after != after):
        return True
    if not (np.isfinite(before) and np.isfinite(after)):
        return False
    return bool(abs(before - after) <= max(SAME_FIGURE * abs(after), rounding))


def body_of(body: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a certificate of a result holds beside its gain sets, as it was before it was written."""
    content: dict[str, Any] = restored({name: value for name, value in body.items() if name != "gain_sets"})
    return content


def kind_of_file(path: Path) -> str:
    """Return what a file that obsynth wrote says it is; empty where it says nothing."""
    try:
        with path.open("rb") as stream:
            match = re.match(rb'\s*\{\s*"kind":\s*"([a-z ]+)"', stream.read(_CERTIFICATE_HEAD_BYTES))
    except (OSError, ValueError):  # there is no such file, or no file can have this name
        return ""
    return "" if match is None else match.group(1).decode()
