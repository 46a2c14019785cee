"""The public functions of the recursive methods: from plant, options or spec to a verified design and its file."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from time_varying_plants import observer_for, printed, record, textbook, varying

import obsynth
from obsynth import DescriptorSystem, PreconditionError, SpecError, TimeVaryingDescriptorSystem
from obsynth.cli.main import main
from obsynth.methods.designing import check
from obsynth.observers.recursive.batches import run_batch
from obsynth.observers.recursive.gain_schedule_summary import FOLLOW_FURTHER, end_of_steps, gain_schedule_summary
from obsynth.specs.loader import load_spec

NOISE = {"Q": 0.1, "R": 0.2}
FORMS = {
    "innovation": {},
    "literal": {"form": "literal"},
    "directional": {"guard": "directional"},
    "random walk": {"form": "random-walk", "random_walk": 1e-3},
    "early": {"early_constraints": True},
    "early random walk": {"form": "random-walk", "random_walk": 1e-3, "early_constraints": True},
}
SPEC = """\
schema_version: 1
name: varying
plant:
  kind: time-varying
  dt: 0.5
  horizon: 60
  constants: {half: 0.5}
  E: [[0, 0], [-1, "(k - 1) / k"]]
  A: [[1, "-(k + 1) / (k + half)"], [0, "1 / (k + 1)"]]
  C: [[1, 0], [0, 1]]
  Phi: [["1 - exp(-k / 30)"], [1]]
  parameter_names: [torque]
  units: {torque: N m}
method:
  id: adaptive-observer
  options:
    Q: [[1.0e-4, 0], [0, "1.0e-4 * (1 + half * step(k - 9))"]]
    R: [[0.01, 0], [0, 0.01]]
    forgetting: 0.95
    window: 10
