"""Linear models that options state: matrices, numerator and denominator, systems of python-control or scipy.signal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arguments import is_finite_number
from obsynth.numerics.arrays import FloatArray, as_matrix
from obsynth.numerics.decoupling_windows import Model
from obsynth.plants.descriptor import DescriptorSystem

#: Coefficients of a transfer function of one input and one output, of the highest power first, as scipy names them.
NUMERATOR, DENOMINATOR = "num", "den"
#: What is done about a transfer function with more zeros than poles.
FEWER_ZEROS = "add fast poles, as (s + 2) / (0.001 s + 1) has for s + 2"
FEWER_ZEROS_SAMPLED = "divide it by z as often, which leaves its size at every frequency"


def is_stated_model(entry: Mapping[str, Any]) -> bool:
    """Whether a mapping is a model by its keys: matrices with D, or a numerator over a denominator."""
    return ("D" in entry and set(entry) <= set("ABCD")) or set(entry) == {NUMERATOR, DENOMINATOR}


def model_of(model: Any, plant: DescriptorSystem, what: str, path: str, *, also: str = "") -> Model:
    """Return ``(A, B, C, D)`` of a stable model in the time of a plant; raise `SpecError`, which says what it is.

    ``also``: what an option takes beside models, for the message.
    """
    a, b, c, d = _matrices(model, plant, what, path, also)
    modes = np.linalg.eigvals(a) if len(a) else np.zeros(0)
    if np.any(np.abs(modes) >= 1.0) if plant.is_discrete else np.any(modes.real >= 0.0):
        raise SpecError(f"The {what} is not stable: no stable filter follows it.", path=path)
    return a, b, c, d


def system_matrices(system: Any) -> Model:
    """Return the matrices of a system of python-control or scipy.signal.

    Raises
    ------
    ValueError, TypeError, AttributeError, ImportError, NotImplementedError
        It is no linear one, or has more zeros than poles.
    """
    if type(system).__module__.startswith("scipy.signal"):
        states = system.to_ss()
    else:
        import control

        states = control.ss(system)
    a, b, c, d = (np.asarray(getattr(states, name), dtype=np.float64) for name in "ABCD")
    return a, b, c, d


def _matrices(model: Any, plant: DescriptorSystem, what: str, path: str, also: str) -> Model:
    if isinstance(model, Mapping):
        if not is_stated_model(model):
            beside = f"is {also}, or " if also else ""
            raise SpecError(
                f"A {what} {beside}has matrices A, B, C and D, or num and den: the coefficients of its transfer "
                "function, of the highest power first.",
                path=path,
            )
        if NUMERATOR in model:
            return _of_coefficients(model, plant, what, path)
        parts = [model.get(name, ()) for name in "ABCD"]
    elif isinstance(model, Sequence) and not isinstance(model, str) and len(model) == len("ABCD"):
        parts = [*model]
    elif hasattr(model, "dt"):
        return _of_system(model, plant, what, path)
    else:
        raise SpecError(
            f"A {what} is {also or 'a number'}, matrices (A, B, C, D), {{'num': [...], 'den': [...]}}, or a system of "
            "python-control or scipy.signal.",
            path=path,
        )
    return _shaped(parts, what, path)


def _of_coefficients(model: Mapping[str, Any], plant: DescriptorSystem, what: str, path: str) -> Model:
    """Return the matrices of a numerator over a denominator, in s or in z as the plant's time is."""
    coefficients = []
    for name in (NUMERATOR, DENOMINATOR):
        values = model[name] if isinstance(model[name], (list, tuple, np.ndarray)) else [model[name]]
        if np.ndim(values) != 1 or not all(map(is_finite_number, values)) or not np.any(values):
            raise SpecError(f"{name} of the {what} is no list of numbers, not all zero.", path=path)
        coefficients.append(np.trim_zeros(np.asarray(values, dtype=np.float64), "f"))
    above, below = coefficients
    if len(above) > len(below):
        remedy = FEWER_ZEROS_SAMPLED if plant.is_discrete else FEWER_ZEROS
        raise SpecError(f"The {what} has more zeros than poles: {remedy}.", path=path)
    return _realised(above, below)


def _realised(above: FloatArray, below: FloatArray) -> Model:
    """Return the controller canonical form of a proper transfer function."""
    n = len(below) - 1
    above, below = np.concatenate([np.zeros(n + 1 - len(above)), above]) / below[0], below / below[0]
    a = np.eye(n, k=-1)
    a[:1] = -below[1:]
    return a, np.eye(n, 1), (above[1:] - above[0] * below[1:])[None, :], above[:1, None]


def _of_system(model: Any, plant: DescriptorSystem, what: str, path: str) -> Model:
    """Return the matrices of a system of another package; raise `SpecError` for an improper or wrongly timed one."""
    try:
        matrices = system_matrices(model)
    except (ValueError, TypeError, AttributeError, ImportError, NotImplementedError) as error:
        raise SpecError(f"The {what} has no proper state space: {str(error).rstrip('.')}.", path=path) from None
    dt = model.dt or 0.0
    if bool(dt) != plant.is_discrete or (plant.is_discrete and dt not in (True, plant.dt)):
        sampled = f" (control.sample_system(..., {plant.dt:g}, 'tustin') samples a continuous one)" if not dt else ""
        raise SpecError(f"The {what} has dt = {dt:g}, the plant {plant.dt:g}: give both the same{sampled}.", path=path)
    return _shaped(matrices, what, path)


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
