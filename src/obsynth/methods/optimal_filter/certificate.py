"""Certificate of an optimal filter: P for its gain, and complex points at which invisible signals bound every gain."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.linalg

from obsynth.errors import SolverError
from obsynth.methods.optimal_filter.checks import DEVIATION_SHARE
from obsynth.methods.optimal_filter.error_channel import ErrorChannel
from obsynth.methods.optimal_filter.fault_maps import ZERO_GAIN, Designed, designed
from obsynth.methods.optimal_filter.realised_filter import RealisedFilter, error_model_of
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.gramians import gramian
from obsynth.numerics.matrix_equations import bounded_real_matrix
from obsynth.numerics.norms import hinf_norm
from obsynth.numerics.standard_form import INFINITE_EIGENVALUE, cayley
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.plant_units import PlantUnits
from obsynth.verification.gain_by_pencil import prove_norm_by_eigenvalues
from obsynth.verification.inequalities import prove_norm
from obsynth.verification.invisible_at_infinity import proved_at_infinity
from obsynth.verification.invisible_faults import invisible_pencil, proved_least, proved_limit
from obsynth.verification.seen_outputs import Setting, nearly_dependent_outputs, with_independent_outputs, with_outputs

#: Shares above the recomputed gain that are claimed: the first one that can be proved.
CLAIM_ROOMS = (1e-9, 1e-8, 1e-7, 5e-7, 1e-6, 1e-5, 1e-4, 1e-3)
#: For a gain of at most so many times the one that counts as zero, further factors are tried, up to this share of the
#: largest effect of the noise in a sample without cancellation.
NEARLY_NOTHING, SMALL_GAIN, SMALL_GAIN_ROOMS = 1e4, 1e-4, np.geomspace(2.0, 1e6, 20)
#: Number of levels at which all eigenvalues of the Hamiltonian matrix are enclosed, in some tenths of a second each.
MOST_ENCLOSURES = 5
#: Levels that are claimed for a gain that is zero up to rounding, in units of the gain that counts as zero.
ZERO_LEVELS = (1.0, 1e1, 1e2, 1e3, 1e4)
#: Slacks of the inequality that the certificate solves, relative to the square of the output matrix.
SLACKS = (1e-3, 1e-6, 1e-8, 1e-9, 1e-10, 1e-11, 1e-12)
#: A small deviation that differs from that of the search by more than this share is due to rounding.
ROUNDING_OF_DEVIATIONS = 3e-7
#: A lower bound within this share of the gain is not improved further, since the search for the gain ends at 1e-8.
CLOSE_ENOUGH = 3e-8
#: Share of a proved bound that is claimed, since machines differ in the last digits of the combinations that they find.
CLAIMED_SHARE = 1.0 - 1e-10
#: Number of levels near which a bound is searched, until the bound can be proved again from itself.
REPETITIONS = 4
#: Decays per sample below this are left out: the last samples, which are free, contain such signals.
FASTEST_DECAY = 1e-2
#: Slower decays are left out, since their signals last too long for the sums of their energies.
SLOWEST_DECAY = 1.0 - 1e-12
#: Imaginary parts below this share are rounding, and angles within this distance of 0 and pi are those of real points.
REAL_SHARE, EDGE_ANGLE = 1e-9, 1e-9
#: Share by which a frequency is moved off the circle or the axis, so that its signals decay.
OFF_THE_EDGE = 1e-9
#: In place of infinite frequency, so many times the Cayley point.  The distance from the limit there falls with the
#: square of this number, but double precision, in which directions are searched, loses digits with it (1e9 left .14 of
#: a gain of 1.03).
INFINITE_FREQUENCY = 1e6
#: Limits on the gains of filters from outputs that depend on others up to rounding, in units in which the plant is near
#: one, and the largest share of a bound that such a limit may cost.  A gain of 1e4 is far beyond what noise allows, and
#: 1e12 is rounding itself.
ANSWER_LIMITS, ANSWERED_SHARE = (1e10, 1e8, 1e6, 1e4), 1e-8
#: Number of last samples beyond the delay whose signals are free, and largest number of unknowns of all free samples.
MORE_SAMPLES, MOST_UNKNOWNS = 3, 150


def certified(
    plant: DescriptorSystem, chosen: Designed, observer: LinearObserver, found: RealisedFilter, norm: str
) -> tuple[dict[str, FloatArray], dict[str, float]]:
    """Return the witnesses and the claims of a filter; raise `SolverError` if no gain near its own can be proved."""
    fault_map = chosen.fault_map
    claims = {"order": float(observer.order)}
    if fault_map.delay is not None:
        claims["delay"] = float(fault_map.delay)
    channel = ErrorChannel.of(error_model_of(plant, observer, found), fault_map)
    if norm == "h2":
        return {}, claims | _deviations(chosen, channel, plant.dt)
    if chosen.is_nothing:
        levels = [factor * chosen.nothing for factor in ZERO_LEVELS]
    else:
        levels = [chosen.gain * (1.0 + room) for room in CLAIM_ROOMS]
    if chosen.gain <= NEARLY_NOTHING * chosen.nothing:
        # The stored numbers may have a larger gain, by rounding.
        levels += [float(level) for level in levels[-1] * SMALL_GAIN_ROOMS if level <= SMALL_GAIN * channel.size]
    matrices: dict[str, FloatArray] = {}
    for number, level in enumerate(levels):
        P = gain_matrix(channel, level, plant.dt, chosen.problem.alpha)
        scaled = channel.in_units_of(level)
        if P is not None:
            matrices["P"] = P
        elif (
            number >= MOST_ENCLOSURES
            or not prove_norm_by_eigenvalues(scaled, scaled.order, level / scaled.unit, dt=plant.dt).proved
        ):
            continue
        claims["gain"] = level
        break
    else:
        raise SolverError(
            f"A gain of {chosen.gain:.6g} was found, and no level near it can be proved: the result is inconclusive. "
            "Scale the plant's signals, or give every sensor noise."
        )
    if chosen.is_nothing:
        return matrices, claims
    return matrices | _lower_bounds(plant, chosen, observer, claims), claims


def _deviations(chosen: Designed, channel: ErrorChannel, dt: float) -> dict[str, float]:
    """Return the claims of a filter of least mean square, or if that is rounding, a bound for the stored numbers."""
    own, gain = channel.deviation(dt), 0.0 if chosen.is_nothing else chosen.gain
    if ZERO_GAIN * channel.size < own <= channel.rounding and abs(own - gain) > ROUNDING_OF_DEVIATIONS * gain:
        return {"deviation": float(10.0 ** np.ceil(np.log10(2.0 * own))), "least_deviation": 0.0}
    if chosen.is_nothing and ZERO_GAIN * channel.size < own <= chosen.nothing:
        # Noise that affects the estimates only by rounding, which is small relative to the estimated signals, but not
        # relative to the outputs.
        return {"deviation": own, "least_deviation": 0.0}
    if gain and own > channel.rounding and not abs(own - gain) <= DEVIATION_SHARE * gain:
        raise SolverError(
            f"A deviation of {gain:.6g} was found, and that of the filter's stored numbers is {own:.6g}: the result is "
            "inconclusive. Scale the plant's signals, or give every sensor noise."
        )
    least = gain if chosen.is_nothing or chosen.least is None else chosen.least
    return {"deviation": max(gain, own) if gain and own <= channel.rounding else gain, "least_deviation": least}


def gain_matrix(channel: ErrorChannel, level: float, dt: float, alpha: float) -> FloatArray | None:
    """Return a matrix P that proves the bounded real inequality of an error system for a level, or ``None``."""
    channel = channel.in_units_of(level)
    (a, b, c, d), own = channel.middle, level / channel.unit
    if dt == 0.0:
        a, b, c, d = cayley(a, b, c, d, alpha)
    for scale, size in ((np.ones(len(a)), float(np.linalg.norm(c)) ** 2), (_reached_sizes(a, b), own**2)):
        for share in SLACKS:
            slack = share * size + float(np.finfo(float).tiny)
            P = bounded_real_matrix(a / scale[:, None] * scale, b / scale[:, None], c * scale, d, own, slack=slack)
            P = None if P is None else P / scale[:, None] / scale
            if P is not None and prove_norm(channel, P, own, dt=dt).proved:
                return P
    return None


def _reached_sizes(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the sizes, powers of two, to which unit white noise drives the states."""
    sizes = np.sqrt(np.maximum(np.diag(gramian(a, b @ b.T)), 0.0))
    known = np.isfinite(sizes) & (sizes > 0.0)
    return np.where(known, np.exp2(np.round(np.log2(np.where(known, sizes, 1.0)))), 1.0)


