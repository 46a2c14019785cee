"""Proof files: the program of one file accepts what they prove, and refuses what is changed."""

from __future__ import annotations

import ast
import copy
import json
import subprocess
import sys
import tomllib
from fractions import Fraction
from functools import cache
from itertools import chain
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pandas as pd
import pytest
from benchmarks.campaigns._changed_proofs import as_array, as_data, changes, checker

import obsynth
from obsynth.cli.main import main
from obsynth.exporting.independent import (
    alarm_proof_of,
    check_alarm_independently,
    check_design_independently,
    check_independently,
    checker_path,
)
from obsynth.exporting.proof_file import proof_bytes, proof_of, write_proof
from obsynth.methods.registry import REGISTRY

ROOT = Path(__file__).parents[2]
CHECKER = ROOT / "checker/check_proof.py"
A = np.array([[0.9, 0.1, 0.0], [-0.2, 0.7, 0.1], [0.0, 0.3, 0.6]])
SAMPLED = obsynth.DescriptorSystem(
    None, A, [[0.0], [1.0], [0.0]], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], Bf=[[0.0], [1.0], [0.0]],
    Bd=[[0.1], [0.0], [0.2]], dt=0.1,
)  # fmt: skip
SMALL = SAMPLED.replace(Bd=None, Dd=None, disturbance_names=None)
SMOOTH = SMALL.replace(A=A - 2.0 * np.eye(3), dt=0.0)
NOISY = SMOOTH.replace(Bd=[[0.3], [0.0], [0.1]], Dd=np.zeros((2, 1)), Bw=np.zeros((3, 2)), Dw=0.3 * np.eye(2))
#: Every output has noise of its own, so that no filter's gain is zero.
LOUD = SAMPLED.replace(Bw=np.zeros((3, 2)), Dw=0.3 * np.eye(2), noise_names=None)
TEST = {"noise_bound": {"y1": 0.1, "y2": 0.1}, "disturbance_bounds": {"d1": 0.05}, "course": "constant", "samples": 8}
#: What the file of each method proves.
CLAIMS: dict[str, tuple[obsynth.DescriptorSystem, dict[str, Any], set[str]]] = {
    "fault-estimation-filter": (SAMPLED, {}, {"identities", "stable", "rounding", "faults", "gain"}),
    "pd-observer": (SMOOTH, {"fault_rate_gain": True}, {"identities", "stable", "rounding"}),
    "ui-pi-observer": (SMALL, {}, {"identities", "stable", "rounding"}),
    "functional-filter": (
        SMALL.replace(Bw=0.1 * np.eye(3, 5), Dw=0.2 * np.eye(2, 5, 3), noise_names=None), {},
        {"identities", "stable", "rounding", "fault models", "deviation"},
    ),
    "detection-filter": (NOISY, {}, {"identities", "stable", "rounding", "gain"}),
    "optimal-filter": (LOUD, {}, {"identities", "stable", "rounding", "faults", "gain", "deviation"}),
    "guaranteed-test": (SAMPLED, TEST, {"threshold", "least"}),
}  # fmt: skip
EACH = pytest.mark.parametrize("method", CLAIMS)


@cache
def design_of(method: str) -> obsynth.ObserverDesign:
    plant, options, _ = CLAIMS[method]
    if method == "pd-observer":
        options = {}
    return obsynth.design(plant, method, **options)


@cache
def proof_text(method: str) -> bytes:
    return proof_bytes(proof_of(design_of(method)))


def proof(method: str) -> dict[str, Any]:
    return json.loads(proof_text(method))


@cache
def program() -> ModuleType:
    return checker()


def refused(file: Any) -> str:
    """Return why a file is not accepted; empty where it is."""
    module = program()
    try:
        verdicts, _ = module.check(file)
    except (module.Refused, *module.UNREADABLE) as error:
        return str(error) or type(error).__name__
    return "; ".join(text for _, proved, text in verdicts if not proved)


