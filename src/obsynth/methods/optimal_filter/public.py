"""The public function of the optimal filter, and its result: a design whose bounds have names."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

from obsynth.errors import SpecError
from obsynth.methods.functions import design_function
from obsynth.methods.optimal_filter.method import OptimalFilterMethod
from obsynth.numerics.arguments import arguments_checked
from obsynth.results.design import ObserverDesign


class DelayChoice(NamedTuple):
    """A row of the trade-off: the least gain (or root mean square) of any filter with an exact map of this delay."""

    delay: int
    gain: float


@dataclass(frozen=True, eq=False, repr=False)
class OptimalFilter(ObserverDesign):
    """The design of a fault-estimation filter that no causal filter beats, with what proves it.

    An `ObserverDesign` in every respect; made by `optimal_filter`.
    """

    @classmethod
    @arguments_checked
    def of(cls, design: ObserverDesign) -> OptimalFilter:
        """Return a design by this method, such as a loaded one, as what it is.

        Parameters
        ----------
        design : ObserverDesign
            By ``optimal-filter``.

        Raises
        ------
        SpecError
            It is by another method.
        """
        if design.method != OptimalFilterMethod.id:
            raise SpecError(f"Design {design.name!r} is by {design.method}, no optimal filter.", path="design")
        return cls(**{field.name: getattr(design, field.name) for field in fields(ObserverDesign)})

    @property
    def gain(self) -> float:
        """Proved bound on this filter's gain from noise to error; for ``norm="h2"`` its root mean square."""
        claims = self.certificate.claims
        return float(claims["gain"] if "gain" in claims else claims["deviation"])

    @property
    def least(self) -> float:
        """No causal filter with the same fault map has less; 0 where nothing above zero is proved."""
        claims = self.certificate.claims
        return float(claims.get("least", claims.get("least_deviation", 0.0)))

    @property
    def non_causal_limit(self) -> float:
        """No delay brings the gain below this; 0 where nothing above zero is proved."""
        return float(self.certificate.claims.get("non_causal_limit", 0.0))

    @property
    def delay(self) -> int:
        """Samples by which the estimates lag; 0 with a reference model."""
        return int(self.certificate.claims.get("delay", 0))

    @property
    def trade_off(self) -> tuple[DelayChoice, ...]:
        """Least gain against delay in samples, as far as the search looked; computed, not proved."""
        rows = self.solver.get("trade_off", ())
        return tuple(DelayChoice(int(delay), float(gain)) for delay, gain in rows if delay is not None)


# Its parameters are those of every design.
OptimalFilter.__doc__ = (OptimalFilter.__doc__ or "") + (ObserverDesign.__doc__ or "").partition("\n")[2]

optimal_filter = design_function(OptimalFilterMethod, OptimalFilter)
