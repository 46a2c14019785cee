"""Optimal filters at the boundary of stability: modes that last and no noise drives, zeros on the axis or circle."""

from __future__ import annotations

import math
import re
from functools import cache
from typing import Any

import numpy as np
import pytest

import obsynth

TURN = [[math.cos(1.0), math.sin(1.0)], [-math.sin(1.0), math.cos(1.0)]]
SENSORS = {"Bf": [[0], [1]], "Bw": np.zeros((2, 3)), "Dw": np.eye(3)}
PLANTS = {
    "a constant": {"A": [[1, 0], [0, 0.5]], "C": [[1, 0], [1, 1], [0, 1]], **SENSORS, "dt": 1.0},
    "a constant beside a noisy state": {
        "A": [[1, 0], [0, 0.5]],
        "C": [[1, 0], [1, 1], [0, 1]],
        "Bf": [[0], [1]],
        "Bw": [[0, 0, 0, 0], [0, 0, 0, 1]],
        "Dw": np.eye(3, 4),
        "dt": 1.0,
    },
    "an oscillation": {
        "A": [[*TURN[0], 0], [*TURN[1], 0], [0, 0, 0.5]],
        "C": [[1, 0, 0], [1, 0, 1], [0, 0, 1]],
        "Bf": [[0], [0], [1]],
        "Bw": np.zeros((3, 3)),
        "Dw": np.eye(3),
        "dt": 1.0,
    },
    "a constant, continuous": {"A": [[0, 0], [0, -0.5]], "C": [[1, 0], [1, 1], [0, 1]], **SENSORS},
}


@cache
def plant_and_filter(name: str) -> tuple[obsynth.DescriptorSystem, obsynth.ObserverDesign]:
    plant = obsynth.DescriptorSystem(**PLANTS[name])
    return plant, obsynth.optimal_filter(plant)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", PLANTS)
def test_a_stable_filter_is_found_whose_error_decays(name: str) -> None:
    plant, design = plant_and_filter(name)
    assert design.report.passed
    assert "does not decay, and no noise drives it" in design.notes[-1]
    poles = np.linalg.eigvals(design.observer.Az)
    assert np.max(np.abs(poles)) < 1.0 if plant.is_discrete else np.max(poles.real) < 0.0


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", ["a constant", "a constant beside a noisy state", "an oscillation"])
def test_its_gain_is_the_limit_of_plants_whose_mode_is_driven_less_and_less(name: str) -> None:
    plant, design = plant_and_filter(name)
    lasting = plant.nx - 1
    driven = plant.replace(
        Bw=np.hstack([plant.Bw, 1e-4 * np.eye(plant.nx)[:, :lasting]]),
        Dw=np.hstack([plant.Dw, np.zeros((plant.ny, lasting))]),
        noise_names=[*plant.noise_names, *(f"drive {i}" for i in range(lasting))],
    )
    limit = obsynth.optimal_filter(driven, delay=int(design.delay))
    assert design.least <= limit.gain * (1.0 + 1e-9)
    assert design.gain == pytest.approx(limit.gain, rel=1e-6)


def test_a_run_from_an_offset_forgets_it() -> None:
    plant, design = plant_and_filter("a constant")
    y = np.tile(plant.C @ [1.0, 0.0], (2000, 1))
    faults = design.observer.run(y).faults
    assert np.max(np.abs(faults[:5])) > 1e-2
    assert np.max(np.abs(faults[-5:])) < 1e-8


@pytest.mark.parametrize(
    ("name", "options"),
    [("a constant", {"delay": 1}), ("a constant, continuous", {"reference": {"bandwidth": 1.0, "order": 2}})],
)
def test_the_least_mean_square_is_nearly_reached_by_a_filter_that_forgets(name: str, options: dict[str, Any]) -> None:
    design = obsynth.optimal_filter(obsynth.DescriptorSystem(**PLANTS[name]), norm="h2", **options)
    claims = design.certificate.claims
    assert design.report.passed
    assert claims["least_deviation"] < claims["deviation"] <= 1.01 * claims["least_deviation"]
    assert "the slower filters forget" in design.notes[-1]


def test_a_plant_over_many_decades_without_noise_has_a_filter_that_follows_it() -> None:
    """Without noise there was no size for what is added, and coordinates over twelve decades lost small entries."""
    rng = np.random.default_rng(46)
    for _ in range(6):
        a, c = rng.standard_normal((4, 4)), rng.standard_normal((2, 4))
        states, outputs = 10.0 ** rng.uniform(-6.0, 6.0, 4), 10.0 ** rng.uniform(-6.0, 6.0, 2)
        plant = obsynth.DescriptorSystem(
            A=states[:, None] * a * (0.9 / np.max(np.abs(np.linalg.eigvals(a)))) / states,
            C=outputs[:, None] * c / states,
            Bf=states[:, None] * rng.standard_normal((4, 1)),
            dt=1.0,
        )
        design = obsynth.optimal_filter(plant)
        assert design.report.passed
        assert design.delay == 1