def run(path: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-I", str(CHECKER), str(path)], capture_output=True, text=True, check=False)


@EACH
def test_every_linear_method_is_proved_by_a_process_of_its_own(method: str, tmp_path: Path) -> None:
    place = tmp_path / "proof.json"
    write_proof(design_of(method), place)
    found = run(place)
    assert found.returncode == 0, found.stdout
    proved = {
        line.removeprefix("PROVED  ").partition(":")[0] for line in found.stdout.splitlines() if "PROVED  " in line
    }
    assert proved == CLAIMS[method][2]
    assert not found.stderr


@EACH
def test_every_change_is_refused(method: str) -> None:
    whole = proof(method)
    assert not refused(whole)
    accepted = []
    for name, change in changes(whole):
        changed = copy.deepcopy(whole)
        change(changed)
        assert changed != whole, name
        if not refused(changed):
            accepted.append(name)
    assert not accepted


@EACH
def test_a_file_of_integers_alone(method: str) -> None:
    def numbers(value: Any) -> list[Any]:
        if isinstance(value, dict):
            return [entry for part in value.values() for entry in numbers(part)]
        if isinstance(value, list):
            return [entry for part in value for entry in numbers(part)]
        return [] if isinstance(value, (str, bool)) or value is None else [value]

    assert {type(value) for value in numbers(proof(method))} == {int}


def test_the_page_says_what_each_file_proves_and_leaves() -> None:
    page = (ROOT / "docs/what_verified_means.md").read_text(encoding="utf-8")
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in page.splitlines() if line[:3] == "| `"]
    table = {cells[0].strip("`"): cells[1:] for cells in lines if len(cells) == 3}
    assert {method for method in table if "," not in method} == set(CLAIMS)
    for method in CLAIMS:
        file = proof(method)
        assert table[method][0].split(", ") == [claim["claim"] for claim in file["claims"]]
        assert table[method][1].split("; ") == file["not_covered"]
    (others,) = (cells[0] for cells in lines if cells[-1] == "everything: they have no proof file")
    named = {name.strip("`") for name in others.split(", ")}
    assert named == set(REGISTRY) - set(CLAIMS)


def test_the_gain_of_an_optimal_filter_is_proved_and_no_smaller_one() -> None:
    """From disturbances and noise together, to a billionth: a smaller level than the filter's own norm is refused."""
    design = design_of("optimal-filter")
    stated = {claim["claim"]: claim for claim in proof("optimal-filter")["claims"]}["gain"]
    gamma = float(as_array(stated["gamma"]).item())
    assert design.certificate.claims["gain"] <= gamma <= design.certificate.claims["gain"] * (1.0 + 1e-8)
    assert (stated["signal"], stated["rows"]) == ("disturbances and noise", ["fault"])
    points = np.exp(1j * np.linspace(0.0, np.pi, 401))
    (plant, observer), T = design.linear, design.certificate.matrices["T"]
    T = T[:, : plant.nx]
    b, d = np.hstack([plant.Bd, plant.Bw]), np.hstack([plant.Dd, plant.Dw])
    T0 = -design.certificate.matrices["T0"][:, : plant.nx]
    into, through = T @ b - observer.By @ d, observer.Dy @ d + T0 @ b
    solved = [np.linalg.solve(z * np.eye(observer.order) - observer.Az, into) for z in points]
    norm = max(np.linalg.norm(through - observer.Cz @ each, 2) for each in solved)
    assert norm <= gamma <= norm * (1.0 + 1e-3)
    changed = proof("optimal-filter")
    place = next(i for i, claim in enumerate(changed["claims"]) if claim["claim"] == "gain")
    changed["claims"][place]["gamma"] = as_data(np.array([[0.999 * norm]]))
    assert "positive definite" in refused(changed)


LAG = {"A": [[0.5]], "B": [[1.0]], "C": [[0.3]], "D": [[1.0]]}
NOTHING = {name: np.zeros(shape) for name, shape in (("A", (0, 0)), ("B", (0, 1)), ("C", (1, 0)))}
#: Plants and options of optimal filters with weights or a reference model, and the number of their matching claims.
MATCHING: dict[str, tuple[obsynth.DescriptorSystem, dict[str, Any], int]] = {
    "a weight": (LOUD, {"delay": 1, "weights": {"errors": {"f1": 2.0}}}, 1),
    "models as weights": (LOUD, {"delay": 1, "weights": {"errors": LAG, "inputs": {"d1": LAG, "w1": 3.0}}}, 1),
    "decoupled": (LOUD, {"decoupled": ["d1"], "weights": {"errors": {"f1": 2.0}}}, 1),
    "a share of the fault": (LOUD, {"reference": {**NOTHING, "D": [[0.1]]}, "exact": False}, 1),
    "a reference": (LOUD, {"reference": {"bandwidth": 2.0}, "exact": False}, 1),
    "a reference and weights": (
        LOUD, {"reference": {"bandwidth": 2.0}, "exact": False, "weights": {"errors": LAG, "inputs": {"f1": 0.5}}}, 1,
    ),
    "continuous time": (NOISY, {}, 1),
    "continuous time and weights": (NOISY, {"weights": {"errors": {"f1": 2.0}}}, 2),
    "continuous time and a reference": (NOISY, {"reference": {"bandwidth": 2.0}, "exact": False}, 1),
    "the least mean square": (NOISY, {"norm": "h2", "reference": {"bandwidth": 2.0, "order": 2}}, 1),
}  # fmt: skip


