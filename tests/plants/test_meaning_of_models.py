"""What changes the meaning of a model is read or refused by name: units of time, delays, quantities, exact numbers."""

from __future__ import annotations

import json
import sys
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import control
import numpy as np
import pandas as pd
import pytest
import scipy.io
import scipy.signal
import sympy

import obsynth
from obsynth.numerics.quantities import in_unit
from obsynth.plants.importing.andes import _completed_names


def written(tmp_path, **fields):
    path = tmp_path / "plant.mat"
    scipy.io.savemat(path, {"sys": {"A": [[-1.0]], "B": [[1.0]], "C": [[1.0]], **fields}})
    return path


@pytest.mark.parametrize(
    ("unit", "seconds"), [("minutes", 60.0), ("milliseconds", 1e-3), ("hours", 3600.0), ("seconds", 1.0)]
)
def test_a_model_of_matlab_is_read_in_seconds(tmp_path, unit, seconds):
    plant = obsynth.from_matlab(written(tmp_path, Ts=0.0, TimeUnit=unit))
    assert np.isclose(plant.A[0, 0], -1 / seconds, rtol=1e-15)
    assert np.isclose(plant.B[0, 0], 1 / seconds, rtol=1e-15)
    assert plant.C[0, 0] == 1.0
    sampled = obsynth.from_matlab(written(tmp_path, Ts=2.0, TimeUnit=unit))
    assert np.isclose(sampled.dt, 2.0 * seconds, rtol=1e-15)
    assert sampled.A[0, 0] == -1.0


def test_a_sampled_model_without_its_sampling_time_takes_the_one_that_is_given(tmp_path):
    path = written(tmp_path, Ts=-1.0)
    assert obsynth.from_matlab(path, dt=0.1).dt == 0.1
    for given in (None, 0.0):
        with pytest.raises(obsynth.SpecError, match="Ts = -1"):
            obsynth.from_matlab(path, dt=given)
    with pytest.raises(obsynth.SpecError, match="leave dt out"):
        obsynth.from_matlab(written(tmp_path, Ts=0.2), dt=0.1)


def test_units_of_signals_are_read_and_an_unknown_field_is_named(tmp_path):
    fields = {"Ts": 0.0, "OutputUnit": np.array(["V"], dtype=object), "OutputName": np.array(["gauge"], dtype=object)}
    assert obsynth.from_matlab(written(tmp_path, **fields, Notes="")).units == {"gauge": "V"}
    with pytest.raises(obsynth.SpecError, match="Offsets"):
        obsynth.from_matlab(written(tmp_path, Ts=0.0, Offsets=[[1.0]]))
    with pytest.raises(obsynth.SpecError, match="Kalman"):
        obsynth.from_matlab(written(tmp_path, Ts=0.0, Kalman=[[1.0]]))
    with pytest.raises(obsynth.SpecError, match="fortnights"):
        obsynth.from_matlab(written(tmp_path, Ts=0.0, TimeUnit="fortnights"))


def test_a_struct_of_octave_is_read(tmp_path):
    path = tmp_path / "octave.mat"
    lti = {"tsam": 0.25, "inname": np.array(["valve"], dtype=object), "outname": np.array(["level"], dtype=object)}
    scipy.io.savemat(
        path, {"sys": {"a": [[0.5]], "b": [[1.0]], "c": [[2.0]], "d": [[0.0]], "e": np.zeros((0, 0)), "lti": lti}}
    )
    plant = obsynth.from_matlab(path)
    assert (plant.dt, plant.input_names, plant.output_names) == (0.25, ("valve",), ("level",))
    assert plant.C[0, 0] == 2.0


def test_a_damaged_file_is_refused_in_words(tmp_path):
    path = tmp_path / "plant.mat"
    scipy.io.savemat(path, {"A": -np.eye(40), "C": np.eye(40)}, do_compression=True)
    whole = path.read_bytes()
    for place in range(128, len(whole), 7):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :])
        try:
            obsynth.from_matlab(path, dt=0)
        except obsynth.SpecError as error:
            assert "plant.mat" in str(error) or error.problems  # noqa: PT017 (what is not refused may be right)


