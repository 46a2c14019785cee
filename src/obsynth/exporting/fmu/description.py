"""The model description of an FMU, in XML, for FMI 2.0 and 3.0: inputs, estimates, points, thresholds and alarms."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

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
        Output(f"fhat[{name}]", None if name in biases else name, units.get(name, ""),
               _late(f"estimate of the fault {name}", delay), watched=True)
        for name, delay in zip(observer.fault_names, observer.fault_delays, strict=True)
    ]  # fmt: skip
    outputs += [Output(f"r[{name}]", None, units.get(name, ""), f"residual {name}", watched=True)
                for name in observer.residual_names]  # fmt: skip
    signals = (*found.inputs, *observer.state_names, *observer.fault_names)
    points = {name: float(stated.get(name, 0.0)) for name in dict.fromkeys(signals)}
    inputs = _apart(observer.input_names, observer.output_names)
    return Signals(inputs, found.inputs, tuple(outputs), points, _checked(thresholds, outputs), units, warm_up,
                   observer.dt)  # fmt: skip


def signals_of_dae(design: ObserverDesign, thresholds: Mapping[str, float] | None, warm_up: float) -> Signals:
    """Return the signals of the observer of a nonlinear plant; innovations and their square may be watched."""
    model, observer = design.nonlinear
    units = dict(model.units)
    estimated = (("xhat", "", model.state_names), ("theta", "the parameter ", model.parameter_names))
    outputs = []
    for kind, of, names in estimated:
        outputs += [Output(f"{kind}[{name}]", None, units.get(name, ""), f"estimate of {of}{name}") for name in names]
        outputs += [Output(f"sd {kind}[{name}]", None, units.get(name, ""),
                           f"standard deviation of the estimate of {name}") for name in names]  # fmt: skip
    outputs += [Output(f"r[{name}]", None, units.get(name, ""), f"innovation of {name}", watched=True)
                for name in model.output_names]  # fmt: skip
    outputs.append(Output("nis", None, "", "square of the innovations in units of their covariance", watched=True))
    return Signals(_apart(model.input_names, model.output_names), (*model.input_names, *model.output_names),
                   tuple(outputs), {}, _checked(thresholds, outputs), units, warm_up, observer.dt)  # fmt: skip


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
    """Return a number that a description may hold: an observer that never settles raises no alarm."""
    return seconds if math.isfinite(seconds) else _NEVER


#: Seconds, about thirty years.
_NEVER = 1e9


@dataclass(frozen=True)
class Model:
    """What a description is about: identifier, token, name, a sentence, and the signals."""

    identifier: str
    token: str
    name: str
    description: str
    signals: Signals


@dataclass(frozen=True)
class _Variable:
    name: str
    kind: str
    causality: str
    variability: str
    initial: str | None
    start: float | None
    unit: str
    description: str


def _variables(signals: Signals) -> Iterator[_Variable]:
    """Yield the variables in the order of their value references, which are 0, 1, 2, ..."""
    yield _Variable("time", "real", "independent", "continuous", None, None, "s", "time")
    for name, signal in zip(signals.inputs, signals.input_signals, strict=True):
        start, unit = signals.points.get(signal, 0.0), signals.units.get(signal, "")
        yield _Variable(name, "real", "input", "discrete", None, start, unit, f"signal {signal}")
    for output in signals.outputs:
        yield _Variable(output.name, "real", "output", "discrete", "calculated", None, output.unit, output.description)
    units = {output.name: output.unit for output in signals.outputs}
    parameters = [(f"operating_point[{name}]", value, signals.units.get(name, ""),
                   f"{name} where the linear model was taken") for name, value in signals.points.items()]  # fmt: skip
    parameters += [(f"threshold[{name}]", level, units[name],
                    f"alarm above this absolute value of {name} (its deviation); 0: none")
                   for name, level in signals.thresholds.items()]  # fmt: skip
    parameters.append(("warm_up", signals.warm_up, "s", "no alarm in these seconds after the start"))
    for name, value, unit, told in parameters:
        yield _Variable(name, "real", "parameter", "tunable", "exact", value, unit, told)
    flags = [(f"alarm[{name}]", f"{name} is above its threshold") for name in signals.thresholds]
    flags.append(("alarm", "any alarm"))
    flags.append(("sample_used", "the last sample was finite and used; else the estimates are held"))
    for name, told in flags:
        yield _Variable(name, "flag", "output", "discrete", "calculated", None, "", told)


def start_values(signals: Signals) -> list[float]:
    """Return the start value of each real variable, by value reference."""
    return [variable.start or 0.0 for variable in _variables(signals) if variable.kind == "real"]


class _Version(NamedTuple):
    """How a version of FMI spells what both have: elements, attributes and the first reference."""

    token: str
    real: str
    outputs: tuple[str, str]
    abilities: dict[str, str]


_STEPS = {"canHandleVariableCommunicationStepSize": "false"}
_VERSIONS = {
    "2.0": _Version("guid", "Real", ("Outputs", "InitialUnknowns"), {
        **_STEPS, "canNotUseMemoryManagementFunctions": "true", "canGetAndSetFMUstate": "true",
        "canSerializeFMUstate": "true",
    }),
    "3.0": _Version("instantiationToken", "Float64", ("Output", "InitialUnknown"), {
        **_STEPS, "fixedInternalStepSize": "", "canGetAndSetFMUState": "true", "canSerializeFMUState": "true",
    }),
}  # fmt: skip


def model_description(model: Model, version: str, sources: list[str]) -> bytes:
    """Return ``modelDescription.xml`` of a version of FMI."""
    spelled, step = _VERSIONS[version], repr(model.signals.dt)
    root = Element("fmiModelDescription", {
        "fmiVersion": version, "modelName": model.name, spelled.token: model.token, "description": model.description,
        "generationTool": "obsynth", "variableNamingConvention": "flat",
    })  # fmt: skip
    abilities = {name: value or step for name, value in spelled.abilities.items()}
    simulation = SubElement(root, "CoSimulation", {"modelIdentifier": model.identifier, **abilities})
    if version == "2.0":
        files = SubElement(simulation, "SourceFiles")
        for name in sources:
            SubElement(files, "File", {"name": name})
    variables = list(_variables(model.signals))
    _units(root, variables)
    SubElement(root, "DefaultExperiment", {"startTime": "0", "stepSize": step})
    listed = SubElement(root, "ModelVariables")
    for reference, variable in enumerate(variables):
        kind = spelled.real if variable.kind == "real" else "Boolean"
        attributes = {
            "name": variable.name, "valueReference": str(reference), "causality": variable.causality,
            "variability": variable.variability, "description": variable.description,
            **({"initial": variable.initial} if variable.initial else {}),
        }  # fmt: skip
        if version == "2.0":
            SubElement(SubElement(listed, "ScalarVariable", attributes), kind, _value(variable))
        else:
            SubElement(listed, kind, {**attributes, **_value(variable)})
    structure = SubElement(root, "ModelStructure")
    outputs = [reference for reference, variable in enumerate(variables) if variable.causality == "output"]
    for part in spelled.outputs:
        # FMI 2 counts variables from one, and lists them inside an element.
        unknowns = SubElement(structure, part) if version == "2.0" else structure
        for reference in outputs:
            if version == "2.0":
                SubElement(unknowns, "Unknown", {"index": str(reference + 1)})
            else:
                SubElement(unknowns, part, {"valueReference": str(reference)})
    return _text(root)


def build_description(model: Model, sources: list[str]) -> bytes:
    """Return ``sources/buildDescription.xml`` of FMI 3.0."""
    root = Element("fmiBuildDescription", {"fmiVersion": "3.0"})
    build = SubElement(root, "BuildConfiguration", {"modelIdentifier": model.identifier})
    files = SubElement(build, "SourceFileSet", {"language": "C99"})
    for name in sources:
        SubElement(files, "SourceFile", {"name": name})
    return _text(root)


def _units(root: Element, variables: list[_Variable]) -> None:
    names = list(dict.fromkeys(variable.unit for variable in variables if variable.unit))
    if names:
        units = SubElement(root, "UnitDefinitions")
        for name in names:
            SubElement(units, "Unit", {"name": name})


def _value(variable: _Variable) -> dict[str, str]:
    given = {} if variable.start is None else {"start": repr(float(variable.start))}
    return {**given, **({"unit": variable.unit} if variable.unit else {})}


def _text(root: Element) -> bytes:
    ElementTree.indent(root)
    return bytes(ElementTree.tostring(root, encoding="UTF-8", xml_declaration=True)) + b"\n"
