"""Constants of linear plants from logs: continuous, discrete, descriptor and varying with k, with known truths."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from obsynth import (
    DescriptorSystem,
    PreconditionError,
    SpecError,
    TimeVaryingDescriptorSystem,
    calibrate,
    eliminate_algebraic_states,
    uncertain_system,
)

QUICK = {"input_delay": 0, "starts": 1}


def held_inputs(n: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(-1.0, 1.0, n // 8 + 1), 8)[:n]


def two_masses(**changes) -> DescriptorSystem:
    """A spring with an algebraic force: 0 = force - k * (x2 - x1)."""
    return uncertain_system(
        {
            "E": [["m", 0, 0], [0, 1, 0], [0, 0, 0]], "A": [["-c", 0, -1], [1, 0, 0], [0, "k", -1]],
            "B": [[1], [0], [0]], "C": [["g", 0, 0], [0, 1, 0]], "state_names": ["speed", "place", "force"],
            "input_names": ["push"], "output_names": ["seen speed", "seen place"],
        },
        {"m": {"nominal": 1.0, "tolerance": "90 %"}, "c": {"nominal": 0.4, "tolerance": "90 %"},
         "k": {"nominal": 2.0, "tolerance": "90 %"}, "g": {"nominal": 1.0, "tolerance": "90 %"}},
    ).replace(**changes)  # fmt: skip


def spring_log(
    m: float, c: float, k: float, g: float, *, n: int = 120, dt: float = 0.2, seed: int = 3, push=0.0, y=0.0
):
    """The same spring as two differential equations, sampled exactly: an independent simulation."""
    rng, u = np.random.default_rng(seed), held_inputs(n, seed)
    whole = expm(np.array([[-c / m, -k / m, 1.0 / m], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]) * dt)
    x, seen = np.zeros(2), np.zeros((n, 2))
    for i in range(n):
        if i:
            x = whole[:2, :2] @ x + whole[:2, 2] * u[i - 1] + 0.003 * rng.standard_normal(2)
        seen[i] = [g * x[0], x[1]]
    seen += 0.01 * rng.standard_normal(seen.shape)
    return {"time": dt * np.arange(n), "push": u + push, "seen speed": seen[:, 0], "seen place": seen[:, 1] + y}


@pytest.mark.long
def test_constants_in_E_A_and_C_of_a_continuous_descriptor_plant_are_found():
    true = {"m": 1.3, "c": 0.6, "k": 2.6, "g": 1.1}
    found = calibrate(two_masses(), spring_log(**true), {"m": (0.3, 3), "c": (0.05, 2), "k": (0.5, 6), "g": (0.5, 2)},
                      noisy=["speed", "place"], **QUICK)  # fmt: skip
    assert found.box.holds(true)
    for name, value in true.items():
        assert found.nominal[name] == pytest.approx(value, rel=0.06)
        assert found.box.high[name] - found.box.low[name] < 0.4 * value
    assert found.integration == "radau"
    assert found.nis.holds
    assert found.R["seen place"] == pytest.approx(1e-4, rel=0.4)
    assert not found.undetermined


@pytest.mark.long
def test_logs_are_absolute_and_a_sampled_plant_is_calibrated_as_it_was_written():
    from obsynth import discretise

    plant = two_masses(operating_point={"push": 5.0, "seen place": -2.0})
    sampled = discretise(eliminate_algebraic_states(plant).plant, 0.2).plant
    log = spring_log(1.0, 0.4, 2.6, 1.0, push=5.0, y=-2.0)
    known = {"noisy": ["speed"], "R": {"seen speed": 1e-4, "seen place": 1e-4}}
    found = calibrate(sampled, log, {"k": (0.5, 6)}, **known, **QUICK)
    again = calibrate(plant, log, {"k": (0.5, 6)}, **known, **QUICK)
    assert found.nominal == again.nominal
    assert found.nominal["k"] == pytest.approx(2.6, rel=0.15)


def varying(**changes) -> TimeVaryingDescriptorSystem:
    """The printed plant of Moussa Ali and Zhang with a constant: its first equation is algebraic."""
    arguments = {
        "E": [[0, 0], [-1, "(k - 1) / k"]], "A": [[1, "-(k + 1) / (k + 0.5)"], [0, "a / (k + 1)"]],
        "B": [[1, 0], [0, "b"]], "C": [[1, 0], [0, 1]],
        "Phi": [["1 - exp(-k / 30) * sin(0.1 * k)"], ["1 - exp(-k / 15) * sin(0.5 * k)"]], "dt": 1.0,
        "constants": {"a": 1.0, "b": 1.0}, "parameter_names": ["theta"],
    }  # fmt: skip
    return TimeVaryingDescriptorSystem(**{**arguments, **changes})


def varying_log(plant: TimeVaryingDescriptorSystem, theta: float, n: int = 120, seed: int = 1):
    """x(k+1) from the dynamic equation of step k and the algebraic one of step k + 1, solved by numpy."""
    rng = np.random.default_rng(seed)
    u = np.column_stack([held_inputs(n, 8), held_inputs(n, 9)])
    x, seen = np.zeros(2), np.zeros((n, 2))
    for k in range(n):
        if k:
            before = plant.A.at(k - 1) @ x + plant.B.at(k - 1) @ u[k - 1] + plant.Phi.at(k - 1)[:, 0] * theta
            H = np.array([-plant.A.at(k)[0], plant.E.at(k)[1]])
            late = plant.B.at(k)[0] @ u[k] + plant.Phi.at(k)[0, 0] * theta
            x = np.linalg.solve(H, [late, before[1] + 0.002 * rng.standard_normal()])
        seen[k] = plant.C.at(k) @ x + 0.01 * rng.standard_normal(2)
    return {"time": np.arange(float(n)), "u1": u[:, 0], "u2": u[:, 1], "y1": seen[:, 0], "y2": seen[:, 1]}


@pytest.mark.long
def test_constants_and_parameters_of_a_varying_plant_are_found():
    true = varying(constants={"a": 1.0, "b": 0.8})
    found = calibrate(varying(), varying_log(true, 0.7), {"b": (0.2, 3.0), "theta": (0.1, 2.0)}, noisy=["x2"], **QUICK)
    assert found.box.holds({"b": 0.8, "theta": 0.7})
    assert found.nominal["b"] == pytest.approx(0.8, abs=0.02)
    assert found.integration == "exact"


@pytest.mark.long
def test_stacks_and_functions_are_as_good_as_expressions():
    n, plant = 60, varying()
    log = varying_log(plant, 0.5, n)
    stack = varying(A=np.array([plant.A.at(k) for k in range(n)]), E=plant.E.at,
                    Phi=np.array([plant.Phi.at(k) for k in range(n)]), B=[[1, 0], [0, 1]])  # fmt: skip
    found = [calibrate(one, log, {"theta": (0.1, 2.0)}, noisy=["x2"], **QUICK) for one in (plant, stack)]
    assert found[0].nominal["theta"] == pytest.approx(found[1].nominal["theta"], rel=1e-6)
    assert found[0].log_likelihood == pytest.approx(found[1].log_likelihood, abs=1e-6)


def test_a_discrete_plant_says_which_direction_a_log_leaves_open():
    most = 3.3  # no whole number of its own width
    plant = uncertain_system(
        {"E": None, "A": [["a"]], "B": [["b"]], "C": [["c"]], "D": [[0.2]], "dt": 0.5},
        {"a": (0.5, 0.99), "b": (0.1, most), "c": (0.1, most)},
    )
    rng, u = np.random.default_rng(0), held_inputs(150, 2)
    x, y = 0.0, np.zeros(150)
    for k in range(150):
        y[k] = 0.5 * x + 0.2 * u[k] + 0.01 * rng.standard_normal()
        x = 0.9 * x + 1.5 * u[k] + 0.01 * rng.standard_normal()
    log = {"time": 0.5 * np.arange(150), "u1": u, "y1": y}
    # Boxes beside offsets along such a curve are those of test_a_product_that_alone_is_seen_is_named_as_a_direction.
    known = {"offset": {}, "sensor_noise": {}}
    found = calibrate(plant, log, {"a": (0.5, 0.99), "b": (0.1, most), "c": (0.1, most)}, **known, **QUICK)
    assert [set(direction) for direction in found.undetermined] == [{"b", "c"}]
    assert found.box.low["a"] < 0.9 < found.box.high["a"]
    # c = 3.3 is the bound, and b c = 0.75 is known: the box follows that curve over a factor of fourteen.
    # An open side is the bound as it was given, to the last digit.
    assert found.box.high["b"] == found.box.high["c"] == most
    assert found.box.holds({"a": found.nominal["a"], "b": most, "c": most})
    assert ("b", "high") in found.box.open_sides
    assert ("c", "high") in found.box.open_sides
    assert found.box.low["b"] == pytest.approx(0.75 / most, rel=0.1)
    assert found.box.low["c"] == pytest.approx(0.75 / most, rel=0.1)


@pytest.mark.long
def test_a_constant_sensor_fault_is_found_and_unknown_inputs_are_told():
    plant = DescriptorSystem(None, [[0.9]], [[1.0]], [[1.0], [2.0]], Df=[[0.0], [1.0]], Bd=[[1.0]], dt=1.0,
                             fault_names=["offset"])  # fmt: skip
    rng, u, x = np.random.default_rng(0), held_inputs(80, 2), 0.0
    y = np.zeros((80, 2))
    for k in range(80):
        y[k] = [x, 2.0 * x + 0.3] + 0.01 * rng.standard_normal(2)
        x = 0.9 * x + u[k] + 0.02 * rng.standard_normal()
    log = {"time": np.arange(80.0), "u1": u, "y1": y[:, 0], "y2": y[:, 1]}
    found = calibrate(plant, log, {"offset": (-1.0, 1.0)}, **QUICK)
    assert found.nominal["offset"] == pytest.approx(0.3, abs=0.01)
    assert any("unknown inputs" in sentence for sentence in found.verdict)


@pytest.mark.long
def test_an_unknown_input_that_is_asked_to_walk_does_so():
    """The load walks by 0.05 a sample, and moves the state by a tenth of that."""
    plant = uncertain_system(
        {"A": [["a"]], "B": [[0.1]], "Bd": [[0.1]], "C": [[1.0]], "dt": 1.0, "disturbance_names": ["load"]},
        {"a": {"nominal": 0.88, "range": [0.8, 0.95]}},
    )
    rng, u = np.random.default_rng(0), np.sin(np.arange(200) / 5.0)
    load, x, y = np.cumsum(0.05 * rng.standard_normal(200)), 0.0, np.zeros(200)
    for k in range(200):
        y[k] = x + 0.1 * rng.standard_normal()
        x = 0.9 * x + 0.1 * u[k] + 0.1 * load[k]
    log = {"time": np.arange(200.0), "u1": u, "y1": y}
    found = calibrate(plant, log, {"a": (0.8, 0.95)}, walks=["load"], **QUICK)
    assert found.box.holds({"a": 0.9})
    assert found.walks["load"] == pytest.approx(0.05, rel=0.5)


@pytest.mark.parametrize(
    ("plant", "arguments", "told"),
    [
        ("not a plant", {}, "DescriptorSystem"),
        (DescriptorSystem([[1, 0], [1, 0]], [[0.5, 0], [0, 1.0]], C=[[1, 1]], dt=1.0), {}, "rows without"),
        (DescriptorSystem(None, [[0.5]], C=[[1.0]], dt=1.0), {"dt": 0.5}, "leave dt out"),
        (DescriptorSystem(None, [[0.5]], C=[[1.0]], dt=1.0), {"substeps": 2}, "discrete"),
        (TimeVaryingDescriptorSystem([[1, 0]], [[1, 0]], C=[[1, 0], [0, 1]], dt=1.0), {}, "number of equations"),
    ],
)
def test_linear_plants_that_cannot_be_stepped_are_refused(plant, arguments, told):
    log = {"time": np.arange(60.0), **{name: np.sin(np.arange(60.0)) for name in ("y1", "y2")}}
    with pytest.raises((SpecError, PreconditionError), match=told):
        calibrate(plant, log, {"a": (0.1, 2.0)}, **arguments)


def test_the_command_takes_a_linear_plant_in_a_file(tmp_path, capsys):
    from obsynth.cli.main import main

    (tmp_path / "plant.yaml").write_text(
        "schema_version: 1\ndt: 0.5\nconstants: {a: {nominal: 0.8, tolerance: 50 %}}\n"
        "A: [[a]]\nB: [[1.5]]\nC: [[0.5]]\n",
        encoding="utf-8",
    )
    rng, u, x = np.random.default_rng(0), held_inputs(60, 2), 0.0
    rows = ["time,u1,y1"]
    for k in range(60):
        rows.append(f"{0.5 * k},{u[k]},{0.5 * x + 0.01 * rng.standard_normal()}")
        x = 0.9 * x + 1.5 * u[k] + 0.01 * rng.standard_normal()
    (tmp_path / "log.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    arguments = ["--data", str(tmp_path / "log.csv"), "--unknown", "a=0.5:0.99", "--quiet", "--json"]
    assert main(["calibrate", "--system", str(tmp_path / "plant.yaml"), *arguments]) == 0
    import json

    low, high = json.loads(capsys.readouterr().out)["constants"]["a"]["range"]
    assert low < 0.9 < high


#: Volumes of the Nile at Aswan, 1871 to 1970, 1e8 m3.
NILE = np.array([
    1120, 1160, 963, 1210, 1160, 1160, 813, 1230, 1370, 1140, 995, 935, 1110, 994, 1020, 960, 1180, 799, 958, 1140,
    1100, 1210, 1150, 1250, 1260, 1220, 1030, 1100, 774, 840, 874, 694, 940, 833, 701, 916, 692, 1020, 1050, 969, 831,
    726, 456, 824, 702, 1120, 1100, 832, 764, 821, 768, 845, 864, 862, 698, 845, 744, 796, 1040, 759, 781, 865, 845,
    944, 984, 897, 822, 1010, 771, 676, 649, 846, 812, 742, 801, 1040, 860, 874, 848, 890, 744, 749, 838, 1050, 918,
    986, 797, 923, 975, 815, 1020, 906, 901, 1170, 912, 746, 919, 718, 714, 740,
], dtype=float)  # fmt: skip


@pytest.mark.one_in(3)
@pytest.mark.parametrize("factor", [1.0, 1e-3, 1e6])
def test_the_nile_in_any_units(factor):
    """Durbin and Koopman 2001, section 2.10: the likelihood is greatest at R = 15,099, Q = 1,469.1."""
    level = DescriptorSystem(None, [[1.0]], None, [[1.0]], dt=1.0, state_names=["level"], output_names=["volume"])
    found = calibrate(
        level, {"time": np.arange(float(len(NILE))), "volume": factor * NILE}, {}, initial_state=[0.0],
        initial_covariance=[[1e7 * factor**2]],
    )  # fmt: skip
    assert found.R["volume"] / factor**2 == pytest.approx(15_099.0, rel=2e-3)
    assert found.Q["level"] / factor**2 == pytest.approx(1_469.1, rel=2e-3)
    assert found.upper_limits == ()
