"""Filters over a region: exact decoupling, proved gains, corrupted designs, files, logs."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from tests.support.corruptions import with_claims, with_matrices, with_observer
from tests.support.polytopic_plants import WANG_A, WANG_BD, WANG_BF, WANG_LEAST, record, wang, wang_filter

import obsynth
from obsynth import ObserverDesign, PolytopicSystem, PreconditionError, SpecError
from obsynth.numerics.arrays import FloatArray


@pytest.fixture(scope="module")
def design() -> ObserverDesign:
    return wang_filter()


@pytest.fixture(scope="module")
def scaled() -> ObserverDesign:
    """Return a design whose first fault changes its effect."""
    return wang_filter(effectiveness=True)


def _wild(plant: PolytopicSystem, samples: int, seed: int = 0) -> tuple[FloatArray, FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    parameters = rng.uniform(-1.0, 1.0, (samples, len(plant.scheduling.names)))
    return parameters, rng.standard_normal((samples, plant.nu)), 10.0 * rng.standard_normal((samples, plant.nf))


def test_one_vertex_is_the_filter_of_the_paper() -> None:
    point = wang().center.replace(A=WANG_A)
    one = obsynth.fault_estimation_filter(PolytopicSystem([point]), gamma_margin=0.01, weight="paper")
    assert one.certificate.claims["gamma_min"] == pytest.approx(WANG_LEAST, rel=1e-6)
    paper = obsynth.fault_estimation_filter(point, weight="paper", gamma_margin=0.01)
    assert one.certificate.claims["gamma"] == pytest.approx(paper.certificate.claims["gamma"], rel=1e-6)


@pytest.mark.long
def test_conditions_of_the_paper_at_four_vertices() -> None:
    found = obsynth.conditions.wang2015(wang())
    assert [name for name in found.constraints if name.startswith("(45)")] == [f"(45)[{i}]" for i in (1, 2, 3, 4)]
    found.solve()
    assert float(found.variables["gamma_squared"].value) ** 0.5 == pytest.approx(1.4970662, rel=1e-6)
    made = found.design()
    assert made.report.passed
    assert made.certificate.claims["gamma"] == pytest.approx(1.4970662, rel=1e-3)
    assert found.existence.passed


@pytest.mark.long
@pytest.mark.parametrize("name", ["design", "scaled"])
def test_faults_are_decoupled_for_wild_courses(name: str, request: pytest.FixtureRequest) -> None:
    made: ObserverDesign = request.getfixturevalue(name)
    plant, observer = made.scheduled
    parameters, u, f = _wild(plant, 200)
    found = observer.run(record(plant, parameters, u, f), np.hstack([u, parameters]))
    left = observer.forgetting
    assert np.abs(found.faults[left + 1 :] - f[left:-1]).max() < 1e-11
    by_step, state = [], observer.init()
    y = record(plant, parameters, u, f)
    for k in range(20):
        state, estimates = observer.step(state, y[k], np.r_[u[k], parameters[k]])
        by_step.append(estimates.faults[0])
    assert np.array(by_step) == pytest.approx(found.faults[:20], abs=1e-14)


@pytest.mark.long
@pytest.mark.parametrize("name", ["design", "scaled"])
def test_disturbances_pass_by_less_than_is_proved(name: str, request: pytest.FixtureRequest) -> None:
    made: ObserverDesign = request.getfixturevalue(name)
    plant, observer = made.scheduled
    gamma = made.certificate.claims["gamma"]
    for seed in range(5):
        parameters, u, f = _wild(plant, 300, seed)
        d = np.random.default_rng(seed).standard_normal((300, 1))
        # Worst for slow filters: steps as well as noise.
        d = np.cumsum(d, axis=0) / 10.0 if seed % 2 else d
        both = [observer.run(record(plant, parameters, u, f, each), np.hstack([u, parameters])).faults
                for each in (d, 0.0 * d)]  # fmt: skip
        assert np.linalg.norm(both[0] - both[1]) <= gamma * np.linalg.norm(d)
    row = made.report["worst switching found"]
    assert 0.8 * gamma / (2.0 if name == "scaled" else 1.0) < row.value <= gamma


def test_errors_decay_as_is_proved(design: ObserverDesign) -> None:
    plant, observer = design.scheduled
    rate, P = design.certificate.claims["region_decay"], design.certificate.matrices["P_region"][0]
    rng = np.random.default_rng(5)
    for _ in range(20):
        e = rng.standard_normal(observer.order)
        for _ in range(30):
            weights = (
                rng.dirichlet(np.ones(plant.count)) if rng.random() < 0.5 else np.eye(plant.count)[rng.integers(4)]
            )
            after = np.tensordot(weights, observer.Az, 1) @ e
            assert np.sqrt(after @ P @ after) <= rate * np.sqrt(e @ P @ e) * (1 + 1e-12)
            e = after


def test_a_rate_buys_a_smaller_gain() -> None:
    slow = obsynth.fault_estimation_filter(wang(0.1, rate=0.02), gamma_margin=0.01, weight="paper")
    assert "G_region" in slow.certificate.matrices
    assert "at most 0.02 in a second" in slow.report["LMI"].claim
    any_course = obsynth.fault_estimation_filter(
        PolytopicSystem(list(slow.scheduled[0].vertices), scheduling={"a": [-1.0, 1.0]}),
        gamma_margin=0.01,
        weight="paper",
    )
    assert slow.certificate.claims["gamma_min"] <= any_course.certificate.claims["gamma_min"] * (1 + 1e-6)
    # With a faster parameter the certificate is none.
    faster = slow.replace(plant=wang(0.1, rate=0.9))
    assert not obsynth.verify(faster)["scheduling"].passed
    observer = dataclasses.replace(slow.scheduled[1], scheduling=faster.scheduled[0].scheduling)
    assert not obsynth.verify(faster.replace(observer=observer))["LMI"].passed


def _nudged(design: ObserverDesign, name: str, size: float) -> ObserverDesign:
    matrix = np.array(getattr(design.observer, name))
    matrix[(1,) + (0,) * (matrix.ndim - 1)] += size
    return with_observer(design, **{name: matrix})


_P = "P_region"
_CORRUPTIONS: dict[str, tuple[Callable[[ObserverDesign], ObserverDesign], str]] = {
    "wider region": (lambda d: d.replace(plant=wang(0.06)), "unbiased: dynamics"),
    "smaller number": (lambda d: with_claims(d, gamma=0.9 * d.certificate.claims["gamma"]), "LMI"),
    "no number": (lambda d: with_claims(d, gamma=float("nan")), "LMI"),
    "faster decay": (
        lambda d: with_claims(d, region_decay=0.8 * d.certificate.claims["region_decay"]),
        "decay over the region",
    ),
    "growth": (lambda d: with_claims(d, region_decay=1.0), "decay over the region"),
    "asymmetric P": (lambda d: with_matrices(d, P_region=d.certificate.matrices[_P] + np.eye(4, k=1) * 1e-9), "LMI"),
    "negative P": (lambda d: with_matrices(d, P_region=-d.certificate.matrices[_P]), "LMI"),
    "P of other order": (lambda d: with_matrices(d, P_region=np.eye(3)[None]), "LMI"),
    "P that is flat": (lambda d: with_matrices(d, P_region=np.eye(4)), "LMI"),
    "a slack that is none": (lambda d: with_matrices(d, G_region=np.eye(4)[None]), "LMI"),
    "changed gain": (lambda d: _nudged(d, "Az", 1e-3), "unbiased: dynamics"),
    "changed By": (lambda d: _nudged(d, "By", 1e-3), "unbiased: dynamics"),
    "changed Bu": (lambda d: _nudged(d, "Bu", 1e-3), "unbiased: inputs"),
    "changed Cz": (lambda d: _nudged(d, "Cz", 1e-3), "unbiased: state"),
    "changed effectiveness": (lambda d: _nudged(d, "effectiveness", 1e-3), "fault estimate"),
    "vertices in another order": (lambda d: with_observer(d, Az=d.observer.Az[::-1]), "unbiased: dynamics"),  # type: ignore[union-attr]
    "too few rows out": (lambda d: with_observer(d, forgetting=1), "rows without a claim"),
    "other tracking": (
        lambda d: with_matrices(d, tracking=1.01 * d.certificate.matrices["tracking"]),
        "unbiased: state",
    ),
    "tracking of other shape": (lambda d: with_matrices(d, tracking=np.eye(3)), "fits the plant"),
    "a claim without a row": (lambda d: with_claims(d, gamma_bracket_low=1.0), "claims covered"),
}


@pytest.mark.one_in(6)
@pytest.mark.parametrize("name", _CORRUPTIONS)
def test_corrupted_designs_are_refused(name: str, design: ObserverDesign) -> None:
    corrupt, row = _CORRUPTIONS[name]
    report = obsynth.verify(corrupt(design))
    assert not report.passed
    assert not report[row].passed


def test_another_scheduling_of_the_observer_is_refused(design: ObserverDesign) -> None:
    from dataclasses import replace

    held = design.scheduled[1].scheduling
    for changed in (replace(held, high=1.1 * held.high), replace(held, names=("b", "a"), functions=("b", "a"))):
        assert not obsynth.verify(with_observer(design, scheduling=changed))["scheduling"].passed


@pytest.mark.long
def test_an_effect_that_is_too_small_is_refused(scaled: ObserverDesign) -> None:
    assert scaled.report["effectiveness of the faults"].value == pytest.approx(2.0)
    gone = wang(effectiveness=True).as_dict()
    gone["plant"] = {**gone["plant"], "Bf": [[f"{a} * (1 + 1.1 * c)", b] for a, b in WANG_BF.tolist()]}
    with pytest.raises(PreconditionError, match=r"rank F at .*c = -0\.909091, where an entry vanishes"):
        obsynth.fault_estimation_filter(PolytopicSystem(**gone))


@pytest.mark.long
def test_a_gain_set_is_the_design_again(tmp_path: Path, scaled: ObserverDesign) -> None:
    again = obsynth.load(scaled.save(tmp_path / "region.gains.json"))
    assert obsynth.verify(again).passed
    plant, observer = again.scheduled
    parameters, u, f = _wild(plant, 40)
    y = record(plant, parameters, u, f)
    one, other = (each.run(y, np.hstack([u, parameters])) for each in (observer, scaled.scheduled[1]))
    assert np.array_equal(one.faults, other.faults)


def _log(design: ObserverDesign, samples: int = 200) -> pd.DataFrame:
    plant = design.scheduled[0]
    parameters, u, f = _wild(plant, samples)
    f[:] = 0.0
    f[80:, 0] = 1.0
    y = record(plant, parameters, u, f)
    columns = {"time": np.arange(float(samples)), "u1": u[:, 0], "y1": y[:, 0], "y2": y[:, 1], "y3": y[:, 2]}
    return pd.DataFrame(columns | dict(zip(plant.scheduling.names, parameters.T, strict=True)))


def test_rows_outside_the_region_are_out_until_the_error_has_decayed(tmp_path: Path, design: ObserverDesign) -> None:
    log, left = _log(design), design.scheduled[1].forgetting
    log.loc[100, "a"], log.loc[102, "b"] = 1.5, np.nan
    obsynth.run_on_data(design, log, out=tmp_path / "estimates.csv")
    found = pd.read_csv(tmp_path / "estimates.csv")
    assert (found.status[100 : 102 + left] == "out").all()
    assert found.status[102 + left + 1] == "ok"
    assert (found.status[: left - 1] == "warm-up").all()
    assert found.status[99] == "ok"
    good = found.status == "ok"
    truth = np.r_[np.zeros(81), np.ones(119)]
    assert np.abs(found["fhat[f1]"] - truth)[good].max() < 1e-5


def test_a_run_that_was_stopped_goes_on(tmp_path: Path, design: ObserverDesign) -> None:
    log = _log(design)
    log.loc[60, "a"], log.loc[150, "y2"] = -3.0, np.nan
    obsynth.run_on_data(design, log, out=tmp_path / "whole.csv")
    obsynth.run_on_data(design, log[:63], out=tmp_path / "first.csv", state=tmp_path / "state.json")
    obsynth.run_on_data(design, log[63:], out=tmp_path / "second.csv", state=tmp_path / "state.json")
    whole = pd.read_csv(tmp_path / "whole.csv")
    parts = pd.concat([pd.read_csv(tmp_path / name) for name in ("first.csv", "second.csv")], ignore_index=True)
    pd.testing.assert_frame_equal(whole, parts, check_exact=True)
    assert whole.status[150] == "gap"
    assert np.isnan(whole["fhat[f1]"][150])
    assert whole.status[151] == "recovering"


def test_what_a_filter_over_a_region_does_not_have_is_refused_by_name() -> None:
    with pytest.raises(SpecError, match="has no mean"):
        obsynth.fault_estimation_filter(wang(), mean=3)
    with pytest.raises(SpecError, match="has no given weight") as refused:
        obsynth.fault_estimation_filter(wang(), weight=np.eye(2, 3))
    assert refused.value.path == "method.options.weight"
    with pytest.raises(SpecError, match="has no engine"):
        obsynth.fault_estimation_filter(wang(), engine="riccati")
    for method in ("pd_observer", "functional_filter"):
        with pytest.raises(PreconditionError, match="kind of plant"):
            getattr(obsynth, method)(wang())
    turning = wang().as_dict()
    turning["plant"] = {**turning["plant"], "Bf": [["0.1 + a", 0], [1, 1], ["-0.1 + b", 1], [-1, 0]]}
    with pytest.raises(PreconditionError, match="a fault turns with the scheduling"):
        obsynth.fault_estimation_filter(PolytopicSystem(**turning))
    sensor = wang().as_dict()
    sensor["plant"] = {**sensor["plant"], "C": [[0, "1 + 0.1 * a", 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}
    with pytest.raises(PreconditionError, match="constant outputs"):
        obsynth.fault_estimation_filter(PolytopicSystem(**sensor))


@pytest.mark.long
def test_units_do_not_matter() -> None:
    plain = obsynth.fault_estimation_filter(wang(), gamma_margin=0.02).certificate.claims["gamma_min"]
    s = np.array([1e3, 1e-4, 1.0, 1e2])
    vertices = [v.replace(
        A=s[:, None] * v.A / s, C=v.C / s, B=s[:, None] * v.B, Bf=s[:, None] * v.Bf, Bd=1e-5 * s[:, None] * WANG_BD
    ) for v in wang().vertices]  # fmt: skip
    moved = obsynth.fault_estimation_filter(PolytopicSystem(vertices), gamma_margin=0.02)
    assert moved.report.passed
    assert moved.certificate.claims["gamma_min"] < 1e-3 * plain


@pytest.mark.long
def test_feedthrough_and_a_sensor_fault_are_exact_too() -> None:
    A = WANG_A.tolist()
    A[0][0] = "0.9 + 0.05 * a"
    plant = PolytopicSystem(
        plant={
            "E": np.diag([1.0, 1, 1, 0]), "A": A, "B": [["1 + 0.2 * a"], [0], [0], [0]],
            "C": np.eye(4)[1:], "D": [[0.3], [0], [-0.2]],
            "Bf": [[0.1, 0], [1, 0], [-0.1, 0], [-1, 0]], "Df": [[0, 0], [0, 1], [0, 0]],
            "Bd": WANG_BD, "Dd": [[0.1], [0], [0.2]], "dt": 1.0,
        },
        scheduling={"a": [-1, 1]},
    )  # fmt: skip
    made = obsynth.fault_estimation_filter(plant)
    observer, gamma = made.scheduled[1], made.certificate.claims["gamma"]
    parameters, u, f = _wild(plant, 700)
    y, inputs = record(plant, parameters, u, f), np.hstack([u, parameters])
    found = observer.run(y, inputs)
    left = observer.forgetting
    assert np.abs(found.faults[left + 1 :] - f[left:-1]).max() < 1e-10
    for seed in range(4):
        d = np.random.default_rng(seed).standard_normal((700, 1))
        d = np.cumsum(d, axis=0) if seed % 2 else d
        moved = observer.run(record(plant, parameters, u, f, d), inputs).faults - found.faults
        assert np.linalg.norm(moved) <= gamma * np.linalg.norm(d)
        assert np.linalg.norm(moved) >= 0.05 * gamma * np.linalg.norm(d)


_TWO = {"A": [["0.7 + 0.2 * v", 0.1], [0, 0.5]], "C": [[1, 0], [0, 1]], "Bf": [[1], [0]], "Bd": [[0], [1]], "dt": 1.0}
_THREE = {
    "A": [["0.7 + 0.2 * v", 0.1, 0.3], [0.2, 0.5, "0.2 * v"], [0.1, 0.4, 0.9]],
    "C": [[1, 0, 0], [0, 1, 0.5], [0, 0.2, 1]], "Bf": [[1], [0], [0.5]],
    "Bd": [["0.3 + 0.15 * v"], ["1 + 0.5 * v"], [0]], "dt": 1.0,
}  # fmt: skip


@pytest.mark.parametrize("matrices", [pytest.param(_TWO, marks=pytest.mark.long), _THREE], ids=["two", "three"])
def test_disturbances_that_can_be_decoupled_have_a_gain_of_zero(matrices: dict[str, object]) -> None:
    """No course and no disturbance moves a fault estimate; where a gain is changed no such row is there any more."""
    plant = PolytopicSystem(plant=matrices, scheduling={"v": [-1.0, 1.0]})
    design = obsynth.fault_estimation_filter(plant)
    row = next(row for row in design.report.checks if row.name == "least gain")
    assert design.report.passed
    assert design.certificate.claims["gamma_min"] == 0.0
    assert row.kind == "equality"
    assert any("No disturbance reaches a fault estimate" in note for note in design.notes)
    rng, observer = np.random.default_rng(0), design.scheduled[1]
    v, d, x, y = rng.uniform(-1, 1, 60), 100.0 * rng.standard_normal(60), np.zeros(plant.nx), []
    for k in range(60):
        own = plant.at([v[k]])
        y.append(own.C @ x)
        x = own.A @ x + own.Bd[:, 0] * d[k]
    assert np.abs(observer.run(y, v[:, None]).faults).max() < 1e-9
    Az = np.array(observer.Az)
    Az[0] += 1e-6
    rows = {row.name: row for row in obsynth.verify(with_observer(design, Az=Az)).checks}
    assert rows["least gain"].kind != "equality"


def _random_region(seed: int, *, outputs: int = 2) -> PolytopicSystem:
    """Return a plant of three states whose disturbance cannot be decoupled, with noise in its outputs."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((3, 3))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    turn = 0.1 * rng.standard_normal((3, 3))
    shared: dict[str, FloatArray] = {
        "C": rng.standard_normal((outputs, 3)),
        "Bf": rng.standard_normal((3, 1)),
        "Bd": np.hstack([rng.standard_normal((3, 1)), np.zeros((3, outputs))]),
        "Dd": np.hstack([np.zeros((outputs, 1)), 0.3 * np.eye(outputs)]),
    }
    return PolytopicSystem([obsynth.DescriptorSystem(np.eye(3), A + v * turn, **shared, dt=1.0) for v in (-1.0, 1.0)])


