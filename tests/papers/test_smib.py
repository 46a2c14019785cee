"""The real input: the torque of a machine on an infinite bus, from a power-system simulator's linearisation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import obsynth
from obsynth.analysis.zeros import fault_zeros
from obsynth.numerics.norms import spectral_radius
from obsynth.simulation.linear import simulate_plant
from obsynth.specs.documents import read_yaml
from obsynth.specs.loader import load_spec

FOLDER = Path(__file__).parents[2] / "designs" / "smib"
EXPECTED = read_yaml(FOLDER / "expected.yaml")
SPEC = load_spec(FOLDER / "spec.yaml")
PLANT = SPEC.plant
SHIPPED = EXPECTED["shipped"]


@pytest.fixture(scope="module")
def design() -> obsynth.ObserverDesign:
    assert SPEC.transformation is not None
    return obsynth.design(PLANT, SPEC.method, name=SPEC.name, recovery=SPEC.transformation.recovery, **SPEC.options)


def test_the_plant_is_what_the_notes_say() -> None:
    assert SPEC.transformation is not None
    source = SPEC.transformation.source
    assert (source.nx, int(np.sum(~source.E.any(axis=1))), source.is_discrete) == (34, 30, False)
    assert list(PLANT.state_names) == EXPECTED["plant"]["states"]
    assert PLANT.dt == EXPECTED["plant"]["dt"]
    assert PLANT.fault_names == ("tm GENCLS 1",)
    assert PLANT.output_names == ("omega GENCLS 1", "a Bus 1", "v Bus 1")
    np.testing.assert_allclose(PLANT.Dd[:, 0], EXPECTED["plant"]["Dd"], atol=5e-5)
    np.testing.assert_array_equal(PLANT.Dw, np.diag([1e-4, 1e-3, 1e-3]))
    assert [zero.value for zero in fault_zeros(PLANT)[0]] == EXPECTED["plant"]["fault_zeros"]


def test_the_design_passes_and_its_claims_are_recomputed(design: obsynth.ObserverDesign) -> None:
    assert design.report.passed
    assert obsynth.verify(design).passed
    claims = design.certificate.claims
    assert claims["gamma"] == SHIPPED["gamma"] == SPEC.options["gamma"]
    assert claims["gamma_min"] < 1e-6
    norm = design.report["H-infinity norm"]
    assert 0.0 < norm.value < claims["gamma"]
    assert design.report["LMI"].kind == "proved"
    assert design.report["noise in fhat[tm GENCLS 1]"].value == pytest.approx(SHIPPED["deviation"], abs=5.1e-5)
    assert spectral_radius(design.observer.Az) == pytest.approx(SHIPPED["spectral_radius"], abs=5.1e-6)
    assert design.observer.fault_delays == (SHIPPED["fault_delay"],)


@pytest.mark.long
def test_noise_against_gamma() -> None:
    """The trade-off of the notes: less gain costs little noise, and below a knee the settling time is hours."""
    rows = EXPECTED["trade_off"]
    found = [obsynth.fault_estimation_filter(PLANT, gamma=row[0]) for row in rows]
    for design, (gamma, deviation, radius) in zip(found, rows, strict=True):
        assert design.report["H-infinity norm"].value <= gamma
        assert design.report["noise in fhat[tm GENCLS 1]"].value == pytest.approx(deviation, abs=6e-5), gamma
        assert spectral_radius(design.observer.Az) == pytest.approx(radius, abs=1e-5), gamma
    deviations = [design.report["noise in fhat[tm GENCLS 1]"].value for design in found]
    assert deviations[-1] == min(deviations)
    assert max(deviations) < 1.02 * min(deviations)
    below = {gamma: obsynth.fault_estimation_filter(PLANT, gamma=gamma) for gamma in (0.1, 0.2)}
    for gamma, design in below.items():
        assert design.report["H-infinity norm"].value <= gamma
        assert design.report["noise in fhat[tm GENCLS 1]"].value < 1.02 * min(deviations), gamma
    assert -PLANT.dt / np.log(spectral_radius(below[0.1].observer.Az)) > 3600.0


def test_a_torque_step_is_followed_within_the_stated_noise(design: obsynth.ObserverDesign) -> None:
    steps, first, settled = 20_000, 10_000, 1_000
    torque = np.where(np.arange(steps) >= first, 0.1, 0.0)[:, None]
    noise = np.random.default_rng(2015).standard_normal((steps, PLANT.nw))
    run = simulate_plant(PLANT, steps=steps, f=torque, w=noise)
    estimates = design.observer.run(run.outputs, np.zeros((steps, 0))).faults[:, 0]
    errors = estimates[1:] - torque[:-1, 0]
    stated = design.report["noise in fhat[tm GENCLS 1]"].value
    deviation = np.sqrt(np.mean(errors[settled:] ** 2))
    # The estimate's autocorrelation is -0.51, 0.03, ...: 1 + 2 sum rho^2 = 1.52, so that the relative spread of the
    # deviation over 19 000 samples is sqrt(1.52 / (2 * 19 000)) = 0.63 %; four of them are allowed.
    assert deviation == pytest.approx(stated, rel=4 * 0.0063)
    # Its mean is 0.14 of that of white noise: three times 0.0402 sqrt(0.14 / 10 000).
    spread = stated * np.sqrt(0.14 / first)
    assert np.mean(estimates[first + 1 :]) == pytest.approx(0.1, abs=3 * spread)
    assert np.mean(estimates[settled:first]) == pytest.approx(0.0, abs=3 * stated * np.sqrt(0.14 / (first - settled)))
    # A single sample shows the step: 0.1 is 2.5 deviations away.
    half = 0.05
    assert np.mean(estimates[first + 1 :] > half) > 0.85
    assert np.mean(estimates[settled:first] < half) > 0.85


def test_without_noise_the_torque_comes_back_one_sample_late(design: obsynth.ObserverDesign) -> None:
    rng = np.random.default_rng(1)
    torque = rng.standard_normal((400, 1))
    run = simulate_plant(PLANT, steps=400, f=torque)
    estimates = design.observer.run(run.outputs, np.zeros((400, 0)))
    # Outputs of size one are multiplied by 290: rounding is 1e-13 of that.
    np.testing.assert_allclose(estimates.faults[1:, 0], torque[:-1, 0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(estimates.states, run.states, rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", ["step", "pulse", "resonance", "random"])
def test_a_disturbance_stays_below_the_gain_at_every_horizon(design: obsynth.ObserverDesign, kind: str) -> None:
    """The filter is causal and starts without error, so the l2 gain bounds every truncation of the record."""
    steps = 3_000
    k = np.arange(steps)
    power = {
        "step": np.where(k >= 100, 0.5, 0.0),
        "pulse": np.where((k >= 100) & (k < 110), 1.0, 0.0),
        # The peak of the norm, in rad/sample, as the report says it.
        "resonance": np.sin(0.1473 * k),
        "random": np.random.default_rng(3).standard_normal(steps),
    }[kind]
    run = simulate_plant(PLANT, steps=steps, d=power)
    errors = design.observer.run(run.outputs, np.zeros((steps, 0))).faults[:, 0]
    energy, cause = np.cumsum(errors**2), np.cumsum(power**2)
    norm, gamma = design.report["H-infinity norm"].value, design.certificate.claims["gamma"]
    assert np.all(energy <= norm**2 * cause * (1.0 + 1e-9) + 1e-20)
    assert norm < gamma
    assert energy[-1] > 0.0
    if kind == "resonance":
        # The bound is no idle one: a long sine at the peak uses nearly all of it.
        assert energy[-1] > 0.98 * norm**2 * cause[-1]


def test_the_infinite_bus_has_no_torque_to_watch() -> None:
    assert SPEC.transformation is not None
    source = SPEC.transformation.source
    wrong = np.zeros((34, 1))
    wrong[source.state_names.index("tm GENCLS 2")] = 1.0
    plant = obsynth.discretise(source.replace(Bf=wrong, fault_names=["tm GENCLS 2"]), PLANT.dt).plant
    assert np.linalg.norm(plant.C @ plant.Bf) == pytest.approx(5e-10, rel=0.02)
    assert np.linalg.norm(PLANT.C @ PLANT.Bf) == pytest.approx(0.009, rel=0.02)
