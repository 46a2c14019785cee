"""The fields of a DAE observer: model, noise covariances, initial values and options, checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal, Self, TypeAlias

import numpy as np

from obsynth.errors import SpecError, counted
from obsynth.numerics.arguments import Count, ForgettingFactor, Positive, Probability, require_kind, require_shape
from obsynth.numerics.arrays import FloatArray, as_matrix, read_only
from obsynth.numerics.ranks import covariance_factor, is_definite
from obsynth.numerics.suggestions import fields_suggested
from obsynth.observers.outliers import Outliers
from obsynth.observers.running import StepObserver
from obsynth.plants.dae import DAEModel
from obsynth.plants.dae_signals import finite_vector, step_length

Form: TypeAlias = Literal["forgetting", "random-walk", "augmented-kalman"]

Guard: TypeAlias = Literal["regularise", "none"]

Weight: TypeAlias = Literal["innovation", "paper"]

Integration: TypeAlias = Literal["backward-euler", "radau"]

_DEFINITE = ("R", "initial_parameter_covariance")


@fields_suggested
@dataclass(frozen=True, eq=False)
class DAESettings(StepObserver):
    """The fields of `obsynth.DAEObserver`, which adds the steps."""

    model: DAEModel
    dt: float
    Q: FloatArray
    R: FloatArray
    initial_state: FloatArray
    initial_covariance: FloatArray
    initial_parameters: FloatArray
    initial_parameter_covariance: FloatArray
    random_walk: FloatArray
    lower: FloatArray
    upper: FloatArray
    form: Form = "forgetting"
    forgetting: ForgettingFactor = 0.98
    guard: Guard = "regularise"
    weight: Weight = "innovation"
    integration: Integration = "backward-euler"
    largest_move: Positive | None = None
    window: Count = 50
    outliers: Outliers = "none"
    outlier_limit: float | None = None
    outlier_sizes: FloatArray | None = None
    sensors: Mapping[str, Mapping[str, int]] | None = None
    state_bounds: FloatArray | None = None
    reset: Probability = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "dt", step_length(self.dt))
        self._check_options()
        self._check_arrays()

    def _check_arrays(self) -> None:
        nx, ny, nq = self.model.nx, self.model.ny, self.model.nq
        sizes = {"Q": nx, "R": ny, "initial_covariance": nx, "initial_parameter_covariance": nq, "random_walk": nq}
        for name, size in sizes.items():
            matrix = as_matrix(getattr(self, name), name) if size else np.zeros((0, 0))
            require_shape(matrix.shape, (size, size), name)
            factor = covariance_factor(matrix, name)
            if name in _DEFINITE:
                self._require_definite(name, matrix, factor)
            object.__setattr__(self, name, read_only(matrix))
        model = self.model
        for name, signals in (("initial_state", model.state_names), ("initial_parameters", model.parameter_names)):
            object.__setattr__(self, name, read_only(finite_vector(getattr(self, name), signals, np.zeros(0), name)))
        for name in ("lower", "upper"):
            vector = np.asarray(getattr(self, name), dtype=np.float64)
            if vector.shape != (nq,) or np.isnan(vector).any():
                raise SpecError(f"bounds: {name} must be {counted(nq, 'number')}.", path="bounds")
            object.__setattr__(self, name, read_only(vector))
        for name, low, start, high in zip(
            model.parameter_names, self.lower, self.initial_parameters, self.upper, strict=True
        ):
            if not (low < high and low <= start <= high):
                raise SpecError(
                    f"bounds.{name}: the lower bound ({low:g}) must be below the upper one ({high:g}), and the start "
                    f"({start:g}) between.",
                    path=f"bounds.{name}",
                )

    def _require_definite(self, name: str, matrix: FloatArray, factor: FloatArray) -> None:
        signals = self.model.output_names if name == "R" else self.model.parameter_names
        variances = np.diag(matrix)
        for signal, variance in zip(signals, variances, strict=True):
            if not variance > 0.0:
                raise SpecError(
                    f"{name} must be positive definite, but the variance of {signal!r} is {variance:g}.", path=name
                )
        if not is_definite(matrix, factor):
            raise SpecError(f"{name} must be positive definite, but it is singular.", path=name)

    @property
    def plant(self) -> DAEModel:
        """The model, under the name that all observers have."""
        return self.model

    @property
    def fault_names(self) -> tuple[str, ...]:
        """The estimated parameters, in order."""
        return self.model.parameter_names

    @property
    def innovation_count(self) -> int:
        """Length of an innovation: the number of outputs."""
        return self.model.ny

    @property
    def outside_graph(self) -> str:
        """The name of an option in use that the compiled steps do not contain; empty where there is none."""
        if self.outliers != "none":
            return "outliers"
        return "reset" if self.reset else "" if self.state_bounds is None else "state_bounds"

    def as_dict(self) -> dict[str, Any]:
        """Return every field as data."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {**values, "model": self.model.as_dict()}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Return the observer that `as_dict` described."""
        require_kind(data, Mapping, "data", "what as_dict() returns")
        return cls(**{**data, "model": DAEModel(**data["model"])})
