"""The observer of states and parameters of a nonlinear DAE that a design ships."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray, as_matrix, read_only
from obsynth.numerics.covariances import covariance_factor, is_definite
from obsynth.numerics.value_types import Count, ForgettingFactor, Positive, checked_value
from obsynth.observers.recursive.records import measured_record
from obsynth.observers.running import RunningObserver
from obsynth.plants.dae.checks import checked_inputs, finite_vector, require_known, step_length
from obsynth.plants.dae.model import DAEModel

if TYPE_CHECKING:
    from obsynth.observers.dae.compiled_library import DAELibrary
    from obsynth.observers.dae.estimates import DAEEstimates, DAERow
    from obsynth.observers.dae.step_graph import ObserverGraph
    from obsynth.observers.dae.steps import DAEState, Steps

Form: TypeAlias = Literal["forgetting", "random-walk", "augmented-kalman"]
Guard: TypeAlias = Literal["regularise", "none"]
Weight: TypeAlias = Literal["innovation", "paper"]
Integration: TypeAlias = Literal["backward-euler", "radau"]
_KINDS = {
    "form": Form, "guard": Guard, "weight": Weight, "integration": Integration, "forgetting": ForgettingFactor,
    "window": Count, "largest_move": Positive | None,
}  # fmt: skip
_DEFINITE = ("R", "initial_parameter_covariance")


@dataclass(frozen=True, eq=False)
class DAEObserver:
    """An observer: what `start` and `run` need, and nothing that depends on data.

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
        In nominal sizes of the states; see `obsynth.plants.dae.step.ImplicitStep`.
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
        object.__setattr__(self, "dt", step_length(self.dt))
        for name, kind in _KINDS.items():
            checked_value(getattr(self, name), name, kind)
        self._check_arrays()

    def __getstate__(self) -> dict[str, Any]:
        """Return what makes it again in another process: its functions and its library are made there anew."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

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
    def state_names(self) -> tuple[str, ...]:
        """The states that are estimated, in order."""
        return self.model.state_names

    @property
    def fault_names(self) -> tuple[str, ...]:
        """The parameters that are estimated, in order."""
        return self.model.parameter_names

    @property
    def order(self) -> int:
        """Number of states and parameters in its state."""
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

    @cached_property
    def steps(self) -> Steps:
        """What follows from the observer alone, made when it is first needed."""
        from obsynth.observers.dae.steps import Steps

        return Steps(self)

    def init(self) -> DAEState:
        """Return the state before the first sample, k = 0."""
        return self.steps.first

    def advance(self, state: DAEState, y: FloatArray, u: FloatArray) -> tuple[DAEState, DAERow]:
        """Return the next state and what is said at a sample, without checking it.

        Parameters
        ----------
        state : DAEState
            Before the sample.
        y, u : FloatArray
            ``(ny,)``, NaN for what is missing, and ``(nu,)``.
        """
        return self.steps.advance(state, y, u)

    def step(self, state: DAEState, y: ArrayLike, u: ArrayLike = ()) -> tuple[DAEState, DAEEstimates]:
        """Return the state after a sample, and the estimates at it.

        Parameters
        ----------
        state : DAEState
            Before the sample; it is not changed.
        y : array_like
            Outputs ``(ny,)``; NaN marks a missing one.
        u : array_like, optional
            Known inputs ``(nu,)`` during the step that ends at this sample.

        Raises
        ------
        SpecError
            A sample has the wrong length, or an input is not finite.
        SolverError
            The step has no solution; k, iteration and worst equation are named.
        """
        from obsynth.observers.dae.estimates import GatheredRows

        outputs = measured_record(np.atleast_2d(np.asarray(y)), self.model.ny)[0]
        try:
            inputs = np.atleast_1d(np.asarray(u, dtype=np.float64))
        except (TypeError, ValueError):
            inputs = np.zeros((0, 0))
        if inputs.shape != (self.model.nu,):
            raise SpecError(f"u must be {self.model.nu} finite number(s) at k = {state.k}.", path="u")
        require_known(self.model, inputs[None], state.k)
        after, row = self.advance(state, outputs, inputs)
        found = GatheredRows(self)
        found.add_regular(row)
        return after, found.estimates(np.array(after.informations))

    def start(self) -> RunningObserver[DAEState, DAERow, DAEEstimates]:
        """Return a running observer, at k = 0."""
        return RunningObserver(self)

    @cached_property
    def graph(self) -> ObserverGraph:
        """The steps of each sample as CasADi functions, built when they are first needed."""
        from obsynth.observers.dae.step_graph import observer_graph

        return observer_graph(self)

    @cached_property
    def library(self) -> DAELibrary:
        """The observer in C, compiled when it is first needed.

        Raises
        ------
        SpecError
            There is no compiler, or it fails.
        """
        from obsynth.observers.dae.compiled_library import DAELibrary

        return DAELibrary(self)

    def run(
        self, y: ArrayLike, u: ArrayLike | None = None, *, compiled: bool | None = None,
        progress: bool | Callable[[int], None] | None = None,
    ) -> DAEEstimates:  # fmt: skip
        """Run over a whole record.

        Parameters
        ----------
        y : array_like
            Outputs ``(samples, ny)``, the first at k = 0; NaN marks a missing one.
        u : array_like, optional
            Known inputs ``(samples, nu)``; ``u(k)`` holds during the step that ends at k, and ``u(0)`` puts the
            initial state onto its constraint.  May be left out when there are none.
        compiled : bool, optional
            ``None`` runs whole stretches inside CasADi, ``False`` each sample by itself, and ``True`` the observer as C
            (a compiler is needed, which takes about a second once for each observer).  The numbers are the same.
        progress : bool or callable, optional
            ``None`` shows a bar on a terminal in runs of more than two seconds, ``True`` everywhere, ``False`` never; a
            function is called with the number of samples that are done.

        Returns
        -------
        DAEEstimates
            One row per sample.

        Raises
        ------
        SpecError
            Shapes do not fit, or an input is not finite (k is named); there is no compiler, but one is needed.
        SolverError
            A step has no solution; k, iteration and worst equation are named.
        """
        from obsynth.observers.dae.records import run_record

        if compiled not in (None, True, False):
            raise SpecError(f"compiled is {compiled!r}: give True, False or None.", path="compiled")
        outputs = measured_record(y, self.model.ny)
        inputs = checked_inputs(self.model, u, len(outputs))
        return run_record(self, outputs, inputs, compiled=compiled, progress=progress)
