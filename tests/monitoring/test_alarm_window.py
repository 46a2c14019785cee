"""The programme of a window against the truth: whatever a plant of the box really does is one of its solutions."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
import pytest

import obsynth
from obsynth.monitoring.alarms.proof_window import Programme, WindowData, WindowRows, window_programme
from obsynth.plants.transformations.uncertain_plant import affine_plant

STEPS = 5
BOUNDS = np.array([0.3, 0.2, 0.1])  # the disturbance, process noise, sensor noise


def plant(variation: str) -> obsynth.DescriptorSystem:
    """Constants in all matrices, in forms that leave remainders."""
    return obsynth.uncertain_system(
        {
            "E": [["p * p", 0.0], [0.0, "1 + 0.2 * q * q"]], "A": [["0.5 * p * q", 0.2], [0.1, "0.4 * p"]],
            "B": [["p"], ["q * q"]], "C": [["q", "0.3 * p * p"]], "D": [["0.5 * p * q"]],
            "Bd": [["p * p"], [0.4]], "Dd": [["q * p"]], "Bf": [[1.0], [0.0]], "Bw": [[0.7, 0.0], [0.2, 0.0]],
            "Dw": [[0.0, 0.9]], "dt": 1.0,
        },
        {"p": {"nominal": 1.0, "range": [0.9, 1.15]}, "q": {"nominal": 0.8, "tolerance": "10 %"}}, variation=variation,
    )  # fmt: skip


def exact(values: dict[str, float]) -> dict[str, np.ndarray]:
    """The matrices, written by hand."""
    p, q = values["p"], values["q"]
    return {
        "E": np.diag([p * p, 1 + 0.2 * q * q]), "A": np.array([[0.5 * p * q, 0.2], [0.1, 0.4 * p]]),
        "B": np.array([p, q * q]), "C": np.array([q, 0.3 * p * p]), "D": 0.5 * p * q, "Bd": np.array([p * p, 0.4]),
        "Dd": q * p,
    }  # fmt: skip


def happened(variation: str, seed: int) -> tuple[Any, WindowData, np.ndarray]:
    """Return family, data and the true values of all variables of the programme, with everything at its bounds."""
    rng, given = np.random.default_rng(seed), plant(variation)
    family = affine_plant(given)
    count = STEPS if variation == "varying" else 1
    at = rng.choice([-1.0, 1.0, 0.3], (count, 2))
    u = rng.choice([-2.0, 2.0], (STEPS, 1))
    d = BOUNDS * rng.choice([-1.0, 1.0], (STEPS, 3))
    x, y, ahead = np.zeros((STEPS, 2)), np.zeros((STEPS, 1)), rng.choice([-1.0, 1.0], 2)
    for k in range(STEPS):
        m = exact(family.box.values(at[k if count > 1 else 0]))
        x[k] = np.linalg.solve(m["E"], ahead) if k else ahead
        y[k] = m["C"] @ x[k] + m["D"] * u[k] + m["Dd"] * d[k, 0] + 0.9 * d[k, 2]
        ahead = m["A"] @ x[k] + m["B"] * u[k] + m["Bd"] * d[k, 0] + np.array([0.7, 0.2]) * d[k, 1]
    assert np.array_equal(family.coordinates, np.eye(2))
    sides = rng.choice([0.0, 0.4], x.shape)
    data = WindowData(u, y, x - sides, x + 0.4 - sides)
    pairs = [(i, j) for i in range(2) for j in range(2) if any(
        family.matrices[name].parts[i][:, j].any() for name in "AEC")]  # fmt: skip
    each = at if count > 1 else np.tile(at, (STEPS, 1))
    products = np.array([[each[k, i] * x[k, j] for i, j in pairs] for k in range(STEPS)])
    return family, data, np.concatenate([x.ravel(), d.ravel(), at.ravel(), products.ravel(), [0.0]])


def scaled(programme: Programme, truth: np.ndarray) -> np.ndarray:
    """The truth in the units of the programme."""
    return truth / programme.below.scales


@pytest.mark.parametrize("variation", ["constant", "varying"])
@pytest.mark.parametrize("seed", range(12))
def test_what_happened_is_a_solution(variation: str, seed: int) -> None:
    family, data, truth = happened(variation, seed)
    programme = window_programme(family, BOUNDS, data)
    found = scaled(programme, truth)
    assert len(found) == len(programme.lower)
    assert np.all(found >= programme.lower - 1e-12)
    assert np.all(found <= programme.upper + 1e-12)
    equal, below = programme.matrices()
    if programme.equal.right:
        assert np.abs(equal @ found - programme.equal.right).max() < 1e-12
    assert np.max(below @ found - programme.below.right) < 1e-12


@pytest.mark.parametrize("variation", ["constant", "varying"])
def test_what_did_not_happen_is_none(variation: str) -> None:
    """Outputs, states, products and dynamics each bind: a value far from the truth breaks some row."""
    family, data, truth = happened(variation, 3)
    programme = window_programme(family, BOUNDS, data)
    equal, below = programme.matrices()
    for place in range(len(truth) - 1):
        other = truth.copy()
        other[place] += 5.0
        found = scaled(programme, other)
        inside = np.all(found <= programme.upper) and np.all(found >= programme.lower)
        rows = np.max(below @ found - programme.below.right, initial=0.0)
        same = not programme.equal.right or np.abs(equal @ found - programme.equal.right).max() < 1e-9
        assert not (inside and same and rows < 1e-9), place


def test_the_proved_least_is_never_above_the_solvers() -> None:
    """A dual bound with any multipliers, in exact arithmetic, is at most the least value that exists."""
    family, data, _ = happened("constant", 1)
    data = WindowData(data.u, data.y + np.array([[4.0], [0.0], [4.0], [0.0], [0.0]]), data.low, data.high)
    programme = window_programme(family, BOUNDS, data)
    from obsynth.monitoring.alarms.proof_file import solved

    equal, below = solved(programme)
    from scipy.optimize import linprog

    cost = np.zeros(len(programme.lower))
    cost[-1] = 1.0
    matrix_equal, matrix_below = programme.matrices()
    given = {"A_eq": matrix_equal, "b_eq": programme.equal.right} if programme.equal.right else {}
    least = linprog(cost, A_ub=matrix_below, b_ub=programme.below.right, method="highs",
                    bounds=np.stack([programme.lower, programme.upper], axis=1), **given).fun  # fmt: skip
    bound = programme.proved_least(equal, below)
    assert isinstance(bound, Fraction)
    assert 0.0 < float(bound) <= least * (1.0 + 1e-9)
    assert float(bound) == pytest.approx(least, rel=1e-6)
    rng = np.random.default_rng(0)
    for _ in range(20):
        some = programme.proved_least(
            equal * rng.uniform(0.0, 2.0, equal.shape), below * rng.uniform(0.0, 2.0, below.shape)
        )
        assert float(some) <= least * (1.0 + 1e-9)
    assert float(programme.proved_least(0.0 * equal, -below)) <= least


def test_a_multiplier_of_the_wrong_sign_proves_nothing() -> None:
    """Of ``x <= 10`` with ``|x| <= 1`` nothing follows, whatever number a certificate holds for it."""
    scales = np.ones(2)
    equal, below = WindowRows(scales), WindowRows(scales)
    below.add({0: 1.0}, 10.0)
    programme = Programme(equal, below, np.array([-1.0, 0.0]), np.array([1.0, 1e3]))
    assert programme.proved_least(np.zeros(0), np.array([5.0])) <= 0
    assert programme.proved_least(np.zeros(0), np.array([-5.0])) <= 0


def least_share(given: dict[str, Any], y: list[float]) -> float:
    """The proved least share for one sample of an exact plant with every state between -1 and 1."""
    from obsynth.monitoring.alarms.proof_file import solved

    family = affine_plant(obsynth.DescriptorSystem(**given, dt=1.0))
    n = len(given["A"])
    data = WindowData(np.zeros((1, 0)), np.array([y]), -np.ones((1, n)), np.ones((1, n)))
    programme = window_programme(family, np.zeros(0), data)
    return float(programme.proved_least(*solved(programme)))


def test_the_least_share_worked_by_hand() -> None:
    """A row in units of 4: x <= 3 + 4 t from the output, x <= 1 + 4 t from the bounds, so t = 1/4; and the other way.

    The equation 0 = x1 - x2 of the last sample counts too: outputs of 0.5 and -0.5 need 0.5 - 4 t = 4 t - 0.5.
    """
    single = {"E": None, "A": [[0.5]], "C": [[1.0]]}
    assert least_share(single, [3.0]) == pytest.approx(0.25, rel=1e-9)
    assert least_share(single, [-3.0]) == pytest.approx(0.25, rel=1e-9)
    assert least_share(single, [0.9]) == pytest.approx(0.0, abs=1e-12)
    equation = {"E": np.diag([1.0, 0.0]), "A": [[0.5, 0.0], [1.0, -1.0]], "C": np.eye(2)}
    assert least_share(equation, [0.5, -0.5]) == pytest.approx(0.125, rel=1e-9)
    assert least_share(equation, [0.5, 0.5]) == pytest.approx(0.0, abs=1e-12)


def test_rounding_of_many_inputs_is_within_the_remainder() -> None:
    """One input of 1 and 799 of 2^-54: a sum in doubles may lose all of these, and the programme must not."""
    given = obsynth.DescriptorSystem(None, [[0.5]], np.ones((1, 800)), C=[[1.0]], dt=1.0)
    u = np.full((2, 800), 2.0**-54)
    u[:, 0] = 1.0
    data = WindowData(u, np.zeros((2, 1)), -np.ones((2, 1)), np.ones((2, 1)))
    rows = window_programme(affine_plant(given), np.zeros(0), data).below
    # The first two rows are x(1) - 0.5 x(0) = B u, from above and below, in units of powers of two.
    above, below = (Fraction(side) * sign for side, sign in zip(rows.right[:2], (1, -1), strict=True))
    unit = Fraction(float(rows.scales[1])) / Fraction(rows.values[0][rows.columns[0].index(1)])
    exact = sum(map(Fraction, u[0].tolist()), start=Fraction(0))
    assert below * unit <= exact <= above * unit
    assert float(above * unit - below * unit) < 1e-12


def test_a_constant_of_a_sensor_alone_explains_what_it_can() -> None:
    """``y = q x`` with x = 1 and q in 0.72 .. 0.88: an output of 0.88 is explained, one of 0.95 is not."""
    from obsynth.monitoring.alarms.proof_file import solved

    given = obsynth.uncertain_system(
        {"A": [[0.5]], "C": [["q"]], "dt": 1.0}, {"q": {"nominal": 0.8, "tolerance": "10 %"}}
    )
    for y, explained in ((0.88, True), (0.72, True), (0.95, False)):
        data = WindowData(np.zeros((1, 0)), np.array([[y]]), np.ones((1, 1)), np.ones((1, 1)))
        programme = window_programme(affine_plant(given), np.zeros(0), data)
        assert (float(programme.proved_least(*solved(programme))) <= 1e-9) == explained