"""


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", FORMS)
def test_every_form_is_verified_saved_and_verified_again(name: str, tmp_path: Path) -> None:
    design = obsynth.adaptive_observer(varying(horizon=60), **NOISE, window=10, **FORMS[name], name=name)
    assert design.report.passed
    loaded = obsynth.load(design.save(tmp_path / "it.json"))
    # Rows that inform have no bound: their NaN equals itself as text only.
    assert repr(loaded.report) == repr(design.report) == repr(obsynth.verify(loaded))
    y, u = record(varying(), 20)
    first, second = design.observer.run(y, u), loaded.observer.run(y, u)
    for field in ("states", "parameters", "parameter_covariances", "innovations", "excitation"):
        np.testing.assert_array_equal(getattr(first, field), getattr(second, field))
    assert json.loads((tmp_path / "it.json").read_text())["design"]["kind"] == "recursive"


def test_a_kalman_filter_of_a_plant_with_parameters_takes_them_as_zero() -> None:
    design = obsynth.descriptor_kalman(varying(horizon=60), **NOISE)
    assert design.report.passed
    assert design.observer.fault_names == ()
    y, u = record(varying(), 12)
    plain = observer_for(varying(), Q=0.1 * np.eye(3), R=0.2 * np.eye(2)).run(y, u)
    np.testing.assert_array_equal(design.observer.run(y, u).states, plain.states)
    assert set(design.gains) == {"L", "K"}
    L, K = design.gains["L"], design.gains["K"]
    np.testing.assert_allclose(L @ varying().E.at(60) + K @ varying().C.at(60), np.eye(3), atol=1e-14)


def test_a_time_invariant_plant_states_its_noise() -> None:
    plant = DescriptorSystem(
        np.diag([1.0, 1, 0]), [[0.9, 0.1, 0.3], [0, 0.7, 0.2], [1, 0.4, -1]], C=[[1, 0, 0.3], [0, 1, 1]],
        Bf=[[0], [1], [0]], Bw=np.hstack([np.diag([0.1, 0.2, 0.3]), np.zeros((3, 2))]),
        Dw=np.hstack([np.zeros((2, 3)), np.diag([0.4, 0.5])]), dt=0.1,
    )  # fmt: skip
    design = obsynth.design(plant, "adaptive-observer")
    assert design.report.passed
    assert isinstance(design.plant, TimeVaryingDescriptorSystem)
    np.testing.assert_allclose(design.observer.Q.at(0), np.diag([0.01, 0.04, 0.09]))
    np.testing.assert_allclose(design.observer.R.at(0), np.diag([0.16, 0.25]))
    with pytest.raises(SpecError, match="R is not stated, and cannot be taken from the plant's noise alone"):
        obsynth.descriptor_kalman(plant.replace(Dw=np.ones((2, 5))), Q=1)
    assert obsynth.descriptor_kalman(plant.replace(Dw=np.ones((2, 5))), Q=1, R=1).report.passed
    bare = obsynth.descriptor_kalman(plant.replace(Bw=None, Dw=None, noise_names=None))
    assert "No noise is stated: Q and R taken as the identity" in bare.notes[0]


def test_noise_in_turned_axes_is_as_independent_as_before() -> None:
    # Bw Dw' is zero but for the rounding of the turn.
    turn = np.linalg.qr(np.random.default_rng(3).standard_normal((4, 4)))[0]
    process, sensors = np.hstack([0.1 * np.eye(2), np.zeros((2, 2))]), np.hstack([np.zeros((2, 2)), 0.2 * np.eye(2)])
    plant = DescriptorSystem(A=[[0.9, 0.1], [0, 0.8]], C=np.eye(2), Bw=process @ turn, Dw=sensors @ turn, dt=1.0)
    assert np.any(plant.Bw @ plant.Dw.T)
    design = obsynth.descriptor_kalman(plant)
    np.testing.assert_allclose(design.observer.R.at(0), 0.04 * np.eye(2), atol=1e-15)


@pytest.mark.long
def test_callables_are_used_but_not_saved(tmp_path: Path) -> None:
    stacked = obsynth.descriptor_kalman(varying(horizon=60), Q=np.tile(0.1 * np.eye(3), (60, 1, 1)), R=0.2)
    assert obsynth.load(stacked.save(tmp_path / "s.json")).observer.Q.length == 60
    called = obsynth.descriptor_kalman(varying(horizon=60, A=lambda k: varying().A.at(k)), **NOISE)
    assert called.report.passed
    with pytest.raises(SpecError, match="A is a Python function, and only data can be saved"):
        called.save(tmp_path / "it.json")
    noisy = obsynth.descriptor_kalman(varying(horizon=60), Q=lambda k: 0.1 * np.eye(3), R=0.2)
    with pytest.raises(SpecError, match="only data can"):
        noisy.save(tmp_path / "it.json")
    assert list(tmp_path.iterdir()) == [tmp_path / "s.json"]


class TestRefusals:
    def test_the_printed_example_in_the_literal_form(self) -> None:
        with pytest.raises(PreconditionError, match=r"uses only rank E \+ ny - nx = 0 residual directions") as caught:
            obsynth.adaptive_observer(printed(horizon=100), form="literal", **NOISE)
        assert caught.value.condition == "residual directions"

    def test_the_check_knows_the_form(self) -> None:
        plant = printed(horizon=100)
        assert check(plant)["adaptive-observer"].passed
        assert not check(plant, {"adaptive-observer": {"form": "literal"}})["adaptive-observer"].passed

    def test_the_worst_k_is_named(self) -> None:
        open_at_7 = [[1, 0, "1 - step(k - 7) + step(k - 8)"], [0, 1, 0]]
        plant = varying(E=np.diag([1.0, 1, 0]), C=open_at_7, horizon=20)
        with pytest.raises(PreconditionError, match="at k = 7 equations and outputs") as caught:
            obsynth.descriptor_kalman(plant, **NOISE)
        assert caught.value.condition == "rank [E; C]"

    def test_a_plant_that_changes_is_nothing_for_the_other_methods(self) -> None:
        with pytest.raises(PreconditionError, match="methods for such plants are: descriptor-kalman"):
            obsynth.fault_estimation_filter(varying())
        reports = check(varying(horizon=20))
        assert {name for name, report in reports.items() if report.passed} == {"descriptor-kalman", "adaptive-observer"}
        continuous = check(DescriptorSystem(None, -np.eye(2), C=np.eye(2)))
        assert "continuous" in continuous["descriptor-kalman"].checks[0].detail

    @pytest.mark.parametrize("name", ["Q", "R"])
    def test_a_covariance_that_is_one_text_is_named(self, name: str) -> None:
        with pytest.raises(SpecError, match=f"{name} is the text '1': give a number, or the rows of"):
            obsynth.descriptor_kalman(varying(horizon=20), **{**NOISE, name: "1"})

    def test_options(self) -> None:
        plant = varying(horizon=20)
        for options, part in (
            ({"forgetting": 1.5}, "above 0 and at most 1"),
            ({"form": "random-walk"}, "needs random_walk"),
            ({"random_walk": 1.0}, "belongs to form 'random-walk'"),
            ({"Q": [[1, 2, 0], [2, 1, 0], [0, 0, 1]]}, "not positive semidefinite"),
            ({"R": [[1, 0.1], [0, 1]]}, "not symmetric"),
            ({"R": np.tile(np.eye(2), (10, 1, 1))}, "R is a stack for 10 steps"),
            ({"initial_state": [1, 2]}, "must be 3 finite"),
            ({"initial_parameters": ["a", "b"]}, "must be 2 finite"),
            ({"initial_parameter_covariance": -1.0}, "negative variance"),
        ):
            with pytest.raises(SpecError, match=part):
                obsynth.adaptive_observer(plant, **{**NOISE, **options})
        with pytest.raises(PreconditionError, match="the plant has parameters"):
            obsynth.adaptive_observer(textbook(Phi=None, horizon=9), **NOISE)
        with pytest.raises(SpecError, match="has no option 'lambda_'"):
            obsynth.design(plant, "adaptive-observer", lambda_=1)

    def test_a_recursive_design_is_no_linear_one(self) -> None:
        design = obsynth.descriptor_kalman(varying(horizon=20), **NOISE)
        with pytest.raises(SpecError, match="no constant realisation to hand on"):
            design.to_control()
        with pytest.raises(SpecError, match="no recursive observer"):
            _ = obsynth.load(linear_file()).recursive


def test_an_empty_record_has_empty_estimates() -> None:
    for design in (obsynth.descriptor_kalman(varying(horizon=20), **NOISE),
                   obsynth.adaptive_observer(varying(horizon=20), **NOISE)):  # fmt: skip
        found, nq = design.observer.run(np.zeros((0, 2)), np.zeros((0, 1))), len(design.observer.fault_names)
        assert found.states.shape == found.state_deviations.shape == (0, 3)
        assert found.parameters.shape == (0, nq)
        assert found.parameter_covariances.shape == (0, nq, nq)


def linear_file() -> Path:
    import tempfile

    plant = DescriptorSystem(None, 0.5 * np.eye(2), C=np.eye(2), Bf=[[1], [0]], dt=1.0)
    return obsynth.fault_estimation_filter(plant).save(Path(tempfile.mkdtemp()) / "linear.json")


class TestBatch:
    @pytest.mark.one_in(6)
    @pytest.mark.usefixtures("taken_as_verified")
    @pytest.mark.parametrize("name", FORMS)
    def test_trials_are_runs(self, name: str) -> None:
        observer = obsynth.adaptive_observer(varying(horizon=60), **NOISE, window=10, **FORMS[name]).observer
        rng = np.random.default_rng(0)
        y, u = rng.standard_normal((5, 25, 2)), rng.standard_normal((5, 25, 1))
        batch = run_batch(observer, y, u)
        for trial in range(5):
            single = observer.run(y[trial], u[trial])
            np.testing.assert_allclose(batch.states[trial], single.states, rtol=0, atol=1e-12)
            np.testing.assert_allclose(batch.parameters[trial], single.parameters, rtol=0, atol=1e-12)
            np.testing.assert_allclose(batch.innovations[trial], single.innovations, rtol=0, atol=1e-12)
        shared = run_batch(observer, y, u[0])
        np.testing.assert_allclose(shared.states[0], batch.states[0], rtol=0, atol=1e-13)

    def test_bad_input(self) -> None:
        observer = observer_for(varying(horizon=9))
        good = np.zeros((4, 10, 2)), np.zeros((4, 10, 1))
        assert run_batch(observer, *good).parameters.shape == (4, 10, 0)
        for y, u, part in (
            (good[0][0], good[1], "y has shape"),
            (good[0], good[1][:, :5], "u has shape"),
            (np.full((4, 10, 2), np.nan), good[1], "must be complete"),
            (np.zeros((4, 11, 2)), np.zeros((4, 11, 1)), "horizon of 9 steps"),
        ):
            with pytest.raises(SpecError, match=part):
                run_batch(observer, y, u)


class TestSpec:
    def write(self, folder: Path, text: str = SPEC) -> Path:
        path = folder / "spec.yaml"
        path.write_text(text)
        return path

    @pytest.mark.long
    def test_from_the_command_line_to_a_file_and_back(self, tmp_path: Path, capsys) -> None:
        path, gains = self.write(tmp_path), tmp_path / "gains.json"
        assert main(["design", "--system", str(path), "--output", str(gains), "--quiet", "-v"]) == 0
        shown = capsys.readouterr().out
        for part in ("change with k", "E, A, Phi", "Parameter estimates", "torque", "N m", "least rank E_k + ny - nx"):
            assert part in shown
        assert main(["verify", str(gains)]) == 0
        capsys.readouterr()
        assert main(["check", "--system", str(path), "--json"]) == 0
        found = json.loads(capsys.readouterr().out)
        assert found["structure"] == {}
        assert found["methods"]["fault-estimation-filter"]["passed"] is False
        assert main(["check", "--system", str(path)]) == 0
        assert "adaptive-observer: all conditions hold" in capsys.readouterr().out

    def test_values(self, tmp_path: Path) -> None:
        (tmp_path / "plant.yaml").write_text(
            "schema_version: 1\n" + "\n".join(line[2:] for line in SPEC.splitlines()[3:13])
        )
        split = SPEC.splitlines()
        parted = "\n".join([*split[:2], "plant: {file: plant.yaml}", *split[13:]])
        for text in (SPEC, parted):
            spec = load_spec(self.write(tmp_path, text))
            assert isinstance(spec.plant, TimeVaryingDescriptorSystem)
            assert (spec.plant.horizon, spec.plant.dt, spec.plant.parameter_names) == (60, 0.5, ("torque",))
            np.testing.assert_allclose(spec.plant.A.at(3), [[1, -4 / 3.5], [0, 0.25]])
            design = obsynth.design(spec.plant, spec.method, **spec.options)
            np.testing.assert_allclose(design.observer.Q.at(9), np.diag([1e-4, 1.5e-4]))
            assert design.report.passed

    @pytest.mark.parametrize(
        ("old", "new", "part"),
        [
            ('"1 / (k + 1)"', '"1 / (k + j)"', "A, row 2, column 2: 'j' is unknown"),
            ('"1 / (k + 1)"', '"open(k)"', "no function 'open'"),
            ('"1 / (k + 1)"', "true", "row 2, column 2 must be a number or an expression in k, not the truth value"),
            ('"1 / (k + 1)"', "null", "must be a number or an expression in k, not nothing"),
            ('"1 / (k + 1)"', ".nan", "must be a finite number"),
            ('"1 / (k + 1)"', '"1 / (k - 3)"', r"A\(3\) has inf"),
            ('[0, "1 / (k + 1)"]', '["1 / (k + 1)"]', "row 2 has 1 entry, but row 1 has 2"),
            ("  Phi:", "  Fi:", "plant.Fi: unknown key"),
            ("horizon: 60", "horizon: 0", "must be at least 1"),
            ("dt: 0.5", "dt: 0", "must be greater than 0"),
            ("forgetting: 0.95", "forgetting: 1.2", "method.options.forgetting"),
            ("time-varying", "varying", "kind: unknown key"),
            ("    window: 10", "    window: 0", "method.options.window: must be at least 1"),
            ('"1.0e-4 * (1', '"1.0e-4 * (m', "Q, row 2, column 2: 'm' is unknown"),
        ],
    )
    def test_mistakes(self, tmp_path: Path, old: str, new: str, part: str) -> None:
        assert old in SPEC
        path = self.write(tmp_path, SPEC.replace(old, new))
        with pytest.raises(SpecError, match=part):
            self.designed(path)

    def designed(self, path: Path) -> obsynth.ObserverDesign:
        spec = load_spec(path)
        return obsynth.design(spec.plant, spec.method, **spec.options)


class TestManyStates:
    """Above `MANY_STATES` fewer steps are followed, and the rows say which."""

    @pytest.fixture(scope="class")
    @classmethod
    def design(cls):
        rng, n = np.random.default_rng(4), 140
        a = np.linalg.qr(rng.normal(size=(n, n)))[0] * np.linspace(0.3, 0.9, n)
        return obsynth.descriptor_kalman(
            DescriptorSystem(
                None, a, C=np.eye(n)[:6], Bw=0.1 * np.eye(n, 14) * (np.arange(14) < 8), Dw=np.eye(6, 14, 8), dt=1.0
            )
        )

    @pytest.mark.long
    def test_fewer_steps_and_rows_that_say_so(self, design):
        rows = {row.name: row for row in design.report.checks}
        assert design.report.passed
        assert design.certificate.claims["steps"] < 400
        assert f"{design.certificate.claims['steps']:.0f} steps" in rows["contraction"].detail
        assert rows["batch: state"].detail.startswith("6 steps at once")

    @pytest.mark.long
    def test_as_the_recursion_has_it(self, design, monkeypatch):
        few = gain_schedule_summary(design.observer)
        monkeypatch.setattr("obsynth.observers.recursive.gain_schedule_summary.MANY_STATES", 200)
        for followed in ("STEPS_WITHOUT_HORIZON", "FIRST_FOLLOWED"):
            monkeypatch.setattr(f"obsynth.observers.recursive.gain_schedule_summary.{followed}", few.steps)
        whole = gain_schedule_summary(design.observer)
        assert whole.steps == few.steps
        np.testing.assert_allclose(whole.L, few.L, rtol=0.0, atol=1e-12)
        assert whole.contraction == pytest.approx(few.contraction, rel=1e-9)
        # Of many states the growth is a bound.
        assert whole.growth <= few.growth <= 20.0 * whole.growth


@pytest.mark.parametrize("first", [60, 100, 364, 490, 970, 1001])
@pytest.mark.parametrize("whole", [1000, 1001])
def test_a_later_end_has_less_than_half_of_its_steps_behind_it(first: int, whole: int) -> None:
    """A decay over the second half is measured from the middle: a middle that has passed would be missed."""
    end = end_of_steps(first, whole)
    while end < whole:
        later = end_of_steps(FOLLOW_FURTHER * end, whole)
        assert end < later // 2
        end = later
    assert end == whole


def test_steps_are_followed_until_gains_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a plant that stays the same, as many steps as its slowest mode needs; the gains are those of all steps."""
    for slow, steps in ((0.5, 100), (0.93, 300), (0.999, 1000)):
        plant = DescriptorSystem(
            None, np.diag([slow, 0.3]), C=np.eye(2), Bw=np.diag([1e-3 * (1.0 - slow), 0.1, 0.0, 0.0])[:2],
            Dw=np.eye(2, 4, 2), dt=1.0,
        )  # fmt: skip
        design = obsynth.descriptor_kalman(plant)
        with monkeypatch.context() as patched:
            patched.setattr("obsynth.observers.recursive.gain_schedule_summary.FIRST_FOLLOWED", 10**6)
            whole = gain_schedule_summary(design.observer)
        assert design.certificate.claims["steps"] == steps
        np.testing.assert_allclose(design.gains["K"], whole.K, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("unit", [1.0, 1e6])
def test_a_state_that_is_zero_after_a_step_is_known_to_rounding(unit: float) -> None:
    # x2 is zero from the first step on; factorisations leave 1e-16 of the others there, which was compared with itself.
    states = np.diag([1.0, unit, 1.0])
    plant = DescriptorSystem(
        np.diag([1.0, 1.0, 0.0]) @ states,
        np.array([[-0.5, -0.75, -0.25], [0, 0, 0], [0, 0, 1]]) @ states,
        C=np.array([[-2.0, 1, -1]]) @ states,
        Bf=[[1.0], [0], [0]],
        Bw=[[0, 0.1], [0, 0], [0, 0]],
        Dw=[[0.01, 0]],
        dt=1.0,
    )
    assert obsynth.descriptor_kalman(plant).report.passed
