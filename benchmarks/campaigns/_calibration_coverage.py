"""Coverage of calibrated boxes: three tanks simulated as they were measured, from short logs.

    python -m benchmarks.campaigns._calibration_coverage --rows 56 --runs 1000

Each log has its own noise and start; four constants and six variances are found from it, and its 95 % box holds the
four true constants or does not.  Its table tells shares and no wrong cases, so that it stands beside the frame.
"""

from __future__ import annotations

import argparse
import json
from functools import lru_cache
from pathlib import Path

import numpy as np

from obsynth.monitoring.calibration.innovations_fit import guarded_maximum
from obsynth.monitoring.calibration.intervals import profile_root, quantile
from obsynth.monitoring.calibration.logs import RecordedLog
from obsynth.monitoring.calibration.maximum import Objective
from obsynth.monitoring.calibration.plants import NonlinearPlant
from obsynth.monitoring.calibration.problem import CalibrationProblem, calibration_problem
from obsynth.monitoring.calibration.simulation_error import simulation_fits
from obsynth.plants.dae import DAEModel
from obsynth.simulation.dae import simulate_dae
from obsynth.specs.loader import load_spec

DESIGN = Path(__file__).parents[2] / "designs" / "threetank"
BOUNDS = {"a1": (0.005, 0.08), "a2": (0.005, 0.08), "b1": (0.01, 0.1), "b2": (0.01, 0.1)}
TRUTH = {"a1": 0.0163, "a2": 0.0199, "b1": 0.0350, "b2": 0.0354}
Q, R = np.array([2.0e-5, 1.2e-5, 9.0e-7]), np.array([1.7e-5, 4.8e-6, 2.7e-5])
#: Above the measured rows the leak is open, so that levels stay where they were measured.
OPEN = 0.03
SPREAD = 1e-2
#: Of the first log.
SEED = 100_000


def plant(rows: int) -> DAEModel:
    """Return the tanks with the true constants."""
    model = load_spec(DESIGN / "spec.yaml").model
    leak = 0.0 if rows <= 56 else OPEN
    return model.replace(constants={**model.constants, **TRUTH}, parameters={"leak": leak})


def simulated(model: DAEModel, rows: int, seed: int, quantum: float) -> RecordedLog:
    """Return one log with the inputs that were measured."""
    import pandas as pd

    table = pd.read_csv(DESIGN / "log.csv")
    u = table[["u1_held", "u3_held"]].to_numpy()[np.arange(rows) % len(table)]
    rng = np.random.default_rng(seed)
    sensors = np.maximum(R - quantum**2 / 12.0, R / 4.0) if quantum else R
    true = simulate_dae(
        model, u, dt=1.0, initial_state=model.nominal_state + SPREAD * rng.standard_normal(3), Q=np.diag(Q),
        R=np.diag(sensors), integration="backward-euler", seed=seed,
    )  # fmt: skip
    y = np.round(true.outputs / quantum) * quantum if quantum else np.array(true.outputs)
    return RecordedLog(np.arange(float(rows)), u, y, 1.0, model.input_names, model.output_names, (0, rows))


@lru_cache(maxsize=4)
def asked(rows: int, quantum: float) -> tuple[DAEModel, CalibrationProblem]:
    """Return the plant and what is asked of its logs: the same functions serve them all."""
    model = plant(rows)
    problem = calibration_problem(
        NonlinearPlant(model), simulated(model, rows, SEED, quantum), unknown=BOUNDS, priors=None, noisy=None,
        Q=None, R=None, initial_state=None, initial_covariance=SPREAD**2, integration="backward-euler", substeps=1,
    )  # fmt: skip
    return model, problem


def root_at_truth(rows: int, seed: int, quantum: float = 0.0) -> float:
    """Return the largest root of the profile deviance at a true constant: a box with that root just holds them all."""
    model, problem = asked(rows, quantum)
    problem = problem.with_log(simulated(model, rows, seed, quantum))
    fits = simulation_fits(problem, 1, 0, lambda text: None)
    objective = Objective(problem, fits[0])
    maximum, _ = guarded_maximum(objective, fits, lambda text: None)
    return max(profile_root(objective, maximum, i)[0](TRUTH[name] / float(objective.problem.widths[i]))
               for i, name in enumerate(BOUNDS))  # fmt: skip


def limit(rows: int) -> float:
    """Return the root at which 95 % boxes of so many rows end."""
    return quantile(0.95, len(BOUNDS), rows, len(Q) + len(R))


def main() -> None:
    """Run some logs and print the share of boxes that hold the truth."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=56)
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--quantum", type=float, default=0.0)
    parser.add_argument("--journal", type=Path, help="where roots are kept, so that an ended run goes on")
    options = parser.parse_args()
    roots = {}
    if options.journal is not None and options.journal.exists():
        roots = dict(json.loads(line) for line in options.journal.read_text(encoding="utf-8").splitlines())
    for seed in range(SEED, SEED + options.runs):
        if seed not in roots:
            roots[seed] = root_at_truth(options.rows, seed, options.quantum)
            if options.journal is not None:
                with options.journal.open("a", encoding="utf-8") as stream:
                    stream.write(json.dumps([seed, roots[seed]]) + "\n")
    found = np.array([roots[seed] for seed in range(SEED, SEED + options.runs)])
    share = float(np.mean(found <= limit(options.rows)))
    error = np.sqrt(share * (1.0 - share) / len(found))
    print(f"{options.rows} rows: {len(found)} logs, {share:.3f} +- {error:.3f} hold the truth")


if __name__ == "__main__":
    main()
