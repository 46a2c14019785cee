"""Fields of a linear plant from a caller's arguments: labelled frames, names of rows, noise of sensors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.numerics.arguments import require_kind
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.sparse import as_sparse_matrix, dense, is_sparse
from obsynth.plants.checking import (
    COUNTED_BY,
    Problems,
    any_matrix,
    checked_dt,
    checked_labels,
    matrix_or_picks,
    picked_names,
    signal_counts,
)
from obsynth.plants.dead_times import checked_delays
from obsynth.plants.signal_names import checked_names, is_name_list, plain_names, require_picked, rows_picking

#: Matrix, signal of its rows, signal of its columns.
MATRIX_LAYOUT = (
    ("E", "x", "x"),
    ("A", "x", "x"),
    ("C", "y", "x"),
    ("B", "x", "u"),
    ("D", "y", "u"),
    ("Bf", "x", "f"),
    ("Df", "y", "f"),
    ("Bd", "x", "d"),
    ("Dd", "y", "d"),
    ("Bw", "x", "w"),
    ("Dw", "y", "w"),
)

#: Names of the signals of each kind.
SIGNAL_FIELDS = {
    "x": "state_names",
    "u": "input_names",
    "y": "output_names",
    "f": "fault_names",
    "d": "disturbance_names",
    "w": "noise_names",
}

# Where a matrix picked by names names the signal as well.
_NAMED_BY = {"output_names": "C", "fault_names": "Bf", "disturbance_names": "Bd"}

#: Matrices of outputs that may be given by the names of sensors, each with that of the dynamics beside it.
SENSOR_PICKS = {"Df": "Bf", "Dd": "Bd"}

MatrixOrNames = ArrayLike | Sequence[str] | None

SIGNAL_NAMES = tuple(SIGNAL_FIELDS.values())

#: How the names of noises begin that ``sensor_noise`` states; the output follows.
SENSOR_NOISE = "noise "

ALL_MATRICES = tuple(name for name, *_ in MATRIX_LAYOUT)


def _without_frames(
    matrices: Mapping[str, Any], names: Mapping[str, Sequence[str] | None]
) -> tuple[dict[str, Any], dict[str, Sequence[str] | None]]:
    """Return matrices and names ``{"state_names": ...}``, labels of frames in one order; numbers are no names."""
    plain, labels = dict(matrices), dict(names)
    # A names the states, C the outputs; the first frame with a label decides on an order.
    for name, rows_of, columns_of in sorted(MATRIX_LAYOUT, key=lambda row: (row[0] != "A", row[0] != "C")):
        frame: Any = plain.get(name)
        if not (hasattr(frame, "columns") and hasattr(frame, "index") and hasattr(frame, "to_numpy")):
            continue
        _require_no_texts(frame, name)
        rows = _order(frame.index, SIGNAL_FIELDS[rows_of], labels, f"the rows of {name}")
        columns = _order(frame.columns, SIGNAL_FIELDS[columns_of], labels, f"the columns of {name}")
        plain[name] = frame.to_numpy()[rows][:, columns] if len(frame) else frame.to_numpy()
    return plain, labels


def _require_no_texts(frame: Any, name: str) -> None:
    """Refuse a frame whose first column are labels: of a table that was read without saying so."""
    if len(frame) and len(frame.columns) and all(isinstance(cell, str) for cell in frame.iloc[:, 0]):
        raise SpecError(
            f"{name} has texts in its first column, {str(frame.columns[0])!r}: names of rows belong into the index of "
            "a frame; read the table with index_col=0.",
            path=name,
        )


def _order(labels: Any, kind: str, known: dict[str, Sequence[str] | None], what: str) -> list[int]:
    """Return the positions of labels in the order of the names known so far, which they define where there are none."""
    own_labels = list(labels)
    if not own_labels or not all(isinstance(label, str) for label in own_labels):
        return list(range(len(own_labels)))
    repeated = sorted({label for label in own_labels if own_labels.count(label) > 1})
    if repeated:
        raise SpecError(f"{what[0].upper()}{what[1:]} repeat the label {repeated[0]!r}.", path=kind)
    if known.get(kind) is None:
        known[kind] = own_labels
    wanted = list(known[kind] or ())
    missing, foreign = (
        [name for name in wanted if name not in own_labels],
        [name for name in own_labels if name not in wanted],
    )
    if missing or foreign:
        texts = [f"lack {', '.join(map(repr, missing))}"] if missing else []
        texts += [f"have {', '.join(map(repr, foreign))}"] if foreign else []
        raise SpecError(
            f"{what[0].upper()}{what[1:]} {' and '.join(texts)}: the {kind} are {', '.join(wanted)}.", path=kind
        )
    return [own_labels.index(name) for name in wanted]


def plant_fields(
    stated_matrices: Mapping[str, Any],
    names: Mapping[str, Sequence[str] | None],
    *,
    dt: Any,
    operating_point: Any,
    scales: Any,
    units: Any,
    delays: Any,
    sensor_noise: Any,
) -> dict[str, Any]:
    """Return every field of a `DescriptorSystem`; raise one `SpecError` with all problems."""
    problems = Problems()
    matrices, labels = _without_frames(stated_matrices, names)
    a = _square_state_matrix(matrices, problems)
    nx = a.shape[0]
    states = problems.collect(lambda: checked_names(labels["state_names"], nx, prefix="x", what="state_names"))
    problems.raise_if_any()
    checked: dict[str, FloatArray | None] = {"A": a, "E": _identity_like(a) if matrices["E"] is None else None}
    for name, value in matrices.items():
        if value is not None and not (name in SENSOR_PICKS and is_name_list(value)):
            checked[name] = problems.collect(partial(matrix_or_picks, value, name, states))
    more = _appended(matrices, labels, checked, sensor_noise, problems)
    sizes = {"x": nx, **signal_counts(checked, nx)}
    unknown = _signals_not_counted(matrices, checked)
    values: dict[str, Any] = {
        name: problems.shaped(checked.get(name), name, (sizes[rows], sizes[columns]))
        for name, rows, columns in MATRIX_LAYOUT
        if not unknown.intersection((rows, columns))
    }
    values |= {"dt": problems.collect(lambda: checked_dt(dt)), "state_names": states}
    for signal, key in SIGNAL_FIELDS.items():
        if signal in unknown or signal == "x":
            continue
        stated = _stated_names(key, signal, labels, matrices, of_sensors=more.get(key, ()), size=sizes[signal])
        values[key] = problems.collect(partial(checked_names, stated, sizes[signal], prefix=signal, what=key))
    if any(values.get(field) is None for field in SIGNAL_FIELDS.values()):
        # What refers to signals by name cannot be judged.
        problems.raise_if_any()
    known, measured = {name for field in SIGNAL_FIELDS.values() for name in values[field]}, set(values["input_names"])
    measured |= set(values["output_names"])
    values |= checked_labels(problems, known, measured, operating_point=operating_point, scales=scales, units=units)
    values["delays"] = problems.collect(lambda: checked_delays(delays, values["input_names"], values["output_names"]))
    problems.raise_if_any()
    return values


def _square_state_matrix(matrices: dict[str, Any], problems: Problems) -> FloatArray:
    """Take A ``(nx, nx)`` out of the matrices; raise `SpecError` where it cannot be read or is not square."""
    a: FloatArray = problems.collect(lambda: any_matrix(matrices.pop("A"), "A"))
    problems.raise_if_any()
    nx = a.shape[0]
    if a.shape == (0, 0):
        raise SpecError(
            "A is 0 by 0: a plant without states (a static gain) has nothing to estimate. Give it a state, such as the "
            "lag of a sensor.",
            path="A",
        )
    if nx == 0 or a.shape[1] != nx:
        remedy = (
            " The first argument is E: give A=..., B=... and C=... by name." if _is_square(matrices["E"], nx) else ""
        )
        raise SpecError(f"A is {nx} by {a.shape[1]}, but it must be square (nx by nx, nx >= 1).{remedy}", path="A")
    return a


def _signals_not_counted(matrices: Mapping[str, Any], checked: Mapping[str, FloatArray | None]) -> set[str]:
    """Return the signals whose number only matrices tell that could not be read: what depends on it is not judged, as
    the message of the matrix is enough."""
    broken = {name for name, value in matrices.items() if value is not None and checked.get(name) is None}
    return {
        signal
        for signal, telling in COUNTED_BY.items()
        if broken.intersection(telling) and all(checked.get(name) is None for name in telling)
    }


def _stated_names(
    key: str,
    signal: str,
    labels: Mapping[str, Any],
    matrices: Mapping[str, Any],
    *,
    of_sensors: tuple[str, ...],
    size: int,
) -> Any:
    """Return the names of a kind of signal: as given, else those by which its matrix was picked; those of signals that
    were given by the names of sensors are appended, where they are not among them."""
    own = plain_names(labels[key])
    no_names = own is None or (isinstance(own, (list, tuple)) and not own)
    stated = picked_names(matrices.get(_NAMED_BY.get(key, ""))) if no_names else own
    others = size - len(of_sensors)
    if not of_sensors or not (stated is None or (is_name_list(stated) and len(stated) == others)):
        return stated
    return (*checked_names(stated, others, prefix=signal, what=key), *of_sensors)


def _is_square(matrix: Any, rows: int) -> bool:
    """Whether E is given with so many rows and columns: a call by position has A in its place."""
    try:
        return matrix is not None and any_matrix(matrix, "E").shape == (rows, rows)
    except SpecError:
        return False


def _identity_like(a: Any) -> Any:
    """Return the identity of the size of A, sparse where A is."""
    if not is_sparse(a):
        return np.eye(a.shape[0])
    from scipy.sparse import eye_array

    return as_sparse_matrix(eye_array(a.shape[0], format="csr"), "E")


def _appended(
    matrices: Mapping[str, Any],
    labels: Mapping[str, Sequence[str] | None],
    fields: dict[str, FloatArray | None],
    sensor_noise: Any,
    problems: Problems,
) -> dict[str, tuple[str, ...]]:
    """Append what is given by the names of sensors to ``fields``; return the names of these signals by field."""
    if sensor_noise is None and not any(is_name_list(matrices[name]) for name in SENSOR_PICKS):
        return {}
    if matrices["C"] is not None and fields.get("C") is None:
        return {}
    names = labels["output_names"]
    stated = picked_names(matrices["C"]) if names is None else names
    outputs = problems.collect(
        lambda: checked_names(stated, signal_counts(fields, _size(fields))["y"], prefix="y", what="output_names")
    )
    problems.raise_if_any()
    picked = problems.collect(lambda: _with_sensor_picks(matrices, fields, outputs)) or {}
    noises = problems.collect(lambda: _noise_of_sensors(sensor_noise, fields, outputs)) or ()
    return {"fault_names": picked.get("Df", ()), "disturbance_names": picked.get("Dd", ()), "noise_names": noises}


def _size(fields: Mapping[str, Any]) -> int:
    return int(fields["A"].shape[0])


def _with_sensor_picks(
    stated: Mapping[str, Any], fields: dict[str, FloatArray | None], outputs: Sequence[str]
) -> dict[str, tuple[str, ...]]:
    """Append a column to Df, Bf (Dd, Bd) in ``fields`` for each sensor that Df (Dd) names; return these."""
    picks = {}
    for name, beside in SENSOR_PICKS.items():
        picked = stated[name]
        if not is_name_list(picked):
            continue
        columns = rows_picking(picked, outputs, what=name).T
        own = fields.get(beside)
        dynamics = np.zeros((_size(fields), 0)) if own is None else dense(own)
        fields[beside] = np.hstack([dynamics, np.zeros((len(dynamics), len(picked)))])
        fields[name] = np.hstack([np.zeros((len(outputs), dynamics.shape[1])), columns])
        picks[name] = tuple(picked)
    return picks


def _noise_of_sensors(
    sensor_noise: Any, fields: dict[str, FloatArray | None], outputs: Sequence[str]
) -> tuple[str, ...]:
    """Append a column to Bw, Dw in ``fields`` for each sensor with a standard deviation; return their names."""
    if sensor_noise is None:
        return ()
    require_kind(sensor_noise, Mapping, "sensor_noise", "a standard deviation by output, such as {'speed': 0.01}")
    require_picked(sensor_noise, outputs, what="sensor_noise")
    columns = np.zeros((len(outputs), len(sensor_noise)))
    for column, (name, value) in enumerate(sensor_noise.items()):
        deviation = float(any_matrix(value, f"sensor_noise[{name!r}]")[0, 0])
        if deviation <= 0.0:
            raise SpecError(
                f"sensor_noise[{name!r}] is {deviation:g}: give a standard deviation above 0.", path="sensor_noise"
            )
        columns[list(outputs).index(name), column] = deviation
    others = [matrix for name in ("Bw", "Dw") if (matrix := fields.get(name)) is not None and 0 not in matrix.shape]
    nw, nx = others[0].shape[1] if others else 0, _size(fields)
    for name, rows, more in (("Bw", nx, np.zeros((nx, len(sensor_noise)))), ("Dw", len(outputs), columns)):
        matrix = fields.get(name)
        matrix = np.zeros((rows, nw)) if matrix is None or 0 in matrix.shape else dense(matrix)
        if matrix.shape != (rows, nw):
            # Its own message is enough.
            return ()
        fields[name] = np.hstack([matrix, more])
    return tuple(f"{SENSOR_NOISE}{name}" for name in sensor_noise)
