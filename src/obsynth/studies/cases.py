"""The cases of a sweep: combinations of plants and values, each with a digest of everything its design reads."""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

from obsynth.errors import SpecError, a_kind
from obsynth.files.inputs import input_file
from obsynth.methods.designing import design
from obsynth.methods.registry import Plant
from obsynth.numerics.arguments import require_kind
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.signal_names import index_of
from obsynth.results.design import ObserverDesign
from obsynth.results.gain_set_writing import plain
from obsynth.specs.documents import read_yaml
from obsynth.specs.loader import changed_document, design_of_spec, spec_of
from obsynth.studies.work import Work

#: Keys of a spec; a parameter that begins with none of them is an option of the method.
_SECTIONS = ("plant", "method", "scenario", "name", "description")

#: What a section ``plant`` may hold beside a reference to a file; everything else is changed in that file.
_REFERENCE = ("file", "transform")

#: More cases than this are taken for a slip.
MOST_CASES = 100_000


def spec_cases(specs: Sequence[Path], parameters: Mapping[str, Sequence[Any]], version: str) -> list[Work]:
    """Return a design to be made for each spec and each combination of values."""
    cases: list[Work] = []
    stems = [path.stem if [other.stem for other in specs].count(path.stem) == 1 else str(path) for path in specs]
    for path, stem in zip(specs, stems, strict=True):
        document = read_yaml(path)
        for chosen in _combinations(parameters, len(specs)):
            own, of_plant = _sorted_out(document, chosen)
            changed = changed_document(document, own)
            name, digest = _named(stem, chosen), _digest(version, changed, of_plant, path)
            cases.append(Work(name, digest, partial(_case_of_spec, name, path, changed, of_plant), chosen))
    return _distinct(cases)


def plant_cases(
    plants: Mapping[str, Plant], method: str, parameters: Mapping[str, Sequence[Any]], version: str
) -> list[Work]:
    """Return a design to be made for each plant and each combination of values: of its fields (``plant.C``) or of
    options."""
    cases: list[Work] = []
    for stem, plant in plants.items():
        for chosen in _combinations(parameters, len(plants)):
            changes = {key.removeprefix("plant."): value for key, value in chosen.items() if key.startswith("plant.")}
            options = {
                key.removeprefix("method.options."): value
                for key, value in chosen.items()
                if not key.startswith("plant.")
            }
            if changes and not isinstance(plant, DescriptorSystem):
                raise SpecError(f"Fields of {a_kind(plant)} cannot be varied in a sweep.", path="parameters")
            varied = _varied(plant, changes) if changes and isinstance(plant, DescriptorSystem) else plant
            written = varied.dense() if isinstance(varied, DescriptorSystem) else varied
            body = json.dumps(plain([version, method, options, written.as_dict()]), sort_keys=True)
            name, digest = _named(stem, chosen), hashlib.sha256(body.encode()).hexdigest()
            cases.append(Work(name, digest, partial(design, varied, method, name=name, **options), chosen))
    return _distinct(cases)


def _case_of_spec(
    name: str, path: Path, document: Mapping[str, Any], plant_changes: Mapping[str, Any]
) -> ObserverDesign:
    """Return the design of a spec, and of changes to the plant in the file that it refers to."""
    return design_of_spec(spec_of(document, path, plant_changes=plant_changes), name=name)


def _varied(plant: DescriptorSystem, changes: Mapping[str, Any]) -> DescriptorSystem:
    """Return a plant with some fields changed; ``outputs`` picks some of its own by name."""
    changes = dict(changes)
    if "outputs" in changes:
        picked = changes.pop("outputs")
        names = [picked] if isinstance(picked, str) else list(picked)
        rows = [index_of(name, plant.output_names, what="The plant") for name in names]
        for name in ("C", "D", "Df", "Dd", "Dw"):
            changes.setdefault(name, getattr(plant, name)[rows])
        changes.setdefault("output_names", names)
    unknown = sorted(set(changes) - {item.name for item in fields(plant)})
    if unknown:
        raise SpecError(f"A plant has no field {', '.join(map(repr, unknown))}.", path=f"parameters.plant.{unknown[0]}")
    return plant.replace(**changes)


def _combinations(parameters: Mapping[str, Sequence[Any]], sources: int) -> Iterator[dict[str, Any]]:
    count = sources
    for name, values in parameters.items():
        require_kind(name, str, f"The parameter {name!r}", "its name", path="parameters")
        if isinstance(values, (str, Mapping)) or not isinstance(values, Sequence) or not len(values):
            raise SpecError(f"The parameter {name!r} is {values!r}: give a list of values.", path=f"parameters.{name}")
        count *= len(values)
    if count > MOST_CASES:
        raise SpecError(f"The sweep has {count} cases, more than {MOST_CASES}: give fewer values.", path="parameters")
    for values in itertools.product(*parameters.values()):
        yield dict(zip(parameters, values, strict=True))


def _sorted_out(document: Mapping[str, Any], chosen: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the changes to a spec, and those to the plant in the file that it refers to."""
    plant = document.get("plant")
    by_reference = isinstance(plant, Mapping) and "file" in plant
    own, of_plant = {}, {}
    for path, value in chosen.items():
        first, _, rest = path.partition(".")
        if first not in _SECTIONS:
            own[f"method.options.{path}"] = value
        elif first == "plant" and by_reference and rest.partition(".")[0] not in _REFERENCE:
            of_plant[rest] = value
        else:
            own[path] = value
    return own, of_plant


def _digest(version: str, document: Mapping[str, Any], plant_changes: Mapping[str, Any], source: Path) -> str:
    """Return the digest of a changed spec and of every file that it refers to."""
    digest = hashlib.sha256(version.encode())

    def read(part: Any, folder: Path) -> None:
        digest.update(json.dumps(part, sort_keys=True, default=str).encode())
        for name in _files_in(part):
            file = folder / name
            digest.update(input_file(file, where=name).read_bytes())
            if file.suffix.lower() in (".yaml", ".yml"):
                read(changed_document(read_yaml(file), plant_changes), file.parent)

    read([document, plant_changes], source.parent)
    return digest.hexdigest()


def _files_in(part: Any) -> Iterator[str]:
    """Return every ``file`` in nested data."""
    if isinstance(part, Mapping):
        if isinstance(part.get("file"), str):
            yield part["file"]
        for value in part.values():
            yield from _files_in(value)
    elif isinstance(part, list):
        for value in part:
            yield from _files_in(value)


def _named(stem: str, chosen: Mapping[str, Any]) -> str:
    values = [f"{path.rpartition('.')[2]} = {_cell_text(value)}" for path, value in chosen.items()]
    return ", ".join([stem, *values])


def _cell_text(value: Any) -> str:
    text = f"{value:g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 40 else f"{text[:36]} ..."


def _distinct(cases: list[Work]) -> list[Work]:
    """Return the cases without repetitions: the same design is made once."""
    return list({case.key: case for case in reversed(cases)}.values())[::-1]
