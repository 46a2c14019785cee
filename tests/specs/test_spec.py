"""Specs: what a document says is what the plant holds."""

from __future__ import annotations

import inspect
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
import scipy.sparse

import obsynth
from obsynth.errors import SpecError
from obsynth.methods.registry import REGISTRY
from obsynth.specs.loader import load_spec
from obsynth.specs.matrix_files import read_matrix
from obsynth.specs.schema_options import options_schema

DESIGNS = Path(__file__).parents[2] / "designs"

METHOD = "method: {id: fault-estimation-filter}\n"
HEAD = "schema_version: 1\nname: small\n"
PLANT = """\
  dt: 0.5
  E: [[1, 0], [0, 0]]
  A: [[0.5, 1], [1, 1]]
  C: [[1, 0], [0, 1]]
"""


@pytest.fixture
def spec_with(tmp_path: Path) -> Any:
    """Return a function that writes and loads a spec, given the plant's section and the method's."""

    def load(plant: str, method: str = METHOD) -> Any:
        path = tmp_path / "spec.yaml"
        path.write_text(f"{HEAD}plant:\n{plant}{method}", encoding="utf-8")
        return load_spec(path)

    return load


class TestDocument:
    def test_plain_spec(self, spec_with: Any) -> None:
        spec = spec_with(PLANT + "  Bf: [[1], [0.25]]\n")
        assert (spec.name, spec.description, spec.method, dict(spec.options)) == (
            "small", "", "fault-estimation-filter", {},
        )  # fmt: skip
        assert spec.transformation is None
        assert spec.plant.dt == 0.5
        assert spec.plant.E.tolist() == [[1, 0], [0, 0]]
        assert spec.plant.A.tolist() == [[0.5, 1], [1, 1]]
        assert spec.plant.Bf.tolist() == [[1], [0.25]]
        assert spec.plant.fault_names == ("f1",)

    def test_E_is_the_identity_by_default(self, spec_with: Any) -> None:
        assert spec_with("  dt: 1\n  A: [[2]]\n  C: [[1]]\n").plant.E.tolist() == [[1.0]]

    def test_every_matrix_lands_in_its_place(self, spec_with: Any) -> None:
        spec = spec_with(
            PLANT + "  B: [[1], [2]]\n  D: [[3], [4]]\n  Bf: [[5], [6]]\n  Df: [[7], [8]]\n"
            "  Bd: [[9], [10]]\n  Dd: [[11], [12]]\n  Bw: [[13], [14]]\n  Dw: [[15], [16]]\n"
        )
        found = [getattr(spec.plant, name).ravel().tolist() for name in ("B", "D", "Bf", "Df", "Bd", "Dd", "Bw", "Dw")]
        assert found == [[2 * i + 1, 2 * i + 2] for i in range(8)]

    def test_yaml_1_2_numbers_and_words(self, spec_with: Any) -> None:
        spec = spec_with("  dt: 1e-3\n  A: [[1E2, -2.5e+1], [0x10, 010]]\n  C: [[1, 0]]\n  state_names: [yes, off]\n")
        assert spec.plant.dt == 0.001
        assert spec.plant.A.tolist() == [[100, -25], [16, 10]]
        assert spec.plant.state_names == ("yes", "off")

    def test_anchors_are_data(self, spec_with: Any) -> None:
        spec = spec_with(PLANT + "  B: &columns [[1], [0]]\n  Bf: *columns\n")
        assert np.array_equal(spec.plant.B, spec.plant.Bf)

    def test_options_are_passed_on_as_given(self, spec_with: Any) -> None:
        method = (
            "method:\n  id: fault-estimation-filter\n  options:\n    gamma: 2\n    solver: SCS\n"
            "    weight: paper\n    S: [[1, 0, 0, 0], [0, 1, 0, 0]]\n    gamma_search: bisection\n"
        )
        options = spec_with(PLANT + "  Bf: [[1], [0]]\n", method).options
        assert options["S"].tolist() == [[1, 0, 0, 0], [0, 1, 0, 0]]
        assert {name: value for name, value in options.items() if name != "S"} == {
            "gamma": 2.0, "solver": "SCS", "weight": "paper", "gamma_search": "bisection",
        }  # fmt: skip

    def test_null_means_the_default(self, spec_with: Any) -> None:
        method = "method:\n  id: fault-estimation-filter\n  options: {gamma: null, weight: null}\n"
        spec = spec_with(PLANT + "  B: null\n", method)
        assert spec.plant.nu == 0
        assert dict(spec.options) == {"gamma": None, "weight": None}

    def test_a_utf8_byte_order_mark_is_no_problem(self, tmp_path: Path) -> None:
        path = tmp_path / "spec.yaml"
        path.write_text(f"{HEAD}plant:\n{PLANT}{METHOD}", encoding="utf-8-sig")
        assert load_spec(str(path)).name == "small"


