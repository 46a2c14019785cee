"""Plants with a lasting motion that no output shows are validated as their part that shows is."""

import numpy as np
import pandas as pd
import pytest

import obsynth

ROWS, NOISE = 600, 0.1

#: The part that shows: two states, two sensors, one fault.
SHOWN = {"A": [[0.8, 0.1], [0.0, 0.6]], "C": [[1.0, 0.0], [0.0, 1.0]], "Bf": [[1.0], [0.5]], "B": [[1.0], [0.0]]}


def whole(seed: int, hidden: np.ndarray) -> obsynth.DescriptorSystem:
    """Return the plant with ``hidden`` motions beside it, driven by all, in coordinates of a seed."""
    rng, k = np.random.default_rng(seed), len(hidden)
    turn = rng.normal(size=(2 + k, 2 + k)) + 3.0 * np.eye(2 + k)
    A = np.block([[np.array(SHOWN["A"]), np.zeros((2, k))], [rng.normal(size=(k, 2)), hidden]])
    back = np.linalg.inv(turn)
    more = {name: np.vstack([SHOWN[name], rng.normal(size=(k, 1))]) for name in ("B", "Bf")}
    return plant(
        A=turn @ A @ back,
        C=np.hstack([SHOWN["C"], np.zeros((2, k))]) @ back,
        **{name: turn @ matrix for name, matrix in more.items()},
    )


def plant(**matrices) -> obsynth.DescriptorSystem:
    return obsynth.DescriptorSystem(**matrices, dt=1.0, sensor_noise={"y1": NOISE, "y2": NOISE})


def log(seed: int) -> pd.DataFrame:
    """Return a log of the part that shows, by its own recursion."""
    rng = np.random.default_rng(seed)
    u, x, rows = np.sin(0.1 * np.arange(ROWS)), np.zeros(2), []
    for k in range(ROWS):
        rows.append([float(k), u[k], *(np.array(SHOWN["C"]) @ x + NOISE * rng.normal(size=2))])
        x = np.array(SHOWN["A"]) @ x + np.array(SHOWN["B"]) @ u[k : k + 1]
    return pd.DataFrame(rows, columns=["time", "u1", "y1", "y2"])


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    "hidden",
    [np.array([[1.0]]), np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.6, 0.8], [-0.8, 0.6]])],
    ids=["integrator", "two integrators", "oscillation"],
)
def test_a_hidden_motion_changes_no_innovation(hidden: np.ndarray, seed: int) -> None:
    """It was refused: 'No observer of this kind exists: the condition detectability fails'."""
    design = obsynth.functional_filter(whole(seed, hidden))
    found, wanted = (
        obsynth.validate(design, log(seed)),
        obsynth.validate(obsynth.functional_filter(plant(**SHOWN)), log(seed)),
    )
    assert found.passed == wanted.passed
    # The start is forgotten by then: 0.8 to the power of 100.
    np.testing.assert_allclose(found.innovations[100:], wanted.innovations[100:], atol=1e-6)


def test_a_lasting_motion_behind_an_unknown_input_is_left_out() -> None:
    """A quarter car: its body and its wheel move on together, as the speed of the road is unknown."""
    ms, mu, ks, cs, kt = 300.0, 40.0, 18000.0, 1200.0, 180000.0
    car = obsynth.DescriptorSystem(
        E=np.diag([1.0, ms, 1.0, mu]),
        A=[[0, 1, 0, -1], [-ks, -cs, 0, cs], [0, 0, 0, 1], [ks, cs, -kt, -cs]],
        Bf=[[0], [1], [0], [-1]],
        Bd=[[0], [0], [-1], [0]],
        C=[[1, 0, 0, 0], [-ks / ms, -cs / ms, 0, cs / ms], [ks / mu, cs / mu, -kt / mu, -cs / mu]],
        Df=[[0], [1 / ms], [-1 / mu]],
        sensor_noise={"y1": 0.001, "y2": 0.05, "y3": 0.3},
    )
    design = obsynth.functional_filter(obsynth.discretise(car, 0.005))
    rng, sampled = np.random.default_rng(4), design.plant
    step, x, rows = np.linalg.inv(sampled.E), np.zeros(4), []
    for k in range(2000):
        fault = 100.0 * (k >= 1000)
        noise = np.array([0.001, 0.05, 0.3]) * rng.normal(size=3)
        rows.append([0.005 * k, *(sampled.C @ x + sampled.Df[:, 0] * fault + noise)])
        x = step @ (sampled.A @ x + sampled.Bf[:, 0] * fault + sampled.Bd[:, 0] * rng.normal())
    table = pd.DataFrame(rows, columns=["time", "y1", "y2", "y3"])
    normal, faulty = obsynth.validate(design, table.iloc[:1000]), obsynth.validate(design, table.iloc[1000:])
    # 2,000 degrees of freedom: five deviations of their mean square are 0.16.
    assert abs(normal.nis.value - 1.0) < 0.16
    assert faulty.nis.value > 3.0
    assert not faulty.passed
