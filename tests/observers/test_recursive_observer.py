"""The running recursive observer: against batch solutions, with missing samples, with early constraints."""

from __future__ import annotations

import numpy as np
import pytest
from time_varying_plants import maximum_likelihood, observer_for, printed, record, textbook, varying

from obsynth import PreconditionError, SpecError, TimeVaryingDescriptorSystem
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.plants.sequences import MatrixSequence

SAMPLES = 9


def last_of(observer: RecursiveObserver, y, u) -> tuple[np.ndarray, np.ndarray]:
    """Estimate and covariance of the last sample."""
    running = observer.start()
    for k in range(len(y)):
        row = running.raw_step(y[k], u[k])
    return row.x, row.factor @ row.factor.T


@pytest.mark.parametrize("make", [varying, textbook, printed])
def test_it_is_the_maximum_likelihood_estimate_at_every_sample(make) -> None:
    plant = make()
    observer, (y, u) = observer_for(plant), record(plant, SAMPLES)
    for samples in range(1, SAMPLES + 1):
        exact, covariance = maximum_likelihood(observer, y[:samples], u[:samples])
        x, P = last_of(observer, y[:samples], u[:samples])
        np.testing.assert_allclose(x, exact, rtol=0, atol=1e-11)
        np.testing.assert_allclose(P, covariance, rtol=0, atol=1e-11)


@pytest.mark.parametrize("make", [varying, printed])
def test_an_early_constraint_is_one_more_row(make) -> None:
    plant = make()
    early, (y, u) = observer_for(plant, early_constraints=True), record(plant, SAMPLES)
    for samples in range(1, SAMPLES + 1):
        exact, covariance = maximum_likelihood(early, y[:samples], u[:samples], constraint=True)
        x, P = last_of(early, y[:samples], u[:samples])
        np.testing.assert_allclose(x, exact, rtol=0, atol=1e-11)
        np.testing.assert_allclose(P, covariance, rtol=0, atol=1e-11)
    late = last_of(observer_for(plant), y, u)[1]
    assert np.trace(covariance) < np.trace(late)


def test_an_early_constraint_with_parameters() -> None:
    plant = varying()
    early = observer_for(plant, early_constraints=True, adapt={"forgetting": 1.0})
    y, u = record(plant, SAMPLES)
    running = early.start()
    for k in range(SAMPLES):
        row = running.raw_step(y[k], u[k])
    # The same problem with the algebraic row of every step moved by hand: the batch knows theta as an unknown.
    exact, covariance = maximum_likelihood(early, y, u, parameters=True, constraint=False)
    late = plant.Phi.at(SAMPLES - 1)[2:], plant.A.at(SAMPLES - 1)[2:]
    joint, gain = np.hstack([late[1], late[0]]), 0.3
    extra = -(plant.B.at(SAMPLES - 1) @ u[-1])[2:]
    update = covariance @ joint.T / (joint @ covariance @ joint.T + gain)
    exact = exact + (update @ (extra - joint @ exact))
    np.testing.assert_allclose(np.concatenate([row.x, row.parameters.theta]), exact, rtol=0, atol=1e-11)


