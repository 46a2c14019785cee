"""The shipped observer: shapes and names, running over a record and sample by sample, and python-control."""

import dataclasses

import control
import numpy as np
import pytest

from obsynth import DescriptorSystem, LinearObserver, SpecError, fault_estimation_filter

FIELDS = {
    "Az": [[0.5, 0.2, 0.0], [-0.1, 0.3, 0.1], [0.0, 0.4, -0.6]],
    "Bu": [[1.0], [0.5], [-1.0]],
    "By": [[1.0, 2.0], [0.0, 1.0], [0.3, -0.7]],
    "Cz": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.5], [0.2, 0.0, 1.0], [0.0, -1.0, 2.0]],
    "Du": [[0.0], [0.1], [0.0], [2.0]],
    "Dy": [[0.5, 0.0], [0.0, 0.0], [1.0, -1.0], [0.3, 0.1]],
    "dt": 0.25,
    "input_names": ("pump",),
    "output_names": ("level", "flow"),
    "state_names": ("x1", "x2"),
    "fault_names": ("leak",),
    "residual_names": ("leak",),
    "state_delays": (1, 1),
    "fault_delays": (2,),
}
MATRICES = ("Az", "Bu", "By", "Cz", "Du", "Dy")


def observer(**changes):
    return LinearObserver(**{**FIELDS, **changes})


@pytest.fixture
def record():
    rng = np.random.default_rng(1)
    return rng.standard_normal((50, 2)), rng.standard_normal((50, 1))


def stacked(estimates):
    return np.hstack([estimates.states, estimates.faults, estimates.residuals])


class TestRunning:
    def test_step_equals_run_bit_for_bit(self, record):
        y, u = record
        running, rows = observer().start(), []
        for outputs, inputs in zip(y, u, strict=True):
            rows.append(stacked(running.step(outputs, inputs))[0])
        assert np.array_equal(stacked(observer().run(y, u)), np.array(rows))

    def test_run_is_the_difference_equation(self, record):
        y, u = record
        az, bu, by, cz, du, dy = (np.array(FIELDS[name]) for name in MATRICES)
        z, expected = np.array([1.0, -2.0, 3.0]), []
        for outputs, inputs in zip(y, u, strict=True):
            expected.append(cz @ z + du @ inputs + dy @ outputs)
            z = az @ z + bu @ inputs + by @ outputs
        found = stacked(observer().run(y, u, initial_state=[1.0, -2.0, 3.0]))
        assert np.allclose(found, expected, rtol=1e-13, atol=1e-13)

    def test_initial_state(self):
        first = observer().start([1.0, 2.0, 4.0]).step([0.0, 0.0], [0.0])
        assert np.array_equal(stacked(first), [[1.0, 4.0, 4.2, 6.0]])
        at_rest = observer().start().step([0.0, 0.0], [0.0])
        assert np.array_equal(stacked(at_rest), np.zeros((1, 4)))

    def test_the_initial_state_is_copied(self):
        start = np.ones(3)
        running = observer().start(start)
        running.step([1.0, 1.0], [1.0])
        assert np.array_equal(start, np.ones(3))
        start[:] = 7.0
        assert np.array_equal(stacked(observer().run([[0.0, 0.0]], [[0.0]], initial_state=np.ones(3)))[0, :1], [1.0])

    @pytest.mark.parametrize("start", [[1.0], [[1.0, 2.0, 3.0]], [np.nan, 0.0, 0.0], [np.inf, 0, 0], ["a", "b", "c"],
                                       [[1.0], [1.0, 2.0]], [1j, 0.0, 0.0], 1.0, []])  # fmt: skip
    def test_wrong_initial_state(self, start):
        with pytest.raises(SpecError) as caught:
            observer().start(start)
        assert caught.value.path == "initial_state"

    def test_two_runs_do_not_share_a_state(self, record):
        y, u = record
        system = observer()
        first, second = system.start(), system.start()
        first.step(y[0], u[0])
        assert np.array_equal(second.state.z, np.zeros(3))

    def test_an_empty_record(self):
        found = observer().run(np.zeros((0, 2)), np.zeros((0, 1)))
        assert (found.states.shape, found.faults.shape, found.residuals.shape) == ((0, 2), (0, 1), (0, 1))

    def test_the_record_may_be_read_only_lists_or_whole_numbers(self, record):
        y, u = (np.round(10.0 * part) for part in record)
        expected = stacked(observer().run(y, u))
        assert np.array_equal(stacked(observer().run(y.tolist(), u.tolist())), expected)
        assert np.array_equal(stacked(observer().run(y.astype(int), u.astype(int))), expected)
        for part in (y, u):
            part.setflags(write=False)
        assert np.array_equal(stacked(observer().run(y, u)), expected)

    def test_one_signal_may_be_given_as_a_plain_list(self, record):
        y, u = record
        assert np.array_equal(stacked(observer().run(y, u[:, 0])), stacked(observer().run(y, u)))
        running = observer().start()
        assert np.array_equal(stacked(running.step(y[0], 2.0)), stacked(observer().run(y[:1], [[2.0]])))

    def test_a_continuous_observer_refuses_to_run(self):
        continuous = observer(dt=0.0)
        for call in (continuous.start, lambda: continuous.run([[0.0, 0.0]], [[0.0]])):
            with pytest.raises(SpecError, match="continuous") as caught:
                call()
            assert caught.value.path == "dt"


