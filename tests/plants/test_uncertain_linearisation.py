"""Linear models of nonlinear plants whose constants have tolerances: their entries, their shift, what is promised."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from dae_plants import ROD, exchanger, pendulum
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve
from test_linearise import tanks

import obsynth
from obsynth import DAEModel, PreconditionError, SpecError, linearise
from obsynth.plants.dae_functions import local_equations
from obsynth.plants.uncertainty import matrices_of
from obsynth.results.calibration_files import calibration_text
from obsynth.specs.loader import load_spec

POINT = {"leak": 0.03, "h1": 0.7, "h3": 0.65}
BOX = {"a1": "5 %", "b1": "2 %", "a2": {"range": [0.0235, 0.0245]}, "offset": {"range": [0.05, 0.06]}}
HELD = {"x": 0.6, "y": -0.8, "vx": 0.0, "vy": 0.0}


def changed(model: DAEModel, values: dict[str, float]) -> DAEModel:
    """Return the model with other values of constants and parameters."""
    groups = {name: getattr(model, name) for name in ("constants", "parameters")}
    return model.replace(**{name: {key: values.get(key, old) for key, old in group.items()}
                            for name, group in groups.items()})  # fmt: skip


@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    ("model", "arguments", "box"),
    [
        (tanks(), {"given": POINT, "free": ["u1", "u3"]}, BOX),
        (exchanger(), {"given": {"pressure": 2.001e5}, "free": ["Qn"]},
         {"v1": "1 %", "A": "2 %", "Cv": "1 %", "a1": "1 %", "phi": "1 %"}),
        (pendulum(ROD[1]),
         {"at": "point", "given": HELD, "drift": True}, {"d": {"range": [0.1, 0.4]}, "g": "1 %"}),
    ],
)  # fmt: skip
def test_entries_are_the_jacobians_of_the_model_with_other_constants(model, arguments, box) -> None:
    linear = linearise(model, constants=box, **arguments)
    point, uncertain = linear.operating_point, linear.uncertainty
    nominal = linearise(model, faults=[name for name in model.parameter_names if name not in box], **arguments)
    x = np.array([point.get(name, point.get(f"{name} (state)")) for name in model.state_names])
    rates = np.zeros(model.nx)
    if "drift" in linear.input_names:
        rates = np.linalg.lstsq(linear.E, linear.B[:, linear.input_names.index("drift")], rcond=None)[0]
    rng = np.random.default_rng(3)
    for _ in range(5):
        values = uncertain.box.values(rng.uniform(-1.0, 1.0, len(uncertain.box.names)))
        found = uncertain.filled(matrices_of(linear), values)
        other = changed(model, values)
        theta = [values.get(name, point.get(name, other.parameters[name])) for name in other.parameter_names]
        u = np.array([point.get(name, model.inputs[name]) for name in model.input_names])
        there = local_equations(other, rates, x, u, np.array(theta))
        for name, wanted in (("E", there.E), ("A", -there.by_state), ("C", there.C)):
            assert np.abs(found[name] - wanted).max() <= 1e-9 * np.abs(wanted).max(), name
        largest = np.abs(there.by_input).max(initial=0.0)
        assert np.abs(found["B"][:, : model.nu] + there.by_input).max(initial=0.0) <= 1e-9 * largest
        if uncertain.shift:
            column = linear.input_names.index(uncertain.shift)
            size = np.abs(there.value).max()
            assert size > 0.0
            assert np.abs(found["B"][:, column] + there.value).max() <= 1e-6 * size
    assert np.abs(linear.A - nominal.A).max() <= 1e-12 * np.abs(nominal.A).max()


def test_the_shift_is_where_the_equilibrium_goes() -> None:
    model = tanks()
    linear = linearise(model, given=POINT, free=["u1", "u3"], constants=BOX)
    assert linear.input_names == ("u1", "u3", "shift")
    assert not linear.B[:, 2].any()
    values = linear.uncertainty.box.values(np.array([0.2, -0.2, 0.2, 0.2]))
    found = linear.uncertainty.filled(matrices_of(linear), values)
    point, c = linear.operating_point, {**model.constants, **values}

    def rest(h):
        q12, q32 = ((c[a] * (d) / np.sqrt(abs(d) + 0.001)) for a, d in (("a1", h[0] - h[1]), ("a2", h[2] - h[1])))
        leak = 0.03 * np.sqrt(h[1] - c["offset"])
        return [c["b1"] * point["u1"] - q12, q12 + q32 - leak, c["b2"] * point["u3"] - q32]

    start = np.array([point[name] for name in ("h1", "h2", "h3")])
    moved = fsolve(rest, start, xtol=1e-12) - start
    predicted = -np.linalg.solve(found["A"], found["B"][:, 2])
    assert np.abs(moved).max() > 1e-3
    assert np.abs(moved - predicted).max() < 0.02 * np.abs(moved).max()


def test_a_log_to_compare_on_has_no_column_of_the_shift() -> None:
    linear = linearise(tanks(), given=POINT, free=["u1", "u3"], constants={"a1": "1 %"})
    plant = obsynth.discretise(linear.replace(sensor_noise=dict.fromkeys(linear.output_names, 1e-3)), 5.0).plant
    point = linear.operating_point
    names = ("u1", "u3", *linear.output_names)
    values = [point["u1"], point["u3"], *(plant.C @ [point[name] for name in ("h1", "h2", "h3")])]
    log = pd.DataFrame([values] * 60, columns=names)
    found = obsynth.compare(plant, data=log, methods=["ui-pi-observer"], runs=1)
    assert not found.methods[0].refused
    assert np.abs(found.methods[0].estimates).max() < 1e-9


SPEC = """schema_version: 1
name: tanks
plant:
  kind: dae
  constants: {a1: {nominal: 0.0163, tolerance: 2 %, unit: V^0.5/s}, a2: 0.0199, b1: 0.035, b2: 0.0354, offset: 0.0533}
  states: {h1: 0.1564, h2: 0.1564, h3: 0.1664}
  inputs: {u1: 0.4737, u3: 0.4737}
  parameters: {leak: 0.0}
  units: {h1: V, h2: V, h3: V, u1: "1", u3: "1", leak: V^0.5/s, v1: V, v2: V, v3: V}
  definitions:
    q12: a1 * (h1 - h2) / sqrt(abs(h1 - h2) + 0.001)
    q32: a2 * (h3 - h2) / sqrt(abs(h3 - h2) + 0.001)
  equations:
    tank1: der(h1) = b1 * u1 - q12
    tank2: der(h2) = q12 + q32 - leak * sqrt(max(h2 - offset, 1e-4))
    tank3: der(h3) = b2 * u3 - q32
  outputs: {v1: h1, v2: h2, v3: h3}
  transform:
    linearise: {at: equilibrium, given: {leak: 0.03, h1: 0.7, h3: 0.65}, free: [u1, u3], constants: {b1: 2 %}}
    sample_time: 1.0
