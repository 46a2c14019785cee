"""An observer of a nonlinear plant on a log."""

from __future__ import annotations

from typing import Any

import numpy as np

from obsynth.data.step_log import SteppingEngine, without_outliers
from obsynth.errors import SolverError, SpecError
from obsynth.experiments.monitors.online import Evidence
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.estimates import Estimates
from obsynth.observers.linear.warm_up import checked_warm_up
from obsynth.observers.running import RunningObserver
from obsynth.results.design import ObserverDesign


class DAEDataObserver(SteppingEngine[Estimates]):
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

    def started(self) -> RunningObserver[Any, Any]:
        """Return the running observer, at k = 0."""
        return self.observer.start()

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

    def taken(self, y: FloatArray, u: FloatArray, row: int) -> Estimates | Exception | None:
        """Take one sample, or return why it cannot be taken.

        Shapes: ``y (ny,)``, ``u (nu,)``.
        """
        try:
            found: Estimates = self.running.step(y, u)
        except SolverError as error:
            return SolverError(f"Row {row}: {error}")
        except (np.linalg.LinAlgError, ValueError):
            return None
        arrays = (found.states, found.parameters, found.state_deviations, found.parameter_covariances)
        return found if all(bool(np.isfinite(array).all()) for array in arrays) else None

    def values(self, found: Estimates) -> FloatArray:
        """Return a row: estimates, standard deviations, innovation."""
        parts = (found.states, found.parameters, found.state_deviations, found.parameter_deviations, found.innovations)
        return np.concatenate([part[0] for part in parts])

    def evidence(self, found: Estimates) -> Evidence:
        """Return what the sample says, for decisions; to first order, as the covariances."""
        # Only the length of the innovation counts, which is known in units of its own covariance.
        degrees = int(found.nis_degrees[0])
        white = np.zeros(degrees)
        white[:1] = np.sqrt(max(float(found.nis[0]), 0.0))
        return Evidence(found.parameters[0], found.parameter_covariances[0], white, np.zeros((degrees, 0)))
