"""Least mean squares in continuous time where sensors have no noise: the white noise of the outputs is singular."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg

import obsynth
from obsynth.methods.optimal_filter.error_channel import ErrorChannel
from obsynth.verification.error_system import ErrorModel

REFERENCE = (np.array([[-3.0]]), np.array([[1.0]]), np.array([[1.0]]), np.array([[0.0]]))

#: Varga 2017, example 5.15: y = f / (s + 1) + w / (s + 2), to be matched 1 / (s + 3).
EXAMPLE = {"A": np.diag([-1.0, -2.0]), "Bf": [[1.0], [0.0]], "Bw": [[0.0], [1.0]], "C": [[1.0, 1.0]], "dt": 0.0}


def plant_of(seed: int) -> obsynth.DescriptorSystem:
    """Return a stable plant of which most sensors have no noise."""
    rng = np.random.default_rng([91, seed])
    n, ny, nw = (int(rng.integers(1, most)) for most in (5, 4, 4))

    def drawn(rows: int, columns: int) -> np.ndarray:
        return np.round(2.0 * rng.standard_normal((rows, columns))) / 2.0

    a = drawn(n, n) - 2.0 * np.eye(n)
    last = np.linalg.eigvals(a).real.max()
    a = a if last <= -0.2 else a - (0.5 + last) * np.eye(n)
    dw = drawn(ny, nw) * (rng.random((ny, 1)) < 0.4)
    return obsynth.DescriptorSystem(A=a, Bf=drawn(n, 1), Bw=drawn(n, nw), C=drawn(ny, n), Dw=dw, dt=0.0)


def least_with_noise(plant: obsynth.DescriptorSystem, noise: float) -> float:
    """Return the least root mean square with so much noise of its own on every sensor, by SciPy's Riccati equation."""
    ar, br, cr, _ = REFERENCE
    a = scipy.linalg.block_diag(plant.A, ar)
    b = np.block([[plant.Bf, plant.Bw], [br, np.zeros((1, plant.nw))]])
    c = np.hstack([plant.C, np.zeros((plant.ny, 1))])
    d = np.hstack([plant.Df, plant.Dw])
    covariance = scipy.linalg.solve_continuous_are(a.T, c.T, b @ b.T, d @ d.T + noise**2 * np.eye(plant.ny), s=b @ d.T)
    wanted = np.hstack([np.zeros((1, plant.nx)), cr])
    return float(np.sqrt((wanted @ covariance @ wanted.T).item()))


def deviation_of(design: obsynth.OptimalFilter, *, faults: float = 1.0) -> float:
    """Return the root mean square of the estimate less what it shall match, from plant and filter in series."""
    plant, filter_ = design.plant, design.observer
    ar, br, cr, dr = REFERENCE
    n, nz = plant.nx, filter_.order
    a = np.block(
        [
            [plant.A, np.zeros((n, nz + 1))],
            [filter_.By @ plant.C, filter_.Az, np.zeros((nz, 1))],
            [np.zeros((1, n + nz)), ar],
        ]
    )
    b = np.block(
        [
            [plant.Bf, plant.Bw],
            [filter_.By @ plant.Df, filter_.By @ plant.Dw],
            [br, np.zeros((1, plant.nw))],
        ]
    )
    rows = filter_.fault_rows
    c = np.hstack([filter_.Dy[rows] @ plant.C, filter_.Cz[rows], -cr])
    through = np.hstack([faults * (filter_.Dy[rows] @ plant.Df - dr), filter_.Dy[rows] @ plant.Dw])
    assert np.max(np.abs(through)) < 1e-9
    covariance = scipy.linalg.solve_continuous_lyapunov(a, -b @ b.T)
    return float(np.sqrt(max((c @ covariance @ c.T).item(), 0.0)))


def matched(plant: obsynth.DescriptorSystem) -> obsynth.OptimalFilter:
    return obsynth.optimal_filter(plant, reference=REFERENCE, exact=False, norm="h2")


def test_a_textbook_example_has_the_value_of_its_spectral_factors() -> None:
    design = matched(obsynth.DescriptorSystem(**EXAMPLE))
    # ||Mr||^2 - ||[Mr Gf~ / Go~]+||^2 with Go = (sqrt 5 + s sqrt 2) / ((s + 1) (s + 2)).
    value = np.sqrt((1.0 - 25.0 / (np.sqrt(5.0) + 3.0 * np.sqrt(2.0)) ** 2) / 6.0)
    claims = design.certificate.claims
    assert claims["deviation"] == pytest.approx(value, rel=1e-9)
    assert claims["least_deviation"] == pytest.approx(value, rel=1e-9)
    assert deviation_of(design) == pytest.approx(value, rel=1e-9)


