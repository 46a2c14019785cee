"""The real input for the PD observer: the torque of a machine on an infinite bus, in continuous time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import obsynth
from obsynth.simulation.linear import simulate_plant
from obsynth.specs.documents import read_yaml
from obsynth.specs.loader import load_spec

FOLDER = Path(__file__).parents[2] / "designs" / "smib"
EXPECTED = read_yaml(FOLDER / "expected.yaml")["pd_observer"]
SPEC = load_spec(FOLDER / "pd_observer.yaml")
PLANT = SPEC.plant


@pytest.fixture(scope="module")
def design() -> obsynth.ObserverDesign:
    assert SPEC.transformation is not None
    return obsynth.design(PLANT, SPEC.method, name=SPEC.name, recovery=SPEC.transformation.recovery, **SPEC.options)


def test_the_same_plant_without_sampling() -> None:
    """The spec's own transform takes the place of the plant's, which samples."""
    assert SPEC.transformation is not None
    assert SPEC.transformation.source.nx == 34
    assert (PLANT.nx, PLANT.dt) == (4, 0.0)
    sampled = load_spec(FOLDER / "spec.yaml").plant
    np.testing.assert_array_equal(obsynth.discretise(PLANT, sampled.dt).plant.A, sampled.A)


def test_fast_with_moderate_gains(design: obsynth.ObserverDesign) -> None:
    assert design.report.passed
    assert obsynth.verify(design).passed
    assert design.report["LMI"].kind == "proved"
    j = np.vstack([design.gains["J"], design.gains["M"]])
    assert design.report["error system"].value <= -1.0
    assert np.linalg.norm(j, 2) < 50.0
    assert design.report["error system"].value == pytest.approx(EXPECTED["abscissa"], abs=6e-3)
    assert np.linalg.norm(j, 2) == pytest.approx(EXPECTED["norm_J"], abs=0.2)
    assert design.certificate.claims["decay"] == pytest.approx(EXPECTED["decay"], abs=1e-3)
    assert design.report["proportional part alone"].value == pytest.approx(EXPECTED["P_part"], abs=0.02)
    for name, value in EXPECTED["norms"].items():
        assert design.report[f"{name} in the fault estimate"].value == pytest.approx(value, rel=0.02), name


def test_without_a_decay_rate_it_is_slow() -> None:
    plain = obsynth.pd_observer(PLANT, decay=0.0)
    assert plain.report["error system"].value == pytest.approx(EXPECTED["plain_abscissa"], abs=2e-3)


def test_the_plant_as_written_gives_the_same(design: obsynth.ObserverDesign) -> None:
    """With singular E the method eliminates by itself, and knows the way back."""
    assert SPEC.transformation is not None
    whole = obsynth.pd_observer(SPEC.transformation.source)
    np.testing.assert_allclose(whole.gains["J"], design.gains["J"], rtol=1e-9, atol=1e-9)
    assert whole.recovery is not None
    assert len(whole.recovery.names) == 34
    assert design.recovery is not None
    assert whole.recovery.flags() == design.recovery.flags()


def test_a_torque_step_in_sampled_data(design: obsynth.ObserverDesign) -> None:
    """0.02 s between samples, as for the other method; the observer by a first-order hold."""
    h, steps, first = 0.02, 2000, 500
    sampled = obsynth.discretise(PLANT, h).plant
    torque = np.where(np.arange(steps) >= first, 0.1, 0.0)[:, None]
    run = simulate_plant(sampled, steps=steps, f=torque)
    estimates = obsynth.sample_observer(design.observer, h).run(run.outputs)
    errors = estimates.faults[:, 0] - torque[:, 0]
    assert np.max(np.abs(errors[:first])) < 1e-12
    # A change at one sample is seen by a continuous observer within its slowest time constant, 1 / 1.236 s.
    settled = first + int(5.0 / h)
    assert np.max(np.abs(errors[settled:])) < 0.1 * 0.02
    # What is left is the hold's: the outputs swing at 10.5 rad/s and are not straight between samples.
    assert np.max(np.abs(errors[-100:])) < 5e-5
    np.testing.assert_allclose(estimates.states[-100:], run.states[-100:], rtol=0, atol=5e-5)


def test_sensor_noise_stays_below_its_norm(design: obsynth.ObserverDesign) -> None:
    h, steps = 0.02, 20_000
    sampled = obsynth.discretise(PLANT, h).plant
    noise = np.random.default_rng(3).standard_normal((steps, PLANT.nw))
    run = simulate_plant(sampled, steps=steps, w=noise)
    errors = obsynth.sample_observer(design.observer, h).run(run.outputs).faults[:, 0]
    deviation = float(np.std(errors[1000:]))
    # In samples, white noise of deviation one has an l2 norm of one per sample; the norm bounds what it can become.
    assert deviation < design.report["noise in the fault estimate"].value * np.sqrt(PLANT.nw)
    assert deviation == pytest.approx(EXPECTED["sampled_deviation"], rel=0.05)
