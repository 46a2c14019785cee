"""An FMU of an observer, for FMI 2.0 and 3.0: its model description in XML, its C, and a binary where a compiler is."""

from __future__ import annotations

import io
import platform
import sys
import uuid
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TypeAlias
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from obsynth.errors import SpecError
from obsynth.exporting.alarms import Alarms, ExportedMonitor, linear_alarms
from obsynth.exporting.c_source import c_identifier, comment, header_text, integer_table, source_text
from obsynth.exporting.dae_c_source import dae_alarms, dae_c_texts, require_no_sample_time
from obsynth.exporting.dae_float import in_precision
from obsynth.exporting.realisation import Realisation, verification_words
from obsynth.files.outputs import working_folder, write_atomically
from obsynth.observers.nonlinear.c_code import FLAGS, compiler, shared_library
from obsynth.observers.nonlinear.observer import DAEObserver
from obsynth.results.design import ObserverDesign, unverified_mark

#: Whether a variable is a number (or a flag), its attributes in XML, and its start and unit where it has any.
_Variable: TypeAlias = tuple[bool, dict[str, str], dict[str, str]]


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


#: Of every name in the C of the observer inside an FMU.
_PREFIX = "observer"

#: Archives of equal content are equal: the first day that a zip file can hold.
_FIRST_DAY = (1980, 1, 1, 0, 0, 0)


@dataclass(frozen=True)
class Output:
    """One estimate: its name, the signal whose operating point it has, and unit."""

    name: str
    signal: str | None
    unit: str
    description: str


@dataclass(frozen=True)
class FmuSignals:
    """Everything that an FMU shows, in the order of its values."""

    inputs: tuple[str, ...]
    input_signals: tuple[str, ...]
    outputs: tuple[Output, ...]
    points: Mapping[str, float]
    alarms: Alarms
    units: Mapping[str, str]
    dt: float

    def point_index(self, signal: str | None) -> int:
        """Return the position of a signal among the operating points, -1 for none."""
        return -1 if signal is None else list(self.points).index(signal)


def signals_of_linear(found: Realisation, alarms: Alarms) -> FmuSignals:
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
        )
        for name, delay in zip(observer.fault_names, observer.fault_delays, strict=True)
    ]
    outputs += [Output(f"r[{name}]", None, units.get(name, ""), f"residual {name}") for name in observer.residual_names]
    outputs += _monitor_outputs(alarms)
    signals = (*found.inputs, *observer.state_names, *observer.fault_names)
    points = {name: float(stated.get(name, 0.0)) for name in dict.fromkeys(signals)}
    inputs = _apart(observer.input_names, observer.output_names)
    return FmuSignals(inputs, found.inputs, tuple(outputs), points, alarms, units, observer.dt)


def _monitor_outputs(alarms: Alarms) -> list[Output]:
    """Return what a monitor shows, if there is one."""
    shown = () if alarms.monitor is None else alarms.monitor.variables
    return [Output(variable.name, None, "", variable.description) for variable in shown]


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
        _apart(model.input_names, model.output_names),
        (*model.input_names, *model.output_names),
        tuple(outputs),
        {},
        alarms,
        units,
        observer.dt,
    )


def _late(text: str, delay: int) -> str:
    return f"{text}, delayed by {delay} sample(s)" if delay else text


def _apart(known: Sequence[str], measured: Sequence[str]) -> tuple[str, ...]:
    """Return names of the FMU's inputs: those of the signals, distinguished where an input is called as an output."""
    both = set(known) & set(measured)
    return (
        *(f"u[{name}]" if name in both else name for name in known),
        *(f"y[{name}]" if name in both else name for name in measured),
    )


def _variable(
    name: str,
    causality: str,
    variability: str,
    told: str,
    *,
    initial: str = "",
    start: float | None = None,
    unit: str = "",
    is_number: bool = True,
) -> _Variable:
    attributes = {"name": name, "causality": causality, "variability": variability, "description": told}
    shown = {} if start is None else {"start": repr(float(start))}
    return is_number, attributes | ({"initial": initial} if initial else {}), shown | ({"unit": unit} if unit else {})


