"""Alarms as events: their times, the fault, its size and the evidence; and how many rows had no decision."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from obsynth.monitoring.logs.clock import OUT_OF_ORDER, REPEATED_STAMP
from obsynth.monitoring.logs.log_observer import GAP, OUT, PARTIAL, RECOVERING, WARM_UP
from obsynth.monitoring.thresholds.alarm_ranking import NONE_OF_THESE, SENSOR, Ranking
from obsynth.monitoring.thresholds.earlier_changes import LOOKED_FOR
from obsynth.monitoring.thresholds.learned_levels import HOLD
from obsynth.monitoring.thresholds.learned_statistics import AGES
from obsynth.observers.estimates import BAND_WIDTH
from obsynth.results.number_texts import duration

#: Status in the summary of rows without missing samples in which the monitor nevertheless decides nothing.
NO_DECISION = "undecided"

#: Name of the fault of an alarm whose evidence does not distinguish the faults.
NOT_DISTINGUISHED_YET = "not distinguished yet"

#: Monitors of innovations.  Their alarms contradict the stated noise and random walks, from which deviations follow.
CONTRADICTING = ("nis", "learned")

#: Note below a table with an interval that such an alarm contradicts.
NOT_VALID = (
    "Not valid: the alarm contradicts the noise and random walks that the interval assumes, so that the fault may lie "
    "outside."
)

#: Note on the names of alarms that last longer than the oldest change that is looked for.
NAMED_BY_THE_FIRST = (
    "An alarm is named by what began it: another fault that came while it stood, or soon after, has an alarm of its "
    "own where it is more than what errors of the model leave of the first (a seventh of its effect); a smaller one "
    "may have no name here. Its time is where the statistic of the output rises again."
)

#: An alarm that no fault explains is shelved after this many rows, the age of the oldest change that is looked for.
SHELVED_AFTER = max(AGES)

#: How a shelved alarm is named.
SHELVED = "shelved: unexplained offset since {}"

#: How the continuation of an alarm under another name is marked.
STILL = "the alarm of {} still stands"

#: Posterior shares below this are not listed.
LEAST_SHARE = 0.01

#: Heading of the column with inputs outside the range from which thresholds were learned.
BEYOND_HEADING = "beyond learned range"

#: Begin of the sentence that there was no alarm.
NO_ALARM = "No alarm"

#: Why a row cannot alarm, by its status.
REASONS = {
    WARM_UP: "the observer was still settling, for {warm_up} (shorten with --warm-up)",
    OUT: "a scheduling parameter, an input, a measurement or the estimate was outside the region, or had been so until "
    "recently",
    RECOVERING: "the observer was still settling after a gap (shorten with --warm-up)",
    GAP: "samples are missing, or left out as outliers",
    REPEATED_STAMP: "the time stamp repeats the one before",
    OUT_OF_ORDER: "the time stamp is earlier than the one before",
    NO_DECISION: "the window of the monitor was not full, or a warm-up or a gap was not over",
}

#: Evidence at which an alarm was named, before it has a name: whether beside an earlier change, and how large.
NOT_NAMED = (False, -math.inf)

#: Alarms that a summary lists.
MOST_LISTED_ALARMS = 20


@dataclass(frozen=True)
class AlarmEvent:
    """An alarm: rows above a threshold that are less than 20 rows apart.

    Missing rows between them belong to it.  Where causes are ranked, an alarm ends at the row in which a later change
    is first named.

    Parameters
    ----------
    by : str
        The column, or the kind of the monitor, whose threshold is passed.
    fault : str
        The fault that it points to; empty where there is none.  It is the one named at the largest evidence, unless
        later rows distinguish it from others that were as likely there, or rows among the first 20 decide.
    start, end : float, seconds
        Times of the first and the last row above the threshold.
    first_row, last_row : int
        Their numbers, from 1.
    rows : int
        Rows above the threshold.
    size, low, high : float
        Estimate of the fault at the largest evidence, and its interval: with 95 % probability for the stated noise, or
        guaranteed by an adaptive threshold; NaN where not known.
    evidence : float
        Largest ratio of the statistic to its threshold.
    distinguished : bool
        Whether the evidence distinguishes the faults; no fault is named otherwise.
    shares : tuple of (str, float)
        Possible causes and their posterior shares, the likeliest first: faults of the plant, ``sensor NAME``, and
        ``none of these faults``; empty where causes are not ranked.
    ties : tuple of str
        Causes that are as likely as the one that is named.
    drifts : bool
        Whether the cause is a drift rather than a jump.
    shelved : float, seconds
        Since when an offset has lasted that no fault explains, if for 200 rows or more; else NaN.
    beyond : tuple of str
        Known inputs that left the range from which thresholds were learned, during the alarm or 200 rows before it.
    while_standing : str
        The earlier name of an alarm that goes on without a pause under another name, which is that of a later change;
        else empty.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> log = {"time": list(range(20)), "y1": [0.0] * 10 + [1.0] * 10, "y2": [0.0] * 20}
    >>> event = obsynth.run_on_data(design, log, thresholds={"fhat[f1]": 0.5}).events[0]
    >>> event.by, event.first_row, event.rows
    ('fhat[f1]', 11, 1)
    """

    by: str
    fault: str
    start: float
    end: float
    first_row: int
    last_row: int
    rows: int
    size: float
    low: float
    high: float
    evidence: float
    distinguished: bool = True
    shares: tuple[tuple[str, float], ...] = ()
    ties: tuple[str, ...] = ()
    drifts: bool = False
    shelved: float = math.nan
    beyond: tuple[str, ...] = ()
    while_standing: str = ""

    @property
    def clear(self) -> bool:
        """Whether one fault alone is named, and its interval, if known, excludes zero."""
        return bool(self.fault) and not self.ties and self.fault != NONE_OF_THESE and not self.low < 0.0 < self.high

    @property
    def candidates(self) -> tuple[str, ...]:
        """All causes that are as likely as the one that is named; empty where causes are not ranked."""
        return tuple(name for name, _ in self.shares[: len(self.ties) + 1])

    @property
    def valid(self) -> bool:
        """Whether the interval is known, and the alarm does not contradict its assumptions."""
        return not math.isnan(self.low) and self.by not in CONTRADICTING

    def as_dict(self) -> dict[str, Any]:
        """Return the event as plain data."""
        shares = {name: share for name, share in self.shares if share >= LEAST_SHARE}
        listed = {"ties": list(self.ties), "beyond": list(self.beyond)}
        return {**asdict(self), "shares": shares, **listed, "interval_valid": self.valid}


class AlarmLog:
    """Collects alarms row by row; ``columns``: those of the output with estimates and intervals."""

    def __init__(self, columns: Sequence[str]) -> None:
        self._places = {name: i for i, name in enumerate(columns)}
        self._open, self._closed = dict[str, AlarmEvent](), list[AlarmEvent]()
        self._named_by = dict[str, tuple[bool, float]]()  # evidence at which the fault of an open event was named
        self._earlier = dict[str, int]()  # number of named changes before an open event
        self._place, self._places_of = 0, dict[str, int]()  # number of this row, and of the last row of each open event
        self._unexplained = dict[str, tuple[int, float]]()  # first row and time without a cause
        self.silent = Counter[str]()

    def advance(self, missing: int) -> None:
        """Advance to the next row, past ``missing`` rows."""
        self._place += missing + 1

    def take(
        self,
        by: str,
        fault: str,
        evidence: float,
        time: float,
        row: int,
        cells: Sequence[float],
        *,
        distinguished: bool = True,
        ranking: Ranking | None = None,
        beyond: tuple[str, ...] = (),
    ) -> None:
        """Take a row above a threshold.

        ``cells``: the numbers of its output; ``distinguished``: whether the evidence distinguishes faults; ``ranking``:
        the possible causes; ``beyond``: inputs outside the range from which thresholds were learned.
        """
        before = self._open.get(by)
        earlier = 0 if ranking is None else ranking.earlier
        is_another = before is not None and earlier > self._earlier[by]
        while_standing = "" if before is None else before.while_standing
        if before is not None and (is_another or self._place - self._places_of[by] > HOLD):
            stood = self._place - self._places_of[by] <= HOLD
            while_standing = (before.while_standing or before.fault or NOT_DISTINGUISHED_YET) if stood else ""
            self._closed.append(self._open.pop(by))
            before = None
        if before is None:
            self._named_by[by] = NOT_NAMED
            self._unexplained.pop(by, None)
            self._earlier[by] = earlier
        self._places_of[by] = self._place
        largest = before is None or evidence > before.evidence or math.isnan(before.evidence)
        size_before = (math.nan,) * 3 if before is None else (before.size, before.low, before.high)
        named = "" if before is None else before.fault
        # The statistic includes all changes: a later change has a name of its own where it is the largest of them.
        is_later = ranking is not None and not math.isnan(ranking.ratio)
        naming = (is_later, ranking.ratio if ranking is not None and is_later else evidence)
        renames = before is None or (
            distinguished and earlier == self._earlier[by] and not naming <= self._named_by[by]
        )
        shelved = self._shelved(by, fault, time)
        # A cause that explains a shelved alarm is reported, even if the alarm had another name at larger evidence.
        if before is not None and not math.isnan(before.shelved) and math.isnan(shelved):
            renames = True
        # Causes that were equally likely are told apart by later rows even where the statistic is smaller; and among
        # the first rows, several rows say more about the cause than the one with the largest statistic.
        is_better = _is_narrower(before, ranking) or (not is_later and _is_better_founded(before, ranking))
        is_same_change = earlier == self._earlier[by] and is_later >= self._named_by[by][0]
        if distinguished and is_same_change and is_better:
            renames, naming = True, max(naming, self._named_by[by])
        size, low, high = self._size(fault, cells, ranking) if renames else size_before
        if renames:
            named = fault
            self._named_by[by] = naming if distinguished else NOT_NAMED
        self._open[by] = AlarmEvent(
            by=by,
            fault=named,
            start=time if before is None else before.start,
            end=time,
            first_row=row if before is None else before.first_row,
            last_row=row,
            rows=1 if before is None else before.rows + 1,
            size=size,
            low=low,
            high=high,
            evidence=evidence if largest or before is None else before.evidence,
            distinguished=distinguished or (before is not None and before.distinguished),
            shelved=shelved,
            beyond=tuple(dict.fromkeys((*(() if before is None else before.beyond), *beyond))),
            while_standing=while_standing,
            **self._ranked(before, ranking, renames=renames),
        )

    @staticmethod
    def _ranked(before: AlarmEvent | None, ranking: Ranking | None, *, renames: bool) -> dict[str, Any]:
        """Return the fields of an event that hold the ranking at which it is named."""
        if renames:
            return {} if ranking is None else {"shares": ranking.shares, "ties": ranking.ties, "drifts": ranking.drifts}
        return {} if before is None else {"shares": before.shares, "ties": before.ties, "drifts": before.drifts}

    def _shelved(self, by: str, fault: str, time: float) -> float:
        """Return since when no fault has explained an open alarm, if for long enough; else NaN."""
        if fault != NONE_OF_THESE:
            self._unexplained.pop(by, None)
            return math.nan
        place, since = self._unexplained.setdefault(by, (self._place, time))
        return since if self._place - place >= SHELVED_AFTER else math.nan

    def shelved_since(self, by: str) -> float:
        """Return since when the alarm of a monitor has been shelved; NaN if it is not."""
        return self._open[by].shelved if by in self._open else math.nan

    def _size(self, fault: str, cells: Sequence[float], ranking: Ranking | None = None) -> tuple[float, float, float]:
        def cell(name: str) -> float:
            place = self._places.get(name)
            return math.nan if place is None else float(cells[place])

        if ranking is not None and ranking.is_sensor and fault == ranking.named:
            reach = BAND_WIDTH * ranking.deviation
            return ranking.size, ranking.size - reach, ranking.size + reach
        size, deviation = cell(f"fhat[{fault}]"), cell(f"sd fhat[{fault}]")
        low, high = cell(f"lowest {fault}"), cell(f"highest {fault}")
        if math.isnan(low) and math.isfinite(deviation):
            low, high = size - BAND_WIDTH * deviation, size + BAND_WIDTH * deviation
        return size, low, high

    def events(self) -> tuple[AlarmEvent, ...]:
        """Return all alarms, including open ones, ordered by their start."""
        return tuple(sorted([*self._closed, *self._open.values()], key=lambda event: (event.first_row, event.by)))


def _is_narrower(before: AlarmEvent | None, ranking: Ranking | None) -> bool:
    """Whether a later row leaves fewer of the equally likely causes of an open alarm, and no other."""
    if before is None or ranking is None or not before.ties:
        return False
    return {ranking.named, *ranking.ties} < set(before.candidates)


def _is_better_founded(before: AlarmEvent | None, ranking: Ranking | None) -> bool:
    """Whether a later row, still among the first of an open alarm, decides for a single cause."""
    if before is None or ranking is None or not before.shares or before.rows >= LOOKED_FOR:
        return False
    return not ranking.ties and ranking.named != NONE_OF_THESE


def alarm_rows(
    events: Sequence[AlarmEvent], date_of: Callable[[float], str], units: Mapping[str, str] | None = None
) -> tuple[list[tuple[str, ...]], int]:
    """Return a table of alarms, headings first and without empty columns, and how many alarms it leaves out.

    ``units``: of faults and outputs, by name.
    """
    if not events:
        return [], 0

    heading = ("alarm by", "from", "to", "rows", "fault", "size", "interval", "peak / threshold", BEYOND_HEADING)
    rows: list[tuple[str, ...]] = [heading]
    for event in events[:MOST_LISTED_ALARMS]:
        unit = (units or {}).get(event.fault.removeprefix(SENSOR), "1")
        unit = "" if unit == "1" else f" {unit}"
        size = "" if math.isnan(event.size) else f"{event.size:.4g}{unit}"
        interval = "" if math.isnan(event.low) else f"{event.low:.4g} to {event.high:.4g}{unit}"
        interval += " (not valid)" if interval and not event.valid else ""
        ends = date_of(event.start), date_of(event.end)
        fault = fault_text(event, date_of)
        peak, beyond = f"{event.evidence:.3g}", ", ".join(event.beyond)
        rows.append((event.by, *ends, str(event.rows), fault, size, interval, peak, beyond))
    nonempty = [i for i in range(len(rows[0])) if any(row[i] for row in rows[1:])]
    return [tuple(row[i] for i in nonempty) for row in rows], len(events) - len(rows) + 1


def fault_text(event: AlarmEvent, date_of: Callable[[float], str]) -> str:
    """Return the description of an alarm: its cause, ties, drift, since when it is shelved, and its earlier name."""
    text = _named_text(event, date_of)
    return f"{text}; {STILL.format(event.while_standing)}" if text and event.while_standing else text


def _named_text(event: AlarmEvent, date_of: Callable[[float], str]) -> str:
    """Return the description of an alarm without its earlier name."""
    if not math.isnan(event.shelved):
        return f"{event.fault} ({SHELVED.format(date_of(event.shelved))})"
    if not event.distinguished:
        candidates = " or ".join(event.candidates)
        return f"{candidates} ({NOT_DISTINGUISHED_YET})" if candidates else NOT_DISTINGUISHED_YET
    if not event.fault:
        return ""
    named = " or ".join(dict.fromkeys([event.fault, *event.ties]))
    notes = [*(["drifts"] if event.drifts else []), *([] if event.clear or event.ties else ["unclear"])]
    notes = [] if event.fault == NONE_OF_THESE else notes
    return f"{named} ({', '.join(notes)})" if notes else named


def rows_in_alarm(events: Sequence[AlarmEvent]) -> dict[str, int]:
    """Return how many rows were above the threshold of each column and monitor that alarmed."""
    counts = Counter[str]()
    for event in events:
        counts[event.by] += event.rows
    return dict(counts)


def time_in_alarm(events: Sequence[AlarmEvent], rows: int) -> list[str]:
    """Return sentences on the share of ``rows`` in alarm, since a single alarm may last for hours."""
    sentences = []
    for by, count in rows_in_alarm(events).items():
        own = [event for event in events if event.by == by]
        longest = max(event.last_row - event.first_row + 1 for event in own)
        alarms, lasting = (f"{n} {noun}{'s' if n != 1 else ''}" for n, noun in ((len(own), "alarm"), (longest, "row")))
        # Rows between the first and the last that are below the threshold are not counted before it.
        alarms_text = f"{alarms}, {'' if len(own) == 1 else 'the longest '}{lasting} from first to last"
        sentences.append(f"In alarm by {by}: {count} of {rows} rows ({100.0 * count / rows:.3g} %), {alarms_text}.")
    return sentences


def alarm_notes(events: Sequence[AlarmEvent]) -> list[str]:
    """Return the notes below a table of alarms: on its intervals, and on the names of long alarms."""
    notes = [NOT_VALID] if any(not math.isnan(event.low) and not event.valid for event in events) else []
    is_long = any(event.shares and event.last_row - event.first_row >= SHELVED_AFTER for event in events)
    return [*notes, NAMED_BY_THE_FIRST] if is_long else notes


def silence(run: Any, by: str) -> list[str]:
    """Return the sentences on a run without alarms and on rows without a decision; ``by``: what would have alarmed."""
    silent, sentences = sum(run.silent.values()), list[str]()
    if not run.alarms and silent < run.rows:
        where = f" in the {run.rows - silent} rows that could alarm" if silent else ""
        sentences.append(f"{NO_ALARM} by {by}{where}.")
    if silent:
        causes = {status: count for status, count in run.silent.items() if status != PARTIAL}
        why = [
            (f"{count}: " if len(causes) > 1 else "")
            + REASONS.get(status, status).format(warm_up=duration(run.warm_up))
            for status, count in causes.items()
        ]
        first = "the first " if set(causes) == {WARM_UP} else ""
        sentences.append(f"No decision in {first}{silent} of {run.rows} rows: {'; '.join(why)}.")
    return sentences
