"""Functionals of the state, ``w = K x``: order, convergence whatever unknown inputs do, any index, the commands."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
import yaml

import obsynth
from obsynth.cli.main import main

SPEC = {
    "schema_version": 1,
    "name": "shaft",
    "plant": {
        "dt": 0.0,
        "A": [[-0.5, 0, -20, 0], [0, -1, 30, 1], [1, -1, 0, 0], [0, 0, 0, -2]],
        "B": [[1], [0], [0], [0]],
        "C": [[1, 0, 0, 0], [0, 1, 0, 0]],
        "Bd": [[0], [0], [0], [1]],
        "state_names": ["motor", "load", "twist", "draw"],
        "functionals": {"slip": {"motor": 1, "load": -1}, "shaft torque": {"twist": 25, "load": 0.1}},
        "units": {"shaft torque": "N m"},
    },
    "method": {"id": "functional-filter", "options": {"states": ["slip", "shaft torque"], "decay": 2.0}},
    "scenario": {
        "horizon": 10,
        "sample_time": 0.02,
        "inputs": {"u1": {"kind": "step", "size": 1}},
        "disturbances": {"d1": {"kind": "step", "size": 1, "start": 3}},
    },
}


def chain(n, seed, dt=0.0, faults=0, unknown=0):
    """A plant with one output, a known input, and a functional that depends on a left eigenvector: w' = -a w + c y."""
    rng = np.random.default_rng(seed)
    a = rng.standard_normal((n, n)) - 2.0 * np.eye(n)
    c, b = rng.standard_normal((1, n)), rng.standard_normal((n, 1))
    k = rng.standard_normal((1, n))
    # k A = -1.7 k + 0.6 c: change A by a rank-one term that has this.
    a += k.T @ (-1.7 * k + 0.6 * c - k @ a) / (k @ k.T)
    left = scipy.linalg.null_space(np.vstack([k, c]))
    bd = left @ rng.standard_normal((left.shape[1], unknown))
    bf = left @ rng.standard_normal((left.shape[1], faults))
    if dt:
        a = np.eye(n) + dt * a
        return obsynth.DescriptorSystem(A=a, B=dt * b, C=c, Bd=dt * bd, Bf=dt * bf, dt=dt), k[0]
    return obsynth.DescriptorSystem(A=a, B=b, C=c, Bd=bd, Bf=bf), k[0]


def true_and_estimated(design, *, seed, dt, steps=4000):
    """Simulate by an exact exponential that is not the package's, with random initial state and held signals."""
    rng = np.random.default_rng(seed)
    observer, plant = design.observer, design.plant
    names = list(plant.state_names)
    goal = [names.index(name) for name in observer.state_names]
    own = [i for i in range(plant.nx) if plant.E[i].any()]
    added = [i for i in range(plant.nx) if i not in own]
    a, c = plant.A[np.ix_(own, own)], plant.C[:, own]
    k = plant.A[np.ix_(added, own)]
    signals = np.hstack([plant.B, plant.Bd, plant.Bf])[own]
    count, nz = signals.shape[1], observer.order
    # Plant and observer together, continuous: [x; z].
    whole = np.block([[a, np.zeros((len(own), nz))], [observer.By @ c, observer.Az]])
    drive = np.vstack([signals, np.hstack([observer.Bu, np.zeros((nz, count - plant.nu))])])
    if not plant.dt:
        big = scipy.linalg.expm(dt * np.block([[whole, drive], [np.zeros((count, len(whole) + count))]]))
        whole, drive = big[: len(whole), : len(whole)], big[: len(whole), len(whole) :]
    state = np.concatenate([rng.standard_normal(len(own)), np.zeros(nz)])
    values = rng.standard_normal((steps, count)).repeat(1, axis=0)
    errors = []
    for v in values:
        x, z = state[: len(own)], state[len(own) :]
        full = np.zeros(plant.nx)
        full[own], full[added] = x, k @ x
        estimate = observer.Cz @ z + observer.Dy @ (c @ x) + observer.Du @ v[: plant.nu]
        errors.append(estimate[observer.state_rows] - full[goal])
        state = whole @ state + drive @ v
    return np.array(errors)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("dt", [0.0, 0.01])
