"""The variables of an observer's FMU: inputs, estimates, operating points and alarms, each with name and unit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from obsynth.errors import counted
from obsynth.exporting.alarms import Alarms
from obsynth.exporting.realisation import Realisation
from obsynth.observers.scheduled.observer import ScheduledObserver
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.results.design import ObserverDesign

#: Name of the output that says what a row of a scheduled observer was.
STATUS = "status"


@dataclass(frozen=True)
class Output:
    """One output: its name, the signal whose operating point is added to it, its unit and description."""

    name: str
    signal: str | None
    unit: str
    description: str


@dataclass(frozen=True)
class FmuSignals:
    """Inputs, outputs, operating points and alarms of an FMU, in the order of its values.

    ``parameters``: start values of inputs that are scheduling parameters, which have no operating point.
    """

    inputs: tuple[str, ...]
    input_signals: tuple[str, ...]
    outputs: tuple[Output, ...]
    points: Mapping[str, float]
    alarms: Alarms
    units: Mapping[str, str]
    dt: float
    parameters: Mapping[str, float] = field(default_factory=dict)

    def point_index(self, signal: str | None) -> int:
        """Return the position of a signal among the operating points, -1 for none."""
        return -1 if signal is None else list(self.points).index(signal)


def signals_of_linear(realisation: Realisation, alarms: Alarms) -> FmuSignals:
    """Return the signals of a linear observer; fault estimates and residuals may be watched."""
    plant, observer = realisation.design.plant, realisation.observer
    outputs, units = _estimates(plant, observer)
    outputs += _monitor_outputs(alarms)
    points = _points(plant, (*realisation.inputs, *observer.state_names, *observer.fault_names))
    inputs = _distinct(observer.input_names, observer.output_names)
    return FmuSignals(inputs, realisation.inputs, tuple(outputs), points, alarms, units, observer.dt)


def signals_of_scheduled(
    plant: PolytopicSystem, observer: ScheduledObserver, alarms: Alarms, seconds: float
) -> FmuSignals:
    """Return the signals of a scheduled observer: its parameters are inputs, and the status of a row is an output;
    ``seconds`` are between rows."""
    held, known = observer.scheduling, observer.input_names[: observer.inputs]
    known = tuple(name for name in known if name != plant.shift)
    read = observer.input_names[observer.inputs :]
    outputs, units = _estimates(plant, observer)
    listed = "0: claimed, 1: warm-up, 2: a sample is missing, 3: recovering from one"
    outputs.append(Output(STATUS, None, "", f"{listed}, 4: a parameter is outside the region, or was until recently"))
    outputs += _monitor_outputs(alarms)
    points = _points(plant, (*known, *observer.output_names, *observer.state_names, *observer.fault_names))
    inputs = _distinct((*known, *read), observer.output_names)
    named = inputs[len(known) : len(known) + len(read)]
    return FmuSignals(
        inputs,
        (*known, *held.names, *observer.output_names),
        tuple(outputs),
        points,
        alarms,
        {**held.units, **units},
        seconds,
        dict(zip(named, observer.middle.tolist(), strict=True)),
    )


def _points(plant: Any, signals: Sequence[str]) -> dict[str, float]:
    operating_point = dict(getattr(plant, "operating_point", {}))
    return {name: float(operating_point.get(name, 0.0)) for name in dict.fromkeys(signals)}


def _estimates(plant: Any, observer: Any) -> tuple[list[Output], dict[str, str]]:
    """Return the outputs of an observer, and the units of signals."""
    biases, units = getattr(plant, "sensor_faults", ()), dict(plant.units)
    outputs = [
        Output(f"xhat[{name}]", name, units.get(name, ""), _delayed(f"estimate of {name}", delay))
        for name, delay in zip(observer.state_names, observer.state_delays, strict=True)
    ]
    outputs += [
        Output(
            f"fhat[{name}]",
            None if name in biases else name,
            units.get(name, ""),
            _delayed(f"estimate of the fault {name}", delay),
        )
        for name, delay in zip(observer.fault_names, observer.fault_delays, strict=True)
    ]
    outputs += [Output(f"r[{name}]", None, units.get(name, ""), f"residual {name}") for name in observer.residual_names]
    return outputs, units


def _monitor_outputs(alarms: Alarms) -> list[Output]:
    """Return the outputs of a monitor, if there is one."""
    variables = () if alarms.monitor is None else alarms.monitor.variables
    return [Output(variable.name, None, "", variable.description) for variable in variables]


def signals_of_dae(design: ObserverDesign, alarms: Alarms) -> FmuSignals:
    """Return the signals of the observer of a nonlinear plant; parameters, innovations and their square may be
    watched."""
    model, observer = design.nonlinear
    units = dict(model.units)
    estimated = (("xhat", "", model.state_names), ("fhat", "the parameter ", model.parameter_names))
    outputs = []
    for kind, of, names in estimated:
        outputs += [Output(f"{kind}[{name}]", None, units.get(name, ""), f"estimate of {of}{name}") for name in names]
        outputs += [
            Output(f"sd {kind}[{name}]", None, units.get(name, ""), f"standard deviation of the estimate of {name}")
            for name in names
        ]
    outputs += [Output(f"r[{name}]", None, units.get(name, ""), f"innovation of {name}") for name in model.output_names]
    outputs.append(Output("nis", None, "", "square of the innovations in units of their covariance"))
    outputs += _monitor_outputs(alarms)
    return FmuSignals(
        _distinct(model.input_names, model.output_names),
        (*model.input_names, *model.output_names),
        tuple(outputs),
        {},
        alarms,
        units,
        observer.dt,
    )


def _delayed(text: str, delay: int) -> str:
    """Return a description, with the delay of the estimate where it has one."""
    return f"{text}, delayed by {counted(delay, 'sample')}" if delay else text


def _distinct(known: Sequence[str], measured: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the FMU's inputs: inputs and outputs, as u[.] and y[.] where they share a name."""
    both = set(known) & set(measured)
    return (
        *(f"u[{name}]" if name in both else name for name in known),
        *(f"y[{name}]" if name in both else name for name in measured),
    )
