"""Dead times of inputs and sensors: exact on samples, refused or approximated in continuous time, in every format."""

import json
import math
from datetime import timedelta

import numpy as np
import pandas as pd
import pytest
import scipy.io
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st
from test_export import through_c

import obsynth
from obsynth.cli.main import main
from obsynth.plants.dead_times import seconds_of
from obsynth.results.gain_set_writing import digest_of

MATRICES = {"A": [[-1.0, 0.5], [0.0, -2.0]], "B": [[0.0], [1.0]], "C": [[1, 0], [0, 1]], "Bf": [[1], [0]]}

SAMPLED_SPEC = """schema_version: 1
name: late
plant:
  dt: 0
  A: [[-1.0, 0.5], [0.0, -2.0]]
  B: [[0.0], [1.0]]
  C: [[1, 0], [0, 1]]
  Bf: [[1], [0]]
  delays: {u1: 0.25, y2: 100 ms}
  transform: {sample_time: 0.1}
method: {id: functional-filter}
"""


def delayed(**changes):
    """A continuous plant with an input that is 0.25 s late and a sensor that is 0.1 s late."""
    return obsynth.DescriptorSystem(
        **{**MATRICES, "delays": {"u1": 0.25, "y2": "100 ms"}, "sensor_noise": {"y1": 0.1, "y2": 0.1}, **changes}
    )


def held(signal, time, step):
    """The value of a held signal; zero before the first sample."""
    k = math.floor(time / step + 1e-9)
    return signal[k] if k >= 0 else np.zeros(signal.shape[1])


class Reference:
    """The continuous plant, stepped from event to event by exponentials; nothing of the package is used."""

    def __init__(self, plant, step, u, f):
        self.plant, self.step, self.u, self.f = plant, step, u, f
        late = [plant.delays.get(name, 0.0) for name in (*plant.input_names, *plant.output_names)]
        self.of_inputs, self.of_outputs = late[: plant.nu], late[plant.nu :]
        ends = {
            round(k * step + sign * delay, 9)
            for k in range(-20, len(u) + 20)
            for delay in (0, *late)
            for sign in (1, -1)
        }
        self.times = sorted(time for time in ends if 0.0 <= time <= step * len(u))
        self.states, x = {0.0: np.zeros(plant.nx)}, np.zeros(plant.nx)
        for start, end in zip(self.times[:-1], self.times[1:], strict=True):
            middle = (start + end) / 2.0
            drive = plant.B @ self.acting(middle) + plant.Bf @ held(f, middle, step)
            block = np.zeros((plant.nx + 1, plant.nx + 1))
            block[:-1, :-1], block[:-1, -1] = plant.A, drive
            x = (scipy.linalg.expm(block * (end - start)) @ np.append(x, 1.0))[:-1]
            self.states[end] = x

    def acting(self, time):
        return np.array([held(self.u, time - late, self.step)[j] for j, late in enumerate(self.of_inputs)])

    def reading(self, k):
        found = np.zeros(self.plant.ny)
        for i, late in enumerate(self.of_outputs):
            time = round(k * self.step - late, 9)
            if time < 0.0:
                continue
            acting = self.plant.D @ self.acting(time + 1e-9) + self.plant.Df @ held(self.f, time + 1e-9, self.step)
            found[i] = self.plant.C[i] @ self.states[time] + acting[i]
        return found


DELAY = st.integers(0, 60).map(lambda hundredths: hundredths / 100)


@pytest.mark.long
@given(
    seed=st.integers(0, 10_000), delays=st.tuples(DELAY, DELAY, DELAY, DELAY), step=st.sampled_from([0.05, 0.1, 0.13])
)
@settings(max_examples=25, deadline=None)
def test_a_sampled_plant_with_delays_of_any_length_is_exact(seed, delays, step):
    rng = np.random.default_rng(seed)
    names = ("u1", "u2", "y1", "y2")
    plant = obsynth.DescriptorSystem(
        A=rng.normal(size=(3, 3)) - np.eye(3),
        B=rng.normal(size=(3, 2)),
        C=rng.normal(size=(2, 3)),
        D=rng.normal(size=(2, 2)),
        Bf=rng.normal(size=(3, 1)),
        Df=rng.normal(size=(2, 1)),
        delays=dict(zip(names, delays, strict=True)),
    )
    made = obsynth.discretise(plant, step).plant
    samples = 14
    u, f = rng.normal(size=(samples, 2)), rng.normal(size=(samples, 1))
    truth, x = Reference(plant, step, u, f), np.zeros(made.nx)
    for k in range(samples):
        size = 1.0 + np.abs(truth.reading(k)).max()
        np.testing.assert_allclose(made.C @ x + made.D @ u[k] + made.Df @ f[k], truth.reading(k), atol=1e-11 * size)
        np.testing.assert_allclose(x[:3], truth.states[round(k * step, 9)], atol=1e-11 * size)
        x = made.A @ x + made.B @ u[k] + made.Bf @ f[k]
    assert not made.delays


