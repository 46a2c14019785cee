"""Bounds for disturbances that switch between samples, and the proved sums that they are made of."""

from __future__ import annotations

from fractions import Fraction
from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.linalg import expm

import obsynth
from obsynth.errors import SpecError
from obsynth.monitoring.thresholds.between_samples import IntersampleErrorSystem
from obsynth.monitoring.thresholds.residual_model import residual_model
from obsynth.proofs.balls import Ball
from obsynth.proofs.contraction import prove_contraction
from obsynth.proofs.peak_sums import absolute_gains, gathered, interval_pieces, peak_sums
from obsynth.proofs.products import energy, exponential


def held_input(a: np.ndarray, b: np.ndarray, time: float) -> Ball:
    r"""Return a ball that holds ``\int_0^t e^{A s} ds B``, for ``A (n, n)``, ``B (n, m)``."""
    n, m = b.shape
    chain = np.zeros((n + m, n + m))
    chain[:n, :n], chain[:n, n:] = a, b
    whole = exponential(chain, time)
    return Ball(whole.midpoint[:n, n:], whole.radius[:n, n:])


def test_the_number_of_the_issue():
    """x' = -x + d, y = x + d, L = .3, h = 1: 2.000 for every d(t), 1.356 for one that is held."""
    a, one, gain = np.array([[-1.0]]), np.eye(1), np.array([[0.3]])
    moving = exponential(a, 1.0) - Ball.exact(gain)
    contraction = prove_contraction(moving, discrete=True)
    pieces = interval_pieces(a, one, Ball.exact(-one), 1.0)
    between = gathered(pieces, peak_sums(moving, one, pieces.columns, contraction)[1], 1)[0]
    sampled = peak_sums(moving, one, Ball.exact(gain), contraction)[1][0]
    exact = ((1.0 - np.exp(-1.0)) + 0.3) / (1.3 - np.exp(-1.0)) + 1.0
    assert exact == pytest.approx(2.0, abs=1e-12)
    assert exact <= between + sampled + 1.0 <= exact * 1.001
    held = peak_sums(moving, one, Ball.exact(gain) - held_input(a, one, 1.0), contraction)[1][0]
    assert held + 1.0 == pytest.approx(1.356, abs=1e-3)


def test_sums_are_bounds_and_tight():
    rng = np.random.default_rng(2)
    for radius in (0.2, 0.9, 0.99):
        a = rng.standard_normal((5, 5))
        a *= radius / np.max(np.abs(np.linalg.eigvals(a)))
        b, c = rng.standard_normal((5, 2)), rng.standard_normal((3, 5))
        contraction = prove_contraction(a, discrete=True)
        found = peak_sums(Ball.exact(a), c, Ball.exact(b), contraction, least=7)
        powers, total = np.eye(5), np.zeros((4000, 2))
        for k in range(4000):
            total[k], powers = np.linalg.norm(c @ powers @ b, axis=0), powers @ a
        exact = np.cumsum(total, axis=0)
        assert np.all(found[0][:7] >= exact[:7])
        assert np.allclose(found[0][:7], exact[:7], rtol=1e-9)
        assert np.all(found[1] >= exact[-1])
        assert np.all(found[1] <= 1.002 * exact[-1])
        loose = contraction.gain(c, b)
        assert np.all(loose >= sum(np.abs(c @ np.linalg.matrix_power(a, k) @ b) for k in range(50)))
        gains, terms = absolute_gains(a, c, contraction), np.zeros((3, 5))
        for k in range(2000):
            terms += np.abs(c @ np.linalg.matrix_power(a, k))
        assert np.all(gains >= terms * (1.0 - 1e-12))
        assert np.all(gains <= 1.06 * terms)