@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", MATCHING)
def test_weights_and_reference_models_of_optimal_filters_are_proved(name: str) -> None:
    plant, options, count = MATCHING[name]
    design = obsynth.optimal_filter(plant, **options)
    file = json.loads(proof_bytes(proof_of(design)))
    assert not refused(file)
    claims = [claim for claim in file["claims"] if claim["claim"] == "matching"]
    assert len(claims) == count
    assert not [text for text in file["not_covered"] if text.startswith(("the gain ", "the fault map"))]
    if "gain" in design.certificate.claims and options:
        gamma = max(float(as_array(claim["gamma"]).item()) for claim in claims)
        assert design.certificate.claims["gain"] <= gamma <= design.certificate.claims["gain"] * (1.0 + 1e-6)
    accepted = []
    for change, make in changes(file):
        changed = copy.deepcopy(file)
        make(changed)
        if not refused(changed):
            accepted.append(change)
    assert not accepted


def test_a_matching_claim_names_what_counts() -> None:
    plant, options, _ = MATCHING["a reference"]
    file = json.loads(proof_bytes(proof_of(obsynth.optimal_filter(plant, **options))))
    place = next(i for i, claim in enumerate(file["claims"]) if claim["claim"] == "matching")
    for change, reason in (
        ({"faults": False}, "reference model"),
        ({"reference": None}, "reference model"),
        ({"disturbances": ["d1", "d1"]}, "twice"),
        ({"disturbances": ["d2"]}, "none of the disturbances"),
        ({"rows": []}, "no such rows"),
        ({"noise": 1}, "true or false"),
        ({"disturbances": []}, "positive definite"),
        ({"input_weight": {name: as_data(np.eye(1)) for name in "ABCD"}}, "do not fit"),
    ):
        changed = copy.deepcopy(file)
        changed["claims"][place].update(change)
        assert "matching" in [name for name, proved, _ in program().check(changed)[0] if not proved], reason
        if reason != "positive definite":
            assert reason in refused(changed)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(6))
def test_gains_of_random_optimal_filters_are_proved(seed: int) -> None:
    """Whether the design has a P or its eigenvalues were enclosed."""
    rng = np.random.default_rng([46, seed])
    n = int(rng.integers(2, 6))
    a = rng.normal(size=(n, n))
    plant = obsynth.DescriptorSystem(
        A=rng.uniform(0.5, 1.2) * a / np.max(np.abs(np.linalg.eigvals(a))), C=rng.normal(size=(3, n)),
        Bf=rng.normal(size=(n, 1)), Bd=rng.normal(size=(n, 1)), Bw=np.hstack([0.3 * np.eye(n), np.zeros((n, 3))]),
        Dw=np.hstack([np.zeros((3, n)), 0.1 * np.eye(3)]), dt=1.0,
    )  # fmt: skip
    design = obsynth.optimal_filter(plant, delay=1, decoupled=["d1"] if seed % 2 else [])
    file = json.loads(proof_bytes(proof_of(design)))
    assert not refused(file)
    assert {"gain", "faults"} <= {claim["claim"] for claim in file["claims"]}, file["not_covered"]