class Quantity:
    """A number with a unit, as pint has it."""

    factors: ClassVar = {("mV", "V"): 1e-3, ("V", "mV"): 1e3}

    def __init__(self, magnitude, units):
        self.magnitude, self.units = magnitude, units

    def __array__(self, dtype=None, copy=None):
        return np.asarray(self.magnitude, dtype=dtype)

    def to(self, unit):
        return Quantity(self.magnitude * self.factors[self.units, unit], unit)


def test_a_quantity_is_converted_where_the_plant_states_the_unit():
    plant = obsynth.DescriptorSystem(
        A=[[-1.0]], C=[[1.0]], units={"y1": "V"}, sensor_noise={"y1": Quantity(5, "mV")},
        operating_point={"y1": Quantity(2.0, "mV")},
    )  # fmt: skip
    assert np.isclose(plant.Dw[0, 0], 0.005)
    assert np.isclose(plant.operating_point["y1"], 0.002)
    assert in_unit(3.0, None, "x") == 3.0


class FloatQuantity(np.ndarray):
    """A number with a unit, as unyt and astropy have it: an array that also passes for a number."""

    units, value = "mV", property(lambda self: np.asarray(self))


def test_a_quantity_in_the_noise_of_a_model_is_refused_instead_of_stripped():
    model = obsynth.DAEModel(equations={"rate": "der(x) = -x"}, outputs={"y1": "x"}, states={"x": 0.0})
    size = np.array(5.0).view(FloatQuantity)
    with pytest.raises(obsynth.SpecError, match=r"process_noise\.rate is a quantity in mV"):
        obsynth.linearise(model, process_noise={"rate": size})
    with pytest.raises(obsynth.SpecError, match=r"process_noise\.rate is a quantity in mV"):
        obsynth.with_noise(model, process_noise={"rate": size}, dt=0.1)
    for noise in (size, {"deviation": size}, {"deviation": 0.1, "correlation": 2.0, "white": size}):
        with pytest.raises(obsynth.SpecError, match=r"sensor_noise\['y1'\].* is a quantity in mV"):
            obsynth.with_noise(model, sensor_noise={"y1": noise})


def test_a_quantity_is_refused_where_no_unit_is_stated_or_another_one():
    for units in ({}, {"y1": "K"}):
        with pytest.raises(obsynth.SpecError, match="quantity in mV"):
            obsynth.DescriptorSystem(A=[[-1.0]], C=[[1.0]], units=units, sensor_noise={"y1": Quantity(5, "mV")})
    for given in (Quantity([[-1.0]], "1/s"), [[Quantity(-1.0, "1/s")]]):
        with pytest.raises(obsynth.SpecError, match="A is a quantity"):
            obsynth.DescriptorSystem(A=given, C=[[1.0]])
    dimensionless = obsynth.DescriptorSystem(A=[[Quantity(-1.0, "dimensionless")]], C=[[1.0]])
    assert dimensionless.A[0, 0] == -1.0


def response(plant, s):
    return plant.C @ np.linalg.solve(s * plant.E - plant.A, plant.B) + plant.D


