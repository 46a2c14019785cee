"""The functional filter: order, proof from the file alone, refusals, delay, residuals, and what is done with it."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from benchmarks.campaigns._rational_plants import drawn_plant
from scipy.linalg import solve_continuous_lyapunov

import obsynth
from obsynth.methods.functional_filter import kalman_gain, rates, synthesis
from obsynth.methods.functional_filter.method import FunctionalFilter
from obsynth.methods.functional_filter.rates import settling_time
from obsynth.plants.faults import exosystem
from obsynth.specs.loader import load_spec

DESIGNS = Path(__file__).parents[2] / "designs"


@cache
def motor() -> obsynth.DescriptorSystem:
    return load_spec(DESIGNS / "motor" / "spec.yaml").plant


@cache
def smib() -> obsynth.DescriptorSystem:
    return load_spec(DESIGNS / "smib" / "functional.yaml").plant


@cache
def tanks() -> obsynth.DescriptorSystem:
    return load_spec(DESIGNS / "tanks" / "spec.yaml").plant


@cache
def delayed() -> obsynth.ObserverDesign:
    return obsynth.functional_filter(smib(), fault_rate=0.01, delay=5)


def on_the_log(design: obsynth.ObserverDesign) -> float:
    log = pd.read_csv(DESIGNS / "motor" / "log.csv")
    true = pd.read_csv(DESIGNS / "motor" / "true_log.csv")
    observer = design.observer if design.plant.dt else obsynth.sample_observer(design.observer, 0.005)
    found = observer.run(log[list(design.plant.output_names)], log[["voltage"]])
    return float(np.sqrt(np.mean((found.faults[:, 0] - true["f"]) ** 2)))


def test_motor_order_proof_and_error_on_the_log() -> None:
    plant = motor()
    found = obsynth.functional_filter(plant, fault_rate=1.0)
    assert found.observer.order == 3
    assert found.observer.state_names == ()
    assert max(check.value for check in found.report.checks if check.kind == "equality") < 1e-9
    observer, t = found.observer, found.certificate.matrices["T"]
    t0 = found.certificate.matrices["T0"]
    at_rest = (
        observer.Dy[0] @ plant.Df
        - t0[0] @ plant.Bf
        - observer.Cz[0] @ np.linalg.solve(observer.Az, observer.By @ plant.Df - t @ plant.Bf)
    )
    assert abs(at_rest[0] - 1.0) < 1e-8
    assert on_the_log(found) < 0.02


@pytest.mark.parametrize("options", [{}, {"decay": 5.0, "fault_rate": 1.0}, {"poles": [-30, -31, -32]}])
def test_motor_by_default_and_by_speed(options: dict[str, object]) -> None:
    found = obsynth.functional_filter(motor(), **options)
    assert found.report.passed
    assert on_the_log(found) < 0.025


def test_refusal_names_the_load_and_the_sensor() -> None:
    plant = load_spec(DESIGNS / "motor" / "one_encoder.yaml").plant
    with pytest.raises(obsynth.PreconditionError) as caught:
        obsynth.functional_filter(plant)
    assert "and a step of -1 in load torque and states theta l = -0.02" in str(caught.value)
    assert "Measure one of: theta l." in str(caught.value)
    assert caught.value.signals == ("torque",)


@pytest.mark.long
def test_delay_against_noise_is_what_monte_carlo_finds() -> None:
    plant = smib()
    found = delayed()
    _, claimed = found.certificate.matrices["deviations"][0]
    assert claimed == pytest.approx(0.0090, rel=0.02)
    rng = np.random.default_rng(5)
    steps = 40_000
    f = np.cumsum(0.01 * rng.standard_normal(steps))
    d = np.cumsum(0.01 * rng.standard_normal(steps))
    noise = rng.standard_normal((steps, plant.nw))
    signals, states = np.column_stack([d, f, noise]), np.zeros((steps, plant.nx))
    driven = signals @ np.hstack([plant.Bd, plant.Bf, plant.Bw]).T
    for k in range(1, steps):
        states[k] = plant.A @ states[k - 1] + driven[k - 1]
    outputs = states @ plant.C.T + signals @ np.hstack([plant.Dd, plant.Df, plant.Dw]).T
    estimate = found.observer.run(outputs).faults[:, 0]
    error = estimate[1000:] - f[995:-5]
    assert np.sqrt(np.mean(error**2)) == pytest.approx(claimed, rel=0.03)
    assert found.observer.fault_delays == (5,)


def test_leak_of_the_load_is_rounding() -> None:
    plant = smib()
    found = delayed()
    observer = found.observer
    for w in (1e-3, 0.1, 1.0, 10.0, 100.0):
        z = np.exp(1j * w * plant.dt)
        y = plant.C @ np.linalg.solve(z * np.eye(plant.nx) - plant.A, plant.Bd) + plant.Dd
        out = observer.Cz @ np.linalg.solve(z * np.eye(observer.order) - observer.Az, observer.By @ y) + observer.Dy @ y
        assert abs(out[0, 0]) < 1e-10


def test_mean_and_delay_count_samples_from_the_fault() -> None:
    found = obsynth.functional_filter(smib(), fault_rate=0.01, delay=2, mean=5)
    assert found.observer.fault_delays == (4,)
    assert found.report["fault models"].passed


def test_joint_and_free_estimates_and_some_faults_only() -> None:
    plant = tanks()
    free = obsynth.functional_filter(plant, fault_rate=1e-3)
    joint = obsynth.functional_filter(plant, fault_rate=1e-3, joint=True)
    one = obsynth.functional_filter(plant, fault_rate=1e-3, faults=["clog 13"])
    assert (free.observer.order, joint.observer.order, one.observer.order) == (6, 6, 2)
    assert one.observer.fault_names == ("clog 13",)
    assert "free of others: clog 13" in [check.name for check in one.report.checks]
    noise = [design.certificate.matrices["deviations"][:, 1] for design in (free, joint)]
    assert np.all(noise[1] <= noise[0] * (1 + 1e-9))


def test_residuals_only() -> None:
    plant = tanks()
    bank = obsynth.functional_filter(plant, residuals="isolate")
    assert bank.observer.fault_names == ()
    assert bank.observer.order == 3
    assert bank.observer.residual_names == ("1: r1", "2: r1", "3: r1") or len(bank.observer.residual_names) == 3
    detect = obsynth.functional_filter(motor(), residuals="detect", poles=[-5, -6])
    assert sorted(np.linalg.eigvals(detect.observer.Az).real) == pytest.approx([-6, -5])
    chosen = obsynth.functional_filter(plant, residuals=[["leak 1", "leak 2"], ["clog 13"]])
    assert chosen.report.passed


def test_index_two_and_algebraic_rows_are_proved_with_t0() -> None:
    # y = x1 measures the algebraic equation 0 = x1 - x2 + f: the estimate uses the row itself.
    plant = obsynth.DescriptorSystem(
        [[1, 0], [0, 0]], [[-0.5, 0], [1, -1]], None, np.eye(2), Bf=[[0], [1]], Bw=np.zeros((2, 2)),
        Dw=0.1 * np.eye(2), dt=1.0,
    )  # fmt: skip
    found = obsynth.functional_filter(plant, fault_rate=0.1, delay=1)
    assert np.any(found.certificate.matrices["T0"])
    assert found.report.passed


@pytest.mark.parametrize("dt", [0.0, 1.0])
def test_exact_equations_need_no_noise(dt: float) -> None:
    # Index 2: x1 = 0 is exact, so x2 = -f, and y = x2 + v is the fault with the noise of one sensor: a walk of q in
    # noise of r has the least error of all filters in closed form.
    plant = obsynth.DescriptorSystem(
        [[1, 0], [0, 0]], [[0, 1], [1, 0]], None, [[0, 1]], Bf=[[1], [0]], Dw=[[0.1]], dt=dt
    )
    found = obsynth.functional_filter(plant, fault_rate=0.1)
    assert found.report.passed
    error = found.certificate.matrices["deviations"][0, 1]
    if dt:
        assert found.observer.order == 2
    else:
        assert error == pytest.approx(0.1, rel=1e-3)


@pytest.mark.parametrize("dt", [0.0, 1.0])
def test_exact_equations_with_inputs_and_noise(dt: float) -> None:
    e, a = np.diag([1.0, 1, 0]), [[-1.0, 1, 0], [-1, -1, 1], [1, 1, 0]]
    plant = obsynth.DescriptorSystem(
        e, a, [[0.0], [0], [-1]], [[0, 0, 1], [1, 0, 0]], Bf=[[1], [0], [0]], Dw=0.1 * np.eye(2), dt=dt
    )
    assert obsynth.functional_filter(plant).report.passed


@pytest.mark.parametrize("dt", [0.0, 1.0])
def test_an_empty_equation_is_left_out(dt: float) -> None:
    # sE - A is not regular: the third equation is 0 = 0, and x3 is free; the fault shows all the same.
    plant = obsynth.DescriptorSystem(
        np.diag([1.0, 1, 0]), [[-0.2, 0, 0.2], [0, -0.4, 0], [0, 0, 0]], None, [[1, 0, 0], [0, 1, 0]],
        Bf=[[0], [1], [0]], Dw=0.1 * np.eye(2), dt=dt,
    )  # fmt: skip
    assert obsynth.functional_filter(plant).report.passed
    assert obsynth.functional_filter(plant, residuals="detect").report.passed


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"delay": 3}, "count samples"),
        ({"faults": ["torgue"]}, "no such fault"),
        ({"fault_rate": {"torgue": 1.0}}, "unknown"),
        ({"poles": [-1, -2, -3], "fault_rate": 1.0}, "choose gains"),
        ({"residuals": "detect", "joint": True}, "leave them out"),
        ({"residuals": ["torgue"]}, "lists of faults to see"),
        ({"delay": -1}, "at least 0"),
        ({"fault_rate": float("nan")}, "positive numbers"),
    ],
)
def test_bad_options(options: dict[str, object], text: str) -> None:
    with pytest.raises(obsynth.SpecError, match=text):
        obsynth.functional_filter(motor(), **options)


def test_sensors_without_noise_are_refused_where_none_has_any() -> None:
    plant = motor()
    silent = plant.Dw.copy()
    silent[0] = 0.0
    assert obsynth.functional_filter(plant.replace(Dw=silent), fault_rate=1.0).report.passed
    with pytest.raises(obsynth.PreconditionError, match="state the noise of every sensor"):
        obsynth.functional_filter(plant.replace(Dw=np.zeros_like(silent)), fault_rate=1.0)


def test_banks_with_poles_as_asked() -> None:
    bank = obsynth.functional_filter(tanks(), residuals="isolate", poles=[[0.9], [0.8], [0.7]])
    assert bank.report.passed
    assert np.diag(bank.observer.Az) == pytest.approx([0.9, 0.8, 0.7])
    each = obsynth.functional_filter(tanks(), poles=[[0.9, 0.8], [0.8, 0.7], [[0.7, 0.1], [0.7, -0.1]]])
    assert sorted(np.abs(np.linalg.eigvals(each.observer.Az)))[-1] == pytest.approx(0.9)
    with pytest.raises(obsynth.SpecError, match="3 filters are asked for, with 1, 1, 1 poles"):
        obsynth.functional_filter(tanks(), residuals="isolate", poles=[0.9, 0.8, 0.7])
    with pytest.raises(obsynth.SpecError, match="functional-filter"):
        obsynth.functional_filter(tanks(), residuals="isolate", poles=[[0.9], [0.8], [0.7, 0.6]])


@pytest.mark.one_in(2)
@pytest.mark.parametrize("sampled", [True, False])
def test_monitors_of_residuals(sampled: bool) -> None:
    # The load torque acts all the time and is felt by none of them; sensor noise is what thresholds are against.
    plant = motor() if not sampled else load_spec(DESIGNS / "motor" / "sampled.yaml").plant
    design = obsynth.functional_filter(plant, residuals="detect")
    scenario = obsynth.Scenario(
        horizon=3.0, sample_time=None if sampled else 0.005, noise=1.0,
        faults={"torque": obsynth.Step(size=0.3, start=1.5)},
        disturbances={"load torque": obsynth.Sine(amplitude=0.2, frequency=1.0)},
    )  # fmt: skip
    for kind, options in (("pointwise", {"noise_bound": 4.0}), ("window", {"noise_bound": 4.0}), ("chi-square", {})):
        monitor = obsynth.monitor(design, scenario, kind, **options)
        counted = obsynth.evaluate(design, scenario, monitor=monitor, runs=20)
        assert counted.false_alarm_rate.value == 0.0
        if kind == "chi-square":
            assert counted.missed_detection_rate.value == 0.0


@pytest.mark.long
def test_monitors_of_estimates_with_a_delay() -> None:
    design = delayed()
    scenario = obsynth.Scenario(horizon=6.0, faults={"tm GENCLS 1": obsynth.Step(size=0.5, start=3.0)})
    monitor = obsynth.monitor(design, scenario, "pointwise")
    counted = obsynth.evaluate(design, scenario, monitor=monitor, runs=3)
    assert (counted.false_alarm_rate.value, counted.missed_detection_rate.value) == (0.0, 0.0)


@pytest.mark.long
def test_saved_file_is_verified_alone_and_exported(tmp_path: Path) -> None:
    found = delayed()
    loaded = obsynth.load(found.save(tmp_path / "gains.json"))
    assert obsynth.verify(loaded).passed
    obsynth.export(loaded, tmp_path / "filter.c")
    obsynth.export(loaded, tmp_path / "filter.mat")
    assert "fhat[tm GENCLS 1]" in obsynth.html_report(loaded, tmp_path / "page.html").read_text(encoding="utf-8")
    assert loaded.to_control().noutputs == len(loaded.observer.Cz)


def test_some_of_the_faults_are_judged_against_those() -> None:
    plant = obsynth.DescriptorSystem(
        A=[[0.5, 0.1], [0.0, 0.4]], B=[[1.0], [0.0]], C=np.eye(2), Bf=np.eye(2), fault_names=["a", "b"],
        sensor_noise={"y1": 0.01, "y2": 0.01}, dt=0.1,
    )  # fmt: skip
    found = obsynth.functional_filter(plant, faults=["b"])
    scenario = obsynth.Scenario(horizon=20.0, faults={"b": obsynth.Step(size=1.0, start=2.0)}, noise=0.0)
    assert abs(obsynth.simulate(found, scenario).fault_errors[-1, 0]) < 1e-3


#: Small integer plants whose filters had rows of nothing but rounding, which met their identities to all of themselves.
ROUNDING_ROWS = {
    "one unstable state": {
        "E": [[1]], "A": [[3]], "C": [[3], [0], [0], [0]], "Bf": [[0]], "Df": [[1], [0], [0], [0]],
        "Bd": [[0]], "Dd": [[0], [0], [-3], [-3]], "dt": 1.0,
    },
    "an output that is a biased zero": {
        "E": [[1]], "A": [[0]], "C": [[-1], [0], [0], [0]], "Bf": [[0]], "Df": [[3], [0], [0], [0]],
        "Bd": [[1]], "Dd": [[0], [-3], [0], [1]], "dt": 1.0,
    },
    "gains of rounding": {
        "E": [[-1]], "A": [[-2]], "C": [[-3], [0], [0], [1]], "Bf": [[0, -1]], "Df": [[3, 0], [0, 2], [1, 0], [0, 0]],
        "Bd": [[-2]], "Dd": [[0]] * 4, "dt": 0.0,
    },
    "a sensor without a state": {
        "E": [[1, 0], [0, 1]], "A": [[-2, -1], [2, 0]], "C": [[0, 0], [0, 2], [0, 3], [0, 0]], "Bf": [[-2, 0], [0, 0]],
        "Df": [[0, 2], [0, 0], [0, 0], [0, 0]], "dt": 1.0,
    },
    "a zero output": {
        "E": [[0, 1, 0, -1], [-1, 1, 0, -1], [1, 0, 1, 0], [0, 0, 0, 1]],
        "A": [[0, -1, 0, 1], [1, -2, 0, 1], [-1, 1, -1, 1], [0, 0, 0, -1]],
        "C": [[0, 0, 0, 0], [0, -1, 0, 0], [0, -1, 1, 0], [0, 1, 0, -2]], "Bf": [[-2, -2], [-4, 0], [4, -4], [2, 1]],
    },
}  # fmt: skip


@pytest.mark.one_in(5)
@pytest.mark.parametrize("name", ROUNDING_ROWS)
def test_rows_of_rounding_are_zero_and_lose_no_filter(name: str) -> None:
    entries = {
        key: value if key == "dt" else np.array(value, dtype=float) for key, value in ROUNDING_ROWS[name].items()
    }
    design = obsynth.functional_filter(obsynth.DescriptorSystem(**entries))
    assert design.report.passed
    # Every row of an output is a number or zero, not what rounding left of one.
    rows = np.abs(np.hstack([design.observer.Cz, design.observer.Dy]))
    assert not np.any((rows > 0.0) & (rows < 1e-13 * np.max(rows)))


#: Two outputs whose noise is one: the inverse of its covariance is rounding.
ONE_NOISE = obsynth.DescriptorSystem(
    [[1, 0, -1, 1], [0, 1, 0, 0], [-1, 2, 2, -1], [1, -1, -2, 1]],
    [[0.75, -0.75, -2, 0], [0.5, -1, -1.25, 0.25], [0.75, -2, -1.25, 1], [0.25, 0, 0, -0.25]],
    C=[[-1, -1, 3, 0], [0, -1, 1, 1]], Bf=[[3], [1], [-3], [5]], dt=1.0,
)  # fmt: skip


@pytest.mark.one_in(2)
@pytest.mark.parametrize("dt", [0.0, 1.0])
def test_the_gain_is_that_of_its_riccati_equation_whatever_the_solver_gives(
    dt: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Under one processor's kernels a solver gave covariances that miss the equation by .3, of filters that are stable.

    Of 500 random plants 50 had other gains.
    """
    plant = ONE_NOISE if dt else ONE_NOISE.replace(A=ONE_NOISE.A - 2.0 * ONE_NOISE.E, dt=0.0)
    usual = obsynth.functional_filter(plant)
    solvers = {"riccati_solution": kalman_gain.riccati_solution, "continuous_solution": kalman_gain.continuous_solution}

    def wrong(solve):
        def found(*given):
            p = solve(*given)
            return None if p is None else 1.3 * p + 0.1 * np.linalg.norm(p) * np.eye(len(p))

        return found

    for name, solve in solvers.items():
        monkeypatch.setattr(kalman_gain, name, wrong(solve))
    again = obsynth.functional_filter(plant)
    assert again.certificate.claims["decay"] == pytest.approx(usual.certificate.claims["decay"], rel=1e-6)
    for name, gain in usual.gains.items():
        np.testing.assert_allclose(again.gains[name], gain, rtol=1e-6, atol=1e-9 * np.max(np.abs(gain), initial=1.0))


