"""The line of a YAML document at which a key, or an entry of a list, is written."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from obsynth.errors import SpecError
from obsynth.files.inputs import read_text


def composed(source: Path) -> Any:
    """Return the tree of a YAML file, whose nodes know their lines; ``None`` where there is none.

    Called after the file has been read as a document, so that what it holds is known to be small enough."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        return YAML(typ="safe", pure=True).compose(read_text(source, is_protected=False))
    except (SpecError, YAMLError):
        return None


def line_of(tree: Any, location: Sequence[str | int]) -> int | None:
    """Return the line, from 1, of a place in a tree: of the key or entry that is deepest on the way to it, so that a
    key that is missing has the line of its section; ``None`` where nothing of the way is in the tree."""
    node, line = tree, None
    for part in location:
        values = getattr(node, "value", None)
        if not isinstance(values, list):
            break
        if isinstance(part, int):
            if type(node).__name__ != "SequenceNode" or part >= len(values):
                break
            node = values[part]
            line = node.start_mark.line + 1
            continue
        pair = next((pair for pair in values if isinstance(pair, tuple) and pair[0].value == part), None)
        if pair is None:
            break
        node, line = pair[1], pair[0].start_mark.line + 1
    return line
