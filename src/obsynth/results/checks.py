"""The rows of a verification report: the claim, the recomputed number, and whether it holds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

CheckKind = Literal["proved", "equality", "computed", "condition", "information"]

Status = Literal["proved", "recomputed", "estimated", "assumed"]

#: The check without which observer and plant say nothing of one another.
FITS = "fits the plant"

#: The row of a design that is a model without feedback; the verdict begins with it.
OPEN_LOOP = "open-loop model"


@dataclass(frozen=True)
class Check:
    """One row of a report.

    Parameters
    ----------
    name : str
        Short name, unique in the report.
    claim : str
        What is claimed, in words.
    value : float
        The number recomputed from the plant and the shipped realisation.
    bound : float
        What the number is compared with.
    margin : float
        How far the number is on the right side of the bound (negative when the check fails).
    passed : bool
        The verdict.
    source : str
        Where the claim comes from: paper and equation, or our own finding.
    kind : str
        ``proved`` (an inequality, rounding errors bounded), ``equality`` (a residual against a bound
        scaled by the data: never called proved), ``computed`` (a number found by a second route),
        ``condition`` (an existence condition) or ``information`` (never fails).
    detail : str, optional
        One more sentence for the reader.
    status : str, optional
        What the row is worth: ``proved`` (outward rounding, on the stored numbers), ``recomputed`` (double
        precision, by a route that shares no intermediate result with the design), ``estimated`` (statistics: see
        ``interval``) or ``assumed`` (stated in the gain set, and not checked).  That of the kind by default.
    interval : tuple of float, optional
        Of an estimate: where it lies by chance alone, with the probability that ``detail`` says.
    unclear : bool, optional
        Of a condition that does not hold: whether double precision could not decide it.
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
    """Return the check `FITS`, that what is shipped belongs to the plant."""
    return upper_bound_check(FITS, claim, float(not fits), 0.0, source=source, kind=kind, detail=detail)


def nothing_wrong(name: str, claim: str, wrong: Sequence[Any], *, source: str) -> Check:
    """Return a check that passes where nothing is wrong; its detail says what is."""
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


def all_hold(checks: Sequence[Check]) -> bool:
    """Return whether there is at least one real check and all of them hold."""
    verdicts = [check.passed for check in checks if check.kind != "information"]
    return bool(verdicts) and all(verdicts)
