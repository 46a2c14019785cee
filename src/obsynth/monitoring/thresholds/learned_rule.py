"""Learned thresholds as a rule of a monitor: row by row, with its state as plain arrays."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import chi2

from obsynth.errors import SpecError
from obsynth.monitoring.thresholds.fault_effects import NO_EFFECTS, EffectState, FaultEffects, Seen, effects_of
from obsynth.monitoring.thresholds.hypotheses import ranked_changes
from obsynth.monitoring.thresholds.learned import FAULTS_SLOWER, FOLLOWED_ROWS, OWN_ROWS, LearnedThresholds
from obsynth.monitoring.thresholds.learned_statistics import AGES, FORGETTING
from obsynth.monitoring.thresholds.monitor import Evidence, Monitor, Rule, RuleOutput, Sample
from obsynth.monitoring.thresholds.parameter_scores import (
    before_any,
    beyond,
    most_likely_change,
    parameter_walk,
    sample_score,
)
from obsynth.monitoring.thresholds.swings import SWING_MEMORY, Swings
from obsynth.monitoring.thresholds.watched_columns import (
    has_innovations_by_sensor,
    innovation_names,
    watched_names,
    watched_values,
)
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.observers.linear.observer import LinearObserver
from obsynth.results.design import ObserverDesign
from obsynth.results.gain_set_writing import digest_of, gain_set_digest, plain

NOTHING = read_only(np.zeros(0))

#: A row is clipped at so many standard deviations before it moves the followed offset, so that a wrong sample moves it
#: no more than a large value of the noise does.
FOLLOWED_MOST = 3.0

#: The first rows of a run are clipped at so many deviations before their mean is taken: one wrong sample among a
#: hundred moves the mean by a tenth of a deviation at most.  If a mean exceeds the second number times this limit, the
#: offset is larger than the limit, and the alarm stays.
OWN_MOST, NEARLY_MOST = 10.0, 0.9

#: If more than this share of the first rows was in alarm when they are taken as usual, the offset was there nearly from
#: the first row on.  Its effect is then known only at the inputs of these rows and may differ at others, so the levels
#: rise to the second number times the statistics of these rows (averaged by their roots, so that wrong samples weigh
#: little).
MOST_OF_START, ROOM_OF_START = 0.75, 2.0

#: The offset is followed so many times more slowly while a level is exceeded, so that a quick change stays an alarm.
SLOWER_IN_ALARM = 10.0


class LearnedState(NamedTuple):
    """The state of `LearnedRule`."""

    past: FloatArray  # ``(order, m)``: rows, latest first
    white: FloatArray  # ``(ages, m)``: whitened rows, latest last
    means: FloatArray  # exponentially weighted means of whitened rows, one row for each weight
    last: float | None = None  # time of the last sample
    taken: int = 0  # number of samples
    waiting: int = 0  # rows until the last incomplete row no longer affects the prediction
    before: FloatArray = NOTHING  # ``(1 + nf, nf)``: estimates and covariance of the faults after the last sample
    scores: FloatArray = NOTHING  # ``(ages, 2 nf)``: score and information of the faults in each row, latest last
    effects: EffectState = NO_EFFECTS  # of faults and sensors on the residuals
    slow: FloatArray = NOTHING  # ``(m,)``: the followed offset of whitened rows
    centres: FloatArray = NOTHING  # ``(nf,)``: values of the faults from which changes are measured
    alarmed: int = 0  # whether the latest decided row exceeded a level
    raised: FloatArray = NOTHING  # ``(ages, nu)``: how far inputs were beyond their ranges in each row, latest last
    begun: int = 0  # number of first rows that are averaged, up to the last of `OWN_ROWS`
    own: FloatArray = NOTHING  # ``(m + nf,)``: sums over the first rows, of whitened values and of fault estimates
    ended: int = 0  # number of first rows whose means were taken as usual, which ended an alarm; 0: none were
    decided: int = 0  # whether a row has been decided, so that the warm-up is over
    stood: int = 0  # number of first rows in alarm
    roots: float = 0.0  # sum of the roots of their largest statistics
    room: float = 1.0  # factor of all levels since an alarm of the first rows was ended
    swings: Swings = Swings()  # swings to both sides of the means of whitened rows and of likelihood ratios


class _Row(NamedTuple):
    """The columns of a sample, and how much evidence they may add."""

    values: FloatArray | None  # estimates and residuals, NaN where one is missing
    complete: bool  # whether no column is missing but those that most rows lack
    evidence: FloatArray | None  # ``(m,)``: watched columns; missing ones are filled in if the others may decide
    counts: bool  # whether the sample adds evidence
    most: float  # largest norm of its whitened values
    varying: bool  # whether the observer's gain depends on which values are measured


def shares_of_partial_scores(learned: LearnedThresholds) -> FloatArray:
    """Return the factor of the score of each fault ``(nf,)`` in a sample that lacks outputs.

    Covariances of the observer that are too large for the rows without faults make the scores of complete samples
    smaller than their information states, and with them the learned levels of changes.  The scores of the other outputs
    alone need not be smaller.  The factor is the root of the learned level divided by the level that follows from the
    information, and one at most.
    """
    faults = len(learned.statistics.estimates)
    if not faults:
        return NOTHING
    levels = learned.levels[-2 * faults : -faults]
    usual = chi2.isf(1.0 / (learned.every * len(learned.levels) * len(AGES)), 1)
    return np.asarray(np.minimum(np.sqrt(levels / usual), 1.0))


def follow_shares(memory: float) -> tuple[float, float]:
    """Return the weights of a new row in the followed offset of the residuals: without an alarm, and during one."""
    return (1.0 / memory, 1.0 / (SLOWER_IN_ALARM * memory)) if memory else (0.0, 0.0)


class LearnedRule(Rule):
    """The largest of all learned statistics in units of its level, row by row.

    The autoregression predicts a row that is missing, or that may not be decided.  Rows of the warm-up are only used to
    predict later ones.  Such rows neither add evidence nor take any away.

    All observers but the linear ones have gains that depend on which values are measured.  With them

    - a sample whose outputs give no evidence of their own is decided by the rows before it;
    - a missing sample changes the estimates in a way that was not learned.  The norm of later whitened rows, as long as
      their prediction uses the missing one, is therefore limited to that of the innovation whitened by the observer's
      own covariance, which has grown; that norm is corrected by its mean size in the rows without faults;
    - innovations that belong to one sensor each (``by_sensor``) keep their distribution when others are missing: they
      decide the row, and the missing ones take their conditional means;
    - the scores of faults in a sample that lacks outputs are reduced (`shares_of_partial_scores`), since their size was
      not learned.

    A linear observer recovers from a gap before rows are decided.  If one of its columns is predicted closely, as an
    estimate that follows from earlier residuals, rows that are predicted from a missing row, from one of the warm-up or
    from before the first row add no evidence, since no such rows were learned from.

    With a ``memory``, changes are measured from exponential means of recent whitened rows and fault estimates.  These
    means follow more slowly after a row in alarm (`SLOWER_IN_ALARM`).  If the thresholds were learned from few logs, an
    alarm that is present after the first `OWN_ROWS` rows of a run ends there: the means of these rows replace the
    learned ones and are followed from then on.  If most of these rows were in alarm, the levels rise as well.

    If means of whitened rows or likelihood ratios swing to both sides, their levels rise with the swings: a fault would
    stay on one side, so that the noise has become slower."""

    def __init__(
        self,
        learned: LearnedThresholds,
        names: Sequence[str],
        faults: Sequence[str] = (),
        *,
        by_sensor: bool = False,
        walk: FloatArray | None = None,
        effects: FaultEffects | None = None,
    ) -> None:
        self.learned, self.by_sensor, self.effects = learned, by_sensor, effects
        self._walk = walk if learned.statistics.estimates else None
        self._residual = np.array([not name.startswith("fhat[") for name in learned.columns])
        self._faults = {f"fault {name}": i for i, name in enumerate(faults)}
        self._names = tuple(faults)
        self._places = np.array([names.index(name) for name in learned.columns])
        self._usual = np.array([name not in learned.seldom for name in names])
        templates = learned.statistics.templates()
        self._templates = templates.reshape(len(templates) * len(AGES), -1)
        self._model = learned.statistics.model
        self._rests_on_the_past = self._model.rests_on_the_past
        offsets = learned.statistics.offset_effects() / np.sqrt(learned.statistics.levels_by_age)
        self._effects = offsets.ravel()
        self._swinging = len(FORGETTING) * self._model.channels + len(templates)
        self._partly_measured = shares_of_partial_scores(learned)
        bands = learned.statistics.fault_bands
        self._bands = np.zeros(len(learned.centres)) if bands is None else bands
        self._ranges = learned.ranges
        self._shares = follow_shares(learned.memory), follow_shares(learned.memory or FOLLOWED_ROWS)
        self._has_offset = learned.memory > 0.0 or learned.takes_first_rows

    def init(self) -> LearnedState:
        """Return the state before the first sample."""
        model = self._model
        white, means = np.zeros((max(AGES), model.channels)), np.zeros((len(FORGETTING), model.channels))
        effects = NO_EFFECTS if self.effects is None else self.effects.init()
        inputs = 0 if self._ranges is None else self._ranges.inputs
        walking = 0 if self._walk is None else len(self._walk)
        state = LearnedState(
            np.tile(model.mean, (model.order, 1)), white, means, effects=effects, slow=np.zeros(model.channels),
            raised=np.ones((max(AGES), inputs)), own=np.zeros(model.channels + walking),
            swings=Swings.none(self._swinging),
        )  # fmt: skip
        if self._walk is None:
            return state
        return state._replace(
            before=before_any(len(self._walk)), scores=np.zeros((max(AGES), 2 * len(self._walk))),
            centres=self.learned.centres,
        )  # fmt: skip

    def step(self, state: LearnedState, sample: Sample) -> tuple[LearnedState, RuleOutput]:
        """Return the state after a sample, and the decision: the largest statistic in units of its level, the threshold
        one, and the likeliest fault."""
        missing = 0 if state.last is None else max(round((sample.time - state.last) / self.learned.dt) - 1, 0)
        state = self._begun(state, sample, missing)
        row = self._row(state, sample)
        if not row.complete and row.varying:
            state = state._replace(waiting=self._model.order + 1)
        state = self._with_row(state._replace(waiting=max(state.waiting - 1, 0)), row, sample)
        # A sample with fewer outputs and no evidence of its own is decided by the rows before it, so that missing
        # outputs do not end an alarm.
        by_rows_before = row.varying and sample.deciding and state.taken > self.learned.settling
        if row.values is None or not (row.counts or by_rows_before):
            return state, RuleOutput(math.nan, math.nan)
        return self._decision(state, row, row.values, sample)

    def _begun(self, state: LearnedState, sample: Sample, missing: int) -> LearnedState:
        """Return the state with the ``missing`` rows before a sample, and with its time, scores and inputs."""
        for _ in range(min(missing, max(AGES))):
            state, _ = self._added(state, None)
        follows_nothing = missing > 0 or state.last is None
        if follows_nothing and self._rests_on_the_past and not isinstance(sample.observation, Evidence):
            state = state._replace(waiting=self._model.order)
        state = state._replace(last=sample.time, taken=state.taken + 1, decided=int(state.decided or sample.deciding))
        if not state.decided and self._rests_on_the_past and not isinstance(sample.observation, Evidence):
            state = state._replace(waiting=self._model.order + 1)
        values = watched_values(sample.residuals, sample.observation)
        state = self._scored(state, sample.observation, missing, whole=self._is_whole(values))
        if sample.deciding and state.taken > self.learned.settling:
            state = self._centred(state, sample.observation)
        return state._replace(raised=self._raised(state.raised, sample, missing))

    def _is_whole(self, values: FloatArray | None) -> bool:
        """Return whether no value is missing but those that most rows lack."""
        return values is not None and bool(np.isfinite(values[self._usual]).all())

    def _row(self, state: LearnedState, sample: Sample) -> _Row:
        """Return the columns of a sample, and how much evidence they may add."""
        values = watched_values(sample.residuals, sample.observation)
        complete = sample.deciding and self._is_whole(values)
        evidence = None
        if values is not None and sample.deciding:
            evidence = self._completed(state, values, complete=complete)
        counts = evidence is not None and state.taken > self.learned.settling
        most, varying = math.inf if counts else 0.0, isinstance(sample.observation, Evidence)
        if counts and state.waiting and isinstance(sample.observation, Evidence):
            most = float(np.linalg.norm(sample.observation.whitened)) / self.learned.innovation
        elif state.waiting and not varying:
            most = 0.0
        return _Row(values, complete, evidence, counts, most, varying)

    def _with_row(self, state: LearnedState, row: _Row, sample: Sample) -> LearnedState:
        """Return the state with a row, or with its prediction from the rows before it if it cannot be used."""
        # Rows after the warm-up are predicted from its last rows: a prediction from the mean would make a slow estimate
        # look like a jump.
        kept = row.varying or not state.decided
        if row.values is None or not (
            row.complete or (kept and (row.counts or np.isfinite(row.values[self._places]).all()))
        ):
            state = self._followed(self._added(state, None)[0], sample.observation)
            if self._rests_on_the_past and not row.varying:
                state = state._replace(waiting=self._model.order)
            return state
        watched = row.values[self._places]
        filled = watched if row.evidence is None else np.where(np.isfinite(watched), watched, row.evidence)
        seen = None
        if row.complete or row.varying:
            is_there = np.isfinite(watched)
            seen = Seen(is_there, is_there if row.complete else is_there & self._residual)
        state, share = self._added(state, filled, row.most, row.evidence)
        counts = row.counts and row.most > 0.0
        return self._followed(state, sample.observation, seen, share if counts else 0.0)

    def _decision(
        self, state: LearnedState, row: _Row, values: FloatArray, sample: Sample
    ) -> tuple[LearnedState, RuleOutput]:
        """Return the state after a row of ``values`` that is decided, and the decision."""
        # A statistic that overflows exceeds every level.
        with np.errstate(all="ignore"):
            ratios, sides = self._likelihood_ratios(state)
            weights = np.array([(2.0 - share) / share for share in FORGETTING])
            smooth = weights * np.sum(state.means**2, axis=1)
            first = [float(np.sum(state.white[-1] ** 2))]
            changes = self._changes(state, self._bands)
            squares = self._squares(state, sample.observation)
            statistics = np.concatenate([first, smooth, ratios, changes.max(axis=0), squares])
            state, levels = self._swung(state, weights, sides * ratios, first[0], sample.time)
            statistics = statistics / levels
        statistics = np.where(np.isnan(statistics), np.inf, statistics)
        largest = float(statistics.max())
        reached = largest * state.room
        state = self._roomy(state._replace(alarmed=int(largest > 1.0)), reached)
        state = self._own_of_start(state, sample.observation, reached, counts=row.counts)
        # To name a fault, changes are compared without their bands: each fault has a band of its own.
        fault = self._fault(values, ratios) if self._walk is None else most_likely_change(self._changes(state, 0.0))
        ranking = None
        if self.effects is not None and largest > 1.0:
            effects, ranking = self.effects.explained(state.effects)
            state = state._replace(effects=effects)
            if ranking is None and self._walk is not None:
                by_fault = statistics[-2 * len(self._faults) :].reshape(2, -1)
                if (by_fault > 1.0).any():
                    ranking = self.effects.ranked_by_scores(state.effects)
                if ranking is None:
                    ranking = ranked_changes(self._names, self._changes(state, 0.0), by_fault.max(axis=0) > 1.0)
        return state, RuleOutput(largest, 1.0, fault, (), ranking)

    def _followed(
        self, state: LearnedState, observation: Any, seen: Seen | None = None, share: float = 0.0
    ) -> LearnedState:
        """Return the state with the effects of faults and sensors on a row, of which the columns ``seen`` were
        measured, and whose whitened values were scaled by ``share``."""
        if self.effects is None:
            return state
        before = state.effects
        effects = self.effects.step(before, observation, state.white[-1], seen, share)
        if self._walk is not None:
            effects = self.effects.with_scores(before, effects, observation, state.scores[-1, : len(self._walk)])
        return state._replace(effects=effects)

    def _raised(self, before: FloatArray, sample: Sample, missing: int) -> FloatArray:
        """Return how far the inputs of the last rows are beyond their ranges ``(ages, nu)``, with those of a sample and
        of the ``missing`` ones before it."""
        if self._ranges is None:
            return before
        now = np.ones(self._ranges.inputs) if sample.inputs is None else self._ranges.beyond_by(sample.inputs)
        gone = np.ones((min(missing, max(AGES)), len(now)))
        return np.vstack([before, gone, now])[-max(AGES) :]

    def _swung(
        self, state: LearnedState, weights: FloatArray, ratios: FloatArray, row: float, time: float
    ) -> tuple[LearnedState, FloatArray]:
        """Return the state after a row, and the levels; those of slow changes are raised with their swings.

        ``weights`` are those of the squared means, ``ratios (k,)`` the likelihood ratios with the signs of the changes,
        and ``row`` is the statistic of this row alone (T2).
        """
        levels = self.learned.levels * self._factors(state) * state.room
        slow = slice(1, 1 + len(weights) + len(ratios))
        of_means, of_ratios = np.split(levels[slow], [len(weights)])
        means = (weights / of_means)[:, None] * state.means * np.abs(state.means)
        swings, factor = state.swings.after(np.concatenate([means.ravel(), ratios / of_ratios]), row / levels[0], time)
        levels[slow] *= factor
        return state._replace(swings=swings), levels

    def _factors(self, state: LearnedState) -> FloatArray | float:
        """Return the factor of each level for inputs beyond their ranges, over the rows that the statistics use."""
        if self._ranges is None:
            return 1.0
        return self._ranges.factors(state.raised.max(axis=0, initial=1.0), len(self.learned.levels))

    def _scored(self, state: LearnedState, observation: Any, missing: int, *, whole: bool) -> LearnedState:
        """Return the state with the scores of the faults from a sample; ``whole``: with no usual output missing."""
        if self._walk is None or not isinstance(observation, Evidence):
            return state
        before, scores = sample_score(state.before, observation, self._walk, missing + 1)
        away = scores.away(state.centres) * (1.0 if whole else self._partly_measured)
        row = np.concatenate([away, np.diag(scores.information)])
        gone = min(missing, max(AGES))
        newest_scores = np.vstack([state.scores, np.zeros((gone, len(row))), row])[-max(AGES) :]
        return state._replace(before=before, scores=newest_scores)

    def _share(self, state: LearnedState) -> float:
        """Return the weight of a new row in the followed offsets, learned ones or those taken from the first rows."""
        return self._shares[int(state.ended > 0)][state.alarmed]

    def _centred(self, state: LearnedState, observation: Any) -> LearnedState:
        """Return the state in which the centres of the faults have followed the estimates."""
        share = self._share(state)
        if self._walk is None or not share or not isinstance(observation, Evidence):
            return state
        deviations = np.sqrt(np.diag(observation.parameter_covariance))
        with np.errstate(all="ignore"):
            away = np.clip((observation.theta - state.centres) / deviations, -FOLLOWED_MOST, FOLLOWED_MOST)
            moved = state.centres + share / FAULTS_SLOWER * away * deviations
        return state._replace(centres=np.where(np.isfinite(moved), moved, state.centres))

    @staticmethod
    def _roomy(state: LearnedState, reached: float) -> LearnedState:
        """Return the state in which levels that the first rows raised fall again, but not below what the statistics
        ``reached`` in this row."""
        kept = (1.0 - 1.0 / SWING_MEMORY) * state.room
        return state._replace(room=max(kept, min(reached, state.room), 1.0))

    def _own_of_start(self, state: LearnedState, observation: Any, reached: float, *, counts: bool) -> LearnedState:
        """Return the state after a row that may be one of the first of a run.

        If there is an alarm when enough rows have come, their means are taken as usual from then on, and the evidence
        of the rows until then is deleted.
        """
        if not (self.learned.takes_first_rows and counts) or state.begun >= OWN_ROWS[-1]:
            return state
        white = np.clip(np.nan_to_num(state.white[-1] + state.slow), -OWN_MOST, OWN_MOST)
        theta = NOTHING
        if self._walk is not None:
            if not isinstance(observation, Evidence):
                return state
            theta = observation.theta
        own, begun = state.own + np.concatenate([white, theta]), state.begun + 1
        state = state._replace(own=own, begun=begun)
        if state.alarmed and math.isfinite(reached):
            state = state._replace(stood=state.stood + 1, roots=state.roots + math.sqrt(reached))
        if begun not in OWN_ROWS or not state.alarmed or not np.isfinite(own).all():
            return state
        slow, centres = np.split(own / begun, [len(white)])
        if np.abs(slow).max(initial=0.0) > NEARLY_MOST * OWN_MOST:
            return state
        room = ROOM_OF_START * (state.roots / state.stood) ** 2 if state.stood > MOST_OF_START * begun else 1.0
        return state._replace(
            slow=slow, centres=centres, room=max(state.room, room), white=np.zeros_like(state.white),
            means=np.zeros_like(state.means), scores=np.zeros_like(state.scores), alarmed=0, ended=begun,
            swings=Swings.none(self._swinging),
        )  # fmt: skip

    def _likelihood_ratios(self, state: LearnedState) -> tuple[FloatArray, FloatArray]:
        """Return twice the log likelihood ratio of each step and ramp at its likeliest age, and the signs of these."""
        fits = self._templates @ state.white.ravel()
        squares = np.maximum(np.abs(fits) - self._effects, 0.0) ** 2
        likeliest = np.argmax(squares.reshape(-1, len(AGES)), axis=1)
        places = np.arange(len(likeliest)) * len(AGES) + likeliest
        return squares[places], np.sign(fits[places])

    def _changes(self, state: LearnedState, bands: FloatArray | float) -> FloatArray:
        """Return twice the log likelihood ratios ``(ages, nf)`` of changes of each age and fault by more than
        ``bands``."""
        if self._walk is None:
            return np.zeros((1, 0))
        sums = np.cumsum(state.scores[::-1], axis=0)[np.array(AGES) - 1]
        away, power = np.hsplit(sums, 2)
        # The ratio is zero as long as no sample has had information on the fault.
        with np.errstate(all="ignore"):
            return np.asarray(np.where(power > 0.0, beyond(away, bands * power) ** 2 / power, 0.0))

    def _squares(self, state: LearnedState, observation: Any) -> FloatArray:
        """Return the squared distances of the fault estimates from their centres, in units of their deviations,
        ``(nf,)``."""
        if self._walk is None or not isinstance(observation, Evidence):
            return np.zeros(0 if self._walk is None else len(self._walk))
        away = beyond(observation.theta - state.centres, self._bands)
        return np.asarray(away**2 / np.diag(observation.parameter_covariance))

    def _fault(self, watched: FloatArray, ratios: FloatArray) -> int | None:
        """Return the fault whose step or ramp is likeliest; if that is none of a fault, the one whose estimate is
        furthest from its centre."""
        names, count = self.learned.columns, len(self.learned.scales)
        signature = self.learned.statistics.signature_names[
            int(np.argmax(ratios)) % len(self.learned.statistics.signature_names)
        ]
        if signature.startswith("fhat["):
            return int(self._places[names.index(signature)])
        if signature in self._faults:
            return self._faults[signature]
        return (
            None if not count else int(np.argmax(np.abs(watched[:count] - self.learned.centres) / self.learned.scales))
        )

    def _predicted(self, state: LearnedState) -> FloatArray:
        """Return the prediction of the next row by the autoregression."""
        model = self._model
        rows = zip(model.A, state.past, strict=True)
        return np.asarray(model.offset + sum((a @ row for a, row in rows), np.zeros(model.channels)))

    def _completed(self, state: LearnedState, values: FloatArray, *, complete: bool) -> FloatArray | None:
        """Return the watched values of a row; missing ones take their conditional means, given the others.  The result
        is `None` if the others may not decide the row."""
        x = values[self._places]
        measured = self._residual & np.isfinite(x)
        if complete or not (self.by_sensor and measured.any()):
            return x if complete else None
        predicted, precision = self._predicted(state), self._model.whitener.T @ self._model.whitener
        away = (x - predicted)[measured]
        expected = np.linalg.solve(
            precision[np.ix_(~measured, ~measured)], -precision[np.ix_(~measured, measured)] @ away
        )
        completed = np.where(measured, x, predicted)
        completed[~measured] += expected
        return completed

    def _added(
        self, state: LearnedState, x: FloatArray | None, most: float = 0.0, evidence: FloatArray | None = None
    ) -> tuple[LearnedState, float]:
        """Return the state after a row, and the factor by which its whitened values were scaled.

        Parameters
        ----------
        state : LearnedState
            The state before.
        x : FloatArray or None
            ``(m,)``: the row, from which later ones are predicted; `None`: as predicted.
        most : float, optional
            Largest norm of the whitened values.
        evidence : FloatArray, optional
            ``(m,)``: the values that are whitened; by default the row itself.
        """
        model, predicted = self._model, self._predicted(state)
        evidence = x if evidence is None else evidence
        with np.errstate(over="ignore", invalid="ignore"):
            e = np.zeros(model.channels) if evidence is None or not most else model.whitener @ (evidence - predicted)
            size = float(np.linalg.norm(e))
            share = most / size if size > most else 1.0
            e = e * share
        slow = state.slow
        if self._has_offset and evidence is not None and most:
            e = e - slow
            # Clipped, so that a wrong sample moves the offset no more than noise does.
            slow = slow + self._share(state) * np.clip(np.nan_to_num(e), -FOLLOWED_MOST, FOLLOWED_MOST)
        shares = np.array(FORGETTING)[:, None]
        past = np.vstack([predicted if x is None else x, state.past[:-1]]) if model.order else state.past
        means = (1.0 - shares) * state.means + shares * e
        return state._replace(past=past, white=np.vstack([state.white[1:], e]), means=means, slow=slow), share

    def restart(self, state: LearnedState, skipped: int = 0) -> LearnedState:
        """Keep the state: missing rows are predicted."""
        return state

    def options(self) -> Any:
        """Return the digest of what was learned, and whether sensors are ranked."""
        return [digest_of(plain(self.learned.as_dict())), self.effects is not None]


def learned_monitor(design: ObserverDesign, learned: LearnedThresholds, *, sensor_faults: bool = True) -> Monitor:
    """Return the monitor of thresholds that were learned with a design; raise `SpecError` for another design.

    Without ``sensor_faults`` only the faults of the design are considered as causes of an alarm.
    """
    if learned.gains != gain_set_digest(design):
        raise SpecError("The thresholds were learned with another gain set: learn them again.", path="normal")
    observer, names = design.observer, watched_names(design)
    missing = [name for name in learned.columns if name not in names]
    if missing:
        raise SpecError(
            f"The thresholds are for {missing[0]!r}, which the design does not have: learn them again for this design.",
            path="normal",
        )
    if learned.outlier_sizes is not None and not has_innovations_by_sensor(observer):
        raise SpecError(
            "The thresholds hold sizes of outliers, and this design judges none of one sensor: learn them again.",
            path="normal",
        )
    residuals = (
        len(observer.residual_names) if isinstance(observer, LinearObserver) else len(innovation_names(observer))
    )
    return Monitor(
        "learned",
        learned.statement,
        LearnedRule(
            learned,
            names,
            observer.fault_names,
            by_sensor=has_innovations_by_sensor(observer),
            walk=parameter_walk(observer),
            effects=effects_of(design, learned) if sensor_faults else None,
        ),
        residuals=residuals,
        fault_names=observer.fault_names,
        fault_scales=learned.scales,
    )
