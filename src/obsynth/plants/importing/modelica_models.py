"""Linear models of Modelica tools: ``linearized_model.mo`` of OpenModelica's ``linearize``, ``dslin.mat`` of Dymola."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.files.inputs import input_file, path_of, read_text
from obsynth.numerics.arguments import arguments_checked, number_in_text
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.importing.matlab_models import from_matlab
from obsynth.plants.importing.roles import plant_of

_SIZE = re.compile(r"parameter\s+Integer\s+([nmpqkl])\s*=\s*(\d+)")

#: Numbers of inputs and of outputs as versions of OpenModelica call them; p is either.
_SIZES_OF_VERSIONS = (("m", "p"), ("p", "q"), ("k", "l"))

#: Endings of what it writes on request, and the language.
_OTHER_LANGUAGES = {".py": "Python", ".m": "MATLAB", ".jl": "Julia"}

_MODELICA_MATRIX = re.compile(r"parameter\s+Real\s+([ABCD])\s*\[[^\]]*\]\s*=\s*(\[[^\]]*\]|zeros\([^)]*\))\s*;")

_POINT = re.compile(r"parameter\s+Real\s+([xu])0\s*\[[^\]]*\]\s*=\s*(\{[^}]*\}|zeros\([^)]*\)|fill\([^)]*\))\s*;")

_ALIAS = re.compile(r"Real\s+'([xuy])_([^']*)'\s*=\s*([xuy])\[(\d+)\]\s*;")

_PARAMETER = re.compile(r"parameter\s+\w+\s+(\w+)")

#: What OpenModelica declares: sizes, operating point, matrices; those with z recover all variables of the model.
_MODELICA_PARAMETERS = frozenset((*"nmpqklABCD", "x0", "u0", "z0", "nz", "Cz", "Dz"))

_EQUATION = re.compile(r"\bequation\b(.*?)\bend\b", re.DOTALL)

#: The equations of a linear model, without blanks; any other changes what the matrices mean.
_MODELICA_EQUATIONS = re.compile(r"(der\(x\)=A\*x(\+B\*u)?|y=C\*x(\+D\*u)?|z=Cz\*x(\+Dz\*u)?|y=D\*u|z=Dz\*u)")

# OpenModelica makes outputs that are states into states of their own name.
_OUTPUT_ALIAS = "$outputAlias_"


@arguments_checked
def from_modelica(path: str | Path, **plant: Any) -> DescriptorSystem:
    """Return the plant of a linearised Modelica model, with the names of its variables.

    Parameters
    ----------
    path : path
        The file ``linearized_model.mo`` that OpenModelica's ``linearize`` (or ``-l=<time>``) writes, of any version, or
        ``dslin.mat`` of Dymola.
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
    source = input_file(path_of(path))
    suffix = source.suffix.lower()
    if suffix == ".mat":
        return from_matlab(source, **plant)
    if suffix in _OTHER_LANGUAGES:
        raise SpecError(
            f"{source} is in {_OTHER_LANGUAGES[suffix]}, and what OpenModelica writes in Modelica is read: compile the "
            "model with --linearizationDumpLanguage=modelica, which is its default.",
            path=str(source),
        )
    text = re.sub(r"//[^\n]*|/\*.*?\*/", "", read_text(source), flags=re.DOTALL)
    sizes = {name: int(count) for name, count in _SIZE.findall(text)}
    bodies = {name: body for name, body in _MODELICA_MATRIX.findall(text)}
    own = next((own for own in _SIZES_OF_VERSIONS if all(name in sizes for name in own)), None)
    if own is not None:
        sizes |= {"m": sizes[own[0]], "p": sizes[own[1]]}
    missing = [name for name in ("n", "m", "p") if name not in sizes] + [name for name in "ABCD" if name not in bodies]
    if missing:
        raise SpecError(
            f"{source} is no linear model as OpenModelica writes it: it has no {missing[0]}.", path=str(source)
        )
    _require_plain_model(text, source)
    shapes = {"A": ("n", "n"), "B": ("n", "m"), "C": ("p", "n"), "D": ("p", "m")}
    matrices = {
        name: _matrix(bodies[name], sizes[rows], sizes[columns], name, source)
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


def _require_plain_model(text: str, source: Path) -> None:
    """Refuse, by name, parameters and equations that a linear model of OpenModelica does not have."""
    unknown = [name for name in _PARAMETER.findall(text) if name not in _MODELICA_PARAMETERS]
    if unknown:
        raise SpecError(
            f"{source} declares {', '.join(unknown)}, which a linear model of OpenModelica does not have: its meaning "
            "is not known here. Give the file as OpenModelica writes it.",
            path=str(source),
        )
    for section in _EQUATION.findall(text):
        for equation in filter(None, (re.sub(r"\s", "", part) for part in section.split(";"))):
            if not _MODELICA_EQUATIONS.fullmatch(equation):
                raise SpecError(
                    f"{source} has the equation {equation!r}, which is not one of x' = A x + B u and y = C x + D u: "
                    "the matrices alone do not say what it means.",
                    path=str(source),
                )


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
