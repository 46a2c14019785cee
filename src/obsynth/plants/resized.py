"""What follows when matrices of a plant are replaced: zeros, the identity, numbered names, and earlier sensor noise."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from obsynth.numerics.sparse import dense, is_sparse, same_matrix
from obsynth.plants.checking import COUNTED_BY
from obsynth.plants.given_matrices import MATRIX_LAYOUT, SENSOR_NOISE, SENSOR_PICKS, SIGNAL_FIELDS
from obsynth.plants.signal_names import is_name_list


def with_what_follows(arguments: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return changes with those that follow: of matrices without entries, of E = I, and of names such as u1, u2.

    ``arguments``: what the plant was made of.  Signals of which no matrix is left go, with their names.
    """
    old = {letter: len(arguments[field]) for letter, field in SIGNAL_FIELDS.items()}
    new = old | _sizes_of(arguments, changes)
    following: dict[str, Any] = {}
    for name, rows, columns in MATRIX_LAYOUT:
        if name not in changes and (new[rows], new[columns]) != (old[rows], old[columns]):
            if name == "E" and _is_identity(arguments[name]):
                following[name] = None
            elif name not in ("E", "A", "C") and not _has_entries(arguments[name]):
                following[name] = np.zeros((new[rows], new[columns]))
    for letter, field in SIGNAL_FIELDS.items():
        numbered = tuple(f"{letter}{i + 1}" for i in range(old[letter]))
        own = letter == "w" and arguments[field] and all(name.startswith(SENSOR_NOISE) for name in arguments[field])
        made = arguments[field] == numbered or own
        if field not in changes and new[letter] != old[letter] and (made or not new[letter]):
            following[field] = None
    return {**changes, **following}


def without_sensor_noise(arguments: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return Bw, Dw and their names without the noise that ``sensor_noise`` states anew; `None` states that of none.

    ``arguments``: what the plant was made of.  Columns that drive equations or several outputs, too, stay.
    """
    if "sensor_noise" not in changes or {"Bw", "Dw", "noise_names"} & set(changes):
        return {}
    stated = changes["sensor_noise"]
    names, outputs = arguments["noise_names"], arguments["output_names"]
    Bw, Dw = dense(arguments["Bw"]), dense(arguments["Dw"])
    kept = []
    for column, name in enumerate(names):
        output = name.removeprefix(SENSOR_NOISE)
        own = [outputs[row] for row in np.flatnonzero(Dw[:, column])] == [output] and not Bw[:, column].any()
        if not (own and name != output and (stated is None or output in stated)):
            kept.append(column)
    return {"Bw": Bw[:, kept], "Dw": Dw[:, kept], "noise_names": [names[column] for column in kept]}


def _sizes_of(arguments: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, int]:
    """Return the numbers of states and signals that changed matrices have, as far as these can be seen."""
    sizes: dict[str, int] = {}
    for name, rows, columns in MATRIX_LAYOUT:
        given = changes.get(name)
        shape = _shape(given)
        if given is not None and is_name_list(given):
            # Faults and unknown inputs of sensors are added to those of the dynamics.
            sizes |= {} if name in SENSOR_PICKS else {columns: len(given)}
        elif len(shape) == 2:
            sizes |= {columns: int(shape[1])} | ({rows: int(shape[0])} if name in ("A", "C") else {})
    for letter, matrices in COUNTED_BY.items():
        changed = [name for name in matrices if name in changes]
        left = [name for name in matrices if name not in changes and _has_entries(arguments[name])]
        if changed and not left and all(changes[name] is None for name in changed):
            sizes[letter] = 0
    return sizes


def _shape(matrix: Any) -> tuple[int, ...]:
    """Return the shape of an argument; none of rows of different lengths, which the plant refuses itself."""
    try:
        return tuple(matrix.shape) if hasattr(matrix, "shape") else np.shape(matrix)
    except ValueError:
        return ()


def _has_entries(matrix: Any) -> bool:
    return bool(matrix.count_nonzero()) if is_sparse(matrix) else bool(np.any(np.asarray(matrix) != 0))


def _is_identity(matrix: Any) -> bool:
    return same_matrix(matrix, np.eye(matrix.shape[0]))
