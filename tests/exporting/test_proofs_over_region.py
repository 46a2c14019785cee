"""Proof files of designs over a region: what they prove, by hand and of designs, and attacks that must be refused."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from benchmarks.campaigns._changed_proofs import as_array, as_data, checker

import obsynth
from obsynth.cli.main import main
from obsynth.exporting.independent import check_design_independently
from obsynth.exporting.proof_file import proof_bytes, proof_of, write_proof
from obsynth.proofs.witnesses import Dyadic, definite_witness

MATRICES = {"A": [["0.7 + 0.2 * v", 0.1], [0.05, "0.5 - 0.1 * v"]], "C": [[1, 0], [0, 1]], "dt": 1.0}
FAULTY = {**MATRICES, "B": [["1 + 0.1 * v"], [0.2]], "Bf": [[1], [0]], "Bd": [[0.2], ["1 + 0.3 * v"]]}
NOISY = {**MATRICES, "Bw": [["0.1 + 0.05 * v", 0, 0, 0], [0, 0.1, 0, 0]], "Dw": [[0, 0, 0.1, 0], [0, 0, 0, 0.2]]}
FLOWING = {"A": [["-1 + 0.9 * v", 0.1], [0, -0.5]], "C": [[1, 0], [0, 1]], "Bf": [[1], [0]]}
RANGE: dict[str, Any] = {"v": [-1.0, 1.0]}
COMMON = ["identities over the region", "decay over the region", "rounding over the region"]
#: Plant, scheduling, method, and what its file claims.
DESIGNS: dict[str, tuple[dict[str, Any], dict[str, Any], str, list[str]]] = {
    "filter": (
        FAULTY, RANGE, "fault-estimation-filter", [*COMMON, "faults over the region", "gain over the region"],
    ),
    "changing effect": (
        {**FAULTY, "Bf": [["1 + 0.5 * v"], [0]]}, RANGE, "fault-estimation-filter", COMMON,
    ),
    "pi": ({**MATRICES, "Bf": [[1], [0]]}, RANGE, "ui-pi-observer", [*COMMON, "gain over the region"]),
    "continuous pi": (FLOWING, RANGE, "ui-pi-observer", [*COMMON, "gain over the region"]),
    "kalman": (NOISY, RANGE, "descriptor-kalman", [*COMMON, "mean square over the region"]),
}  # fmt: skip
WHOLE = ("filter", "pi", "continuous pi", "kalman")


@cache
def program() -> ModuleType:
    return checker()


@cache
def design_of(name: str) -> obsynth.ObserverDesign:
    plant, scheduling, method, _ = DESIGNS[name]
    return obsynth.design(obsynth.PolytopicSystem(plant=plant, scheduling=scheduling), method)


@cache
def text_of(name: str) -> bytes:
    return proof_bytes(proof_of(design_of(name)))


def file_of(name: str) -> dict[str, Any]:
    return json.loads(text_of(name))


def refused(file: Any) -> str:
    """Return why a file is not accepted; empty where it is."""
    module = program()
    try:
        verdicts, _ = module.check(file)
    except (module.Refused, *module.UNREADABLE) as error:
        return str(error) or type(error).__name__
    return "; ".join(text for _, proved, text in verdicts if not proved)


def claim(file: dict[str, Any], name: str) -> dict[str, Any]:
    return next(entry for entry in file["claims"] if entry["claim"] == name)


def data(value: Any) -> dict[str, Any]:
    return as_data(np.atleast_2d(np.asarray(value, dtype=np.float64)))


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", DESIGNS)
def test_what_a_file_claims_is_proved_by_a_process_of_its_own(name: str, tmp_path: Path) -> None:
    assert [entry["claim"] for entry in file_of(name)["claims"]] == DESIGNS[name][3]
    report = check_design_independently(design_of(name))
    assert report.passed, report.text
    assert "2 vertices, jumps among them" in report.text


def test_a_proof_that_fails_is_left_out_by_its_name() -> None:
    """Matrices of a certificate that prove nothing."""
    design = design_of("pi")
    matrices = {**design.certificate.matrices, "P_region": -design.certificate.matrices["P_region"]}
    left = proof_of(design.replace(certificate=replace(design.certificate, matrices=matrices)))["not_covered"]
    assert "decay over the region" in left


def test_a_file_of_a_region_is_written_and_checked_on_the_command_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    gains, proof = tmp_path / "pi.gains.json", tmp_path / "proof.json"
    design_of("pi").save(gains)
    assert main(["export", "--gains", str(gains), "--to", str(proof), "--checker"]) == 0
    assert (tmp_path / "check_proof.py").is_file()
    assert main(["verify", "--independent", str(gains)]) == 0
    assert "PROVED  gain over the region" in capsys.readouterr().out


def test_designs_whose_file_would_say_too_little_are_refused_by_name() -> None:
    spring = obsynth.DAEModel(
        {"speed": "der(x) = v", "force": "der(v) = -x - 0.5 * v - 0.1 * x ** 3"}, {"gauge": "x"},
        states={"x": 0.0, "v": 0.0},
    )  # fmt: skip
    design = obsynth.region_observer(spring, region={"x": (-1.0, 1.0), "v": (-1.0, 1.0)}, goal="decay", sample_time=0.1)
    with pytest.raises(obsynth.SpecError, match="nonlinear plant"):
        proof_of(design)
    turning = obsynth.PolytopicSystem(plant={**MATRICES, "Bf": [["v"], [1]]}, scheduling=RANGE)
    with pytest.raises(obsynth.SpecError, match="turn their directions"):
        proof_of(obsynth.design(turning, "fault-estimation-filter"))


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", WHOLE)
def test_numbers_that_are_false_are_refused(name: str) -> None:
    """What courses that stay at a vertex, or alternate, reach already is never proved to be smaller."""
    file = file_of(name)
    az = [as_array(vertex["observer"]["Az"]) for vertex in file["vertices"]]
    sampled = bool(as_array(file["plant"]["sample_time"]).item())
    poles = [np.linalg.eigvals(a) for a in az]
    fastest = max(np.abs(p).max() for p in poles) if sampled else min(-p.real.max() for p in poles)
    if fastest > 0.0:
        claim(file, "decay over the region")["rate"] = data(fastest * (0.999 if sampled else 1.001))
        assert "Lyapunov inequality" in refused(file)


def changed_matrix(kind: str, name: str) -> Callable[[dict[str, Any]], None]:
    def change(file: dict[str, Any]) -> None:
        matrix = as_array(file["vertices"][-1][kind][name])
        matrix[np.unravel_index(int(np.argmax(np.abs(matrix))), matrix.shape)] *= 1.01
        file["vertices"][-1][kind][name] = data(matrix)

    return change


def of_each_claim(key: str, value: Any) -> Callable[[dict[str, Any]], None]:
    def change(file: dict[str, Any]) -> None:
        for entry in file["claims"]:
            if key in entry:
                entry[key] = copy.deepcopy(value(entry[key]))

    return change


def vertex_beside_matrices(file: dict[str, Any]) -> None:
    file["plant"]["A"] = copy.deepcopy(file["vertices"][0]["plant"]["A"])


def more_at_a_vertex(file: dict[str, Any]) -> None:
    file["vertices"][0]["plant"]["C"] = copy.deepcopy(file["plant"]["C"])


def another_vertex(file: dict[str, Any]) -> None:
    """A vertex for which nothing is proved."""
    vertex = copy.deepcopy(file["vertices"][0])
    vertex["observer"]["Az"] = data(2.0 * np.eye(len(as_array(vertex["observer"]["Az"]))))
    file["vertices"].append(vertex)


def without_identities(file: dict[str, Any]) -> None:
    file["claims"] = [entry for entry in file["claims"] if entry["claim"] != "identities over the region"]


ATTACKS: dict[str, Callable[[dict[str, Any]], None]] = {
    "A of a vertex": changed_matrix("plant", "A"),
    "Az of a vertex": changed_matrix("observer", "Az"),
    "By of a vertex": changed_matrix("observer", "By"),
    "a witness less": of_each_claim("decreases", lambda each: each[:-1]),
    "another vertex": another_vertex,
    "no vertices": lambda file: file.update(vertices=[]),
    "a matrix at the vertices and beside them": vertex_beside_matrices,
    "a vertex with its own outputs": more_at_a_vertex,
    "claims of constant plants": lambda file: [
        entry.update(claim=entry["claim"].removesuffix(" over the region")) for entry in file["claims"]
    ] and None,
    "no contraction": lambda file: file.update(contraction=None),
    "a P that is zero": of_each_claim("P", lambda each: [data(np.zeros(P["size"])) for P in each]),
    "no P": of_each_claim("P", lambda each: []),
    "no room for rounding": of_each_claim("bounds", lambda each: (
        {kind: data(0.0 * as_array(bound)) for kind, bound in each.items()} if "size" not in each
        else data(0.0 * as_array(each))
    )),
}  # fmt: skip


@pytest.mark.parametrize("name", WHOLE)
@pytest.mark.parametrize("attack", ATTACKS)
def test_attacks_are_refused(name: str, attack: str) -> None:
    file = file_of(name)
    assert not refused(file)
    ATTACKS[attack](file)
    assert file != file_of(name)
    assert refused(file)


@pytest.mark.parametrize("name", ["filter", "pi", "kalman"])
def test_claims_about_errors_rest_on_the_identities(name: str) -> None:
    file = file_of(name)
    without_identities(file)
    assert "only where the claim 'identities over the region' is proved" in refused(file)


def test_claims_of_a_region_are_none_of_a_constant_plant() -> None:
    plant = obsynth.DescriptorSystem(None, [[0.5]], C=[[1.0]], Bf=[[1.0]], dt=1.0)
    file = json.loads(proof_bytes(proof_of(obsynth.design(plant, "ui-pi-observer"))))
    for entry in file["claims"]:
        entry["claim"] += " over the region"
    assert "knows no such claim" in refused(file)


# One state, by hand: errors obey e+ = a e + d with a at the vertices, and so the row's error is -e.


def by_hand(vertices: tuple[float, ...], entries: dict[str, Any], *, dt: float = 1.0) -> dict[str, Any]:
    """Return a file of ``x+ = x / 2 + d + w``, ``y = x``; ``z+ = a z + (1/2 - a) y``, ``r = y - z`` with one claim."""
    none, one, zero = data(np.zeros((1, 0))), data(1.0), data(0.0)
    plant = {"E": one, "C": one, "D": none, "Df": none, "Dd": zero, "Dw": zero, "sample_time": data(dt),
             "names": {"states": ["x"], "faults": [], "disturbances": ["d"]}}  # fmt: skip
    each = [
        {"plant": {"A": data(0.5), "B": none, "Bf": none, "Bd": one, "Bw": one},
         "observer": {"Az": data(a), "Bu": none, "By": data(0.5 - a)}}
        for a in vertices
    ]  # fmt: skip
    empty = data(np.zeros((0, 0)))
    return {
        "format": "obsynth-proof", "version": 1, "about": "by hand", "plant": plant, "vertices": each,
        "observer": {"Cz": data(-1.0), "Du": none, "Dy": one, "rows": [["residual", "r", 0]]},
        "follows": {"T": one, "T0": zero, "Phi": empty, "Cw": data(np.zeros((0, 0))), "lag": 0, "decoupled": False},
        "contraction": None, "not_covered": [],
        "claims": [entries, {"claim": "identities over the region", "share": data(2.0**-20), "floor": zero}],
    }  # fmt: skip


def witness(matrix: Any) -> dict[str, Any]:
    """Return a witness, or one that cannot hold where there is none."""
    exact = Dyadic.of(np.atleast_2d(matrix))
    size = exact.shape[0]
    return definite_witness(exact) or {"factor": data(np.zeros((size, size))), "weights": [1] * size}


def gain_claim(vertices: tuple[float, ...], P: tuple[float, ...], gamma: float, *, flowing: bool) -> dict[str, Any]:
    def form(a: float, now: float, then: float) -> Any:
        if flowing:
            return [[-2.0 * a * now - 1.0, -now], [-now, gamma**2]]
        return [[now - a * then * a - 1.0, -a * then], [-a * then, gamma**2 - then]]

    own = P if len(P) > 1 else P * len(vertices)
    witnesses = [witness(form(a, now, then)) for a, now in zip(vertices, own, strict=True) for then in P]
    return {
        "claim": "gain over the region", "signal": "disturbances", "rows": ["residual"], "gamma": data(gamma),
        "P": [data(each) for each in P], "P_positive": [witness(each) for each in P], "bounded_real": witnesses,
    }  # fmt: skip


@pytest.mark.parametrize("separate", [False, True])
def test_a_gain_is_sharp_where_it_is_by_hand(separate: bool) -> None:
    """``|a| <= 1/2`` of either sign: the gain is 2 from a constant d at one vertex, and no course has more."""
    vertices = (0.5, -0.5)
    P = (4.0, 4.0)[: 2 if separate else 1]
    # With P = c the least level is where c - c/4 - 1 - (c/2)^2 / (g^2 - c) = 0: g = 2 at c = 2.
    P = tuple(2.0 for _ in P)
    assert not refused(by_hand(vertices, gain_claim(vertices, P, 2.0001, flowing=False)))
    assert "bounded real" in refused(by_hand(vertices, gain_claim(vertices, P, 1.9999, flowing=False)))


def test_a_gain_in_continuous_time_is_sharp_where_it_is_by_hand() -> None:
    """The slowest of ``e' = -e`` and ``e' = -2 e`` has a gain of one, and two P are refused."""
    vertices = (-1.0, -2.0)
    assert not refused(by_hand(vertices, gain_claim(vertices, (1.0,), 1.0001, flowing=True), dt=0.0))
    assert refused(by_hand(vertices, gain_claim(vertices, (1.0,), 0.9999, flowing=True), dt=0.0))
    assert "one P" in refused(by_hand(vertices, gain_claim(vertices, (1.0, 1.0), 1.0001, flowing=True), dt=0.0))


def test_a_pair_of_vertices_that_is_not_proved_is_named() -> None:
    """With P of 2 and 8 a step from the first vertex to the second is not proved, though each alone is."""
    vertices = (0.5, -0.5)
    text = refused(by_hand(vertices, gain_claim(vertices, (2.0, 8.0), 3.0, flowing=False)))
    assert "vertex 1, then 2" in text


@pytest.mark.parametrize("level", [1.1548, 1.1546])
def test_a_mean_square_is_sharp_where_it_is_by_hand(level: float) -> None:
    """``e+ = a e + w`` with ``|a| <= 1/2`` has a mean square of at most 4/3, and a root of 1.15470."""
    vertices, P = (0.5, -0.5), 4.0 / 3.0 * (1.0 + 1e-9)
    entries = {
        "claim": "mean square over the region", "rows": ["residual"], "level": data(level), "P": [data(P)],
        "P_positive": [witness(P)], "decreases": [witness(P - 0.25 * P - 1.0)] * 2,
    }  # fmt: skip
    text = refused(by_hand(vertices, entries))
    assert (not text) if level > np.sqrt(4.0 / 3.0) else "mean square is not proved" in text
    assert "sampled plants" in refused(by_hand(vertices, entries, dt=0.0))


def test_a_proof_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    place = tmp_path / "proof.json"
    write_proof(design_of("kalman"), place)
    assert json.loads(place.read_text(encoding="utf-8")) == file_of("kalman")


@pytest.mark.parametrize("place", [0, 1])
def test_identities_hold_at_every_vertex(place: int) -> None:
    file = by_hand((0.5, -0.5), gain_claim((0.5, -0.5), (2.0,), 2.0001, flowing=False))
    file["vertices"][place]["plant"]["A"] = data(0.501)
    assert "identity K: entry 1, 1 does not hold" in refused(file)