@pytest.mark.one_in(6)
@pytest.mark.parametrize("seed", [0, 4, 8, 10, 12, 38])
def test_the_least_mean_square_is_the_limit_of_less_and_less_noise(seed: int) -> None:
    plant = plant_of(seed)
    design = matched(plant)
    claims = design.certificate.claims
    some, little = (least_with_noise(plant, noise) for noise in (1e-3, 1e-5))
    assert claims["least_deviation"] <= little * (1.0 + 1e-6)
    assert claims["least_deviation"] >= little - 0.2 * (some - little) - 1e-6
    assert claims["least_deviation"] <= claims["deviation"] <= 1.01 * claims["least_deviation"] + 1e-6
    assert deviation_of(design) == pytest.approx(claims["deviation"], rel=1e-5, abs=1e-6)


@pytest.mark.parametrize("seed", [144, 164])
def test_a_least_mean_square_that_is_not_reached_is_approached(seed: int) -> None:
    design = matched(plant_of(seed))
    claims = design.certificate.claims
    assert claims["least_deviation"] == 0.0
    assert 0.0 < claims["deviation"] < least_with_noise(plant_of(seed), 1e-3)
    assert design.solver["added_noise"] > 0.0


@pytest.mark.parametrize("seed", [4, 39, 53])
def test_an_exact_fault_map_has_the_least_mean_square_of_sensors_without_noise(seed: int) -> None:
    design = obsynth.optimal_filter(plant_of(seed), reference=REFERENCE, norm="h2")
    claims = design.certificate.claims
    assert claims["deviation"] == claims["least_deviation"]
    assert deviation_of(design, faults=0.0) == pytest.approx(claims["deviation"], rel=1e-6)


@pytest.mark.parametrize("seed", [15, 43, 55, 59])
def test_sensors_without_noise_that_follow_from_others_change_nothing(seed: int) -> None:
    design = obsynth.optimal_filter(plant_of(seed), reference=REFERENCE, norm="h2")
    claims = design.certificate.claims
    assert claims["deviation"] == claims["least_deviation"]
    assert np.max(np.abs(design.observer.By), initial=0.0) < 1e3


def test_noise_that_is_read_by_rounding_only_has_its_own_mean_square() -> None:
    plant = obsynth.DescriptorSystem(
        A=[[0.0]], Bf=[[2.0]], Bw=[[0.0]], C=[[-1.0], [0.5], [-0.5]], Dw=[[0.0], [-0.5], [0.0]], dt=0.0
    )
    claims = obsynth.optimal_filter(plant, norm="h2", reference={"bandwidth": 1.0, "order": 2}).certificate.claims
    assert claims["least_deviation"] == 0.0
    assert claims["deviation"] < 1e-9


def test_outputs_that_show_derivatives_of_white_noise_have_the_least_mean_square_of_their_lags() -> None:
    plant = obsynth.DescriptorSystem(
        E=np.diag([1.0, 0.0]),
        A=[[-1.5, 2.0], [-1.0, 0.0]],
        Bf=[[1.0], [0.5]],
        Bw=[[0.5], [1.0]],
        C=[[0.5, -1.0]],
        dt=0.0,
    )
    lagged = obsynth.DescriptorSystem(
        E=np.diag([1.0, 0.0, 1.0]),
        A=[[-1.5, 2.0, 0.0], [-1.0, 0.0, 0.0], [0.5, -1.0, -1.0]],
        Bf=[[1.0], [0.5], [0.0]],
        Bw=[[0.5], [1.0], [0.0]],
        C=[[0.0, 0.0, 1.0]],
        dt=0.0,
    )
    own, behind = matched(plant).certificate.claims, matched(lagged).certificate.claims
    assert own["deviation"] == pytest.approx(own["least_deviation"], rel=1e-9)
    assert own["least_deviation"] == pytest.approx(behind["least_deviation"], rel=1e-9)
    assert own["least_deviation"] < 0.99 / np.sqrt(6.0)  # that of the estimate zero


def test_a_mean_square_that_has_lost_its_digits_is_none() -> None:
    design = matched(obsynth.DescriptorSystem(**EXAMPLE))
    observer = obsynth.LinearObserver.from_dict(
        {
            **design.observer.as_dict(),
            "Az": [[-2.12975633e17, -1.50161882e17, 0.576561668], [0.0, -1.5, 0.5], [0.0, 0.5, -1.5]],
            "By": [[-1.69352829e17], [0.0], [0.0]],
            "Bu": [[], [], []],
            "Cz": [[0.825109985, -0.346117782, -1.0331281e-17]],
            "Dy": [[0.0]],
        }
    )
    T = np.array([[-0.29661771, -0.29661771], [-0.70710678, -0.70710678], [-0.70710678, 0.70710678]])
    model = ErrorModel(design.plant, observer, T, np.zeros((1, 2)), decoupled=True)
    assert np.isnan(ErrorChannel(model, REFERENCE).deviation(0.0))


