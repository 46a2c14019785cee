"""Claims for slowly changing parameters in proof files: the inequalities of ``SlowCourses`` and ``SlowFlow`` of
``checker/check_proof.py``, and what shows them, in exact numbers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from obsynth.exporting.exact_error_system import ExactErrorSystem, exact
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.proofs.rated_inequalities import PIECES
from obsynth.proofs.witnesses import Dyadic, blocks, definite_witness, inverse, number_data, rounded

#: Weights of the second vertex, now and at the next sample, at the corners of what a step reaches: each is a whole
#: number and a multiple of the step.
CORNERS = (
    *(((0, 0), (0, 0)), ((0, 0), (0, 1)), ((1, -1), (1, 0))),
    *(((1, 0), (1, 0)), ((1, 0), (1, -1)), ((0, 1), (0, 0))),
)
#: The bound of a trace is above it by this share, and has so many bits.
TRACE_ROOM, TRACE_BITS = 2.0**-40, 160

Weight = tuple[int, int]


@dataclass(frozen=True, eq=False)
class SlowCourses:
    """Two vertices of a sampled plant, with a Lyapunov matrix each and one slack.

    Parameters
    ----------
    systems : sequence of ExactErrorSystem
        At both vertices.
    P : sequence of Dyadic
        At both vertices.
    slack : Dyadic
        For all weights.
    step : float
        By how much the weight of the second changes in a sample.
    """

    systems: Sequence[ExactErrorSystem]
    P: Sequence[Dyadic]
    slack: Dyadic
    step: float

    @classmethod
    def of(
        cls,
        systems: Sequence[ExactErrorSystem],
        plant: PolytopicSystem,
        matrices: Mapping[str, FloatArray],
        names: tuple[str, str],
    ) -> SlowCourses | None:
        """Return those of a certificate, by the names of its matrices; ``None`` where it has none."""
        P, G = (matrices.get(name) for name in names)
        step = plant.scheduling.step_of(plant.dt) if plant.is_discrete else None
        order = systems[0].observer.order
        if P is None or G is None or step is None or P.shape != (2, order, order) or G.shape != (1, order, order):
            return None
        return cls(systems, [exact(0.5 * (each + each.T)) for each in P], exact(G[0]), min(step, 1.0))

    def decay(self, rate: float) -> dict[str, Any] | None:
        """Return that errors decay at a rate."""
        decreases = self._decreases(rate, None)
        stated = None if decreases is None else self._stated
        return None if stated is None else {"rate": number_data(rate), **stated, "decreases": decreases}

    def gain(self, gamma: float, signal: str, rows: Sequence[int]) -> dict[str, Any] | None:
        """Return that the gain from a signal to the errors of some rows is below gamma."""
        c = -self.systems[0].cz.rows_at(rows)

        def form(now: Weight, p: Dyadic, lower: Dyadic) -> Dyadic:
            moved, (driven, whole) = self._moved(now), self._driven(signal, now)
            d = whole.rows_at(rows)
            across = -(c.T @ d)
            level = Dyadic.identity(d.shape[1]).scaled(gamma).scaled(gamma) - d.T @ d
            return blocks([[p - c.T @ c, across, moved.T], [across.T, level, driven.T], [moved, driven, lower]])

        proved = self._at_corners(form)
        stated = None if proved is None else self._stated
        return None if stated is None else {"gamma": number_data(gamma), **stated, "bounded_real": proved}

    def mean_square(self, rows: Sequence[int]) -> tuple[dict[str, Any], list[Dyadic]] | None:
        """Return that the errors of some rows under white noise have a mean square of at most the trace of one of some
        matrices, and what the noise adds at once."""
        decreases, stated = self._decreases(1.0, self.systems[0].cz.rows_at(rows)), self._stated
        traces, bounds = [], []
        for now, then in CORNERS:
            driven, _ = self._driven("noise", now)
            lower = self.slack + self.slack.T - self._between(self.P, then)
            bound = _above(driven, lower)
            covers = None if bound is None else definite_witness(blocks([[bound, driven.T], [driven, lower]]))
            if bound is None or covers is None:
                return None
            bounds.append(bound)
            traces.append({"W": bound.data(), "covers": covers})
        if decreases is None or stated is None:
            return None
        return {**stated, "decreases": decreases, "traces": traces}, bounds

    @cached_property
    def _stated(self) -> dict[str, Any] | None:
        positive = [definite_witness(P) for P in self.P]
        if None in positive:
            return None
        return {
            "P": [P.data() for P in self.P],
            "P_positive": positive,
            "slack": self.slack.data(),
            "step": number_data(self.step),
        }

    def _decreases(self, rate: float, c: Dyadic | None) -> list[dict[str, Any]] | None:
        def form(now: Weight, p: Dyadic, lower: Dyadic) -> Dyadic:
            first, moved = p.scaled(rate).scaled(rate), self._moved(now)
            return blocks([[first if c is None else first - c.T @ c, moved.T], [moved, lower]])

        return self._at_corners(form)

    def _at_corners(self, form: Callable[[Weight, Dyadic, Dyadic], Dyadic]) -> list[dict[str, Any]] | None:
        witnesses = []
        for now, then in CORNERS:
            p, after = self._between(self.P, now), self._between(self.P, then)
            if (witness := definite_witness(form(now, p, self.slack + self.slack.T - after))) is None:
                return None
            witnesses.append(witness)
        return witnesses

    def _between(self, pair: Sequence[Dyadic], weight: Weight) -> Dyadic:
        apart = pair[1] - pair[0]
        return pair[0] + apart.scaled(weight[0]) + apart.scaled(self.step).scaled(weight[1])

    def _moved(self, now: Weight) -> Dyadic:
        return self.slack.T @ self._between([system.az for system in self.systems], now)

    def _driven(self, signal: str, now: Weight) -> tuple[Dyadic, Dyadic]:
        (b, d), (other, _) = (system.driven(signal) for system in self.systems)
        return self.slack.T @ self._between([b, other], now), d


def _above(driven: Dyadic, lower: Dyadic) -> Dyadic | None:
    """Return W a little above ``B' (S + S' - P)^-1 B``, for B that is multiplied by the slack."""
    inverted = inverse(lower)
    if inverted is None:
        return None
    product = driven.T @ inverted @ driven
    size = product.shape[0]
    largest = max((float(product.fraction(i, i)) for i in range(size)), default=0.0)
    room = Dyadic.identity(size).scaled(TRACE_ROOM).scaled(largest if largest > 0.0 else 1.0)
    return rounded((product + room).balls(), TRACE_BITS, symmetric=True)


@dataclass(frozen=True, eq=False)
class SlowFlow:
    """Two vertices of a plant in continuous time, with a Lyapunov matrix that is a polynomial of the weight.

    Parameters
    ----------
    systems : sequence of ExactErrorSystem
        At both vertices.
    P : sequence of Dyadic
        Coefficients in Bernstein's form.
    rate : float
        By how much the weight of the second changes in a second.
    """

    systems: Sequence[ExactErrorSystem]
    P: Sequence[Dyadic]
    rate: float

    @classmethod
    def of(
        cls, systems: Sequence[ExactErrorSystem], plant: PolytopicSystem, matrices: Mapping[str, FloatArray], name: str
    ) -> SlowFlow | None:
        """Return those of a certificate, by the name of its matrix; ``None`` where it has none."""
        P = matrices.get(name)
        rate = None if plant.is_discrete else plant.scheduling.rate_of_weight
        order = systems[0].observer.order
        if P is None or rate is None or P.ndim != 3 or len(P) < 2 or P.shape[1:] != (order, order):
            return None
        return cls(systems, [exact(0.5 * (each + each.T)) for each in P], rate)

    def gain(self, gamma: float, signal: str, rows: Sequence[int]) -> dict[str, Any] | None:
        """Return that the gain from a signal to the errors of some rows is below gamma, on the fewest pieces."""
        signs = [self._coefficients(gamma, signal, rows, sign) for sign in (1, -1)]
        for pieces in PIECES:
            positive, *proved = (_on_pieces(each, pieces) for each in (self.P, *signs))
            if positive is not None and None not in proved:
                return {
                    "gamma": number_data(gamma),
                    "P": [P.data() for P in self.P],
                    "P_positive": positive,
                    "pieces": pieces,
                    "rate_of_weight": number_data(self.rate),
                    "bounded_real": proved,
                }
        return None

    def _coefficients(self, gamma: float, signal: str, rows: Sequence[int], sign: int) -> list[Dyadic]:
        degree, slopes = len(self.P), self._slopes()

        def at(vertex: int, k: int) -> Dyadic:
            system, p = self.systems[vertex], self.P[k]
            b, d = system.driven(signal)
            form = system.bounded_real_form(gamma, p, p, system.az, b, -system.cz.rows_at(rows), d.rows_at(rows))
            n, count = p.shape[0], b.shape[1]
            moved = slopes[k].scaled(self.rate).scaled(sign)
            beside, below = exact(np.zeros((n, count))), exact(np.zeros((count, count)))
            return form - blocks([[moved, beside], [beside.T, below]])

        coefficients = []
        for k in range(degree + 1):
            parts = [at(0, k).scaled(degree - k)] if k < degree else []
            parts += [at(1, k - 1).scaled(k)] if k else []
            coefficients.append(parts[0] if len(parts) == 1 else parts[0] + parts[1])
        return coefficients

    def _slopes(self) -> list[Dyadic]:
        """Return the coefficients of the derivative of P, of the degree of P."""
        last, found = len(self.P) - 1, []
        for k, p in enumerate(self.P):
            slope = p.scaled(0.0)
            if k > 0:
                slope = slope + (p - self.P[k - 1]).scaled(k)
            if k < last:
                slope = slope + (self.P[k + 1] - p).scaled(last - k)
            found.append(slope)
        return found


def _on_pieces(coefficients: Sequence[Dyadic], pieces: int) -> list[dict[str, Any]] | None:
    """Return what shows a polynomial to be positive definite, by its coefficients on equal pieces of [0, 1]."""
    if pieces == 1:
        witnesses: list[dict[str, Any]] = []
        for coefficient in coefficients:
            if (witness := definite_witness(coefficient)) is None:
                return None
            witnesses.append(witness)
        return witnesses
    low, high, row = list[Dyadic](), list[Dyadic](), list(coefficients)
    while row:
        low.append(row[0])
        high.insert(0, row[-1])
        row = [(one + two).scaled(0.5) for one, two in pairwise(row)]
    first = _on_pieces(low, pieces // 2)
    second = None if first is None else _on_pieces(high, pieces // 2)
    return None if first is None or second is None else first + second
