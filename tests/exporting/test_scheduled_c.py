"""C of designs over a region: the rows that a run on a log has, to twelve digits."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.io import loadmat
from tests.support.polytopic_plants import WANG_A, WANG_BD, WANG_BF, WANG_C, WANG_E, record, wang

import obsynth
from obsynth import ObserverDesign, PolytopicSystem, SpecError
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.scheduled.observer import ScheduledObserver

_MAIN = """
#include <stdio.h>
#include "region.h"
int main(void)
{
    region_state s;
    double u[NU], y[NY], states[NX], faults[NF], residuals[NF];
    int i;
    region_reset(&s);
    for (;;) {
        for (i = 0; i < NU; i++) if (scanf("%lf", &u[i]) != 1) return 0;
        for (i = 0; i < NY; i++) if (scanf("%lf", &y[i]) != 1) return 0;
        region_step(&s, u, y, states, faults, residuals);
        printf("%d", s.status);
        for (i = 0; i < NX; i++) printf(" %.17g", states[i]);
        for (i = 0; i < NF; i++) printf(" %.17g", faults[i]);
        for (i = 0; i < NF; i++) printf(" %.17g", residuals[i]);
        printf("\\n");
    }
}
"""
_STATUSES = ("ok", "warm-up", "gap", "recovering", "out")


def _compiled(design: ObserverDesign, folder: Path, main: str = _MAIN) -> Path:
    observer = design.scheduled[1]
    obsynth.export(design, folder / "region.c")
    sizes = {"NU": len(observer.input_names), "NY": len(observer.output_names), "NX": len(observer.state_names),
             "NF": len(observer.fault_names)}  # fmt: skip
    (folder / "main.c").write_text("\n".join(f"#define {k} {v}" for k, v in sizes.items()) + main)
    flags = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-O1", "-fsanitize=undefined", "-fno-sanitize-recover"]
    run = subprocess.run(
        ["gcc", *flags, "main.c", "region.c", "-lm", "-o", "region"], cwd=folder, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr
    return folder / "region"


def _in_c(program: Path, rows: FloatArray) -> FloatArray:
    text = "\n".join(" ".join(repr(float(value)) for value in row) for row in rows)
    found = subprocess.run([program], input=text, capture_output=True, text=True, check=True).stdout
    return np.array([[float(value) for value in line.split()] for line in found.splitlines()])


def _plants() -> dict[str, PolytopicSystem]:
    A = WANG_A.tolist()
    A[0][0] = "0.9 * (1 + 0.05 * sin(3 * a) / (1 + a ** 2))"
    A[1][2] = "0.0997 + 0.02 * exp(-abs(b)) * min(a, b)"
    plant = {"E": WANG_E, "A": A, "C": WANG_C, "Bf": WANG_BF, "Bd": WANG_BD, "dt": 1.0}
    functions = PolytopicSystem(plant=plant, scheduling={"a": [-1, 1], "b": {"range": [-1, 1], "rate": 1.97}})
    return {
        "linear": wang(), "effectiveness": wang(effectiveness=True), "functions": functions,
        "vertices": PolytopicSystem(list(wang().vertices)[:3]),
    }  # fmt: skip


@pytest.mark.one_in(4)
@pytest.mark.skipif(shutil.which("gcc") is None, reason="no C compiler")
@pytest.mark.parametrize("name", ["linear", "effectiveness", "functions", "vertices"])
def test_c_equals_the_run_on_a_log(name: str, tmp_path: Path) -> None:
    plant = _plants()[name]
    design = obsynth.fault_estimation_filter(plant)
    observer, samples, rng = design.scheduled[1], 300, np.random.default_rng(3)
    count = len(plant.scheduling.names)
    parameters = rng.dirichlet(np.ones(count), samples) if name == "vertices" else rng.uniform(-1, 1, (samples, count))
    u, f = rng.standard_normal((samples, plant.nu)), rng.standard_normal((samples, plant.nf))
    y = record(plant, parameters, u, f)
    # Parameters outside, far outside and missing; outputs and inputs missing, at the start, in a row and later.
    parameters[120, 0], parameters[121, 1], parameters[190, 0] = 1.3, np.nan, -1e9
    y[0, 0], y[3, 1], y[250:253, 2] = np.nan, np.nan, np.nan
    if plant.nu:
        u[255, 0] = np.nan
    found = _in_c(_compiled(design, tmp_path), np.hstack([u, parameters, y]))
    log = pd.DataFrame(np.hstack([np.arange(float(samples))[:, None], u, parameters, y]))
    log.columns = ["time", *observer.input_names, *observer.output_names]
    obsynth.run_on_data(design, log, out=tmp_path / "run.csv")
    run = pd.read_csv(tmp_path / "run.csv")
    assert [_STATUSES[int(status)] for status in found[:, 0]] == run.status.tolist()
    assert {"ok", "out", "gap", "warm-up"} <= set(run.status)
    numbers = run[list(observer.row_names)].to_numpy()
    assert np.array_equal(np.isnan(numbers), np.isnan(found[:, 1:]))
    assert np.nanmax(np.abs(numbers - found[:, 1:]) / np.maximum(np.abs(numbers), 1.0)) < 1e-12


def _random_plant(seed: int) -> PolytopicSystem:
    """Return a plant of two to four states with one or two parameters that enter linearly."""
    rng = np.random.default_rng(seed)
    n, names = int(rng.integers(2, 5)), ("a", "b")[: 1 + seed % 2]

    def moved(matrix: FloatArray, share: float) -> list[list[str]]:
        parts = [share * rng.standard_normal(matrix.shape) for _ in names]
        stacked = np.stack([matrix, *parts], axis=-1).tolist()
        terms = ["1", *names]
        return [[" + ".join(f"{x!r} * {name}" for x, name in zip(entry, terms, strict=True)) for entry in row]
                for row in stacked]  # fmt: skip

    A = rng.standard_normal((n, n))
    plant = {
        "A": moved(0.7 * A / abs(np.linalg.eigvals(A)).max(), 0.03), "B": moved(rng.standard_normal((n, 1)), 0.3),
        "C": np.eye(2, n), "Bf": np.eye(n, 1) + 0.3 * rng.standard_normal((n, 1)), "Bd": rng.standard_normal((n, 1)),
        "dt": 1.0,
    }  # fmt: skip
    return PolytopicSystem(plant=plant, scheduling={name: [-1.0, 2.0] for name in names})


def _products(rho: FloatArray) -> FloatArray:
    return np.array([1.0, *rho, *([rho.prod()] if len(rho) > 1 else [])])


def _affine(observer: ScheduledObserver, rows: FloatArray) -> FloatArray:
    """Return the rows of ``M0 + a M1 (+ b M2 + a b M12)``, fitted to the corners."""
    held, inputs = observer.scheduling, observer.inputs
    corners = np.linalg.inv([_products(corner) for corner in held.corners])
    parts = [np.tensordot(corners, matrix, 1) for matrix in (observer.Az, observer.Bu, observer.By)]
    z, rho, found = np.zeros(observer.order), 0.5 * (held.low + held.high), []
    for row in rows:
        u, given, y = np.split(row, [inputs, inputs + len(held.names)])
        rho = np.where(np.isnan(given), rho, np.clip(given, held.low, held.high))
        Az, Bu, By = (np.tensordot(_products(rho), part, 1) for part in parts)
        found.append(observer.Cz @ z + observer.Du @ u + observer.Dy @ y)
        z = Az @ z + Bu @ u + By @ y
    return np.array(found)


@pytest.mark.one_in(4)
@pytest.mark.skipif(shutil.which("gcc") is None, reason="no C compiler")
@pytest.mark.parametrize("seed", range(10))
def test_c_of_random_plants_is_affine_in_the_parameters(seed: int, tmp_path: Path) -> None:
    plant = _random_plant(seed)
    design = obsynth.fault_estimation_filter(plant)
    observer, rng, samples = design.scheduled[1], np.random.default_rng(seed), 150
    parameters = rng.uniform(-1.0, 2.0, (samples, len(plant.scheduling.names)))
    parameters[rng.integers(0, samples, 8), 0] = [np.nan, np.nan, 2.1, -1.1, 1e9, -1e9, np.nan, 3.0]
    parameters[0, -1] = np.nan
    rows = np.hstack([rng.standard_normal((samples, 1)), parameters, rng.standard_normal((samples, 2))])
    found = _in_c(_compiled(design, tmp_path), rows)
    run, claimed = observer.record(rows[:, -2:], rows[:, :-2])
    for numbers in (run, _affine(observer, rows)):
        assert np.max(np.abs(numbers - found[:, 1:]) / np.maximum(np.abs(numbers), 1.0)) < 1e-12
    settled = found[observer.forgetting :, 0]
    assert np.array_equal(settled == _STATUSES.index("ok"), claimed[observer.forgetting :])
    assert not claimed.all()


@pytest.mark.long
@pytest.mark.skipif(shutil.which("gcc") is None, reason="no C compiler")
def test_c_of_a_kalman_filter_has_states_and_innovations(tmp_path: Path) -> None:
    plant = PolytopicSystem(
        plant={"A": [["0.8 + 0.3 * v", 0.3], [-0.2, "0.9 - 0.2 * v"]], "B": [[0], [1]], "C": [[1, 0]], "D": [[0.5]],
               "dt": 1.0},
        scheduling={"v": [-1, 1]},
    )  # fmt: skip
    design = obsynth.descriptor_kalman(plant, Q=0.1, R=0.1)
    main = _MAIN.replace("states, faults, residuals", "states, residuals").replace(", faults[NF]", "")
    main = main.replace('        for (i = 0; i < NF; i++) printf(" %.17g", faults[i]);\n', "")
    main = main.replace("residuals[NF]", "residuals[NY]").replace("i < NF", "i < NY")
    rng = np.random.default_rng(0)
    rows = np.column_stack([rng.standard_normal(200), rng.uniform(-1, 1, 200), rng.standard_normal(200)])
    rows[50, 1], rows[80, 1], rows[120, 2] = np.nan, 1.5, np.nan
    found = _in_c(_compiled(design, tmp_path, main), rows)
    log = pd.DataFrame(np.column_stack([np.arange(200.0), rows]), columns=["time", "u1", "v", "y1"])
    run = obsynth.run_on_data(design, log).table
    assert [_STATUSES[int(status)] for status in found[:, 0]] == run.status.tolist()
    numbers = run[list(design.scheduled[1].row_names)].to_numpy()
    assert np.array_equal(np.isnan(numbers), np.isnan(found[:, 1:]))
    assert np.nanmax(np.abs(numbers - found[:, 1:]) / np.maximum(np.abs(numbers), 1.0)) < 1e-12


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", ["linear", "effectiveness", "functions", "vertices"])
@pytest.mark.parametrize("suffix", [".mat", ".npz"])
def test_arrays_hold_the_observer_at_every_vertex(name: str, suffix: str, tmp_path: Path) -> None:
    plant = _plants()[name]
    design = obsynth.fault_estimation_filter(plant)
    (file,) = obsynth.export(design, tmp_path / f"region{suffix}")
    found = dict(np.load(file)) if suffix == ".npz" else loadmat(file)
    observer, held, rng = design.scheduled[1], plant.scheduling, np.random.default_rng(2)
    samples, count = 40, len(held.names)
    parameters = rng.dirichlet(np.ones(count), samples) if name == "vertices" else rng.uniform(-1, 1, (samples, count))
    y, u = rng.standard_normal((samples, plant.ny)), rng.standard_normal((samples, plant.nu))
    rows, _ = observer.record(y, np.hstack([u, parameters]))
    # The same by the arrays alone.
    names = [str(text.item() if hasattr(text, "item") else text) for text in found["parameters"].ravel()]
    functions = [str(text.item() if hasattr(text, "item") else text) for text in found["functions"].ravel()]
    z, before = np.zeros((observer.order, 1)), None
    nx, nf = len(observer.state_names), len(observer.fault_names)
    for k in range(samples):
        values = dict(zip(names, parameters[k], strict=True))
        if functions:
            a = np.array([eval(text, vars(np) | {"abs": abs, "min": min} | values) for text in functions])
            share = (a - found["bounds"][:, 0]) / (found["bounds"][:, 1] - found["bounds"][:, 0])
            at_high = found["corners"] == found["bounds"][:, 1]
            weights = np.prod(np.where(at_high, share, 1 - share), axis=1)
        else:
            weights = parameters[k]
        driving = np.r_[u[k], y[k]][:, None]
        row = (found["C"] @ z + found["D"] @ driving)[:, 0]
        if before is not None:
            row[nx : nx + nf] = np.linalg.solve(found["effectiveness"] @ before, row[nx : nx + nf])
            assert row == pytest.approx(rows[k], rel=1e-10, abs=1e-10)
        z, before = (found["A"] @ weights) @ z + (found["B"] @ weights) @ driving, weights
    assert found["forgetting"].item() == observer.forgetting


@pytest.mark.long
def test_other_files_are_refused(tmp_path: Path) -> None:
    design = obsynth.fault_estimation_filter(wang())
    with pytest.raises(SpecError, match="sampled already"):
        obsynth.export(design, tmp_path / "region.fmu", sample_time=1.0)
    with pytest.raises(SpecError, match="leave precision out"):
        obsynth.export(design, tmp_path / "region.c", precision="float")
    with pytest.raises(SpecError, match="leave sample_time out"):
        obsynth.export(design, tmp_path / "region.mat", sample_time=1.0)
    with pytest.raises(SpecError, match="no output"):
        obsynth.export(design, tmp_path / "region.c", thresholds={"fhat[unknown]": 1.0})
