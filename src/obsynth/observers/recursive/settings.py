"""The fields of a recursive observer: plant, noise, initial values, and how parameters are estimated; checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal, Self, TypeAlias

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arguments import (
    Count,
    ForgettingFactor,
    Probability,
    check_fields,
    real_array,
    real_vector,
    require_kind,
    require_shape,
    truth,
)
from obsynth.numerics.arrays import FloatArray, as_matrix, read_only
from obsynth.numerics.ranks import covariance_factor, rounding_rank
from obsynth.numerics.suggestions import fields_suggested
from obsynth.observers.outliers import Outliers
from obsynth.observers.running import StepObserver
from obsynth.plants.sequences import MatrixSequence
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem

Form: TypeAlias = Literal["innovation", "literal", "random-walk"]

Guard: TypeAlias = Literal["regularise", "directional", "none"]


@fields_suggested
@dataclass(frozen=True, eq=False)
class Adaptation:
    """How parameters are estimated.

    Parameters
    ----------
    form : {"innovation", "literal", "random-walk"}
        Least squares on the whitened parity innovation; (18) as printed; or the parameters as states.
    forgetting : float
        lambda in (0, 1], dimensionless; not used by the random walk.
    guard : {"regularise", "directional", "none"}
        What keeps S bounded where excitation is missing.
    initial_parameters : FloatArray
        ``(nq,)``.
    initial_covariance : FloatArray
        ``S_0 (nq, nq)``, positive definite: also the covariance of the initial parameters.
    walk : FloatArray
        ``(nq, nq)``: covariance of one step of the random walk.
    window : int
        Samples over which excitation is watched.
    reset : float
        Detect and reset: probability, per sample, that innovations which no change has made larger pass the threshold
        above which S and the covariance start again from S_0.  Zero never resets.

    Raises
    ------
    SpecError
        Something is out of range or has the wrong shape.
    """

    form: Form
    forgetting: ForgettingFactor
    guard: Guard
    initial_parameters: FloatArray
    initial_covariance: FloatArray
    walk: FloatArray
    window: Count
    reset: Probability = 0.0

    def __post_init__(self) -> None:
        check_fields(self, Adaptation)
        if self.reset and self.form == "random-walk":
            raise SpecError("reset is for the forms with a forgetting factor.", path="reset")
        start = np.atleast_1d(real_array(self.initial_parameters, "initial_parameters"))
        q = len(start)
        object.__setattr__(self, "initial_parameters", read_only(start))
        for name, option in (("initial_covariance", "initial_parameter_covariance"), ("walk", "random_walk")):
            matrix = as_matrix(getattr(self, name), option)
            require_shape(matrix.shape, (q, q), option)
            object.__setattr__(self, name, matrix)
            factor = covariance_factor(matrix, option)
            if name == "initial_covariance" and (np.diag(matrix) <= 0.0).any() | (rounding_rank(factor) < q):
                raise SpecError(f"{option} (S_0) must be positive definite.", path=option)


@fields_suggested
@dataclass(frozen=True, eq=False)
class RecursiveSettings(StepObserver):
    """The fields of `obsynth.RecursiveObserver`, which is these with its recursion."""

    plant: TimeVaryingDescriptorSystem
    Q: MatrixSequence
    R: MatrixSequence
    initial_state: FloatArray
    initial_covariance: FloatArray
    adaptation: Adaptation | None
    early_constraints: bool = False
    outliers: Outliers = "none"
    outlier_limit: float | None = None
    outlier_sizes: FloatArray | None = None
    sensors: Mapping[str, Mapping[str, int]] | None = None
    state_bounds: FloatArray | None = None

    def __post_init__(self) -> None:
        self._check_options()
        plant = self.plant
        for name, size in (("Q", plant.ne), ("R", plant.ny)):
            shape = getattr(self, name).shape
            require_shape(shape, (size, size), name)
        state = real_vector(self.initial_state, plant.nx, "initial_state")
        object.__setattr__(self, "early_constraints", truth(self.early_constraints, "early_constraints"))
        covariance = as_matrix(self.initial_covariance, "initial_covariance")
        require_shape(covariance.shape, (plant.nx, plant.nx), "initial_covariance")
        covariance_factor(covariance, "initial_covariance")
        object.__setattr__(self, "initial_state", read_only(state))
        object.__setattr__(self, "initial_covariance", covariance)
        if self.adaptation is not None and len(self.adaptation.initial_parameters) != plant.nq:
            raise SpecError(f"initial_parameters must be {plant.nq} numbers.", path="initial_parameters")

    @property
    def dt(self) -> float:
        """Seconds between samples."""
        return self.plant.dt

    @property
    def fault_names(self) -> tuple[str, ...]:
        """The parameters that are estimated, in order."""
        return () if self.adaptation is None else self.plant.parameter_names

    @property
    def form(self) -> str:
        """How parameters are estimated; empty for a filter without any."""
        return "" if self.adaptation is None else self.adaptation.form

    @property
    def initial_parameters(self) -> FloatArray:
        """Mean of the parameters at the start ``(nq,)``; empty for a filter without any."""
        return np.zeros(0) if self.adaptation is None else self.adaptation.initial_parameters

    @property
    def innovation_count(self) -> int:
        """Numbers in an innovation: what equations and outputs say beyond the state."""
        return self.plant.ne + self.plant.ny - self.plant.nx

    def as_dict(self) -> dict[str, Any]:
        """Return every field as data."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        if self.adaptation is not None:
            values["adaptation"] = {field.name: getattr(self.adaptation, field.name) for field in fields(Adaptation)}
        return {
            **values,
            "plant": self.plant.as_dict(),
            "Q": self.Q.as_data(),
            "R": self.R.as_data(),
            "noise_constants": {**(self.Q.constants or {}), **(self.R.constants or {})},
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Return the observer that `as_dict` described.

        Parameters
        ----------
        data : mapping
            Every field by name.
        """
        require_kind(data, Mapping, "data", "what as_dict() returns")
        values = dict(data)
        constants, adaptation = values.pop("noise_constants"), values["adaptation"]
        noise = {name: MatrixSequence.of(values[name], name, constants=constants) for name in ("Q", "R")}
        return cls(
            **{
                **values,
                **noise,
                "plant": TimeVaryingDescriptorSystem(**values["plant"]),
                "adaptation": None if adaptation is None else Adaptation(**adaptation),
            }
        )
