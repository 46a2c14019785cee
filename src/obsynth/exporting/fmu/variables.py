"""The variables of an observer as an FMU: what goes in, what comes out, operating points, thresholds and alarms."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from obsynth.errors import SpecError
from obsynth.exporting.realisation import Realisation
from obsynth.numerics.arguments import is_finite_number, require_mapping
from obsynth.results.design import ObserverDesign


@dataclass(frozen=True)
class Output:
    """One estimate: its name, the signal whose operating point it has, unit, and whether it is watched."""

    name: str
    signal: str | None
    unit: str
    description: str
    watched: bool = False


@dataclass(frozen=True)
class Signals:
    """Everything that an FMU shows, in the order of its values."""

    inputs: tuple[str, ...]
    input_signals: tuple[str, ...]
    outputs: tuple[Output, ...]
    points: Mapping[str, float]
    thresholds: Mapping[str, float]
    units: Mapping[str, str]
    warm_up: float
    dt: float

    def point_index(self, signal: str | None) -> int:
        """Return the position of a signal among the operating points, -1 for none."""
        return -1 if signal is None else list(self.points).index(signal)

    @property
    def watched(self) -> tuple[str, ...]:
        """Outputs that have a threshold."""
        return tuple(output.name for output in self.outputs if output.watched)


def signals_of_linear(found: Realisation, thresholds: Mapping[str, float] | None, warm_up: float) -> Signals:
    """Return the signals of a linear observer; fault estimates and residuals may be watched."""
    plant, observer = found.design.plant, found.observer
    biases = getattr(plant, "sensor_faults", ())
    units, stated = dict(plant.units), dict(getattr(plant, "operating_point", {}))
    outputs = [
        Output(f"xhat[{name}]", name, units.get(name, ""), _late(f"estimate of {name}", delay))
        for name, delay in zip(observer.state_names, observer.state_delays, strict=True)
    ]
    outputs += [
        Output(
            f"fhat[{name}]",
            None if name in biases else name,
            units.get(name, ""),
            _late(f"estimate of the fault {name}", delay),
            True,
        )
        for name, delay in zip(observer.fault_names, observer.fault_delays, strict=True)
    ]
    outputs += [
        Output(f"r[{name}]", None, units.get(name, ""), f"residual {name}", True) for name in observer.residual_names
    ]
    signals = (*found.inputs, *observer.state_names, *observer.fault_names)
    points = {name: float(stated.get(name, 0.0)) for name in dict.fromkeys(signals)}
    inputs = _apart(observer.input_names, observer.output_names)
    return Signals(inputs, found.inputs, tuple(outputs), points, _checked(thresholds, outputs), units, warm_up,
                   observer.dt)  # fmt: skip


def signals_of_dae(design: ObserverDesign, thresholds: Mapping[str, float] | None, warm_up: float) -> Signals:
    """Return the signals of the observer of a nonlinear plant; innovations and their square may be watched."""
    model, observer = design.nonlinear
    units = dict(model.units)

    def unit(name: str) -> str:
        return units.get(name, "")

    outputs = [Output(f"xhat[{name}]", None, unit(name), f"estimate of {name}") for name in model.state_names]
    outputs += [Output(f"sd xhat[{name}]", None, unit(name), f"standard deviation of the estimate of {name}")
                for name in model.state_names]  # fmt: skip
    outputs += [Output(f"theta[{name}]", None, unit(name), f"estimate of the parameter {name}")
                for name in model.parameter_names]  # fmt: skip
    outputs += [Output(f"sd theta[{name}]", None, unit(name), f"standard deviation of the estimate of {name}")
                for name in model.parameter_names]  # fmt: skip
    outputs += [Output(f"r[{name}]", None, unit(name), f"innovation of {name}", True) for name in model.output_names]
    outputs.append(Output("nis", None, "", "square of the innovations in units of their covariance", True))
    names = (*model.input_names, *model.output_names)
    return Signals(_apart(model.input_names, model.output_names), names, tuple(outputs), {},
                   _checked(thresholds, outputs), units, warm_up, observer.dt)  # fmt: skip


def _late(text: str, delay: int) -> str:
    return f"{text}, {delay} sample(s) late" if delay else text


def _apart(known: Sequence[str], measured: Sequence[str]) -> tuple[str, ...]:
    """Return names of the FMU's inputs: those of the signals, told apart where an input is called as an output."""
    both = set(known) & set(measured)
    return (*(f"u[{name}]" if name in both else name for name in known),
            *(f"y[{name}]" if name in both else name for name in measured))  # fmt: skip


def _checked(thresholds: Mapping[str, float] | None, outputs: Sequence[Output]) -> dict[str, float]:
    """Return the level of each watched output, 0 where there is none."""
    require_mapping(thresholds, "thresholds")
    watched = [output.name for output in outputs if output.watched]
    for name, level in (thresholds or {}).items():
        if name not in watched:
            raise SpecError(f"There is no {name!r} to watch: there are {', '.join(watched)}.", path="thresholds")
        if not is_finite_number(level) or level <= 0.0:
            raise SpecError(f"The threshold of {name!r} is {level!r}: give a positive number.", path="thresholds")
    return {name: float((thresholds or {}).get(name, 0.0)) for name in watched}


def finite_warm_up(seconds: float) -> float:
    """Return a number that a description may hold: an observer that never forgets its start raises no alarm."""
    return seconds if math.isfinite(seconds) else _NEVER


#: Seconds, about thirty years.
_NEVER = 1e9
