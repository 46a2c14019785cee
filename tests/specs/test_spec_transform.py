"""A spec's own transform takes the place of that of the plant's file."""

from __future__ import annotations

from pathlib import Path

import pytest

from obsynth import SpecError
from obsynth.specs.loader import load_spec

PLANT = """schema_version: 1
dt: 0
E: [[1, 0], [0, 0]]
A: [[-1, 1], [1, -2]]
C: [[1, 0]]
Bf: [[1], [0]]
"""
SPEC = """schema_version: 1
name: case
plant: {PLANT}
method: {id: pd-observer}
"""
WITH_SAMPLING = "transform: {eliminate_algebraic_states: true, sample_time: 0.1}\n"


def loaded(folder: Path, plant: str, reference: str):
    (folder / "plant.yaml").write_text(plant, encoding="utf-8")
    path = folder / "spec.yaml"
    path.write_text(SPEC.replace("{PLANT}", reference), encoding="utf-8")
    return load_spec(path)


def test_without_one_the_files_transform_holds(tmp_path: Path) -> None:
    spec = loaded(tmp_path, PLANT + WITH_SAMPLING, "{file: plant.yaml}")
    assert (spec.plant.nx, spec.plant.dt) == (1, 0.1)


def test_it_takes_the_place_of_the_files(tmp_path: Path) -> None:
    reference = "{file: plant.yaml, transform: {eliminate_algebraic_states: true}}"
    spec = loaded(tmp_path, PLANT + WITH_SAMPLING, reference)
    assert (spec.plant.nx, spec.plant.dt) == (1, 0.0)
    assert spec.transformation is not None
    assert spec.transformation.source.nx == 2


def test_an_empty_one_switches_the_files_off(tmp_path: Path) -> None:
    spec = loaded(tmp_path, PLANT + WITH_SAMPLING, "{file: plant.yaml, transform: {}}")
    assert (spec.plant.nx, spec.plant.dt) == (2, 0.0)
    assert spec.transformation is None


def test_it_serves_a_file_that_has_none(tmp_path: Path) -> None:
    spec = loaded(tmp_path, PLANT, "{file: plant.yaml, transform: {sample_time: 0.5}}")
    assert spec.plant.dt == 0.5


def test_its_problems_are_found_where_it_stands(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match=r"plant\.transform\.sample_time"):
        loaded(tmp_path, PLANT.replace("dt: 0", "dt: 0.1"), "{file: plant.yaml, transform: {sample_time: 0.5}}")
    with pytest.raises(SpecError, match=r"plant\.transform\.sampletime: unknown key"):
        loaded(tmp_path, PLANT, "{file: plant.yaml, transform: {sampletime: 0.5}}")
    with pytest.raises(SpecError, match=r"plant\.transform\.sample_time"):
        loaded(tmp_path, PLANT, "{file: plant.yaml, transform: {sample_time: -1.0}}")


@pytest.mark.parametrize("folder", ["moussaali2013_ltv", "diode_circuit"])
def test_a_transform_of_a_plant_that_takes_none_is_refused(folder: str, tmp_path: Path) -> None:
    plant = Path(__file__).parents[2] / "designs" / folder / "plant.yaml"
    spec = tmp_path / "spec.yaml"
    method = "{id: dae-adaptive-observer, options: {dt: 1}}" if folder == "diode_circuit" else "{id: adaptive-observer}"
    spec.write_text(
        f"schema_version: 1\nname: case\nplant: {{file: {plant}, transform: {{sample_time: 0.1}}}}\nmethod: {method}\n",
        encoding="utf-8",
    )
    with pytest.raises(SpecError, match="transform is for linear plants") as caught:
        load_spec(spec)
    assert caught.value.path == "plant.transform"


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("100 ms", 0.1),
        ("1.1ms", 0.0011),
        ("250 us", 0.00025),
        ("2 s", 2.0),
        ("1.5 min", 90.0),
        ("1 h", 3600.0),
        # The sign of keyboards, and the letter of the Greek alphabet.
        ("250 \u00b5s", 0.00025),
        ("250 \u03bcs", 0.00025),
    ],
)
def test_times_are_read_with_their_units(text: str, seconds: float, tmp_path: Path) -> None:
    transform = f"transform: {{eliminate_algebraic_states: true, sample_time: {text}}}\n"
    reference = f"{{file: plant.yaml}}\nscenario: {{horizon: {text}}}"
    spec = loaded(tmp_path, PLANT + transform, reference)
    assert spec.scenario is not None
    assert (spec.plant.dt, spec.scenario.horizon) == (seconds, seconds)


@pytest.mark.parametrize("text", ["5 m", "3 V", "2 minutes", "10 %"])
def test_what_is_no_unit_of_time_is_refused(text: str, tmp_path: Path) -> None:
    transform = f"transform: {{eliminate_algebraic_states: true, sample_time: {text}}}\n"
    with pytest.raises(
        SpecError, match=f"sample_time: must be a number of seconds, or a time in us, .*not the text '{text}'"
    ):
        loaded(tmp_path, PLANT + transform, "{file: plant.yaml}")
