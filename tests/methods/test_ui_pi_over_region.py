"""Unknown-input PI observers over a region: what is proved, in both times; corrupted designs; files and logs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.linalg import expm, solve_continuous_lyapunov
from tests.support.corruptions import with_claims, with_matrices

import obsynth
from obsynth import ObserverDesign, PolytopicSystem, PreconditionError, SpecError
from obsynth.numerics.arrays import FloatArray
from obsynth.results.design import Certificate


def sampled_plant(**changes: Any) -> PolytopicSystem:
    """Return a plant in discrete time whose fault and unknown input change their directions."""
    plant = {
        "A": [["0.9", "0.1 * x", 0], [0, "0.8 - 0.1 * x", "0.2"], [0.1, 0, "0.5 + 0.2 * x"]],
        "B": [[0], [1], [0]], "Bf": [[0], ["1 + 0.5 * x"], ["0.2 - 0.1 * x"]], "Bd": [["2 + x"], [0], [0]],
        "C": [[1, 0, 0], [0, 1, 0]], "dt": 0.1,
    }  # fmt: skip
    return PolytopicSystem(plant={**plant, **changes}, scheduling={"x": [-1, 1]})


def continuous_plant() -> PolytopicSystem:
    """Return the descriptor plant of reference case 15: a fault whose effect changes, and an algebraic state."""
    plant = {
        "E": np.diag([1.0, 1, 0]), "A": [[-1, "x", 1], [0, -2, "x"], [1, 1, -3]], "B": [[0], [1], [0]],
        "Bf": [[0], ["1 + 2 * (x - 0.5) / 1.5"], [0]], "Bd": [[1], [0], [0]], "C": [[1, 0, 0], [0, 0, 1]],
    }  # fmt: skip
    return PolytopicSystem(plant=plant, scheduling={"x": [0.5, 2]})


@pytest.fixture(scope="module")
def sampled() -> ObserverDesign:
    return obsynth.ui_pi_observer(sampled_plant())


@pytest.fixture(scope="module")
def continuous() -> ObserverDesign:
    return obsynth.ui_pi_observer(continuous_plant())


def _record(samples: int, seed: int = 0) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return outputs, inputs with parameters, faults and states of the sampled plant on a wild course."""
    rng, plant = np.random.default_rng(seed), sampled_plant()
    course, u, d = rng.uniform(-1, 1, samples), rng.standard_normal(samples), 5.0 * rng.standard_normal(samples)
    f, x, outputs, states = np.where(np.arange(samples) < samples // 2, 0.0, 2.0), np.ones(3), [], []
    for k in range(samples):
        now = plant.at([course[k]])
        outputs.append(now.C @ x)
        states.append(x)
        x = now.A @ x + now.B[:, 0] * u[k] + now.Bf[:, 0] * f[k] + now.Bd[:, 0] * d[k]
    return np.array(outputs), np.column_stack([u, course]), f, np.array(states)


@pytest.mark.long
def test_estimates_follow_whatever_the_unknown_input_and_the_course_do(sampled: ObserverDesign) -> None:
    y, u, f, x = _record(400)
    found = sampled.scheduled[1].run(y, u)
    assert np.abs(found.faults[190:200, 0] - f[190:200]).max() < 1e-6
    assert np.abs(found.faults[-10:, 0] - f[-10:]).max() < 1e-6
    assert np.abs(found.states[-10:] - x[-10:]).max() < 1e-6


@pytest.mark.long
def test_errors_decay_as_is_proved_in_discrete_time(sampled: ObserverDesign) -> None:
    rate, P = sampled.certificate.claims["region_decay"], sampled.certificate.matrices["P_region"][0]
    rng, Az = np.random.default_rng(1), sampled.scheduled[1].Az
    worst = 0.0
    for _ in range(300):
        e, weights = rng.standard_normal(len(P)), rng.dirichlet([0.3, 0.3])
        after = np.tensordot(weights, Az, 1) @ e
        worst = max(worst, float(np.sqrt(after @ P @ after / (e @ P @ e))))
    assert 0.5 * rate < worst <= rate


@pytest.mark.long
def test_errors_decay_as_is_proved_in_continuous_time(continuous: ObserverDesign) -> None:
    rate, P = continuous.certificate.claims["region_decay"], continuous.certificate.matrices["P_region"][0]
    rng, Az, step = np.random.default_rng(2), continuous.scheduled[1].Az, 0.01
    for _ in range(20):
        e = rng.standard_normal(len(P))
        first = e @ P @ e
        for k in range(1, 60):
            e = expm(step * Az[rng.integers(2)]) @ e
            assert e @ P @ e <= first * np.exp(-2 * rate * step * k) * (1 + 1e-9)
    # And in steps of implicit Euler of any length.
    for h in (0.01, 1.0, 100.0):
        e = rng.standard_normal(len(P))
        after = np.linalg.solve(np.eye(len(P)) - h * np.tensordot(rng.dirichlet([1, 1]), Az, 1), e)
        assert after @ P @ after <= e @ P @ e / (1 + 2 * rate * h) * (1 + 1e-9)


def test_the_gain_is_not_exceeded_and_is_near(sampled: ObserverDesign) -> None:
    level, row = sampled.certificate.claims["region_gain"], sampled.report["worst switching found"]
    assert 0.85 * level < row.value <= level


def test_in_continuous_time_one_gain_serves_all_vertices(continuous: ObserverDesign) -> None:
    gains = [continuous.gains[f"K_a[{i}]"] for i in (1, 2)]
    assert np.array_equal(*gains)
    assert np.abs(gains[0]).max() < 1e3
    assert any("the same at all vertices" in note for note in continuous.notes)


def _noise_at_rest(design: ObserverDesign) -> float:
    """Return the largest H2 norm from the outputs to a fault estimate, over the vertices."""
    observer, found = design.scheduled[1], []
    for Az, By in zip(observer.Az, observer.By, strict=True):
        rows = observer.Cz[observer.fault_rows]
        found.append(np.sqrt(np.diag(rows @ solve_continuous_lyapunov(Az, -By @ By.T) @ rows.T)).max())
    return float(max(found))


@pytest.mark.long
def test_the_noise_is_told_and_a_smaller_drive_of_the_faults_makes_it_less(continuous: ObserverDesign) -> None:
    told = continuous.report["noise amplification at rest"].value
    assert told == pytest.approx(_noise_at_rest(continuous), rel=1e-6)
    assert any("{fault: 0.3}" in note for note in continuous.notes)
    quieter = obsynth.ui_pi_observer(continuous_plant(), noise={"fault": 0.3})
    assert quieter.report["noise amplification at rest"].value < 0.98 * told
    assert quieter.certificate.claims["region_gain"] > continuous.certificate.claims["region_gain"]


@pytest.mark.long
def test_a_decay_that_is_asked_for_is_proved() -> None:
    assert obsynth.ui_pi_observer(sampled_plant(), decay=2.5).certificate.claims["region_decay"] <= np.exp(-0.25)
    assert obsynth.ui_pi_observer(continuous_plant(), decay=3.0).certificate.claims["region_decay"] >= 3.0


@pytest.mark.long
def test_one_vertex_is_the_plain_observer() -> None:
    point = sampled_plant().center
    one = obsynth.ui_pi_observer(PolytopicSystem([point]))
    first = one.scheduled[1].at_vertex(0)
    assert one.report.passed
    rates = np.abs(np.linalg.eigvals(first.Az))
    assert rates.max() <= one.certificate.claims["region_decay"] + 1e-12
    # The same observer as one of constant matrices passes the checks of these.
    U, D, K = one.gains["U_a"], one.gains["D_a"], one.gains["K_a[1]"]
    plain = obsynth.design_from_gains(point, "ui-pi-observer", U=U[:3, :3], D=D[:3], K=K[:3], F=K[3:])
    assert plain.report.passed


def test_conditions_become_a_design() -> None:
    found = obsynth.conditions.sharepasand(sampled_plant())
    assert [name for name in found.constraints if name.startswith("(V1)")] == ["(V1)[1]", "(V1)[2]"]
    assert found.existence.passed
    found.problem.solve(solver="CLARABEL")
    assert found.design().report.passed
    with pytest.raises(SpecError, match="there is no poles"):
        obsynth.conditions.sharepasand(sampled_plant(), poles=[0.1])


def _nudged(design: ObserverDesign, name: str) -> ObserverDesign:
    matrix = np.array(getattr(design.observer, name))
    # In a row of a state that is integrated, and not read from an output.
    matrix[(*(0,) * (matrix.ndim - 2), 1, min(1, matrix.shape[-1] - 1))] += 1e-3
    return design.replace(observer=replace(design.observer, **{name: matrix}))  # type: ignore[type-var]


_CORRUPTIONS: dict[str, tuple[Callable[[ObserverDesign], ObserverDesign], str]] = {
    "faster decay": (lambda d: with_claims(d, region_decay=_stronger(d)), "decay over the region"),
    "no decay": (lambda d: with_claims(d, region_decay=float("nan")), "decay over the region"),
    "smaller gain": (
        lambda d: with_claims(d, region_gain=0.9 * d.certificate.claims["region_gain"]), "gain over the region",
    ),
    "no gain": (lambda d: with_claims(d, region_gain=float("nan")), "gain over the region"),
    "negative gain": (lambda d: with_claims(d, region_gain=-1.0), "gain over the region"),
    "asymmetric P": (
        lambda d: with_matrices(d, P_region=d.certificate.matrices["P_region"] + 1e-9 * np.eye(4, k=1)),
        "decay over the region",
    ),
    "P of the gain that is flat": (lambda d: with_matrices(d, P_gain=np.eye(4)[None]), "gain over the region"),
    "changed Az": (lambda d: _nudged(d, "Az"), "Sylvester"),
    "changed By": (lambda d: _nudged(d, "By"), "Sylvester"),
    "changed Bu": (lambda d: _nudged(d, "Bu"), "inputs"),
    "changed Cz": (lambda d: _nudged(d, "Cz"), "state"),
    "other tracking": (lambda d: with_matrices(d, tracking=1.01 * d.certificate.matrices["tracking"]), "Sylvester"),
    "tracking of other shape": (lambda d: with_matrices(d, tracking=np.eye(3)), "fits the plant"),
    "other fault model": (lambda d: with_matrices(d, Phi=np.array([[1.01 if _discrete(d) else 0.01]])), "Sylvester"),
    "too few rows out": (
        lambda d: d.replace(observer=replace(d.observer, forgetting=0)),  # type: ignore[type-var]
        "rows without a claim",
    ),
}  # fmt: skip


def _discrete(design: ObserverDesign) -> bool:
    return design.scheduled[0].is_discrete


def _stronger(design: ObserverDesign) -> float:
    return design.certificate.claims["region_decay"] * (0.8 if _discrete(design) else 1.25)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("time", ["sampled", "continuous"])
@pytest.mark.parametrize("name", _CORRUPTIONS)
def test_corrupted_designs_are_refused(name: str, time: str, request: pytest.FixtureRequest) -> None:
    corrupt, row = _CORRUPTIONS[name]
    report = obsynth.verify(corrupt(request.getfixturevalue(time)))
    assert not report.passed
    assert not report[row].passed


def test_a_wider_region_is_refused(sampled: ObserverDesign) -> None:
    wide = PolytopicSystem(**{**sampled_plant().as_dict(), "scheduling": {"x": [-1.1, 1.1]}})
    report = obsynth.verify(sampled.replace(plant=wide))
    assert not report["scheduling"].passed


@pytest.mark.parametrize("time", ["sampled", "continuous"])
def test_a_gain_set_is_the_design_again(time: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    design: ObserverDesign = request.getfixturevalue(time)
    again = obsynth.load(design.save(tmp_path / "region.gains.json"))
    assert obsynth.verify(again).passed
    assert np.array_equal(again.scheduled[1].Az, design.scheduled[1].Az)
    assert again.scheduled[1].forgetting == design.scheduled[1].forgetting


def _continuous_log(seconds: float, step: float) -> pd.DataFrame:
    """Return a log of the continuous plant, integrated exactly between rows with what is constant there."""
    plant, times = continuous_plant(), np.arange(0.0, seconds, step)
    x, rows = np.zeros(2), []
    for t in times:
        value = 1.25 + 0.7 * np.sin(0.7 * t)
        now, u, f, d = plant.at([value]), np.cos(0.5 * t), (0.0 if t < seconds / 2 else 1.0), np.sin(3 * t)
        driven = now.B[:, 0] * u + now.Bf[:, 0] * f + now.Bd[:, 0] * d
        third = -(now.A[2, :2] @ x + driven[2]) / now.A[2, 2]
        rows.append([t, u, value, *(now.C @ np.r_[x, third])])
        A = now.A[:2, :2] - np.outer(now.A[:2, 2], now.A[2, :2]) / now.A[2, 2]
        b = driven[:2] - now.A[:2, 2] * driven[2] / now.A[2, 2]
        x = (expm(step * np.block([[A, b[:, None]], [np.zeros((1, 3))]])) @ np.r_[x, 1.0])[:2]
    return pd.DataFrame(rows, columns=["time", "u1", "x", "y1", "y2"])


@pytest.mark.long
def test_a_continuous_observer_runs_on_a_log(continuous: ObserverDesign, tmp_path: Path) -> None:
    log = _continuous_log(40.0, 0.01)
    log.loc[3000, "x"] = 9.0
    obsynth.run_on_data(continuous, log, out=tmp_path / "out.csv")
    found = pd.read_csv(tmp_path / "out.csv")
    left = continuous.scheduled[1].forgetting
    assert found.status[2999] == "ok"
    out = found.status[3000 : 3000 + int(left / 0.01)]
    assert (out == "out").all()
    assert found.status[3000 + int(1.5 * left / 0.01)] == "ok"
    # What is left is what implicit Euler misses of the plant's motion.
    assert np.abs(found["fhat[f1]"][1700:2000]).max() < 0.03
    assert np.abs(found["fhat[f1]"][2800:3000] - 1.0).max() < 0.03


def test_a_stopped_run_goes_on(continuous: ObserverDesign, tmp_path: Path) -> None:
    log = _continuous_log(12.0, 0.05)
    log.loc[60, "x"] = np.nan
    obsynth.run_on_data(continuous, log, out=tmp_path / "whole.csv")
    obsynth.run_on_data(continuous, log[:70], out=tmp_path / "first.csv", state=tmp_path / "state.json")
    obsynth.run_on_data(continuous, log[70:], out=tmp_path / "second.csv", state=tmp_path / "state.json")
    parts = pd.concat([pd.read_csv(tmp_path / name) for name in ("first.csv", "second.csv")], ignore_index=True)
    pd.testing.assert_frame_equal(pd.read_csv(tmp_path / "whole.csv"), parts, check_exact=True)


def test_steps_and_runs_agree_and_time_is_asked_for(continuous: ObserverDesign, sampled: ObserverDesign) -> None:
    observer, log = continuous.scheduled[1], _continuous_log(1.0, 0.05)
    u, y = log[["u1", "x"]].to_numpy(), log[["y1", "y2"]].to_numpy()
    found, state = observer.run(y, u, sample_time=0.05), observer.init()
    for k in range(len(y)):
        state, estimates = observer.step(state, y[k], u[k], seconds=0.05 if k else 0.0)
        assert np.array_equal(estimates.states[0], found.states[k])
    with pytest.raises(SpecError, match="continuous in time: give sample_time"):
        observer.run(y, u)
    with pytest.raises(SpecError, match="give a finite number, 0 or more"):
        observer.step(state, y[0], u[0], seconds=-1.0)
    with pytest.raises(SpecError, match="is for continuous time"):
        sampled.scheduled[1].run(y, u, sample_time=0.1)


def test_c_of_a_continuous_observer_is_refused(continuous: ObserverDesign, tmp_path: Path) -> None:
    with pytest.raises(SpecError, match="continuous in time"):
        obsynth.export(continuous, tmp_path / "region.c")


@pytest.mark.long
def test_units_do_not_matter() -> None:
    plain = obsynth.ui_pi_observer(sampled_plant()).certificate.claims
    plant = sampled_plant()
    s = np.array([1e3, 1e-4, 1.0])
    moved = PolytopicSystem([
        v.replace(E=np.eye(3), A=v.A * s / s[:, None], B=v.B / s[:, None], Bf=v.Bf / s[:, None],
                  Bd=v.Bd / s[:, None], C=v.C * s, exact=None)
        for v in plant.vertices
    ])  # fmt: skip
    found = obsynth.ui_pi_observer(moved).certificate.claims
    assert found["region_gain"] == pytest.approx(plain["region_gain"], rel=0.05)
    assert found["region_decay"] == pytest.approx(plain["region_decay"], rel=0.05)


def test_what_does_not_exist_is_refused_by_name() -> None:
    with pytest.raises(SpecError, match="has no poles"):
        obsynth.ui_pi_observer(sampled_plant(), poles=[0.1, 0.2, 0.3, 0.4])
    with pytest.raises(PreconditionError, match="constant outputs"):
        obsynth.ui_pi_observer(sampled_plant(C=[["1 + 0.1 * x", 0, 0], [0, 1, 0]]))
    # An unknown input that turns takes both outputs, which leaves none for the fault.
    turning = sampled_plant(Bd=[["2 + x"], ["x"], [0]])
    with pytest.raises(PreconditionError, match="with all directions, at vertex 1"):
        obsynth.ui_pi_observer(turning)
    blind = sampled_plant(A=[[0.9, 0, 0], [0, 0.8, 0], [0, 0, "0.95 + 0.1 * x"]], Bf=[[0], [1], [0]])
    with pytest.raises(PreconditionError, match=r"\(D2\) zeros at vertex 2"):
        obsynth.ui_pi_observer(blind)


@pytest.mark.long
def test_auto_takes_the_method_that_exists() -> None:
    found = obsynth.design(continuous_plant())
    assert found.method == "ui-pi-observer"
    names = set(obsynth.check(continuous_plant()))
    assert {"fault-estimation-filter", "ui-pi-observer"} <= names


def slow_plant(rate: float | None) -> PolytopicSystem:
    """Return a spring whose stiffness moves slowly, in continuous time."""
    scheduling = {"k": {"range": [1, 6], **({"rate": rate} if rate else {})}}
    return PolytopicSystem(
        plant={"A": [[0, 1], ["-k", -0.1]], "B": [[0], [1]], "C": [[1, 0]], "Bf": [[0], [1]]}, scheduling=scheduling
    )


@pytest.fixture(scope="module")
def slow() -> ObserverDesign:
    return obsynth.ui_pi_observer(slow_plant(0.1))


@pytest.mark.long
def test_a_rate_buys_a_smaller_gain_in_continuous_time(slow: ObserverDesign) -> None:
    any_course = obsynth.ui_pi_observer(slow_plant(None))
    # At the same decay: with a slower one the gain could be .89 of one, in place of .94.
    assert slow.certificate.claims["region_gain"] < 0.985 * any_course.certificate.claims["region_gain"]
    assert slow.certificate.claims["region_decay"] >= any_course.certificate.claims["region_decay"]
    assert "changes by at most 0.1 in a second" in slow.report["gain over the region"].claim
    assert "every course of k" in slow.report["decay over the region"].claim
    # What it claims is no less than the gain at rest of any point.
    plant, observer = slow.scheduled
    drive, frequencies = slow.certificate.matrices["tracking"][:, plant.nx :], np.logspace(-2, 2, 400)
    worst = 0.0
    for share in np.linspace(0.0, 1.0, 21):
        A = (1.0 - share) * observer.Az[0] + share * observer.Az[1]
        for w in frequencies:
            inner = np.linalg.solve(1j * w * np.eye(len(A)) - A, drive)
            worst = max(worst, float(np.linalg.norm(observer.Cz[observer.fault_rows] @ inner, 2)))
    assert 0.9 * slow.certificate.claims["region_gain"] < worst <= slow.certificate.claims["region_gain"]


@pytest.mark.long
@pytest.mark.parametrize("change", ["faster", "smaller", "other", "fewer"])
def test_a_certificate_for_slow_courses_proves_nothing_else(slow: ObserverDesign, change: str) -> None:
    matrices, claims, plant = dict(slow.certificate.matrices), dict(slow.certificate.claims), slow.plant
    assert len(matrices["P_gain"]) > 1
    if change == "faster":
        plant = slow_plant(50.0)
    if change == "smaller":
        claims["region_gain"] *= 0.9
    if change == "other":
        matrices["P_gain"] = matrices["P_gain"][::-1]
    if change == "fewer":
        matrices["P_gain"] = matrices["P_gain"][:1]
    observer = slow.observer if plant is slow.plant else replace(slow.observer, scheduling=plant.scheduling)  # type: ignore[type-var]
    changed = replace(slow, plant=plant, observer=observer, certificate=Certificate(matrices, claims))
    report = obsynth.verify(changed)
    assert not report.passed
    assert [row.name for row in report.failures] == ["gain over the region"]


@pytest.mark.long
def test_a_design_for_slow_courses_is_saved_and_runs(slow: ObserverDesign, tmp_path: Path) -> None:
    again = obsynth.load(slow.save(tmp_path / "slow.gains.json"))
    assert obsynth.verify(again).passed
    observer = again.scheduled[1]
    y, u = np.zeros((5, 1)), np.column_stack([np.zeros(5), [3.0, 3.01, 3.02, 4.0, 4.01]])
    _, claimed = observer.record(y, u, sample_time=0.5)
    assert not claimed[3]