#: What the outputs show of the fault: its first or second derivative alone, the sum of two samples.
ZEROS_ON_THE_BOUNDARY = {
    "derivative": {"E": [[0, 1], [0, 0]], "C": [[1, 0]], "dt": 0.0},
    "second derivative": {"E": [[0, 1, 0], [0, 0, 1], [0, 0, 0]], "C": [[1, 0, 0]], "dt": 0.0},
    "sum of two samples": {"E": [[0, 1], [0, 0]], "C": [[1, 1]], "dt": 1.0},
}


@pytest.mark.one_in(6)
@pytest.mark.parametrize("norm", ["hinf", "h2"])
@pytest.mark.parametrize("name", ZEROS_ON_THE_BOUNDARY)
def test_a_zero_on_the_boundary_leaves_no_stable_filter(name: str, norm: str) -> None:
    n = len(ZEROS_ON_THE_BOUNDARY[name]["E"])
    plant = obsynth.DescriptorSystem(
        **ZEROS_ON_THE_BOUNDARY[name], A=np.eye(n), Bf=np.eye(n)[:, -1:], Bw=np.zeros((n, 1)), Dw=[[1.0]]
    )
    with pytest.raises(obsynth.PreconditionError, match="a zero that is not strictly stable"):
        obsynth.optimal_filter(plant, norm=norm)


def test_what_holds_at_any_delay_holds_at_this_one() -> None:
    """Of ``y_k = f_{k+2} + w_k`` nothing but the bound for any delay is proved, and the least gain is one."""
    plant = obsynth.DescriptorSystem(
        E=[[0, 1, 0], [0, 0, 1], [0, 0, 0]], A=np.eye(3), C=[[1, 0, 0]], Bf=[[0], [0], [1]], Bw=np.zeros((3, 1)),
        Dw=[[1]], dt=1.0,
    )  # fmt: skip
    design = obsynth.optimal_filter(plant)
    assert 0.9999 < design.least <= 1.0 < design.gain < 1.0 + 1e-8
    assert "between 0.9999" in design.notes[0]


@pytest.mark.long
def test_the_filter_for_more_noise_is_kept_where_less_cannot_be_proved() -> None:
    """A double integrator beside four states: with a tenth of the added noise, rounding spoils the proof."""
    A = np.zeros((6, 6))
    A[:4, :4] = [[-0.74, 0.06, -0.62, -0.81], [-0.81, -0.73, 0.2, 0.16], [0.05, -1.17, 0.01, 0.25],
                 [0.82, -0.16, 0.36, 0.76]]  # fmt: skip
    A[4:, 4:] = [[1.0, 1.0], [0.0, 1.0]]
    Bw = np.zeros((6, 4))
    Bw[:4, 0] = [0.94, -2.82, 0.94, 0.41]
    plant = obsynth.DescriptorSystem(
        E=None, A=A, Bw=Bw, Dw=np.hstack([np.zeros((3, 1)), 0.1 * np.eye(3)]), dt=1.0,
        Bf=[[-0.13, 0.8], [-1.34, 0.03], [-0.15, -0.88], [0.26, -0.21], [-1.58, -0.19], [1.23, 0.33]],
        C=[[2.49, -1.15, -0.94, -0.11, 0.22, 0.35], [-1.02, -0.19, -0.5, -0.35, 0.64, -0.55],
           [0.65, 0.27, -0.44, -0.5, 0.62, -0.59]],
        Df=[[0.58, 0.81], [1.57, 2.41], [-0.94, 0.74]],
    )  # fmt: skip
    design = obsynth.optimal_filter(plant, delay=8)
    assert obsynth.verify(design).passed
    claims = design.certificate.claims
    # The noise that was added is a hundredth of the plant's own.
    assert claims["least"] <= claims["gain"] <= 1.01 * claims["least"]


def growing(mode: float, dt: float) -> obsynth.DescriptorSystem:
    stable = 0.2 if dt else -0.2
    return obsynth.DescriptorSystem(
        A=[[mode, 0.0], [0.0, stable]], Bf=[[0], [1]], Bw=np.zeros((2, 3)), C=[[1, 0], [0, 1], [1, 1]],
        Df=[[1], [0], [2]], Dw=np.eye(3), dt=dt,
    )  # fmt: skip


@pytest.mark.one_in(3)
@pytest.mark.parametrize(("mode", "dt"), [(1.3, 1.0), (-1.05, 1.0), (0.3, 0.0)])
def test_where_a_mode_grows_the_least_mean_square_is_that_of_filters_whose_errors_decay(mode: float, dt: float) -> None:
    """From rest a filter of less ignores the mode; the Riccati equation has a stabilising solution beside."""
    plant, options = growing(mode, dt), {"delay": 2} if dt else {"reference": {"bandwidth": 0.2}}
    design = obsynth.optimal_filter(plant, norm="h2", **options)
    assert obsynth.verify(design).passed
    claims = design.certificate.claims
    assert claims["deviation"] == claims["least_deviation"]
    assert "whose errors decay after any start" in design.notes[0]
    # The limit of plants whose mode is driven less and less.
    drives = np.hstack([np.zeros((2, 3)), [[1e-4], [0.0]]])
    driven = obsynth.optimal_filter(
        plant.replace(Bw=drives, Dw=np.eye(3, 4), noise_names=[*"abcd"]), norm="h2", **options
    ).certificate.claims
    assert claims["deviation"] <= driven["deviation"] == pytest.approx(claims["deviation"], rel=1e-7)
    beyond = obsynth.Certificate(
        design.certificate.matrices, {**claims, "least_deviation": 1.00001 * claims["deviation"]}
    )
    failed = obsynth.verify(design.replace(certificate=beyond)).failures
    assert [check.name for check in failed] == ["least deviation"]