def test_of_one_state_the_sum_is_the_series():
    """1 / (1 - a), wherever the terms that are summed one by one end."""
    one = np.eye(1)
    for a in (0.5, 0.9, 0.97):
        contraction = prove_contraction(a * one, discrete=True)
        for left in (1e-3, 0.3, 10.0):
            found = peak_sums(Ball.exact(a * one), one, Ball.exact(one), contraction, relative_remainder=left)
            assert 1.0 / (1.0 - a) * (1.0 - 1e-15) <= found[1][0] <= 1.2 / (1.0 - a)


@pytest.mark.parametrize("each", [False, True])
def test_sums_hold_for_every_member_of_balls(each: bool):
    """The largest member of a positive system has the largest sums."""
    rng = np.random.default_rng(4)
    for wide in ((0.02, 0.0), (0.0, 0.1), (0.02, 0.1)):
        a, b, c = rng.uniform(0.05, 0.2, (3, 3)), rng.uniform(0.5, 1.0, (3, 2)), rng.uniform(0.5, 1.0, (2, 3))
        moving, columns = Ball(a, np.full_like(a, wide[0])), Ball(b, np.full_like(b, wide[1]))
        contraction = prove_contraction(moving, discrete=True)
        found = peak_sums(moving, c, columns, contraction, least=6, each=each)
        terms = [c @ np.linalg.matrix_power(a + wide[0], k) @ (b + wide[1]) for k in range(400)]
        exact = np.cumsum([term if each else np.linalg.norm(term, axis=0) for term in terms], axis=0)
        assert np.all(found[0][:6] >= exact[:6])
        assert np.all(found[1] >= exact[-1] * (1.0 - 1e-12))


def test_sums_are_no_less_than_those_of_rational_arithmetic():
    """Products that cancel, so that double precision is off by much of what is left; half of them are too small."""
    rng = np.random.default_rng(5)
    for trial in range(20):
        b, c = rng.standard_normal((12, 1)), rng.standard_normal((1, 12))
        c[0, -1] = -float(c[0, :-1] @ b[:-1, 0]) / b[-1, 0]
        a = np.diag(rng.uniform(0.3, 0.6, 12)) if trial % 2 else np.zeros((12, 12))
        found = peak_sums(Ball.exact(a), c, Ball.exact(b), prove_contraction(a, discrete=True), least=4)
        pairs = zip(np.diag(a), c[0], b[:, 0], strict=True)
        modes = [(Fraction(pole), Fraction(x) * Fraction(y)) for pole, x, y in pairs]
        total = Fraction(0)
        for k in range(4):
            total += abs(sum((weight * pole**k for pole, weight in modes), Fraction(0)))
            assert Fraction(float(found[0][k, 0])) >= total


@pytest.mark.parametrize("start", [0.0, np.pi / 2.0])
def test_an_interval_is_no_shorter_than_its_integral(start: float):
    """sin and cos over [0, 1.3]: trapezoids are below both, and the curvature of one grows along every piece."""
    turn, length = np.array([[0.0, 1.0], [-1.0, 0.0]]), 1.3
    b = np.array([[np.sin(start)], [np.cos(start)]])
    pieces = interval_pieces(turn, b, Ball.exact(np.eye(2)), length)
    sizes = np.abs(pieces.columns.midpoint[0]) + pieces.columns.radius[0]
    exact = np.cos(start) - np.cos(start + length)
    assert exact * (1.0 - 1e-14) <= gathered(pieces, sizes, 1)[0] <= exact * (1.0 + 1e-3)


def test_gains_in_continuous_time_are_integrals():
    a, c = np.array([[-1.0, 5.0], [-5.0, -1.0]]), np.array([[1.0, 0.5]])
    found = absolute_gains(a, c, prove_contraction(a, discrete=False))
    for i in range(2):
        exact = sum(quad(lambda t, i=i: abs((c @ expm(a * t))[0, i]), k, k + 1, limit=200)[0] for k in range(30))
        assert exact <= found[0, i] <= 1.1 * exact