def _variables(signals: FmuSignals) -> Iterator[_Variable]:
    """Yield the variables in the order of their value references, which are 0, 1, 2, ..."""
    yield _variable("time", "independent", "continuous", "time", unit="s")
    for name, signal in zip(signals.inputs, signals.input_signals, strict=True):
        start, unit = signals.points.get(signal, 0.0), signals.units.get(signal, "")
        yield _variable(name, "input", "discrete", f"signal {signal}", start=start, unit=unit)
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
    for name, value, unit, told in parameters:
        yield _variable(name, "parameter", "tunable", told, initial="exact", start=value, unit=unit)
    flags = [(f"alarm[{name}]", f"{name} is above its threshold") for name in signals.alarms.levels]
    flags.append(("alarm", "any alarm"))
    flags.append(("sample_used", "the last sample was used; otherwise the estimates are those of the model alone"))
    for name, told in flags:
        yield _variable(name, "output", "discrete", told, initial="calculated", is_number=False)


def model_description(
    signals: FmuSignals, version: str, sources: list[str], *, identifier: str, token: str, name: str, told: str
) -> bytes:
    """Return ``modelDescription.xml`` of a version of FMI; ``told``: what the model is, in a sentence."""
    (token_name, number, lists, abilities), step = _VERSIONS[version], repr(signals.dt)
    root = Element(
        "fmiModelDescription",
        {
            "fmiVersion": version,
            "modelName": name,
            token_name: token,
            "description": told,
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
    variables = list(_variables(signals))
    units = dict.fromkeys(shown["unit"] for _, _, shown in variables if "unit" in shown)
    definitions = SubElement(root, "UnitDefinitions") if units else root
    for unit in units:
        SubElement(definitions, "Unit", {"name": unit})
    SubElement(root, "DefaultExperiment", {"startTime": "0", "stepSize": step})
    listed = SubElement(root, "ModelVariables")
    for reference, (is_number, own, shown) in enumerate(variables):
        kind = number if is_number else "Boolean"
        attributes = {"name": own["name"], "valueReference": str(reference), **own}
        if version == "2.0":
            SubElement(SubElement(listed, "ScalarVariable", attributes), kind, shown)
        else:
            SubElement(listed, kind, attributes | shown)
    structure = SubElement(root, "ModelStructure")
    outputs = [reference for reference, (_, own, _) in enumerate(variables) if own["causality"] == "output"]
    for part in lists:
        # FMI 2 counts variables from one, and lists them inside an element.
        unknowns = SubElement(structure, part) if version == "2.0" else structure
        for reference in outputs:
            if version == "2.0":
                SubElement(unknowns, "Unknown", {"index": str(reference + 1)})
            else:
                SubElement(unknowns, part, {"valueReference": str(reference)})
    return _text(root)


def build_description(identifier: str, sources: list[str]) -> bytes:
    """Return ``sources/buildDescription.xml`` of FMI 3.0."""
    root = Element("fmiBuildDescription", {"fmiVersion": "3.0"})
    build = SubElement(root, "BuildConfiguration", {"modelIdentifier": identifier})
    files = SubElement(build, "SourceFileSet", {"language": "C99"})
    for name in sources:
        SubElement(files, "SourceFile", {"name": name})
    return _text(root)


def _text(root: Element) -> bytes:
    ElementTree.indent(root)
    return bytes(ElementTree.tostring(root, encoding="UTF-8", xml_declaration=True)) + b"\n"


def write_fmu(
    design: ObserverDesign,
    target: Path,
    *,
    version: str,
    sample_time: float | None,
    thresholds: Mapping[str, float] | None,
    warm_up: float | None,
    monitor: ExportedMonitor | None,
    outliers: str | None = None,
) -> Path:
    """Write an FMU for co-simulation; the binary is left out where there is no compiler."""
    signals, texts, digest = _contents(design, sample_time, thresholds, warm_up, monitor, outliers)
    identifier = c_identifier(target.stem)
    token = f"{{{uuid.uuid5(uuid.NAMESPACE_URL, ' '.join((digest, version, repr(signals))))}}}"
    sentence = f"Observer of {design.name} by {design.method}, written by obsynth; sha256 of the gain set {digest}"
    mark = unverified_mark(design.report)
    sentence = f"{mark}. {sentence}" if mark else f"{sentence}. {verification_words(design)}"
    wrapper = f"fmi{version[0]}.c"
    sources = {f"{_PREFIX}.c": texts[0], f"{_PREFIX}.h": texts[1], "layout.h": _layout(design, signals, token)}
    folder = files("obsynth.exporting.fmu")
    sources |= {name: folder.joinpath(name).read_text(encoding="utf-8") for name in ("instance.h", "common.h", wrapper)}
    compiled = [f"{_PREFIX}.c", wrapper]
    content: dict[str, bytes] = {f"sources/{name}": text.encode() for name, text in sources.items()}
    content["modelDescription.xml"] = model_description(
        signals, version, compiled, identifier=identifier, token=token, name=design.name, told=sentence
    )
    if version == "3.0":
        content["sources/buildDescription.xml"] = build_description(identifier, compiled)
    place = _binary_folder(version)
    if place is not None:
        binary = _binary(sources)
        if binary is not None:
            content[f"binaries/{place[0]}/{identifier}{place[1]}"] = binary
    return write_atomically(target, _zipped(content))


def _contents(
    design: ObserverDesign,
    sample_time: float | None,
    thresholds: Mapping[str, float] | None,
    warm_up: float | None,
    monitor: ExportedMonitor | None,
    outliers: str | None,
) -> tuple[FmuSignals, tuple[str, str], str]:
    """Return the signals, source and header, and the digest of the gain set."""
    header = f"{_PREFIX}.h"
    if isinstance(design.observer, DAEObserver):
        require_no_sample_time(design, sample_time)
        alarms = dae_alarms(design, thresholds, warm_up, monitor)
        text, declared, digest = dae_c_texts(design, _PREFIX, header, alarms, outliers)
        return signals_of_dae(design, alarms), (text, declared), digest
    found = Realisation.of(design, sample_time)
    if found.observer.dt == 0.0:
        raise SpecError(
            "The observer is continuous in time: give the sample time, in seconds, for an FMU.", path="sample_time"
        )
    alarms = linear_alarms(found, thresholds, warm_up, monitor)
    texts = source_text(found, _PREFIX, header, alarms), header_text(found, _PREFIX, alarms)
    source, declared = (in_precision(text, found.precision) for text in texts)
    return signals_of_linear(found, alarms), (source, declared), found.digest


def _layout(design: ObserverDesign, signals: FmuSignals, token: str) -> str:
    """Return ``layout.h``: sizes, start values, and how one sample is taken."""
    # Of each number, by value reference.
    starts = [shown.get("start", "0.0") for is_number, _, shown in _variables(signals) if is_number]
    points = [signals.point_index(signal if signals.points else None) for signal in signals.input_signals]
    shown = [signals.point_index(output.signal) for output in signals.outputs]
    sizes = {
        "N_IN": len(signals.inputs),
        "N_OUT": len(signals.outputs),
        "N_POINT": len(signals.points),
        "N_WATCHED": len(signals.alarms.levels),
    }
    body = _taking_dae(design, signals) if isinstance(design.observer, DAEObserver) else _taking_linear(design, signals)
    return "\n".join(
        [
            comment("Sizes and start values of this observer, written by obsynth."),
            "#ifndef OBSYNTH_FMU_LAYOUT_H",
            "#define OBSYNTH_FMU_LAYOUT_H",
            "",
            f'#include "{_PREFIX}.h"',
            "",
            f'#define TOKEN "{token}"',
            f"#define DT {signals.dt!r}",
            *(f"#define {name} {size}" for name, size in sizes.items()),
            "",
            f"typedef {_PREFIX}_state observer_memory;",
            "",
            *integer_table("start_values", starts, "double"),
            *integer_table("point_of_in", points),
            *integer_table("point_of_out", shown),
            "",
            "static void begin_observer(observer_memory *memory)",
            "{",
            f"    {_PREFIX}_reset(memory);",
            "}",
            "",
            "static int take_sample(observer_memory *memory, const double *in, double *out)",
            "{",
            *body,
            "}",
            "",
            "#endif",
            "",
        ]
    )


def _taking_linear(design: ObserverDesign, signals: FmuSignals) -> list[str]:
    """Return the body that hands one sample to the linear observer; empty groups are no arguments there."""
    kinds = [output.name.partition("[")[0] for output in signals.outputs]
    known = len(signals.inputs) - len(design.plant.output_names)
    counts = (("in", known), (f"in + {known}", len(signals.inputs) - known))
    groups, place = [], 0
    for kind in ("xhat", "fhat", "r"):
        groups.append((f"out + {place}", kinds.count(kind)))
        place += kinds.count(kind)
    arguments = ", ".join(text for text, count in (*counts, *groups) if count)
    return [
        f"    int failed = {_PREFIX}_step(memory, {arguments});",
        *_monitor_lines(signals, place),
        "    return failed;",
    ]


def _monitor_lines(signals: FmuSignals, place: int) -> list[str]:
    """Return the lines that show what a monitor says, if there is one."""
    shown = () if signals.alarms.monitor is None else signals.alarms.monitor.variables
    return [f"    out[{place + i}] = memory->monitor.{item.expression};" for i, item in enumerate(shown)]


def _taking_dae(design: ObserverDesign, signals: FmuSignals) -> list[str]:
    model, _ = design.nonlinear
    parts = (
        ("states", model.nx),
        ("state_deviations", model.nx),
        ("faults", model.nq),
        ("fault_deviations", model.nq),
        ("residuals", model.ny),
    )
    lines = [f"    {_PREFIX}_estimates said;", "    int i;"]
    inputs = "in, " if model.nu else ""
    lines += [
        f"    int failed = {_PREFIX}_step(memory, {inputs}in + {model.nu}, &said);",
        "    if (failed == 2) {",
        "        return 2;",
        "    }",
    ]
    place = 0
    for name, size in parts:
        if size:
            lines += [f"    for (i = 0; i < {size}; i++) {{", f"        out[{place} + i] = said.{name}[i];", "    }"]
        place += size
    lines.append(f"    out[{place}] = said.nis;")
    return [*lines, *_monitor_lines(signals, place + 1), "    return failed;"]


def _binary_folder(version: str) -> tuple[str, str] | None:
    """Return the folder and the suffix of this machine's binaries, `None` where the standard has none."""
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(platform.machine().lower(), platform.machine().lower())
    system = {"linux": ("linux", ".so"), "darwin": ("darwin", ".dylib"), "win32": ("windows", ".dll")}.get(sys.platform)
    if system is None:
        return None
    if version == "3.0":
        return f"{machine}-{system[0]}", system[1]
    if machine != "x86_64":
        return None
    return {"linux": "linux64", "darwin": "darwin64", "windows": "win64"}[system[0]], system[1]


def _binary(sources: Mapping[str, str]) -> bytes | None:
    """Return the shared library, or `None` where there is no compiler."""
    command = compiler()
    if command is None:
        return None
    with working_folder() as folder:
        hidden = [*command, *FLAGS, "-fvisibility=hidden"]
        return shared_library(folder, sources, hidden, path="fmu").read_bytes()


def _zipped(content: Mapping[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in sorted(content):
            entry = zipfile.ZipInfo(name, date_time=_FIRST_DAY)
            entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            archive.writestr(entry, content[name])
    return buffer.getvalue()
