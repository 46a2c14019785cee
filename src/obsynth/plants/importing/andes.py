"""Power networks of the simulator ANDES: a case, or the pencil that was written from one."""

from __future__ import annotations

import json
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import scipy

from obsynth.errors import SpecError
from obsynth.files.inputs import READING_ERRORS
from obsynth.numerics.arguments import arguments_checked
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.libraries import imported
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.signal_names import checked_names

#: Names of variables, or the variables of each device: ``{"GENCLS 1": ["omega"], "Bus 1": ["a", "v"]}``.
Picked: TypeAlias = "Sequence[str] | Mapping[str, Sequence[str]]"

_PENCIL = ("E.mtx", "A.mtx", "names.json")

#: A rate or an imbalance (per unit) that the power flow's tolerance explains.
_AT_REST = 1e-4

#: Devices that a message lists.
_LISTED_DEVICES = 12


@arguments_checked
def from_andes(
    case: Any, *, outputs: Picked, faults: Picked = (), disturbances: Picked = (), **plant: Any
) -> DescriptorSystem:
    """Return the plant of a power network, linearised at its power flow solution.

    Parameters
    ----------
    case : path or andes.System
        A case file that ANDES reads (``.json``, ``.xlsx``, ``.raw``, ...); a folder with ``E.mtx``, ``A.mtx`` and
        ``names.json``, such as ``designs/smib``; or a system of ANDES, whose power flow is solved where it is not yet.
    outputs : list of str, or mapping
        Measured variables by name, ``["omega GENCLS 1", "v Bus 1"]``, or by device,
        ``{"GENCLS 1": ["omega"], "Bus 1": ["v"]}``.
    faults, disturbances : list of str, or mapping
        Variables in whose equations a fault, or an unknown input, is added: ``{"GENCLS 1": ["tm"]}`` is a change of
        mechanical torque, ``{"Bus 3": ["a"]}`` active power drawn at a bus.
    **plant
        Any other argument of `DescriptorSystem`, such as ``sensor_noise`` or ``fault_names``.

    Returns
    -------
    DescriptorSystem
        Continuous, ``T x' = f(x, y)``, ``0 = g(x, y)`` as one pencil ``(nx + ny, nx + ny)``: differential variables
        first.  From a case, the power flow solution is the operating point.

    Raises
    ------
    SpecError
        ANDES is not installed (it is licensed under the GPL and no dependency of ours), it cannot read or solve the
        case, or a name is unknown.

    Warns
    -----
    UserWarning
        ANDES does not start the case at rest: a linear model of deviations has no constant term.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.from_andes(  # a folder of the repository: a pencil that ANDES wrote
    ...     "designs/smib", outputs={"GENCLS 1": ["omega"], "Bus 1": ["a", "v"]}, faults={"GENCLS 1": ["tm"]}
    ... )
    >>> plant.ny, plant.nf
    (3, 1)
    """
    point: dict[str, float] = {}
    if isinstance(case, (str, Path)) and Path(case).is_dir():
        e, a, names = _written_pencil(Path(case))
    else:
        e, a, names, point = _solved_case(case)
    roles = {
        kind: _names(picked, names, kind)
        for kind, picked in (("outputs", outputs), ("faults", faults), ("disturbances", disturbances))
    }
    stated = {**point, **(plant.pop("operating_point", None) or {})}
    arguments: dict[str, Any] = {
        "dt": 0.0,
        "state_names": checked_names(names, len(names), prefix="x", what="state_names"),
        "Bf": roles["faults"] or None,
        "Bd": roles["disturbances"] or None,
        "C": roles["outputs"],
    }
    # A fault and a disturbance are changes: the value of the variable they are named after is not theirs.
    for kind, role, word in (("faults", "fault_names", "change of"), ("disturbances", "disturbance_names", "load on")):
        if roles[kind]:
            arguments[role] = [f"{word} {name}" for name in roles[kind]]
    return DescriptorSystem(e, a, **{**arguments, "operating_point": stated, **plant})


def _written_pencil(folder: Path) -> tuple[FloatArray, FloatArray, list[str]]:
    missing = [name for name in _PENCIL if not (folder / name).is_file()]
    if missing:
        raise SpecError(f"{folder} has no {missing[0]}: a pencil of ANDES is {', '.join(_PENCIL)}.", path=str(folder))
    try:
        e, a = (np.asarray(_dense(scipy.io.mmread(folder / name)), dtype=np.float64) for name in _PENCIL[:2])
        names = json.loads((folder / _PENCIL[2]).read_text(encoding="utf-8"))
        listed = [*names["differential"], *names["algebraic"]]
        unknown = [key for key in names if key not in ("differential", "algebraic") and names[key]]
        if unknown:
            raise ValueError(f"{_PENCIL[2]} has the unknown key {unknown[0]!r}, whose meaning is not known here")
    except READING_ERRORS as error:
        raise SpecError(f"{folder} holds no pencil of ANDES: {error}", path=str(folder)) from error
    return e, a, listed


