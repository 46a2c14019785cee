"""The observer of a DAE as C: compiled with warnings as errors, it gives what Python gives."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dae_plants import DESIGNS, linear
from test_dae_observer import matrices

import obsynth
from obsynth import SpecError, simulate_dae
from obsynth.cli.main import main
from obsynth.observers.changed_options import changed
from obsynth.observers.nonlinear.observer import DAEObserver
from obsynth.plants.dae_functions import Compiled
from obsynth.specs.loader import load_spec

pytestmark = pytest.mark.usefixtures("taken_as_verified")

FLAGS = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-O1", "-ffp-contract=off"]

HARNESS = """\
#include <stdio.h>
#include "NAME.h"
int main(void)
{
    NAME_state state;
    NAME_estimates found;
    double in[WIDTH];
    NAME_reset(&state);
    while (fread(in, sizeof in[0], WIDTH, stdin) == WIDTH) {
        int failed = NAME_step(&state, INPUT, &found);
        double end = failed;
        fwrite(&found, sizeof found, 1, stdout);
        fwrite(&end, sizeof end, 1, stdout);
    }
    return 0;
}
"""


def designed(name: str, **options) -> obsynth.ObserverDesign:
    spec = load_spec(DESIGNS / name / "spec.yaml")
    return obsynth.design(spec.plant, spec.method, name=spec.name, **{**spec.options, **options})


def run_c(
    design: obsynth.ObserverDesign, y: np.ndarray, u: np.ndarray, folder: Path, *, quick: bool = False, **options: Any
) -> dict[str, np.ndarray]:
    """Return what the compiled export says, by field, and what each step returned; ``quick``: compiled as it stands,
    which takes a third of the time of a large source."""
    source, header = obsynth.export(design, folder / "observer.c", **options)
    assert header == folder / "observer.h"
    nu, ny = u.shape[1], y.shape[1]
    arguments = f"in, in + {nu}" if nu else "in"
    text = HARNESS.replace("NAME", "observer").replace("WIDTH", str(nu + ny)).replace("INPUT", arguments)
    (folder / "main.c").write_text(text)
    compiler = shutil.which("cc")
    assert compiler is not None, "these tests need a C compiler"
    flags = [flag for flag in FLAGS if flag != "-O1"] if quick else FLAGS
    subprocess.run([compiler, *flags, source, folder / "main.c", "-o", folder / "run", "-lm"], check=True)
    done = subprocess.run([folder / "run"], input=np.hstack([u, y]).tobytes(), capture_output=True, check=True)
    nx, nq = design.plant.nx, design.plant.nq
    # C has no empty arrays.
    some = max(nq, 1)
    fields = {"states": nx, "state_deviations": nx, "parameters": some, "parameter_deviations": some, "innovations": ny,
              "nis": 1, "residual": 1, "returned": 1}  # fmt: skip
    table = np.frombuffer(done.stdout).reshape(len(y), sum(fields.values()))
    found = dict(zip(fields, np.split(table, np.cumsum(list(fields.values()))[:-1], axis=1), strict=True))
    return found | {name: found[name][:, :nq] for name in ("parameters", "parameter_deviations")}


def as_run(design: obsynth.ObserverDesign) -> DAEObserver:
    """The observer as `run` has it: outliers are left out where the design says nothing of them."""
    observer = design.nonlinear[1]
    return changed(observer, outliers="gate") if observer.outliers == "none" else observer


def assert_equal(found: dict[str, np.ndarray], expected: obsynth.types.Estimates) -> None:
    assert not found["returned"].any()
    for name in ("states", "state_deviations", "parameters", "parameter_deviations", "innovations"):
        values = getattr(expected, name)
        size = np.nanmax(np.abs(values), axis=0)
        assert np.array_equal(np.isnan(found[name]), np.isnan(values)), name
        assert np.nanmax(np.abs(found[name] - values) / size) <= 1e-10, name
    assert np.abs(found["nis"][:, 0] - expected.nis).max() <= 1e-10 * expected.nis.max()
    assert found["residual"].max() <= 1e-9


@pytest.mark.one_in(2)
@pytest.mark.parametrize("form", ["forgetting", "augmented-kalman"])
def test_the_heat_exchanger_with_gaps_and_a_start_off_its_constraint(form, tmp_path) -> None:
    design = designed("moussaali2013_dae", form=form, initial_state={"p1": 2.1e5})
    rng, samples = np.random.default_rng(3), 300
    u = np.tile(design.plant.nominal_input, (samples, 1))
    u[:, 0] *= 1.0 + 0.01 * rng.standard_normal(samples)
    faults = np.column_stack([np.full(samples, 0.9), np.where(np.arange(samples) > 100, 2e3, 0.0)])
    y = np.array(simulate_dae(design.plant, u, dt=1.0, parameters=faults, R=design.observer.R, seed=1).outputs)
    y[50], y[60:90, 0] = np.nan, np.nan
    expected = as_run(design).run(y, u, compiled=False)
    assert expected.projection.any()
    assert np.abs(expected.states - design.observer.run(y, u).states).max() > 0.0
    assert_equal(run_c(design, y, u, tmp_path, quick=form != "forgetting"), expected)


@pytest.mark.long
def test_a_pendulum_by_radau_without_inputs(tmp_path) -> None:
    """Fifteen unknowns in a step: factorised, where fewer are eliminated."""
    design = designed("pendulum")
    u = np.zeros((200, 0))
    y = simulate_dae(design.plant, u, dt=0.01, parameters=[0.3, 0.02], R=design.observer.R).outputs
    assert_equal(run_c(design, y, u, tmp_path, quick=True), as_run(design).run(y, u, compiled=False))


@pytest.mark.long
@pytest.mark.parametrize(("move", "least"), [(None, 1), (1.0, 10)])
def test_a_diode_whose_source_jumps_by_300_v(move, least, tmp_path) -> None:
    """Damped Newton, and with a largest move the homotopy, are in the C as well."""
    design = designed("diode_circuit", initial_state={"v": 0.0, "c": 0.0}, largest_move=move)
    u = np.where(np.arange(40) < 10, 0.0, 300.0)[:, None]
    y = simulate_dae(design.plant, u, dt=1e-3, initial_state=[0.0, 0.0], R=design.observer.R, seed=1).outputs
    expected = as_run(design).run(y, u, compiled=False)
    hard = expected.states[9], u[10], expected.parameters[9]
    assert Compiled(design.observer.graph.step.step)(*hard)[2] == 0.0
    assert design.observer.steps.implicit.solve(*hard, before=u[9]).subsolves >= least
    assert_equal(run_c(design, y, u, tmp_path), expected)


@pytest.mark.long
def test_a_missing_input_is_taken_as_in_python_and_a_step_without_a_solution_leaves_the_state_as_it_was(
    tmp_path,
) -> None:
    design = designed("moussaali2013_dae")
    u = np.tile(design.plant.nominal_input, (30, 1))
    u[:, 0] *= 1.0 + 0.001 * np.arange(30)
    y = np.array(simulate_dae(design.plant, u, dt=1.0, R=design.observer.R, seed=1).outputs)
    spoiled, running = u.copy(), as_run(design).start()
    spoiled[12, 0] = np.nan
    expected = np.array([running.step(*sample).states[0] for sample in zip(y, spoiled, strict=True)])
    spoiled = np.insert(spoiled, 20, [[1e3, 450.0, 15150.0, -1.0]], axis=0)
    found = run_c(design, np.insert(y, 20, y[20], axis=0), spoiled, tmp_path, quick=True)
    assert [found["returned"][k, 0] for k in (11, 12, 13, 19, 20, 21)] == [0.0, 1.0, 0.0, 0.0, 2.0, 0.0]
    assert np.abs(np.delete(found["states"], 20, axis=0) / expected - 1.0).max() <= 1e-10


@pytest.mark.long
def test_both_files_carry_the_digest_of_the_gain_set(tmp_path, capsys) -> None:
    design = designed("diode_circuit")
    gains = design.save(tmp_path / "gains.json")
    assert main(["export", "--gains", str(gains), "--to", str(tmp_path / "load 1.c")]) == 0
    digest = json.loads(gains.read_text())["sha256"]
    header = (tmp_path / "load 1.h").read_text()
    assert f'#define LOAD_1_SHA256 "{digest}"' in header
    assert "#define LOAD_1_DT 0.001" in header
    assert '/* faults[0]: "fhat[load]", "S" */' in header
    assert digest in (tmp_path / "load 1.c").read_text()


def test_what_cannot_be_exported_says_why(tmp_path) -> None:
    design = designed("diode_circuit")
    with pytest.raises(SpecError, match=r"has no constant matrices\. Export it as C \(\.c\) or an FMU"):
        obsynth.export(design, tmp_path / "observer.mat")
    with pytest.raises(SpecError, match="sampled already"):
        obsynth.export(design, tmp_path / "observer.c", sample_time=0.1)
    functions = obsynth.dae_adaptive_observer(
        linear(matrices()), dt=0.25, Q=0.01, R=0.04, initial_parameter_covariance=1.0, initial_covariance=1.0
    )
    with pytest.raises(SpecError, match="Python functions"):
        obsynth.export(functions, tmp_path / "observer.c")
    assert not list(tmp_path.iterdir())
