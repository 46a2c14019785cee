"""The realisation of an optimal filter that is shipped: of several, one whose stored numbers keep the digits needed.

What passes of a fault that the outputs hardly show is a small difference of large numbers: which realisation keeps it
depends on the plant, and on the processor.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import partial
from typing import NamedTuple

import numpy as np

from obsynth.errors import SolverError
from obsynth.methods.optimal_filter.checks import FAULT_MAP_SHARE, fault_map_missed
from obsynth.methods.optimal_filter.common_numbers import with_fault_map
from obsynth.methods.optimal_filter.fault_maps import Designed, FaultMap
from obsynth.methods.optimal_filter.late_outputs import later_inputs
from obsynth.methods.optimal_filter.passed_at_once import with_digits_of, without_white_noise
from obsynth.methods.optimal_filter.realisation import (
    filter_with_error_system,
    observer_of,
    realisations,
    realised_behind_delay,
)
from obsynth.methods.optimal_filter.realised_filter import RealisedFilter, before_delay, error_model_of
from obsynth.numerics.ranks import RANK_TOLERANCE
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.plant_units import PlantUnits
from obsynth.verification.constant_faults import STEADY_ERROR
from obsynth.verification.error_system import IDENTITY_SHARE

#: The fault map of a filter for added noise is kept to this share, which leaves room below what verification allows.
EXACT_SHARE = 0.3 * FAULT_MAP_SHARE
#: What it misses of a constant fault, in doubles, leaves as much room.
STEADY_SHARE = 0.3 * STEADY_ERROR


def realisation_of(
    plant: DescriptorSystem, chosen: Designed, norm: str
) -> tuple[RealisedFilter, LinearObserver, float]:
    """Return a filter's realisation with its observer, and by which share it misses its fault map."""
    problem, fault_map = chosen.problem, chosen.fault_map
    later = later_inputs(plant, chosen.filter) if problem.shift else 0
    outputs = PlantUnits.of(plant).rounded().outputs
    ways = realisations(chosen.filter, outputs, discrete=plant.is_discrete)
    # One of few states may follow the plant by states that y does not reach.
    ways += [chosen.filter] if chosen.least is not None else []
    white = norm == "h2" and not plant.is_discrete
    if white:
        ways = without_white_noise(plant, fault_map, ways)
    finished = partial(with_digits_of, plant, fault_map) if white else _unchanged
    longest = problem.window + problem.shift
    follower = (
        realised_behind_delay(plant, ways, longest, later)
        if later
        else filter_with_error_system(plant, ways, longest, finished=finished)
    )
    observer, missed_identities, missed = _followed_by(plant, fault_map, follower)
    if not missed_identities <= IDENTITY_SHARE:
        raise SolverError(
            "The numbers of the filter of least gain follow the plant by rounding only, as none of its outputs shows "
            f"its states by more: the result is inconclusive. Take norm: {'hinf' if norm == 'h2' else 'h2'}, or a "
            "reference model of a hundredth of the bandwidth: either gave a filter where this was seen."
        )
    first = Realised(follower, observer, missed, _steady_error(plant, fault_map, observer))
    if first.keeps_digits:
        return first[:3]
    others = [first, *_of_the_fault_map(plant, fault_map.behind_delay(later), [follower])]
    if not later and not any(other.keeps_digits for other in others):
        # A realisation of another size may keep digits that this one loses, on one processor and not on another.
        for way in ways:
            with suppress(SolverError):
                one = filter_with_error_system(plant, [way], longest, finished=finished)
                others += _of_the_fault_map(plant, fault_map, [one])
    best = min(others, key=lambda other: (not other.keeps_digits, max(other.shares)))
    return best[:3]


class Realised(NamedTuple):
    """A filter with its observer, the share by which it misses its fault map, and its error of a constant fault."""

    follower: RealisedFilter
    observer: LinearObserver
    missed: float
    steady_error: float

    @property
    def shares(self) -> tuple[float, float]:
        """What is missed, of what is allowed."""
        return self.missed / FAULT_MAP_SHARE, self.steady_error / STEADY_ERROR

    @property
    def keeps_digits(self) -> bool:
        """Whether what is missed leaves room below what verification allows."""
        return self.missed <= EXACT_SHARE and self.steady_error <= STEADY_SHARE


def _of_the_fault_map(
    plant: DescriptorSystem, fault_map: FaultMap, followers: Sequence[RealisedFilter]
) -> Iterator[Realised]:
    """Yield the filters whose T and B, changed by rounding, make the faults pass by their fault map."""
    for follower in followers:
        exact = with_fault_map(plant, fault_map, follower)
        observer, missed_identities, missed = _followed_by(plant, fault_map, exact)
        if missed_identities <= IDENTITY_SHARE:
            yield Realised(exact, observer, missed, _steady_error(plant, fault_map, observer))


def _steady_error(plant: DescriptorSystem, fault_map: FaultMap, observer: LinearObserver) -> float:
    """Return by how much an exact filter misses a unit of constant faults, in doubles; zero where nothing is steady."""
    if not fault_map.exact or not observer.fault_names:
        return 0.0
    point = 1.0 if plant.is_discrete else 0.0
    steady = point * plant.E - plant.A
    if not np.linalg.cond(steady) < 1.0 / RANK_TOLERANCE:
        return 0.0
    try:
        states = np.linalg.solve(steady, plant.Bf)
        outputs = plant.C @ states + plant.Df
        held = np.linalg.solve(point * np.eye(observer.order) - observer.Az, observer.By @ outputs)
    except np.linalg.LinAlgError:
        return 0.0
    missed = observer.Cz @ held + observer.Dy @ outputs - np.eye(plant.nf)
    return float(np.max(np.abs(missed), initial=0.0)) if np.all(np.isfinite(missed)) else 0.0


def _followed_by(
    plant: DescriptorSystem, fault_map: FaultMap, follower: RealisedFilter
) -> tuple[LinearObserver, float, float]:
    """Return the observer of a filter, and by which shares it misses what it follows and an exact fault map."""
    rows = len(follower.C)
    names = plant.fault_names if rows == plant.nf else tuple(f"reference {i + 1}" for i in range(rows))
    observer = observer_of(plant, follower, names, fault_map.delays or (0,) * rows)
    observer = before_delay(observer, follower.later)
    model = error_model_of(plant, observer, follower)
    return observer, model.missed(), fault_map_missed(model, fault_map)[0] if fault_map.exact else 0.0


def _unchanged(follower: RealisedFilter) -> RealisedFilter:
    return follower
