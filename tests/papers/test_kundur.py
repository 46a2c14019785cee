"""A real network: four torques of Kundur's two-area system, whatever power bus 7 draws."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from exact_runs import Together, ramp_and_sine

import obsynth
from obsynth.analysis.existence.sharepasand import existence
from obsynth.analysis.existence.sharepasand_decoupling import decoupling_rank
from obsynth.analysis.existence.statements import Evaluator
from obsynth.plants.faults import exosystem
from obsynth.simulation.linear import simulate_plant
from obsynth.specs.documents import read_yaml
from obsynth.specs.loader import load_spec

FOLDER = Path(__file__).parents[2] / "designs" / "kundur"
EXPECTED = read_yaml(FOLDER / "expected.yaml")
SPEC = load_spec(FOLDER / "spec.yaml")
PLANT = SPEC.plant
SHIPPED = EXPECTED["shipped"]


@pytest.fixture(scope="module")
def design() -> obsynth.ObserverDesign:
    return obsynth.design(PLANT, SPEC.method, name=SPEC.name, **SPEC.options)


def with_unknown_input(state: str) -> obsynth.DescriptorSystem:
    direction = np.zeros((PLANT.nx, 1))
    direction[PLANT.state_names.index(state)] = 1.0
    return PLANT.replace(Bd=direction, disturbance_names=[state], units=None)


def test_the_plant_is_what_the_notes_say() -> None:
    algebraic = int(np.sum(~PLANT.E.any(axis=1)))
    assert (PLANT.nx, algebraic) == (EXPECTED["plant"]["variables"], EXPECTED["plant"]["algebraic"])
    assert (PLANT.ny, PLANT.nf, PLANT.nd, PLANT.is_discrete) == (12, 4, 1, False)
    before = decoupling_rank(Evaluator(PLANT))
    reduced = obsynth.eliminate_algebraic_states(PLANT).plant
    after = decoupling_rank(Evaluator(reduced))
    assert [before.rank, before.expected] == EXPECTED["plant"]["decoupling_rank_as_written"]
    assert [after.rank, after.expected] == EXPECTED["plant"]["decoupling_rank_eliminated"]
    found = existence(PLANT, exosystem("step", PLANT.fault_names, 0.0))
    assert all(condition.holds for condition in found.conditions)
    np.testing.assert_allclose(found.fixed_modes, EXPECTED["plant"]["fixed_modes"], atol=1e-6)
    assert found.plant.nx == 52


def test_the_design_passes_and_keeps_the_fixed_modes(design: obsynth.ObserverDesign) -> None:
    assert design.report.passed
    assert obsynth.verify(design).passed
    assert design.observer.order == 56
    poles = np.linalg.eigvals(design.observer.Az)
    assert np.sum(np.abs(poles + 1.0) < 1e-6) == 4
    assert any("4 of 56 poles are fixed" in note and "-1" in note for note in design.notes)
    assert any("61 of 197" in note for note in design.notes)
    assert design.report["fixed modes"].value == 4.0
    # Rounding makes pairs of some: they are shown as what they are.
    assert design.report["fixed modes"].detail == "4 of 56 poles are fixed: -1, -1, -1, -1"
    assert design.report["stability"].kind == "proved"


def test_it_is_not_slow(design: obsynth.ObserverDesign) -> None:
    """An untuned Kalman filter leaves poles near zero; the default must not, with weights or without."""
    assert design.certificate.claims["decay"] == pytest.approx(SHIPPED["decay"], rel=0.02)
    assert design.certificate.claims["noise_amplification"] == pytest.approx(SHIPPED["noise_amplification"], rel=0.02)
    found = [design.report[f"noise in fhat[{name}]"].value for name in PLANT.fault_names]
    np.testing.assert_allclose(found, SHIPPED["deviations"], rtol=0.02)
    quiet = PLANT.replace(Bw=None, Dw=None, noise_names=None, units=None)
    for options, key in (({}, "without_weights"), ({"decay": 0.0}, "plain_kalman")):
        claims = obsynth.ui_pi_observer(quiet, **options).certificate.claims
        assert claims["decay"] == pytest.approx(EXPECTED[key]["decay"], rel=0.02)
        assert claims["noise_amplification"] == pytest.approx(EXPECTED[key]["noise_amplification"], rel=0.02)
    assert EXPECTED["without_weights"]["decay"] > 10.0 * EXPECTED["plain_kalman"]["decay"]


@pytest.mark.long
def test_faster_costs_noise() -> None:
    for asked, slowest, deviations in EXPECTED["trade_off"]:
        found = obsynth.ui_pi_observer(PLANT, decay=asked)
        assert found.certificate.claims["decay"] == pytest.approx(slowest, rel=0.02)
        noise = [found.report[f"noise in fhat[{name}]"].value for name in PLANT.fault_names]
        np.testing.assert_allclose(noise, deviations, rtol=0.02)


def test_the_states_of_the_network_come_back(design: obsynth.ObserverDesign) -> None:
    recovery = design.recovery
    assert recovery is not None
    assert len(recovery.names) == 196
    assert dict(Counter(recovery.flags())) == EXPECTED["recovered_states"]


def test_torques_are_followed_whatever_bus_7_draws(design: obsynth.ObserverDesign) -> None:
    """Exact runs: torque steps on two machines, load 0.3 t + sin(2 t); the estimates do not see the load at all."""
    steps = np.array([[0.1], [0.0], [-0.05], [0.0]])
    together = Together(
        design.plant, design.observer, fault=(np.zeros((1, 1)), steps), disturbance=ramp_and_sine(0.3, 1.0, 2.0)
    )
    order = len(together.total)
    start = np.zeros(order)
    start[together.places[2]] = 1.0
    calm = together.run(start, 0.1, 601)
    start[together.places[3]] = [0.0, 1.0, 0.0, 1.0]
    loaded = together.run(start, 0.1, 601)
    rows = together.estimates[together.fault_rows]
    np.testing.assert_allclose((calm @ rows.T)[-1], steps[:, 0], atol=1e-5)
    np.testing.assert_allclose(loaded @ rows.T, calm @ rows.T, atol=1e-6)
    assert np.max(np.abs(loaded - calm)) > 1.0
    states = together.estimates[together.state_rows]
    np.testing.assert_allclose((loaded @ states.T)[-1], (loaded @ together.x.T)[-1], atol=1e-5)


@pytest.mark.parametrize("h", [0.02, 0.01])
def test_on_samples(design: obsynth.ObserverDesign, h: float) -> None:
    """Load and torque held between samples, observer with a first-order hold: an error of the size of the sample."""
    sampled = obsynth.discretise(design.plant, h).plant
    count = round(60.0 / h)
    time = h * np.arange(count)
    torque = np.zeros((count, 4))
    torque[time >= 5.0, 1] = 0.1
    load = np.sin(2.0 * np.pi * 0.3 * time)[:, None]
    run = simulate_plant(sampled, steps=count, f=torque, d=load)
    estimates = obsynth.sample_observer(design.observer, h).run(run.outputs, np.zeros((count, 0)))
    late = time > 40.0
    assert np.max(np.abs(estimates.faults[late] - torque[late])) < 0.5 * h


@pytest.mark.parametrize("state", ["vref EXDC2 1", "pref TGOV1 1"])
def test_other_unknown_inputs_are_refused(state: str) -> None:
    plant = with_unknown_input(state)
    with pytest.raises(obsynth.PreconditionError) as caught:
        obsynth.ui_pi_observer(plant)
    error = caught.value
    assert error.condition == "(D1) decoupling"
    assert state in error.signals
    masked = state.startswith("pref")
    assert ("tm GENROU 1" in error.signals) == masked
    assert error.mode == (0.0 if masked else None)
    assert ("masked by the unknown input 'pref TGOV1 1'" in str(error)) == masked


def test_the_fault_estimation_filter_of_the_same_network() -> None:
    spec, expected = load_spec(FOLDER / "spec_fault_filter.yaml"), EXPECTED["fault_filter"]
    assert spec.plant.nx == 52
    filtered = obsynth.design(spec.plant, spec.method, name=spec.name, **spec.options)
    assert filtered.report.passed
    assert filtered.solver["engine"] == "riccati"
    assert filtered.observer.fault_delays == (expected["fault_delay"],) * 4
    assert filtered.certificate.claims["gamma"] == pytest.approx(expected["gamma"], rel=1e-3)
    assert filtered.certificate.claims["gamma_min"] < 1e-4
    found = [filtered.report[f"noise in fhat[{name}]"].value for name in spec.plant.fault_names]
    assert found == pytest.approx(expected["deviations"], abs=1.5e-3)
    radius = np.max(np.abs(np.linalg.eigvals(filtered.observer.Az)))
    assert radius == pytest.approx(expected["spectral_radius"], abs=2e-5)