@pytest.mark.parametrize("order", [1, 2])
def test_where_no_output_shows_the_faults_the_estimate_is_zero(order: int) -> None:
    plant = obsynth.DescriptorSystem(
        A=[[0.0]],
        Bf=[[0.0]],
        Bw=[[2.5, 1.0, -0.5]],
        C=[[0.5], [0.5], [-1.0]],
        Dw=[[0.0, 0.0, 0.0], [1.0, 0.0, 1.0], [1.5, 1.0, -0.5]],
        dt=0.0,
    )
    design = obsynth.optimal_filter(plant, norm="h2", exact=False, reference={"bandwidth": 2.0, "order": order})
    claims = design.certificate.claims
    # The mean square of the reference model alone: 2 / (s + 2), or its square.
    assert claims["least_deviation"] == claims["deviation"] == pytest.approx(1.0 / np.sqrt(order), rel=1e-12)
    assert design.observer.order == 0
    assert not design.observer.Dy.any()


def test_outputs_that_are_read_at_once_by_rounding_pass_no_white_noise() -> None:
    plant = obsynth.DescriptorSystem(
        E=np.diag([1.0, 1.0, 0.0]),
        A=[[0.5, 0.5, 0.0], [0.5, 0.0, 0.0], [0.0, -1.0, 1.5]],
        B=[[1.5], [0.0], [-0.5]],
        Bf=[[2.5], [0.0], [0.0]],
        Bw=[[1.0], [-1.0], [1.5]],
        C=[[-1.0, -1.5, -1.0], [-1.0, 0.5, 1.0], [-1.0, 2.0, -0.5]],
        Dw=[[0.0], [-1.5], [0.0]],
        dt=0.0,
    )
    design = obsynth.optimal_filter(plant, norm="h2", exact=False, reference={"bandwidth": 2.0, "order": 2})
    claims = design.certificate.claims
    assert claims["least_deviation"] == 0.0
    assert claims["deviation"] <= 1e-3
    assert design.report.passed


def test_outputs_whose_algebraic_parts_cancel_in_the_filter_pass_no_white_noise() -> None:
    plant = obsynth.DescriptorSystem(
        E=np.diag([1.0, 0.0, 1.0]),
        A=[[-0.5, -0.5, -1.5], [0.0, -1.0, 1.5], [-1.0, -1.5, -1.0]],
        Bf=[[-1.0, 1.0], [-1.0, 1.0], [1.5, -1.0]],
        Bw=[[0.0, 0.0, 0.5], [-1.0, 0.0, 0.0], [-1.5, -2.0, 1.0]],
        C=[[-0.5, 1.0, -0.5], [0.5, 1.5, 0.0]],
        dt=0.0,
    )
    design = obsynth.optimal_filter(plant, norm="h2", exact=False, reference={"bandwidth": 2.0})
    assert design.report.passed
    assert design.certificate.claims["deviation"] == pytest.approx(1.22255095, rel=1e-8)


def test_a_least_mean_square_that_is_rounding_is_zero() -> None:
    plant = obsynth.DescriptorSystem(
        E=np.diag([1.0, 0.0, 1.0]),
        A=[[-1.5, -1.5, -0.5], [-0.5, -1.0, 0.0], [-2.0, -0.5, -1.0]],
        Bf=[[-0.5], [1.0], [1.5]],
        Bw=[[1.0], [-1.0], [0.5]],
        C=[[0.5, 1.0, 0.5], [-1.0, 1.0, 1.0], [1.5, -0.5, -2.0]],
        Dw=[[0.0], [1.0], [0.0]],
        dt=0.0,
    )
    claims = obsynth.optimal_filter(plant, norm="h2", reference={"bandwidth": 1.0, "order": 2}).certificate.claims
    assert claims["least_deviation"] == 0.0
    assert claims["deviation"] < 1e-6


