"""Guaranteed tests of plants whose matrices change with k: a programme for each different window, proved by row."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from ruamel.yaml import YAML
from scipy.optimize import linprog

import obsynth
from obsynth.cli.main import main
from obsynth.results.design import Certificate

V, W = 0.5, 0.25
GAINS = np.array([1.0, 2.0, 0.5, 0.0, 4.0, 1.0, 2.0, 0.5])
NOISE = {"y1": V}


def varying(**parts: Any) -> obsynth.TimeVaryingDescriptorSystem:
    return obsynth.TimeVaryingDescriptorSystem(**{"E": None, "dt": 1.0, "parameter_names": ["leak"], **parts})


@cache
def integrator() -> obsynth.GuaranteedTest:
    """An integrator whose fault has another gain at each step, none at k = 3."""
    plant = varying(A=[[1.0]], C=[[1.0]], B=[[1.0]], Phi=GAINS[:, None, None], input_names=["pump"],
                    operating_point={"y1": 10.0}, scales={"y1": 0.1}, units={"leak": "l/s"})  # fmt: skip
    return obsynth.guaranteed_test(plant, course="constant", samples=2, noise_bound=NOISE, disturbance_bounds=W)


def random_plant(seed: int, *, singular: bool = False) -> obsynth.TimeVaryingDescriptorSystem:
    rng, n, horizon = np.random.default_rng(seed), 3, 12
    E = np.eye(n) + 0.2 * rng.standard_normal((horizon + 1, n, n))
    A = 0.6 * rng.standard_normal((horizon, n, n))
    if singular:
        # An algebraic equation whose state is determined by the others: index one at each k.
        E[:, -1], A[:, -1, -1] = 0.0, 2.0
    return varying(
        E=E, A=A, B=rng.standard_normal((horizon, n, 1)), C=rng.standard_normal((horizon + 1, 2, n)),
        Phi=rng.standard_normal((horizon, n, 2)), Psi=rng.standard_normal((horizon, 2, 2)),
        parameter_names=["leak", "clog"],
    )  # fmt: skip


#: What is asked of the random plants.
ASKED: dict[str, dict[str, Any]] = {
    "constant": {"course": "constant", "samples": 5, "free": "none"},
    "blind": {"course": "constant", "samples": 5, "free_course": "constant"},
    "step": {"course": "step", "before": 2, "after": 3, "free": "none"},
    "any": {"course": "any", "lag": 0, "samples": 4, "free": "none"},
    "ramp": {"course": "ramp", "lag": 0, "samples": 5, "free": "none"},
}


@cache
def random_test(name: str, *, singular: bool = False) -> obsynth.GuaranteedTest:
    return obsynth.guaranteed_test(
        random_plant(3, singular=singular), "leak", noise_bound={"y1": V, "y2": V}, disturbance_bounds=W, **ASKED[name]
    )


def largest_hidden(plant: Any, name: str, row: int) -> float:
    """Return the largest fault that bounds hide at a row, by a dense programme that shares nothing with the code.

    Unknowns: states, theta, slope or other samples of the fault, mu and nu; all data are zero.
    """
    asked = ASKED[name]
    samples = asked.get("samples", 5)
    ks = list(range(row - samples + 1, row + 1))
    singular = not plant.E.at(1)[-1].any()
    steps = ks if singular and row < plant.horizon else ks[:-1]
    nx, free = plant.nx, 2 * (samples + 1)
    states = {k: slice(i * nx, (i + 1) * nx) for i, k in enumerate([*ks, row + 1])}
    at = (len(ks) + 1) * nx
    theta, other = at, at + 1
    mu, nu = at + 1 + free, at + 1 + free + nx * len(steps)
    count = nu + 2 * len(ks)
    bounds = [(None, None)] * mu + [(-W, W)] * (nx * len(steps)) + [(-V, V)] * (2 * len(ks))
    rows = []

    def fault(k: int) -> np.ndarray:
        """The two faults that act from k to k + 1, as rows over all unknowns."""
        found = np.zeros((2, count))
        place = k + 1 - ks[0]  # of the sample that they lead to
        if name == "any":
            found[0, theta if k + 1 == row else other + place] = 1.0
        elif name == "ramp":
            found[0, theta], found[0, other] = 1.0, k + 1 - row
        elif name != "step" or place >= asked["before"]:
            found[0, theta] = 1.0
        if name == "blind":
            found[1, other] = 1.0
        return found

    for i, k in enumerate(steps):
        block = -plant.Phi.at(k) @ fault(k)
        block[:, states[k + 1]] += plant.E.at(k + 1)
        block[:, states[k]] -= plant.A.at(k)
        block[:, mu + i * nx : mu + (i + 1) * nx] -= np.eye(nx)
        rows.append(block)
    for i, k in enumerate(ks):
        block = plant.Psi.at(k - 1) @ fault(k - 1)
        block[:, states[k]] += plant.C.at(k)
        block[:, nu + 2 * i : nu + 2 * i + 2] += np.eye(2)
        rows.append(block)
    whole = np.vstack(rows)
    cost = np.zeros(count)
    cost[theta] = -1.0
    found = linprog(cost, A_eq=whole, b_eq=np.zeros(len(whole)), bounds=bounds, method="highs")
    return np.inf if found.status == 3 else -found.fun


def test_each_row_has_the_threshold_of_its_gain() -> None:
    test = integrator()
    # y(k) - y(k - 1) = g f + w + two noises; at k = 4 the fault has no gain.
    expected = np.divide(W + 2 * V, GAINS[1:], out=np.full(7, np.inf), where=GAINS[1:] > 0.0)
    assert test.limits(9) == pytest.approx([np.inf, np.inf, *expected], rel=1e-12)
    assert test.threshold == pytest.approx(2.5, rel=1e-12)
    assert test.threshold / (1.0 + 1e-9) <= test.least <= test.threshold
    assert (test.surely_found, test.delay, test.samples) == (2.0 * test.threshold, 1.0, 2)
    assert test.hidden_course()["leak"] == pytest.approx([2.5, 2.5], rel=1e-9)
    assert any("1 rows have no verdict" in note for note in test.notes)
    assert "the last 2 samples are used" in str(test)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("singular", [False, True])
@pytest.mark.parametrize("name", ASKED)
def test_thresholds_are_those_of_a_dense_programme(name: str, singular: bool) -> None:
    test = random_test(name, singular=singular)
    plant, found = test.plant, test.limits(13)
    for row in (test.samples, 9, 12):
        # HiGHS keeps equations to 1e-7 of its own accord.
        assert found[row] == pytest.approx(largest_hidden(plant, name, row), rel=1e-6)
    assert np.isinf(found[: test.samples]).all()
    assert test.least == pytest.approx(test.threshold, rel=1e-9)
    assert test.report.passed


def test_constant_matrices_are_one_programme_for_ever() -> None:
    plant = obsynth.DescriptorSystem(None, [[1.0]], C=[[1.0]], Bf=[[1.0]], Bd=[[1.0]], dt=1.0)
    asked = {"course": "constant", "samples": 6, "noise_bound": NOISE, "disturbance_bounds": W}
    same = varying(A=[[1.0]], C=[[1.0]], Phi=[[1.0]])
    found = obsynth.guaranteed_test(same, **asked)
    assert found.threshold == pytest.approx(obsynth.guaranteed_test(plant, **asked).threshold, rel=1e-12)
    assert found.limits(1000)[6:] == pytest.approx(np.full(994, found.threshold))
    periodic = varying(A=[[1.0]], C=[[1.0]], Phi=np.tile([1.0, 2.0, 3.0], 8)[:, None, None])
    assert len(obsynth.guaranteed_test(periodic, **asked).certificate.matrices["thresholds"]) == 3
    table = obsynth.guaranteed_test(periodic, **{**asked, "samples": "auto"}).trade_off
    assert np.all(np.diff(table[np.isfinite(table[:, 1]), 1]) <= 0.0)


#: What else may be asked, of a sensor's fault: the same of matrices that are given as constants.
SAME: dict[str, dict[str, Any]] = {
    "ellipsoid": {"norm": "ellipsoid"}, "held": {"disturbance": "held"},
    "rate of disturbances": {"disturbance": "rate", "disturbance_rate": 0.05},
    "states": {"state_bounds": {"x1": 0.4}}, "start": {"initial_bounds": {"x1": 0.1, "x2": 0.3}},
    "rate": {"course": "rate", "fault_rate": 0.1, "lag": 1}, "any": {"course": "any"}, "ramp": {"course": "ramp"},
    "step": {"course": "step", "before": 2}, "an interval": {"noise_bound": {"y1": [0.0, 1.0], "y2": 0.2}},
}  # fmt: skip


@pytest.mark.one_in(6)
@pytest.mark.parametrize("name", SAME)
def test_constant_matrices_have_the_thresholds_of_a_plant_without_time(name: str) -> None:
    A, C, psi = [[0.9, 0.3], [-0.2, 0.8]], [[1.0, 0.0], [1.0, 1.0]], [[1.0], [0.0]]
    asked = {"course": "constant", "samples": 5, "noise_bound": {"y1": V, "y2": 0.2}, "disturbance_bounds": W}
    asked |= SAME[name]
    fixed = obsynth.DescriptorSystem(None, A, C=C, Bd=np.eye(2), Bf=np.zeros((2, 1)), Df=psi, dt=1.0)
    found = obsynth.guaranteed_test(varying(A=A, C=C, Psi=psi), **asked)
    wanted = obsynth.guaranteed_test(fixed, **asked)
    assert found.threshold == pytest.approx(wanted.threshold, rel=1e-9)
    assert found.least == pytest.approx(wanted.least, rel=1e-9)
    assert found.options["lag"] == wanted.options["lag"]
    y = np.random.default_rng(2).standard_normal((12, 2))
    rows = [test.residual(test.observer.run(y))[5:] for test in (found, wanted)]
    if name != "ellipsoid":  # several tests may have the least threshold of a box; both solve the same programme
        assert rows[0] == pytest.approx(rows[1], rel=1e-6)


@pytest.mark.parametrize("name", ["constant", "step"])
def test_no_healthy_record_passes_and_twice_the_threshold_alarms(name: str) -> None:
    test, rng = random_test(name), np.random.default_rng(7)
    plant, limits = test.plant, random_test(name).limits(13)
    for trial in range(60):
        onset = 13 if trial % 2 else 0 if name == "constant" else int(rng.integers(2, 8))
        size = 2.0 * test.threshold * (1.0 + 1e-9)
        x, y, u = 5.0 * rng.standard_normal(3), np.zeros((13, 2)), rng.standard_normal((13, 1))
        for k in range(12):
            f = size if k >= onset else 0.0
            pushed = plant.A.at(k) @ x + plant.B.at(k) @ u[k] + plant.Phi.at(k)[:, 0] * f
            x = np.linalg.solve(plant.E.at(k + 1), pushed + W * np.sign(rng.standard_normal(3)))
            y[k + 1] = plant.C.at(k + 1) @ x + plant.Psi.at(k)[:, 0] * f + V * np.sign(rng.standard_normal(2))
        alarms = test.alarms(test.observer.run(y, u))
        assert not alarms[: min(onset + 1, 13)].any()
        if onset < 13:
            assert alarms[-1]
            low, high = test.interval(test.observer.run(y, u))
            # The step of k acts on the way to sample k + 1, which is the third of its window.
            row = test.samples if name == "constant" else onset + 3
            assert low[row] <= size <= high[row]
            assert high[row] - low[row] == pytest.approx(2.0 * limits[row])


def log(rows: int = 9) -> pd.DataFrame:
    rng = np.random.default_rng(1)
    flow, x = rng.standard_normal(rows), np.zeros(rows)
    for k in range(rows - 1):
        x[k + 1] = x[k] + flow[k] + GAINS[k] * (4.0 if k >= 4 else 0.0) + W * rng.uniform(-1.0, 1.0)
    # The log has tenths, and the level is 10 at rest.
    level = 10.0 * (10.0 + x + V * rng.uniform(-1.0, 1.0, rows))
    return pd.DataFrame({"time": np.arange(float(rows)), "pump": flow, "y1": level})


def test_a_log_is_judged_by_row_whatever_is_missing(tmp_path: Path) -> None:
    test, whole = integrator(), log()
    monitor = obsynth.online_monitor(test)
    assert "each row has its own threshold" in monitor.statement
    run = obsynth.run_on_data(test, whole, monitor=monitor)
    assert run.table["threshold"][[2, 3]].to_numpy() == pytest.approx([0.625, 2.5], rel=1e-9)
    assert run.table["status"].tolist() == ["warm-up"] * 2 + ["ok"] * 7
    assert np.isnan(run.table["statistic"][4])
    assert run.alarm_rows == {"pointwise": 6}
    assert run.events[0].fault == "leak"
    # A blank cell and a row that is not there: windows with either have no verdict, all others are the same.
    holed = whole.drop(index=6)
    holed.loc[2, "pump"] = np.nan
    table = obsynth.run_on_data(test, holed, monitor=monitor).table
    assert table["status"].tolist() == ["warm-up", "warm-up", "gap", "warm-up", "ok", "ok", "recovering", "ok"]
    kept = [4, 5, 8]
    for column in ("fhat[leak]", "statistic"):
        both = table.set_index("time")[column], run.table.set_index("time")[column]
        assert both[0][kept].to_numpy() == pytest.approx(both[1][kept].to_numpy(), nan_ok=True, rel=1e-12)
        assert both[0][[2, 3, 7]].isna().all()
    # In two pieces, with a saved state between them: the same rows to the last digit.
    parts = []
    for piece in (holed[:5], holed[5:]):
        target = tmp_path / "out.csv"
        obsynth.run_on_data(test, piece, target, monitor=monitor, state=tmp_path / "state")
        parts.append(pd.read_csv(target))
    again = pd.concat(parts, ignore_index=True)
    pd.testing.assert_frame_equal(again.drop(columns="alarm"), table.drop(columns="alarm"), rtol=1e-14)
    step, said = test.observer.init(), []
    for row in whole.itertuples():
        step, one = test.observer.step(step, [row.y1 * 0.1 - 10.0], [row.pump])
        said.append(one.faults[0, 0])
    assert np.array(said) == pytest.approx(run.table["fhat[leak]"].to_numpy(), nan_ok=True)


def test_a_log_beyond_the_horizon_is_refused_at_its_row() -> None:
    longer = pd.concat([log(), log().assign(time=lambda frame: frame["time"] + 9.0)], ignore_index=True)
    with pytest.raises(obsynth.SpecError, match=r"Row 10: .*horizon of 8 steps"):
        obsynth.run_on_data(integrator(), longer)
    with pytest.raises(obsynth.SpecError, match="The log has 2 rows, but a window"):
        obsynth.run_on_data(integrator(), log()[:2])


def corrupted(what: str) -> obsynth.ObserverDesign:
    """Return the design of a random plant with one thing changed."""
    test = random_test("step")
    matrices = {name: np.array(value) for name, value in test.certificate.matrices.items()}
    claims, changed = dict(test.certificate.claims), {}
    worst = int(np.argmax(matrices["thresholds"]))
    if what in claims:
        claims[what] *= {"least": 1.001, "delay": 0.5}.get(what, 0.999)
    elif what == "own threshold":
        matrices["thresholds"][0] *= 0.999
    elif what == "own least":
        matrices["leasts"][worst] *= 1.01
        claims["least"] = claims["threshold"]
    elif what == "programmes":
        matrices["programmes"] = matrices["programmes"][::-1]
    elif what == "weights":
        weights = np.array(test.observer.weights)
        weights[2, 3] += 1e-3
        changed["observer"] = type(test.observer).from_dict({**test.observer.as_dict(), "weights": weights})
    elif what == "rows of weights":
        rows = test.observer.programmes[::-1].copy()
        changed["observer"] = type(test.observer).from_dict({**test.observer.as_dict(), "programmes": rows})
    elif what == "plant":
        moved = np.array(test.plant.A.values)
        moved[6, 0, 0] += 0.01
        changed["plant"] = test.plant.replace(A=moved)
    elif what in ("rounding", "multiplier_radius", "witness_radius"):
        matrices[what] *= 1e-3
    else:
        matrices[what][worst, 0] += 1e-3
    return test.replace(certificate=Certificate(matrices, claims), **changed)


#: what is changed -> the row that must fail.
CORRUPTED = {
    "threshold": "threshold", "least": "least", "surely_found": "surely found", "delay": "delay",
    "own threshold": "thresholds", "own least": "least", "programmes": "rows", "weights": "weights",
    "rows of weights": "weights", "plant": "multipliers", "rounding": "rounding", "multiplier_radius": "multipliers",
    "witness_radius": "witness", "multipliers": "multipliers", "witness": "witness",
}  # fmt: skip


@pytest.mark.one_in(6)
@pytest.mark.parametrize("what", CORRUPTED)
def test_what_is_corrupted_fails_its_row(what: str) -> None:
    assert CORRUPTED[what] in {row.name for row in obsynth.verify(corrupted(what)).failures}


def test_the_claim_is_of_the_worst_row_wherever_it_is() -> None:
    test = integrator()  # the second of four windows needs most
    for name, row in (("threshold", "threshold"), ("least", "least")):
        factor = 0.999 if name == "threshold" else 1.001
        claims = {**test.certificate.claims, name: factor * test.certificate.claims[name]}
        report = obsynth.verify(test.replace(certificate=Certificate(test.certificate.matrices, claims)))
        assert row in {check.name for check in report.failures}


def test_matrices_of_another_shape_are_no_answer() -> None:
    test = random_test("step")
    for name in ("multipliers", "thresholds", "programmes", "witness_radius", "rounding"):
        for bad in (test.certificate.matrices[name][:, :0], np.full_like(test.certificate.matrices[name], np.nan)):
            matrices = {**test.certificate.matrices, name: bad}
            broken = test.replace(certificate=Certificate(matrices, test.certificate.claims))
            assert not obsynth.verify(broken).passed
    missing = {name: value for name, value in test.certificate.matrices.items() if name != "leasts"}
    assert not obsynth.verify(test.replace(certificate=Certificate(missing, test.certificate.claims))).passed


def test_least_is_not_claimed_where_later_equations_may_say_more() -> None:
    # Index two: x1 follows from the next equation, which has no part in the window.
    plant = varying(E=[[0.0, 1.0], [0.0, 0.0]], A=np.eye(2), C=np.eye(2), Phi=[[1.0], [0.0]], horizon=8)
    found = obsynth.guaranteed_test(
        plant, course="constant", samples=3, noise_bound={"y1": V, "y2": V}, disturbance_bounds={"mu1": W, "mu2": 0.0}
    )
    least = found.certificate.matrices["leasts"].ravel()[found.certificate.matrices["programmes"].ravel().astype(int)]
    # The last two windows know all equations that there are.
    assert np.isnan(least).tolist() == [True] * 4 + [False] * 2
    assert any("not claimed" in note for note in found.notes)


def test_windows_that_differ_in_what_known_inputs_do_are_not_one() -> None:
    gains = np.array([1.0, 2.0, -1.0, 0.5, 3.0, 1.0])
    plant = varying(A=[[1.0]], C=[[1.0]], B=gains[:, None, None], Phi=[[1.0]])
    found = obsynth.guaranteed_test(plant, course="constant", samples=2, noise_bound=NOISE, disturbance_bounds=W)
    u = np.random.default_rng(5).standard_normal((7, 1))
    y = np.cumsum(np.concatenate([[0.0], gains * u[:6, 0]]))[:, None]
    assert np.abs(found.residual(found.observer.run(y, u))[2:]).max() < 1e-12
    assert len(found.certificate.matrices["thresholds"]) == 5  # a window has the gain of one step


def test_least_knows_of_an_equation_far_behind_the_window() -> None:
    # At k = 6 E vanishes: x(5) obeys an equation of its own, which says something of every window before it.
    E = np.ones((9, 1, 1))
    E[6] = 0.0
    plant = varying(E=E, A=[[1.0]], C=[[1.0]], Phi=[[1.0]], horizon=8)
    found = obsynth.guaranteed_test(plant, course="constant", samples=2, noise_bound=NOISE, disturbance_bounds=W)
    shipped = found.certificate.matrices
    least = dict(zip(range(2, 9), shipped["leasts"].ravel()[shipped["programmes"].ravel().astype(int)], strict=True))
    assert [k for k, value in least.items() if np.isnan(value)] == [2, 3, 4]
    assert found.report.passed


GOOD: dict[str, Any] = {"course": "constant", "samples": 3, "noise_bound": NOISE, "disturbance_bounds": W}
REFUSED: dict[str, tuple[dict[str, Any], dict[str, Any], type[Exception], str]] = {
    "deviations": ({}, {"noise_bound": 3}, obsynth.SpecError, "states no deviations"),
    "no noise": ({}, {"noise_bound": None}, obsynth.SpecError, "noise_bound"),
    "no bounds": ({}, {"disturbance_bounds": None}, obsynth.SpecError, "mu1, and 0 where an equation holds"),
    "another name": ({}, {"disturbance_bounds": {"d1": 1.0}}, obsynth.SpecError, "must name mu1; unknown: d1"),
    "negative": ({}, {"disturbance_bounds": -1.0}, obsynth.SpecError, "disturbance_bounds is -1.0: give a finite"),
    "unknown fault": ({}, {"fault": "lek"}, obsynth.SpecError, "There is no fault 'lek'"),
    "isolate": ({}, {"isolate": True}, obsynth.SpecError, "isolate is for plants whose matrices do not change"),
    "exact": ({}, {"exact": True}, obsynth.SpecError, "exact is for plants whose matrices do not change"),
    "solve": ({}, {"missing": "solve"}, obsynth.SpecError, "missing is for plants whose matrices do not change"),
    "too long": ({}, {"samples": 9}, obsynth.SpecError, "horizon of 8 steps has no window of 9"),
    "no horizon": ({"Phi": [["1 + k"]]}, {}, obsynth.SpecError, "has no horizon"),
    "hidden": ({}, {"samples": 1}, obsynth.PreconditionError, "leak gives the same outputs as no fault"),
    "no fault": ({"Phi": None, "parameter_names": None}, {}, obsynth.SpecError, "the plant has none"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_it_cannot_be_asked_is_refused_by_name(name: str) -> None:
    parts, options, error, words = REFUSED[name]
    plant = varying(**{"A": [[1.0]], "C": [[1.0]], "Phi": GAINS[:, None, None], **parts})
    with pytest.raises(error, match=words):
        obsynth.guaranteed_test(plant, **{**GOOD, **options})


def test_what_is_for_constant_matrices_says_so(tmp_path: Path) -> None:
    test, scenario = integrator(), obsynth.Scenario(horizon=5.0)
    refused = {
        "which no export holds": lambda: obsynth.export(test, tmp_path / "test.c"),
        "cannot be simulated": lambda: obsynth.simulate(test, scenario),
        "is for measured data": lambda: obsynth.monitor(test, scenario),
        "prove-alarm is for plants": lambda: obsynth.prove_alarm(test, log(), row=6),
        "the fixed test of each row": lambda: test.exact_interval(np.zeros((9, 1)), np.zeros((9, 1))),
        "for an exact model from any start": lambda: obsynth.online_monitor(test, initial_set={"x1": 1.0}),
        "uses the samples of its window alone": lambda: obsynth.run_on_data(test, log(), warm_up=1.0),
        "outliers is for": lambda: obsynth.run_on_data(test, log(), outliers="gate"),
    }
    for words, call in refused.items():
        with pytest.raises(obsynth.SpecError, match=words):
            call()
    with pytest.raises(obsynth.SpecError, match="none is learned"):
        obsynth.learn_thresholds(test, log())
    with pytest.raises(obsynth.SpecError, match="states no covariance"):
        obsynth.validate(test, log())
    assert not list(tmp_path.iterdir())


@pytest.mark.long
def test_the_command_line_designs_verifies_runs_and_reports(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    document = {
        "schema_version": 1, "name": "tank",
        "plant": {"kind": "time-varying", "dt": 1.0, "A": [[1.0]], "B": [[1.0]], "C": [[1.0]], "horizon": 8,
                  "Phi": [["1 + 0.5 * cos(k)"]], "input_names": ["pump"], "output_names": ["level"],
                  "parameter_names": ["leak"]},
        "method": {"id": "guaranteed-test", "options": {
            "course": "constant", "samples": 3, "noise_bound": {"level": V}, "disturbance_bounds": {"mu1": W}}},
    }  # fmt: skip
    spec, gains, out = tmp_path / "tank.yaml", tmp_path / "tank.gains.json", tmp_path / "out.csv"
    with spec.open("w") as stream:
        YAML(typ="safe").dump(document, stream)
    log().rename(columns={"y1": "level"}).to_csv(tmp_path / "log.csv", index=False)
    assert main(["check", "--system", str(spec)]) == 0
    assert main(["design", "--system", str(spec), "--output", str(gains)]) == 0
    assert main(["verify", str(gains)]) == 0
    run = ["run", "--gains", str(gains), "--data", str(tmp_path / "log.csv"), "--monitor", "pointwise"]
    assert main([*run, "--out", str(out)]) == 0
    assert pd.read_csv(out)["threshold"].notna().sum() == 6
    said = capsys.readouterr().out
    assert "never passed without leak" in said
    assert main(["report", "--gains", str(gains), "--out", str(tmp_path / "page.html")]) == 0
    assert "Why there is no smaller one" in (tmp_path / "page.html").read_text()
    with_log = ["report", "--gains", str(gains), "--data", str(tmp_path / "log.csv"), "--monitor", "pointwise"]
    assert main([*with_log, "--out", str(tmp_path / "log.html")]) == 0
