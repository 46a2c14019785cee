"""Effects of faults and of sensors' offsets on the whitened residuals, and how well each explains the latest rows.

For a change that begins at row k0, the error d of the estimates of an extended Kalman filter and the effect g on its
innovations obey, with the filter's own steps and gains,

.. math::
    d^-_k = A_k d_{k-1}, \\qquad g_k = H_k d^-_k + s_k, \\qquad d_k = d^-_k - K_k g_k

where a jump of fault j begins with ``d = e_j``, and s is the offset of a sensor (Willsky & Jones 1976).  The learned
whitening model is applied to the residuals and to these effects alike.  The response of a linear observer is the same
for every k0.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from obsynth.methods.registry import error_model, follows_later_rows
from obsynth.monitoring.thresholds.alarm_ranking import NONE_OF_THESE, Ranking
from obsynth.monitoring.thresholds.earlier_changes import LOOKED_FOR, EarlierChanges
from obsynth.monitoring.thresholds.hypotheses import Explanation, Hypothesis, hypotheses_of, ranked
from obsynth.monitoring.thresholds.learned import LearnedThresholds
from obsynth.monitoring.thresholds.learned_levels import HOLD
from obsynth.monitoring.thresholds.parameter_scores import parameter_walk, precisions
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.numerics.autoregression import Autoregression
from obsynth.numerics.ranks import DIRECTION_SHARE
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.nonlinear.estimates import DAERow
from obsynth.observers.nonlinear.observer import DAEObserver
from obsynth.results.design import ObserverDesign

#: For how many rows the effect of a change that begins at a row is computed: the first number, doubled for each factor
#: of two in the row's number, at most the last number.  So every recent row is a candidate, and older ones are sparse.
FOLLOWED, MOST_DOUBLINGS = 8, 5

#: Number of candidate begins at any time, without those of an alarm: four for each factor of two, and a few more.
BEGINS = 4 * (MOST_DOUBLINGS + 1) + 12

#: Number of hypotheses whose likeliest begins are kept for as long as an alarm lasts.
HELD = 12

#: Rows after a begin that count: later ones depend more on errors of the model than on the change.
COUNTED = FOLLOWED * 2**MOST_DOUBLINGS

#: Most numbers that are updated in each row, which takes a hundredth of a second; larger designs have no ranking.
MOST_NUMBERS = 2_000_000


_NOTHING = read_only(np.zeros(0))


class EffectState(NamedTuple):
    """The state of `FaultEffects`, for ``b`` candidate begins."""

    begun: (
        FloatArray  # begun, until: ``(b,)``: row of each begin, NaN for none, and the row up to which it is a candidate
    )
    until: FloatArray
    error: FloatArray  # ``(b, n, h)``: effect of each hypothesis on the error of the estimates
    past: FloatArray  # ``(b, order, m, h)``: effect on the residuals of earlier rows, latest first
    score: FloatArray  # score, information: ``(b, h)``
    information: FloatArray
    sums: FloatArray  # ``(b, m)``: of whitened rows
    counts: FloatArray  # ``(b,)``: number of these rows
    held: FloatArray  # ``(b,)``: one for begins that are kept while an alarm lasts
    row: float = 0.0  # of the last sample
    alarmed: float = 0.0  # alarmed, quiet: rows in alarm, and rows since the last of them
    quiet: float = 0.0
    earlier: EarlierChanges = EarlierChanges()  # named changes, whose effects are subtracted from later rows
    shown: FloatArray = _NOTHING  # ``(b, nf, h)``: effects on the fault estimates after the last sample
    spread: FloatArray = _NOTHING  # ``(nf, nf)``: covariance of these, NaN before the first sample
    scored: FloatArray = _NOTHING  # scored, informed: ``(b, h)``: of the scores of the faults
    informed: FloatArray = _NOTHING


class Seen(NamedTuple):
    """Which residuals and estimates of a row are present, and which of these are tested, ``(m,)`` each.

    Those that are present but not tested follow from earlier rows.
    """

    there: NDArray[np.bool_]
    judged: NDArray[np.bool_]


#: The state of a rule without a ranking.
NO_EFFECTS = EffectState(
    _NOTHING, _NOTHING, _NOTHING, _NOTHING, _NOTHING, _NOTHING, _NOTHING, _NOTHING, _NOTHING
)  # fmt: skip


class FaultEffects(ABC):
    """Effects of hypotheses on the whitened residuals, row by row, and the ranking that follows from them."""

    def __init__(self, faults: Sequence[str], outputs: Sequence[str], learned: LearnedThresholds) -> None:
        self.hypotheses: tuple[Hypothesis, ...] = hypotheses_of(faults, outputs)
        self.model = learned.statistics.model
        self.walk: FloatArray | None = None

    @property
    @abstractmethod
    def sizes(self) -> tuple[int, int]:
        """Order of the error system, and number of earlier rows of residuals."""

    @property
    def numbers(self) -> int:
        """How many numbers are updated in each row."""
        per_hypothesis = self.model.channels + self.sizes[0] + self.sizes[1] * self.model.channels
        return (BEGINS + HELD) * len(self.hypotheses) * per_hypothesis

    def init(self) -> EffectState:
        """Return the state before the first sample."""
        (n, order), h, m, b = self.sizes, len(self.hypotheses), self.model.channels, BEGINS + HELD
        state = EffectState(
            np.full(b, np.nan), np.zeros(b), np.zeros((b, n, h)), np.zeros((b, order, m, h)), np.zeros((b, h)),
            np.zeros((b, h)), np.zeros((b, m)), np.zeros(b), np.zeros(b),
            earlier=EarlierChanges.none(b, m, h),
        )  # fmt: skip
        if self.walk is None:
            return state
        nf = len(self.walk)
        return state._replace(
            shown=np.zeros((b, nf, h)), spread=np.full((nf, nf), np.nan), scored=np.zeros((b, h)),
            informed=np.zeros((b, h)),
        )  # fmt: skip

    def with_scores(self, before: EffectState, state: EffectState, observation: Any, away: FloatArray) -> EffectState:
        """Return the state after the score of a sample ``away (nf,)`` from the centres of the faults; ``before``: the
        state before the sample."""
        if self.walk is None or not isinstance(observation, DAERow) or observation.k == 0:
            return state
        spread = np.asarray(observation.parameter_covariance)
        shown = self._shown(state)
        state = state._replace(shown=shown, spread=spread)
        known = precisions(before.spread, spread, self.walk, 1)
        if known is None:
            return state
        is_older = (state.begun < state.row)[:, None, None]
        earlier = np.where(is_older, before.shown, 0.0)
        with np.errstate(all="ignore"):
            information = known.added
            units = np.sqrt(np.maximum(np.diag(information), 0.0))
            if not (units > 0.0).all():
                return state
            sizes, vectors = np.linalg.eigh(information / np.outer(units, units))
            weights = np.where(sizes > DIRECTION_SHARE * sizes[-1], 1.0 / sizes, 0.0)
            inverse = (vectors * weights) @ vectors.T / np.outer(units, units)
            effects = known.after @ shown - known.before @ earlier
            rows = state.row - state.begun + 1.0
            counted = (np.isfinite(state.begun) & (rows <= COUNTED))[:, None]
            scored = state.scored + counted * np.einsum("bfh,f->bh", effects, inverse @ away)
            informed = state.informed + counted * np.einsum("bfh,fg,bgh->bh", effects, inverse, effects)
        if not (np.isfinite(scored).all() and np.isfinite(informed).all()):
            return state
        return state._replace(scored=scored, informed=informed)

    def _shown(self, state: EffectState) -> FloatArray:
        """Return the effects on the fault estimates after a sample; of filters whose faults walk."""
        raise NotImplementedError

    def ranked_by_scores(self, state: EffectState) -> Ranking | None:
        """Return the ranking by the scores of the faults, where no residual shows a change."""
        if self.walk is None:
            return None
        nothing = np.zeros((len(state.scored), 1))
        explanation, _ = _explanation(state.scored, state.informed, nothing, nothing[:, 0])
        return ranked(self.hypotheses, explanation._replace(shift=float(explanation.ratios.max())))

    def step(
        self, state: EffectState, observation: Any, white: FloatArray, seen: Seen | None, share: float
    ) -> EffectState:
        """Return the state after a sample.

        ``observation``: what the observer says of it; ``white (m,)``: its whitened residuals; ``seen``: which of them
        are measured, `None` for none; ``share``: the factor by which they were limited, which applies to effects too.
        """
        if isinstance(observation, DAERow) and observation.k == 0:
            return self.init()
        state = self._with_begin(self._ended(state) if state.quiet == HOLD else state)
        followed = np.isfinite(state.begun)
        rows = np.where(followed, state.row - state.begun + 1.0, 0.0)
        with np.errstate(all="ignore"):
            error, past, added = self._moved(state, observation, rows, seen)
            error = error * followed[:, None, None]
            score, information, sums, count = state.score, state.information, state.sums, state.counts
            earlier = state.earlier
            if share > 0.0 and seen is not None:
                added = share * added
                counted = followed & (rows <= COUNTED)
                earlier = earlier.moved(added, counted, white)
                added = added * counted[:, None, None]
                score = score + np.einsum("bmh,m->bh", added, white)
                information = information + np.einsum("bmh,bmh->bh", added, added)
                sums, count = sums + counted[:, None] * white, count + counted
        after = state._replace(
            error=error, past=past, score=score, information=information, sums=sums, counts=count, earlier=earlier
        )
        finite = all(np.isfinite(part).all() for part in (*after[2:8], *earlier[2:6]))
        return after if finite else self.init()

    @abstractmethod
    def _moved(
        self, state: EffectState, observation: Any, rows: FloatArray, seen: Seen | None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return ``error`` and ``past`` after a sample, and the effects on its whitened residuals ``(b, m, h)``.

        ``rows (b,)``: number of rows since each begin.
        """

    @abstractmethod
    def _at_begin(self, error: FloatArray) -> None:
        """Write the errors ``(n, h)`` at the begin of each hypothesis."""

    def _ended(self, state: EffectState) -> EffectState:
        """Return the state after the end of a short alarm: the change that it was named by now counts as earlier."""
        earlier = state.earlier
        if not earlier.number and state.alarmed > 0.0:
            _, ranking, best = self._beside_none(state._replace(alarmed=float(LOOKED_FOR)))
            return self._keeping(state, ranking, best)
        if earlier.looked:
            looked = earlier._replace(looked=LOOKED_FOR)
            return self._beside_earlier(state._replace(earlier=looked), None)[0]
        return state

    def _with_begin(self, state: EffectState) -> EffectState:
        """Return the state with a new candidate begin in the place of one that has expired."""
        row, quiet = state.row + 1.0, state.quiet + 1.0
        begun = np.where((row < state.until) | (state.held > 0.0), state.begun, np.nan)
        place, until = int(np.isnan(begun).argmax()), state.until.copy()
        error, past, score, information, sums, counts, held = map(np.array, state[2:9])
        for part in (error, past, score, information, sums, counts, held):
            part[place] = 0.0
        self._at_begin(error[place])
        of_scores = [np.array(part) for part in (state.shown, state.scored, state.informed)]
        for part in of_scores if self.walk is not None else ():
            part[place] = 0.0
        earlier = state.earlier
        if quiet > HOLD:
            held[:] = 0.0
            earlier = earlier._replace(looked=0, is_over=1)
            # Begins before the named changes are no longer candidates.
            if row - earlier.since > COUNTED:
                earlier = earlier._replace(changes=0, number=0)
            held[earlier.begins] = 1.0
        begun[place], until[place] = row, row + FOLLOWED * 2.0 ** _doublings(int(row))
        alarmed = state.alarmed if quiet <= HOLD else 0.0
        return EffectState(
            begun, until, error, past, score, information, sums, counts, held, row, alarmed, quiet,
            earlier.with_begin(place), of_scores[0], state.spread, *of_scores[1:],
        )  # fmt: skip

    def explained(self, state: EffectState) -> tuple[EffectState, Ranking | None]:
        """Return the ranking of the rows up to one in alarm, and the state that keeps the likeliest begins.

        Where there is a change later than those already named, it is the one that is ranked.
        """
        state, ranking, best = self._beside_none(state)
        if state.earlier.number:
            return self._beside_earlier(state, ranking)
        if state.alarmed >= LOOKED_FOR:
            state = self._keeping(state, ranking, best)
        return state, ranking

    def _beside_none(self, state: EffectState) -> tuple[EffectState, Ranking | None, NDArray[np.intp]]:
        """Return the state, the ranking under the assumption of a single change, and its begins ``(h,)``."""
        parts, is_held = (state.score, state.information, state.sums, state.counts), state.held > 0.0
        if state.alarmed >= LOOKED_FOR and is_held.any():
            explanation, best = _explanation(*(part[is_held] for part in parts))
            best = np.flatnonzero(is_held)[best]
            return state._replace(quiet=0.0), ranked(self.hypotheses, explanation), best
        explanation, best = _explanation(*parts)
        held = np.zeros_like(state.held)
        held[state.earlier.begins] = 1.0
        held[best[np.argsort(-explanation.ratios)[: HELD - state.earlier.changes]]] = 1.0
        state = state._replace(held=held, alarmed=state.alarmed + 1.0, quiet=0.0)
        return state, ranked(self.hypotheses, explanation), best

    def _beside_earlier(self, state: EffectState, alone: Ranking | None) -> tuple[EffectState, Ranking | None]:
        """Return the state and the ranking of a change after the named ones; ``alone`` where there is no other
        cause."""
        earlier, later = state.earlier, state.begun > state.earlier.since
        # A new alarm is separate from earlier ones even if its cause has the same name.
        alone = alone._replace(earlier=earlier.number) if alone is not None and earlier.is_over else alone
        if not later.any():
            return state, alone
        parts = *earlier.beside(state.score, state.information, state.sums), state.counts
        explanation, best = _explanation(*(part[later] for part in parts))
        ranking, ratio = ranked(self.hypotheses, explanation), float(explanation.ratios.max())
        names = {self.hypotheses[int(i)].name for i in earlier.hypotheses[: earlier.changes]}
        if ranking is None or not earlier.distinguishes(ranking, ratio, names):
            return state, alone
        ranking = ranking._replace(earlier=earlier.number, ratio=ratio)
        state = state._replace(earlier=earlier._replace(looked=earlier.looked + 1))
        best = np.flatnonzero(later)[best]
        # Begins for the new search replace kept ones of hypotheses that no alarm is named by.
        held = np.zeros_like(state.held)
        held[earlier.begins] = 1.0
        held[best[np.argsort(-explanation.ratios)[: HELD - earlier.changes]]] = 1.0
        state = state._replace(held=held)
        if state.earlier.looked >= LOOKED_FOR:
            state = self._keeping(state, ranking, best)
        return state, ranking

    def _keeping(self, state: EffectState, ranking: Ranking | None, best: NDArray[np.intp]) -> EffectState:
        """Return the state in which the effect of the named change, with the begins ``best (h,)``, is subtracted from
        later rows."""
        if ranking is None:
            return state
        earlier = state.earlier.kept(state.row)
        if ranking.named == NONE_OF_THESE:
            return state._replace(earlier=earlier)
        number = next(
            i
            for i, hypothesis in enumerate(self.hypotheses)
            if hypothesis.name == ranking.named and hypothesis.is_drift == ranking.drifts
        )
        place, held = int(best[number]), state.held.copy()
        held[place] = 1.0
        score, information = float(state.score[place, number]), float(state.information[place, number])
        return state._replace(earlier=earlier.with_change(place, number, score, information), held=held)


