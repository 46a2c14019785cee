"""A discrete-time observer from a continuous-time one, for data that come in samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arguments import is_finite_number, require_kind
from obsynth.numerics.holds import first_order_hold
from obsynth.observers.linear.observer import LinearObserver


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
    """
    require_kind(observer, LinearObserver, "observer", "the LinearObserver of a continuous design")
    if observer.dt > 0.0:
        raise SpecError(f"The observer is discrete in time already (dt = {observer.dt:g} s).", path="dt")
    if not (is_finite_number(dt) and dt > 0.0):
        raise SpecError(f"dt is {dt!r}: give the seconds between two samples, a positive number.", path="dt")
    inputs = len(observer.input_names)
    b, d = np.hstack([observer.Bu, observer.By]), np.hstack([observer.Du, observer.Dy])
    transition, constant, ramp = first_order_hold(observer.Az, b, dt)
    into, through = transition @ ramp + constant - ramp, d + observer.Cz @ ramp
    return replace(
        observer, Az=transition, Bu=into[:, :inputs], By=into[:, inputs:], Du=through[:, :inputs],
        Dy=through[:, inputs:], dt=dt,
    )  # fmt: skip
