"""Rules of monitors of residuals: norms, and windows in the metric of their covariance."""

from __future__ import annotations

import math
from copy import copy
from typing import Any, NamedTuple

import numpy as np

from obsynth.monitoring.thresholds.between_samples import InputResponse
from obsynth.monitoring.thresholds.change_statistics import two_sided_sums
from obsynth.monitoring.thresholds.gap_growth import GapGrowth, GapState
from obsynth.monitoring.thresholds.monitor import Rule, RuleOutput, Sample
from obsynth.monitoring.thresholds.residual_norm_bounds import UnlimitedHorizonBound
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.outliers import chi_square_limit

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
NOT_DECIDED = RuleOutput(math.nan, math.nan)

ANY_LENGTH = " (the run may have any length)"


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

    @property
    def bound_by_row(self) -> UnlimitedHorizonBound | None:
        """Bounds on the norm of one residual by the row since the start, and for ever after; ``None`` where a threshold
        depends on more than the row."""
        more = (self.gaps, self.irregular, self._watched, self._driven)
        plain = self._window == 1 and all(part is None for part in more)
        return self._regular if plain else None

    def over_gaps(self, gaps: GapGrowth) -> NormRule:
        """Return the rule that knows what missing outputs add after them: it need not wait until their effect has
        settled."""
        rule = copy(self)
        rule.gaps, rule.bridges, rule.takes_gaps = gaps, True, True
        return rule

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

    def step(self, state: NormState, sample: Sample) -> tuple[NormState, RuleOutput]:
        """Return the state after a sample, statistic and threshold."""
        observation: Any = sample.observation
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
            state = self._with_inputs(self._driven, state, observation)
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
            return state, RuleOutput(math.nan, threshold)
        state, value = self.fold(state, sample.residuals if self._watched is None else observation.rows[self._watched])
        return state, RuleOutput(value, threshold)

    def _with_inputs(self, driven: InputResponse, state: NormState, observation: Any) -> NormState:
        """Return the state with the known inputs of a row, and what they add to the norm; in a gap they are held."""
        before, states = state.inputs, state.driven
        u = before if observation is None or not np.isfinite(observation.inputs).all() else observation.inputs
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


class WindowRuleState(NamedTuple):
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
    of a record, in place of those for any number of looks; ``watched``: rows of the observer that take the place of the
    residual."""

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
        watched: slice | None = None,
    ) -> None:
        self._watched = watched
        self.whitener, self._mean, self._change, self._window = whitener, mean, change, window
        self._probability, self._dt, self._white, self.table = false_alarms, dt, white, table

    def init(self) -> WindowRuleState:
        """Return the state before the first sample."""
        return WindowRuleState((np.zeros_like(self._mean),) * self._window, np.zeros(2 * len(self.whitener)))

    def fold(self, state: WindowRuleState, residuals: FloatArray) -> tuple[WindowRuleState, Any]:
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
            ones = np.ones_like(white)
            levels = _finite(two_sided_sums(state.levels, white, ones, self._change * ones))
        return state._replace(levels=levels), levels.max(axis=-1)

    def step(self, state: WindowRuleState, sample: Sample) -> tuple[WindowRuleState, RuleOutput]:
        """Return the state after a sample, statistic and threshold. Stamps that jitter are those of the regular samples
        that they are nearest to."""
        if state.last is not None:
            away = state.away * (1.0 - FITTING_SHARE / LARGEST_AWAY) + (sample.time - state.last) / self._dt - 1.0
            state = state._replace(away=away) if abs(away) <= LARGEST_AWAY else self.restart(state)
        state = state._replace(last=sample.time)
        if not sample.deciding:
            return state, NOT_DECIDED
        observation: Any = sample.observation
        watched = sample.residuals if self._watched is None else observation.rows[self._watched]
        state, value = self.fold(state, watched)
        if state.filled < self._window:
            return state, NOT_DECIDED
        state = state._replace(looks=state.looks + 1)
        probability, degrees = self._probability * share_of_look(state.looks), len(self.whitener)
        if self._change is None:
            return state, RuleOutput(float(value), chi_square_limit(degrees, probability))
        # Sums of what is not white are counted one by one: as many end here as there were looks.
        ending = 1 if self._white else state.looks
        return state, RuleOutput(float(value), math.log(2 * degrees * ending / probability))

    def restart(self, state: WindowRuleState, skipped: int = 0) -> WindowRuleState:
        """Clear window and sums; the decisions that were taken stay counted."""
        return self.init()._replace(looks=state.looks)

    def options(self) -> list[float]:
        """Return probability, window and change."""
        return [self._probability, float(self._window), self._change or 0.0]


def _finite(values: FloatArray) -> FloatArray:
    """Return numbers that have overflowed as the largest there is: one of them must not silence all that follow."""
    largest = np.finfo(np.float64).max
    return np.nan_to_num(values, nan=largest, posinf=largest, neginf=-largest)
