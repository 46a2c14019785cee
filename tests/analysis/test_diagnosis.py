"""What can be diagnosed: exact truths, counterexamples to shortcuts, units, and sentences."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from networks import random_network

import obsynth
from obsynth.analysis.diagnosis.decoupled import decoupled, unknowns_pencil
from obsynth.analysis.diagnosis.exact_fault_columns import DecoupledFaults, decoupled_fault
from obsynth.analysis.diagnosis.hidden_motions import hidden_motion, hiding_amplitudes
from obsynth.analysis.diagnosis.without_unknown_inputs import PencilUnits
from obsynth.numerics.ranks import TRACE_TOLERANCE, decide_rank

CASES = Path(__file__).parents[1] / "data" / "cases"


def motor(*, two_encoders: bool) -> obsynth.DescriptorSystem:
    """A motor, a flexible shaft and a load; torque fault, unknown load torque."""
    measured = ["theta m", "theta l", "i"] if two_encoders else ["theta m", "i"]
    return obsynth.DescriptorSystem(
        np.diag([1, 0.01, 1, 0.05, 0]),
        [[0, 1, 0, 0, 0], [-50, -0.06, 50, 0.05, 0.5], [0, 0, 0, 1, 0], [50, 0.05, -50, -0.07, 0], [0, -0.5, 0, 0, -1]],
        [[0], [0], [0], [0], [1]],
        measured,
        Bf=["omega m"],
        Bd=["omega l"],
        state_names=["theta m", "omega m", "theta l", "omega l", "i"],
        fault_names=["torque"],
        disturbance_names=["load torque"],
        input_names=["voltage"],
    )


def in_other_units(plant: obsynth.DescriptorSystem, seed: int) -> tuple[obsynth.DescriptorSystem, float]:
    """The same plant with every signal, every equation and the time in other units; and the factor of s."""
    rng = np.random.default_rng(seed)
    x, e, u, y, f, d = (
        10.0 ** rng.uniform(-4, 4, size=n) for n in (plant.nx, plant.nx, plant.nu, plant.ny, plant.nf, plant.nd)
    )
    time = 1.0 if plant.dt else 10.0 ** rng.uniform(-3, 3)
    return plant.replace(
        E=e[:, None] * plant.E * x * time, A=e[:, None] * plant.A * x, B=e[:, None] * plant.B * u,
        C=y[:, None] * plant.C * x, D=y[:, None] * plant.D * u, Bf=e[:, None] * plant.Bf * f,
        Df=y[:, None] * plant.Df * f, Bd=e[:, None] * plant.Bd * d, Dd=y[:, None] * plant.Dd * d,
        Bw=None, Dw=None, noise_names=None,
    ), 1.0 / time  # fmt: skip


def test_motor_with_one_encoder_names_the_load_and_the_sensor() -> None:
    found = obsynth.diagnose(motor(two_encoders=False))
    torque = found["torque"]
    assert found.exact
    assert (torque.detectable, torque.estimable, torque.step_estimable) == (False, False, False)
    text = str(found)
    assert "a step of 1 in torque and a step of -1 in load torque and states theta l = -0.02 cancel at" in text
    assert "Measure one of: theta l." in text
    assert "omega l would make it detectable, but not estimable." in text


def test_motor_with_two_encoders() -> None:
    torque = obsynth.diagnose(motor(two_encoders=True), frequencies=[0.0, 3.0])["torque"]
    assert torque.estimable
    assert torque.step_estimable
    assert torque.detectable_at == {0.0: True, 3.0: True}
    assert (torque.order, torque.residual_order, torque.filter_order) == (1, 1, 2)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("two_encoders", [False, True])
def test_units_decide_nothing(seed: int, two_encoders: bool) -> None:
    plant = motor(two_encoders=two_encoders)
    other, _ = in_other_units(plant, seed)
    a, b = obsynth.diagnose(plant)["torque"], obsynth.diagnose(other, suggest=False)["torque"]
    assert not b.exact
    assert (a.detectable, a.estimable, a.step_estimable, a.order, a.filter_order, a.residual_order) == (
        b.detectable, b.estimable, b.step_estimable, b.order, b.filter_order, b.residual_order,
    )  # fmt: skip


@pytest.mark.parametrize("units", [(1.0, 1.0, 1.0), (2.0**-13, 2.0**3, 2.0**19), (1e5, 1e-6, 1.0)])
def test_units_of_outputs_change_no_delay(units: tuple[float, float, float]) -> None:
    # Sensors of one state, which the fault reaches a sample later: none is free of noise in any unit.
    e, a = np.diag([1.0, 1.0, 0.0]), [[-0.1 / 3, 0, 0], [0, -0.3, 0.2], [-0.1, 0, 0.4]]
    c = np.array([[1.7, 0, 0], [-1.3, 0, 0], [0.5, 0, 0]])
    plant = obsynth.DescriptorSystem(e, a, C=np.array(units)[:, None] * c, Bf=[[-1.9], [0.7], [0.4]], dt=0.1)
    found = obsynth.diagnose(plant)["f1"]
    assert not found.exact
    assert (found.order, found.filter_order) == (1, 1)


def test_a_rank_at_the_point_is_not_enough() -> None:
    # y = s/(s+1) f: M_W loses rank at s = 0 itself, so the rank test there passes; a constant fault is hidden.
    plant = obsynth.DescriptorSystem(
        None, [[0, 0], [0, -1]], None, [[1, 0], [0, 1]], Bf=[[-1], [0]], Bd=[[0], [1]],
    )  # fmt: skip
    assert obsynth.diagnose(plant)["f1"].step_estimable
    hidden = obsynth.DescriptorSystem(None, [[-1.0]], None, [[1.0]], Bf=[[-1.0]], Df=[[1.0]])
    found = obsynth.diagnose(hidden)["f1"]
    assert found.detectable
    assert not found.detectable_at_rest
    assert "a step of 1 in f1 " in found.sentences[0]


def test_estimating_may_take_more_sensors_than_signals() -> None:
    # Numerators (s-1)(s-2), (s-2)(s-3), (s-1)(s-3) over (s+1)^3: only all three sensors estimate one fault.
    rows = [np.poly([1, 2]), np.poly([2, 3]), np.poly([1, 3])]
    a = np.array([[-3.0, -3.0, -1.0], [1, 0, 0], [0, 1, 0]])
    for kept, expected in (((0, 1), False), ((0, 2), False), ((1, 2), False), ((0, 1, 2), True)):
        plant = obsynth.DescriptorSystem(None, a, None, [rows[i] for i in kept], Bf=[[1], [0], [0]])
        assert obsynth.diagnose(plant, suggest=False)["f1"].estimable is expected


def test_exact_constraints_cost_no_derivative() -> None:
    # Index 2: x1 = 0 is exact, so its derivative x2 + f = 0 is free, and y = x2 shows f at once.
    plant = obsynth.DescriptorSystem(
        [[1, 0], [0, 0]], [[0, 1], [1, 0]], None, [[0, 1]], Bf=[[1], [0]],
    )  # fmt: skip
    found = obsynth.diagnose(plant)["f1"]
    assert found.order == 0


@pytest.mark.parametrize("shift", [0.0, 1e-9])
def test_multiple_zeros_on_the_boundary_are_exact(shift: float) -> None:
    # y = (s - shift)^4 / (s + 1)^4 f: rounding scatters the four zeros by 1e-4, the verdict must not follow.
    numerator, denominator = np.poly([shift] * 4), np.poly([-1] * 4)
    a = np.vstack([-denominator[1:], np.eye(3, 4)])
    plant = obsynth.DescriptorSystem(
        None, a, None, [numerator[1:] - denominator[1:]], Bf=[[1], [0], [0], [0]], Df=[[1.0]]
    )
    found = obsynth.diagnose(plant, suggest=False)["f1"]
    assert not found.estimable


def test_pairs_and_banks() -> None:
    # Two faults through one path cannot be distinguished; a third one can.
    plant = obsynth.DescriptorSystem(
        None, np.diag([-1.0, -2.0]), None, np.eye(2), Bf=[[1, 2, 0], [0, 0, 1]], fault_names=["a", "b", "c"],
    )  # fmt: skip
    found = obsynth.diagnose(plant, suggest=False)
    assert found.isolable.tolist() == [[True, False, True], [False, True, True], [True, True, True]]
    assert {residual.sees for residual in found.bank} == {("c",), ("a", "b"), ("a", "b", "c")}
    assert found["a"].sentences[0].startswith("a: detectable, but not distinguishable from b, c")


def test_singular_pencils_are_answered_by_name() -> None:
    plant = obsynth.DescriptorSystem(
        [[1, 0], [0, 0]], [[-1, 0], [0, 0]], None, [[1, 0], [0, 1]], Bf=[[1], [0]],
    )  # fmt: skip
    found = obsynth.diagnose(plant, suggest=False)
    assert found["f1"].estimable
    assert any("not regular" in warning for warning in found.warnings)


def test_decoupled_plant_is_blind_and_exact() -> None:
    plant = motor(two_encoders=True)
    found = obsynth.decouple(plant)
    k = found.order
    assert k == 2
    equations, outputs = found.rows[:, : plant.nx], found.rows[:, plant.nx :]
    size = np.abs(equations) @ np.abs(plant.A) + np.abs(outputs) @ np.abs(plant.C)
    assert np.max(np.abs(equations[k:] @ plant.E)) < 1e-15
    left = equations @ plant.A + outputs @ plant.C
    assert np.max(np.abs(left - np.vstack([found.A, found.C]) @ found.states) / size.max(axis=1)[:, None]) < 1e-13
    assert np.max(np.abs(equations @ plant.Bd + outputs @ plant.Dd)) < 1e-13
    assert found.plant.input_names == ("voltage", "measured theta m", "measured theta l", "measured i")


def test_decouple_refuses_unknown_names() -> None:
    with pytest.raises(obsynth.SpecError, match="no such fault; there are: torque"):
        obsynth.decouple(motor(two_encoders=True), without=["torgue"])
    with pytest.raises(obsynth.SpecError, match="cannot be kept and removed"):
        obsynth.decouple(motor(two_encoders=True), without=["torque"], faults=["torque"])


def test_exact_and_rounded_agree_on_random_integer_plants() -> None:
    rng = np.random.default_rng(18)
    for _ in range(40):
        n, ny, nd, nf = (int(rng.integers(low, high)) for low, high in ((1, 7), (1, 4), (1, 3), (1, 3)))

        def sparse(rows: int, columns: int) -> np.ndarray:
            return rng.integers(-2, 3, (rows, columns)) * (rng.random((rows, columns)) < 0.5)

        plant = obsynth.DescriptorSystem(
            sparse(n, n), sparse(n, n), sparse(n, 1), sparse(ny, n), Bf=sparse(n, nf), Bd=sparse(n, nd),
            dt=float(rng.integers(0, 2)),
        )  # fmt: skip
        for fault in range(nf):
            removed = tuple(j for j in range(nf) if j != fault)
            exact, rounded = (decoupled_fault(plant, removed, fault, way) for way in (True, False))
            assert exact.visible == rounded.visible
            if exact.visible:
                assert (len(exact.zeros), len(exact.blocking)) == (len(rounded.zeros), len(rounded.blocking))
                assert (exact.derivatives, exact.residual_order) == (rounded.derivatives, rounded.residual_order)
            assert exact.order == rounded.order


class TestManyFaultsAndStates:
    """What several questions rest on is computed once, and rows that repeat others are not kept."""

    @pytest.mark.parametrize("exactly", [True, False])
    def test_rows_that_repeat_others_are_not_kept(self, exactly: bool) -> None:
        """A state behind twelve integrators is known to be zero: the rows that say so were doubled by each of them."""
        import tracemalloc

        m = 12
        a = np.diag([1.0] * (m - 1) + [0.0], 1)
        a[m - 1, m - 1], a[m, 0] = -0.5, 1.0
        last = np.eye(m + 1)[:, [m - 1]]
        e = np.diag([1.0] * m + [0.0])
        plant = obsynth.DescriptorSystem(e, a, last, last.T, Bf=last, dt=0.1)
        tracemalloc.start()
        try:
            found = decoupled_fault(plant, (), 0, exactly)
            assert found.visible
            assert found.derivatives == 0  # the input and the output are known, and the state before it
            peak = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
        assert peak < 10e6  # 134 MB for the null space of 4,096 rows

    @pytest.mark.parametrize("exactly", [True, False])
    def test_questions_that_share_what_is_left_answer_as_if_asked_alone(self, exactly: bool) -> None:
        rng = np.random.default_rng(5)
        nx = 6
        a, bf, c = (rng.integers(-3, 4, size=shape) / 4 for shape in ((nx, nx), (nx, 3), (4, nx)))
        e = np.diag([1.0, 1.0, 1.0, 1.0, 1.0, 0.0])
        plant = obsynth.DescriptorSystem(e, a - 2.0 * np.eye(nx), C=c, Bf=bf, Bd=np.eye(nx)[:, :1])
        together = DecoupledFaults(plant, exactly)
        for removed in ((), (0,), (2, 1)):
            for number in set(range(3)) - set(removed):
                one, alone = together.of(removed, number), decoupled_fault(plant, removed, number, exactly)
                assert one is together.of(removed[::-1], number)
                for name in ("visible", "estimable", "shows_at_rest", "derivatives", "residual_order", "order"):
                    assert getattr(one, name) == getattr(alone, name), (removed, number, name)
                np.testing.assert_allclose(np.sort_complex(one.zeros), np.sort_complex(alone.zeros), rtol=1e-9)


@pytest.mark.parametrize(
    "error", [np.linalg.LinAlgError("SVD did not converge"), MemoryError("32.8 GiB"), OverflowError()]
)
def test_a_method_whose_numbers_fail_is_a_row_of_check_and_not_its_end(error, monkeypatch) -> None:
    from obsynth.methods.ui_pi_observer.method import UiPiObserver

    def failing(*_: object, **__: object) -> None:
        raise error

    plant = obsynth.DescriptorSystem(None, [[0.5]], C=[[1.0]], Bf=[[1.0]], dt=1.0)
    before = obsynth.check(plant)
    monkeypatch.setattr(UiPiObserver, "existence", failing)
    found = obsynth.check(plant)
    assert not found["ui-pi-observer"].passed
    assert "Unclear" in found["ui-pi-observer"].failures[0].detail
    assert {method: report.passed for method, report in found.items() if method != "ui-pi-observer"} == {
        method: report.passed for method, report in before.items() if method != "ui-pi-observer"
    }


@pytest.mark.parametrize(("faults", "said"), [(16, "obsynth.sensor_sets searches"), (2, "Measure one of: x1.")])
def test_what_would_help_many_faults_is_left_to_the_search_for_sensors(faults: int, said: str) -> None:
    states = 30
    a = 0.5 * np.eye(states) + 0.25 * np.eye(states, k=-1)
    plant = obsynth.DescriptorSystem(None, a, C=np.eye(states)[[-1]], Bf=np.eye(states)[:, :faults], dt=0.1)
    for fault in obsynth.diagnose(plant).faults:
        assert said in fault.sentences[-1]


def test_what_holds_no_derivative_holds_none_to_the_last_digit() -> None:
    """In a network of 126 states a long reduction left 3e-16 of equations in what only the sensors tell: the identities
    of a filter on it failed by 2e-4 of their terms."""
    network = random_network(576, 128, 7000)
    plant = obsynth.eliminate_algebraic_states(network.plant()).plant
    found = decoupled(plant, [1], [0])
    assert np.array_equal(plant.E, np.eye(plant.nx))
    assert len(found.C) == 26
    assert not found.rows[found.order :, : plant.nx].any()
    left = found.rows / PencilUnits.of(*unknowns_pencil(plant, [1])).rows
    assert np.all((left == 0.0) | (np.abs(left) > 1e-14))
    # Equations without derivatives stay where there are some: 0 = x1 + x2 - x3 is told by three sensors.
    given = obsynth.DescriptorSystem(
        np.diag([1.0, 2.0, 0.0]), [[0.5, 0.1, 0.0], [0.2, 0.3, 0.1], [1.0, 1.0, -1.0]], C=np.eye(3),
        Bf=np.eye(3)[:, :1], dt=1.0,
    )  # fmt: skip
    found = decoupled(given, [], [0])
    own = found.rows[found.order :, :3]
    assert np.abs(own).max() > 0.1
    assert np.abs(own @ given.E).max() < 1e-15
    whole = own @ given.A + found.rows[found.order :, 3:] @ given.C
    assert whole == pytest.approx(found.C @ found.states, abs=1e-14)


def test_no_motion_is_told_that_hides_nothing() -> None:
    """x+ = 0.5 x + f + d: y = x shows the fault wherever d is absent, and d = -1 hides it, whatever its course is."""
    given = {"A": [[0.5]], "C": [[1.0]], "Bf": [[1.0]], "dt": 1.0, "state_names": ["x"], "fault_names": ["f"]}
    shown = obsynth.DescriptorSystem(None, **given)
    hidden = obsynth.DescriptorSystem(None, **given, Bd=[[1.0]], disturbance_names=["d"])
    for point in (1.0 + 0.0j, 2.0 + 0.0j):
        assert hidden_motion(shown, 0, point, []) is None
        assert hiding_amplitudes(hidden, 0, point, []) == {"d": pytest.approx(-1.0)}


def fault_of(plant: obsynth.DescriptorSystem, *, exactly: bool):
    return decoupled_fault(plant, [], 0, exactly)


def test_a_fault_is_hidden_at_its_own_complex_zeros() -> None:
    """(s^2 - s + 0.5) / s^3 has its zeros at 0.5 +- 0.5i, not at -0.5 +- 0.5i."""
    plant = obsynth.DescriptorSystem(
        None, [[0, 1, 0], [0, 0, 1], [0, 0, 0]], C=[[0.5, -1.0, 1.0]], Bf=[[0], [0], [1]], dt=1.0
    )
    for exactly in (True, False):
        asked = fault_of(plant, exactly=exactly)
        assert not asked.shows_at(0.5 + 0.5j)
        assert asked.shows_at(-0.5 + 0.5j)
        assert asked.shows_at_rest  # at one: (1 - 1 + 0.5)


def test_slow_zeros_of_a_sampled_plant_stay_inside_whatever_the_units_of_s_are() -> None:
    """A zero at 0.02 is inside the unit circle, though balanced units make it 2; one at 1.5 of like poles is not."""
    for zero, blocking, at_rest in ((2.0, 0, True), (150.0, 1, True), (100.0, 1, False)):
        plant = obsynth.DescriptorSystem(None, [[0.0, 0.01], [0.0, 0.0]], C=[[-zero, 1.0]], Bf=[[0.0], [1.0]], dt=1.0)
        for exactly in (True, False):
            found = fault_of(plant, exactly=exactly)
            assert len(found.blocking) == blocking
            assert found.shows_at_rest == at_rest
            assert found.zeros == pytest.approx([0.01 * zero])


def test_the_gap_of_a_question_knows_how_small_a_trace_is() -> None:
    """Of a fault nearly along an unknown input little is left: that is less clear than every rank on the way."""
    plant = obsynth.DescriptorSystem(
        None, [[0.5, 0.1], [0.0, 0.2]], C=np.eye(2), Bf=[[0.0], [1.0]], Bd=[[1e-7], [1.0]], dt=1.0
    )
    found = fault_of(plant, exactly=False)
    assert found.leaves_trace
    assert found.gap == pytest.approx(found.trace / TRACE_TOLERANCE)
    assert found.gap < found.plant.thinnest.gap


def test_no_order_is_printed_for_a_filter_that_does_not_exist() -> None:
    hidden = obsynth.DescriptorSystem(A=[[0.5]], C=[[1.0]], Bf=[[1.0]], Bd=[[1.0]], dt=1.0)
    assert obsynth.diagnose(hidden).verdict_rows()[1] == ("f1", "no", "no", "no", "no", "-", "-", "-")


def test_a_rank_that_no_rounding_can_change_is_described_without_a_gap() -> None:
    assert decide_rank(np.diag([1.0, 0.0]), expected=2).describe() == "rank 1 of 2"