@pytest.mark.parametrize("scatter", [0.0, 3e-16, 3e-8])
def test_what_rounding_leaves_of_an_integrator_is_no_time_of_the_plant(scatter: float) -> None:
    a = [[1.0 + scatter, 1.0], [0.0, 1.0]]
    sampled = obsynth.DescriptorSystem(None, a, C=[[1, 0]], Bf=[[0], [1]], dt=0.5)
    assert settling_time(sampled) == 10.0


def test_a_default_walk_shows_a_step_where_none_does_at_once() -> None:
    # Its unstable poles set the pace: after four samples no walk shows a step, and the slowest of all was taken, with
    # a pole at 1 - 1e-10 and a note that a step is estimated after 2 s.  The design was lost for what it then missed.
    e = [[1, 1, 1, 0, -1], [0, 1, 0, -1, 0], [0, 0, 1, 1, 0], [0, 0, 0, 1, -1], [0, 0, 0, 0, 1]]
    a = [[-4, 4, 1, -4, 0], [-1, 1, 4, -3, 3], [0, -2, 3, -4, -1], [-3, -2, 3, -1, 0], [-3, 0, -4, 1, -3]]
    plant = obsynth.DescriptorSystem(
        e, np.array(a) / 4, C=[[1, 1, -1, -2, -2]], Bf=[[-2], [-1], [1], [2], [-2]], Df=[[1]], dt=0.5
    )
    design = obsynth.functional_filter(plant)
    assert design.report.passed
    seconds = float(next(note for note in design.notes if "slowest with which" in note).split(" after ")[1].split()[0])
    assert seconds < 20.0
    x, outputs = np.zeros(5), []
    for _ in range(round(seconds / plant.dt) + 1):
        outputs.append(plant.C @ x + plant.Df[:, 0])
        x = np.linalg.solve(plant.E, plant.A @ x + plant.Bf[:, 0])
    assert design.observer.run(np.array(outputs)).faults[-1, 0] == pytest.approx(1.0, abs=0.5)


