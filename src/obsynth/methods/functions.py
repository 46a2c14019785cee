"""The public function of each method, made from its class."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from inspect import Parameter, Signature, getdoc
from typing import Any, TypeVar

from obsynth.errors import SpecError
from obsynth.methods.designing import design
from obsynth.methods.method import Method
from obsynth.methods.registry import method_class
from obsynth.numerics.arguments import argument_kinds, field_types, problem_with
from obsynth.plants.transformations.recovery import Transformation
from obsynth.results.design import ObserverDesign

Made = TypeVar("Made", bound=ObserverDesign)


def design_function(
    method: type[Method], result: type[Made] = ObserverDesign, *, positional: tuple[str, ...] = ()
) -> Callable[..., Made]:
    """Return the function that designs by a method: the plant, and its options by name.

    Signature and docstring are those of the class; some methods take a scenario besides.  ``result``: the class of what
    it returns; ``positional``: options that may be given without their names.
    """

    named, either = Parameter.KEYWORD_ONLY, Parameter.POSITIONAL_OR_KEYWORD
    first = [Parameter(name, either, default=None) for name in ("plant", *positional)]

    def designed(plant: Any, *values: Any, **options: Any) -> Made:
        own = plant.plant if isinstance(plant, Transformation) else plant
        if method.over_scenario and options.get("scenario") is not None and getattr(own, "uncertainty", None) is None:
            raise SpecError(
                "scenario is for plants whose constants have tolerances: it weighs their effects. State tolerances "
                "(obsynth.uncertain_system), or leave scenario out.",
                path="scenario",
            )
        bound = {**Signature(first).bind(plant, *values).arguments, **options}
        _require_kinds(method, bound)
        outcome = design(**bound, method=method.id)
        if isinstance(outcome, result):
            return outcome
        return result(**{part.name: getattr(outcome, part.name) for part in fields(outcome)})

    options = [
        Parameter(o.name, either if o.name in positional else named, default=o.default, annotation=o.type)
        for o in fields(method)
    ]
    if method.over_scenario:
        options.append(Parameter("scenario", named, default=None, annotation="Scenario | None"))
    options.append(Parameter("name", named, default="design", annotation="str"))
    signature = Signature([Parameter("plant", either), *options], return_annotation=result.__name__)
    designed.__signature__ = signature  # type: ignore[attr-defined]
    designed.__name__ = designed.__qualname__ = method.id.replace("-", "_")
    designed.__doc__ = getdoc(method)
    return designed


def _require_kinds(method: type[Method], arguments: dict[str, Any]) -> None:
    """Raise `SpecError` for all arguments of a wrong kind at once, where the plant or the name is one of them."""
    wrong = {name: text for name, kind in argument_kinds(design).items()
             if name in arguments and (text := problem_with(arguments[name], name, kind))}  # fmt: skip
    if not wrong:
        return
    kinds = field_types(method)
    wrong |= {
        name: text
        for name, kind in kinds.items()
        if name in arguments and (text := problem_with(arguments[name], name, kind))
    }
    function = method.id.replace("-", "_")
    message = next(iter(wrong.values())) if len(wrong) == 1 else f"Arguments of {function}:"
    raise SpecError(message, path=next(iter(wrong)), problems=tuple(wrong.values()) if len(wrong) > 1 else ())


fault_estimation_filter = design_function(method_class("fault-estimation-filter"))

pd_observer = design_function(method_class("pd-observer"))

ui_pi_observer = design_function(method_class("ui-pi-observer"))

functional_filter = design_function(method_class("functional-filter"))

descriptor_kalman = design_function(method_class("descriptor-kalman"))

adaptive_observer = design_function(method_class("adaptive-observer"))

extended_kalman = design_function(method_class("extended-kalman"))

dae_adaptive_observer = design_function(method_class("dae-adaptive-observer"))

region_observer = design_function(method_class("region-observer"))