BAD_SAMPLES = {
    "y too short": ([1.0], [0.0], "y"),
    "y too long": ([1.0, 2.0, 3.0], [0.0], "y"),
    "y a matrix": ([[1.0, 2.0]], [0.0], "y"),
    "y ragged": ([[1.0], [1.0, 2.0]], [0.0], "y"),
    "y text": (["1.0", "2.0"], [0.0], "y"),
    "y complex": ([1j, 0.0], [0.0], "y"),
    "y booleans": ([True, False], [0.0], "y"),
    "y nothing": (None, [0.0], "y"),
    "y NaN": ([np.nan, 0.0], [0.0], "y"),
    "y inf": ([0.0, np.inf], [0.0], "y"),
    "u missing": ([1.0, 2.0], (), "u"),
    "u too long": ([1.0, 2.0], [0.0, 1.0], "u"),
    "u NaN": ([1.0, 2.0], [np.nan], "u"),
    "u -inf": ([1.0, 2.0], [-np.inf], "u"),
}


class TestBadSamples:
    @pytest.mark.parametrize("case", BAD_SAMPLES)
    def test_a_bad_sample_leaves_the_state_unchanged(self, case):
        y, u, path = BAD_SAMPLES[case]
        running, twin = observer().start([1.0, 2.0, 3.0]), observer().start([1.0, 2.0, 3.0])
        with pytest.raises(SpecError) as caught:
            running.step(y, u)
        assert caught.value.path == path
        assert np.array_equal(running.state.z, twin.state.z)
        assert np.array_equal(stacked(running.step([1.0, 2.0], [3.0])), stacked(twin.step([1.0, 2.0], [3.0])))

    @pytest.mark.parametrize(
        ("y", "u", "path"),
        [
            (np.zeros((5, 3)), np.zeros((5, 1)), "y"),
            (np.zeros(5), np.zeros((5, 1)), "y"),
            (np.zeros((5, 2)), np.zeros((4, 1)), "u"),
            (np.zeros((5, 2)), None, "u"),
            (np.full((5, 2), np.nan), np.zeros((5, 1)), "y"),
            ([["a", "b"]], [[0.0]], "y"),
            ([[1.0, 2.0], [3.0]], np.zeros((2, 1)), "y"),
        ],
    )
    def test_a_bad_record(self, y, u, path):
        with pytest.raises(SpecError) as caught:
            observer().run(y, u)
        assert caught.value.path == path

    def test_inputs_for_an_observer_without_inputs(self):
        plain = observer(Bu=np.zeros((3, 0)), Du=np.zeros((4, 0)), input_names=())
        y = np.ones((3, 2))
        assert np.array_equal(stacked(plain.run(y)), stacked(plain.run(y, np.zeros((3, 0)))))
        assert np.array_equal(stacked(plain.start().step(y[0])), stacked(plain.run(y))[:1])
        for call in (lambda: plain.run(y, np.ones((3, 1))), lambda: plain.start().step(y[0], [5.0])):
            with pytest.raises(SpecError) as caught:
                call()
            assert caught.value.path == "u"


