"""The innovations of a design along a log, with what the design expects of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from obsynth.calibration.logs import Log
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.observers.dae.observer import DAEObserver
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.results.design import ObserverDesign


@dataclass(frozen=True, eq=False)
class RecordedInnovations:
    """Innovations ``(n, ny)`` and their deviations; sum of NIS and of its degrees; each parameter ``(n, 2)``."""

    innovations: FloatArray
    deviations: FloatArray
    squares: float
    degrees: int
    estimates: Mapping[str, FloatArray]

    @property
    def standardised(self) -> FloatArray:
        """Innovations in their own deviations ``(n, ny)``, NaN where nothing was measured."""
        return np.asarray(self.innovations / self.deviations)


def recorded_innovations(design: ObserverDesign, log: Log) -> RecordedInnovations:
    """Run a design over a log."""
    observer = design.observer
    if isinstance(observer, DAEObserver):
        return _nonlinear(observer, log)
    if isinstance(observer, RecursiveObserver):
        return _recursive(observer, log, dict(getattr(design.plant, "operating_point", {})))
    raise TypeError(f"{type(observer).__name__} has no innovations with a covariance")


def _nonlinear(observer: DAEObserver, log: Log) -> RecordedInnovations:
    found = observer.run(log.y, log.u, progress=False)
    deviations = np.sqrt(np.einsum("kii->ki", found.innovation_covariances))
    return RecordedInnovations(
        found.innovations, deviations, float(found.nis.sum()), int(found.nis_degrees.sum()),
        _estimates(found.parameter_names, found.parameters, found.parameter_covariances),
    )  # fmt: skip


def _recursive(observer: RecursiveObserver, log: Log, point: Mapping[str, float]) -> RecordedInnovations:
    """Predict each sample from those before it: a step without measurements, beside the one with them."""
    plant = observer.plant
    y = log.y - np.array([point.get(name, 0.0) for name in plant.output_names])
    u = log.u - np.array([point.get(name, 0.0) for name in plant.input_names])
    state, nothing = observer.init(), np.full(plant.ny, np.nan)
    e, deviations = np.full(y.shape, np.nan), np.full(y.shape, np.nan)
    for k in range(len(y)):
        if k:
            mean, spread = observer.recursion.predicted(state, nothing, u[k])
            e[k], deviations[k] = np.where(np.isfinite(spread), y[k] - mean, np.nan), spread
        state, _ = observer.advance(state, y[k], u[k])
    found = observer.run(y, u)
    return RecordedInnovations(
        e, deviations, float(found.nis.sum()), int(found.nis_degrees.sum()),
        _estimates(found.parameter_names, found.parameters, found.parameter_covariances),
    )  # fmt: skip


def _estimates(names: tuple[str, ...], values: FloatArray, covariances: FloatArray) -> dict[str, FloatArray]:
    deviations = np.sqrt(np.einsum("kii->ki", covariances))
    return {name: read_only(np.column_stack([values[:, i], deviations[:, i]])) for i, name in enumerate(names)}
