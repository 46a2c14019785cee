"""Delay against noise, the mean of the fault-estimation filter, and what a passed design is warned about."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

import obsynth
from obsynth.methods.functional_filter.rates import delay_curve
from obsynth.report.designs import design_warnings, followed_steps
from obsynth.specs.loader import load_spec

DESIGNS = Path(__file__).parents[2] / "designs"


@pytest.mark.long
def test_the_curve_is_what_designs_claim() -> None:
    plant = load_spec(DESIGNS / "smib" / "functional.yaml").plant
    curve = delay_curve(plant, 0, 0.01)
    assert curve is not None
    assert np.all(np.diff(curve.deviations, axis=1) < 0.0)
    for lag, expected in zip(curve.lags[:4], curve.deviations[1], strict=False):
        made = obsynth.functional_filter(plant, fault_rate=0.01, delay=lag)
        assert made.certificate.matrices["deviations"][0, 1] == pytest.approx(expected, rel=1e-6)
    assert "one sample of delay takes the deviation from 0.0167" in curve.sentence


@pytest.mark.long
def test_mean_of_the_fault_estimation_filter() -> None:
    plant = load_spec(DESIGNS / "smib" / "spec.yaml").plant
    plain = obsynth.fault_estimation_filter(plant, gamma=0.3)
    mean = obsynth.fault_estimation_filter(plant, gamma=0.3, mean=6)
    assert mean.observer.fault_delays == (plain.observer.fault_delays[0] + 2,)
    y = np.random.default_rng(1).standard_normal((60, 3))
    single, averaged = (design.observer.run(y).faults[:, 0] for design in (plain, mean))
    assert averaged[5:] == pytest.approx(np.convolve(single, np.ones(6) / 6, "valid"), abs=1e-9)
    assert mean.report["noise in the mean of fhat[tm GENCLS 1]"].value == pytest.approx(0.0078, rel=0.03)
    changed = mean.observer.Cz.copy()
    changed[mean.observer.fault_rows] *= 1.001
    broken = obsynth.verify(mean.replace(observer=dataclasses.replace(mean.observer, Cz=changed)))
    assert [check.name for check in broken.failures][:1] == ["mean"]


@pytest.mark.long
def test_a_step_that_is_not_reached_is_said() -> None:
    source = load_spec(DESIGNS / "smib" / "functional.yaml").transformation.source
    design = obsynth.ui_pi_observer(obsynth.eliminate_algebraic_states(source).plant)
    assert design.report.passed
    told = design_warnings(design, followed_steps(design))
    assert any("gives an estimate of 4.38 after 20 s" in text for text in told)


def test_a_fault_that_cannot_be_told_is_said() -> None:
    plant = obsynth.discretise(load_spec(DESIGNS / "motor" / "one_encoder.yaml").plant, 0.005).plant
    design = obsynth.fault_estimation_filter(plant)
    told = design_warnings(design, followed_steps(design))
    assert any(text.startswith("A constant torque cannot be distinguished from load torque") for text in told)
    filter_ = obsynth.functional_filter(load_spec(DESIGNS / "motor" / "sampled.yaml").plant)
    assert design_warnings(filter_, followed_steps(filter_)) == ()


def test_two_faults_that_only_an_unknown_input_makes_alike_are_said() -> None:
    # A load on one state is what a bias of its sensor is; a load on both is the sum of a drop and a bias.
    plant = obsynth.DescriptorSystem(
        A=[[0.9, 0.0], [0.1, 0.8]],
        C=[[1.0, 0.0], [0.0, 1.0]],
        Bf=[[0.1, 0.0], [0.0, 0.0]],
        Df=[[0.0, 0.0], [0.0, 1.0]],
        Bd=[[0.0], [0.2]],
        dt=0.1,
        fault_names=["drop", "bias"],
        disturbance_names=["load"],
    )
    design = obsynth.fault_estimation_filter(plant)
    told = design_warnings(design, followed_steps(design))
    assert [text.partition(":")[0] for text in told] == ["bias cannot be distinguished from load"]
    mixed = plant.replace(Bf=[[0.1, 0.0], [0.0, 0.0]], Bd=[[0.1], [0.2]])
    design = obsynth.fault_estimation_filter(mixed)
    told = design_warnings(design, followed_steps(design))
    assert [text.partition(":")[0] for text in told] == [
        "A constant drop cannot be distinguished from load and bias together",
        "A constant bias cannot be distinguished from load and drop together",
    ]


def test_numbers_of_the_curve_have_the_unit_of_the_fault() -> None:
    plant = obsynth.DescriptorSystem(
        A=[[0.9]], C=[[1.0]], Bf=[[1.0]], dt=1.0, sensor_noise={"y1": 0.1}, fault_names=["leak"], units={"leak": "kg/s"}
    )
    curve = delay_curve(plant, 0, 0.01)
    assert curve is not None
    assert "leak (kg/s)" in curve.title
    assert curve.sentence.count(" kg/s") == 3
    bare = delay_curve(plant.replace(units={}), 0, 0.01)
    assert bare is not None
    assert "kg" not in bare.title + bare.sentence
