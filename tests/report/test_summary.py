"""The answer first: the summary of a design, on the terminal, in a REPL and in a notebook."""

from __future__ import annotations

import html
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg
from scipy.optimize import brentq

import obsynth
from obsynth.cli.main import main
from obsynth.monitoring.verbs.data_arguments import own_tolerances
from obsynth.report.designs import design_warnings, followed_steps
from obsynth.report.plots.frequency import fault_gains
from obsynth.report.summary import summary
from obsynth.verification.output_responses import _state_response

DESIGNS = Path(__file__).parents[2] / "designs"


@pytest.fixture(scope="module")
def network() -> obsynth.ObserverDesign:
    spec = obsynth.load_spec(DESIGNS / "smib" / "spec.yaml")
    return obsynth.design(spec.plant, spec.method, name=spec.name, **dict(spec.options))


def leaky(gain: float, *, units: dict[str, str] | None = None) -> obsynth.ObserverDesign:
    """A fault and an unknown input beside it that are hard to tell apart."""
    plant = obsynth.DescriptorSystem(
        None, [[0.5, 0.1], [0.0, 0.4]], C=np.eye(2), Bf=[[1.0], [0.0]], Bd=[[gain], [1.0]],
        Dd=[[0.0], [0.0]], dt=1.0, units=units, Dw=0.1 * np.eye(2), fault_names=["leak"],
    )  # fmt: skip
    return obsynth.fault_estimation_filter(plant)


def test_a_design_prints_as_about_twelve_lines_of_eighty_columns(network):
    lines = str(network).splitlines()
    assert 8 <= len(lines) <= 15
    assert max(map(len, lines)) <= 80
    assert lines[0] == f"smib: Verified: all {sum(c.kind != 'information' for c in network.report.checks)} checks hold."
    text = " ".join(" ".join(lines).split())
    assert "fault-estimation-filter" in text
    assert "gamma = 0.3" in text
    assert re.search(r"tm GENCLS 1 +1 +0\.02 +0\.04\d* pu +0\.\d+ from active power Bus 3", "\n".join(lines))
    assert "white noise on 3 of 3 sensors" in text


def test_the_leak_is_that_of_the_norm(network):
    """With one fault and one unknown input, the worst leak is the H-infinity norm that verification recomputes."""
    leak = float(summary(network).rows[0][-1].split()[0])
    assert leak == pytest.approx(network.report["H-infinity norm"].value, rel=2e-3)


def test_a_repl_shows_one_line(network):
    assert repr(network) == "<ObserverDesign 'smib' by fault-estimation-filter: verified>"
    broken = network.replace(report=obsynth.VerificationReport.of([]))
    assert "NOT verified" in repr(broken)
    assert "FAILS" in str(broken).splitlines()[0]


def test_a_notebook_shows_the_same_and_escapes_names():
    plant = obsynth.DescriptorSystem(
        None, [[0.5]], C=[[1.0]], Bf=[[1.0]], dt=1.0, fault_names=["<b>leak</b>"], Dw=[[0.1]]
    )  # fmt: skip
    design = obsynth.fault_estimation_filter(plant)
    page = design._repr_html_()
    assert "<b>leak" not in page
    assert "<b>leak</b>" in html.unescape(page)
    assert "Verified" in page


def test_a_report_prints_as_a_table(network):
    text = str(network.report)
    assert "LMI" in text
    assert text.splitlines()[-1].startswith("Verified: all")
    assert all(check.name.split()[0] in text for check in network.report.checks)


def test_a_leak_in_the_fault_s_unit_is_a_warning():
    assert any("looks like a fault" in text for text in summary(leaky(5.0)).warnings)
    assert not summary(leaky(5.0, units={"leak": "kg/s", "d1": "K"})).warnings
    assert not summary(leaky(0.0)).warnings


def test_an_estimate_that_does_not_follow_a_step_is_a_warning():
    """Half of a step is left where the estimate is scaled by a half."""
    design = leaky(0.0)
    observer = design.observer
    rows = np.ones((observer.Cz.shape[0], 1))
    rows[observer.fault_rows] = 0.5
    halved = obsynth.LinearObserver(**{**observer.as_dict(), "Cz": rows * observer.Cz, "Dy": rows * observer.Dy,
                                       "Du": rows * observer.Du})  # fmt: skip
    texts = summary(design.replace(observer=halved)).warnings
    assert any("does not follow a step" in text and "its steady state is 50 % of it" in text for text in texts)


