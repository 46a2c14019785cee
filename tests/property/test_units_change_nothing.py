"""Units change nothing: verdicts and settled estimates of every linear method, in random powers of two."""

from pathlib import Path

import numpy as np
import pytest
from flint import fmpq, fmpq_mat

from obsynth import DescriptorSystem, PreconditionError, fault_estimation_filter, pd_observer, ui_pi_observer
from obsynth.specs.loader import load_spec

DESIGNS = Path(__file__).parents[2] / "designs"
PLANTS = {
    "fault-estimation-filter": (
        fault_estimation_filter,
        {
            "E": [[1, 0, -1], [0, 2, 3], [1, 3, 4]],
            "A": [[0.5, 0.5, 0.5], [-0.75, 0.5, 1.75], [-0.75, 1.25, 3.5]],
            "C": [[-1, -1, -1], [0, -1, -1]],
            "Bf": [[-1, 1], [1, -2], [0, -2]],
            "Bd": [[0], [2], [3]],
            "dt": 1.0,
        },
    ),
    "pd-observer": (
        pd_observer,
        {
            "E": [[1, 0, 0], [0, 1, 0], [0, 0, 0]],
            "A": [[0.5, 0, 1], [0, -2, 1], [1, 2, 3]],
            "C": [[1, -1, 1], [0, 1, 0]],
            "Bf": [[0], [1], [1]],
            "dt": 0.0,
        },
    ),
    "ui-pi-observer": (
        ui_pi_observer,
        {
            "E": [[1, 0, 0], [1, 1, 1], [0, 0, 0]],
            "A": [[-1, 2, 2], [-1, 0, -1], [0, 0, 3]],
            "C": [[0, 1, 1]],
            "Bf": [[0], [-1], [2]],
            "dt": 0.0,
        },
    ),
}
#: Faults that no output ever shows, for the same plants.
HIDDEN = {
    "fault-estimation-filter": {"Bf": [[-1, -2], [1, 2], [0, 0]]},
    "pd-observer": {"C": [[0, 1, 0]], "Bf": [[0], [0], [0]]},
    "ui-pi-observer": {"Bf": [[0], [-1], [3]]},
}


def in_units(data, seed):
    """The plant with every signal and equation multiplied by a power of two, and the units of its faults."""
    rng = np.random.default_rng(seed)
    sizes = {"row": 3, "state": 3, "output": len(data["C"]), "fault": len(data["Bf"][0]), "disturbance": 1}
    units = {name: np.exp2(rng.integers(-13, 14, n)) if seed else np.ones(n) for name, n in sizes.items()}
    rows = units["row"][:, None]
    more = {"Bd": rows * np.array(data["Bd"], float) * units["disturbance"]} if "Bd" in data else {}
    plant = DescriptorSystem(
        rows * np.array(data["E"], float) * units["state"],
        rows * np.array(data["A"], float) * units["state"],
        C=units["output"][:, None] * np.array(data["C"], float) * units["state"],
        Bf=rows * np.array(data["Bf"], float) * units["fault"],
        dt=data["dt"],
        **more,
    )
    return plant, units["fault"]


def exact(matrix):
    return fmpq_mat(*matrix.shape, [fmpq(*value.as_integer_ratio()) for value in matrix.ravel().tolist()])


def settled(plant, observer, faults):
    """What the fault estimates settle to while the faults stay at these values, in rational numbers."""
    still = exact(plant.E * plant.is_discrete) - exact(plant.A)
    y = exact(plant.C) * still.solve(exact(plant.Bf) * exact(faults[:, None]))
    rest = exact(np.eye(observer.order) * plant.is_discrete) - exact(observer.Az)
    found = exact(observer.Cz) * rest.solve(exact(observer.By) * y) + exact(observer.Dy) * y
    return np.array([int(value.p) / int(value.q) for value in found.entries()])[observer.fault_rows]


@pytest.mark.one_in(4)
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("method", PLANTS)
def test_estimates_settle_at_the_faults_in_all_units(method, seed):
    design, data = PLANTS[method]
    plant, units = in_units(data, seed)
    found = design(plant)
    assert found.report.passed
    np.testing.assert_allclose(settled(plant, found.observer, 1.0 / units) * units, 1.0, rtol=1e-6)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("method", PLANTS)
def test_hidden_faults_are_refused_for_the_same_reason_in_all_units(method, seed):
    design, data = PLANTS[method]
    conditions = []
    for number in (0, seed):
        with pytest.raises(PreconditionError, match=r"^No observer of this kind exists") as error:
            design(in_units({**data, **HIDDEN[method]}, number)[0])
        conditions.append(error.value.condition)
    assert conditions[0] == conditions[1]


#: Another unit of each state, output and fault, and of time.
UNITS = ([7.1e2, 3.3e-3, 41.0, 0.17], [0.023, 670.0], [5.9, 0.083], 17.3)


@pytest.mark.one_in(3)
@pytest.mark.parametrize("case", ["filasova", "one slow", "oscillator"])
def test_a_pd_observer_claims_and_is_the_same_in_all_units(case):
    """Not powers of two: the rate that is imposed, the eigenvalues and the gains are the same but for the units."""
    plants = {
        "filasova": load_spec(DESIGNS / "filasova" / "spec.yaml").plant,
        "one slow": DescriptorSystem(
            None, [[-0.2, 1.0, 0.0, 0.3], [0.0, -2.0, 0.5, 0.0], [0.1, 0.0, -1.0, 2.0], [0.0, 0.0, 0.4, -3.0]],
            C=[[1, 0, 0, 0], [0, 0, 1, 0]], Bf=[[0, 1], [1, 0], [0, 0], [0, 2]],
        ),
        "oscillator": DescriptorSystem(
            None, [[0.0, 3.0, 0.0, 0.0], [-3.0, 0.1, 1.0, 0.0], [0.0, 0.0, -1.0, 2.0], [0.5, 0.0, 0.0, -2.0]],
            C=[[1, 0, 0, 1], [0, 0, 1, 0]], Bf=[[1, 0], [0, 0], [0, 1], [1, 1]],
        ),
    }  # fmt: skip
    plant = plants[case]
    states, outputs, faults, time = (np.array(part) for part in UNITS)
    other = DescriptorSystem(
        None,
        time * plant.A * states / states[:, None],
        C=plant.C * states / outputs[:, None],
        Bf=time * plant.Bf * faults / states[:, None],
    )
    found, scaled = pd_observer(plant), pd_observer(other)
    claims, others = found.certificate.claims, scaled.certificate.claims
    assert others["decay"] == pytest.approx(claims["decay"] * time, rel=1e-6)
    assert others["delta"] == pytest.approx(claims["delta"] / time, rel=1e-6)
    assert scaled.report["error system"].value == pytest.approx(found.report["error system"].value * time, rel=1e-4)
    gains = scaled.gains["L"] * states[:, None] / outputs
    np.testing.assert_allclose(gains, found.gains["L"], rtol=1e-3, atol=1e-4 * np.max(np.abs(found.gains["L"])))
