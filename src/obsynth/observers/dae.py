"""The observer of states and parameters of a nonlinear DAE that a design ships."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.models.dae import DAEModel
from obsynth.models.dae_functions import BUTCHER
from obsynth.models.time_varying_checks import positive_dt
from obsynth.numerics.arrays import FloatArray, as_matrix, read_only
from obsynth.numerics.covariances import covariance_factor
from obsynth.observers.records import checked_record, measured_record

if TYPE_CHECKING:
    from obsynth.observers.dae_estimates import DAEEstimates
    from obsynth.observers.dae_running import RunningDAEObserver

FORMS = ("forgetting", "random-walk", "augmented-kalman")
GUARDS = ("regularise", "none")
WEIGHTS = ("innovation", "paper")
_CHOICES = {"form": FORMS, "guard": GUARDS, "weight": WEIGHTS, "integration": tuple(BUTCHER)}
_DEFINITE = ("R", "initial_parameter_covariance")


@dataclass(frozen=True, eq=False)
class DAEObserver:
    """An observer at rest: what `start` and `run` need, and nothing that depends on data.

    Parameters
    ----------
    model : DAEModel
        The model it runs on.
    dt : float
        Seconds between samples.
    Q : FloatArray
        ``(nx, nx)``: covariance of what is added to the right sides of the equations in each step.
    R : FloatArray
        ``(ny, ny)``: covariance of the sensors, positive definite.
    initial_state, initial_parameters : FloatArray
        ``(nx,)`` and ``(nq,)``.
    initial_covariance, initial_parameter_covariance : FloatArray
        ``P_0 (nx, nx)`` and ``S_0 (nq, nq)``.
    random_walk : FloatArray
        ``(nq, nq)``: covariance of one step of the parameters.
    lower, upper : FloatArray
        ``(nq,)``: bounds of the parameters, infinite where there are none.
    form : {"forgetting", "random-walk", "augmented-kalman"}
        Recursive least squares with a forgetting factor or with parameters that walk; or the extended Kalman filter
        of states and parameters together.
    forgetting : float
        lambda in (0, 1], dimensionless; used by form ``forgetting``.
    guard : {"regularise", "none"}
        Whether S is kept below S_0 where excitation is missing; used by form ``forgetting``.
    weight : {"innovation", "paper"}
        The covariance in (18): of the innovation, or R as printed.
    integration : {"backward-euler", "radau"}
        How F is discretised.
    largest_move : float or None
        In nominal sizes of the states; see `obsynth.models.dae_step.ImplicitStep`.
    window : int
        Samples over which excitation is watched.

    Raises
    ------
    SpecError
        Something is out of range or has the wrong shape.
    """

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

    def __post_init__(self) -> None:
        object.__setattr__(self, "dt", positive_dt(self.dt))
        for name, allowed in _CHOICES.items():
            if getattr(self, name) not in allowed:
                raise SpecError(f"{name} is {getattr(self, name)!r}: use one of {', '.join(allowed)}.", path=name)
        if not 0.0 < self.forgetting <= 1.0:
            raise SpecError(f"forgetting is {self.forgetting}: give lambda in (0, 1], such as 0.98.", path="forgetting")
        if self.window < 1:
            raise SpecError(f"window is {self.window}: give a number of samples, at least 1.", path="window")
        if self.largest_move is not None and not self.largest_move > 0.0:
            raise SpecError(f"largest_move is {self.largest_move}: give a positive number.", path="largest_move")
        self._check_arrays()

    def _check_arrays(self) -> None:
        nx, ny, nq = self.model.nx, self.model.ny, self.model.nq
        sizes = {"Q": nx, "R": ny, "initial_covariance": nx, "initial_parameter_covariance": nq, "random_walk": nq}
        for name, size in sizes.items():
            matrix = as_matrix(getattr(self, name), name) if size else np.zeros((0, 0))
            if matrix.shape != (size, size):
                raise SpecError(f"{name} is {matrix.shape}, but {(size, size)} is needed.", path=name)
            factor = covariance_factor(matrix, name)
            if name in _DEFINITE and ((np.diag(matrix) <= 0.0).any() or np.linalg.matrix_rank(factor) < size):
                raise SpecError(f"{name} must be positive definite.", path=name)
            object.__setattr__(self, name, read_only(matrix))
        for name, size in {"initial_state": nx, "initial_parameters": nq, "lower": nq, "upper": nq}.items():
            vector = np.asarray(getattr(self, name), dtype=np.float64)
            if vector.shape != (size,) or np.isnan(vector).any() or (size == nx and not np.isfinite(vector).all()):
                raise SpecError(f"{name} must be {size} finite number(s).", path=name)
            object.__setattr__(self, name, read_only(vector))
        outside = (self.initial_parameters < self.lower) | (self.initial_parameters > self.upper)
        if outside.any() or not (self.lower < self.upper).all():
            raise SpecError("bounds: each lower bound must be below its upper one, and initial_parameters between.",
                            path="bounds")  # fmt: skip

    @property
    def state_names(self) -> tuple[str, ...]:
        """The states that are estimated, in order."""
        return self.model.state_names

    @property
    def fault_names(self) -> tuple[str, ...]:
        """The parameters that are estimated, in order."""
        return self.model.parameter_names

    @property
    def order(self) -> int:
        """Number of states and parameters that are carried from sample to sample."""
        return self.model.nx + self.model.nq

    def as_dict(self) -> dict[str, Any]:
        """Return every field as data.

        Raises
        ------
        SpecError
            The model is given as Python functions.
        """
        found = {field.name: getattr(self, field.name) for field in fields(self)}
        return {**found, "model": self.model.as_dict()}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> DAEObserver:
        """Return the observer that `as_dict` described.

        Parameters
        ----------
        data : mapping
            Every field by name.
        """
        return cls(**{**data, "model": DAEModel(**data["model"])})

    def start(self) -> RunningDAEObserver:
        """Return an observer in motion, at k = 0."""
        from obsynth.observers.dae_running import RunningDAEObserver

        return RunningDAEObserver(self)

    def run(self, y: ArrayLike, u: ArrayLike | None = None) -> DAEEstimates:
        """Run over a whole record.

        Parameters
        ----------
        y : array_like
            Outputs ``(samples, ny)``, the first at k = 0; NaN marks a missing one.
        u : array_like, optional
            Known inputs ``(samples, nu)``; ``u(k)`` holds during the step that ends at k, and ``u(0)`` puts the
            initial state onto its constraint.  May be left out when there are none.

        Returns
        -------
        DAEEstimates
            One row per sample.

        Raises
        ------
        SpecError
            Shapes do not fit, or an input is not finite (k is named).
        SolverError
            A step has no solution; k, iteration and worst equation are named.
        """
        from obsynth.observers.dae_estimates import DAEEstimates

        outputs = measured_record(y, self.model.ny)
        given = np.zeros((len(outputs), 0)) if u is None and not self.model.nu else np.asarray(u)
        if given.dtype.kind == "f" and given.ndim == 2 and not np.isfinite(given).all():
            k, i = np.argwhere(~np.isfinite(given))[0]
            raise SpecError(
                f"The input {self.model.input_names[i]!r} is {given[k, i]} at k = {k}: inputs must be known. Fill the "
                "gap, or make the signal a state with a sensor.", path="u",
            )  # fmt: skip
        inputs = checked_record(given, self.model.nu, "u")
        if len(inputs) != len(outputs):
            raise SpecError(f"u has {len(inputs)} samples and y has {len(outputs)}: give the same number.", path="u")
        running = self.start()
        return DAEEstimates.of(self, [running.raw_step(outputs[k], inputs[k]) for k in range(len(outputs))])
