"""Filters of few states: the least order that keeps the fault map and the decoupling, and a filter of low gain.

The filter of least gain has as many states as the plant, its reference model and its windows together.  One of fewer
states is looked for among all left fractions that see neither the state, nor known inputs, nor decoupled disturbances;
for model matching on plants whose modes decay also among all filters, whose errors hold these modes.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import block_diag

from obsynth.errors import InfeasibleError, SolverError
from obsynth.methods.optimal_filter.fault_maps import (
    Designed,
    FaultMap,
    channels_of,
    filter_in_plant_units,
    unit_of_errors,
)
from obsynth.methods.optimal_filter.realisation import modes_that_inputs_drive
from obsynth.methods.optimal_filter.reference import delayed
from obsynth.methods.optimal_filter.weights import Weights, in_series
from obsynth.numerics.arrays import ComplexArray, FloatArray
from obsynth.numerics.decoupling_windows import Channels, Model
from obsynth.numerics.least_estimation import STABLE_RADIUS
from obsynth.numerics.left_fractions import Criterion, FractionProblem, best_fraction, is_stabilised, least_degrees
from obsynth.numerics.low_order_models import Target, is_stable, plainly_truncated, searched, truncations, weighed
from obsynth.numerics.standard_form import StandardForm, cayley, standard_form, uncayley
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.pencil import structure_of
from obsynth.plants.plant_units import PlantUnits

#: So many filters that may read the plant's states are made, the best ones at the angles, beside the plain truncation.
MOST_TRIED = 3
#: Angles on the half circle at which the error is weighed, and the least one beside both ends.
ANGLES, LEAST_ANGLE = 240, 1e-4


def filters_of_order(plant: DescriptorSystem, chosen: Designed, limit: int, full: int, norm: str) -> list[Designed]:
    """Return filters of at most ``limit`` states with the fault map of one that has ``full``, the best first.

    Raise `InfeasibleError` where there is none, `SolverError` where none of these that is stable was found.
    """
    problem, criterion = _fractions(plant, chosen, norm)
    least = least_degrees(problem, full)
    if least is None:
        raise SolverError(
            f"No filter with this fault map and fewer than {full} states was found: the result is inconclusive. "
            f"Give order_limit={full}."
        )
    # A search of more states may end in a worse minimum than one of fewer, or than no filter at all.
    orders = dict.fromkeys(order for order in (limit, limit - 1, sum(least)) if sum(least) <= order <= limit)
    tried = [degrees for order in orders for degrees in _shared(least, order)]
    filters = [_filter(plant, chosen, problem, criterion, degrees, norm) for degrees in tried]
    stable = sorted((one for one in filters if one is not None), key=lambda one: one[1])
    if stable:
        return [filter_ for filter_, _ in stable]
    larger = range(max(sum(least), limit + 1), full)
    # The filter of least gain is a stable one of its order.
    works = next((k for k in larger if any(is_stabilised(problem, one) for one in _shared(least, k))), full)
    if sum(least) > limit:
        raise InfeasibleError(
            f"No filter of at most {limit} states has this fault map and follows the plant's states: each has at least "
            f"{sum(least)} (decided in floating point). The least order of a stable one that was found: "
            f"order_limit={works}.",
            necessary=True,
            lower_bound=float(sum(least)),
        )
    raise SolverError(
        f"No stable filter of at most {limit} states with this fault map was found, and none is proved not to exist. "
        f"The least order of a stable one that was found: order_limit={works}."
    )


def _filter(
    plant: DescriptorSystem,
    chosen: Designed,
    problem: FractionProblem,
    criterion: Criterion,
    degrees: tuple[int, ...],
    norm: str,
) -> tuple[Designed, float] | None:
    fraction = best_fraction(problem, degrees, criterion, norm)
    if fraction is None:
        return None
    filter_, size = fraction
    filter_ = filter_ if plant.is_discrete else uncayley(*filter_, chosen.problem.alpha)
    own = filter_in_plant_units(plant, chosen.fault_map._replace(weights=None), filter_)
    return chosen._replace(filter=own, least=chosen.least_gain), size


def _shared(least: tuple[int, ...], limit: int) -> list[tuple[int, ...]]:
    """Return row degrees whose sum is the limit: what is left goes to the rows in turn, or to one of them."""
    more, count = limit - sum(least), len(least)
    even = tuple(one + (more + count - 1 - i) // count for i, one in enumerate(least))
    alone = (tuple(one + more * (i == j) for j, one in enumerate(least)) for i in range(count))
    return list(dict.fromkeys((even, *alone)))


def _fractions(plant: DescriptorSystem, chosen: Designed, norm: str) -> tuple[FractionProblem, Criterion]:
    """Return what the left fractions of a filter are chosen among and for, in units in which the plant is near one."""
    fault_map, full = chosen.fault_map, chosen.problem
    channels, each = channels_of(plant, fault_map)
    form, (bf, bd, bw), (df, dd, dw) = _with_every_state(channels, full.alpha)
    wanted = _wanted(plant, fault_map, each, full.alpha)
    # An index above one takes all inputs later.
    late = [delay + form.shift for delay in fault_map.delays or (0,) * plant.nf]
    wanted = in_series(delayed(late), wanted) if any(late) else wanted
    # An index above one leaves samples of the inputs among the states, which are seen at once.
    own, spare = 0 if form.shift else len(form.A), form.shift + max(late, default=0)
    rows, ends = len(wanted[3]), _must_end(plant, norm)
    if not fault_map.exact:
        w, through = np.hstack([bf, bw]), np.hstack([df, dw])
        fractions = FractionProblem(form.A, form.C, bd, dd, w, through, plant.ny, rows, False, own, spare, ends)
        return fractions, _criterion(plant, fault_map, wanted, norm, full.alpha)
    a, b, c, d = wanted
    fractions = FractionProblem(
        block_diag(form.A, a),
        block_diag(form.C, c),
        np.block([[bf, bd], [b, np.zeros((len(b), plant.nd))]]),
        np.block([[df, dd], [d, np.zeros((rows, plant.nd))]]),
        np.vstack([bw, np.zeros((len(a), plant.nw))]),
        np.vstack([dw, np.zeros((rows, plant.nw))]),
        plant.ny,
        rows,
        True,
        own,
        spare,
        ends,
    )
    return fractions, _criterion(plant, fault_map, None, norm, full.alpha)


def free_filters(plant: DescriptorSystem, chosen: Designed, limit: int, norm: str) -> list[Designed]:
    """Return filters of at most ``limit`` states that may read the plant's states, the plain truncation last.

    They are for model matching without decoupled disturbances, on plants whose modes decay: none for others.  Of modes
    that known inputs drive each takes a state, so that these do not reach the error.
    """
    fault_map, alpha = chosen.fault_map, chosen.problem.alpha
    if fault_map.exact or plant.nd or not _decays(plant):
        return []
    limit -= modes_that_inputs_drive(plant)
    if limit < 1:
        return []
    target = _free_target(plant, chosen, norm)
    units, error = PlantUnits.of(plant).rounded().outputs, unit_of_errors(plant)
    rate = 1.0 if plant.is_discrete else alpha
    a, b, c, d = chosen.filter

    def in_target_units(model: Model) -> Model:
        a, b, c, d = model
        return a / rate, b / units / rate, c / error, d / units / error

    plain = plainly_truncated((a / rate, b / rate, c, d), limit, discrete=plant.is_discrete)
    plain = plain[0] * rate, plain[1] * rate, plain[2], plain[3]
    starts = [*truncations(in_target_units(chosen.filter), limit, target), in_target_units(plain)]
    starts = [start for start in starts if is_stable(start, discrete=target.discrete)]
    best = [*searched(starts, limit, target, norm), *starts]
    best.sort(key=lambda one: weighed(one, target, norm))
    models = [(a * rate, b * units * rate, c * error, d * units * error) for a, b, c, d in best[:MOST_TRIED]]
    return [chosen._replace(filter=model, least=chosen.least_gain) for model in (*models, plain)]


def _decays(plant: DescriptorSystem) -> bool:
    modes = structure_of(plant).finite_eigenvalues
    return bool(np.all(np.abs(modes) < STABLE_RADIUS) if plant.is_discrete else np.all(np.real(modes) < 0.0))


def _free_target(plant: DescriptorSystem, chosen: Designed, norm: str) -> Target:
    """Return what a filter is weighed by that may read everything: all that faults and noise do to the outputs."""
    fault_map, alpha = chosen.fault_map, chosen.problem.alpha
    channels, each = channels_of(plant, fault_map)
    criterion = _criterion(plant, fault_map, _wanted(plant, fault_map, each, alpha), norm, alpha)
    angles, discrete = criterion.angles, plant.is_discrete
    points = np.exp(1j * angles) if discrete else 1j * alpha * np.tan(0.5 * angles)
    driving = np.hstack([channels.Bf, channels.Bw])
    states = np.linalg.solve(points[:, None, None] * channels.E - channels.A, driving.astype(complex))
    shown = channels.C @ states + np.hstack([channels.Df, channels.Dw])
    return Target(
        points if discrete else points / alpha,
        criterion.shares,
        criterion.left_weight,
        shown @ criterion.right_weight,
        criterion.target @ criterion.right_weight,
        discrete,
        not _must_end(plant, norm),
    )


def _must_end(plant: DescriptorSystem, norm: str) -> bool:
    return norm == "h2" and not plant.is_discrete


def _with_every_state(
    channels: Channels, alpha: float
) -> tuple[StandardForm, tuple[FloatArray, ...], tuple[FloatArray, ...]]:
    """Return the standard form with every state that is shown, and B and D of faults, disturbances and noise."""
    n, ny = len(channels.A), len(channels.C)
    parts = (channels.Bf, channels.Bd, channels.Bw)
    # Inputs to all equations, so that no state is left out that only they reach.
    inputs = np.hstack([*parts, np.eye(n)])
    through = np.hstack([channels.Df, channels.Dd, channels.Dw, np.zeros((ny, n))])
    form = standard_form(channels.E, channels.A, inputs, channels.C, through, channels.dt, alpha=alpha)
    ends = np.cumsum([part.shape[1] for part in parts])
    b, d = (tuple(np.split(part, ends, axis=1)[:3]) for part in (form.B, form.D))
    return form, b, d


def _wanted(plant: DescriptorSystem, fault_map: FaultMap, each: FloatArray, alpha: float) -> Model:
    """Return what the estimates shall be of the faults, but for delays."""
    unit = unit_of_errors(plant)
    if fault_map.reference is None:
        none = np.zeros((0, 0))
        return none, np.zeros((0, plant.nf)), np.zeros((plant.nf, 0)), np.diag(each) / unit
    a, b, c, d = fault_map.reference
    model = (a, b * each, c / unit, d * each / unit)
    return model if plant.is_discrete else cayley(*model, alpha)


def _criterion(
    plant: DescriptorSystem, fault_map: FaultMap, matched: Model | None, norm: str, alpha: float
) -> Criterion:
    near = np.geomspace(LEAST_ANGLE, 1.0, ANGLES // 4)
    angles = np.unique(np.concatenate([(np.arange(ANGLES) + 0.5) * np.pi / ANGLES, near, np.pi - near]))
    edges = np.concatenate([[0.0], 0.5 * (angles[1:] + angles[:-1]), [np.pi]])
    shares = np.diff(edges) / np.pi
    if _must_end(plant, norm):
        # The frequency is alpha tan(angle / 2).
        shares = shares * 0.5 * alpha / np.cos(0.5 * angles) ** 2
    weights = fault_map.weights or Weights(None, None, None)
    points = np.exp(1j * angles)
    one = np.eye(plant.nf if fault_map.reference is None else len(fault_map.reference[2]))

    def response(model: Model | None, size: int) -> ComplexArray:
        if model is None:
            return np.broadcast_to(np.eye(size, dtype=complex), (len(points), size, size))
        return _response(model if plant.is_discrete else cayley(*model, alpha), points)

    left_weight, noise = response(weights.errors, len(one)), response(weights.noise, plant.nw)
    if matched is None:
        return Criterion(angles, shares, left_weight, noise, np.zeros((1, len(one), plant.nw), dtype=complex))
    right_weight = np.zeros((len(points), plant.nf + plant.nw, plant.nf + plant.nw), dtype=complex)
    right_weight[:, : plant.nf, : plant.nf] = response(weights.faults, plant.nf)
    right_weight[:, plant.nf :, plant.nf :] = noise
    target = np.zeros((len(points), len(one), plant.nf + plant.nw), dtype=complex)
    target[:, :, : plant.nf] = _response(matched, points)
    return Criterion(angles, shares, left_weight, right_weight, target)


def _response(model: Model, points: ComplexArray) -> ComplexArray:
    a, b, c, d = model
    states = np.linalg.solve(points[:, None, None] * np.eye(len(a)) - a, np.broadcast_to(b, (len(points), *b.shape)))
    return np.asarray(c @ states + d, dtype=complex)