class TestNames:
    def test_picks_by_name_name_their_signals(self, spec_with: Any) -> None:
        plant = spec_with(
            "  dt: 0\n  A: [[1, 2, 3], [4, 5, 6], [7, 8, 9]]\n  state_names: [a, b, c]\n"
            "  C: {outputs: [c, a]}\n  B: {states: [b]}\n  Bf: {states: [c]}\n  Bd: {states: [a, b]}\n"
            "  Bw: {states: [a]}\n"
        ).plant
        assert plant.C.tolist() == [[0, 0, 1], [1, 0, 0]]
        assert plant.B.ravel().tolist() == [0, 1, 0]
        assert plant.Bf.ravel().tolist() == [0, 0, 1]
        assert plant.Bd.tolist() == [[1, 0], [0, 1], [0, 0]]
        assert plant.Bw.ravel().tolist() == [1, 0, 0]
        assert (plant.output_names, plant.input_names, plant.fault_names) == (("c", "a"), ("b",), ("c",))
        assert (plant.disturbance_names, plant.noise_names) == (("a", "b"), ("a",))

    def test_given_names_win_over_picked_ones(self, spec_with: Any) -> None:
        plant = spec_with(
            "  dt: 0\n  A: [[1]]\n  C: {outputs: [x1, x1]}\n  output_names: [first, second]\n"
            "  Bf: {states: [x1]}\n  fault_names: [torque]\n  B: {states: [x1]}\n  input_names: [valve]\n"
        ).plant
        assert plant.C.tolist() == [[1], [1]]
        assert (plant.output_names, plant.fault_names, plant.input_names) == (
            ("first", "second"),
            ("torque",),
            ("valve",),
        )

    def test_names_from_json_in_the_order_of_the_file(self, spec_with: Any, tmp_path: Path) -> None:
        (tmp_path / "names.json").write_text(json.dumps({"differential": ["b"], "algebraic": ["a"]}), encoding="utf-8")
        (tmp_path / "outputs.json").write_text(json.dumps(["p", "q"]), encoding="utf-8")
        plant = spec_with(PLANT + "  state_names: {file: names.json}\n  output_names: {file: outputs.json}\n").plant
        assert plant.state_names == ("b", "a")
        assert plant.output_names == ("p", "q")

    def test_operating_point_and_units(self, spec_with: Any) -> None:
        plant = spec_with(PLANT + "  operating_point: {x1: 2}\n  units: {x1: pu, y2: rad}\n").plant
        assert dict(plant.operating_point) == {"x1": 2.0}
        assert dict(plant.units) == {"x1": "pu", "y2": "rad"}


class TestSensorNoise:
    def test_columns_are_appended_to_the_noise(self, spec_with: Any) -> None:
        plant = spec_with(
            PLANT + "  Bw: [[0.5], [0]]\n  Dw: [[0], [0]]\n  noise_names: [gusts]\n  sensor_noise: {y2: 0.1, y1: 0.2}\n"
            "  units: {noise y2: pu}\n"
        ).plant
        assert plant.Bw.tolist() == [[0.5, 0, 0], [0, 0, 0]]
        assert plant.Dw.tolist() == [[0, 0, 0.2], [0, 0.1, 0]]
        assert plant.noise_names == ("gusts", "noise y2", "noise y1")
        assert dict(plant.units) == {"noise y2": "pu"}

    def test_without_other_noise(self, spec_with: Any) -> None:
        plant = spec_with(PLANT + "  sensor_noise: {y1: 0.2}\n").plant
        assert plant.Dw.tolist() == [[0.2], [0]]
        assert plant.Bw.tolist() == [[0], [0]]


