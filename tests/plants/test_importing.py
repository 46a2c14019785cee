"""Models of other tools as plants: matrices, names, roles of inputs, operating points."""

from __future__ import annotations

import gc
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import scipy.signal

import obsynth
from obsynth import DescriptorSystem, PreconditionError, SpecError

ROOT = Path(__file__).parents[2]
A = np.array([[-1.0, 2.0], [0.0, -3.0]])
B = np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 2.0]])
C = np.array([[1.0, 0.0], [1.0, 1.0]])
D = np.array([[0.0, 0.0, 0.1], [0.0, 0.0, 0.0]])


def test_a_system_of_python_control_keeps_its_labels():
    control = pytest.importorskip("control")
    system = control.ss(A, B, C, D, inputs=["drive", "load", "leak"], outputs=["speed", "flow"], states=["w", "q"])
    plant = obsynth.from_control(
        system, faults=["leak"], disturbances=["load"], actuator_faults=["drive"], sensor_faults=["flow"],
        sensor_noise={"speed": 0.1},
    )  # fmt: skip
    assert (plant.state_names, plant.input_names) == (("w", "q"), ("drive",))
    assert plant.output_names == ("speed", "flow")
    assert plant.fault_names == ("leak", "fault of drive", "bias of flow")
    assert plant.disturbance_names == ("load",)
    assert np.array_equal(plant.B, B[:, :1])
    assert np.array_equal(plant.Bf, np.hstack([B[:, [2, 0]], np.zeros((2, 1))]))
    assert np.array_equal(plant.Df, np.hstack([D[:, [2, 0]], [[0.0], [1.0]]]))
    assert np.array_equal(plant.Bd, B[:, [1]])
    assert plant.dt == 0.0
    assert np.array_equal(plant.Dw, [[0.1], [0.0]])


def test_sampling_times_of_python_control():
    control = pytest.importorskip("control")
    assert obsynth.from_control(control.ss(A, B, C, D, 0.1)).dt == 0.1
    with pytest.raises(SpecError, match=r"has no sampling time"):
        obsynth.from_control(control.ss(A, B, C, D, True))
    assert obsynth.from_control(control.ss(A, B, C, D, True), dt=0.5).dt == 0.5
    with pytest.raises(SpecError, match=r"leave dt out"):
        obsynth.from_control(control.ss(A, B, C, D, 0.1), dt=0.2)
    with pytest.raises(SpecError, match=r"StateSpace"):
        obsynth.from_control("system")
    transfer = obsynth.from_control(control.tf([1.0], [1.0, 2.0]))
    assert np.allclose(-transfer.C @ np.linalg.solve(transfer.A, transfer.B), 0.5)


def test_a_descriptor_system_from_control_takes_its_own_e():
    control = pytest.importorskip("control")
    singular = np.diag([1.0, 0.0])
    assert np.array_equal(obsynth.from_control(control.ss(A, B, C, D), E=singular).E, singular)


def test_what_is_no_system_of_python_control_is_named_with_what_reads_it():
    pytest.importorskip("control")
    with pytest.raises(SpecError, match="from_scipy reads it"):
        obsynth.from_control(scipy.signal.lti([1.0], [1.0, 1.0]))


def test_a_static_gain_is_named():
    control = pytest.importorskip("control")
    with pytest.raises(SpecError, match="a static gain"):
        obsynth.from_control(control.ss([], [], [], [[3.0]]))


def test_state_spaces_of_scipy():
    plant = obsynth.from_scipy(scipy.signal.StateSpace(A, B, C, D), input_names=["a", "b", "c"], faults=["c"])
    assert plant.input_names == ("a", "b")
    assert np.array_equal(plant.Df, D[:, [2]])
    assert obsynth.from_scipy(scipy.signal.StateSpace(A, B, C, D, dt=0.2)).dt == 0.2
    assert obsynth.from_scipy(scipy.signal.TransferFunction([1.0], [1.0, 2.0])).nx == 1
    with pytest.raises(SpecError, match=r"StateSpace"):
        obsynth.from_scipy((A, B, C, D))


@pytest.mark.parametrize(
    ("roles", "words"),
    [
        ({"faults": ["u9"]}, ["faults", "'u9'"]),
        ({"faults": ["u1"], "disturbances": ["u1"]}, ["'u1'", "fault", "disturbance"]),
        ({"faults": "u1"}, ["list of names"]),
        ({"faults": ["u1", "u1"]}, ["repeats"]),
        ({"actuator_faults": ["u1"], "faults": ["u1"]}, ["no known input"]),
        ({"faults": ["u1"], "Bf": np.eye(2)}, ["both given", "Bf"]),
        ({"sensor_faults": ["y7"]}, ["sensor_faults", "'y7'"]),
    ],
)
def test_wrong_roles_are_refused(roles, words):
    with pytest.raises(SpecError) as caught:
        obsynth.from_scipy(scipy.signal.StateSpace(A, B, C, D), **roles)
    assert all(word in str(caught.value) for word in words)