@pytest.mark.one_in(3)
@pytest.mark.parametrize("rate", [1e-9, 0.1, 1e9])
def test_a_rate_keeps_a_gain_of_zero(rate: float) -> None:
    plant = PolytopicSystem(
        plant={
            "A": [["0.5 + 0.3 * v", 0.1], [0, 0.8]], "C": [[1, 0], [0, 1]], "Bf": [[1], [0.5]], "Bd": [[0.3], [1]],
            "dt": 1.0,
        },
        scheduling={"v": {"range": [-1, 1], "rate": rate}},
    )  # fmt: skip
    design = obsynth.fault_estimation_filter(plant)
    assert design.certificate.claims["gamma_min"] == 0.0
    assert not any("is not used" in note for note in design.notes)


@pytest.mark.long
def test_the_free_weight_is_that_of_the_constant_filter_at_one_vertex() -> None:
    plant = _random_region(1)
    one = obsynth.fault_estimation_filter(PolytopicSystem([plant.center]), gamma_margin=0.01)
    constant = obsynth.fault_estimation_filter(plant.center, weight="free", gamma_margin=0.01, engine="lmi")
    assert one.certificate.claims["gamma_min"] == pytest.approx(constant.certificate.claims["gamma_min"], rel=1e-3)
    paper = obsynth.fault_estimation_filter(PolytopicSystem([plant.center]), gamma_margin=0.01, weight="paper")
    assert paper.certificate.claims["gamma_min"] > 1.01 * one.certificate.claims["gamma_min"]


