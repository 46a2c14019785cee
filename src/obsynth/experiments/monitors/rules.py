"""Rules of monitors: norms and whitened windows of residuals; parameters and innovations.

By how much a pointwise bound grows after missing outputs: what the plant's model, which stood in, may have missed.

At the last complete row its states and faults are off by ``zeta = S e + S_q q`` (inputs q of the plant, each at most
one); after j rows without outputs these are off by ``M^j zeta - sum M^l [Bq; 0] q``, ``M = [A Bf; 0 I]``, so that the
outputs that were told to the observer are off by ``delta = [C Df] (...) - Dq q``, and ``e+ = A e + ... - By delta``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from copy import copy
from typing import Any, NamedTuple

import numpy as np

from obsynth.errors import SpecError
from obsynth.experiments.monitors.monitor import Judged, LinearSample, Monitor, Rule, Sample
from obsynth.experiments.monitors.residual_model import InputResponse, ResidualModel, UnlimitedHorizonBound
from obsynth.numerics.arguments import FloatArray, largest_singular_value, real_number
from obsynth.observers.dae.observer import DAEObserver
from obsynth.observers.decisions import NIS_WINDOW, WALKING_FORMS, alone, two_sided_sums
from obsynth.observers.outliers import chi_square_limit
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.plants.descriptor import index_of
from obsynth.verification.error_system import ErrorModel

#: States that are solved from the observer's own and the outputs are these, up to rounding.
SOLVED_SHARE = 1e-9
#: Largest share of a sample, in units of 1 / norm of A, in which a slope is bounded at once.
SLOPE_PIECE = 0.1
#: Columns that are kept apart; more of them are put together to a box, which holds them.
MOST_APART = 200
#: What is smaller, of what the error may be without a gap, is rounding of the threshold.
GAP_ROUNDING = 2.0**-52


class GapState(NamedTuple):
    """What missing outputs have left: columns ``(n, any)`` whose sum, each times at most one, is in the error."""

    columns: FloatArray
    begun: FloatArray  # those at the last complete row
    age: int = 0  # rows since then


class GapGrowth:
    """What missing outputs add to the pointwise bound of a sampled design."""

    def __init__(self, errors: ErrorModel, model: ResidualModel, sizes: FloatArray, factor: float) -> None:
        plant, observer = errors.plant, errors.observer
        self._A, self._By, self._C = model.A, observer.By, model.C
        held, direct = _disturbances(model, errors, sizes)
        self._Bq = np.hstack([held, factor * plant.Bw])
        self._Dq = np.hstack([direct, factor * plant.Dw])
        self._S, self._Sq = _stand_in(errors, self._Bq, self._Dq)
        nx, nf = plant.nx, plant.nf
        self._M = np.block([[plant.A, plant.Bf], [np.zeros((nf, nx)), np.eye(nf)]])
        self._H = np.hstack([plant.C, plant.Df])
        powers, driven = model.powers(), errors.own @ self._Bq - observer.By @ self._Dq
        self._last = powers[-1] @ model.A
        self._impulses = np.hstack([power @ driven for power in powers]) if len(model.A) else np.zeros((0, 0))
        self._powers, self._aged = np.stack(powers), float(np.linalg.norm(self._last @ driven, axis=0).sum())
        left = largest_singular_value(self._last)
        self._aged /= 1.0 - left
        self._size = np.abs(self._impulses).sum(axis=1) if self._impulses.size else np.zeros(len(model.A))
        # By age: what the outputs of the model may miss, and how they hang on the error at the last complete row.
        self._misses: list[FloatArray] = [np.abs(self._Dq).sum(axis=1)]
        self._maps: list[FloatArray] = [np.zeros((plant.ny, len(model.A)))]
        self._power, self._drift = np.eye(nx + nf), np.zeros(plant.ny)
        # States that lag are those of earlier rows: the model goes on from there.
        for _ in range(max(observer.state_delays, default=0)):
            self._further()

    def start(self) -> GapState:
        """Return the state where nothing is missing."""
        nothing = np.zeros((len(self._A), 0))
        return GapState(nothing, nothing)

    def missed(self, age: int) -> tuple[FloatArray, FloatArray]:
        """Return ``(ny,)``: what outputs may miss ``age`` rows after a complete one; ``(ny, n)``: per error there."""
        while len(self._misses) <= age:
            self._further()
            shown = self._H @ self._power
            on_errors = shown @ self._S
            reach = np.abs(on_errors @ self._impulses).sum(axis=1) if self._impulses.size else np.zeros(len(shown))
            # What is older than all powers, as in `unlimited_bound`.
            older = np.linalg.norm(np.einsum("ij,kjl->kil", on_errors, self._powers), axis=2).sum(axis=0) * self._aged
            own = np.abs(shown @ self._Sq).sum(axis=1)
            self._misses.append(reach + older + own + self._drift + self._misses[0])
            self._maps.append(on_errors)
        return self._misses[age], self._maps[age]

    def _further(self) -> None:
        driven = self._power[:, : len(self._Bq)] @ self._Bq
        self._drift = self._drift + np.abs(self._H @ driven).sum(axis=1)
        self._power = self._M @ self._power

    def after(self, state: GapState, sample: Sample) -> tuple[GapState, float]:
        """Return the state after a row, and what gaps before it add to the norm of what is watched at it."""
        for _ in range(sample.skipped):
            state = self._without(state, np.ones(len(self._H), dtype=bool))
        grown = float(np.linalg.norm(self._C @ state.columns, axis=0).sum())
        outputs = sample.said.outputs if isinstance(sample.said, LinearSample) else np.full(len(self._H), np.nan)
        return self._without(state, np.isnan(outputs)), grown

    def _without(self, state: GapState, missing: np.ndarray) -> GapState:
        """Return the state after a row in which some outputs are missing, or none."""
        columns = self._A @ state.columns
        if not missing.any():
            return GapState(self._kept(columns), state.columns, 0)
        age = state.age + 1
        bound, per_error = self.missed(age)
        bound = bound + np.abs(per_error @ state.begun).sum(axis=1)
        new = self._By[:, missing] * bound[missing]
        return GapState(self._kept(np.hstack([columns, new])), state.begun, age)

    def _kept(self, columns: FloatArray) -> FloatArray:
        """Return columns that hold the same: none that are rounding, and not too many."""
        sizes = np.abs(columns).sum(axis=1)
        if (sizes <= GAP_ROUNDING * self._size).all():
            return columns[:, :0]
        return columns if columns.shape[1] <= MOST_APART else np.diag(sizes)


def _disturbances(model: ResidualModel, errors: ErrorModel, sizes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return columns ``(nx, any)`` that disturbances add to the states in a sample, and ``(ny, any)`` to the outputs.

    Between samples they may do anything: the states take their mean, and the outputs their value at the sample; what
    the states take besides the mean is ``int (e^(A s) b - mean) d ds``, of at most ``L h^2 / 3`` for the largest slope
    L of ``e^(A s) b``, state by state.
    """
    plant, sampled = errors.plant, model.sampled
    if sampled is None:
        return plant.Bd * sizes, plant.Dd * sizes
    a, h, none = sampled.plant.A, sampled.dt, np.zeros((plant.nx, plant.nd))
    count = max(1, int(np.ceil(np.abs(a).sum(axis=1).max(initial=0.0) * h / SLOPE_PIECE)))
    from scipy.linalg import expm

    step, wider = expm(a * h / count), expm(np.abs(a) * h / count)
    slope, largest = a @ sampled.plant.Bd, np.zeros((plant.nx, plant.nd))
    for _ in range(count):
        largest, slope = np.maximum(largest, wider @ np.abs(slope)), step @ slope
    rest = np.diag((largest @ sizes) * h**2 / 3.0)
    outputs = np.zeros((plant.ny, plant.nd)), plant.Dd * sizes, np.zeros((plant.ny, plant.nx))
    return np.hstack([plant.Bd * sizes, none, rest]), np.hstack(outputs)