@pytest.mark.parametrize("prior", [0, 1, 3])
def test_equations_before_the_window_are_those_of_the_plant(prior: int) -> None:
    """Whatever the plant does from ``prior`` samples before the window on satisfies every row, and no row is empty."""
    module, file = program(), proof("guaranteed-test")
    (question,) = (claim["window"] for claim in file["claims"] if claim["claim"] == "threshold")
    nothing = as_data(np.zeros((1, 1)))
    bounds = {name: [None if bound is None else nothing for bound in each] for name, each in question["bounds"].items()}
    question |= {"samples": 3, "prior": prior, "equations": prior + 2, "bounds": bounds}
    window, matrices = module.Window(module.System(file), question), (SAMPLED.A, SAMPLED.C)
    a, c = ([[Fraction(value) for value in row] for row in matrix.tolist()] for matrix in matrices)
    x = [Fraction(3), Fraction(-1, 2), Fraction(1, 7)]
    course, seen = [Fraction(0), *x], []
    for k in range(-prior, 3):
        seen += [sum(p * q for p, q in zip(row, x, strict=True)) for row in c] if k >= 0 else []
        x = [sum(p * q for p, q in zip(row, x, strict=True)) for row in a]
        course += x if k < 2 else []
    sums: dict[int, Fraction] = {}
    for row, column, value in window.entries:
        known = course[column] if column < len(course) else 0
        sums[row] = sums.get(row, Fraction(0)) + value * known
    equations = (prior + 2) * len(a)
    assert [sums[row] for row in range(window.row_count)] == [0] * equations + seen


def test_a_test_may_be_proved_with_equations_that_it_does_not_need() -> None:
    """Weights of the oldest samples are compared where the window begins before them, and others are refused."""
    file = proof("guaranteed-test")
    (claim,) = (claim for claim in file["claims"] if claim["claim"] == "threshold")
    claim["window"] |= {"prior": 2, "equations": claim["window"]["equations"] + 2}
    claim["multipliers"]["numerators"] = [0] * 2 * SAMPLED.nx + claim["multipliers"]["numerators"]
    file["claims"] = [claim]
    assert not refused(file)
    # What reaches the row of the oldest sample alone: the last state of a chain of samples.
    By = as_array(file["observer"]["By"])
    oldest = np.flatnonzero(np.abs(By).max(axis=1))
    for row in oldest:
        changed = copy.deepcopy(file)
        changed["observer"]["By"] = as_data(np.where(np.arange(len(By))[:, None] == row, 1.01 * By, By))
        assert "weights" in refused(changed), row


@pytest.mark.parametrize("lag", [0, 1, 2])
def test_the_extended_state_is_the_past_and_the_model(lag: int) -> None:
    """What an observer with a fault model and a lag follows: the plant's equations, shifted states, and the model's."""
    file, n = proof("ui-pi-observer"), SAMPLED.nx
    follows = file["follows"]
    phi, cw = (as_array(follows[name]) for name in ("Phi", "Cw"))
    count, past = len(phi), lag * n
    for name in ("T", "T0"):
        part = as_array(follows[name])
        between = np.zeros((len(part), past))
        follows[name] = as_data(np.hstack([part[:, :n], between, part[:, n:]]))
    follows["lag"] = lag
    file["observer"]["rows"] = [[kind, name, lag * (kind == "state")] for kind, name, _ in file["observer"]["rows"]]
    system = program().System(file)
    found = {name: as_array({"size": [m.rows, m.columns], "exponent": m.exponent, "entries": [*chain(*m.entries)]})
             for name, m in (("Ea", system.Ea), ("Aa", system.Aa), ("Ca", system.Ca))}  # fmt: skip
    a = np.zeros((n + past + count, n + past + count))
    a[:n, :n], a[:n, n + past :], a[n + past :, n + past :] = SMALL.A, SMALL.Bf @ cw, phi
    a[n : n + past, :past] = np.eye(past)
    np.testing.assert_array_equal(found["Aa"], a)
    np.testing.assert_array_equal(found["Ea"], np.eye(len(a)))
    np.testing.assert_array_equal(found["Ca"], np.hstack([SMALL.C, np.zeros((SMALL.ny, past)), SMALL.Df @ cw]))


