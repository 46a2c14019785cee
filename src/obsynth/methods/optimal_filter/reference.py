"""Reference models of fault estimates as matrices: the desired response to each fault."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from obsynth.analysis.existence.condition import OPTIONS_PATH
from obsynth.errors import SpecError
from obsynth.methods.optimal_filter.stated_models import model_of
from obsynth.numerics.arguments import is_finite_number, is_whole
from obsynth.numerics.arrays import FloatArray
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
    model = model_of(reference, plant, "reference model", PATH, also="{'bandwidth': 10}")
    inputs = model[3].shape[1]
    if model[3].shape == (1, 1):
        each = np.eye(plant.nf)
        a, b, c, d = (np.asarray(np.kron(each, part), dtype=np.float64) for part in model)
        return a, b, c, d
    if inputs != plant.nf:
        raise SpecError(f"The reference model has {inputs} inputs; the plant has {plant.nf} faults.", path=PATH)
    return model


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
