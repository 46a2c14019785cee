"""Exports: what they hold, and that C gives what Python gives."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import scipy.signal

import obsynth
from obsynth import LinearObserver, SpecError
from obsynth.exporting.c_source import c_identifier
from obsynth.numerics.continuous import first_order_hold
from obsynth.specs.loader import load_spec

pytestmark = pytest.mark.usefixtures("taken_as_verified")

ROOT = Path(__file__).parents[2]
STEPS = 10_000
FLAGS = ["-Wall", "-Wextra", "-Werror", "-std=c99", "-pedantic", "-ffp-contract=off", "-O2"]


def designed(path: str) -> obsynth.ObserverDesign:
    spec = load_spec(ROOT / "designs" / path)
    return obsynth.design(spec.plant, spec.method, name=spec.name, **dict(spec.options))


@pytest.fixture(scope="module")
def sampled() -> obsynth.ObserverDesign:
    return designed("wang2015/spec.yaml")


@pytest.fixture(scope="module")
def network() -> obsynth.ObserverDesign:
    """Without known inputs, with delays."""
    return designed("smib/spec.yaml")


@pytest.fixture(scope="module")
def continuous() -> obsynth.ObserverDesign:
    return designed("filasova/spec.yaml")


def digest(design, tmp_path) -> str:
    return str(json.loads(design.save(tmp_path / "gains.json").read_text())["sha256"])


@pytest.mark.parametrize("suffix", [".mat", ".npz"])
@pytest.mark.parametrize("which", ["sampled", "continuous"])
def test_arrays_are_those_of_the_observer(request, tmp_path, suffix, which):
    design = request.getfixturevalue(which)
    (path,) = obsynth.export(design, tmp_path / f"observer{suffix}")
    found = dict(np.load(path)) if suffix == ".npz" else scipy.io.loadmat(path)
    observer = design.observer
    wanted = {
        "A": observer.Az, "B": np.hstack([observer.Bu, observer.By]), "C": observer.Cz,
        "D": np.hstack([observer.Du, observer.Dy]), "x0": np.zeros((observer.order, 1)),
    }  # fmt: skip
    for name, matrix in wanted.items():
        assert np.array_equal(found[name], matrix), name
        assert found[name].dtype == np.float64
    assert float(np.squeeze(found["Ts"])) == observer.dt
    texts = [str(np.squeeze(cell)) for cell in found["input_names"].ravel()]
    assert texts == [*observer.input_names, *observer.output_names]
    assert str(np.squeeze(found["output_names"].ravel()[-1])) == f"r[{observer.residual_names[-1]}]"
    assert str(np.squeeze(found["sha256"])) == digest(design, tmp_path)


def test_the_mat_file_runs_as_a_state_space_block(sampled, tmp_path):
    """Another implementation of x+ = A x + B u, y = C x + D u takes the file as it is."""
    (path,) = obsynth.export(sampled, tmp_path / "observer.mat")
    found = scipy.io.loadmat(path)
    rng = np.random.default_rng(2)
    u, y = rng.normal(size=(200, 2)), rng.normal(size=(200, 3))
    system = (found["A"], found["B"], found["C"], found["D"], found["Ts"].item())
    _, response, _ = scipy.signal.dlsim(system, np.hstack([u, y]), x0=found["x0"].ravel())
    wanted = sampled.observer.run(y, u)
    assert np.allclose(response[:, :4], wanted.states, rtol=0.0, atol=1e-10 * np.abs(wanted.states).max())


def test_a_continuous_observer_is_sampled_when_asked(continuous, tmp_path):
    (path,) = obsynth.export(continuous, tmp_path / "observer.npz", sample_time=0.01)
    wanted = obsynth.sample_observer(continuous.observer, 0.01)
    found = np.load(path)
    assert np.array_equal(found["A"], wanted.Az)
    assert np.array_equal(found["D"], np.hstack([wanted.Du, wanted.Dy]))
    assert found["Ts"] == 0.01


def test_the_operating_point_goes_with_the_names(sampled, tmp_path):
    plant = sampled.linear[0].replace(operating_point={"x2": 3.0, "u2": -1.0})
    (path,) = obsynth.export(sampled.replace(plant=plant), tmp_path / "observer.npz")
    found = np.load(path)
    assert dict(zip(found["input_names"], found["input_point"], strict=True)) == {
        "u1": 0.0, "u2": -1.0, "x2": 3.0, "x3": 0.0, "x4": 0.0,
    }  # fmt: skip
    assert found["output_point"][1] == 3.0
    assert np.count_nonzero(found["output_point"]) == 1


HARNESS = """\
#include <stdio.h>
#include "{header}"
int main(void)
{{
    {prefix}_state state;
    double in[{inputs}];
    double out[{outputs}];
    {prefix}_reset(&state);
    while (fread(in, sizeof in[0], {inputs}, stdin) == {inputs}) {{
        if ({prefix}_step(&state{arguments}) != 0) {{
            return 3;
        }}
        fwrite(out, sizeof out[0], {outputs}, stdout);
    }}
    return 0;
}}
"""


def compiled(observer: LinearObserver, source: Path) -> Path:
    """Compile an export with a program around it that reads and writes doubles."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler")
    nu, ny = len(observer.input_names), len(observer.output_names)
    nx, nf, nr = len(observer.state_names), len(observer.fault_names), len(observer.residual_names)
    arguments = [
        text
        for text, count in (
            ("in", nu), (f"in + {nu}", ny), ("out", nx), (f"out + {nx}", nf), (f"out + {nx + nf}", nr),
        )
        if count
    ]  # fmt: skip
    harness = source.with_name("main.c")
    harness.write_text(
        HARNESS.format(
            header=source.with_suffix(".h").name, prefix=c_identifier(source.stem), inputs=nu + ny,
            outputs=nx + nf + nr, arguments="".join(f", {text}" for text in arguments),
        )
    )  # fmt: skip
    program = source.with_name("program")
    done = subprocess.run(
        [compiler, *FLAGS, str(source), str(harness), "-o", str(program)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return program


def through_c(observer: LinearObserver, source: Path, signals: np.ndarray) -> np.ndarray:
    program = compiled(observer, source)
    done = subprocess.run([str(program)], input=signals.tobytes(), capture_output=True, check=False)
    assert done.returncode == 0
    return np.frombuffer(done.stdout).reshape(len(signals), -1)


def test_large_matrices_by_columns_and_by_entries(tmp_path):
    rng = np.random.default_rng(5)
    order, nx = 70, 40
    shown = np.zeros((nx + 1 + 9, order))
    shown[np.arange(nx), np.arange(nx)] = 1.0
    shown[nx:] = rng.normal(size=(10, order))
    observer = LinearObserver(
        0.9 * np.linalg.qr(rng.normal(size=(order, order)))[0], rng.normal(size=(order, 2)),
        rng.normal(size=(order, 9)), shown, np.zeros((nx + 10, 2)), rng.normal(size=(nx + 10, 9)),
        dt=1.0, input_names=("u1", "u2"), output_names=tuple(f"y{i}" for i in range(9)),
        state_names=tuple(f"x{i}" for i in range(nx)), fault_names=("f",),
        residual_names=tuple(f"y{i}" for i in range(9)), state_delays=(0,) * nx, fault_delays=(0,),
    )  # fmt: skip
    design = obsynth.fault_estimation_filter(
        obsynth.DescriptorSystem(None, [[0.5]], C=[[1.0]], Bf=[[1.0]], dt=1.0)
    ).replace(observer=observer)
    source = obsynth.export(design, tmp_path / "large.c")[0]
    text = source.read_text()
    assert "by columns" in text
    assert "states_z_column[40]" in text
    assert "-O3" in text
    signals = rng.normal(size=(500, 11))
    expected = observer.run(signals[:, 2:], signals[:, :2])
    found = through_c(observer, source, signals)
    wanted = np.hstack([expected.states, expected.faults, expected.residuals])
    np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=1e-12)


def start_of(observer: LinearObserver, dt: float, first: np.ndarray) -> np.ndarray:
    """Return the state of a continuous observer, as `sample_observer` keeps it, that starts at rest where the first
    sample is: less by the ramp to it."""
    return -first_order_hold(observer.Az, np.hstack([observer.Bu, observer.By]), dt)[2] @ first


@pytest.mark.long
@pytest.mark.parametrize(("which", "sample_time"), [("sampled", None), ("network", None), ("continuous", 0.01)])
def test_c_equals_python_over_ten_thousand_steps(request, tmp_path, which, sample_time):
    design = request.getfixturevalue(which)
    files = obsynth.export(design, tmp_path / f"{which}.c", sample_time=sample_time)
    assert [path.name for path in files] == [f"{which}.c", f"{which}.h"]
    observer = design.observer if sample_time is None else obsynth.sample_observer(design.observer, sample_time)
    nu = len(observer.input_names)
    signals = np.random.default_rng(1).normal(size=(STEPS, nu + len(observer.output_names)))
    found = through_c(observer, files[0], signals)
    start = None if sample_time is None else start_of(design.observer, sample_time, signals[0])
    run = observer.run(signals[:, nu:], signals[:, :nu], initial_state=start)
    wanted = np.hstack([run.states, run.faults, run.residuals])
    assert found.shape == wanted.shape
    assert np.all(np.abs(found - wanted).max(axis=0) <= 1e-12 * np.abs(wanted).max(axis=0))
    for path in files:
        assert digest(design, tmp_path) in path.read_text(encoding="ascii")


NASTY = ("*/ int x; /*", "??/ trigraph ????/", "back\\", "new\nline", "tor\u03c4ue \U0001f600", '"quoted"', "%d /* //")


def test_c_survives_any_name(sampled, tmp_path):
    """Names end up in comments, which they can neither end nor nest; the file's name becomes an identifier."""
    observer = LinearObserver(
        **{**sampled.observer.as_dict(), "output_names": NASTY[:3], "state_names": NASTY[3:], "dt": 0.1}
    )
    source, _ = obsynth.export(sampled.replace(name="*/ ??/", observer=observer), tmp_path / "2 wörter-while.c")
    signals = np.ones((3, 5))
    assert np.allclose(
        through_c(observer, source, signals)[:, :4], observer.run(np.ones((3, 3)), np.ones((3, 2))).states
    )


@pytest.mark.parametrize("name", ["math.c", "Time.c"])
def test_a_header_of_c_is_not_shadowed(sampled, tmp_path, name):
    with pytest.raises(SpecError, match="in place of C's own: name it otherwise"):
        obsynth.export(sampled, tmp_path / name)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("stem", "wanted"),
    [("wang2015", "wang2015"), ("2a", "obs_2a"), ("while", "obs_while"), ("_a", "obs__a"), ("é", "obs__")],
)  # fmt: skip
def test_identifiers(stem, wanted):
    assert c_identifier(stem) == wanted


