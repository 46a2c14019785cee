"""C of designs over a region: the rows that a run on a log has, to twelve digits."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from tests.support.polytopic_plants import WANG_A, WANG_BD, WANG_BF, WANG_C, WANG_E, record, wang

import obsynth
from obsynth import ObserverDesign, PolytopicSystem, SpecError
from obsynth.numerics.arrays import FloatArray

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


def _compiled(design: ObserverDesign, folder: Path) -> Path:
    observer = design.scheduled[1]
    obsynth.export(design, folder / "region.c")
    sizes = {"NU": len(observer.input_names), "NY": len(observer.output_names), "NX": len(observer.state_names),
             "NF": len(observer.fault_names)}  # fmt: skip
    (folder / "main.c").write_text("\n".join(f"#define {k} {v}" for k, v in sizes.items()) + _MAIN)
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


def test_other_files_are_refused(tmp_path: Path) -> None:
    design = obsynth.fault_estimation_filter(wang())
    for suffix in (".fmu", ".mat", ".npz"):
        with pytest.raises(SpecError, match="exported as C"):
            obsynth.export(design, tmp_path / f"region{suffix}")
    with pytest.raises(SpecError, match="the observer alone"):
        obsynth.export(design, tmp_path / "region.c", thresholds={"fhat[f1]": 1.0})