def test_symbols_of_sympy_are_parameters():
    sympy = pytest.importorskip("sympy", reason="sympy is not installed (obsynth[sympy])")
    m, k, x, v = sympy.symbols("m k x v")
    matrix = sympy.Matrix([[0, 1], [-k / m, -sympy.Rational(1, 10) / m]])
    plant = obsynth.from_sympy(
        matrix, sympy.Matrix([0, 1 / m]), sympy.Matrix([[1, 0]]), parameters={m: 3.0, "k": 0.7},
        state_names=[x, v], Bf=[[0], [1 / m]], dt=0,
    )  # fmt: skip
    assert np.array_equal(plant.A, [[0.0, 1.0], [-0.7 / 3.0, -0.1 / 3.0]])
    assert plant.state_names == ("x", "v")
    assert plant.Bf[1, 0] == 1.0 / 3.0
    with pytest.raises(SpecError, match=r"without a value: k"):
        obsynth.from_sympy(matrix, parameters={"m": 1.0})
    with pytest.raises(SpecError, match=r"no real number|finite real"):
        obsynth.from_sympy(matrix, parameters={"m": 0.0, "k": 1.0})
    with pytest.raises(SpecError, match=r"No matrix holds the symbol 'mm'.*'m'"):
        obsynth.from_sympy(matrix, parameters={"m": 1.0, "k": 1.0, "mm": 2.0})


def test_labels_of_frames_are_names_and_decide_the_order():
    pandas = pytest.importorskip("pandas")
    states, swapped = ["w", "q"], ["q", "w"]
    frame = pandas.DataFrame(A, index=states, columns=states)
    outputs = pandas.DataFrame(C, index=["speed", "flow"], columns=states)
    inputs = pandas.DataFrame(B, index=states, columns=["a", "b", "c"])
    faults = pandas.DataFrame([[1.0], [2.0]], index=states, columns=["leak"])
    plain = DescriptorSystem(None, A, B, C, Bf=[[1.0], [2.0]], dt=0.1)
    for make in (obsynth.from_pandas, lambda *matrices, **more: DescriptorSystem(None, *matrices, **more)):
        plant = make(frame, inputs.loc[swapped], outputs[swapped], Bf=faults.loc[swapped], dt=0.1)
        for name in ("A", "B", "C", "Bf"):
            assert np.array_equal(getattr(plant, name), getattr(plain, name)), name
        assert plant.state_names == ("w", "q")
        assert plant.input_names == ("a", "b", "c")
        assert plant.output_names == ("speed", "flow")
        assert plant.fault_names == ("leak",)
    with pytest.raises(SpecError, match=r"columns of C.*lack 'q'.*have 'r'"):
        DescriptorSystem(None, frame, None, outputs.rename(columns={"q": "r"}))
    with pytest.raises(SpecError, match=r"repeat"):
        DescriptorSystem(None, pandas.DataFrame(A, index=["w", "w"], columns=["w", "q"]))


def test_a_frame_without_labels_is_a_matrix():
    pandas = pytest.importorskip("pandas")
    plant = DescriptorSystem(None, pandas.DataFrame(A), pandas.DataFrame(B), C)
    assert plant.state_names == ("x1", "x2")
    assert np.array_equal(plant.B, B)


def test_a_struct_of_matlab(tmp_path):
    singular = np.diag([1.0, 0.0])
    names = np.array([["w"], ["q"]], dtype=object)
    inputs, outputs = np.array([["a"], ["b"], ["c"]], dtype=object), np.array([[""], [""]], dtype=object)
    struct = {"E": singular, "A": A, "B": B, "C": C, "D": D, "Ts": 0.1, "StateName": names, "InputName": inputs,
              "OutputName": outputs}  # fmt: skip
    scipy.io.savemat(tmp_path / "plant.mat", {"sys": struct, "other": np.eye(2)})
    plant = obsynth.from_matlab(tmp_path / "plant.mat", faults=["c"])
    assert (plant.state_names, plant.input_names, plant.output_names) == (("w", "q"), ("a", "b"), ("y1", "y2"))
    assert np.array_equal(plant.E, singular)
    assert np.array_equal(plant.Bf, B[:, [2]])
    assert plant.dt == 0.1
    with pytest.raises(SpecError, match=r"no struct 'plant'.*'sys'"):
        obsynth.from_matlab(tmp_path / "plant.mat", "plant")
    with pytest.raises(SpecError, match=r"leave dt out"):
        obsynth.from_matlab(tmp_path / "plant.mat", dt=0.2)


