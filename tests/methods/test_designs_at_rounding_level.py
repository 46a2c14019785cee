"""Gains so large that rounding of the outputs hides a unit fault are no design."""

import re
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from benchmarks.campaigns.static_and_chains import plant_of

import obsynth
from obsynth import DescriptorSystem, PreconditionError, VerificationError, ui_pi_observer
from obsynth.methods.rounding import last_digits, require_above_rounding
from obsynth.proofs.exact_doubles import stored_matrix

PLANT = DescriptorSystem(None, [[-1.0, 0.5], [0.0, -2.0]], C=np.eye(2), Bf=[[1], [0]])


def test_ordinary_designs_are_far_above_rounding():
    require_above_rounding(PLANT, ui_pi_observer(PLANT).observer)


@pytest.mark.parametrize("units", [1e-9, 1.0, 1e9])
def test_cancelling_gains_are_refused_in_all_units(units):
    observer = ui_pi_observer(PLANT).observer
    # The residual of y2 is zero along every solution; any multiple of it may be added to the estimate of the fault.
    share = np.zeros_like(observer.Dy)
    share[observer.fault_rows] = [[0.0, 1e17]]
    broken = replace(observer, Dy=observer.Dy + share)
    coupled = PLANT.replace(A=[[-1.0, 0.5], [0.5, -2.0]], Bf=units * PLANT.Bf)
    scaled = replace(broken, Dy=broken.Dy / units, Cz=broken.Cz)
    with pytest.raises(PreconditionError, match=r"^Unclear: .*rounding of the outputs.*'f1'") as error:
        require_above_rounding(coupled, scaled)
    assert error.value.condition == "gains against rounding"
    assert "Tolerance: 1e-16 of the largest scaled entry. Witness: the plant with entry (" in str(error.value)
    assert "would decide it." in str(error.value)


def test_the_last_digit_that_is_named_moves_the_estimate_by_so_much():
    observer = ui_pi_observer(PLANT).observer
    share = np.zeros_like(observer.Dy)
    share[observer.fault_rows] = [[2.0**56, 2.0**57]]
    coupled = PLANT.replace(A=[[-1.0, 0.5], [0.5, -2.0]])
    broken = replace(observer, Dy=observer.Dy + share)
    found = {witness.changes[0].matrix: witness for witness in last_digits(coupled, broken, 0, 0j)}
    assert set(found) == {"C", "By", "Dy"}
    (change,) = found["C"].changes

    def estimate(c):
        """The settled estimate of a unit fault, in rational numbers."""
        still, az = (stored_matrix(matrix) for matrix in (-coupled.A, -broken.Az))
        y = stored_matrix(c) * still.solve(stored_matrix(coupled.Bf))
        z = az.solve(stored_matrix(broken.By) * y)
        rows = [stored_matrix(matrix[broken.fault_rows]) for matrix in (broken.Cz, broken.Dy)]
        value = (rows[0] * z + rows[1] * y)[0, 0]
        return Fraction(int(value.p), int(value.q))

    changed = coupled.C.copy()
    assert Fraction(changed[change.row, change.column]) == change.before
    changed[change.row, change.column] = float(change.after)
    moved = abs(estimate(changed) - estimate(coupled.C))
    assert float(moved) == pytest.approx(found["C"].size, rel=1e-9)
    assert moved >= 1


def chain(order: int, inside: float, link: float) -> DescriptorSystem:
    """States in a row with one pole near the boundary; the fault drives the last, a sensor reads the first."""
    a = (1.0 - inside) * np.eye(order) + link * np.eye(order, k=1)
    return DescriptorSystem(A=a, C=np.eye(order)[[0, order - 2]], Bf=np.eye(order)[:, [-1]], dt=1.0)


def drift_in_operation(design: obsynth.ObserverDesign, samples: int = 1000) -> float:
    """How far the estimate of a constant unit fault is off, begun where it stays, run in double precision."""
    plant, observer = design.plant, design.observer
    state = stored_matrix(plant.E - plant.A).solve(stored_matrix(plant.Bf))
    seen = stored_matrix(plant.C) * state + stored_matrix(plant.Df)
    inner = stored_matrix(np.eye(observer.order)) - stored_matrix(observer.Az)
    settled = inner.solve(stored_matrix(observer.By) * seen)
    y, z = ([float(Fraction(int(entry.p), int(entry.q))) for entry in part.entries()] for part in (seen, settled))
    found = observer.run(np.tile(y, (samples, 1)), initial_state=z)
    return float(np.max(np.abs(found.faults - 1.0)))


