"""A continuous observer sampled by a first-order hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arguments import arguments_checked, real_number
from obsynth.numerics.continuous import first_order_hold
from obsynth.observers.linear.observer import LinearObserver


@arguments_checked
def sample_observer(observer: LinearObserver, dt: float) -> LinearObserver:
    r"""Sample a continuous-time observer by a first-order hold.

    Exact for known inputs and outputs that are linear between samples: with v = [u; y],

    .. math::
        z_{k+1} = \Phi z_k + \Gamma_0 v_k + \Gamma_1 (v_{k+1} - v_k), \qquad \xi_k = z_k - \Gamma_1 v_k

    and the state that is kept is :math:`\xi`, so that no sample is needed in advance.

    Parameters
    ----------
    observer : LinearObserver
        Continuous time (``dt == 0``).
    dt : float
        Seconds between samples, positive.

    Returns
    -------
    LinearObserver
        Of the same order and with the same signals; a start at rest means ``z(0) = Gamma_1 v(0)``.

    Raises
    ------
    SpecError
        The observer is discrete in time already, or ``dt`` is not positive and finite.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(A=[[-1.0, 0.5], [0.0, -2.0]], C=[[1, 0], [0, 1]], Bf=[[1], [0]])
    >>> observer = obsynth.sample_observer(obsynth.pd_observer(plant, decay=2.0).observer, 0.01)
    >>> observer.dt, observer.order
    (0.01, 3)
    """
    if observer.dt > 0.0:
        raise SpecError(f"The observer is discrete in time already (dt = {observer.dt:g} s).", path="dt")
    real_number(dt, "dt", "the seconds between two samples, a positive number", above=0.0)
    inputs = len(observer.input_names)
    b, d = np.hstack([observer.Bu, observer.By]), np.hstack([observer.Du, observer.Dy])
    transition, constant, ramp = first_order_hold(observer.Az, b, dt)
    into, through = transition @ ramp + constant - ramp, d + observer.Cz @ ramp
    return replace(
        observer,
        Az=transition,
        Bu=into[:, :inputs],
        By=into[:, inputs:],
        Du=through[:, :inputs],
        Dy=through[:, inputs:],
        dt=dt,
    )
