"""Guaranteed tests as C: a dot product that says what the run on a log says, row by row, blanks and all."""

from __future__ import annotations

import shutil
import subprocess
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import obsynth

ROOT = Path(__file__).parents[2]
FLAGS = ["-Wall", "-Wextra", "-Werror", "-std=c99", "-pedantic", "-ffp-contract=off", "-O2"]
HARNESS = """
#include "test.h"
#include <stdio.h>
int main(void)
{
    test_state state;
    double in[%(width)d], out[2 * %(tests)d + 1];
    test_reset(&state);
    while (fread(in, sizeof in, 1, stdin) == 1) {
        out[2 * %(tests)d] = test_step(&state, %(given)s, out, out + %(tests)d);
        fwrite(out, sizeof out, 1, stdout);
    }
    return 0;
}
"""


@cache
def tanks() -> obsynth.GuaranteedTest:
    plant = obsynth.load_spec(ROOT / "designs/tanks/spec.yaml").plant
    return obsynth.guaranteed_test(plant, isolate=True, course="constant", samples=6, noise_bound=3.0)


#: Shipped designs with this method: specs, and how far signals move in a sample.
SHIPPED = {"drive/guaranteed_test": 0.01, "smib/guaranteed_test": 0.05, "vehicle/spec": 1.0}


@cache
def shipped(name: str) -> obsynth.GuaranteedTest:
    spec = obsynth.load_spec(ROOT / "designs" / f"{name}.yaml")
    return obsynth.guaranteed_test(spec.plant, **spec.options)


def through_c(design: obsynth.GuaranteedTest, folder: Path, signals: np.ndarray) -> np.ndarray:
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler")
    source, _ = obsynth.export(design, folder / "test.c")
    nu = design.linear[0].nu
    given = f"in, in + {nu}" if nu else "in"
    sizes = {"width": signals.shape[1], "tests": len(design.tests), "given": given}
    (folder / "main.c").write_text(HARNESS % sizes)
    command = [compiler, *FLAGS, str(source), str(folder / "main.c"), "-lm", "-o", str(folder / "program")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    ran = subprocess.run([str(folder / "program")], input=signals.tobytes(), capture_output=True, check=True)
    return np.frombuffer(ran.stdout).reshape(len(signals), -1)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", [*SHIPPED, "tanks"])
def test_c_equals_the_run_on_a_log_with_blanks(name: str, tmp_path: Path) -> None:
    design = tanks() if name == "tanks" else shipped(name)
    plant, rng = design.linear[0], np.random.default_rng(4)
    names = (*plant.input_names, *plant.output_names)
    size = SHIPPED.get(name, 1e-4)
    values = np.cumsum(size * rng.standard_normal((140, len(names))), axis=0)
    values[50:53, -1], values[90, plant.nu] = np.nan, np.nan
    found, count = through_c(design, tmp_path, values), len(design.tests)
    point = np.array([plant.operating_point.get(name, 0.0) for name in names])
    data = pd.DataFrame(values + point, columns=names)
    data.insert(0, "time", np.arange(len(data)) * plant.dt)
    table = obsynth.run_on_data(design, data, monitor=obsynth.online_monitor(design)).table
    rows = table[[column for column in table if column.startswith(("r[", "fhat["))]].to_numpy()
    statistic, threshold = (table[column].to_numpy(dtype=float) for column in ("statistic", "threshold"))
    decided = np.isfinite(statistic)
    assert decided.sum() > 20
    assert found[decided, :count] == pytest.approx(rows[decided], rel=1e-12, abs=1e-12 * np.nanmax(np.abs(rows)))
    shares = np.abs(found[decided, :count]) / found[decided, count : 2 * count]
    stands = np.argmax(shares, axis=1)
    assert np.abs(found[decided, :count])[np.arange(len(stands)), stands] == pytest.approx(statistic[decided], rel=1e-9)
    assert found[decided, count : 2 * count][np.arange(len(stands)), stands] == pytest.approx(
        threshold[decided], rel=1e-12
    )
    alarms = np.where(statistic[decided] > threshold[decided], stands + 1, 0)
    assert np.array_equal(found[decided, -1], alarms)
    assert alarms.any()
    # No verdict before the window is full, nor while a sample in it is missing.
    length = max(test.linear[1].order for test in design.tests) + 1
    blank = np.isnan(values).any(axis=1)
    unknown = np.array([k + 1 < length or blank[k + 1 - length : k + 1].any() for k in range(len(values))])
    assert np.array_equal(np.isnan(found[:, 0]), unknown)


@pytest.mark.one_in(6)
@pytest.mark.parametrize("option", [{"exact": True}, {"missing": "solve"}])
@pytest.mark.parametrize("suffix", [".c", ".npz", ".fmu"])
def test_what_solves_programmes_is_not_exported(option: dict[str, object], suffix: str, tmp_path: Path) -> None:
    design = shipped("drive/guaranteed_test").replace(options={**shipped("drive/guaranteed_test").options, **option})
    with pytest.raises(obsynth.SpecError, match=f"option '{next(iter(option))}'.*the fixed test.*can be exported"):
        obsynth.export(design, tmp_path / f"test{suffix}", unverified=True)
    assert not list(tmp_path.iterdir())
