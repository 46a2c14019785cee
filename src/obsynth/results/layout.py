"""Tables: the checks of a report, and the pieces that all tables share: headings, columns of numbers, verdicts.

Text is always a `rich.text.Text`, so that brackets in names are no markup; a verdict is always a word, not a colour.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from io import StringIO

from rich import box
from rich.console import Console, Group, RenderableType
from rich.padding import Padding
from rich.rule import Rule
from rich.table import Table
from rich.text import Text

from obsynth.files.tables import aligned
from obsynth.results.checks import OPEN_LOOP, Check, all_hold, with_verdict
from obsynth.results.number_texts import bound_number, number

#: On narrower terminals the claim stands below the numbers, over the whole width.
WIDE_ENOUGH = 110

#: Of a report as text.
TEXT_WIDTH = 120

_HEADINGS = ("check", "claim", "value", "bound", "margin", "verdict", "kind")

_NUMBER_WIDTH = 10

#: As wide as "not recomputed".
_KIND_WIDTH = 14


#: Rows of information that are true or false.
YES_OR_NO = ("plant: regular", "plant: admissible")


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
