"""The rows of an observer of a DAE, sample by sample or several at once, and the estimates in them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from obsynth.analysis.dae_structure import involved
from obsynth.errors import SolverError
from obsynth.numerics import lapack
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.numerics.ranks import SINGULAR_CONDITION
from obsynth.observers.estimates import NO_NUMBERS, Estimates
from obsynth.observers.running import STEP_RESIDUAL, named_estimates

if TYPE_CHECKING:
    from obsynth.observers.nonlinear.settings import DAESettings
    from obsynth.observers.nonlinear.step_graph import ObserverGraph


#: Single rows whose estimates are made together.
GATHERED_TOGETHER = 256


def _part(name: str, meaning: str) -> Any:
    """Return a property of a row: an array by its name in the layouts."""
    return property(lambda row: row.part(name), doc=meaning)


@dataclass(frozen=True, eq=False)
class DAERow:
    """What the graph of an observer gave at one sample, or (with a leading axis) at several in a row."""

    graph: ObserverGraph  # which laid it out
    k: int  # number of the (first) sample
    memory: FloatArray  # what is carried on to the next sample, packed
    row_values: FloatArray  # what else is computed at this sample, packed
    measured: NDArray[np.bool_]  # ``(ny,)``, of bool: which outputs were there
    moved: FloatArray  # ``(nx,)``: how far the state was put onto its constraint; zeros but at k = 0

    def part(self, name: str) -> FloatArray:
        """Return one array by its name in the layouts `obsynth.observers.nonlinear.settings`."""
        layout, values = (
            (self.graph.memory, self.memory) if name in self.graph.memory.shapes else (self.graph.row, self.row_values)
        )
        return layout.part(values, name)

    x = _part("posterior", "The state after the measurement ``(nx,)``.")
    theta = _part("theta", "The parameters ``(nq,)``.")
    covariance = _part("covariance", "Covariance of `x` ``(nx, nx)``.")
    parameter_covariance = _part("spread", "Covariance of `theta` ``(nq, nq)``.")
    score = _part("score", "What the sample says of the parameters ``(nq,)``, see `row_layout`.")
    information = _part("information", "How much it says of them ``(nq, nq)``.")

    @property
    def cross_covariance(self) -> FloatArray:
        """Covariance of `x` with `theta` ``(nx, nq)``."""
        if "cross" in self.graph.memory.shapes:
            return self.part("cross")
        K, H, L, Upsilon = (self.part(name) for name in ("K", "H", "L", "Upsilon"))
        return np.asarray((Upsilon - K @ (H @ Upsilon + L)) @ self.parameter_covariance)

    @property
    def innovation(self) -> FloatArray:
        """Outputs without what was predicted of them ``(ny,)``; NaN where a sample is missing."""
        return np.where(self.measured, self.part("innovation"), np.nan)

    @property
    def gap(self) -> FloatArray:
        """The same, under the name that every observer of parameters has for it: parameters are those before."""
        return self.innovation

    @property
    def whitened(self) -> FloatArray:
        """An innovation of the same length in units of its covariance ``(degrees,)``, of one sample; to first order.
        Only its length counts for decisions."""
        white = np.zeros(self.degrees)
        white[:1] = np.sqrt(max(float(self.nis), 0.0))
        return white

    @property
    def regressor(self) -> FloatArray:
        """Regressor of `whitened` ``(degrees, 0)``: there is none."""
        return np.zeros((self.degrees, 0))

    @property
    def state_deviations(self) -> FloatArray:
        """Standard deviations of `x` ``(nx,)``."""
        return np.asarray(np.sqrt(np.maximum(np.einsum("...ii->...i", self.covariance), 0.0)))

    @property
    def is_finite(self) -> bool:
        """Whether no number has overflown."""
        arrays = (self.x, self.theta, self.state_deviations, self.parameter_covariance)
        return all(bool(np.isfinite(array).all()) for array in arrays)

    @property
    def nis(self) -> FloatArray:
        """Square of the innovation in units of its covariance, a number."""
        return self.part("nis")[..., 0]

    @property
    def degrees(self) -> int:
        """Number of outputs that are there, of one sample."""
        return int(self.measured.sum())

    @cached_property
    def several(self) -> DAERow:
        """The same with a leading axis of samples."""
        if self.memory.ndim == 2:
            return self
        return DAERow(self.graph, self.k, self.memory[None], self.row_values[None], self.measured[None], self.moved)

    @cached_property
    def conditions(self) -> FloatArray:
        """Condition number of the equilibrated matrix of (7) at each sample; one at k = 0, where no step was taken."""
        rows = self.several
        if rows is not self:
            return np.array([self.condition])
        numbers, begin = np.full(len(rows.memory), np.inf), int(self.k == 0)
        numbers[:begin] = 1.0
        values = np.linalg.svd(rows.part("scaled")[begin:], compute_uv=False)
        least = values[:, -1]
        np.divide(values[:, 0], least, out=numbers[begin:], where=least > 0.0)
        return numbers

    @property
    def condition(self) -> float:
        """The same number of one sample, infinite where LAPACK has none."""
        if self.k == 0:
            return 1.0
        _, values, _, failed = lapack.dgesdd(self.part("scaled"), compute_uv=0)
        least = float(values[-1])
        return float(values[0]) / least if not failed and least > 0.0 else np.inf

    @property
    def contractions(self) -> FloatArray:
        """Spectral radius of F (I - K H) at each sample; zero at k = 0."""
        return np.asarray(np.abs(np.linalg.eigvals(self.several.part("kept"))).max(axis=1))


class GatheredRows:
    """What the estimates keep of the rows of a record, while it is being run."""

    def __init__(self, observer: DAESettings) -> None:
        self.observer = observer
        self.parts: list[dict[str, FloatArray]] = []
        self.single: list[DAERow] = []
        self.projection = np.zeros(observer.model.nx)

    def add(self, rows: DAERow) -> None:
        """Keep some rows.  What is kept of single ones is made of many together: of each it takes as long as its
        step."""
        if rows.k == 0:
            self.projection = rows.moved
        if rows.memory.ndim == 1:
            self.single.append(rows)
        if rows.memory.ndim > 1 or len(self.single) >= GATHERED_TOGETHER:
            self._keep_single()
        if rows.memory.ndim > 1:
            self._keep(rows)

    def _keep_single(self) -> None:
        """Keep single rows that wait."""
        if not self.single:
            return
        first, rows = self.single[0], self.single
        memory, values, measured = (
            np.stack([getattr(row, name) for row in rows]) for name in ("memory", "row_values", "measured")
        )
        self._keep(DAERow(first.graph, first.k, memory, values, measured, first.moved))
        self.single = []

    def _keep(self, rows: DAERow) -> None:
        # Copies, so that what is not kept can go.
        self.parts.append({name: np.array(of(rows)) for name, of in _KEPT_COLUMNS.items()})

    def add_regular(self, rows: DAERow) -> None:
        """Keep some rows, unless the matrix of (7) was singular to working precision in one of them."""
        self.add(rows)
        self._keep_single()
        require_regular(self.observer, rows, self.parts[-1]["conditions"])

    def estimates(self) -> Estimates:
        """Return what was gathered."""
        self._keep_single()
        first, *more = self.parts
        columns = {name: np.concatenate([part[name] for part in self.parts]) for name in first} if more else dict(first)
        columns["excitation"] = _excitation(self.observer, columns["informations"])
        received = read_only(~np.isnan(columns["innovations"]), bool)
        return named_estimates(self.observer, **columns, projection=self.projection, received=received)


def require_regular(observer: DAESettings, rows: DAERow, conditions: FloatArray) -> None:
    """Raise `SolverError` where the matrix of (7) was singular to working precision (``conditions (samples,)``)."""
    if not len(conditions) or conditions.max() <= SINGULAR_CONDITION:
        return
    rows, i = rows.several, int(np.argmax(conditions > SINGULAR_CONDITION))
    equations, states = involved(observer.model, rows.part("scaled")[i])
    k, condition = rows.k + i, float(conditions[i])
    raise SolverError(
        f"The matrix of (7), dF/dx' / dt + dF/dx, is singular at k = {k} (condition {condition:.3g}): the equations "
        f"{', '.join(map(repr, equations))} do not determine {', '.join(map(repr, states))} there.",
        record={"k": k, "condition": condition},
    )


#: What the estimates keep of some samples, by its name there.
_KEPT_COLUMNS: Mapping[str, Callable[[DAERow], FloatArray]] = {
    "states": lambda rows: rows.x,
    "state_deviations": lambda rows: rows.state_deviations,
    "state_covariances": lambda rows: rows.covariance,
    "cross_covariances": lambda rows: rows.cross_covariance,
    "faults": lambda rows: rows.theta,
    "fault_covariances": lambda rows: rows.parameter_covariance,
    "innovations": lambda rows: rows.innovation,
    "innovation_covariances": lambda rows: rows.part("expected"),
    "nis": lambda rows: rows.nis,
    "nis_degrees": lambda rows: rows.measured.sum(axis=1).astype(np.float64),
    "residuals": lambda rows: rows.part("residual"),
    "conditions": lambda rows: rows.conditions,
    "contraction": lambda rows: rows.contractions,
    "informations": lambda rows: rows.information,
    "scores": lambda rows: rows.score,
}


class SampleEstimates(Estimates):
    """The estimates of one sample: each array is made when it is first asked for, most are not."""

    def __init__(self, observer: DAESettings, row: DAERow, informations: tuple[FloatArray, ...]) -> None:
        """Keep the row, and the information (``(nq, nq)`` each) on the parameters of the latest samples."""
        vars(self).update(
            _observer=observer, _row=row, _informations=informations,
            residual_names=STEP_RESIDUAL, regressors=NO_NUMBERS,
        )  # fmt: skip

    def __getattr__(self, name: str) -> Any:
        made: Any
        if name in _KEPT_COLUMNS:
            made = read_only(_KEPT_COLUMNS[name](self._row.several))
        elif name in ("state_names", "fault_names", "state_delays", "fault_delays"):
            made = getattr(self._observer, name)
        elif name == "excitation":
            made = read_only(_excitation(self._observer, np.array(self._informations))[-1:])
        elif name == "projection":
            made = read_only(self._row.moved)
        elif name == "received":
            made = read_only(~np.isnan(self.innovations), bool)
        else:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        vars(self)[name] = made
        return made

    def __reduce__(self) -> tuple[Any, ...]:
        return Estimates, tuple(getattr(self, field.name) for field in fields(Estimates))


def _excitation(observer: DAESettings, informations: FloatArray) -> FloatArray:
    levels, window = np.zeros(len(informations)), observer.window
    if not observer.model.nq or len(informations) < window:
        return levels
    root = np.linalg.cholesky(observer.initial_parameter_covariance)
    total = np.cumsum(root.T @ informations @ root, axis=0)
    total[window:] -= total[:-window].copy()
    levels[window - 1 :] = np.maximum(np.linalg.eigvalsh(total[window - 1 :])[:, 0], 0.0)
    return levels
