"""The methods: one file per paper, and a registry of one line each."""

from __future__ import annotations

from importlib import import_module
from typing import Any

#: Method id -> module; each module offers ``conditions(plant)`` and ``synthesise(plant, **options)``.
REGISTRY = {
    "fault-estimation-filter": "obsynth.synthesis.methods.fault_estimation_filter",
    "pd-observer": "obsynth.synthesis.methods.pd_observer",
    "ui-pi-observer": "obsynth.synthesis.methods.ui_pi_observer",
    "descriptor-kalman": "obsynth.synthesis.methods.descriptor_kalman",
    "adaptive-observer": "obsynth.synthesis.methods.adaptive_observer",
    "dae-adaptive-observer": "obsynth.synthesis.methods.dae_adaptive_observer",
}
#: Methods that take plants whose matrices change with k.
TIME_VARYING = ("descriptor-kalman", "adaptive-observer")
#: Methods for nonlinear plants, and for no others.
NONLINEAR = ("dae-adaptive-observer",)


def method_module(method: str) -> Any:
    """Return the module of a method.

    Parameters
    ----------
    method : str
        A key of `REGISTRY`.

    Raises
    ------
    SpecError
        There is no such method; the known ones are listed.
    """
    from obsynth.errors import SpecError

    if method not in REGISTRY:
        raise SpecError(f"There is no method {method!r}; there are: {', '.join(REGISTRY)}.", path="method")
    return import_module(REGISTRY[method])
