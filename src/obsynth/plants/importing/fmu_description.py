"""The description of a functional mock-up unit: whether it can be linearised here, and what a linear model lacks."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from obsynth.errors import SpecError

#: Types of real variables, in FMI 2 and in FMI 3.
REAL_TYPES = ("Real", "Float64")

#: Spellings of the second, the unit of an FMU's independent variable where it states none.
_SECONDS = ("", "s", "sec", "second", "seconds")


def provides_derivatives(fmpy: Any, path: Path) -> bool:
    """Return whether an FMU provides derivatives; raise `SpecError` unless it can be linearised on this machine."""
    if not path.is_file():
        raise SpecError(f"{path} does not exist.", path=str(path))
    root = read_or_refuse(lambda: _description(path), path)
    version = root.get("fmiVersion", "")
    if version[:2] not in ("2.", "3."):
        raise SpecError(f"{path} is of FMI {version or '?'}: give an FMU of FMI 2 or 3.", path=str(path))
    exchange = root.find("ModelExchange")
    if exchange is None:
        raise SpecError(
            f"{path} is for co-simulation only: it does not give its states and derivatives. Export it "
            "for model exchange.",
            path=str(path),
        )
    platforms = read_or_refuse(lambda: fmpy.supported_platforms(str(path)), path)
    if fmpy.platform not in platforms and fmpy.platform_tuple not in platforms:
        raise SpecError(
            f"{path} has no binary for this machine ({fmpy.platform_tuple}); it has {', '.join(platforms) or 'none'}.",
            path=str(path),
        )
    # fmpy does not read the attribute of FMI 3, which is spelled differently.
    named = "providesDirectionalDerivative" + ("" if version.startswith("2") else "s")
    return exchange.get(named) in ("true", "1")


def require_linear_meaning(
    description: Any, path: Path, inputs: Sequence[str] | None, outputs: Sequence[str] | None
) -> None:
    """Refuse, by name, what a description states and a linear model in seconds of its real variables does not have:
    another unit of time, clocks, inputs that are no real numbers, outputs that change at events alone."""
    for variable in description.modelVariables:
        if variable.causality == "independent":
            unit = variable.unit or (variable.declaredType.unit if variable.declaredType is not None else None) or ""
            if unit not in _SECONDS:
                raise SpecError(
                    f"{path}: its independent variable {variable.name!r} is in {unit!r}, not in seconds: derivatives "
                    "would be per that unit. Export the FMU in seconds.",
                    path=str(path),
                )
        if variable.type == "Clock":
            raise SpecError(
                f"{path} has the clock {variable.name!r}: a part of it is sampled, and a linear model in continuous "
                "time would leave it out. Export the FMU without it.",
                path=str(path),
            )
    # An input that is left at its value may switch the equations; an output that changes at events alone has no row.
    strange = {
        "inputs": [v for v in description.modelVariables if v.causality == "input" and not _is_continuous(v)],
        "outputs": [
            v
            for v in description.modelVariables
            if v.causality == "output" and (v.type not in REAL_TYPES or v.variability == "discrete")
        ],
    }
    consequences = {"inputs": "keep the values that they start with", "outputs": "are left out"}
    for what, picked in (("inputs", inputs), ("outputs", outputs)):
        if picked is None and strange[what]:
            names = ", ".join(v.name if v.type in REAL_TYPES else f"{v.name} ({v.type})" for v in strange[what])
            raise SpecError(
                f"{path}: its {what} {names} are no continuous real numbers, and a linear model has no such signal: "
                f"name those that it shall have by {what}=[...]; the others {consequences[what]}.",
                path=what,
            )
        for variable in strange[what]:
            if picked is not None and variable.type not in REAL_TYPES and variable.name in picked:
                raise SpecError(
                    f"{path}: {variable.name!r} is of type {variable.type}, and a linear model has real numbers "
                    f"({' or '.join(REAL_TYPES)}) alone: leave it out of {what}.",
                    path=what,
                )


def read_or_refuse(make: Callable[[], Any], path: Path) -> Any:
    """Return what fmpy makes of a file; whatever it says of a damaged one becomes one error."""
    try:
        return make()
    except MemoryError:
        raise
    # Whatever readers of damaged zips and texts raise; fmpy raises bare ones for a library that cannot be loaded.
    except Exception as error:
        raise SpecError(f"{path} cannot be used as an FMU: {error}", path=str(path)) from error


def _description(path: Path) -> ElementTree.Element:
    """Return the description of the model in an FMU."""
    with zipfile.ZipFile(path) as archive, archive.open("modelDescription.xml") as stream:
        return ElementTree.parse(stream).getroot()


def _is_continuous(variable: Any) -> bool:
    return variable.type in REAL_TYPES and variable.variability in (None, "continuous")
