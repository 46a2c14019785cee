r"""Scheduled observers: linear observers whose matrices are weighted means of vertices, by measured parameters.

.. math::
    z^+ = A_z(\mu_k) z + B_u(\mu_k) u + B_y(\mu_k) y, \qquad
    [\hat x; \varphi; r] = C_z z + D_u u + D_y y, \qquad \hat f = \Delta(\mu_{k-1})^{-1} \varphi

with the weights :math:`\mu_k` of the sample itself.  Only the effectiveness :math:`\Delta` of the faults and a
correction :math:`K(\mu_{k-1}) r` of z have the weights of the sample before.  In continuous time (``dt = 0``) each
sample takes a step of implicit Euler over the h seconds since the last one,

.. math::
    z_k = (I - h A_z(\mu_k))^{-1} (z_{k-1} + h B_u(\mu_k) u_k + h B_y(\mu_k) y_k),

If errors decay like :math:`e^{-a t}` in the norm of a matrix P for all parameter trajectories, then this step shrinks
them by :math:`(1 + 2 a h)^{-1/2}` in that norm, for any h.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from obsynth.errors import SpecError
from obsynth.numerics.arguments import is_finite_number, is_whole, require_kind, shown
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.observers.estimate_rows import EstimateRows
from obsynth.observers.estimates import Estimates
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.records import NAME_FIELDS, checked_sample, require_delays, require_names, whole_record
from obsynth.observers.running import Observer
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.plants.scheduling import RATE_TOLERANCE, Scheduling

#: Matrices with a value at each vertex, and matrices that are the same at all vertices.
SCHEDULED = ("Az", "Bu", "By")
FIXED = ("Cz", "Du", "Dy")
#: Claims hold again when an error has decayed to this share.
FORGOTTEN_SHARE = 0.01


class ScheduledState(NamedTuple):
    """The state of a scheduled observer."""

    z: FloatArray  # ``(nz,)``, before the next sample
    weights: FloatArray  # ``(N,)``, at the last sample
    parameters: FloatArray  # ``(p,)``, at the last sample, within their ranges; NaN before the first sample
    unclaimed: float  # rows, or in continuous time seconds, until claims hold again


@dataclass(frozen=True, eq=False)
class ScheduledObserver(EstimateRows, Observer[ScheduledState, FloatArray]):
    """An observer whose matrices change with measured parameters; ``u`` holds them after the known inputs.

    A missing parameter keeps its last value, and one outside its range is replaced by the nearest end.  Claims do not
    hold from then on until the error has decayed.

    Parameters
    ----------
    Az, Bu, By : FloatArray
        Matrices of z at each vertex: ``(N, nz, nz)``, ``(N, nz, nu)``, ``(N, nz, ny)``.
    Cz, Du, Dy : FloatArray
        Rows of states, faults and residuals: ``(nx + nf + nr, nz)``, ``(nx + nf + nr, nu)``, ``(nx + nf + nr, ny)``.
    effectiveness : FloatArray
        Matrices at each vertex ``(N, nf, nf)``: their mean, with the weights of the sample before, divides the rows of
        faults.
    scheduling : Scheduling
        The parameters, their ranges, and how weights follow from them.
    forgetting : int or float
        How long claims do not hold after a parameter was missing or outside its range, in rows, or in seconds for
        continuous time.
    dt : float
        Seconds between samples; 0 in continuous time.
    input_names : tuple of str
        Known inputs, then the columns of the scheduling parameters.
    output_names, state_names, fault_names, residual_names : tuple of str
        The signals of ``y`` and of the rows, in order.
    state_delays, fault_delays : tuple of int
        Delay of each estimate in samples.
    correction : FloatArray, optional
        Gains ``(N, nz, nr)`` from the residuals of a sample to a correction of z, with the weights of the sample
        before; in discrete time only.

    Raises
    ------
    SpecError
        Shapes do not fit together.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.PolytopicSystem(
    ...     plant={
    ...         "A": [["0.7 + 0.2 * v", 0.1], [0, 0.5]], "C": [[1, 0], [0, 1]], "Bf": [[1], [0]], "Bd": [[0], [1]],
    ...         "dt": 1.0,
    ...     },
    ...     scheduling={"v": [-1.0, 1.0]},
    ... )
    >>> observer = obsynth.design(plant).observer
    >>> observer.input_names, observer.fault_names
    (('v',), ('f1',))
    >>> estimates = observer.run(y=[[0.0, 0.0], [0.1, 0.0]], u=[[0.5], [0.6]])
    >>> estimates.faults.shape
    (2, 1)
    """

    Az: FloatArray
    Bu: FloatArray
    By: FloatArray
    Cz: FloatArray
    Du: FloatArray
    Dy: FloatArray
    effectiveness: FloatArray
    scheduling: Scheduling
    forgetting: float
    dt: float
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    state_names: tuple[str, ...]
    fault_names: tuple[str, ...]
    residual_names: tuple[str, ...]
    state_delays: tuple[int, ...]
    fault_delays: tuple[int, ...]
    correction: FloatArray | None = None

    @staticmethod
    def names_of(plant: PolytopicSystem) -> dict[str, Any]:
        """Return the fields that an observer of all states takes from its plant: sample time, scheduling and names.

        Parameters
        ----------
        plant : PolytopicSystem
            The plant that the observer is for.
        """
        return {
            "scheduling": plant.scheduling,
            "dt": plant.dt,
            "input_names": (*plant.input_names, *plant.scheduling.read_names),
            "output_names": plant.output_names,
            "state_names": plant.state_names,
        }

    def __post_init__(self) -> None:
        require_kind(self.scheduling, Scheduling, "scheduling", "a Scheduling")
        for name in NAME_FIELDS:
            require_names(getattr(self, name), name)
        count, ny = self.scheduling.count, len(self.output_names)
        nu = len(self.input_names) - len(self.scheduling.names)
        nf = len(self.fault_names)
        rows = len(self.state_names) + nf + len(self.residual_names)
        nz = np.shape(self.Az)[-1] if np.ndim(self.Az) == 3 else -1
        shapes = {
            "Az": (count, nz, nz),
            "Bu": (count, nz, nu),
            "By": (count, nz, ny),
            "Cz": (rows, nz),
            "Du": (rows, nu),
            "Dy": (rows, ny),
            "effectiveness": (count, nf, nf),
        }
        if self.correction is not None:
            shapes["correction"] = (count, nz, len(self.residual_names))
            if self.dt == 0.0:
                raise SpecError("A correction is for discrete time: leave it out.", path="correction")
        for name, shape in shapes.items():
            matrix = np.asarray(getattr(self, name), dtype=np.float64)
            if matrix.shape != shape or not np.isfinite(matrix).all():
                raise SpecError(f"{name} of the observer is {matrix.shape}, finite {shape} is needed.", path=name)
            object.__setattr__(self, name, read_only(matrix))
        if not (is_finite_number(self.dt) and self.dt >= 0.0):
            raise SpecError(
                f"dt of a scheduled observer is {shown(self.dt)}: give positive seconds, or 0 for continuous time.",
                path="dt",
            )
        counted = is_whole(self.forgetting) if self.dt > 0.0 else is_finite_number(self.forgetting)
        if not counted or self.forgetting < 0:
            raise SpecError("forgetting must be a whole number of rows (or seconds), 0 or more.", path="forgetting")
        if self.dt == 0.0 and not self.effectiveness_is_one:
            raise SpecError("effectiveness is for discrete time: leave it one.", path="effectiveness")
        require_delays(self.state_names, self.state_delays)
        require_delays(self.fault_names, self.fault_delays)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Return the observer that its `as_dict` described.

        Parameters
        ----------
        data : mapping
            Every field by name; lists stand for tuples.
        """
        require_kind(data, Mapping, "data", "what as_dict() returns")
        return super().from_dict({**data, "scheduling": Scheduling.from_dict(data["scheduling"])})

    @property
    def order(self) -> int:
        """Number of observer states ``nz``."""
        return int(self.Az.shape[1])

    @property
    def count(self) -> int:
        """Number of vertices."""
        return len(self.Az)

    @property
    def inputs(self) -> int:
        """Number of known inputs, without the scheduling parameters."""
        return len(self.input_names) - len(self.scheduling.names)

    @cached_property
    def effectiveness_is_one(self) -> bool:
        """Whether the effectiveness is the identity at all vertices, so that the rows of faults stay as they are."""
        return not self.fault_names or not bool((self.effectiveness != np.eye(len(self.fault_names))).any())

    def at_vertex(self, place: int) -> LinearObserver:
        """Return the linear observer at a vertex.

        Parameters
        ----------
        place : int
            Number of the vertex, from 0.
        """
        Cz, Du, Dy = (np.array(getattr(self, name)) for name in FIXED)
        if not self.effectiveness_is_one:
            for matrix in (Cz, Du, Dy):
                matrix[self.fault_rows] = np.linalg.solve(self.effectiveness[place], matrix[self.fault_rows])
        return self._linear(place, Cz, Du, Dy)

    def before_division(self, place: int) -> LinearObserver:
        """Return the linear observer at a vertex without the division of the fault rows by the effectiveness.

        Parameters
        ----------
        place : int
            Number of the vertex, from 0.
        """
        return self._linear(place, self.Cz, self.Du, self.Dy)

    def _linear(self, place: int, Cz: FloatArray, Du: FloatArray, Dy: FloatArray) -> LinearObserver:
        return LinearObserver(
            Az=self.Az[place],
            Bu=self.Bu[place],
            By=self.By[place],
            Cz=Cz,
            Du=Du,
            Dy=Dy,
            dt=self.dt,
            input_names=self.input_names[: self.inputs],
            output_names=self.output_names,
            state_names=self.state_names,
            fault_names=self.fault_names,
            residual_names=self.residual_names,
            state_delays=self.state_delays,
            fault_delays=self.fault_delays,
        )

    def as_dict(self) -> dict[str, Any]:
        """Return every field, as the constructor takes it."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        if self.correction is None:
            del values["correction"]
        return {**values, "scheduling": self.scheduling.as_dict()}

    def init(self) -> ScheduledState:
        """Return the state before the first sample."""
        unknown = np.full(len(self.scheduling.names), np.nan)
        return ScheduledState(np.zeros(self.order), self.scheduling.weights(self.middle), unknown, 0)

    @cached_property
    def middle(self) -> FloatArray:
        """The middle of the region, which replaces parameters before their first value."""
        return 0.5 * (self.scheduling.low + self.scheduling.high)

    @cached_property
    def steps(self) -> FloatArray:
        """Largest change of each parameter within a sample; infinite where no rate is stated."""
        return self.steps_in(self.dt)

    def steps_in(self, seconds: float) -> FloatArray:
        """Return the largest change of each parameter ``(p,)`` in a time; infinite where no rate is stated.

        Parameters
        ----------
        seconds : float
            The time, positive.
        """
        rates = [np.inf if rate is None else rate for rate in self.scheduling.rates]
        return np.array(rates) * seconds * (1.0 + RATE_TOLERANCE)

    def advance(
        self, state: ScheduledState, y: FloatArray, u: FloatArray, seconds: float = 0.0
    ) -> tuple[ScheduledState, FloatArray]:
        """Return the next state and the row ``[xhat, fhat, r]``, without checking the sample.

        Parameters
        ----------
        state : ScheduledState
            Before the sample.
        y, u : FloatArray
            ``(ny,)`` and ``(nu + p,)``: known inputs, then parameters, NaN for a missing one.
        seconds : float, optional
            In continuous time the time since the last sample; 0 for the first.
        """
        if self.dt == 0.0:
            return self._advance_continuous(state, y, u, seconds)
        inputs, measured = u[: self.inputs], u[self.inputs :]
        parameters = self._parameters(state, measured)
        weights = self.scheduling.weights(parameters)
        row, z = self.Cz @ state.z + self.Du @ inputs + self.Dy @ y, state.z
        if self.correction is not None:
            change = np.tensordot(state.weights, self.correction, 1) @ row[self.residual_rows]
            row[self.state_rows] += self.Cz[self.state_rows] @ change
            z = z + change
        if not self.effectiveness_is_one:
            effect = np.tensordot(state.weights, self.effectiveness, 1)
            row[self.fault_rows] = np.linalg.solve(effect, row[self.fault_rows])
        after = np.zeros(self.order)
        for weight, Az, Bu, By in zip(weights, self.Az, self.Bu, self.By, strict=True):
            if weight:
                after += weight * (Az @ z + Bu @ inputs + By @ y)
        # Before the first sample `state.parameters` are NaN, so that no comparison is true.
        slow = not bool((np.abs(measured - state.parameters) > self.steps).any())
        inside = slow and self.scheduling.is_inside(measured)
        unclaimed = max(state.unclaimed - 1, 0) if inside else self.forgetting
        return ScheduledState(after, weights, parameters, unclaimed), row

    def _parameters(self, state: ScheduledState, measured: FloatArray) -> FloatArray:
        """Return the parameters of a sample: the last value for a missing one, the nearest end outside the range."""
        before = np.where(np.isnan(state.parameters), self.middle, state.parameters)
        return np.where(np.isnan(measured), before, self.scheduling.nearest(measured))

    def _advance_continuous(
        self, state: ScheduledState, y: FloatArray, u: FloatArray, seconds: float
    ) -> tuple[ScheduledState, FloatArray]:
        """Return the state after a step of implicit Euler in continuous time, and the row at its end."""
        inputs, measured = u[: self.inputs], u[self.inputs :]
        parameters = self._parameters(state, measured)
        weights = self.scheduling.weights(parameters)
        Az, Bu, By = (np.tensordot(weights, matrix, 1) for matrix in (self.Az, self.Bu, self.By))
        driven = state.z + seconds * (Bu @ inputs + By @ y)
        z = np.asarray(np.linalg.solve(np.eye(self.order) - seconds * Az, driven)) if seconds > 0.0 else state.z
        row = self.Cz @ z + self.Du @ inputs + self.Dy @ y
        far = self.steps_in(seconds if seconds > 0.0 else np.inf)
        slow = not bool((np.abs(measured - state.parameters) > far).any())
        inside = slow and self.scheduling.is_inside(measured)
        unclaimed = max(state.unclaimed - self.forgotten_in(seconds), 0.0) if inside else self.forgetting
        return ScheduledState(z, weights, parameters, unclaimed), row

    def rows_without_claim(self, seconds: float) -> int:
        """Return the number of rows without a claim after a parameter was missing or outside its range.

        Parameters
        ----------
        seconds : float
            Time between rows, for a continuous observer.
        """
        if self.dt > 0.0 or not self.forgetting:
            return int(self.forgetting)
        return int(np.ceil(self.forgetting / self.forgotten_in(seconds)))

    def forgotten_in(self, seconds: float) -> float:
        """Return the part of `forgetting` that one row takes off.

        That is 1 in discrete time.  In continuous time it is the time in which the exact observer shrinks an error as
        much as one step of implicit Euler does.

        Parameters
        ----------
        seconds : float
            Time since the last row.
        """
        if self.dt > 0.0:
            return 1.0
        if self.forgetting == 0.0:
            return 0.0
        rate = -np.log(FORGOTTEN_SHARE) / self.forgetting
        return float(0.5 * np.log1p(2.0 * rate * seconds) / rate)

    def step(
        self, state: ScheduledState, y: ArrayLike, u: ArrayLike = (), *, seconds: float | None = None
    ) -> tuple[ScheduledState, Estimates]:
        """Return the state after a sample, and the estimates at it.

        Parameters
        ----------
        state : ScheduledState
            Before the sample; it is not changed.
        y : array_like
            Outputs ``(ny,)``.
        u : array_like
            Known inputs, then scheduling parameters, ``(nu + p,)``; NaN marks a missing parameter.
        seconds : float, optional
            In continuous time the time since the last sample; 0 for the first.

        Raises
        ------
        SpecError
            A sample has the wrong length, or a value other than a parameter is not finite; ``seconds`` is missing in
            continuous time, or given in discrete time.
        """
        elapsed = self._elapsed(seconds, "seconds")
        require_kind(state, ScheduledState, "state", "what init() or the step before returned")
        outputs = checked_sample(y, len(self.output_names), "y")
        signals = np.asarray(u, dtype=np.float64).ravel()
        if signals.shape != (len(self.input_names),):
            raise SpecError(f"u needs {len(self.input_names)} numbers: {', '.join(self.input_names)}.", path="u")
        checked_sample(signals[: self.inputs], self.inputs, "u")
        after, row = self.advance(state, outputs, signals, elapsed)
        return after, self.split(row[None, :])

    def _elapsed(self, seconds: float | None, name: str) -> float:
        """Return the seconds between samples of a continuous observer, checked; 0 for the others."""
        if self.dt > 0.0:
            if seconds is not None:
                raise SpecError(f"{name} is for continuous time: this observer has dt {self.dt:g} s.", path=name)
            return 0.0
        if seconds is None:
            raise SpecError(f"The observer is continuous in time: give {name}, between its samples.", path=name)
        if not (is_finite_number(seconds) and seconds >= 0.0):
            raise SpecError(f"{name} is {shown(seconds)}: give a finite number, 0 or more.", path=name)
        return float(seconds)

    def run(self, y: ArrayLike, u: ArrayLike, *, sample_time: float | None = None) -> Estimates:
        """Run over a whole record.

        Parameters
        ----------
        y : array_like
            Outputs ``(samples, ny)``.
        u : array_like
            Known inputs, then scheduling parameters, ``(samples, nu + p)``.
        sample_time : float, optional
            Seconds between samples of a continuous observer.

        Raises
        ------
        SpecError
            Shapes do not fit, or a number is not finite; in continuous time ``sample_time`` is missing.
        """
        rows, _ = self.record(y, u, sample_time=sample_time)
        return self.split(rows)

    def record(
        self, y: ArrayLike, u: ArrayLike, *, sample_time: float | None = None
    ) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Return the rows of a record ``(samples, nx + nf + nr)``, and for each of them whether claims hold.

        Parameters
        ----------
        y, u : array_like
            As for `run`; NaN marks a missing parameter.
        sample_time : float, optional
            As for `run`.
        """
        elapsed = self._elapsed(sample_time, "sample_time")
        signals = np.asarray(u, dtype=np.float64)
        filled = np.where(np.isnan(signals), 0.0, signals) if signals.ndim == 2 else signals
        if signals.ndim == 2 and signals.shape[1] == len(self.input_names):
            filled[:, : self.inputs] = signals[:, : self.inputs]
        outputs, _ = whole_record(y, filled, len(self.output_names), len(self.input_names))
        state = self.init()
        rows, claimed = np.empty((len(outputs), len(self.Cz))), np.empty(len(outputs), dtype=bool)
        for k, (y_k, u_k) in enumerate(zip(outputs, signals, strict=True)):
            state, rows[k] = self.advance(state, y_k, u_k, elapsed if k else 0.0)
            claimed[k] = not state.unclaimed
        return rows, claimed
