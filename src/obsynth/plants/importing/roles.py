"""Roles of the inputs of an imported model: known inputs, faults, and disturbances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.numerics.arguments import require_shape
from obsynth.numerics.arrays import FloatArray, as_matrix
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.signal_names import checked_names, index_of

_ROLES = ("faults", "disturbances", "actuator_faults", "sensor_faults")


def plant_of(
    matrices: Mapping[str, ArrayLike | None],
    plant: Mapping[str, Any],
    *,
    dt: float,
    labels: Mapping[str, Sequence[str] | None],
    point: Mapping[str, float] | None = None,
    units: Mapping[str, str] | None = None,
    delays: Mapping[str, float] | None = None,
) -> DescriptorSystem:
    """Return the plant of matrices ``E, A, B, C, D`` whose inputs are shared out among known, faults and unknown.
    ``labels``: ``state_names``, ``input_names``, ``output_names``; ``plant``: roles and arguments of the plant, which
    go before ``dt``, and entry by entry before operating point, units and delays.  A delayed input that is a fault or
    unknown has none: its time is counted from when it acts."""
    more = {"dt": dt, **plant}
    for name, stated in (("operating_point", point), ("units", units)):
        if stated is not None:
            more[name] = {**stated, **(more.get(name) or {})}
    faults, disturbances, actuator_faults, sensor_faults = _role_lists(more)
    a = as_matrix(matrices["A"], "A")
    checked = {name: None if value is None else as_matrix(value, name) for name, value in matrices.items()}
    c = checked.get("C")
    c = np.eye(a.shape[0]) if c is None else c
    nu = next((m.shape[1] for name in "BD" if (m := checked.get(name)) is not None), 0)
    inputs = checked_names(labels.get("input_names"), nu, prefix="u", what="input_names")
    outputs = checked_names(labels.get("output_names"), c.shape[0], prefix="y", what="output_names")
    b, d = _full(checked.get("B"), a.shape[0], nu, "B"), _full(checked.get("D"), c.shape[0], nu, "D")
    both = sorted(set(faults) & set(disturbances))
    if both:
        raise SpecError(f"Input {both[0]!r} is given as a fault and as a disturbance: keep one.", path="faults")
    fault, unknown = (
        _places(names, inputs, what) for names, what in ((faults, "faults"), (disturbances, "disturbances"))
    )
    doubled = _places(actuator_faults, inputs, "actuator_faults")
    gone = [name for name in actuator_faults if name in (*faults, *disturbances)]
    if gone:
        raise SpecError(f"actuator_faults names {gone[0]!r}, which is no known input.", path="actuator_faults")
    biased = _places(sensor_faults, outputs, "sensor_faults")
    known = [i for i in range(nu) if i not in (*fault, *unknown)]
    arguments: dict[str, Any] = {
        "E": checked.get("E"),
        "A": a,
        "B": b[:, known],
        "C": c,
        "D": d[:, known],
        "state_names": labels.get("state_names"),
        "output_names": outputs,
        "input_names": [inputs[i] for i in known],
    }
    if fault or doubled or biased:
        _refuse_both(more, "faults", ("Bf", "Df", "fault_names"))
        bias = np.eye(c.shape[0])[:, biased]
        arguments |= {
            "Bf": np.hstack([b[:, [*fault, *doubled]], np.zeros((a.shape[0], len(biased)))]),
            "Df": np.hstack([d[:, [*fault, *doubled]], bias]),
            "fault_names": [
                *faults,
                *(f"fault of {name}" for name in actuator_faults),
                *(f"bias of {name}" for name in sensor_faults),
            ],
        }
    late = {name: delay for name, delay in (delays or {}).items() if name not in (*faults, *disturbances)}
    if late:
        more["delays"] = {**late, **(more.get("delays") or {})}
    if unknown:
        _refuse_both(more, "disturbances", ("Bd", "Dd", "disturbance_names"))
        arguments |= {"Bd": b[:, unknown], "Dd": d[:, unknown], "disturbance_names": list(disturbances)}
    return DescriptorSystem(**{**arguments, **more})


def _full(matrix: FloatArray | None, rows: int, columns: int, name: str) -> FloatArray:
    if matrix is None or (matrix.size == 0 and 0 in (rows, columns)):
        return np.zeros((rows, columns))
    require_shape(matrix.shape, (rows, columns), name)
    return matrix


def _role_lists(more: dict[str, Any]) -> list[Sequence[str]]:
    """Take the names of each role out of the arguments of a plant."""
    lists = [more.pop(role, ()) for role in _ROLES]
    for role, names in zip(_ROLES, lists, strict=True):
        if isinstance(names, str) or not all(isinstance(name, str) for name in names):
            raise SpecError(f"{role} is {names!r}: give a list of names.", path=role)
        repeated = [name for name in names if list(names).count(name) > 1]
        if repeated:
            raise SpecError(f"{role} repeats {repeated[0]!r}.", path=role)
    return lists


def _places(names: Sequence[str], known: Sequence[str], what: str) -> list[int]:
    return [index_of(name, known, what=what) for name in names]


def _refuse_both(more: Mapping[str, Any], role: str, names: Sequence[str]) -> None:
    twice = [name for name in names if more.get(name) is not None]
    if twice:
        raise SpecError(f"{role} and {twice[0]} are both given: use one of them.", path=twice[0])
