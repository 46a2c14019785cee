"""The bound on what single precision changes, worked by hand for one state."""

from __future__ import annotations

from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest

from obsynth.exporting.float_error import UNIT, float_bounds
from obsynth.methods.guaranteed_test.proofs import down, exact_right_sides
from obsynth.proofs.exact_doubles import rounded_outward


def one_state(pole: float, *, into: float, rise: float = 0.0) -> SimpleNamespace:
    """``z+ = pole z + into y (+ rise (y+ - y))``, told as ``2 z + 0.5 y``."""
    return SimpleNamespace(
        observer=SimpleNamespace(order=1),
        transition={"z": np.array([[pole]]), "y": np.array([[into]])} | ({"rise": np.array([[rise]])} if rise else {}),
        straight=rise != 0.0,
        running=SimpleNamespace(Cz=np.array([[2.0]]), Du=np.zeros((1, 0)), Dy=np.array([[-0.5]])),
        inputs=("y",),
    )


@pytest.mark.parametrize("pole", [0.5, -0.5, 0.9])
def test_the_bound_is_that_of_all_roundings(pole: float) -> None:
    """The state keeps within 4 / (1 - |pole|); each sample rounds 5 times; what is told rounds once more."""
    unit, gathered = 5 * UNIT / (1.0 - 5 * UNIT), 1.0 / (1.0 - abs(pole))
    size = 4.0 * gathered
    error = gathered * unit * (abs(pole) * size + 4.0)
    told = 2.0 * error + unit * (2.0 * size + 0.5)
    (found,) = float_bounds(one_state(pole, into=-4.0))
    assert told <= found <= 1.01 * told
    # A line between samples rises by two units at most: 2 + 2 * 1.
    assert float_bounds(one_state(pole, into=2.0, rise=-1.0))[0] == pytest.approx(found, rel=1e-12)


def test_what_never_forgets_has_no_bound() -> None:
    assert float_bounds(one_state(1.5, into=1.0)) is None


def test_fractions_become_doubles_on_the_safe_side() -> None:
    tiny = Fraction(1, 2**60)
    for value in (Fraction(1) + tiny, Fraction(1) - tiny, -Fraction(1) - tiny, Fraction(1, 3), Fraction(3, 4)):
        assert Fraction(down(value)) <= value <= Fraction(rounded_outward(value))
        assert rounded_outward(value) <= np.nextafter(float(value), np.inf)
    assert rounded_outward(Fraction(3, 4)) == down(Fraction(3, 4)) == 0.75


def test_right_sides_of_a_window_are_exact() -> None:
    """``B u`` and ``y - D u``, of doubles that no double sums up: 0.1 + 3 * 0.7."""
    plant = SimpleNamespace(B=np.array([[0.1, 3.0]]), D=np.array([[0.7, -0.3]]), nx=1, ny=1)
    window = SimpleNamespace(
        plant=plant, rows=3, equations=1, outputs_at=1, test_problem=SimpleNamespace(samples=2), standing=()
    )
    u, y = np.array([[1.0, 0.7], [0.2, 5.0]]), np.array([[0.4], [0.9]])
    exact = [[Fraction(float(value)) for value in row] for row in np.vstack([plant.B, plant.D, u])]
    b, d, *known = exact
    wanted = [b[0] * known[0][0] + b[1] * known[0][1]]
    wanted += [Fraction(float(y[k, 0])) - d[0] * known[k][0] - d[1] * known[k][1] for k in range(2)]
    assert exact_right_sides(window, y, u) == wanted
