"""Method ``adaptive-observer``: states and parameters of a time-varying descriptor plant.

Source: A. Moussa Ali, Q. Zhang, Fault diagnosis for linear time-varying descriptor systems, IFAC ALCOSP 2013, (18).

Deviations:

1. The default learns from the whitened parity innovation of the filter: all ``rank`` directions of it, where (18f) sees
   only ``rank E + ny - nx`` of them (none in the paper's own example; the paper does not state this condition).
2. (18) as printed is form ``literal``: with the paper's values, refused where it has no residual direction.
3. States are reported after the correction ``xhat + Upsilon (theta(k+1) - theta(k))``; (18a) lags by one update.
4. The covariance of theta is carried besides S, which is none (4.8 times too large in the audit's example).
5. S is a triangle; a term ``(1 - lambda) M_reg`` or directional forgetting bounds it where excitation ends.
6. Parameters may walk randomly instead (the augmented Kalman filter).
7. Parameters that leave no trace, or none of their own, are refused: (26) cannot hold for them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from obsynth.analysis.conditions import Condition, require_all
from obsynth.analysis.time_varying import as_time_varying
from obsynth.errors import SpecError
from obsynth.methods.recursive.conditions import recursive_conditions
from obsynth.methods.recursive.synthesis_parts import recursive_synthesis, with_stated_noise
from obsynth.methods.synthesis_result import Synthesis
from obsynth.numerics.arguments import chosen, truth
from obsynth.observers.recursive.observer import FORMS
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem


def conditions(
    plant: DescriptorSystem | TimeVaryingDescriptorSystem, *, form: str = "innovation", early_constraints: bool = False
) -> tuple[Condition, ...]:
    """Return the existence conditions; the list ends at the first failure."""
    return tuple(recursive_conditions(plant, parameters=True, literal=form == "literal", early=early_constraints))


def synthesise(
    plant: DescriptorSystem | TimeVaryingDescriptorSystem,
    *,
    progress: Callable[[str], None],
    Q: Any = None,
    R: Any = None,
    forgetting: float = 0.98,
    form: str = "innovation",
    guard: str | None = None,
    random_walk: Any = None,
    initial_parameters: Any = None,
    initial_parameter_covariance: Any = None,
    initial_state: Any = None,
    initial_covariance: Any = None,
    early_constraints: bool = False,
    window: int = 50,
    reset: float = 0.0,
) -> Synthesis:
    """Put the observer together; see `obsynth.adaptive_observer` for the options, results and errors."""
    literal = chosen(form, "form", FORMS) == "literal"
    if form == "random-walk" and random_walk is None:
        raise SpecError("form 'random-walk' needs random_walk, the variance of one step of each parameter.",
                        path="method.options.random_walk")  # fmt: skip
    if form != "random-walk" and random_walk is not None:
        raise SpecError("random_walk belongs to form 'random-walk': the other forms forget instead.",
                        path="method.options.random_walk")  # fmt: skip
    progress("checking the existence conditions along the horizon")
    require_all(conditions(plant, form=form, early_constraints=truth(early_constraints, "early_constraints")))
    options = with_stated_noise(plant, {
        "Q": Q, "R": R, "initial_state": initial_state, "initial_covariance": initial_covariance,
        "early_constraints": early_constraints, "form": form, "forgetting": forgetting,
        "guard": ("none" if literal else "regularise") if guard is None else guard,
        "initial_parameters": initial_parameters, "initial_parameter_covariance": initial_parameter_covariance,
        "random_walk": random_walk, "window": window, "reset": reset,
    })  # fmt: skip
    progress("computing the gains")
    return recursive_synthesis(as_time_varying(plant), options)
