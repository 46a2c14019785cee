"""The problem of a calibration, checked: a model with unknown constants, a log, priors and known variances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.errors import SpecError, counted
from obsynth.monitoring.calibration.logs import EVEN, RecordedLog, bad_log, quantum, refused, repeats
from obsynth.monitoring.calibration.plants import CalibrationPlant
from obsynth.monitoring.calibration.step_graphs import SampleGraphs, sample_graphs
from obsynth.numerics.arguments import is_number, real_number, require_mapping, require_shape, whole_number
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import covariance_factor
from obsynth.observers.records import named_covariance, named_vector
from obsynth.plants.signal_names import index_of

#: Measured values for each unknown constant and variance that are needed at least.
VALUES_PER_UNKNOWN = 5

#: Least deviation of a sensor, as a share of its largest value: rounding.
LEAST_NOISE = 1e-9


@dataclass(frozen=True, eq=False)
class CalibrationProblem:
    """A plant with its log; arrays by unknown ``(nt,)``, by sensor ``(ny,)``, by noisy equation. ``u (n, ns)``: the
    signals that the plant takes of each row."""

    plant: CalibrationPlant
    log: RecordedLog
    u: FloatArray
    unknown: tuple[str, ...]
    nominal: FloatArray
    low: FloatArray
    high: FloatArray
    prior_means: FloatArray
    prior_weights: FloatArray
    noisy: tuple[str, ...]
    known_Q: FloatArray
    known_R: FloatArray
    x0: FloatArray
    P0: FloatArray
    quanta: FloatArray
    floors: FloatArray
    graphs: SampleGraphs
    integration: str
    substeps: int
    notes: tuple[str, ...] = ()

    @property
    def y(self) -> FloatArray:
        """Outputs ``(n, ny)``, NaN where missing."""
        return self.log.y

    @property
    def names(self) -> tuple[str, ...]:
        """The constants that were asked for; what is sought beside them stands last."""
        return self.unknown[: len(self.unknown) - len(self.plant.bounds)]

    @property
    def widths(self) -> FloatArray:
        """Width of the bounds of each unknown ``(nt,)``."""
        return self.high - self.low

    @property
    def output_names(self) -> tuple[str, ...]:
        """The sensors."""
        return self.log.output_names

    @property
    def noisy_equations(self) -> list[int]:
        """Numbers of the noisy equations."""
        return [self.plant.equation_names.index(name) for name in self.noisy]

    def integrated(self, integration: str, substeps: int) -> CalibrationProblem:
        """Return the same problem with other steps."""
        graphs = sample_graphs(
            self.plant, self.unknown, self.log.dt, integration=integration, substeps=substeps, samples=self.log.samples
        )
        return CalibrationProblem(**{**vars(self), "graphs": graphs, "integration": integration, "substeps": substeps})

    def with_start(self, P0: FloatArray, *notes: str) -> CalibrationProblem:
        """Return the same problem with another covariance of the initial state, and what is said of that."""
        return CalibrationProblem(**{**vars(self), "P0": P0, "notes": notes})

    def with_notes(self, *notes: str) -> CalibrationProblem:
        """Return the same problem with more that is said of it."""
        return CalibrationProblem(**{**vars(self), "notes": (*self.notes, *notes)})

    def with_log(self, log: RecordedLog) -> CalibrationProblem:
        """Return the same problem with another log of the same signals."""
        return CalibrationProblem(**{**vars(self), "log": log, "u": self.plant.signals(log)})

    def with_whole_log(self, log: RecordedLog) -> CalibrationProblem:
        """Return the same problem with the log of which it had some rows."""
        quanta = np.array([quantum(column) for column in log.y.T])
        return CalibrationProblem(**{**vars(self.with_log(log)), "quanta": quanta, "floors": _floors(log.y, quanta)})


def calibration_problem(
    plant: CalibrationPlant,
    log: RecordedLog,
    *,
    unknown: Mapping[str, Sequence[float]],
    priors: Mapping[str, Sequence[float]] | None,
    noisy: Sequence[str] | None,
    Q: Mapping[str, float | None] | None,
    R: Mapping[str, float | None] | None,
    initial_state: Any,
    initial_covariance: Any,
    integration: str,
    substeps: int,
) -> CalibrationProblem:
    """Return the problem, or say what is wrong with what is asked."""
    substeps = whole_number(substeps, "substeps")
    if not log.samples > 1:
        raise bad_log("too-short", f"The log has {counted(log.samples, 'row')}: a calibration needs more.")
    if not isinstance(unknown, Mapping):
        raise SpecError("unknown must be a mapping from names to [low, high], such as {k: [0.5, 2]}.", path="unknown")
    unknown = {**unknown, **plant.bounds}
    names = tuple(unknown)
    for name in names:
        index_of(name, list(plant.values), what="unknown")
    values = _started(unknown, plant)
    low, high = _bounds(unknown, values)
    equations = tuple(plant.equation_names if noisy is None else noisy)
    for name in equations:
        index_of(name, plant.equation_names, what="noisy (the equations that Q names)")
    means, weights = _priors(priors, names, values)
    known_Q = _variances(Q, equations, "Q")
    known_R = _variances(R, log.output_names, "R")
    quanta = np.array([quantum(column) for column in log.y.T])
    _require_enough(log, len(names), int(np.isnan(known_Q).sum() + np.isnan(known_R).sum()))
    x0 = named_vector(initial_state, plant.state_names, plant.nominal_state, "initial_state")
    graphs = sample_graphs(plant, names, log.dt, integration=integration, substeps=substeps, samples=log.samples)
    return CalibrationProblem(
        plant=plant,
        log=log,
        u=plant.signals(log),
        unknown=names,
        nominal=np.array([values[name] for name in names]),
        low=low,
        high=high,
        prior_means=means,
        prior_weights=weights,
        noisy=equations,
        known_Q=known_Q,
        known_R=known_R,
        x0=x0,
        P0=_covariance(plant, initial_covariance),
        quanta=quanta,
        floors=_floors(log.y, quanta),
        graphs=graphs,
        integration=integration,
        substeps=substeps,
    )


def _floors(y: FloatArray, quanta: FloatArray) -> FloatArray:
    """Return the least variance of each sensor ``(ny,)``: of its quantisation, where values repeat, or of rounding."""
    held = np.array([repeats(column) for column in y.T])
    largest = np.nanmax(np.abs(y), axis=0)
    return np.maximum(np.where(held, quanta**2 / EVEN, 0.0), (LEAST_NOISE * np.where(largest > 0.0, largest, 1.0)) ** 2)


def _require_enough(log: RecordedLog, constants: int, variances: int) -> None:
    """Refuse a question without unknowns, or with more of them than the log can determine."""
    if not constants and not variances:
        raise SpecError(
            "unknown is empty, and Q and R are known: there is nothing to estimate. Name constants with their "
            "bounds, or leave variances out.",
            path="unknown",
        )
    needed, measured = VALUES_PER_UNKNOWN * (constants + variances), int(np.isfinite(log.y).sum())
    if measured < needed:
        raise bad_log(
            "too-short",
            f"The log is too short: {measured} measured values for {constants} constants and "
            f"{variances} variances; at least {needed} are needed. Take more rows, fewer unknowns, or state "
            "Q and R.",
        )


def _started(unknown: Mapping[str, Sequence[float]], plant: CalibrationPlant) -> dict[str, float]:
    """Return nominal values; the middle of its bounds for what has none within them and none that is stated."""
    values = dict(plant.values)
    for name in plant.unstated.intersection(unknown):
        pair = unknown[name]
        if _is_pair(pair) and not pair[0] <= values[name] <= pair[1]:
            values[name] = 0.5 * (float(pair[0]) + float(pair[1]))
    return values


def _is_pair(pair: Any) -> bool:
    """Whether a value is two finite numbers."""
    return np.shape(pair) == (2,) and all(is_number(entry) and np.isfinite(entry) for entry in pair)


def _bounds(unknown: Mapping[str, Sequence[float]], values: Mapping[str, float]) -> tuple[FloatArray, FloatArray]:
    rows = []
    for name, pair in unknown.items():
        if not _is_pair(pair) or not pair[0] < pair[1]:
            raise SpecError(
                f"unknown.{name} is {pair!r}: give [low, high], finite, the lower one first.", path=f"unknown.{name}"
            )
        if not pair[0] <= values[name] <= pair[1]:
            raise SpecError(
                f"The nominal value of {name!r}, {values[name]:g}, is outside its bounds [{pair[0]:g}, "
                f"{pair[1]:g}]: move one of them.",
                path=f"unknown.{name}",
            )
        rows.append([float(pair[0]), float(pair[1])])
    low, high = np.array(rows).reshape(len(rows), 2).T
    return low, high


def _priors(
    priors: Mapping[str, Sequence[float]] | None, names: Sequence[str], values: Mapping[str, float]
) -> tuple[FloatArray, FloatArray]:
    means, weights = np.array([values[name] for name in names]), np.zeros(len(names))
    for name, pair in (priors or {}).items():
        i = index_of(name, names, what="priors")
        if not _is_pair(pair) or not pair[1] > 0.0:
            raise SpecError(f"priors.{name} is {pair!r}: give [mean, standard deviation].", path=f"priors.{name}")
        means[i], weights[i] = float(pair[0]), float(pair[1]) ** -2
    return means, weights


def _variances(stated: Mapping[str, float | None] | None, names: Sequence[str], letter: str) -> FloatArray:
    """Return known variances, NaN for those that are to be found."""
    require_mapping(stated, letter)
    variances = np.full(len(names), np.nan)
    for name, value in (stated or {}).items():
        i = index_of(name, names, what=letter)
        if value is None:
            continue
        variances[i] = real_number(
            value, f"{letter}.{name}", "a positive variance, or leave it out to have it found", above=0.0
        )
    return variances


def _covariance(plant: CalibrationPlant, value: Any) -> FloatArray:
    default, nx = plant.state_deviations**2, len(plant.state_names)
    matrix = named_covariance(value, plant.state_names, "initial_covariance", default, others=default)
    require_shape(matrix.shape, (nx, nx), "initial_covariance")
    covariance_factor(matrix, "initial_covariance")
    return matrix


def require_variation(problem: CalibrationProblem) -> None:
    """Refuse a log in which nothing moves and nothing is put in: it determines no constant."""
    if not np.nanstd(problem.y, axis=0).any() and not np.std(problem.u, axis=0).any():
        raise refused(
            "not-exciting",
            "Every signal is constant in these rows: they hold no information on the dynamics.",
            signals=list(problem.unknown),
        )
