"""What an observer of a DAE is made of: model, noise, start, and how parameters are estimated; all of it checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal, Self, TypeAlias

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arguments import Count, ForgettingFactor, Positive, Probability, checked_value
from obsynth.numerics.arrays import FloatArray, as_matrix, read_only
from obsynth.numerics.covariances import covariance_factor, is_definite
from obsynth.observers.outliers import Outliers
from obsynth.observers.running import StepSettings
from obsynth.plants.dae.checks import finite_vector, step_length
from obsynth.plants.dae.model import DAEModel

Form: TypeAlias = Literal["forgetting", "random-walk", "augmented-kalman"]
Guard: TypeAlias = Literal["regularise", "none"]
Weight: TypeAlias = Literal["innovation", "paper"]
Integration: TypeAlias = Literal["backward-euler", "radau"]
_KINDS = {
    "form": Form, "guard": Guard, "weight": Weight, "integration": Integration, "forgetting": ForgettingFactor,
    "window": Count, "largest_move": Positive | None,
    "reset": Probability,
}  # fmt: skip
_DEFINITE = ("R", "initial_parameter_covariance")


@dataclass(frozen=True, eq=False)
class DAESettings(StepSettings):
    """The fields of `obsynth.DAEObserver`, which is these with its steps."""

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
    form: str = "forgetting"
    forgetting: float = 0.98
    guard: str = "regularise"
    weight: str = "innovation"
    integration: str = "backward-euler"
    largest_move: float | None = None
    window: int = 50
    outliers: Outliers = "none"
    outlier_limit: float | None = None
    sensors: Mapping[str, Mapping[str, int]] | None = None
    state_bounds: FloatArray | None = None
    reset: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "dt", step_length(self.dt))
        for name, kind in _KINDS.items():
            checked_value(getattr(self, name), name, kind)
        self._check_options()
        self._check_arrays()

    def _check_arrays(self) -> None:
        nx, ny, nq = self.model.nx, self.model.ny, self.model.nq
        sizes = {"Q": nx, "R": ny, "initial_covariance": nx, "initial_parameter_covariance": nq, "random_walk": nq}
        for name, size in sizes.items():
            matrix = as_matrix(getattr(self, name), name) if size else np.zeros((0, 0))
            if matrix.shape != (size, size):
                raise SpecError(f"{name} is {matrix.shape}, but {(size, size)} is needed.", path=name)
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
                raise SpecError(f"bounds: {name} must be {nq} number(s).", path="bounds")
            object.__setattr__(self, name, read_only(vector))
        for name, low, start, high in zip(
            model.parameter_names, self.lower, self.initial_parameters, self.upper, strict=True
        ):
            if not (low < high and low <= start <= high):
                raise SpecError(
                    f"bounds.{name}: the lower bound ({low:g}) must be below the upper one ({high:g}), and the start "
                    f"({start:g}) between.", path=f"bounds.{name}",
                )  # fmt: skip

    def _require_definite(self, name: str, matrix: FloatArray, factor: FloatArray) -> None:
        signals = self.model.output_names if name == "R" else self.model.parameter_names
        variances = np.diag(matrix)
        for signal, variance in zip(signals, variances, strict=True):
            if not variance > 0.0:
                raise SpecError(f"{name} must be positive definite, but the variance of {signal!r} is {variance:g}.",
                                path=name)  # fmt: skip
        if not is_definite(matrix, factor):
            raise SpecError(f"{name} must be positive definite, but it is singular.", path=name)

    @property
    def plant(self) -> DAEModel:
        """The model, by the name that every observer has for what it runs on."""
        return self.model

    @property
    def fault_names(self) -> tuple[str, ...]:
        """The parameters that are estimated, in order."""
        return self.model.parameter_names

    @property
    def innovation_count(self) -> int:
        """Numbers in an innovation: one for each output."""
        return self.model.ny

    @property
    def outside_graph(self) -> str:
        """An option in use that stands outside of the compiled steps, by name; empty without one."""
        if self.outliers != "none":
            return "outliers"
        return "reset" if self.reset else "" if self.state_bounds is None else "state_bounds"

    def as_dict(self) -> dict[str, Any]:
        """Return every field as data."""
        found = {field.name: getattr(self, field.name) for field in fields(self)}
        return {**found, "model": self.model.as_dict()}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Return the observer that `as_dict` described."""
        return cls(**{**data, "model": DAEModel(**data["model"])})
