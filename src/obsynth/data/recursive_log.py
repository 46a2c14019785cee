"""A recursive observer on a log: it takes missing samples itself, and knows how much they cost."""

from __future__ import annotations

from typing import Any

import numpy as np

from obsynth.data.step_log import SteppingEngine, without_outliers
from obsynth.errors import PreconditionError, SpecError
from obsynth.experiments.monitors.online import Evidence
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.warm_up import checked_warm_up
from obsynth.observers.recursive.estimates import deviations_of
from obsynth.observers.recursive.records import require_horizon
from obsynth.observers.recursive.recursion import RawEstimate
from obsynth.observers.running import RunningObserver
from obsynth.results.design import ObserverDesign


class RecursiveDataObserver(SteppingEngine[RawEstimate]):
    """A running recursive observer on measured data.

    Fields: design: A recursive design; warm_up: Seconds that are marked after a start, and after rows with unknown
    inputs, none by default: the covariances of the start say how uncertain the estimates are; outliers: What is done
    with them, a gate by default.
    """

    uses_first_outputs = False

    def __init__(self, design: ObserverDesign, *, warm_up: float | None = None, outliers: str | None = None) -> None:
        self.plant, self.observer = design.recursive
        self.observer = without_outliers(self.observer, outliers)
        # H_k has as many directions beside the state as there are parity innovations.
        self.directions = self.plant.ne + self.plant.ny - self.plant.nx
        residuals = tuple(f"innovation {i + 1}" for i in range(self.directions))
        constant = self.plant.is_time_invariant and self.observer.Q.is_constant and self.observer.R.is_constant
        super().__init__(
            (self.plant.input_names, self.plant.output_names, self.observer.state_names, self.observer.fault_names,
             residuals),
            dt=self.plant.dt, warm_up=checked_warm_up(warm_up, 0.0),
            may_restart=constant and self.plant.horizon is None,
        )  # fmt: skip
        self.point, self.scales = self.plant.operating_point, self.plant.scales
        self.theta = np.zeros(len(self.fault_names))

    def started(self) -> RunningObserver[Any, Any]:
        """Return the running observer, at k = 0."""
        return self.observer.start()

    def taken(self, y: FloatArray, u: FloatArray, row: int) -> RawEstimate | Exception | None:
        """Take one sample, or return why it cannot be taken.

        Shapes: ``y (ny,)``, ``u (nu,)``.
        """
        try:
            require_horizon(self.plant.horizon, self.running.state.k + 1, early=self.observer.early_constraints)
            self.theta = self.running.state.parameters.theta
            found: RawEstimate = self.running.raw_step(y, u)
        except SpecError as error:
            raise SpecError(f"Row {row}: {error}", path=f"row {row}") from error
        except PreconditionError as error:
            raise PreconditionError(f"Row {row}: {error}", condition=error.condition) from error
        except (np.linalg.LinAlgError, ValueError):
            return None
        arrays = (found.x, found.factor, found.parameters.theta, found.parameters.spread, found.innovation)
        return found if all(bool(np.isfinite(array).all()) for array in arrays) else None

    def values(self, found: RawEstimate) -> FloatArray:
        """Return a row: estimates, standard deviations, innovation at the parameters of one sample before."""
        residual = np.full(self.directions, np.nan)
        gap = found.innovation - found.regressor @ self.theta if found.regressor.size else found.innovation
        # The correction of the start by early constraints has no more directions, but may have fewer.
        residual[: min(len(gap), self.directions)] = gap[: self.directions]
        spread = found.parameters.spread
        deviations = np.sqrt(np.einsum("ij,ij->i", spread, spread))
        return np.concatenate([found.x, found.parameters.theta, deviations_of(found), deviations, residual])

    def evidence(self, found: RawEstimate) -> Evidence:
        """Return what the sample says, for decisions."""
        known = found.parameters
        return Evidence(known.theta, known.spread @ known.spread.T, found.innovation, found.regressor)
