"""What an observer of a DAE is made of, all of it checked, and how it lays out what it remembers and says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, Literal, Self, TypeAlias

import numpy as np

from obsynth.errors import SpecError, counted
from obsynth.numerics import lazy_casadi as ca
from obsynth.numerics.arguments import Count, ForgettingFactor, Positive, Probability, require_kind, require_shape
from obsynth.numerics.arrays import FloatArray, as_matrix, read_only
from obsynth.numerics.ranks import covariance_factor, is_definite
from obsynth.numerics.suggestions import fields_suggested
from obsynth.observers.outliers import Outliers
from obsynth.observers.running import StepObserver
from obsynth.plants.dae import DAEModel
from obsynth.plants.dae_functions import BUTCHER
from obsynth.plants.dae_signals import finite_vector, step_length

Form: TypeAlias = Literal["forgetting", "random-walk", "augmented-kalman"]

Guard: TypeAlias = Literal["regularise", "none"]

Weight: TypeAlias = Literal["innovation", "paper"]

Integration: TypeAlias = Literal["backward-euler", "radau"]

_DEFINITE = ("R", "initial_parameter_covariance")

#: Arrays that stay matrices when they have one column.
MATRIX_SETTINGS = frozenset(
    {
        "P",
        "S",
        "spread",
        "cross",
        "Upsilon",
        "K",
        "H",
        "L",
        "information",
        "covariance",
        "F",
        "G",
        "noise",
        "missing",
        "kept",
        "scaled",
        "expected",
    }
)


@fields_suggested
@dataclass(frozen=True, eq=False)
class DAESettings(StepObserver):
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
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {**values, "model": self.model.as_dict()}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Return the observer that `as_dict` described."""
        require_kind(data, Mapping, "data", "what as_dict() returns")
        return cls(**{**data, "model": DAEModel(**data["model"])})


@dataclass(frozen=True)
class Layout:
    """Named arrays in one vector, each by columns, as CasADi has them."""

    shapes: Mapping[str, tuple[int, int]]  # in order

    @cached_property
    def slices(self) -> dict[str, slice]:
        """Where each array lies."""
        places, begin = {}, 0
        for name, (rows, columns) in self.shapes.items():
            places[name] = slice(begin, begin + rows * columns)
            begin += rows * columns
        return places

    @cached_property
    def size(self) -> int:
        """Length of the vector."""
        return sum(rows * columns for rows, columns in self.shapes.values())

    def part(self, vectors: FloatArray, name: str) -> FloatArray:
        """Return one array of each of many vectors (``vectors (..., size)``)."""
        return self.shaped(vectors[..., self.slices[name]], name)

    def shaped(self, flat: FloatArray, name: str) -> FloatArray:
        """Return one array of each of many parts of vectors (``flat (..., entries)``)."""
        rows, columns = self.shapes[name]
        if columns == 1 and name not in MATRIX_SETTINGS:
            return flat
        return flat.reshape(*flat.shape[:-1], columns, rows).swapaxes(-1, -2)

    def packed(self, arrays: Mapping[str, FloatArray]) -> FloatArray:
        """Return the vector of named arrays."""
        return np.concatenate([np.ravel(arrays[name], order="F") for name in self.shapes])

    def symbols(self, vector: Any) -> dict[str, Any]:
        """Return the arrays in a vector of CasADi symbols by name."""
        return {
            name: ca.reshape(vector[self.slices[name]], *shape) if shape[0] * shape[1] else ca.MX(*shape)
            for name, shape in self.shapes.items()
        }

    def column(self, arrays: Mapping[str, Any]) -> Any:
        """Return the vector of named CasADi expressions."""
        return ca.vertcat(*(ca.vec(ca.densify(arrays[name])) for name in self.shapes))


def memory_layout(observer: DAESettings) -> Layout:
    """Return the state. ``posterior`` is the state after the measurement, ``x`` the one before it with the parameters
    as they are estimated now; P belongs to ``x``, and ``spread`` is the covariance of the parameters, which S with
    forgetting is not."""
    nx, ny, nq = observer.model.nx, observer.model.ny, observer.model.nq
    learning = {"cross": (nx, nq)} if observer.form == "augmented-kalman" else {"S": (nq, nq)}
    return Layout(
        {
            "posterior": (nx, 1),
            "x": (nx, 1),
            "theta": (nq, 1),
            "P": (nx, nx),
            **learning,
            "spread": (nq, nq),
            "Upsilon": (nx, nq),
            "K": (nx, ny),
            "H": (ny, nx),
            "L": (ny, nq),
        }
    )


def row_layout(observer: DAESettings) -> Layout:
    """Return what is said of one sample besides what is remembered."""
    nx, ny, nq = observer.model.nx, observer.model.ny, observer.model.nq
    n = nx * len(BUTCHER[observer.integration])
    # score less information times the true parameters (which stay as they are): to first order mean zero and covariance
    # ``information``; expected: covariance of the innovation, the identity for what is not seen; noise: derivative by
    # what is added to the equations; missing: covariance by inputs that nobody measured; kept: F (I - K H) with K and H
    # of the sample before; scaled: the equilibrated matrix of (7); trusted: one where the step of the compiled graph
    # was solved
    return Layout(
        {
            "innovation": (ny, 1),
            "expected": (ny, ny),
            "nis": (1, 1),
            "information": (nq, nq),
            "score": (nq, 1),
            "covariance": (nx, nx),
            "F": (nx, nx),
            "G": (nx, nq),
            "noise": (nx, nx),
            "missing": (nx, nx),
            "kept": (nx, nx),
            "scaled": (n, n),
            "residual": (1, 1),
            "trusted": (1, 1),
        }
    )


def initial_memory(observer: DAESettings, x: FloatArray) -> FloatArray:
    """Return what is remembered before the first sample (``x (nx,)``)."""
    layout = memory_layout(observer)
    start = {name: np.zeros(shape) for name, shape in layout.shapes.items()}
    start |= {
        "posterior": x,
        "x": x,
        "theta": observer.initial_parameters,
        "P": observer.initial_covariance,
        "S": observer.initial_parameter_covariance,
        "spread": observer.initial_parameter_covariance,
    }
    return layout.packed(start)
