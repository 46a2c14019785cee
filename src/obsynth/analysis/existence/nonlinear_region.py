"""Existence conditions of an observer over a region of a nonlinear plant: constant E, bounded slopes, detectability."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from obsynth.analysis.dae_structure import index_report
from obsynth.analysis.existence.condition import Condition, up_to_failure
from obsynth.analysis.existence.recursive import described_mode
from obsynth.analysis.existence.statements import Evaluator
from obsynth.errors import PreconditionError, counted
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import decide_rank
from obsynth.plants.dae import DAEModel
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.operating_region import OperatingRegion, Slope
from obsynth.plants.signal_names import leading_names
from obsynth.plants.transformations.nonlinear_terms import ARGUMENT, NonlinearTerms, nonlinear_terms

#: Most slopes whose corners are examined one by one: 2 ** 12 = 4096.
MOST_CORNER_SLOPES = 12
#: Most slopes of one block: with errors and their inputs, definiteness of matrices of order 128 is proved.
MOST_SLOPES = 64
_SOURCE = "observer over a region"


def region_conditions(
    model: DAEModel, region: Mapping[str, Any] | None, faults: Sequence[str], dt: float | None
) -> tuple[Condition, ...]:
    """Return the conditions of an observer over a region; the list ends at the first failure.

    ``dt``: seconds between samples, where they are stated."""
    return up_to_failure(_in_order(model, region, faults, dt))


def _in_order(
    model: DAEModel, region: Mapping[str, Any] | None, faults: Sequence[str], dt: float | None
) -> Iterator[Condition]:
    """Yield the conditions, each for a plant that meets those before it."""
    form = "E is constant, its derivatives are independent, and no formula jumps"
    try:
        terms = nonlinear_terms(model, faults=faults)
    except PreconditionError as error:
        yield _of_the_form(error.condition or "form", form, str(error), signals=error.signals)
        return
    if dt is not None:
        report = index_report(model, dt)
        if report.index > 1:
            text = (
                f"index {report.index} at the nominal values, because of the equations "
                f"{', '.join(map(repr, report.equations))}, which do not determine "
                f"{', '.join(map(repr, report.states))}: write the plant in coordinates that meet the constraint by "
                "themselves, such as the angle of a rod in place of the coordinates of its end and its force"
            )
            yield _of_the_form("index", "the plant has index 1", text, value=float(report.index), signals=report.states)
            return
    count = len(terms.nonlinearities)
    yield _of_the_form(
        "constant E",
        form,
        f"{counted(terms.differential, 'differential state or fault', 'differential states and faults')}, "
        f"{len(terms.names) - terms.differential} algebraic, {counted(count, 'nonlinearity', 'nonlinearities')}",
        value=1.0,
    )
    if not terms.differential:
        text = "no state moves and no parameter is a fault: solve the equations in every row"
        yield _of_the_form("states that move", "a state or a fault moves", text)
        return
    if region is None:
        text = "give ranges of the signals (option region)"
        yield _of_the_form("region stated", "the region is stated", text)
        return
    bounded = "every nonlinearity has a bounded slope over the region"
    try:
        place = OperatingRegion.of(terms, region)
        slopes = place.slopes()
    except PreconditionError as error:
        yield _of_the_form("bounded slopes", bounded, str(error), signals=error.signals)
        return
    number = float(len(slopes))
    yield _of_the_form("bounded slopes", bounded, counted(len(slopes), "slope"), value=number, needed=number)
    is_small = len(slopes) <= MOST_SLOPES
    yield Condition(
        "corners", "the slopes are no more than can be proved: at their corners, or in one block",
        is_small, number, float(MOST_SLOPES), _SOURCE,
        "" if is_small else
        f"{len(slopes)} slopes: write products of one argument as one function of it, or linearise what hardly bends",
    )  # fmt: skip
    if is_small:
        yield from _at_values_of_the_slopes(terms, place, slopes)


def _of_the_form(
    name: str, claim: str, detail: str, *, value: float = 0.0, needed: float = 1.0, signals: Sequence[str] = ()
) -> Condition:
    """Return a condition of the method on the form of plant and region; it holds if ``value`` is ``needed``."""
    return Condition(
        name, claim, value == needed, value, needed, _SOURCE, detail, signals=tuple(signals), of_the_method=True
    )


def _at_values_of_the_slopes(
    terms: NonlinearTerms, place: OperatingRegion, slopes: Sequence[Slope]
) -> Iterator[Condition]:
    """Yield the conditions at single values of the slopes: at corners, in the middle, and where one is zero."""
    bounds = np.array([[each.low, each.high] for each in slopes]).reshape(len(slopes), 2)
    # With more slopes the algebraic equations are part of the block that is proved.
    if terms.differential < len(terms.names) and len(slopes) <= MOST_CORNER_SLOPES:
        yield _algebraic_states(terms, slopes, bounds)
    middle = bounds.mean(axis=1)
    yield _detectable(terms, slopes, middle, "in the middle", "with slopes in the middle of their bounds")
    for k in map(int, np.flatnonzero((bounds[:, 0] < 0.0) & (bounds[:, 1] > 0.0) & (middle != 0.0))):
        at_zero = np.where(np.arange(len(middle)) == k, 0.0, middle)
        condition = _detectable(terms, slopes, at_zero, "where a slope is zero", "where the slope of one is zero")
        if not condition.holds:
            text = terms.nonlinearities[slopes[k].nonlinearity].expression.text
            which = place.in_signals(f"This is where the slope of {text!r} by {ARGUMENT}{slopes[k].argument} is zero.")
            # Slopes of several nonlinearities need not take these values at the same time.
            yield replace(condition, of_the_method=True, detail=f"{condition.detail}. {which}")
            return


def _at_slopes(terms: NonlinearTerms, slopes: Sequence[Slope], values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return A and C at values of the slopes."""
    A, C = np.array(terms.A), np.array(terms.C)
    for each, value in zip(slopes, values, strict=True):
        turned = value * terms.state_parts[each.argument]
        A += np.outer(terms.W[:, each.nonlinearity], turned)
        C += np.outer(terms.Wy[:, each.nonlinearity], turned)
    return A, C


