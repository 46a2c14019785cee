"""Share Pasand, Aliyari, Taghirad: what is printed, what it can be, and what we ship."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from exact_runs import ONE, RAMP, Together, ramp_and_sine, sine

import obsynth
from obsynth.conditions.augmented_plant import paper_decoupling
from obsynth.numerics.eigenstructure import place
from obsynth.numerics.invariant_zeros import zeros_of_system
from obsynth.numerics.spectra import spectrum_error
from obsynth.simulation.linear import simulate_plant
from obsynth.specs.documents import read_yaml
from obsynth.specs.loader import load_spec

FOLDER = Path(__file__).parents[2] / "designs" / "sharepasand"
EXPECTED = read_yaml(FOLDER / "expected.yaml")
SPEC = load_spec(FOLDER / "spec.yaml")
PLANT = SPEC.plant
GIVEN, PRINTED, TRUTH = EXPECTED["given"], EXPECTED["printed"], EXPECTED["truth"]
FIVE = [-2, -3, -4, -5, -6]
#: Disturbance 0.5 t + 2 sin 3t, and the state of its generator at the start.
NOISY, LOUD = ramp_and_sine(0.5, 2.0, 3.0), [0.0, 1.0, 0.0, 1.0]
PAPER = {name: GIVEN[name] for name in ("E_sharp", "C_sharp", "G")}


def array(group: dict, name: str) -> np.ndarray:
    return np.array(group[name], dtype=float)


@pytest.fixture(scope="module")
def design() -> obsynth.ObserverDesign:
    return obsynth.design(PLANT, SPEC.method, name=SPEC.name, **SPEC.options)


@pytest.fixture(scope="module")
def printed() -> obsynth.ObserverDesign:
    return obsynth.design_from_gains(
        PLANT, "ui-pi-observer",
        U=array(PRINTED, "U"), D=array(PRINTED, "D"), K=array(TRUTH, "K"), F=array(TRUTH, "F"),
        fault_model="ramp",
    )  # fmt: skip


class TestPrinted:
    """Level (a): the printed matrices against the paper's own identities."""

    def test_the_papers_construction_gives_its_own_matrices_exactly(self) -> None:
        found = paper_decoupling(
            PLANT, e_sharp=array(GIVEN, "E_sharp"), c_sharp=array(GIVEN, "C_sharp"), g=array(GIVEN, "G")
        )
        for name, matrix in zip(("L", "U", "D"), found, strict=True):
            np.testing.assert_array_equal(matrix, array(PRINTED, name), err_msg=name)

    def test_identities(self) -> None:
        u, d, a_hat = (array(PRINTED, name) for name in ("U", "D", "Ahat"))
        np.testing.assert_array_equal(u @ PLANT.Bd, np.zeros((3, 1)))
        np.testing.assert_array_equal(u @ PLANT.E + d @ PLANT.C, np.eye(3))
        np.testing.assert_array_equal(u @ PLANT.Bf, array(PRINTED, "Hhat"))
        np.testing.assert_array_equal(u @ PLANT.B, array(PRINTED, "Jhat"))
        residual = a_hat @ u @ PLANT.E + array(PRINTED, "Bhat") @ PLANT.C - u @ PLANT.A
        # Bhat(2, 1) is printed to three decimals of 17.4885.
        assert np.max(np.abs(residual)) == pytest.approx(0.0005, abs=1e-12)

    def test_as_printed_it_is_no_observer(self) -> None:
        a_hat, b_hat = array(PRINTED, "Ahat_as_printed"), array(PRINTED, "Bhat_as_printed")
        residual = a_hat @ array(PRINTED, "U") @ PLANT.E + b_hat @ PLANT.C - array(PRINTED, "U") @ PLANT.A
        assert np.max(np.abs(residual)) == pytest.approx(TRUTH["Bhat_residual_as_printed"], abs=0.01)

    def test_the_recovered_gain(self) -> None:
        u, d, k = array(PRINTED, "U"), array(PRINTED, "D"), array(TRUTH, "K")
        a_hat = u @ PLANT.A - k @ PLANT.C
        np.testing.assert_allclose(a_hat, array(PRINTED, "Ahat"), atol=1e-12)
        b_hat = a_hat @ d + k
        np.testing.assert_allclose(b_hat, array(PRINTED, "Bhat"), atol=0.5001e-3)
        assert b_hat[1, 0] == pytest.approx(TRUTH["Bhat_21_of_Ahat"], abs=1e-9)
        np.testing.assert_allclose(np.sort(np.linalg.eigvals(a_hat).real), TRUTH["eigenvalues_of_Ahat"], atol=5e-5)

    def test_with_a_stabilising_f_the_printed_matrices_pass(self, printed: obsynth.ObserverDesign) -> None:
        poles = np.sort(np.linalg.eigvals(printed.observer.Az).real)
        np.testing.assert_allclose(poles, TRUTH["F_poles"], atol=2e-3)
        assert printed.report.passed
        np.testing.assert_array_equal(printed.gains["Hhat"], array(PRINTED, "Hhat"))

    def test_printed_k_cannot_be_fast_whatever_f(self) -> None:
        """Two invariants of the characteristic polynomial hold for every F: sum of the poles, and its value at 1/2."""
        rng = np.random.default_rng(3)
        for size in (1.0, 1e2, 1e4):
            found = obsynth.design_from_gains(
                PLANT, "ui-pi-observer",
                U=PRINTED["U"], D=PRINTED["D"], K=TRUTH["K"], F=size * rng.standard_normal((2, 2)),
                fault_model="ramp",
            )  # fmt: skip
            a = found.observer.Az
            assert np.trace(a) == pytest.approx(TRUTH["invariant_sum_with_printed_K"], abs=1e-9)
            value = np.linalg.det(0.5 * np.eye(5) - a)
            assert value == pytest.approx(TRUTH["invariant_p_at_zero"], rel=1e-4)

    def test_the_plant(self) -> None:
        structure = obsynth.analyse_structure(PLANT)
        assert (structure.regular, structure.index, structure.stable) == (True, 1, False)
        found = np.sort(structure.finite_eigenvalues.real)
        np.testing.assert_allclose(found, TRUTH["plant_eigenvalues"], rtol=1e-12)
        inputs = np.hstack([PLANT.Bf, PLANT.Bd])
        (zero,) = zeros_of_system(PLANT.E, PLANT.A, inputs, PLANT.C, dt=1.0)[1]
        assert zero.value == pytest.approx(TRUTH["zero"], abs=1e-12)


