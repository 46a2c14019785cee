"""Linear models in files: ``.mat`` files of MATLAB, and ``linearized_model.mo`` of OpenModelica's ``linearize``."""

from __future__ import annotations

import errno
import math
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from obsynth.errors import SpecError
from obsynth.files.inputs import path_of, read_text
from obsynth.numerics.arguments import arguments_checked, number_in_text
from obsynth.numerics.arrays import FloatArray, require_readable
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.importing.roles import plant_of

_MODEL_MATRICES = ("E", "A", "B", "C", "D")

_MORE = ("Bf", "Df", "Bd", "Dd", "Bw", "Dw")

# What MATLAB's state-space objects call them, and what obsynth does.
_MATLAB_NAMES = {
    "StateName": "state_names",
    "InputName": "input_names",
    "OutputName": "output_names",
    **{f"{kind}_names": f"{kind}_names" for kind in ("state", "input", "output", "fault", "disturbance", "noise")},
}

_SAMPLE_TIME_NAMES = ("Ts", "dt")


_SIZE = re.compile(r"parameter\s+Integer\s+([nmp])\s*=\s*(\d+)")

_MODELICA_MATRIX = re.compile(r"parameter\s+Real\s+([ABCD])\s*\[[^\]]*\]\s*=\s*(\[[^\]]*\]|zeros\([^)]*\))\s*;")

_POINT = re.compile(r"parameter\s+Real\s+([xu])0\s*\[[^\]]*\]\s*=\s*(\{[^}]*\}|zeros\([^)]*\)|fill\([^)]*\))\s*;")

_ALIAS = re.compile(r"Real\s+'([xuy])_([^']*)'\s*=\s*([xuy])\[(\d+)\]\s*;")

# OpenModelica makes outputs that are states into states of their own name.
_OUTPUT_ALIAS = "$outputAlias_"


@arguments_checked
def from_matlab(
    path: str | Path,
    variable: str | None = None,
    *,
    dt: float | None = None,
    **plant: Any,
) -> DescriptorSystem:
    """Return the plant in a ``.mat`` file (up to version 7.2).

    Parameters
    ----------
    path : path
        The file.
    variable : str, optional
        A struct with fields ``A`` and, as far as there are any, ``E, B, C, D, Bf, Df, Bd, Dd, Bw, Dw``, ``Ts`` or
        ``dt`` (seconds, 0 for continuous time) and names (``StateName``, ``InputName``, ``OutputName``, as
        ``struct(sys)`` has them, or ``state_names`` and so on).  May be left out where the file has one struct, or the
        matrices themselves.
    dt : float, optional, seconds
        Where the file does not say it; 0 for continuous time.
    **plant
        Roles, as lists of names: ``faults`` and ``disturbances`` (inputs that are faults, or unknown; the others are
        known inputs), ``actuator_faults`` (known inputs on which a fault acts: adds ``fault of <input>``) and
        ``sensor_faults`` (outputs with a bias: adds ``bias of <output>``).  Any other argument of `DescriptorSystem`.

    Returns
    -------
    DescriptorSystem
        With the names in the file.

    Raises
    ------
    SpecError
        The file cannot be read, holds no such struct, or its matrices do not fit together.

    Examples
    --------
    >>> import obsynth
    >>> from tempfile import TemporaryDirectory
    >>> from scipy.io import savemat
    >>> with TemporaryDirectory() as folder:
    ...     savemat(f"{folder}/plant.mat", {"A": [[-1.0]], "C": [[1.0]], "Ts": 0.0})
    ...     print(obsynth.from_matlab(f"{folder}/plant.mat").A.tolist())
    [[-1.0]]
    """
    source = path_of(path)
    content = _content(source)
    fields = _fields(content, variable, source)
    if "A" not in fields:
        raise SpecError(
            f"{source} has no matrix A{_in(variable)}; it has: {', '.join(fields) or 'nothing'}.", path=str(source)
        )
    times = [
        float(np.squeeze(fields[name])) for name in _SAMPLE_TIME_NAMES if name in fields and np.size(fields[name]) == 1
    ]
    if dt is None and not times:
        raise SpecError(f"{source} has no sampling time (Ts): give dt in seconds, or 0 for continuous time.", path="dt")
    if dt is not None and times and dt != times[0]:
        raise SpecError(f"dt is {dt}, but {source} has {times[0]:g}: leave dt out.", path="dt")
    names = {ours: _texts(fields[theirs]) for theirs, ours in _MATLAB_NAMES.items() if theirs in fields}
    labels = {ours: names.pop(ours, None) for ours in ("state_names", "input_names", "output_names")}
    given = {name: _dense_value(fields[name]) for name in (*_MODEL_MATRICES, *_MORE) if name in fields}
    return plant_of(
        {name: given[name] for name in _MODEL_MATRICES if name in given and np.size(given[name])},
        {**{name: given[name] for name in _MORE if name in given}, **names, **plant},
        labels=labels,
        dt=times[0] if dt is None else dt,
    )


def mat_arrays(source: Path) -> dict[str, Any]:
    """Return what a ``.mat`` file holds by name; raise `ValueError` for other versions, damaged and too large files."""
    try:
        # A small file may unpack to more than the memory holds.
        require_readable(sum(math.prod(shape) for _, shape, kind in scipy.io.whosmat(source) if kind != "sparse"))
        content = scipy.io.loadmat(source)
    except NotImplementedError as error:
        raise ValueError("MATLAB 7.3 files are not supported, save it with '-v7'") from error
    except scipy.io.matlab.MatReadError as error:
        raise ValueError(str(error)) from error
    return {name: value for name, value in content.items() if not name.startswith("__")}