@pytest.mark.parametrize(
    ("top", "bottom"),
    [
        ([1, 0, 0], [1, 1]),
        ([2, 1, 3, 1], [1, 2]),
        ([1, 0], [1]),
        ([[[1, 0, 0], [1]], [[1, 2, 3], [1, 0, 0, 4]]], [[[1, 1], [1, 3]], [[2], [1, 5]]]),
    ],
)
def test_an_improper_transfer_function_has_a_descriptor_realisation(top, bottom):
    system = control.tf(top, bottom)
    plant = obsynth.from_control(system)
    for s in (0.3 + 0.7j, 2.0j, 1.5):
        assert np.allclose(response(plant, s), np.atleast_2d(system(s)), rtol=1e-10, atol=1e-10)
    with pytest.raises(obsynth.SpecError, match="later samples"):
        obsynth.from_control(control.tf([1, 0, 0], [1, 0.5], 0.1))


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("coordinate integer hermitian\n2 2 1\n2 1 1\n", [[0, 1], [1, 0]]),
        ("coordinate complex general\n2 2 2\n1 1 1.5 0\n2 1 -2 0.0\n", [[1.5, 0], [-2, 0]]),
        ("array real general\n1 2\n1.0D+00\n-2.5d-1\n", [[1.0, -0.25]]),
        ("array complex symmetric\n2 2\n1 0\n2 0\n3 0\n", [[1, 2], [2, 3]]),
    ],
)
def test_kinds_of_matrix_market_that_hold_real_numbers_are_read(tmp_path, text, wanted):
    from obsynth.specs.matrix_files import read_matrix

    path = tmp_path / "M.mtx"
    path.write_text(f"%%MatrixMarket matrix {text}")
    assert np.array_equal(read_matrix(path, where="A"), wanted)
    path.write_text("%%MatrixMarket matrix coordinate complex general\n1 1 1\n1 1 1 2\n")
    with pytest.raises(obsynth.SpecError, match="complex numbers"):
        read_matrix(path, where="A")


@pytest.mark.parametrize(
    "value", [sympy.Rational(1, 3), Fraction(1, 3), sympy.sqrt(sympy.Rational(1, 9)), Decimal("0.25")]
)
def test_exact_numbers_are_values_of_symbols(value):
    k = sympy.Symbol("k")
    plant = obsynth.from_sympy(sympy.Matrix([[-k]]), C=sympy.Matrix([[1]]), parameters={k: value})
    assert plant.A[0, 0] == -float(value)
    for wrong in (sympy.I, sympy.oo, sympy.Symbol("a"), Decimal("nan")):
        with pytest.raises(obsynth.SpecError, match="finite number"):
            obsynth.from_sympy(sympy.Matrix([[-k]]), C=sympy.Matrix([[1]]), parameters={k: wrong})


def test_nameless_and_repeated_variables_get_the_names_of_their_devices():
    variable = SimpleNamespace(name="p", v_code="y", a=[0, 1])
    load = type("Load", (), {})()
    load.cache, load.idx = SimpleNamespace(all_vars={"p": variable}), SimpleNamespace(v=["L1", "L2"])
    system = SimpleNamespace(models={"Load": load})
    assert _completed_names(system, ["omega", "", "a", "a"], 1) == ["omega", "p Load L1", "p Load L2", "a"]
    assert _completed_names(system, ["omega", "v"], 1) == ["omega", "v"]
    found = _completed_names(system, ["b", "b", "", "x", ""], 5)
    assert len(set(found)) == len(found)


def test_serial_days_are_refused_and_read_by_their_unit():
    plant = obsynth.DescriptorSystem(
        A=[[-0.1]], B=[[0.1]], C=[[1.0]], Bf=[[1.0]], input_names=["u"], output_names=["y"]
    )
    design = obsynth.ui_pi_observer(plant)
    k = np.arange(600)
    for start in (45321.5, 738000.25):
        log = pd.DataFrame({"time": start + k / 86400, "u": np.ones(len(k)), "y": 1 - np.exp(-0.1 * k)})
        with pytest.raises(obsynth.SpecError, match=r"time \[d\]"):
            obsynth.run_on_data(design, log)
        run = obsynth.run_on_data(design, log.rename(columns={"time": "time [d]"}))
        assert (run.table["status"] == "ok").any()
        assert np.isclose(run.table["time"].iloc[-1] - run.table["time"].iloc[0], 599.0, atol=1e-3)


