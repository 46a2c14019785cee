"""Verified designs from a user's solution of a paper's conditions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from obsynth.conditions.wang import CLAIMED_ABOVE_NORM, error_norm
from obsynth.errors import VerificationError
from obsynth.methods.designing import design_from_gains, draft_of
from obsynth.methods.functions import descriptor_kalman
from obsynth.methods.verifying import verify
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.injection_problem import GainProblem
from obsynth.observers.recursive.steady_filter import steady_state_filter
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.plants.transformations.delays import linear_plant
from obsynth.plants.transformations.recovery import Transformation
from obsynth.results.design import ObserverDesign

#: A gain of the inequality is that of the recursion when they differ by at most this share of their size: the minimum
#: is flat, so that half the digits of a solver's optimum are those of its gain ...
SAME_GAIN = 1e-3

#: ... or when no state's variance is larger by more than this share of it: what a gain adds that misses by the above.
SAME_VARIANCE = 1e-6


def design_of(source: str, plant: Any, *arguments: Any) -> ObserverDesign:
    """Return the design of gains that conditions of this source have; ``arguments`` end with the gains and a name."""
    makers: dict[str, Callable[..., ObserverDesign]] = {
        "wang2015": _wang2015,
        "filasova": _filasova,
        "sharepasand": _sharepasand,
        "kalman": _kalman,
        "optimal filter": _optimal_filter,
        "wang over region": _wang_over_region,
        "sharepasand over region": _sharepasand_over_region,
    }
    return makers[source](plant, *arguments)


def _wang2015(
    plant: DescriptorSystem | Transformation, convex: GainProblem, gains: dict[str, FloatArray], name: str
) -> ObserverDesign:
    """Return the design of gains, claiming as little above its true norm as can be proved."""
    letters: dict[str, Any] = {letter: gains[letter] for letter in "TNLW"}
    if not convex.disturbances:
        return design_from_gains(plant, "fault-estimation-filter", **letters, name=name)
    norm = error_norm(linear_plant(plant).dense(), gains)
    if not np.isfinite(norm):
        return design_from_gains(plant, "fault-estimation-filter", **letters, gamma=1.0, name=name)
    size = max(norm, float(np.finfo(np.float64).eps) * convex.disturbance_size, float(np.finfo(np.float64).tiny))
    for room in CLAIMED_ABOVE_NORM:
        design = design_from_gains(plant, "fault-estimation-filter", **letters, gamma=(1.0 + room) * size, name=name)
        if design.report.passed:
            break
    return design


def problem_of_options(plant: DescriptorSystem, options: dict[str, Any]) -> tuple[Any, Any, float]:
    """Return the problem of estimation of `obsynth.optimal_filter` with its innovation, how to design, and its unit."""
    from obsynth.methods.optimal_filter.fault_maps import conditions, first_problem, unit_of_gains
    from obsynth.methods.optimal_filter.method import OptimalFilterMethod
    from obsynth.methods.refusals import require_all_conditions
    from obsynth.numerics.least_estimation import whitened
    from obsynth.verification.seen_outputs import seen_plant

    method = OptimalFilterMethod.of(options)
    existence = conditions(plant, method)
    require_all_conditions(existence)
    visible = seen_plant(plant, method.decoupled_names(plant))
    fault_map, problem = first_problem(visible, method)
    return whitened(problem), (method, fault_map, existence), unit_of_gains(visible, fault_map)


def _optimal_filter(
    plant: DescriptorSystem | Transformation, recipe: tuple[Any, Any, Any], gains: dict[str, FloatArray], name: str
) -> ObserverDesign:
    """Return the filter of gains on the innovation, with what can be proved of it and of every other one."""
    from obsynth.methods.optimal_filter.synthesis import synthesis_of_gains

    method, fault_map, _ = recipe
    own = linear_plant(plant)
    draft = draft_of(own, method.id, synthesis_of_gains(own.dense(), method, fault_map, gains), name=name)
    return draft.replace(report=verify(draft))


def _wang_over_region(plant: PolytopicSystem, gains: dict[str, FloatArray], name: str) -> ObserverDesign:
    """Return the scheduled filter of gains, with the least gain over the region that can be proved for them."""
    from obsynth.methods.fault_estimation_filter.over_region import synthesis_of_gains

    made = synthesis_of_gains(plant, [gains[f"R[{i + 1}]"] for i in range(plant.count)])
    draft = draft_of(plant, "fault-estimation-filter", made, name=name)
    return draft.replace(report=verify(draft))


def _sharepasand_over_region(
    plant: PolytopicSystem, fault_model: Any, gains: dict[str, FloatArray], name: str
) -> ObserverDesign:
    """Return the scheduled observer of gains, with what can be proved for them."""
    from obsynth.methods.ui_pi_observer.over_region import synthesis_of_gains

    made = synthesis_of_gains(plant, [gains[f"K_a[{i + 1}]"] for i in range(plant.count)], fault_model)
    draft = draft_of(plant, "ui-pi-observer", made, name=name)
    return draft.replace(report=verify(draft))


def _filasova(
    plant: DescriptorSystem | Transformation, decay: float, gains: dict[str, FloatArray], name: str
) -> ObserverDesign:
    J, L, M, N = (gains[letter] for letter in "JLMN")
    return design_from_gains(plant, "pd-observer", J=J, L=L, M=M, N=N, decay=decay, name=name)


def _sharepasand(
    plant: DescriptorSystem | Transformation, fault_model: Any, gains: dict[str, FloatArray], name: str
) -> ObserverDesign:
    U, D, K, F = (gains[letter] for letter in "UDKF")
    return design_from_gains(plant, "ui-pi-observer", U=U, D=D, K=K, F=F, fault_model=fault_model, name=name)


def _kalman(
    plant: DescriptorSystem | Transformation,
    Q: Any,
    R: Any,
    noisy: tuple[TimeVaryingDescriptorSystem, FloatArray, FloatArray],
    gains: dict[str, FloatArray],
    name: str,
) -> ObserverDesign:
    """Return the recursive filter whose gains tend to the given ones; `VerificationError` where they do not."""
    made = descriptor_kalman(plant, Q=Q, R=R, name=name)
    varying, process, sensor = noisy
    steady = steady_state_filter(varying, Q=process, R=sensor)
    variances, least = np.diag(gains["covariance"]), np.diag(steady.P)
    if np.all(variances <= (1.0 + SAME_VARIANCE) * least) and np.all(least > 0.0):
        return made
    for letter, steady_gain in (("L", steady.L), ("K", steady.K)):
        miss = float(np.linalg.norm(gains[letter] - steady_gain) / max(float(np.linalg.norm(steady_gain)), 1.0))
        if not miss <= SAME_GAIN:
            raise VerificationError(
                f"{letter} of the inequality differs from the steady gain of the recursion by {miss:.3g} of its "
                "size: with other constraints or another objective this is no Kalman filter.",
                report=made.report,
            )
    return made
