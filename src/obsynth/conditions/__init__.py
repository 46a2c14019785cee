"""The papers' conditions as cvxpy problems, to read, change and solve, and the matrix inequalities they consist of.

- of the papers, each returns `Conditions`: ``wang2015``, ``filasova_theorem1``, ``filasova_theorem2``, ``sharepasand``,
  ``kalman``;
- of the least filters, the same: ``hinf_filter``, ``h2_filter``;
- over a region, the same: ``vertex_inequalities`` of an `ErrorPolytope`, ``rated_inequalities`` where its one parameter
  is slow, ``slope_inequality`` of `SlopedErrors`, ``nonlinear_region`` (or ``region``) of a nonlinear plant,
  ``turning_faults`` of faults that turn with the scheduling;
- single constraints for a problem of your own: ``bounded_real``, ``h2``, ``region``, ``admissible``;
- regions for eigenvalues: ``disk``, ``half_plane``, ``sector``.

``Conditions.bisect`` returns a `Bisection` over a parameter.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from obsynth.conditions.atoms import admissible, bounded_real, h2, region
    from obsynth.conditions.bisection import Bisection
    from obsynth.conditions.filasova import filasova_theorem1, filasova_theorem2
    from obsynth.conditions.kalman_gain import kalman
    from obsynth.conditions.least_filter import h2_filter, hinf_filter
    from obsynth.conditions.nonlinear_plants import nonlinear_region
    from obsynth.conditions.polytope import vertex_inequalities
    from obsynth.conditions.problem import Conditions
    from obsynth.conditions.rated_polytope import rated_inequalities
    from obsynth.conditions.share_pasand import sharepasand
    from obsynth.conditions.slope_multipliers import SlopedErrors, slope_inequality
    from obsynth.conditions.turning_directions import turning_errors, turning_faults
    from obsynth.conditions.wang import wang2015
    from obsynth.numerics.regions import LMIRegion, disk, half_plane, sector
    from obsynth.verification.error_polytope import ErrorPolytope
    from obsynth.verification.sampled_polytope import drift_within_samples, sampled_polytope

__all__ = [
    "Bisection",
    "Conditions",
    "ErrorPolytope",
    "LMIRegion",
    "SlopedErrors",
    "admissible",
    "bounded_real",
    "disk",
    "drift_within_samples",
    "filasova_theorem1",
    "filasova_theorem2",
    "h2",
    "h2_filter",
    "half_plane",
    "hinf_filter",
    "kalman",
    "nonlinear_region",
    "rated_inequalities",
    "region",
    "sampled_polytope",
    "sector",
    "sharepasand",
    "slope_inequality",
    "turning_errors",
    "turning_faults",
    "vertex_inequalities",
    "wang2015",
]

#: Where each name is: imported when it is first used, as what runs and verifies needs no cvxpy.
_HOMES = {
    name: f"obsynth.{module}"
    for module, names in {
        "conditions.atoms": "admissible bounded_real h2 region",
        "conditions.bisection": "Bisection",
        "conditions.filasova": "filasova_theorem1 filasova_theorem2",
        "conditions.kalman_gain": "kalman",
        "conditions.least_filter": "h2_filter hinf_filter",
        "conditions.nonlinear_plants": "nonlinear_region",
        "conditions.polytope": "vertex_inequalities",
        "conditions.rated_polytope": "rated_inequalities",
        "conditions.slope_multipliers": "SlopedErrors slope_inequality",
        "conditions.problem": "Conditions",
        "conditions.share_pasand": "sharepasand",
        "conditions.turning_directions": "turning_errors turning_faults",
        "conditions.wang": "wang2015",
        "numerics.regions": "LMIRegion disk half_plane sector",
        "verification.error_polytope": "ErrorPolytope",
        "verification.sampled_polytope": "drift_within_samples sampled_polytope",
    }.items()
    for name in names.split()
}


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    from obsynth.numerics.suggestions import not_in_module

    raise not_in_module(__name__, name, __all__, {})


def __dir__() -> list[str]:
    return __all__
