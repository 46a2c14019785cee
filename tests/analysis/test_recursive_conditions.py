"""Existence of recursive observers: which mode, which states, which parameters stand in the way."""

from __future__ import annotations

import numpy as np
import pytest
from time_varying_plants import varying

import obsynth
from obsynth import DescriptorSystem, PreconditionError, TimeVaryingDescriptorSystem
from obsynth.analysis.existence.recursive import recursive_conditions
from obsynth.methods.designing import check

NOISE = {"Q": 1.0, "R": 1.0}


def sampled(A, C, E=None, **fields) -> DescriptorSystem:
    return DescriptorSystem(E, A, C=C, dt=1.0, **fields)


def refusal(plant, method: str = "descriptor-kalman", **options) -> PreconditionError:
    with pytest.raises(PreconditionError) as caught:
        obsynth.design(plant, method, **{**NOISE, **options})
    return caught.value


class TestDetectability:
    @pytest.mark.parametrize("mode", [1.0, -1.0, 2.0])
    def test_mode_and_state_are_named(self, mode: float) -> None:
        error = refusal(sampled(np.diag([0.5, mode]), [[1.0, 0]], state_names=["seen", "hidden"]))
        assert (error.condition, error.signals) == ("detectability", ("hidden",))
        assert error.mode == pytest.approx(mode)
        assert f"the mode z = {mode:g} of the state 'hidden' is unobservable" in str(error)

    def test_a_pair_and_further_modes(self) -> None:
        A = np.zeros((4, 4))
        A[0, 0], A[1, 2], A[2, 1], A[3, 3] = 0.5, 1.1, -1.1, 1.0
        error = refusal(sampled(A, [[1.0, 0, 0, 0]]))
        assert "z = 0 +- 1.1j of the states 'x2', 'x3'" in str(error)
        assert "(as the modes 1)" in str(error)

    def test_of_a_descriptor_plant(self) -> None:
        """x2 = x1 + x3 is algebraic; x1 integrates unseen."""
        E, A = np.diag([1.0, 0, 1]), [[1.0, 0, 0], [1, -1, 1], [0, 0, 0.5]]
        error = refusal(sampled(A, [[1.0, -1, 0]], E=E))
        assert error.mode == pytest.approx(1.0)
        assert obsynth.descriptor_kalman(sampled(A, [[0.0, 1, 0]], E=E), **NOISE).report.passed

    def test_modes_that_decay_may_stay_hidden(self) -> None:
        assert obsynth.descriptor_kalman(sampled(np.diag([0.5, 0.9]), [[1.0, 0]]), **NOISE).report.passed

    def test_constant_matrices_are_enough(self) -> None:
        plant = TimeVaryingDescriptorSystem(None, np.diag([0.5, 2]), [["k"], [0]], [[1, 0]], dt=1.0, horizon=9)
        assert refusal(plant).condition == "detectability"

    def test_of_a_plant_that_changes_the_errors_tell(self) -> None:
        for growth, condition in (("1 + 0 * k", "contraction"), ("2 + 0 * k", "bounded errors")):
            plant = TimeVaryingDescriptorSystem(None, [[0.5, 0], [0, growth]], C=[[1, 0]], dt=1.0)
            error = refusal(plant)
            assert (error.condition, error.signals) == (condition, ("x2",))
        assert "at k = 332" in str(error)

    def test_a_run_that_outgrows_double_precision_names_its_sample(self) -> None:
        late = [[0.5, 0], [0, "0.9 + 3 * step(k - 1100)"]]
        observer = obsynth.descriptor_kalman(
            TimeVaryingDescriptorSystem(None, late, C=[[1, 0]], dt=1.0), **NOISE
        ).observer  # fmt: skip
        with pytest.raises(PreconditionError, match=r"outgrow double precision at k = 12[0-9][0-9]: .*: 'x2'"):
            observer.run(np.zeros((1400, 1)))

    @pytest.mark.long
    def test_nothing_forgets_what_is_claimed_to_be_known(self) -> None:
        plant = sampled(np.diag([0.5, 2]), np.eye(2))
        error = refusal(plant, Q=0.0, initial_covariance=np.diag([1.0, 0]))
        assert (error.condition, error.signals) == ("contraction", ("x2",))
        assert obsynth.descriptor_kalman(plant, Q=0.0, R=1.0).report.passed