def test_the_noise_between_samples_is_that_of_the_plant():
    """A sensor that is read within a sample: its covariance with the sensor at the sample, by fine sampling."""
    A, noise = np.array([[-1.0, 3.0], [-2.0, -0.5]]), np.diag([0.3, 0.7])
    plant = obsynth.DescriptorSystem(A=A, C=np.eye(2), Bw=noise, delays={"y2": 0.23})
    made = obsynth.discretise(plant, 0.1).plant
    P = scipy.linalg.solve_discrete_lyapunov(made.A, made.Bw @ made.Bw.T)
    # Stationary: cov(y1(t), y2(t)) = c1 P exp(A' late) ... with the later state first.
    stationary = scipy.linalg.solve_continuous_lyapunov(A, -noise @ noise.T)
    cross = (scipy.linalg.expm(A * 0.23) @ stationary)[0, 1]
    found = made.C @ P @ made.C.T
    np.testing.assert_allclose(found, [[stationary[0, 0], cross], [cross, stationary[1, 1]]], rtol=1e-10)
    # And one sample later, which sees how noise of the same sample reaches both.
    later = (made.C @ made.A @ P @ made.C.T)[0, 1]
    np.testing.assert_allclose(later, (scipy.linalg.expm(A * 0.33) @ stationary)[0, 1], rtol=1e-10)
    earlier = (made.C @ made.A @ P @ made.C.T)[1, 0]
    np.testing.assert_allclose(earlier, (scipy.linalg.expm(A.T * (0.23 - 0.1)).T @ stationary)[0, 1], rtol=1e-10)


def test_whole_samples_add_no_rounding():
    plant = delayed(delays={"u1": 0.3, "y2": 0.2})
    plain, made = obsynth.discretise(plant.replace(delays=None), 0.1).plant, obsynth.discretise(plant, 0.1).plant
    assert np.array_equal(made.A[:2, :2], plain.A)
    assert np.array_equal(made.A[:2, 4], plain.B[:, 0])
    assert np.array_equal(made.Bw[:2], plain.Bw)
    assert made.nx == 2 + 3 + 2
    assert made.state_names[4] == "u1, 3 samples ago"
    assert made.state_names[-1] == "reading of y2, 2 samples ago"


def test_a_plant_on_samples_takes_whole_samples_only():
    plant = delayed(dt=0.05)
    made = obsynth.absorb_delays(plant)
    assert made.plant.nx == 2 + 5 + 2
    assert not made.plant.delays
    u = np.random.default_rng(2).normal(size=(30, 1))
    run, plain = obsynth.simulate(plant, steps=30, u=u), plant.replace(delays=None)
    late = np.vstack([np.zeros((5, 1)), u[:-5]])
    alone = obsynth.simulate(plain, steps=30, u=late)
    np.testing.assert_allclose(run.states, alone.states, atol=1e-14)
    np.testing.assert_allclose(run.outputs[:, 0], alone.outputs[:, 0], atol=1e-14)
    np.testing.assert_allclose(run.outputs[2:, 1], alone.outputs[:-2, 1], atol=1e-14)
    with pytest.raises(obsynth.SpecError, match=r"u1 0\.25 s.*not whole samples of 0\.1 s"):
        obsynth.absorb_delays(delayed(dt=0.1))


