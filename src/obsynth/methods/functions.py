"""The public function of each method, made from its class."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from inspect import Parameter, Signature, getdoc
from typing import Any

from obsynth.methods.designing import design
from obsynth.methods.method import Method
from obsynth.methods.registry import method_class
from obsynth.results.design import ObserverDesign


def design_function(method: type[Method]) -> Callable[..., ObserverDesign]:
    """Return the function that designs by a method: the plant, and its options by name.

    Signature and docstring are those of the class; some methods take a scenario besides.
    """

    def designed(plant: Any, **options: Any) -> ObserverDesign:
        return design(plant, method.id, **options)

    keyword = Parameter.KEYWORD_ONLY
    options = [Parameter(o.name, keyword, default=o.default, annotation=o.type) for o in fields(method)]
    if method.over_scenario:
        options.append(Parameter("scenario", keyword, default=None, annotation="Scenario | None"))
    options.append(Parameter("name", keyword, default="design", annotation="str"))
    given = Parameter("plant", Parameter.POSITIONAL_OR_KEYWORD)
    designed.__signature__ = Signature([given, *options], return_annotation="ObserverDesign")  # type: ignore[attr-defined]
    designed.__name__ = designed.__qualname__ = method.id.replace("-", "_")
    designed.__doc__ = getdoc(method)
    return designed


fault_estimation_filter = design_function(method_class("fault-estimation-filter"))
pd_observer = design_function(method_class("pd-observer"))
ui_pi_observer = design_function(method_class("ui-pi-observer"))
functional_filter = design_function(method_class("functional-filter"))
descriptor_kalman = design_function(method_class("descriptor-kalman"))
adaptive_observer = design_function(method_class("adaptive-observer"))
dae_adaptive_observer = design_function(method_class("dae-adaptive-observer"))
