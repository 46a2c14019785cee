"""Offsets that `calibrate` proposes where a fault of the plant does the same."""

import numpy as np
import pandas as pd
import pytest

import obsynth


def tank(leak: str = " - leak") -> obsynth.DAEModel:
    return obsynth.DAEModel(
        {"tank": f"der(h) = q - a * h{leak}"}, {"LT": "h"}, states={"h": 1.0}, inputs={"q": 0.1},
        parameters={"leak": 0.0} if leak else {}, constants={"a": 0.1},
    )  # fmt: skip


def found(model: obsynth.DAEModel, offset: float) -> obsynth.types.Calibration:
    """Return what is found in a log of the tank whose sensor has an offset."""
    rng, h, rows = np.random.default_rng(2), 1.0, []
    for k, q in enumerate(np.repeat(rng.uniform(0.05, 0.15, 11), 20)[:200]):
        h = (h + q) / 1.1 + 0.002 * rng.standard_normal() if k else h
        rows.append([float(k), q, h + offset + 0.01 * rng.standard_normal()])
    log = pd.DataFrame(rows, columns=["time", "q", "LT"])
    return obsynth.calibrate(model, log, {"a": (0.05, 0.2)}, input_delay=0, starts=1, integration="backward-euler")


@pytest.mark.long
def test_an_offset_that_hides_a_fault_needs_as_many_nats_as_any_other_state() -> None:
    """By 2.43 nats a level sensor had an offset, and the design that was to estimate a leak beside it was refused."""
    assert list(found(tank(""), 0.04).offset) == ["LT"]
    assert not found(tank(), 0.04).offset


@pytest.mark.long
def test_an_offset_that_hides_a_fault_is_told_with_the_fault_and_the_remedy() -> None:
    told = found(tank(), 0.1)
    assert list(told.offset) == ["LT"]
    assert "leak cannot be distinguished from the offset of LT" in str(told)
    beside = obsynth.with_noise(tank(), offset=["LT"])[0]
    design = obsynth.dae_adaptive_observer(
        beside, dt=1.0, Q=np.zeros((2, 2)), R=[[1e-4]], form="augmented-kalman", random_walk=[[1e-8]],
        initial_parameter_covariance=[[1e-4]], integration="backward-euler",
    )  # fmt: skip
    assert any("leave out the offset of LT" in note for note in design.notes), design.notes
