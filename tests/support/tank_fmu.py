"""A nonlinear tank as an FMU for model exchange, compiled from C written for these tests."""

from __future__ import annotations

import subprocess
import zipfile
from pathlib import Path

import pytest

fmpy = pytest.importorskip("fmpy", reason="fmpy is not installed (obsynth[fmu])")

SOURCE = Path(__file__).parent / "fmu_plants" / "tank.c"
# Name, causality, variability, initial, start, unit, which state it is the derivative of.
VARIABLES = [
    ("level", "output", "continuous", "exact", 1.0, "m", None),
    ("der(level)", "local", "continuous", "calculated", None, "m/s", 0),
    ("inflow", "input", "continuous", None, 0.2, "m3/s", None),
    ("area", "parameter", "fixed", "exact", 2.0, "m2", None),
    ("c", "parameter", "fixed", "exact", 0.1, None, None),
    ("outflow", "output", "continuous", "calculated", None, "m3/s", None),
    ("temperature", "output", "continuous", "exact", 300.0, "K", None),
    ("der(temperature)", "local", "continuous", "calculated", None, "K/s", 6),
    ("supply temperature", "input", "continuous", None, 300.0, "K", None),
]


def description(version: str, *, derivatives: bool = True) -> str:
    units = "".join(f'<Unit name="{unit}"/>' for unit in dict.fromkeys(row[5] for row in VARIABLES if row[5]))
    lines = []
    for i, (name, causality, variability, initial, start, unit, state) in enumerate(VARIABLES):
        common = f'name="{name}" valueReference="{i}" causality="{causality}" variability="{variability}"'
        common += f' initial="{initial}"' if initial else ""
        value = (f' start="{start}"' if start is not None else "") + (f' unit="{unit}"' if unit else "")
        if version == "2.0":
            value += f' derivative="{state + 1}"' if state is not None else ""
            lines.append(f"<ScalarVariable {common}><Real{value}/></ScalarVariable>")
        else:
            value += f' derivative="{state}"' if state is not None else ""
            lines.append(f"<Float64 {common}{value}/>")
    if version == "3.0":
        lines.append('<Float64 name="time" valueReference="99" causality="independent" variability="continuous"/>')
    flag = str(derivatives).lower()
    if version == "2.0":
        head = 'fmiVersion="2.0" modelName="tank" guid="{t}"'
        exchange = f'<ModelExchange modelIdentifier="tank" providesDirectionalDerivative="{flag}"/>'
        unknowns = {"Outputs": (1, 6, 7), "Derivatives": (2, 8), "InitialUnknowns": (2, 6, 8)}
        structure = ""
        for part, numbers in unknowns.items():
            structure += f"<{part}>" + "".join(f'<Unknown index="{i}"/>' for i in numbers) + f"</{part}>"
    else:
        head = 'fmiVersion="3.0" modelName="tank" instantiationToken="{t}"'
        exchange = f'<ModelExchange modelIdentifier="tank" providesDirectionalDerivatives="{flag}"/>'
        parts = {"Output": (0, 5, 6), "ContinuousStateDerivative": (1, 7), "InitialUnknown": (1, 5, 7)}
        structure = "".join(f'<{part} valueReference="{i}"/>' for part, numbers in parts.items() for i in numbers)
    return (
        f'<?xml version="1.0" encoding="UTF-8"?><fmiModelDescription {head}>{exchange}'
        f"<UnitDefinitions>{units}</UnitDefinitions><ModelVariables>{''.join(lines)}</ModelVariables>"
        f"<ModelStructure>{structure}</ModelStructure></fmiModelDescription>"
    )


def stubs(version: str, text: str) -> str:
    """Return functions for whatever fmpy loads and the tank does not need."""
    from fmpy import fmi2, fmi3

    kind, prefix = (fmi2.FMU2Model, "fmi2") if version == "2.0" else (fmi3.FMU3Model, "fmi3")
    names = [name for name in dir(kind) if name.startswith(prefix)]
    return "\n".join(
        f"int {name}(void) {{ return 3; }}" for name in names if f" {name}(" not in text and f"*{name}(" not in text
    )


def tank(folder: Path, version: str, *, derivatives: bool = True) -> Path:
    """Build the FMU; skips where there is no compiler."""
    from obsynth.observers.nonlinear.c_code import compiler

    command = compiler()
    if command is None:
        pytest.skip("no C compiler")
    text = SOURCE.read_text()
    own = text.partition("#else")[0] if version == "2.0" else text.partition("#else")[2]
    source, library = folder / "tank.c", folder / "tank.so"
    source.write_text(text + stubs(version, own))
    flags = ["-shared", "-fPIC", "-O1", *(["-DFMI3"] if version == "3.0" else [])]
    subprocess.run([*command, *flags, str(source), "-o", str(library), "-lm"], check=True)
    place = fmpy.platform if version == "2.0" else fmpy.platform_tuple
    target = folder / f"tank{version[0]}.fmu"
    with zipfile.ZipFile(target, "w") as archive:
        archive.writestr("modelDescription.xml", description(version, derivatives=derivatives))
        archive.write(library, f"binaries/{place}/tank.so")
    return target
