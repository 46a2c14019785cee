"""Tables: the checks of a report, and the pieces that all tables share: numbers, verdicts, lists of names.

Text is always a `rich.text.Text`, so that brackets in names are no markup; a verdict is always a word, not a colour.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from io import StringIO

from rich import box
from rich.console import Console, Group, RenderableType
from rich.padding import Padding
from rich.rule import Rule
from rich.table import Table
from rich.text import Text

from obsynth.files.tables import aligned
from obsynth.numerics.arguments import is_number
from obsynth.numerics.outward import lower, upper
from obsynth.results.checks import OPEN_LOOP, Check, all_hold, with_verdict

#: Two values this near to each other, relative to their size or one, are shown as conjugates.
SAME_NUMBER = 1e-9

#: Values that are listed; the others are counted.
MOST_LISTED_VALUES = 8

#: On narrower terminals the claim stands below the numbers, over the whole width.
WIDE_ENOUGH = 110

#: Of a report as text.
TEXT_WIDTH = 120

_HEADINGS = ("check", "claim", "value", "bound", "margin", "verdict", "kind")

_NUMBER_WIDTH = 10

#: As wide as "not recomputed".
_KIND_WIDTH = 14

#: From these sizes on a number has an exponent (of ten), and commas.
LEAST_WITH_EXPONENT, LEAST_WITH_COMMAS = 7, 10_000
#: A time is reported in a longer unit as well from so many of it on.
LONG_TIMES = (("d", 86400.0, 2.0), ("h", 3600.0, 2.0), ("min", 60.0, 10.0))

#: Rows of information that are true or false.
YES_OR_NO = ("plant: regular", "plant: admissible")


def number(value: float, *, digits: int = 4) -> str:
    """Return ``value`` with a few significant digits; a dash for "not a number", whatever a changed file may hold.

    Numbers of everyday sizes have no exponent: 2140 and not 2.14e+03, with commas from ten thousand on.
    """
    if not is_number(value) or math.isnan(value):
        return "-"
    if math.isinf(value):
        return "inf" if value > 0 else "-inf"
    text = f"{value:.{digits}g}"
    if "e" not in text:
        return text
    mantissa, exponent = text.split("e")
    if 0 < int(exponent) < LEAST_WITH_EXPONENT:
        rounded = float(text)
        return f"{rounded:,.0f}" if abs(rounded) >= LEAST_WITH_COMMAS else f"{rounded:.0f}"
    return f"{mantissa}e{int(exponent)}"


def upper_number(value: float, *, digits: int = 3) -> str:
    """Return an upper bound with a few significant digits, the last rounded up: what is printed is a bound as well."""
    return _rounded(value, upper, digits)


def lower_number(value: float, *, digits: int = 3) -> str:
    """Return a lower bound with a few significant digits, the last rounded down: what is printed is a bound as well."""
    return _rounded(value, lower, digits)


def bound_number(value: float, side: str, *, digits: int = 4) -> str:
    """Return a number that bounds another one from a side, ``"at most"`` or ``"at least"``, rounded away from that one;
    any other to the nearest."""
    rounding = {"at most": upper, "at least": lower}.get(side)
    return number(value, digits=digits) if rounding is None else _rounded(value, rounding, digits)


def _rounded(value: float, rounding: Callable[[float, int], float], digits: int) -> str:
    return number(rounding(value, digits) if is_number(value) else value, digits=digits)


def duration(seconds: float, *, digits: int = 3) -> str:
    """Return a time in seconds, and in minutes, hours or days where it is long: ``2140 s (35.7 min)``."""
    text = f"{number(seconds, digits=digits)} s"
    if not math.isfinite(seconds):
        return text
    for unit, size, least in LONG_TIMES:
        if abs(seconds) >= least * size:
            return f"{text} ({number(seconds / size, digits=digits)} {unit})"
    return text


def complex_numbers(values: Iterable[complex]) -> str:
    """Return several values as text, largest first; conjugate pairs once, as ``a +- bj``; long lists are cut.

    What is below one rounding of the largest is zero: computed eigenvalues are not known better.
    """
    listed = [complex(value) for value in values]
    rounding = math.ulp(1.0) * max(map(abs, listed), default=0.0)
    waiting = sorted(
        (value if abs(value) >= rounding else 0j for value in listed),
        key=lambda value: (-abs(value), -value.real, -value.imag),
    )
    texts: list[str] = []
    while waiting:
        value = waiting.pop(0)
        partner = next((w for w in waiting if abs(w - value.conjugate()) <= SAME_NUMBER * max(1.0, abs(value))), None)
        real, size = number(value.real), number(abs(value.imag))
        if value.imag == 0.0:
            texts.append(real)
        elif partner is None:
            texts.append(f"{real} {'+' if value.imag > 0 else '-'} {size}j")
        else:
            waiting.remove(partner)
            texts.append(f"{real} +- {size}j")
    return name_list(texts, limit=MOST_LISTED_VALUES)


def name_list(names: Sequence[str], *, limit: int = 6) -> str:
    """Return names separated by commas, or by semicolons where commas are in names (``valve, 1 sample ago``); of a long
    list the first ones and how many more there are."""
    if not names:
        return "none"
    between = "; " if any("," in name for name in names) else ", "
    if len(names) <= limit + 1:
        return between.join(names)
    return f"{between.join(names[:limit])} and {len(names) - limit} more"


def align_numbers(table: Table) -> Table:
    """Put decimal points below each other in the columns of a table; such a column begins at the left."""
    for column in table.columns[1:]:
        before = [str(cell) for cell in column.cells]
        after = aligned(before)
        if after != before:
            column.justify = "left"
            column._cells[:] = [Text(text) for text in after]
    return table


def print_section(console: Console, title: str, content: RenderableType) -> None:
    """Print a title, the content below it, and an empty line."""
    if isinstance(content, Table) and content.box is box.SIMPLE_HEAD:
        align_numbers(content)
    console.print(Text(title, style="bold"))
    console.print(content)
    console.print()


def headed_table(*headings: str) -> Table:
    """Return an empty table with a line below its headings; all columns but the first align right."""
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0), header_style="bold")
    for position, heading in enumerate(headings):
        # A heading may be folded between its words, never within one.
        longest = max(map(len, heading.split()), default=0)
        table.add_column(heading, justify="right" if position else "left", min_width=longest)
    return table


def facts_table(rows: Iterable[Sequence[str]], *, headings: Sequence[str] = ()) -> Table:
    """Return a table of labels with one or more values each."""
    table = Table(
        box=None,
        show_header=bool(headings),
        pad_edge=False,
        padding=(0, 2, 0, 0),
        header_style="dim",
    )
    listed = [tuple(row) for row in rows]
    for column in range(max((len(row) for row in listed), default=0)):
        heading = headings[column] if column < len(headings) else ""
        table.add_column(heading, overflow="fold", no_wrap=column == 0, style="dim" if column == 0 else "")
    for row in listed:
        table.add_row(*(Text(cell) for cell in row))
    return table


def checks_table(checks: Sequence[Check], *, width: int) -> RenderableType:
    """Return checks as a table."""
    if width >= WIDE_ENOUGH:
        head, body = _grid(width, with_claim=True), _grid(width, with_claim=True)
        head.add_row(*(Text(heading, style="bold") for heading in _HEADINGS))
        for check in checks:
            body.add_row(Text(check.name), _claim(check), *_numbers_and_verdict(check))
        return Group(head, Rule(style="dim", characters="-"), body)
    head = _grid(width, with_claim=False)
    head.add_row(*(Text(heading, style="bold") for heading in _HEADINGS if heading != "claim"))
    return Group(head, Rule(style="dim", characters="-"), *_stacked(checks, width))


def _stacked(checks: Sequence[Check], width: int) -> Iterable[RenderableType]:
    for check in checks:
        row = _grid(width, with_claim=False)
        row.add_row(Text(check.name, style="bold"), *_numbers_and_verdict(check))
        yield row
        yield Padding(_claim(check), (0, 0, 0, 2))


def _grid(width: int, *, with_claim: bool) -> Table:
    grid = Table.grid(padding=(0, 1, 0, 0))
    fixed_width = 3 * (_NUMBER_WIDTH + 1) + 8 + _KIND_WIDTH
    if with_claim:
        grid.add_column(width=26, overflow="fold")
        grid.add_column(width=max(width - fixed_width - 28, 20), overflow="fold")
    else:
        grid.add_column(width=max(width - fixed_width - 1, 16), overflow="fold")
    for _ in range(3):
        grid.add_column(width=_NUMBER_WIDTH, justify="right", no_wrap=True)
    grid.add_column(width=7, no_wrap=True)
    grid.add_column(width=_KIND_WIDTH, no_wrap=True)
    return grid


def _claim(check: Check) -> Text:
    claim = Text(check.claim)
    return claim.append(f"; {check.detail}", style="dim") if check.detail else claim


def shown_numbers(check: Check) -> tuple[str, str, str]:
    """Return value, bound and margin of a row; conditions that are true or false have none."""
    if check.kind == "condition" or check.name in YES_OR_NO:
        return ("", "", "")
    side = _proved_side(check)
    return bound_number(check.value, side), bound_number(check.bound, side), number(check.margin)


def _proved_side(check: Check) -> str:
    """Return from which side what is proved is bounded by the numbers of a row; empty where nothing is."""
    if check.status != "proved" or not check.passed or not check.margin > 0.0:
        return ""
    return "at most" if check.value < check.bound else "at least"


def _numbers_and_verdict(check: Check) -> list[Text]:
    numbers = [Text(text) for text in shown_numbers(check)]
    return [*numbers, verdict(check), Text(worth(check), style="dim")]


def verdict(check: Check) -> Text:
    """Return ``holds``, ``FAILS`` or ``info``."""
    if not check.passed:
        return Text("FAILS", style="bold red")
    if check.kind == "information":
        return Text("info", style="cyan")
    return Text("holds", style="green")


def verdict_line(checks: Sequence[Check]) -> Text:
    """Return one line that says whether a whole report holds, and what fails; first, what it is not about."""
    real = with_verdict(checks)
    if all_hold(checks):
        opens = any(check.name == OPEN_LOOP for check in checks)
        about = "An open-loop model, of whose stability nothing is claimed. " if opens else ""
        return Text(f"{about}Verified: all {len(real)} checks hold.", style="green")
    if not real:
        return Text("FAILS: the report is empty, so nothing is verified.", style="bold red")
    failed = [check.name for check in checks if not check.passed]
    text = f"FAILS: {len(failed)} of {len(real)} checks do not hold: {', '.join(failed)}."
    return Text(text, style="bold red")


def printed(report: Callable[[Console], None]) -> str:
    """Return what a report prints on a console, as plain text."""
    console = Console(file=StringIO(), width=TEXT_WIDTH, markup=False, highlight=False, emoji=False, color_system=None)
    report(console)
    text: str = console.file.getvalue()  # type: ignore[attr-defined]
    return "\n".join(line.rstrip() for line in text.splitlines())


def report_text(checks: Sequence[Check]) -> str:
    """Return what ``print(report)`` shows: the table of the checks, and the verdict."""
    return printed(lambda console: print_checks(checks, console=console))


def worth(check: Check) -> str:
    """Return what a row is worth: a row that should be proved and fails proves nothing."""
    return f"not {check.status}" if check.status == "proved" and not check.passed else check.status


def print_checks(checks: Sequence[Check], *, console: Console) -> None:
    """Print the checks of a report and its verdict."""
    print_section(console, "Verification", checks_table(checks, width=console.width))
    console.print(verdict_line(checks))
