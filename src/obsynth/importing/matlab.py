"""A plant in a ``.mat`` file: a struct, or the whole file, with E, A, B, C, D."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.importing.roles import plant_of
from obsynth.plants.descriptor import DescriptorSystem

_MATRICES = ("E", "A", "B", "C", "D")
_MORE = ("Bf", "Df", "Bd", "Dd", "Bw", "Dw")
# What MATLAB's state-space objects call them, and what obsynth does.
_NAMES = {
    "StateName": "state_names", "InputName": "input_names", "OutputName": "output_names",
    **{f"{kind}_names": f"{kind}_names" for kind in ("state", "input", "output", "fault", "disturbance", "noise")},
}  # fmt: skip
_TIMES = ("Ts", "dt")


def from_matlab(
    path: str | Path,
    variable: str | None = None,
    *,
    dt: float | None = None,
    faults: Sequence[str] = (),
    disturbances: Sequence[str] = (),
    actuator_faults: Sequence[str] = (),
    sensor_faults: Sequence[str] = (),
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
    faults, disturbances : list of str
        Inputs in the file that are faults, or unknown; the others are known inputs.
    actuator_faults : list of str
        Known inputs on which a fault acts: adds ``fault of <input>``.
    sensor_faults : list of str
        Outputs with a bias: adds ``bias of <output>``.
    **plant
        Any other argument of `DescriptorSystem`.

    Returns
    -------
    DescriptorSystem
        With the names in the file.

    Raises
    ------
    SpecError
        The file cannot be read, holds no such struct, or its matrices do not fit together.
    """
    source = Path(path)
    content = _content(source)
    fields = _fields(content, variable, source)
    if "A" not in fields:
        raise SpecError(f"{source} has no matrix A{_in(variable)}; it has: {', '.join(fields) or 'nothing'}.",
                        path=str(source))  # fmt: skip
    times = [float(np.squeeze(fields[name])) for name in _TIMES if name in fields and np.size(fields[name]) == 1]
    if dt is None and not times:
        raise SpecError(f"{source} does not say the sampling time (Ts): give dt in seconds, or 0 for continuous time.",
                        path="dt")  # fmt: skip
    if dt is not None and times and dt != times[0]:
        raise SpecError(f"dt is {dt}, but {source} has {times[0]:g}: leave dt out.", path="dt")
    names = {ours: _texts(fields[theirs]) for theirs, ours in _NAMES.items() if theirs in fields}
    labels = {ours: names.pop(ours, None) for ours in ("state_names", "input_names", "output_names")}
    more = {name: _dense(fields[name]) for name in _MORE if name in fields}
    return plant_of(
        {name: _dense(fields[name]) for name in _MATRICES if name in fields and np.size(_dense(fields[name]))},
        labels=labels, faults=faults, disturbances=disturbances, actuator_faults=actuator_faults,
        sensor_faults=sensor_faults, more={"dt": times[0] if dt is None else dt, **more, **names, **plant},
    )  # fmt: skip


def _content(source: Path) -> dict[str, Any]:
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    if not source.is_file():
        raise SpecError(f"{source} does not exist.", path=str(source))
    try:
        content = loadmat(source)
    except NotImplementedError:
        raise SpecError(f"{source} is of MATLAB 7.3: save it with '-v7'.", path=str(source)) from None
    except (OSError, ValueError, TypeError, KeyError, EOFError, OverflowError, MatReadError) as error:
        raise SpecError(f"{source} cannot be read as a .mat file: {error}", path=str(source)) from error
    return {name: value for name, value in content.items() if not name.startswith("__")}


def _fields(content: Mapping[str, Any], variable: str | None, source: Path) -> dict[str, Any]:
    structs = [name for name, value in content.items() if getattr(value, "dtype", None) is not None
               and value.dtype.names and value.size == 1]  # fmt: skip
    if variable is None and "A" in content:
        return dict(content)
    if variable is None and len(structs) != 1:
        found = ", ".join(map(repr, structs)) or "none"
        raise SpecError(f"{source}: say which struct is the plant (variable=...); it has: {found}.", path=str(source))
    name = structs[0] if variable is None else variable
    if name not in structs:
        raise SpecError(f"{source} has no struct {name!r}; it has: {', '.join(map(repr, structs)) or 'none'}.",
                        path=str(source))  # fmt: skip
    record = content[name].reshape(-1)[0]
    return {field: record[field] for field in content[name].dtype.names}


def _in(variable: str | None) -> str:
    return "" if variable is None else f" in {variable!r}"


def _dense(value: Any) -> Any:
    return value.toarray() if hasattr(value, "toarray") else value


def _texts(value: Any) -> list[str] | None:
    """Return the texts of a cell array, or of a matrix of characters; `None` where all are empty, as MATLAB has it."""
    texts = [str(np.squeeze(cell)) if np.size(cell) else "" for cell in np.atleast_1d(value).ravel()]
    return [text.strip() for text in texts] if any(text.strip() for text in texts) else None