def test_a_file_of_matlab_with_the_matrices_themselves(tmp_path):
    import scipy.sparse

    scipy.io.savemat(tmp_path / "plant.mat", {"A": scipy.sparse.csc_array(A), "B": B, "C": C})
    with pytest.raises(SpecError, match=r"sampling time"):
        obsynth.from_matlab(tmp_path / "plant.mat")
    plant = obsynth.from_matlab(tmp_path / "plant.mat", dt=0)
    assert np.array_equal(plant.A, A)
    (tmp_path / "broken.mat").write_bytes(b"MATLAB")
    with pytest.raises(SpecError, match=r"cannot be read"):
        obsynth.from_matlab(tmp_path / "broken.mat")
    with pytest.raises(SpecError, match=r"does not exist"):
        obsynth.from_matlab(tmp_path / "none.mat")


def test_the_linear_model_of_openmodelica():
    """The file is in the form that OpenModelica 1.2x writes, of a motor with a flexible shaft."""
    path = Path(__file__).parent / "linear_models" / "linearized_model.mo"
    plant = obsynth.from_modelica(path, disturbances=["load.tau"], sensor_faults=["theta"])
    assert plant.state_names == ("motor.i", "motor.w", "shaft.phi_rel", "load.w")
    assert plant.input_names == ("v",)
    assert plant.output_names == ("theta", "motor.w")
    assert np.array_equal(plant.A[0], [-2000.0, -50.0, 0.0, 0.0])
    assert np.array_equal(plant.Bd[:, 0], [0.0, 0.0, 0.0, -1250.0])
    assert plant.operating_point["motor.i"] == 1.5
    assert plant.operating_point["v"] == 24.0
    with pytest.raises(SpecError, match=r"no linear model"):
        obsynth.from_modelica(ROOT / "README.md")
    with pytest.raises(SpecError, match=r"none.mo does not exist"):
        obsynth.from_modelica("none.mo")


@pytest.mark.parametrize("fault", [("A[n, n] =\n\t[", "A[n, n] =\n\t[1, ")])
def test_a_damaged_linear_model_is_refused(tmp_path, fault):
    text = (Path(__file__).parent / "linear_models" / "linearized_model.mo").read_text().replace(*fault)
    (tmp_path / "model.mo").write_text(text)
    with pytest.raises(SpecError, match=r"A is not 4 by 4"):
        obsynth.from_modelica(tmp_path / "model.mo")


def test_the_pencil_of_andes_as_shipped_in_designs():
    spec = obsynth.load_spec(ROOT / "designs" / "smib" / "spec.yaml")
    plant = obsynth.from_andes(
        ROOT / "designs" / "smib", outputs={"GENCLS 1": ["omega"], "Bus 1": ["a", "v"]}, faults=["tm GENCLS 1"],
        disturbances={"Bus 3": ["a"]},
        sensor_noise={"omega GENCLS 1": 1e-4, "a Bus 1": 1e-3, "v Bus 1": 1e-3},
    )  # fmt: skip
    written = spec.transformation.source
    for name in ("E", "A", "C", "Bf", "Bd", "Dw", "Bw"):
        # Entries of A are expressions in constants with tolerances there: equal to rounding.
        np.testing.assert_allclose(getattr(plant, name), getattr(written, name), rtol=1e-12, atol=1e-12, err_msg=name)
    assert plant.state_names == written.state_names
    with pytest.raises(SpecError, match=r"no device 'GENROU 1'.*GENCLS 1"):
        obsynth.from_andes(ROOT / "designs" / "smib", outputs={"GENROU 1": ["omega"]})
    with pytest.raises(SpecError, match=r"no variable 'speed'.*omega"):
        obsynth.from_andes(ROOT / "designs" / "smib", outputs={"GENCLS 1": ["speed"]})