def test_two_specs_of_one_name_keep_their_gain_sets(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    text = (DESIGNS / "wang2015" / "spec.yaml").read_text().replace("plant.yaml", str(DESIGNS / "wang2015/plant.yaml"))
    for name, gamma in (("first", 2.5), ("second", 3.0)):
        (tmp_path / f"{name}.yaml").write_text(text.replace("weight: paper", f"gamma: {gamma}"))
        assert main(["design", "--system", f"{name}.yaml", "--quiet"]) == 0
    assert "wang2015.second.gains.json" in capsys.readouterr().out
    files = {path.name: obsynth.load(path).options["gamma"] for path in tmp_path.glob("*.json")}
    assert files == {"wang2015.gains.json": 2.5, "wang2015.second.gains.json": 3.0}
    # The same spec again takes the place of its own.
    assert main(["design", "--system", "first.yaml", "--quiet"]) == 0
    assert len(list(tmp_path.glob("*.json"))) == 2


def test_what_a_method_alone_asks_for_is_not_called_impossible():
    plant = obsynth.DescriptorSystem(A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], dt=1.0)
    told = " ".join(str(obsynth.check(plant.replace(Bf=None, fault_names=None))).split())
    assert "IMPOSSIBLE" not in told
    assert "fault-estimation-filter: not for this plant as it is: the method's condition 'faults' FAILS." in told
    # A state that nothing shows and that grows: no observer of these kinds exists, whatever else a method asks for.
    hidden = plant.replace(A=[[1.2, 0.0], [0.0, 0.8]], C=[[0, 1], [0, 1]], Bf=[[0], [1]])
    lines = " ".join(str(obsynth.check(hidden)).split())
    assert "ui-pi-observer: IMPOSSIBLE for this plant: the condition" in lines
    rows = obsynth.check(hidden)["ui-pi-observer"].failures
    assert not any(check.of_the_method for check in rows)


def test_check_with_all_conditions_leaves_out_those_of_methods_for_other_kinds_of_plants(capsys):
    assert main(["check", "-v", "--system", str(DESIGNS / "wang2015" / "spec.yaml")]) == 0
    printed = capsys.readouterr().out
    assert "Existence conditions of ui-pi-observer" in printed
    for method in ("pd-observer", "detection-filter", "region-observer", "extended-kalman"):
        assert f"Existence conditions of {method}" not in printed
        assert printed.count(method) == 1
    assert printed.count("ui-pi-observer: all conditions hold") == 1


@pytest.mark.long
def test_check_says_one_line_per_method(capsys):
    assert main(["check", "--system", str(DESIGNS / "filasova" / "spec.yaml")]) == 0
    printed = capsys.readouterr().out
    # A bound on the residual's least gain asks for noise on every output, which this plant does not state: other
    # residuals exist.
    assert "IMPOSSIBLE" not in printed
    assert "detection-filter: not for this plant as it is: the method's condition" in " ".join(printed.split())
    assert "discrete only: sample the plant first" in " ".join(printed.split())
    assert "pd-observer" in printed
    assert main(["check", "--system", str(DESIGNS / "smib" / "spec.yaml")]) == 0
    assert "sample the observer afterwards" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("matrix", "dt", "words"),
    [
        ([[-20.0, 1.0], [0.0, -0.5]], 0.1, "matrices of a plant in continuous time?"),
        ([[0.9, 0.1], [0.0, 0.8]], 0.0, "matrices of a sampled plant?"),
        ([[0.9, 0.1], [0.0, 0.8]], 0.1, ""),
        ([[-20.0, 1.0], [0.0, -0.5]], 0.0, ""),
        ([[1.5, 1.0], [0.0, -0.5]], 0.1, ""),
    ],
)
def test_matrices_of_another_time_are_asked_about(matrix, dt, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("spec.yaml").write_text(
        f"schema_version: 1\nname: a\nplant: {{dt: {dt}, A: {matrix}, C: [[1, 0], [0, 1]], Bf: [[1], [0]]}}\n"
        "method: {id: ui-pi-observer}\n"
    )
    main(["check", "--system", "spec.yaml"])
    asked = capsys.readouterr().err
    assert (words in asked) if words else not asked


def test_figures_of_a_step_end_where_an_unstable_plant_is_let_go():
    # The plant doubles in a second and no input holds it: after some twenty samples its outputs are beyond all digits.
    plant = obsynth.DescriptorSystem(
        None, [[2.0, 0.0], [0.0, 0.5]], C=np.eye(2), Bf=[[1.0], [0.0]], Dw=0.1 * np.eye(2), dt=1.0
    )
    design = obsynth.fault_estimation_filter(plant)
    (found,) = followed_steps(design).values()
    assert found.horizon == pytest.approx(np.log(1e6) / np.log(2.0), abs=1.5)


@pytest.mark.parametrize(
    ("value", "told"),
    [
        (-2.4e-3, "0"),
        (0.8834, "0.88"),
        (-0.478, "-0.48"),
        (-2.02e16, "more than 10 times"),
        (np.nan, "more than 10 times"),
    ],
)
def test_a_missed_step_is_told_to_the_digits_that_are_not_rounding(network, value, told):
    (name, figures), *_ = followed_steps(network).items()
    (text,) = design_warnings(network, {name: replace(figures, at_horizon=value)})
    assert f"gives an estimate of {told}" in text


def test_a_fixed_pole_at_zero_is_zero():
    # Rounding makes 1e-16 of it, another one on each processor.
    turned = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0]
    dynamics = np.array([[0.5, 0.0, 0.0], [0.2, 0.3, 0.0], [0.3, 0.1, 0.0]])
    plant = obsynth.DescriptorSystem(
        None, turned @ dynamics @ turned.T, C=np.eye(2, 3) @ turned.T, Bf=turned[:, :1], dt=1.0
    )
    notes = obsynth.ui_pi_observer(plant).notes
    assert any(note.endswith("poles are fixed, whatever the gains: 0.") for note in notes)