MATRIX = np.array([[0.5, 1.0], [0.0, 0.25]])


def write_matrix(path: Path) -> None:
    """Write ``MATRIX`` in the format that the file's name asks for."""
    if path.name == "sparse.mtx":
        scipy.io.mmwrite(path, scipy.sparse.coo_array(MATRIX))
    elif path.suffix == ".mtx":
        scipy.io.mmwrite(path, MATRIX)
    elif path.suffix == ".csv":
        path.write_text("# two states\n0.5,1\n0,0.25\n", encoding="utf-8")
    elif path.suffix == ".npz":
        np.savez(path, A=MATRIX)
    else:
        scipy.io.savemat(path, {"A": scipy.sparse.csc_array(MATRIX) if path.name == "sparse.mat" else MATRIX})


class TestMatrixFiles:
    @pytest.mark.parametrize("name", ["dense.mtx", "sparse.mtx", "plain.csv", "one.npz", "one.mat", "sparse.mat"])
    def test_each_format_gives_the_same_matrix(self, spec_with: Any, tmp_path: Path, name: str) -> None:
        write_matrix(tmp_path / name)
        plant = spec_with(f"  dt: 1\n  A: {{file: {name}}}\n  C: [[1, 0]]\n").plant
        assert np.array_equal(plant.A, MATRIX)

    @pytest.mark.parametrize("suffix", ["npz", "mat"])
    def test_one_array_of_several(self, spec_with: Any, tmp_path: Path, suffix: str) -> None:
        arrays = {"A": MATRIX, "C": np.array([[1.0, 0.0]])}
        if suffix == "npz":
            np.savez(tmp_path / "plant.npz", **arrays)
        else:
            scipy.io.savemat(tmp_path / "plant.mat", arrays)
        plant = spec_with(
            f"  dt: 1\n  A: {{file: plant.{suffix}, variable: A}}\n  C: {{file: plant.{suffix}, variable: C}}\n"
        ).plant
        assert np.array_equal(plant.A, MATRIX)
        assert plant.C.tolist() == [[1, 0]]

    def test_a_file_in_a_sibling_folder_and_for_an_option(self, spec_with: Any, tmp_path: Path) -> None:
        (tmp_path / "data").mkdir()
        write_matrix(tmp_path / "data" / "plain.csv")
        method = "method: {id: fault-estimation-filter, options: {S: {file: data/plain.csv}}}\n"
        spec = spec_with("  dt: 1\n  A: {file: data/plain.csv}\n  C: [[1, 0]]\n", method)
        assert np.array_equal(spec.options["S"], MATRIX)


class TestMatrixMarket:
    """Our reader agrees with scipy's writer, for every kind of file."""

    @pytest.mark.parametrize("sparse", [False, True], ids=["array", "coordinate"])
    @pytest.mark.parametrize("field", ["real", "integer"])
    @pytest.mark.parametrize("symmetry", ["general", "symmetric", "skew-symmetric"])
    def test_round_trip(self, tmp_path: Path, sparse: bool, field: str, symmetry: str) -> None:
        matrix = np.array([[1.0, 0, 2], [-3, 4, 0], [0, 5, 6]])
        matrix = {"general": matrix, "symmetric": matrix + matrix.T, "skew-symmetric": matrix - matrix.T}[symmetry]
        path = tmp_path / "matrix.mtx"
        scipy.io.mmwrite(path, scipy.sparse.coo_array(matrix) if sparse else matrix, field=field, symmetry=symmetry)
        assert np.array_equal(read_matrix(path, where="plant.A"), matrix)

    def test_pattern_and_repeated_entries(self, tmp_path: Path) -> None:
        path = tmp_path / "matrix.mtx"
        path.write_text("%%MatrixMarket matrix coordinate pattern general\n% note\n\n2 3 3\n1 1\n2 3\n1 1\n", "utf-8")
        assert read_matrix(path, where="plant.A").tolist() == [[2, 0, 0], [0, 0, 1]]


