"""What is known of an observer of a DAE from a run at nominal inputs and parameters, without noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsynth.analysis.dae_structure import Identifiability, IndexReport, identifiability, index_report
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.observers.dae.estimates import DAERow, GatheredRows
from obsynth.observers.dae.observer import DAEObserver
from obsynth.observers.dae.records import advanced

#: Steps of the nominal run.
NOMINAL_STEPS = 100


@dataclass(frozen=True, eq=False)
class DAEFacts:
    """Facts of a nominal run.

    Fields: index: At the nominal point; condition: Largest condition number of (7) along the run; condition_k: The
    sample at which it is largest; residual: Largest scaled Newton residual; contraction: Spectral radius of F (I - K H)
    at the end; deviations: ``(nq,)``: standard deviations of the parameters at the end; correlations: ``(nq, nq)``: of
    the parameters' errors at the end: how much a change of one is taken for another; projection: ``(nx,)``: how far the
    initial state is moved onto its constraint; identifiable: Of states and parameters along the nominal trajectory; K:
    ``(nx, ny)`` at the end; Upsilon: ``(nx, nq)`` at the end; kept: ``(steps, nx, nx)``: F (I - K H) of every step;
    parameter_covariance: ``(nq, nq)`` at the end.
    """

    index: IndexReport
    condition: float
    condition_k: int
    residual: float
    contraction: float
    deviations: FloatArray
    correlations: FloatArray
    projection: FloatArray
    identifiable: Identifiability
    K: FloatArray
    Upsilon: FloatArray
    kept: FloatArray
    parameter_covariance: FloatArray

    @property
    def decay_time(self) -> float:
        """Steps in which an error of the state filter falls to 1/e; infinite where it does not."""
        if not 0.0 < self.contraction < 1.0:
            return 0.0 if self.contraction == 0.0 else float("inf")
        return float(-1.0 / np.log(self.contraction))


def dae_facts(observer: DAEObserver) -> DAEFacts:
    """Run an observer on its own model at nominal inputs and parameters."""
    model = observer.model
    u = np.array(model.nominal_input)
    truth = _nominal_outputs(observer, u)
    gathered, kept = GatheredRows(observer), []

    def add(rows: DAERow) -> None:
        gathered.add(rows)
        kept.append(np.array(rows.several.part("kept")))

    end = advanced(observer.steps, truth, np.tile(u, (len(truth), 1)), add)
    found = gathered.estimates()
    covariance = found.parameter_covariances[-1]
    deviations = np.sqrt(np.diag(covariance))
    safe = np.where(deviations > 0.0, deviations, 1.0)
    identifiable = identifiability(
        model, np.tile(u, (NOMINAL_STEPS + 1, 1)), dt=observer.dt, R=observer.R, method=observer.integration,
        initial_state=observer.initial_state, parameters=observer.initial_parameters,
        parameter_scales=np.sqrt(np.diag(observer.initial_parameter_covariance)),
    )  # fmt: skip
    return DAEFacts(
        index_report(model, observer.dt, x=found.states[-1], u=u, theta=found.parameters[-1]),
        float(found.conditions.max()), int(np.argmax(found.conditions)), float(found.residuals.max()),
        float(found.contraction[-1]), read_only(deviations), read_only(covariance / np.outer(safe, safe)),
        found.projection, identifiable, read_only(observer.steps.part(end, "K")),
        read_only(observer.steps.part(end, "Upsilon")), read_only(np.concatenate(kept)[1:]), read_only(covariance),
    )  # fmt: skip


def _nominal_outputs(observer: DAEObserver, u: FloatArray) -> FloatArray:
    """Return the outputs of the model from the observer's initial state, without noise."""
    step = observer.steps.implicit
    x, theta = np.array(observer.initial_state), np.array(observer.initial_parameters)
    outputs = []
    for k in range(NOMINAL_STEPS + 1):
        x = step.solve(x, u, theta, k=k).x
        outputs.append(step.functions.outputs(x, theta)[0])
    return np.array(outputs)
