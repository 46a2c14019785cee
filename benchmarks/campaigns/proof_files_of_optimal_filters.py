"""Proof files of optimal filters with weights, reference models and delays, checked without obsynth.

A case is a random plant of two to four states with noise and a filter of least gain; the rest is as in the campaign
`proof_files`: its file is accepted, and each of two changed ones is refused.
"""

from __future__ import annotations

import numpy as np
from benchmarks.campaigns.frame import Outcome
from benchmarks.campaigns.proof_files import LIMIT, case_of

__all__ = ["CASES", "LIMIT", "case"]

CASES = 75
#: Seeds that the campaign of all other methods has before.
FIRST = 450


def case(seed: int) -> Outcome:
    """Design, export, check; change and check again."""
    return case_of("optimal-filter", np.random.default_rng([46, FIRST + seed]))