def _solved_case(case: Any) -> tuple[FloatArray, FloatArray, list[str], dict[str, float]]:
    """Return E, A, the names of the variables and their values at the power flow solution."""
    andes = imported("andes", extra="andes")
    system = case
    if isinstance(case, (str, Path)):
        if not Path(case).is_file():
            raise SpecError(f"{case} does not exist.", path=str(case))
        system = andes.load(str(case), no_output=True, default_config=True, setup=True)
    if not hasattr(system, "PFlow") or not hasattr(system, "dae"):
        raise SpecError(f"ANDES cannot read {case}.", path="case")
    if not system.PFlow.converged and not system.PFlow.run():
        raise SpecError("The power flow of the case has no solution that ANDES finds.", path="case")
    if not system.TDS.initialized:
        system.TDS.init()
    dae = system.dae
    n, m = dae.n, dae.m
    blocks = ((dae.fx, dae.fy), (dae.gx, dae.gy))
    a = np.block([[_dense(block) for block in row] for row in blocks])
    e = np.zeros((n + m, n + m))
    e[np.arange(n), np.arange(n)] = np.asarray(dae.Tf, dtype=np.float64)
    names = _completed_names(system, [str(name) for name in (*dae.x_name, *dae.y_name)], n)
    values = np.concatenate([np.asarray(dae.x), np.asarray(dae.y)])
    _say_where_not_at_rest(np.concatenate([np.asarray(dae.f), np.asarray(dae.g)]), names)
    return e, a, names, dict(zip(names, map(float, values), strict=True))


def _say_where_not_at_rest(residuals: FloatArray, names: Sequence[str]) -> None:
    """Warn of a point at which ANDES does not start at rest: deviations from it obey no linear model."""
    worst = int(np.argmax(np.abs(residuals)))
    if not abs(residuals[worst]) <= _AT_REST:
        warnings.warn(
            f"ANDES does not start this case at rest: the equation of {names[worst]!r} is off by "
            f"{residuals[worst]:.3g}, and a linear model of deviations has no term for that. Mend the data of that "
            "device (ANDES lists limits and initial values that do not fit).",
            stacklevel=4,
        )


def _completed_names(system: Any, names: list[str], differential: int) -> list[str]:
    """Return names with empty and repeated ones completed from the device that has the variable: ``<variable> <model>
    <idx>``; what is still empty or repeated gets its number."""
    counts = Counter(name.strip() for name in names)
    if all(name and count == 1 for name, count in counts.items()):
        return names
    of_devices: dict[int, str] = {}
    for model in getattr(system, "models", {}).values():
        listed = getattr(getattr(model, "cache", None), "all_vars", None) or {}
        idx = list(getattr(getattr(model, "idx", None), "v", ()))
        for variable in listed.values():
            start = 0 if getattr(variable, "v_code", "x") == "x" else differential
            for device, address in zip(idx, np.ravel(getattr(variable, "a", ())), strict=False):
                of_devices.setdefault(start + int(address), f"{variable.name} {type(model).__name__} {device}")
    completed: list[str] = []
    for place, name in enumerate(names):
        text = name.strip()
        if not text or counts[text] > 1:
            text = of_devices.get(place, text or "variable")
        if text in completed or (text != name.strip() and counts[text]):
            text = f"{text} {place + 1}"
        completed.append(text)
    return completed


def _dense(matrix: Any) -> FloatArray:
    """Return a full array of a sparse matrix of scipy or of kvxopt."""
    if hasattr(matrix, "toarray"):
        return np.asarray(matrix.toarray(), dtype=np.float64)
    if hasattr(matrix, "V"):
        rows, columns, values = (np.array(part).ravel() for part in (matrix.I, matrix.J, matrix.V))
        dense = np.zeros(matrix.size)
        np.add.at(dense, (rows.astype(np.int64), columns.astype(np.int64)), values)
        return dense
    return np.asarray(matrix, dtype=np.float64)


def _names(picked: Picked, known: Sequence[str], what: str) -> list[str]:
    """Return names of variables; devices are spelled as ANDES does, ``omega GENCLS 1``."""
    if isinstance(picked, str):
        raise SpecError(f"{what} is {picked!r}: give a list of names.", path=what)
    if not isinstance(picked, Mapping):
        return list(picked)
    listed = []
    for device, variables in picked.items():
        own = [name.removesuffix(f" {device}") for name in known if name.endswith(f" {device}")]
        if not own:
            devices = list(dict.fromkeys(name.partition(" ")[2] for name in known))
            first_devices = ", ".join(devices[:_LISTED_DEVICES]) + (", ..." if len(devices) > _LISTED_DEVICES else "")
            raise SpecError(f"{what}: the network has no device {device!r}; it has {first_devices}.", path=what)
        for variable in variables:
            if variable not in own:
                raise SpecError(f"{what}: {device} has no variable {variable!r}; it has {', '.join(own)}.", path=what)
            listed.append(f"{variable} {device}")
    return listed