@pytest.mark.one_in(3)
@pytest.mark.parametrize(("seed", "times"), [(40134, 4), (52070, 256), (52298, 4096)])
def test_a_default_walk_waits_twice_as_long_until_a_step_shows(seed: int, times: int) -> None:
    given = drawn_plant("functional-filter", seed)
    plant = obsynth.DescriptorSystem(**{name: given.given[name] for name in ("E", "A", "C", "Bf", "Df", "Bd", "Dd")},
                                     dt=given.dt)  # fmt: skip
    note = next(note for note in obsynth.functional_filter(plant).notes if "slowest with which" in note)
    waited = float(note.split(" after ")[1].split()[0].replace(",", ""))
    assert waited == pytest.approx(times * settling_time(plant), rel=5e-3)


def test_a_fault_that_equations_without_noise_tell_has_a_walk() -> None:
    # No noise reaches what tells the second fault: all walks that were tried were zero.
    plant = obsynth.DescriptorSystem(
        [[1, 1], [0, 0]],
        [[-1, -1], [-0.5, -0.5]],
        C=[[1, -1], [2, 1]],
        Bf=[[0, 1], [0, -2]],
        Df=[[1, 0], [0, 0]],
        dt=0.5,
    )
    assert obsynth.functional_filter(plant).observer.fault_names == ("f1", "f2")


