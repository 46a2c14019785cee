"""Public functions of the method ``fault-estimation-filter``."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from numpy.typing import ArrayLike

from obsynth.analysis.transformations.recovery import Transformation, linear_plant
from obsynth.errors import SpecError
from obsynth.methods.designing import design_of_given_gains
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import ObserverDesign


def fault_estimation_filter_from_gains(
    plant: DescriptorSystem | Transformation,
    *,
    T: ArrayLike,
    N: ArrayLike,
    L: ArrayLike,
    W: ArrayLike,
    gamma: float | None = None,
    indexes: Sequence[int] | None = None,
    name: str = "design from gains",
) -> ObserverDesign:
    """Put gains from a paper or another program into a design, with its report; nothing is refused.

    Parameters
    ----------
    plant : DescriptorSystem or Transformation
        As for `fault_estimation_filter`.
    T, N, L, W : array_like
        ``(nx, nx)``, ``(nx, ny)``, ``(nx, ny)``, ``(nf, ny)`` of eq. (23).
    gamma : float, optional, dimensionless
        Claimed bound on the l2 gain; needed when the plant has disturbances.
    indexes : sequence of int, optional
        Detectability index ``rho_i`` of each fault (19): samples by which its estimate lags.  Found from T by default,
        which needs all of its digits: where an index is above one, ``C T f_i`` must vanish, and with a rounded T it
        does not.
    name : str, optional
        Name of the design.

    Returns
    -------
    ObserverDesign
        Its report may hold failed checks: look at ``report.passed``, or call `obsynth.verify` with the number of
        printed digits.

    Raises
    ------
    SpecError
        A gain has the wrong shape, gamma is missing, or ``indexes`` are not one positive number for each fault.
    PreconditionError
        No filter exists for this plant.

    References
    ----------
    .. [Wang2015] Fault estimation filter design for discrete-time descriptor systems, eq. (23).
    """
    from obsynth.methods.fault_estimation_filter.realisation import synthesis_from_gains

    if linear_plant(plant).nd and gamma is None:
        raise SpecError(
            "gamma is needed: the plant has disturbances, and a gain set claims a bound on them.", path="gamma"
        )
    synthesis = partial(synthesis_from_gains, T=T, N=N, L=L, W=W, gamma=gamma, indexes=indexes)
    return design_of_given_gains(plant, "fault-estimation-filter", synthesis, name=name)