# Andes leaves a pool of processes open; it is collected within the test, where the filter is on.
@pytest.mark.filterwarnings("ignore:unclosed running multiprocessing pool:ResourceWarning")
def test_a_case_of_andes(tmp_path):
    andes = pytest.importorskip("andes", reason="andes is not installed (obsynth[andes]); it is licensed under the GPL")
    outputs = {"GENCLS 1": ["omega"], "Bus 1": ["a", "v"]}
    plant = obsynth.from_andes(andes.get_case("smib/SMIB.json"), outputs=outputs, faults=["tm GENCLS 1"])
    shipped = obsynth.from_andes(ROOT / "designs" / "smib", outputs=outputs, faults=["tm GENCLS 1"])
    assert plant.state_names == shipped.state_names
    assert np.array_equal(plant.E, shipped.E)
    assert np.allclose(plant.A, shipped.A, rtol=0, atol=1e-12)
    assert plant.operating_point["omega GENCLS 1"] == 1.0
    gc.collect()


def test_a_folder_without_a_pencil_is_refused(tmp_path):
    with pytest.raises(SpecError, match=r"no E\.mtx"):
        obsynth.from_andes(tmp_path, outputs=["v"])
    for name in ("E.mtx", "A.mtx"):
        (tmp_path / name).write_text((ROOT / "designs" / "smib" / name).read_text())
    (tmp_path / "names.json").write_text(json.dumps({"differential": []}))
    with pytest.raises(SpecError, match=r"no pencil"):
        obsynth.from_andes(tmp_path, outputs=["v"])


LEVEL = (0.2 / 0.1) ** 2


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_an_fmu_is_linearised_at_its_equilibrium(tmp_path, version):
    from tank_fmu import tank

    path = tank(tmp_path, version)
    with pytest.raises(PreconditionError, match=r"no equilibrium: 'level' changes by 0\.05 per second"):
        obsynth.from_fmu(path)
    plant = obsynth.from_fmu(
        path, at={"area": 2.0, "inflow": 0.2}, equilibrium=True, disturbances=["supply temperature"],
        actuator_faults=["inflow"],
    )  # fmt: skip
    rate, volume = 0.1 / (2.0 * np.sqrt(LEVEL)), 2.0 * LEVEL
    assert plant.state_names == ("level", "temperature")
    assert plant.output_names == ("level", "outflow", "temperature")
    assert plant.operating_point["level"] == pytest.approx(LEVEL, rel=1e-7)
    assert plant.operating_point["outflow"] == pytest.approx(0.2, rel=1e-7)
    assert np.allclose(plant.A, [[-rate / 2.0, 0.0], [0.0, -0.2 / volume]], rtol=1e-7, atol=0)
    assert np.allclose(plant.B, [[0.5], [0.0]])
    assert np.allclose(plant.Bd, [[0.0], [0.2 / volume]], rtol=1e-7)
    assert np.allclose(plant.C, [[1.0, 0.0], [rate, 0.0], [0.0, 1.0]], rtol=1e-7)
    assert plant.units["level"] == "m"
    assert plant.fault_names == ("fault of inflow",)
    assert obsynth.from_fmu(path, at={"level": LEVEL}).operating_point["level"] == LEVEL


def test_what_is_no_such_fmu_is_refused(tmp_path):
    from tank_fmu import tank

    path = tank(tmp_path, "2.0")
    with pytest.raises(SpecError, match=r"'levl'.*'level'"):
        obsynth.from_fmu(path, at={"levl": 1.0})
    with pytest.raises(SpecError, match=r"inputs: the FMU has no 'flow'"):
        obsynth.from_fmu(path, inputs=["flow"])
    with pytest.raises(SpecError, match=r"finite"):
        obsynth.from_fmu(path, at={"level": float("nan")})
    (tmp_path / "text.fmu").write_text("no archive")
    with pytest.raises(SpecError, match=r"text\.fmu cannot be used as an FMU: File is not a zip"):
        obsynth.from_fmu(tmp_path / "text.fmu")
    with pytest.raises(SpecError, match=r"does not exist"):
        obsynth.from_fmu(tmp_path / "none.fmu")