@pytest.mark.parametrize("decay", [0.01, 0.05, 0.1, 0.3])
def test_any_decay_of_a_sampled_plant_without_other_noise_has_a_gain(decay: float) -> None:
    # Nothing drives the fault's own mode, which the decay makes unstable: the solution that doubling begins at is none.
    plant = obsynth.DescriptorSystem(
        A=[[0.9, 0.1, 0.0], [0.0, 0.8, 0.1], [0.0, 0.0, 0.7]],
        C=[[1, 0, 0], [0, 1, 0]],
        Bf=[[1], [0], [0]],
        dt=1.0,
        sensor_noise={"y1": 0.1, "y2": 0.1},
    )
    found = obsynth.functional_filter(plant, decay=decay)
    assert found.report.passed
    assert found.certificate.claims["decay"] >= decay


@pytest.mark.parametrize(
    ("order", "pole", "link", "read", "moved"),
    [
        (15, -0.0273, 0.1506, [0, 11], 0),
        (15, -0.0049, 0.0215, [0, 6, 9, 13], 7),
        pytest.param(39, -0.3867, 0.0219, [0, 8, 24, 37], 1, marks=pytest.mark.long),
    ],
)
def test_a_long_chain_in_continuous_time_has_a_filter(
    order: int, pole: float, link: float, read: list[int], moved: int
) -> None:
    """Rows of the decoupled chain are decades apart in size, and so are the states of its filter."""
    a = pole * np.eye(order) + link * np.eye(order, k=1)
    plant = obsynth.DescriptorSystem(A=a, C=np.eye(order)[read], Bf=np.eye(order)[:, [moved]])
    design = obsynth.functional_filter(plant)
    assert design.report.passed
    assert design.report["constant fault"].value < 1e-6


