"""Method ``descriptor-kalman``: the Kalman filter of a time-varying descriptor plant.

Source: R. Nikoukhah, A. Willsky, B. Levy, Kalman filtering and Riccati equations for descriptor systems, IEEE TAC 37
(9), 1992, as used by A. Moussa Ali, Q. Zhang, Fault diagnosis for linear time-varying descriptor systems, IFAC ALCOSP
2013.

Deviations:

1. Square-root covariance step instead of (9)-(11): nothing is inverted but triangles, so Q, R and P_0 may be singular.
2. The algebraic equations of step k + 1 may be used one step earlier (``early_constraints``).
3. Missing samples; states that they leave undetermined are said to be so.
4. Detectability is asked for before any gain: the paper's Lemma 3.1 takes a stable product of L_k A_k for granted.
5. Unknown inputs: removed or estimated, with nothing assumed about them (see `unknown_inputs`).
6. (14) and (15) have misprints (indexes, a transpose); we need neither.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from obsynth.analysis.conditions import Condition, require_all
from obsynth.analysis.time_varying import as_time_varying
from obsynth.errors import SpecError
from obsynth.methods.descriptor_kalman.options import DescriptorKalmanOptions
from obsynth.methods.descriptor_kalman.unknown_inputs import without_unknown_inputs
from obsynth.methods.method_spec import Synthesis
from obsynth.methods.recursive.conditions import recursive_conditions
from obsynth.methods.recursive.synthesis_parts import recursive_synthesis, with_stated_noise
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem


def conditions(
    plant: DescriptorSystem | TimeVaryingDescriptorSystem, *, early_constraints: bool = False
) -> tuple[Condition, ...]:
    """Return the existence conditions; the list ends at the first failure."""
    if isinstance(plant, DescriptorSystem) and plant.nd:
        try:
            plant = without_unknown_inputs(plant).plant
        except SpecError:
            # What it is says why it is not taken.
            plant = plant.replace(Bd=None, Dd=None, disturbance_names=None)
    return tuple(recursive_conditions(plant, parameters=False, early=early_constraints))


def synthesise(
    plant: DescriptorSystem | TimeVaryingDescriptorSystem,
    asked: DescriptorKalmanOptions,
    *,
    progress: Callable[[str], None],
) -> Synthesis:
    """Put the filter together; see `obsynth.descriptor_kalman` for the options, results and errors."""
    progress("checking the existence conditions along the horizon")
    require_all(conditions(plant, early_constraints=asked.early_constraints))
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