class TestFalseTheorems:
    """The hypotheses of the paper hold, its conclusion does not; our conditions refuse, and name who hides whom."""

    def refused(self, plant: obsynth.DescriptorSystem, model: object) -> obsynth.PreconditionError:
        with pytest.raises(obsynth.PreconditionError) as caught:
            obsynth.ui_pi_observer(plant, fault_model=model)
        return caught.value

    def test_theorem_1(self) -> None:
        error = self.refused(PLANT.replace(Bf=[[0], [0], [1]]), "ramp")
        assert (error.mode, error.signals) == (0.0, ("fault",))

    def test_theorem_1_for_a_normal_plant(self) -> None:
        plant = obsynth.DescriptorSystem(None, [[0, 1], [-1, -1]], C=[[0, 1]], Bf=[[0], [1]])
        assert self.refused(plant, "step").mode == 0.0

    def test_theorem_2(self) -> None:
        error = self.refused(PLANT.replace(Bf=PLANT.Bd), "step")
        assert (error.mode, error.signals) == (0.0, ("fault", "disturbance"))

    def test_theorem_2_at_the_eigenvalue_of_the_model(self) -> None:
        error = self.refused(PLANT, {"exponential": 0.5})
        assert (error.mode, error.signals) == (0.5, ("fault", "disturbance"))
        assert obsynth.ui_pi_observer(PLANT, fault_model={"exponential": 0.49}).report.passed

    def test_lemma_6_with_the_moore_penrose_inverse(self) -> None:
        inverse = np.linalg.pinv(np.vstack([PLANT.E, PLANT.C]))
        with pytest.raises(obsynth.PreconditionError) as caught:
            obsynth.ui_pi_observer(
                PLANT, fault_model="ramp", E_sharp=inverse[:, :3], C_sharp=inverse[:, 3:], G=GIVEN["G"]
            )
        assert (caught.value.condition, caught.value.mode) == ("fixed modes", pytest.approx(0.0, abs=1e-9))

    def test_the_first_condition_of_lemma_4_depends_on_the_choice(self) -> None:
        with pytest.raises(obsynth.SpecError, match="choose another E_sharp"):
            obsynth.ui_pi_observer(
                PLANT, E_sharp=[[0, 0, 0], [0, 0, 0], [0, 1, 0]], C_sharp=[[1, 0], [0, 1], [0, 0]], G=np.zeros((3, 2))
            )


