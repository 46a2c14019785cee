"""What Python and specs say alike: noise and faults by sensor name, E and units optional, many mistakes at once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import obsynth
from obsynth import DescriptorSystem, SpecError

A = [[0.9, 0.1], [0.0, 0.8]]


def plant(**more) -> DescriptorSystem:
    return DescriptorSystem(**{"A": A, "C": ["level", "flow"], "state_names": ["level", "flow"], "dt": 1.0, **more})


def spec_plant(folder: Path, text: str) -> DescriptorSystem:
    (folder / "spec.yaml").write_text(
        "schema_version: 1\nname: a\nmethod: {id: ui-pi-observer}\nplant:\n  dt: 1.0\n  A: [[0.9, 0.1], [0.0, 0.8]]\n"
        "  C: {outputs: [level, flow]}\n  state_names: [level, flow]\n" + text
    )
    return obsynth.load_spec(folder / "spec.yaml").plant


@pytest.mark.parametrize(
    ("more", "text"),
    [
        ({"Bf": ["flow"], "sensor_noise": {"flow": 0.1}}, "  Bf: {states: [flow]}\n  sensor_noise: {flow: 0.1}\n"),
        ({"Df": ["level"]}, "  Df: {outputs: [level]}\n"),
        ({"Bf": ["flow"], "Df": ["level"]}, "  Bf: {states: [flow]}\n  Df: {outputs: [level]}\n"),
        ({"Dd": ["flow"]}, "  Dd: {outputs: [flow]}\n"),
        ({"Bw": [[1.0], [0.0]], "sensor_noise": {"level": 0.2}}, "  Bw: [[1], [0]]\n  sensor_noise: {level: 0.2}\n"),
    ],
)
def test_python_and_specs_make_the_same_plant(more, text, tmp_path):
    ours, theirs = plant(**more), spec_plant(tmp_path, text)
    for name, value in ours.as_dict().items():
        assert (
            np.array_equal(value, getattr(theirs, name))
            if isinstance(value, np.ndarray)
            else (value == getattr(theirs, name))
        ), name


def test_noise_and_faults_of_sensors_are_columns_of_their_own():
    found = plant(Bf=["flow"], Df=["level"], sensor_noise={"flow": 0.1}, Dw=[[0.5], [0.0]], noise_names=["hum"])
    assert found.fault_names == ("flow", "level")
    assert np.array_equal(found.Bf, [[0.0, 0.0], [1.0, 0.0]])
    assert np.array_equal(found.Df, [[0.0, 1.0], [0.0, 0.0]])
    assert found.noise_names == ("hum", "noise flow")
    assert np.array_equal(found.Dw, [[0.5, 0.0], [0.0, 0.1]])
    assert np.array_equal(found.E, np.eye(2))


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"sensor_noise": {"flwo": 0.1, "levl": 0.1}}, ["'flwo'", "'levl'", "'flow'", "'level'"]),
        ({"sensor_noise": {"flow": 0.0}}, ["sensor_noise['flow']", "above 0"]),
        ({"sensor_noise": 0.1}, ["sensor_noise", "{'speed': 0.01}"]),
        ({"Df": ["levle"]}, ["Df", "'levle'", "'level'"]),
        ({"C": ["levle", "flwo"]}, ["C has no signal named 'levle'", "'level'", "'flwo'", "'flow'"]),
        ({"units": {"a": "m", "levle": "m"}}, ["units names 'a'", "'levle'", "'level'"]),
        ({"B": [[1.0, 2.0, 3.0]]}, ["B is 1 by 3"]),
        ({"B": [[1.0, 0.0]], "input_names": ["valve"]}, ["B is 1 by 2"]),
        ({"A": None}, ["A is missing"]),
    ],
)
def test_mistakes_are_told_together_with_what_may_be_meant(more, words):
    with pytest.raises(SpecError) as caught:
        plant(**more)
    assert [word for word in words if word not in str(caught.value)] == []


def test_a_transposed_matrix_is_asked_about():
    with pytest.raises(SpecError, match=r"Bf is 1 by 2, but 2 by 1 is needed\. Is it transposed\?|Bf is 1 by 2"):
        plant(Bf=[[1.0, 0.0]], Df=[[0.0], [0.0]])
    with pytest.raises(SpecError, match=r"C is 2 by 3, but 2 by 2|C is 2 by 3"):
        plant(C=[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    with pytest.raises(SpecError, match=r"D is 1 by 2, but 2 by 1 is needed\. Is it transposed\?"):
        plant(B=[[1.0], [0.0]], D=[[0.0, 0.0]])


def test_a_missing_dt_is_told_what_zero_means(tmp_path):
    (tmp_path / "spec.yaml").write_text(
        "schema_version: 1\nname: a\nmethod: {id: ui-pi-observer}\nplant: {A: [[0.5]], C: [[1]]}\n"
    )
    with pytest.raises(SpecError, match=r"plant\.dt: this key is missing: .* or 0 for a plant in continuous time"):
        obsynth.load_spec(tmp_path / "spec.yaml")


def test_labels_of_signals_that_are_gone_go_with_them():
    found = plant(Bd=["flow"], disturbance_names=["rain"], units={"rain": "mm", "level": "m"})
    left = found.replace(Bd=None, Dd=None, disturbance_names=None)
    assert dict(left.units) == {"level": "m"}


def test_units_of_a_nonlinear_plant_are_optional():
    pytest.importorskip("casadi")
    model = obsynth.DAEModel({"a": "der(x) = -x"}, {"y": "x"}, states={"x": 1.0})
    assert dict(model.units) == {}


def test_a_transformation_is_a_plant():
    full = DescriptorSystem(
        [[1, 0], [0, 0]], [[-1, 1], [0.5, -1]], C=[[1, 0]], Bf=[[1], [0]], state_names=["tank", "pipe"]
    )
    sampled = obsynth.discretise(obsynth.eliminate_algebraic_states(full), 0.1)
    design = obsynth.fault_estimation_filter(sampled)
    assert design.recovery.names == ("tank", "pipe")
    assert obsynth.check(sampled)["fault-estimation-filter"].passed


def test_a_bias_has_no_operating_point_though_it_is_called_like_its_sensor(tmp_path):
    """A state's fault is shown with the state's operating point, a sensor's bias as it is."""
    found = plant(Df=["flow"], operating_point={"flow": 5.0, "level": 2.0}, sensor_noise={"level": 0.1, "flow": 0.1})
    assert found.sensor_faults == ("flow",)
    design = obsynth.ui_pi_observer(found)
    log = tmp_path / "log.csv"
    log.write_text("time,level,flow\n" + "".join(f"{k},2,5\n" for k in range(5)))
    table = obsynth.run_on_data(design, log).table
    assert np.allclose(table["fhat[flow]"], 0.0)
    assert np.allclose(table["xhat[flow]"], 5.0)
    (path,) = obsynth.export(design, tmp_path / "observer.npz")
    saved = np.load(path)
    assert dict(zip(saved["output_names"], saved["output_point"], strict=True))["fhat[flow]"] == 0.0


def test_a_call_by_position_is_told_that_the_first_argument_is_e():
    with pytest.raises(obsynth.SpecError, match="first argument is E: give A="):
        obsynth.DescriptorSystem([[0.9, 0.1], [0.0, 0.8]], [[1.0], [0.0]], [[1.0, 0.0]])
    for e in (None, [[1.0], [2.0, 3.0]], np.eye(3)):
        with pytest.raises(obsynth.SpecError) as caught:
            obsynth.DescriptorSystem(e, [[1.0], [0.0]], C=[[1.0, 0.0]])
        assert "must be square" in str(caught.value)
        assert "first argument" not in str(caught.value)
