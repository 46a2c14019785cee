"""Sweeps: all combinations, any executor, resumed from a folder; failing cases are rows."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor

import matplotlib.pyplot as plt
import numpy as np
import pytest

import obsynth
from obsynth.results.gain_set_writing import digest_of, gain_set_bytes
from obsynth.results.gain_sets import loaded

PLANT = """\
schema_version: 1
dt: 1
E: [[1, 0, 0], [0, 1, 0], [0, 0, 0]]
A: [[0.6, 0.1, 0.2], [0, 0.5, 0.3], [0.2, 0.1, 1]]
C: {outputs: [x1, x3]}
Bf: [[1], [0], [0]]
Bd: [[0], [0.5], [0]]
"""
SPEC = """\
schema_version: 1
name: small
plant: {file: plant.yaml}
method: {id: fault-estimation-filter, options: {weight: paper}}
"""


@pytest.fixture
def spec(tmp_path):
    (tmp_path / "plant.yaml").write_text(PLANT)
    file = tmp_path / "spec.yaml"
    file.write_text(SPEC)
    return file


def outcomes(found):
    """Return everything of a sweep but times and files."""
    return [(r.name, r.status, dict(r.claims), r.condition, r.message) for r in found.results]


def test_all_combinations_of_options_and_sensors(spec):
    (spec.parent / "plant.yaml").write_text(PLANT.replace("[0, 0.5, 0.3]", "[0, 0.5, 0]"))  # x2 shows nothing of x1
    found = obsynth.sweep(spec, {"gamma_margin": [0.05, 0.5], "plant.C.outputs": [["x1", "x3"], ["x2"]]})
    assert len(found) == 4
    assert found.counts == {"designed": 2, "impossible": 2}
    assert [r.status for r in found.results] == ["designed", "impossible"] * 2
    assert all(r.condition == "rank [E; C]" for r in found.results if r.status == "impossible")
    table = found.table()
    assert list(table["gamma_margin"]) == [0.05, 0.05, 0.5, 0.5]
    alone = obsynth.fault_estimation_filter(found.results[0].design.plant, weight="paper")
    np.testing.assert_array_equal(found.results[0].design.observer.Az, alone.observer.Az)
    assert found.results[2].claims["gamma"] > found.results[0].claims["gamma"]
    with pytest.raises(obsynth.SpecError, match="has no design"):
        _ = found.results[1].design


def test_designs_know_when_the_inputs_of_a_log_act(spec):
    (spec.parent / "plant.yaml").write_text(PLANT + "B: [[1], [0], [0]]\n")
    spec.write_text(SPEC + "inputs: {delay: 2}\n")
    (found,) = obsynth.sweep(spec, {}).results
    assert found.design.input_delay == 2


def test_executors_change_nothing(spec):
    values = {"plant.A": [[[a, 0.1, 0.2], [0, 0.5, 0.3], [0.2, 0.1, 1]] for a in (0.2, 0.4, 0.6)]}
    here = obsynth.sweep(spec, values)
    with ThreadPoolExecutor(2) as executor:
        there = obsynth.sweep(spec, values, executor=executor)
    assert outcomes(here) == outcomes(there)
    assert [r.content for r in here.results] == [r.content for r in there.results]


def test_a_folder_is_gone_on_with(spec, tmp_path):
    folder, values = tmp_path / "many", {"gamma_margin": [0.05, 0.1]}
    first = obsynth.sweep(spec, values, folder=folder)
    stamps = {file: file.stat().st_mtime_ns for file in folder.iterdir()}
    assert len(stamps) == 4
    calls = []
    again = obsynth.sweep(
        spec, {"gamma_margin": [0.1, 0.05, 0.2]}, folder=folder, progress=lambda *numbers: calls.append(numbers)
    )
    assert calls == [(2, 3), (3, 3)]
    assert all(file.stat().st_mtime_ns == stamp for file, stamp in stamps.items())
    assert outcomes(again)[0] == outcomes(first)[1]
    # A damaged gain set, or a changed plant, is designed again.
    again.results[0].file.write_text("{}")
    (spec.parent / "plant.yaml").write_text(PLANT.replace("0.5]", "0.7]"))
    third = obsynth.sweep(spec, values, folder=folder)
    assert third.results[0].claims["gamma"] != first.results[0].claims["gamma"]
    assert obsynth.load(third.results[0].file).report.passed


def without_status(body):
    del body["status"]


@pytest.mark.one_in(4)
@pytest.mark.parametrize("sealed", [False, True], ids=["as edited", "with the digest made anew"])
@pytest.mark.parametrize(
    ("change", "is_taken"),
    [
        (lambda body: body["claims"].update(gamma=0.01), True),
        (lambda body: body.update(status="infeasible", message="proved"), True),
        (without_status, False),
        (lambda body: body.update(claims=[["gamma", 1.0]]), False),
        (lambda body: body.update(signals=3), False),
        (lambda body: body.update(facts={"shape": [2], "data": ["x", 1]}), False),
        (lambda body: body.update(key="0" * 64), False),
    ],
    ids=["claim", "status", "no status", "claims of another type", "signals of another type", "array of texts", "key"],
)
def test_a_result_that_was_edited_is_found_anew(spec, tmp_path, change, is_taken, sealed):
    """A table was made of whatever stood in the folder: claims and states of cases that nobody had found."""
    folder, values = tmp_path / "many", {"gamma_margin": [0.05]}
    first = obsynth.sweep(spec, values, folder=folder)
    (result,) = folder.glob("*.result.json")
    document = json.loads(result.read_text())
    change(document["result"])
    if sealed:
        document["sha256"] = digest_of(document["result"])
    result.write_text(json.dumps(document))
    again = obsynth.sweep(spec, values, folder=folder)
    assert (outcomes(again) == outcomes(first)) is not (sealed and is_taken)


def test_an_option_and_a_claim_of_the_same_name_have_a_column_each(spec):
    found = obsynth.sweep(spec, {"gamma": [3.0, 0.01]})
    header, rows = found.rows()
    assert len(set(header)) == len(header)
    assert [row[header.index("gamma")] for row in rows] == [3.0, 0.01]
    assert rows[0][header.index("certified gamma")] == found.results[0].claims["gamma"]


@pytest.mark.long
def test_plants_in_memory():
    plant = obsynth.DescriptorSystem(None, [[0.5, 0.1], [0, 0.7]], C=np.eye(2), Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0)
    found = obsynth.sweep(
        {"one": plant, "two": plant.replace(A=0.5 * plant.A)}, {"plant.outputs": [["y1", "y2"], ["y1"]]},
        method="fault-estimation-filter",
    )  # fmt: skip
    assert len(found) == 4
    assert found.results[0].name.startswith("one")
    assert found.counts["designed"] == 4
    figure = found.plot("gamma_min")
    assert figure.axes[0].get_ylabel() == "gamma min"
    plt.close(figure)


@pytest.mark.parametrize(
    ("arguments", "path"),
    [
        ({"parameters": {"gamma": 3.0}}, "parameters.gamma"),
        ({"parameters": {"gamma": []}}, "parameters.gamma"),
        ({"method": "pd-observer"}, "method"),
    ],
)
def test_bad_arguments(spec, arguments, path):
    with pytest.raises(obsynth.SpecError) as caught:
        obsynth.sweep(spec, **arguments)
    assert caught.value.path == path


def test_malformed_cases_are_rows(spec):
    found = obsynth.sweep(spec, {"gamma_margin": [-1.0, 0.05], "plant.nothing": [1]})
    assert found.counts == {"malformed": 2}
    assert "nothing" in found.results[1].message


@pytest.mark.long
def test_large_gain_sets_have_a_binary_member(tmp_path):
    rng = np.random.default_rng(0)
    a = rng.normal(size=(90, 90)) / 12.0
    plant = obsynth.DescriptorSystem(None, a, C=np.eye(30, 90), Bf=np.eye(90, 1), dt=1.0)
    design = obsynth.fault_estimation_filter(plant)
    content = gain_set_bytes(design)
    assert content.startswith(b"PK")
    assert content == gain_set_bytes(design)
    file = design.save(tmp_path / "large.gains.json")
    again = obsynth.load(file)
    np.testing.assert_array_equal(again.observer.Az, design.observer.Az)
    np.testing.assert_array_equal(again.certificate.matrices["P_factor"], design.certificate.matrices["P_factor"])
    assert obsynth.verify(again).passed
    for position in (len(content) // 2, 400, len(content) - 30):
        damaged = bytearray(content)
        damaged[position] ^= 1
        with pytest.raises(obsynth.SpecError):
            loaded(bytes(damaged))
    for end in (100, len(content) - 100):
        file.write_bytes(content[:end])
        with pytest.raises(obsynth.SpecError):
            obsynth.load(file)


def test_a_column_of_a_printed_sweep_is_headed_by_the_last_part_of_its_name(spec):
    found = obsynth.sweep(spec, {"gamma_margin": [0.05, 0.5], "plant.C.outputs": [["x1", "x3"], ["x1"]]})
    heading = next(line for line in str(found).splitlines() if line.startswith("case"))
    assert "outputs" in heading
    assert "plant" not in str(found)