class TestConstruction:
    @pytest.mark.parametrize("name", MATRICES)
    def test_wrong_shape(self, name):
        wide = np.hstack([np.array(FIELDS[name]), np.ones((len(FIELDS[name]), 1))])
        with pytest.raises(SpecError, match=name):
            observer(**{name: wide})

    @pytest.mark.parametrize("name", MATRICES)
    @pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
    def test_not_finite(self, name, value):
        matrix = np.array(FIELDS[name])
        matrix[-1, -1] = value
        with pytest.raises(SpecError) as caught:
            observer(**{name: matrix})
        assert caught.value.path == name

    def test_matrices_for_signals_that_are_not_there(self):
        with pytest.raises(SpecError, match="Bu"):
            observer(input_names=(), Du=np.zeros((4, 0)))

    def test_a_scalar_is_a_matrix(self):
        small = LinearObserver(
            Az=0.5, Bu=np.zeros((1, 0)), By=1.0, Cz=[[1.0], [1.0]], Du=np.zeros((2, 0)), Dy=[[0.0], [0.0]], dt=1.0,
            input_names=(), output_names=("y",), state_names=("x",), fault_names=("f",), residual_names=(),
            state_delays=(0,), fault_delays=(1,),
        )  # fmt: skip
        assert small.order == 1

    @pytest.mark.parametrize("dt", [-1.0, np.nan, np.inf])
    def test_wrong_sampling_time(self, dt):
        with pytest.raises(SpecError) as caught:
            observer(dt=dt)
        assert caught.value.path == "dt"

    @pytest.mark.parametrize("field", ["input_names", "output_names", "state_names", "fault_names", "residual_names"])
    def test_names_are_tuples_of_unique_texts(self, field):
        names = FIELDS[field]
        twice = (names[0],) * len(names)
        wrong = {
            "give a tuple": [list(names), dict.fromkeys(names), "".join(names), None],
            "non-empty texts": [(*names[1:], 1), (*names[1:], " "), (*names[1:], None)],
            "repeats": [twice] if len(names) > 1 else [(*names, *names)],
        }
        for message, cases in wrong.items():
            for case in cases:
                with pytest.raises(SpecError, match=message) as caught:
                    observer(**{field: case})
                assert caught.value.path == field

    def test_one_name_may_stand_for_signals_of_two_kinds(self):
        shared = observer(input_names=("x1",), output_names=("x1", "x2"), fault_names=("x1",), residual_names=("x1",))
        assert shared.output_names == shared.state_names

    @pytest.mark.parametrize("delays", [(), (1, 2), (-1,), (0.5,), (True,), [2]])
    def test_wrong_delays(self, delays):
        with pytest.raises(SpecError) as caught:
            observer(fault_delays=delays)
        assert caught.value.path == "delays"

    def test_arrays_are_private_and_read_only(self):
        given = np.array(FIELDS["Az"])
        system = observer(Az=given)
        given[0, 0] = 99.0
        assert system.Az[0, 0] == 0.5
        for name in MATRICES:
            with pytest.raises(ValueError, match="read-only"):
                getattr(system, name)[0, 0] = 1.0
        found = system.run([[1.0, 2.0]], [[3.0]])
        for part in (found.states, found.faults, found.residuals):
            with pytest.raises(ValueError, match="read-only"):
                part[0, 0] = 1.0
        with pytest.raises(dataclasses.FrozenInstanceError):
            system.dt = 2.0

    def test_rows_order_and_names(self, record):
        system = observer()
        assert system.order == 3
        assert (system.state_rows, system.fault_rows, system.residual_rows) == (slice(0, 2), slice(2, 3), slice(3, 4))
        found = system.run(*record)
        assert (found.states.shape, found.faults.shape, found.residuals.shape) == ((50, 2), (50, 1), (50, 1))
        assert (found.state_names, found.fault_names, found.residual_names) == (("x1", "x2"), ("leak",), ("leak",))
        assert (found.state_delays, found.fault_delays) == ((1, 1), (2,))

    def test_as_dict_and_back(self):
        system = observer()
        again = LinearObserver.from_dict(system.as_dict())
        lists = {key: list(value) if isinstance(value, tuple) else value for key, value in system.as_dict().items()}
        for other in (again, LinearObserver.from_dict(lists)):
            for name, value in system.as_dict().items():
                assert np.array_equal(getattr(other, name), value)
                assert type(getattr(other, name)) is type(value)


