"""The linear observer that a design ships: one realisation, `run` over a record, `step` sample by sample."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SpecError, counted
from obsynth.numerics.arguments import is_finite_number, real_array, require_kind, require_shape, shown
from obsynth.numerics.arrays import FloatArray, as_matrix, read_only, restore
from obsynth.numerics.suggestions import fields_suggested
from obsynth.observers.estimate_rows import EstimateRows
from obsynth.observers.estimates import Estimates
from obsynth.observers.records import NAME_FIELDS, checked_sample, require_delays, require_names, whole_record
from obsynth.observers.running import Observer, RunningObserver


class LinearState(NamedTuple):
    """The state of a linear observer."""

    z: FloatArray  # ``(nz,)``, before the next sample


@fields_suggested
@dataclass(frozen=True, eq=False)
class LinearObserver(EstimateRows, Observer[LinearState, FloatArray]):
    r"""A realisation from known inputs and outputs to estimates.

    .. math::
        z^+ = A_z z + B_u u + B_y y, \qquad
        [\hat x; \hat f; r] = C_z z + D_u u + D_y y

    Parameters
    ----------
    Az, Bu, By : array_like
        ``(nz, nz)``, ``(nz, nu)``, ``(nz, ny)``.
    Cz, Du, Dy : array_like
        ``(nx + nf + nr, nz)``, ``(nx + nf + nr, nu)``, ``(nx + nf + nr, ny)``: state estimates first, then
        fault estimates, then residuals.
    dt : float
        Seconds between samples; 0 for continuous time.
    input_names, output_names : tuple of str
        The signals of ``u`` and ``y``, in order.
    state_names, fault_names, residual_names : tuple of str
        The signals that are estimated, in order.
    state_delays, fault_delays : tuple of int
        Samples by which each estimate lags: at time k it is the estimate of the signal at ``k - delay``.
    constant : array_like, optional
        ``(nx + nf + nr,)``: added to the rows; of tests whose bounds lie on different sides of zero.

    Raises
    ------
    SpecError
        Shapes do not fit together, names are no tuple of unique texts, or delays no tuple of whole numbers.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> observer = design.observer
    >>> state, estimates = observer.step(observer.init(), [0.0, 0.0])
    >>> estimates.faults.tolist()
    [[0.0]]
    """

    Az: FloatArray
    Bu: FloatArray
    By: FloatArray
    Cz: FloatArray
    Du: FloatArray
    Dy: FloatArray
    dt: float
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    state_names: tuple[str, ...]
    fault_names: tuple[str, ...]
    residual_names: tuple[str, ...]
    state_delays: tuple[int, ...]
    fault_delays: tuple[int, ...]
    constant: FloatArray | None = None

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        restore(self, state)

    def __repr__(self) -> str:
        time = f"dt={self.dt:g} s" if self.dt > 0.0 else "continuous"
        return (
            f"<LinearObserver of order {self.order}, {time}: from {counted(len(self.input_names), 'input')} and "
            f"{counted(len(self.output_names), 'output')} to {counted(len(self.state_names), 'state')}, "
            f"{counted(len(self.fault_names), 'fault')} and {counted(len(self.residual_names), 'residual')}>"
        )

    def __post_init__(self) -> None:
        for field in NAME_FIELDS:
            require_names(getattr(self, field), field)
        matrices = {name: as_matrix(getattr(self, name), name) for name in ("Az", "Bu", "By", "Cz", "Du", "Dy")}
        nz, nu, ny = matrices["Az"].shape[0], len(self.input_names), len(self.output_names)
        rows = len(self.state_names) + len(self.fault_names) + len(self.residual_names)
        shapes = {"Az": (nz, nz), "Bu": (nz, nu), "By": (nz, ny), "Cz": (rows, nz), "Du": (rows, nu), "Dy": (rows, ny)}
        for name, shape in shapes.items():
            matrix = np.zeros(shape) if 0 in shape and matrices[name].size == 0 else matrices[name]
            require_shape(matrix.shape, shape, name)
            object.__setattr__(self, name, read_only(matrix))
        if self.constant is not None:
            added = as_matrix(np.atleast_2d(real_array(self.constant, "constant")), "constant").ravel()
            require_shape(added.shape, (rows,), "constant")
            object.__setattr__(self, "constant", read_only(added) if added.any() else None)
        if not (is_finite_number(self.dt) and self.dt >= 0.0):
            raise SpecError(
                f"dt of the observer is {shown(self.dt)}: give seconds, or 0 for continuous time.", path="dt"
            )
        require_delays(self.state_names, self.state_delays)
        require_delays(self.fault_names, self.fault_delays)

    @property
    def order(self) -> int:
        """Number of observer states ``nz``."""
        return int(self.Az.shape[0])

    def as_dict(self) -> dict[str, Any]:
        """Return every field, as the constructor takes it."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        if self.constant is None:
            del values["constant"]
        return values

    @cached_property
    def added(self) -> FloatArray:
        """What is added to the rows ``(nx + nf + nr,)``."""
        return np.zeros(len(self.Cz)) if self.constant is None else self.constant

    def init(self, initial_state: ArrayLike | None = None) -> LinearState:
        """Return the state before the first sample.

        Parameters
        ----------
        initial_state : array_like, optional
            ``z(0)``, ``(nz,)``; zero by default.

        Raises
        ------
        SpecError
            The observer is a continuous-time one, or the initial state has the wrong length.
        """
        if self.dt <= 0.0:
            raise SpecError(
                "This observer is continuous in time: it must be discretised before it can step.", path="dt"
            )
        start = np.zeros(self.order) if initial_state is None else initial_state
        return LinearState(checked_sample(start, self.order, "initial_state").copy())

    def start(self, initial_state: ArrayLike | None = None) -> RunningObserver[LinearState, FloatArray]:
        """Return a running observer, which takes one sample at a time.

        Parameters
        ----------
        initial_state : array_like, optional
            ``z(0)``, ``(nz,)``; zero by default.
        """
        return RunningObserver(self, self.init(initial_state))

    def advance(self, state: LinearState, y: FloatArray, u: FloatArray) -> tuple[LinearState, FloatArray]:
        """Return the next state and the row ``[xhat, fhat, r]``, without checking the sample.

        Parameters
        ----------
        state : LinearState
            Before the sample.
        y, u : FloatArray
            ``(ny,)`` and ``(nu,)``, finite.
        """
        row = self.Cz @ state.z + self.Du @ u + self.Dy @ y + self.added
        return LinearState(self.Az @ state.z + self.Bu @ u + self.By @ y), np.asarray(row)

    def step(self, state: LinearState, y: ArrayLike, u: ArrayLike = ()) -> tuple[LinearState, Estimates]:
        """Return the state after a sample, and the estimates at it.

        Parameters
        ----------
        state : LinearState
            Before the sample; it is not changed.
        y : array_like
            Outputs ``(ny,)``.
        u : array_like, optional
            Known inputs ``(nu,)``.

        Raises
        ------
        SpecError
            A sample has the wrong length or is not finite.
        """
        require_kind(state, LinearState, "state", "what init() or the step before returned")
        outputs = checked_sample(y, len(self.output_names), "y")
        inputs = checked_sample(u, len(self.input_names), "u")
        after, row = self.advance(state, outputs, inputs)
        return after, self.split(row[None, :])

    @cached_property
    def _is_delay_line(self) -> bool:
        """Whether its rows are weighted sums of its last samples, kept in one register each."""
        order = self.order
        return order > 1 and not self.Cz[:, 1:].any() and np.array_equal(self.Az, np.eye(order, k=1))

    def _weighted(self, y: FloatArray, u: FloatArray, start: FloatArray) -> FloatArray:
        """Return the rows of a record ``(steps, rows)`` of such an observer, sample by sample of the window."""
        taken = np.zeros(len(y))
        count = min(len(y), self.order)
        taken[:count] = start[:count]
        for age, (on_u, on_y) in enumerate(zip(self.Bu, self.By, strict=True), start=1):
            taken[age:] += u[:-age] @ on_u + y[:-age] @ on_y
        return np.asarray(np.outer(taken, self.Cz[:, 0]) + u @ self.Du.T + y @ self.Dy.T + self.added)

    def run(self, y: ArrayLike, u: ArrayLike | None = None, *, initial_state: ArrayLike | None = None) -> Estimates:
        """Run over a whole record of a discrete-time observer.

        Parameters
        ----------
        y : array_like
            Outputs ``(steps, ny)``.
        u : array_like, optional
            Known inputs ``(steps, nu)``; may be left out when there are none.
        initial_state : array_like, optional
            ``z(0)``, ``(nz,)``; zero by default.

        Returns
        -------
        Estimates
            One row per sample.

        Raises
        ------
        SpecError
            Shapes do not fit, or a sample is not finite.
        """
        outputs, inputs = whole_record(y, u, len(self.output_names), len(self.input_names), complete=True)
        state = self.init(initial_state)
        if self._is_delay_line:
            return self.split(self._weighted(outputs, inputs, state.z))
        rows = np.empty((len(outputs), self.Cz.shape[0]))
        for k in range(len(outputs)):
            state, rows[k] = self.advance(state, outputs[k], inputs[k])
        return self.split(rows)
