"""Gains so large that rounding of the outputs drowns a unit fault are no design."""

from dataclasses import replace

import numpy as np
import pytest

from obsynth import DescriptorSystem, PreconditionError, ui_pi_observer
from obsynth.methods.drowned_designs import require_above_rounding

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