class TestMissingSamples:
    def test_some_outputs_are_missing(self) -> None:
        plant = varying()
        observer, (y, u) = observer_for(plant), record(plant, SAMPLES)
        y[3, 0] = y[5, 1] = y[6, 0] = np.nan
        for samples in (4, 6, 7, 9):
            exact, covariance = maximum_likelihood(observer, y[:samples], u[:samples])
            x, P = last_of(observer, y[:samples], u[:samples])
            np.testing.assert_allclose(x, exact, rtol=0, atol=1e-11)
            np.testing.assert_allclose(P, covariance, rtol=0, atol=1e-11)

    def test_nothing_is_measured_and_a_state_is_undetermined_for_a_while(self) -> None:
        """E has rank two: without outputs the third state is open, until the next algebraic equation."""
        plant = varying()
        observer, (y, u) = observer_for(plant), record(plant, SAMPLES)
        y[4] = y[5] = np.nan
        found = observer.run(y, u)
        assert np.isinf(found.state_deviations[4:6, 2]).all()
        assert np.isfinite(found.state_deviations[[3, 6, 7, 8]]).all()
        assert np.isfinite(found.states).all()
        assert found.nis_degrees.tolist() == [0, 2, 2, 2, 1, 0, 1, 2, 2]
        for samples in (7, 9):
            exact, covariance = maximum_likelihood(observer, y[:samples], u[:samples])
            np.testing.assert_allclose(found.states[samples - 1], exact, rtol=0, atol=1e-10)
            deviations = np.sqrt(np.diag(covariance))
            np.testing.assert_allclose(found.state_deviations[samples - 1], deviations, rtol=0, atol=1e-10)

    def test_parameters_do_not_mind(self) -> None:
        plant = varying()
        observer, (y, u) = observer_for(plant, adapt={"forgetting": 1.0}), record(plant, SAMPLES)
        y[2], y[4, 1] = np.nan, np.nan
        exact, covariance = maximum_likelihood(observer, y, u, parameters=True)
        found = observer.run(y, u)
        np.testing.assert_allclose(found.states[-1], exact[:3], rtol=0, atol=1e-10)
        np.testing.assert_allclose(found.parameters[-1], exact[3:], rtol=0, atol=1e-10)
        np.testing.assert_allclose(found.parameter_covariances[-1], covariance[3:, 3:], rtol=0, atol=1e-10)


def test_outputs_that_determine_the_state_end_a_gap_of_several_samples() -> None:
    """A rectangular plant: one equation for two states, of which a gap leaves both open."""
    plant = TimeVaryingDescriptorSystem(E=[[1, 0.5]], A=[["0.8 + 0.1 * cos(0.3 * k)", 0.1]], C=[[0, 1], [1, 1]], dt=1.0)
    observer = observer_for(plant)
    y = np.random.default_rng(5).standard_normal((12, 2))
    y[8:10] = np.nan
    found = observer.run(y)
    assert np.isinf(found.state_deviations[8:10]).all()
    # At k = 10 the state is what the outputs alone say, C^-1 y(10); from there the gap has no effect.
    np.testing.assert_allclose(found.states[10], np.linalg.solve(plant.C.at(10), y[10]), atol=1e-13)
    alone = np.linalg.inv(plant.C.at(10)) @ observer.R.at(10) @ np.linalg.inv(plant.C.at(10)).T
    np.testing.assert_allclose(found.state_deviations[10], np.sqrt(np.diag(alone)), rtol=1e-13)
    H = np.vstack([plant.E.at(11), plant.C.at(11)])
    A = plant.A.at(10)
    before = np.block([[A @ alone @ A.T + observer.Q.at(10), np.zeros((1, 2))], [np.zeros((2, 1)), observer.R.at(11)]])
    last = np.linalg.inv(H.T @ np.linalg.solve(before, H))
    np.testing.assert_allclose(found.state_deviations[11], np.sqrt(np.diag(last)), rtol=1e-12)


def test_steps_are_the_run() -> None:
    plant = varying()
    observer, (y, u) = observer_for(plant, adapt={"window": 3}), record(plant, SAMPLES)
    whole, running = observer.run(y, u), observer.start()
    for k in range(SAMPLES):
        one = running.step(y[k], u[k])
        for name in ("states", "state_deviations", "parameters", "parameter_covariances", "nis", "excitation"):
            np.testing.assert_array_equal(getattr(one, name)[0], getattr(whole, name)[k], err_msg=name)
    assert whole.excitation[2] == 0.0 or whole.excitation[3] > 0.0
    assert whole.state_names == plant.state_names
    assert whole.parameter_names == plant.parameter_names