def test_errors_of_any_start_decay_beside_a_mode_that_grows() -> None:
    plant = growing(1.3, 1.0)
    design = obsynth.optimal_filter(plant, norm="h2", delay=1)
    y = 1e-3 * 1.3 ** np.arange(80.0)[:, None] * plant.C[:, 0]
    faults = np.abs(design.observer.run(y).faults)
    assert faults[-1, 0] < 1e-5 * np.max(faults) < 1e-7 * np.max(y)


@pytest.mark.parametrize(("mode", "dt"), [(-1.05, 1.0), pytest.param(0.3, 0.0, marks=pytest.mark.long)])
def test_the_least_gain_of_filters_whose_errors_decay_is_printed_beside_a_mode_that_grows(
    mode: float, dt: float
) -> None:
    """No noise drives it, so that the bound is also of filters that ignore it."""
    plant, options = growing(mode, dt), {"delay": 1} if dt else {"reference": {"bandwidth": 0.2}}
    design = obsynth.optimal_filter(plant, **options)
    printed = float(re.search(r"decay after any start is about ([\d.]+) ", design.notes[-1])[1])
    driven = plant.replace(Bw=np.hstack([np.zeros((2, 3)), [[1e-4], [0.0]]]), Dw=np.eye(3, 4), noise_names=[*"abcd"])
    limit = obsynth.optimal_filter(driven, **options)
    # Six digits are printed.
    assert printed == pytest.approx(limit.least, rel=5e-6)
    assert design.least < 0.9 * printed
    assert printed * (1 - 5e-6) <= design.gain <= 1.001 * printed


@pytest.mark.long
def test_weights_reach_the_noise_beside_modes_that_last() -> None:
    """The weights were those of the plant with its drives, and did not fit the plant as it is."""
    plant = growing(1.0, 1.0)
    weights = {"inputs": {plant.noise_names[0]: 2.0}}
    for norm in ("hinf", "h2"):
        assert obsynth.optimal_filter(plant, norm=norm, weights=weights, delay=1).report.passed


def test_noise_of_the_plant_may_have_the_name_of_what_is_added() -> None:
    plant = obsynth.DescriptorSystem(
        A=[[1]],
        C=[[1], [1]],
        Bf=[[0]],
        Df=[[1], [0]],
        Bw=np.zeros((1, 2)),
        Dw=np.eye(2),
        dt=1.0,
        noise_names=("drive of lasting mode 1", "noise y1"),
    )
    assert obsynth.optimal_filter(plant, delay=0).report.passed


@pytest.mark.parametrize("exact", [True, False])
def test_an_angle_sensor_of_a_cart_with_an_inverted_pendulum(exact: bool) -> None:
    """No noise drives the plant: neither its pole at zero nor the one that grows, and drives of the one are none of
    the other.  With the exact fault map the least is known: ``e = M v2 - N v1``, where ``N(p) = M(p) angle / position``
    at the growing pole, so that ``|N|_2^2 >= 2 p N(p)^2``."""
    noise, bandwidth = 1e-3, 1.3
    pendulum = obsynth.DescriptorSystem(
        A=[[0, 1, 0, 0], [0, -0.1, -0.98, 0], [0, 0, 0, 1], [0, 0.2, 21.56, 0]], B=[[0], [1], [0], [-2]],
        C=[[1, 0, 0, 0], [0, 0, 1, 0]], Df=[[0], [1]], Bf=np.zeros((4, 1)), Dw=noise * np.eye(2),
    )  # fmt: skip
    design = obsynth.optimal_filter(pendulum, norm="h2", exact=exact, reference={"bandwidth": bandwidth})
    claims, pole = design.certificate.claims, float(np.max(np.linalg.eigvals(pendulum.A).real))
    at_pole = bandwidth / (pole + bandwidth) * (pole**2 + 0.1 * pole) / 0.98
    least = noise * np.sqrt(bandwidth / 2.0 + 2.0 * pole * at_pole**2)
    assert design.report.passed
    if exact:
        assert claims["least_deviation"] == pytest.approx(least, rel=1e-6)
    assert claims["least_deviation"] <= claims["deviation"] <= 1.01 * claims["least_deviation"] <= 1.011 * least
    # A constant error of the position is forgot in minutes, not in years.
    assert np.max(np.linalg.eigvals(design.observer.Az).real) < -1e-3