def test_a_frequency_that_meets_a_mode_of_the_plant_stops_no_summary():
    # Low frequencies beside an integrator are lost in rounding, on some processors: here for certain, on the mode.
    plant = obsynth.DescriptorSystem(None, [[1.0, 0.0], [0.0, 0.5]], C=np.eye(2), Bf=[[0.0], [1.0]], dt=1.0)
    found = _state_response(plant, plant.Bf, np.array([1.0 + 0.0j, -1.0 + 0.0j]))
    assert found[:, :, 0] == pytest.approx(np.array([[0.0, 2.0], [0.0, -2.0 / 3.0]]))


def test_a_condition_number_beyond_a_double_is_no_number():
    plant = obsynth.DescriptorSystem(
        None, np.diag([0.5, 0.3, 0.1]), C=[[0.1, 0.3, 0.0], [0.2, 0.6, 1.0]], Bf=np.eye(3, 2), dt=1.0
    )
    with pytest.raises(obsynth.PreconditionError, match=r"condition number above 1e\+14"):
        obsynth.fault_estimation_filter(plant)


def test_what_rounding_leaves_of_errors_is_not_printed() -> None:
    """A mean factor of 1e-10 per step has other digits on every processor."""
    plant = obsynth.TimeVaryingDescriptorSystem(None, [[0.0, 1.0], [0.0, 0.0]], C=np.eye(2), dt=1.0, horizon=30)
    told = str(obsynth.descriptor_kalman(plant, Q=1e-3 * np.eye(2), R=1e-20 * np.eye(2)))
    assert "the error is gone after a few samples" in " ".join(told.split())


def test_the_time_to_90_percent_is_the_observer_s_not_of_the_clock_of_a_slow_plant():
    # With the poles -40 and -50 the estimate of a unit step is 1 - 5 exp(-40 t) + 4 exp(-50 t).
    plant = obsynth.DescriptorSystem(None, [[-0.01]], C=[[1.0]], Bf=[[1.0]])
    design = obsynth.ui_pi_observer(plant, poles=[-40.0, -50.0])
    passed = brentq(lambda t: 1.0 - 5.0 * np.exp(-40.0 * t) + 4.0 * np.exp(-50.0 * t) - 0.9, 1e-3, 1.0)
    assert followed_steps(design)["f1"].most == pytest.approx(passed, rel=0.01)


