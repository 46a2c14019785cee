"""What an observer of a nonlinear plant over a region needs: constant E, independent derivatives, bounded slopes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from obsynth.analysis.existence.condition import Condition, up_to_failure
from obsynth.errors import PreconditionError
from obsynth.plants.dae import DAEModel
from obsynth.plants.operating_region import OperatingRegion
from obsynth.plants.transformations.nonlinear_terms import nonlinear_terms

#: Slopes over whose corners a proof is made one by one: 2 ** 12 = 4096.
MOST_SLOPES = 12
_SOURCE = "observer over a region"


def region_conditions(
    model: DAEModel, region: Mapping[str, Any] | None, faults: Sequence[str]
) -> tuple[Condition, ...]:
    """Return the conditions of an observer over a region; the list ends at the first failure."""
    return up_to_failure(_in_order(model, region, faults))


def _in_order(model: DAEModel, region: Mapping[str, Any] | None, faults: Sequence[str]) -> Iterator[Condition]:
    try:
        terms = nonlinear_terms(model, faults=faults)
    except PreconditionError as error:
        yield Condition(
            error.condition or "form", "E is constant, its derivatives are independent, and no formula jumps", False,
            0.0, 1.0, _SOURCE, str(error), signals=error.signals,
        )  # fmt: skip
        return
    count = len(terms.nonlinearities)
    yield Condition(
        "constant E", "E is constant, its derivatives are independent, and no formula jumps", True, 1.0, 1.0, _SOURCE,
        f"{terms.differential} differential state(s) and fault(s), "
        f"{len(terms.names) - terms.differential} algebraic one(s), {count} nonlinearit{'y' if count == 1 else 'ies'}",
    )  # fmt: skip
    if region is None:
        yield Condition(
            "region stated", "the region is stated", False, 0.0, 1.0, _SOURCE,
            "there is none: give ranges of the signals (option region)",
        )  # fmt: skip
        return
    try:
        slopes = OperatingRegion.of(terms, region).slopes()
    except PreconditionError as error:
        yield Condition(
            "bounded slopes", "every nonlinearity has a bounded slope over the region", False, 0.0, 1.0, _SOURCE,
            str(error), signals=error.signals,
        )  # fmt: skip
        return
    yield Condition(
        "bounded slopes", "every nonlinearity has a bounded slope over the region", True, float(len(slopes)),
        float(len(slopes)), _SOURCE, f"{len(slopes)} slope(s)",
    )  # fmt: skip
    yield Condition(
        "corners", "the slopes have no more corners than can be proved one by one", len(slopes) <= MOST_SLOPES,
        float(len(slopes)), float(MOST_SLOPES), _SOURCE,
        "" if len(slopes) <= MOST_SLOPES else
        f"{len(slopes)} slopes have 2 ** {len(slopes)} corners: write products of one argument as one function of it, "
        "or linearise what hardly bends",
    )  # fmt: skip
