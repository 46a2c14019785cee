"""Numbers, arrays and mappings as JSON data and back, bit for bit, and the digest of such data."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.results.binary_members import MEMBER

# What JSON does not have is marked by these sets of keys; a mapping that happens to have one of them is wrapped.
_ARRAY, _FLOAT, _MAPPING = {"shape", "data"}, {"float"}, {"mapping"}
_MARKS = (_ARRAY, _FLOAT, _MAPPING, MEMBER)


def plain(value: Any) -> Any:
    """Return ``value`` as JSON data; arrays, NaN and infinities are marked so that `restored` finds them."""
    if isinstance(value, np.ndarray):
        return {"shape": list(value.shape), "data": [plain(x) for x in value.ravel().tolist()]}
    if isinstance(value, (np.floating, np.integer, np.bool_)):
        return plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return {"float": str(value)}
    if isinstance(value, Mapping):
        entries = {str(key): plain(item) for key, item in value.items()}
        return {"mapping": entries} if entries.keys() in _MARKS else entries
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise SpecError(f"A value of type {type(value).__name__} cannot be saved: only data can.")


def restored(value: Any) -> Any:
    """Return what `plain` wrote, with arrays and special floats restored."""
    if isinstance(value, dict):
        if value.keys() == _ARRAY:
            data = [restored(item) for item in value["data"]]
            if not {type(item) for item in data} <= {float, int}:
                raise TypeError("an array holds something that is no number")
            return np.array(data, dtype=np.float64).reshape(value["shape"])
        if value.keys() == _FLOAT:
            return float(value["float"])
        if value.keys() == _MAPPING:
            value = value["mapping"]
        return {key: restored(item) for key, item in value.items()}
    if isinstance(value, list):
        return [restored(item) for item in value]
    return value


def digest_of(body: Mapping[str, Any]) -> str:
    """Return the sha256 digest of the canonical JSON of ``body``."""
    text = json.dumps(body, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()