@pytest.mark.long
def test_rounding_in_operation_under_a_constant_fault_is_limited() -> None:
    """Right to 1e-13 in exact arithmetic, and without a bound on what rounding does as it runs: that is refused."""
    good, bad = chain(4, 0.3, 0.5), plant_of(1213)
    ordinary = ui_pi_observer(good)
    assert drift_in_operation(ordinary) <= ordinary.report["constant fault"].value < 1e-9
    with pytest.raises(VerificationError, match="was tried with its defaults and is verified for this plant") as error:
        ui_pi_observer(bad)
    (row,) = error.value.report.failures
    assert row.name == "constant fault"
    assert row.value > 1.0
    exact = float(re.search(r"together: ([0-9.e-]+) in exact arithmetic", row.detail).group(1))
    assert exact < 1e-9
    other = obsynth.functional_filter(bad)
    assert drift_in_operation(other) <= other.report["constant fault"].value < 1e-3


@pytest.mark.parametrize("seed", [3008, 3014, 3028, pytest.param(3034, marks=pytest.mark.long), 3035])
def test_what_is_verified_is_right_in_operation(seed: int) -> None:
    plant = plant_of(seed)
    for method in ("ui-pi-observer", "fault-estimation-filter", "functional-filter"):
        try:
            design = obsynth.design(plant, method)
        except obsynth.ObsynthError:
            continue
        row = design.report["constant fault"]
        assert row.value <= 1e-3
        # An observer that takes more than 1e5 samples to settle is judged in exact arithmetic, and its row says so.
        if "is not counted" not in row.detail:
            assert drift_in_operation(design) <= row.value, method


@pytest.mark.long
def test_where_no_method_is_right_at_constant_faults_none_is_named() -> None:
    plant = plant_of(1180)
    with pytest.raises(VerificationError, match="No other method that estimates faults is verified") as error:
        ui_pi_observer(plant)
    assert {row.name for row in error.value.report.failures} == {"constant fault"}
    for other in ("functional-filter", "fault-estimation-filter", "optimal-filter"):
        with pytest.raises(obsynth.ObsynthError):
            obsynth.design(plant, other)


def test_gains_that_rounding_moves_too_far_are_refused_with_the_error_that_they_reach() -> None:
    """The fault of a chain of masses is seen by 1e-5 within a sample: rounding moves the estimate by a thousandth."""
    stiffness = np.array([[2.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 1.0]])
    masses = DescriptorSystem(
        A=np.block([[np.zeros((3, 3)), np.eye(3)], [-stiffness, -0.1 * stiffness]]),
        C=np.eye(6)[:2],
        Bf=np.eye(6)[:, 5:],
        Dw=0.001 * np.eye(2),
    )
    plant = obsynth.discretise(masses, 0.1)
    with pytest.raises(VerificationError, match=r"may miss .* of a constant fault, above 0\.001 ") as error:
        obsynth.fault_estimation_filter(plant)
    assert "badly scaled" not in str(error.value)
    (offered,) = re.findall(r"With steady_error_limit=([0-9.e-]+), which was tried", str(error.value))
    limit = float(offered)
    design = obsynth.fault_estimation_filter(plant, steady_error_limit=limit)
    assert 1e-3 < design.report["constant fault"].value <= limit
    (instead,) = re.findall(r"([a-z-]+) was tried with its defaults and is verified", str(error.value))
    assert obsynth.design(plant, instead).report.passed


@pytest.mark.parametrize("dt", [0.0, 0.1])
def test_nothing_is_said_of_rounding_in_a_steady_state_that_a_plant_has_not(dt: float) -> None:
    """The angle that a torque turns never stays: what rounding did there was that of the pole."""
    swing = DescriptorSystem(
        A=[[0.0, 1.0, 0.0], [-0.3, -0.5, 0.3], [0.1, 0.0, -0.1]],
        C=[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        Bf=[[0.0], [1.0], [0.0]],
        dt=0.0,
    )
    # A rotation that leaves the pole at zero only to rounding.
    turned, _ = np.linalg.qr(np.array([[1.0, 2.0, 3.0], [0.3, 1.0, 0.2], [0.7, 0.1, 1.0]]))
    plant = swing.replace(A=turned.T @ swing.A @ turned, C=swing.C @ turned, Bf=turned.T @ swing.Bf)
    if dt:
        plant = obsynth.discretise(plant, dt).plant
    design = obsynth.design(plant, "ui-pi-observer")
    assert "does not settle with such a fault" in design.report["constant fault"].detail
    assert not any("is constant, rounding" in note for note in design.notes)
