"""What thresholds promise, in sentences that list what they rest on with its numbers, and are the same everywhere."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.linalg import expm

import obsynth
from obsynth.cli.main import main
from obsynth.monitoring.statement_lines import statement_lines
from obsynth.plants.constants import constants_box, shown
from obsynth.report.designs import promises
from obsynth.report.headline import headline
from obsynth.report.summary import summary
from obsynth.studies.least_thresholds import in_words
from obsynth.verification.assumptions import Assumptions

DESIGNS = Path(__file__).parents[2] / "designs"

#: An auditor signs no more words than this.
MOST_WORDS = 75


@pytest.fixture(scope="module")
def design() -> obsynth.ObserverDesign:
    plant = obsynth.uncertain_system(
        {
            "E": None, "A": [["0.8 * p", 0.1], [0.0, 0.5]], "B": [[1.0], [0.5]], "C": [[1.0, 0.0], [0.0, 1.0]],
            "Bf": [[1.0], [0.0]], "Bd": [[0.0], [1.0]], "Dw": [[0.01, 0.0], [0.0, 0.02]],
            "dt": 0.1, "units": {"d1": "N m", "y1": "rad"},
        },
        {"p": {"nominal": 1.0, "tolerance": "2 %"}},
    )  # fmt: skip
    return obsynth.fault_estimation_filter(plant)


BOUNDS: dict[str, Any] = {"disturbance_bounds": {"d1": 0.25}, "noise_bound": 3.5}


def test_bounds_of_an_exact_model(design: obsynth.ObserverDesign) -> None:
    told = obsynth.online_monitor(design, initial_error=0.125, **BOUNDS).statement
    for words in ("d1 within 0.25 N m", "3.5 standard deviations (0.035 rad at y1, 0.07 at y2)", "start within 0.125",
                  "never passed without a fault", "assumes an exact model"):  # fmt: skip
        assert words in told
    assert len(told.split()) <= MOST_WORDS
    other = obsynth.online_monitor(design, initial_error=0.125, **{**BOUNDS, "disturbance_bounds": {"d1": 0.001}})
    assert "d1 within 0.001 N m" in other.statement
    window = obsynth.online_monitor(design, "window", window=7, **BOUNDS).statement
    assert "l2 norm of 7 samples" in window
    assert "d1 within 0.25 N m" in window


def test_box_and_start_of_a_threshold_over_tolerances(design: obsynth.ObserverDesign) -> None:
    told = obsynth.online_monitor(design, initial_set={"x1": 0.5, "x2": [0.25, 0.75]}, **BOUNDS).statement
    for words in ("d1 within 0.25 N m", "3.5 standard deviations", "a start with x1 within 0.5, x2 in 0.25 .. 0.75",
                  "constants (p within 2 % of nominal; the same at all times)", "from the first row on"):  # fmt: skip
        assert words in told
    assert len(told.split()) <= MOST_WORDS
    wider = obsynth.online_monitor(design, constants={"p": "3 %"}, **BOUNDS).statement
    assert "p within 3 % of nominal" in wider
    assert "once the initial-condition response has settled" in wider


def test_probabilities_window_and_change_are_told(design: obsynth.ObserverDesign) -> None:
    scenario = obsynth.Scenario(horizon=8.0, noise=1.0)
    square = obsynth.monitor(design, scenario, "chi-square", window=9, false_alarms=0.003).statement
    assert "9 samples" in square
    assert "probability of 0.003 at most" in square
    total = obsynth.monitor(design, scenario, "cusum", false_alarms=0.02, change=1.5).statement
    assert "change of 1.5 deviations" in total
    assert "probability of 0.02 at most" in total


def test_a_record_tells_its_start_and_its_bounds(design: obsynth.ObserverDesign) -> None:
    scenario = obsynth.Scenario(
        horizon=4.0, noise=1.0, disturbances={"d1": obsynth.Step(size=0.4)}, initial_state={"x1": 0.3}
    )
    told = obsynth.monitor(design, scenario, noise_bound=4.0, constants=design.plant.uncertainty).statement
    assert "d1 within 0.4 N m" in told
    assert "x1 at 0.3, x2 at 0" in told
    exact = obsynth.monitor(design, scenario, noise_bound=4.0, initial_error=0.0).statement
    assert "start of zero" in exact


def test_run_and_picture_say_the_same(design: obsynth.ObserverDesign) -> None:
    watched = obsynth.online_monitor(design, initial_error=0.0, **BOUNDS)
    names = [*design.plant.input_names, *design.plant.output_names]
    data = pd.DataFrame(np.zeros((30, len(names))), columns=names).assign(time=0.1 * np.arange(30))
    run = obsynth.run_on_data(design, data, monitor=watched)
    assert run.statement == watched.statement
    axes = obsynth.plotting.plot_data(run, design=design)
    drawn = " ".join(axes[-1].texts[-1].get_text().split())
    assert drawn == f"Constant inputs: u1 0. The threshold: {watched.statement}."
    assert obsynth.run_on_data(design, data).statement == ""


def test_a_statement_of_many_clauses_is_a_list() -> None:
    assert statement_lines("The threshold: ", "never passed; held inputs") == [
        "The threshold: never passed; held inputs."
    ]
    clauses = "alarms 1.5 rows apart count as one; as stated. Too few rows (9; 20 needed)"
    assert statement_lines("", f"learned from 9 rows: one alarm per 7 rows; {clauses}") == [
        "learned from 9 rows: one alarm per 7 rows.",
        "  - alarms 1.5 rows apart count as one",
        "  - as stated",
        "  - Too few rows (9; 20 needed)",
    ]


def test_a_box_is_told_in_per_cent_or_by_its_ends() -> None:
    assert constants_box({"a": {"nominal": 2.0, "tolerance": "5 %"}}).phrase == (
        "constants (a within 5 % of nominal; the same at all times)"
    )
    mixed = constants_box({"a": {"nominal": 2.0, "tolerance": "5 %"}, "b": {"range": [-0.5, 0.5], "unit": "m"}})
    assert mixed.phrase == "constants (a in 1.9 .. 2.1, b in -0.5 .. 0.5 m; the same at all times)"
    around_zero = constants_box({"b": {"range": [-0.5, 0.5]}}, variation="varying")
    assert around_zero.phrase == "constants (b in -0.5 .. 0.5; they may change from sample to sample)"
    off = constants_box({"a": {"nominal": 2.0, "range": [1.9, 2.2]}})
    assert off.phrase == "constants (a in 1.9 .. 2.2; the same at all times)"
    # Six digits, rounded into the range: what holds for the box holds for what the text says.
    calibrated = constants_box({"a": {"nominal": 2.1, "range": [2.087847870048583, 2.1118556243976663]}})
    assert calibrated.phrase == "constants (a in 2.08785 .. 2.11185; the same at all times)"
    narrow = constants_box({"a": {"nominal": 2.00000001, "range": [2.00000001, 2.00000003]}})
    assert narrow.phrase == "constants (a in 2.00000001 .. 2.00000003; the same at all times)"
    many = constants_box({f"c{i}": {"nominal": 1.0, "range": [0.5, 1.0 + i]} for i in range(9)})
    assert many.phrase.startswith("constants (9 constants within their ranges;")
    assert constants_box({"a": 1.0}).phrase == "an exact model"


def test_every_assumption_has_its_part_in_the_digest_and_in_the_words() -> None:
    plant = obsynth.DescriptorSystem(
        None, np.diag([0.5, 0.2]), C=np.eye(2), Bd=np.eye(2), Bw=np.zeros((2, 1)), Dw=np.array([[0.5], [0.0]]), dt=1.0
    )
    asked: dict[str, Any] = {
        "bounds": np.array([0.1, np.inf]),
        "noise_bound": 3.0,
        "initial_set": {"x1": 1.0, "x2": 2.0},
    }
    one = Assumptions(plant, **asked)
    assert one.parts() == [
        "d1 within 0.1",
        "sensor noise within 3 standard deviations (1.5 at y1)",
        "a start with x1 within 1, x2 within 2",
    ]
    assert one.phrase().endswith(", and an exact model")
    others = [
        Assumptions(plant, **{**asked, "bounds": np.array([0.2, np.inf])}),
        Assumptions(plant, **{**asked, "noise_bound": 3.5}),
        Assumptions(plant, **{**asked, "initial_set": {"x1": 1.0, "x2": [2.0, 3.0]}}),
        Assumptions(plant, **{**asked, "initial_set": None, "state_bounds": {"x1": 1.0, "x2": 2.0}}),
    ]
    assert len({one.digest, *(other.digest for other in others)}) == 5
    assert len({one.phrase(), *(other.phrase() for other in others)}) == 5
    driven = plant.replace(Bw=np.ones((2, 1)))
    assert "noise within 3 standard deviations" in Assumptions(driven, **asked).parts()
    root = Assumptions(driven, **asked | {"noise_bound": 2.0 / 3.0 + 1.0}).parts()
    assert "noise within 1.66666 standard deviations" in root
    assert "at y1" not in Assumptions(driven, **asked).phrase()
    assert shown(5.0) == "5"
    assert shown(0.25, "m") == "0.25 m"
    sampled = plant.replace(Dw=np.zeros((2, 0)), Bw=np.zeros((2, 0)), noise_names=None)
    (bound, *_) = Assumptions(sampled, bounds=np.array([11.693517472388132, 1.0]), noise_bound=0.0).parts()
    assert bound.startswith("d1 within 11.6935, ")
    assert shown(1e15) == "1000000000000000.0"


@pytest.mark.long
def test_a_course_that_is_no_sine_moves_an_estimate_further_than_the_page_says_of_sines() -> None:
    # The estimate follows the fault and, beside it, an oscillation that the disturbance drives.
    a, b, d = np.array([[0.5, 0.6, 0.0], [0.0, 0.7, 0.6], [0.0, -0.6, 0.7]]), np.eye(3)[:, :1], np.eye(3)[:, 2:]
    plant = obsynth.DescriptorSystem(
        None, a, C=[[1.0, 0.0, 0.0]], Bf=b, Bd=d, Dw=[[0.1]], dt=1.0, units={"d1": "N", "f1": "W"}
    )
    design = obsynth.optimal_filter(plant)
    (line,) = [text for text in headline(design, None) if "moves the estimate" in text]
    found = re.search(r"a sine of amplitude 1 N in d1 moves the estimate by up to ([\d.]+) W", line)
    assert found is not None, line
    observer = design.linear[1]
    joined = np.block([[a, np.zeros((3, observer.order))], [observer.By @ plant.C, observer.Az]])
    shown = np.hstack([observer.Dy[observer.fault_rows] @ plant.C, observer.Cz[observer.fault_rows]])[0]
    state, response = np.concatenate([d[:, 0], np.zeros(observer.order)]), [0.0]
    for _ in range(2_000):
        response.append(float(shown @ state))
        state = joined @ state
    sines = np.exp(-1j * np.outer(np.linspace(0.0, np.pi, 2_001), np.arange(len(response)))) @ np.array(response)
    assert np.max(np.abs(sines)) == pytest.approx(float(found.group(1)), rel=5e-3)
    assert np.abs(response).sum() > 1.05 * np.max(np.abs(sines))  # what a disturbance of the worst signs reaches


@pytest.mark.parametrize("written", [False, True])
def test_peak_gains_over_tolerances_say_which_disturbances_and_vertices(design: Any, written: bool) -> None:
    if written:
        plant = obsynth.uncertain_system(
            {
                "A": [["-p", 1.0], [0.0, -2.0]],
                "C": [[1.0, 0.0], [0.0, 1.0]],
                "Bf": [[1.0], [0.0]],
                "Bd": [[0.0], [1.0]],
            },
            {"p": {"nominal": 1.0, "tolerance": "2 %"}},
        )
        design = obsynth.fault_estimation_filter(obsynth.discretise(plant, 0.1))
        # The constant acts where the fault acts: no tolerance is too large for the error, until numbers overflow.
        (most,) = [text for label, text in obsynth.robustness(design).facts() if label == "largest tolerances"]
        assert "inf" not in most
    (text,) = [text for label, text in obsynth.robustness(design).facts() if label == "peak gain, fhat[f1]"]
    assert re.fullmatch(
        r"\S+ at the worst of 2 vertices, for disturbances within 1( that are held between samples)?", text
    )
    assert text.endswith("held between samples") == written


def test_the_time_of_the_slowest_mode_is_not_called_that_of_the_response() -> None:
    plant = obsynth.DescriptorSystem(
        None, [[-1.0, 2.0], [0.0, -1.0]], C=[[1.0, 0.0], [0.0, 1.0]], Bf=[[1.0], [0.0]], Bd=[[0.0], [1.0]]
    )
    design = obsynth.ui_pi_observer(plant)
    text, observer = " ".join(str(summary(design)).split()), design.linear[1]
    found = re.search(r"dynamics the slowest mode falls to 2 % in ([\d.]+) s; observer of order", text)
    assert found is not None, text
    slowest = np.max(np.linalg.eigvals(observer.Az).real)
    assert np.exp(slowest * float(found.group(1))) == pytest.approx(0.02, rel=0.2)
    assert "settling time" not in text


def test_the_slowest_mode_does_not_wait_for_the_delay_of_the_estimates() -> None:
    plant = obsynth.DescriptorSystem(
        None, [[0.9, 0.1], [0.0, 0.8]], C=np.eye(2), Bf=[[1.0], [0.0]], dt=1.0, sensor_noise={"y1": 0.1, "y2": 0.1}
    )
    design = obsynth.functional_filter(plant, fault_rate=0.01, delay=10)
    text, observer = " ".join(str(summary(design)).split()), design.linear[1]
    assert observer.fault_delays == (10,)
    (found,) = re.findall(r"the slowest mode falls to 2 % in ([\d.]+) s", text)
    samples = np.log(0.02) / np.log(np.max(np.abs(np.linalg.eigvals(observer.Az))))
    assert samples <= float(found) < max(samples, observer.order) + 1.0


@pytest.mark.parametrize(("claimed", "printed"), [(1.53841, "1.539"), (1.5, "1.5"), (0.300049, "0.3001")])
def test_a_claimed_bound_is_not_rounded_below_itself(claimed: float, printed: str) -> None:
    plant = obsynth.DescriptorSystem(A=[[0.9, 0.1], [0.0, 0.8]], C=np.eye(2), Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0)
    design = obsynth.fault_estimation_filter(plant)
    claims = design.certificate.claims | {"gamma": claimed, "gamma_min": claimed}
    design = design.replace(certificate=obsynth.Certificate(design.certificate.matrices, claims))
    assert f"gamma = {printed}, " in str(summary(design))
    listed = {name: value for name, value, _ in promises(design)}
    assert listed["gamma"] == printed
    assert float(listed["gamma min"]) <= claimed


@pytest.mark.parametrize("between", [0.01, 0.002])
def test_noise_of_a_continuous_design_is_that_of_a_rate_of_readings(between: float) -> None:
    plant = obsynth.DescriptorSystem(
        None, [[-1.0, 2.0], [0.0, -1.0]], C=np.eye(2), Bf=[[1.0], [0.0]], Bd=[[0.0], [1.0]],
        sensor_noise={"y1": 0.1, "y2": 0.2},
    )  # fmt: skip
    design = obsynth.ui_pi_observer(plant, decay=2.0)
    line, stated = (" ".join(headline(design, None, interval=interval)) for interval in (None, between))
    told = r"f1: ([\d.]+) exceeds 5 standard deviations of the noise with a reading of the sensors every "
    found = re.search(told + r"1 s, ([\d.]+) with one every 0.01 s ", line)
    assert found is not None, line
    assert float(found.group(2)) == pytest.approx(0.1 * float(found.group(1)), rel=1e-2)
    own = re.search(told + f"{between:g} s ", stated)
    assert own is not None, stated
    observer, rows = design.linear[1], design.linear[1].fault_rows
    assert not observer.Dy[rows].any()
    n = observer.order
    whole = expm(np.block([[observer.Az, observer.By], [np.zeros((2, n + 2))]]) * between)
    driven = whole[:n, n:] * [0.1, 0.2]
    states, power = np.zeros((n, n)), driven
    for _ in range(round(12.0 / between)):
        states, power = states + power @ power.T, whole[:n, :n] @ power
    deviation = np.sqrt((observer.Cz[rows] @ states @ observer.Cz[rows].T).item())
    assert 5.0 * deviation == pytest.approx(float(found.group(1)) * np.sqrt(between), rel=0.02)
    assert 5.0 * deviation == pytest.approx(float(own.group(1)), rel=0.02)


@pytest.mark.long
def test_runs_that_are_all_alike_are_called_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    spec = DESIGNS / "filasova" / "spec.yaml"
    gains = tmp_path / "gains.json"
    assert main(["design", "--system", str(spec), "--output", str(gains), "--quiet"]) == 0
    words = ["evaluate", "--system", str(spec), "--gains", str(gains), "--quiet", "--monitor", "pointwise"]
    assert main([*words, "--runs", "2"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "All runs are the same" in text
    found = re.search(r"Its threshold \((\S+) at the end of a run\)", text)
    assert found is not None
    # Rounding of residuals from numbers of size one is more than that.
    assert float(found.group(1)) > np.finfo(float).eps


def test_what_cannot_be_estimated_has_no_delay() -> None:
    plant = obsynth.load_spec(DESIGNS / "drive" / "guaranteed_test.yaml").plant
    diagnosis = obsynth.diagnose(plant)
    (row,) = diagnosis.verdict_rows()[1:]
    assert row[3:6] == ("no", "no", "-")
    assert not any("the estimate needs" in sentence for sentence in diagnosis.sentences)


def test_a_bound_below_the_least_of_tests_is_not_called_a_part_of_an_optimum() -> None:
    """Tests use a window; an observer with a longer memory may do better."""
    longer = in_words("f1", 0.6, 0.75, "W", samples=32)
    assert "less than any test with its delay on at most 32 samples of inputs and outputs has (0.75 W)" in longer
    assert "times" not in longer
    assert "2.00 times the optimum of all tests" in in_words("f1", 1.5, 0.75, "W", samples=32)


@pytest.mark.parametrize("width", [80, 74, 70])
def test_the_table_of_faults_keeps_names_on_one_line_where_all_columns_fit(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], width: int
) -> None:
    """In 80 columns 'tm GENROU 1' stood on two lines; kept at any width it would cut off the last column."""
    monkeypatch.setenv("COLUMNS", str(width))
    assert main(["check", "--system", str(DESIGNS / "kundur" / "spec.yaml")]) == 0
    lines = [line.rstrip() for line in capsys.readouterr().out.splitlines()]
    assert len([line for line in lines if line.endswith(" 39")]) == 4
    assert any(line.startswith("tm GENROU 1  ") for line in lines) == (width == 80)


def test_cases_of_a_sweep_are_numbered_by_whole_numbers() -> None:
    """A claim of one case of two was drawn at 1.00 between 0.96 and 1.04, without a place for the other."""
    specs = [str(DESIGNS / name / "spec.yaml") for name in ("threetank", "filasova")]
    axes = obsynth.sweep(specs).plot("index").axes[0]
    assert axes.get_xlim() == (0.5, 2.5)
    assert [tick for tick in axes.get_xticks() if 0.5 <= tick <= 2.5] == [1.0, 2.0]
