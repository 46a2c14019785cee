"""Suggestions in messages about invalid values and keys of a spec.

Every sentence names the text to write; it is empty where none is certain.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from obsynth.errors import SpecError
from obsynth.numerics.arguments import is_number
from obsynth.specs.matrix_files import MATRIX_SUFFIXES

#: Matrices that every plant has.
NEEDED_MATRICES = ("A", "C")

#: Texts by which other programs write an identity.
_IDENTITIES = ("I", "eye", "identity", "Identity")

#: Matrices that may be given by names of signals, the key for these, and what they name.
_PICKS = {
    **dict.fromkeys(("B", "Bf", "Bd", "Bw"), ("states", "equations")),
    **dict.fromkeys(("C", "Df", "Dd"), ("outputs", "outputs")),
}

#: What to write for a key that every document of its kind has.
MISSING_KEYS = {
    "A": "write the matrix of the dynamics, such as A: [[0.9, 0.1], [0, 0.8]]",
    "C": "write the matrix of the outputs, a row for each, such as C: [[1, 0]]",
    "dt": "give the seconds between samples, or 0 for a plant in continuous time",
    "horizon": "give the seconds that are simulated, such as horizon: 100",
    "kind": "write kind: step, or ramp, sine, drift and others",
    "name": "write name: my-design",
    "plant": "write plant: and its matrices below, indented",
    "schema_version": "write schema_version: 1",
}

#: What kinds of signals are called elsewhere, and how they are written here.
OTHER_KINDS = {
    **dict.fromkeys(("constant", "const", "bias", "offset"), "kind: step, size: 1 (from the first sample on)"),
    **dict.fromkeys(("pulse", "impulse", "rectangle"), "kind: step, size: 1, start: 10, end: 20"),
    **dict.fromkeys(("square", "pulses"), "kind: intermittent, size: 1, period: 10"),
    **dict.fromkeys(("normal", "noise", "white", "random", "randn"), "kind: gaussian, or kind: uniform"),
    **dict.fromkeys(("sinusoid", "sin", "cosine", "harmonic"), "kind: sine"),
    **dict.fromkeys(("table", "csv", "file", "data", "series", "interpolated"), "kind: time-table"),
}

#: So many keys of a section are listed in a message.
MOST_KEYS = 15

#: A matrix with at most this many numbers is written out in a message.
LARGEST_EXAMPLE = 12


def instead_of_nothing(key: str) -> str:
    """Return what to write for a key without a value."""
    return f" {MISSING_KEYS[key][0].upper()}{MISSING_KEYS[key][1:]}." if key in MISSING_KEYS else f" Leave {key} out."


def instead_of_kind(value: Any) -> str:
    """Return how a signal of a kind that has another name here is written."""
    meant = OTHER_KINDS.get(value.lower()) if isinstance(value, str) else None
    return f" Write {meant}." if meant else ""


def instead_of_mapping(key: str, value: Any) -> str:
    """Return how a list of mappings, as dashes make one, is written as one mapping."""
    dashes = isinstance(value, list) and value and all(isinstance(part, dict) for part in value)
    return f" Write what is below {key} without dashes." if dashes else ""


def instead_of_section(value: Any, known: Sequence[str]) -> str:
    """Return where the keys of a section belong that should not be there, or which keys there are."""
    if isinstance(value, dict) and value and set(value) <= set(known):
        return " Write what is below it one level higher, without this key."
    return f" The keys here are {', '.join(known)}." if 0 < len(known) <= MOST_KEYS else ""


def instead_of_number(value: Any, *, whole: bool = False) -> str:
    """Return the number that a text stands for: in quotes, a fraction or formula, with a decimal comma."""
    if isinstance(value, list):
        return " Remove a pair of brackets."
    number = number_of(value)
    if number is None:
        return ""
    return f" Write {int(number) if whole and number.is_integer() else number!r}."


def number_of(value: Any) -> float | None:
    """Return the finite number that a text of one number without names stands for; ``None`` where it is none."""
    from obsynth.numerics.expressions import parse_expression

    if not isinstance(value, str):
        return None
    text = value.strip()
    for written in (text, text.replace(",", "."), text.replace("D", "e").replace("d", "e")):
        try:
            expression = parse_expression(written)
            number = float(expression({"pi": math.pi}))
        except (SpecError, KeyError, ValueError, TypeError, ArithmeticError):
            continue
        if math.isfinite(number):
            return number
    return None


def instead_of_matrix(key: str, value: Any, folder: Path) -> str:
    """Return how a matrix is written that was given as a text, a single number, a flat list, or an empty one;
    ``folder`` is that of the spec."""
    if isinstance(value, list):
        if value and all(map(is_number, value)) and len(value) <= LARGEST_EXAMPLE:
            return f" Write {[value]} for one row, {[[entry] for entry in value]} for one column."
        is_empty = all(isinstance(row, list) and not row for row in value)
        return f" Leave {key} out if there is none." if is_empty and key not in NEEDED_MATRICES else ""
    if is_number(value):
        return f" Write {key}: [[{value!r}]] for a matrix of one entry."
    return _instead_of_text(key, value.strip(), folder) if isinstance(value, str) else ""


def _instead_of_text(key: str, text: str, folder: Path) -> str:
    if Path(text).suffix.lower() in MATRIX_SUFFIXES:
        missing = "" if (folder / text).is_file() else f" {text} is not in the folder of the spec."
        return f" Write {key}: {{file: {text}}} for a matrix in a file.{missing}"
    if text.partition("(")[0] in _IDENTITIES:
        default = "Leave E out: it is the identity then." if key == "E" else "Write the identity out, row by row."
        return f" {default}"
    if key in _PICKS and re.fullmatch(r"[^\W\d][\w .-]*", text):
        kind, meaning = _PICKS[key]
        return f" Write {key}: {{{kind}: [{text}]}} for {meaning} by name."
    rows = [row.replace(",", " ").split() for row in text.strip("[]").split(";")]
    numbers = [[number_of(entry) for entry in row] for row in rows]
    complete = all(numbers) and all(number is not None for row in numbers for number in row)
    few = sum(map(len, numbers)) <= LARGEST_EXAMPLE
    return f" Write {key}: {numbers}." if complete and few and len(set(map(len, numbers))) == 1 else ""


def is_matlab(value: Any) -> bool:
    """Whether a text is a matrix with its rows separated by semicolons, as MATLAB writes them."""
    return isinstance(value, str) and ";" in value


def instead_of_list(key: str, value: Any) -> str:
    """Return a name that is alone as a list of it."""
    return f" Write {key}: [{value}]." if isinstance(value, str) and "," not in value else ""


def instead_of_time(value: Any) -> str:
    """Return a time that was given as a frequency or a fraction, in seconds."""
    text = value.strip() if isinstance(value, str) else ""
    for unit, factor in (("kHz", 1e3), ("Hz", 1.0)):
        rate = number_of(text.removesuffix(unit)) if text.endswith(unit) else None
        if rate:
            return f" Write {1.0 / (rate * factor)!r} for a period of {text}."
    return instead_of_number(value)
