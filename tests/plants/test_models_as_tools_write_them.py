"""Linear models as Simulink, Dymola, OpenModelica, sympy and spreadsheets write them."""

from __future__ import annotations

from pathlib import Path

import control
import numpy as np
import pandas as pd
import pytest
import scipy.io
import scipy.signal
import sympy
from sympy.physics.mechanics import dynamicsymbols

import obsynth
from obsynth.plants.importing import matlab_models

A, B, C, D = np.array([[-1.0, 1.0], [0.5, -2.0]]), np.array([[0.0], [3.0]]), np.array([[4.0, 0.0]]), np.array([[0.5]])

LINEAR_MODEL = Path(__file__).parent / "linear_models" / "linearized_model.mo"


def cells(*texts):
    return np.array([[text] for text in texts], dtype=object)


def linmod(**changes):
    """A struct as ``sys = linmod('model')`` returns it."""
    names = {"StateName": cells("m/A", "m/B"), "OutputName": cells("m/Out1"), "InputName": cells("m/In1")}
    point = {"x": np.array([[1.0], [0.5]]), "u": np.array([[2.0]]), "t": 0.0}
    return {"a": A, "b": B, "c": C, "d": D, **names, "OperPoint": point, "Ts": 0.0, **changes}


def read(tmp_path, struct):
    scipy.io.savemat(tmp_path / "plant.mat", {"sys": struct})
    return obsynth.from_matlab(tmp_path / "plant.mat")


def assert_matrices(plant):
    for name, matrix in (("A", A), ("B", B), ("C", C), ("D", D)):
        np.testing.assert_array_equal(getattr(plant, name), matrix)


def test_what_linmod_returns_is_read_with_its_operating_point(tmp_path):
    plant = read(tmp_path, linmod())
    assert_matrices(plant)
    assert dict(plant.operating_point) == {"m/A": 1.0, "m/B": 0.5, "m/In1": 2.0}
    without_inputs = {"x": np.array([[1.0], [0.5]]), "u": np.zeros((0, 0)), "t": 0.0}
    assert dict(read(tmp_path, linmod(OperPoint=without_inputs)).operating_point) == {"m/A": 1.0, "m/B": 0.5}


def test_an_operating_point_that_is_a_struct_of_blocks_is_refused(tmp_path):
    with pytest.raises(obsynth.SpecError, match=r"OperPoint.x is a struct"):
        read(tmp_path, linmod(OperPoint={"x": {"time": 0.0}, "u": np.array([[2.0]]), "t": 0.0}))


@pytest.mark.parametrize(
    ("names", "wanted"),
    [
        (("m/Plant", "m/Plant"), ("m/Plant", "m/Plant (2)")),
        (("m/Transfer\nFcn", "m/Int"), ("m/Transfer Fcn", "m/Int")),
        (("m/Int", ""), ("m/Int", "x2")),
    ],
)
def test_names_of_blocks_are_names_of_states(tmp_path, names, wanted):
    assert read(tmp_path, linmod(StateName=cells(*names))).state_names == wanted


def test_an_object_of_matlab_is_named_with_what_to_save(tmp_path, monkeypatch):
    held = np.empty((1,), dtype=[("s0", "O"), ("s1", "O"), ("s2", "O"), ("arr", "O")])
    held[0] = (b"sys", b"MCOS", b"ss", np.zeros((6, 1), dtype=np.uint32))
    path = tmp_path / "plant.mat"
    path.touch()
    monkeypatch.setattr(matlab_models, "mat_arrays", lambda source: {"sys": scipy.io.matlab.MatlabOpaque(held)})
    for variable in (None, "sys"):
        with pytest.raises(obsynth.SpecError, match=r"sys is an object of MATLAB's class ss, .* s = struct\(sys\)"):
            obsynth.from_matlab(path, variable)


def test_the_linear_model_of_dymola(tmp_path):
    path = tmp_path / "dslin.mat"
    names = np.array(["tank.level", "tank.T    ", "pump      ", "gauge     "])
    content = {"ABCD": np.block([[A, B], [C, D]]), "nx": 2.0, "xuyName": names}
    scipy.io.savemat(path, content, format="4")
    for plant in (obsynth.from_modelica(path), obsynth.from_matlab(path)):
        assert_matrices(plant)
        assert (plant.dt, plant.state_names, plant.input_names) == (0.0, ("tank.level", "tank.T"), ("pump",))
        assert plant.output_names == ("gauge",)
    assert obsynth.from_modelica(path, faults=["pump"]).fault_names == ("pump",)
    scipy.io.savemat(path, {**content, "xuyName": names[:3]}, format="4")
    with pytest.raises(obsynth.SpecError, match="do not fit together"):
        obsynth.from_modelica(path)


@pytest.mark.parametrize(("inputs", "outputs"), [("p", "q"), ("k", "l")])
def test_older_versions_of_openmodelica_call_the_sizes_otherwise(tmp_path, inputs, outputs):
    text = LINEAR_MODEL.read_text().replace("model linearized_model", "model linear_Drive")
    renamed = {"Integer p": f"Integer {outputs}", "Integer m": f"Integer {inputs}", "u0[m]": f"u0[{inputs}]"}
    renamed |= {"zeros(p, m)": f"zeros({outputs}, {inputs})", "[p, m]": f"[{outputs}, {inputs}]"}
    for before, after in renamed.items():
        assert before in text
        text = text.replace(before, after)
    path = tmp_path / "linear_Drive.mo"
    path.write_text(text)
    older, newer = obsynth.from_modelica(path), obsynth.from_modelica(LINEAR_MODEL)
    assert (older.input_names, older.output_names) == (newer.input_names, newer.output_names)
    np.testing.assert_array_equal(older.B, newer.B)
    np.testing.assert_array_equal(older.C, newer.C)


