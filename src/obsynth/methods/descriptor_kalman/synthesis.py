"""Method ``descriptor-kalman``: the Kalman filter of a time-varying descriptor plant.

Source: R. Nikoukhah, A. Willsky, B. Levy, Kalman filtering and Riccati equations for descriptor systems, IEEE TAC 37
(9), 1992, as used by A. Moussa Ali, Q. Zhang, Fault diagnosis for linear time-varying descriptor systems, IFAC ALCOSP
2013.

Deviations:

1. Square-root covariance step instead of (9)-(11): nothing is inverted but triangles, so Q, R and P_0 may be singular.
2. The algebraic equations of step k + 1 may be used one step earlier (``early_constraints``).
3. Missing samples; states that they leave undetermined are said to be so.
4. Detectability is asked for before any gain: the paper's Lemma 3.1 takes a stable product of L_k A_k for granted.
5. (14) and (15) have misprints (indexes, a transpose); we need neither.
"""

from __future__ import annotations

from collections.abc import Callable

from obsynth.analysis.conditions import Condition, require_all
from obsynth.analysis.time_varying import as_time_varying
from obsynth.methods.descriptor_kalman.options import DescriptorKalmanOptions
from obsynth.methods.recursive.conditions import recursive_conditions
from obsynth.methods.recursive.synthesis_parts import recursive_synthesis, with_stated_noise
from obsynth.methods.synthesis_result import Synthesis
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem


def conditions(
    plant: DescriptorSystem | TimeVaryingDescriptorSystem, *, early_constraints: bool = False
) -> tuple[Condition, ...]:
    """Return the existence conditions; the list ends at the first failure."""
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
    return recursive_synthesis(as_time_varying(plant), options)
