"""Bad input for the PD observer: the right error, exit code and message, and no file; large gains are a warning."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest

from obsynth.cli.main import main

A = [[1.380, -0.208, 6.715, -5.676], [-0.581, -4.290, 0, 0.675], [1.067, 4.273, -6.654, 5.893],
     [0.048, 4.273, 1.343, -2.104]]  # fmt: skip
F = [[0, 0], [5.679, 0], [1.136, -3.146], [1.136, 0]]
BASE: dict[str, Any] = {
    "schema_version": 1,
    "name": "case",
    "plant": {"dt": 0, "A": A, "B": F, "C": [[4, 0, 1, 0], [0, 0, 0, 1]], "Bf": F},
    "method": {"id": "pd-observer", "options": {}},
}
#: A mode at +1 that no output shows; one at -0.5; a pair at -0.4 +- 2j; a fault with a zero at the origin.
HIDDEN_UNSTABLE = {"dt": 0, "A": [[-1, 0], [0, 1]], "C": [[1, 0]], "Bf": [[1], [0]]}
HIDDEN_STABLE = {"dt": 0, "A": [[1, 0], [0, -0.5]], "C": [[1, 0]], "Bf": [[1], [0]]}
HIDDEN_PAIR = {"dt": 0, "A": [[1, 0, 0], [0, -0.4, 2], [0, -2, -0.4]], "C": [[1, 0, 0]], "Bf": [[1], [0], [0]]}
ZERO = {"dt": 0, "A": [[0, 1], [-1, -1]], "C": [[0, 1]], "Bf": [[0], [1]], "fault_names": ["valve"]}
INDEX_2 = {"dt": 0, "E": [[0, 1], [0, 0]], "A": [[1, 0], [0, 1]], "C": [[1, 0]], "Bf": [[0], [1]]}
NOT_REGULAR = {"dt": 0, "E": [[1, 0], [0, 0]], "A": [[1, 0], [0, 0]], "C": [[1, 0]], "Bf": [[1], [0]]}
ALGEBRAIC = {"dt": 0, "E": [[0]], "A": [[1]], "C": [[1]], "Bf": [[1]]}

#: What is changed -> (plant or None, options, exit code, what the message must say).
CASES: dict[str, tuple[dict[str, Any] | None, dict[str, Any], int, tuple[str, ...]]] = {
    # Malformed: 2.
    "delta zero": (None, {"delta": 0.0}, 2, ("method.options.delta",)),
    "delta negative": (None, {"delta": -0.1}, 2, ("method.options.delta",)),
    "delta a text": (None, {"delta": "0.1"}, 2, ("method.options.delta",)),
    "theorem 3": (None, {"theorem": 3}, 2, ("method.options.theorem",)),
    "decay negative": (None, {"decay": -1.0}, 2, ("method.options.decay",)),
    "gain bound zero": (None, {"gain_bound": 0.0}, 2, ("method.options.gain_bound",)),
    "noise gain negative": (None, {"noise_gain": -1.0}, 2, ("method.options.noise_gain",)),
    "rate gain zero": (None, {"fault_rate_gain": 0.0}, 2, ("method.options.fault_rate_gain",)),
    "disk of one number": (None, {"disk": [1.0]}, 2, ("method.options.disk",)),
    "disk right of the axis": (None, {"disk": [-5.0, 4.0]}, 2, ("disk",)),
    "disk of negative radius": (None, {"disk": [5.0, -4.0]}, 2, ("disk",)),
    "range upside down": (None, {"adaptation_range": [12.0, 1.0]}, 2, ("adaptation_range",)),
    "range from zero": (None, {"adaptation_range": [0.0, 1.0]}, 2, ("adaptation_range",)),
    "range and disk": (None, {"adaptation_range": [1.0, 2.0], "disk": [5.0, 4.5]}, 2, ("cannot be combined", "disk")),
    "singular G": (None, {"adaptation_gain": [[1, 1], [1, 1]]}, 2, ("adaptation_gain", "nonsingular")),
    "G of the wrong shape": (None, {"adaptation_gain": [[1, 0, 0]]}, 2, ("adaptation_gain", "1 by 3")),
    "unknown option": (None, {"detla": 0.1}, 2, ("method.options.detla", "delta")),
    "unknown solver": (None, {"solver": "MOSEK"}, 2, ("method.options.solver",)),
    # Existence conditions: 3.
    "discrete plant": ({**BASE["plant"], "dt": 0.1}, {}, 3, ("continuous time", "sample_observer")),
    "no faults": ({**BASE["plant"], "Bf": None}, {}, 3, ("'faults'",)),
    "more faults than outputs": ({**BASE["plant"], "C": [[4, 0, 1, 0]]}, {}, 3, ("nf <= ny", "2 faults and 1 output")),
    "F not of full column rank": (
        {**BASE["plant"], "Bf": [[0, 0], [1, 2], [1, 2], [0, 0]], "fault_names": ["a", "b"]}, {}, 3,
        ("rank F", "'a'", "'b'")),
    "a fault that acts nowhere": (
        {**BASE["plant"], "Bf": [[0, 0], [1, 0], [1, 0], [0, 0]], "fault_names": ["a", "b"]}, {}, 3, ("rank F", "'b'")),
    "an unobservable unstable mode": (HIDDEN_UNSTABLE, {}, 3, ("detectability", "s = 1", "'x2'")),
    "a zero at s = 0": (ZERO, {}, 3, ("rank [A F; C Df]", "s = 0", "'valve'")),
    "index 2": (INDEX_2, {}, 3, ("index 2", "the output 'y1' needs the derivative of 'f1'")),
    "not regular": (NOT_REGULAR, {}, 3, ("regularity",)),
    "algebraic alone": (ALGEBRAIC, {}, 3, ("dynamic states",)),
    # Proved impossible: 4.
    "decay faster than a hidden mode": (HIDDEN_STABLE, {"decay": 0.6}, 4, ("-0.5", "0.6")),
    "disk beside a hidden mode": (HIDDEN_STABLE, {"disk": [10.0, 9.0]}, 4, ("-0.5",)),
    "too large a delta for Theorem 2": (HIDDEN_PAIR, {"theorem": 2, "delta": 0.5, "decay": 0}, 4, ("delta <", "0.4")),
    "less noise than steady state has": (None, {"noise_gain": 0.01}, 4, ("steady state", "noise_gain")),
    "a delta that does not suit the disk": (None, {"disk": [5.0, 4.0], "delta": 20.0}, 4, ("-1/delta",)),
    # Nothing is known: 5.
    "gains far too small": (None, {"gain_bound": 0.001}, 5, ("gain_bound", "inconclusive")),
}  # fmt: skip


def written(folder: Path, plant: dict[str, Any] | None, options: dict[str, Any]) -> Path:
    document = copy.deepcopy(BASE)
    if plant is not None:
        document["plant"] = {key: value for key, value in plant.items() if value is not None}
    document["method"]["options"] = options
    path = folder / "spec.yaml"
    path.write_text(json.dumps(document), encoding="utf-8")
    return path


@pytest.mark.one_in(4)
@pytest.mark.parametrize("case", CASES)
def test_bad_input(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    plant, options, code, fragments = CASES[case]
    monkeypatch.chdir(tmp_path)
    assert main(["design", "--system", str(written(tmp_path, plant, options)), "--quiet"]) == code
    captured = capsys.readouterr()
    for fragment in fragments:
        assert fragment in captured.err
    assert captured.out == ""
    assert [path.name for path in tmp_path.iterdir()] == ["spec.yaml"]


def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, plant: dict[str, Any] | None, options: dict[str, Any]) -> int:
    monkeypatch.chdir(tmp_path)
    return main(["design", "--system", str(written(tmp_path, plant, options)), "--quiet", "--json"])


def test_the_base_is_good(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:  # fmt: skip
    assert run(tmp_path, monkeypatch, None, {}) == 0
    assert main(["verify", "case.gains.json"]) == 0
    assert main(["check", "--system", "spec.yaml"]) == 0
    assert "pd-observer: all conditions hold" in capsys.readouterr().out


@pytest.mark.one_in(2)
@pytest.mark.parametrize("plant", [HIDDEN_STABLE, HIDDEN_PAIR], ids=["real", "pair"])
def test_a_hidden_mode_that_decays_is_no_obstacle(
    plant: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for theorem in (1, 2):
        assert run(tmp_path, monkeypatch, plant, {"theorem": theorem}) == 0
    assert capsys.readouterr().err == ""


def test_gains_that_explode_are_a_warning_in_the_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(tmp_path, monkeypatch, None, {"decay": 60.0}) == 0
    rows = json.loads(capsys.readouterr().out)["gain_set"]["design"]["report"]["checks"]
    (gain,) = [row for row in rows if row["name"] == "gain"]
    assert gain["value"] > 1e3
    assert gain["kind"] == "information"
    assert "WARNING" in gain["detail"]
