"""C and `obsynth run` on short logs with outliers at any row, the first ones above all.

Nonlinear observers of three plants (`_plants_of_logs`), with one to four inputs; every second one starts from a wide
covariance.  Thresholds are learned from 400 rows.  A log has 40 rows: outliers of 5 to 10^9 deviations of one sensor,
some or all, one to three in a row; four logs of ten have blanks, two of ten lack inputs, three of ten have a sensor
that is off from the first row on, and three of ten begin with a row without outputs.  Wrong is a log of which a row
differs: estimates, deviations and residuals by more than 10^-6 of the largest of their column (both solve implicit
equations to their own rounding), or status, alarm of the monitor, or its statistic by more than 10^-6 (5 % where it is
above 10^9, as digits of covariances cancel there).  Where a step has no solution, `run` says so, and nothing is
compared.
"""

from __future__ import annotations

import ctypes
import functools
import shutil
import subprocess
import tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
from benchmarks.campaigns._plants_of_logs import PLANTS, as_log, simulated
from benchmarks.campaigns.frame import Outcome

import obsynth as ob

CASES, LIMIT = 2000, 300.0
NAMES = ("tanks", "motor", "exchanger")
ROWS, LEARNED = 40, 400
SIZES = (5.0, 8.0, 20.0, 60.0, 500.0, 1e4, 1e9)
CLOSE, LARGE, LARGE_CLOSE = 1e-6, 1e9, 0.05
STATUSES = np.array(["ok", "warm-up", "gap", "recovering", "partial"])

HARNESS = """
#include "NAME.h"
void run(const double *in, double *out, int rows)
{
    static NAME_state state;
    static NAME_estimates found;
    int i;
    NAME_reset(&state);
    for (; rows > 0; rows--, in += NU + NY, out += WIDTH) {
        NAME_step(&state, in, in + NU, &found);
        for (i = 0; i < NX; i++) { out[i] = found.states[i]; out[NX + NQ + i] = found.state_deviations[i]; }
        for (i = 0; i < NQ; i++) { out[NX + i] = found.faults[i]; out[2 * NX + NQ + i] = found.fault_deviations[i]; }
        for (i = 0; i < NY; i++) out[2 * NX + 2 * NQ + i] = found.residuals[i];
        out[WIDTH - 3] = state.status;
        out[WIDTH - 2] = state.monitor.statistic;
        out[WIDTH - 1] = state.monitor.alarm;
    }
}
"""


@functools.cache
def compiled(name: str, wide: bool) -> SimpleNamespace:
    """Return the design of a plant, its monitor, and its C."""
    plant = PLANTS[name]()
    sizes, model = np.array(plant.sizes), plant.model
    starts = {
        state: (0.5 * abs(value) + 0.1) ** 2 for state, value in zip(model.state_names, plant.start, strict=False)
    }
    design = ob.dae_adaptive_observer(
        model, dt=plant.dt, R=np.diag(np.array(plant.noise) ** 2), form="augmented-kalman", name=name,
        Q={equation: size**2 for equation, size in zip(model.equation_names, plant.process, strict=False)},
        random_walk=np.diag((sizes / 30) ** 2), initial_parameter_covariance=np.diag(sizes**2 / 100), outliers="gate",
        outlier_sizes=dict(zip(model.output_names, 12 * np.array(plant.noise), strict=True)),
        **({"initial_covariance": starts} if wide else {}),
    )  # fmt: skip
    u, y = simulated(plant, [5], np.zeros((1, len(sizes))))[0]
    log = as_log(plant, u[:LEARNED], y[:LEARNED])
    monitor = ob.online_monitor(
        design, "learned", normal=ob.learn_thresholds(design, log, false_alarms="1 per 100 rows")
    )
    nx, nq, nu, ny = model.nx, model.nq, model.nu, model.ny
    width = 2 * nx + 2 * nq + ny + 3
    folder = Path(tempfile.mkdtemp(prefix="obsynth-c-"))
    try:
        sources = ob.export(design, folder / f"{name}.c", monitor=monitor)
        text = HARNESS
        for word, number in (("NAME", name), ("WIDTH", width), ("NX", nx), ("NQ", nq), ("NU", nu), ("NY", ny)):
            text = text.replace(word, str(number))
        (folder / "run.c").write_text(text)
        files = [str(file) for file in (*sources, folder / "run.c") if file.suffix == ".c"]
        command = ["cc", "-O1", "-ffp-contract=off", "-shared", "-fPIC", *files, "-o", str(folder / "all.so"), "-lm"]
        subprocess.run(command, check=True)
        code = ctypes.CDLL(str(folder / "all.so"))
    finally:
        shutil.rmtree(folder)
    return SimpleNamespace(plant=plant, design=design, monitor=monitor, code=code, width=width)


