"""The PD observer's options, each against the true closed loop; its realisation; what is refused before a solver."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import cvxpy
import numpy as np
import pytest

import obsynth
from obsynth.analysis.existence import statements
from obsynth.analysis.existence.filasova import pd_observer_conditions
from obsynth.conditions import lmi
from obsynth.methods.pd_observer import synthesis as pd_design
from obsynth.methods.pd_observer.certificate import (
    coupled_certificate,
    explicit_certificate,
    gain_certificate,
    symmetric_certificate,
)
from obsynth.methods.pd_observer.certificate_proofs import error_inputs, prove_gains, prove_shipped_stability
from obsynth.methods.pd_observer.limits import least_noise_gain
from obsynth.methods.pd_observer.realisation import with_faults_as_states, with_sensor_noise
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.continuous import ContinuousNorms
from obsynth.numerics.pencils import FiniteZeros
from obsynth.simulation.linear import simulate_plant
from obsynth.specs.loader import load_spec
from obsynth.verification.inequalities import prove_gain, prove_symmetric_positive

FOLDER = Path(__file__).parents[2] / "designs" / "filasova"
PLANT = load_spec(FOLDER / "spec.yaml").plant


@cache
def rich() -> obsynth.DescriptorSystem:
    """Every kind of signal and feedthrough; the second fault is that of a sensor."""
    return obsynth.DescriptorSystem(
        None,
        [[0.3, 1, 0], [-2, -0.5, 0.4], [0.1, 0, -1.5]],
        [[0], [1], [0.5]],
        [[1, 0, 0], [0, 1, 1], [0, 0, 1]],
        D=[[0.2], [0], [1]],
        Bf=[[0, 0], [1, 0], [0.3, 0]],
        Df=[[0, 0], [0.4, 0], [0, 1]],
        Bd=[[1], [0], [0]],
        Dd=[[0], [0.1], [0]],
        Bw=[[0.01, 0], [0, 0], [0, 0]],
        Dw=[[0, 0.02], [0, 0.01], [0, 0]],
    )


def loop(design: obsynth.ObserverDesign) -> tuple[np.ndarray, np.ndarray]:
    """The paper's own error equation D e' = Ae e from the listed gains: Ae and D, feedthrough and G included."""
    plant, gains = design.plant, design.gains
    g = gains.get("G", np.eye(plant.nf))
    c = np.hstack([plant.C, plant.Df])
    a = np.block([[plant.A, plant.Bf], [np.zeros((plant.nf, plant.nx + plant.nf))]])
    j, l = np.vstack([gains["J"], g @ gains["M"]]), np.vstack([gains["L"], g @ gains["N"]])  # noqa: E741
    return a - j @ c, np.eye(len(a)) + l @ c


@cache
def plain() -> obsynth.ObserverDesign:
    """Return the paper's plant with every option as it is by default."""
    return obsynth.pd_observer(PLANT)


def eigenvalues(design: obsynth.ObserverDesign) -> np.ndarray:
    ae, d = loop(design)
    return np.linalg.eigvals(np.linalg.solve(d, ae))


def norm_on_a_grid(design: obsynth.ObserverDesign, inputs: np.ndarray, rates: np.ndarray) -> float:
    """Largest gain to the fault error of D e' = Ae e + inputs v + rates v' over a fine grid of frequencies."""
    ae, d = loop(design)
    shown = np.eye(len(ae))[design.plant.nx :]
    frequencies = np.concatenate([[0.0], np.logspace(-3, 5, 4001)])
    s = 1j * frequencies[:, None, None]
    return float(np.linalg.norm(shown @ np.linalg.solve(s * d - ae, inputs + s * rates), 2, axis=(1, 2)).max())


