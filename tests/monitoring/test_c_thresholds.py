"""Thresholds over tolerances as C are those of Python."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from test_adaptive_thresholds import exact_records
from uncertain_plants import drive, wang

import obsynth
from obsynth.errors import SpecError
from obsynth.verification.over_tolerances.adaptive_recursion import thresholds_of_records

COMPILER = shutil.which("cc") or shutil.which("gcc")


def uneven() -> obsynth.DescriptorSystem:
    """Return the drive with a stiffness that is nearer to one end of its range: the middle is not nominal."""
    return obsynth.uncertain_system(drive(), {"k": {"range": [18.0, 24.0]}})


@pytest.mark.skipif(COMPILER is None, reason="no C compiler")
@pytest.mark.parametrize(
    ("make", "level", "start"),
    [(drive, "-O2", "initial_error"), (wang, "-O0", "initial_error"), (uneven, "-O0", "initial_set")],
)
def test_c_gives_the_thresholds_of_python(tmp_path: Path, make, level: str, start: str) -> None:
    plant = make()
    design = obsynth.fault_estimation_filter(plant)
    known = {"initial_error": 0.3, "initial_set": dict.fromkeys(plant.state_names, 0.3)}[start]
    monitor = obsynth.online_monitor(
        design, constants=plant.uncertainty, noise_bound=1.0 if plant.nw else None, **{start: known},
        disturbance_bounds={plant.disturbance_names[0]: 0.1},
    )  # fmt: skip
    source, _ = obsynth.export(design, tmp_path / "filter.c", monitor=monitor)
    library = tmp_path / "filter.so"
    flags = ["-std=c99", level, "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC"]
    subprocess.run([str(COMPILER), *flags, str(source), "-o", str(library), "-lm"], check=True)
    code = ctypes.CDLL(str(library))
    bound = monitor.rule.plan.bound
    rows, u, y, _ = exact_records(design, np.zeros((1, bound.counts[0])), 120, 3)
    python = thresholds_of_records(bound, rows @ bound.structure.reading.T, u, y).total[0]
    state = (ctypes.c_double * 4_000_000)()
    code.filter_thresholds_reset(state)
    total = np.zeros(python.shape[1])
    pointer = lambda values: np.ascontiguousarray(values).ctypes.data_as(ctypes.c_void_p)  # noqa: E731
    for k in range(120):
        code.filter_thresholds_step(state, pointer(u[0, k]), pointer(y[0, k]), pointer(rows[0, k]), pointer(total))
        assert total == pytest.approx(python[k], rel=1e-10)
    # A row in which something is missing bounds nothing, and the next one is the first after a later start.
    code.filter_thresholds_step(state, pointer(u[0, 0]), pointer(y[0, 0]), pointer(rows[0, 0] * np.nan), pointer(total))
    assert np.isposinf(total).all()
    again = thresholds_of_records(monitor.rule.later.bound, rows @ bound.structure.reading.T, u, y).total[0]
    for k in range(120):
        code.filter_thresholds_step(state, pointer(u[0, k]), pointer(y[0, k]), pointer(rows[0, k]), pointer(total))
        assert total == pytest.approx(again[k], rel=1e-10)


@pytest.mark.long
def test_what_cannot_be_written_is_refused(tmp_path: Path) -> None:
    design = obsynth.fault_estimation_filter(drive())
    bounds = {"noise_bound": 1.0, "disturbance_bounds": {"load": 0.1}}
    with pytest.raises(SpecError, match="make it with constants"):
        obsynth.export(design, tmp_path / "a.c", monitor=obsynth.online_monitor(design, **bounds))
    varying = obsynth.online_monitor(design, constants=drive(variation="varying").uncertainty, **bounds)
    with pytest.raises(SpecError, match="stay the same"):
        obsynth.export(design, tmp_path / "a.c", monitor=varying)
    with pytest.raises(SpecError, match="as C"):
        obsynth.export(design, tmp_path / "a.npz", monitor=varying)
