"""Checks, the rows of a verification report: each has a claim, a recomputed number, a bound and a verdict."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

CheckKind = Literal["proved", "equality", "computed", "condition", "information"]

Status = Literal["proved", "recomputed", "estimated", "assumed"]

#: Name of the check that an observer belongs to its plant; without it no other check has a meaning.
FITS = "fits the plant"

#: Name of the row of a design that is a model without feedback; the verdict begins with it.
OPEN_LOOP = "open-loop model"


@dataclass(frozen=True)
class Check:
    """One row of a report.

    Parameters
    ----------
    name : str
        Short name, unique in the report.
    claim : str
        The claim, in words.
    value : float
        The number recomputed from the plant and the stored observer.
    bound : float
        The bound that the number is compared with.
    margin : float
        Distance of the number from the bound, negative when the check fails.
    passed : bool
        The verdict.
    source : str
        Source of the claim: paper and equation, or a result of obsynth.
    kind : str
        ``proved`` (an inequality, rounding errors bounded), ``equality`` (a residual against a bound
        scaled by the data: never called proved), ``computed`` (a number found by a second route),
        ``condition`` (an existence condition) or ``information`` (never fails).
    detail : str, optional
        A further sentence for the reader.
    status : str, optional
        How far the row can be trusted: ``proved`` (outward rounding, on the stored numbers), ``recomputed`` (double
        precision, by a route that shares no intermediate result with the design), ``estimated`` (statistics: see
        ``interval``) or ``assumed`` (stated in the gain set, and not checked).  By default it follows from ``kind``.
    interval : tuple of float, optional
        Confidence interval of an estimate, with the probability that ``detail`` states.
    unclear : bool, optional
        For a condition that does not hold: double precision could not decide it.
    of_the_method : bool, optional
        Of a condition that does not hold: whether the method alone needs it.  It does not take the plant as it is, and
        nothing is said of other observers.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> check = design.report.checks[0]
    >>> check.name, check.passed, check.status
    ('plant: regular', True, 'recomputed')
    """

    name: str
    claim: str
    value: float
    bound: float
    margin: float
    passed: bool
    source: str
    kind: CheckKind = "computed"
    detail: str = ""
    status: Status | Literal[""] = ""
    interval: tuple[float, float] | None = None
    unclear: bool = False
    of_the_method: bool = False

    def __post_init__(self) -> None:
        if not self.status:
            object.__setattr__(self, "status", "proved" if self.kind == "proved" else "recomputed")
        if self.interval is not None:
            low, high = self.interval
            object.__setattr__(self, "interval", (low, high))


def upper_bound_check(
    name: str, claim: str, value: float, bound: float, *, source: str, kind: CheckKind = "computed", detail: str = ""
) -> Check:
    """Return a check that passes when ``value <= bound``; NaN fails."""
    return Check(
        name, claim, float(value), float(bound), float(bound - value), bool(value <= bound), source, kind, detail
    )


def fitting_check(
    claim: str, *, fits: bool, source: str = "shipped realisation", kind: CheckKind = "computed", detail: str = ""
) -> Check:
    """Return the check `FITS`: the stored observer and its certificate belong to the plant."""
    return upper_bound_check(FITS, claim, float(not fits), 0.0, source=source, kind=kind, detail=detail)


def nothing_wrong(name: str, claim: str, wrong: Sequence[Any], *, source: str) -> Check:
    """Return a check that passes if the list ``wrong`` is empty; otherwise its detail shows the list."""
    detail = f"wrong: {', '.join(map(str, wrong))}" if wrong else ""
    return upper_bound_check(name, claim, float(len(wrong)), 0.0, source=source, detail=detail)


def lower_bound_check(
    name: str, claim: str, value: float, bound: float, *, source: str, kind: CheckKind = "computed", detail: str = ""
) -> Check:
    """Return a check that passes when ``value >= bound``; NaN fails."""
    return Check(
        name, claim, float(value), float(bound), float(value - bound), bool(value >= bound), source, kind, detail
    )


def information(
    name: str, claim: str, value: float, *, source: str, detail: str = "", status: Status = "recomputed"
) -> Check:
    """Return a row that informs and cannot fail."""
    return Check(
        name=name,
        claim=claim,
        value=float(value),
        bound=math.nan,
        margin=math.nan,
        passed=True,
        source=source,
        kind="information",
        detail=detail,
        status=status,
    )


def with_verdict(checks: Sequence[Check]) -> list[Check]:
    """Return the checks that hold or fail: those that are counted; rows that inform are none."""
    return [check for check in checks if check.kind != "information"]


def all_hold(checks: Sequence[Check]) -> bool:
    """Whether there is at least one check besides information, and all of these pass."""
    verdicts = [check.passed for check in with_verdict(checks)]
    return bool(verdicts) and all(verdicts)
