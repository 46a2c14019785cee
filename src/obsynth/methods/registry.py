"""The methods: one file per paper, and a registry of one line each."""

from __future__ import annotations

from importlib import import_module
from typing import Any

#: Method id -> module; each module offers ``conditions(plant)`` and ``synthesise(plant, **options)``.
REGISTRY = {
    "fault-estimation-filter": "obsynth.methods.fault_estimation_filter.synthesis",
    "pd-observer": "obsynth.methods.pd_observer.synthesis",
    "ui-pi-observer": "obsynth.methods.ui_pi_observer.synthesis",
    "descriptor-kalman": "obsynth.methods.descriptor_kalman.synthesis",
    "adaptive-observer": "obsynth.methods.adaptive_observer.synthesis",
    "dae-adaptive-observer": "obsynth.methods.dae_adaptive_observer.synthesis",
}
#: Methods that take plants whose matrices change with k.
TIME_VARYING = ("descriptor-kalman", "adaptive-observer")
#: Methods for nonlinear plants, and for no others.
NONLINEAR = ("dae-adaptive-observer",)


def method_module(method: str) -> Any:
    """Return the module of a method."""
    from obsynth.errors import SpecError

    if method not in REGISTRY:
        raise SpecError(f"There is no method {method!r}; there are: {', '.join(REGISTRY)}.", path="method")
    return import_module(REGISTRY[method])
