"""Public functions of the method ``ui-pi-observer``."""

from __future__ import annotations

from functools import partial
from typing import Any

from numpy.typing import ArrayLike

from obsynth.analysis.transformations.recovery import Transformation
from obsynth.methods.designing import design_of_given_gains
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import ObserverDesign


def ui_pi_observer_from_gains(
    plant: DescriptorSystem | Transformation,
    *,
    U: ArrayLike,
    D: ArrayLike,
    K: ArrayLike,
    F: ArrayLike,
    fault_model: Any = "step",
    name: str = "design from gains",
) -> ObserverDesign:
    """Put gains from a paper or another program into a design, with its report; nothing is refused.

    Parameters
    ----------
    plant : DescriptorSystem or Transformation
        As for `ui_pi_observer`.
    U, D, K, F : array_like
        ``(nx, nx)``, ``(nx, ny)``, ``(nx, ny)`` of eqs. (11), (12), and ``(nw, ny)`` of (23).
    fault_model : str, mapping or FaultModel, optional
        As for `ui_pi_observer`.
    name : str, optional
        Name of the design.

    Returns
    -------
    ObserverDesign
        Its report may hold failed checks: look at ``report.passed``, or call `obsynth.verify` with the number of
        printed digits (dimensionless).

    Raises
    ------
    SpecError
        A gain has the wrong shape, or the fault model is malformed.

    References
    ----------
    .. [SharePasand] Unknown Input-Proportional Integral Observer for Singular Systems, eqs. (4), (19)-(23).
    """
    from obsynth.methods.ui_pi_observer.synthesis import synthesis_from_gains

    synthesis = partial(synthesis_from_gains, U=U, D=D, K=K, F=F, fault_model=fault_model)
    return design_of_given_gains(plant, "ui-pi-observer", synthesis, name=name)
