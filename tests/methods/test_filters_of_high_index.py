"""Optimal filters of plants of index 2 or more: of sampled ones, whose outputs show inputs of later samples, and of
continuous ones, whose outputs show derivatives."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import block_diag

import obsynth
from obsynth.errors import counted
from obsynth.results.design import Certificate
from obsynth.verification.invisible_faults import proved_least
from obsynth.verification.seen_outputs import Setting, seen_plant

#: y1 = f_k + w_{k+1} and y2 = w_k + n_k: with one sample of delay w is measured, with noise.
LATER_NOISE = obsynth.DescriptorSystem(
    E=[[0, 1], [0, 0]],
    A=np.eye(2),
    C=np.eye(2),
    Bf=np.zeros((2, 1)),
    Df=[[1], [0]],
    Bw=[[0, 0], [-1, 0]],
    Dw=[[0, 0], [0, 1]],
    dt=1.0,
)


ONE_LATE = {"A": [[0.0]], "B": [[1.0]], "C": [[1.0]], "D": [[0.0]]}


def scrambled(seed: int, index: int) -> obsynth.DescriptorSystem:
    """Return a plant of an index in random integer coordinates."""
    rng = np.random.default_rng([index, seed])
    modes = np.round(2.0 * rng.standard_normal((2, 2))) / 4.0
    e, a = block_diag(np.eye(2), np.eye(index, k=1)), block_diag(modes, np.eye(index))
    left, right = (np.eye(len(e)) + np.triu(rng.integers(-1, 2, a.shape), 1) for _ in range(2))
    c, bf = rng.integers(-2, 3, (2, len(e))), rng.integers(-2, 3, (len(e), 1))
    return obsynth.DescriptorSystem(
        E=left @ e @ right, A=left @ a @ right, C=c, Bf=bf, dt=1.0, sensor_noise={"y1": 0.1, "y2": 0.1}
    )


def turned(seed: int, count: int) -> obsynth.DescriptorSystem:
    """Return a continuous plant of index 3 with so many finite modes, in random coordinates."""
    rng = np.random.default_rng([3, seed, count])
    modes = rng.standard_normal((count, count))
    modes -= (max(np.linalg.eigvals(modes).real) + 0.3) * np.eye(count)
    e, a = block_diag(np.eye(count), np.eye(3, k=1)), block_diag(modes, np.eye(3))
    left, right = rng.standard_normal((2, len(e), len(e)))
    return obsynth.DescriptorSystem(
        E=left @ e @ right,
        A=left @ a @ right,
        C=rng.standard_normal((3, len(e))),
        Bf=rng.standard_normal((len(e), 1)),
        Bw=np.hstack([0.1 * rng.standard_normal((len(e), 2)), np.zeros((len(e), 3))]),
        Dw=np.hstack([np.zeros((3, 2)), 0.1 * np.eye(3)]),
    )


@pytest.mark.parametrize(("seed", "count"), [(2, 3), (1, 5)])
def test_infinite_modes_of_index_3_that_come_out_of_qz_as_fast_ones_place_no_cayley_point(
    seed: int, count: int
) -> None:
    design = obsynth.optimal_filter(turned(seed, count))
    assert design.report.passed
    assert 0.0 < design.least <= design.gain < design.least * (1 + 3e-5)
    lag = -np.array(design.options["reference"]["A"])[0, 0]
    assert lag < 10.0  # rad/s, near the finite modes; with infinite ones among them some hundred


@pytest.mark.parametrize(("delay", "truth"), [(0, 1.0), (1, 0.5**0.5)])
def test_noise_that_is_seen_a_sample_before_has_its_least_gain_proved(delay: int, truth: float) -> None:
    plant, setting = seen_plant(LATER_NOISE, ()), Setting((delay,), (), True)
    bounds = [
        proved_least(plant, points, 3, setting, level=truth, enough=0.0)
        for points in ([], [1.5 + 0j], [1.1j, -2.0 + 0j])
    ]
    assert all(bound is not None and truth * (1 - 1e-9) < bound <= truth * (1 + 1e-14) for bound in bounds)


def test_a_filter_reaches_the_least_gain_with_noise_of_the_next_sample() -> None:
    design = obsynth.optimal_filter(LATER_NOISE, delay=1)
    assert design.report.passed
    assert design.gain == pytest.approx(0.5**0.5, rel=1e-6)
    assert design.least == pytest.approx(0.5**0.5, rel=1e-6)


@pytest.mark.parametrize("index", [2, 3])
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.long), pytest.param(2, marks=pytest.mark.long)])
def test_gain_and_least_gain_meet_whatever_the_index(index: int, seed: int) -> None:
    design = obsynth.optimal_filter(scrambled(seed, index))
    assert design.report.passed
    assert 0.0 < design.least <= design.gain < design.least * (1 + 1e-6)


@pytest.mark.parametrize(
    ("index", "norm"), [(2, "hinf"), pytest.param(3, "hinf", marks=pytest.mark.long), (2, "h2"), (3, "h2")]
)
def test_matching_whose_best_filter_reads_later_inputs_reads_outputs_at_once(index: int, norm: str) -> None:
    plant = scrambled(2, index)
    design = obsynth.optimal_filter(plant, reference=ONE_LATE, exact=False, norm=norm)
    assert design.report.passed
    assert f"a state only {counted(index - 1, 'sample')} later" in design.notes[-1]
    assert 0.0 < design.least <= design.gain < design.least * (1.0 + 1e-6)
    gains, squares = [], []
    for angle in (np.arange(2000) + 0.5) * np.pi / 2000:
        point, o = np.exp(1j * angle), design.observer
        read = o.Cz @ np.linalg.solve(point * np.eye(o.order) - o.Az, o.By.astype(complex)) + o.Dy
        driven = np.linalg.solve(point * plant.E - plant.A, np.hstack([plant.Bf, plant.Bw]).astype(complex))
        error = read @ (plant.C @ driven + np.hstack([plant.Df, plant.Dw])) - np.eye(1, 3) / point
        gains.append(np.linalg.norm(error, 2))
        squares.append(np.linalg.norm(error) ** 2)
    reached = max(gains) if norm == "hinf" else np.sqrt(np.mean(squares))
    assert reached == pytest.approx(design.gain, rel=1e-4)
    assert reached <= design.gain * (1.0 + (1e-9 if norm == "hinf" else 1e-3))


def test_matching_reads_outputs_late_where_known_inputs_would_be_needed_before_they_act() -> None:
    plant = scrambled(1, 2)
    known = plant.replace(B=np.ones((plant.nx, 1)), D=np.zeros((plant.ny, 1)), input_names=["u"])
    design = obsynth.optimal_filter(known, reference=ONE_LATE, exact=False)
    assert design.report.passed
    assert "reads each output 1 sample late" in design.notes[-1]
    assert 0.0 < design.least < design.gain <= 1.0 + 1e-6  # that of no filter


def test_thresholds_of_filters_whose_errors_are_a_state_only_later_are_learned_and_run(tmp_path: Path) -> None:
    plant = scrambled(2, 2)
    design = obsynth.optimal_filter(plant, reference=ONE_LATE, exact=False)
    assert "later" in design.certificate.matrices
    rng, n = np.random.default_rng(20261201), 600
    log = {"time": np.arange(n) * plant.dt} | {name: rng.normal(size=n) for name in plant.output_names}
    learned = obsynth.learn_thresholds(design, log, false_alarms="1 per 100 rows")
    shifted = log | {name: log[name] + 20.0 * (np.arange(n) >= 300) for name in plant.output_names}
    monitor = obsynth.online_monitor(design, learned)
    run = obsynth.run_on_data(design, shifted, monitor=monitor)
    assert run.alarms == {"learned": 300.0 * plant.dt}
    assert obsynth.export(design, tmp_path / "a.c", monitor=monitor)


@pytest.mark.parametrize("later", [None, 0.0, 2.0, 0.5, np.nan])
def test_another_number_of_samples_by_which_errors_are_later_is_refused(later: float | None, tmp_path: Path) -> None:
    design = obsynth.optimal_filter(scrambled(2, 2), reference=ONE_LATE, exact=False, norm="h2")
    assert obsynth.verify(obsynth.load(design.save(tmp_path / "a.gains.json"))).passed
    matrices = {name: part for name, part in design.certificate.matrices.items() if name != "later"}
    matrices |= {} if later is None else {"later": np.array([[later]])}
    assert design.certificate.matrices["later"].tolist() == [[1.0]]
    assert not obsynth.verify(design.replace(certificate=Certificate(matrices, design.certificate.claims))).passed


def test_faults_that_do_nothing_are_no_rounding_of_other_inputs() -> None:
    plant = obsynth.DescriptorSystem(
        E=[[0, 1], [0, 0]],
        A=[[-1, 0.5], [0, -0.5]],
        C=[[-3, -2], [-6, -1]],
        Bf=[[0], [0]],
        Bd=[[-3, -1], [0, 2]],
        Dd=[[-3, -1], [3, 0]],
        Bw=[[-1, 0, 0], [2, 0, 0]],
        Dw=[[0, 0.1, 0], [0, 0, 0.1]],
        dt=0.1,
    )
    with pytest.raises(obsynth.PreconditionError, match="cannot be told from each other"):
        obsynth.optimal_filter(plant)


def test_a_fast_zero_that_a_lag_hardly_shows_is_not_taken_for_one_that_it_cancels() -> None:
    plant = obsynth.DescriptorSystem(
        A=[[-0.25, 0], [-0.5, -0.5]],
        C=[[-2, 0]],
        Bf=[[-4], [-1]],
        Df=[[-0.5]],  # a zero at 15.75
        Bw=[[2, 0], [3, 0]],
        Dw=[[0, 0.1]],
    )
    with pytest.raises(obsynth.PreconditionError, match="zero that is not strictly stable"):
        obsynth.optimal_filter(plant)


def test_a_long_delay_leaves_no_states_that_are_reached_by_rounding_only() -> None:
    """The filter had 21 states, for 12 that respond, and its gain was proved to four digits only."""
    rng = np.random.default_rng([47, 3, 14])
    rng.integers(1, 5), rng.integers(2, 4), rng.integers(1, 3), rng.random()
    modes = rng.standard_normal((3, 3))
    modes *= 0.8 / max(abs(np.linalg.eigvals(modes)))
    e, a = block_diag(np.eye(3), np.eye(3, k=1)), block_diag(modes, np.eye(3))
    left, right = rng.standard_normal((2, 6, 6))
    c, fault = rng.standard_normal((2, 6)), rng.standard_normal((6, 1))
    design = obsynth.optimal_filter(
        obsynth.DescriptorSystem(
            E=left @ e @ right, A=left @ a @ right, C=c, Bf=fault, dt=1.0, sensor_noise={"y1": 0.1, "y2": 0.1}
        ),
        delay=5,
    )
    assert design.report.passed
    assert design.observer.order <= 14
    assert design.gain == pytest.approx(0.04384642, rel=1e-6)
    assert design.gain < design.least * (1 + 1e-6)


@pytest.mark.long
def test_modes_that_grow_and_that_no_input_drives_are_followed_where_outputs_are_of_high_index() -> None:
    design = obsynth.optimal_filter(scrambled(8, 3))
    assert design.report.passed
    assert "A mode of the plant does not decay" in design.notes[-1]
    assert 0.05 * (1.0 - 1e-8) < design.least <= design.gain < design.least * (1 + 1e-6)


def lagged(plant: obsynth.DescriptorSystem) -> obsynth.DescriptorSystem:
    """Return a plant behind a lag of each output, of which the same is known: what y is follows from its lag."""
    ny, none = plant.ny, np.zeros((plant.ny, plant.ny))
    return obsynth.DescriptorSystem(
        E=block_diag(plant.E, np.eye(ny)),
        A=np.block([[plant.A, np.zeros((plant.nx, ny))], [plant.C, -np.eye(ny)]]),
        C=np.hstack([np.zeros((ny, plant.nx)), np.eye(ny)]),
        Bf=np.vstack([plant.Bf, plant.Df]),
        Bw=np.vstack([plant.Bw, plant.Dw]),
        Df=none[:, : plant.nf],
        Dw=np.zeros_like(plant.Dw),
    )


@pytest.mark.long
@pytest.mark.parametrize(("seed", "count"), [(0, 3), (2, 3), (1, 5)])
def test_outputs_that_show_second_derivatives_of_white_noise_have_the_least_mean_square_of_their_lags(
    seed: int, count: int
) -> None:
    reference = {"A": [[-1.5]], "B": [[1.5]], "C": [[1.0]], "D": [[0.0]]}
    plant = turned(seed, count)
    own, behind = (
        obsynth.optimal_filter(one, norm="h2", exact=False, reference=reference).certificate.claims
        for one in (plant, lagged(plant))
    )
    assert own["deviation"] == pytest.approx(own["least_deviation"], rel=1e-6)
    assert own["least_deviation"] == pytest.approx(behind["least_deviation"], rel=1e-7)
    assert own["least_deviation"] < 0.9 * np.sqrt(0.75)  # that of the estimate zero
    twice = obsynth.optimal_filter(lagged(lagged(plant)), norm="h2", exact=False, reference=reference)
    assert own["least_deviation"] == pytest.approx(twice.least, rel=1e-7)
    assert twice.gain < 1.01 * twice.least


def of_index_two(seed: int, count: int) -> obsynth.DescriptorSystem:
    """Return a continuous plant of index 2 with so many finite modes and a disturbance; no noise reaches the others."""
    rng = np.random.default_rng([47, 2, seed])
    modes = rng.standard_normal((count, count))
    modes -= (max(np.linalg.eigvals(modes).real) + 0.4) * np.eye(count)
    e, a = block_diag(np.eye(count), np.eye(2, k=1)), block_diag(modes, np.eye(2))
    left, right = rng.standard_normal((2, len(e), len(e)))
    noise = np.vstack([rng.standard_normal((count, 1)), np.zeros((2, 1))])
    return obsynth.DescriptorSystem(
        E=left @ e @ right,
        A=left @ a @ right,
        C=rng.standard_normal((4, len(e))) @ right,
        Bf=left @ rng.standard_normal((len(e), 1)),
        Bd=left @ rng.standard_normal((len(e), 1)),
        Bw=np.hstack([left @ noise, np.zeros((len(e), 4))]),
        Dw=np.hstack([np.zeros((4, 1)), 0.1 * np.eye(4)]),
    )


@pytest.mark.parametrize(("seed", "count"), [(0, 2), pytest.param(1, 4, marks=pytest.mark.long)])
def test_exact_fault_maps_of_index_2_pass_no_white_noise(seed: int, count: int) -> None:
    plant = of_index_two(seed, count)
    design = obsynth.optimal_filter(plant, norm="h2", reference={"bandwidth": 2.0, "order": 3}, decoupled="d1")
    assert design.report.passed
    observer = design.observer
    for frequency in (0.3, 2.0, 30.0):
        point = 1j * frequency
        of_y = observer.Cz @ np.linalg.solve(point * np.eye(observer.order) - observer.Az, observer.By) + observer.Dy
        of_f, of_d = (
            plant.C @ np.linalg.solve(point * plant.E - plant.A, driven) + through
            for driven, through in ((plant.Bf, plant.Df), (plant.Bd, plant.Dd))
        )
        assert of_y @ of_f == pytest.approx(8.0 / (point + 2.0) ** 3, rel=1e-6)
        assert abs(of_y @ of_d) < 1e-7 * np.linalg.norm(of_y) * np.linalg.norm(of_d)


def test_a_default_reference_has_the_order_that_a_finite_mean_square_needs() -> None:
    # y = f / (s + 1) + w: a lag of first order has an exact fault map, and passes white noise at once.
    plant = obsynth.DescriptorSystem(A=[[-1]], Bf=[[1]], C=[[1]], Bw=[[0]], Dw=[[1]])
    assert np.shape(obsynth.optimal_filter(plant).options["reference"]["A"]) == (1, 1)
    assert np.shape(obsynth.optimal_filter(plant, norm="h2").options["reference"]["A"]) == (2, 2)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("norm", ["hinf", "h2"])
def test_outputs_that_need_derivatives_of_a_known_input_cost_nothing(norm: str):
    """Index 3, outputs with u and its first two derivatives: the least is that of the plant without the input."""
    matrices = {
        "E": [[1, 0, 0, 1], [0, 0, -1, 1], [-1, 1, -2, 1], [0, 0, 1, -1]],
        "A": [[-5, 4, -2, -4], [-7, 6, -2, -5], [-7, 5, -2, -5], [6, -5, 1, 5]],
        "C": [[-1, 4, 1, 0], [-2, 3, 0, 0], [2, -1, 3, 0]],
        "Bf": [[-1], [1], [1], [-1]],
        "Bw": np.hstack([[[0.1], [0.1], [0.1], [-0.1]], np.zeros((4, 3))]),
        "Dw": np.hstack([np.zeros((3, 1)), 0.05 * np.eye(3)]),
    }
    design = obsynth.optimal_filter(obsynth.DescriptorSystem(**matrices, B=[[1], [4], [4], [-3]]), norm=norm)
    assert design.observer.input_names == ("u1", "derivative of u1", "second derivative of u1")
    assert any("need the derivative of 'u1'" in note for note in design.notes)
    alone = obsynth.optimal_filter(obsynth.DescriptorSystem(**matrices), norm=norm)
    claim = "least" if norm == "hinf" else "least_deviation"
    assert design.certificate.claims[claim] == pytest.approx(alone.certificate.claims[claim], rel=1e-6)