class TestOptions:
    @pytest.mark.one_in(4)
    @pytest.mark.parametrize("theorem", [1, 2])
    @pytest.mark.parametrize("decay", [0.0, 0.5, 3.0])
    def test_decay(self, decay: float, theorem: int) -> None:
        for plant in (PLANT, rich()):
            design = obsynth.pd_observer(plant, theorem=theorem, decay=decay)
            assert np.max(eigenvalues(design).real) < -decay
            assert design.certificate.claims["decay"] == decay

    def test_forgetting_the_second_term_of_the_decay_would_be_seen(self) -> None:
        """J = J' + alpha L: with J' alone the loop is another one, and too slow here."""
        design = obsynth.pd_observer(PLANT, delta=0.1, decay=5.0)
        gains = design.gains
        ae, d = loop(design)
        c = np.hstack([PLANT.C, PLANT.Df])
        without = ae + 5.0 * np.vstack([gains["L"], gains["N"]]) @ c
        assert np.max(eigenvalues(design).real) < -5.0
        assert np.max(np.linalg.eigvals(np.linalg.solve(d, without)).real) > -5.0

    @pytest.mark.one_in(5)
    @pytest.mark.parametrize("disk", [[5.0, 4.5], [10.0, 9.0], [3.0, 2.8], [50.0, 49.9], [1.0, 3.0]])
    def test_disk(self, disk: list[float]) -> None:
        design = obsynth.pd_observer(PLANT, disk=disk)
        assert np.max(np.abs(eigenvalues(design) + disk[0])) < disk[1]
        assert np.max(eigenvalues(design).real) < 0.0

    def test_disk_and_decay_together(self) -> None:
        design = obsynth.pd_observer(PLANT, disk=[10.0, 9.0], decay=2.0)
        found = eigenvalues(design)
        assert np.max(np.abs(found + 10.0)) < 9.0
        assert np.max(found.real) < -2.0

    @pytest.mark.one_in(3)
    @pytest.mark.parametrize("bound", [2.5, 5.0, 30.0])
    def test_gain_bound(self, bound: float) -> None:
        free = obsynth.pd_observer(PLANT, delta=0.1, decay=0.0, fault_rate_gain=0.25)
        design = obsynth.pd_observer(PLANT, delta=0.1, decay=0.0, gain_bound=bound)
        for found in (free, design):
            gains = found.gains
            stacked = np.block([[gains["J"], gains["L"]], [gains["M"], gains["N"]]])
            assert found.report["gain"].value == pytest.approx(np.linalg.norm(stacked, 2), rel=1e-9)
        assert design.report["gain"].value <= bound

    def test_a_gain_bound_is_felt(self) -> None:
        """A decay of 2 takes gains of 6.1 by default; with a bound of 5.5 they are smaller."""
        free = obsynth.pd_observer(PLANT, delta=0.1, decay=2.0)
        bounded = obsynth.pd_observer(PLANT, delta=0.1, decay=2.0, gain_bound=5.5)
        assert free.report["gain"].value > 5.5 >= bounded.report["gain"].value
        assert np.max(eigenvalues(bounded).real) < -2.0

    @pytest.mark.one_in(3)
    @pytest.mark.parametrize("gain", [0.7, 0.3, 0.1])
    def test_fault_rate_gain(self, gain: float) -> None:
        for plant in (PLANT, rich()):
            design = obsynth.pd_observer(plant, fault_rate_gain=gain)
            rate = np.vstack([np.zeros((plant.nx, plant.nf)), np.eye(plant.nf)])
            found = norm_on_a_grid(design, rate, np.zeros_like(rate))
            assert found <= gain
            assert design.report["fault rate in the fault estimate"].value == pytest.approx(found, rel=1e-4)

    def test_noise_gain(self) -> None:
        free = obsynth.pd_observer(PLANT, delta=0.1, decay=4.0)
        bounded = obsynth.pd_observer(PLANT, delta=0.1, decay=4.0, noise_gain=1.0)
        row = "noise and its derivative in the fault estimate"
        assert free.report[row].value > 1.0 >= bounded.report[row].value
        for design in (free, bounded):
            d = loop(design)[1]
            gains = design.gains
            j, l = np.vstack([gains["J"], gains["M"]]), np.vstack([gains["L"], gains["N"]])  # noqa: E741
            assert norm_on_a_grid(design, -np.hstack([j, l]), 0.0 * np.hstack([j, l])) == pytest.approx(
                design.report[row].value, rel=1e-4
            )
            # With the true derivative the norm is another one, finite because it is absorbed.
            assert norm_on_a_grid(design, -j, -l) == pytest.approx(
                design.report["noise in the fault estimate"].value, rel=1e-3
            )
            fast = np.linalg.norm(np.linalg.solve(d, l)[PLANT.nx :], 2)
            assert design.report["fast noise in the fault estimate"].value == pytest.approx(fast, rel=1e-9)

    @pytest.mark.parametrize("scale", [0.5, 2.0])
    def test_noise_of_a_stated_decay_does_not_follow_the_unit_of_an_output(self, scale: float) -> None:
        """In a unit twice as large the smallest gains had six times the noise at the estimate."""
        plant = obsynth.DescriptorSystem(
            A=[[-1.278, -2.419, 1.611], [-0.182, -2.301, 0.959], [-0.121, 1.05, -2.526]], C=[[-1.027, 1.98, 0.678]],
            Bf=[[1.004], [-0.909], [0.012]], Bw=np.zeros((3, 1)), Dw=[[0.1]],
        )  # fmt: skip
        scaled = plant.replace(C=scale * plant.C, Dw=scale * plant.Dw)
        direct = [
            float(np.abs(design.observer.Dy[design.observer.fault_rows] @ design.plant.Dw).item())
            for design in (obsynth.pd_observer(each, decay=0.3) for each in (plant, scaled))
        ]
        assert direct[1] == pytest.approx(direct[0], rel=1e-3)
        assert direct[0] < 0.003

    def test_noise_and_disturbance_as_the_plant_states_them(self) -> None:
        design = obsynth.pd_observer(rich(), noise_gain=0.5, fault_rate_gain=2.0)
        plant, gains = design.plant, design.gains
        j, l = np.vstack([gains["J"], gains["M"]]), np.vstack([gains["L"], gains["N"]])  # noqa: E741
        for b, d, row in ((plant.Bw, plant.Dw, "noise"), (plant.Bd, plant.Dd, "disturbance")):
            padded = np.vstack([b, np.zeros((plant.nf, b.shape[1]))])
            found = norm_on_a_grid(design, padded - j @ d, -l @ d)
            assert design.report[f"{row} in the fault estimate"].value == pytest.approx(found, rel=1e-3)

    def test_adaptation_gain_is_inside_the_loop(self) -> None:
        g = np.array([[3.0, 0.5], [0.0, 2.0]])
        for plant in (PLANT, rich()):
            design = obsynth.pd_observer(plant, adaptation_gain=g, decay=0.7)
            np.testing.assert_array_equal(design.gains["G"], g)
            assert np.max(eigenvalues(design).real) < -0.7

    def test_a_gain_bound_is_on_the_gains_in_the_loop(self) -> None:
        design = obsynth.pd_observer(PLANT, delta=0.1, decay=2.0, adaptation_gain=12.0, gain_bound=5.5)
        gains = design.gains
        stacked = np.block([[gains["J"], gains["L"]], [12.0 * gains["M"], 12.0 * gains["N"]]])
        assert np.linalg.norm(stacked, 2) <= 5.5
        assert np.max(eigenvalues(design).real) < -2.0

    def test_a_number_stands_for_a_multiple_of_the_identity(self) -> None:
        design = obsynth.pd_observer(PLANT, adaptation_gain=4.0)
        np.testing.assert_array_equal(design.gains["G"], 4.0 * np.eye(2))

    @pytest.mark.parametrize("theorem", [1, 2])
    def test_adaptation_range(self, theorem: int) -> None:
        design = obsynth.pd_observer(rich(), theorem=theorem, adaptation_range=[0.5, 6.0], decay=0.2)
        assert design.report["adaptation range"].kind == "proved"
        np.testing.assert_array_equal(design.gains["G"], np.eye(2))
        for g in np.linspace(0.5, 6.0, 23):
            moved = design.replace(gains={**design.gains, "G": g * np.eye(2)})
            assert np.max(eigenvalues(moved).real) < -0.2

    def test_a_range_without_one_ships_its_nearer_end(self) -> None:
        design = obsynth.pd_observer(PLANT, adaptation_range=[2.0, 6.0])
        np.testing.assert_array_equal(design.gains["G"], 2.0 * np.eye(2))
        assert np.max(eigenvalues(design).real) < 0.0

    @pytest.mark.parametrize("solver", ["CLARABEL", "SCS"])
    def test_solvers_agree(self, solver: str) -> None:
        design = obsynth.pd_observer(PLANT, delta=0.1, decay=0.0, solver=solver)
        reference = obsynth.pd_observer(PLANT, delta=0.1, decay=0.0)
        np.testing.assert_allclose(design.gains["J"], reference.gains["J"], rtol=0, atol=1e-4)
        np.testing.assert_allclose(design.gains["L"], reference.gains["L"], rtol=0, atol=1e-4)

    def test_theorem_2_has_a_stable_proportional_part_and_a_symmetric_p3(self) -> None:
        design = obsynth.pd_observer(PLANT, theorem=2, delta=0.1, decay=0.0)
        p3 = design.certificate.matrices["P3"]
        np.testing.assert_array_equal(p3, p3.T)
        assert np.max(np.linalg.eigvals(loop(design)[0]).real) < 0.0

    def test_the_p_part_may_be_unstable_under_theorem_2(self) -> None:
        """The audit's case: L = 0 and A_e stable, yet A - J C is not; the paper's remark says otherwise."""
        design = obsynth.design_from_gains(
            PLANT, "pd-observer",
            J=[[1.188, 0], [0, 1.25], [-1.09, 0], [0, 1.256]], L=np.zeros((4, 2)),
            M=[[0.152, 0.777], [-0.002, 0]], N=np.zeros((2, 2)),
        )  # fmt: skip
        assert design.report.passed
        assert design.report["proportional part alone"].value == pytest.approx(0.786, abs=2e-3)
        assert design.report["error system"].value == pytest.approx(-0.124, abs=2e-3)
        a, zero = loop(design)[0], np.zeros((1, 6))
        for delta in (0.01, 0.1):
            p1, q = lmi.symmetric_variable(6), lmi.symmetric_variable(6)
            w = lmi.symmetric_blocks([[q @ a + a.T @ q], [p1 - q + delta * q @ a, -2.0 * delta * q]])
            constraints = [lmi.at_most(w, -1e-3), lmi.at_least(p1, 1e-3), lmi.at_least(q, 1.0)]
            lmi.minimise(cvxpy.trace(p1), constraints, what="Theorem 2 for gains with L = 0")
            found = [0.5 * (value + value.T) for value in (lmi.value_of(p1), lmi.value_of(q))]
            assert all(prove_symmetric_positive(matrix).proved for matrix in found)
            assert prove_gains(a, zero, zero.T, zero.T, *found, delta=delta, decay=0.0).proved


