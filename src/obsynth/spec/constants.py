"""Constants with tolerances in the plant of a spec: expressions in its matrices, entry by entry."""

from __future__ import annotations

from obsynth.errors import SpecError
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.names import index_of
from obsynth.plants.uncertain_system import uncertain_system, with_expressions
from obsynth.plants.uncertainty import UNCERTAIN_MATRICES, Entry
from obsynth.spec.schema import EntrySection, PlantSection

#: Signals that name the columns of a matrix; rows are equations (states) or outputs.
_COLUMNS = {"B": "input_names", "D": "input_names", "Bf": "fault_names", "Df": "fault_names",
            "Bd": "disturbance_names", "Dd": "disturbance_names"}  # fmt: skip
_OUTPUT_ROWS = ("C", "D", "Df", "Dd")


def with_constants(plant: DescriptorSystem, section: PlantSection) -> DescriptorSystem:
    """Return the plant of a section with its constants and tolerances, if it has any."""
    if section.constants is None and section.tolerance is None:
        for name in ("entries", "variation", "box"):
            if getattr(section, name) is not None:
                raise SpecError(f"{name} is for a plant with constants: give constants, or tolerance.", path=name)
        return plant
    box = {} if section.box is None else section.box.model_dump()
    options = {"tolerance": section.tolerance, "variation": section.variation, **box}
    entries = {name: [_entry(plant, name, item) for item in found] for name, found in (section.entries or {}).items()}
    if not entries:
        return uncertain_system(plant, section.constants, **options)
    return with_expressions(plant, entries, section.constants, **options)


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
