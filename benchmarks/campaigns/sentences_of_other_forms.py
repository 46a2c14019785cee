"""The sentences of campaign `sentences`, printed about plants with delays and about plants of index 2.

Half of the plants have inputs that act late and readings that are late, by whole samples or parts of them; outputs of
the others read the derivative of a combination of states, written with two variables and a constraint.  What is
compared is that of the campaign `sentences`, by the same simulations: readings are taken within a sample where they are
late.  Of plants with delays everything must be said for disturbances that are held between samples.
"""

from __future__ import annotations

import numpy as np
from benchmarks.campaigns._written_plants import of_another_form, written_plant
from benchmarks.campaigns.frame import Outcome
from benchmarks.campaigns.sentences import LIMIT, more_of_table, of_plant

__all__ = ["CASES", "LIMIT", "case", "more_of_table"]

CASES = 120


def case(seed: int) -> Outcome:
    """Run one command on one plant and read what it prints."""
    rng = np.random.default_rng([seed, 46, 57])
    return of_plant(seed, of_another_form(written_plant(rng, uncertain=rng.random() < 0.5), rng), rng)
