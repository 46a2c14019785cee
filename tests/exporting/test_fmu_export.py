"""Observers as functional mock-up units: fmpy validates and runs them, and gets what Python gives."""

from __future__ import annotations

import errno
import subprocess
import tempfile
import zipfile
from pathlib import Path

import numpy as np
import pytest

import obsynth
from obsynth import SpecError
from obsynth.exporting.fmu import archive
from obsynth.observers.nonlinear import c_code as dae_library

fmpy = pytest.importorskip("fmpy", reason="fmpy is not installed (obsynth[fmu])")
# Its parts are modules of their own.
for part in ("fmi1", "fmi2", "fmi3", "validation"):
    pytest.importorskip(f"fmpy.{part}")

ROOT = Path(__file__).parents[2]
STEPS = 2_000
VERSIONS = pytest.mark.parametrize("version", ["2.0", "3.0"])


@pytest.fixture(scope="module")
def design() -> obsynth.ObserverDesign:
    """Two faults, operating points and units."""
    spec = obsynth.load_spec(ROOT / "designs" / "wang2015" / "spec.yaml")
    plant = spec.plant.replace(
        operating_point={"u1": 2.0, "x2": -3.0, "x1": 1.0}, units={"x2": "m", "u1": "V", "actuator 1": "V"}
    )
    return obsynth.design(plant, spec.method, name=spec.name, **dict(spec.options))


@pytest.fixture(autouse=True, scope="module")
def _compiled_in_less_time():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(archive, "FLAGS", tuple("-O0" if flag == "-O2" else flag for flag in archive.FLAGS))
        yield


@pytest.fixture
def compiler() -> list[str]:
    command = dae_library.compiler()
    if command is None:
        pytest.skip("no C compiler")
    return command


class Stepped:
    """A unit stepped by fmpy's functions of either version."""

    def __init__(self, path, folder):
        self.description = fmpy.read_model_description(str(path))
        self.references = {v.name: v.valueReference for v in self.description.modelVariables}
        unpacked = fmpy.extract(str(path), unzipdir=str(folder))
        arguments = {
            "guid": self.description.guid, "unzipDirectory": unpacked, "instanceName": "observer",
            "modelIdentifier": self.description.coSimulation.modelIdentifier,
        }  # fmt: skip
        self.is_old = self.description.fmiVersion == "2.0"
        self.unit = fmpy.fmi2.FMU2Slave(**arguments) if self.is_old else fmpy.fmi3.FMU3Slave(**arguments)
        self.unit.instantiate()
        self.get = self.unit.getReal if self.is_old else self.unit.getFloat64
        self.set = self.unit.setReal if self.is_old else self.unit.setFloat64

    def begin(self):
        if self.is_old:
            self.unit.setupExperiment(startTime=0.0)
        self.unit.enterInitializationMode()
        self.unit.exitInitializationMode()

    def values(self, names):
        return self.get([self.references[name] for name in names])

    def flag(self, name):
        return bool(self.unit.getBoolean([self.references[name]])[0])

    def run(self, names, record, dt, shown):
        references, wanted = [self.references[name] for name in names], [self.references[name] for name in shown]
        rows = np.empty((len(record), len(shown)))
        for k, row in enumerate(record):
            self.set(references, row.tolist())
            self.unit.doStep(currentCommunicationPoint=k * dt, communicationStepSize=dt)
            rows[k] = self.get(wanted)
        return rows

    def end(self):
        self.unit.terminate()
        self.unit.freeInstance()


def unit_names(observer):
    return (*observer.input_names, *observer.output_names), (
        *(f"xhat[{name}]" for name in observer.state_names), *(f"fhat[{name}]" for name in observer.fault_names),
        *(f"r[{name}]" for name in observer.residual_names),
    )  # fmt: skip


@VERSIONS
@pytest.mark.usefixtures("compiler")
def test_a_unit_is_valid_and_gives_what_python_gives(design, tmp_path, version):
    (path,) = obsynth.export(design, tmp_path / "observer.fmu", fmi=version)
    assert fmpy.validation.validate_fmu(str(path)) == []
    observer, point = design.observer, design.plant.operating_point
    names, shown = unit_names(observer)
    record = np.random.default_rng(1).normal(size=(STEPS, len(names)))
    before = np.array([point.get(name, 0.0) for name in names])
    nu = len(observer.input_names)
    wanted = observer.run(record[:, nu:] - before[nu:], record[:, :nu] - before[:nu])
    after = np.array([point.get(name, 0.0) for name in (*observer.state_names, *observer.fault_names)])
    whole = np.hstack([wanted.states, wanted.faults]) + after, wanted.residuals
    stepped = Stepped(path, tmp_path / "unpacked")
    stepped.begin()
    assert stepped.values(["xhat[x1]", "xhat[x2]"]) == [1.0, -3.0]
    found = stepped.run(names, record, observer.dt, shown)
    stepped.end()
    assert np.abs(found - np.hstack(whole)).max() <= 1e-12 * max(1.0, np.abs(found).max())


