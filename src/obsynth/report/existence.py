"""Whether each method can serve a plant: one line each, with the reason and what to add."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping, Sequence

from rich.console import Console
from rich.text import Text

from obsynth.results.report import Check, VerificationReport

#: Conditions that ask for another time than the plant's, and what to do about each.
_TIME = {
    "exists: continuous time": "continuous only: design for the plant in continuous time (dt: 0, without sample_time), "
    "and sample the observer afterwards (obsynth.sample_observer)",
    "exists: discrete time": "discrete only: sample the plant first (transform: {sample_time: ...})",
}
_KIND, _OF_THIS_KIND = "exists: kind of plant", "exists: plant of this kind"


def method_lines(methods: Mapping[str, VerificationReport], *, own: str = "") -> Iterator[tuple[str, str, str]]:
    """Yield method, verdict in words and style; methods for other kinds of plants come last, in one line."""
    others = []
    for method, report in methods.items():
        failed = report.failures
        names = {check.name for check in failed}
        asked = " (the spec's method)" if method == own else ""
        if report.passed:
            yield method, f"all conditions hold, so a design exists{asked}", "green"
        elif _KIND in names and method != own:
            others.append(method)
        elif names & set(_TIME):
            yield method, next(text for name, text in _TIME.items() if name in names) + asked, "yellow"
        elif _OF_THIS_KIND in names:
            reason = next(check.detail for check in failed if check.name == _OF_THIS_KIND)
            yield method, f"not for this plant{asked}: {reason}".rstrip("."), "yellow"
        else:
            yield method, f"IMPOSSIBLE for this plant{asked}: {_reason(failed)}", "bold red"
    if others:
        yield "other plants", f"{', '.join(others)}: for another kind of plant", "dim"


def print_methods(methods: Mapping[str, VerificationReport], *, own: str, console: Console) -> None:
    """Print the lines of all methods."""
    for method, text, style in method_lines(methods, own=own):
        lines = textwrap.wrap(f"{method}: {text}", min(console.width, 120), subsequent_indent="  ",
                              break_on_hyphens=False)  # fmt: skip
        for line in lines:
            console.print(Text(line, style=style), soft_wrap=True)


def _reason(failed: Sequence[Check]) -> str:
    if not failed:
        return "no condition was checked"
    first, *more = failed
    told = f"{first.name.removeprefix('exists: ')} FAILS: {first.claim}"
    told += f"; found {first.detail}" if first.detail else ""
    return told.rstrip(".") + (f" (and {len(more)} more with -v)" if more else "")
