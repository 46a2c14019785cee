r"""Existence conditions of a fault-estimation filter over the region of a polytopic plant, with exact decoupling.

Wang et al. 2015 at a plant of which A, B, Bd change, with a constant ``T E + N C = I``: if the faults keep their
directions, ``Bf(mu) = Bf0 Delta(mu)`` with Delta nonsingular on the hull, and reach the outputs after one sample
(``Upsilon = C T Bf0`` of full column rank), then ``L(mu) = T A(mu) Psi Upsilon^+ + R(mu) U2'``, ``Psi = T Bf0``, makes
``(T A - L C) Psi = 0`` at every point, and what is left is a problem at the vertices.  *Proof:*
``Psi Delta (Upsilon Delta)^+ = Psi Upsilon^+``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from obsynth.analysis.existence.condition import Condition
from obsynth.analysis.existence.effectiveness import effectiveness_condition, inverse_bound
from obsynth.analysis.existence.restricted_equivalent import prepare, with_sensor_faults_as_states
from obsynth.analysis.existence.turning_filter import TurningFilter, has_turning_form, turning_conditions
from obsynth.analysis.existence.wang2015 import fault_filter_conditions
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import decide_rank
from obsynth.numerics.scaling import Scaling
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.polytopic import SCHEDULED_MATRICES, PolytopicSystem

#: Roundings of an entry by a least-squares solution, beside the largest entry, for each row.
LEAST_SQUARES_ROUNDINGS = 16.0
#: Points where an entry vanishes that are looked at: each costs as much as a vertex.
MOST_VANISHING = 16
#: Vertices up to which a point without a fault's effect is sought: beyond, the matrix of weights is large.
MOST_HULL_VERTICES = 512
#: A line through the hull: the words of a point on it, and the weights of its ends.
Line = tuple[Callable[[float], str], FloatArray, FloatArray]
_SOURCE = "over the region: Wang 2015 with constant T, N"
#: exp(dt A(mu)) has no vertices: what helps a filter of samples where the plant is continuous.
_CONTINUOUS = (
    "a continuous plant, whose samples over a region have no vertices. Take ui-pi-observer, which takes it as it is, "
    "and steps from row to row by implicit Euler."
)
#: Matrices that a scheduled gain needs to be the same at all vertices.
CONSTANT_MATRICES = ("C", "D", "Df", "Dd", "Dw")


@dataclass(frozen=True, eq=False)
class FilterOverRegion:
    """The parts of a filter that do not change: with the plant's sensor faults as states.

    ``T (n, n)``, ``N (n, ny)``, ``Bf0 (nx, nf)``, ``Psi (n, nf)``, ``Upsilon (ny, nf)``; ``Delta`` ``(nf, nf)`` at each
    vertex; ``reach``: a proved bound on ``|Delta^-1|`` over the hull; ``vertices``: the plant's, with Bf0 as Bf;
    ``scaling``: units of ``work`` in which its middle is balanced.
    """

    T: FloatArray
    N: FloatArray
    Bf0: FloatArray
    Psi: FloatArray
    Upsilon: FloatArray
    Delta: tuple[FloatArray, ...]
    reach: float
    vertices: tuple[DescriptorSystem, ...]
    work: tuple[DescriptorSystem, ...]
    scaling: Scaling

    def balanced(self) -> FilterOverRegion:
        """Return the parts with ``work`` in balanced units; faults and disturbances, and ``vertices``, stay."""
        own, states = self.scaling, self.scaling.states[:, None]
        work = tuple(
            vertex.replace(
                exact=None,
                E=own.scale_dynamics(vertex.E),
                A=own.scale_dynamics(vertex.A),
                **{name: own.scale_input(getattr(vertex, name)) for name in ("B", "Bf", "Bd", "Bw")},
                C=own.scale_output(vertex.C),
                **{name: own.scale_feedthrough(getattr(vertex, name)) for name in ("D", "Df", "Dd", "Dw")},
            )
            for vertex in self.work
        )
        return replace(
            self,
            T=self.T / states / own.equations,
            N=self.N / states / own.outputs,
            Psi=self.Psi / states,
            Upsilon=own.scale_feedthrough(self.Upsilon),
            work=work,
            scaling=Scaling(*(np.ones_like(factors) for factors in (own.equations, own.states, own.outputs))),
        )


def conditions_over_region(plant: PolytopicSystem, *, exactly: bool = True) -> tuple[Condition, ...]:
    """Return the existence conditions over a region; the list ends at the first failure."""
    return tuple(_in_order(plant, exactly, []))


def examine_over_region(
    plant: PolytopicSystem,
) -> tuple[tuple[Condition, ...], FilterOverRegion | TurningFilter | None]:
    """Return the existence conditions over a region, and the constant parts of the filter where they hold."""
    made: list[FilterOverRegion | TurningFilter] = []
    conditions = tuple(_in_order(plant, True, made))
    return conditions, made[0] if made else None


def constant_outputs(plant: PolytopicSystem, product: str, source: str) -> Condition:
    """Return the condition that outputs are the same at all vertices; ``product``: what has no vertices otherwise."""
    changing = [name for name in CONSTANT_MATRICES if not plant.is_constant(name)]
    return Condition(
        "constant outputs",
        f"C, D, Df, Dd and Dw are the same at all vertices: the product {product} has no vertices",
        not changing,
        float(len(changing)),
        0.0,
        source,
        f"changing: {', '.join(changing)}. Divide a measurement by what scales its row, and write the quotient as the "
        "output; an input's part may be subtracted from it"
        if changing
        else "",
        of_the_method=True,
    )


@dataclass(frozen=True, eq=False)
class FrozenPoint:
    """The plant where the parameters rest: ``attained`` unless no values of them give it, as at a corner of a hull."""

    where: str
    plant: DescriptorSystem
    attained: bool = True

    def failing(self, condition: Condition) -> Condition:
        """Return a condition that fails here, with the place in its name."""
        where = replace(condition, name=f"{condition.name} at {self.where}")
        if self.attained:
            return where
        return replace(
            where,
            of_the_method=True,
            detail=f"{where.detail.rstrip()} The parameters need not give this point: it is of the hull of their "
            "functions, over which the inequalities have no solution then. Give a smaller region.",
        )


def frozen_points(plant: PolytopicSystem) -> Iterator[FrozenPoint]:
    """Yield every vertex, the middle of the region, and points where a fault or an entry vanishes: a parameter may rest
    there."""
    scheduling = plant.scheduling
    for place, vertex in enumerate(plant.vertices):
        yield FrozenPoint(scheduling.vertex_name(place), vertex, scheduling.is_linear)
    if plant.count == 1:
        return
    middle = (
        np.full(plant.count, 1.0 / plant.count)
        if scheduling.gives_weights
        else 0.5 * (scheduling.low + scheduling.high)
    )
    words = ", ".join(f"{name} = {value:.6g}" for name, value in zip(scheduling.names, middle, strict=True))
    yield FrozenPoint(f"the middle of the region ({words})", plant.at(middle.tolist()))
    yield from _vanishing_entries(plant)
    yield from _vanishing_faults(plant)


def _vanishing_faults(plant: PolytopicSystem) -> Iterator[FrozenPoint]:
    """Yield a point of the hull, for each fault that has one, where all entries of the fault are zero together."""
    stacked = np.array([np.vstack([vertex.Bf, vertex.Df]) for vertex in plant.vertices])
    for fault in range(plant.nf):
        columns = stacked[:, :, fault]
        size = float(np.max(np.abs(columns)))
        if size == 0.0 or plant.count > MOST_HULL_VERTICES or np.array_equal(columns.min(axis=0), columns.max(axis=0)):
            continue
        weights = _weights_of_zero(columns / size)
        if weights is None:
            continue
        point = plant.mean(weights)
        Bf, Df = np.array(point.Bf), np.array(point.Df)
        Bf[:, fault], Df[:, fault] = 0.0, 0.0  # rounding of the mean leaves some 1e-17
        yield FrozenPoint(
            f"{_point_in_words(plant, weights)}, where the fault {plant.fault_names[fault]!r} vanishes",
            point.replace(exact=None, Bf=Bf, Df=Df),
            plant.scheduling.is_linear,
        )


def _weights_of_zero(columns: FloatArray) -> FloatArray | None:
    """Return weights of the simplex with which rows add up to zero but for rounding, ``None`` where there are none."""
    from scipy.optimize import nnls

    count, length = columns.shape
    weights, _ = nnls(np.vstack([columns.T, np.ones(count)]), np.append(np.zeros(length), 1.0))
    if not weights.any():
        return None
    rounding = LEAST_SQUARES_ROUNDINGS * (count + length) * np.finfo(np.float64).eps
    weights = np.where(weights > rounding * weights.max(), weights, 0.0)
    weights = weights / weights.sum()
    return np.asarray(weights) if np.max(np.abs(weights @ columns)) <= rounding else None


def _point_in_words(plant: PolytopicSystem, weights: FloatArray) -> str:
    """Return the values of the functions of the scheduling, or the weights themselves, at a mean of the vertices."""
    scheduling = plant.scheduling
    names = scheduling.names if scheduling.gives_weights else scheduling.functions
    values = weights if scheduling.gives_weights else _cleaned_mean(weights, scheduling.corners)
    return ", ".join(f"{name} = {value:.6g}" for name, value in zip(names, values, strict=True))


def _cleaned_mean(weights: FloatArray, corners: FloatArray) -> FloatArray:
    """Return the mean of corners, zero where it is rounding beside them."""
    mean, sizes = weights @ corners, np.max(np.abs(corners), axis=0)
    return np.where(np.abs(mean) > len(corners) * LEAST_SQUARES_ROUNDINGS * np.finfo(np.float64).eps * sizes, mean, 0.0)


def _vanishing_entries(plant: PolytopicSystem) -> Iterator[FrozenPoint]:
    """Yield points between two vertices, or along one function in the middle of the others, where an entry is zero."""
    scheduling, known = plant.scheduling, set[tuple[int, float]]()
    lines = [*_lines(plant)]
    through_middle = 0 if scheduling.gives_weights and plant.count > 2 else len(lines)
    for place, (name, first, last) in enumerate([*lines, *_lines_between_corners(plant, lines)]):
        ends = {key: _ends(plant, key, first, last) for key in SCHEDULED_MATRICES if not plant.is_constant(key)}
        shares = {key: _sign_changes(*pair) for key, pair in ends.items()}
        for share in sorted({float(each) for found in shares.values() for each in found[np.isfinite(found)]}):
            if (share == 0.5 and place < through_middle) or (place, share) in known:
                continue  # the middle is looked at already
            known.add((place, share))
            if len(known) > MOST_VANISHING:
                return
            point = plant.mean((1.0 - share) * first + share * last)
            # Rounding of the mean leaves some 1e-17 where the entry is zero.
            changed = {key: np.where(shares[key] == share, 0.0, getattr(point, key)) for key in ends}
            yield FrozenPoint(
                f"{name(share)}, where an entry vanishes",
                point.replace(exact=None, **changed),
                scheduling.is_linear,
            )


def _lines(plant: PolytopicSystem) -> Iterator[Line]:
    """Yield lines through the hull: the words of a point on it, and the weights of its ends."""
    scheduling, count = plant.scheduling, plant.count
    if scheduling.gives_weights:
        for i in range(count):
            for j in range(i + 1, count):
                names = scheduling.names[i], scheduling.names[j]

                def weights(share: float, names: tuple[str, str] = names) -> str:
                    return f"{names[0]} = {1.0 - share:.6g}, {names[1]} = {share:.6g}"

                yield weights, np.eye(count)[i], np.eye(count)[j]
        return
    functions, bounds = scheduling.functions, scheduling.bounds
    for k in range(len(functions)):
        at_low = scheduling.corners[:, k] == bounds[k, 0]

        def values(share: float, k: int = k) -> str:
            shares = [share if place == k else 0.5 for place in range(len(functions))]
            pairs = zip(functions, bounds.tolist(), shares, strict=True)
            return ", ".join(f"{text} = {low + at * (high - low):.6g}" for text, (low, high), at in pairs)

        yield values, at_low / at_low.sum(), ~at_low / (~at_low).sum()


def _lines_between_corners(plant: PolytopicSystem, lines: Sequence[Line]) -> Iterator[Line]:
    """Yield a line for each entry that changes its sign over the region, but not along any of ``lines``."""
    for key in SCHEDULED_MATRICES:
        if plant.is_constant(key):
            continue
        stacked = np.array([getattr(vertex, key) for vertex in plant.vertices])
        missed = (stacked.min(axis=0) < 0.0) & (stacked.max(axis=0) > 0.0)
        for _, first, last in lines:
            missed &= ~np.isfinite(_sign_changes(*_ends(plant, key, first, last)))
        for row, column in np.argwhere(missed):
            entry = stacked[:, row, column]
            first, last = np.eye(plant.count)[[int(np.argmin(entry)), int(np.argmax(entry))]]

            def values(share: float, first: FloatArray = first, last: FloatArray = last) -> str:
                return _point_in_words(plant, (1.0 - share) * first + share * last)

            yield values, first, last


def _ends(plant: PolytopicSystem, key: str, first: FloatArray, last: FloatArray) -> tuple[FloatArray, FloatArray]:
    stacked = np.array([getattr(vertex, key) for vertex in plant.vertices])
    return np.tensordot(first, stacked, axes=1), np.tensordot(last, stacked, axes=1)


def _sign_changes(first: FloatArray, last: FloatArray) -> FloatArray:
    """Return at which share of the way every entry is zero; NaN where it does not change its sign."""
    change = first * last < 0.0
    return np.where(change, first / np.where(change, first - last, 1.0), np.nan)


def _in_order(
    plant: PolytopicSystem, exactly: bool, made: list[FilterOverRegion | TurningFilter]
) -> Iterator[Condition]:
    constant = constant_outputs(plant, "L(mu) C(mu)", _SOURCE)
    yield constant
    if not constant.holds:
        return
    for point in frozen_points(plant):
        for condition in fault_filter_conditions(point.plant, exactly=exactly):
            if condition.name == "discrete time" and not condition.holds:
                yield replace(condition, detail=_CONTINUOUS)
                return
            if not condition.holds:
                yield point.failing(condition)
                return
    yield Condition(
        "filter at every vertex",
        "at every vertex the filter of the plant with constant matrices exists",
        True,
        float(plant.count),
        float(plant.count),
        "Wang 2015, Theorem 2",
    )
    directions = _directions(plant)
    if directions is None and has_turning_form(plant):
        yield from turning_conditions(plant, made)
        return
    yield _direction_condition(plant, directions)
    if directions is None:
        return
    Bf0, Delta = directions
    reach, _ = inverse_bound(Delta)
    yield effectiveness_condition(
        reach,
        "Delta(mu) of Bf(mu) = Bf0 Delta(mu) is nonsingular on the whole region: a fault does not lose its effect",
        _SOURCE,
    )
    if reach is None:
        return
    parts = _constant_parts(plant, Bf0, Delta, reach)
    late = [name for name, index in zip(plant.fault_names, parts[1], strict=True) if index != 1]
    yield Condition(
        "one sample to the outputs",
        "every fault reaches the outputs after one sample: C T Bf0 has full column rank",
        not late,
        float(len(late)),
        0.0,
        _SOURCE,
        f"later: {', '.join(late)}; a filter for these over a region is not known here. ui-pi-observer does not need it"
        if late
        else "",
        signals=tuple(late),
        of_the_method=True,
    )
    if not late:
        made.append(parts[0])


def _directions(plant: PolytopicSystem) -> tuple[FloatArray, tuple[FloatArray, ...]] | None:
    """Return Bf0 and Delta at each vertex, or ``None`` where the faults turn."""
    each = [np.vstack([vertex.Bf, vertex.Df]) for vertex in plant.vertices]
    nf = plant.nf
    if all(np.array_equal(matrix, each[0]) for matrix in each):
        return plant.vertices[0].Bf, (np.eye(nf),) * plant.count
    middle = sum(each[1:], start=each[0]) / len(each)
    turning = decide_rank(np.hstack([middle, *each]), expected=nf).rank > nf
    if turning or not decide_rank(middle, expected=nf).full:
        return None
    # A column that keeps its direction has one number; others are mixed by least squares.
    Delta = tuple(_cleaned(np.asarray(np.linalg.lstsq(middle, matrix, rcond=None)[0])) for matrix in each)
    return plant.center.Bf, Delta


def _cleaned(matrix: FloatArray) -> FloatArray:
    """Return a matrix without what is rounding beside its largest entry."""
    size = float(np.max(np.abs(matrix), initial=0.0))
    return np.where(
        np.abs(matrix) > len(matrix) * LEAST_SQUARES_ROUNDINGS * np.finfo(np.float64).eps * size, matrix, 0.0
    )


def _direction_condition(plant: PolytopicSystem, directions: object) -> Condition:
    return Condition(
        "directions of the faults",
        "Bf(mu) = Bf0 Delta(mu): the faults keep the space of their directions over the region",
        directions is not None,
        float(plant.nf),
        float(plant.nf),
        _SOURCE,
        ""
        if directions is not None
        else "a fault turns with the scheduling, and exact decoupling of such a fault is for two vertices without Df "
        "and Dd. Take ui-pi-observer, for which faults may turn",
        signals=() if directions is not None else plant.fault_names,
        of_the_method=True,
    )


def _constant_parts(
    plant: PolytopicSystem, Bf0: FloatArray, Delta: tuple[FloatArray, ...], reach: float
) -> tuple[FilterOverRegion, list[int]]:
    vertices = tuple(vertex.replace(Bf=Bf0, exact=None) for vertex in plant.vertices)
    prepared = prepare(plant.center.replace(Bf=Bf0, exact=None), exactly=False)
    states = prepared.scaling.states[:, None]
    T = states * prepared.T * prepared.scaling.equations
    N = states * prepared.N * prepared.scaling.outputs
    work = tuple(with_sensor_faults_as_states(vertex) for vertex in vertices)
    Psi = T @ work[0].Bf
    Upsilon = work[0].C @ Psi
    full = decide_rank(Upsilon, expected=plant.nf).full
    indexes = [int(index or 0) for index in prepared.detectability.indexes]
    indexes = indexes if full or any(index != 1 for index in indexes) else [0] * plant.nf
    return FilterOverRegion(T, N, Bf0, Psi, Upsilon, Delta, reach, vertices, work, prepared.scaling), indexes