@pytest.mark.one_in(3)
@pytest.mark.parametrize("seed", range(3))
def test_the_least_gain_depends_on_no_coordinates(seed: int) -> None:
    """With the weight of the paper it moved by half with the units of outputs; noise in outputs failed altogether."""
    rng, plant = np.random.default_rng(seed), _random_region(seed)
    T, S = rng.standard_normal((3, 3)), np.diag(10.0 ** rng.uniform(-2, 2, 2))
    moved = [
        v.replace(A=T @ v.A @ np.linalg.inv(T), C=S @ v.C @ np.linalg.inv(T), Bf=T @ v.Bf, Bd=T @ v.Bd, Dd=S @ v.Dd)
        for v in plant.vertices[::-1]
    ]
    least = obsynth.fault_estimation_filter(plant).certificate.claims["gamma_min"]
    other = obsynth.fault_estimation_filter(PolytopicSystem(moved)).certificate.claims["gamma_min"]
    assert other == pytest.approx(least, rel=1e-3)


def _with_rate(plant: PolytopicSystem, rate: float | None) -> PolytopicSystem:
    return PolytopicSystem(list(plant.vertices), scheduling={"v": {"range": [-1.0, 1.0], "rate": rate}})


_DESIGNS: dict[str, Callable[[PolytopicSystem], ObserverDesign]] = {
    "filter": obsynth.fault_estimation_filter,
    "kalman": obsynth.descriptor_kalman,
    "pi": obsynth.ui_pi_observer,
}


