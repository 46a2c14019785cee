"""A seeded share of every campaign has the results that the committed tables state for thousands of cases."""

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

from benchmarks.campaigns import frame  # noqa: E402

PARTS = 4


#: Campaigns with cases that take many seconds.
LONG = {"logs_as_they_are", "nonlinear_regions", "c_over_outliers", "switched_regions", "switched_slopes"}
#: Parts of the other campaigns whose cases take half a second or more.
LONG_PARTS = {
    ("adaptive_thresholds", 1), ("adaptive_thresholds", 2), ("chain_plants", 1), ("mutated_files", 3),
    ("random_tolerances", 2), ("recursive_existence", 0), ("regions", 1), ("regions", 3), ("sentences", 2),
    ("sentences_of_pages", 0), ("sentences_of_pages", 1), ("static_and_chains", 1), ("static_and_chains", 2),
    ("static_and_chains", 3), ("tampered_claims", 0), ("tampered_claims", 3),
}  # fmt: skip
#: The shares: name of the campaign, and part.
SHARES = [
    pytest.param(name, part, marks=[pytest.mark.long] * long, id=f"{name}-{part}")
    for name in frame.campaign_names()
    for part in range(PARTS)
    for long in [name in LONG or (name, part) in LONG_PARTS]
]


@pytest.mark.parametrize(("name", "part"), SHARES)
def test_a_share_of_the_campaign(name, part, share):
    campaign = frame.load_campaign(name)
    seeds = list(frame.share_of(campaign))[part::PARTS]
    outcomes = frame.run_campaign(campaign, share(seeds, 64, together=(name, part) in LONG_PARTS))
    wrong = {seed: outcome for seed, outcome in outcomes.items() if outcome.wrong}
    assert not wrong, wrong


#: Campaigns with a table, that is those that were run as a whole.
TABLES = [name for name in frame.campaign_names() if (Path(frame.__file__).parent / f"{name}.md").exists()]


@pytest.mark.parametrize("name", TABLES)
def test_the_table_is_of_the_whole_campaign_and_nothing_is_wrong(name):
    campaign = frame.load_campaign(name)
    table = (Path(frame.__file__).parent / f"{name}.md").read_text(encoding="utf-8")
    assert f"Wrong: 0 of {campaign.CASES}." in table
    assert (campaign.__doc__ or "").strip() in table


@pytest.mark.parametrize(
    ("seed", "result"), [(2642, "unclear"), (55, "designed"), (143, "designed"), (379, "designed"), (719, "designed")]
)
def test_cases_that_once_went_wrong_or_had_no_design(seed, result):
    """A fault of which elimination leaves rounding; walks, poles on the boundary and rows of rounding in filters."""
    outcome = frame.load_campaign("existence").case(seed)
    assert (outcome.result, outcome.wrong) == (result, "")


@pytest.mark.parametrize("seed", [70159, 70617])
def test_parameters_that_leave_no_trace_only_exactly_are_named(seed):
    """Floating point found the rank full: there was no null vector to name them by, and an error of numpy came out."""
    outcome = frame.outcome_of(frame.load_campaign("recursive_existence"), seed)
    assert (outcome.result, outcome.wrong) == ("refused", "")