def test_what_a_design_states_of_outliers_is_the_rule_everywhere():
    plant = obsynth.DescriptorSystem(A=[[0.9]], C=[[1.0]], dt=1.0)
    y = np.array([0, 0.1, 0, 5.0, 0, 0.1])
    log = pd.DataFrame({"time": np.arange(6.0), "y1": y})
    for rule in ("none", "gate", "huber"):
        design = obsynth.descriptor_kalman(plant, Q=[[0.01]], R=[[0.01]], outliers=rule)
        own = np.ravel(design.observer.run(y[:, None]).states)
        assert np.allclose(obsynth.run_on_data(design, log).table["xhat[x1]"], own)
    unsaid = obsynth.descriptor_kalman(plant, Q=[[0.01]], R=[[0.01]])
    assert obsynth.run_on_data(unsaid, log).outliers == {"y1": 1}


def test_the_offsets_of_a_linearised_model_are_its_operating_point(tmp_path):
    offsets = {"dx": [[0.0]], "x": [[3.0]], "u": [[2.0]], "y": [[5.0]]}
    plant = obsynth.from_matlab(written(tmp_path, Ts=0.0, Offsets=offsets))
    assert dict(plant.operating_point) == {"x1": 3.0, "u1": 2.0, "y1": 5.0}
    for wrong, words in (
        ({"dx": [[1.0]]}, "no equilibrium"),
        ({"z": [[1.0]]}, "'z'"),
        ({"x": [[1.0, 2.0]]}, "x0 has 2"),
    ):
        with pytest.raises(obsynth.SpecError, match=words):
            obsynth.from_matlab(written(tmp_path, Ts=0.0, Offsets={**offsets, **wrong}))


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"x0": [[1.0, 2.0]]}, "x0 has 2 entries, but there are 1"),
        ({"OutputUnit": np.array(["V", "A"], dtype=object)}, "OutputUnit has 2 entries"),
        ({"dt": 0.5}, "Ts = 0 and dt = 0.5"),
        ({"inputdelay": 0.5}, "did you mean 'InputDelay'"),
    ],
)
def test_fields_that_contradict_the_matrices_are_refused(tmp_path, fields, words):
    with pytest.raises(obsynth.SpecError, match=words):
        obsynth.from_matlab(written(tmp_path, Ts=0.0, **fields))


def test_of_a_file_with_many_variables_misspelt_ones_are_refused_and_others_left(tmp_path):
    path = tmp_path / "workspace.mat"
    matrices = {"A": [[-1.0]], "C": [[1.0]], "Ts": 0.0}
    scipy.io.savemat(path, {**matrices, "Q": [[1.0]]})
    assert obsynth.from_matlab(path).nx == 1
    scipy.io.savemat(path, {**matrices, "timeunit": "minutes"})
    with pytest.raises(obsynth.SpecError, match="did you mean 'TimeUnit'"):
        obsynth.from_matlab(path)


LINEAR_MODEL = Path(__file__).parent / "linear_models" / "linearized_model.mo"


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ("B * u;", "B * u + f0;", "x\\+B\\*u\\+f0"),
        ("der(x)", "60 * der(x)", "60\\*der"),
        ("y = C * x", "y = C * delay(x, 0.5)", "delay"),
        ("parameter Real D", "parameter Real tau = 0.5; parameter Real D", "declares tau"),
    ],
)
def test_what_a_linear_model_of_openmodelica_does_not_have_is_named(tmp_path, before, after, words):
    text = LINEAR_MODEL.read_text()
    assert before in text
    path = tmp_path / "linearized_model.mo"
    path.write_text(text.replace(before, after, 1))
    with pytest.raises(obsynth.SpecError, match=words):
        obsynth.from_modelica(path)