class TestPlantFile:
    def test_one_plant_serves_two_specs(self, tmp_path: Path) -> None:
        (tmp_path / "shared").mkdir()
        write_matrix(tmp_path / "shared" / "plain.csv")
        # Files are found beside the document that names them.
        text = "schema_version: 1\ndt: 1\nA: {file: plain.csv}\nC: [[1, 0]]\n"
        (tmp_path / "shared" / "plant.yaml").write_text(text, encoding="utf-8")
        plants = []
        for name in ("one", "two"):
            path = tmp_path / f"{name}.yaml"
            path.write_text(f"schema_version: 1\nname: {name}\nplant: {{file: shared/plant.yaml}}\n{METHOD}", "utf-8")
            plants.append(load_spec(path).plant)
        assert np.array_equal(plants[0].A, MATRIX)
        assert np.array_equal(plants[0].A, plants[1].A)


class TestTransform:
    PLANT = (
        "  dt: 0\n  E: [[1, 0], [0, 0]]\n  A: [[-1, 1], [0, -1]]\n  B: [[0], [2]]\n  C: [[1, 0]]\n  Bf: [[0], [1]]\n"
    )

    def test_elimination_then_sampling(self, spec_with: Any) -> None:
        spec = spec_with(self.PLANT + "  transform: {eliminate_algebraic_states: true, sample_time: 0.5}\n")
        # x2 = 2 u + f, so x1' = -x1 + 2 u + f.
        held = 1.0 - np.exp(-0.5)
        assert spec.plant.nx == 1
        assert spec.plant.dt == 0.5
        np.testing.assert_allclose(spec.plant.A, [[np.exp(-0.5)]], rtol=1e-14)
        np.testing.assert_allclose(spec.plant.B, [[2 * held]], rtol=1e-14)
        np.testing.assert_allclose(spec.plant.Bf, [[held]], rtol=1e-14)
        recovery = spec.transformation.recovery
        assert recovery.names == ("x1", "x2")
        assert recovery.from_input.tolist() == [[0], [2]]
        assert recovery.flags() == ("exact", "needs the fault estimate")
        assert spec.transformation.source.nx == 2

    def test_elimination_alone(self, spec_with: Any) -> None:
        spec = spec_with(self.PLANT + "  transform: {eliminate_algebraic_states: true}\n")
        assert spec.plant.dt == 0.0
        assert spec.plant.A.tolist() == [[-1.0]]

    def test_sampling_alone(self, spec_with: Any) -> None:
        spec = spec_with("  dt: 0\n  A: [[-1]]\n  C: [[1]]\n  transform: {sample_time: 0.25}\n")
        np.testing.assert_allclose(spec.plant.A, [[np.exp(-0.25)]], rtol=1e-14)

    @pytest.mark.parametrize("transform", ["{}", "{eliminate_algebraic_states: false}", "null"])
    def test_nothing_asked_nothing_done(self, spec_with: Any, transform: str) -> None:
        spec = spec_with(self.PLANT + f"  transform: {transform}\n")
        assert spec.transformation is None
        assert spec.plant.nx == 2

    def test_sensor_noise_stays_per_sample(self, spec_with: Any) -> None:
        spec = spec_with(self.PLANT + "  sensor_noise: {y1: 0.125}\n  transform: {sample_time: 0.5}\n")
        assert spec.plant.Dw.tolist() == [[0.125]]
        assert spec.plant.noise_names == ("noise y1",)


