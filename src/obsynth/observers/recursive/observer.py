"""The recursive observer of a time-varying plant: a descriptor Kalman filter, with or without parameters."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.numerics.arguments import checked_value, real_array
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.estimates import Estimates
from obsynth.observers.outliers import projected
from obsynth.observers.records import measured_record, require_horizon, whole_record
from obsynth.observers.recursive.compiled_run import kernel_is_chosen, run_compiled
from obsynth.observers.recursive.estimates import recursive_estimates
from obsynth.observers.recursive.recursion import Recursion
from obsynth.observers.recursive.sample import RawEstimate, RecursiveState
from obsynth.observers.recursive.settings import RecursiveSettings
from obsynth.observers.taken_inputs import require_inputs


class RecursiveObserver(RecursiveSettings):
    """A recursive observer: everything that `start` and `run` need, and nothing that depends on data.

    Parameters
    ----------
    plant : TimeVaryingDescriptorSystem
        The model it runs on.
    Q, R : MatrixSequence
        Covariances of mu(k) ``(ne, ne)`` and nu(k) ``(ny, ny)``; may be singular.
    initial_state : FloatArray
        ``(nx,)``: the mean of x(0).
    initial_covariance : FloatArray
        ``P_0 (nx, nx)``.
    adaptation : Adaptation or None
        ``None`` for a Kalman filter.
    early_constraints : bool
        Whether equations without x(k+1) are used one step earlier, with u(k+1).
    outliers : {"none", "gate", "huber"}
        What is done with a sample that its prediction excludes: taken as it is; left out, at most twice in a row
        of one sensor; or taken at the limit.
    outlier_limit : float or None
        In standard deviations of the prediction: 6 for ``gate`` and 3 for ``huber`` by default.
    outlier_sizes : FloatArray or None
        ``(ny,)``, in units of the sensors: a sample that is nearer than this to its prediction is no outlier.
    sensors : mapping or None
        ``{name: {"every": rows, "delay": rows}}`` of the sensors that are sampled every so many rows, at k = 0, every,
        2 every, ..., or whose values are delayed by so many rows.
    state_bounds : FloatArray or None
        ``(nx, 2)``: lower and upper bounds of the states, infinite where there are none.

    Raises
    ------
    SpecError
        A shape does not fit the plant.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.TimeVaryingDescriptorSystem(
    ...     E=None, A=[[0.9]], C=[[1.0]], Phi=[[1.0]], dt=1.0, horizon=50, parameter_names=["leak"]
    ... )
    >>> design = obsynth.adaptive_observer(plant, Q=1e-4, R=1e-2, forgetting=0.95)
    >>> state, estimates = design.observer.step(design.observer.init(), [0.1])
    >>> estimates.fault_names
    ('leak',)
    """

    def __repr__(self) -> str:
        return f"<RecursiveObserver of {self.plant!r}>"

    @cached_property
    def recursion(self) -> Recursion:
        """What follows from the observer alone, made when it is first needed."""
        return Recursion(self)

    @cached_property
    def without_walk(self) -> RecursiveObserver:
        """The observer whose state filter is that of the model without a walk of the parameters."""
        if self.adaptation is None or self.form != "random-walk":
            return self
        return replace(self, adaptation=replace(self.adaptation, form="innovation", forgetting=1.0))

    @property
    def _steps(self) -> Recursion:
        return self.recursion

    def _allow(self, state: RecursiveState) -> None:
        require_horizon(self.plant.horizon, state.k + 1, early=self.early_constraints)

    def _sample(self, state: RecursiveState, y: ArrayLike, u: ArrayLike) -> tuple[FloatArray, FloatArray]:
        outputs = measured_record(np.atleast_2d(real_array(y, "y")), self.plant.ny)[0]
        inputs = np.atleast_1d(real_array(u, "u"))
        require_inputs(inputs, self.plant.input_names, state.k)
        return outputs, inputs

    def _estimates(self, state: RecursiveState, row: RawEstimate) -> Estimates:
        return recursive_estimates(self, [row], window=state.regressors)

    def run(self, y: ArrayLike, u: ArrayLike | None = None, *, compiled: bool | None = None) -> Estimates:
        """Run over a whole record.

        Parameters
        ----------
        y : array_like
            Outputs ``(samples, ny)``, the first at k = 0; NaN marks a missing sample.  y(0) is not used: the model
            begins with y(1).
        u : array_like, optional
            Known inputs ``(samples, nu)``; may be left out when there are none.
        compiled : bool, optional
            Whether a kernel compiled by numba (`obsynth[fast]`) runs the same square-root recursion: always, never, or,
            by default, for long records of small observers.  `compiled_run` says what it covers.

        Returns
        -------
        Estimates
            One row per sample.

        Raises
        ------
        SpecError
            Shapes do not fit, an input is not finite, or the record is longer than the plant's horizon; the kernel is
            asked for, but numba is missing or parameters are estimated by least squares.
        PreconditionError
            Rank H_k is lost at some k (named) although no sample is missing.
        """
        checked_value(compiled, "compiled", bool | None)
        outputs, inputs = whole_record(y, u, self.plant.ny, self.plant.nu)
        require_horizon(self.plant.horizon, len(outputs), early=self.early_constraints)
        if compiled and not self.is_plain:
            raise SpecError(
                "compiled=True: the kernel has neither sensors with their own times nor state_bounds: leave it out.",
                path="compiled",
            )
        if self.is_plain and kernel_is_chosen(self, len(outputs), compiled):
            return run_compiled(self.recursion, outputs, inputs)
        rows, state = [], self.init()
        for y_k, u_k in zip(outputs, inputs, strict=True):
            state, row = self.advance(state, y_k, u_k)
            rows.append(row)
        return recursive_estimates(self, rows)

    def within_bounds(self, row: RawEstimate) -> RawEstimate:
        """Return a row with its states within their bounds; the recursion goes on without them.

        Parameters
        ----------
        row : RawEstimate
            What is known at a sample.
        """
        return row if self.state_bounds is None else row._replace(x=projected(row.x, row.factor, self.state_bounds))