class TestRank:
    E, A = np.diag([1.0, 0, 0]), np.array([[0.9, 0.1, 0.2], [1, 0.5, -1], [0.3, 1, 1]])

    @pytest.mark.long
    def test_early_constraints_count(self) -> None:
        plant = sampled(self.A, [[1.0, 0, 0]], E=self.E, Bf=[[1.0], [0], [0]])
        error = refusal(plant)
        assert (error.condition, error.signals) == ("rank [E; C]", ("x2", "x3"))
        for part in ("do not determine the states 'x2', 'x3'", "early_constraints: true", "eliminate_algebraic_states"):
            assert part in str(error)
        assert ".." not in str(error)
        assert obsynth.descriptor_kalman(plant, **NOISE, early_constraints=True).report.passed
        assert obsynth.adaptive_observer(plant, **NOISE, early_constraints=True, form="literal").report.passed
        found = check(plant, {"descriptor-kalman": {"early_constraints": True}})
        assert found["descriptor-kalman"].passed
        # Without a Q of the states as written the algebraic states are eliminated.
        assert found["adaptive-observer"].passed

    def test_early_constraints_that_repeat_each_other(self) -> None:
        A = self.A.copy()
        A[2] = A[1]
        error = refusal(sampled(A, [[1.0, 0, 0]], E=self.E), early_constraints=True)
        assert error.condition == "rank [E; C; algebraic rows of A]"
        assert error.signals == ("x2", "x3")

    def test_only_what_helps_is_offered(self) -> None:
        error = refusal(sampled(0.5 * np.eye(2), [[1.0, 0]], E=[[1.0, 0], [1, 0]]))
        assert error.signals == ("x2",)
        assert "early_constraints" not in str(error)
        assert "eliminate" not in str(error)


class TestParameters:
    def plant(self, A=((0.5, 0.0), (0.0, 0.7)), **fields) -> DescriptorSystem:
        return sampled(np.array(A), np.eye(2), **fields)

    def test_two_that_act_alike(self) -> None:
        error = refusal(self.plant(Bf=[[1, 2], [0, 0]], fault_names=["a", "b"]), "adaptive-observer")
        assert (error.condition, error.signals) == ("identifiable parameters", ("a", "b"))
        assert "'a', 'b' cannot be distinguished from each other: in the ratio 1 : -0.5" in str(error)

    def test_a_bias_of_a_sensor_of_an_integrator(self) -> None:
        error = refusal(self.plant(np.diag([1.0, 0.7]), Df=[[1], [0]], fault_names=["bias"]), "adaptive-observer")
        assert error.signals == ("bias",)
        assert "the parameter 'bias' cannot be distinguished from constant shifts of 'x1'" in str(error)
        assert obsynth.adaptive_observer(self.plant(Df=[[1], [0]]), **NOISE).report.passed

    def test_one_that_enters_nowhere(self) -> None:
        for form in ({}, {"form": "random-walk", "random_walk": 1.0}):
            error = refusal(self.plant(Bf=[[0], [0]]), "adaptive-observer", **form)
            assert "the parameter 'f1' has no effect on the outputs" in str(error)

    @pytest.mark.long
    def test_rank_in_a_random_plant_with_known_kernel(self) -> None:
        """Phi and Psi are chosen such that one combination, with one constant state, vanishes; then it is broken."""
        rng = np.random.default_rng(5)
        A = 0.4 * rng.standard_normal((3, 3))
        C, x, theta = rng.standard_normal((2, 3)), rng.standard_normal(3), np.array([1.0, -2.0, 0.5])
        Phi, Psi = rng.standard_normal((3, 3)), rng.standard_normal((2, 3))
        Phi[:, 2] = -((A - np.eye(3)) @ x + Phi[:, :2] @ theta[:2]) / theta[2]
        Psi[:, 2] = -(C @ x + Psi[:, :2] @ theta[:2]) / theta[2]
        error = refusal(sampled(A, C, Bf=Phi, Df=Psi), "adaptive-observer")
        assert error.signals == ("f1", "f2", "f3")
        assert "in the ratio -0.5 : 1 : -0.25 together with constant shifts of 'x1', 'x2', 'x3'" in str(error)
        # Two outputs hold two constants at rest, not three: any third one is refused, and two are not.
        assert obsynth.adaptive_observer(sampled(A, C, Bf=Phi[:, :2], Df=Psi[:, :2]), **NOISE).report.passed

    def test_of_plants_that_change(self) -> None:
        def plant(Phi, C=((1.0, 0.0), (0.0, 1.0))) -> TimeVaryingDescriptorSystem:
            A = [["0.5 + 0.1 * sin(k)", 0], [0, 0.7]]
            return TimeVaryingDescriptorSystem(None, A, C=C, Phi=Phi, dt=1.0, horizon=100)

        error = refusal(plant([["sin(k)", "2 * sin(k)"], [1, 2]]), "adaptive-observer")
        assert error.signals == ("theta1", "theta2")
        assert "ratio 1 : -0.5" in str(error)
        assert refusal(plant([[0, 1], [1, 1]], C=[[1, 0]]), "adaptive-observer").signals == ("theta1",)
        assert obsynth.adaptive_observer(plant([["sin(k)", "2 * sin(k)"], [1, 1]]), **NOISE).report.passed
        # One output is enough where the regressors move; units do not decide.
        tiny = plant([["1e-12 * sin(k)", 1e6], [0, 0]], C=[[1e-9, 0]])
        assert obsynth.adaptive_observer(tiny, **NOISE).report.passed
        assert refusal(plant([["1e-12 * sin(k)", "1e6 * sin(k)"], [0, 0]], C=[[1e-9, 0]]), "adaptive-observer").signals

    def test_a_state_that_grows_unseen_does_not_hide_the_traces(self) -> None:
        plant = TimeVaryingDescriptorSystem(
            None, [[0.5, 0], [0, "2 + 0 * k"]], C=[[1, 0]], Phi=[[1], [1]], dt=1.0, horizon=400
        )
        rows = {row.name: row for row in recursive_conditions(plant, parameters=True)}
        assert rows["identifiable parameters"].holds

    def test_the_early_equation_tells_too(self) -> None:
        """What acts on the last algebraic equation alone shows early, and late as well."""
        plant = varying(horizon=20, Phi=[[0, 0], [0, 0], [1, 0]], Psi=[[0, 1], [0, 0]])
        for early in (False, True):
            rows = {row.name: row for row in recursive_conditions(plant, parameters=True, early=early)}
            assert rows["identifiable parameters"].holds


