"""Which rows of a linear observer's output a monitor watches: its residuals, or its fault estimates."""

from __future__ import annotations

from enum import Enum

from obsynth.numerics.arrays import FloatArray
from obsynth.observers.estimates import Estimates
from obsynth.observers.linear.observer import LinearObserver
from obsynth.results.design import ObserverDesign


class Watched(Enum):
    """Rows of an observer's output that are zero without a fault, but for errors."""

    RESIDUALS = "residuals"
    ESTIMATES = "fault estimates"

    def rows(self, observer: LinearObserver) -> slice:
        """Return their places among the rows of the observer."""
        return observer.fault_rows if self is Watched.ESTIMATES else observer.residual_rows

    def of(self, estimates: Estimates) -> FloatArray:
        """Return what is watched of a record ``(steps, n)``."""
        return estimates.faults if self is Watched.ESTIMATES else estimates.residuals


def watched_by(design: ObserverDesign, kind: str) -> Watched:
    """Return what a monitor of a kind watches: the threshold of a paper is one on the residual in any case.

    A residual that is made not to see the faults that are modelled shows their beginning and their end at most.
    """
    return Watched.ESTIMATES if kind != "paper" and estimates_modelled_faults(design) else Watched.RESIDUALS


def estimates_modelled_faults(design: ObserverDesign) -> bool:
    """Whether the observer holds a model of the faults, which it estimates, so that its residual does not see them."""
    return "Phi" in design.certificate.matrices and bool(design.linear[1].fault_names)
