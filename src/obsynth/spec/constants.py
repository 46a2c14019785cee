"""Constants with tolerances in the plant of a spec: expressions in its matrices, entry by entry."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from obsynth.errors import SpecError
from obsynth.files.inputs import read_json
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.uncertain_system import with_expressions
from obsynth.plants.uncertainty import UNCERTAIN_MATRICES, Entry
from obsynth.plants.validation import index_of
from obsynth.spec.schema import DAESection, EntrySection, PlantSection

#: Signals that name the columns of a matrix; rows are equations (states) or outputs.
_COLUMNS = {"B": "input_names", "D": "input_names", "Bf": "fault_names", "Df": "fault_names",
            "Bd": "disturbance_names", "Dd": "disturbance_names"}  # fmt: skip
_OUTPUT_ROWS = ("C", "D", "Df", "Dd")


def with_constants(plant: DescriptorSystem, section: PlantSection, folder: Path) -> DescriptorSystem:
    """Return the plant of a section with its constants and tolerances, if it has any."""
    if section.constants is None and section.tolerance is None:
        for name in ("entries", "variation", "box"):
            if getattr(section, name) is not None:
                raise SpecError(f"{name} is for a plant with constants: give constants, or tolerance.", path=name)
        return plant
    constants, box = boxed_constants(section, folder)
    entries = {name: [_entry(plant, name, item) for item in found] for name, found in (section.entries or {}).items()}
    return with_expressions(
        plant, entries, constants, tolerance=section.tolerance, variation=section.variation, **box
    )  # fmt: skip


def boxed_constants(section: PlantSection | DAESection, folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the constants of a section, those of a calibration put in place, and where their box comes from."""
    constants = dict(section.constants or {})
    if section.box is None:
        return constants, {}
    box = section.box.model_dump(exclude_none=True)
    file = box.pop("file", None)
    if file is None:
        if "source" not in box:
            raise SpecError("box has no source: give source (stated, set-membership or calibrated), or the file of a "
                            "calibration.", path="box.source")  # fmt: skip
        return constants, box
    if box:
        raise SpecError("box has a file, which says where it comes from: remove source, level and digest.", path="box")
    found = read_json(folder / file, where="box.file")
    if not isinstance(found, dict) or found.get("kind") != "obsynth calibration":
        raise SpecError(f"{file} is no calibration: write one by obsynth calibrate --out {file}.", path="box.file")
    try:
        calibrated = {name: _calibrated(name, item) for name, item in found["constants"].items()}
        options = {"source": "calibrated", "level": found["level"], "digest": found["log"]["digest"]}
    except (KeyError, TypeError, AttributeError) as error:
        raise SpecError(f"{file} is damaged: it has no {error}.", path="box.file") from error
    for name in calibrated:
        stated = constants.get(name)
        if isinstance(stated, dict) and ("range" in stated or "tolerance" in stated):
            raise SpecError(f"{name!r} has a tolerance here, and one in {file}: remove one of them.",
                            path=f"constants.{name}")  # fmt: skip
    return constants | calibrated, {**options, "calibrated": tuple(calibrated)}


def _calibrated(name: str, item: Mapping[str, Any]) -> dict[str, Any]:
    """Return nominal value, range and unit of a calibrated constant."""
    if item["open"]:
        raise SpecError(
            f"The box of {name!r} has an open {item['open'][0]} side: the log bounds nothing there. State its range, "
            "or take a log that moves it.", path=f"constants.{name}",
        )  # fmt: skip
    return {"nominal": item["nominal"], "range": list(item["range"]), "unit": item["unit"]}


def _entry(plant: DescriptorSystem, matrix: str, item: EntrySection) -> Entry:
    if matrix not in UNCERTAIN_MATRICES:
        raise SpecError(
            f"{matrix!r} holds no constants: {', '.join(UNCERTAIN_MATRICES)} may.", path=f"entries.{matrix}"
        )
    rows = plant.output_names if matrix in _OUTPUT_ROWS else plant.state_names
    columns = getattr(plant, _COLUMNS.get(matrix, "state_names"))
    places = []
    for key, value, names in (("row", item.row, rows), ("column", item.column, columns)):
        if isinstance(value, str):
            places.append(index_of(value, names, what=f"entries.{matrix}"))
        elif 1 <= value <= len(names):
            places.append(value - 1)
        else:
            raise SpecError(f"{matrix} has no {key} {value}: it has {len(names)}.", path=f"entries.{matrix}")
    return places[0], places[1], str(item.value)
