"""The papers' conditions as problems of cvxpy, to read, to change and to solve; and the inequalities they are made of.

``wang2015``, ``filasova_theorem1``, ``filasova_theorem2``, ``sharepasand`` and ``kalman`` return `Conditions`;
``bounded_real``, ``h2``, ``region`` and ``admissible`` return constraints; ``disk``, ``half_plane`` and ``sector`` are
regions for the eigenvalues.
"""

from obsynth.conditions.atoms import admissible, bounded_real, h2, region
from obsynth.conditions.filasova import filasova_theorem1, filasova_theorem2
from obsynth.conditions.kalman_gain import kalman
from obsynth.conditions.problem import Conditions
from obsynth.conditions.share_pasand import sharepasand
from obsynth.conditions.wang import wang2015
from obsynth.numerics.regions import LMIRegion, disk, half_plane, sector

__all__ = [
    "Conditions",
    "LMIRegion",
    "admissible",
    "bounded_real",
    "disk",
    "filasova_theorem1",
    "filasova_theorem2",
    "h2",
    "half_plane",
    "kalman",
    "region",
    "sector",
    "sharepasand",
    "wang2015",
]