@pytest.mark.long
def test_errors_that_decay_beyond_the_horizon_are_unclear_not_impossible() -> None:
    # Every state shows, exactly; as identities, Q and R hardly weigh x4 in these units.
    plant = obsynth.DescriptorSystem(
        np.diag([0.001, 0.1, 0.01, 1.0]),
        [[0.00025, -0.5, -25.0, 2.5e-07], [0, -0.05, -2.5, -2.5e-08], [0, 0, 0.0075, 2.5e-11], [0, 0, 0, -1.0]],
        C=[[-0.002, -2.0, -100.0, 2e-06], [-1e-07, 0.0002, 0.02, 2e-10]],
        Bf=[[1e-05], [2e-06], [-1e-09], [0.0]], dt=0.5,
    )  # fmt: skip
    with pytest.raises(obsynth.PreconditionError, match=r"^Unclear: .* State Q and R in the units of") as caught:
        obsynth.adaptive_observer(
            plant, Q=np.eye(4), R=np.eye(2), initial_covariance=np.eye(4), initial_parameter_covariance=np.eye(1)
        )
    assert (caught.value.unclear, caught.value.signals) == (True, ("x4",))
    # Weighed in its own units it is designed.
    states, outputs = np.array([1.0, 1e-3, 1e-5, 1e3]), np.array([5e2, 1e7])
    weighed = obsynth.adaptive_observer(
        plant, Q=np.eye(4), R=np.diag(outputs**-2.0), initial_covariance=np.diag(states**2)
    )
    assert weighed.report.passed


@pytest.mark.parametrize("seed", [616105, 616156, 677787])
def test_a_filter_and_its_checks_do_not_hang_on_units(seed: int) -> None:
    # Of a plant in other units the checks took for zero what is small in these, and rows of a step in thousands cost
    # those in millionths their digits: what was found was refused (12 of 480 filters).
    rng = np.random.default_rng([91, seed])
    n = int(rng.integers(2, 6))
    a = np.round(0.5 * rng.normal(size=(n, n)), 2)
    c, b = np.round(rng.normal(size=(2, n)), 2), np.round(rng.normal(size=(n, 1)), 1)
    noise = np.hstack([np.diag(np.round(10.0 ** rng.uniform(-1, 0, n), 2)), np.zeros((n, 2))])
    shown = np.hstack([np.zeros((2, n)), 0.1 * np.eye(2)])
    rows, states, outputs = (np.exp2(rng.integers(-20, 21, count).astype(float)) for count in (n, n, 2))
    plain = obsynth.DescriptorSystem(np.eye(n), a, C=c, Bf=b, Bw=noise, Dw=shown, dt=0.1)
    other = obsynth.DescriptorSystem(
        np.diag(rows * states), rows[:, None] * a * states, C=outputs[:, None] * c * states, Bf=rows[:, None] * b,
        Bw=rows[:, None] * noise, Dw=outputs[:, None] * shown, dt=0.1,
    )  # fmt: skip
    first = obsynth.descriptor_kalman(plain, initial_covariance=np.eye(n))
    second = obsynth.descriptor_kalman(other, initial_covariance=np.diag(states**-2.0))
    assert second.report.passed
    y = rng.normal(size=(30, 2))
    found = [one.observer.run(record).states for one, record in ((first, y), (second, y * outputs))]
    np.testing.assert_allclose(found[1] * states, found[0], rtol=1e-9, atol=1e-9 * np.max(np.abs(found[0])))