@pytest.mark.parametrize(
    "options",
    [
        {"course": "ramp"}, {"course": "ramp", "lag": 2}, {"course": "rate", "fault_rate": 0.05},
        {"course": "rate", "fault_rate": 0.05, "lag": 3}, {"course": "step", "before": 3},
        {"course": "any", "lag": 1, "state_bounds": {"x1": 1.0, "x2": 1.0, "x3": 1.0}},
        {"disturbance": "held"}, {"disturbance": "rate", "disturbance_rate": {"d1": 0.01}},
        pytest.param({"norm": "ellipsoid", "samples": 3}, marks=pytest.mark.long),
        {"state_bounds": {"x1": 0.2, "x3": 0.1}},
        {"initial_bounds": {"x1": 0.1, "x2": 0.1, "x3": 0.1}}, {"disturbance_bounds": {"d1": [-0.02, 0.08]}},
        {"Df": [[0.2], [1.0]]}, {"Dd": [[0.0], [0.4]]},
    ],
    ids=str,
)  # fmt: skip
def test_whatever_the_fault_and_the_disturbance_do(options: dict[str, Any]) -> None:
    """The program forms the equations of each question itself: it accepts what is proved, and nothing a little more."""
    plant = SAMPLED.replace(**{name: options[name] for name in ("Df", "Dd") if name in options})
    options = {**TEST, **{name: value for name, value in options.items() if name not in ("Df", "Dd")}}
    file = json.loads(proof_bytes(proof_of(obsynth.design(plant, "guaranteed-test", **options))))
    assert not refused(file)
    claims = {claim["claim"]: claim for claim in file["claims"]}
    assert {"threshold", "least"} >= set(claims) >= {"threshold"}
    for name, share in (("threshold", 0.999), ("least", 1.001)):
        for claim in (claims[name],) if name in claims else ():
            changed = {**claim, name: as_data(share * as_array(claim[name]))}
            assert refused({**file, "claims": [changed]})
    # The same numbers prove nothing of another course of the fault, or of disturbances that may do more.
    window = claims["threshold"]["window"]
    for name, other in (("course", "any"), ("disturbance", "any"), ("lag", window["lag"] + 1)):
        changed = {**claims["threshold"], "window": {**window, name: other}}
        same = window[name] == other or (name == "lag" and window["course"] not in ("ramp", "any"))
        same = same or (name == "disturbance" and window[name] == "jump")
        assert same or refused({**file, "claims": [changed]}), name


def test_numbers_are_printed_on_the_side_that_is_proved() -> None:
    """Upper bounds are rounded upwards and lower ones downwards, to four digits, whatever their size and sign."""
    module, rng = program(), np.random.default_rng(46)
    for _ in range(300):
        value = Fraction(int(rng.integers(1, 2**62)), int(rng.integers(1, 2**62)))
        value *= Fraction(10) ** int(rng.integers(-30, 30)) * int(rng.choice([-1, 1]))
        below, above = Fraction(module.shown(value, down=True)), Fraction(module.shown(value))
        assert below <= value <= above
        assert above - below <= abs(value) / 1000
    assert module.shown(Fraction(0)) == "0"


@pytest.mark.parametrize("value", [True, False, None, 1.5, [1], {}, "x", "0.5", "1g", "-", ""], ids=repr)
def test_what_is_no_integer_is_refused(value: Any) -> None:
    module = program()
    assert (module.read_integer(-7), module.read_integer("-1f")) == (-7, -31)
    with pytest.raises((module.Refused, *module.UNREADABLE)):
        module.read_integer(value)


def test_a_fault_that_rounding_hides_is_no_estimate() -> None:
    """A larger bound is a weaker claim, but not of the fault's own model: there an estimate may miss a thousandth."""
    for size, accepted in ((0.9e-3, True), (1.1e-3, False)):
        file = proof("ui-pi-observer")
        (claim,) = (claim for claim in file["claims"] if claim["claim"] == "rounding")
        bounds = as_array(claim["bounds"]["states"])
        (row,) = (i for i, (kind, _, _) in enumerate(file["observer"]["rows"]) if kind == "fault")
        bounds[row, SMALL.nx] = size
        claim["bounds"]["states"] = as_data(bounds)
        assert (refused(file) == "") == accepted


def test_a_fault_that_is_followed_to_more_than_a_thousandth_is_no_estimate() -> None:
    for size, accepted in ((0.9e-3, True), (1.1e-3, False)):
        file = proof("functional-filter")
        (claim,) = (claim for claim in file["claims"] if claim["claim"] == "fault models")
        bounds = as_array(claim["bounds"])
        (row,) = (i for i, (kind, _, _) in enumerate(file["observer"]["rows"]) if kind == "fault")
        bounds[row] = size * np.abs(as_array(claim["Cw"])[0])
        claim["bounds"] = as_data(bounds)
        assert (refused(file) == "") == accepted