class TestShipped:
    def test_the_design_passes(self, design: obsynth.ObserverDesign) -> None:
        assert design.report.passed
        assert obsynth.verify(design).passed
        for name in ("U", "D"):
            np.testing.assert_array_equal(design.gains[name], array(PRINTED, name))
        assert design.report["noise amplification"].value == pytest.approx(TRUTH["least_gain"]["noise"], rel=0.01)
        assert design.report["stability"].kind == "proved"

    def test_the_pair_and_its_least_gain(self) -> None:
        pair, outputs = array(TRUTH, "UaAa"), np.eye(2, 5)
        least, far = place(pair, outputs, [complex(pole) for pole in FIVE], objective="gain")
        best, near = place(pair, outputs, [complex(pole) for pole in FIVE], objective="conditioning")
        assert np.linalg.norm(least) == pytest.approx(TRUTH["least_gain"]["norm_K"], rel=0.01)
        assert np.linalg.norm(best) == pytest.approx(TRUTH["best_conditioned"]["norm_K"], rel=0.01)
        assert near < 2.24e4 < far
        for gain in (least, best):
            np.testing.assert_allclose(np.sort(np.linalg.eigvals(pair - gain @ outputs).real), sorted(FIVE), rtol=1e-6)

    def test_rounding_a_small_gain(self, design: obsynth.ObserverDesign) -> None:
        """Three decimals of a least gain move the poles visibly; nine significant digits do not."""
        poles = np.linalg.eigvals(np.round(design.observer.Az, 3))
        assert np.max(np.abs(np.sort_complex(poles) - np.sort(FIVE))) > 0.02
        assert design.report["stable with 9 digits"].value < -1.9

    @pytest.mark.long
    def test_our_own_decoupling_and_the_joint_design(self) -> None:
        own = obsynth.ui_pi_observer(PLANT, fault_model="ramp", poles=FIVE, objective="gain")
        joint = obsynth.ui_pi_observer(PLANT, fault_model="ramp", poles=FIVE, objective="gain", joint=True)
        assert own.report.passed
        assert joint.report.passed
        assert np.linalg.norm(joint.gains["K_a"]) < 0.5 * np.linalg.norm(own.gains["K_a"])
        # The price: the fault estimate sees the measurements directly.
        assert not np.any(own.observer.Dy[own.observer.fault_rows])
        assert np.any(joint.observer.Dy[joint.observer.fault_rows])

    def test_repeated_poles_and_a_region(self) -> None:
        for poles in ([-4] * 5, [-4, -4, -5, -5, -6]):
            found = obsynth.ui_pi_observer(PLANT, fault_model="ramp", poles=poles)
            assert found.report["poles"].passed
            # Rounding scatters k poles by its k-th root, but moves their mean by cond * |Ahat| * 1e-16 = 1e-10 at most.
            assert spectrum_error(found.observer.Az, poles, 0.0) < 1e-6
        region = TRUTH["region"]
        found = obsynth.ui_pi_observer(PLANT, fault_model="ramp", region=region)
        poles = np.linalg.eigvals(found.observer.Az)
        assert np.all(poles.real < -region["decay"])
        assert np.all(np.abs(poles) < region["radius"])

    def test_the_default(self) -> None:
        found = obsynth.ui_pi_observer(PLANT, fault_model="ramp")
        assert found.report.passed
        # The audit's untuned filter is at -0.414; the plant's own modes have the median speed 2.83.
        assert found.certificate.claims["decay"] > 1.0
        assert found.certificate.claims["noise_price"] <= 10.0

    def test_sampled_and_dead_beat(self) -> None:
        sampled = obsynth.discretise(PLANT, 0.1).plant
        inputs, direct = np.hstack([sampled.Bf, sampled.Bd]), np.hstack([sampled.Df, sampled.Dd])
        zeros = zeros_of_system(sampled.E, sampled.A, inputs, sampled.C, direct, dt=1.0)[1]
        assert [zero.value.real for zero in zeros] == pytest.approx([TRUTH["sampled_zero"]], abs=1e-6)
        found = obsynth.ui_pi_observer(sampled, fault_model="ramp", poles=[0] * 4)
        rng = np.random.default_rng(1)
        steps = 30
        ramp, random = 0.3 * np.arange(steps)[:, None], 50.0 * rng.standard_normal((steps, 1))
        run = simulate_plant(sampled, steps=steps, f=ramp, d=random, u=np.ones((steps, 1)), initial_state=[0.5, -0.2])
        errors = found.observer.run(run.outputs, run.inputs).faults - ramp
        assert np.max(np.abs(errors[:4])) > 1.0
        assert np.max(np.abs(errors[4:])) < 1e-6