def test_what_does_not_contract_is_not_proved():
    assert prove_contraction(np.array([[1.0]]), discrete=True) is None
    assert prove_contraction(np.array([[0.0]]), discrete=False) is None
    assert prove_contraction(np.array([[0.5, 1.0], [0.0, 1.0 + 1e-15]]), discrete=True) is None
    assert prove_contraction(np.array([[-1.0]]), discrete=False, rate=1.0 + 1e-9) is None
    assert prove_contraction(np.array([[-1.0]]), discrete=False, rate=1.0 - 1e-9) is not None


def test_the_energy_of_an_interval_is_enclosed():
    a, b = np.array([[-1.0, 2.0], [0.0, -0.3]]), np.array([[1.0], [0.5]])
    found = energy(a, b, 0.7)
    for i in range(2):
        for j in range(2):
            exact = quad(lambda s, i=i, j=j: (expm(a * s) @ b @ b.T @ expm(a.T * s))[i, j], 0.0, 0.7)[0]
            assert abs(found.midpoint[i, j] - exact) <= 1e-12
            assert found.radius[i, j] <= 1e-14


def worst_residual(design: obsynth.ObserverDesign, dt: float, horizon: float, pieces: int = 8) -> float:
    """The largest residual that switching loads of one reaches in a simulation of plant and sampled observer."""
    plant, held = design.linear[0], obsynth.sample_observer(design.observer, dt)
    steps, step = round(horizon / dt), dt / pieces
    whole = expm(np.block([[plant.A, plant.Bd], [np.zeros((plant.nd, plant.nx + plant.nd))]]) * step)
    free, forced = whole[: plant.nx, : plant.nx], whole[: plant.nx, plant.nx :]
    seen = []
    for piece, load in product(range(-1, pieces), range(plant.nd)):  # -1: the value at the sample alone
        x, z, rows = np.zeros(plant.nx), np.zeros(held.order), []
        for k in range(steps):
            y = plant.C @ x + (plant.Dd[:, load] if k == 0 and piece == -1 else 0.0)
            rows.append((held.Cz @ z + held.Dy @ y)[held.residual_rows])
            z = held.Az @ z + held.By @ y
            for i in range(pieces):
                x = free @ x + forced[:, load] * (k == 0 and i == piece)
        seen.append(rows)
    response = np.array(seen).reshape(-1, held.Cz[held.residual_rows].shape[0])
    directions = np.random.default_rng(0).standard_normal((20, response.shape[1]))
    best = 0.0
    for direction in directions:
        for _ in range(20):
            direction = np.sign(response @ direction) @ response
        best = max(best, float(np.linalg.norm(direction)))
    return best


@pytest.mark.one_in(4)
@pytest.mark.parametrize("dt", [0.05, 0.4])
@pytest.mark.parametrize("direct", [0.0, 0.3])
def test_no_switching_load_passes_the_threshold_and_some_come_near(dt: float, direct: float):
    """An oscillating plant whose outputs are far from straight between samples, with and without feedthrough."""
    plant = obsynth.DescriptorSystem(
        None, [[-0.4, 6.0, 0], [-6.0, -0.4, 0], [0, 0, 0.0]], C=[[1.0, 0, 0], [0, 1.0, 0], [0, 0.2, 1.0]],
        Bf=[[0.0], [1.0], [0.0]], Bd=[[0.5], [0.2], [0.3]], Dd=[[0.0], [direct], [0.0]], disturbance_names=["load"],
    )  # fmt: skip
    design = obsynth.pd_observer(plant, decay=1.0)
    scenario = obsynth.Scenario(horizon=20, sample_time=dt, disturbances={"load": obsynth.Uniform(low=-1, high=1)})
    threshold = obsynth.monitor(design, scenario).threshold
    found = worst_residual(design, dt, 20.0)
    assert found <= threshold[-1] <= 1.5 * found
    online = obsynth.online_monitor(design, disturbance_bounds={"load": 1.0}, sample_time=dt)
    assert online.rule.limit >= threshold[-1] * (1.0 - 1e-9)
    assert "between samples" in online.statement
    assert "exact model" in online.statement
    assert online.rule.irregular[1] >= found


