"""Operating regions of nonlinear plants: ranges of signals and of their linear combinations, and slopes in them.

A region is a set of ranges ``low <= expression <= high``, each of a state, a fault, an input or a linear combination of
these such as ``h1 - h2``.  The arguments of nonlinearities get the ranges that follow, with outward rounding, and the
nonlinearities the slopes over the box of their arguments (`obsynth.proofs.slopes`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np

from obsynth.errors import PreconditionError, SpecError
from obsynth.numerics.arguments import is_finite_number, shown
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.transformations.nonlinear_terms import (
    ARGUMENT,
    LinearCombination,
    NonlinearTerms,
    linear_combination,
)
from obsynth.proofs.intervals import Interval
from obsynth.proofs.slopes import slope_over


@dataclass(frozen=True, eq=False)
class RangeOfCombination:
    """``low <= combination <= high``; ``text`` is how it was written."""

    text: str
    combination: LinearCombination
    low: float
    high: float
    given: tuple[float, float]  # as written, with its constant


@dataclass(frozen=True)
class Slope:
    """Between what one nonlinearity rises with one of its arguments."""

    nonlinearity: int
    argument: int
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class OperatingRegion:
    """A region with the terms of a plant in it.

    Parameters
    ----------
    terms : NonlinearTerms
        The plant.
    ranges : tuple of RangeOfCombination
        What the region says.
    arguments : FloatArray
        ``(arguments, 2)``: ranges of the arguments of nonlinearities.
    """

    terms: NonlinearTerms
    ranges: tuple[RangeOfCombination, ...]
    arguments: FloatArray

    @classmethod
    def of(cls, terms: NonlinearTerms, region: Mapping[str, Any]) -> OperatingRegion:
        """Return the region of ranges by name or linear expression.

        Raises
        ------
        SpecError
            A range is empty or not finite, or an expression is unknown or not linear.
        PreconditionError
            An argument of a nonlinearity has no finite range.
        """
        if not isinstance(region, Mapping) or not region:
            raise SpecError(
                "region must name ranges, such as {'h2': [0.1, 0.6], 'h1 - h2': [0.02, 0.55]}.", path="region"
            )
        known = (*terms.names, *terms.input_names)
        ranges = tuple(_range(str(text), ends, known) for text, ends in region.items())
        # Of known inputs alone plant and observer have the same: no slope depends on their ranges.
        moved = [each for each in terms.nonlinearities if terms.state_parts[list(each.arguments)].any()]
        needed = {j for each in moved for j in each.arguments}
        arguments = np.array(
            [
                _argument_range(each, ranges) if j in needed else (-np.inf, np.inf)
                for j, each in enumerate(terms.arguments)
            ]
        ).reshape(-1, 2)
        return cls(terms, ranges, arguments)

    def slopes(self) -> tuple[Slope, ...]:
        """Return the slopes of every nonlinearity by every argument in which there are states, enclosed.

        Raises
        ------
        PreconditionError
            A slope is not bounded, or a nonlinearity jumps.
        """
        slopes = []
        for place, nonlinearity in enumerate(self.terms.nonlinearities):
            box = {f"{ARGUMENT}{j}": tuple(map(float, self.arguments[j])) for j in nonlinearity.arguments}
            for j in nonlinearity.arguments:
                if not self.terms.state_parts[j].any():
                    continue  # known inputs alone: plant and observer have the same
                try:
                    slope = slope_over(nonlinearity.expression, f"{ARGUMENT}{j}", box)  # type: ignore[arg-type]
                except PreconditionError as error:
                    raise PreconditionError(self.in_signals(str(error)), condition=error.condition) from None
                if not (np.isfinite(slope.low) and np.isfinite(slope.high)):
                    raise PreconditionError(
                        self.in_signals(f"The slope of {nonlinearity.expression.text} is not bounded over the region."),
                        condition="boundedness",
                    )
                slopes.append(Slope(place, j, slope.low, slope.high))
        return tuple(slopes)

    def in_signals(self, text: str) -> str:
        """Return a text with what each argument is."""
        named = [
            f"{ARGUMENT}{j} = {each.text} in [{low:.6g}, {high:.6g}]"
            for j, (each, (low, high)) in enumerate(zip(self.terms.arguments, self.arguments, strict=True))
            if f"{ARGUMENT}{j}" in text
        ]
        return f"{text} Here {', '.join(named)}." if named else text

    def sentence(self) -> str:
        """Return the region in words."""
        return ", ".join(f"{each.text} in [{each.given[0]:.6g}, {each.given[1]:.6g}]" for each in self.ranges)

    def matrices(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the combinations of z ``(r, n)`` and of inputs ``(r, nu)``, and their ranges ``(r, 2)``."""
        states = np.array([each.combination.over(self.terms.names) for each in self.ranges])
        inputs = np.array([each.combination.over(self.terms.input_names) for each in self.ranges])
        return (
            states,
            inputs.reshape(len(states), len(self.terms.input_names)),
            np.array([[each.low, each.high] for each in self.ranges]),
        )

    def measured(self) -> tuple[tuple[int, int, float], ...]:
        """Return which ranges an output shows: the number of the range, that of the output, and its constant."""
        terms, measured = self.terms, []
        states, inputs, _ = self.matrices()
        for place in range(len(states)):
            for output in range(len(terms.output_names)):
                same = np.array_equal(terms.C[output], states[place]) and not inputs[place].any()
                if same and not terms.Wy[output].any():
                    measured.append((place, output, float(terms.c_y[output])))
        return tuple(measured)