class TestDefaults:
    def test_delta_follows_the_plants_time_scale(self) -> None:
        fastest = np.max(np.abs(np.linalg.eigvals(PLANT.A)))
        assert plain().options["delta"] == pytest.approx(1.0 / fastest)
        slower = PLANT.replace(A=PLANT.A / 60.0, B=PLANT.B / 60.0, Bf=PLANT.Bf / 60.0)
        assert obsynth.pd_observer(slower).options["delta"] == pytest.approx(60.0 / fastest)

    @pytest.mark.parametrize("unit", [2.0**-10, 2.0**10])
    def test_the_unit_of_time_does_not_matter(self, unit: float) -> None:
        other = PLANT.replace(A=PLANT.A * unit, B=PLANT.B * unit, Bf=PLANT.Bf * unit)
        found, reference = obsynth.pd_observer(other), plain()
        np.testing.assert_allclose(found.gains["J"] / unit, reference.gains["J"], rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(found.gains["L"], reference.gains["L"], rtol=1e-6, atol=1e-9)
        # The fault has no unit of time of its own, its integrator has.
        np.testing.assert_allclose(found.gains["M"] / unit, reference.gains["M"], rtol=1e-6, atol=1e-9)

    def test_a_slow_design_gets_a_decay_rate_and_says_so(self) -> None:
        slow = obsynth.DescriptorSystem(None, [[-0.05, 5.0], [-5.0, -0.05]], C=[[1.0, 0.0]], Bf=[[0.0], [1.0]])
        plain, default = obsynth.pd_observer(slow, decay=0.0), obsynth.pd_observer(slow)
        assert plain.report["error system"].value > -0.5
        assert default.report["error system"].value < -0.5
        assert default.certificate.claims["decay"] == pytest.approx(0.1 * 5.0, rel=1e-3)
        assert any("decay: 0" in note for note in default.notes)

    def test_the_default_decay_rate_respects_a_hidden_mode(self) -> None:
        a = np.diag([-0.05, 1.0, -3.0])
        plant = obsynth.DescriptorSystem(None, a, C=[[0.0, 1, 0], [0, 0, 1]], Bf=[[0.0], [1.0], [0.0]])
        design = obsynth.pd_observer(plant)
        assert design.certificate.claims["decay"] == pytest.approx(0.025)
        assert design.report["error system"].value <= -0.025
        assert np.min(np.abs(np.linalg.eigvals(design.observer.Az) + 0.05)) < 1e-9

    def test_a_default_decay_rate_never_makes_a_design_impossible(self) -> None:
        """Theorem 2 with delta = 0.35 serves the hidden pair -0.4 +- 2j, but not with a decay rate of 0.2."""
        pair = obsynth.DescriptorSystem(
            None, [[0.1, 0, 0], [0, -0.4, 2], [0, -2, -0.4]], C=[[1, 0, 0]], Bf=[[1], [0], [0]]
        )
        with pytest.raises(obsynth.InfeasibleError, match="delta <"):
            obsynth.pd_observer(pair, theorem=2, delta=0.35, decay=0.2)
        design = obsynth.pd_observer(pair, theorem=2, delta=0.35)
        assert design.report.passed
        assert design.certificate.claims["decay"] < 0.1

    def test_a_fast_mode_that_decays_by_itself_does_not_set_the_pace(self) -> None:
        """An unstable mode at 0.5 and a sensor at -1e5: gains are those of the slow plant."""
        a = np.diag([-1e5, -1.0, 0.5]) + 0.3 * np.triu(np.ones((3, 3)), 1)
        plant = obsynth.DescriptorSystem(None, a, C=[[0.1, 0.1, 1.1]], Bf=[[0.0], [1.0], [1.0]])
        design = obsynth.pd_observer(plant)
        assert design.options["delta"] == pytest.approx(1.0, rel=1e-4)
        assert design.report["gain"].value < 100.0

    def test_integrators_have_no_time_scale(self) -> None:
        plant = obsynth.DescriptorSystem(None, [[0.0, 1.0], [0.0, 0.0]], C=[[1.0, 0.0]], Bf=[[0.0], [1.0]])
        assert obsynth.pd_observer(plant).options["delta"] == 1.0

    @pytest.mark.long
    def test_gains_stay_small_for_every_delta(self) -> None:
        """The trap: plain feasibility with P1 >= I gives 1.4e9 at delta = 1, a maximal margin 3e13."""
        scan = obsynth.sweep(PLANT, {"delta": np.logspace(-3, 0, 7).tolist(), "decay": [0.0]}, method="pd-observer")
        assert np.max(scan.values("gain")) < 10.0

    def test_gains_out_of_proportion_are_a_warning_in_the_report(self) -> None:
        design = obsynth.pd_observer(PLANT, decay=60.0)
        row = design.report["gain"]
        assert row.value > 1e3
        assert row.kind == "information"
        assert row.detail.startswith("WARNING")
        assert plain().report["gain"].detail == ""


class TestWhenTheSolverFails:
    @pytest.mark.parametrize("theorem", [1, 2])
    def test_a_riccati_equation_gives_gains(self, monkeypatch: pytest.MonkeyPatch, theorem: int) -> None:
        def failing(*_: object, **__: object) -> None:
            raise obsynth.SolverError("broken")

        monkeypatch.setattr(pd_design, "solve", failing)
        design = obsynth.pd_observer(PLANT, theorem=theorem, decay=0.5)
        assert design.report.passed
        assert not np.any(design.gains["L"])
        assert np.max(eigenvalues(design).real) < -0.5
        assert any("Riccati" in note for note in design.notes)
        with pytest.raises(obsynth.SolverError, match="broken") as caught:
            obsynth.pd_observer(PLANT, theorem=theorem, gain_bound=5.0)
        assert "gain_bound" in str(caught.value)

    def test_wrong_numbers_from_the_solver_are_not_shipped(self, monkeypatch: pytest.MonkeyPatch) -> None:
        right = pd_design.solve

        def wrong(task: object, *, solver: str) -> object:
            found = right(task, solver=solver)
            return type(found)(-50.0 * found.J, found.L, found.P1, found.P3, found.record)

        monkeypatch.setattr(pd_design, "solve", wrong)
        design = obsynth.pd_observer(PLANT)
        assert any("Riccati" in note for note in design.notes)
        with pytest.raises(obsynth.SolverError, match="could not be proved"):
            obsynth.pd_observer(PLANT, gain_bound=5.0)


class TestCertificates:
    @pytest.mark.long
    def test_a_certificate_is_found_up_to_the_true_decay_rate_and_not_beyond(self) -> None:
        for plant in (PLANT, rich()):
            observer = obsynth.pd_observer(plant).observer
            estimate = observer.Cz[: observer.order]
            true = -float(np.max(np.linalg.eigvals(observer.Az).real))
            for share in (0.0, 0.5, 0.99):
                found = explicit_certificate(observer.Az, estimate, decay=share * true)
                assert found is not None
                p1, p3, delta = found
                assert prove_symmetric_positive(p1).proved
                assert prove_shipped_stability(observer, p1, p3, delta=delta, decay=share * true).proved
                assert not prove_shipped_stability(observer, p1, p3, delta=delta, decay=1.001 * true).proved
            assert explicit_certificate(observer.Az, estimate, decay=1.001 * true) is None

    def test_a_symmetric_certificate_serves_below_its_delta(self) -> None:
        a = np.array([[0.0, 1.0], [-4.0, -0.4]])
        found = symmetric_certificate(a)
        assert found is not None
        (p3, weight, limit), none = found, np.zeros((2, 1))
        for delta, proved in ((0.999 * limit, True), (1.001 * limit, False)):
            p1 = p3 + 0.5 * delta * weight
            assert prove_gains(a, none.T, none, none, p1, p3, delta=delta, decay=0.0).proved is proved
        assert symmetric_certificate(-a) is None

    @pytest.mark.parametrize("delta", [1e-3, 0.1, 1.0, 10.0, 1e3])
    def test_a_coupled_certificate_serves_for_every_delta(self, delta: float) -> None:
        a, none = np.array([[0.0, 1.0], [-4.0, -0.4]]), np.zeros((2, 1))
        p1, p3 = coupled_certificate(a, delta)
        p1 = 0.5 * (p1 + p1.T)
        assert prove_symmetric_positive(p1).proved
        assert prove_gains(a, none.T, none, none, p1, p3, delta=delta, decay=0.0).proved

    @pytest.mark.long
    def test_an_l2_gain_is_proved_down_to_the_norm_and_not_below(self) -> None:
        for plant in (PLANT, rich()):
            design = obsynth.pd_observer(plant)
            observer, gains = design.observer, design.gains
            noisy = with_sensor_noise(plant)
            stacked = np.vstack([gains["J"], gains["M"]]), np.vstack([gains["L"], gains["N"]])
            shown = observer.Cz[observer.fault_rows]
            rows = {"rate": "fault rate in", "noise": "noise and its derivative in"}
            for kind, row in rows.items():
                entering = error_inputs(noisy, *stacked, kind)
                norm = design.report[f"{row} the fault estimate"].value
                for factor in (10.0, 1.1, 1.001):
                    found = gain_certificate(observer.Az, entering, shown, factor * norm)
                    assert found is not None
                    assert prove_gain(observer.Az, entering, shown, found, factor * norm).proved
                    assert not prove_gain(observer.Az, entering, shown, found, (1.0 - 1e-6) * norm).proved
                assert gain_certificate(observer.Az, entering, shown, (1.0 - 1e-6) * norm) is None
                assert not prove_gain(-observer.Az, entering, shown, found, 10.0 * norm).proved

    @pytest.mark.long
    def test_both_forms_of_the_inequality_agree(self) -> None:
        design = obsynth.pd_observer(rich(), decay=0.3)
        augmented = with_faults_as_states(design.plant)
        gains, matrices, claims = design.gains, design.certificate.matrices, design.certificate.claims
        j, l = np.vstack([gains["J"], gains["M"]]), np.vstack([gains["L"], gains["N"]])  # noqa: E741
        for decay, proved in ((0.3, True), (100.0, False)):
            found = prove_gains(
                augmented.A, augmented.C, j, l, matrices["P1"], matrices["P3"], delta=claims["delta"], decay=decay
            )
            assert found.proved is proved

    def test_a_symmetric_matrix_must_be_so_exactly(self) -> None:
        assert prove_symmetric_positive(np.array([[2.0, 1.0], [1.0, 2.0]])).proved
        assert not prove_symmetric_positive(np.array([[2.0, 1.0], [1.0 + 1e-15, 2.0]])).proved
        assert not prove_symmetric_positive(np.array([[1.0, 2.0], [2.0, 1.0]])).proved


class TestRunning:
    """Continuous plants sampled finely, the observer by a first-order hold."""

    @pytest.mark.one_in(2)
    @pytest.mark.parametrize("decay", [0.5, 3.0])
    def test_states_and_faults_come_back(self, decay: float) -> None:
        design = obsynth.pd_observer(rich(), decay=decay)
        h, steps = 4e-3, 7_500
        sampled = obsynth.discretise(design.plant, h).plant
        time = h * np.arange(steps)
        u = np.sin(time)[:, None]
        f = np.column_stack([np.where(time >= 5.0, 1.0, 0.0), np.where(time >= 10.0, -0.5, 0.0)])
        run = simulate_plant(sampled, steps=steps, u=u, f=f, initial_state=[1.0, -1.0, 0.5])
        estimates = obsynth.sample_observer(design.observer, h).run(run.outputs, u)
        bound = 1e-4 + 1e3 * np.exp(-decay * 19.0)
        np.testing.assert_allclose(estimates.faults[-250:], f[-250:], rtol=0, atol=bound + 5e-3)
        np.testing.assert_allclose(estimates.states[-250:], run.states[-250:], rtol=0, atol=bound + 5e-3)
        np.testing.assert_allclose(estimates.residuals[-250:], 0.0, atol=bound + 5e-3)

    def test_a_singular_plant_is_eliminated_with_the_way_back(self) -> None:
        e = np.diag([1.0, 1.0, 0.0])
        plant = obsynth.DescriptorSystem(
            e, [[0.2, 1, 0], [-1, 0, 1], [1, 1, -1]], C=[[1, 0, 0], [0, 0, 1]], Bf=[[0], [1], [0.5]]
        )
        design = obsynth.pd_observer(plant, decay=1.0)
        assert design.plant.nx == 2
        assert design.recovery is not None
        assert design.recovery.names == plant.state_names
        assert design.recovery.flags() == ("exact", "exact", "needs the fault estimate")
        assert np.any(design.plant.Df)
        assert np.max(eigenvalues(design).real) < -1.0

    def test_e_may_be_any_nonsingular_matrix(self) -> None:
        change = np.array([[2.0, 0, 0, 1], [0, 1, 0, 0], [0, 1, 3, 0], [0, 0, 0, 1]])
        moved = PLANT.replace(E=change, A=change @ PLANT.A, B=change @ PLANT.B, Bf=change @ PLANT.Bf)
        found, reference = obsynth.pd_observer(moved), plain()
        np.testing.assert_allclose(found.gains["J"], reference.gains["J"], rtol=0, atol=1e-6)

    def test_it_is_saved_and_verified_from_the_file(self, tmp_path: Path) -> None:
        design = obsynth.pd_observer(rich(), adaptation_range=[0.5, 2.0])
        again = obsynth.load(design.save(tmp_path / "pd.gains.json"))
        assert obsynth.verify(again).passed
        assert repr(again.report) == repr(design.report)  # NaN is not equal to itself


class TestRefusals:
    def test_a_noise_gain_below_that_of_steady_state(self) -> None:
        least = least_noise_gain(PLANT)
        # By hand: ny = nf, so in steady state f is read from y by one matrix alone.
        rosenbrock = np.block([[PLANT.A, PLANT.Bf], [PLANT.C, PLANT.Df]])
        by_hand = np.linalg.inv(rosenbrock)[4:, 4:]
        assert least == pytest.approx(np.linalg.norm(by_hand, 2))
        with pytest.raises(obsynth.InfeasibleError, match="steady state") as caught:
            obsynth.pd_observer(PLANT, noise_gain=0.999 * least)
        assert (caught.value.necessary, caught.value.lower_bound) == (True, least)
        assert obsynth.pd_observer(PLANT, decay=0.0, noise_gain=2.0 * least).report.passed

    def test_units_of_states_and_faults_do_not_move_that_bound(self) -> None:
        x, f = np.array([1e4, 1e-3, 1.0, 1e2]), np.array([1e3, 1e-2])
        moved = PLANT.replace(
            A=PLANT.A * x / x[:, None], B=PLANT.B / x[:, None], C=PLANT.C * x, Bf=PLANT.Bf * f / x[:, None]
        )
        expected = np.linalg.norm(
            np.linalg.inv(np.block([[PLANT.A, PLANT.Bf], [PLANT.C, PLANT.Df]]))[4:, 4:] / f[:, None], 2
        )
        assert least_noise_gain(moved) == pytest.approx(expected, rel=1e-9)

    @pytest.mark.long
    def test_no_design_has_less_noise_than_that(self) -> None:
        for plant in (PLANT, rich().replace(Bw=np.zeros((3, 3)), Dw=np.eye(3), noise_names=None)):
            least = least_noise_gain(plant)
            assert least > 0.0
            for options in ({}, {"decay": 0.0}, {"theorem": 2}, {"decay": 2.0}):
                report = obsynth.pd_observer(plant, **options).report
                assert report["noise in the fault estimate"].value >= least * (1.0 - 1e-9)

    def test_a_hidden_mode_limits_decay_and_disk(self) -> None:
        plant = obsynth.DescriptorSystem(None, np.diag([-0.5, 1.0]), C=[[0.0, 1.0]], Bf=[[0.0], [1.0]])
        with pytest.raises(obsynth.InfeasibleError, match=r"-0\.5") as caught:
            obsynth.pd_observer(plant, decay=0.5)
        assert caught.value.necessary
        assert obsynth.pd_observer(plant, decay=0.45).report.passed
        with pytest.raises(obsynth.InfeasibleError, match="no gain moves it"):
            obsynth.pd_observer(plant, disk=[5.0, 4.0])
        assert obsynth.pd_observer(plant, disk=[5.0, 4.6]).report.passed

    def test_delta_must_suit_the_disk(self) -> None:
        with pytest.raises(obsynth.InfeasibleError, match="-1/delta") as caught:
            obsynth.pd_observer(PLANT, disk=[5.0, 4.5], delta=10.0)
        assert not caught.value.necessary

    def test_outputs_that_show_nothing_end_in_the_mode_that_they_hide(self, share: Callable[..., Any]) -> None:
        """In rates of many sizes too, where the zeros of [A - s I; C] computed another way are too few."""
        with pytest.raises(obsynth.PreconditionError) as caught:
            obsynth.pd_observer(PLANT.replace(C=np.zeros_like(PLANT.C)))
        assert caught.value.condition == "detectability"
        assert caught.value.mode == pytest.approx(np.max(np.linalg.eigvals(PLANT.A).real))
        for seed in share(range(60)):
            rng = np.random.default_rng([7, seed])
            n = int(rng.integers(1, 9))
            a = rng.normal(size=(n, n)) * 10.0 ** rng.uniform(-8, 8, (n, n))
            values = np.linalg.eigvals(a)
            if not np.max(values.real) > 1e-6 * np.max(np.abs(values)):
                continue
            for c in (np.zeros((2, n)), np.eye(1, n)):
                plant = obsynth.DescriptorSystem(None, a, C=c, Bf=np.ones((n, 1)))
                failed = pd_observer_conditions(plant)[-1]
                if not np.any(c) or failed.name == "detectability":
                    assert failed.name == "detectability"
                    assert failed.mode.real >= -1e-9 * abs(failed.mode)
                    assert failed.signals

    def test_conditions_are_listed_for_check(self) -> None:
        names = [condition.name for condition in pd_observer_conditions(PLANT)]
        assert names[-1] == "rank [A F; C Df]"
        assert all(condition.holds for condition in pd_observer_conditions(PLANT))

    def test_other_designs_have_no_adaptation_gain(self) -> None:
        other = plain().replace(method="fault-estimation-filter")
        with pytest.raises(obsynth.SpecError, match="adaptation gain"):
            obsynth.apply_adaptation_gain(other, 2.0)

    @pytest.mark.parametrize("change", [{"J": np.zeros((3, 2))}, {"M": np.zeros((2, 3))}, {"N": [[1.0]]}])
    def test_gains_of_the_wrong_shape(self, change: dict[str, object]) -> None:
        gains = {letter: plain().gains[letter] for letter in "JLMN"} | change
        with pytest.raises(obsynth.SpecError, match="is needed"):
            obsynth.design_from_gains(PLANT, "pd-observer", **gains)

    def test_gains_that_make_i_plus_lc_singular(self) -> None:
        """The audit's case: L(1, 1) = -1/4 with C(1, 1) = 4."""
        zero = np.zeros((4, 2))
        singular = np.array(zero)
        singular[0, 0] = -0.25
        with pytest.raises(obsynth.SpecError, match="singular"):
            obsynth.design_from_gains(PLANT, "pd-observer", J=zero, L=singular, M=np.zeros((2, 2)), N=np.zeros((2, 2)))

    def test_gains_that_are_not_stable_are_reported_not_refused(self) -> None:
        zero = np.zeros((4, 2))
        design = obsynth.design_from_gains(PLANT, "pd-observer", J=zero, L=zero, M=np.zeros((2, 2)), N=np.zeros((2, 2)))
        assert {row.name for row in design.report.failures} == {"error system", "descriptor pair", "LMI"}


def test_the_doors_options_are_those_of_the_method() -> None:
    from obsynth.methods.pd_observer.method import PdObserver

    door = {
        name: parameter.default
        for name, parameter in inspect.signature(obsynth.pd_observer).parameters.items()
        if name not in ("plant", "name")
    }
    inside = {
        name: parameter.default for name, parameter in inspect.signature(PdObserver).parameters.items()
    }  # fmt: skip
    assert door == inside


@pytest.mark.long
def test_norms_of_the_report_are_those_of_the_realisation() -> None:
    """Third route: plant and shipped observer as one system, for a plant that is stable itself."""
    plant = rich().replace(A=rich().A - 5.0 * np.eye(3))
    design = obsynth.pd_observer(plant)
    observer, rows = design.observer, design.observer.fault_rows
    a = np.block([[plant.A, np.zeros((plant.nx, observer.order))], [observer.By @ plant.C, observer.Az]])
    b = np.vstack([plant.Bd, observer.By @ plant.Dd])
    c = -np.hstack([observer.Dy[rows] @ plant.C, observer.Cz[rows]])
    norm = ContinuousNorms(a).between(b, c, -observer.Dy[rows] @ plant.Dd)
    assert design.report["disturbance in the fault estimate"].value == pytest.approx(norm.upper, rel=1e-7)


@pytest.mark.long
def test_a_sensor_that_shows_its_noise_alone_is_hardly_used() -> None:
    """In units in which it shows the states as the others do its gains were cheap: noise of .09 became 55."""
    noise = []
    for outputs in (2, 3):
        plant = obsynth.DescriptorSystem(
            E=np.eye(2),
            A=[[-1.0, 0.5], [0.0, -2.0]],
            Bf=[[1.0], [0.5]],
            C=np.array([[1.0, 0.0], [0.0, 1.0], [1e-4, 2e-4]])[:outputs],
            Bw=np.zeros((2, outputs)),
            Dw=0.1 * np.eye(outputs),
        )
        noise.append(obsynth.pd_observer(plant).report["noise in the fault estimate"].value)
    assert noise[1] <= 1.01 * noise[0]


@pytest.mark.parametrize(
    "beside", [{"disk": [1, 20]}, {"gain_bound": 50.0}, {"noise_gain": 50.0}, {"adaptation_gain": 2.0}], ids=str
)
@pytest.mark.parametrize(
    "region", [{"half_plane": 0.1}, obsynth.conditions.half_plane(0.1)], ids=["by name", "as a region"]
)
def test_a_region_beside_what_its_inequality_knows_nothing_of_is_refused(region: Any, beside: dict[str, Any]) -> None:
    plant = obsynth.DescriptorSystem(A=[[-1.0, 0.2], [0.1, -2.0]], C=np.eye(2), Bf=[[1.0], [0.0]])
    with pytest.raises(obsynth.SpecError, match=f"region cannot be combined with {next(iter(beside))}"):
        obsynth.pd_observer(plant, region=region, **beside)


def test_white_noise_in_a_constraint_is_named_where_outputs_would_differentiate_it() -> None:
    plant = obsynth.DescriptorSystem(
        np.diag([1.0, 1.0, 0.0]), [[-1.0, 0.5, 0.4], [0.0, -2.0, -0.2], [-0.2, -0.2, 0.0]],
        C=[[1.0, 0.0, 1.5], [1.0, -1.5, 1.0]], Bf=[[1.0], [0.5], [0.0]], Bw=[[0.1], [0.0], [-0.1]], Dw=np.zeros((2, 1)),
    )  # fmt: skip
    with pytest.raises(
        obsynth.PreconditionError, match=r"need the derivative of 'w1', white noise in a constraint\. Leave that"
    ):
        obsynth.pd_observer(plant)
    assert obsynth.pd_observer(plant.replace(Bw=None, Dw=None, noise_names=None)).report.passed


def test_a_rank_that_e_itself_excludes_is_unclear_and_no_lost_mode(monkeypatch: pytest.MonkeyPatch) -> None:
    # Of a network of 565 states over 40 decades a staircase made normal rank 564.
    def one_short(E: FloatArray, A: FloatArray) -> FiniteZeros:
        return FiniteZeros(np.zeros(0, dtype=np.complex128), E.shape[1] - 1, ())

    monkeypatch.setattr(statements, "finite_zeros", one_short)
    plant = obsynth.DescriptorSystem(A=[[-1.0, 0.5], [0.0, -2.0]], C=[[1.0, 0.0]], Bf=[[1.0], [0.0]])
    last = pd_observer_conditions(plant, exactly=False)[-1]
    assert not last.holds
    assert last.unclear
    assert "too many decades apart" in last.detail
