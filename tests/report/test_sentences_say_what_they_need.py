"""What a summary says of a design is said with what it needs: signals that are held, a time, filters that are alike."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.linalg import expm

import obsynth
from obsynth.methods.functional_filter.rates import delay_curve
from obsynth.methods.optimal_filter.least_possible import LeastPossible
from obsynth.methods.registry import method_class

A, FAULT = np.array([[0.0, 1.0], [-3.0, -0.8]]), np.array([0.2, 1.0])
HOLD = 0.5


def in_continuous_time() -> obsynth.DescriptorSystem:
    return obsynth.DescriptorSystem(
        A=A, C=[[1.0, 0.0], [0.0, 1.0]], Bf=FAULT[:, None], sensor_noise={"y1": 0.01, "y2": 0.01}
    )


def held(duration: float) -> np.ndarray:
    """What a unit fault adds to the state within a time."""
    block = np.zeros((3, 3))
    block[:2, :2], block[:2, 2] = A, FAULT
    return expm(block * duration)[:2, 2]


def test_a_fault_within_a_sample_is_another_one_and_the_summary_says_that_signals_are_held() -> None:
    design = obsynth.fault_estimation_filter(obsynth.discretise(in_continuous_time(), HOLD))
    observer, (state, z) = design.observer, (np.zeros(2), np.zeros(design.observer.order))
    estimates = []
    for k in range(20):
        estimates.append(float((observer.Cz[observer.fault_rows] @ z + observer.Dy[observer.fault_rows] @ state)[0]))
        z = observer.Az @ z + observer.By @ state
        # The fault of size one begins at 10.8 samples.
        state = expm(A * HOLD) @ state + held(HOLD * min(max(k + 1 - 10.8, 0.0), 1.0))
    # Neither no fault nor the fault, in the first row and in those after it: no value that the fault had.
    assert 0.05 < abs(estimates[11]) < 0.95
    assert abs(estimates[12] - 1.0) > 0.01
    assert "the model is exact, all signals held over each sample" in " ".join(str(design).split())


def test_the_deviation_of_a_recursion_without_a_horizon_has_its_time() -> None:
    plant = obsynth.discretise(in_continuous_time(), HOLD)
    design = obsynth.adaptive_observer(plant)
    told = " ".join(str(design).split())
    assert "horizon" not in told
    assert "deviation after 1,000 samples without a change" in told
    # After forty samples it is another one, as what is assumed before the first is forgotten at this pace.
    short = obsynth.adaptive_observer(obsynth.discretise(in_continuous_time(), HOLD), forgetting=0.999)
    (printed,) = (check.value for check in short.report.checks if check.name == "noise in fhat[f1]")
    state = short.observer.init()
    for _ in range(40):
        state, estimates = short.observer.step(state, np.zeros(2), np.zeros(0))
    assert estimates.fault_deviations.item() > 1.1 * printed


@pytest.mark.parametrize(
    ("delay", "is_decoupled", "said"),
    [
        (
            None,
            True,
            "noise 2 times the least of any causal filter with its response to the faults, decoupled as it is",
        ),
        (None, False, "noise 2 times the least of any causal filter with its response to the faults"),
        ((1,), False, "noise 2 times the least of any causal filter with delay 1"),
    ],
)
def test_the_least_noise_is_that_of_filters_that_respond_alike(delay, is_decoupled, said) -> None:
    """A slower filter has a hundredth of the noise: "4.62 times the least possible" was said beside it."""
    least = LeastPossible(0.0, 0.0, 2.0, 1.0, delay, math.nan, is_decoupled=is_decoupled)
    assert least.sentence() == said


def test_a_certain_detection_is_of_a_fault_from_a_sample_on() -> None:
    """One that begins within a sample may be detected later than at the stated delay."""
    design = obsynth.guaranteed_test(obsynth.discretise(in_continuous_time(), HOLD), noise_bound=3.0)
    observer, delay = design.observer, round(design.certificate.claims["delay"] / HOLD)

    def largest(begins: float) -> float:
        """The residual within the delay after a unit step that begins so many samples after row 40."""
        state, z, residuals = np.zeros(2), np.zeros(observer.order), []
        for k in range(40 + delay + math.ceil(begins)):
            residuals.append(abs((observer.Cz @ z + observer.Dy @ state)[-1]))
            z = observer.Az @ z + observer.By @ state
            state = expm(A * HOLD) @ state + held(HOLD * min(max(k + 1 - 40 - begins, 0.0), 1.0))
        return max([*residuals, abs((observer.Cz @ z + observer.Dy @ state)[-1])][: 41 + math.floor(delay + begins)])

    assert largest(0.0) >= 1.0 - 1e-9 > 1.0 - 1e-4 > largest(0.5)
    assert "with this course, from a sample on, is certain to raise an alarm" in " ".join(design.notes)
    assert "from a sample on" in method_class("guaranteed-test").claims["surely_found"].meaning


def test_a_delay_curve_is_of_walks_and_of_no_design() -> None:
    curve = delay_curve(obsynth.discretise(in_continuous_time(), HOLD).plant, 0)
    assert curve is not None
    assert curve.title.startswith("Least standard deviation of an estimate of f1 that walks")


def test_the_price_of_noise_is_against_the_filter_of_the_search() -> None:
    """Any slower filter is quieter: none is the quietest of the plant."""
    plant = in_continuous_time()
    design = obsynth.ui_pi_observer(plant)
    row = "noise in fhat[f1]"
    (own,) = (check.value for check in design.report.checks if check.name == row)
    slow = obsynth.functional_filter(plant, fault_rate=1e-5)
    (quiet,) = (check.value for check in slow.report.checks if check.name == row)
    assert own / quiet > 2.0 * design.certificate.claims["noise_price"]
    assert "quietest" not in method_class("ui-pi-observer").claims["noise_price"].meaning