@pytest.mark.parametrize("seed", range(4))
def test_a_search_with_rough_gains_comes_to_the_same_walk(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Large plants look for the walk with gains that are solved roughly: the walk is that of halving, or the next."""
    rng = np.random.default_rng([52, seed])
    a = rng.normal(size=(5, 5))
    a *= 0.9 / np.max(np.abs(np.linalg.eigvals(a)))
    plant = obsynth.DescriptorSystem(
        A=a, C=rng.normal(size=(3, 5)), Bf=rng.normal(size=(5, 1)), dt=1.0, Dw=0.1 * np.eye(3)
    )
    (model,) = FunctionalFilter().filter_models(plant, exosystem("step", plant.fault_names, 1.0))
    walks = {}
    for least in (1, 1000):
        monkeypatch.setattr(rates, "ROUGH_FROM", least)
        walks[least] = rates.default_rates(model, settling_time(plant), lag=0)[0]
    np.testing.assert_allclose(walks[1], walks[1000], rtol=1.5 * np.log(10.0) * 0.5**rates.RATE_BISECTIONS)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("dt", [0.0, 1.0])
def test_a_filter_without_a_proof_of_stability_is_written_in_triangular_states(
    dt: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(521)
    a = 0.3 * rng.normal(size=(4, 4)) - (1.0 - dt) * np.eye(4)
    plant = obsynth.DescriptorSystem(A=a, C=rng.normal(size=(3, 4)), Bf=rng.normal(size=(4, 2)), dt=dt)
    plain = obsynth.functional_filter(plant)
    monkeypatch.setattr(synthesis, "contraction_of", lambda _: None)
    other = obsynth.functional_filter(plant)
    assert other.report.passed
    # Up to pairs of poles that are not real.
    assert np.abs(np.tril(other.observer.Az, -2)).max() < 1e-12 < np.abs(np.tril(plain.observer.Az, -2)).max()
    np.testing.assert_allclose(
        other.certificate.matrices["deviations"], plain.certificate.matrices["deviations"], rtol=1e-8
    )


@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    ("n", "pole", "link", "measured", "fault"),
    [(8, 0.9987, 0.1144, [0, 5, 7], 5), (9, 0.9959, 0.0823, [0, 1], 8), (25, 0.993, 0.0874, [0, 4, 18, 19], 5)],
)
def test_a_chain_that_is_sampled_fast_has_a_filter(
    n: int, pole: float, link: float, measured: list[int], fault: int
) -> None:
    # Beside the diagonal of A, nearly one, the links are weak: in units of A the last fault was said to show nowhere.
    a, c = pole * np.eye(n) + link * np.eye(n, k=1), np.eye(n)
    plant = obsynth.DescriptorSystem(A=a, C=c[measured], Bf=c[:, [fault]], dt=1.0)
    design = obsynth.functional_filter(plant)
    assert design.report.passed
    assert design.certificate.claims["decay"] > 0.1 * (1.0 - pole)


@pytest.mark.parametrize(("dt", "mode"), [(0.0, -40.0), (1.0, 1e-3)])
def test_a_fast_state_that_no_output_shows_does_not_hurry_the_default(dt: float, mode: float) -> None:
    """The time in which a step should be seen was that of all modes: the filter had up to 4.6 times the noise."""
    own = 0.4 if dt else -1.0
    noise = {"sensor_noise": {"y1": 0.1}, "dt": dt}
    alone = obsynth.DescriptorSystem(A=[[own]], Bf=[[1.0]], C=[[1.0]], **noise)
    beside = obsynth.DescriptorSystem(A=np.diag([own, mode]), Bf=[[1.0], [0.0]], C=[[1.0, 0.0]], **noise)
    decays = [obsynth.functional_filter(plant).certificate.claims["decay"] for plant in (alone, beside)]
    assert decays[1] == pytest.approx(decays[0], rel=0.01)


def test_a_sensor_that_hardly_differs_is_not_read_for_what_only_the_difference_shows() -> None:
    """The difference of both shows a step in time, with 900 times the noise: a slower walk is taken, and said."""
    rng = np.random.default_rng([8, 8])
    n = int(rng.integers(2, 7))
    a = rng.standard_normal((n, n))
    a -= (np.max(np.linalg.eigvals(a).real) + rng.uniform(0.1, 1.0)) * np.eye(n)
    c = rng.standard_normal((int(rng.integers(1, 3)), n))
    bf, other = rng.standard_normal((n, 1)), rng.standard_normal((1, n))
    noises = []
    for outputs in (c, np.vstack([c, c[:1] + 1e-3 * other])):
        plant = obsynth.DescriptorSystem(A=a, C=outputs, Bf=bf, Dw=0.1 * np.eye(len(outputs)))
        design = obsynth.functional_filter(plant)
        o = design.observer
        covariance = solve_continuous_lyapunov(o.Az, -0.01 * o.By @ o.By.T)
        noises.append(np.sqrt((o.Cz[o.fault_rows] @ covariance @ o.Cz[o.fault_rows].T)[0, 0]))
    assert noises[1] <= noises[0]
    assert any("with larger ones less, and over 20 times as much noise" in note for note in design.notes)
