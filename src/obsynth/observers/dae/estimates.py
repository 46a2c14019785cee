"""What an observer of a DAE says, sample by sample, with honest spreads."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from obsynth.analysis.dae_index import SINGULAR_CONDITION, involved
from obsynth.errors import SolverError
from obsynth.numerics.arrays import FloatArray, read_only

if TYPE_CHECKING:
    from obsynth.observers.dae.settings import DAESettings
    from obsynth.observers.dae.step_graph import ObserverGraph


@dataclass(frozen=True, eq=False)
class DAERow:
    """What the graph of an observer gave at one sample, or (with a leading axis) at several in a row.

    Fields: graph: Which laid it out; k: Number of the (first) sample; memory, said: What is carried on, and what is
    said besides; seen: ``(ny,)``, of bool: which outputs were there; moved: ``(nx,)``: how far the state was put onto
    its constraint; zeros but at k = 0.
    """

    graph: ObserverGraph
    k: int
    memory: FloatArray
    said: FloatArray
    seen: NDArray[np.bool_]
    moved: FloatArray

    def part(self, name: str) -> FloatArray:
        """Return one array by its name in the layouts `obsynth.observers.dae.memory_layout`."""
        layout, values = (self.graph.memory, self.memory) if name in self.graph.memory.shapes else (
            self.graph.row, self.said)  # fmt: skip
        return layout.part(values, name)

    @property
    def x(self) -> FloatArray:
        """The state after the measurement ``(nx,)``."""
        return self.part("posterior")

    @property
    def theta(self) -> FloatArray:
        """The parameters ``(nq,)``."""
        return self.part("theta")

    @property
    def covariance(self) -> FloatArray:
        """Covariance of `x` ``(nx, nx)``."""
        return self.part("covariance")

    @property
    def parameter_covariance(self) -> FloatArray:
        """Covariance of `theta` ``(nq, nq)``."""
        return self.part("spread")

    @property
    def innovation(self) -> FloatArray:
        """Outputs without what was predicted of them ``(ny,)``; NaN where a sample is missing."""
        return np.where(self.seen, self.part("innovation"), np.nan)

    @property
    def nis(self) -> FloatArray:
        """Square of the innovation in units of its covariance, a number."""
        return self.part("nis")[..., 0]

    @property
    def degrees(self) -> int:
        """Number of outputs that are there, of one sample."""
        return int(self.seen.sum())

    @property
    def several(self) -> DAERow:
        """The same with a leading axis of samples."""
        if self.memory.ndim == 2:
            return self
        return DAERow(self.graph, self.k, self.memory[None], self.said[None], self.seen[None], self.moved)

    @property
    def conditions(self) -> FloatArray:
        """Condition number of the equilibrated matrix of (7) at each sample; one at k = 0, where no step was taken."""
        rows = self.several
        matrices, found = rows.part("scaled"), np.ones(len(rows.memory))
        stepped = np.arange(self.k, self.k + len(matrices)) > 0
        values = np.linalg.svd(matrices[stepped], compute_uv=False)
        with np.errstate(divide="ignore"):
            found[stepped] = values[:, 0] / values[:, -1]
        return found

    @property
    def contractions(self) -> FloatArray:
        """Spectral radius of F (I - K H) at each sample; zero at k = 0."""
        return np.asarray(np.abs(np.linalg.eigvals(self.several.part("kept"))).max(axis=1))


@dataclass(frozen=True, eq=False)
class DAEEstimates:
    """Estimates of an observer of a DAE, one row per sample.

    Parameters
    ----------
    states, state_deviations : FloatArray
        ``(samples, nx)``: after the measurement of the same sample, and standard deviations of their errors.
    parameters : FloatArray
        ``(samples, nq)``.
    parameter_covariances : FloatArray
        ``(samples, nq, nq)``: the covariance of the estimates while the parameters are constant (or walk as stated).
        S is none: with forgetting it says how much is still remembered.
    innovations : FloatArray
        ``(samples, ny)``, in units of the outputs; NaN where a sample is missing.
    innovation_covariances : FloatArray
        ``(samples, ny, ny)``: what is expected of the innovations; rows and columns of missing samples are those of the
        identity.
    nis, nis_degrees : FloatArray
        ``(samples,)``: squared innovations in units of their covariance, and degrees of freedom.
    excitation : FloatArray
        ``(samples,)``: least eigenvalue of the information on the parameters in the last `window` samples, in units of
        ``S_0^-1``: below one, a window says less than was known before.  Zero while the window fills.
    residuals, conditions : FloatArray
        ``(samples,)``: scaled residual of each step, and condition of (7).
    contraction : FloatArray
        ``(samples,)``: spectral radius of F (I - K H); an error of the state filter decays in about
        ``-1 / log`` of it steps, which should not be longer than the window ``1 / (1 - lambda)``.
    projection : FloatArray
        ``(nx,)``: how far the initial state was moved onto its constraint.
    state_names, parameter_names : tuple of str
        Names of the columns.
    """

    states: FloatArray
    state_deviations: FloatArray
    parameters: FloatArray
    parameter_covariances: FloatArray
    innovations: FloatArray
    innovation_covariances: FloatArray
    nis: FloatArray
    nis_degrees: FloatArray
    excitation: FloatArray
    residuals: FloatArray
    conditions: FloatArray
    contraction: FloatArray
    projection: FloatArray
    state_names: tuple[str, ...]
    parameter_names: tuple[str, ...]

    @property
    def parameter_deviations(self) -> FloatArray:
        """Standard deviations of the parameters ``(samples, nq)``."""
        return np.asarray(np.sqrt(np.einsum("kii->ki", self.parameter_covariances)))


class GatheredRows:
    """What `DAEEstimates` keeps of the rows of a record, while it is being run.

    Fields: observer: Whose rows they are.
    """

    def __init__(self, observer: DAESettings) -> None:
        self.observer = observer
        self.parts: list[dict[str, FloatArray]] = []
        self.projection = np.zeros(observer.model.nx)

    def add(self, rows: DAERow) -> None:
        """Keep some rows."""
        if rows.k == 0:
            self.projection = rows.moved
        # Copies, so that what is not kept can go.
        self.parts.append({name: np.array(value) for name, value in _columns(rows.several).items()})

    def add_regular(self, rows: DAERow) -> None:
        """Keep some rows, unless the matrix of (7) was singular to working precision in one of them."""
        self.add(rows)
        conditions = self.parts[-1]["conditions"]
        if len(conditions) and conditions.max() > SINGULAR_CONDITION:
            raise _singular(self.observer, rows.several, int(np.argmax(conditions > SINGULAR_CONDITION)))

    def estimates(self, informations: FloatArray | None = None) -> DAEEstimates:
        """Return what was gathered.

        Shapes: ``informations (any, nq, nq)``.
        """
        whole = {name: np.concatenate([part[name] for part in self.parts]) for name in self.parts[0]}
        seen = whole.pop("information")
        levels = _excitation(self.observer, seen if informations is None else informations)
        whole["excitation"] = levels[len(levels) - len(whole["nis"]) :]
        return DAEEstimates(
            **{name: read_only(value) for name, value in whole.items()}, projection=read_only(self.projection),
            state_names=self.observer.state_names, parameter_names=self.observer.fault_names,
        )  # fmt: skip


def _singular(observer: DAESettings, rows: DAERow, i: int) -> SolverError:
    equations, states = involved(observer.model, rows.part("scaled")[i])
    k, condition = rows.k + i, float(rows.conditions[i])
    return SolverError(
        f"The matrix of (7), dF/dx' / dt + dF/dx, is singular at k = {k} (condition {condition:.3g}): the equations "
        f"{', '.join(map(repr, equations))} do not determine {', '.join(map(repr, states))} there.",
        record={"k": k, "condition": condition},
    )


def _columns(rows: DAERow) -> dict[str, FloatArray]:
    """Return what `DAEEstimates` keeps of some samples."""
    variances = np.einsum("kii->ki", rows.part("covariance"))
    return {
        "states": rows.x, "state_deviations": np.sqrt(np.maximum(variances, 0.0)),
        "parameters": rows.theta, "parameter_covariances": rows.parameter_covariance,
        "innovations": rows.innovation, "innovation_covariances": rows.part("expected"), "nis": rows.nis,
        "nis_degrees": rows.seen.sum(axis=1).astype(np.float64), "residuals": rows.part("residual")[:, 0],
        "conditions": rows.conditions, "contraction": rows.contractions, "information": rows.part("information"),
    }  # fmt: skip


def _excitation(observer: DAESettings, informations: FloatArray) -> FloatArray:
    levels, window = np.zeros(len(informations)), observer.window
    if not observer.model.nq or len(informations) < window:
        return levels
    root = np.linalg.cholesky(observer.initial_parameter_covariance)
    total = np.cumsum(root.T @ informations @ root, axis=0)
    total[window:] -= total[:-window].copy()
    levels[window - 1 :] = np.maximum(np.linalg.eigvalsh(total[window - 1 :])[:, 0], 0.0)
    return levels
