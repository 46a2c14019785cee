"""The trade-off of a larger region, or a faster parameter: the proved claim of a design for each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from obsynth.errors import ObsynthError, SpecError, a_kind
from obsynth.methods.designing import design as designed
from obsynth.numerics.arguments import arguments_checked, is_finite_number, shown
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.suggestions import there_are
from obsynth.plants.dae import DAEModel
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.results.design import ObserverDesign
from obsynth.verification.over_region import FROZEN_ROW, SWITCHING_ROW

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Shares of the region by default, about its middle.
SIZES = (0.1, 0.25, 0.5, 0.75, 1.0)
#: What is looked for in a certificate, in this order.
DECAY = "region_decay"
CLAIMS = ("gamma", "region_deviation", "region_gain", DECAY)


@dataclass(frozen=True, eq=False)
class RegionTradeOff:
    """A claim over regions of several sizes, or for several rates; from `region_trade_off`.

    Parameters
    ----------
    by : {"size", "rate"}
        What was changed.
    values : tuple of float
        Shares of the ranges, or rates in units of the parameter per second (infinite: any course).
    claim : str
        Name of the claim.
    designs : tuple of ObserverDesign or str
        The design of each, or why there is none.  What is proved over a region holds over every smaller one, and for
        every slower parameter: where the design of a larger value proves more than the own one, it stands in its place.
    designed_for : tuple of float
        The value that each of these designs was made for.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.PolytopicSystem(
    ...     plant={
    ...         "A": [["0.7 + 0.2 * v", 0.1], [0, 0.5]], "C": [[1, 0], [0, 1]], "Bf": [[1], [0]], "Bd": [[0], [1]],
    ...         "dt": 1.0,
    ...     },
    ...     scheduling={"v": [-1.0, 1.0]},
    ... )
    >>> trade_off = obsynth.region_trade_off(plant, sizes=[0.5, 1.0])
    >>> trade_off.by, trade_off.values
    ('size', (0.5, 1.0))
    """

    by: str
    values: tuple[float, ...]
    claim: str
    designs: tuple[ObserverDesign | str, ...]
    designed_for: tuple[float, ...]

    @property
    def claims(self) -> FloatArray:
        """``(n,)``: what is proved; NaN where no design was found."""
        return np.array(
            [np.nan if isinstance(design, str) else design.certificate.claims[self.claim] for design in self.designs]
        )

    @property
    def reached(self) -> FloatArray:
        """``(n,)``: what some course was found to reach; no claim can be better.  NaN where none was looked for."""
        reached = np.full(len(self.designs), np.nan)
        for i, design in enumerate(self.designs):
            rows = () if isinstance(design, str) else design.report.checks
            reached[i] = next((row.value for row in rows if row.name in (SWITCHING_ROW, FROZEN_ROW)), np.nan)
        return reached

    def table(self) -> pd.DataFrame:
        """Return a row for each value: what is proved, what is reached, their ratio, and why there is no design, or
        which larger value the design is for."""
        claims, reached = self.claims, self.reached
        why = [
            design if isinstance(design, str) else "" if own == used else f"design for {self.by} {used:g}"
            for design, own, used in zip(self.designs, self.values, self.designed_for, strict=True)
        ]
        columns = {self.by: self.values, self.claim: claims, "reached": reached, "ratio": reached / claims, "why": why}
        return pd.DataFrame(columns)

    def plot(self, *, axes: Axes | None = None) -> Axes:
        """Draw what is proved, and what is reached, over the size of the region or the rate.

        Parameters
        ----------
        axes : Axes, optional
            Where; new ones by default.
        """
        from obsynth.report.plots.trade_off import draw_region_trade_off

        return draw_region_trade_off(
            np.array(self.values),
            self.designs,
            (self.claim, self.claims),
            self.reached,
            below="share of the region" if self.by == "size" else "rate of the parameter (1/s)",
            axes=axes,
        )


@arguments_checked
def region_trade_off(
    plant: PolytopicSystem | DAEModel,
    *,
    sizes: Sequence[float] | None = None,
    rates: Sequence[float | None] | None = None,
    method: str = "auto",
    claim: str | None = None,
    **options: Any,
) -> RegionTradeOff:
    """Design over a region for several of its sizes, or rates of its parameter, and compare what is proved.

    Parameters
    ----------
    plant : PolytopicSystem or DAEModel
        Over the whole region; of a nonlinear plant the ``region`` is among the options.
    sizes : sequence of float, optional
        Shares of every range about its middle, above 0; of a tenth to the whole by default.
    rates : sequence of float or None, optional
        Instead: largest changes in a second of the one scheduling parameter; ``None`` for any course.
    method : str, optional
        Id of a method; the first that exists by default.
    claim : str, optional
        Of the certificate; by default the first that it has of gain, deviation and decay.
    **options
        Of the method.

    Returns
    -------
    RegionTradeOff
        With `table` and `plot`.

    Raises
    ------
    SpecError
        A size is not positive, both sizes and rates are given, or the plant has no such region.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.PolytopicSystem(
    ...     plant={
    ...         "A": [["0.7 + 0.2 * v", 0.1], [0, 0.5]], "C": [[1, 0], [0, 1]], "Bf": [[1], [0]], "Bd": [[0], [1]],
    ...         "dt": 1.0,
    ...     },
    ...     scheduling={"v": [-1.0, 1.0]},
    ... )
    >>> trade_off = obsynth.region_trade_off(plant, sizes=[0.5, 1.0])
    >>> bool((trade_off.reached <= trade_off.claims).all())
    True
    """
    if sizes is not None and rates is not None:
        raise SpecError("Give sizes or rates, not both.", path="rates")
    by = "size" if rates is None else "rate"
    values = tuple((SIZES if sizes is None else sizes) if rates is None else rates)
    for value in values:
        if not (value is not None and is_finite_number(value) and value > 0.0) and not (by == "rate" and value is None):
            raise SpecError(f"{by}s has {shown(value)}: give positive numbers.", path=f"{by}s")
    if not values:
        raise SpecError(f"{by}s is empty: give positive numbers.", path=f"{by}s")
    if isinstance(plant, DAEModel) and rates is not None:
        raise SpecError("rates are for scheduling parameters, which a nonlinear plant has none of.", path="rates")
    designs: list[ObserverDesign | str] = []
    for value in values:
        try:
            designs.append(_designed(plant, by, value, method, options))
        except SpecError:
            raise
        except ObsynthError as error:
            designs.append(f"{type(error).__name__}: {error}")
    made = [design for design in designs if isinstance(design, ObserverDesign)]
    known = [name for name in CLAIMS if made and all(name in design.certificate.claims for design in made)]
    if claim is not None and made and any(claim not in design.certificate.claims for design in made):
        raise SpecError(f"No design claims {claim!r}; {there_are(claim, known)}", path="claim")
    numbers = tuple(float("inf") if value is None else float(value) for value in values)
    name = claim or (known[0] if known else CLAIMS[0])
    places = range(len(numbers))
    used = [_best_of_larger(name, numbers, designs, place) if name in CLAIMS else place for place in places]
    return RegionTradeOff(
        by, numbers, name, tuple(designs[place] for place in used), tuple(numbers[place] for place in used)
    )


def _best_of_larger(claim: str, values: Sequence[float], designs: Sequence[ObserverDesign | str], place: int) -> int:
    """Return the place of the design that proves most for a value: its own, or that of a larger one."""
    own = designs[place]
    larger = {
        other: design
        for other, design in enumerate(designs)
        if values[other] > values[place] and isinstance(design, ObserverDesign)
    }
    better = [other for other, design in larger.items() if isinstance(own, str) or _proves_more(design, own, claim)]
    return min(better, key=lambda other: _as_cost(larger[other], claim), default=place)


def _proves_more(design: ObserverDesign, other: ObserverDesign, claim: str) -> bool:
    """Whether a claim is better, and no decay slower."""
    better = _as_cost(design, claim) < _as_cost(other, claim)
    return better and not _as_cost(design, DECAY) > _as_cost(other, DECAY)


def _as_cost(design: ObserverDesign, claim: str) -> float:
    """Return a claim, larger where it is worse; decays are rates, but for factors a sample."""
    value = float(design.certificate.claims.get(claim, np.nan))
    is_rate = claim == DECAY and (design.observer.dt == 0.0 or isinstance(design.plant, DAEModel))
    return -value if is_rate else value


def _designed(
    plant: PolytopicSystem | DAEModel, by: str, value: float | None, method: str, options: Mapping[str, Any]
) -> ObserverDesign:
    if isinstance(plant, PolytopicSystem):
        return designed(_changed(plant, by, value), method, **options)
    region = options.get("region")
    if not isinstance(region, Mapping):
        raise SpecError(f"region is {a_kind(region)}: give ranges of the signals of the plant.", path="region")
    shrunk = {text: _about_middle(ends, value or 1.0) for text, ends in region.items()}
    return designed(plant, "region-observer" if method == "auto" else method, **{**options, "region": shrunk})


def _changed(plant: PolytopicSystem, by: str, value: float | None) -> PolytopicSystem:
    """Return the plant over a share of its region, or with another rate."""
    scheduling, data = plant.scheduling, plant.as_dict()
    if by == "rate":
        if len(scheduling.names) != 1:
            raise SpecError(
                f"rates are for one scheduling parameter: there are {', '.join(scheduling.names)}.", path="rates"
            )
        entry = {"range": [float(scheduling.low[0]), float(scheduling.high[0])], "rate": value}
        return PolytopicSystem(**{**data, "scheduling": {scheduling.names[0]: entry}})
    size = 1.0 if value is None else value
    ranges = {
        name: {"range": _about_middle((low, high), size), "rate": rate}
        for name, low, high, rate in zip(
            scheduling.names, scheduling.low, scheduling.high, scheduling.rates, strict=True
        )
    }
    if "plant" in data:
        return PolytopicSystem(**{**data, "scheduling": ranges})
    if size > 1.0:
        raise SpecError("Vertices alone hold nothing beyond themselves: give sizes up to 1.", path="sizes")
    middle = 1.0 / plant.count
    weights = size * np.eye(plant.count) + (1.0 - size) * middle
    vertices = [plant.mean(row) for row in weights]
    return PolytopicSystem(vertices, scheduling=None if scheduling.gives_weights else ranges, shift=plant.shift)


def _about_middle(ends: Any, size: float) -> list[float]:
    low, high = (float(end) for end in ends)
    middle, half = 0.5 * (low + high), 0.5 * (high - low) * size
    return [middle - half, middle + half]