def designed():
    plant = DescriptorSystem(
        [[1, 0, 0], [0, 1, 0], [0, 0, 0]],
        [[0.7, 0.2, 0.0], [-0.1, 0.8, 0.3], [0.2, 0.1, -1.0]],
        [[1.0], [0.5], [0.2]],
        [[1, 0, 0], [0, 0, 1]],
        D=[[0.3], [0.0]],
        Bf=[[0.0], [1.0], [0.1]],
        Bd=[[0.1], [0.1], [0.0]],
        dt=0.5,
        state_names=["omega GENCLS 1", "a Bus 1", "v"],
        input_names=["u 1"],
        output_names=["speed", "v Bus 1"],
        fault_names=["torque"],
    )
    return fault_estimation_filter(plant, name="a name with blanks")


class TestToControl:
    def test_names_time_and_response(self):
        design = designed()
        system = design.to_control()
        assert isinstance(system, control.StateSpace)
        assert (system.dt, system.name) == (0.5, "a name with blanks")
        assert system.input_labels == ["u 1", "speed", "v Bus 1"]
        assert system.output_labels == [
            "xhat[omega GENCLS 1]", "xhat[a Bus 1]", "xhat[v]", "fhat[torque]", "r[torque]",
        ]  # fmt: skip
        assert system.state_labels == [f"z[{i}]" for i in range(1, design.observer.order + 1)]
        rng = np.random.default_rng(2)
        u, y = rng.standard_normal((80, 1)), rng.standard_normal((80, 2))
        start = rng.standard_normal(design.observer.order)
        response = control.forced_response(system, 0.5 * np.arange(80), np.hstack([u, y]).T, start, squeeze=False)
        found = stacked(design.observer.run(y, u, initial_state=start))
        assert np.allclose(found, response.outputs.T, rtol=1e-10, atol=1e-10)

    def test_one_signal_by_name(self):
        """What python-control selects by name is the response that the rows of the observer give."""
        design = designed()
        part = design.to_control()["fhat[torque]", "speed"]
        impulse = control.impulse_response(part, T=0.5 * np.arange(20)).outputs * 0.5
        y = np.zeros((20, 2))
        y[0, 0] = 1.0
        assert np.allclose(design.observer.run(y, np.zeros((20, 1))).faults[:, 0], impulse, rtol=1e-10, atol=1e-12)

    def test_the_estimates_are_those_of_the_plant(self):
        """Run against a simulated plant: the fault comes back delayed once the initial-condition response has settled,
        names in order."""
        design = designed()
        plant, observer_ = design.plant, design.observer
        rng = np.random.default_rng(3)
        steps = 300
        u, f = rng.standard_normal((steps, 1)), rng.standard_normal((steps, 1))
        dynamic, row = rng.standard_normal(2), plant.A[2]
        states, outputs = [], []
        for k in range(steps):
            algebraic = -(row[:2] @ dynamic + plant.B[2] @ u[k] + plant.Bf[2] @ f[k]) / row[2]
            x = np.append(dynamic, algebraic)
            states.append(x)
            outputs.append(plant.C @ x + plant.D @ u[k])
            dynamic = (plant.A @ x + plant.B @ u[k] + plant.Bf @ f[k])[:2]
        found = observer_.run(np.array(outputs), u)
        delay, lag = found.fault_delays[0], found.state_delays[0]
        assert np.allclose(found.faults[200 + delay :, 0], f[200 : steps - delay, 0], atol=1e-9)
        assert np.allclose(found.residuals, found.faults, atol=1e-12)
        assert np.allclose(found.states[200 + lag :], np.array(states)[200 : steps - lag], atol=1e-9)
