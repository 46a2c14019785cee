"""What fails its verification is not handed on in silence: refused, or marked wherever it goes."""

from __future__ import annotations

from obsynth.errors import VerificationError
from obsynth.plants.validation import listed
from obsynth.results.design import ObserverDesign
from obsynth.results.verification_report import VerificationReport

#: Checks that a mark names; the others are counted.
_MOST_NAMED_CHECKS = 4


def unverified_mark(report: VerificationReport) -> str:
    """Return what is written beside a design whose report fails, in one line of plain text; empty where it holds."""
    if report.passed:
        return ""
    names = [check.name for check in report.failures]
    if not names:
        return "UNVERIFIED: no check was made"
    return f"UNVERIFIED: {len(names)} of {len(report.checks)} checks FAIL: {listed(names, most=_MOST_NAMED_CHECKS)}"


def require_verified(design: ObserverDesign, *, unverified: bool = False) -> None:
    """Raise `VerificationError` where the report of a design fails, unless it is wanted ``unverified``.
    A design that was put together by hand and has no report is the caller's own: it is marked, not refused."""
    report = design.report
    if unverified or report.passed or not report.checks:
        return
    raise VerificationError(
        f"{design.name!r} fails its verification ({unverified_mark(report).partition(': ')[2]}): it is not used. "
        "Design it again, or allow it (--unverified, unverified=True): every file that is written then says so.",
        report=report,
    )
