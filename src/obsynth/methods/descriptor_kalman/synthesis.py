"""Method ``descriptor-kalman``: Nikoukhah, Willsky, Levy, IEEE TAC 37 (9), 1992; Moussa Ali, Zhang, ALCOSP 2013."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from obsynth.analysis.conditions import require_all
from obsynth.analysis.time_varying import as_time_varying
from obsynth.methods.descriptor_kalman.method import DescriptorKalman
from obsynth.methods.descriptor_kalman.unknown_inputs import without_unknown_inputs
from obsynth.methods.method import Synthesis
from obsynth.methods.recursive.synthesis_parts import recursive_synthesis, with_stated_noise
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem


def synthesise(
    plant: DescriptorSystem | TimeVaryingDescriptorSystem,
    asked: DescriptorKalman,
    *,
    progress: Callable[[str], None],
) -> Synthesis:
    """Put the filter together; see `obsynth.descriptor_kalman` for the options, results and errors."""
    progress("checking the existence conditions along the horizon")
    require_all(asked.existence(plant))
    options = with_stated_noise(plant, asked.as_given())
    progress("computing the gains")
    if not isinstance(plant, DescriptorSystem) or not plant.nd:
        return recursive_synthesis(as_time_varying(plant), options)
    reduced = without_unknown_inputs(plant)
    options |= {
        "initial_state": reduced.initial_state(options["initial_state"]),
        "initial_covariance": reduced.initial_covariance(options["initial_covariance"]),
    }
    if options["Q"] is not None:
        options["Q"] = reduced.process_covariance(options["Q"])
    found = recursive_synthesis(reduced.plant, options)
    return replace(found, notes=(reduced.note, *found.notes))