def test_algebraic_states_with_a_delayed_input_are_recovered():
    plant = obsynth.DescriptorSystem(
        E=np.diag([1.0, 0.0]),
        A=[[-1.0, 1.0], [0.0, -2.0]],
        B=[[0.0], [3.0]],
        C=[[1, 0]],
        Bf=[[1], [0]],
        delays={"u1": 0.07},
    )
    u = np.random.default_rng(3).normal(size=(40, 1))
    for way in (
        obsynth.discretise(plant, 0.05),
        obsynth.discretise(obsynth.eliminate_algebraic_states(plant), 0.05),
    ):
        run = obsynth.simulate(way.plant, steps=40, u=u)
        found = run.states @ way.recovery.from_state.T + run.inputs @ way.recovery.from_input.T
        truth = Reference(plant.replace(E=None, A=[[-1, 1], [0, -2]]), 0.05, u, np.zeros((40, 1)))
        expected = [1.5 * truth.acting(0.05 * k + 1e-9)[0] for k in range(40)]
        np.testing.assert_allclose(found[:, 1], expected, atol=1e-13)
    reduced = obsynth.eliminate_algebraic_states(plant)
    with pytest.raises(obsynth.SpecError, match="give the transformation itself"):
        reduced.then(obsynth.discretise(reduced.plant, 0.05))


def test_a_bias_of_a_late_sensor_is_counted_from_its_reading():
    plant = delayed(Bf=None, Df=["y2"])
    made = obsynth.discretise(plant, 0.1).plant
    assert not made.Bf.any()
    assert made.sensor_faults == ("y2",)
    # One that reaches two sensors at different times is not.
    both = obsynth.discretise(delayed(Bf=[[0], [0]], Df=[[1], [1]]), 0.1).plant
    assert both.Bf.any()


@pytest.mark.parametrize(
    "value", [-1.0, math.nan, math.inf, True, "1 fortnight", "later", "", [1.0], 1e300, "1_0 s", {"s": 1}]
)
def test_what_is_no_dead_time_is_refused(value):
    with pytest.raises(obsynth.SpecError, match="delays"):
        delayed(delays={"u1": value})


def test_names_and_texts_of_delays():
    assert delayed(delays={"u1": timedelta(milliseconds=250), "y1": 0}).delays == {"u1": 0.25}
    assert delayed(delays={"u1": "2 min"}).delays == {"u1": 120.0}
    with pytest.raises(obsynth.SpecError, match=r"f1.*Faults and unknown inputs need none"):
        delayed(delays={"f1": 1.0})
    with pytest.raises(obsynth.SpecError, match="an input and an output"):
        delayed(input_names=["level"], output_names=["level", "y2"], delays={"level": 1.0})
    with pytest.raises(obsynth.SpecError, match="each is a state"):
        obsynth.discretise(delayed(), 1e-4)
    assert "u1 0.25 s" in repr(delayed())
    assert delayed().replace(input_names=["valve"]).delays == {"y2": 0.1}
    again = obsynth.DescriptorSystem(**delayed().as_dict())
    assert again.delays == delayed().delays
    assert "delays" not in delayed(delays=None).as_dict()


@pytest.mark.long
def test_continuous_designs_are_refused_with_what_was_tried():
    for method in ("auto", "pd-observer", "ui-pi-observer", "functional-filter"):
        with pytest.raises(obsynth.PreconditionError, match=r"obsynth\.discretise\(plant, 0\.05\)") as caught:
            obsynth.design(delayed(), method)
        assert caught.value.condition == "delays"
        assert caught.value.signals == ("u1", "y2")
        named = str(caught.value).partition("For that exist: ")[2].partition(".")[0].split(", ")
        tried = [method] if f"{method} exists for that" in str(caught.value) else [name for name in named if name]
        assert tried
        for name in tried:
            assert obsynth.design(obsynth.discretise(delayed(), 0.05), name).report.passed


@pytest.mark.one_in(4)
@pytest.mark.parametrize(
    "call",
    [
        obsynth.analyse_structure,
        obsynth.check,
        obsynth.compare,
        obsynth.decouple,
        obsynth.diagnose,
        obsynth.sensor_sets,
        lambda plant: obsynth.optimal_filter(plant, delay=1, reference=None),
        lambda plant: obsynth.steady_state_filter(plant, Q=1.0, R=1.0),
        lambda plant: obsynth.design_from_gains(plant, "pd-observer"),
        lambda plant: obsynth.conditions.filasova_theorem1(plant, delta=0.1),
        lambda plant: obsynth.simulate(plant, steps=3),
        lambda plant: obsynth.calibrate(plant, {"time": [0.0, 1.0]}, {}),
    ],
)  # fmt: skip
def test_nothing_takes_a_continuous_plant_with_delays_as_if_it_had_none(call):
    with pytest.raises(obsynth.ObsynthError, match=r"delays|continuous: sample it"):
        call(delayed())