#: Plants of index 1 of which some signals reach the outputs at once by rounding of the products that say so, or all
#: outputs together show nothing of the algebraic state.
MIXED_EQUATIONS = {
    "fault": {
        "E": [[1.3, -0.1, 0.4, 0.0], [0.1, 1.4, -0.3, 0.0], [0.2, 0.0, 1.1, 0.0], [-0.4, 0.0, 0.1, 0.0]],
        "A": [
            [-0.76, 0.6, -2.68, -2.63], [-2.85, -3.65, 2.03, -0.28],
            [1.86, 0.68, -3.48, -0.27], [2.77, -0.05, -0.78, 0.0],
        ],
        "Bf": [[0.44], [-1.63], [1.3], [0.16]],
        "Bw": [[0.11, 0.22], [-0.19, -0.53], [1.0, -0.82], [1.7, 0.15]],
        "C": [[0.3, 2.2, -0.9, 1.4], [0.2, -0.7, 0.2, -1.3], [-0.2, 0.2, 0.4, 0.2]],
    },
    "noise": {
        "E": [[0.9, 0.2, 0.1, 0.0], [0.4, 0.6, 0.2, 0.0], [-0.5, 0.1, 1.2, 0.0], [0.2, 0.0, -0.5, 0.0]],
        "A": [
            [-2.28, -1.23, 0.05, 0.28], [-1.94, -1.7, 0.22, -0.26],
            [0.29, 2.64, -3.68, -2.47], [1.73, -0.34, 0.32, -0.49],
        ],
        "Bf": [[-0.96], [-0.38], [-0.45], [0.29]],
        "Bw": [[-0.12, 0.46], [0.3, 0.3], [0.57, 1.77], [-0.21, -0.12]],
        "C": [[-0.7, 2.1, 0.1, 0.6], [0.6, -1.3, 0.9, 0.8], [-3.1, -0.2, -0.8, 0.0]],
    },
    "algebraic state": {
        "E": [[0.5, -0.3, 0.3, 0.0], [-0.3, 0.5, -0.1, 0.0], [-0.4, 0.1, 0.9, 0.0], [0.1, 0.4, 1.0, 0.0]],
        "A": [
            [-1.64, 2.05, -2.1, -0.34], [2.04, -1.3, 1.2, 0.22],
            [2.22, -0.87, -2.64, 0.11], [2.14, 0.76, -3.54, -0.13],
        ],
        "Bf": [[0.45], [-0.11], [1.88], [1.93]],
        "Bw": [[1.14, -1.05], [-1.09, 1.45], [-0.93, 1.42], [-0.49, 1.61]],
        "C": [[0.3, -0.6, 0.0, -0.6], [0.1, -0.9, -0.2, -0.5], [2.4, 3.1, 0.0, -0.1]],
    },
}  # fmt: skip


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", MIXED_EQUATIONS)
def test_signals_that_reach_the_outputs_at_once_by_rounding_only_take_no_filter_away(name: str) -> None:
    given = MIXED_EQUATIONS[name]
    plant = obsynth.DescriptorSystem(**given, Dw=[[0.0, 0.0], [0.0, 0.2], [0.0, 1.4]], dt=0.0)
    design = obsynth.optimal_filter(plant, norm="h2")
    assert design.report.passed
    # The algebraic states solved for by hand: the last column of E is zero, and one combination of its rows is.
    e, a = np.array(given["E"]), np.array(given["A"])
    left = scipy.linalg.null_space(e.T).T
    rows, rest = left @ a / (left @ a)[0, 3], np.eye(3)
    into = np.vstack([rest, -rows[:, :3] @ rest])
    driven = np.hstack([np.array(given["Bf"]), np.array(given["Bw"])])
    added = np.vstack([np.zeros((3, 3)), -(left @ driven) / (left @ a)[0, 3]])
    right = np.linalg.lstsq(e[:, :3], np.hstack([a @ into, a @ added + driven]), rcond=None)[0]
    c, through = plant.C @ into, plant.C @ added + np.hstack([plant.Df, plant.Dw])
    explicit = obsynth.DescriptorSystem(
        A=right[:, :3], Bf=right[:, 3:4], Bw=right[:, 4:], C=c, Df=through[:, :1], Dw=through[:, 1:], dt=0.0
    )
    other = obsynth.optimal_filter(
        explicit, norm="h2", reference={part: np.array(design.options["reference"][part]) for part in "ABCD"}
    )
    own, same = design.certificate.claims, other.certificate.claims
    assert own["least_deviation"] == pytest.approx(same["least_deviation"], rel=1e-6, abs=1e-6)
    assert own["deviation"] == pytest.approx(own["least_deviation"], rel=1e-2, abs=1e-6)


def test_a_filter_that_follows_no_state_but_by_rounding_follows_none() -> None:
    # Index 2 without dynamics: no finite mode, and the outputs show derivatives of what drives the plant.
    plant = obsynth.DescriptorSystem(
        E=[[1.0, 0.0], [0.0, 0.0]],
        A=[[0.0, 1.5], [0.5, 0.0]],
        Bf=[[-0.5], [1.0]],
        Df=[[1.5], [0.0], [0.5]],
        Bw=[[1.0, -0.5], [-0.5, 1.0]],
        C=[[-0.5, 1.0], [-0.5, -1.5], [1.0, 1.0]],
        dt=0.0,
    )
    design = obsynth.optimal_filter(plant, norm="h2", reference={"bandwidth": 2.0})
    claims = design.certificate.claims
    # Three outputs show the three signals: all is known.
    assert claims["least_deviation"] == 0.0
    assert claims["deviation"] < 1e-6