def _claims(name: str, plant: PolytopicSystem) -> dict[str, float]:
    claims = _DESIGNS[name](plant).certificate.claims
    return {
        each: claims[each] for each in ("gamma", "region_deviation", "region_gain", "region_decay") if each in claims
    }


def _for(name: str, seed: int) -> PolytopicSystem:
    """Return a plant for a method, without what the method has no use for."""
    plant = _random_region(seed)
    if name == "filter":
        return plant
    faults = {"Bf": None, "fault_names": None} if name == "kalman" else {}
    return PolytopicSystem([v.replace(Bd=None, Dd=None, disturbance_names=None, **faults) for v in plant.vertices])


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", _DESIGNS)
def test_a_rate_makes_no_claim_worse(name: str, seed: int) -> None:
    """With a rate a decay was one of a coarse grid (.9 where .69 is proved without), and a gain could be larger."""
    plant = _for(name, seed)
    plain = _claims(name, _with_rate(plant, None))
    for rate in (0.1, 1.0):
        slow = _claims(name, _with_rate(plant, rate))
        assert slow.keys() == plain.keys()
        assert all(slow[each] <= plain[each] * (1.0 + 1e-9) for each in plain)


@pytest.mark.long
@pytest.mark.parametrize("name", ["filter", "kalman"])
def test_the_order_of_vertices_and_one_twice_change_no_claim(name: str) -> None:
    """Decays moved by a fifth: they were those of whatever P the solver ended with."""
    plant = _for(name, 0)
    first, second = plant.vertices
    claims = _claims(name, PolytopicSystem([first, second]))
    for vertices in ([second, first], [first, second, first]):
        other = _claims(name, PolytopicSystem(vertices))
        assert [other[each] for each in claims] == pytest.approx(list(claims.values()), rel=2e-3)
