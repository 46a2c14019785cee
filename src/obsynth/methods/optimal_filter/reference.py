"""Reference models, from the faults to their wanted estimate, as matrices."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from obsynth.analysis.existence.condition import OPTIONS_PATH
from obsynth.errors import SpecError
from obsynth.numerics.arguments import is_finite_number, is_whole
from obsynth.numerics.arrays import FloatArray, as_matrix
from obsynth.numerics.decoupling_windows import Model
from obsynth.plants.descriptor import DescriptorSystem

#: Where a message points.
PATH = f"{OPTIONS_PATH}.reference"


def reference_model(reference: Any, plant: DescriptorSystem) -> Model:
    """Return ``(A, B, C, D)`` of a reference model with ``nf`` inputs; raise `SpecError` for what is none."""
    if isinstance(reference, Mapping) and "bandwidth" in reference:
        order, width = reference.get("order", 1), reference["bandwidth"]
        fits = set(reference) <= {"bandwidth", "order"} and is_whole(order) and order >= 1 and is_finite_number(width)
        if not fits or not width > 0:
            raise SpecError("A lag is {'bandwidth': rad/s, 'order': 1}, both positive.", path=PATH)
        return lag_model(float(width), int(order), plant.nf, plant.dt)
    model = model_of(reference, plant, "reference model", PATH)
    inputs = model[3].shape[1]
    if inputs != plant.nf:
        raise SpecError(f"The reference model has {inputs} inputs; the plant has {plant.nf} faults.", path=PATH)
    return model


def model_of(model: Any, plant: DescriptorSystem, what: str, path: str) -> Model:
    """Return ``(A, B, C, D)`` of a stable model in the time of a plant; raise `SpecError`, which says what it is."""
    a, b, c, d = _matrices(model, plant, what, path)
    modes = np.linalg.eigvals(a) if len(a) else np.zeros(0)
    if np.any(np.abs(modes) >= 1.0) if plant.is_discrete else np.any(modes.real >= 0.0):
        raise SpecError(f"The {what} is not stable: no stable filter follows it.", path=path)
    return a, b, c, d


def lag_model(bandwidth: float, order: int, faults: int, dt: float) -> Model:
    """Return a chain of lags of unit gain for each fault: ``(w / (s + w))^order``, sampled where ``dt`` is not zero."""
    pole, gain = (-bandwidth, bandwidth) if dt == 0.0 else (np.exp(-bandwidth * dt), 1.0 - np.exp(-bandwidth * dt))
    a = pole * np.eye(order) + gain * np.eye(order, k=-1)
    b, c = gain * np.eye(order, 1), np.eye(1, order, k=order - 1)
    repeat = np.eye(faults)
    a, b, c = (np.asarray(np.kron(repeat, part), dtype=np.float64) for part in (a, b, c))
    return a, b, c, np.zeros((faults, faults))


def plain(model: Model) -> dict[str, Any]:
    """Return a model as an option: lists by name."""
    return {name: part.tolist() for name, part in zip("ABCD", model, strict=True)}


def _matrices(model: Any, plant: DescriptorSystem, what: str, path: str) -> Model:
    if isinstance(model, Mapping):
        if set(model) - set("ABCD") or "D" not in model:
            lag = "is {'bandwidth': 10}, or " if path == PATH else ""
            raise SpecError(f"A {what} {lag}has matrices A, B, C and D.", path=path)
        parts = [model.get(name, ()) for name in "ABCD"]
    elif isinstance(model, Sequence) and not isinstance(model, str) and len(model) == 4:
        parts = [*model]
    elif hasattr(model, "dt"):
        return _of_control(model, plant, what, path)
    else:
        lag = "{'bandwidth': 10}" if path == PATH else "a number"
        raise SpecError(f"A {what} is {lag}, matrices (A, B, C, D), or a system of python-control.", path=path)
    return _shaped(parts, what, path)


def _shaped(parts: Sequence[Any], what: str, path: str) -> Model:
    """Return matrices that fit each other."""
    d = as_matrix(parts[3], f"{path.rpartition('.')[2]}.D")
    rows, inputs = d.shape
    n = len(np.atleast_2d(parts[0])) if np.size(parts[0]) else 0
    wanted = ((n, n), (n, inputs), (rows, n))
    matrices: list[FloatArray] = []
    for name, part, shape in zip("ABC", parts, wanted, strict=False):
        matrix = as_matrix(part, f"{path.rpartition('.')[2]}.{name}") if n else np.zeros(shape)
        if matrix.shape != shape:
            raise SpecError(f"{name} of the {what} has shape {matrix.shape}: {shape} fits A and D.", path=path)
        matrices.append(matrix)
    return matrices[0], matrices[1], matrices[2], d


def _of_control(model: Any, plant: DescriptorSystem, what: str, path: str) -> Model:
    """Return the matrices of a system of python-control; raise `SpecError` for an improper or wrongly timed one."""
    import control

    try:
        system = control.ss(model)
    except (ValueError, TypeError, AttributeError, ImportError) as error:
        raise SpecError(f"The {what} has no proper state space: {error}.", path=path) from None
    if bool(system.dt) != plant.is_discrete or (plant.is_discrete and system.dt not in (True, plant.dt)):
        raise SpecError(f"The {what} has dt = {system.dt}, the plant {plant.dt:g}: give both the same.", path=path)
    return _shaped([system.A, system.B, system.C, system.D], what, path)


def delayed(delays: Sequence[int]) -> Model:
    """Return the model of signals that are late by so many samples each."""
    chains = [(np.eye(late, k=-1), np.eye(late, 1), np.eye(1, late, k=late - 1)) for late in delays]
    a, b, c = (np.asarray(block_diag(*(chain[i] for chain in chains)), dtype=np.float64) for i in range(3))
    return a, b, c, np.diag([float(late == 0) for late in delays])


def stored_reference(matrices: Mapping[str, FloatArray]) -> Model | None:
    """Return the reference model that the matrices of a certificate hold; ``None`` where they hold none."""
    names = [f"reference_{name}" for name in "ABCD"]
    if any(name not in matrices for name in names):
        return None
    a, b, c, d = (matrices[name] for name in names)
    return a, b, c, d


def constant_gain(model: Model, dt: float) -> FloatArray:
    """Return what a model makes of constant signals in the end."""
    a, b, c, d = model
    return np.asarray(d + c @ np.linalg.solve(np.eye(len(a)) * (dt > 0.0) - a, b))