def test_an_observer_without_states_is_exported(sampled, tmp_path):
    parts = {"Az": np.zeros((0, 0)), "Bu": np.zeros((0, 2)), "By": np.zeros((0, 3)), "Cz": np.zeros((8, 0))}
    observer = LinearObserver(**{**sampled.observer.as_dict(), **parts})
    source, _ = obsynth.export(sampled.replace(observer=observer), tmp_path / "static.c")
    signals = np.random.default_rng(0).normal(size=(5, 5))
    wanted = signals @ np.hstack([observer.Du, observer.Dy]).T
    assert np.allclose(through_c(observer, source, signals), wanted, rtol=0.0, atol=1e-13)


def test_a_sample_that_is_not_finite_leaves_the_c_observer_alone(sampled, tmp_path):
    source, _ = obsynth.export(sampled, tmp_path / "observer.c")
    program = compiled(sampled.observer, source)
    bad = np.ones((1, 5))
    bad[0, 3] = np.nan
    assert subprocess.run([str(program)], input=bad.tobytes(), capture_output=True, check=False).returncode == 3


@pytest.mark.parametrize(
    ("which", "name", "sample_time", "message"),
    [
        ("sampled", "a.xlsx", None, "unknown suffix"),
        ("sampled", "a", None, "a has no suffix: use one of .mat"),
        ("sampled", "nowhere/a.mat", None, "cannot be written"),
        ("sampled", "a.mat", 0.1, "sampled already"),
        ("continuous", "a.c", None, r"give the sample time \(sample_time, --sample-time\)"),
        ("continuous", "a.c", -1.0, "dt is -1"),
    ],
)
def test_what_cannot_be_exported_is_refused(request, tmp_path, which, name, sample_time, message):
    with pytest.raises(SpecError, match=message):
        obsynth.export(request.getfixturevalue(which), tmp_path / name, sample_time=sample_time)
    assert list(tmp_path.iterdir()) == []