def test_noise_of_a_sample_in_an_ellipsoid_does_no_more_than_in_its_box() -> None:
    """What is proved for the box is proved for the ellipsoid inside, of one signal with nothing to spare."""
    file = proof("guaranteed-test")
    (claim,) = (claim for claim in file["claims"] if claim["claim"] == "threshold")
    claim["window"]["norm"] = "ellipsoid"
    assert not refused({**file, "claims": [claim]})
    claim["threshold"] = as_data(0.5 * as_array(claim["threshold"]))
    assert refused({**file, "claims": [claim]})


def test_a_call_without_a_file_says_how_it_is_called() -> None:
    found = subprocess.run([sys.executable, "-I", str(CHECKER)], capture_output=True, text=True, check=False)
    assert (found.returncode, found.stdout) == (2, "")
    assert "usage" in found.stderr


def test_the_program_imports_nothing_but_the_standard_library() -> None:
    tree = ast.parse(CHECKER.read_text(encoding="utf-8"))
    imported = {
        name.name.split(".")[0] for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names
    }
    imported |= {str(node.module).split(".")[0] for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert imported <= {"json", "sys", "fractions", "math"}
    floats = [node for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, float)]
    assert not floats, "nothing is decided by a floating-point number"


def test_floating_point_is_for_printing_alone() -> None:
    tree = ast.parse(CHECKER.read_text(encoding="utf-8"))
    for function in (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)):
        called = {
            node.func.id
            for node in ast.walk(function)
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
        }
        assert "float" not in called or function.name == "shown", function.name


def test_the_gain_of_the_paper_is_proved_and_one_below_the_norm_is_not() -> None:
    plant = obsynth.load_spec(ROOT / "designs/wang2015/spec.yaml").plant
    design = obsynth.fault_estimation_filter(plant)
    whole = json.loads(proof_bytes(proof_of(design)))
    gain = next(claim for claim in whole["claims"] if claim["claim"] == "gain")
    assert as_array(gain["gamma"])[0, 0] == pytest.approx(design.certificate.claims["gamma"], rel=1e-8)
    assert not refused(whole)
    for claim in whole["claims"]:
        if claim["claim"] == "gain":
            claim["gamma"] = as_data([[0.9999 * as_array(claim["gamma"])[0, 0]]])
    assert "bounded real" in refused(whole)


def test_no_witness_is_found_for_a_gain_below_the_norm() -> None:
    design = obsynth.fault_estimation_filter(obsynth.load_spec(ROOT / "designs/wang2015/spec.yaml").plant)
    certificate = design.certificate
    claims = {**certificate.claims, "gamma": 0.9999 * certificate.claims["gamma"]}
    false = design.replace(certificate=obsynth.Certificate(certificate.matrices, claims))
    found = proof_of(false)
    assert "gain" not in {claim["claim"] for claim in found["claims"]}
    assert any("l2 gain" in text for text in found["not_covered"])


@pytest.mark.parametrize("decay", [0.99, 1.01])
def test_the_decay_is_that_of_the_slowest_pole(decay: float) -> None:
    file = proof("ui-pi-observer")
    claim = next(claim for claim in file["claims"] if claim["claim"] == "stable")
    rate, slowest = as_array(claim["rate"])[0, 0], np.abs(np.linalg.eigvals(as_array(file["observer"]["Az"]))).max()
    assert slowest < rate < 1.0
    claim["rate"] = as_data([[slowest**decay if decay > 1.0 else rate]])
    assert bool(refused(file)) == (decay > 1.0)


def test_deviations_are_those_of_the_covariance() -> None:
    file = proof("functional-filter")
    claim = next(claim for claim in file["claims"] if claim["claim"] == "deviation")
    observer, plant = design_of("functional-filter").linear[1], CLAIMS["functional-filter"][0]
    t = design_of("functional-filter").certificate.matrices["T"]
    b = t @ plant.Bw - observer.By @ plant.Dw
    x = np.zeros((observer.order, observer.order))
    for _ in range(4000):
        x = observer.Az @ x @ observer.Az.T + b @ b.T
    rows = observer.fault_rows
    through = observer.Dy[rows] @ plant.Dw - design_of("functional-filter").certificate.matrices["T0"][rows] @ plant.Bw
    deviation = np.sqrt(np.diag(observer.Cz[rows] @ x @ observer.Cz[rows].T + through @ through.T))
    assert as_array(claim["deviations"]).ravel() == pytest.approx(deviation, rel=1e-5)
    assert np.all(as_array(claim["deviations"]).ravel() >= deviation * (1.0 - 1e-9))