def _lower_bounds(
    plant: DescriptorSystem, chosen: Designed, observer: LinearObserver, claims: dict[str, float]
) -> dict[str, FloatArray]:
    """Add the proved lower bounds for all causal filters, and for all delays, to the claims; return the witnesses."""
    read = with_independent_outputs(plant)
    nearly = nearly_dependent_outputs(read)
    read = with_outputs(read, [i for i in range(read.ny) if i not in nearly])
    if read.ny < plant.ny:
        # The worst noise was computed for added noise, which is not needed without the dependent outputs.
        worst = designed(read, chosen.fault_map, "hinf")
        chosen = chosen._replace(
            problem=worst.problem, limit=worst.limit, limit_angle=worst.limit_angle, decays=worst.decays
        )
    matrices = _bounds_of_outputs(read, chosen, claims)
    if not nearly:
        return matrices
    dependent = [i for i, name in enumerate(plant.output_names) if name not in read.output_names]
    return _bounds_beside(plant, dependent, chosen, observer, (matrices, claims))


def _bounds_beside(
    plant: DescriptorSystem,
    dependent: list[int],
    chosen: Designed,
    observer: LinearObserver,
    of_others: tuple[dict[str, FloatArray], dict[str, float]],
) -> dict[str, FloatArray]:
    """Add proved lower bounds for filters with any gain from the other outputs, and a limited one from dependent ones.

    The limit is the largest tried one that hardly changes the bounds.  ``of_others`` are witnesses and claims for the
    other outputs alone, from which bounds that are not proved for all outputs are removed.
    """
    (matrices, claims), units = of_others, PlantUnits.of(plant).rounded()
    least, limit = claims.pop("least", None), claims.pop("non_causal_limit", None)
    if least is None:
        return {}
    unit = float(np.max(units.faults, initial=0.0) * np.max(units.outputs[dependent]))
    a, b, c, d = observer.Az, observer.By[:, dependent], observer.Cz, observer.Dy[:, dependent]
    if not plant.is_discrete:
        a, b, c, d = cayley(a, b, c, d, chosen.problem.alpha)
    own_gain, plant = float(hinf_norm(a, b, c, d).upper), chosen.fault_map.driven(plant)
    for share in ANSWER_LIMITS:
        most = float(f"{share * unit:.0e}")
        if most < own_gain:
            break
        setting = chosen.fault_map.setting._replace(dependent=tuple(dependent), answer_limit=most)
        if not len(matrices["invisible"]) and not plant.is_discrete:
            bound = proved_at_infinity(plant, setting)
        else:
            points, samples = [complex(*pair) for pair in matrices["invisible"]], int(matrices["samples"][0, 0])
            bound = proved_least(plant, points, samples, setting, level=least * (1.0 - ANSWERED_SHARE))
        if bound is None or bound < least * (1.0 - ANSWERED_SHARE):
            continue
        claims |= {"least": least * (1.0 - ANSWERED_SHARE), "answer_limit": most}
        if limit is not None:
            beside = proved_limit(plant, complex(*matrices["limit_point"][0]), setting)
            if beside is not None and beside >= limit * (1.0 - ANSWERED_SHARE):
                claims["non_causal_limit"] = limit * (1.0 - ANSWERED_SHARE)
        return matrices | {"dependent": np.array([[float(i)] for i in dependent])}
    return {}


