"""Logs whose inputs are late or early: what is said of it, and that what is advised is taken."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest
from test_calibration_statements import SPEC, log

import obsynth
from obsynth.specs.loader import load_plant


def test_inputs_that_the_log_has_a_row_late_are_told_and_the_advice_is_taken(tmp_path: Path) -> None:
    """A delay of the plant is taken by itself; an input that acts before the log has it is an error of the log."""
    spec = tmp_path / "spec.yaml"
    spec.write_text(SPEC, encoding="utf-8")
    model, _ = load_plant(spec)
    rows = pd.DataFrame(log(0.5))
    rows["inflow"] = rows["inflow"].shift(1).bfill()
    told = obsynth.calibrate(model, rows, {"c": (0.1, 2.0)})
    (advice,) = [text for text in told.verdict if "would be better" in text]
    assert "Inputs that act 1 row earlier than is taken here" in advice
    assert "give input_delay = -1 " in advice
    again = obsynth.calibrate(model, rows, {"c": (0.1, 2.0)}, input_delay=-1)
    assert not any("would be better" in text for text in again.verdict)
    assert again.log_likelihood > told.log_likelihood
    assert again.nominal["c"] == pytest.approx(0.5, abs=0.02)
