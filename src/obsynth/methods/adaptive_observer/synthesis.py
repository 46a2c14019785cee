"""Method ``adaptive-observer``: A. Moussa Ali, Q. Zhang, IFAC ALCOSP 2013, (18)."""

from __future__ import annotations

from collections.abc import Callable

from obsynth.analysis.conditions import Condition, require_all
from obsynth.analysis.time_varying import as_time_varying
from obsynth.methods.adaptive_observer.options import AdaptiveObserverOptions
from obsynth.methods.method_spec import Synthesis
from obsynth.methods.recursive.conditions import recursive_conditions
from obsynth.methods.recursive.synthesis_parts import recursive_synthesis, with_stated_noise
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem


def conditions(
    plant: DescriptorSystem | TimeVaryingDescriptorSystem, *, form: str = "innovation", early_constraints: bool = False
) -> tuple[Condition, ...]:
    """Return the existence conditions; the list ends at the first failure."""
    return tuple(recursive_conditions(plant, parameters=True, literal=form == "literal", early=early_constraints))


def synthesise(
    plant: DescriptorSystem | TimeVaryingDescriptorSystem,
    asked: AdaptiveObserverOptions,
    *,
    progress: Callable[[str], None],
) -> Synthesis:
    """Put the observer together; see `obsynth.adaptive_observer` for the options, results and errors."""
    progress("checking the existence conditions along the horizon")
    require_all(conditions(plant, form=asked.form, early_constraints=asked.early_constraints))
    default_guard = "none" if asked.form == "literal" else "regularise"
    options = {**asked.as_given(), "guard": default_guard if asked.guard is None else asked.guard}
    progress("computing the gains")
    return recursive_synthesis(as_time_varying(plant), with_stated_noise(plant, options))