def _stand_in(errors: ErrorModel, Bq: FloatArray, Dq: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return how far the states that the model starts from, and the faults it holds, are off: per error and input."""
    plant, observer = errors.plant, errors.observer
    told = [plant.fault_names.index(name) for name in observer.fault_names]

    def off(rows: slice) -> tuple[FloatArray, FloatArray]:
        added = 0.0 if errors.T0 is None else errors.T0[rows, : plant.nx] @ Bq
        return -observer.Cz[rows], observer.Dy[rows] @ Dq + added

    fault_e, fault_q = np.zeros((plant.nf, observer.order)), np.zeros((plant.nf, Bq.shape[1]))
    fault_e[told], fault_q[told] = off(observer.fault_rows)
    if len(observer.state_names) == plant.nx:
        order = [plant.state_names.index(name) for name in observer.state_names]
        state_e, state_q = np.zeros((plant.nx, observer.order)), np.zeros((plant.nx, Bq.shape[1]))
        state_e[order], state_q[order] = off(observer.state_rows)
    else:
        into = np.linalg.pinv(np.vstack([errors.own @ plant.E, plant.C]))
        own, outputs = into[:, : observer.order], into[:, observer.order :]
        state_e = -own - outputs @ plant.Df @ fault_e
        state_q = outputs @ (Dq - plant.Df @ fault_q)
    return np.vstack([state_e, fault_e]), np.vstack([state_q, fault_q])


def gap_growth(model: ResidualModel, bounds: FloatArray, noise_bound: float | None) -> GapGrowth | str:
    """Return what missing outputs add to a pointwise bound, or why that is not known; ``bounds (nd,)``."""
    errors = model.errors
    if model.continuous is not None:
        return "between samples of a continuous design the plant's model has no bound"
    plant, observer = errors.plant, errors.observer
    if not np.array_equal(plant.E, np.eye(plant.nx)):
        return "the plant has algebraic states"
    if observer.fault_names != plant.fault_names or len(set(observer.state_delays)) > 1:
        return "the observer does not estimate all faults, or not all states of the same row"
    moving = plant.Bd.any(axis=0) | plant.Dd.any(axis=0)
    if not np.isfinite(bounds[moving]).all():
        return "a disturbance that moves the plant has no bound"
    if len(observer.state_names) not in (0, plant.nx):
        return "the observer does not estimate all states"
    if not observer.state_names:
        if errors.T[:, plant.nx :].any():
            return "the observer follows earlier states"
        known = np.vstack([errors.own @ plant.E, plant.C])
        gap = np.linalg.pinv(known) @ known - np.eye(plant.nx)
        if np.abs(gap).max(initial=0.0) > SOLVED_SHARE:
            return "the states that the plant's model starts from do not follow from the observer's"
    return GapGrowth(errors, model, np.where(moving, bounds, 0.0), 0.0 if noise_bound is None else noise_bound)


#: Share of an interval by which the data's sampling may differ from the one that a threshold is for.
FITTING_SHARE = 0.01
#: How far stamps may be off regular ones, in intervals, for the statistics of these: two of them may be off by a fifth
#: each. Intervals that are all longer or shorter by `FITTING_SHARE` get no further away.
LARGEST_AWAY = 0.4
#: Share of an interval within which two of them are the same: stamps are rounded.
SAME_INTERVAL = 1e-6
#: What rounding may take from a number of samples, as a share of it.
COUNT_ROUNDING = 1e-9
#: What a rule says where nothing is decided.
NOT_DECIDED = Judged(math.nan, math.nan)


def share_of_look(look: int) -> float:
    """Return the share of the probability of a false alarm for look ``look`` (from 1); all sum up to one.
    Looks ``2^j`` to ``2^(j+1) - 1`` share ``6 / (pi (j + 1))^2`` evenly."""
    epoch = look.bit_length() - 1
    return 6.0 / (math.pi * (epoch + 1.0)) ** 2 / 2.0**epoch


class NormState(NamedTuple):
    """The state of `NormRule`; of many runs norms have an axis."""

    norms: tuple[Any, ...] = ()  # of the latest samples
    begin: float | None = None  # first, latest stamp since the start
    last: float | None = None
    regular: bool = True  # whether all samples were as far apart as stated, or some further
    late: bool = False
    added: tuple[float, ...] = ()  # what known inputs add, of the latest samples; what that is made of
    driven: FloatArray | None = None
    inputs: FloatArray | None = None
    moved: bool = False
    gap: GapState | None = None  # what outputs that were missing have left


class NormRule(Rule):
    """The norm of the residual, or of a window of it, against a bound by the number of samples since the start.
    Continuous designs: ``irregular`` holds where samples are not all ``dt`` apart, but none further; ``driven``: what
    known inputs add.  ``watched``: rows of the observer that take the place of the residual."""

    GUARANTEES = True

    def __init__(
        self,
        table: FloatArray,
        limit: float,
        *,
        window: int,
        dt: float,
        irregular: UnlimitedHorizonBound | None = None,
        watched: slice | None = None,
        driven: InputResponse | None = None,
    ) -> None:
        self.gaps: GapGrowth | None = None
        self.table, self.limit, self.irregular = table, limit, irregular
        self._regular = table, limit
        self._window, self._dt, self._watched, self._driven = window, dt, watched, driven

    def over_gaps(self, gaps: GapGrowth) -> NormRule:
        """Return the rule that knows what missing outputs add after them: it need not wait until their effect has
        settled."""
        found = copy(self)
        found.gaps, found.bridges, found.takes_gaps = gaps, True, True
        return found

    def init(self) -> NormState:
        """Return the state before the first sample."""
        return NormState(
            driven=None if self._driven is None else self._driven.start(),
            gap=None if self.gaps is None else self.gaps.start(),
        )

    def fold(self, state: NormState, residuals: FloatArray) -> tuple[NormState, Any]:
        """Return the state and the norm of the window after residuals ``(..., nr)``."""
        # The bound counts samples before the window as well: a window that is not full is bounded all the more.
        norms = (*state.norms, norm_of(residuals))[-self._window :]
        return state._replace(norms=norms), norm_of(np.stack(norms, axis=-1)) if len(norms) > 1 else norms[0]

    def statistics(self, residuals: FloatArray) -> FloatArray:
        """Return the statistic of records: without a window every sample stands for itself."""
        return norm_of(residuals) if self._window == 1 else super().statistics(residuals)

    def step(self, state: NormState, sample: Sample) -> tuple[NormState, Judged]:
        """Return the state after a sample, statistic and threshold."""
        said: Any = sample.said
        late = 0.0 if state.last is None else (sample.time - state.last - self._dt) / self._dt
        begin = sample.time if state.begin is None else state.begin
        regular = state.regular and abs(late) <= SAME_INTERVAL
        state = state._replace(
            # A window is a number of samples at the sampling that its bound is for.
            norms=() if self._window > 1 and abs(late) > FITTING_SHARE else state.norms,
            begin=begin,
            last=sample.time,
            regular=regular,
            late=state.late or (self.irregular is not None and late > FITTING_SHARE),
        )
        if self._driven is not None:
            state = self._with_inputs(self._driven, state, said)
        k = math.floor((sample.time - begin) / self._dt * (1.0 + COUNT_ROUNDING))
        table, limit = self._regular if regular or self.irregular is None else self.irregular
        threshold = float(table[k]) if k < len(table) else limit
        # Neither rows further apart than stated nor inputs that move at other stamps are in the bound.
        if state.late or (state.moved and not regular):
            threshold = math.inf
        threshold += math.hypot(*state.added)
        if self.gaps is not None and state.gap is not None:
            gap, grown = self.gaps.after(state.gap, sample) if sample.bridged else (self.gaps.start(), 0.0)
            state, threshold = state._replace(gap=gap), threshold + grown
        if not sample.deciding:
            return state, Judged(math.nan, threshold)
        state, value = self.fold(state, sample.residuals if self._watched is None else said.rows[self._watched])
        return state, Judged(value, threshold)

    def _with_inputs(self, driven: InputResponse, state: NormState, said: Any) -> NormState:
        """Return the state with the known inputs of a row, and what they add to the norm; in a gap they are held."""
        before, states = state.inputs, state.driven
        u = before if said is None or not np.isfinite(said.inputs).all() else said.inputs
        if u is None:
            return state
        moved = state.moved
        if before is not None and states is not None:
            states, moved = driven.advanced(states, before, u), moved or bool(u.any() or before.any())
        size = 0.0 if states is None else driven.size(states)
        return state._replace(driven=states, inputs=u, moved=moved, added=(*state.added, size)[-self._window :])

    def restart(self, state: NormState, skipped: int = 0) -> NormState:
        """Begin again: the error at a new start is taken to be no larger than that at the first."""
        gap = None if self.gaps is None else self.gaps.start()
        return state._replace(norms=(), added=(), begin=None, last=None, regular=True, late=False, gap=gap)

    def options(self) -> float:
        """Return the limit: it depends on all options."""
        return self.limit


def norm_of(values: FloatArray) -> Any:
    """Return the norms ``(...)`` of rows ``(..., n)``; a row alone is not squared, as its square may be no number."""
    return math.hypot(*values) if values.ndim == 1 else np.linalg.norm(values, axis=-1)


class WindowState(NamedTuple):
    """The state of `WhitenedRule`; of many runs rows and sums have an axis before their last."""

    window: tuple[FloatArray, ...]  # latest residuals ``(..., nr)``, oldest first
    levels: FloatArray  # ``(..., 2 m)``: cumulative sums
    filled: int = 0  # rows since the start
    looks: int = 0
    last: float | None = None
    away: float = 0.0  # of the last stamp from regular ones, in intervals


class WhitenedRule(Rule):
    """A window of residuals in the metric of its covariance: chi-square, or cumulative sums for a ``change``.
    ``whitener (m, window nr)``, oldest sample first; ``white``: see `whitening.cusum_whitener`; ``table``: thresholds
    of a record, in place of those for any number of looks."""

    def __init__(
        self,
        whitener: FloatArray,
        mean: FloatArray,
        *,
        window: int,
        change: float | None,
        false_alarms: float,
        dt: float,
        white: bool = True,
        table: FloatArray | None = None,
    ) -> None:
        self.whitener, self._mean, self._change, self._window = whitener, mean, change, window
        self._probability, self._dt, self._white, self.table = false_alarms, dt, white, table

    def init(self) -> WindowState:
        """Return the state before the first sample."""
        return WindowState((np.zeros_like(self._mean),) * self._window, np.zeros(2 * len(self.whitener)))

    def fold(self, state: WindowState, residuals: FloatArray) -> tuple[WindowState, Any]:
        """Return the state and the statistic ``(...)`` after residuals ``(..., nr)``."""
        centred = residuals - self._mean
        shape, count = centred.shape, state.filled + 1
        window = tuple(np.broadcast_to(row, shape) for row in (*state.window[1:], centred))
        state = state._replace(window=window, filled=count)
        deciding = count >= self._window if self.table is None else np.isfinite(self.table[count - 1])
        if self._change is not None and not deciding:
            return state, np.zeros(shape[:-1])
        with np.errstate(over="ignore", invalid="ignore"):
            white = _finite(np.concatenate(window, axis=-1) @ self.whitener.T)
            if self._change is None:
                return state, np.sum(white**2, axis=-1)
            one = np.ones_like(white)
            levels = _finite(two_sided_sums(state.levels, white, one, self._change * one))
        return state._replace(levels=levels), levels.max(axis=-1)

    def step(self, state: WindowState, sample: Sample) -> tuple[WindowState, Judged]:
        """Return the state after a sample, statistic and threshold. Stamps that jitter are those of the regular samples
        that they are nearest to."""
        if state.last is not None:
            away = state.away * (1.0 - FITTING_SHARE / LARGEST_AWAY) + (sample.time - state.last) / self._dt - 1.0
            state = state._replace(away=away) if abs(away) <= LARGEST_AWAY else self.restart(state)
        state = state._replace(last=sample.time)
        if not sample.deciding:
            return state, NOT_DECIDED
        state, value = self.fold(state, sample.residuals)
        if state.filled < self._window:
            return state, NOT_DECIDED
        state = state._replace(looks=state.looks + 1)
        probability, degrees = self._probability * share_of_look(state.looks), len(self.whitener)
        if self._change is None:
            return state, Judged(float(value), chi_square_limit(degrees, probability))
        # Sums of what is not white are counted one by one: as many end here as there were looks.
        ending = 1 if self._white else state.looks
        return state, Judged(float(value), math.log(2 * degrees * ending / probability))

    def restart(self, state: WindowState, skipped: int = 0) -> WindowState:
        """Clear window and sums; the decisions that were taken stay counted."""
        return self.init()._replace(looks=state.looks)

    def options(self) -> list[float]:
        """Return probability, window and change."""
        return [self._probability, float(self._window), self._change or 0.0]


def _finite(values: FloatArray) -> FloatArray:
    """Return numbers that have overflowed as the largest there is: one of them must not silence all that follow."""
    largest = np.finfo(np.float64).max
    return np.nan_to_num(values, nan=largest, posinf=largest, neginf=-largest)


PARAMETER_KINDS = ("chi-square", "cusum", "nis")
ANY_LENGTH = " (the run may have any length)"
_PARAMETER_STATEMENTS = {
    "chi-square": "distance of the parameters from their nominal values in the metric of their covariance: passed in a "
    "run without a change with a probability of {} at most, for Gaussian noise as stated",
    "cusum": "cumulative sum of the whitened innovation for a change of the stated size: passed in a run without a "
    "change with a probability of {} at most, for Gaussian noise as stated",
    "nis": "squared innovations of 20 samples: passed in a run of the plant as modelled with a probability of {} at "
    "most, for Gaussian noise as stated",
}


class ParameterState(NamedTuple):
    """The state of `ParameterRule`."""

    levels: FloatArray  # ``(2 nq,)``: cumulative sums
    looks: int = 0
    squares: tuple[float, ...] = ()  # of the latest innovations, and how many numbers each has
    degrees: tuple[int, ...] = ()


class ParameterRule(Rule):
    """Parameters against nominal values, or innovations against what noise explains, in a run of any length.
    ``chi-square`` of theta by its covariance; ``cusum`` of the innovations for a ``change (nq,)``; ``nis``, squares of
    the innovations over 20 samples, for all that the model does not explain."""

    def __init__(self, kind: str, nominal: FloatArray, change: FloatArray, false_alarms: float) -> None:
        self._kind, self._nominal, self._change, self._probability = kind, nominal, change, false_alarms

    def init(self) -> ParameterState:
        """Return the state before the first sample."""
        return ParameterState(np.zeros(2 * len(self._nominal)))

    def step(self, state: ParameterState, sample: Sample) -> tuple[ParameterState, Judged]:
        """Return the state after a sample, statistic, threshold, and the number of the parameter if it is known."""
        if not sample.deciding:
            return state, NOT_DECIDED
        found: Any = sample.said
        looked = state._replace(looks=state.looks + 1)
        share = self._probability * share_of_look(looked.looks)
        if self._kind == "cusum":
            along, information = found.score - found.information @ self._nominal, np.diag(found.information)
            levels = two_sided_sums(state.levels, along, information, self._change)
            which = int(np.argmax(levels)) % len(self._nominal)
            return looked._replace(levels=levels), Judged(float(levels.max()), math.log(len(levels) / share), which)
        if self._kind == "chi-square":
            away = found.theta - self._nominal
            weights = np.linalg.pinv(found.parameter_covariance, hermitian=True)
            value, limit = float(away @ weights @ away), chi_square_limit(len(away), share)
            return looked, Judged(value, limit, alone(weights @ away, np.diag(weights)))
        gap = found.whitened
        if found.regressor.size:
            gap = gap - found.regressor @ self._nominal
        squares, degrees = (*state.squares, float(gap @ gap))[-NIS_WINDOW:], (*state.degrees, len(gap))[-NIS_WINDOW:]
        if not sum(degrees):
            return state._replace(squares=squares, degrees=degrees), NOT_DECIDED
        looked = looked._replace(squares=squares, degrees=degrees)
        return looked, Judged(sum(squares), chi_square_limit(sum(degrees), share))

    def restart(self, state: ParameterState, skipped: int = 0) -> ParameterState:
        """Clear the sums; the covariance of the filter accounts for missing rows."""
        return self.init()._replace(looks=state.looks)

    def options(self) -> list[Any]:
        """Return kind, probability, nominal values and change."""
        return [self._kind, self._probability, self._nominal.tolist(), self._change.tolist()]


def _whole_record(observer: RecursiveObserver | DAEObserver) -> str:
    """Return why a likelihood ratio is not among the monitors, and what to use instead."""
    why = " glr compares every time at which a change may have begun, which takes a whole record"
    if isinstance(observer, DAEObserver):
        return f"{why}, and regressors, which a nonlinear design does not have: chi-square, cusum or nis serve here."
    if observer.form in ("", "random-walk"):
        return f"{why}, and regressors, which this design does not have: chi-square or nis serve here."
    return f"{why}: obsynth.decide(..., statistic='glr') has it for recorded estimates; row by row, use cusum."


def parameter_monitor(
    observer: RecursiveObserver | DAEObserver,
    kind: str,
    nominal: Mapping[str, float],
    change: float,
    false_alarms: float,
) -> Monitor:
    """Return the monitor of parameters, or of innovations, for data of any length."""
    if kind not in PARAMETER_KINDS:
        hint = _whole_record(observer) if kind == "glr" else ""
        raise SpecError(
            f"The monitor {kind!r} is not for a recursive or nonlinear design: use one of "
            f"{', '.join(PARAMETER_KINDS)}, learned.{hint}",
            path="kind",
        )
    names = observer.fault_names
    theta = np.array(observer.initial_parameters, dtype=np.float64)
    for name, value in nominal.items():
        place = index_of(name, names, what="nominal")
        theta[place] = real_number(value, f"The nominal value of {name!r}", "a finite number", path="nominal")
    if kind != "nis" and not len(theta):
        raise SpecError(f"{kind} monitors parameters, and this design estimates none: use nis.", path="kind")
    if kind == "cusum" and observer.form in WALKING_FORMS:
        raise SpecError(
            f"cusum needs regressors, which a {observer.form} design does not have: use chi-square or nis.", path="kind"
        )
    rule = ParameterRule(kind, theta, np.full(len(theta), float(change)), false_alarms)
    return Monitor(
        kind,
        _PARAMETER_STATEMENTS[kind].format(f"{false_alarms:g}") + ANY_LENGTH,
        rule,
        residuals=observer.innovation_count,
        fault_names=names,
        fault_scales=np.ones(len(names)),
    )
