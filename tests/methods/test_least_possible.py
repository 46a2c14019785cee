"""What no causal filter beats, beside designs of every method: known values, other methods' optima, units."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import obsynth
from obsynth.methods.optimal_filter.least_possible import LeastPossible, least_possible, least_possible_of

DESIGNS = Path(__file__).parents[2] / "designs"
WANG = obsynth.load_spec(DESIGNS / "wang2015" / "spec.yaml").plant


def two_speeds(**parts) -> obsynth.DescriptorSystem:
    """Return a plant whose first fault shows after one sample, the second after two."""
    return obsynth.DescriptorSystem(
        E=None,
        A=[[0.5, 0, 0], [0, 0.4, 1], [0, 0, 0.3]],
        C=[[1, 0, 0], [0, 1, 0], [0.2, 0.7, 0]],
        Bf=[[1, 0], [0, 0], [0, 1]],
        Bd=[[0.3], [0.2], [0.1]],
        dt=1.0,
        **parts,
    )


def test_the_papers_plant() -> None:
    """The least with the paper's delay is exactly 1, and with one sample more exactly 0 (1.4647 with the paper's W)."""
    for weight in ("paper", "free"):
        design = obsynth.fault_estimation_filter(WANG, weight=weight)
        found = least_possible(design, later=True)
        assert found.delay == (1, 1)
        assert found.least_gain == pytest.approx(1.0, rel=1e-7)
        assert found.later_gain == 0.0
        assert found.gain <= design.certificate.claims["gamma"]
        assert found.gain_share == found.gain / found.least_gain > 1.0
    assert found.sentence().startswith("gain 1.04")
    assert "least of any causal filter with delay 1: 1; with one sample more: 0; noise 1.3" in found.sentence()


def test_the_line_of_a_plant_has_both_weights_the_least_and_one_sample_more() -> None:
    assert least_possible_of(WANG) == (
        "Least gain from the disturbances, held over each sample, to the fault estimates with delay 1, if the model is "
        "exact: 1.4647 with the paper's W (Wang 2015), "
        "1 with a free W, 1 of any causal filter; with one sample more: 0."
    )
    assert least_possible_of(WANG.replace(Bd=WANG.Bd[:, :0], Dd=WANG.Dd[:, :0], disturbance_names=())) == ""


def test_the_optimal_filter_is_at_the_least_itself() -> None:
    design = obsynth.optimal_filter(WANG, delay=1)
    assert least_possible(design).gain_share == pytest.approx(1.0, rel=1e-6)
    quiet = obsynth.optimal_filter(WANG, delay=1, decoupled=(), norm="h2")
    assert least_possible(quiet).delay == (1, 1)


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", ["filasova", "sharepasand", "motor"])
def test_filters_that_minimise_the_noise_by_another_route_are_at_the_least(name: str) -> None:
    """The functional filter weighs the noise by a Kalman filter of its own: the least has the same deviation."""
    plant = obsynth.load_spec(DESIGNS / name / "spec.yaml").plant
    found = least_possible(obsynth.design(plant, method="functional-filter"))
    assert found.delay is None
    assert found.deviation_share == pytest.approx(1.0, rel=1e-9)
    assert found.gain == 0.0
    assert found.gain_share == 1.0


def test_faults_with_different_delays_keep_their_own() -> None:
    plant = two_speeds(sensor_noise={"y1": 0.1, "y2": 0.1, "y3": 0.1})
    design = obsynth.fault_estimation_filter(plant)
    found = least_possible(design)
    assert found.delay == (1, 2)
    assert 1.0 <= found.deviation_share < 2.0
    assert found.gain_share >= 1.0 - 1e-9
    # A filter that waits for the slower fault has the choice of more: its least is no larger.
    both = obsynth.optimal_filter(plant.replace(Bw=plant.Bw[:, :0], Dw=plant.Dw[:, :0], noise_names=()), delay=2)
    assert both.gain <= found.least_gain * (1.0 + 1e-6)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("seed", range(4))
def test_no_design_is_below_the_least(seed: int) -> None:
    rng = np.random.default_rng([47, seed])
    a = rng.normal(size=(5, 5))
    plant = obsynth.DescriptorSystem(
        E=None, A=0.9 * a / np.max(np.abs(np.linalg.eigvals(a))), C=rng.normal(size=(3, 5)), Bf=rng.normal(size=(5, 1)),
        Bd=rng.normal(size=(5, 1)), dt=1.0, sensor_noise={"y1": 0.1, "y2": 0.2, "y3": 0.1},
    )  # fmt: skip
    for method in ("fault-estimation-filter", "functional-filter", "ui-pi-observer", "optimal-filter"):
        try:
            design = obsynth.design(plant, method=method)
        except (obsynth.PreconditionError, obsynth.SolverError):
            continue
        found = least_possible(design)
        assert not found.gain_share < 1.0 - 1e-6, method
        assert not found.deviation_share < 1.0 - 1e-6, method


def test_shares_do_not_depend_on_the_unit_of_the_faults() -> None:
    plant = two_speeds()
    shares = []
    for factor in (1.0, 2.0**20):
        found = least_possible(obsynth.fault_estimation_filter(plant.replace(Bf=factor * plant.Bf), weight="paper"))
        shares.append((found.gain_share, found.deviation_share))
    assert shares[0] == pytest.approx(shares[1], rel=1e-6)


def test_what_estimates_no_fault_has_no_least() -> None:
    assert least_possible(obsynth.guaranteed_test(WANG, fault="actuator 1", disturbance_bounds=0.1)) is None


def test_a_least_gain_that_the_search_leaves_at_rounding_is_a_power_of_ten() -> None:
    nothing = LeastPossible(0.5, 7.5e-7, 1.0, 1.0, (1,), 9.2e-7)
    assert nothing.sentence().startswith(
        "gain 0.5; least of any causal filter with delay 1: below 1e-6; with one sample more: below 1e-6;"
    )
    assert "below" not in LeastPossible(0.5, 0.0, 1.0, 1.0, (1,), 1e-4).sentence()