def test_an_attribute_that_is_not_of_python_control_is_named():
    system = control.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]])
    connected = control.interconnect(
        [control.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]], inputs="u", outputs="y", name="first")],
        inputs="u", outputs="y",
    )  # fmt: skip
    assert obsynth.from_control(system).nx == obsynth.from_control(connected).nx == 1
    system.InputDelay = 2.0
    with pytest.raises(obsynth.SpecError, match="InputDelay"):
        obsynth.from_control(system)


def test_a_continuous_system_of_scipy_is_not_taken_as_sampled():
    system = scipy.signal.lti([1.0], [1.0, 0.5])
    with pytest.raises(obsynth.SpecError, match="continuous"):
        obsynth.from_scipy(system, dt=0.1)
    assert obsynth.from_scipy(system, dt=0.0).dt == 0.0


@pytest.mark.parametrize(
    "system",
    [
        scipy.signal.lti([1, 0, 0], [1, 1]),
        scipy.signal.ZerosPolesGain([-1.0, -2.0], [-3.0], 2.0),
        scipy.signal.lti([1, 1], [1, 2, 3]),
    ],
)
def test_transfer_functions_of_scipy_proper_or_not(system):
    plant = obsynth.from_scipy(system, input_names=["pump"])
    function = system.to_tf()
    for s in (0.3 + 0.7j, 2.0j, 1.5):
        wanted = np.polyval(np.ravel(function.num), s) / np.polyval(function.den, s)
        assert np.allclose(response(plant, s), wanted, rtol=1e-10)
    assert plant.input_names == ("pump",)


def test_a_pencil_of_andes_with_an_unknown_key_is_refused(tmp_path):
    shipped = Path(__file__).parents[2] / "designs" / "smib"
    for name in ("E.mtx", "A.mtx"):
        (tmp_path / name).write_bytes((shipped / name).read_bytes())
    names = json.loads((shipped / "names.json").read_text())
    (tmp_path / "names.json").write_text(json.dumps({**names, "time_unit": "ms"}))
    with pytest.raises(obsynth.SpecError, match="time_unit"):
        obsynth.from_andes(tmp_path, outputs=["omega GENCLS 1"])


def hdf5_written(path, fields, *, more=()):
    """Write a struct ``sys`` as MATLAB 7.3 does: columns first, classes as attributes, cells as references."""
    h5py = pytest.importorskip("h5py", reason="h5py is not installed (obsynth[hdf5])")
    with h5py.File(path, "w", userblock_size=512) as file:
        group = file.create_group("sys")
        group.attrs["MATLAB_class"] = np.bytes_("struct")
        for number, (name, value) in enumerate(fields.items()):
            if isinstance(value, str):
                item = group.create_dataset(name, data=np.array([[ord(letter)] for letter in value], dtype=np.uint16))
                item.attrs["MATLAB_class"] = np.bytes_("char")
            elif isinstance(value, list) and value and isinstance(value[0], str):
                names = []
                for i, text in enumerate(value):
                    letters = np.array([[ord(letter)] for letter in text], dtype=np.uint16)
                    cell = file.create_dataset(f"#refs#/{number}{i}", data=letters)
                    cell.attrs["MATLAB_class"] = np.bytes_("char")
                    names.append([cell.ref])
                item = group.create_dataset(name, data=np.array(names, dtype=h5py.ref_dtype).T, dtype=h5py.ref_dtype)
                item.attrs["MATLAB_class"] = np.bytes_("cell")
            elif np.size(value) == 0:
                item = group.create_dataset(name, data=np.zeros(2, dtype=np.uint64))
                item.attrs["MATLAB_class"], item.attrs["MATLAB_empty"] = np.bytes_("double"), 1
            else:
                item = group.create_dataset(name, data=np.atleast_2d(np.asarray(value, dtype=float)).T)
                item.attrs["MATLAB_class"] = np.bytes_("double")
        for name, kind in more:
            item = group.create_dataset(name, data=np.zeros((1, 1)))
            item.attrs["MATLAB_class"] = np.bytes_(kind)
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\0\2IM")
    return path


