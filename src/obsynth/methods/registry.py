"""The registry of methods: one line each."""

from __future__ import annotations

from importlib import import_module

from obsynth.errors import SpecError
from obsynth.methods.method_spec import MethodSpec, PlantKind

#: What a spec and `obsynth.design` call the choice between all methods that exist.
AUTO = "auto"
#: Method id -> where its declaration is; a method is its own folder and a line here.
REGISTRY: dict[str, str] = {
    "fault-estimation-filter": "obsynth.methods.fault_estimation_filter",
    "pd-observer": "obsynth.methods.pd_observer",
    "ui-pi-observer": "obsynth.methods.ui_pi_observer",
    "functional-filter": "obsynth.methods.functional_filter",
    "descriptor-kalman": "obsynth.methods.descriptor_kalman",
    "adaptive-observer": "obsynth.methods.adaptive_observer",
    "dae-adaptive-observer": "obsynth.methods.dae_adaptive_observer",
}


def method_spec(method: str) -> MethodSpec:
    """Return the declaration of a method; raise `SpecError` listing the known ones where there is none."""
    if method not in REGISTRY:
        raise SpecError(f"There is no method {method!r}; there are: {', '.join(REGISTRY)}.", path="method")
    found: MethodSpec = import_module(REGISTRY[method]).METHOD
    return found


def methods_for(kind: PlantKind) -> tuple[str, ...]:
    """Return the ids of the methods that take plants of a kind."""
    return tuple(method for method in REGISTRY if kind in method_spec(method).plants)