@pytest.mark.long
@pytest.mark.parametrize("dt", [0.05, 0.4])
def test_two_loads_at_once_pass_no_threshold_at_any_sample(dt: float):
    """Both switch at their worst, from the first interval on; at any stamps as well as at regular ones."""
    plant = obsynth.DescriptorSystem(
        None, [[-0.4, 3.0], [-3.0, -0.4]], C=np.eye(2), Bf=[[0.0], [1.0]], Bd=[[0.5, 0.4], [0.2, 0.3]],
        Dd=[[0.0, 0.1], [0.3, 0.2]], disturbance_names=["load", "wind"],
    )  # fmt: skip
    design = obsynth.pd_observer(plant, decay=1.0)
    both = {name: obsynth.Uniform(low=-1, high=1) for name in ("load", "wind")}
    threshold = obsynth.monitor(design, obsynth.Scenario(horizon=10, sample_time=dt, disturbances=both)).threshold
    for k in (1, 2, 3, len(threshold)):
        assert worst_residual(design, dt, k * dt) <= threshold[k - 1]
    online = obsynth.online_monitor(design, disturbance_bounds={"load": 1.0, "wind": 1.0}, sample_time=dt)
    reached = worst_residual(design, dt, 10.0)
    assert reached <= min(online.rule.limit, online.rule.irregular[1])


def test_two_noises_of_the_plant_add_up_in_tables_and_for_ever():
    """What is gathered in each sample, of the worst signs, through plant and sampled observer."""
    plant = obsynth.DescriptorSystem(
        None, [[-0.4, 3.0], [-3.0, -0.4]], C=np.eye(2), Bf=[[0.0], [1.0]], Bw=[[0.1, 0.05], [0.0, 0.2]],
        Dw=np.zeros((2, 2)),
    )  # fmt: skip
    design, dt, bound = obsynth.pd_observer(plant, decay=1.0), 0.1, 2.0
    scenario = obsynth.Scenario(horizon=10, sample_time=dt, noise=1)
    threshold = obsynth.monitor(design, scenario, noise_bound=bound).threshold
    model = residual_model(design, scenario)
    columns = bound * model.continuous.gathered_noise(model.continuous.between.plant)
    held, free = obsynth.sample_observer(design.observer, dt), expm(plant.A * dt)
    rows, terms = held.residual_rows, np.zeros(len(threshold))
    for column in columns.T:
        x, z = column, np.zeros(held.order)
        for k in range(1, len(threshold)):
            y = plant.C @ x
            terms[k] += np.linalg.norm((held.Cz @ z + held.Dy @ y)[rows])
            x, z = free @ x, held.Az @ z + held.By @ y
    sums = np.cumsum(terms)
    assert np.all(threshold >= sums * (1.0 - 1e-12))
    assert np.all(threshold <= sums * 1.01 + 1e-9)
    online = obsynth.online_monitor(design, noise_bound=bound, sample_time=dt)
    assert online.rule.limit >= sums[-1]


def test_two_loads_of_a_sampled_design_add_up():
    written = obsynth.DescriptorSystem(
        None, [[-0.2, 4.0], [-4.0, -0.2]], C=np.eye(2), Bf=[[0.0], [1.0]], Bd=[[1.0, 0.4], [0.3, 0.7]],
        disturbance_names=["load", "wind"],
    )  # fmt: skip
    design = obsynth.fault_estimation_filter(obsynth.discretise(written, 0.6).plant)
    bounds = {"load": 1.0, "wind": 1.0}
    alone = [obsynth.online_monitor(design, disturbance_bounds={**bounds, name: 0.0}).rule.limit for name in bounds]
    both = obsynth.online_monitor(design, disturbance_bounds=bounds).rule.limit
    assert both == pytest.approx(sum(alone), rel=1e-9)
    scenario = obsynth.Scenario(horizon=60, disturbances={name: obsynth.Uniform(low=-1, high=1) for name in bounds})
    assert obsynth.monitor(design, scenario).threshold[-1] <= both * (1.0 + 1e-9)


