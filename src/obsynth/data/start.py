"""The engine of a design: which kind of observer it ships decides."""

from __future__ import annotations

from obsynth.data.dae_log import DAEDataObserver
from obsynth.data.linear_log import DataObserver
from obsynth.data.log_estimator import Engine
from obsynth.data.recursive_log import RecursiveDataObserver
from obsynth.errors import SpecError
from obsynth.observers.dae.observer import DAEObserver
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.results.design import ObserverDesign


def engine_of(
    design: ObserverDesign, *, gap: float | None = None, warm_up: float | None = None, outliers: str | None = None
) -> Engine:
    """Return a running design, at its start; ``outliers`` takes the place of what the design says of them."""
    if not isinstance(design.observer, (RecursiveObserver, DAEObserver)):
        if outliers not in (None, "none"):
            raise SpecError("outliers is for recursive and nonlinear designs, which know how far a sample may be from "
                            "its prediction.", path="outliers")  # fmt: skip
        return DataObserver(design, gap=gap, warm_up=warm_up)
    if gap is not None:
        raise SpecError("gap is for continuous-time designs: a sampled one knows which rows are missing.", path="gap")
    if isinstance(design.observer, RecursiveObserver):
        return RecursiveDataObserver(design, warm_up=warm_up, outliers=outliers)
    return DAEDataObserver(design, warm_up=warm_up, outliers=outliers)
