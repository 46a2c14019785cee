"""Recursive observers from the options of a method, for design and for verification."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arguments import is_number, real_number, real_vector, shown
from obsynth.numerics.arrays import FloatArray, matrix_or_multiple_of_identity
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.recursive.settings import Adaptation
from obsynth.plants.sequences import MatrixSequence
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem


def observer_from_options(plant: TimeVaryingDescriptorSystem, options: Mapping[str, Any]) -> RecursiveObserver:
    """Return the observer that options stand for."""
    adaptation = None
    if "form" in options:
        nq = plant.nq
        adaptation = Adaptation(
            form=options["form"],
            forgetting=options["forgetting"],
            guard=options["guard"],
            initial_parameters=_vector(options["initial_parameters"], nq, "initial_parameters"),
            initial_covariance=_square(
                options["initial_parameter_covariance"], nq, 1.0, "initial_parameter_covariance"
            ),
            walk=_square(options["random_walk"], nq, 0.0, "random_walk"),
            window=options["window"],
            reset=options["reset"],
        )
    return RecursiveObserver(
        plant=plant,
        Q=_sequence(options["Q"], plant.ne, "Q", plant),
        R=_sequence(options["R"], plant.ny, "R", plant),
        initial_state=_vector(options["initial_state"], plant.nx, "initial_state"),
        initial_covariance=_square(options["initial_covariance"], plant.nx, 1.0, "initial_covariance"),
        adaptation=adaptation,
        early_constraints=options["early_constraints"],
        outliers=options.get("outliers") or "none",
        outlier_limit=options.get("outlier_limit"),
        outlier_sizes=options.get("outlier_sizes"),
        sensors=options.get("sensors"),
        state_bounds=options.get("state_bounds"),
    )


def plain_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return options as they are kept with a design: arrays and sequences as data, callables as they are."""
    plain: dict[str, Any] = {}
    for name, stated in options.items():
        value = stated.item() if isinstance(stated, np.generic) else stated
        if isinstance(value, MatrixSequence):
            plain[name] = value.as_data() if value.is_data else value.function
        elif value is None or callable(value) or isinstance(value, (bool, int, float, str, Mapping)) or has_text(value):
            plain[name] = value
        else:
            plain[name] = np.array(value, dtype=np.float64)
    return plain


def has_text(value: Any) -> bool:
    """Whether an option is written with texts, which may depend on k."""
    return isinstance(value, (list, tuple)) and any(isinstance(item, str) or has_text(item) for item in value)


def _sequence(value: Any, size: int, name: str, plant: TimeVaryingDescriptorSystem) -> MatrixSequence:
    if value is None:
        return MatrixSequence.of(np.eye(size), name)
    if is_number(value):
        value = real_number(value, name, "a variance, or a covariance matrix") * np.eye(size)
    if isinstance(value, str) and size != 1:
        raise SpecError(
            f"{name} is the text {shown(value)}: give a number, or the rows of a {size} by {size} matrix; its entries "
            "may be texts.",
            path=name,
        )
    sequence = MatrixSequence.of(value, name, constants=plant.constants)
    if sequence.length is not None and (plant.horizon is None or sequence.length < plant.horizon):
        raise SpecError(
            f"{name} is a stack for {sequence.length} steps: it must reach as far as the plant's horizon "
            f"({plant.horizon or 'without end'}).",
            path=name,
        )
    return sequence


def _vector(value: Any, size: int, name: str) -> FloatArray:
    return np.zeros(size) if value is None else real_vector(value, size, name)


def _square(value: Any, size: int, default: float, name: str) -> FloatArray:
    return default * np.eye(size) if value is None else matrix_or_multiple_of_identity(value, size, name)
