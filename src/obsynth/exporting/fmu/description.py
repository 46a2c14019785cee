"""The XML files of an FMU: ``modelDescription.xml`` of FMI 2.0 and 3.0, and ``buildDescription.xml`` of 3.0."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from obsynth.exporting.fmu.signals import FmuSignals

_STEP_CAPABILITY = {"canHandleVariableCommunicationStepSize": "false"}

#: How a version of FMI spells what both have: the token, a number, what lists the outputs, and what the FMU can do.
_VERSIONS = {
    "2.0": (
        "guid",
        "Real",
        ("Outputs", "InitialUnknowns"),
        {
            **_STEP_CAPABILITY,
            "canNotUseMemoryManagementFunctions": "true",
            "canGetAndSetFMUstate": "true",
            "canSerializeFMUstate": "true",
        },
    ),
    "3.0": (
        "instantiationToken",
        "Float64",
        ("Output", "InitialUnknown"),
        {
            **_STEP_CAPABILITY,
            "fixedInternalStepSize": "",
            "canGetAndSetFMUState": "true",
            "canSerializeFMUState": "true",
        },
    ),
}


@dataclass(frozen=True)
class FmuVariable:
    """A variable in XML: a number or a flag, what every kind of variable has, and its start and unit if it has any."""

    is_number: bool
    attributes: dict[str, str]
    start_and_unit: dict[str, str]


def model_description(
    signals: FmuSignals, version: str, sources: list[str], *, identifier: str, token: str, name: str, sentence: str
) -> bytes:
    """Return ``modelDescription.xml`` of a version of FMI; ``sentence`` says what the model is."""
    (token_name, number, lists, abilities), step = _VERSIONS[version], repr(signals.dt)
    root = Element(
        "fmiModelDescription",
        {
            "fmiVersion": version,
            "modelName": name,
            token_name: token,
            "description": sentence,
            "generationTool": "obsynth",
            "variableNamingConvention": "flat",
        },
    )
    able = {ability: value or step for ability, value in abilities.items()}
    simulation = SubElement(root, "CoSimulation", {"modelIdentifier": identifier, **able})
    if version == "2.0":
        files = SubElement(simulation, "SourceFiles")
        for source in sources:
            SubElement(files, "File", {"name": source})
    variables = list(fmu_variables(signals))
    units = dict.fromkeys(
        variable.start_and_unit["unit"] for variable in variables if "unit" in variable.start_and_unit
    )
    definitions = SubElement(root, "UnitDefinitions") if units else root
    for unit in units:
        SubElement(definitions, "Unit", {"name": unit})
    SubElement(root, "DefaultExperiment", {"startTime": "0", "stepSize": step})
    _add_variables(root, variables, version, number)
    _add_structure(root, variables, version, lists)
    return _text(root)


def build_description(identifier: str, sources: list[str]) -> bytes:
    """Return ``sources/buildDescription.xml`` of FMI 3.0."""
    root = Element("fmiBuildDescription", {"fmiVersion": "3.0"})
    build = SubElement(root, "BuildConfiguration", {"modelIdentifier": identifier})
    files = SubElement(build, "SourceFileSet", {"language": "C99"})
    for name in sources:
        SubElement(files, "SourceFile", {"name": name})
    return _text(root)


def fmu_variables(signals: FmuSignals) -> Iterator[FmuVariable]:
    """Yield the variables in the order of their value references, which are 0, 1, 2, ..."""
    yield _variable("time", "independent", "continuous", "time", unit="s")
    for name, signal in zip(signals.inputs, signals.input_signals, strict=True):
        start = signals.parameters.get(name, signals.points.get(signal, 0.0))
        kind = "scheduling parameter" if name in signals.parameters else "signal"
        unit = signals.units.get(signal, "")
        yield _variable(name, "input", "discrete", f"{kind} {signal}", start=start, unit=unit)
    for output in signals.outputs:
        yield _variable(output.name, "output", "discrete", output.description, initial="calculated", unit=output.unit)
    units = {output.name: output.unit for output in signals.outputs}
    parameters = [
        (f"operating_point[{name}]", value, signals.units.get(name, ""), f"{name} where the linear model was taken")
        for name, value in signals.points.items()
    ]
    parameters += [
        (
            f"threshold[{name}]",
            level,
            units[name],
            f"alarm above this absolute value of {name} (its deviation); 0: none",
        )
        for name, level in signals.alarms.levels.items()
    ]
    parameters.append(("warm_up", signals.alarms.warm_up, "s", "no alarm in these seconds after the start"))
    for name, value, unit, description in parameters:
        yield _variable(name, "parameter", "tunable", description, initial="exact", start=value, unit=unit)
    flags = [(f"alarm[{name}]", f"{name} is above its threshold") for name in signals.alarms.levels]
    flags.append(("alarm", "any alarm"))
    flags.append(("sample_used", "the last sample was used; otherwise the estimates are those of the model alone"))
    for name, description in flags:
        yield _variable(name, "output", "discrete", description, initial="calculated", is_number=False)


def _add_variables(root: Element, variables: list[FmuVariable], version: str, number: str) -> None:
    """Add ``ModelVariables``; ``number`` is the version's name of a real number."""
    listed = SubElement(root, "ModelVariables")
    for reference, variable in enumerate(variables):
        kind = number if variable.is_number else "Boolean"
        attributes = {"name": variable.attributes["name"], "valueReference": str(reference), **variable.attributes}
        if version == "2.0":
            SubElement(SubElement(listed, "ScalarVariable", attributes), kind, variable.start_and_unit)
        else:
            SubElement(listed, kind, attributes | variable.start_and_unit)


def _add_structure(root: Element, variables: list[FmuVariable], version: str, lists: tuple[str, ...]) -> None:
    """Add ``ModelStructure``: the outputs, in each of the version's ``lists``."""
    structure = SubElement(root, "ModelStructure")
    outputs = [i for i, variable in enumerate(variables) if variable.attributes["causality"] == "output"]
    for part in lists:
        # FMI 2 counts variables from one, and lists them inside an element.
        unknowns = SubElement(structure, part) if version == "2.0" else structure
        for reference in outputs:
            if version == "2.0":
                SubElement(unknowns, "Unknown", {"index": str(reference + 1)})
            else:
                SubElement(unknowns, part, {"valueReference": str(reference)})


def _variable(
    name: str,
    causality: str,
    variability: str,
    description: str,
    *,
    initial: str = "",
    start: float | None = None,
    unit: str = "",
    is_number: bool = True,
) -> FmuVariable:
    attributes = {"name": name, "causality": causality, "variability": variability, "description": description}
    start_and_unit = {} if start is None else {"start": repr(float(start))}
    return FmuVariable(
        is_number,
        attributes | ({"initial": initial} if initial else {}),
        start_and_unit | ({"unit": unit} if unit else {}),
    )


def _text(root: Element) -> bytes:
    ElementTree.indent(root)
    return bytes(ElementTree.tostring(root, encoding="UTF-8", xml_declaration=True)) + b"\n"