def test_the_time_to_90_percent_is_that_of_the_estimate_where_a_feedback_holds_an_unstable_plant():
    """The observer, sampled by itself, took the held inputs of the feedback as lines, which moved its estimate."""
    plant = obsynth.DescriptorSystem(
        None, [[1.0, 0.0], [0.0, -1.0]], [[0.02], [1.0]], [[1.0, 1.0]], D=[[1.0]], Bf=[[1.0], [0.0]],
        sensor_noise={"y1": 0.01},
    )  # fmt: skip
    design = obsynth.functional_filter(plant)
    observer, row = design.observer, design.observer.fault_rows.start
    joint = np.block([[plant.A, np.zeros((2, observer.order))], [observer.By @ plant.C, observer.Az]])
    shown = np.concatenate([observer.Dy[row] @ plant.C, observer.Cz[row]])
    fault = np.concatenate([plant.Bf[:, 0], np.zeros(observer.order)])

    def missing(t: float) -> float:
        step = scipy.linalg.expm(t * np.block([[joint, fault[:, None]], [np.zeros((1, len(fault) + 1))]]))[:-1, -1]
        return float(shown @ step - 0.9)

    passed = brentq(missing, 0.1, 9.0)
    assert passed <= followed_steps(design)["f1"].most <= 1.01 * passed


@pytest.mark.long
@pytest.mark.parametrize(
    ("A", "fault", "unknown", "decay"),
    [
        # The largest gain is that at rest; it lies between two frequencies of the grid.
        ([[0, 1, 0], [-144, -2.4, 1], [0, 0, -2]], [0, 1, 0], [0, 0, 1], 1.2),
        ([[-1, -3, 2], [2, -4, -5], [1, -3, -3]], [0, 0, 1], [1, 0, 0], 0.0),
    ],
)
def test_the_largest_gain_is_that_of_its_peak(A, fault, unknown, decay):
    plant = obsynth.DescriptorSystem(None, A, C=np.eye(3)[:2], Bf=np.c_[fault], Bd=np.c_[unknown])
    design = obsynth.pd_observer(plant, decay=decay)
    observer, row = design.observer, design.observer.fault_rows
    gains = []
    for point in 1j * np.geomspace(1e-4, 1e3, 20001):
        seen = plant.C @ np.linalg.solve(point * np.eye(3) - plant.A, plant.Bd)
        moved = np.linalg.solve(point * np.eye(observer.order) - observer.Az, observer.By @ seen)
        gains.append(abs((observer.Cz[row] @ moved + observer.Dy[row] @ seen).item()))
    assert fault_gains(design).disturbance_gains.item() == pytest.approx(max(gains), rel=2e-5)


@pytest.mark.long
def test_a_summary_says_where_nothing_is_proved_of_constant_faults() -> None:
    """Linear methods prove it; of recursive ones, those over a region and faults that are never constant it is open."""
    told = ("unproved", "that the estimate of a constant fault equals it in the end")
    plant = obsynth.DescriptorSystem(A=[[0.5]], C=[[1.0], [1.0]], Bf=[[1.0]], dt=1.0)
    assert told not in summary(obsynth.functional_filter(plant)).facts
    assert told in summary(obsynth.adaptive_observer(plant)).facts
    waves = obsynth.ui_pi_observer(plant, fault_model={"sinusoid": 0.7})
    assert told in summary(waves).facts
    region = obsynth.PolytopicSystem(
        plant={"A": [["a"]], "C": [[1.0], [1.0]], "Bf": [[1.0]], "dt": 1.0}, scheduling={"a": [0.2, 0.6]}
    )
    assert told in summary(obsynth.ui_pi_observer(region)).facts
    assert told not in summary(obsynth.descriptor_kalman(plant)).facts


@pytest.mark.parametrize("sampled", [False, True])
def test_what_accounts_for_tolerances_is_what_run_does(sampled: bool) -> None:
    """Of a continuous design with known inputs ``run --monitor pointwise`` takes the exact model."""
    matrices = {"A": [["-R", 0.1], [0.0, -1.0]], "B": [[1.0], [0.0]], "C": np.eye(2), "Bf": [[1.0], [0.0]], "dt": 0}
    plant = obsynth.uncertain_system(matrices, {"R": {"nominal": 2.0, "tolerance": "3 %"}})
    design = obsynth.ui_pi_observer(obsynth.discretise(plant, 0.1) if sampled else plant)
    words = " ".join(str(design).split())
    assert ("only --monitor pointwise accounts for tolerances" in words) == sampled
    assert ("only --monitor pointwise of a sampled plant (transform: sample_time) accounts" in words) != sampled
    assert (own_tolerances(design, "pointwise") is not None) == sampled
