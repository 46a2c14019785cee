"""The bound on what single precision changes, worked by hand for one state."""

from __future__ import annotations

from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest

from obsynth.exporting.float_error import UNIT, float_bounds
from obsynth.methods.guaranteed_test.proofs import down, up


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
        assert Fraction(down(value)) <= value <= Fraction(up(value))
        assert up(value) <= np.nextafter(float(value), np.inf)
    assert up(Fraction(3, 4)) == down(Fraction(3, 4)) == 0.75