def _content(source: Path) -> dict[str, Any]:
    if not source.is_file():
        raise SpecError(f"{source} does not exist.", path=str(source))
    try:
        return mat_arrays(source)
    except (OSError, ValueError, TypeError, KeyError, EOFError, OverflowError) as error:
        raise SpecError(f"{source} cannot be read as a .mat file: {error}", path=str(source)) from error


def _fields(content: Mapping[str, Any], variable: str | None, source: Path) -> dict[str, Any]:
    structs = [
        name
        for name, value in content.items()
        if getattr(value, "dtype", None) is not None and value.dtype.names and value.size == 1
    ]
    if variable is None and "A" in content:
        return dict(content)
    if variable is None and len(structs) != 1:
        found = ", ".join(map(repr, structs)) or "none"
        raise SpecError(f"{source}: name the struct of the plant (variable=...); it has: {found}.", path=str(source))
    name = structs[0] if variable is None else variable
    if name not in structs:
        raise SpecError(
            f"{source} has no struct {name!r}; it has: {', '.join(map(repr, structs)) or 'none'}.", path=str(source)
        )
    record = content[name].reshape(-1)[0]
    return {field: record[field] for field in content[name].dtype.names}


def _in(variable: str | None) -> str:
    return "" if variable is None else f" in {variable!r}"


def _dense_value(value: Any) -> Any:
    return value.toarray() if hasattr(value, "toarray") else value


def _texts(value: Any) -> list[str] | None:
    """Return the texts of a cell array, or of a matrix of characters; `None` where all are empty, as MATLAB has it."""
    texts = [str(np.squeeze(cell)) if np.size(cell) else "" for cell in np.atleast_1d(value).ravel()]
    return [text.strip() for text in texts] if any(text.strip() for text in texts) else None


@arguments_checked
def from_modelica(path: str | Path, **plant: Any) -> DescriptorSystem:
    """Return the plant of a linearised Modelica model, with the names of its variables.

    Parameters
    ----------
    path : path
        The file ``linearized_model.mo`` that OpenModelica's ``linearize`` (or ``-l=<time>``) writes.
    **plant
        Roles, as lists of names: ``faults`` and ``disturbances`` (inputs that are faults, or unknown; the others are
        known inputs), ``actuator_faults`` (known inputs on which a fault acts: adds ``fault of <input>``) and
        ``sensor_faults`` (outputs with a bias: adds ``bias of <output>``).  Any other argument of `DescriptorSystem`.

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

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> import obsynth
    >>> text = (
    ...     "model linearized_model parameter Integer n = 1; parameter Integer m = 1; parameter Integer p = 1;"
    ...     " parameter Real A[n, n] = [-1]; parameter Real B[n, m] = [1]; parameter Real C[p, n] = [1];"
    ...     " parameter Real D[p, m] = [0]; Real 'x_level' = x[1]; Real 'u_inflow' = u[1]; Real 'y_gauge' = y[1];"
    ...     " end linearized_model;"
    ... )
    >>> with TemporaryDirectory() as folder:
    ...     file = Path(folder) / "linearized_model.mo"
    ...     _ = file.write_text(text)
    ...     plant = obsynth.from_modelica(file)
    >>> plant.A.tolist()
    [[-1.0]]
    """
    source = path_of(path)
    if not source.exists():
        raise SpecError(f"{source} cannot be read: {os.strerror(errno.ENOENT)}.", path=str(source))
    text = re.sub(r"//[^\n]*|/\*.*?\*/", "", read_text(source), flags=re.DOTALL)
    sizes = {name: int(count) for name, count in _SIZE.findall(text)}
    found = {name: body for name, body in _MODELICA_MATRIX.findall(text)}
    missing = [name for name in ("n", "m", "p") if name not in sizes] + [name for name in "ABCD" if name not in found]
    if missing:
        raise SpecError(
            f"{source} is no linear model as OpenModelica writes it: it has no {missing[0]}.", path=str(source)
        )
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
        name: value
        for kind in "xu"
        for name, value in zip(
            names[kind], _numbers(points.get(kind, ""), len(names[kind]), f"{kind}0", source), strict=True
        )
    }
    measured = sizes["p"] > 0
    if not measured:
        matrices |= {"C": np.eye(sizes["n"]), "D": np.zeros((sizes["n"], sizes["m"]))}
    labels = {"state_names": names["x"], "input_names": names["u"], "output_names": names["y" if measured else "x"]}
    return plant_of(matrices, plant, labels=labels, dt=0.0, point=point)


def _matrix(body: str, rows: int, columns: int, name: str, source: Path) -> FloatArray:
    if body.startswith("zeros"):
        return np.zeros((rows, columns))
    lines = [line for line in body.strip("[]").split(";") if line.strip()]
    values = [[_number(entry, name, source) for entry in line.split(",")] for line in lines]
    if len(values) != rows or any(len(row) != columns for row in values):
        raise SpecError(f"{source}: {name} is not {rows} by {columns}, as the file states.", path=name)
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
        return number_in_text(text)
    except ValueError:
        raise SpecError(f"{source}: {name} holds {text.strip()!r}, which is no number.", path=name) from None
