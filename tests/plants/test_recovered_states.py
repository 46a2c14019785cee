"""States that a transformation took away are in the output of a run, aligned and in absolute values."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import obsynth
from obsynth import DescriptorSystem, run_on_data
from obsynth.simulation.linear import simulate_plant
from obsynth.specs.loader import load_spec

ROOT = Path(__file__).parents[2]
POINT = {"speed": 50.0, "voltage": 1.02, "power": 0.8, "valve": 3.0}
#: voltage = speed / 2 + valve / 10; power = voltage + 0.3 speed + fault; leak carries the disturbance.
SOURCE = DescriptorSystem(
    np.diag([1.0, 1.0, 0.0, 0.0, 0.0]),
    [[-1.0, 0.2, 0.0, 0.5, 0.0], [0.1, -2.0, 0.3, 0.0, 0.0], [0.5, 0.0, -1.0, 0.0, 0.0], [0.3, 0.0, 1.0, -1.0, 0.0],
     [0.0, 1.0, 0.0, 0.0, -1.0]],
    [[0.0], [1.0], [0.1], [0.0], [0.0]], [[1, 0, 0, 0, 0], [0, 1, 0, 0, 0]],
    Bf=[[0.0], [0.0], [0.0], [1.0], [0.0]], Bd=[[0.0], [0.0], [0.0], [0.0], [1.0]],
    state_names=["speed", "flux", "voltage", "power", "leak"], input_names=["valve"],
    output_names=["speed", "flux"], fault_names=["torque"], disturbance_names=["draught"],
    operating_point=POINT,
)  # fmt: skip


def designed(sample_time: float | None) -> obsynth.ObserverDesign:
    reduced = obsynth.eliminate_algebraic_states(SOURCE)
    if sample_time is None:
        return obsynth.design(reduced.plant, "ui-pi-observer", fault_model="step", recovery=reduced.recovery)
    whole = reduced.then(obsynth.discretise(reduced.plant, sample_time))
    return obsynth.design(whole.plant, "fault-estimation-filter", recovery=whole.recovery)


def simulated(design: obsynth.ObserverDesign, step: float) -> tuple[pd.DataFrame, dict[str, np.ndarray]]:
    """Return an absolute log, and the states of the source from its own equations."""
    scenario = obsynth.Scenario(
        horizon=40 if step > 0.05 else 15, sample_time=None if design.plant.is_discrete else step,
        inputs={"valve": obsynth.Step(size=0.4, start=1.0)}, faults={"torque": obsynth.Step(size=0.2, start=2.0)},
    )  # fmt: skip
    run = obsynth.simulate(design, scenario)
    table = pd.DataFrame(
        np.hstack([run.inputs, run.outputs]) + np.array([3.0, 50.0, 0.0]), columns=["valve", "speed", "flux"]
    )
    table.insert(0, "time", run.time)
    speed, flux = run.states.T
    voltage = 0.5 * speed + 0.1 * run.inputs[:, 0]
    power = 0.3 * speed + voltage + run.faults[:, 0]
    return table, {"voltage": voltage + 1.02, "power": power + 0.8, "leak": flux}


@pytest.mark.parametrize("step", [0.1, 0.01])
def test_they_are_those_of_the_plant_as_written(step):
    sampled = step > 0.05
    design = designed(step if sampled else None)
    table, truth = simulated(design, step)
    done = run_on_data(design, table)
    assert done.recovered == {
        "voltage": "exact", "power": "needs the fault estimate", "leak": "biased by the disturbance",
    }  # fmt: skip
    found = done.table
    late = 0
    if sampled:
        # The fault estimate is one sample late, and every recovered state is of that moment.
        assert np.array_equal(found["time of recovered states"], found["time"] - 0.1)
        late = 1
    else:
        assert "time of recovered states" not in found.columns
    for name, values in truth.items():
        away = found[f"xhat[{name}]"].to_numpy()[late:] - values[: len(values) - late]
        assert np.abs(away[-40:]).max() < 1e-6, name
    assert np.isnan(found["xhat[power]"][0]) == sampled


def test_inputs_faults_and_states_are_of_the_same_moment():
    """The input changes in every sample: one that is a sample early or late is wrong by its size."""
    design, steps = designed(0.1), 300
    u = np.random.default_rng(8).uniform(-0.5, 0.5, size=(steps, 1))
    run = simulate_plant(design.linear[0], steps=steps, u=u, f=np.full((steps, 1), 0.2))
    speed, table = run.states[:, 0], pd.DataFrame(run.outputs + np.array([50.0, 0.0]), columns=["speed", "flux"])
    table.insert(0, "valve", u[:, 0] + 3.0)
    table.insert(0, "time", 0.1 * np.arange(steps))
    found = run_on_data(design, table).table
    assert np.array_equal(found["time of recovered states"], found["time"] - 0.1)
    voltage = 0.5 * speed + 0.1 * u[:, 0]
    for name, values in (("voltage", voltage + 1.02), ("power", 0.3 * speed + voltage + 1.0)):
        estimated = found[f"xhat[{name}]"].to_numpy()
        assert np.abs(estimated[1:] - values[:-1])[-100:].max() < 1e-6, name
        # Any other moment would be distinguished.
        assert np.abs(estimated - values)[-100:].max() > 1e-2, name


def test_after_missing_rows_they_are_those_after_rows_without_signals():
    design = designed(0.1)
    table, _ = simulated(design, 0.1)
    found = run_on_data(design, table.drop(index=[100, 101]).reset_index(drop=True)).table
    table.loc[[100, 101], table.columns[1:]] = np.nan
    blank = run_on_data(design, table).table.drop(index=[100, 101]).reset_index(drop=True)
    pd.testing.assert_frame_equal(found, blank)
    assert np.isfinite(found["xhat[power]"][100:]).all()


def test_they_wait_for_the_fault_estimate_after_too_many_missing_rows():
    design = designed(0.1)
    table, _ = simulated(design, 0.1)
    table.loc[100:, "time"] += 2000.0
    found = run_on_data(design, table).table
    assert np.isnan(found["xhat[power]"][100])
    assert np.isfinite(found["xhat[power]"][101:]).all()


def test_they_can_be_watched_and_a_run_goes_on_with_them(tmp_path):
    design = designed(0.1)
    table, _ = simulated(design, 0.1)
    whole = run_on_data(design, table, thresholds={"xhat[power]": 0.35}).table
    assert (whole["alarm"] == "xhat[power]").any()
    parts = [
        run_on_data(design, part, state=tmp_path / "state.json", thresholds={"xhat[power]": 0.35}).table
        for part in (table[:51], table[51:])
    ]
    pd.testing.assert_frame_equal(pd.concat(parts, ignore_index=True), whole, rtol=0.0, atol=0.0)


def test_a_filter_without_parameters_takes_faults_as_zero():
    calm = SOURCE.replace(Bd=None, Dd=None, disturbance_names=None, operating_point={"speed": 50.0, "power": 0.8})
    reduced = obsynth.eliminate_algebraic_states(calm)
    plant = reduced.then(obsynth.discretise(reduced.plant, 0.1))
    design = obsynth.design(plant.plant, "descriptor-kalman", Q=1e-4, R=1e-2, recovery=plant.recovery)
    table = pd.DataFrame(np.ones((30, 3)), columns=["valve", *plant.plant.output_names])
    table.insert(0, "time", 0.1 * np.arange(30))
    found = run_on_data(design, table).table
    voltage = 0.5 * (found["xhat[speed]"] - 50.0) + 0.1 * table["valve"]
    np.testing.assert_allclose(found["xhat[voltage]"], voltage, atol=1e-12)
    np.testing.assert_allclose(found["xhat[power]"] - 0.8, 0.3 * (found["xhat[speed]"] - 50.0) + voltage, atol=1e-12)


def test_a_networks_bus_voltages_are_there():
    spec = load_spec(ROOT / "designs/smib/spec.yaml")
    design = obsynth.design(spec.plant, spec.method, recovery=spec.transformation.recovery, **dict(spec.options))
    names = list(design.plant.output_names)
    table = pd.DataFrame(np.zeros((20, len(names))), columns=names)
    table.insert(0, "time", 0.02 * np.arange(20))
    done = run_on_data(design, table)
    assert len(done.recovered) == 30
    shown = {name for name in done.table.columns if name.startswith("xhat[")}
    assert shown == {f"xhat[{name}]" for name in spec.transformation.source.state_names}


def test_a_number_that_overflows_there_is_no_warning():
    A = SOURCE.A.copy()
    A[4, 1] = 300.0  # leak = 300 flux, which nothing feels
    whole = obsynth.eliminate_algebraic_states(SOURCE.replace(A=A))
    whole = whole.then(obsynth.discretise(whole.plant, 0.1))
    design = obsynth.design(whole.plant, "fault-estimation-filter", recovery=whole.recovery)
    table = simulated(design, 0.1)[0]
    table.loc[30, "flux"] = 1e307
    found = run_on_data(design, table).table
    assert not np.isfinite(found["xhat[leak]"][30:33]).all()
    assert np.isfinite(found["xhat[leak]"][200:]).all()