HOSTILE = {
    "an exponent that would fill the memory": lambda file: file["plant"]["A"].update(exponent=10**9),
    "a matrix of another size": lambda file: file["plant"]["A"].update(size=[2, 3]),
    "a float": lambda file: file["plant"]["A"]["entries"].__setitem__(0, 0.5),
    "a truth value": lambda file: file["plant"]["A"]["entries"].__setitem__(0, True),
    "words": lambda file: file["plant"]["A"]["entries"].__setitem__(0, "one"),
    "underscores": lambda file: file["plant"]["A"]["entries"].__setitem__(0, "1_0"),
    "a size below zero": lambda file: file["plant"]["A"].update(size=[-1, -9]),
    "no observer": lambda file: file.pop("observer"),
    "claims that are no list": lambda file: file.update(claims=7),
    "a claim that is no mapping": lambda file: file.update(claims=["gain"]),
    "a sample time below zero": lambda file: file["plant"].update(sample_time=as_data([[-0.1]])),
    "a row of an unknown kind": lambda file: file["observer"]["rows"][0].__setitem__(0, "wish"),
    "a lag without samples": lambda file: file["follows"].update(lag=-1),
    "an infinite share": lambda file: file["claims"][0].update(share=as_data([[1.0]])),
    "no contraction": lambda file: file.update(contraction=None),
}


@pytest.mark.one_in(6)
@pytest.mark.parametrize("hostile", HOSTILE)
def test_what_is_no_proof_file_is_refused_in_one_line(hostile: str, tmp_path: Path) -> None:
    file = proof("fault-estimation-filter")
    HOSTILE[hostile](file)
    place = tmp_path / "proof.json"
    place.write_text(json.dumps(file), encoding="utf-8")
    found = run(place)
    assert found.returncode in (1, 2)
    assert "Traceback" not in found.stderr


@pytest.mark.one_in(6)
@pytest.mark.parametrize("text", ["", "[]", "null", "{", '{"format": "obsynth-proof"}', "[" * 100_000])
def test_files_of_other_kinds_are_refused(text: str, tmp_path: Path) -> None:
    place = tmp_path / "proof.json"
    place.write_text(text, encoding="utf-8")
    found = run(place)
    assert found.returncode == 2
    assert len(found.stderr.splitlines()) == 1, found.stderr


def test_methods_with_varying_gains_are_refused_by_name() -> None:
    plant = obsynth.DescriptorSystem(None, [[1.1, 0.1], [0.0, 0.9]], [[0.0], [1.0]], np.eye(2), dt=0.1)
    design = obsynth.design(plant, "descriptor-kalman", Q=0.01, R=0.01)
    with pytest.raises(obsynth.SpecError, match="gains that change with k"):
        proof_of(design)


def test_export_writes_the_proof_and_the_program_beside_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    gains, place = tmp_path / "gains.json", tmp_path / "out/proof.json"
    design_of("fault-estimation-filter").save(gains)
    place.parent.mkdir()
    assert main(["export", "--gains", str(gains), "--to", str(place), "--checker"]) == 0
    copied = place.with_name("check_proof.py")
    assert copied.read_bytes() == CHECKER.read_bytes()
    assert (
        subprocess.run([sys.executable, "-I", str(copied), str(place)], capture_output=True, check=False).returncode
        == 0
    )
    # A proof file is replaced, a file of another kind is not.
    assert main(["export", "--gains", str(gains), "--to", str(place)]) == 0
    other = tmp_path / "other.json"
    other.write_text("{}", encoding="utf-8")
    assert main(["export", "--gains", str(gains), "--to", str(other)]) == obsynth.SpecError.exit_code
    assert "other.json" in capsys.readouterr().err


