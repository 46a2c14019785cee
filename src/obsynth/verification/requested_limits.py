"""Limits that the options of a design state (decay, region, poles, gains), against what its stored numbers reach.

A design that is read from a file is printed with its options.  A rate, a region or a gain that was asked for and is not
reached would be read as if it were.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Literal, TypeAlias

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arguments import is_finite_number, is_number, real_array, shown
from obsynth.numerics.arrays import ComplexArray
from obsynth.numerics.regions import LMIRegion, NamedRegion, checked_region
from obsynth.numerics.requested_poles import as_pole
from obsynth.numerics.spectra import multiple_miss, pole_groups
from obsynth.observers.linear.modes import poles_of
from obsynth.observers.linear.observer import LinearObserver
from obsynth.proofs.extended_balls import enclosed_eigenvalues, middle_of
from obsynth.results.checks import Check, nothing_wrong, upper_bound_check
from obsynth.results.design import ObserverDesign
from obsynth.verification.claims import claimed
from obsynth.verification.inequalities import decay_row

#: Which side of a claim an option bounds; a factor is that by which errors decay in a sample.
Bound: TypeAlias = Literal["at least", "at most", "equal", "factor"]

#: For an option, the claim that it bounds; of a list of numbers, one for each.
Limits: TypeAlias = Mapping[str, tuple[tuple[str, Bound], ...]]

#: Poles may be outside a region by this share of the terms of its inequality, and miss those asked for by this share
#: of their size: they were placed, and found again, in double precision.
POLE_TOLERANCE = 1e-4

#: Claims may miss what was asked for by this share: the two are compared in the units of different coordinates.
CLAIM_TOLERANCE = 1e-6

_SOURCE = "options, and the stored numbers"


def requested_rows(
    design: ObserverDesign,
    limits: Limits,
    placed: frozenset[str],
    fixed_modes: Callable[[ObserverDesign], Sequence[complex]],
) -> Iterator[Check]:
    """Yield a row for each number that the options ask for.

    ``placed`` holds which of decay, region and poles are about the eigenvalues of the observer; ``fixed_modes`` returns
    those that no gain moves, and is called where a row fails without it.
    """
    options, observer = design.options, design.observer
    requested = {name: bounds for name, bounds in limits.items() if options.get(name) is not None}
    if requested:
        wrong = [text for name, bounds in requested.items() for text in _beyond(design, name, bounds)]
        yield nothing_wrong(
            "requested bounds",
            f"what is claimed is within {', '.join(requested)} of the options",
            wrong,
            source=_SOURCE,
        )
    wanted = {name: options[name] for name in ("decay", "region", "poles") if name in placed and name in options}
    wanted = {name: value for name, value in wanted.items() if value is not None}
    if not isinstance(observer, LinearObserver):
        # One that changes with the scheduling has no poles: what bounds its errors is a claim.
        wrong = [name for name in wanted if name not in limits]
        if wrong:
            claim = "no poles are requested of an observer that changes with the scheduling"
            yield nothing_wrong("requested poles", claim, wrong, source=_SOURCE)
        return
    modes = _Modes(design, observer, fixed_modes)
    decay, region, poles = (wanted.get(name) for name in ("decay", "region", "poles"))
    if decay is not None and not is_finite_number(decay):
        yield nothing_wrong("requested decay", "decay is a number", [f"it is {shown(decay)}"], source=_SOURCE)
    elif decay is not None and float(decay) > 0.0 and observer.order:
        yield _decay_row(modes, float(decay))
    try:
        where = None if region is None else region_of(region, observer.dt)
        readings = [] if poles is None else _readings(poles)
    except (SpecError, TypeError, ValueError) as error:
        yield nothing_wrong("requested poles", "region and poles are readable", [str(error)], source=_SOURCE)
        return
    if where is not None and observer.order:
        yield _region_row(modes, where)
    if readings:
        missed = min(multiple_miss(modes.poles, reading, observer.dt) for reading in readings)
        yield upper_bound_check(
            "requested poles",
            "the poles of the options are among those of the observer, each within this share of its size; m equal "
            "ones by their mean, and each within the m-th root",
            missed,
            POLE_TOLERANCE,
            source=_SOURCE,
        )


@dataclass(frozen=True, eq=False)
class _Modes:
    """The poles of an observer, computed once and where a row asks for them."""

    design: ObserverDesign
    observer: LinearObserver
    fixed_modes: Callable[[ObserverDesign], Sequence[complex]]

    @cached_property
    def poles(self) -> ComplexArray:
        """All of them, with more digits than double precision gives where that is practical."""
        enclosed = enclosed_eigenvalues(self.observer.Az)
        if enclosed is None:
            return poles_of(self.observer)
        return np.array([middle_of(ball) for ball in enclosed], dtype=np.complex128)

    @cached_property
    def fixed(self) -> Sequence[complex]:
        """Those that no gain moves, from the plant."""
        return self.fixed_modes(self.design)

    @cached_property
    def movable(self) -> ComplexArray:
        """The poles without the fixed ones, each of which must be where the plant has it."""
        poles, fixed = self.poles, np.asarray(self.fixed, dtype=np.complex128)
        if not fixed.size or fixed.size > poles.size:
            return poles
        same = [group.computed[group.needed <= POLE_TOLERANCE] for group in pole_groups(poles, fixed, self.observer.dt)]
        return np.delete(poles, np.concatenate(same))


def region_of(region: Any, dt: float) -> LMIRegion:
    """Return the region of an option: by name (decay, radius, damping), by its matrices, or as `checked_region` takes
    it."""
    if isinstance(region, Mapping) and region.keys() == {"L", "M"}:
        L, M = (real_array(region[name], f"region.{name}") for name in ("L", "M"))
        if L.ndim != 2 or L.shape != L.shape[::-1] or M.shape != L.shape or not np.isfinite([L, M]).all():
            raise SpecError("region: L and M are no square matrices of one size.", path="region")
        return LMIRegion(L, M, "the region")
    if isinstance(region, Mapping) and set(region) <= {field.name for field in fields(NamedRegion)}:
        stated = {name: value for name, value in region.items() if value is not None}
        return NamedRegion.of(stated, dt).as_inequality(dt)
    return checked_region(region)


def _beyond(design: ObserverDesign, name: str, bounds: tuple[tuple[str, Bound], ...]) -> Iterator[str]:
    """Yield what is claimed and is not within an option."""
    claims, value = design.certificate.claims, design.options[name]
    numbers = list(value) if len(bounds) > 1 and isinstance(value, (list, tuple)) else [value]
    if len(numbers) != len(bounds) or not all(map(is_finite_number, numbers)):
        yield f"{name} is not {len(bounds)} number{'s' if len(bounds) > 1 else ''}"
        return
    for number, (claim, bound) in zip(map(float, numbers), bounds, strict=True):
        reached = claimed(claims, claim)
        if bound == "factor":  # of a rate, in a sample
            number, bound = float(np.exp(-number * design.observer.dt)), "at most"
        slack = CLAIM_TOLERANCE * abs(number)
        holds = {
            "at least": reached >= number - slack,
            "at most": reached <= number + slack,
            "equal": abs(reached - number) <= slack,
        }[bound]
        if not holds:
            yield f"{claim} {reached:.6g}, where {name} asks for {bound} {number:.6g}"


def _decay_row(modes: _Modes, rate: float) -> Check:
    """Return the row that all modes but the fixed ones decay at a rate."""
    observer = modes.observer
    row = decay_row(observer, rate)
    claim = "every mode decays at the rate (1/s) of the option decay, or faster"
    if row.passed or not len(modes.fixed):
        return replace(row, name="requested decay", claim=claim)
    # By the shape of the region: a mode that is fixed may be slower.
    inside = _region_row(modes, NamedRegion(decay=rate).as_inequality(observer.dt))
    return replace(inside, name="requested decay", claim=f"{claim}, but for the {len(modes.fixed)} that no gain moves")


def _region_row(modes: _Modes, region: LMIRegion) -> Check:
    """Return the row that poles lie in a region, relative to the terms of its inequality.

    Where all of them do, those that no gain moves are not asked for."""
    outside = _outside(modes.poles, region)
    if outside > POLE_TOLERANCE:
        outside = _outside(modes.movable, region)
    return upper_bound_check(
        "requested region",
        f"the poles that a gain moves lie in {region}: the farthest outside, relative to the terms",
        outside,
        POLE_TOLERANCE,
        source=_SOURCE,
    )


def _outside(values: ComplexArray, region: LMIRegion) -> float:
    size = np.linalg.norm(region.L, 2) + 2.0 * np.abs(values) * np.linalg.norm(region.M, 2)
    return float(np.max(-region.margins(values) / np.where(size > 0.0, size, 1.0), initial=-1.0))


def _readings(poles: Any) -> list[list[complex]]:
    """Return what a list of poles may mean: a pair of numbers is one pole, or the two of one of several filters."""
    if not isinstance(poles, (list, tuple, np.ndarray)):
        raise SpecError(f"poles are no list, but {shown(poles)}.", path="poles")
    pairs, lists = list[complex](), list[complex]()
    for entry in poles:
        several = isinstance(entry, (list, tuple, np.ndarray))
        lists += [as_pole(pole) for pole in entry] if several else [as_pole(entry)]
        paired = several and len(entry) == 2 and all(map(is_number, entry))
        pairs += [as_pole(pole) for pole in entry] if several and not paired else [as_pole(entry)]
    return [pairs, lists]