def test_the_first_output_is_not_used_and_the_input_is_kept_for_the_next_step() -> None:
    plant = varying()
    observer, (y, u) = observer_for(plant), record(plant, 3)
    first, other = observer.run(y, u), observer.run(np.vstack([np.full(2, np.nan), y[1:]]), u)
    np.testing.assert_array_equal(first.states, other.states)
    np.testing.assert_array_equal(first.states[0], observer.initial_state)
    last = u.copy()
    last[2] += 1.0
    np.testing.assert_array_equal(observer.run(y, last).states, first.states)


def test_redundant_perfect_constraints() -> None:
    """The same exact equation twice: dropped while it agrees, refused when it contradicts itself."""
    E = [[1, 0], [0, 0], [0, 0]]
    plant = TimeVaryingDescriptorSystem(E, [[0.9, 0.1], [1, 1], [2, 2]], [[0, 0], [1, 0], [0, 1]], [[0.5, 1]], dt=1.0)
    observer = observer_for(plant, Q=np.diag([0.1, 0, 0]), R=[[0.2]], early_constraints=True)
    y = np.array([[0.0], [0.3], [0.1]])
    agreeing = np.array([[1.0, 2.0], [0.5, 1.0], [0.2, 0.4]])
    found = observer.run(y, agreeing)
    np.testing.assert_allclose(found.states.sum(axis=1), -agreeing[:, 0], atol=1e-14)
    with pytest.raises(PreconditionError, match="contradict each other"):
        observer.run(y, agreeing + np.array([0.0, 0.1]))


class TestBadInput:
    def test_records(self) -> None:
        plant = varying(horizon=5)
        observer, (y, u) = observer_for(plant), record(plant, 6)
        assert len(observer.run(y, u).states) == 6
        longer = record(plant, 7)
        with pytest.raises(SpecError, match="7 samples, but the plant's horizon of 5 steps is good for 6"):
            observer.run(*longer)
        with pytest.raises(SpecError, match="early constraints need one step more"):
            observer_for(plant, early_constraints=True).run(y, u)
        running = observer.start()
        for k in range(6):
            running.step(y[k], u[k])
        with pytest.raises(SpecError, match="horizon"):
            running.step(y[0], u[0])
        for bad, part in (
            ((y[:, :1], u), r"y has shape \(6, 1\)"),
            ((y, None), "u is missing"),
            ((y, u[:5]), "u has 5 samples and y has 6"),
            ((y, np.full((6, 1), np.nan)), "u has nan"),
            ((np.full((6, 2), np.inf), u), "y holds an infinity"),
            (([[1, 2], [1]], u), "y must be numbers"),
        ):
            with pytest.raises(SpecError, match=part):
                observer.run(*bad)
        with pytest.raises(SpecError, match="u must be 1 finite"):
            observer.start().step(y[0], [1.0, 2.0])
        with pytest.raises(SpecError, match="'u1' is nan at k = 0: inputs must be known at the first sample"):
            observer.start().step(y[0], [np.nan])
        running = observer.start()
        running.step(y[0], u[0])
        with pytest.raises(SpecError, match="'u1' is inf at k = 1"):
            running.step(y[1], [np.inf])
        with pytest.raises(SpecError, match="y has shape"):
            observer.start().step([1.0], u[0])

    def test_covariances(self) -> None:
        plant = textbook()
        data = record(plant, 6)
        with pytest.raises(SpecError, match="Q is 3 by 3, but 2 by 2 is needed"):
            observer_for(plant, Q=np.eye(3))
        with pytest.raises(SpecError, match=r"Q\(0\) is not symmetric"):
            observer_for(plant, Q=[[1, 0.2], [0.1, 1]]).run(*data)
        with pytest.raises(SpecError, match=r"R\(3\) is no covariance: it has a negative variance"):
            observer_for(plant, R=[["3 - k - step(k - 3)"]]).run(*data)
        with pytest.raises(SpecError, match=r"Q\(0\) is not positive semidefinite"):
            observer_for(plant, Q=[[1, 2], [2, 1]]).run(*data)
        with pytest.raises(SpecError, match="initial_covariance is not positive"):
            observer_for(plant, initial_covariance=[[1, 2], [2, 1]])
        with pytest.raises(SpecError, match="initial_state must be 2"):
            observer_for(plant, initial_state=[0.0])

    def test_a_rank_is_lost_at_one_k(self) -> None:
        plant = varying(C=[["1 - step(k - 4) + step(k - 5)", 0, 0.3], [0, "1 - step(k - 4) + step(k - 5)", 0]])
        lost = plant.replace(C=[["1", 0, "1 - step(k - 4) + step(k - 5)"], [0, 1, 0]], E=np.diag([1.0, 1, 0]))
        with pytest.raises(PreconditionError, match="rank H_k is lost at k = 4") as caught:
            observer_for(lost).run(*record(lost, 9))
        assert caught.value.condition == "rank [E; C]"

    def test_early_constraints_that_are_none(self) -> None:
        with pytest.raises(SpecError, match="rows of E that are zero"):
            observer_for(textbook(), early_constraints=True).start()
        coupled = np.diag([0.1, 0.2, 0.3]) + 0.01
        with pytest.raises(SpecError, match="couples the noise of algebraic equations"):
            observer_for(varying(), Q=coupled, early_constraints=True).run(*record(varying(), 3))

    def test_adaptation(self) -> None:
        for changes, part in (
            ({"forgetting": 0.0}, "above 0 and at most 1"),
            ({"forgetting": 1.01}, "above 0 and at most 1"),
            ({"forgetting": float("nan")}, "above 0 and at most 1"),
            ({"form": "magic"}, "form is 'magic'"),
            ({"guard": "prayer"}, "guard is 'prayer'"),
            ({"window": 0}, "window is 0"),
            ({"initial_covariance": np.zeros((2, 2))}, "must be positive definite"),
            ({"initial_covariance": np.eye(3)}, "but 2 by 2 is needed"),
        ):
            with pytest.raises(SpecError, match=part):
                observer_for(varying(), adapt=changes)