@VERSIONS
@pytest.mark.usefixtures("compiler")
def test_alarms_thresholds_and_operating_points_can_be_changed(design, tmp_path, version):
    (path,) = obsynth.export(
        design, tmp_path / "observer.fmu", fmi=version, thresholds={"fhat[actuator 1]": 0.5}, warm_up=3.0
    )
    stepped = Stepped(path, tmp_path / "unpacked")
    assert stepped.values(["threshold[fhat[actuator 1]]", "threshold[fhat[actuator 2]]", "warm_up"]) == [0.5, 0.0, 3.0]
    stepped.begin()
    observer, point = design.observer, design.plant.operating_point
    names, shown = unit_names(observer)
    rest = np.array([point.get(name, 0.0) for name in names])
    jump = rest + np.where(np.array(names) == "x2", 50.0, 0.0)
    found = stepped.run(names, np.array([rest, jump]), 1.0, shown)
    assert np.array_equal(found[0], [1.0, -3.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert not stepped.flag("alarm")  # warm-up
    stepped.set([stepped.references["warm_up"]], [0.0])
    stepped.run(names, np.array([jump]), 1.0, shown)
    assert stepped.flag("alarm")
    assert stepped.flag("alarm[fhat[actuator 1]]")
    assert stepped.flag("sample_used")
    # A sample that is no number raises nothing: the model goes on, faults are held, and there is no residual.
    held = dict(zip(shown, stepped.values(shown), strict=True))
    stepped.run(names, np.array([np.where(np.arange(len(names)) == 1, np.nan, rest)]), 1.0, shown)
    after = dict(zip(shown, stepped.values(shown), strict=True))
    assert all(after[name] == held[name] for name in shown if name.startswith("fhat["))
    assert all(np.isnan(after[name]) for name in shown if name.startswith("r["))
    assert after["xhat[x2]"] != held["xhat[x2]"]
    assert not stepped.flag("sample_used")
    assert not stepped.flag("alarm")
    stepped.end()


@VERSIONS
@pytest.mark.usefixtures("compiler")
def test_the_state_can_be_kept_and_a_wrong_step_is_refused(design, tmp_path, version):
    (path,) = obsynth.export(design, tmp_path / "observer.fmu", fmi=version)
    stepped = Stepped(path, tmp_path / "unpacked")
    stepped.begin()
    names, shown = unit_names(design.observer)
    record = np.random.default_rng(2).normal(size=(6, len(names)))
    stepped.run(names, record[:3], 1.0, shown)
    state = stepped.unit.getFMUstate() if stepped.is_old else stepped.unit.getFMUState()
    first = stepped.run(names, record[3:], 1.0, shown)
    (stepped.unit.setFMUstate if stepped.is_old else stepped.unit.setFMUState)(state)
    assert np.array_equal(stepped.run(names, record[3:], 1.0, shown), first)
    (stepped.unit.freeFMUstate if stepped.is_old else stepped.unit.freeFMUState)(state)
    with pytest.raises(fmpy.fmi1.FMICallException):
        stepped.unit.doStep(currentCommunicationPoint=9.0, communicationStepSize=0.4)
    stepped.unit.freeInstance()


@VERSIONS
def test_names_units_and_sources_are_inside(design, tmp_path, version, monkeypatch):
    monkeypatch.setattr("obsynth.exporting.fmu.archive.compiler", lambda: None)
    (path,) = obsynth.export(design, tmp_path / "my observer.fmu", fmi=version)
    assert fmpy.validation.validate_fmu(str(path)) == []
    variables = {v.name: v for v in fmpy.read_model_description(str(path)).modelVariables}
    assert variables["x2"].causality == "input"
    assert variables["x2"].unit == variables["xhat[x2]"].unit == "m"
    assert variables["fhat[actuator 1]"].unit == "V"
    assert "delayed by 1 sample" in variables["fhat[actuator 1]"].description
    assert float(variables["operating_point[u1]"].start) == 2.0
    with zipfile.ZipFile(path) as unit:
        names = unit.namelist()
    assert not [name for name in names if name.startswith("binaries")]
    assert {"sources/observer.c", "sources/observer.h", "sources/layout.h", "sources/instance.h"} <= set(names)


@VERSIONS
def test_the_sources_compile_without_a_warning(design, tmp_path, version, compiler):
    (path,) = obsynth.export(design, tmp_path / "observer.fmu", fmi=version)
    with zipfile.ZipFile(path) as unit:
        unit.extractall(tmp_path / "unpacked")
    flags = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC"]
    sources = sorted(map(str, (tmp_path / "unpacked" / "sources").glob("*.c")))
    done = subprocess.run([*compiler, *flags, *sources, "-o", str(tmp_path / "library.so"), "-lm"],
                          capture_output=True, text=True, check=False)  # fmt: skip
    assert done.returncode == 0, done.stderr


@pytest.mark.long
@pytest.mark.usefixtures("compiler", "taken_as_verified")
def test_the_observer_of_a_nonlinear_plant_is_a_unit_too(tmp_path):
    spec = obsynth.load_spec(ROOT / "designs" / "pendulum" / "spec.yaml")
    design = obsynth.design(spec.plant, spec.method, name=spec.name, **dict(spec.options))
    (path,) = obsynth.export(design, tmp_path / "observer.fmu")
    assert fmpy.validation.validate_fmu(str(path)) == []
    model, observer = design.nonlinear
    names = (*model.input_names, *model.output_names)
    shown = [f"xhat[{name}]" for name in model.state_names] + [f"fhat[{name}]" for name in model.parameter_names]
    u = np.tile(list(model.inputs.values()), (200, 1))
    y = obsynth.simulate_dae(model, u, dt=observer.dt).outputs[:200]
    y = y + 1e-4 * np.random.default_rng(3).normal(size=y.shape)
    wanted = observer.run(y, u)
    stepped = Stepped(path, tmp_path / "unpacked")
    stepped.begin()
    found = stepped.run(names, np.hstack([u, y]), observer.dt, shown)
    stepped.end()
    whole = np.hstack([wanted.states, wanted.parameters])
    assert np.abs(found - whole).max() <= 1e-9 * max(1.0, np.abs(whole).max())


@pytest.mark.long
@pytest.mark.usefixtures("compiler", "taken_as_verified")
def test_the_unit_of_the_tanks_watches_its_leak_by_a_level_and_by_what_was_learned(tmp_path):
    """As a run on the same log: the leak, its deviation, the statistic, and both alarms."""
    from test_c_on_logs import log_of, told

    spec = obsynth.load_spec(ROOT / "designs" / "threetank" / "spec.yaml")
    design = obsynth.design(spec.plant, spec.method, name=spec.name, **dict(spec.options))
    monitor, log = obsynth.online_monitor(design, "learned", normal=told(design)), log_of(design)
    quiet = obsynth.run_on_data(design, log).table["fhat[leak]"]
    level = {"fhat[leak]": float(quiet.abs().quantile(0.7))}
    (path,) = obsynth.export(design, tmp_path / "tanks.fmu", thresholds=level, monitor=monitor, warm_up=20.0)
    assert fmpy.validation.validate_fmu(str(path)) == []
    run = obsynth.run_on_data(design, log, thresholds=level, monitor=monitor, warm_up=20.0).table
    model, observer = design.nonlinear
    shown = ["fhat[leak]", "sd fhat[leak]", "statistic", "alarm[fhat[leak]]", "alarm[statistic]", "sample_used"]
    stepped = Stepped(path, tmp_path / "unpacked")
    stepped.begin()
    found = []
    for row in log.to_numpy()[:, 1:]:
        stepped.run((*model.input_names, *model.output_names), row[None], observer.dt, shown[:3])
        found.append([*stepped.values(shown[:3]), *(stepped.flag(name) for name in shown[3:])])
    stepped.end()
    table = np.array(found, dtype=float)
    np.testing.assert_allclose(table[:, :3], run[shown[:3]].to_numpy(float), rtol=1e-9)
    alarms = run.alarm.to_numpy(str)
    np.testing.assert_array_equal(table[:, 3] > 0.0, np.char.find(alarms, "fhat[leak]") >= 0)
    np.testing.assert_array_equal(table[:, 4] > 0.0, np.char.find(alarms, "learned") >= 0)
    np.testing.assert_array_equal(table[:, 5] > 0.0, run.status != "gap")
    assert 0.0 < table[:, 3].mean() < 1.0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"fmi": "1.0"}, ["fmi", "2.0"]),
        ({"thresholds": {"fhat[pump]": 1.0}}, ["fhat[pump]", "fhat[actuator 1]"]),
        ({"thresholds": {"fhat[actuator 1]": -1.0}}, ["positive"]),
        ({"warm_up": -1.0}, ["warm_up"]),
        ({"sample_time": 0.1}, ["sampled already"]),
    ],
)
def test_wrong_options_are_refused(design, tmp_path, options, words):
    with pytest.raises(SpecError) as caught:
        obsynth.export(design, tmp_path / "observer.fmu", **options)
    assert all(word in str(caught.value) for word in words)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("refused", ["no folder", "nothing is written there"])
def test_a_folder_for_temporary_files_that_cannot_be_used_is_told(design, tmp_path, monkeypatch, refused):
    """It was told as standard output that cannot be written."""

    class Refused(tempfile.TemporaryDirectory):
        def __init__(self, *arguments, **options):
            if refused == "no folder":
                raise FileNotFoundError(errno.ENOENT, "No usable temporary directory found")
            super().__init__(*arguments, **options)

        def __enter__(self):
            return f"{super().__enter__()}/gone"

    monkeypatch.setattr("tempfile.TemporaryDirectory", Refused)
    with pytest.raises(
        SpecError, match=r"The folder for temporary files cannot be used: No .*Name another one in TMPDIR"
    ):
        obsynth.export(design, tmp_path / "observer.fmu", fmi="2.0")
    assert not (tmp_path / "observer.fmu").exists()


def test_thresholds_are_for_units_and_c_only(design, tmp_path):
    with pytest.raises(SpecError, match=r"FMU"):
        obsynth.export(design, tmp_path / "observer.npz", thresholds={"fhat[actuator 1]": 1.0})
