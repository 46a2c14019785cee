"""Rows per second of `obsynth.run_on_data`, beside python-control's `forced_response` on the same realisation.

Every result is checked before it is timed.  One thread: set OMP_NUM_THREADS=1.  ``--frame ROWS`` prints processor
seconds and peak memory of a run on a frame of so many rows, with four states, in a process that loads nothing else.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
from fault_estimation_filter import peak

import obsynth

ROWS = 20_000
REPEATS = 5


def made_up(nx: int) -> obsynth.ObserverDesign:
    """Return a stable realisation with nx states, two known inputs, four outputs and one fault; gains play no role."""
    rng = np.random.default_rng(nx)
    a = rng.normal(size=(nx, nx))
    plant = obsynth.DescriptorSystem(
        None, 0.9 * a / np.abs(np.linalg.eigvals(a)).max(), rng.normal(size=(nx, 2)), rng.normal(size=(4, nx)),
        Bf=rng.normal(size=(nx, 1)), dt=0.01,
    )  # fmt: skip
    observer = obsynth.LinearObserver(
        Az=plant.A, Bu=plant.B, By=rng.normal(size=(nx, 4)), Cz=rng.normal(size=(nx + 5, nx)), Du=np.zeros((nx + 5, 2)),
        Dy=rng.normal(size=(nx + 5, 4)), dt=plant.dt, input_names=plant.input_names, output_names=plant.output_names,
        state_names=plant.state_names, fault_names=plant.fault_names, residual_names=plant.output_names,
        state_delays=(0,) * nx, fault_delays=(1,),
    )  # fmt: skip
    return obsynth.ObserverDesign("made up", "none", plant, {}, {}, observer, obsynth.Certificate({}, {}), {})


def best(work: Callable[[], object], rows: int) -> float:
    """Return rows per second, best of several."""
    seconds = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - begin)
    return rows / min(seconds)


def frame_of(rows: int) -> float:
    """Return the processor seconds to run a design on a frame."""
    design = made_up(4)
    names = [*design.linear[1].input_names, *design.linear[1].output_names]
    frame = pd.DataFrame(np.random.default_rng(0).normal(size=(rows, len(names))), columns=names)
    frame.insert(0, "time", 0.01 * np.arange(rows))
    began = time.process_time()
    run = obsynth.run_on_data(design, frame)
    spent = time.process_time() - began
    assert run.rows == rows
    return spent


def main() -> None:
    """Print one line of the table for each size."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--small", action="store_true", help="one small instance, to see that it runs")
    parser.add_argument("--frame", type=int, help="print seconds and peak memory of a run on so many rows, no table")
    options = parser.parse_args()
    if options.frame:
        print(frame_of(options.frame), peak())
        return
    import control

    small = options.small
    rows = 500 if small else ROWS
    for nx in (4,) if small else (4, 20, 100):
        design = made_up(nx)
        observer = design.linear[1]
        names = [*observer.input_names, *observer.output_names]
        signals = np.random.default_rng(1).normal(size=(rows, len(names)))
        table = pd.DataFrame(signals, columns=names)
        table.insert(0, "time", observer.dt * np.arange(rows))
        system = design.to_control()
        stamps = observer.dt * np.arange(rows)
        wanted = control.forced_response(system, stamps, signals.T).outputs.T
        found = obsynth.run_on_data(design, table).table
        assert found is not None
        assert np.abs(found.iloc[:, -wanted.shape[1] :].to_numpy() - wanted).max() < 1e-9 * np.abs(wanted).max()
        with tempfile.TemporaryDirectory() as folder:
            log, out = Path(folder) / "log.csv", Path(folder) / "out.csv"
            table.to_csv(log, index=False)
            rates = [
                best(lambda log=log, out=out, design=design: obsynth.run_on_data(design, log, out), rows),
                best(lambda table=table, design=design: obsynth.run_on_data(design, table), rows),
                best(lambda observer=observer, signals=signals: observer.run(signals[:, 2:], signals[:, :2]), rows),
                best(
                    lambda system=system, stamps=stamps, s=signals: control.forced_response(system, stamps, s.T), rows
                ),
            ]
        print(f"| {nx} | " + " | ".join(f"{rate:,.0f}" for rate in rates) + " |", flush=True)


if __name__ == "__main__":
    main()