@pytest.mark.long
def test_a_pade_model_says_that_it_is_one():
    made = obsynth.absorb_delays(delayed(), 3)
    plant = made.plant
    assert plant.nx == 2 + 3 + 3
    assert "not for the delays" in made.notes[0]
    good = float(made.notes[0].partition("up to ")[2].split()[0])
    for frequency, within in ((0.5 * good, True), (0.99 * good, True), (1.6 * good, False)):
        s = 1j * frequency
        inner = np.linalg.solve(s * np.eye(2) - np.array(MATRICES["A"]), np.array(MATRICES["B"]))
        truth = np.exp(-0.25 * s) * inner[0, 0]
        found = (plant.C @ np.linalg.solve(s * np.eye(plant.nx) - plant.A, plant.B) + plant.D)[0, 0]
        assert (abs(found - truth) <= 0.05 * abs(truth)) == within
    design = obsynth.pd_observer(made)
    assert design.report.passed
    assert "not for the delays" in design.notes[0]
    with pytest.raises(obsynth.SpecError, match="on samples delays are exact"):
        obsynth.absorb_delays(delayed(dt=0.05), 2)


def test_python_control_and_scipy_take_delays():
    control = pytest.importorskip("control")
    plant = obsynth.from_control(control.tf([1.0], [2.0, 1.0]), delays={"u[0]": "3 s"})
    assert plant.delays == {"u[0]": 3.0}
    step = obsynth.simulate(obsynth.discretise(plant, 0.5).plant, steps=40, u=np.ones((40, 1))).outputs[:, 0]
    time = 0.5 * np.arange(40)
    np.testing.assert_allclose(step, np.where(time > 3.0, 1.0 - np.exp(-(time - 3.0) / 2.0), 0.0), atol=1e-12)


def written(folder, **fields):
    """A .mat file with a struct of a plant."""
    path = folder / "plant.mat"
    system = {"A": [[-1.0]], "B": [[1.0, 2.0]], "C": [[1.0]], "D": [[0.0, 0.0]], "Ts": 0.0, **fields}
    scipy.io.savemat(path, {"sys": system})
    return path


def test_delays_of_matlab_are_read_in_their_unit(tmp_path):
    path = written(tmp_path, InputDelay=[[2.0], [0.0]], OutputDelay=[[0.5]], TimeUnit="minutes")
    assert obsynth.from_matlab(path).delays == {"u1": 120.0, "y1": 30.0}
    # Of sampled models they count samples.
    assert obsynth.from_matlab(written(tmp_path, Ts=0.1, InputDelay=[[3.0], [4.0]])).delays == pytest.approx(
        {"u1": 0.3, "u2": 0.4}
    )
    # A delayed input that is a fault is counted from when it acts.
    plant = obsynth.from_matlab(written(tmp_path, InputDelay=[[2.0], [1.0]]), faults=["u2"], delays={"u1": 0.5})
    assert plant.delays == {"u1": 0.5}
    assert plant.fault_names == ("u2",)
    with pytest.raises(obsynth.SpecError, match="InputDelay has 3 numbers"):
        obsynth.from_matlab(written(tmp_path, InputDelay=[[1.0], [2.0], [3.0]]))


@pytest.mark.parametrize("field", ["InternalDelay", "IODelay", "ioDelay"])
def test_inner_delays_are_refused_by_name(tmp_path, field):
    with pytest.raises(obsynth.SpecError, match=field):
        obsynth.from_matlab(written(tmp_path, **{field: [[0.5, 0.0]]}))
    assert not obsynth.from_matlab(written(tmp_path, **{field: [[0.0, 0.0]]})).delays


