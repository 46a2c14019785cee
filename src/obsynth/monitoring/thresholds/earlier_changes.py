"""Earlier changes: tests for a later change after the effects of changes that were already named are subtracted.

During an alarm, and as long as earlier beginnings are followed, the rows contain the effect of the change that the
alarm is named by.  That change explains more of them than a later one.  A later change is therefore tested after least
squares over the earlier changes and a constant shift of the whitened rows, which stands for errors of the model.  With
their scores s and information J, and the inner products c of their effects with that of the hypothesis h, its score and
information become

.. math::
    \\tilde s = s_h - c' J^{-1} s, \\qquad \\tilde J = J_h - c' J^{-1} c

The increase of twice the log likelihood by the later change is ``s^2 / J`` of these (Willsky & Jones 1976).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from obsynth.monitoring.thresholds.alarm_ranking import NONE_OF_THESE, Ranking
from obsynth.monitoring.thresholds.hypotheses import LEAST_RATIO, ratio_scale
from obsynth.numerics.arrays import FloatArray, read_only

#: Largest number of successive changes whose effects are subtracted; a further change gets no name.
MOST_KEPT = 3

#: Number of rows of an alarm in which its likeliest beginnings are searched.  These are then kept as long as the alarm
#: lasts, and later beginnings are tested after subtraction of the named change.
LOOKED_FOR = 20

#: If less than this share of the information on a later change is left after subtraction of the earlier ones, it is not
#: distinguished from these.
LEAST_LEFT = 0.01

_NOTHING = read_only(np.zeros(0))


class EarlierChanges(NamedTuple):
    """A shift of the ``m`` whitened columns and the named changes, ``r = m + MOST_KEPT`` regressors in all.

    Unused regressors are zero.  ``b`` is the number of followed beginnings, and ``h`` that of hypotheses.
    """

    places: FloatArray = _NOTHING  # ``(MOST_KEPT,)``: numbers of the beginnings of the changes
    hypotheses: FloatArray = _NOTHING  # ``(MOST_KEPT,)``: numbers of their hypotheses
    score: FloatArray = _NOTHING  # ``(r,)``
    information: FloatArray = _NOTHING  # ``(r, r)``
    shared: FloatArray = _NOTHING  # ``(b, h, r)``: inner products of effects of hypotheses with the regressors
    sums: FloatArray = _NOTHING  # ``(b, m, r)``: sums of the regressors over the rows of each beginning
    changes: int = 0  # number of named changes
    number: int = 0  # number of these and of alarms that no change explains
    since: float = 0.0  # row of the last one; later beginnings are tested after subtraction
    looked: int = 0  # number of rows in which a later beginning was the likeliest
    is_over: int = 0  # whether the alarm of the last change has ended

    @classmethod
    def none(cls, begins: int, channels: int, hypotheses: int) -> EarlierChanges:
        """Return the state without earlier changes."""
        r = channels + MOST_KEPT
        return cls(
            np.zeros(MOST_KEPT),
            np.zeros(MOST_KEPT),
            np.zeros(r),
            np.zeros((r, r)),
            np.zeros((begins, hypotheses, r)),
            np.zeros((begins, channels, r)),
        )

    @property
    def begins(self) -> NDArray[np.intp]:
        """The numbers of the beginnings of the changes."""
        return self.places[: self.changes].astype(np.intp)

    def with_begin(self, place: int) -> EarlierChanges:
        """Return the state in which a new beginning replaces the one with the number ``place``."""
        if not self.number:
            return self
        shared, sums = self.shared.copy(), self.sums.copy()
        shared[place] = sums[place] = 0.0
        return self._replace(shared=shared, sums=sums)

    def moved(self, added: FloatArray, counted: FloatArray, white: FloatArray) -> EarlierChanges:
        """Return the state after a ``white (m,)`` row, on which hypotheses have the effects ``added (b, m, h)``.

        ``counted (b,)``: the beginnings that are tested with this row.
        """
        if not self.number:
            return self
        m = len(white)
        own = np.zeros((m, m + MOST_KEPT))
        own[:, :m] = np.eye(m)
        own[:, m : m + self.changes] = added[self.begins, :, self.hypotheses[: self.changes].astype(np.intp)].T
        of_begins = added * counted[:, None, None]
        return self._replace(
            score=self.score + own.T @ white,
            information=self.information + own.T @ own,
            shared=self.shared + np.einsum("bmh,mr->bhr", of_begins, own),
            sums=self.sums + counted[:, None, None] * own,
        )

    def kept(self, row: float) -> EarlierChanges:
        """Return the state in which changes that begin after a ``row`` are tested after subtraction."""
        before = (self.score, self.information, self.shared, self.sums)
        score, information, shared, sums = before if self.number else (np.zeros_like(part) for part in before)
        return self._replace(
            score=score,
            information=information,
            shared=shared,
            sums=sums,
            number=self.number + 1,
            since=row,
            looked=0,
            is_over=0,
        )

    def with_change(self, place: int, hypothesis: int, score: float, information: float) -> EarlierChanges:
        """Return the state with one more change and its score and information; unchanged if there are `MOST_KEPT`."""
        n = self.changes
        if n == MOST_KEPT:
            return self
        places, hypotheses, scores, informations = map(
            np.array, (self.places, self.hypotheses, self.score, self.information)
        )
        last = len(scores) - MOST_KEPT + n
        places[n], hypotheses[n], scores[last] = place, hypothesis, score
        informations[last, :last] = informations[:last, last] = self.shared[place, hypothesis, :last]
        informations[last, last] = information
        return self._replace(
            places=places, hypotheses=hypotheses, score=scores, information=informations, changes=n + 1
        )

    def beside(
        self, score: FloatArray, information: FloatArray, sums: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return score and information ``(b, h)``, and sums of whitened rows ``(b, m)``, after subtraction."""
        n = len(self.score) - MOST_KEPT + self.changes
        inverse = np.linalg.pinv(self.information[:n, :n], hermitian=True)
        sizes, shared = inverse @ self.score[:n], self.shared[..., :n]
        left = information - np.einsum("bhr,rs,bhs->bh", shared, inverse, shared)
        left = np.where(left > LEAST_LEFT * information, left, 0.0)
        return score - shared @ sizes, left, sums - self.sums[..., :n] @ sizes

    @property
    def ratio(self) -> float:
        """Twice the log likelihood ratio of all earlier changes together."""
        inverse = np.linalg.pinv(self.information, hermitian=True)
        return float(self.score @ inverse @ self.score)

    def distinguishes(self, later: Ranking, ratio: float, names: set[str]) -> bool:
        """Whether a ``later`` change is significant, and another one than the earlier ones with these ``names``.

        Its ``ratio`` after subtraction must exceed what errors of the model leave of the earlier effects.  During the
        alarm of these, a change of the same name is such an error; afterwards the same fault may come again.
        """
        if later.named == NONE_OF_THESE or (not self.is_over and names & {later.named, *later.ties}):
            return False
        return ratio >= LEAST_RATIO * ratio_scale(self.ratio)
