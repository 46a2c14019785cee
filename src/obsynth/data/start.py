"""The engine of a design: which kind of observer it ships decides.

An observer of a nonlinear plant on a log.

A recursive observer on a log: it takes missing samples itself, and knows how much they cost.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from obsynth.data.linear_log import DataObserver
from obsynth.data.log_estimator import Engine
from obsynth.data.step_log import SteppingEngine, without_outliers
from obsynth.errors import PreconditionError, SolverError, SpecError
from obsynth.experiments.monitors.online import Evidence
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.dae.estimates import DAEEstimates
from obsynth.observers.dae.observer import DAEObserver
from obsynth.observers.linear.warm_up import checked_warm_up
from obsynth.observers.recursive.estimates import deviations_of
from obsynth.observers.recursive.observer import RecursiveObserver
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

    def started(self) -> RunningObserver[Any, Any, Any]:
        """Return the running observer, at k = 0."""
        found: RunningObserver[Any, Any, Any] = self.observer.start()
        return found

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


class DAEDataObserver(SteppingEngine[DAEEstimates]):
    """A running observer of a DAE on measured data; signals are absolute values, as the model's.

    Fields: design: Of a nonlinear plant; warm_up: Seconds that are marked after a start, and after rows with unknown
    inputs, none by default: the covariances of the start say how uncertain the estimates are; outliers: What is done
    with them, a gate by default.
    """

    def __init__(self, design: ObserverDesign, *, warm_up: float | None = None, outliers: str | None = None) -> None:
        self.model, self.observer = design.nonlinear
        self.observer = without_outliers(self.observer, outliers)
        super().__init__(
            (self.model.input_names, self.model.output_names, self.observer.state_names, self.observer.fault_names,
             self.model.output_names),
            dt=self.observer.dt, warm_up=checked_warm_up(warm_up, 0.0), may_restart=True,
        )  # fmt: skip

    def started(self) -> RunningObserver[Any, Any, Any]:
        """Return the running observer, at k = 0."""
        found: RunningObserver[Any, Any, Any] = self.observer.start()
        return found

    def first_inputs(self, values: FloatArray, row: int) -> FloatArray:
        """Return the inputs of the first row, in which they must be known.

        Shapes: ``values (nu,)``.
        """
        if not np.isfinite(values).all():
            raise SpecError(
                f"Row {row}: an input is missing before it was ever known, and a nonlinear model has no zero to begin "
                "with: begin with a row in which all inputs are known.", path=f"row {row}",
            )  # fmt: skip
        return values

    def taken(self, y: FloatArray, u: FloatArray, row: int) -> DAEEstimates | Exception | None:
        """Take one sample, or return why it cannot be taken.

        Shapes: ``y (ny,)``, ``u (nu,)``.
        """
        try:
            said = self.running.raw_step(y, u)
            found: DAEEstimates = self.observer.estimates(self.running.state, said)
        except SolverError as error:
            return SolverError(f"Row {row}: {error}")
        except (np.linalg.LinAlgError, ValueError):
            return None
        arrays = (found.states, found.parameters, found.state_deviations, found.parameter_covariances)
        return found if all(bool(np.isfinite(array).all()) for array in arrays) else None

    def values(self, found: DAEEstimates) -> FloatArray:
        """Return a row: estimates, standard deviations, innovation."""
        parts = (found.states, found.parameters, found.state_deviations, found.parameter_deviations, found.innovations)
        return np.concatenate([part[0] for part in parts])

    def evidence(self, found: DAEEstimates) -> Evidence:
        """Return what the sample says, for decisions; to first order, as the covariances."""
        # Only the length of the innovation counts, which is known in units of its own covariance.
        degrees = int(found.nis_degrees[0])
        white = np.zeros(degrees)
        white[:1] = np.sqrt(max(float(found.nis[0]), 0.0))
        return Evidence(found.parameters[0], found.parameter_covariances[0], white, np.zeros((degrees, 0)))


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