method: {id: fault-estimation-filter}
"""


def tank_rows(point, a1: float, b1: float) -> pd.DataFrame:
    """Return rows of the nonlinear tanks from the nominal equilibrium on, with no column for the shift."""

    def moves(_, h):
        q12, q32 = (a * d / np.sqrt(abs(d) + 0.001) for a, d in ((a1, h[0] - h[1]), (0.0199, h[2] - h[1])))
        return [b1 * point["u1"] - q12, q12 + q32 - 0.03 * np.sqrt(h[1] - 0.0533), 0.0354 * point["u3"] - q32]

    h, rows = np.array([point["h1"], point["h2"], point["h3"]]), []
    for k in range(40):
        rows.append([k, point["u1"], point["u3"], *h])
        h = solve_ivp(moves, (0.0, 1.0), h, rtol=1e-9, atol=1e-12).y[:, -1]
    return pd.DataFrame(rows, columns=["time", "u1", "u3", "v1", "v2", "v3"])


@pytest.mark.long
def test_a_spec_with_tolerances_of_a_nonlinear_plant_watches_logs_of_it(tmp_path: Path) -> None:
    (tmp_path / "spec.yaml").write_text(SPEC, encoding="utf-8")
    spec = load_spec(tmp_path / "spec.yaml")
    assert spec.plant.uncertainty.box.names == ("a1", "b1")
    design = obsynth.design(spec.plant, spec.method)
    design = obsynth.load(design.save(tmp_path / "g.json"))
    found = obsynth.robustness(design)
    assert "not covered" in dict(found.facts())["linear model"]
    monitor = obsynth.online_monitor(
        design, constants=design.plant, initial_set=dict.fromkeys(("h1", "h2", "h3"), 1e-6)
    )
    assert "not linear in the plant is not covered" in monitor.statement
    rows = tank_rows(design.plant.operating_point, 0.0163 * 1.02, 0.035 * 0.98)
    table = obsynth.run_on_data(design, rows, monitor=monitor).table
    settled = table.iloc[10:]
    assert (settled["alarm"] == "").all()
    # A tolerance that is not known would be taken for a fault.
    smaller = obsynth.uncertain_system(design.plant, {"a1": "0.1 %", "b1": "0.1 %"})
    exact = obsynth.online_monitor(design, constants=smaller)
    assert (obsynth.run_on_data(design, rows, monitor=exact).table.iloc[10:]["alarm"] != "").any()


def test_a_calibration_file_gives_the_box(tmp_path: Path) -> None:
    found = {"level": 0.95, "stands": True, "log": {"digest": "cd" * 32}, "constants": {
        "a2": {"nominal": 0.0201, "range": [0.0195, 0.0211], "open": [], "unit": "V^0.5/s"}}}  # fmt: skip
    (tmp_path / "cal.json").write_text(calibration_text(found), encoding="utf-8")
    (tmp_path / "spec.yaml").write_text(
        SPEC.replace("  states:", "  box: {file: cal.json}\n  states:", 1), encoding="utf-8"
    )
    box = load_spec(tmp_path / "spec.yaml").plant.uncertainty.box
    assert box.constants["a2"].nominal == 0.0201
    assert box.sentence == ("a constant outside its 95 % box of the log cdcdcdcdcdcd, or outside its stated tolerance "
                            "(a1, b1)")  # fmt: skip
    found["constants"]["a2"]["open"] = ["high"]
    (tmp_path / "cal.json").write_text(calibration_text(found), encoding="utf-8")
    with pytest.raises(SpecError, match="open high side"):
        load_spec(tmp_path / "spec.yaml")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("constants: {b1: 2 %}", "constants: {b9: 2 %}", "no constant and no parameter"),
        ("constants: {b1: 2 %}", "constants: {leak: {range: [0.0, 0.04]}}, faults: [leak]", "is a fault"),
        ("constants: {b1: 2 %}}\n    sample_time: 1.0", "constants: {b1: {range: [0.03, .inf]}}}", "needs both ends"),
        ("  transform:\n    linearise: {at: equilibrium, given: {leak: 0.03, h1: 0.7, h3: 0.65}, free: [u1, u3], "
         "constants: {b1: 2 %}}\n    sample_time: 1.0\n", "", "tolerances are for the linear model"),
        ("tolerance: 2 %, unit", "unit", "no constant|tolerances"),
    ],
)  # fmt: skip
def test_refused_tolerances_of_a_nonlinear_plant(tmp_path: Path, old: str, new: str, words: str) -> None:
    assert old in SPEC
    (tmp_path / "spec.yaml").write_text(SPEC.replace(old, new), encoding="utf-8")
    if old.startswith("tolerance"):
        assert load_spec(tmp_path / "spec.yaml").plant.uncertainty.box.names == ("b1",)
        return
    with pytest.raises(SpecError, match=words):
        load_spec(tmp_path / "spec.yaml")


def test_what_cannot_be_written_as_an_expression_is_refused_by_name() -> None:
    chain = {"d0": "sin(c * x)", **{f"d{i}": f"sin(d{i - 1} + x)" for i in range(1, 60)}}
    model = DAEModel({"a": "der(x) = -x + d59"}, {"y": "x"}, states={"x": 1.0}, constants={"c": 1.0}, definitions=chain,
                     units={"x": "1", "y": "1"})  # fmt: skip
    with pytest.raises(PreconditionError, match="A, row 1, column 1"):
        linearise(model, at="point", given={"x": 1.0}, drift=True, constants={"c": "1 %"})


def test_drawn_plants_rest_elsewhere(tmp_path: Path) -> None:
    """Plants of the box have another equilibrium: the fixed bound takes that for a fault, the adaptive one does not."""
    (tmp_path / "spec.yaml").write_text(SPEC.replace("tolerance: 2 %", "tolerance: 5 %"), encoding="utf-8")
    spec = load_spec(tmp_path / "spec.yaml")
    design = obsynth.design(spec.plant, spec.method)
    scenario = obsynth.Scenario(horizon=80.0, sensor_noise=dict.fromkeys(("v1", "v2", "v3"), 5e-5))
    rates = []
    for constants in (None, design.plant):
        monitor = obsynth.monitor(design, scenario, constants=constants, noise_bound=5.0)
        rates.append(obsynth.evaluate(design, scenario, plants=20, monitor=monitor).false_alarm_rate.value)
    assert rates[0] > 0.3
    assert rates[1] == 0.0