def test_data_come_back() -> None:
    plant = varying(horizon=8)
    observer = observer_for(plant, adapt={}, Q=[["0.1 + 0.01 * k", 0, 0], [0, 0.2, 0], [0, 0, 0.3]])
    again = RecursiveObserver.from_dict(observer.as_dict())
    y, u = record(plant, 9)
    np.testing.assert_array_equal(again.run(y, u).parameters, observer.run(y, u).parameters)
    np.testing.assert_array_equal(again.run(y, u).states, observer.run(y, u).states)
    called = observer_for(plant, R=np.eye(2))
    object.__setattr__(called, "R", MatrixSequence.of(lambda k: np.eye(2), "R"))
    with pytest.raises(SpecError, match="R is a Python function"):
        called.as_dict()


def walking_likelihood(observer: RecursiveObserver, y: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Estimate and covariance of ``[x(N); theta(N)]``: all states and parameters of a record, early rows too."""
    plant, adapt, steps = observer.plant, observer.adaptation, len(y) - 1
    nx, nq = plant.nx, plant.nq
    size = (nx + nq) * (steps + 1)
    rows, values, weights = [], [], []

    def add(blocks: dict[int, np.ndarray], value: np.ndarray, covariance: np.ndarray) -> None:
        row, kept = np.zeros((len(value), size)), np.isfinite(value)
        for column, block in blocks.items():
            row[:, column : column + block.shape[1]] = block
        rows.append(row[kept])
        values.append(value[kept])
        weights.append(np.linalg.inv(covariance[np.ix_(kept, kept)]))

    state, theta = [k * (nx + nq) for k in range(steps + 1)], [k * (nx + nq) + nx for k in range(steps + 1)]
    add({0: np.eye(nx)}, observer.initial_state, observer.initial_covariance)
    add({theta[0]: np.eye(nq)}, adapt.initial_parameters, adapt.initial_covariance)
    for k in range(steps):
        add({state[k + 1]: plant.E.at(k + 1), state[k]: -plant.A.at(k), theta[k]: -plant.Phi.at(k)},
            plant.B.at(k) @ u[k], observer.Q.at(k))  # fmt: skip
        add({state[k + 1]: plant.C.at(k + 1), theta[k]: plant.Psi.at(k)}, y[k + 1], observer.R.at(k))
        add({theta[k + 1]: np.eye(nq), theta[k]: -np.eye(nq)}, np.zeros(nq), adapt.walk)
    late = ~plant.E.at(1).any(axis=1)
    add({state[steps]: plant.A.at(steps)[late], theta[steps]: plant.Phi.at(steps)[late]},
        -(plant.B.at(steps) @ u[steps])[late], observer.Q.at(steps)[np.ix_(late, late)])  # fmt: skip
    matrix, value = np.vstack(rows), np.concatenate(values)
    weight = np.zeros((len(value), len(value)))
    top = 0
    for block in weights:
        weight[top : top + len(block), top : top + len(block)] = block
        top += len(block)
    covariance = np.linalg.inv(matrix.T @ weight @ matrix)
    return (covariance @ matrix.T @ weight @ value)[state[steps] :], covariance[state[steps] :, state[steps] :]


@pytest.mark.parametrize("missing", [False, True])
def test_early_constraints_and_a_random_walk_are_maximum_likelihood(missing: bool) -> None:
    plant = varying(horizon=30)
    walk = np.array([[0.02, 0.005], [0.005, 0.01]])
    observer = observer_for(plant, adapt={"form": "random-walk", "walk": walk}, early_constraints=True)
    y, u = record(plant, 14)
    y = y.copy()
    if missing:
        y[4, 0] = y[9, 1] = y[12, 1] = np.nan
    for samples in (1, 2, 7, 14):
        found = observer.run(y[:samples], u[:samples])
        exact, covariance = walking_likelihood(observer, y[:samples], u[:samples])
        np.testing.assert_allclose(found.states[-1], exact[:3], rtol=0, atol=1e-11)
        np.testing.assert_allclose(found.parameters[-1], exact[3:], rtol=0, atol=1e-11)
        np.testing.assert_allclose(found.state_deviations[-1] ** 2, np.diag(covariance)[:3], rtol=1e-10)
        np.testing.assert_allclose(found.parameter_covariances[-1], covariance[3:, 3:], rtol=0, atol=1e-12)


def test_early_constraints_and_parameters_that_stand_still() -> None:
    """A random walk of no variance is least squares without a forgetting factor."""
    plant = varying(horizon=30)
    data = record(plant, 20)
    still = observer_for(plant, adapt={"form": "random-walk"}, early_constraints=True).run(*data)
    squares = observer_for(plant, adapt={"forgetting": 1.0}, early_constraints=True).run(*data)
    np.testing.assert_allclose(still.parameters, squares.parameters, rtol=0, atol=1e-12)
    np.testing.assert_allclose(still.states, squares.states, rtol=0, atol=1e-12)


def test_a_masked_sample_is_a_missing_one() -> None:
    observer, (y, u) = observer_for(varying()), record(varying(), SAMPLES)
    masked = np.ma.masked_array(y, mask=np.zeros_like(y, dtype=bool))
    masked[4], masked[6, 0] = np.ma.masked, np.ma.masked
    y[4], y[6, 0] = np.nan, np.nan
    np.testing.assert_array_equal(observer.run(masked, u).states, observer.run(y, u).states)
    with pytest.raises(SpecError, match="u has nan in row 3"):
        observer.run(y, np.ma.masked_array(u, mask=np.arange(SAMPLES)[:, None] == np.full((1, u.shape[1]), 2)))