SPEC = """
schema_version: 1
name: late
plant:
  dt: 0
  A: [[-1, 0.5], [0, -2]]
  B: [[0], [1]]
  C: [[1, 0], [0, 1]]
  Bf: [[1], [0]]
  Bd: [[0], [1]]
  sensor_noise: {y1: 0.01, y2: 0.01}
  delays: {u1: 0.25 s, y2: 0.1}
  transform: {TRANSFORM}
scenario:
  horizon: 10
  inputs: {u1: {kind: sine, amplitude: 1, frequency: 2}}
  disturbances: {d1: {kind: uniform, low: -0.1, high: 0.1}}
  faults: {f1: {kind: step, size: 1, start: 5}}
method: {id: ui-pi-observer}
"""


def spec(folder, transform="sample_time: 0.05"):
    path = folder / "spec.yaml"
    path.write_text(SPEC.replace("TRANSFORM", transform))
    return path


def test_a_spec_with_delays_is_designed_simulated_saved_and_verified(tmp_path):
    loaded = obsynth.load_spec(spec(tmp_path))
    assert loaded.plant.nx == 2 + 5 + 2
    assert "u1 0.25 s" in loaded.transformation.description
    design = obsynth.design(loaded.transformation, loaded.method)
    assert design.report.passed
    assert design.source.plant.delays == {"u1": 0.25, "y2": 0.1}
    run = obsynth.simulate(design, loaded.scenario)
    assert abs(run.estimates.faults[-20:, 0].mean() - 1.0) < 0.05
    design.save(tmp_path / "late.gains.json")
    assert obsynth.verify(obsynth.load(tmp_path / "late.gains.json")).passed
    # Another delay is another plant.
    document = json.loads((tmp_path / "late.gains.json").read_text())
    document["design"]["source"]["signals"]["delays"]["u1"] = 0.3
    document["sha256"] = digest_of(document["design"])
    (tmp_path / "other.gains.json").write_text(json.dumps(document))
    failed = obsynth.verify(obsynth.load(tmp_path / "other.gains.json"))
    assert "plant as written" in [check.name for check in failed.checks if not check.passed]


def test_transforms_of_a_spec_with_delays(tmp_path):
    path = spec(tmp_path, "pade: 2")
    path.write_text(SPEC.replace("TRANSFORM", "pade: 2").replace("  horizon: 10", "  horizon: 10\n  sample_time: 0.05"))
    assert obsynth.load_spec(path).plant.nx == 2 + 2 + 2
    for transform, wrong in (
        ("{pade: 2, sample_time: 0.05}", "exact"),
        ("pade: 9", "pade"),
        ("sample_time: 1.e-5", "state"),
    ):
        text = transform.strip("{}")
        with pytest.raises(obsynth.SpecError, match=wrong):
            obsynth.load_spec(spec(tmp_path, text))
    path = spec(tmp_path)
    path.write_text(path.read_text().replace("u1: 0.25 s", "u9: 0.25 s"))
    with pytest.raises(obsynth.SpecError, match="u9"):
        obsynth.load_spec(path)


@pytest.mark.long
def test_on_logs_in_c_and_in_python_the_same(tmp_path):
    loaded = obsynth.load_spec(spec(tmp_path))
    design = obsynth.design(loaded.transformation, loaded.method)
    run = obsynth.simulate(design, loaded.scenario)
    signals = {"u1": run.inputs[:, 0], "y1": run.outputs[:, 0], "y2": run.outputs[:, 1]}
    table = pd.DataFrame({"time": run.time, **signals})
    log = obsynth.run_on_data(design, table)
    np.testing.assert_allclose(log.table["fhat[f1]"].to_numpy(), run.estimates.faults[:, 0], atol=1e-12)
    # A log that is taken as if nothing were late shows another fault.
    plain = obsynth.design(obsynth.discretise(loaded.transformation.source.replace(delays=None), 0.05), loaded.method)
    wrong = obsynth.run_on_data(plain, table)
    assert (
        np.abs(wrong.table["fhat[f1]"].to_numpy()[60:100]).max()
        > 3.0 * np.abs(log.table["fhat[f1]"].to_numpy()[60:100]).max()
    )
    obsynth.export(design, tmp_path / "late.c")
    signals = np.column_stack([run.inputs, run.outputs])
    found = through_c(design.observer, tmp_path / "late.c", signals)
    nx = len(design.observer.state_names)
    np.testing.assert_allclose(found[:, nx], run.estimates.faults[:, 0], atol=1e-12)