def _algebraic_states(terms: NonlinearTerms, slopes: Sequence[Slope], bounds: FloatArray) -> Condition:
    """Return whether the determinant of the algebraic equations has one sign at all corners where it is not zero.

    Where it has both, it is zero between them, and no inequality over the hull of the slopes has a solution.
    """
    nd, names = terms.differential, terms.names[terms.differential :]
    signs = set[float]()
    for corner in itertools.product(*bounds.tolist()):
        A22 = _at_slopes(terms, slopes, np.array(corner))[0][nd:, nd:]
        if decide_rank(A22, expected=len(A22)).full:
            signs.add(float(np.linalg.slogdet(A22)[0]))
    return Condition(
        "index 1 over the region",
        "the algebraic equations determine the algebraic states at all slopes between their bounds",
        len(signs) < 2,
        float(len(signs)),
        1.0,
        _SOURCE,
        f"between two corners the equations no longer determine {', '.join(names)}: give a smaller region, on one side "
        "of where the equations turn"
        if len(signs) > 1
        else "",
        signals=tuple(names) if len(signs) > 1 else (),
        of_the_method=True,
    )


def _detectable(
    terms: NonlinearTerms, slopes: Sequence[Slope], values: FloatArray, where: str, claim: str
) -> Condition:
    """Return whether every mode that does not decay is observable at values of the slopes.

    Otherwise no gain makes the errors decay there, and no certificate over the region exists.
    """
    A, C = _at_slopes(terms, slopes, values)
    E = np.diag([float(place < terms.differential) for place in range(len(A))])
    plant = DescriptorSystem(E, A, C=C, dt=0.0, state_names=terms.names, output_names=terms.output_names)
    lost = Evaluator(plant).hidden_modes().outside
    names: tuple[str, ...] = ()
    if lost:
        mode = complex(lost[0])
        null = np.linalg.svd(np.vstack([A - mode * E, C.astype(complex)]))[2][-1]
        names = leading_names(np.abs(null), terms.names)
    return Condition(
        f"detectable {where}",
        f"{claim}, modes that no output shows decay",
        not lost,
        float(len(lost)),
        0.0,
        _SOURCE,
        f"the mode s = {described_mode(complex(lost[0]))} of {', '.join(names)} is shown by no output and does not "
        "decay: measure something that it moves, or estimate fewer faults"
        if lost
        else "",
        mode=complex(lost[0]) if lost else None,
        signals=names,
    )
