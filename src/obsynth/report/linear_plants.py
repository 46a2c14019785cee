"""A linear plant as text for people, and as a document that specs can name."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from obsynth.plants.descriptor import DescriptorSystem

_MATRICES = ("E", "A", "B", "C", "D", "Bf", "Df", "Bd", "Dd")
_NAMES = ("state_names", "input_names", "output_names", "fault_names", "disturbance_names")


def linear_plant_text(plant: DescriptorSystem) -> str:
    """Return operating point and matrices, each with its signals."""
    lines = ["Operating point:"]
    for name, value in plant.operating_point.items():
        unit = plant.units.get(name, "1")
        lines.append(f"  {name} = {value:.8g}{'' if unit == '1' else ' ' + unit}")
    for name, signals in (("E", plant.state_names), ("A", plant.state_names), ("B", plant.input_names),
                          ("C", plant.state_names), ("Bf", plant.fault_names), ("Df", plant.fault_names),
                          ("Bd", plant.disturbance_names)):  # fmt: skip
        matrix = getattr(plant, name)
        if matrix.size and (np.any(matrix) or name in "EABC"):
            lines += [f"{name}, columns {', '.join(signals)}:"]
            lines += ["  " + "  ".join(f"{value + 0.0:>11.5g}" for value in row) for row in matrix]
    return "\n".join(lines)


def plant_document(plant: DescriptorSystem, source: str) -> str:
    """Return the plant as YAML that a spec can name; every number as exact as it is."""
    from ruamel.yaml import YAML

    data: dict[str, Any] = {"schema_version": 1, "dt": float(plant.dt)}
    for name in _MATRICES:
        matrix = getattr(plant, name)
        if matrix.size and (np.any(matrix) or name in "EAC"):
            data[name] = [[float(value) + 0.0 for value in row] for row in matrix]
    data |= {name: list(getattr(plant, name)) for name in _NAMES if getattr(plant, name)}
    data["operating_point"] = {name: float(value) for name, value in plant.operating_point.items()}
    data["units"] = dict(plant.units)
    text = io.StringIO()
    yaml: Any = YAML(typ="safe", pure=True)
    yaml.default_flow_style = None
    yaml.width = 4096
    yaml.sort_base_mapping_type_on_output = False
    yaml.dump(data, text)
    return f"# Linearised by obsynth from {source}, at the operating point below.\n{text.getvalue()}"
