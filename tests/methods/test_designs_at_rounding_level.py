"""Gains so large that rounding of the outputs hides a unit fault are no design."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from obsynth import DescriptorSystem, PreconditionError, ui_pi_observer
from obsynth.methods.refusals import last_digits, require_above_rounding
from obsynth.proofs.exact_arithmetic import stored_matrix

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
