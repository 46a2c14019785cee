"""A seeded share of the coverage campaign: boxes of short logs hold the truth nearly always, and miss it by little."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks.campaigns._calibration_coverage import SEED, limit, root_at_truth


@pytest.mark.long
def test_boxes_of_short_logs_hold_the_truth(share):
    roots = [root_at_truth(56, SEED + run) for run in share(range(12), 2)]
    # With 95 % boxes, more than two of twelve are missed with 2 %, and more than one of six with 3 %.
    assert sum(root <= limit(56) for root in roots) >= 10 * len(roots) / 12
    assert max(roots) < 6.0