def test_a_linear_model_in_another_language_says_how_to_get_one_in_modelica(tmp_path):
    path = tmp_path / "linearized_model.py"
    path.write_text("def linearized_model():\n    n = 2 # number of states\n")
    with pytest.raises(obsynth.SpecError, match="linearizationDumpLanguage=modelica"):
        obsynth.from_modelica(path)


def test_a_sampled_system_is_not_taken_as_continuous():
    for read_system, system in (
        (obsynth.from_control, control.ss([[0.5]], [[1.0]], [[1.0]], [[0.0]], True)),
        (obsynth.from_scipy, scipy.signal.dlti([1.0], [1.0, -0.5])),
    ):
        with pytest.raises(obsynth.SpecError, match="sampled"):
            read_system(system, dt=0.0)
        assert read_system(system, dt=0.1).dt == 0.1


def test_what_another_function_reads_is_named():
    system = control.ss(A, B, C, D)
    with pytest.raises(obsynth.SpecError, match="from_control reads it"):
        obsynth.from_scipy(system)
    pendulum = control.nlsys(lambda t, x, u, p: -x + u, inputs=1, outputs=1, states=1)
    with pytest.raises(obsynth.SpecError, match=r"control\.linearize"):
        obsynth.from_control(pendulum)


def test_functions_of_time_in_sympy_have_values_at_the_point():
    theta, k = dynamicsymbols("theta"), sympy.Symbol("k")
    rate = theta.diff()
    matrix = sympy.Matrix([[0, 1], [-k * sympy.cos(theta), -rate]])
    values = {k: 2, theta: 0, rate: sympy.Rational(1, 2)}
    plant = obsynth.from_sympy(matrix, C=[[1, 0]], parameters=values)
    assert plant.A.tolist() == [[0.0, 1.0], [-2.0, -0.5]]
    del values[theta]
    with pytest.raises(obsynth.SpecError, match=r"without a value: theta\(t\)\."):
        obsynth.from_sympy(matrix, C=[[1, 0]], parameters=values)


@pytest.mark.parametrize("kind", [sympy.Array, lambda rows: np.array(rows, dtype=object)])
def test_arrays_of_symbols_are_matrices_too(kind):
    k = sympy.Symbol("k")
    plant = obsynth.from_sympy(kind([[0, 1], [-k, -1]]), C=kind([[1, 0]]), parameters={k: 2})
    assert plant.A.tolist() == [[0.0, 1.0], [-2.0, -1.0]]


def test_a_state_space_of_sympy_says_what_to_give():
    from sympy.physics.control.lti import StateSpace

    model = StateSpace(sympy.Matrix([[-1]]), sympy.Matrix([[1]]), sympy.Matrix([[1]]), sympy.Matrix([[0]]))
    with pytest.raises(obsynth.SpecError, match=r"from_sympy\(model\.A"):
        obsynth.from_sympy(model)
    assert obsynth.from_sympy(model.A, model.B, model.C, D=model.D).nx == 1


def test_a_workbook_with_a_sheet_for_each_matrix(tmp_path):
    pytest.importorskip("openpyxl")
    states, path = ["level", "flow"], tmp_path / "plant.xlsx"
    with pd.ExcelWriter(path) as book:
        for name, (matrix, rows, columns) in {
            "A": (A, states, states), "B": (B, states, ["pump"]), "C": (C, ["gauge"], states),
        }.items():  # fmt: skip
            pd.DataFrame(matrix, rows, columns).to_excel(book, sheet_name=name)
    plant = obsynth.from_pandas(**pd.read_excel(path, sheet_name=None, index_col=0))
    assert (plant.state_names, plant.input_names, plant.output_names) == (("level", "flow"), ("pump",), ("gauge",))
    np.testing.assert_array_equal(plant.A, A)
    with pytest.raises(obsynth.SpecError, match="index_col=0"):
        obsynth.from_pandas(**pd.read_excel(path, sheet_name=None))


def spec_of(tmp_path, plant):
    path = tmp_path / "spec.yaml"
    path.write_text(f"schema_version: 1\nname: drive\nplant: {plant}\nmethod: {{id: pd-observer}}\n")
    return path


def test_a_spec_may_have_its_plant_in_a_file_of_openmodelica(tmp_path):
    (tmp_path / "drive.mo").write_text(LINEAR_MODEL.read_text())
    plant = obsynth.load_spec(spec_of(tmp_path, "{file: drive.mo, faults: [load.tau]}")).plant
    assert (plant.input_names, plant.fault_names) == (("v",), ("load.tau",))
    with pytest.raises(obsynth.SpecError, match=r"plant\.dt: .*remove it"):
        obsynth.load_spec(spec_of(tmp_path, "{file: drive.mo, dt: 0.1}"))


@pytest.mark.parametrize(("name", "words"), [("plant.xlsx", r"A: \{file: A\.csv\}"), ("plant.fmu", "from_fmu")])
def test_a_spec_says_how_to_read_other_files(tmp_path, name, words):
    (tmp_path / name).write_bytes(b"PK\x03\x04\xff")
    with pytest.raises(obsynth.SpecError, match=words):
        obsynth.load_spec(spec_of(tmp_path, f"{{file: {name}}}"))
