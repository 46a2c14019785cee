"""Run a campaign and write its table: ``python -m benchmarks.campaigns NAME`` from the project's root."""

from __future__ import annotations

import argparse
from pathlib import Path

from benchmarks.campaigns.frame import (
    campaign_names,
    finished,
    forget_wrong,
    load_campaign,
    run_campaign,
    written_table,
)

HERE = Path(__file__).parent


def main() -> int:
    """Run a campaign."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.campaigns", description=__doc__)
    parser.add_argument("name", choices=campaign_names(), help="which campaign")
    parser.add_argument("--cases", type=int, metavar="N", help="how many (default: all; fewer write no table)")
    parser.add_argument("--first", type=int, default=0, metavar="SEED", help="seed of the first case (default: 0)")
    parser.add_argument("--fresh", action="store_true", help="begin again; by default a run that was ended goes on")
    parser.add_argument("--again", action="store_true", help="run the cases again that were wrong")
    parser.add_argument("--stop", action="store_true", help="stop at the first wrong case")
    options = parser.parse_args()
    campaign = load_campaign(options.name)
    seeds = range(options.first, options.first + (options.cases or campaign.CASES))
    journal = HERE / f"{options.name}.jsonl"
    if options.fresh:
        journal.unlink(missing_ok=True)
    if options.again:
        forget_wrong(journal)
    outcomes = run_campaign(campaign, seeds, journal, stop=options.stop)
    table = written_table(campaign, outcomes)
    print(table)
    if seeds == range(campaign.CASES) and finished(outcomes, seeds) and not any(o.wrong for o in outcomes.values()):
        (HERE / f"{options.name}.md").write_text(table, encoding="utf-8")
        journal.unlink()
    return int(any(outcome.wrong for outcome in outcomes.values()))


if __name__ == "__main__":
    raise SystemExit(main())
