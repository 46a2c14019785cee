"""The linear observer that a design ships: one realisation, `run` over a record, `step` sample by sample.

Observers made from a linear one: sampled, or with means of its fault estimates; how long it remembers its start, and
at which frequencies to look at it.

Means of the last fault estimates of an observer: registers behind it, and the observer without them again.

A weighted sum of the last samples, with weights of its own at each row.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.numerics.arguments import (
    ComplexArray,
    FloatArray,
    arguments_checked,
    as_matrix,
    freeze,
    is_finite_number,
    is_whole,
    read_only,
    real_array,
    real_number,
    real_vector,
    remembered,
    require_kind,
    require_shape,
    shown,
    whole_number,
)
from obsynth.numerics.continuous import first_order_hold
from obsynth.numerics.modal_response import Modes
from obsynth.numerics.spectra import abscissa, eigenvalues, speeds
from obsynth.observers.records import (
    NAME_FIELDS,
    checked_sample,
    measured_record,
    require_horizon,
    require_names,
    whole_record,
)
from obsynth.observers.running import Estimates, Observer, RunningObserver


class LinearState(NamedTuple):
    """The state of a linear observer."""

    z: FloatArray  # ``(nz,)``, before the next sample


@dataclass(frozen=True, eq=False)
class LinearObserver(Observer[LinearState, FloatArray]):
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

    def __post_init__(self) -> None:
        for field in NAME_FIELDS:
            require_names(getattr(self, field), field)
        given = {name: as_matrix(getattr(self, name), name) for name in ("Az", "Bu", "By", "Cz", "Du", "Dy")}
        nz, nu, ny = given["Az"].shape[0], len(self.input_names), len(self.output_names)
        rows = len(self.state_names) + len(self.fault_names) + len(self.residual_names)
        shapes = {"Az": (nz, nz), "Bu": (nz, nu), "By": (nz, ny), "Cz": (rows, nz), "Du": (rows, nu), "Dy": (rows, ny)}
        for name, shape in shapes.items():
            matrix = np.zeros(shape) if 0 in shape and given[name].size == 0 else given[name]
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
        for names, delays in ((self.state_names, self.state_delays), (self.fault_names, self.fault_delays)):
            whole = isinstance(delays, tuple) and all(is_whole(delay) and delay >= 0 for delay in delays)
            if not whole or len(names) != len(delays):
                raise SpecError("The observer needs one delay >= 0, in samples, for each signal.", path="delays")

    @property
    def order(self) -> int:
        """Number of observer states ``nz``."""
        return int(self.Az.shape[0])

    @property
    def row_names(self) -> tuple[str, ...]:
        """Names of the rows of ``Cz``: ``xhat[...]``, ``fhat[...]``, ``r[...]``."""
        kinds = (("xhat", self.state_names), ("fhat", self.fault_names), ("r", self.residual_names))
        return tuple(f"{kind}[{name}]" for kind, names in kinds for name in names)

    @property
    def state_rows(self) -> slice:
        """Rows of ``Cz`` that hold the state estimates."""
        return slice(0, len(self.state_names))

    @property
    def fault_rows(self) -> slice:
        """Rows of ``Cz`` that hold the fault estimates."""
        return slice(len(self.state_names), len(self.state_names) + len(self.fault_names))

    @property
    def residual_rows(self) -> slice:
        """Rows of ``Cz`` that hold the residuals."""
        return slice(len(self.state_names) + len(self.fault_names), int(self.Cz.shape[0]))

    def as_dict(self) -> dict[str, Any]:
        """Return every field, as the constructor takes it."""
        known = {field.name: getattr(self, field.name) for field in fields(self)}
        if self.constant is None:
            del known["constant"]
        return known

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
        return after, split_rows(self, row[None, :])

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
            return split_rows(self, self._weighted(outputs, inputs, state.z))
        rows = np.empty((len(outputs), self.Cz.shape[0]))
        for k in range(len(outputs)):
            state, rows[k] = self.advance(state, outputs[k], inputs[k])
        return split_rows(self, rows)


def split_rows(observer: LinearObserver, rows: FloatArray) -> Estimates:
    """Return the estimates in the output rows ``(..., samples, nx + nf + nr)`` of an observer."""
    return Estimates(
        read_only(rows[..., observer.state_rows]),
        read_only(rows[..., observer.fault_rows]),
        read_only(rows[..., observer.residual_rows]),
        observer.state_names,
        observer.fault_names,
        observer.residual_names,
        observer.state_delays,
        observer.fault_delays,
    )


#: From so many states on eigenvectors are worth to be found with the eigenvalues: more than one check wants them.
STATES_FOR_ALL_MODES = 200


@remembered
def modes_of(observer: LinearObserver) -> Modes:
    """Return the modes of a shipped ``Az``."""
    found = Modes.of(observer.Az)
    for part in found:
        part.setflags(write=False)
    return found


@remembered
def poles_of(observer: LinearObserver) -> ComplexArray:
    """Return the eigenvalues of a shipped ``Az``."""
    if observer.order >= STATES_FOR_ALL_MODES:
        return modes_of(observer).values
    return read_only(eigenvalues(observer.Az), np.complex128)


def is_stable(observer: LinearObserver) -> bool:
    """Whether computed poles lie strictly inside the region of stability."""
    if not np.all(np.isfinite(observer.Az)):
        return False
    poles = poles_of(observer)
    return bool(np.all(np.abs(poles) < 1.0) if observer.dt > 0.0 else np.all(poles.real < 0.0))


@arguments_checked
def sample_observer(observer: LinearObserver, dt: float) -> LinearObserver:
    r"""Sample a continuous-time observer by a first-order hold.

    Exact for known inputs and outputs that are linear between samples: with v = [u; y],

    .. math::
        z_{k+1} = \Phi z_k + \Gamma_0 v_k + \Gamma_1 (v_{k+1} - v_k), \qquad \xi_k = z_k - \Gamma_1 v_k

    and the state that is kept is :math:`\xi`, so that no sample is needed in advance.

    Parameters
    ----------
    observer : LinearObserver
        Continuous time (``dt == 0``).
    dt : float
        Seconds between samples, positive.

    Returns
    -------
    LinearObserver
        Of the same order and with the same signals; a start at rest means ``z(0) = Gamma_1 v(0)``.

    Raises
    ------
    SpecError
        The observer is discrete in time already, or ``dt`` is not positive and finite.
    """
    if observer.dt > 0.0:
        raise SpecError(f"The observer is discrete in time already (dt = {observer.dt:g} s).", path="dt")
    real_number(dt, "dt", "the seconds between two samples, a positive number", above=0.0)
    inputs = len(observer.input_names)
    b, d = np.hstack([observer.Bu, observer.By]), np.hstack([observer.Du, observer.Dy])
    transition, constant, ramp = first_order_hold(observer.Az, b, dt)
    into, through = transition @ ramp + constant - ramp, d + observer.Cz @ ramp
    return replace(
        observer,
        Az=transition,
        Bu=into[:, :inputs],
        By=into[:, inputs:],
        Du=through[:, :inputs],
        Dy=through[:, inputs:],
        dt=dt,
    )


def averaged(observer: LinearObserver, mean: int) -> LinearObserver:
    """Return the observer whose fault estimates are means of its last ``mean`` ones."""
    rows, order, count = observer.fault_rows, observer.order, len(observer.fault_names)
    kept = (mean - 1) * count
    az, cz = np.zeros((order + kept,) * 2), np.zeros((len(observer.Cz), order + kept))
    az[:order, :order], cz[:, :order] = observer.Az, observer.Cz
    first = slice(order, order + count)
    az[first, :order] = observer.Cz[rows]
    for j in range(1, mean - 1):
        place = slice(order + j * count, order + (j + 1) * count)
        az[place, order + (j - 1) * count : order + j * count] = np.eye(count)
    cz[rows] = cz[rows] / mean
    for j in range(mean - 1):
        cz[rows, order + j * count : order + (j + 1) * count] = np.eye(count) / mean
    below = np.zeros((kept - count, 1))

    def widened(matrix: np.ndarray, direct: np.ndarray) -> np.ndarray:
        return np.vstack([matrix, direct[rows], np.repeat(below, matrix.shape[1], axis=1)])

    du, dy = observer.Du.copy(), observer.Dy.copy()
    du[rows], dy[rows] = du[rows] / mean, dy[rows] / mean
    return replace(
        observer,
        Az=az,
        Bu=widened(observer.Bu, observer.Du),
        By=widened(observer.By, observer.Dy),
        Cz=cz,
        Du=du,
        Dy=dy,
        fault_delays=tuple(delay + (mean - 1) // 2 for delay in observer.fault_delays),
    )


def unaveraged(observer: LinearObserver, mean: int) -> LinearObserver | None:
    """Return the observer that `averaged` was given; ``None`` where this is not exactly what it makes of one."""
    rows, count = observer.fault_rows, len(observer.fault_names)
    order = observer.order - (mean - 1) * count
    if order < 0 or not all(np.all(np.isfinite(part)) for part in (observer.Az, observer.Cz, observer.Du, observer.Dy)):
        return None
    first = slice(order, order + count)
    cz, du, dy = observer.Cz[:, :order].copy(), observer.Du.copy(), observer.Dy.copy()
    cz[rows], du[rows], dy[rows] = observer.Az[first, :order], observer.Bu[first], observer.By[first]
    earlier = tuple(delay - (mean - 1) // 2 for delay in observer.fault_delays)
    if min(earlier, default=0) < 0:
        return None
    base = replace(
        observer,
        Az=observer.Az[:order, :order],
        Bu=observer.Bu[:order],
        By=observer.By[:order],
        Cz=cz,
        Du=du,
        Dy=dy,
        fault_delays=earlier,
    )
    again = averaged(base, mean)
    same = all(np.array_equal(getattr(again, n), getattr(observer, n)) for n in ("Az", "Bu", "By", "Cz", "Du", "Dy"))
    return base if same else None


#: The initial-condition response has settled when its slowest mode has decayed to this share.
SETTLED_TO = 0.02


def transient(observer: LinearObserver) -> float:
    """Return the settling time of an observer in seconds: after it the slowest mode has decayed to `SETTLED_TO`."""
    if observer.order == 0:
        return 0.0
    slowest = abscissa(observer.Az, observer.dt)
    if observer.dt == 0.0:
        return math.log(SETTLED_TO) / slowest if slowest < 0.0 else math.inf
    if slowest >= 1.0:
        return math.inf
    samples = math.ceil(math.log(SETTLED_TO) / math.log(slowest)) if slowest > 0.0 else 0
    return observer.dt * (
        max(samples, _steps_remembered(observer.Az)) + max((*observer.state_delays, *observer.fault_delays), default=0)
    )


def _steps_remembered(Az: FloatArray) -> int:
    """Return the number of states; where these are registers that pass samples on, the longest chain of them."""
    if np.tril(Az).any():
        return len(Az)
    passes, reached, steps = Az != 0.0, np.ones(len(Az), dtype=bool), 0
    while reached.any():
        reached, steps = np.asarray(passes @ reached), steps + 1
    return steps


#: Squarings after which powers of a stable matrix are below rounding, whatever its modes.
MOST_SQUARINGS = 64


def noise_variances(observer: LinearObserver, noise: FloatArray) -> FloatArray:
    """Return stationary variances of the rows ``(rows,)`` of a sampled observer whose outputs have white noise
    ``noise (ny, any)`` of unit covariance; zero where there is none, or where they have no limit."""
    into, through = observer.By @ noise, observer.Dy @ noise
    covariance, power = into @ into.T, observer.Az
    with np.errstate(all="ignore"):
        for _ in range(MOST_SQUARINGS):
            more = power @ covariance @ power.T
            if not np.abs(more).max(initial=0.0) > np.finfo(float).eps * np.abs(covariance).max(initial=0.0):
                break
            covariance, power = covariance + more, power @ power
        found = np.einsum("ij,jk,ik->i", observer.Cz, covariance, observer.Cz) + (through**2).sum(axis=1)
    return np.where(np.isfinite(found), found, 0.0)


def checked_warm_up(asked: float | None, default: float) -> float:
    """Return the warm-up in seconds."""
    return default if asked is None else real_number(asked, "warm_up", "seconds, 0 or more", least=0.0)


#: Frequencies of the grid, and how far it reaches beyond the slowest and the fastest pole of the observer.
RESPONSE_POINTS = 61
GRID_REACH = 30.0


def frequency_grid(observer: LinearObserver) -> FloatArray:
    """Return frequencies in rad/s around the poles of an observer, zero included; up to pi/dt in discrete time."""
    found = speeds(poles_of(observer), observer.dt) if observer.order else np.ones(1)
    alive = found[np.isfinite(found) & (found > 0.0)]
    low = float(np.min(alive, initial=1.0 if not alive.size else np.inf)) / GRID_REACH
    high = float(np.max(alive, initial=1.0 if not alive.size else 0.0)) * GRID_REACH
    if observer.dt > 0.0:
        high = np.pi / observer.dt
        low = min(low, high / GRID_REACH)
    return np.concatenate([[0.0], np.geomspace(low, high, RESPONSE_POINTS)])


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
        known = programmes == np.round(programmes)
        if weights.shape[1] != width or len(programmes) != rows or not known.all():
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
        which = self.programme_at(state.k)
        value = float(self.weights[which] @ window[::-1].ravel() + self.constants[which]) if which >= 0 else np.nan
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
        state, found = self.init(), np.empty(len(outputs))
        for k, (y_k, u_k) in enumerate(zip(outputs, inputs, strict=True)):
            state, found[k] = self.advance(state, y_k, u_k)
        return self._estimates(found)

    def _estimates(self, values: FloatArray) -> Estimates:
        column, nothing = read_only(values[:, None]), read_only(np.zeros((len(values), 0)))
        faults, residuals = (column, nothing) if self.fault_names else (nothing, column)
        return Estimates(nothing, faults, residuals, (), self.fault_names, self.residual_names, (), self.fault_delays)
