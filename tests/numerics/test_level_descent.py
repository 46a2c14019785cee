"""The descent to the least level, on equations whose least level is known."""

import math

import numpy as np
import pytest

from obsynth.numerics.central_filter import NOISE_WEIGHTS, USUAL_WEIGHT, last_found
from obsynth.numerics.injection_problem import Injection
from obsynth.numerics.least_level import GammaIteration

TOLERANCE = 1e-7


class Gains:
    """A problem whose filters carry their true gain."""

    def achieved_gain(self, injection):
        return float(injection.R[0, 0])


class Equation:
    """An equation with a given margin at each level, none where it is not positive; counts what it is asked."""

    problem = Gains()

    def __init__(self, margin, promise=lambda level: level):
        self.margin, self.promise, self.asked = margin, promise, []

    def filter_and_margin(self, level):
        self.asked.append(level)
        margin = self.margin(level)
        if not margin > 0.0:
            return None, 0.0
        return Injection(np.full((1, 1), self.promise(level)), np.zeros((1, 1))), margin

    def filter_at(self, level):
        return self.filter_and_margin(level)[0]


def straight(level):
    """Nothing but the level changes: its square less that of the least."""
    return 1.0 - (0.3 / level) ** 2


def curved(level):
    """A solution that grows towards the least level, 0.3."""
    return 1.0 - (0.3 / level) ** 2 * (1.0 + 4.0 * (level - 0.3) / level) / (1.0 + 6.0 * (level - 0.3) / level)


def jump(level):
    """No solution below 0.3, where the margin has not vanished."""
    return 0.2 + math.sqrt(level - 0.3) if level >= 0.3 else 0.0


@pytest.mark.parametrize(("margin", "most"), [(straight, 7), (curved, 12), (jump, 45)])
def test_the_least_level_is_found_in_few_steps(margin, most):
    equation = Equation(margin)
    descent = GammaIteration(equation, 0.0, 1.0, TOLERANCE)
    descent.run(0.5)
    injection, gain = descent.best()
    assert 0.3 <= gain <= 0.3 * (1.0 + 3.0 * TOLERANCE)
    assert gain == descent.high == injection.R[0, 0]
    assert len(equation.asked) <= most
    assert descent.settled == (margin is not jump)


def test_a_first_level_next_to_the_best_that_fails_ends_the_descent():
    equation = Equation(straight)
    descent = GammaIteration(equation, 0.0, 0.3, TOLERANCE)
    descent.run(0.3 * (1.0 - 1e-6))
    assert len(equation.asked) == 1
    assert descent.best() is None


def test_a_promise_broken_next_to_the_least_level_is_left_for_the_lowest_that_is_kept():
    kept = 0.3 * (1.0 + 1e-5)
    descent = GammaIteration(
        Equation(straight, lambda level: level if level >= kept else math.inf), 0.0, 1.0, TOLERANCE
    )
    descent.run(0.5)
    assert descent.high < kept
    _, gain = descent.best()
    assert kept <= gain <= 0.3 * (1.0 + 2e-5)


def test_solutions_whose_margin_grows_downwards_are_not_believed():
    # Below 0.5 the equation has another solution, which is not the stabilising one.
    equation = Equation(lambda level: 1.0 - (0.45 / level) ** 2 if level >= 0.5 else 0.9, lambda level: level)
    descent = GammaIteration(equation, 0.0, 1.0, TOLERANCE)
    descent.run(0.6)
    assert 0.5 <= descent.high <= 0.5 * (1.0 + 2.0 * TOLERANCE)
    assert not descent.settled


def test_where_the_first_promise_is_broken_each_is_judged():
    equation = Equation(straight, lambda level: level if level >= 0.7 else math.inf)
    descent = GammaIteration(equation, 0.0, 1.0, TOLERANCE)
    descent.run(0.5)
    assert descent.best() is None
    _, gain = descent.judged_again(1.0).best()
    assert 0.7 <= gain <= 0.7 * (1.0 + 2.0 * TOLERANCE)


def test_a_wary_descent_judges_the_first_and_gives_up_in_a_narrow_bracket():
    broken = GammaIteration(Equation(straight, lambda level: math.inf), 0.0, 1.0, TOLERANCE, expects_rounding=True)
    broken.run(1.0 - 1e-6)
    assert not broken.reached
    equation = Equation(lambda level: 1.0 if level >= 0.9995 else 0.0)
    narrow = GammaIteration(equation, 0.999, 1.0, TOLERANCE, expects_rounding=True)
    narrow.run(1.0 - 1e-6)
    assert len(narrow.reached) >= 1
    assert sum(level < 0.9995 for level in equation.asked) == 3


@pytest.mark.parametrize("places", [range(len(NOISE_WEIGHTS)), range(7, 11), range(5, 6), range(4, 4)])
@pytest.mark.parametrize("begin", [0, 8, USUAL_WEIGHT, 99])
def test_the_last_weight_that_is_found_does_not_hang_on_where_the_search_begins(places, begin):
    for kept in range(places.start, places.stop + 1):
        asked = []

        def tried(place, kept=kept, asked=asked):
            asked.append(place)
            return f"filter {place}" if place < kept else None

        expected = (kept - 1, f"filter {kept - 1}") if kept > places.start else None
        assert last_found(tried, places, begin) == expected
        assert len(asked) == len(set(asked)) <= 2 * math.log2(len(places) + 1) + 1
        assert set(asked) <= set(places)


def test_the_last_weight_takes_few_trials_next_to_the_usual_one():
    for kept in (USUAL_WEIGHT, USUAL_WEIGHT + 1, USUAL_WEIGHT + 2):
        asked = []
        last_found(lambda place, k=kept, a=asked: a.append(place) or (place < k or None), range(31), USUAL_WEIGHT)
        assert len(asked) <= 4
