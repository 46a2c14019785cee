"""The verification report as a table."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from io import StringIO

from rich.console import Console, Group, RenderableType
from rich.padding import Padding
from rich.rule import Rule
from rich.table import Table
from rich.text import Text

from obsynth.results.checks import Check, all_hold
from obsynth.results.layout import number, print_section

#: On narrower terminals the claim stands below the numbers, over the whole width.
WIDE_ENOUGH = 110
#: Of a report as text.
TEXT_WIDTH = 120

_HEADINGS = ("check", "claim", "value", "bound", "margin", "verdict", "kind")
_NUMBER_WIDTH = 10
#: As wide as "computed twice".
_KIND_WIDTH = 14


def checks_table(checks: Sequence[Check], *, width: int) -> RenderableType:
    """Return checks as a table."""
    if width >= WIDE_ENOUGH:
        table = _grid(width, with_claim=True)
        table.add_row(*(Text(heading, style="bold") for heading in _HEADINGS))
        body = _grid(width, with_claim=True)
        for check in checks:
            body.add_row(Text(check.name), _claim(check), *_numbers_and_verdict(check))
        return Group(table, Rule(style="dim", characters="-"), body)
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
    others = 3 * (_NUMBER_WIDTH + 1) + 8 + _KIND_WIDTH
    if with_claim:
        grid.add_column(width=26, overflow="fold")
        grid.add_column(width=max(width - others - 28, 20), overflow="fold")
    else:
        grid.add_column(width=max(width - others - 1, 16), overflow="fold")
    for _ in range(3):
        grid.add_column(width=_NUMBER_WIDTH, justify="right", no_wrap=True)
    grid.add_column(width=7, no_wrap=True)
    grid.add_column(width=_KIND_WIDTH, no_wrap=True)
    return grid


def _claim(check: Check) -> Text:
    claim = Text(check.claim)
    return claim.append(f"; {check.detail}", style="dim") if check.detail else claim


def _numbers_and_verdict(check: Check) -> list[Text]:
    numbers = [Text(number(value)) for value in (check.value, check.bound, check.margin)]
    return [*numbers, verdict(check), Text(check.status, style="dim")]


def verdict(check: Check) -> Text:
    """Return ``holds``, ``FAILS`` or ``info``."""
    if not check.passed:
        return Text("FAILS", style="bold red")
    if check.kind == "information":
        return Text("info", style="cyan")
    return Text("holds", style="green")


def verdict_line(checks: Sequence[Check]) -> Text:
    """Return one line that says whether a whole report holds, and what fails."""
    real = [check for check in checks if check.kind != "information"]
    if all_hold(checks):
        return Text(f"Verified: all {len(real)} checks hold.", style="green")
    if not real:
        return Text("FAILS: the report is empty, so nothing is verified.", style="bold red")
    failed = [check.name for check in checks if not check.passed]
    told = f"FAILS: {len(failed)} of {len(real)} checks do not hold: {', '.join(failed)}."
    return Text(told, style="bold red")


def report_text(checks: Sequence[Check]) -> str:
    """Return what ``print(report)`` shows: the table of the checks, and the verdict."""
    console = Console(file=StringIO(), width=TEXT_WIDTH, markup=False, highlight=False, emoji=False, color_system=None)
    print_checks(checks, console=console)
    text: str = console.file.getvalue()  # type: ignore[attr-defined]
    return "\n".join(line.rstrip() for line in text.splitlines())


def print_checks(checks: Sequence[Check], *, console: Console) -> None:
    """Print the checks of a report and its verdict."""
    print_section(console, "Verification", checks_table(checks, width=console.width))
    console.print(verdict_line(checks))
