"""State-space systems of python-control and of scipy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.importing.roles import plant_of
from obsynth.numerics.extras import imported
from obsynth.plants.descriptor import DescriptorSystem


def from_control(
    system: Any,
    *,
    E: ArrayLike | None = None,
    dt: float | None = None,
    faults: Sequence[str] = (),
    disturbances: Sequence[str] = (),
    actuator_faults: Sequence[str] = (),
    sensor_faults: Sequence[str] = (),
    **plant: Any,
) -> DescriptorSystem:
    """Return the plant of a system of python-control, with its labels.

    Parameters
    ----------
    system : control.StateSpace or control.TransferFunction
        A transfer function is realised by ``control.ss``.
    E : array_like, optional
        ``(nx, nx)``: python-control has none; ``None`` means the identity.
    dt : float, optional, seconds
        Sampling time; needed where the system's own is ``True``, which only says that there is one.  A system whose
        ``dt`` is ``None`` is continuous.
    faults, disturbances : list of str
        Inputs of the system that are faults, or unknown; the others are known inputs.
    actuator_faults : list of str
        Known inputs on which a fault acts: adds ``fault of <input>``.
    sensor_faults : list of str
        Outputs with a bias: adds ``bias of <output>``.
    **plant
        Any other argument of `DescriptorSystem`, such as ``sensor_noise``, ``Bd`` or ``operating_point``.

    Returns
    -------
    DescriptorSystem
        With ``state_labels``, ``input_labels`` and ``output_labels`` as names.

    Raises
    ------
    SpecError
        It is no linear system, python-control is not installed, a name is unknown, or the sampling time is missing.
    """
    control = imported("control", extra=None)
    if isinstance(system, control.TransferFunction):
        system = control.ss(system)
    if not isinstance(system, control.StateSpace):
        raise SpecError(f"system is a {type(system).__name__}: give a control.StateSpace, such as control.ss(...).",
                        path="system")  # fmt: skip
    own = system.dt
    if own is True and dt is None:
        raise SpecError("The system is sampled, but does not say how fast: give dt in seconds.", path="dt")
    labels = {"state_names": system.state_labels, "input_names": system.input_labels,
              "output_names": system.output_labels}  # fmt: skip
    return plant_of(
        {"E": E, "A": system.A, "B": system.B, "C": system.C, "D": system.D}, labels=labels, faults=faults,
        disturbances=disturbances, actuator_faults=actuator_faults, sensor_faults=sensor_faults,
        more={"dt": _sampling_time(own, dt), **plant},
    )  # fmt: skip


def from_scipy(
    system: Any,
    *,
    E: ArrayLike | None = None,
    input_names: Sequence[str] | None = None,
    output_names: Sequence[str] | None = None,
    faults: Sequence[str] = (),
    disturbances: Sequence[str] = (),
    actuator_faults: Sequence[str] = (),
    sensor_faults: Sequence[str] = (),
    **plant: Any,
) -> DescriptorSystem:
    """Return the plant of a linear system of ``scipy.signal``.

    Parameters
    ----------
    system : scipy.signal.lti or scipy.signal.dlti
        A ``StateSpace``, or what ``to_ss`` makes into one.
    E : array_like, optional
        ``(nx, nx)``: scipy has none; ``None`` means the identity.
    input_names, output_names : list of str, optional
        Of all inputs and outputs of the system; ``u1, u2, ...`` and ``y1, y2, ...`` by default.
    faults, disturbances : list of str
        Inputs of the system that are faults, or unknown; the others are known inputs.
    actuator_faults : list of str
        Known inputs on which a fault acts: adds ``fault of <input>``.
    sensor_faults : list of str
        Outputs with a bias: adds ``bias of <output>``.
    **plant
        Any other argument of `DescriptorSystem`, such as ``state_names``.

    Returns
    -------
    DescriptorSystem
        Continuous, or with the ``dt`` of the system.

    Raises
    ------
    SpecError
        It is no linear system of scipy, a name is unknown, or a discrete system does not say its ``dt``.
    """
    signal = imported("scipy.signal", extra=None)
    if not isinstance(system, (signal.lti, signal.dlti)):
        raise SpecError(f"system is a {type(system).__name__}: give a scipy.signal.StateSpace.", path="system")
    state_space = system.to_ss()
    own = state_space.dt
    dt = plant.pop("dt", None)
    if own is True and dt is None:
        raise SpecError("The system is sampled, but does not say how fast: give dt in seconds.", path="dt")
    return plant_of(
        {"E": E, **{name: np.asarray(getattr(state_space, name)) for name in "ABCD"}},
        labels={"state_names": None, "input_names": input_names, "output_names": output_names}, faults=faults,
        disturbances=disturbances, actuator_faults=actuator_faults, sensor_faults=sensor_faults,
        more={"dt": _sampling_time(own, dt), **plant},
    )  # fmt: skip


def _sampling_time(own: Any, given: float | None) -> float:
    """Return the sampling time: ``None`` is continuous, ``True`` unsaid; two that differ are refused."""
    if own is None or own is True:
        return 0.0 if given is None else given
    if given is not None and given != own:
        raise SpecError(f"dt is {given}, but the system has dt = {own}: leave dt out.", path="dt")
    return float(own)
