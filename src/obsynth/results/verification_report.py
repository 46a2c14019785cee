"""The verification report: its checks, and whether all of them pass."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from typing import Any

from obsynth.numerics.arguments import require_kind
from obsynth.numerics.suggestions import fields_suggested, there_are
from obsynth.results.checks import Check, all_hold
from obsynth.results.registered import registered


@fields_suggested
@dataclass(frozen=True)
class VerificationReport:
    """All checks of one design; an empty report fails.

    Parameters
    ----------
    checks : tuple of Check
        The rows, in the order of the argument they make.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> design.report.passed, len(design.report.failures)
    (True, 0)
    """

    checks: tuple[Check, ...] = field(default_factory=tuple)

    @classmethod
    def of(cls, checks: Iterable[Check]) -> VerificationReport:
        """Return a report.

        Parameters
        ----------
        checks : iterable of Check
            Its rows.
        """
        return cls(tuple(checks))

    @property
    def passed(self) -> bool:
        """Whether there is at least one real check and all of them hold."""
        return all_hold(self.checks)

    @property
    def failures(self) -> tuple[Check, ...]:
        """The checks that do not hold."""
        return tuple(check for check in self.checks if not check.passed)

    def __getitem__(self, name: str) -> Check:
        for check in self.checks:
            if check.name == name:
                return check
        raise KeyError(f"no check named {name!r}; {there_are(name, [check.name for check in self.checks])}")

    def __repr__(self) -> str:
        """Return the table of the checks."""
        from obsynth.results.layout import report_text

        return report_text(self.checks)

    def as_dict(self) -> dict[str, Any]:
        """Return the report as plain data."""
        rows = [asdict(check) for check in self.checks]
        for row in rows:
            for key in ("unclear", "of_the_method"):
                if not row[key]:
                    del row[key]
        return {"passed": self.passed, "checks": rows}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> VerificationReport:
        """Return the report that `as_dict` wrote.

        Parameters
        ----------
        data : dict
            With the key ``checks``.
        """
        require_kind(data, dict, "data", "what as_dict() returns")
        return cls.of(Check(**row) for row in data["checks"])


class MethodReports(dict[str, VerificationReport]):
    """Reports by method id: a dictionary whose text says for each method whether a design can exist, or why not."""

    def __repr__(self) -> str:
        return str(registered("text_of_methods")(self))


def failed_rows(report: VerificationReport) -> str:
    """Return the rows that fail as a text: numbers, or why something fails that is counted."""
    return "; ".join(
        f"{row.name}: {row.detail.rstrip('.')}"
        if row.detail and row.bound == 0.0
        else f"{row.name} ({row.value:.3g} against {row.bound:.3g})"
        for row in report.failures
    )