class TestLimits:
    def test_no_gain_removes_the_inverse_response(self, design: obsynth.ObserverDesign) -> None:
        row = design.report["limit at 0.5"]
        assert row.value < 1e-9
        assert f"at least {TRUTH['undershoot_for_2_s']:.2f}" in row.detail
        run = started(design, fault=ONE, disturbance=(np.zeros((1, 1)), np.zeros((1, 1))), wf=[1.0], wd=[0.0])
        estimates = run[0]
        settled = run[1] >= 4.0 / 2.0
        assert np.min(estimates) < -TRUTH["undershoot_for_2_s"]
        assert abs(estimates[settled][-1] - 1.0) < 1e-6

    def test_a_step_model_on_a_ramp(self) -> None:
        found = obsynth.ui_pi_observer(PLANT, fault_model="step", poles=[-2, -3, -4, -5], objective="gain", **PAPER)
        row = found.report["steady error[fault]"]
        assert row.value == pytest.approx(TRUTH["step_model_on_a_ramp"], rel=0.02)
        estimates, time, _ = started(found, fault=RAMP, disturbance=NOISY, wf=[0, 1], wd=[0, 1, 0, 1])
        assert estimates[-1] - time[-1] == pytest.approx(row.value, abs=1e-3)

    def test_a_sinusoid_seen_by_a_ramp_model(self, design: obsynth.ObserverDesign) -> None:
        frequency = 1.0
        gain = obsynth.fault_response(design, [frequency])[0, 0, 0]
        estimates, time, _ = started(design, fault=sine(frequency), disturbance=NOISY, wf=[0, 1], wd=[0, 1, 0, 1])
        late = time > 12.0
        expected = np.imag(gain * np.exp(1j * frequency * time[late]))
        np.testing.assert_allclose(estimates[late], expected, atol=1e-3)
        assert abs(gain) > 3.0

    def test_a_slow_sinusoid_is_within_ten_per_cent(self, design: obsynth.ObserverDesign) -> None:
        slow, faster = abs(obsynth.fault_response(design, [0.11, 0.12])[:, 0, 0])
        assert slow < 1.1 < faster

    def test_the_right_model_follows_the_sinusoid(self) -> None:
        found = obsynth.ui_pi_observer(PLANT, fault_model={"sinusoid": 1.0}, poles=FIVE)
        estimates, time, _ = started(found, fault=sine(1.0), disturbance=NOISY, wf=[0, 1], wd=[0, 1, 0, 1])
        late = time > 12.0
        np.testing.assert_allclose(estimates[late], np.sin(time[late]), atol=1e-5)
        assert obsynth.fault_response(found, [1.0])[0, 0, 0] == pytest.approx(1.0, abs=1e-9)


def started(design, *, fault, disturbance, wf, wd, end: float = 16.0, step: float = 0.01):
    """Run from x1 = 0.5, x3 = -0.2, z = 0 with u = 1; return fault estimate, time and the whole."""
    together = Together(design.plant, design.observer, fault=fault, disturbance=disturbance, known=ONE)
    start = np.concatenate([[0.5, -0.2], np.zeros(design.observer.order), wf, wd, [1.0]])
    rows = together.run(start, step, round(end / step) + 1)
    return (rows @ together.estimates.T)[:, together.fault_rows][:, 0], step * np.arange(len(rows)), rows


def test_the_papers_simulation(design: obsynth.ObserverDesign) -> None:
    """A ramp fault from t = 5 s under a ramp plus a sine; the plant itself runs away to 1e6."""
    together = Together(design.plant, design.observer, fault=RAMP, disturbance=ramp_and_sine(0.5, 2.0, 3.0), known=ONE)
    step, before, after = 0.005, 1000, 3000
    start = np.concatenate([[0.5, -0.2], np.zeros(5), [0, 0], [0, 1, 0, 1], [1.0]])
    first = together.run(start, step, before + 1)
    switched = first[-1].copy()
    switched[together.places[2]] = [0.0, 1.0]
    second = together.run(switched, step, after + 1)
    estimates = (second @ together.estimates.T)[:, together.fault_rows][:, 0]
    truth, time = step * np.arange(after + 1), 5.0 + step * np.arange(after + 1)

    def rmse(start: float) -> float:
        return float(np.sqrt(np.mean((estimates - truth)[time >= start] ** 2)))

    assert rmse(5.0) == pytest.approx(1.33, rel=0.1)
    assert rmse(10.0) < 5e-3
    assert rmse(15.0) < 1e-5
    assert np.max(np.abs(second[-1])) > 1e5
    # Without the disturbance the estimates are the same, up to rounding of states that reach 1e6.
    calm = start.copy()
    calm[together.places[3]] = 0.0
    others = together.run(calm, step, before + 1)
    difference = ((first - others) @ together.estimates.T)[:, together.fault_rows]
    assert np.max(np.abs(first - others)) > 1.0
    assert np.max(np.abs(difference)) < 1e-9
