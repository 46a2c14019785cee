"""Registry of method classes by id, of obsynth and other packages, and which of them take a kind of plant."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any, TypeAlias

from obsynth.analysis.existence.condition import Condition
from obsynth.errors import SpecError, a_kind
from obsynth.methods.installed import OWN, REGISTRY, not_loadable
from obsynth.methods.method import Method, PlantKind
from obsynth.numerics.suggestions import suggestion
from obsynth.plants.dae import DAEModel
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.results.design import ObserverDesign
from obsynth.verification.error_system import ErrorModel

#: What a spec and `obsynth.design` call the choice between all methods that exist.
AUTO = "auto"

Plant: TypeAlias = DescriptorSystem | TimeVaryingDescriptorSystem | DAEModel | PolytopicSystem

_PLANT_KINDS: Mapping[PlantKind, tuple[type, str]] = {
    "time-invariant": (DescriptorSystem, "a linear plant with constant matrices"),
    "time-varying": (TimeVaryingDescriptorSystem, "a linear plant whose matrices change with k"),
    "nonlinear": (DAEModel, "a nonlinear DAEModel"),
    "polytopic": (PolytopicSystem, "a polytopic plant (PolytopicSystem)"),
}

__all__ = [
    "AUTO",
    "REGISTRY",
    "error_model",
    "kind_conditions",
    "kind_of",
    "method_class",
    "methods_for",
]


def method_class(method: str) -> type[Method]:
    """Return the class of a method; raise `SpecError` listing the known ones where there is none."""
    if method not in REGISTRY:
        plug_in = f" If a plug-in has it, install the package that provides {method}."
        raise SpecError(
            f"There is no method {method!r}.{suggestion(method, REGISTRY) or plug_in} "
            f"There are: {', '.join(REGISTRY)}.",
            path="method",
        )
    module, _, name = REGISTRY[method].partition(":")
    if method in OWN:
        own: type[Method] = getattr(import_module(module), name)
        return own
    try:
        loaded = getattr(import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise not_loadable(method, error) from error
    if not (isinstance(loaded, type) and issubclass(loaded, Method)) or loaded.id != method:
        raise not_loadable(method, f"it is no class derived from obsynth.methods.method.Method with the id {method!r}")
    return loaded


def error_model(design: ObserverDesign) -> ErrorModel:
    """Return what a linear design follows; raise `SpecError` where its certificate does not say it."""
    model = method_class(design.method).error_model(design)
    if model is None or not model.fits:
        raise SpecError(f"Design {design.name!r} has no tracking map: its residual has no model.", path="observer")
    if model.later:
        raise SpecError(
            f"The outputs of the plant of design {design.name!r} show inputs of later samples, and its filter reads "
            "them at once: its errors have no model without a delay.",
            path="observer",
        )
    return model


def follows_later_rows(design: ObserverDesign) -> bool:
    """Whether the errors of a linear design have a model only some samples later than its estimates."""
    model = method_class(design.method).error_model(design)
    return model is not None and model.later > 0


def methods_for(kind: PlantKind) -> tuple[str, ...]:
    """Return the ids of the methods that take plants of a kind."""
    return tuple(method for method in REGISTRY if kind in method_class(method).plants)


def kind_of(plant: Any) -> PlantKind:
    """Return the kind of a plant; raise `SpecError` for anything else."""
    for kind, (plant_type, _) in _PLANT_KINDS.items():
        if isinstance(plant, plant_type):
            return kind
    raise SpecError(
        f"The plant is {a_kind(plant)}: give an obsynth.DescriptorSystem, TimeVaryingDescriptorSystem, "
        "PolytopicSystem or DAEModel.",
        path="plant",
    )


def kind_conditions(plant: Plant, method: type[Method]) -> tuple[Condition, ...]:
    """Return the failing condition where a method does not take plants of this kind, else nothing."""
    kind = kind_of(plant)
    if kind in method.plants:
        return ()
    needed = " or ".join(_PLANT_KINDS[plant_kind][1] for plant_kind in method.plants)
    return (
        Condition(
            "kind of plant",
            f"{method.id} needs {needed}",
            False,
            0.0,
            1.0,
            method.id,
            f"{_PLANT_KINDS[kind][1]}; methods for such plants are: {', '.join(methods_for(kind))}.",
            of_the_method=True,
        ),
    )
