"""Proof files of scheduled designs whose parameter has a rate: what they prove, attacks that must be refused, and the
inequalities once more at weights between the vertices, from the numbers of the file."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from benchmarks.campaigns._changed_proofs import as_array, as_data, checker
from scipy.interpolate import BPoly

import obsynth
from obsynth.exporting.independent import check_design_independently
from obsynth.exporting.proof_file import proof_bytes, proof_of

COUPLED = [
    ["0.08 - 0.44 * v", "-0.08 - 0.22 * v", "0.4 + 0.01 * v"],
    ["0.06 - 0.81 * v", "-0.33 - 0.08 * v", "0.22 - 0.44 * v"],
    ["0.8 - 0.26 * v", "0.58 - 0.19 * v", "-0.43 - 0.11 * v"],
]
MIXED = [
    ["0.42 - 0.22 * v", "-0.26 - 0.13 * v", "0.76 - 0.38 * v"],
    ["-0.55 - 0.45 * v", "-0.28 + 0.22 * v", "0.39 + 0.2 * v"],
    ["0.02 + 0.45 * v", "0.83 - 0.26 * v", "0.08 + 0.59 * v"],
]
TURNING = [["0.9 + 0.4 * v", 0.6], [-0.4, "0.8 - 0.4 * v"]]
FAULT = [[1], [0.3], [0.2]]
#: Plant, rate, method, and what its file claims for slow courses.
DESIGNS: dict[str, tuple[dict[str, Any], float, str, list[str]]] = {
    "filter": (
        {"A": COUPLED, "C": np.eye(2, 3), "Bf": FAULT, "Bd": [[0.2], [0.4], [0.5]], "dt": 1.0}, 0.05,
        "fault-estimation-filter", ["decay", "rounding", "faults", "gain"],
    ),
    "pi": (
        {"A": MIXED, "C": np.eye(1, 3), "Bf": FAULT, "dt": 1.0}, 0.05,
        "ui-pi-observer", ["decay", "rounding", "gain"],
    ),
    "kalman": (
        {"A": TURNING, "C": [[1, 0]], "Bw": [[0.1, 0, 0], [0, 0.1, 0]], "Dw": [[0, 0, 0.2]], "dt": 1.0}, 0.02,
        "descriptor-kalman", ["decay", "rounding", "mean square"],
    ),
    "continuous pi": (
        {"A": [["-1 + 0.9 * v", 0.1], [0, -0.5]], "C": np.eye(2), "Bf": [[1], [0]]}, 0.1, "ui-pi-observer", ["gain"],
    ),
}  # fmt: skip
SAMPLED = ("filter", "pi", "kalman")
#: The key of the witnesses at the corners, by claim.
WITNESSES = {"decay": "decreases", "gain": "bounded_real", "mean square": "decreases"}


@cache
def program() -> ModuleType:
    return checker()


@cache
def design_of(name: str) -> obsynth.ObserverDesign:
    plant, rate, method, _ = DESIGNS[name]
    return obsynth.design(
        obsynth.PolytopicSystem(plant=plant, scheduling={"v": {"range": [-1, 1], "rate": rate}}), method
    )


@cache
def text_of(name: str) -> bytes:
    return proof_bytes(proof_of(design_of(name)))


def file_of(name: str) -> dict[str, Any]:
    return json.loads(text_of(name))


def slow_claims(file: dict[str, Any]) -> list[dict[str, Any]]:
    return [entry for entry in file["claims"] if entry["claim"].endswith(" for slow courses")]


def refused(file: Any, claim: str | None = None) -> str:
    """Return why a claim, or any of them, is not proved; empty where it is."""
    verdicts, _ = program().check(file)
    return "; ".join(text for name, proved, text in verdicts if not proved and claim in (None, name))


def number(data: dict[str, Any]) -> float:
    return float(as_array(data).item())


def times(factor: float) -> Callable[[dict[str, Any]], dict[str, Any]]:
    return lambda matrix: as_data(factor * as_array(matrix))


@pytest.mark.parametrize("name", DESIGNS)
def test_what_holds_for_slow_courses_alone_is_claimed_for_these(name: str) -> None:
    file = file_of(name)
    assert [entry["claim"] for entry in slow_claims(file)] == [f"{kind} for slow courses" for kind in DESIGNS[name][3]]
    verdicts, left = program().check(file)
    assert all(proved for _, proved, _ in verdicts), refused(file)
    step = f"changes by at most {DESIGNS[name][1] / 2:.5g}"[:-1]
    for claim, _, text in verdicts:
        if claim.endswith("slow courses"):
            assert step in text
            assert "jumps" not in text
        else:
            assert "jumps among them" in text
    assert not any("gain" in text or "decay" in text or "mean square" in text for text in left)


def test_a_file_is_checked_by_a_process_of_its_own() -> None:
    report = check_design_independently(design_of("kalman"))
    assert report.passed, report.text
    assert "PROVED  mean square for slow courses" in report.text


def each_claim(key: str, change: Callable[[Any], Any]) -> Callable[[dict[str, Any]], None]:
    """Return an attack on a key of every claim for slow courses, and of the contraction."""

    def attack(file: dict[str, Any]) -> None:
        for entry in [*slow_claims(file), file["contraction"]]:
            if key in entry:
                entry[key] = copy.deepcopy(change(entry[key]))

    return attack


def of_both_signs(change: Callable[[list[Any]], list[Any]]) -> Callable[[dict[str, Any]], None]:
    return each_claim("bounded_real", change)


ATTACKS: dict[str, tuple[tuple[str, ...], Callable[[dict[str, Any]], None]]] = {
    "a faster parameter": (SAMPLED, each_claim("step", lambda _: as_data(1.0))),
    "no step": (SAMPLED, each_claim("step", lambda _: as_data(0.0))),
    "a step above one": (SAMPLED, each_claim("step", lambda _: as_data(2.0))),
    "a slack that is zero": (SAMPLED, each_claim("slack", times(0.0))),
    "a slack of another size": (SAMPLED, each_claim("slack", lambda _: as_data(1.0))),
    "P in another order": (SAMPLED, each_claim("P", lambda each: each[::-1])),
    "one P": (SAMPLED, each_claim("P", lambda each: each[:1])),
    "a corner less": (SAMPLED, each_claim("decreases", lambda each: each[:-1])),
    "corners in another order": (SAMPLED, each_claim("decreases", lambda each: each[::-1])),
    "less noise": (("kalman",), each_claim("traces", lambda each: [{**e, "W": times(0.99)(e["W"])} for e in each])),
    "a corner of the noise less": (("kalman",), each_claim("traces", lambda each: each[:-1])),
    "a smaller mean square": (("kalman",), each_claim("level", times(0.95))),
    "a smaller gain": (("filter", "pi", "continuous pi"), each_claim("gamma", times(0.9))),
    "a gain that is negative": (("filter", "pi", "continuous pi"), each_claim("gamma", times(-1.0))),
    "a faster parameter in continuous time": (("continuous pi",), each_claim("rate_of_weight", times(1000.0))),
    "a rate of zero": (("continuous pi",), each_claim("rate_of_weight", times(0.0))),
    "one sign of the rate": (("continuous pi",), of_both_signs(lambda each: each[:1])),
    "a coefficient less": (("continuous pi",), of_both_signs(lambda each: [each[0], each[1][:-1]])),
    "more pieces": (("continuous pi",), each_claim("pieces", lambda pieces: 2 * pieces)),
    "three pieces": (("continuous pi",), each_claim("pieces", lambda _: 3)),
    "no pieces": (("continuous pi",), each_claim("pieces", lambda _: 0)),
    "a coefficient of P less": (("continuous pi",), each_claim("P", lambda each: each[:-1])),
    "P backwards": (("continuous pi",), each_claim("P", lambda each: each[::-1])),
}


@pytest.mark.parametrize(
    ("attack", "name"), [(attack, name) for attack, (names, _) in ATTACKS.items() for name in names]
)
def test_attacks_are_refused(attack: str, name: str) -> None:
    file = file_of(name)
    ATTACKS[attack][1](file)
    assert file != file_of(name)
    assert refused(file)


@pytest.mark.parametrize("name", DESIGNS)
def test_a_claim_for_slow_courses_is_none_for_all(name: str) -> None:
    file = file_of(name)
    for entry in slow_claims(file):
        entry["claim"] = entry["claim"].replace("for slow courses", "over the region")
    for entry in file["claims"]:
        if entry["claim"].split(" over")[0] in DESIGNS[name][3]:
            assert refused(file, entry["claim"])


def test_a_contraction_for_all_courses_is_none_for_slow_ones() -> None:
    file = file_of("continuous pi")
    entry = next(each for each in file["claims"] if each["claim"] == "rounding over the region")
    entry["claim"] = "rounding for slow courses"
    assert "for other courses" in refused(file, entry["claim"])


def test_claims_for_slow_courses_are_of_their_own_time() -> None:
    file = file_of("pi")
    file["plant"]["sample_time"] = as_data(0.0)
    assert "sampled plant" in refused(file, "decay for slow courses")
    file = file_of("continuous pi")
    file["plant"]["sample_time"] = as_data(1.0)
    assert refused(file, "gain for slow courses")


@pytest.mark.parametrize("name", ["filter", "pi", "kalman", "continuous pi"])
def test_claims_about_errors_rest_on_the_identities(name: str) -> None:
    file = file_of(name)
    file["claims"] = [entry for entry in file["claims"] if entry["claim"] != "identities over the region"]
    told = {"gain": "gain", "mean square": "mean square", "faults": "faults"}
    for kind in set(told) & set(DESIGNS[name][3]):
        assert "only where the claim 'identities over the region'" in refused(file, f"{kind} for slow courses")


def error_systems(file: dict[str, Any], signal: str) -> list[tuple[np.ndarray, ...]]:
    """Return a, b, c and d of both vertices, formed by hand from the matrices of the file."""
    t, dy, cz = (as_array(each) for each in (file["follows"]["T"], file["observer"]["Dy"], file["observer"]["Cz"]))
    kinds = [kind for kind, _, _ in file["observer"]["rows"]]
    rows = [i for i, kind in enumerate(kinds) if kind == ("state" if signal == "w" else "fault")]
    systems = []
    for vertex in file["vertices"]:
        by = as_array(vertex["observer"]["By"])
        if signal == "f":
            b, d = t[:, -1:], np.zeros((len(cz), 1))
        else:
            state, output = as_array(vertex["plant"][f"B{signal}"]), as_array(file["plant"][f"D{signal}"])
            b, d = t @ state - by @ output, dy @ output
        systems.append((as_array(vertex["observer"]["Az"]), b, -cz[rows], d[rows]))
    return systems


def least(matrix: np.ndarray) -> float:
    return float(np.linalg.eigvalsh(matrix).min())


def mean(one: Any, two: Any, weight: float) -> Any:
    return (1.0 - weight) * one + weight * two


@pytest.mark.parametrize("name", SAMPLED)
def test_inequalities_hold_for_weights_that_move_slowly_and_not_for_jumps(name: str) -> None:
    """With P at the next sample, and no slack, at random pairs of weights."""
    file = file_of(name)
    kind = "mean square" if name == "kalman" else "gain"
    entry = next(each for each in file["claims"] if each["claim"] == f"{kind} for slow courses")
    P, step = [as_array(p) for p in entry["P"]], number(entry["step"])
    (one, two), rng = error_systems(file, {"filter": "d", "pi": "f", "kalman": "w"}[name]), np.random.default_rng(1)

    def margin(now: float, then: float) -> float:
        a, b, c, d = (mean(x, y, now) for x, y in zip(one, two, strict=True))
        p, after = mean(P[0], P[1], now), mean(P[0], P[1], then)
        if kind == "mean square":
            total = np.trace(b.T @ after @ b) + np.trace(d.T @ d)
            return min(least(p - a.T @ after @ a - c.T @ c), number(entry["level"]) ** 2 - float(total))
        whole = np.hstack([a, b])
        right = np.block(
            [[p, np.zeros(b.shape)], [np.zeros(b.T.shape), number(entry["gamma"]) ** 2 * np.eye(b.shape[1])]]
        )
        seen = np.hstack([c, d])
        return least(right - whole.T @ after @ whole - seen.T @ seen)

    for _ in range(300):
        now = rng.random()
        assert margin(now, float(np.clip(now + step * rng.uniform(-1, 1), 0, 1))) > 0.0
    assert min(margin(*rng.random(2)) for _ in range(300)) < 0.0


def test_the_gain_holds_at_every_weight_and_rate_in_continuous_time() -> None:
    """The polynomial and its derivative by scipy's Bernstein form, at random weights and rates."""
    file = file_of("continuous pi")
    (entry,) = slow_claims(file)
    P = BPoly(np.array([as_array(p) for p in entry["P"]])[:, None], [0.0, 1.0])
    slope, rate, gamma = P.derivative(), number(entry["rate_of_weight"]), number(entry["gamma"])
    (one, two), rng = error_systems(file, "f"), np.random.default_rng(2)

    def margin(w: float, moves: float) -> float:
        a, b, c, d = (mean(x, y, w) for x, y in zip(one, two, strict=True))
        p = P(w)
        corner, side = -(a.T @ p + p @ a + moves * slope(w) + c.T @ c), -(p @ b + c.T @ d)
        return least(np.block([[corner, side], [side.T, gamma**2 * np.eye(b.shape[1]) - d.T @ d]]))

    assert min(margin(rng.random(), rate * rng.uniform(-1, 1)) for _ in range(300)) > 0.0
    assert min(margin(rng.random(), 1000.0 * rate * rng.uniform(-1, 1)) for _ in range(300)) < 0.0
