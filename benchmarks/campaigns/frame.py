"""What campaigns have in common: seeded cases, a journal from which an ended run goes on, and a table.

A campaign is a module of this folder with ``CASES`` (how many), ``LIMIT`` (seconds, for one case) and
``case(seed) -> Outcome``; its docstring is the text of its table.  Every case follows from its seed alone, so that any
share of a campaign can be run, in any order: CI takes one case in ``SHARE``, the tests every sixteenth of these.
"""

from __future__ import annotations

import importlib
import json
import signal
import sys
import time
import traceback
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from types import ModuleType

#: CI runs one case in this many.
SHARE = 50
#: Modules of this folder that are no campaigns.
_FRAME = {"__init__", "__main__", "frame"}
#: How many wrong cases a table lists.
LISTED = 20


@dataclass(frozen=True)
class Outcome:
    """What became of a case: the row and the column of the table it counts in; ``wrong`` says what must not be,
    ``value`` is what the table says the mean of, and ``details`` (JSON) what a campaign's own table (`more_of_table`)
    is made of."""

    group: str
    result: str
    wrong: str = ""
    value: float | None = None
    details: str = ""


class TooLongError(BaseException):
    """A case has used up its time; no handler of ordinary errors sees this."""


def campaign_names() -> list[str]:
    """Names of all campaigns."""
    return sorted(file.stem for file in Path(__file__).parent.glob("[!_]*.py") if file.stem not in _FRAME)


def load_campaign(name: str) -> ModuleType:
    """Return the module of a campaign."""
    return importlib.import_module(f"benchmarks.campaigns.{name}")


def share_of(campaign: ModuleType) -> range:
    """Return the seeds of the share that CI runs."""
    return range(0, campaign.CASES, SHARE)


def outcome_of(campaign: ModuleType, seed: int) -> Outcome:
    """Run one case; an error that leaves it, and a case that takes too long, are wrong."""
    try:
        with _limited(campaign.LIMIT):
            found = campaign.case(seed)
    except TooLongError:
        return Outcome("any", "too long", f"not done in {campaign.LIMIT} s")
    except Exception as error:  # noqa: BLE001 - any error that leaves a case is a finding
        place = traceback.extract_tb(error.__traceback__)[-1]
        return Outcome("any", "error", f"{type(error).__name__}: {error} ({Path(place.filename).name}:{place.lineno})")
    if not isinstance(found, Outcome):
        raise TypeError(f"case({seed}) of {campaign.__name__} returned {found!r}, no Outcome")
    return found


def run_campaign(
    campaign: ModuleType, seeds: Iterable[int], journal: Path | None = None, *, stop: bool = False
) -> dict[int, Outcome]:
    """Run the cases that a journal does not hold yet, and return all outcomes by seed."""
    seeds = list(seeds)
    found = {seed: outcome for seed, outcome in _journalled(journal) if seed in set(seeds)}
    begin, shown = time.monotonic(), 0.0
    for seed in seeds:
        if seed in found:
            continue
        found[seed] = outcome = outcome_of(campaign, seed)
        if journal is not None:
            with journal.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps({"seed": seed, **asdict(outcome)}) + "\n")
        if outcome.wrong:
            print(f"seed {seed}: {outcome.group}: {outcome.wrong}", file=sys.stderr, flush=True)
            if stop:
                break
        if time.monotonic() - shown > 10.0:
            shown = time.monotonic()
            print(f"{len(found)} of {len(seeds)} cases, {shown - begin:.0f} s", file=sys.stderr, flush=True)
    return found


def finished(outcomes: Mapping[int, Outcome], seeds: Iterable[int]) -> bool:
    """Whether every case has been run."""
    return all(seed in outcomes for seed in seeds)


def written_table(campaign: ModuleType, outcomes: Mapping[int, Outcome]) -> str:
    """Return the campaign as a page: what it is, counts by group and result, and what was wrong."""
    counts = Counter((outcome.group, outcome.result) for outcome in outcomes.values())
    groups = sorted({group for group, _ in counts})
    results = sorted({result for _, result in counts})
    wrong = {seed: outcome for seed, outcome in sorted(outcomes.items()) if outcome.wrong}
    name = campaign.__name__.rpartition(".")[2]
    rows = [["", *results, "cases", "wrong"]]
    for group in groups:
        cells = [counts[group, result] for result in results]
        rows.append([group, *map(str, cells), str(sum(cells)),
                     str(sum(outcome.group == group for outcome in wrong.values()))])  # fmt: skip
    sums = [sum(counts[group, result] for group in groups) for result in results]
    rows.append(["all", *map(str, sums), str(len(outcomes)), str(len(wrong))])
    if any(outcome.value is not None for outcome in outcomes.values()):
        for row, group in zip(rows, ["", *groups, ""], strict=True):
            values = [o.value for o in outcomes.values() if o.group == group and o.value is not None]
            row.append("mean" if row is rows[0] else f"{sum(values) / len(values):.2f}" if values else "")
    lines = [f"# Campaign `{name}`", "", (campaign.__doc__ or "").strip(), "",
             f"`python -m benchmarks.campaigns {name}`, seeds {min(outcomes)} to {max(outcomes)}.", ""]  # fmt: skip
    for number, row in enumerate(rows):
        lines.append("| " + " | ".join(row) + " |")
        if number == 0:
            lines.append("|" + " --- |" * len(row))
    if hasattr(campaign, "more_of_table"):
        lines += ["", *campaign.more_of_table(outcomes)]
    lines += ["", f"Wrong: {len(wrong)} of {len(outcomes)}."]
    lines += [f"- seed {seed}: {outcome.group}: {outcome.wrong}" for seed, outcome in list(wrong.items())[:LISTED]]
    return "\n".join(lines) + "\n"


def forget_wrong(journal: Path) -> None:
    """Take the wrong cases out of a journal, so that they are run again."""
    kept = {seed: outcome for seed, outcome in _journalled(journal) if not outcome.wrong}
    lines = [json.dumps({"seed": seed, **asdict(outcome)}) + "\n" for seed, outcome in kept.items()]
    journal.write_text("".join(lines), encoding="utf-8")


def _journalled(journal: Path | None) -> Iterator[tuple[int, Outcome]]:
    if journal is None or not journal.exists():
        return
    for line in journal.read_text(encoding="utf-8").splitlines():
        entry = json.loads(line)
        yield entry.pop("seed"), Outcome(**entry)


@contextmanager
def _limited(seconds: float) -> Iterator[None]:
    """Raise `TooLongError` when the time is up; code outside Python ends first."""

    def end(*_: object) -> None:
        raise TooLongError

    before = signal.signal(signal.SIGALRM, end)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
