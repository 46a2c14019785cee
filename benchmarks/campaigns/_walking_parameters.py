"""Covariances of parameters that walk as stated: nonlinear and linear observers on 200 simulated records each.

    python -m benchmarks.campaigns._walking_parameters --runs 200

At each sample the squared errors of the parameters, in units of the covariance that is stated there, have a mean of one
per parameter; the table tells in which share of the samples it lies in the 95 % band of so many runs.
"""

from __future__ import annotations

import argparse
from typing import NamedTuple

import numpy as np

from obsynth.methods.functions import adaptive_observer, dae_adaptive_observer
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.batches import run_dae_batch
from obsynth.plants.dae import DAEModel
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.simulation.dae import simulate_dae

SAMPLES = 120
FORMS = ("random-walk", "augmented-kalman")


class Case(NamedTuple):
    """A nonlinear plant with its noise: by equation, by output, of the walk and of its start by parameter."""

    model: DAEModel
    dt: float
    Q: dict[str, float]
    R: dict[str, float]
    walk: dict[str, float]
    start: dict[str, float]


def cases() -> dict[str, Case]:
    """Return the nonlinear plants."""
    spring = DAEModel(
        {"place": "der(x) = v", "force": "der(v) = -k * x - 0.4 * v + u"}, {"seen": "x", "speed": "v"},
        states={"x": 1.0, "v": 1.0}, inputs={"u": 1.0}, parameters={"k": 2.0},
        units=dict.fromkeys(("x", "v", "u", "k", "seen", "speed"), "1"),
    )  # fmt: skip
    offsets = DAEModel(
        {"balance": "3 * der(x) = u - x + leak", "sensor": "level = x"}, {"y": "level + bias", "z": "level"},
        states={"x": 0.5, "level": 0.5}, inputs={"u": 1.0}, parameters={"leak": 0.0, "bias": 0.0},
        units=dict.fromkeys(("x", "level", "u", "leak", "bias", "y", "z"), "1"),
    )  # fmt: skip
    return {
        "stiffness of a spring": Case(spring, 0.1, {"force": 1e-4}, {"seen": 1e-4, "speed": 1e-2}, {"k": 4e-4},
                                      {"k": 0.04}),
        "leak and bias of a tank": Case(offsets, 0.5, {"balance": 1e-4}, {"y": 1e-3, "z": 1e-3},
                                        {"leak": 1e-3, "bias": 1e-3}, {"leak": 0.04, "bias": 0.04}),
    }  # fmt: skip


def nonlinear_errors(case: Case, form: str, runs: int) -> FloatArray:
    """Return the mean squared error at each sample, per parameter and in units of the stated covariance."""
    design = dae_adaptive_observer(
        case.model, dt=case.dt, Q=case.Q, R=case.R, form=form, random_walk=case.walk,
        initial_parameter_covariance=case.start, initial_covariance=1e-4, integration="backward-euler",
    )  # fmt: skip
    observer, rng = design.observer, np.random.default_rng(0)
    u = np.sign(np.sin(0.15 * np.arange(SAMPLES)))[:, None]
    steps, start = np.sqrt(np.diag(observer.random_walk)), np.sqrt(np.diag(observer.initial_parameter_covariance))
    paths, outputs = [], []
    for run in range(runs):
        walk = np.cumsum(steps * rng.standard_normal((SAMPLES, len(steps))), axis=0)
        path = observer.initial_parameters + start * rng.standard_normal(len(steps)) + walk - walk[0]
        x0 = observer.initial_state + 1e-2 * rng.standard_normal(case.model.nx)
        true = simulate_dae(case.model, u, dt=case.dt, parameters=path, initial_state=x0, Q=observer.Q, R=observer.R,
                            integration="backward-euler", seed=run)  # fmt: skip
        paths.append(path)
        outputs.append(true.outputs)
    found = run_dae_batch(observer, np.array(outputs), u, compiled=False, progress=False)
    return weighted(found.parameters - np.array(paths), found.parameter_covariances)


def linear_errors(runs: int) -> FloatArray:
    """Return the same of a time-varying plant with a random walk."""
    plant = TimeVaryingDescriptorSystem(
        [[1, 0.3], [0, 1]], [[0.9, 0.2], [-0.1, "0.8 + 0.1 * sin(0.1 * k)"]], [[1], [0]], [[1, 0], [0, 1]],
        Phi=[["1 + 0.5 * sin(0.2 * k)"], [0.3]], dt=1.0,
    )  # fmt: skip
    Q, R = np.diag([1e-2, 1e-4]), np.diag([1e-2, 1e-2])
    design = adaptive_observer(plant, Q=Q, R=R, form="random-walk", random_walk=4e-3, initial_covariance=1e-2,
                               initial_parameter_covariance=[[0.25]])  # fmt: skip
    observer, rng = design.observer, np.random.default_rng(0)
    gaps, covariances = [], []
    for _ in range(runs):
        theta = 0.5 * rng.standard_normal() + np.cumsum(np.sqrt(4e-3) * rng.standard_normal(SAMPLES))
        x, y = 0.1 * rng.standard_normal(2), np.zeros((SAMPLES, 2))
        u = np.sign(np.sin(0.1 * np.arange(SAMPLES)))[:, None]
        for k in range(1, SAMPLES):
            driven = plant.A.at(k - 1) @ x + plant.B.at(k - 1) @ u[k - 1] + plant.Phi.at(k - 1)[:, 0] * theta[k - 1]
            x = np.linalg.solve(plant.E.at(k), driven + np.sqrt(np.diag(Q)) * rng.standard_normal(2))
            y[k] = x + np.sqrt(np.diag(R)) * rng.standard_normal(2)
        found = observer.run(y, u)
        # The estimate at k is of the parameter that acted in the step that ends there.
        gaps.append(found.parameters[1:, 0] - theta[:-1])
        covariances.append(found.parameter_covariances[1:])
    return weighted(np.array(gaps)[:, :, None], np.array(covariances))


def weighted(gaps: FloatArray, covariances: FloatArray) -> FloatArray:
    """Return the mean over trials of ``e' P^-1 e / nq`` at each sample."""
    white = np.linalg.solve(covariances, gaps[..., None])[..., 0]
    return np.asarray((gaps * white).sum(axis=-1).mean(axis=0) / gaps.shape[-1])


def share_in_band(errors: FloatArray, runs: int, parameters: int) -> float:
    """Return the share of samples in the 95 % band."""
    from scipy.stats import chi2

    low, high = chi2.ppf([0.025, 0.975], runs * parameters) / (runs * parameters)
    return float(np.mean((errors >= low) & (errors <= high)))


def main() -> None:
    """Print a row for each plant and form."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=200)
    runs = parser.parse_args().runs
    print("| plant | form | mean of NEES | samples in the 95 % band |\n| --- | --- | --- | --- |")
    for name, case in cases().items():
        for form in FORMS:
            errors = nonlinear_errors(case, form, runs)[1:]
            share = share_in_band(errors, runs, len(case.walk))
            print(f"| {name} | {form} | {errors.mean():.3f} | {100 * share:.0f} % |")
    errors = linear_errors(runs)
    print(f"| linear and varying | random-walk | {errors.mean():.3f} | "
          f"{100 * share_in_band(errors, runs, 1):.0f} % |")  # fmt: skip


if __name__ == "__main__":
    main()