def test_a_spec_may_have_its_plant_in_a_mat_file(tmp_path):
    struct = {"E": np.diag([1.0, 1.0, 0.0]), "A": [[-1, 0.2, 0.1], [0.1, -2, 1], [0.5, 0.5, -1]],
              "B": [[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]], "C": [[1.0, 0, 0], [0, 1.0, 0]], "Ts": 0.0}  # fmt: skip
    scipy.io.savemat(tmp_path / "plant.mat", {"sys": struct})
    spec = tmp_path / "spec.yaml"
    lines = "plant: {file: plant.mat, faults: [u2], sensor_noise: {y1: 0.1}, transform: {sample_time: 0.1}}"
    spec.write_text(f"schema_version: 1\nname: mat\n{lines}\n")
    found = obsynth.load_spec(spec)
    own = obsynth.discretise(obsynth.from_matlab(tmp_path / "plant.mat", faults=["u2"], sensor_noise={"y1": 0.1}), 0.1)
    assert np.array_equal(found.plant.Bf, own.plant.Bf)
    assert np.array_equal(found.plant.Dw, own.plant.Dw)
    assert found.transformation.recovery.names == ("x1", "x2", "x3")
    assert obsynth.design(found.plant, "fault-estimation-filter").report.passed
    spec.write_text("schema_version: 1\nname: mat\nplant: {file: plant.mat, faults: [u3, u9]}\n")
    with pytest.raises(obsynth.SpecError, match="'u3'") as error:
        obsynth.load_spec(spec)
    assert str(error.value).startswith(str(spec))
    (tmp_path / "plant.yaml").write_text("schema_version: 1\ndt: 0\nA: [[-1]]\nC: [[1]]\n")
    spec.write_text("schema_version: 1\nname: mat\nplant: {file: plant.yaml, faults: [u3]}\n")
    with pytest.raises(obsynth.SpecError, match=r"plant\.faults: unknown key beside a file that is no \.mat"):
        obsynth.load_spec(spec)


def with_description(built, before, after):
    """Return an FMU whose description has another text in one place."""
    changed = built.with_name("changed.fmu")
    with zipfile.ZipFile(built) as source, zipfile.ZipFile(changed, "w") as target:
        for name in source.namelist():
            data = source.read(name)
            if name == "modelDescription.xml":
                assert before.encode() in data
                data = data.replace(before.encode(), after.encode())
                data = data.replace(b"</UnitDefinitions>", b'<Unit name="min"/></UnitDefinitions>')
            target.writestr(name, data)
    return changed


@pytest.mark.long
@pytest.mark.parametrize(
    ("version", "before", "after", "words"),
    [
        ("3.0", 'variability="continuous"/></ModelVariables>', 'variability="continuous" unit="min"/></ModelVariables>',
         "'time' is in 'min'"),
        ("3.0", "</ModelVariables>", '<Clock name="tick" valueReference="50" causality="local" '
         'intervalVariability="constant" intervalDecimal="0.1"/></ModelVariables>', "the clock 'tick'"),
        ("3.0", "</ModelVariables>", '<Boolean name="open" valueReference="51" causality="input" variability="discrete"'
         ' start="false"/></ModelVariables>', r"inputs open \(Boolean\) are no continuous"),
        ("2.0", "</ModelVariables>", '<ScalarVariable name="mode" valueReference="52" causality="input" '
         'variability="discrete"><Integer start="1"/></ScalarVariable></ModelVariables>',
         r"inputs mode \(Integer\) are no"),
        ("2.0", 'name="outflow" valueReference="5" causality="output" variability="continuous"',
         'name="outflow" valueReference="5" causality="output" variability="discrete"', "outputs outflow are no"),
        ("3.0", "</ModelVariables>", '<Boolean name="full" valueReference="53" causality="output" '
         'variability="discrete"/></ModelVariables>', r"outputs full \(Boolean\) are no .* the others are left out"),
        ("2.0", "</ModelVariables>", '<ScalarVariable name="stage" valueReference="54" causality="output" '
         'variability="discrete"><Integer/></ScalarVariable></ModelVariables>', r"outputs stage \(Integer\) are no"),
    ],
)  # fmt: skip
def test_what_a_description_of_an_fmu_says_and_a_linear_model_does_not_have_is_named(
    tmp_path, version, before, after, words
):
    pytest.importorskip("fmpy", reason="fmpy is not installed (obsynth[fmu])")
    from tank_fmu import tank

    changed = with_description(tank(tmp_path, version), before, after)
    with pytest.raises(SpecError, match=words):
        obsynth.from_fmu(changed, equilibrium=True)


def test_outputs_of_an_fmu_that_are_named_leave_out_a_boolean_one(tmp_path):
    pytest.importorskip("fmpy", reason="fmpy is not installed (obsynth[fmu])")
    from tank_fmu import tank

    full = '<Boolean name="full" valueReference="53" causality="output" variability="discrete"/></ModelVariables>'
    path = with_description(tank(tmp_path, "3.0"), "</ModelVariables>", full)
    plant = obsynth.from_fmu(path, equilibrium=True, outputs=["level", "outflow"])
    assert plant.output_names == ("level", "outflow")
    with pytest.raises(SpecError, match=r"'full' is of type Boolean.*leave it out of outputs"):
        obsynth.from_fmu(path, equilibrium=True, outputs=["level", "full"])
