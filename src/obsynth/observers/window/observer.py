"""Observers as weighted sums of the last samples, with weights that depend on the number of the row."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.numerics.arguments import real_array, real_vector, whole_number
from obsynth.numerics.arrays import FloatArray, as_matrix, freeze, read_only
from obsynth.observers.estimates import Estimates
from obsynth.observers.records import NAME_FIELDS, measured_record, require_horizon, require_names, whole_record
from obsynth.observers.running import Observer


class WindowState(NamedTuple):
    """The last samples before a row, and its number."""

    k: int
    recent: FloatArray  # ``(samples - 1, nu + ny)``, the newest last; NaN where there was none


@dataclass(frozen=True, eq=False)
class WindowObserver(Observer[WindowState, float]):
    """A weighted sum of the last samples: which weights, says the number k of the row.

    Parameters
    ----------
    weights : FloatArray
        ``(programmes, samples (nu + ny))``: of known inputs and outputs, the newest sample first.
    programmes : FloatArray
        ``(rows,)``: numbers of the weights at k = samples, samples + 1, ...; negative where there is no sum.
    samples : int
        Samples of the window.
    horizon : int or None
        Last k; without one the last entry of ``programmes`` holds for ever.
    dt : float
        Seconds between samples.
    input_names, output_names : tuple of str
        The signals of ``u`` and ``y``, in order.
    fault_names, residual_names : tuple of str
        What the sum is: the estimate of a fault, or a residual.
    fault_delays : tuple of int
        Samples by which the estimate lags.
    constants : FloatArray
        ``(programmes,)``: added to the sums.

    Raises
    ------
    SpecError
        Shapes do not fit together.

    Examples
    --------
    >>> mean = WindowObserver(
    ...     weights=[[0.5, 0.5]], programmes=[0], samples=2, horizon=None, dt=1.0, input_names=(), output_names=("y",),
    ...     fault_names=(), residual_names=("mean",), fault_delays=(), constants=[0.0],
    ... )
    >>> mean.run([[1.0], [3.0], [5.0]]).residuals.ravel()
    array([nan, nan,  4.])
    """

    weights: FloatArray
    programmes: FloatArray
    samples: int
    horizon: int | None
    dt: float
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    fault_names: tuple[str, ...]
    residual_names: tuple[str, ...]
    fault_delays: tuple[int, ...]
    constants: FloatArray
    state_names = ()
    state_delays = ()

    def __post_init__(self) -> None:
        for field in NAME_FIELDS:
            require_names(getattr(self, field), field)
        whole_number(self.samples, "samples")
        weights = as_matrix(self.weights, "weights")
        width = self.samples * (len(self.input_names) + len(self.output_names))
        programmes = np.asarray(self.programmes, dtype=np.float64).ravel()
        rows = 1 if self.horizon is None else self.horizon - self.samples + 1
        are_numbers = programmes == np.round(programmes)
        if weights.shape[1] != width or len(programmes) != rows or not are_numbers.all():
            raise SpecError(
                f"The observer has weights {weights.shape} and {len(programmes)} rows, but {width} weights of each sum "
                f"and {rows} rows are needed.",
                path="weights",
            )
        constants = np.asarray(self.constants, dtype=np.float64).ravel()
        if len(constants) != len(weights) or not np.isfinite(constants).all():
            raise SpecError(f"The observer needs {len(weights)} finite constants.", path="constants")
        if np.any(programmes >= len(weights)) or len(self.fault_names) + len(self.residual_names) != 1:
            raise SpecError("The observer names weights that it does not have, or not one signal.", path="programmes")
        if len(self.fault_delays) != len(self.fault_names):
            raise SpecError("The observer needs one delay for its fault.", path="delays")
        freeze(self, weights=weights, programmes=programmes, constants=constants)

    @property
    def order(self) -> int:
        """Number of known signals that it keeps."""
        return (self.samples - 1) * (len(self.input_names) + len(self.output_names))

    @property
    def row_names(self) -> tuple[str, ...]:
        """The name of its column: ``fhat[...]`` or ``r[...]``."""
        return (*(f"fhat[{name}]" for name in self.fault_names), *(f"r[{name}]" for name in self.residual_names))

    def as_dict(self) -> dict[str, Any]:
        """Return every field, as the constructor takes it."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def programme_at(self, k: int) -> int:
        """Return the number of the weights at a row; -1 where there is no sum.

        Parameters
        ----------
        k : int
            Number of the row.
        """
        place = k - self.samples
        return -1 if place < 0 else int(self.programmes[min(place, len(self.programmes) - 1)])

    def init(self) -> WindowState:
        """Return the state before the first sample, k = 0."""
        width = len(self.input_names) + len(self.output_names)
        return WindowState(0, np.full((self.samples - 1, width), np.nan))

    def skip(self, state: WindowState, count: int) -> WindowState:
        """Return the state after samples that are missing.

        Parameters
        ----------
        state : WindowState
            Before them.
        count : int
            How many they are.
        """
        recent = np.array(state.recent)
        lost = min(count, len(recent))
        if lost:
            recent = np.vstack([recent[lost:], np.full((lost, recent.shape[1]), np.nan)])
        return WindowState(state.k + count, recent)

    def advance(self, state: WindowState, y: FloatArray, u: FloatArray) -> tuple[WindowState, float]:
        """Return the state after a sample and the sum at it, NaN where its window is not complete or there is no sum.

        Parameters
        ----------
        state : WindowState
            Before the sample.
        y, u : FloatArray
            ``(ny,)`` and ``(nu,)``, NaN where missing.
        """
        require_horizon(self.horizon, state.k + 1, early=False)
        window = np.vstack([state.recent, np.concatenate([u, y])])
        programme = self.programme_at(state.k)
        value = (
            float(self.weights[programme] @ window[::-1].ravel() + self.constants[programme])
            if programme >= 0
            else np.nan
        )
        return WindowState(state.k + 1, window[1:]), value

    def step(self, state: WindowState, y: ArrayLike, u: ArrayLike = ()) -> tuple[WindowState, Estimates]:
        """Check a sample; return the state after it, and what is known at it.

        Parameters
        ----------
        state : WindowState
            From `init`, or from the sample before.
        y, u : array_like
            Outputs ``(ny,)``, NaN where missing, and known inputs ``(nu,)``.

        Raises
        ------
        SpecError
            A sample has the wrong length, or the plant's horizon is passed.
        """
        outputs = measured_record(np.atleast_2d(real_array(y, "y")), len(self.output_names))[0]
        after, value = self.advance(state, outputs, real_vector(u, len(self.input_names), "u"))
        return after, self._estimates(np.array([value]))

    def run(self, y: ArrayLike, u: ArrayLike | None = None) -> Estimates:
        """Run over a whole record.

        Parameters
        ----------
        y : array_like
            Outputs ``(samples, ny)``, the first at k = 0; NaN marks a missing sample.
        u : array_like, optional
            Known inputs ``(samples, nu)``; may be left out when there are none.

        Returns
        -------
        Estimates
            One row per sample; NaN where there is no sum.

        Raises
        ------
        SpecError
            Shapes do not fit, or the record is longer than the plant's horizon.
        """
        outputs, inputs = whole_record(y, u, len(self.output_names), len(self.input_names))
        require_horizon(self.horizon, len(outputs), early=False)
        state, values = self.init(), np.empty(len(outputs))
        for k, (y_k, u_k) in enumerate(zip(outputs, inputs, strict=True)):
            state, values[k] = self.advance(state, y_k, u_k)
        return self._estimates(values)

    def _estimates(self, values: FloatArray) -> Estimates:
        column, nothing = read_only(values[:, None]), read_only(np.zeros((len(values), 0)))
        faults, residuals = (column, nothing) if self.fault_names else (nothing, column)
        return Estimates(nothing, faults, residuals, (), self.fault_names, self.residual_names, (), self.fault_delays)
