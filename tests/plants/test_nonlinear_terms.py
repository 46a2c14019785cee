"""Equations as linear parts and nonlinearities: multiples of one nonlinearity are one, and nothing is lost."""

from __future__ import annotations

import numpy as np
import pytest

import obsynth
from obsynth.plants.transformations.nonlinear_terms import ARGUMENT, nonlinear_terms


@pytest.mark.parametrize(
    ("texts", "count"),
    [
        (("2 * x * v", "3 * v * x - x"), 1),
        (("4 / x", "0.5 / (3 * x) + v"), 1),
        (("(2 * x) ** 2", "-x ** 2 / 7"), 1),
        (("(2 * x + 4 * v) ** 3", "(x + 2 * v) ** 3"), 1),
        (("5 * sin(x) / (2 * v)", "-sin(x) / v"), 1),
        (("0.3 * (2 * exp(v)) * x", "x * exp(v)"), 1),
        (("(2 * x) ** (-1)", "x ** (-1)"), 1),
        (("sin(2 * x)", "sin(x)"), 2),
        (("(1 + x) * v", "(2 + x) * v"), 2),
        (("sqrt(4 * x)", "sqrt(x)"), 2),
    ],
)
def test_multiples_of_one_nonlinearity_are_one(texts: tuple[str, str], count: int) -> None:
    """Each has slopes of its own, and each slope doubles the corners: 2 x v and 3 x v were two."""
    model = obsynth.DAEModel(
        {"one": f"der(x) = -x - v + {texts[0]}", "two": f"der(v) = -2 * v + x + {texts[1]}"}, {"y": "x"},
        states={"x": 1.0, "v": 1.0},
    )  # fmt: skip
    terms = nonlinear_terms(model, faults=())
    assert len(terms.nonlinearities) == count
    known = {"exp": np.exp, "sin": np.sin, "sqrt": np.sqrt}
    for x, v in np.random.default_rng(0).uniform(0.5, 2.0, (5, 2)):
        z = np.array([dict(x=x, v=v)[name] for name in terms.names])
        values = {f"{ARGUMENT}{j}": float(each.over(terms.names) @ z) for j, each in enumerate(terms.arguments)}
        functions = [eval(each.expression.text, {**known, **values}) for each in terms.nonlinearities]
        rates = terms.A @ z + terms.W @ np.array(functions) + terms.c
        at = {**known, "x": x, "v": v}
        written = {"x": -x - v + eval(texts[0], at), "v": -2 * v + x + eval(texts[1], at)}
        assert rates == pytest.approx([written[name] for name in terms.names], rel=1e-13)