@pytest.mark.parametrize("seed", range(4))
def test_a_functional_with_dynamics_of_its_own_takes_an_observer_of_order_one(seed, dt):
    plant, k = chain(5, seed, dt, faults=1, unknown=1)
    named = obsynth.with_functionals(plant, {"w": {f"x{i + 1}": v for i, v in enumerate(k)}})
    design = obsynth.functional_filter(named, states=["w"], decay=1.0)
    assert design.report.passed
    assert design.observer.order == 1
    assert design.observer.state_names == ("w",)
    assert design.certificate.claims["decay"] >= 1.0
    errors = true_and_estimated(design, seed=seed, dt=0.01)
    assert np.abs(errors[0]).max() > 1e-3
    assert np.abs(errors[-1000:]).max() <= 1e-9 * max(1.0, np.abs(errors).max())


@pytest.mark.one_in(4)
@pytest.mark.parametrize("seed", range(6))
def test_any_functional_of_an_observable_plant_is_estimated_at_the_rate_or_poles_asked_for(seed):
    rng = np.random.default_rng([3, seed])
    n = int(rng.integers(2, 6))
    plant = obsynth.DescriptorSystem(
        A=rng.standard_normal((n, n)) - np.eye(n), B=rng.standard_normal((n, 1)), C=rng.standard_normal((1, n))
    )
    weights = {f"x{i + 1}": float(v) for i, v in enumerate(rng.standard_normal(n))}
    design = obsynth.functional_filter(obsynth.with_functionals(plant, {"w": weights}), states=["w"], decay=3.0)
    assert design.report.passed
    assert design.observer.order <= n - 1
    assert np.linalg.eigvals(design.observer.Az).real.max(initial=-9.0) <= -3.0
    errors = true_and_estimated(design, seed=seed, dt=0.002)
    assert np.abs(errors[-5:]).max() <= 1e-4 * max(1.0, np.abs(errors).max())
    order = design.observer.order
    if order:
        poles = list(-np.linspace(2.0, 4.0, order))
        placed = obsynth.functional_filter(obsynth.with_functionals(plant, {"w": weights}), states=["w"], poles=poles)
        assert np.allclose(np.sort(np.linalg.eigvals(placed.observer.Az).real), np.sort(poles), rtol=1e-5)


def test_states_of_a_plant_of_index_2_go_by_their_names_as_written():
    # A mass on a moving support: x1' = v1, v1' = force - lambda, x1 - x2 = 0, x2' = v2, v2' = lambda - x2.
    e = np.diag([1.0, 1.0, 0.0, 1.0, 1.0])
    a = np.array([[0, 1, 0, 0, 0], [0, -1, -1, 0, 0], [0, 1, 0, 0, -1], [0, 0, 0, 0, 1], [0, 0, 1, -1, 0]], dtype=float)
    plant = obsynth.DescriptorSystem(
        e, a, [[0], [1], [0], [0], [0]], C=[[0, 0, 0, 1, 0]], state_names=["x1", "v1", "force", "x2", "v2"]
    )
    assert obsynth.analyse_structure(plant).index == 2
    design = obsynth.functional_filter(plant, states=["v2"], decay=1.0)
    assert design.report.passed
    assert design.observer.state_names == ("v2",)


def test_what_unknown_inputs_hide_is_refused_by_name():
    plant = obsynth.DescriptorSystem(
        A=np.diag([-1.0, -2.0]), C=[[1.0, 0.0]], Bd=[[0.0], [1.0]], Bf=[[1.0], [0.0]], disturbance_names=["draught"]
    )
    with pytest.raises(obsynth.PreconditionError, match=r"'x2 determined' fails.*draught") as caught:
        obsynth.functional_filter(plant, states=["x2"])
    assert caught.value.signals == ("x2",)
    assert obsynth.functional_filter(plant, states=["x1"]).observer.order == 0
    with pytest.raises(obsynth.SpecError, match="no such state; there are: x1, x2"):
        obsynth.functional_filter(plant, states=["x9"])


