"""The machine of designs/smib with an inertia that changes: a loss of torque, estimated and decided upon."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import obsynth
from obsynth.observers.recursive.batches import run_batch
from obsynth.simulation.linear import varying_runs
from obsynth.specs.documents import read_yaml
from obsynth.specs.loader import load_spec

FOLDER = Path(__file__).parents[2] / "designs" / "smib"
EXPECTED = read_yaml(FOLDER / "expected.yaml")["inertia"]
SPEC = load_spec(FOLDER / "spec_inertia.yaml")
PLANT = SPEC.plant
SAMPLES, ONSET, BACK, TRIALS = 2000, 600, 1400, 25
DEVIATIONS = np.array([1e-5, 1e-5, 4e-5, 1e-7]), np.array([1e-4, 1e-3, 1e-3])


@cache
def design() -> obsynth.ObserverDesign:
    return obsynth.design(PLANT, SPEC.method, name=SPEC.name, **SPEC.options)


@cache
def torque() -> np.ndarray:
    loss = np.zeros((SAMPLES, 1))
    loss[ONSET:BACK], loss[BACK:] = EXPECTED["loss"], EXPECTED["loss"] / 2
    return loss


@cache
def records() -> np.ndarray:
    """Outputs of the trials ``(trials, samples, ny)``; a step of the plant is one product for all of them."""
    generators = [np.random.default_rng(seed) for seed in range(TRIALS)]
    equations = [rng.standard_normal((SAMPLES, 4)) * DEVIATIONS[0] for rng in generators]
    sensors = [rng.standard_normal((SAMPLES - 1, 3)) * DEVIATIONS[1] for rng in generators]
    _, outputs = varying_runs(
        PLANT.replace(horizon=None), parameters=torque(), inputs=np.zeros((SAMPLES, PLANT.nu)),
        initial_state=np.zeros(4), equation_noise=np.stack(equations, axis=1), output_noise=np.stack(sensors, axis=1),
    )  # fmt: skip
    return outputs.swapaxes(0, 1)


def continuous() -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """The reduced plant of the simulator's linearisation: A, C, the column of the torque, and the inertia."""
    source = load_spec(FOLDER / "spec.yaml").transformation.source
    reduced = obsynth.eliminate_algebraic_states(source).plant
    row = source.state_names.index("omega GENCLS 1")
    return reduced.A, reduced.C, reduced.Bf[:, 0], float(source.E[row, row])


def test_the_numbers_are_those_of_the_linearisation() -> None:
    """With the inertia as it is, the sampled plant is the trapezoidal rule for the reduced one, row by row."""
    A, C, torque_column, M = continuous()
    h = PLANT.dt
    assert PLANT.constants["M_before"] == M
    rows = np.diag([1.0, 1.0, M, 1.0])
    np.testing.assert_allclose(PLANT.E.at(1), rows @ (np.eye(4) - h / 2 * A), rtol=1e-13, atol=1e-17)
    np.testing.assert_allclose(PLANT.A.at(0), rows @ (np.eye(4) + h / 2 * A), rtol=1e-13, atol=1e-17)
    np.testing.assert_allclose(PLANT.C.at(1), C, rtol=1e-13)
    np.testing.assert_allclose(PLANT.Phi.at(0)[:, 0], -h * rows @ torque_column, rtol=1e-13)


@cache
def machine_outputs() -> np.ndarray:
    """The machine itself: M(t) omega' = ..., integrated with small tolerances, not sampled by the rule of the model."""
    A, C, torque_column, before = continuous()
    h, after = PLANT.dt, PLANT.constants["M_after"]

    def slope(t: float, x: np.ndarray) -> np.ndarray:
        change = A @ x - torque()[min(int(t / h), SAMPLES - 1), 0] * torque_column
        change[2] *= before / (before + (after - before) * min(max((t - 10.0) / 5.0, 0.0), 1.0))
        return change

    time = h * np.arange(SAMPLES)
    return (C @ solve_ivp(slope, (0.0, time[-1]), np.zeros(4), t_eval=time, rtol=1e-8, atol=1e-12, max_step=h).y).T


@pytest.mark.long
def test_the_machine_itself_is_followed_and_the_schedule_is_needed() -> None:
    rng = np.random.default_rng(0)
    outputs = machine_outputs()[None] + rng.standard_normal((TRIALS, SAMPLES, 3)) * DEVIATIONS[1]
    found = run_batch(design().observer, outputs)
    errors = (found.parameters[:, :, 0] - torque()[:, 0])[:, 900:1200]
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(EXPECTED["machine"]["rmse"], rel=0.2)
    data = {name: matrix.as_data() for name, matrix in PLANT.matrices.items()}
    fixed = PLANT.replace(**data, constants={**PLANT.constants, "M_after": PLANT.constants["M_before"]})
    ratios = []
    for observer in (design().observer, replace(design().observer, plant=fixed)):
        run = observer.run(outputs[0])
        ratios.append(float(np.mean(run.nis[650:1000] / run.nis_degrees[650:1000])))
    assert ratios == pytest.approx(EXPECTED["machine"]["nis"], rel=0.1)


def test_the_design_passes() -> None:
    assert design().report.passed
    claims = design().certificate.claims
    assert claims["contraction"] == pytest.approx(EXPECTED["contraction"], abs=5e-5)
    deviation = design().report["noise in fhat[torque loss GENCLS 1]"].value
    assert deviation == pytest.approx(EXPECTED["deviation"], rel=0.005)


def test_the_errors_are_as_large_as_stated() -> None:
    """The last 300 samples before the change, 100 trials: the error has a correlation time of about 50 samples."""
    errors = run_batch(design().observer, records()).parameters[:, :, 0] - torque()[:, 0]
    quiet, late = errors[:, 300:ONSET], errors[:, 1700:]
    independent = TRIALS * 300 / 50
    for found in (quiet, late):
        deviation = float(np.sqrt(np.mean(found**2)))
        assert deviation == pytest.approx(EXPECTED["deviation"], rel=4 / np.sqrt(2 * independent))
    lag = np.mean(errors[:, ONSET + 49]) / EXPECTED["loss"]
    # After 49 samples, lambda / (1 - lambda), about exp(-1) of a step is left.
    assert lag == pytest.approx(-np.exp(-1.0), abs=0.03)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("statistic", ["chi-square", "cusum", "glr", "nis"])
def test_the_loss_is_noticed(statistic: str) -> None:
    for seed in range(3):
        # The record may end early: the threshold is for as many samples as there are.
        estimates = design().observer.run(records()[seed][: ONSET + 50])
        alarm = obsynth.decide(design().observer, estimates, statistic=statistic, change=0.05).alarm
        assert alarm is not None
        assert 1 <= alarm.k - ONSET <= EXPECTED["delays"][statistic]
        assert alarm.parameter == ("" if statistic == "nis" else "torque loss GENCLS 1")