RESONANCE = [[0.0, 1.0], [-1.0, -0.1]]
STRAIGHT_LINES = {
    # name: A, C, Bd, Dd, interval
    "at once": ([[-1.0]], [[1.0]], [[0.0, 0.0]], [[1.0, 0.5]], 0.1),
    "slope": ([[-1.0]], [[1.0]], [[1.0, 0.5]], [[0.0, 0.0]], 0.01),
    "bend": (RESONANCE, [[1.0, 0.0]], [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]], [[0.0, 0.0, 0.0]], 0.2),
}


@pytest.mark.parametrize("name", STRAIGHT_LINES)
def test_straight_lines_miss_no_more_of_an_output_than_is_added(name: str):
    """An observer of gain one: what is added is the largest distance of an output from its chord."""
    a, c, bd, dd, h = STRAIGHT_LINES[name]
    plant = obsynth.DescriptorSystem(None, a, C=c, Bd=bd, Dd=dd)
    none: Any = None
    found = IntersampleErrorSystem(plant, h, none, none, none, none, none, none, none, slice(0, 1), 0.0)
    one: Any = SimpleNamespace(Az=-np.eye(1), By=np.eye(1), Cz=np.eye(1))
    added = found.at_any_stamps(np.ones(plant.nd), one)
    if name == "at once":
        reached = 2.0 * 1.5  # both are one at the samples, and minus one between them
    else:
        # Impulse responses of what an output has above the middle of its chord; the worst signs of what came before.
        fine = h / 40
        whole = expm(np.block([[plant.A, plant.Bd], [np.zeros((plant.nd, plant.nx + plant.nd))]]) * fine)
        free, forced, response = whole[: plant.nx, : plant.nx], whole[: plant.nx, plant.nx :], [np.zeros(plant.nd)] * 40
        for _ in range(20_000):
            response.append((plant.C @ forced)[0])
            forced = free @ forced
        rows = np.array(response)
        reached = float(np.sum(np.abs(rows[20:-20] - 0.5 * (rows[40:] + rows[:-40]))))
    assert reached <= added * (1.0 + 2e-3)
    assert added < 4.0 * reached


def test_an_unstable_plant_whose_outputs_bend_has_no_bound_for_ever():
    plant = obsynth.DescriptorSystem(
        None, [[0.5, 1.0], [0.0, -1.0]], C=np.eye(2), Bf=[[0.0], [1.0]], Bd=[[1.0], [0.0]], disturbance_names=["load"]
    )
    design = obsynth.pd_observer(plant, decay=1.0)
    with pytest.raises(SpecError, match=r"no bound: the plant's mode at 0\.5"):
        obsynth.online_monitor(design, disturbance_bounds={"load": 1.0}, sample_time=0.1)
    # A record of known length has one.
    scenario = obsynth.Scenario(horizon=5, sample_time=0.1, disturbances={"load": obsynth.Uniform(low=-1, high=1)})
    assert worst_residual(design, 0.1, 5.0) <= obsynth.monitor(design, scenario).threshold[-1]