def _range(text: str, ends: Any, known: Sequence[str]) -> RangeOfCombination:
    path = f"region.{text}"
    pair = isinstance(ends, (list, tuple, np.ndarray)) and len(ends) == 2
    if not (pair and all(map(is_finite_number, ends))):
        raise SpecError(f"The range of {text!r} is {shown(ends)}: give [low, high], both finite.", path=path)
    low, high = map(float, ends)
    if not low < high:
        raise SpecError(f"The range of {text!r} is [{low:g}, {high:g}]: give the lower one first.", path=path)
    combination, unit, constant = linear_combination(text, known, path)
    both = sorted((Fraction(end) - constant) / unit for end in (low, high))
    return RangeOfCombination(text, combination, _down(both[0]), -_down(-both[1]), (low, high))


def _down(value: Fraction) -> float:
    """Return the largest double that is not above a rational."""
    nearest = float(value)
    return nearest if Fraction(nearest) <= value else float(np.nextafter(nearest, -np.inf))


def _argument_range(argument: LinearCombination, ranges: Sequence[RangeOfCombination]) -> tuple[float, float]:
    """Return the range of an argument: as stated, and as its signals have it, whichever is narrower."""
    stated = [each for each in ranges if each.combination == argument]
    lows, highs = [each.low for each in stated], [each.high for each in stated]
    single = {each.combination.parts[0][0]: each for each in ranges if len(each.combination.parts) == 1}
    missing = [name for name, _ in argument.parts if name not in single]
    if not missing:
        total = Interval(0.0, 0.0)
        for name, factor in argument.parts:
            share = Interval(_down(factor), -_down(-factor))
            total = total + Interval(single[name].low, single[name].high) * share
        lows.append(total.low)
        highs.append(total.high)
    if not lows:
        raise PreconditionError(
            f"The region has no range of {', '.join(map(repr, missing))}, on which a nonlinearity depends by way of "
            f"{argument.text}: its slopes have no bound. Give the range of {argument.text!r}"
            + ("." if len(argument.parts) == 1 else f", or those of {', '.join(name for name, _ in argument.parts)}."),
            condition="boundedness",
            signals=tuple(missing),
        )
    low, high = max(lows), min(highs)
    if not low < high:
        raise SpecError(f"The ranges leave nothing for {argument.text}: they contradict each other.", path="region")
    return low, high