class TestEveryProblemIsReported:
    def test_all_at_once_each_with_its_path(self, spec_with: Any) -> None:
        plant = "  dt: yes\n  A: [[1, '2'], [3]]\n  E: [[.nan]]\n  C: {output: [x1]}\n  Bg: [[1]]\n  units: {x1: 1}\n"
        method = "method: {id: fault-estimation-filter, options: {gamma: -1, gama: 1}}\n"
        with pytest.raises(SpecError) as caught:
            spec_with(plant, method)
        paths = {problem.split(":")[0] for problem in caught.value.problems}
        assert paths == {
            "plant.dt", "plant.A", "plant.E", "plant.C.output", "plant.C.outputs", "plant.Bg", "plant.units.x1",
            "method.options.gamma", "method.options.gama",
        }  # fmt: skip
        # Both problems of A: the text and the ragged row.
        assert sum(problem.startswith("plant.A:") for problem in caught.value.problems) == 2

    def test_all_files_at_once(self, spec_with: Any) -> None:
        with pytest.raises(SpecError) as caught:
            spec_with("  dt: 1\n  A: {file: A.mtx}\n  C: {file: C.xyz}\n  state_names: {file: names.json}\n")
        assert [problem.split(":")[0] for problem in caught.value.problems] == [
            "plant.A",
            "plant.C",
            "plant.state_names",
        ]

    def test_all_shapes_at_once(self, spec_with: Any) -> None:
        with pytest.raises(SpecError) as caught:
            spec_with("  dt: 1\n  A: [[1, 0], [0, 1]]\n  C: [[1]]\n  E: [[1]]\n  Bf: [[1]]\n")
        assert len(caught.value.problems) == 3

    def test_a_long_list_is_cut(self, spec_with: Any) -> None:
        rows = [["a"] * 10] * 10
        with pytest.raises(SpecError, match="and 75 more"):
            spec_with(f"  dt: 1\n  A: {json.dumps(rows)}\n  C: [[1]]\n")

    def test_a_close_key_is_suggested(self, spec_with: Any) -> None:
        with pytest.raises(SpecError, match=r"plant\.ouput_names: unknown key\. Did you mean 'output_names'"):
            spec_with(PLANT + "  ouput_names: [a, b]\n")


class TestShippedDesigns:
    def test_wang2015(self) -> None:
        plant = load_spec(DESIGNS / "wang2015" / "spec.yaml").plant
        assert np.array_equal(plant.B, plant.Bf)
        assert plant.A[3].tolist() == [1, 0, 1, 1]
        assert np.array_equal(plant.C, np.eye(4)[1:])
        assert plant.dt == 1.0

    def test_wang2015_printed_psi(self) -> None:
        plant = load_spec(DESIGNS / "wang2015_printed_psi" / "spec.yaml").plant
        assert np.array_equal(plant.Bf, np.column_stack([plant.A[:, 0], plant.B[:, 1]]))
        # The printed Psi = T F with the printed T.
        printed_psi = np.array([[0.9, 0], [0.0025, 0.5], [0.0475, 0.5], [1, 0]])
        np.testing.assert_allclose(np.diag([1, 0.5, 0.5, 1]) @ plant.Bf, printed_psi, rtol=1e-15)

    def test_smib(self) -> None:
        spec = load_spec(DESIGNS / "smib" / "spec.yaml")
        assert spec.transformation is not None
        assert spec.transformation.source.nx == 34
        plant = spec.plant
        assert (plant.nx, plant.ny, plant.nf, plant.nd, plant.nw, plant.dt) == (4, 3, 1, 1, 3, 0.02)
        # The unknown power reaches two of the outputs directly.
        assert np.count_nonzero(plant.Dd) == 2
        assert np.count_nonzero(plant.Df) == 0
        np.testing.assert_array_equal(plant.Dw, np.diag([1e-4, 1e-3, 1e-3]))

    @pytest.mark.long
    def test_every_design_folder_has_a_spec_with_its_name(self) -> None:
        folders = sorted(path.name for path in DESIGNS.iterdir() if path.is_dir())
        assert {"smib", "wang2015", "wang2015_printed_psi"} <= set(folders)
        for folder in folders:
            for path in sorted((DESIGNS / folder).glob("spec*.yaml")):
                assert load_spec(path).name.startswith(folder)


