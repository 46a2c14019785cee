"""Labelled frames (pandas.DataFrame) as matrices: rows and columns in one order, labels as names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from obsynth.errors import SpecError

_ROWS = {"E": "state", "A": "state", "C": "output", "B": "state", "D": "output", "Bf": "state", "Df": "output",
         "Bd": "state", "Dd": "output", "Bw": "state", "Dw": "output"}  # fmt: skip
_COLUMNS = {"E": "state", "A": "state", "C": "state", "B": "input", "D": "input", "Bf": "fault", "Df": "fault",
            "Bd": "disturbance", "Dd": "disturbance", "Bw": "noise", "Dw": "noise"}  # fmt: skip
# A names the states, C the outputs; the first frame with a label decides on an order.
_ORDER = ("A", "C", "E", "B", "D", "Bf", "Df", "Bd", "Dd", "Bw", "Dw")


def without_frames(
    matrices: Mapping[str, Any], names: Mapping[str, Sequence[str] | None]
) -> tuple[dict[str, Any], dict[str, Sequence[str] | None]]:
    """Return matrices and names ``{"state_names": ...}`` in which the frames' labels are used, in one order.

    The rows of the dynamics are the equations of the states of the same name.  Numbered labels are no names.
    """
    plain, labels = dict(matrices), dict(names)
    for name in _ORDER:
        frame: Any = plain.get(name)
        if not (hasattr(frame, "columns") and hasattr(frame, "index") and hasattr(frame, "to_numpy")):
            continue
        rows = _order(frame.index, f"{_ROWS[name]}_names", labels, f"the rows of {name}")
        columns = _order(frame.columns, f"{_COLUMNS[name]}_names", labels, f"the columns of {name}")
        plain[name] = frame.to_numpy()[rows][:, columns] if len(frame) else frame.to_numpy()
    return plain, labels


def _order(labels: Any, kind: str, known: dict[str, Sequence[str] | None], what: str) -> list[int]:
    """Return the positions of labels in the order of the names known so far, which they define where there are none."""
    found = list(labels)
    if not found or not all(isinstance(label, str) for label in found):
        return list(range(len(found)))
    repeated = sorted({label for label in found if found.count(label) > 1})
    if repeated:
        raise SpecError(f"{what[0].upper()}{what[1:]} repeat the label {repeated[0]!r}.", path=kind)
    if known.get(kind) is None:
        known[kind] = found
    wanted = list(known[kind] or ())
    missing, foreign = [name for name in wanted if name not in found], [name for name in found if name not in wanted]
    if missing or foreign:
        texts = [f"lack {', '.join(map(repr, missing))}"] if missing else []
        texts += [f"have {', '.join(map(repr, foreign))}"] if foreign else []
        raise SpecError(f"{what[0].upper()}{what[1:]} {' and '.join(texts)}: the {kind} are {', '.join(wanted)}.",
                        path=kind)  # fmt: skip
    return [found.index(name) for name in wanted]
