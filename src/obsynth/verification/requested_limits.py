"""Checks that a design keeps the limits in its options: decay, region, poles, gains.

A design from a file is printed with its options.  Without these checks a reader would believe that a requested rate,
region or gain is reached.
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

#: How an option bounds a claim; "factor": the option is a rate, and the claim a factor per sample.
Bound: TypeAlias = Literal["at least", "at most", "equal", "factor"]

#: The claims that an option bounds, one for each number of the option, by the option's name.
Limits: TypeAlias = Mapping[str, tuple[tuple[str, Bound], ...]]

#: Poles may lie outside a region by this share of the terms of its inequality, and differ from requested poles by this
#: share of their size: they were placed and recomputed in double precision.
POLE_TOLERANCE = 1e-4

#: Claims may exceed a requested limit by this share: the two are computed in different coordinates.
CLAIM_TOLERANCE = 1e-6

_SOURCE = "options, and the stored numbers"


def requested_rows(
    design: ObserverDesign,
    limits: Limits,
    placed: frozenset[str],
    fixed_modes: Callable[[ObserverDesign], Sequence[complex]],
) -> Iterator[Check]:
    """Yield a check for each limit in the options.

    Parameters
    ----------
    design : ObserverDesign
        The design.
    limits : mapping
        The claims that options bound.
    placed : frozenset of str
        Which of decay, region and poles are requests on the eigenvalues of the observer.
    fixed_modes : callable
        Returns the modes that no gain moves; called only where a check fails without it.
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
        # A scheduled observer has no poles: claims bound its errors instead.
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
    """The poles of an observer, each kind computed when a check first needs it."""

    design: ObserverDesign
    observer: LinearObserver
    fixed_modes: Callable[[ObserverDesign], Sequence[complex]]

    @cached_property
    def poles(self) -> ComplexArray:
        """All poles, more accurate than in double precision where that is affordable."""
        enclosed = enclosed_eigenvalues(self.observer.Az)
        if enclosed is None:
            return poles_of(self.observer)
        return np.array([middle_of(ball) for ball in enclosed], dtype=np.complex128)

    @cached_property
    def fixed(self) -> Sequence[complex]:
        """The modes of the plant that no gain moves."""
        return self.fixed_modes(self.design)

    @cached_property
    def movable(self) -> ComplexArray:
        """The poles without those that agree with a fixed mode of the plant."""
        poles, fixed = self.poles, np.asarray(self.fixed, dtype=np.complex128)
        if not fixed.size or fixed.size > poles.size:
            return poles
        same = [group.computed[group.needed <= POLE_TOLERANCE] for group in pole_groups(poles, fixed, self.observer.dt)]
        return np.delete(poles, np.concatenate(same))


def region_of(region: Any, dt: float) -> LMIRegion:
    """Return the region of an option: by decay, radius and damping, by its matrices, or as in `checked_region`."""
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
    """Yield a text for each claim that exceeds the limit of an option."""
    claims, value = design.certificate.claims, design.options[name]
    numbers = list(value) if len(bounds) > 1 and isinstance(value, (list, tuple)) else [value]
    if len(numbers) != len(bounds) or not all(map(is_finite_number, numbers)):
        yield f"{name} is not {len(bounds)} number{'s' if len(bounds) > 1 else ''}"
        return
    for number, (claim, bound) in zip(map(float, numbers), bounds, strict=True):
        reached = claimed(claims, claim)
        if bound == "factor":
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
    """Return the check that all modes except the fixed ones decay at a rate."""
    observer = modes.observer
    row = decay_row(observer, rate)
    claim = "every mode decays at the rate (1/s) of the option decay, or faster"
    if row.passed or not len(modes.fixed):
        return replace(row, name="requested decay", claim=claim)
    # A fixed mode may be slower: check the others, as poles in a half plane or disk.
    inside = _region_row(modes, NamedRegion(decay=rate).as_inequality(observer.dt))
    return replace(inside, name="requested decay", claim=f"{claim}, but for the {len(modes.fixed)} that no gain moves")


def _region_row(modes: _Modes, region: LMIRegion) -> Check:
    """Return the check that the poles lie in a region, relative to the terms of its inequality.

    The modes that no gain moves are computed and left out only if some pole lies outside.
    """
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
    """Return how far the farthest value lies outside a region, relative to the terms of its inequality."""
    size = np.linalg.norm(region.L, 2) + 2.0 * np.abs(values) * np.linalg.norm(region.M, 2)
    return float(np.max(-region.margins(values) / np.where(size > 0.0, size, 1.0), initial=-1.0))


def _readings(poles: Any) -> list[list[complex]]:
    """Return both meanings of a list of poles: a pair of numbers is one complex pole, or two poles of one filter."""
    if not isinstance(poles, (list, tuple, np.ndarray)):
        raise SpecError(f"poles are no list, but {shown(poles)}.", path="poles")
    with_pairs, with_lists = list[complex](), list[complex]()
    for entry in poles:
        several = isinstance(entry, (list, tuple, np.ndarray))
        with_lists += [as_pole(pole) for pole in entry] if several else [as_pole(entry)]
        paired = several and len(entry) == 2 and all(map(is_number, entry))
        with_pairs += [as_pole(pole) for pole in entry] if several and not paired else [as_pole(entry)]
    return [with_pairs, with_lists]
