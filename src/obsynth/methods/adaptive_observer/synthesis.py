"""Method ``adaptive-observer``: A. Moussa Ali, Q. Zhang, IFAC ALCOSP 2013, (18)."""

from __future__ import annotations

from collections.abc import Callable

from obsynth.analysis.conditions import require_all
from obsynth.analysis.time_varying import as_time_varying
from obsynth.methods.adaptive_observer.method import AdaptiveObserver
from obsynth.methods.method import Synthesis
from obsynth.methods.recursive.synthesis_parts import recursive_synthesis, with_stated_noise
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem


def synthesise(
    plant: DescriptorSystem | TimeVaryingDescriptorSystem,
    asked: AdaptiveObserver,
    *,
    progress: Callable[[str], None],
) -> Synthesis:
    """Put the observer together; see `obsynth.adaptive_observer` for the options, results and errors."""
    progress("checking the existence conditions along the horizon")
    require_all(asked.existence(plant))
    default_guard = "none" if asked.form == "literal" else "regularise"
    options = {**asked.as_given(), "guard": default_guard if asked.guard is None else asked.guard}
    progress("computing the gains")
    return recursive_synthesis(as_time_varying(plant), with_stated_noise(plant, options))