def _bounds_of_outputs(plant: DescriptorSystem, chosen: Designed, claims: dict[str, float]) -> dict[str, FloatArray]:
    """Add proved lower bounds for all causal filters of a plant with independent outputs; return the witnesses."""
    fault_map, best, settled, matrices = chosen.fault_map, 0.0, False, dict[str, FloatArray]()
    setting, plant = fault_map.setting, fault_map.driven(plant)
    block = plant.nx + plant.nf + plant.nd + plant.nw
    samples = min(setting.longest + MORE_SAMPLES, max(setting.longest, 1) + MOST_UNKNOWNS // block)
    best_points: list[complex] = []
    for points in _candidates(plant, chosen):
        # First in double precision, which suffices for most plants.
        bound = proved_least(plant, points, samples, setting, level=chosen.gain, enough=0.0)
        # Points of two levels with one bound: those of further levels have it too.
        settled = bound is not None and best > 0.0 and abs(bound * CLAIMED_SHARE - best) <= CLOSE_ENOUGH * best
        if bound is not None and best < bound * CLAIMED_SHARE <= claims["gain"]:
            best, best_points = bound * CLAIMED_SHARE, points
        if settled or best >= chosen.gain * (1.0 - CLOSE_ENOUGH):
            break
    if not settled and 0.0 < best < chosen.gain * (1.0 - CLOSE_ENOUGH):
        bound = _repeatable(plant, best_points, samples, setting, chosen.gain)
        if bound is not None and bound <= claims["gain"]:
            best = max(best, bound)
    if best > 0.0:
        matrices["invisible"] = np.array([[p.real, p.imag] for p in best_points]).reshape(-1, 2)
        matrices["samples"] = np.array([[float(samples)]])
    at_once = proved_at_infinity(plant, setting)
    if at_once is not None and best < at_once * CLAIMED_SHARE <= claims["gain"]:
        best = at_once * CLAIMED_SHARE
        matrices |= {"invisible": np.zeros((0, 2)), "samples": np.zeros((1, 1))}
    if best > 0.0:
        claims["least"] = best
    if fault_map.delay is not None and fault_map.exact and chosen.limit > chosen.nothing:
        point = _edge_point(plant, chosen)
        limit = proved_limit(plant, point, setting)
        if limit is not None and limit > chosen.nothing:
            claims["non_causal_limit"] = min(limit * CLAIMED_SHARE, claims.get("least", np.inf))
            matrices["limit_point"] = np.array([[point.real, point.imag]])
    return matrices


def _repeatable(
    plant: DescriptorSystem, points: Sequence[complex], samples: int, setting: Setting, level: float
) -> float | None:
    """Return a bound that verification can prove again: it searches near the bound itself, and not near the gain."""
    for _ in range(REPETITIONS):
        bound = proved_least(plant, points, samples, setting, level=level)
        if bound is None:
            return None
        claimed = bound * CLAIMED_SHARE
        again = proved_least(plant, points, samples, setting, level=claimed)
        if again is not None and again >= claimed:
            return claimed
        level = claimed
    return None


def _edge_point(plant: DescriptorSystem, chosen: Designed) -> complex:
    """Return the frequency of the limit as a point just outside the circle, or right of the axis."""
    angle = chosen.limit_angle
    if plant.is_discrete:
        turn = (
            complex(np.cos(angle), np.sin(angle)) if min(angle, np.pi - angle) > EDGE_ANGLE else complex(np.cos(angle))
        )
        return complex((1.0 + OFF_THE_EDGE) * turn)
    alpha = chosen.problem.alpha
    rate = alpha * np.tan(angle / 2.0) if np.pi - angle > EDGE_ANGLE else alpha * INFINITE_FREQUENCY
    return complex(OFF_THE_EDGE * (alpha + rate), rate if angle > EDGE_ANGLE else 0.0)


def _candidates(plant: DescriptorSystem, chosen: Designed) -> list[list[complex]]:
    """Return the sets of points to try: zeros if only these are invisible, else those of the worst noise by level."""
    free = plant.nf + plant.nd + plant.nw - plant.ny
    if free <= 0:
        return [_zeros_outside(plant), []] if plant.is_discrete else [_zeros_outside(plant)]
    edge = [_edge_point(plant, chosen)] if chosen.limit > chosen.nothing else []
    candidates: list[list[complex]] = []
    for decays in reversed(chosen.decays):
        points = [point for value in decays if (point := _point_of(plant, chosen, complex(value))) is not None]
        candidates.append(points + edge if not candidates else points)
    return [*candidates, edge] if edge else [*candidates, []] if plant.is_discrete else candidates


def _point_of(plant: DescriptorSystem, chosen: Designed, decay: complex) -> complex | None:
    """Return the point of a decay per sample (in continuous time of the Cayley transform); ``None`` for conjugates."""
    real = abs(decay.imag) <= REAL_SHARE * abs(decay)
    if (decay.imag < 0.0 and not real) or abs(decay) >= SLOWEST_DECAY:
        return None
    decay = complex(decay.real) if real else decay
    if plant.is_discrete:
        return 1.0 / decay if abs(decay) > FASTEST_DECAY else None
    return complex(chosen.problem.alpha * (1.0 - decay) / (1.0 + decay))


def _zeros_outside(plant: DescriptorSystem) -> list[complex]:
    """Return the unstable finite zeros from faults, disturbances and noise to the outputs, for as many outputs as
    inputs; none otherwise."""
    inputs, through = np.hstack([plant.Bf, plant.Bd, plant.Bw]), np.hstack([plant.Df, plant.Dd, plant.Dw])
    if inputs.shape[1] != plant.ny:
        return []
    still, moved = invisible_pencil(plant, inputs, through)
    alpha, beta = scipy.linalg.eigvals(still, -moved, homogeneous_eigvals=True)
    unstable: list[complex] = []
    for top, bottom in zip(alpha, beta, strict=True):
        if abs(bottom) * INFINITE_EIGENVALUE <= abs(top):
            continue
        value: Any = complex(top / bottom)
        value = complex(value.real) if abs(value.imag) <= REAL_SHARE * abs(value) else value
        outside = abs(value) > 1.0 if plant.is_discrete else value.real > 0.0
        if outside and value.imag >= 0.0:
            unstable.append(value)
    return unstable
