"""Designs over a region in continuous time as C and FMU: the steps of implicit Euler that a run on a log takes."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import obsynth
from obsynth import ObserverDesign, PolytopicSystem, SpecError
from obsynth.numerics.arrays import FloatArray

_MAIN = """
#include <stdio.h>
#include "region.h"
int main(void)
{
    region_state s;
    double in[NU + NY], rows[NX + NF + NR];
    int i;
    region_reset(&s);
    for (;;) {
        for (i = 0; i < NU + NY; i++) if (scanf("%lf", &in[i]) != 1) return 0;
        region_step(&s, in, in + NU, ARGUMENTS);
        printf("%d %d", s.status, s.any_alarm);
        for (i = 0; i < NX + NF + NR; i++) printf(" %.17g", rows[i]);
        MORE
        printf("\\n");
    }
}
"""
_FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-O1", "-fsanitize=undefined", "-fno-sanitize-recover")
_STATUSES = ("ok", "warm-up", "gap", "recovering", "out")


def random_plant(seed: int) -> PolytopicSystem:
    """Return a stable plant of two to four states, the last of which may be algebraic.

    Its entries are expressions of parameters, with or without rates, or the weights of its vertices are the parameters.
    """
    rng = np.random.default_rng([seed, 51])
    n, algebraic, kind = int(rng.integers(2, 5)), bool(rng.integers(0, 2)), seed % 3
    middle = rng.standard_normal((n, n))
    middle -= (np.max(np.linalg.eigvals(middle).real) + rng.uniform(0.3, 2.0)) * np.eye(n)
    turns = 0.2 * rng.standard_normal((2, n, n))
    E = np.eye(n)
    if algebraic:
        E[-1, -1], middle[-1, -1], turns[:, -1] = 0.0, -2.0, 0.0
    fixed = {
        "E": E.tolist(), "B": rng.standard_normal((n, 1)).tolist(), "Bf": rng.standard_normal((n, 1)).tolist(),
        "Bd": rng.standard_normal((n, 1)).tolist(), "C": np.eye(n)[: max(n - 1, 2)].tolist(),
    }  # fmt: skip
    if kind == 0:
        vertices = [obsynth.DescriptorSystem(A=middle + one * turns[0] + other * turns[1], **fixed)
                    for one, other in ((-1, 0), (1, 0), (0, 1))]  # fmt: skip
        return PolytopicSystem(vertices)
    texts = ["p", "(p * sin(q))"] if kind == 1 else ["exp(-p ** 2)", "q"]
    terms = list(zip(turns, texts, strict=True))
    A = [
        [" + ".join([f"{middle[i, j]:.6f}", *(f"{t[i, j]:.6f} * {text}" for t, text in terms)]) for j in range(n)]
        for i in range(n)
    ]
    scheduling: dict[str, Any] = {"p": {"range": [-1, 1.2], "rate": 6.0 if kind == 1 else 1e3}, "q": [-1, 1.2]}
    return PolytopicSystem(plant={**fixed, "A": A}, scheduling=scheduling)


def rows_of(design: ObserverDesign, seed: int, count: int) -> FloatArray:
    """Return random rows with blank cells, also at the start, and with parameters outside the region, missing or too
    fast."""
    plant, rng = design.scheduled[0], np.random.default_rng(seed)
    held, nu = plant.scheduling, plant.nu
    p = len(held.names)
    if held.gives_weights:
        parameters = 1.1 + np.sin(0.05 * np.arange(count)[:, None] + 2.0 * np.arange(p))
        parameters /= parameters.sum(axis=1, keepdims=True)
    else:
        share = 0.5 + 0.5 * np.sin(0.05 * np.arange(count)[:, None] + np.arange(p))
        parameters = held.low + (held.high - held.low) * share
    rows = np.hstack([rng.standard_normal((count, nu)), parameters, rng.standard_normal((count, plant.ny))])
    rows[0, -1], rows[3, 0], rows[count // 2 : count // 2 + 3, -1] = np.nan, np.nan, np.nan
    rows[40, nu], rows[41, nu + 1], rows[60, nu], rows[-1, nu] = 1e9, np.nan, -3.0, np.nan
    rows[2, nu], rows[80, nu] = np.nan, rows[160, nu]
    return rows


def in_c(design: ObserverDesign, folder: Path, rows: FloatArray, more: str = "", **options: Any) -> FloatArray:
    """Return the output of the C code for each row: status, alarm, estimates, and what ``more`` prints."""
    observer = design.scheduled[1]
    obsynth.export(design, folder / "region.c", **options)
    nx, nf, nr = len(observer.state_names), len(observer.fault_names), len(observer.residual_names)
    sizes = {"NU": len(observer.input_names), "NY": len(observer.output_names), "NX": nx, "NF": nf, "NR": nr}
    groups = ", ".join(f"rows + {at}" for at, size in ((0, nx), (nx, nf), (nx + nf, nr)) if size)
    defined = "".join(f"#define {name} {size}\n" for name, size in sizes.items())
    (folder / "main.c").write_text(defined + _MAIN.replace("ARGUMENTS", groups).replace("MORE", more))
    made = subprocess.run(
        ["gcc", *_FLAGS, "main.c", "region.c", "-lm", "-o", "region"], cwd=folder, capture_output=True, text=True
    )
    assert made.returncode == 0, made.stderr
    text = "\n".join(" ".join(repr(float(value)) for value in row) for row in rows)
    lines = subprocess.run([folder / "region"], input=text, capture_output=True, text=True, check=True).stdout
    return np.array([[float(value) for value in line.split()] for line in lines.splitlines()])


def on_a_log(design: ObserverDesign, folder: Path, rows: FloatArray, h: float, **options: Any) -> pd.DataFrame:
    """Return the table of a run that is saved and resumed twice."""
    observer, parts = design.scheduled[1], []
    log = pd.DataFrame(rows, columns=[*observer.input_names, *observer.output_names])
    log.insert(0, "time", h * np.arange(len(rows)))
    for part in np.array_split(np.arange(len(rows)), 3):
        obsynth.run_on_data(design, log.iloc[part], out=folder / "run.csv", state=folder / "state.json", **options)
        parts.append(pd.read_csv(folder / "run.csv"))
    return pd.concat(parts, ignore_index=True)


def watched_plant(seed: int) -> PolytopicSystem:
    """Return a plant with noise of its sensors and a bounded disturbance, linear in its parameters, or with weights."""
    rng, plant = np.random.default_rng([seed, 52]), random_plant(3 * seed)
    noisy = [
        vertex.replace(Bw=np.zeros((plant.nx, plant.ny)), Dw=0.002 * np.eye(plant.ny), noise_names=None)
        for vertex in plant.vertices
    ]
    if seed % 2:
        return PolytopicSystem(noisy)
    first, turn = noisy[0], 0.2 * rng.standard_normal((2, plant.nx, plant.nx))
    turn[:, np.flatnonzero(~plant.E.any(axis=1))] = 0.0
    A = [
        [f"{first.A[i, j]:.6f} + {turn[0, i, j]:.6f} * q + {turn[1, i, j]:.6f} * p" for j in range(plant.nx)]
        for i in range(plant.nx)
    ]
    names = ("E", "Bf", "Bd", "C", "Bw", "Dw") + (() if seed % 10 == 0 else ("B",))
    fixed = {name: getattr(first, name).tolist() for name in names}
    return PolytopicSystem(plant={**fixed, "A": A}, scheduling={"p": [-1, 1.2], "q": {"range": [0, 2], "rate": 1e3}})


@pytest.mark.skipif(shutil.which("gcc") is None, reason="no C compiler")
@pytest.mark.usefixtures("taken_as_verified")
@pytest.mark.parametrize(
    ("seed", "h", "initial_error", "warm_up"),
    [
        (2, 0.1, None, None),
        (3, 0.1, 0.5, 0.0),
        pytest.param(20, 0.05, 0.0, None, marks=pytest.mark.long),
        *(pytest.param(s, 0.1, None, 0.0, marks=pytest.mark.long) for s in (8, 14, 22, 25, 26, 27)),
    ],
)
def test_guaranteed_thresholds_in_c_follow_the_rows_as_in_a_run(
    seed: int, h: float, initial_error: float | None, warm_up: float | None, tmp_path: Path
) -> None:
    """C has the norm and the threshold of a run in every row, in gaps, and after rows outside the region."""
    design = obsynth.ui_pi_observer(watched_plant(seed))
    bounds = dict.fromkeys(design.plant.disturbance_names, 0.1)
    monitor = obsynth.online_monitor(design, disturbance_bounds=bounds, noise_bound=3, initial_error=initial_error)
    rows, ny = rows_of(design, seed, 1500), design.plant.ny
    if initial_error is not None:
        # The first rows are whole: the stated start counts.
        rows[:4] = rows[4]
    rows[:, -ny:] *= np.where(np.arange(1500) % 90 < 45, 0.01, 1.0)[:, None]
    more = ' printf(" %.17g %.17g %d", s.monitor.norm, s.monitor.threshold, s.monitor.alarm);'
    found = in_c(design, tmp_path, rows, more, sample_time=h, monitor=monitor, warm_up=warm_up)
    run = on_a_log(design, tmp_path, rows, h, monitor=monitor, warm_up=warm_up)
    assert [_STATUSES[int(status)] for status in found[:, 0]] == run.status.tolist()
    numbers, in_texts = run[["statistic", "threshold"]].to_numpy(), found[:, -3:-1]
    assert np.array_equal(np.isnan(numbers), np.isnan(in_texts))
    shown = ~np.isnan(numbers)
    assert shown[:, 1].sum() > 200
    assert np.max(np.abs(numbers - in_texts)[shown] / np.maximum(np.abs(numbers[shown]), 1e-3)) < 1e-11
    assert np.array_equal(found[:, -1] == 1.0, run.alarm.notna())


@pytest.mark.skipif(shutil.which("gcc") is None, reason="no C compiler")
@pytest.mark.usefixtures("taken_as_verified")
@pytest.mark.parametrize(
    ("seed", "h"),
    [
        (6, 0.3),
        pytest.param(7, 0.02, marks=pytest.mark.long),
        pytest.param(2, 2.0, marks=pytest.mark.long),
        *(pytest.param(s, 0.05 * s + 0.1, marks=pytest.mark.long) for s in (0, 1, 9, 14, 17)),
    ],
)
def test_c_equals_a_run_that_is_resumed(seed: int, h: float, tmp_path: Path) -> None:
    design = obsynth.ui_pi_observer(random_plant(seed))
    rows, shown = rows_of(design, seed, 240), design.scheduled[1].row_names
    levels = {name: 0.5 for name in shown if name.startswith("fhat[")}
    for warm_up in (None, 7.0 * h):
        folder = tmp_path / str(warm_up)
        folder.mkdir()
        found = in_c(design, folder, rows, sample_time=h, thresholds=levels, warm_up=warm_up)
        run = on_a_log(design, folder, rows, h, thresholds=levels, warm_up=warm_up)
        assert [_STATUSES[int(status)] for status in found[:, 0]] == run.status.tolist()
        assert {"out", "gap", "warm-up"} <= set(run.status)
        numbers = run[list(shown)].to_numpy()
        assert np.array_equal(np.isnan(numbers), np.isnan(found[:, 2:]))
        assert np.nanmax(np.abs(numbers - found[:, 2:]) / np.maximum(np.abs(numbers), 1.0)) < 1e-12
        assert np.array_equal(found[:, 1] == 1.0, run.alarm.notna())


@pytest.mark.long
@pytest.mark.usefixtures("taken_as_verified")
def test_what_is_not_written_is_refused_with_what_can_be_done(tmp_path: Path) -> None:
    matrices: dict[str, Any] = {
        "A": [["-1 - v", 1], [0, -2]], "Bf": [[0], [1]], "C": [[1, 0], [0, 1]], "Bw": [[0], [0]], "Dw": [[0], [0.01]],
    }  # fmt: skip
    plant = PolytopicSystem(plant=matrices, scheduling={"v": [0, 1]})
    design = obsynth.ui_pi_observer(plant)
    for name in ("region.c", "region.fmu"):
        with pytest.raises(SpecError, match="continuous in time: give the sample time"):
            obsynth.export(design, tmp_path / name)
    with pytest.raises(SpecError, match="seconds, above 0"):
        obsynth.export(design, tmp_path / "region.c", sample_time=-0.1)
    with pytest.raises(SpecError, match="leave precision out"):
        obsynth.export(design, tmp_path / "region.c", sample_time=0.1, precision="float")
    monitor = obsynth.online_monitor(design, noise_bound=3.0)
    with pytest.raises(SpecError, match=r"no row would have a threshold\. Give a shorter sample time"):
        obsynth.export(design, tmp_path / "region.c", sample_time=50.0, monitor=monitor)
    squared = {**matrices, "A": [["-1 - v ** 2", 1], [0, -2]]}
    other = obsynth.ui_pi_observer(PolytopicSystem(plant=squared, scheduling={"v": [0, 1]}))
    enclosed = obsynth.online_monitor(other, noise_bound=3.0)
    with pytest.raises(SpecError, match=r"by enclosures of 'v \*\* 2' between two of them"):
        obsynth.export(other, tmp_path / "region.c", sample_time=0.1, monitor=enclosed)
    assert not list(tmp_path.iterdir())
    # What the message names.
    assert obsynth.export(design, tmp_path / "region.c", sample_time=0.1, thresholds={"fhat[f1]": 0.2})
