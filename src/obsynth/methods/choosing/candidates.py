"""Every method that exists for a plant, designed, sampled to one clock; the others with the reason why not."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np

from obsynth.errors import ObsynthError
from obsynth.methods.choosing.figures import DECOUPLED, FaultFigures, fault_figures
from obsynth.methods.method_spec import MethodSpec
from obsynth.methods.registry import REGISTRY, method_spec
from obsynth.observers.linear.derived import sample_observer
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.recursive.gain_schedule import steady_observer
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import ObserverDesign

#: Methods whose designs are continuous whatever the plant is used for: they are sampled afterwards.
CONTINUOUS_ONLY = ("pd-observer",)
#: An estimate that shows 90 % of a step later than this share of the plant's settling time comes after faster ones.
SLOW = 0.25


@dataclass(frozen=True, eq=False)
class Candidate:
    """A method for a plant: its design and figures, or why there is none.

    Fields: method; design; observer: on the clock; figures: of each fault; milliseconds: to design; refused.
    """

    method: str
    design: ObserverDesign | None
    observer: LinearObserver | None
    figures: tuple[FaultFigures, ...]
    milliseconds: float
    refused: str

    def rank(self, leaky: bool, settling: float = np.inf) -> tuple[float, ...]:
        """Return what sorts candidates by closed-form figures, the best first; ``leaky``: there are unknown inputs.

        Steps that are reached first, then decoupled estimates, then those that show a step well within the plant's
        settling time (s); among these a mean over time T divides noise by the root of T: the deviation times the root
        of the delay is what averaging cannot change.
        """
        if not self.figures:
            return (2.0, 0.0, 0.0, np.inf)
        missed = float(not all(found.reaches for found in self.figures))
        leak = float(leaky and any(found.leak > DECOUPLED for found in self.figures))
        slow = float(any(found.most > SLOW * settling for found in self.figures))
        dt = self.observer.dt if self.observer is not None else 0.0
        prices = [found.deviation * np.sqrt(max(found.most, dt)) for found in self.figures]
        price = float(np.prod(prices) ** (1.0 / len(prices))) if np.all(np.isfinite(prices)) else np.inf
        return (missed, leak, slow, price)


def candidate(
    method: str,
    plant: DescriptorSystem,
    sampled: DescriptorSystem,
    steps: int,
    maker: Callable[[DescriptorSystem, str, Mapping[str, Any]], ObserverDesign],
    options: Mapping[str, Any],
    *,
    continuous: bool = False,
) -> Candidate:
    """Return one method for a plant; on the sampled plant where it can be, or else (or if asked) sampled afterwards."""
    spec = method_spec(method)
    if "time-invariant" not in spec.plants:
        return _refused(method, "for nonlinear plants")
    begun = perf_counter()
    try:
        made = maker(plant if continuous or method in CONTINUOUS_ONLY else sampled, method, options)
        observer = _sampled(made, sampled.dt)
    except ObsynthError as error:
        return _refused(method, one_line(str(error)), 1e3 * (perf_counter() - begun))
    spent = 1e3 * (perf_counter() - begun)
    if not observer.fault_names or any(name not in sampled.fault_names for name in observer.fault_names):
        return _refused(method, "estimates the state, but no fault", spent)
    return Candidate(method, made, observer, fault_figures(sampled, observer, steps), spent, "")


def _sampled(design: ObserverDesign, dt: float) -> LinearObserver:
    if isinstance(design.observer, LinearObserver):
        return design.observer if design.observer.dt > 0.0 else sample_observer(design.observer, dt)
    return steady_observer(design.recursive[1]).observer


def _refused(method: str, reason: str, spent: float = 0.0) -> Candidate:
    return Candidate(method, None, None, (), spent, reason)


#: Letters of a message that are shown.
MOST_LETTERS = 160


def one_line(text: str) -> str:
    """Return the start of a message in one line, with what would help, which stands at its end."""
    flat = " ".join(text.split())
    for mark in ("Add one of:", "Leave out one of:"):
        head, found, tail = flat.rpartition(mark)
        if found:
            return f"{_cut(head)} {mark}{tail}"
    return _cut(flat)


def _cut(text: str) -> str:
    short = text.removeprefix("No observer of this kind exists: ").strip()
    return short if len(short) <= MOST_LETTERS else short[: MOST_LETTERS - 3].rstrip() + "..."


def linear_methods() -> Sequence[MethodSpec]:
    """Return the methods that take linear plants with constant matrices."""
    return [found for found in map(method_spec, REGISTRY) if "time-invariant" in found.plants]
