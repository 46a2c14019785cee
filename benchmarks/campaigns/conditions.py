"""The printed inequality (45) of Wang et al. and the engines behind the fault-estimation filter: the same least gamma.

Random plants with an algebraic state, three outputs, two faults, disturbances of states and outputs.  Not above: the
best filter that the engines find satisfies the printed inequality, evaluated, at 1 + 1e-6 times their gamma.  Not
below: the printed problem, solved by Clarabel, has no smaller minimum than that, by 1e-6.  "found by both": its minimum
is within 1e-5 as well; "found by the engine": the solver ends further above, as where the infimum needs ever larger P.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from benchmarks.campaigns.frame import Outcome

import obsynth
from obsynth.analysis.existence.wang2015 import examine_fault_filter
from obsynth.methods.fault_estimation_filter.convex_problem import centred, gain_problem, gains_in_given_units
from obsynth.numerics.central_filter import search_least_gain

CASES = 50
LIMIT = 60.0
#: What is the same gamma, and the same minimum.
SAME, NEAR = 1e-6, 1e-5


def case(seed: int) -> Outcome:
    """Compare the two on one plant."""
    plant = _plant(np.random.default_rng([32, seed]))
    held, prepared = examine_fault_filter(plant)
    if not all(condition.holds for condition in held) or prepared is None:
        return Outcome("random", "no filter exists")
    problem, parts = centred(*_order(gain_problem(prepared, free_weight=False), prepared))
    least = search_least_gain(problem)
    size = max(least.gain, 1.0)
    gains = gains_in_given_units(prepared, parts, least.injection)
    level = least.gain + SAME * size
    given: dict[str, Any] = {letter: gains[letter] for letter in "TNLW"}
    shipped = obsynth.design_from_gains(plant, "fault-estimation-filter", **given, gamma=level).conditions()
    P = np.abs(shipped.variables["P"].value).max()
    wrong = [name for name, part in shipped.constraints.items() if not part.violation() <= 1e-9 * P]
    found = obsynth.conditions.wang2015(plant, coordinates="balanced", margin=0.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found.solve()
    printed = float(np.sqrt(max(float(found.variables["gamma_squared"].value), 0.0)))
    if printed < least.gain - SAME * size:
        wrong.append(f"printed {printed:.9g} below {least.gain:.9g}")
    result = "found by both" if printed <= least.gain + NEAR * size else "found by the engine"
    return Outcome("random", result, "; ".join(wrong))


def _order(found: Any, prepared: Any) -> tuple[Any, Any, Any]:
    problem, parts = found
    return problem, prepared, parts


def _plant(rng: np.random.Generator) -> obsynth.DescriptorSystem:
    a = rng.uniform(-1, 1, (4, 4))
    a[:3, :3] *= 0.7 / max(abs(np.linalg.eigvals(a[:3, :3])))
    a[3, 3] = 1.0 + rng.uniform()
    c = np.vstack([np.eye(4)[[1, 3]], rng.uniform(-1, 1, (1, 4))])
    bd = np.hstack([rng.uniform(-1, 1, (4, 1)), np.zeros((4, 3))])
    dd = np.hstack([np.zeros((3, 1)), 0.3 * np.eye(3)])
    return obsynth.DescriptorSystem(
        np.diag([1.0, 1.0, 1.0, 0.0]), a, C=c, Bf=rng.uniform(-1, 1, (4, 2)), Bd=bd, Dd=dd, dt=1.0
    )
