"""How far a linear model can be trusted: the nonlinear plant and its linear model along the inputs of a log."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.monitoring.calibration.logs import EVEN, LogData, RecordedLog, quantum, read_log
from obsynth.numerics.arguments import arguments_checked
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.observers.records import named_vector
from obsynth.plants.dae import DAEModel
from obsynth.plants.dae_functions import BUTCHER
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.transformations.linearisation import DRIFT
from obsynth.report.plots.panels import (
    BAND_STYLE,
    ESTIMATE_STYLE,
    RESIDUAL_STYLE,
    TRUE_STYLE,
    WIDTH,
    label_time,
    legend_above,
    new_figure,
    tidy,
)
from obsynth.simulation.dae import simulate_dae

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class Validity:
    """The outputs of a nonlinear plant and of its linear model along the same inputs.

    Parameters
    ----------
    largest : float
        Largest difference of any sensor, in its standard deviations: the number to look at.
    by_sensor, rms : mapping of str to float
        Largest and root mean square difference of each, in the same unit.
    excursion : mapping of str to float
        Largest distance of each output from the operating point, in its unit.
    nonlinear, linear : FloatArray
        ``(n, ny)``, in units of the outputs.
    deviations : mapping of str to float
        The standard deviations that were used.
    time : FloatArray
        ``(n,)`` seconds.

    Examples
    --------
    >>> import obsynth
    >>> import numpy as np
    >>> tank = obsynth.DAEModel(
    ...     {"balance": "der(level) = inflow - c * sqrt(level)"},
    ...     {"gauge": "level"},
    ...     states={"level": 1.0},
    ...     inputs={"inflow": 0.5},
    ...     parameters={"c": 0.5},
    ...     units={"level": "m", "inflow": "m/s", "c": "m0.5/s", "gauge": "m"},
    ... )
    >>> linear = obsynth.linearise(tank, given={"inflow": 0.5})
    >>> log = {"time": np.arange(20), "inflow": 0.5 + 0.1 * (np.arange(20) > 5), "gauge": np.ones(20)}
    >>> region = obsynth.validity(tank, linear, log, deviations={"gauge": 0.01})
    >>> round(region.largest, 2), round(region.excursion["gauge"], 3)
    (3.0, 0.418)
    """

    largest: float
    by_sensor: Mapping[str, float]
    rms: Mapping[str, float]
    excursion: Mapping[str, float]
    nonlinear: FloatArray
    linear: FloatArray
    deviations: Mapping[str, float]
    time: FloatArray

    def __repr__(self) -> str:
        listed = ", ".join(f"{name} {value:.3g}" for name, value in self.by_sensor.items())
        return f"Nonlinear against linear: at most {self.largest:.3g} deviations of a sensor ({listed})."

    def to_dict(self) -> dict[str, Any]:
        """Return everything but the records as plain data."""
        return {
            "largest": self.largest,
            "by_sensor": dict(self.by_sensor),
            "rms": dict(self.rms),
            "excursion": dict(self.excursion),
            "deviations": dict(self.deviations),
        }

    def plot(self) -> Figure:
        """Return a picture: both outputs, and their difference in deviations, by sensor."""
        names = list(self.by_sensor)
        figure, panels = new_figure(2 * len(names), size=(WIDTH, 0.6 + 3.0 * len(names)))
        for i, name in enumerate(names):
            signals, apart = panels[2 * i : 2 * i + 2]
            signals.plot(self.time, self.nonlinear[:, i], label="nonlinear", **TRUE_STYLE)
            signals.plot(self.time, self.linear[:, i], label="linear", **ESTIMATE_STYLE)
            signals.set_ylabel(name)
            legend_above(signals)
            apart.axhspan(-1.0, 1.0, **BAND_STYLE)
            apart.plot(self.time, (self.linear - self.nonlinear)[:, i] / self.deviations[name], **RESIDUAL_STYLE)
            apart.set_ylabel(f"difference of\n{name} (deviations)")
        for panel in panels:
            tidy(panel)
        label_time(panels[-1])
        return figure


@arguments_checked
def validity(
    model: DAEModel,
    linear: DescriptorSystem,
    log: LogData,
    *,
    rows: str | slice | Sequence[int] | None = None,
    columns: Mapping[str, str] | None = None,
    scales: Mapping[str, float] | None = None,
    dt: float | None = None,
    initial_state: ArrayLike | Mapping[str, float] | None = None,
    deviations: Mapping[str, float] | None = None,
) -> Validity:
    """Compare a nonlinear plant with its linear model along the inputs of a log, both by Radau.

    Parameters
    ----------
    model : DAEModel
        The plant, at its nominal parameters unless the linear model's operating point holds others.
    linear : DescriptorSystem
        From `obsynth.linearise`: ``nx`` states.
    log : path, pandas.DataFrame or mapping
        CSV or Parquet file, or columns by name: ``time`` in seconds, inputs and outputs.
    rows : str, slice or pair, optional
        ``"a:b"``, as Python counts; all by default.
    columns : mapping of str to str, optional
        Column of a signal, or of ``time``, where the names differ.
    scales : mapping of str to float, optional
        What a column is multiplied by to be in the signal's unit.
    dt : float, optional
        Seconds between rows; the median of the stamps by default.
    initial_state : array_like or mapping, optional
        ``(nx,)`` or values by name; the operating point by default.
    deviations : mapping of str to float, optional
        Standard deviation of each sensor; by default what the log's outputs show from row to row.

    Returns
    -------
    Validity
        Differences in deviations of the sensors, and both records.

    Raises
    ------
    SpecError
        The linear model is of another plant, or the log cannot be used.
    SolverError
        The plant has no solution along the log's inputs.

    Examples
    --------
    >>> import numpy as np
    >>> import obsynth
    >>> tank = obsynth.DAEModel(
    ...     {"balance": "der(level) = inflow - c * sqrt(level)"},
    ...     {"gauge": "level"},
    ...     states={"level": 1.0},
    ...     inputs={"inflow": 0.5},
    ...     parameters={"c": 0.5},
    ...     units={"level": "m", "inflow": "m/s", "c": "m0.5/s", "gauge": "m"},
    ... )
    >>> linear = obsynth.linearise(tank, given={"inflow": 0.5})
    >>> log = {"time": np.arange(20), "inflow": 0.5 + 0.1 * (np.arange(20) > 5), "gauge": np.ones(20)}
    >>> region = obsynth.validity(tank, linear, log, deviations={"gauge": 0.01})
    >>> round(region.largest, 2)  # in deviations of the sensors
    3.0
    """
    names = {*linear.input_names, *linear.disturbance_names} - {DRIFT}
    if names != set(model.input_names) or linear.output_names != model.output_names or linear.is_discrete:
        raise SpecError(
            "The linear model is of another plant, or sampled: give what obsynth.linearise returns.", path="linear"
        )
    record = read_log(
        log, model.input_names, model.output_names, rows=rows, columns=columns, scales=scales, dt=dt, units=model.units
    )
    point = linear.operating_point
    center = np.array([point[name] for name in linear.state_names])
    start = (
        center
        if initial_state is None
        else named_vector(initial_state, model.state_names, np.array(model.nominal_state), "initial_state")
    )
    theta = [point.get(name, value) for name, value in model.parameters.items()]
    true = simulate_dae(model, record.u, dt=record.dt, parameters=theta, initial_state=start).outputs
    approximate = _linear_outputs(linear, record, start - center) + np.array(
        [point[name] for name in linear.output_names]
    )
    spread = {name: _deviation(record.y[:, i], name, deviations) for i, name in enumerate(model.output_names)}
    differences = np.abs(true - approximate) / np.array(list(spread.values()))
    y0 = np.array([point[name] for name in linear.output_names])
    by_name = dict(zip(model.output_names, differences.max(axis=0).tolist(), strict=True))
    return Validity(
        max(by_name.values()),
        by_name,
        dict(zip(model.output_names, np.sqrt((differences**2).mean(axis=0)).tolist(), strict=True)),
        dict(zip(model.output_names, np.abs(true - y0).max(axis=0).tolist(), strict=True)),
        read_only(true),
        read_only(approximate),
        spread,
        record.time,
    )


def _deviation(column: FloatArray, name: str, stated: Mapping[str, float] | None) -> float:
    """Return a sensor's standard deviation, as given, or from the roughness of its record and its resolution."""
    if stated is not None and name in stated:
        if not stated[name] > 0.0:
            raise SpecError(
                f"deviations.{name} is {stated[name]!r}: give a positive number.", path=f"deviations.{name}"
            )
        return float(stated[name])
    rough = float(np.nanstd(np.diff(column, n=2)) / np.sqrt(6.0))
    deviation = max(rough, quantum(column) / math.sqrt(EVEN))
    if not deviation > 0.0:
        raise SpecError(
            f"The record of {name!r} shows no noise: state its deviation by deviations.", path=f"deviations.{name}"
        )
    return deviation


def _linear_outputs(linear: DescriptorSystem, log: RecordedLog, start: FloatArray) -> FloatArray:
    """Return outputs ``(n, ny)`` in deviations from the operating point, by the Radau method of the nonlinear plant."""
    E, A, a, n = linear.E, linear.A, BUTCHER["radau"], linear.nx
    inputs = dict(zip(log.input_names, log.u.T, strict=True)) | {DRIFT: np.ones(log.samples)}
    point = linear.operating_point
    forced = np.zeros((log.samples, n))
    for names, matrix in ((linear.input_names, linear.B), (linear.disturbance_names, linear.Bd)):
        for name, column in zip(names, matrix.T, strict=True):
            forced += np.outer(inputs[name] - point[name], column)
    stages = len(a)
    step_matrix = np.kron(np.eye(stages), E) - log.dt * np.kron(a, A)
    ending = np.kron(a, np.eye(n))[-n:]
    z, outputs = start, [linear.C @ start]
    for k in range(1, log.samples):
        slopes = np.linalg.solve(step_matrix, np.tile(A @ z + forced[k], stages))
        z = z + log.dt * (ending @ slopes)
        outputs.append(linear.C @ z)
    return np.array(outputs)
