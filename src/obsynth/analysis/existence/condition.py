"""Existence conditions as values with a name, numbers and a verdict, to be shown, verified or raised as errors."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

from obsynth.analysis.existence.witnesses import Unclear
from obsynth.errors import PreconditionError
from obsynth.numerics.ranks import RankDecision
from obsynth.plants.descriptor import DescriptorSystem

#: Where errors say that options are.
OPTIONS_PATH = "method.options"

#: How a refusal begins where no observer of the kind exists, and where the method does not take the plant as it is, or
#: as it is stated: nothing is decided then about other observers.
NONE_OF_THIS_KIND = "No observer of this kind exists: "
NOT_TAKEN = "This method does not take the plant as it is: "


def without_opening(text: str) -> str | None:
    """Return a refusal by a condition that fails without its opening; `None` for other texts."""
    return next((text.removeprefix(each) for each in (NONE_OF_THIS_KIND, NOT_TAKEN) if text.startswith(each)), None)


@dataclass(frozen=True)
class Condition:
    """One existence condition: ``value`` against ``bound``, the evidence, the ``mode`` where it fails, a doubt (or that
    its numbers cannot be computed, ``True``).

    ``of_the_method``: where it fails the method does not take the plant as it is, or as it is stated; nothing is
    decided about other observers."""

    name: str
    claim: str
    holds: bool
    value: float
    bound: float
    source: str
    detail: str = ""
    mode: complex | None = None
    signals: tuple[str, ...] = ()
    unclear: Unclear | bool | None = None
    of_the_method: bool = field(default=False, kw_only=True)

    def require(self) -> None:
        """Raise `PreconditionError` when the condition fails."""
        if not self.holds:
            opening = (
                f"Unclear: whether the condition {self.name!r} holds ({self.source}) cannot be decided from the "
                "digits of the data. "
                if self.unclear
                else f"{self._opening}the condition {self.name!r} fails ({self.source}). "
            )
            missing = [repr(name) for name in self.signals if repr(name) not in self.detail]
            ended = "" if not missing or self.detail.endswith((".", "?", "!")) else "."
            involved = f"{ended} Signals involved: {', '.join(missing)}." if missing else ""
            raise PreconditionError(
                f"{opening}Needed: {self.claim}. Found: {self.detail}{involved}",
                condition=self.name,
                mode=self.mode,
                signals=self.signals,
                unclear=bool(self.unclear),
            )

    @property
    def _opening(self) -> str:
        return NOT_TAKEN if self.of_the_method else NONE_OF_THIS_KIND

    def in_doubt(self, doubt: Unclear, plant: DescriptorSystem) -> Condition:
        """Return the condition as one that rounding of the data could change, with what tells so in its detail."""
        return replace(self, holds=False, unclear=doubt, detail=f"{self.detail.rstrip()} {doubt.described(plant)}")


def up_to_failure(conditions: Iterable[Condition]) -> tuple[Condition, ...]:
    """Return conditions in order, up to the first that fails: those after it may rely on it, and are not asked for."""
    checked = list[Condition]()
    for condition in conditions:
        checked.append(condition)
        if not condition.holds:
            break
    return tuple(checked)


def require_all(conditions: Iterable[Condition]) -> None:
    """Raise `PreconditionError` for the first condition that fails."""
    for condition in conditions:
        condition.require()


def rank_condition(
    name: str, decision: RankDecision, remedy: str, *, source: str, signals: tuple[str, ...] = ()
) -> Condition:
    """Return the condition that a rank is full."""
    return Condition(
        name,
        f"{name} = {decision.expected}",
        decision.full,
        float(decision.rank),
        float(decision.expected),
        source,
        decision.describe() + ("" if decision.full else f": {remedy}"),
        signals=() if decision.full else signals,
    )
