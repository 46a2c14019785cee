"""C code in single precision: number formats, and the tolerances that single precision needs."""

from __future__ import annotations

import re

import numpy as np

from obsynth.errors import SpecError

#: A number of a table, or of a line that a macro names.
_WRITTEN_NUMBER = re.compile(r"(?<![\w.\"])-?\d+(?:\.\d+(?:e[+-]?\d+)?|e[+-]?\d+)(?![\w.\"])")

#: Newton in floats: a last step whose square is rounding, and a residual of some roundings of its terms.
FLOAT_LAST_STEP, FLOAT_RESIDUAL = 3e-4, 1e-5

#: A projection that moves no state by more than rounding moves none, and bounds that dependent rows miss are kept.
FLOAT_PROJECTION_NOTICE, FLOAT_DEPENDENT, FLOAT_SLACK = 1e-4, 1e-5, 1e-4

#: What a sample adds to the information on faults is a difference of inverses of covariances.
FLOAT_LEAST_ADDED = 1e-5

#: What is larger has no square in a float.
FLOAT_OVERFLOW = 1e18

_FLOAT_CONSTANTS = {
    "LAST_STEP": FLOAT_LAST_STEP,
    "LARGEST_RESIDUAL": FLOAT_RESIDUAL,
    "PROJECTION_NOTICE": FLOAT_PROJECTION_NOTICE,
    "DEPENDENT": FLOAT_DEPENDENT,
    "SLACK": FLOAT_SLACK,
    "OVERFLOW_LIMIT": FLOAT_OVERFLOW,
    "MONITOR_LEAST": FLOAT_LEAST_ADDED,
}


def in_precision(text: str, precision: str) -> str:
    """Return C in which numbers of signals are doubles, or floats as near to these as they can be."""
    if precision == "double":
        return re.sub(r"\bREAL\b", "double", text)
    rounded = []
    for line in re.sub(r"\bREAL\b", "float", text).split("\n"):
        plain = line.startswith(("#define", "/*", " *"))
        rounded.append(line if plain else _WRITTEN_NUMBER.sub(_as_float, line))
    return "\n".join(rounded)


def _as_float(match: re.Match[str]) -> str:
    """Return a matched number as a float of C."""
    value = np.float32(match.group())
    if not np.isfinite(value):
        raise SpecError(
            f"{match.group()} is beyond the largest number of precision 'float': scale the signals, or export doubles.",
            path="precision",
        )
    return f"{value}f"


def in_floats(text: str) -> str:
    """Return C with floats in place of doubles; seconds stay doubles, as they are counted up."""
    for name, value in _FLOAT_CONSTANTS.items():
        text = re.sub(rf"^#define {name} .*$", f"#define {name} {value!r}f", text, flags=re.MULTILINE)
    lines = [
        line if re.search(r"\b(time|warm_up)\b", line) else re.sub(r"\bdouble\b", "float", line)
        for line in text.split("\n")
    ]
    return in_precision("\n".join(lines), "float")