def log_of(plant: Any, rng: np.random.Generator) -> pd.DataFrame:
    """Return a short log with outliers, and some with blanks, inputs that lack, and sensors that are off."""
    record = simulated(plant, [int(rng.integers(2**31))], np.zeros((1, len(plant.sizes))), rows=ROWS)[0]
    u, y = (np.array(part) for part in record)
    noise = np.array(plant.noise)
    if rng.random() < 0.3:
        y[:, rng.integers(y.shape[1])] += float(noise.mean() * rng.choice([3.0, 30.0, 300.0]))
    if rng.random() < 0.3:
        y[0] = np.nan
    for _ in range(rng.integers(1, 7)):
        row = int(rng.integers(ROWS) if rng.random() < 0.4 else rng.integers(5))
        which = rng.random(y.shape[1]) < rng.choice([0.3, 1.0])
        y[row : row + int(rng.integers(1, 4)), which] += (rng.choice([-1, 1]) * rng.choice(SIZES) * noise)[which]
    if rng.random() < 0.4:
        y[rng.random(y.shape) < 0.05] = np.nan
    if rng.random() < 0.2:
        u[rng.random(u.shape) < 0.03] = np.nan
    return as_log(plant, u, y)


def case(seed: int) -> Outcome:
    """Compare C and a run on one log."""
    name, wide = NAMES[seed % len(NAMES)], bool(seed // len(NAMES) % 2)
    given, rng = compiled(name, wide), np.random.default_rng([11, seed])
    log = log_of(given.plant, rng)
    group = f"{name}, {'wide' if wide else 'usual'} start"
    try:
        run = ob.run_on_data(given.design, log, monitor=given.monitor, warm_up=0.0, recovered="none").table
    except ob.SolverError:
        return Outcome(group, "no step")
    out, pointer = np.zeros((ROWS, given.width)), ctypes.POINTER(ctypes.c_double)
    signals = np.ascontiguousarray(log.to_numpy(dtype=float)[:, 1:])
    given.code.run(signals.ctypes.data_as(pointer), out.ctypes.data_as(pointer), ROWS)
    rows = differing(run, out)
    return Outcome(
        group, "differs" if rows.any() else "same", f"rows {np.flatnonzero(rows).tolist()}" if rows.any() else ""
    )


def differing(run: pd.DataFrame, out: np.ndarray) -> np.ndarray:
    """Return in which rows a run and C differ."""
    columns = [name for start in ("xhat[", "fhat[", "sd xhat[", "sd fhat[", "r[") for name in run.columns
               if name.startswith(start)]  # fmt: skip
    wanted, found = run[columns].to_numpy(dtype=float), out[:, : len(columns)]
    sizes = np.maximum(np.nanmax(np.abs(wanted), axis=0, initial=0.0, where=np.isfinite(wanted)), 1e-9)
    off = (np.isnan(wanted) != np.isnan(found)) | (np.nan_to_num(np.abs(found - wanted) / sizes) > CLOSE)
    rows = off.any(axis=1) | (STATUSES[out[:, -3].astype(int)] != run["status"].to_numpy())
    statistic = run["statistic"].to_numpy(dtype=float)
    close = np.where(np.nan_to_num(statistic) > LARGE, LARGE_CLOSE, CLOSE) * np.maximum(np.abs(statistic), 1.0)
    rows |= np.isnan(statistic) != np.isnan(out[:, -2])
    rows |= np.nan_to_num(np.abs(out[:, -2] - statistic) - close) > 0.0
    return np.asarray(rows | ((out[:, -1] != 0.0) != (np.nan_to_num(statistic) > 1.0)))
