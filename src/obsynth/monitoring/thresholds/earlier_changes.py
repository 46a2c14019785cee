"""Changes that were named already: what is left of the residuals when their effects are subtracted.

While an alarm stands, and for as long as begins from before it are followed, the effect of the change that it was named
by is in the rows, and explains more of them than one that came later.  A later change is therefore judged by what it
explains beside the earlier ones, and beside a constant shift of the white rows, which is what errors of the model leave
of them: by least squares over all, with their scores s and information J, and the products c of their effects with its
own,

.. math::
    \\tilde s = s_h - c' J^{-1} s, \\qquad \\tilde J = J_h - c' J^{-1} c

whose quotient is how much twice the log likelihood gains by one more change (Willsky & Jones 1976).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from obsynth.monitoring.thresholds.alarm_ranking import NONE_OF_THESE, Ranking
from obsynth.monitoring.thresholds.hypotheses import LEAST_RATIO, ratio_scale
from obsynth.numerics.arrays import FloatArray, read_only

#: Changes in a row whose effects are subtracted; one more has no name of its own.
MOST_KEPT = 3

#: Rows of an alarm in which its likeliest begins are looked for; after that they stay, as long as it lasts, and what
#: begins later is judged beside the change that it is named by.
LOOKED_FOR = 20

#: Share of what samples say of a later change that those before leave of it at least: of less, it is one of these.
LEAST_LEFT = 0.01

_NOTHING = read_only(np.zeros(0))


class EarlierChanges(NamedTuple):
    """A shift of white rows and changes that were named, ``r = m + MOST_KEPT`` (those that are not there are zero), and
    what their effects share with those of the hypotheses ``h`` at each begin that is followed ``b``."""

    places: FloatArray = _NOTHING  # places, hypotheses: ``(MOST_KEPT,)``: begins of the changes, and what they are
    hypotheses: FloatArray = _NOTHING
    score: FloatArray = _NOTHING  # ``(r,)``
    information: FloatArray = _NOTHING  # ``(r, r)``
    shared: FloatArray = _NOTHING  # ``(b, h, r)``: products of effects on white rows
    sums: FloatArray = _NOTHING  # ``(b, m, r)``: sums of their effects
    changes: int = 0  # how many there are
    number: int = 0  # of these, and of alarms that no change explains
    since: float = 0.0  # the row in which the last of them was kept: what began later is judged beside them
    looked: int = 0  # rows in which something that began later has been the likeliest
    is_over: int = 0  # whether the alarm that the last of them raised has ended

    @classmethod
    def none(cls, begins: int, channels: int, hypotheses: int) -> EarlierChanges:
        """Return the state without any."""
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
        """The places of the begins of the changes."""
        return self.places[: self.changes].astype(np.intp)

    def with_begin(self, place: int) -> EarlierChanges:
        """Return the state in which a begin is followed in the ``place`` of another one."""
        if not self.number:
            return self
        shared, sums = self.shared.copy(), self.sums.copy()
        shared[place] = sums[place] = 0.0
        return self._replace(shared=shared, sums=sums)

    def moved(self, added: FloatArray, counted: FloatArray, white: FloatArray) -> EarlierChanges:
        """Return the state after a ``white (m,)`` row, to which hypotheses have ``added (b, m, h)``; those that are
        ``counted (b,)`` are judged by it."""
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
        """Return the state in which what begins after a ``row`` is judged beside what is there."""
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
        """Return the state with one more change, of so much score and information; with no more than `MOST_KEPT`."""
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
        """Return score and information ``(b, h)``, and sums of white rows ``(b, m)``, that are left beside them."""
        n = len(self.score) - MOST_KEPT + self.changes
        inverse = np.linalg.pinv(self.information[:n, :n], hermitian=True)
        sizes, shared = inverse @ self.score[:n], self.shared[..., :n]
        left = information - np.einsum("bhr,rs,bhs->bh", shared, inverse, shared)
        left = np.where(left > LEAST_LEFT * information, left, 0.0)
        return score - shared @ sizes, left, sums - self.sums[..., :n] @ sizes

    @property
    def ratio(self) -> float:
        """Twice the log likelihood ratio of all of them."""
        inverse = np.linalg.pinv(self.information, hermitian=True)
        return float(self.score @ inverse @ self.score)

    def distinguishes(self, later: Ranking, ratio: float, names: set[str]) -> bool:
        """Whether a ``later`` change, of so large a ``ratio`` beside these, is more than what errors of the model leave
        of their effects, and something else than they, whose ``names`` these are."""
        if names & {later.named, *later.ties} or later.named == NONE_OF_THESE:
            return False
        return ratio >= LEAST_RATIO * ratio_scale(self.ratio)