def test_a_struct_of_matlab_7_3_is_read_as_one_of_an_older_version(tmp_path):
    fields = {
        "A": [[-1.0, 2.0], [0.0, -3.0]], "B": [[1.0], [0.5]], "C": [[1.0, 0.0]], "D": [[0.0]], "E": [], "Ts": 0.0,
        "TimeUnit": "minutes", "StateName": ["level", "flow"], "InputName": ["pump"], "OutputName": ["gauge"],
        "InputDelay": [[0.5]],
    }  # fmt: skip
    plant = obsynth.from_matlab(hdf5_written(tmp_path / "plant.mat", fields))
    old = {
        name: np.array(value, dtype=object)[:, None] if value and isinstance(value[0], str) else value
        for name, value in fields.items()
        if not isinstance(value, (str, float))
    }
    scipy.io.savemat(tmp_path / "old.mat", {"sys": {**old, "Ts": 0.0, "TimeUnit": "minutes"}})
    other = obsynth.from_matlab(tmp_path / "old.mat")
    for name in ("E", "A", "B", "C", "D"):
        assert np.array_equal(getattr(plant, name), getattr(other, name)), name
    assert plant.state_names == other.state_names == ("level", "flow")
    assert dict(plant.delays) == dict(other.delays) == {"pump": 30.0}


def test_what_no_model_has_and_damaged_files_of_7_3_are_refused(tmp_path):
    path = hdf5_written(tmp_path / "odd.mat", {"A": [[-1.0]], "C": [[1.0]], "Ts": 0.0}, more=[("f", "function_handle")])
    with pytest.raises(obsynth.SpecError, match="function_handle"):
        obsynth.from_matlab(path)
    whole = path.read_bytes()
    for count in (600, len(whole) // 2, len(whole) - 200):
        path.write_bytes(whole[:count])
        with pytest.raises(obsynth.SpecError, match=r"odd\.mat"):
            obsynth.from_matlab(path)


@pytest.mark.parametrize("kind", ["ss", "tf", "interval"])
def test_an_object_of_matlab_in_a_file_of_7_3_is_named_with_what_to_save(tmp_path, kind):
    # An object is six marks in whole numbers; of a class that begins as int8 does they were taken for numbers.
    path = hdf5_written(tmp_path / "object.mat", {"A": [[-1.0]], "C": [[1.0]], "Ts": 0.0})
    h5py = pytest.importorskip("h5py", reason="h5py is not installed (obsynth[hdf5])")
    with h5py.File(path, "r+") as file:
        item = file.create_dataset("plant", data=np.array([[0xDD000000, 2, 1, 1, 1, 1]], dtype=np.uint32))
        item.attrs["MATLAB_class"], item.attrs["MATLAB_object_decode"] = np.bytes_(kind), np.int32(3)
    with pytest.raises(obsynth.SpecError, match=rf"plant is an object of MATLAB's class {kind} .*dssdata\(plant\)"):
        obsynth.from_matlab(path)


def test_remarks_of_a_struct_of_7_3_may_be_objects(tmp_path):
    # struct(sys) has Notes as MATLAB's strings, which are objects.
    path = hdf5_written(tmp_path / "noted.mat", {"A": [[-1.0]], "C": [[1.0]], "Ts": 0.0}, more=[("Notes", "string")])
    h5py = pytest.importorskip("h5py", reason="h5py is not installed (obsynth[hdf5])")
    with h5py.File(path, "r+") as file:
        file["sys/Notes"].attrs["MATLAB_object_decode"] = np.int32(3)
    assert obsynth.from_matlab(path).A.tolist() == [[-1.0]]


def test_without_h5py_a_file_of_7_3_says_what_to_install(tmp_path, monkeypatch):
    path = tmp_path / "new.mat"
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(124) + b"\0\2IM" + bytes(400))
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(obsynth.SpecError, match=r"pip install 'obsynth\[hdf5\]'"):
        obsynth.from_matlab(path)