@pytest.mark.parametrize("options", [["--sample-time", "0.1"], ["--precision", "float"], ["--unverified"]])
def test_options_that_do_nothing_for_a_proof_are_refused(options: list[str], tmp_path: Path) -> None:
    gains = tmp_path / "gains.json"
    design_of("fault-estimation-filter").save(gains)
    command = ["export", "--gains", str(gains), "--to", str(tmp_path / "proof.json"), *options]
    assert main(command) == obsynth.SpecError.exit_code
    with pytest.raises(obsynth.SpecError, match="checker"):
        obsynth.export(design_of("fault-estimation-filter"), tmp_path / "gains.mat", checker=True)


def test_verify_independent(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    gains, place = tmp_path / "gains.json", tmp_path / "proof.json"
    design = design_of("ui-pi-observer")
    design.save(gains)
    write_proof(design, place)
    for file in (gains, place):
        assert main(["verify", str(file), "--independent"]) == 0
        assert "All 3 claims are proved" in capsys.readouterr().out
    assert main(["verify", str(gains), "--independent", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["passed"] is True
    false = proof("ui-pi-observer")
    claim = next(claim for claim in false["claims"] if claim["claim"] == "stable")
    claim["rate"] = as_data([[0.01]])
    place.write_text(json.dumps(false), encoding="utf-8")
    assert main(["verify", str(place), "--independent"]) == obsynth.VerificationError.exit_code
    assert "NOT PROVED  stable" in capsys.readouterr().out
    assert main(["verify", str(place), "--independent", "--printed-digits", "3"]) == obsynth.SpecError.exit_code
    assert main(["verify", str(tmp_path / "none.json"), "--independent"]) == obsynth.SpecError.exit_code


@cache
def alarm() -> dict[str, Any]:
    design = design_of("guaranteed-test")
    rng, x = np.random.default_rng(5), np.zeros(3)
    y, u = [], rng.standard_normal((20, 1))
    for k in range(20):
        y.append(SAMPLED.C @ x + rng.uniform(-0.1, 0.1, 2))
        x = A @ x + SAMPLED.B @ u[k] + SAMPLED.Bf[:, 0] * 2.0 + SAMPLED.Bd[:, 0] * rng.uniform(-0.05, 0.05)
    log = pd.DataFrame({"time": 0.1 * np.arange(20), "u1": u[:, 0], "y1": np.array(y)[:, 0], "y2": np.array(y)[:, 1]})
    found = obsynth.prove_alarm(design, log, 20)
    assert found.proved
    return {"certificate": dict(found.certificate)}


def test_the_alarm_of_a_guaranteed_test_is_proved() -> None:
    found = check_alarm_independently(alarm())
    assert found.passed, found.text
    assert "PROVED  alarm: the 8 samples" in found.text


def test_an_alarm_with_other_samples_or_a_larger_margin_is_not() -> None:
    whole = json.loads(proof_bytes(alarm_proof_of(alarm()["certificate"])))
    assert not refused(whole)
    names = []
    for name, change in changes(whole):
        changed = copy.deepcopy(whole)
        change(changed)
        names.append(name)
        assert refused(changed), name
    assert {"a larger margin", "other samples"} <= set(names)


def test_alarms_of_other_methods_are_named() -> None:
    with pytest.raises(obsynth.SpecError, match="linear programme over the states"):
        check_alarm_independently({"certificate": {"equal": []}})


def test_a_bank_proves_each_test() -> None:
    plant = SAMPLED.replace(
        Bf=[[0.0, 1.0], [1.0, 0.0], [0.0, 0.0]], Df=None, fault_names=None, Bd=None, Dd=None, disturbance_names=None
    )
    options = {**TEST, "disturbance_bounds": None, "isolate": True, "course": "step", "before": 4, "samples": 10}
    found = check_design_independently(obsynth.design(plant, "guaranteed-test", **options))
    assert found.passed, found.text
    assert found.text.count("PROVED  threshold") == 2


def test_the_program_is_part_of_what_is_installed() -> None:
    assert checker_path().read_bytes() == CHECKER.read_bytes()
    built = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["hatch"]["build"]["targets"]
    assert built["wheel"]["force-include"]["checker/check_proof.py"] == "obsynth/exporting/check_proof.py"


def test_a_file_that_cannot_be_read_is_said_so(tmp_path: Path) -> None:
    place = tmp_path / "proof.json"
    place.write_text("{}", encoding="utf-8")
    with pytest.raises(obsynth.SpecError, match="could not be checked"):
        check_independently(place)