@pytest.mark.parametrize("direct", [0.0, 0.4])
def test_a_sampled_design_knows_what_moves_between_its_samples(direct: float, tmp_path):
    """The bound is that of the issue; a saved design, which holds the plant as written, has the same."""
    written = obsynth.DescriptorSystem(
        None, [[-0.2, 4.0], [-4.0, -0.2]], C=[[1.0, 0.2], [0.0, 1.0]], Bf=[[0.0], [1.0]], Bd=[[1.0], [0.3]],
        Dd=[[direct], [0.0]], disturbance_names=["load"],
    )  # fmt: skip
    design = obsynth.fault_estimation_filter(obsynth.discretise(written, 0.6).plant)
    scenario = obsynth.Scenario(horizon=60, disturbances={"load": obsynth.Uniform(low=-1, high=1)})
    watched = obsynth.monitor(design, scenario)
    observer, rows = design.observer, design.observer.residual_rows
    t, phi = design.certificate.matrices["tracking"][:, :2], observer.Az
    exact, powers = np.zeros(1), np.eye(observer.order)
    for _ in range(80):
        shown = observer.Cz[rows] @ powers
        exact += quad(lambda s, c=shown: np.linalg.norm(c @ t @ expm(written.A * s) @ written.Bd), 0.0, 0.6)[0]
        exact += np.linalg.norm(shown @ observer.By @ written.Dd)
        powers = powers @ phi
    exact += np.linalg.norm(observer.Dy[rows] @ written.Dd)
    assert exact[0] <= watched.threshold[-1] <= exact[0] * 1.002
    assert "between samples" in watched.statement
    again = obsynth.load(design.save(tmp_path / "gains.json"))
    online = obsynth.online_monitor(again, disturbance_bounds={"load": 1.0})
    assert online.rule.limit == pytest.approx(watched.threshold[-1], rel=1e-3)
    held = design.replace(source=None)
    assert obsynth.monitor(held, scenario).threshold[-1] < watched.threshold[-1]
    assert "held between samples" in obsynth.monitor(held, scenario).statement


@pytest.mark.parametrize("kind", ["held", "line"])
def test_known_inputs_that_move_between_samples_are_in_the_threshold(kind: str):
    """A continuous design knows its inputs at samples only; its threshold follows what they may do between them."""
    a, b, h, rows = np.array([[0.0, 4.0], [-4.0, -0.4]]), np.array([[0.0], [3.0]]), 0.2, 150
    plant = obsynth.DescriptorSystem(
        None, a, B=b, C=[[1.0, 0.0]], Bf=[[0.0], [1.0]], Bd=[[0.0], [0.01]], disturbance_names=["load"]
    )
    design = obsynth.pd_observer(plant, decay=1.0)
    watched = obsynth.online_monitor(design, disturbance_bounds={"load": 1.0}, sample_time=h)
    u = np.random.default_rng(1).uniform(-1.0, 1.0, rows)
    slopes = np.diff(u, append=u[-1]) / h if kind == "line" else np.zeros(rows)
    step = expm(np.block([[a, b, np.zeros((2, 1))], [np.zeros((2, 3)), np.array([[1.0], [0.0]])]]) * h)
    states = [np.zeros(2)]
    for k in range(rows - 1):
        states.append(step[:2, :2] @ states[-1] + step[:2, 2] * u[k] + step[:2, 3] * slopes[k])
    log = {"time": h * np.arange(rows), "y1": np.array(states)[:, 0], "u1": u}
    table = obsynth.run_on_data(design, log, monitor=watched).table
    ratio = (table["statistic"] / table["threshold"]).dropna()
    assert len(ratio) > 100
    assert 0.9 < ratio.max() <= 1.0
    # Disturbances alone are far from it.
    assert table["statistic"].max() > 5.0 * watched.rule.limit


def test_a_disturbance_of_size_zero_has_no_effect_even_where_another_has_no_bound():
    """What does not decay makes the effect of a disturbance infinite, and that of none is zero, not undefined."""
    plant = obsynth.DescriptorSystem(
        None, [[0.5, 1.0], [0.0, -1.0]], C=np.eye(2), Bf=[[0.0], [1.0]], Bd=[[1.0], [0.0]], disturbance_names=["load"]
    )
    scenario = obsynth.Scenario(horizon=5, sample_time=0.1)
    assert obsynth.monitor(obsynth.pd_observer(plant, decay=1.0), scenario).threshold[-1] < 1e-300
    # Nothing but rounding would pass such a threshold on a log.
    with pytest.raises(SpecError, match="no disturbance and no noise reaches the residual"):
        obsynth.online_monitor(obsynth.ui_pi_observer(plant), disturbance_bounds={"load": 0.0}, sample_time=0.1)
