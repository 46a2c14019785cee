"""How far faults are from looking alike: margins against angles and counts that are known by construction."""

from __future__ import annotations

import numpy as np
import pytest

import obsynth

NEAR = 0.01


def collinear(**more):
    """Three faults whose steady effects are (1, 0, 0), (1, e, 0), (1, 2 e, e^2): collinear within 1 %."""
    a = -np.diag([1.0, 2.0, 3.0])
    effects = np.array([[1, 0, 0], [1, NEAR, 0], [1, 2 * NEAR, NEAR**2]]).T
    return obsynth.DescriptorSystem(A=a, C=np.eye(3), Bf=-a @ effects, **more)


def test_faults_that_are_nearly_collinear_are_named_with_the_sizes_that_look_alike():
    found = obsynth.diagnose(collinear(sensor_noise=dict.fromkeys(("y1", "y2", "y3"), 0.1)))
    assert found.isolable.all()
    # Angle of two effects: about e; of one to the plane of the others: about e^2.
    assert np.isclose(found.margins[0, 1], 1.0 / NEAR, rtol=1e-3)
    assert np.isclose(found["f1"].margin, 1.0 / NEAR**2, rtol=1e-3)
    assert np.isclose(found["f2"].margin, 2.0 / NEAR**2, rtol=1e-3)
    (sentence,) = (text for text in found["f1"].sentences if "nearly lost" in text)
    assert "2 of f2 and 1 of f3" in sentence
    # A step of one leaves e^2 of its effect; the mean of 100 samples has a deviation of 0.01.
    assert np.isclose(found["f1"].least_step, 3 * 0.1 / 10 / NEAR**2, rtol=1e-3)
    assert "(margin 1e+02)" in repr(found)
    assert found.to_dict()["faults"][0]["margin"] == found["f1"].margin


def test_margins_do_not_depend_on_units():
    plant = collinear(sensor_noise=dict.fromkeys(("y1", "y2", "y3"), 0.1))
    row = np.array([1e6, 1e-3, 10.0])[:, None]
    other = plant.replace(C=row * plant.C, Dw=row * plant.Dw, Bf=plant.Bf * [1e5, 1.0, 1e-5])
    one, two = obsynth.diagnose(plant), obsynth.diagnose(other)
    np.testing.assert_allclose(two.margins, one.margins, rtol=1e-5)
    steps = [np.array([fault.least_step for fault in found.faults]) for found in (one, two)]
    np.testing.assert_allclose(steps[1], steps[0] * [1e-5, 1.0, 1e5], rtol=1e-5)


def test_orthogonal_faults_have_no_sentence():
    a = -np.diag([1.0, 2.0])
    found = obsynth.diagnose(obsynth.DescriptorSystem(A=a, C=np.eye(2), Bf=np.eye(2)))
    np.testing.assert_allclose(found.margins, np.ones((2, 2)))
    assert [fault.margin for fault in found.faults] == [1.0, 1.0]
    assert [fault.least_step for fault in found.faults] == [None, None]
    assert not any("nearly" in text for text in found.sentences)


def test_unknown_inputs_count_as_faults_of_any_size():
    a = -np.diag([1.0, 1.0])
    plant = obsynth.DescriptorSystem(
        A=a, C=np.eye(2), Bf=[[1.0, 0.0], [0.0, 1.0]], Bd=[[1.0], [1.0]], sensor_noise={"y1": 1.0, "y2": 1.0}
    )
    found = obsynth.diagnose(plant)
    # Beside d both faults act in one direction.
    assert not found.isolable[0, 1]
    assert np.isinf(found.margins[0, 1])
    assert np.isinf(found["f1"].margin)
    assert found.to_dict()["margins"][0][1] is None
    alone = obsynth.diagnose(plant.replace(Bf=[[1.0], [0.0]], Df=[[0.0], [0.0]], fault_names=["f1"]))
    # Orthogonal to (1, 1): 1 / sqrt(2) of it.
    assert np.isclose(alone["f1"].least_step, 0.3 * np.sqrt(2.0))


@pytest.mark.parametrize("dt", [0.0, 0.1])
def test_faults_that_are_no_constants_are_compared_as_sinusoids(dt):
    """An integrator has no value at rest, and the effect of its second fault is a derivative."""
    a = [[1, dt], [0, 1]] if dt else [[0, 1], [0, 0]]
    plant = obsynth.DescriptorSystem(A=a, C=np.eye(2), Bf=[[0.0, 1.0], [1.0, 0.0]], dt=dt)
    found = obsynth.diagnose(plant)
    assert found.isolable.all()
    assert np.isfinite(found.margins).all()
    assert (found.margins >= 1.0).all()
