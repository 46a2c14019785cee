"""Linear models that Modelica tools write: the file ``linearized_model.mo`` of OpenModelica's ``linearize``."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.files.inputs import input_file
from obsynth.importing.roles import plant_of
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.descriptor import DescriptorSystem

_SIZE = re.compile(r"parameter\s+Integer\s+([nmp])\s*=\s*(\d+)")
_MATRIX = re.compile(r"parameter\s+Real\s+([ABCD])\s*\[[^\]]*\]\s*=\s*(\[[^\]]*\]|zeros\([^)]*\))\s*;")
_POINT = re.compile(r"parameter\s+Real\s+([xu])0\s*\[[^\]]*\]\s*=\s*(\{[^}]*\}|zeros\([^)]*\)|fill\([^)]*\))\s*;")
_ALIAS = re.compile(r"Real\s+'([xuy])_([^']*)'\s*=\s*([xuy])\[(\d+)\]\s*;")
# OpenModelica makes outputs that are states into states of their own name.
_OUTPUT_ALIAS = "$outputAlias_"


def from_modelica(
    path: str | Path,
    *,
    faults: Sequence[str] = (),
    disturbances: Sequence[str] = (),
    actuator_faults: Sequence[str] = (),
    sensor_faults: Sequence[str] = (),
    **plant: Any,
) -> DescriptorSystem:
    """Return the plant of a linearised Modelica model, with the names of its variables.

    Parameters
    ----------
    path : path
        The file ``linearized_model.mo`` that OpenModelica's ``linearize`` (or ``-l=<time>``) writes.
    faults, disturbances : list of str
        Inputs of the model that are faults, or unknown; the others are known inputs.
    actuator_faults : list of str
        Known inputs on which a fault acts: adds ``fault of <input>``.
    sensor_faults : list of str
        Outputs with a bias: adds ``bias of <output>``.
    **plant
        Any other argument of `DescriptorSystem`.

    Returns
    -------
    DescriptorSystem
        Continuous; states and known inputs have the values ``x0`` and ``u0`` of the file as operating point.  A model
        without outputs measures all its states.

    Raises
    ------
    SpecError
        The file cannot be read, or is no such model.

    Notes
    -----
    The file does not hold the outputs at the operating point: add them by ``operating_point={...}``.  Constant terms
    are not in it either: linearise in a steady state.
    """
    source = Path(path)
    if source.exists():
        source = input_file(source)
    try:
        text = source.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is no text"
        raise SpecError(f"{source} cannot be read: {reason}.", path=str(source)) from error
    text = re.sub(r"//[^\n]*|/\*.*?\*/", "", text, flags=re.DOTALL)
    sizes = {name: int(count) for name, count in _SIZE.findall(text)}
    found = {name: body for name, body in _MATRIX.findall(text)}
    missing = [name for name in ("n", "m", "p") if name not in sizes] + [name for name in "ABCD" if name not in found]
    if missing:
        raise SpecError(f"{source} is no linear model as OpenModelica writes it: it has no {missing[0]}.",
                        path=str(source))  # fmt: skip
    shapes = {"A": ("n", "n"), "B": ("n", "m"), "C": ("p", "n"), "D": ("p", "m")}
    matrices = {
        name: _matrix(found[name], sizes[rows], sizes[columns], name, source)
        for name, (rows, columns) in shapes.items()
    }
    names = {kind: [f"{kind}{i + 1}" for i in range(sizes[size])] for kind, size in zip("xuy", "nmp", strict=True)}
    for kind, name, array, number in _ALIAS.findall(text):
        if kind == array and int(number) <= len(names[kind]):
            names[kind][int(number) - 1] = name.removeprefix(_OUTPUT_ALIAS)
    points = dict(_POINT.findall(text))
    point = {
        name: value for kind in "xu" for name, value in
        zip(names[kind], _numbers(points.get(kind, ""), len(names[kind]), f"{kind}0", source), strict=True)
    }  # fmt: skip
    measured = sizes["p"] > 0
    stated = {**point, **(plant.pop("operating_point", None) or {})}
    return plant_of(
        {**matrices, "C": matrices["C"] if measured else np.eye(sizes["n"]),
         "D": matrices["D"] if measured else np.zeros((sizes["n"], sizes["m"]))},
        labels={"state_names": names["x"], "input_names": names["u"],
                "output_names": names["y"] if measured else names["x"]},
        faults=faults, disturbances=disturbances, actuator_faults=actuator_faults, sensor_faults=sensor_faults,
        more={"dt": 0.0, "operating_point": stated, **plant},
    )  # fmt: skip


def _matrix(body: str, rows: int, columns: int, name: str, source: Path) -> FloatArray:
    if body.startswith("zeros"):
        return np.zeros((rows, columns))
    lines = [line for line in body.strip("[]").split(";") if line.strip()]
    values = [[_number(entry, name, source) for entry in line.split(",")] for line in lines]
    if len(values) != rows or any(len(row) != columns for row in values):
        raise SpecError(f"{source}: {name} is not {rows} by {columns}, as the file says.", path=name)
    return np.array(values).reshape(rows, columns)


def _numbers(body: str, count: int, name: str, source: Path) -> list[float]:
    if not body.startswith("{"):
        return [0.0] * count
    entries = [entry for entry in body.strip("{}").split(",") if entry.strip()]
    if len(entries) != count:
        raise SpecError(f"{source}: {name} has {len(entries)} entries, but {count} are needed.", path=name)
    return [_number(entry, name, source) for entry in entries]


def _number(text: str, name: str, source: Path) -> float:
    try:
        return float(text)
    except ValueError:
        raise SpecError(f"{source}: {name} holds {text.strip()!r}, which is no number.", path=name) from None
