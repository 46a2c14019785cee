"""A plant that escapes within a step: the row is named, and what the message advises is followed."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

import obsynth


def test_the_step_that_has_no_solution_is_named_and_the_ways_out_lead_somewhere() -> None:
    model = obsynth.DAEModel(
        {"growth": "der(x) = k*x**2 + u"}, {"gauge": "x"}, states={"x": 0.1}, inputs={"u": 0.0}, constants={"k": 1.0}
    )
    rng, x, rows = np.random.default_rng(1), 0.1, []
    for k in range(39):
        rows.append((0.25 * k, 0.0, x + 0.001 * rng.standard_normal()))
        x = x / (1.0 - 0.25 * x)  # what the equation does, exactly
    log = pd.DataFrame(rows, columns=["time", "u", "gauge"])
    bounds = {"k": (0.9, 1.3)}
    with pytest.raises(
        obsynth.PreconditionError, match=r"With k = 1 the step of 0\.25 s to row \d+ .* has none"
    ) as told:
        obsynth.calibrate(model, log, bounds, integration="backward-euler")
    # Implicit Euler: y = x + 0.25 y^2 has no real solution above x = 1.
    row = int(str(told.value).partition("to row ")[2].partition(" ")[0])
    assert log["gauge"][row - 1] == pytest.approx(1.0, abs=0.35)
    assert "integration: radau or substeps: 10" in str(told.value)
    assert obsynth.calibrate(model, log, bounds, integration="radau").nominal["k"] == pytest.approx(1.0, rel=0.01)
    shorter = obsynth.calibrate(model, log, bounds, integration="backward-euler", substeps=10)
    assert shorter.nominal["k"] == pytest.approx(1.0, rel=0.05)