def test_states_and_faults_stand_side_by_side():
    plant = obsynth.DescriptorSystem(
        A=[[0.9, 0.1, 0.0], [0.0, 0.8, 0.1], [0.0, 0.0, 0.7]],
        C=[[1, 0, 0], [0, 1, 0]],
        Bf=[[1], [0], [0]],
        dt=1.0,
        sensor_noise={"y1": 0.1, "y2": 0.1},
    )
    design = obsynth.functional_filter(plant, states=["x3"], faults=["f1"], decay=0.05)
    assert design.report.passed
    assert design.observer.row_names[:2] == ("xhat[x3]", "fhat[f1]")
    alone = obsynth.functional_filter(plant, faults=["f1"], decay=0.05)
    assert design.observer.order == alone.observer.order + 1


def test_a_corrupted_observer_of_a_functional_is_found():
    plant, k = chain(4, 11, faults=1)
    named = obsynth.with_functionals(plant, {"w": {f"x{i + 1}": v for i, v in enumerate(k)}})
    design = obsynth.functional_filter(named, states=["w"], decay=1.0)
    for name in ("Az", "By", "Bu", "Cz", "Dy"):
        numbers = design.observer.as_dict()
        matrix = numbers[name].copy()
        matrix[0, 0] += 0.01 * max(1.0, abs(matrix[0, 0]))
        broken = design.replace(observer=obsynth.LinearObserver(**{**numbers, name: matrix}))
        assert not obsynth.verify(broken).passed, name


@pytest.mark.parametrize(
    ("functionals", "message"),
    [
        ({"x1": {"x2": 1.0}}, "is a state already"),
        ({"w": {}}, "needs the weight of each state"),
        ({"w": {"x9": 1.0}}, "which is no state; there are: x1, x2"),
        ({"w": {"x1": float("nan")}}, "give a number"),
        ({"w": {"x1": 0.0}}, "is zero"),
    ],
)
def test_a_functional_that_makes_no_sense_is_refused(functionals, message):
    plant = obsynth.DescriptorSystem(A=np.diag([-1.0, -2.0]), C=[[1.0, 1.0]])
    with pytest.raises(obsynth.SpecError, match=message) as caught:
        obsynth.with_functionals(plant, functionals)
    assert caught.value.path.startswith("functionals.")


@pytest.mark.long
def test_a_spec_with_functionals_goes_through_every_command(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "spec.yaml").write_text(yaml.safe_dump(SPEC))
    for command in (
        "design --system spec.yaml --out g.json",
        "verify --gains g.json",
        "simulate --system spec.yaml --gains g.json --out run.csv",
        "evaluate --system spec.yaml --gains g.json",
        "run --gains g.json --data run.csv --out estimates.csv",
        "plot --gains g.json --data run.csv --out run.png",
        "report --gains g.json --system spec.yaml --out page.html",
        "export --gains g.json --to g.mat",
    ):
        assert main(command.split()) == 0, (command, capsys.readouterr())
    import pandas as pd

    run, found = pd.read_csv("run.csv"), pd.read_csv("estimates.csv")
    late = run["time"] > 4.0
    assert np.abs(run["x[shaft torque]"])[late].max() > 0.1
    assert np.abs(run["xhat[shaft torque]"] - run["x[shaft torque]"])[late].max() < 0.02
    assert np.abs(found["xhat[slip]"] - run["x[slip]"])[late].max() < 1e-9


def test_methods_of_the_whole_state_recover_functionals():
    plant = obsynth.DescriptorSystem(A=[[-1.0, 0.5], [0.0, -2.0]], C=[[1, 0], [0, 1]], Bf=[[1], [0]])
    named = obsynth.with_functionals(plant, {"w": {"x1": 2.0, "x2": -3.0}}, units={"w": "W"})
    assert named.units == {"w": "W"}
    design = obsynth.pd_observer(named, decay=1.0)
    assert design.report.passed
    assert design.recovery is not None
    place = list(design.recovery.names).index("w")
    assert np.allclose(design.recovery.from_state[place], [2.0, -3.0])
