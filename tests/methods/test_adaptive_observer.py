"""Parameters: (18) by values, the innovation form by the augmented filter, honest spreads, and guards."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from paper_filter import PaperState, paper_step
from time_varying_plants import maximum_likelihood, observer_for, printed, record, textbook, varying

import obsynth
from obsynth import PreconditionError, SpecError, run_batch, simulate_time_varying
from obsynth.analysis.existence.recursive import residual_condition
from obsynth.analysis.time_varying import horizon_ranks
from obsynth.numerics.square_root_estimation import ParameterState, start_of, update
from obsynth.observers.recursive.sample import RawEstimate

SAMPLES = 40


def printed_with_two_outputs(**changes):
    return printed(C=np.eye(2), output_names=["y1", "y2"], Psi=np.zeros((2, 1)), **changes)


def rows_of(observer, y, u) -> list[RawEstimate]:
    running = observer.start()
    return [running.raw_step(y[k], u[k]) for k in range(len(y))]


@pytest.mark.parametrize("make", [varying, textbook, printed_with_two_outputs])
@pytest.mark.parametrize("forgetting", [0.6, 0.95])
def test_the_literal_form_has_the_values_of_the_printed_one(make, forgetting: float) -> None:
    plant = make()
    observer, (y, u) = observer_for(plant, adapt={"form": "literal", "forgetting": forgetting}), record(plant, SAMPLES)
    zero = np.zeros(plant.nq)
    state = PaperState(
        np.zeros(plant.nx), zero, zero, np.zeros((plant.nx, plant.nq)), np.eye(plant.nq), np.eye(plant.nx)
    )
    rows = rows_of(observer, y, u)
    for k in range(SAMPLES - 1):
        matrices = {name: plant.matrices[name].at(k + (name in ("E", "C"))) for name in plant.matrices}
        state = paper_step(
            state, matrices, observer.Q.at(k), observer.R.at(k), y=y[k + 1], u=u[k], forgetting=forgetting
        )
        row = rows[k + 1]
        corrected = state.x + state.Upsilon @ (state.theta - state.theta_before)
        scale = np.linalg.norm(state.S)
        np.testing.assert_allclose(row.parameters.theta, state.theta, rtol=0, atol=1e-9)
        np.testing.assert_allclose(row.x, corrected, rtol=0, atol=1e-9)
        S = np.linalg.inv(row.parameters.triangle.T @ row.parameters.triangle)
        np.testing.assert_allclose(S, state.S, rtol=0, atol=1e-9 * scale)


def test_a_wrong_order_has_other_values() -> None:
    """The acceptance above can fail: without omega_k, which still converges, the values differ."""
    plant = varying()
    y, u = record(plant, 6)
    zero = np.zeros(2)
    right = wrong = PaperState(np.zeros(3), zero, zero, np.zeros((3, 2)), np.eye(2), np.eye(3))
    Q, R = np.diag(np.linspace(0.1, 0.3, 3)), np.diag([0.2, 0.4])
    for k in range(5):
        matrices = {name: plant.matrices[name].at(k + (name in ("E", "C"))) for name in plant.matrices}
        right = paper_step(right, matrices, Q, R, y=y[k + 1], u=u[k], forgetting=0.95)
        wrong = paper_step(
            wrong._replace(theta_before=wrong.theta), matrices, Q, R, y=y[k + 1], u=u[k], forgetting=0.95
        )
    assert np.linalg.norm(right.theta - wrong.theta) > 1e-3


@pytest.mark.parametrize("make", [varying, textbook, printed])
def test_the_innovation_form_without_forgetting_is_the_augmented_filter(make) -> None:
    plant = make()
    y, u = record(plant, SAMPLES)
    ours = observer_for(plant, adapt={"forgetting": 1.0})
    augmented = observer_for(plant, adapt={"form": "random-walk"})
    for row, other in zip(rows_of(ours, y, u), rows_of(augmented, y, u), strict=True):
        np.testing.assert_allclose(row.parameters.theta, other.parameters.theta, rtol=0, atol=1e-10)
        np.testing.assert_allclose(row.x, other.x, rtol=0, atol=1e-10)
        spread, theirs = row.parameters.spread, other.parameters.spread
        np.testing.assert_allclose(spread @ spread.T, theirs @ theirs.T, rtol=0, atol=1e-11)
        np.testing.assert_allclose(row.factor @ row.factor.T, other.factor @ other.factor.T, rtol=0, atol=1e-10)
    exact, covariance = maximum_likelihood(ours, y, u, parameters=True)
    np.testing.assert_allclose(row.parameters.theta, exact[plant.nx :], rtol=0, atol=1e-9)
    np.testing.assert_allclose(spread @ spread.T, covariance[plant.nx :, plant.nx :], rtol=0, atol=1e-9)


def test_the_random_walk_is_the_textbook_augmented_filter() -> None:
    """E = I, no parameters in the outputs: x and theta stacked, the usual prediction and correction."""
    plant, walk = textbook(), 0.01
    observer = observer_for(plant, adapt={"form": "random-walk", "walk": [[walk]]})
    y, u = record(plant, SAMPLES)
    x, P = np.zeros(3), np.eye(3)
    for k, row in enumerate(rows_of(observer, y, u)[1:]):
        F = np.block([[plant.A.at(k), plant.Phi.at(k)], [np.zeros((1, 2)), np.eye(1)]])
        C = np.hstack([plant.C.at(k + 1), [[0.0]]])
        # The walk's first increment comes before the first step, so that theta(0) has the variance 1 + walk.
        P[2, 2] += walk
        x = F @ x + np.concatenate([plant.B.at(k) @ u[k], [0.0]])
        P = F @ P @ F.T
        P[:2, :2] += observer.Q.at(k)
        S = C @ P @ C.T + observer.R.at(k)
        gain = P @ C.T / S
        x, P = x + gain @ (y[k + 1] - C @ x), P - gain @ S @ gain.T
        np.testing.assert_allclose(np.concatenate([row.x, row.parameters.theta]), x, rtol=0, atol=1e-12)
        np.testing.assert_allclose(row.factor @ row.factor.T, P[:2, :2], rtol=0, atol=1e-12)
        assert (row.parameters.spread @ row.parameters.spread.T)[0, 0] == pytest.approx(P[2, 2], abs=1e-12)


@pytest.mark.one_in(6)
@pytest.mark.parametrize("form", ["innovation", "literal"])
@pytest.mark.parametrize("guard", ["none", "regularise", "directional"])
def test_the_stated_covariances_are_those_of_the_errors(form: str, guard: str) -> None:
    """Every source of noise by itself: the sum of the squared responses is the covariance, without any statistics."""
    plant = varying(B=np.eye(3))
    samples, adapt = 7, {"form": form, "guard": guard, "forgetting": 0.8}
    base = {"Q": np.diag([0.1, 0.2, 0.3]), "R": np.diag([0.2, 0.4])}
    silent, zero = np.zeros((samples, 2)), np.zeros((samples, 3))

    def errors(y, u, *, x=(0, 0, 0), theta=(0, 0)) -> np.ndarray:
        """Errors around the trajectory zero: the observer starts at x and theta, and the noise is its data."""
        adapted = {**adapt, "initial_parameters": np.array(theta, float)}
        observer = observer_for(plant, adapt=adapted, initial_state=np.array(x, float), **base)
        row = rows_of(observer, y, u)[-1]
        return np.concatenate([row.x, row.parameters.theta])

    responses = [errors(silent, zero, x=axis) for axis in np.eye(3)]
    responses += [errors(silent, zero, theta=axis) for axis in np.eye(2)]
    for k in range(samples - 1):
        for i, variance in enumerate(np.diag(base["Q"])):
            drive = zero.copy()
            drive[k, i] = np.sqrt(variance)
            responses.append(errors(silent, drive))
        for i, variance in enumerate(np.diag(base["R"])):
            noise = silent.copy()
            noise[k + 1, i] = np.sqrt(variance)
            responses.append(errors(noise, zero))
    exact = np.array(responses).T @ np.array(responses)
    row = rows_of(observer_for(plant, adapt=adapt, **base), silent, zero)[-1]
    spread = row.parameters.spread
    np.testing.assert_allclose(spread @ spread.T, exact[3:, 3:], rtol=0, atol=1e-12)
    if form == "innovation":
        np.testing.assert_allclose(row.factor @ row.factor.T, exact[:3, :3], rtol=0, atol=1e-12)
    S = np.linalg.inv(row.parameters.triangle.T @ row.parameters.triangle)
    assert np.linalg.norm(S - exact[3:, 3:]) > 0.1 * np.linalg.norm(exact[3:, 3:])


def test_without_noise_the_error_is_what_forgetting_leaves() -> None:
    """theta_err(k) = lambda^k S_k S_0^-1 theta_err(0), when the state starts without error."""
    plant, true = varying(B=np.eye(3)), np.array([0.7, -0.4])
    observer = observer_for(plant, adapt={"form": "literal", "forgetting": 0.9})
    # On the trajectory zero the parameters are seen as inputs and in the outputs.
    samples = 20
    u = np.array([-plant.Phi.at(k) @ true for k in range(samples)])
    y = np.array([np.zeros(2), *(plant.Psi.at(k) @ true for k in range(samples - 1))])
    # x = 0 solves E x+ = A x + u + Phi theta: the state is known exactly.
    rows = rows_of(observer, y, u)
    for k, row in enumerate(rows):
        S = np.linalg.inv(row.parameters.triangle.T @ row.parameters.triangle)
        np.testing.assert_allclose(row.parameters.theta - true, 0.9**k * S @ -true, rtol=0, atol=1e-12)
    assert np.linalg.norm(rows[-1].parameters.theta - true) < 0.05


class TestLearning:
    def test_the_printed_example_never_learns_in_the_literal_form(self) -> None:
        """rank E + ny - nx = 0: y - C xhat is zero, whatever the noise and the parameters."""
        plant = printed()
        observer, (y, u) = observer_for(plant, adapt={"form": "literal"}), record(plant, 30)
        found = observer.run(y, u)
        assert np.abs(found.parameters).max() < 1e-12
        np.testing.assert_allclose(found.states[1:, 1], y[1:, 0], rtol=0, atol=1e-13)
        learning = observer_for(plant, adapt={}).run(y, u)
        assert np.abs(learning.parameters[-1]).max() > 0.1

    def test_the_refusal(self) -> None:
        with pytest.raises(PreconditionError, match=r"uses only rank E \+ ny - nx = 0 residual directions") as caught:
            residual_condition(horizon_ranks(printed(horizon=50))).require()
        assert "'innovation'" in str(caught.value)
        assert caught.value.condition == "residual directions"
        residual_condition(horizon_ranks(varying(horizon=50))).require()

    def test_a_singular_r_is_refused_by_the_literal_form_only(self) -> None:
        plant = varying()
        data = record(plant, 5)
        with pytest.raises(PreconditionError, match="divides by R, which is singular"):
            observer_for(plant, R=np.diag([0.1, 0]), adapt={"form": "literal"}).run(*data)
        assert np.isfinite(observer_for(plant, R=np.diag([0.1, 0]), adapt={}).run(*data).parameters).all()


class TestWindUp:
    """Excitation that ends: what S does then."""

    STEPS = 2000

    def spread_without_excitation(self, guard: str) -> np.ndarray:
        plant = varying(Phi=[["exp(-k / 10)", 0], [0, "exp(-k / 10)"], [0, 0]], Psi=np.zeros((2, 2)))
        observer = observer_for(plant, adapt={"guard": guard, "forgetting": 0.95})
        y, u = record(plant, self.STEPS)
        row = rows_of(observer, y, u)[-1]
        assert np.isfinite(row.parameters.theta).all()
        return np.linalg.svd(row.parameters.triangle, compute_uv=False)

    @pytest.mark.long
    def test_unguarded_it_grows_without_bound(self) -> None:
        assert self.spread_without_excitation("none").min() < 1e-20

    @pytest.mark.long
    def test_the_guards_bound_it(self) -> None:
        assert self.spread_without_excitation("regularise").min() > 0.99
        assert self.spread_without_excitation("directional").min() > 0.99

    def test_directional_forgetting_keeps_what_is_not_excited(self) -> None:
        """Only theta1 is excited: what is known about theta2 stays, and theta1 is still tracked."""
        state = start_of(np.zeros(2), np.eye(2))
        both, one = np.array([[1.0, 0.3], [0.2, 1.0]]), np.array([[1.0, 0.0]])
        for _ in range(50):
            state, _ = update(state, np.zeros(2), both, forgetting=0.9, directional=True)
        known = state.triangle.T @ state.triangle
        for _ in range(400):
            state, _ = update(state, np.zeros(1), one, forgetting=0.9, directional=True)
        M = state.triangle.T @ state.triangle
        # The information that theta1 has no part in is untouched; on theta1 alone it is that of ten samples.
        np.testing.assert_allclose(M[:, 1], known[:, 1], rtol=1e-12)
        assert 1.0 / np.linalg.inv(M)[0, 0] == pytest.approx(10.0, rel=1e-6)

    def test_the_triangle_stays_definite_where_the_matrix_does_not(self) -> None:
        """One of two directions is excited: S grows as lambda^-k in the other, to the end of what doubles hold."""
        rng = np.random.default_rng(0)
        state, S = start_of(np.zeros(2), np.eye(2)), np.eye(2)
        direction = np.array([[0.6, 0.8]])
        lost = 0
        for _ in range(1200):
            G = direction * rng.uniform(0.5, 1.5)
            state, _ = update(state, rng.standard_normal(1), G, forgetting=0.95)
            gain = S @ G.T / (0.95 + G @ S @ G.T)
            S = (S - gain @ G @ S) / 0.95
            lost += int(np.linalg.eigvalsh(0.5 * (S + S.T))[0] <= 0.0)
            assert (np.abs(np.diag(state.triangle)) > 0.0).all()
        assert lost > 100


def test_excitation_is_the_least_information_in_the_window() -> None:
    plant = varying()
    observer, (y, u) = observer_for(plant, adapt={"window": 5}), record(plant, 12)
    found = observer.run(y, u)
    for k in range(12):
        blocks = found.regressors[max(k - 4, 0) : k + 1]
        used = [block[np.isfinite(block).all(axis=1)] for block in blocks]
        total = sum(block.T @ block for block in used)
        assert found.excitation[k] == pytest.approx(0.0 if k < 4 else np.linalg.eigvalsh(total)[0], abs=1e-12)
    assert found.excitation[-1] > 1e-3


def test_innovations_minus_regressors_are_what_the_filter_with_known_parameters_gives() -> None:
    plant, true = varying(), np.array([0.5, -1.0])
    y, u = record(plant, 10)
    bare = observer_for(plant, adapt={}).run(y, u)
    known = varying(B=np.eye(3))
    driven = np.array([plant.B.at(k) @ u[k] + plant.Phi.at(k) @ true for k in range(10)])
    shifted = y - np.array([np.zeros(2), *(plant.Psi.at(k) @ true for k in range(9))])
    other = observer_for(known.replace(Psi=np.zeros((2, 2)))).run(shifted, driven)
    for k in range(1, 10):
        whitened = bare.innovations[k] - bare.regressors[k] @ true
        np.testing.assert_allclose(whitened, other.innovations[k], rtol=0, atol=1e-12)


def test_a_scalar_parameter_takes_the_same_way_as_several() -> None:
    rng = np.random.default_rng(1)
    one = ParameterState(np.array([0.3]), np.array([[2.0]]), np.array([[0.5]]))
    two = ParameterState(np.array([0.3, 0.0]), np.diag([2.0, 1.0]), np.diag([0.5, 1.0]))
    for _ in range(5):
        G, v = rng.standard_normal((3, 1)), rng.standard_normal(3)
        for directional, regular in ((False, None), (False, 1.5), (True, None)):
            small = None if regular is None else np.array([[regular]])
            big = None if regular is None else np.diag([regular, 1.0])
            first, _ = update(one, v, G, forgetting=0.9, regular=small, directional=directional)
            wide = np.hstack([G, np.zeros((3, 1))])
            second, _ = update(two, v, wide, forgetting=0.9, regular=big, directional=directional)
            assert first.theta[0] == pytest.approx(second.theta[0], abs=1e-14)
            assert abs(first.triangle[0, 0]) == pytest.approx(abs(second.triangle[0, 0]), abs=1e-14)
            assert abs(first.spread[0, 0]) == pytest.approx(np.linalg.norm(second.spread[0]), abs=1e-14)


class TestReset:
    """Detect and reset: a jump is followed at once, and nothing happens without one."""

    SAMPLES, CHANGE = 300, 150

    def errors(self, seed: int, *, jump: float, **adapt: float) -> tuple[np.ndarray, int]:
        plant = varying(horizon=self.SAMPLES)
        rng = np.random.default_rng(seed)
        theta = np.zeros((self.SAMPLES, 2))
        theta[self.CHANGE :, 1] = jump
        y = simulate_time_varying(
            plant, samples=self.SAMPLES, parameters=theta,
            equation_noise=rng.standard_normal((self.SAMPLES, 3)) * np.sqrt([0.1, 0.2, 0.3]),
            output_noise=rng.standard_normal((self.SAMPLES - 1, 2)) * np.sqrt([0.2, 0.4]),
        ).outputs  # fmt: skip
        running = observer_for(plant, adapt={"forgetting": 0.995, "guard": "regularise", **adapt}).start()
        found = np.array([running.raw_step(row, np.zeros(1)).parameters.theta for row in y])
        return found - theta, running.state.resets

    def test_a_jump_is_followed_at_once(self, share: Callable[..., Any]) -> None:
        after = slice(self.CHANGE + 15, self.CHANGE + 60)
        for seed in share(range(4), 2):
            plain, none = self.errors(seed, jump=4.0)
            reset, count = self.errors(seed, jump=4.0, reset=1e-6)
            assert (none, count) == (0, 1)
            assert np.sqrt(np.mean(reset[after] ** 2)) < 0.3 * np.sqrt(np.mean(plain[after] ** 2))

    def test_nothing_happens_without_a_jump(self, share: Callable[..., Any]) -> None:
        for seed in share(range(10)):
            plain, _ = self.errors(seed, jump=0.0)
            reset, count = self.errors(seed, jump=0.0, reset=1e-6)
            assert count == 0
            np.testing.assert_array_equal(plain, reset)

    def test_refusals(self) -> None:
        with pytest.raises(SpecError, match="reset is 1"):
            observer_for(varying(), adapt={"reset": 1.0})
        with pytest.raises(SpecError, match="reset is for the forms with a forgetting factor"):
            observer_for(varying(), adapt={"form": "random-walk", "reset": 0.01})
        with pytest.raises(SpecError, match="run them one by one"):
            run_batch(observer_for(varying(), adapt={"reset": 0.01}), np.zeros((2, 5, 2)), np.zeros((5, 1)))


def test_a_batch_whose_inputs_are_of_another_number_of_trials_is_refused() -> None:
    """It used to end in an error of numpy, which names no argument."""
    with pytest.raises(SpecError, match=r"u has shape \(3, 5, 1\), but \(5, 1\) or \(2, 5, 1\) is needed") as found:
        run_batch(observer_for(varying()), np.zeros((2, 5, 2)), np.zeros((3, 5, 1)))
    assert found.value.path == "u"


def test_the_random_walk_has_no_regressors_to_report_an_excitation_of() -> None:
    """Zero would say that nothing is excited."""
    plant = varying()
    found = observer_for(plant, adapt={"form": "random-walk", "walk": 1e-3 * np.eye(plant.nq)}).run(*record(plant, 9))
    assert np.isnan(found.excitation).all()


@pytest.mark.long
def test_units_do_not_decide_whether_there_is_an_observer() -> None:
    """Without a stated noise, the identity in given units may keep errors for as long as anybody looks."""
    sizes, shown = np.array([1e0, 1e-3, 1e-5, 1e3]), np.array([5e2, 1e7])
    e = np.diag([0.001, 0.1, 0.01, 1.0])
    a = [[0.00025, -0.5, -25.0, 2.5e-07], [0, -0.05, -2.5, -2.5e-08], [0, 0, 0.0075, 2.5e-11], [0, 0, 0, -1.0]]
    c, faults = (
        np.array([[-0.002, -2.0, -100.0, 2e-06], [-1e-07, 0.0002, 0.02, 2e-10]]),
        [[1e-5], [2e-6], [-1e-9], [0.0]],
    )
    given = obsynth.DescriptorSystem(e, a, C=c, Bf=faults, dt=0.5)
    rows = np.array([[3e2], [2e3], [1e6], [6e-5]])
    natural = obsynth.DescriptorSystem(
        rows * e * sizes, rows * a * sizes, C=shown[:, None] * c * sizes, Bf=rows * faults * 1e2, dt=0.5
    )
    design = obsynth.adaptive_observer(given)
    assert design.report.passed
    assert any("in units in which the plant is near one" in note for note in design.notes)
    assert not any("in units in which" in note for note in obsynth.adaptive_observer(natural).notes)
    kept = obsynth.adaptive_observer(given, Q=design.options["Q"], R=design.options["R"]).options
    np.testing.assert_array_equal(kept["Q"], design.options["Q"])


@pytest.mark.one_in(2)
@pytest.mark.parametrize("seed", range(6))
def test_a_parameter_may_be_read_where_no_state_is(seed: int) -> None:
    # Its regressor is exactly zero: the least-squares problem leaves the rounding of that sensor's own datum.
    rng = np.random.default_rng([46, seed])
    n = 1 + seed % 3
    units = 10.0 ** rng.integers(-4, 5, n + 1)
    read_alone = np.zeros((n + 1, 2))
    read_alone[-1, 1] = rng.standard_normal()
    plant = obsynth.DescriptorSystem(
        A=0.3 * rng.standard_normal((n, n)),
        C=units[:, None] * np.vstack([rng.standard_normal((n, n)), np.zeros(n)]),
        Bf=np.hstack([rng.standard_normal((n, 1)), np.zeros((n, 1))]),
        Df=units[:, None] * read_alone,
        Bw=np.eye(n, 2 * n + 1),
        Dw=np.hstack([np.zeros((n + 1, n)), np.diag(0.1 * units)]),
        dt=1.0,
    )
    assert obsynth.adaptive_observer(plant).report.passed