class FilterEffects(FaultEffects):
    """Effects on an extended Kalman filter of states and parameters."""

    def __init__(self, observer: DAEObserver, learned: LearnedThresholds) -> None:
        faults, outputs = observer.fault_names, observer.plant.output_names
        super().__init__(faults, outputs, learned)
        self.R, self.walk = observer.R, parameter_walk(observer)
        self._shapes = len(observer.state_names), len(faults), len(outputs)
        rows = [f"fhat[{name}]" for name in faults] + [f"r[{name}]" for name in outputs]
        self._places = np.array([rows.index(name) for name in learned.columns])

    @property
    def sizes(self) -> tuple[int, int]:
        """Order of the error system, and number of earlier rows of residuals."""
        return self._shapes[0] + self._shapes[1], self.model.order

    def _at_begin(self, error: FloatArray) -> None:
        nx, nq, _ = self._shapes
        error[nx + np.arange(nq), np.arange(nq)] = 1.0

    def _moved(
        self, state: EffectState, observation: Any, rows: FloatArray, seen: Seen | None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        if not isinstance(observation, DAERow):
            return state.error, state.past, np.zeros((len(rows), self.model.channels, len(self.hypotheses)))
        nx, nq, ny = self._shapes
        moved, sensors, outputs = np.arange(nq), 2 * nq + np.arange(ny), np.arange(ny)
        error = state.error.copy()
        error[:, nx + moved, nq + moved] += 1.0
        step = np.eye(nx + nq)
        step[:nx, :nx], step[:nx, nx:] = observation.part("F"), observation.part("G")
        error = step @ error
        reading = np.hstack([observation.part("H"), observation.part("L")])
        effect = reading @ error
        effect[:, outputs, sensors] += 1.0
        effect[:, outputs, sensors + ny] += rows[:, None]
        effect[:, ~observation.measured] = 0.0
        error = error - _gain(observation, reading, self.R) @ effect
        estimates = self._estimates(error, rows)
        effects = np.concatenate([estimates, effect], axis=1)[:, self._places]
        return error, *_whitened(self.model, state.past, effects, seen)

    def _estimates(self, error: FloatArray, rows: FloatArray) -> FloatArray:
        """Return the effects on the fault estimates ``(b, nf, h)``."""
        nx, nq, _ = self._shapes
        moved = np.arange(nq)
        estimates = -error[:, nx:]
        estimates[:, moved, moved] += 1.0
        estimates[:, moved, nq + moved] += rows[:, None]
        return np.asarray(estimates)

    def _shown(self, state: EffectState) -> FloatArray:
        rows = np.where(np.isfinite(state.begun), state.row - state.begun + 1.0, 0.0)
        return self._estimates(state.error, rows)


class LinearEffects(FaultEffects):
    """Effects on a linear observer, whose response does not depend on the row in which a change begins."""

    def __init__(self, design: ObserverDesign, learned: LearnedThresholds) -> None:
        self._errors, self._learned = error_model(design), learned
        super().__init__(self._errors.plant.fault_names, self._errors.observer.output_names, learned)

    @property
    def sizes(self) -> tuple[int, int]:
        """Order of the error system, and number of earlier rows of residuals, which is zero."""
        return 0, 0

    def _at_begin(self, error: FloatArray) -> None:
        pass

    def _moved(
        self, state: EffectState, observation: Any, rows: FloatArray, seen: Seen | None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        places = np.clip(rows.astype(np.int64) - 1, 0, COUNTED - 1)
        # After the computed rows the response to a jump is constant, and that to a drift is linear.
        slope = self.responses[-1] - self.responses[-2]
        return state.error, state.past, self.responses[places] + np.maximum(rows - COUNTED, 0.0)[:, None, None] * slope

    @cached_property
    def responses(self) -> FloatArray:
        """Responses of the whitened rows to each hypothesis from its begin on, ``(rows, m, h)``."""
        errors, states = self._errors, len(self._errors.observer.state_names)
        observer = errors.observer
        places = [observer.row_names.index(name) for name in self._learned.columns]
        c, direct, *_ = errors.output(slice(states, None))
        rows = [place - states for place in places]
        systems = ((errors.fault, -c[rows], direct[rows]), (observer.By, observer.Cz[places], observer.Dy[places]))
        parts = []
        for driven, read, through in systems:
            transition, inputs = _sampled(observer.Az, driven, observer.dt, self._learned.dt)
            z, steps = np.zeros_like(inputs), np.zeros((COUNTED, *through.shape))
            for k in range(len(steps)):
                steps[k] = read @ z + through
                z = transition @ z + inputs
            parts += [steps, np.cumsum(steps, axis=0)]
        responses, whole = np.concatenate(parts, axis=2), Seen(*(np.ones(len(places), dtype=bool),) * 2)
        past, white = np.zeros((1, self.model.order, *responses.shape[1:])), []
        for row in responses:
            past, added = _whitened(self.model, past, row[None], whole)
            white.append(added[0])
        return np.array(white)


def effects_of(design: ObserverDesign, learned: LearnedThresholds) -> FaultEffects | None:
    """Return the effects of a design's faults and sensors on the watched columns; `None` where they are not known."""
    observer = design.observer
    effects: FaultEffects | None = None
    if isinstance(observer, DAEObserver) and observer.form == "augmented-kalman":
        effects = None if parameter_walk(observer) is None else FilterEffects(observer, learned)
    elif isinstance(observer, LinearObserver) and not follows_later_rows(design):
        effects = LinearEffects(design, learned)
    return None if effects is None or effects.numbers > MOST_NUMBERS else effects


def _doublings(row: int) -> int:
    """Return how often the row of a begin is divisible by two, at most `MOST_DOUBLINGS`."""
    return min((row & -row).bit_length() - 1, MOST_DOUBLINGS)


def _gain(observation: DAERow, reading: FloatArray, R: FloatArray) -> FloatArray:
    """Return the gain ``(n, ny)`` of a sample on states and parameters, by the covariance after it: ``P H' R^-1``."""
    nx, joint_covariance = len(observation.x), np.empty((reading.shape[1], reading.shape[1]))
    joint_covariance[:nx, :nx], joint_covariance[nx:, nx:] = observation.covariance, observation.parameter_covariance
    joint_covariance[:nx, nx:] = observation.cross_covariance
    joint_covariance[nx:, :nx] = joint_covariance[:nx, nx:].T
    measured, gain = observation.measured, np.zeros((len(joint_covariance), len(reading)))
    gain[:, measured] = np.linalg.solve(R[measured][:, measured], reading[measured] @ joint_covariance).T
    return gain


def _whitened(
    model: Autoregression, past: FloatArray, row: FloatArray, seen: Seen | None
) -> tuple[FloatArray, FloatArray]:
    """Return the effects on the latest residuals ``(b, order, m, h)`` and on the whitened row ``(b, m, h)``.

    Missing residuals have their conditional mean given the others; without any others, their prediction, and the row
    adds no evidence.
    """
    predicted = np.einsum("jac,bjch->bah", model.A, past) if model.order else np.zeros_like(row)
    judged = predicted if seen is None else _completed(model, predicted, row, seen.judged)
    kept = judged if seen is None else np.where(seen.there[:, None], row, judged)
    past_after = np.concatenate([kept[:, None], past[:, :-1]], axis=1) if model.order else past
    return past_after, np.asarray(model.whitener @ (judged - predicted))


def _completed(model: Autoregression, predicted: FloatArray, row: FloatArray, judged: NDArray[np.bool_]) -> FloatArray:
    """Return the effects on a row ``(b, m, h)``; entries that are not ``judged (m,)`` have their conditional mean."""
    if judged.all():
        return row
    precision = model.whitener.T @ model.whitener
    regression = np.linalg.solve(precision[np.ix_(~judged, ~judged)], -precision[np.ix_(~judged, judged)])
    completed = np.where(judged[:, None], row, predicted)
    completed[:, ~judged] += regression @ (row - predicted)[:, judged]
    return completed


def _sampled(a: FloatArray, b: FloatArray, dt: float, rows: float) -> tuple[FloatArray, FloatArray]:
    """Return the transition and input matrices between two rows, for a continuous observer over their interval."""
    if dt > 0.0:
        return a, b
    n = len(a)
    generator = np.zeros((n + b.shape[1], n + b.shape[1]))
    generator[:n, :n], generator[:n, n:] = a * rows, b * rows
    exponential = expm(generator)
    return np.asarray(exponential[:n, :n]), np.asarray(exponential[:n, n:])


def _explanation(
    score: FloatArray, information: FloatArray, sums: FloatArray, counts: FloatArray
) -> tuple[Explanation, NDArray[np.intp]]:
    """Return the explanation of each hypothesis at its likeliest begin, and the place of that begin ``(h,)``.

    ``score`` and ``information (b, h)``: of each begin and hypothesis; ``sums (b, m)``: of whitened rows, ``counts``
    of them.
    """
    is_informed = information > 0.0
    safe = np.where(is_informed, information, 1.0)
    ratios = np.where(is_informed, score**2 / safe, 0.0)
    best, hypotheses = ratios.argmax(axis=0), np.arange(ratios.shape[1])
    shifts = np.where(counts > 0.0, np.sum(sums**2, axis=1) / np.maximum(counts, 1.0), 0.0)
    explanation = Explanation(
        ratios[best, hypotheses],
        (score / safe)[best, hypotheses],
        1.0 / np.sqrt(safe[best, hypotheses]),
        float(shifts.max(initial=0.0)),
    )
    return explanation, best
