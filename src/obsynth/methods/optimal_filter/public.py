"""The public function of the optimal filter, and its result: a design whose bounds have names."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, NamedTuple

from obsynth.errors import SpecError
from obsynth.files.tables import html_table, text_table
from obsynth.methods.functions import design_function
from obsynth.methods.optimal_filter.method import OptimalFilterMethod
from obsynth.numerics.arguments import arguments_checked
from obsynth.numerics.suggestions import fields_suggested
from obsynth.results.design import ObserverDesign, describe_parameters
from obsynth.results.number_texts import number
from obsynth.results.registered import registered

if TYPE_CHECKING:
    from matplotlib.axes import Axes


class DelayChoice(NamedTuple):
    """A row of the trade-off: what no filter with an exact fault map of this delay has less of.

    ``gain``: from noise to error, of energies; ``deviation``: root mean square for white noise of unit intensity.
    """

    delay: int
    gain: float
    deviation: float


class TradeOff(tuple[DelayChoice, ...]):
    """Least gain and least deviation by delay in samples; printed as a table."""

    __slots__ = ()

    def rows(self) -> tuple[tuple[str, ...], ...]:
        """Return the table as texts, the header first."""
        header = ("delay", "least gain", "least deviation")
        return (header, *((str(row.delay), number(row.gain), number(row.deviation)) for row in self))

    def __str__(self) -> str:
        return "\n".join(text_table(self.rows()))

    def _repr_html_(self) -> str:
        return html_table(self.rows())


@fields_suggested
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
        # What holds at any delay holds at this one.
        return float(claims.get("least", claims.get("least_deviation", claims.get("non_causal_limit", 0.0))))

    @property
    def non_causal_limit(self) -> float:
        """No delay brings the gain below this; 0 where nothing above zero is proved."""
        return float(self.certificate.claims.get("non_causal_limit", 0.0))

    @property
    def delay(self) -> int:
        """Samples by which the estimates lag, at most; 0 with a reference model."""
        return int(self.certificate.claims.get("delay", 0))

    @property
    def delays(self) -> dict[str, int]:
        """Samples by which the estimate of each fault lags; empty with a reference model."""
        observer = self.linear[1]
        late = zip(observer.fault_names, observer.fault_delays, strict=True)
        return {name: int(samples) for name, samples in late} if "delay" in self.certificate.claims else {}

    @property
    def trade_off(self) -> TradeOff:
        """Least gain and deviation against delay in samples, as far as the search looked; computed, not proved."""
        rows = self.solver.get("trade_off", ())
        return TradeOff(DelayChoice(int(delay), float(gain), float(deviation)) for delay, gain, deviation in rows)

    def plot(self, axes: Axes | None = None) -> Axes:
        """Plot least gain and least deviation against delay; see `obsynth.plotting.plot_delays`.

        Parameters
        ----------
        axes : Axes, optional
            Where; new ones by default.

        Returns
        -------
        Axes
            The delay of this filter is marked.
        """
        drawn: Axes = registered("plot_delays")(self, axes=axes)
        return drawn


# Its parameters are those of every design.
describe_parameters(OptimalFilter)

optimal_filter = design_function(OptimalFilterMethod, OptimalFilter)
