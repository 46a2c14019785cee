"""The model description of an FMU, in XML, for FMI 2.0 and 3.0."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from obsynth.exporting.fmu.variables import Signals


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
    for name, value in signals.points.items():
        yield _Variable(f"operating_point[{name}]", "real", "parameter", "tunable", "exact", value,
                        signals.units.get(name, ""), f"{name} where the linear model was taken")  # fmt: skip
    units = {output.name: output.unit for output in signals.outputs}
    for name, level in signals.thresholds.items():
        yield _Variable(f"threshold[{name}]", "real", "parameter", "tunable", "exact", level, units[name],
                        f"alarm above this absolute value of {name} (its deviation); 0: none")  # fmt: skip
    yield _Variable("warm_up", "real", "parameter", "tunable", "exact", signals.warm_up, "s",
                    "no alarm in these seconds after the start")  # fmt: skip
    for name in signals.thresholds:
        yield _Variable(f"alarm[{name}]", "flag", "output", "discrete", "calculated", None, "",
                        f"{name} is above its threshold")  # fmt: skip
    yield _Variable("alarm", "flag", "output", "discrete", "calculated", None, "", "any alarm")
    yield _Variable("sample_used", "flag", "output", "discrete", "calculated", None, "",
                    "the last sample was finite and used; else the estimates are held")  # fmt: skip


def start_values(signals: Signals) -> list[float]:
    """Return the start value of each real variable, by value reference."""
    return [variable.start or 0.0 for variable in _variables(signals) if variable.kind == "real"]


def fmi2_description(model: Model, sources: list[str]) -> bytes:
    """Return ``modelDescription.xml`` of FMI 2.0."""
    root = Element("fmiModelDescription", {
        "fmiVersion": "2.0", "modelName": model.name, "guid": model.token, "description": model.description,
        "generationTool": "obsynth", "variableNamingConvention": "flat",
    })  # fmt: skip
    simulation = SubElement(root, "CoSimulation", {
        "modelIdentifier": model.identifier, "canHandleVariableCommunicationStepSize": "false",
        "canNotUseMemoryManagementFunctions": "true", "canGetAndSetFMUstate": "true", "canSerializeFMUstate": "true",
    })  # fmt: skip
    files = SubElement(simulation, "SourceFiles")
    for name in sources:
        SubElement(files, "File", {"name": name})
    variables = list(_variables(model.signals))
    _units(root, variables)
    SubElement(root, "DefaultExperiment", {"startTime": "0", "stepSize": repr(model.signals.dt)})
    listed = SubElement(root, "ModelVariables")
    for reference, variable in enumerate(variables):
        element = SubElement(listed, "ScalarVariable", {
            "name": variable.name, "valueReference": str(reference), "causality": variable.causality,
            "variability": variable.variability, "description": variable.description,
            **({"initial": variable.initial} if variable.initial else {}),
        })  # fmt: skip
        SubElement(element, "Real" if variable.kind == "real" else "Boolean", _value(variable))
    structure = SubElement(root, "ModelStructure")
    outputs = [number for number, variable in enumerate(variables, 1) if variable.causality == "output"]
    for part in ("Outputs", "InitialUnknowns"):
        unknowns = SubElement(structure, part)
        for number in outputs:
            SubElement(unknowns, "Unknown", {"index": str(number)})
    return _text(root)


def fmi3_description(model: Model) -> bytes:
    """Return ``modelDescription.xml`` of FMI 3.0."""
    root = Element("fmiModelDescription", {
        "fmiVersion": "3.0", "modelName": model.name, "instantiationToken": model.token,
        "description": model.description, "generationTool": "obsynth", "variableNamingConvention": "flat",
    })  # fmt: skip
    SubElement(root, "CoSimulation", {
        "modelIdentifier": model.identifier, "canHandleVariableCommunicationStepSize": "false",
        "fixedInternalStepSize": repr(model.signals.dt), "canGetAndSetFMUState": "true",
        "canSerializeFMUState": "true",
    })  # fmt: skip
    variables = list(_variables(model.signals))
    _units(root, variables)
    SubElement(root, "DefaultExperiment", {"startTime": "0", "stepSize": repr(model.signals.dt)})
    listed = SubElement(root, "ModelVariables")
    for reference, variable in enumerate(variables):
        SubElement(listed, "Float64" if variable.kind == "real" else "Boolean", {
            "name": variable.name, "valueReference": str(reference), "causality": variable.causality,
            "variability": variable.variability, "description": variable.description,
            **({"initial": variable.initial} if variable.initial else {}), **_value(variable),
        })  # fmt: skip
    structure = SubElement(root, "ModelStructure")
    outputs = [reference for reference, variable in enumerate(variables) if variable.causality == "output"]
    for part in ("Output", "InitialUnknown"):
        for reference in outputs:
            SubElement(structure, part, {"valueReference": str(reference)})
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