@pytest.mark.one_in(4)
@pytest.mark.parametrize(
    "method", ["fault-estimation-filter", "ui-pi-observer", "functional-filter", "descriptor-kalman"]
)
@pytest.mark.parametrize("delays", [{"u1": 0.3}, {"y2": 0.2}, {"u1": 0.12, "y1": 0.05, "y2": 0.07}])
def test_methods_take_plants_whose_delays_became_states(method, delays):
    design = obsynth.design(obsynth.discretise(delayed(delays=delays, Bw=0.1 * np.eye(2)), 0.1), method)
    assert design.report.passed


def test_both_signs_of_micro_are_microseconds():
    texts = ("300 us", "300 \u00b5s", "300\u03bcs")
    assert [seconds_of(text, "delays.u1") for text in texts] == pytest.approx([3e-4] * 3)


@pytest.mark.parametrize(
    "delays", [{"reflux": ["1 s", "7 s"]}, {"reflux": {"top": 1.0, "bottom": 7.0}}, {("reflux", "top"): 1.0}]
)
def test_a_signal_has_one_delay(delays) -> None:
    with pytest.raises(obsynth.SpecError, match=r"a signal has one delay, in seconds.*give it once for each delay"):
        delayed(input_names=["reflux"], delays=delays)


def test_paths_with_delays_of_their_own_as_inputs_of_the_same_values() -> None:
    """The column of Wood and Berry, in minutes: its steps are those of its four transfer functions."""
    gains, times = np.array([[12.8, -18.9], [6.6, -19.4]]), np.array([[16.7, 21.0], [10.9, 14.4]])
    late = np.array([[1.0, 3.0], [7.0, 3.0]])
    paths = [(1, 0), (0, 0), (0, 1), (1, 1)]  # of reflux 7 and 1 late, of steam twice 3 late
    column = obsynth.DescriptorSystem(
        A=np.diag([-1.0 / times[path] for path in paths]),
        B=[[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0], [0, 0, 1.0]],
        C=[[gains[path] / times[path] if path[0] == i else 0.0 for path in paths] for i in (0, 1)],
        input_names=["reflux to bottom", "reflux to top", "steam"],
        output_names=["top", "bottom"],
        delays={"reflux to bottom": 7.0, "reflux to top": 1.0, "steam": 3.0},
    )
    sampled = obsynth.discretise(column, 1.0).plant
    u = np.array([1.0, 1.0, 0.5])
    x = np.zeros(sampled.nx)
    for k in range(30):
        risen = 1.0 - np.exp(-np.maximum(k - late, 0.0) / times)
        np.testing.assert_allclose(sampled.C @ x, (gains * risen) @ [1.0, 0.5], rtol=1e-9, atol=1e-12)
        x = np.linalg.solve(sampled.E, sampled.A @ x + sampled.B @ u)


def test_check_takes_a_spec_whose_transformation_samples_the_delays(tmp_path, capsys):
    """It refused what ``design`` takes, and named as the remedy the transformation that the spec has."""
    spec = tmp_path / "spec.yaml"
    spec.write_text(SAMPLED_SPEC)
    assert main(["check", "-v", "--system", str(spec)]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "functional-filter: all conditions hold" in printed
    assert "as written without delays" in printed
    assert "x1; x2; u1, 1 sample ago; u1, 2 samples ago" in printed  # commas are in the names
    assert main(["check", "--system", str(spec), "--json"]) == 0
    structure = json.loads(capsys.readouterr().out)["structure"]
    assert set(structure) == {"as_written_without_delays", "as_the_method_sees_it"}


def test_tolerances_are_lost_with_delays_by_that_name():
    """It said 'E, A, B, C, Bf, Bd were changed', of which the user had changed nothing."""
    plant = obsynth.uncertain_system(
        {"A": [["-a"]], "B": [[1]], "C": [[1]], "Bf": [[1]], "delays": {"u1": 3.0}},
        {"a": {"nominal": 0.5, "tolerance": "5 %"}},
    )
    for delayed in (obsynth.discretise(plant, 1.0), obsynth.absorb_delays(plant, order=2)):
        assert delayed.plant.uncertainty.lost == "delays became states"