class TestMethods:
    @pytest.mark.parametrize("method", REGISTRY)
    def test_the_schema_has_the_options_and_defaults_of_the_function(self, method: str) -> None:
        parameters = inspect.signature(getattr(obsynth, method.replace("-", "_"))).parameters
        # Plant, name and scenario are parts of a spec of their own.
        own = ("plant", "name", "scenario")
        of_function = {name: p.default for name, p in parameters.items() if name not in own}
        fields = options_schema(method).model_fields
        assert {name: field.default for name, field in fields.items()} == of_function


THERMAL = Path(__file__).parents[2] / "docs" / "examples" / "thermal" / "spec.yaml"


def with_text(tmp_path, before, after):
    text = THERMAL.read_text(encoding="utf-8")
    assert before in text
    path = tmp_path / "spec.yaml"
    path.write_text(text.replace(before, after, 1), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("sensor_noise: {heater: 0.1,", "sensor_noise: {heater: 0.1 K,"),
        ("operating_point: {power: 100,", "operating_point: {power: 100 W,"),
        ("heater: 175.45,", "heater: 175.45 degC,"),
    ],
)
def test_numbers_with_the_unit_that_is_stated_are_numbers(tmp_path, before, after):
    plain, written = load_spec(THERMAL).plant, load_spec(with_text(tmp_path, before, after)).plant
    assert written.operating_point == plain.operating_point
    assert np.array_equal(written.Dw, plain.Dw)


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ("units: {power: W, ", "units: {", r"plant: operating_point\.power is in W, but units states none"),
        ("heater: 175.45,", "heater: 448.6 K,", r"operating_point\.heater: kelvin is not degC"),
        ("sensor_noise: {heater: 0.1,", "sensor_noise: {heater: 0.1 V,", r"sensor_noise\.heater is in V"),
    ],
)
def test_numbers_in_another_unit_are_not_taken_as_they_are(tmp_path, before, after, words, monkeypatch):
    monkeypatch.setattr("obsynth.numerics.measurement_units.find_spec", lambda name: None)
    path = with_text(tmp_path, before, after)
    path.write_text(path.read_text().replace("point: {power: 100,", "point: {power: 100 W,"), encoding="utf-8")
    with pytest.raises(SpecError, match=words):
        load_spec(path)


def test_numbers_in_another_unit_are_converted(tmp_path):
    pytest.importorskip("pint", reason="pint is not installed (obsynth[units])")
    plant = load_spec(with_text(tmp_path, "point: {power: 100,", "point: {power: 0.1 kW,")).plant
    assert np.isclose(plant.operating_point["power"], 100.0)


def test_times_of_profiles_may_have_a_unit(tmp_path):
    path = tmp_path / "spec.yaml"
    scenario = "scenario:\n  horizon: 1 h\n  faults: {heater fault: {kind: step, size: 1, start: 10 min, end: 0.5 h}}\n"
    path.write_text(THERMAL.read_text(encoding="utf-8") + scenario, encoding="utf-8")
    (profile,) = load_spec(path).scenario.faults["heater fault"]
    assert (profile.start, profile.end) == (600.0, 1800.0)
    path.write_text(path.read_text().replace("10 min", "10 parsecs"), encoding="utf-8")
    with pytest.raises(SpecError, match="a time in us, ms, s, min or h"):
        load_spec(path)


def test_a_name_with_a_space_is_answered_with_one_that_is_taken(tmp_path: Path) -> None:
    """The message said which letters a name may have, and left the name to the reader."""
    path = tmp_path / "spec.yaml"
    path.write_text("schema_version: 1\nname: quarter car\nplant: {dt: 1, A: [[0.5]], C: [[1]], Bf: [[1]]}\n")
    with pytest.raises(SpecError, match="'quarter-car', for example; description takes any text") as failure:
        load_spec(path)
    path.write_text(path.read_text().replace("quarter car", "quarter-car"))
    assert load_spec(path).name == "quarter-car"
    assert "quarter car" in str(failure.value)
