"""Plants from the plant sections of a checked document, with the tolerances of their constants."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from obsynth.errors import SpecError
from obsynth.plants.calibrated_box import not_valid
from obsynth.plants.constants import constant_of
from obsynth.plants.dae import DAEModel
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.given_matrices import ALL_MATRICES, SIGNAL_NAMES
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.plants.signal_names import index_of
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.plants.transformations.functionals import with_functionals
from obsynth.plants.uncertain_system import with_expressions
from obsynth.plants.uncertainty import UNCERTAIN_MATRICES, Entry
from obsynth.results.calibration_files import read_calibration
from obsynth.specs.documents import DocumentProblems, read_names
from obsynth.specs.lines import composed, line_of
from obsynth.specs.matrix_files import read_matrices, read_matrix

if TYPE_CHECKING:
    from obsynth.specs.schema_plants import EntrySection, PlantReference, PlantSection
    from obsynth.specs.schema_sections import DAESection, TimeVaryingSection

_Made = TypeVar("_Made")

# Equations picked by name also name the signal that enters there.
_SIGNAL_OF_PICK = {"B": "input_names", "Bw": "noise_names"}

_LABELS = ("operating_point", "scales", "units")

#: What a file of OpenModelica does not leave open.
_OF_MATLAB = ("variable", "dt")

#: Files of plants that no spec refers to, and the way to them.
_OTHER_PLANTS = {
    ".fmu": "obsynth.from_fmu linearises it, in Python",
    ".xlsx": "save each sheet as .csv, and give A: {file: A.csv} and so on, or read it in Python",
    ".xls": "save each sheet as .csv, and give A: {file: A.csv} and so on, or read it in Python",
    ".csv": "a matrix is given as A: {file: A.csv}",
    ".npz": "a matrix is given as A: {file: plant.npz, variable: A}",
    ".mtx": "a matrix is given as A: {file: A.mtx}",
}

#: Noise of a nonlinear plant, which its linear model or the options of a method take; and what `with_noise` takes.
_TAKEN_NOISE = ("sensor_noise", "process_noise")

_NOISE_MODEL = ("sensor_noise", "offset", "walks")

#: Signals that name the columns of a matrix; rows are equations (states) or outputs.
_COLUMN_NAMES = {
    "B": "input_names",
    "D": "input_names",
    "Bf": "fault_names",
    "Df": "fault_names",
    "Bd": "disturbance_names",
    "Dd": "disturbance_names",
}

_OUTPUT_ROWS = ("C", "D", "Df", "Dd")


def built_plant(
    section: PlantSection | TimeVaryingSection | DAESection, source: Path, prefix: str
) -> DescriptorSystem | TimeVaryingDescriptorSystem | PolytopicSystem | DAEModel:
    """Return the plant of a section, as written."""
    kind = getattr(section, "kind", None)
    make: Any = _invariant_plant if kind is None else _nonlinear_plant if kind == "dae" else _varying_plant
    plant: DescriptorSystem | TimeVaryingDescriptorSystem | PolytopicSystem | DAEModel = make(section, source, prefix)
    return plant


def placed(make: Callable[[], _Made], source: Path, prefix: str) -> _Made:
    """Return the result of ``make``; an error gets its place in the document."""
    try:
        return make()
    except SpecError as error:
        path = joined(prefix, error.path or "")
        line = line_of(composed(source), path.split("."))
        place = source if line is None or error.problems else f"{source}, line {line}"
        raise SpecError(f"{place}: {error.args[0].splitlines()[0]}", path=path, problems=error.problems) from error


def joined(prefix: str, name: str) -> str:
    """Return the path of an entry of a document."""
    return f"{prefix}.{name}" if prefix and name else prefix or name


def read_value(value: Any, folder: Path, where: str, problems: DocumentProblems, *, keep_sparse: bool = False) -> Any:
    """Return rows as an array, files read (matrices, or names), picks as lists of names, sections as mappings, all else
    as it is."""
    if isinstance(value, list):
        entries = (entry for row in value for entry in (row if isinstance(row, list) else [row]))
        is_matrix = all(isinstance(row, list) for row in value) and not any(isinstance(entry, str) for entry in entries)
        return np.array(value, dtype=np.float64) if is_matrix else value
    if hasattr(value, "file"):
        path = folder / value.file
        try:
            if not hasattr(value, "variable"):
                return read_names(path, where=where)
            if hasattr(value, "stack"):
                return read_matrices(path, variable=value.variable, count=value.stack, where=where)
            return read_matrix(path, variable=value.variable, where=where, keep_sparse=keep_sparse)
        except SpecError as error:
            problems.add(where, str(error))
            return None
    if hasattr(value, "outputs") or hasattr(value, "states"):
        return getattr(value, "outputs", getattr(value, "states", None))
    if isinstance(value, dict):
        return {name: entry.model_dump() if hasattr(entry, "model_dump") else entry for name, entry in value.items()}
    return value.model_dump(exclude_unset=True) if hasattr(value, "model_dump") else value


def _read(
    section: Any,
    source: Path,
    prefix: str,
    plain: Sequence[str],
    matrices: Sequence[str],
    names: Sequence[str],
    *,
    keep_sparse: bool = False,
) -> dict[str, Any]:
    """Return entries of a section by name: some as they are, matrices and lists of names with their files read."""
    problems = DocumentProblems(source, what="plant" if not prefix else "spec")
    arguments: dict[str, Any] = {name: getattr(section, name) for name in plain}
    for name in (*matrices, *names):
        value, where = getattr(section, name), joined(prefix, name)
        # A list without names is no matrix.
        arguments[name] = value and read_value(value, source.parent, where, problems, keep_sparse=keep_sparse)
    problems.raise_if_any()
    return arguments


def _varying_plant(section: TimeVaryingSection, source: Path, prefix: str) -> TimeVaryingDescriptorSystem:
    names = ("state_names", "input_names", "output_names", "parameter_names")
    arguments = _read(
        section,
        source,
        prefix,
        ("dt", "horizon", "constants", *_LABELS),
        ("E", "A", "B", "C", "D", "Phi", "Psi"),
        names,
    )
    return placed(lambda: TimeVaryingDescriptorSystem(**arguments), source, prefix)


def noise_model_of(section: Any) -> dict[str, Any]:
    """Return what a section says of noise that needs states, as `with_noise` takes it; white noise of others too."""
    noise = {name: getattr(section, name, None) or {} for name in _NOISE_MODEL}
    noise["sensor_noise"] = {
        name: item if isinstance(item, (int, float)) else item.model_dump(exclude_none=True)
        for name, item in noise["sensor_noise"].items()
    }
    return {name: dict(value) for name, value in noise.items() if value}


def none_of_noise(section: Any) -> dict[str, Any]:
    """Return what a section states that there is none of, as an empty mapping: coloured noise, offsets, walks."""
    return {name: {} for name in _NOISE_MODEL if getattr(section, name, None) == {}}


def noise_needs_states(noise: Mapping[str, Any]) -> bool:
    """Whether what is said of noise needs states of its own: colour, offsets or walks."""
    coloured = any(isinstance(item, dict) for item in noise.get("sensor_noise", {}).values())
    return coloured or "offset" in noise or "walks" in noise


def _nonlinear_plant(section: DAESection, source: Path, prefix: str) -> DAEModel:
    left_out = {"kind", "schema_version", "transform", "variation", "box", *_TAKEN_NOISE, *_NOISE_MODEL}
    arguments = section.model_dump(exclude=left_out, exclude_none=True)

    def made() -> DAEModel:
        units = arguments.get("units")
        for name, item in boxed_constants(section, source.parent)[0].items():
            constant = constant_of(name, item)
            arguments["constants"][name] = constant.nominal
            if constant.unit and units is not None:
                units.setdefault(name, constant.unit)
        return DAEModel(**arguments)

    return placed(made, source, prefix)


def _polytopic_plant(section: PlantSection, source: Path, prefix: str) -> PolytopicSystem:
    """Return the plant of a section with scheduling parameters."""
    arguments = _read(section, source, prefix, ("dt", "sensor_noise", *_LABELS), ALL_MATRICES, SIGNAL_NAMES)
    for name in ("tolerance", "variation", "box", "transform", "delays", "functionals"):
        if getattr(section, name) is not None:
            raise SpecError(f"{source}: {name} is for plants without scheduling: remove it.", path=joined(prefix, name))
    if noise_needs_states(noise_model_of(section)):
        raise SpecError(
            f"{source}: noise with states of its own is for plants without scheduling: state white noise.",
            path=joined(prefix, "sensor_noise"),
        )

    def made() -> PolytopicSystem:
        values = {name: value for name, value in arguments.items() if value is not None}
        for matrix, names in _SIGNAL_OF_PICK.items():
            if isinstance(arguments[matrix], list) and arguments[names] is None:
                values[names] = arguments[matrix]
        base = DescriptorSystem(**values)
        for name, entries in (section.entries or {}).items():
            places = [_entry(base, name, item) for item in entries]
            rows = getattr(base, name).tolist()
            for row, column, text in places:
                rows[row][column] = text
            values[name] = rows
        scheduling = {name: item.model_dump(exclude_none=True) for name, item in (section.scheduling or {}).items()}
        return PolytopicSystem(plant=values, scheduling=scheduling, constants=section.constants)

    return placed(made, source, prefix)


def _invariant_plant(section: PlantSection, source: Path, prefix: str) -> DescriptorSystem | PolytopicSystem:
    if section.scheduling is not None:
        return _polytopic_plant(section, source, prefix)
    arguments = _read(
        section,
        source,
        prefix,
        ("dt", "sensor_noise", "delays", *_LABELS),
        ALL_MATRICES,
        SIGNAL_NAMES,
        keep_sparse=True,
    )
    if noise_needs_states(noise_model_of(section)):
        arguments["sensor_noise"] = None
    for matrix, names in _SIGNAL_OF_PICK.items():
        if isinstance(arguments[matrix], list) and arguments[names] is None:
            arguments[names] = arguments[matrix]

    def made() -> DescriptorSystem:
        functionals = section.functionals or {}
        units = arguments.pop("units") or {}
        own = {name: unit for name, unit in units.items() if name not in functionals}
        plant = DescriptorSystem(**arguments, units=own)
        named = {name: unit for name, unit in units.items() if name in functionals}
        return with_constants(with_functionals(plant, functionals, units=named), section, source.parent)

    return placed(made, source, prefix)


def imported_plant(reference: PlantReference, spec: Path) -> DescriptorSystem | None:
    """Return the plant in a file of another tool that a spec refers to; `None` where it refers to a document."""
    arguments = reference.model_dump(exclude={"file", "transform"}, exclude_none=True)
    path, suffix = spec.parent / reference.file, Path(reference.file).suffix.lower()
    if suffix == ".mat":
        from obsynth.plants.importing.matlab_models import from_matlab

        return placed(lambda: from_matlab(path, **arguments), spec, "plant")
    wrong = [name for name in arguments if suffix != ".mo" or name in _OF_MATLAB]
    if wrong:
        what = "a linear model of OpenModelica, which says that itself" if suffix == ".mo" else "no .mat or .mo file"
        remedy = "remove it" if suffix == ".mo" else f"it belongs into {reference.file}"
        raise SpecError(
            f"{spec}: plant.{wrong[0]}: unknown key beside a file that is {what}: {remedy}.", path=f"plant.{wrong[0]}"
        )
    if suffix == ".mo":
        from obsynth.plants.importing.modelica_models import from_modelica

        return placed(lambda: from_modelica(path, **arguments), spec, "plant")
    if suffix in _OTHER_PLANTS:
        raise SpecError(
            f"{spec}: plant.file: a plant is read from another spec (.yaml), a .mat or a .mo file, not from "
            f"{reference.file}: {_OTHER_PLANTS[suffix]}.",
            path="plant.file",
        )
    return None


def with_constants(plant: DescriptorSystem, section: PlantSection, folder: Path) -> DescriptorSystem:
    """Return the plant of a section with its constants and tolerances, if it has any."""
    if section.constants is None and section.tolerance is None:
        for name in ("entries", "variation", "box"):
            if getattr(section, name) is not None:
                raise SpecError(f"{name} is for a plant with constants: give constants, or tolerance.", path=name)
        return plant
    constants, box = boxed_constants(section, folder)
    entries = {name: [_entry(plant, name, item) for item in items] for name, items in (section.entries or {}).items()}
    return with_expressions(plant, entries, constants, tolerance=section.tolerance, variation=section.variation, **box)


def boxed_constants(section: PlantSection | DAESection, folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the constants of a section, those of a calibration put in place, and where their box comes from."""
    constants = dict(section.constants or {})
    if section.box is None:
        return constants, {}
    box = section.box.model_dump(exclude_none=True)
    file = box.pop("file", None)
    if file is None:
        if "source" not in box:
            raise SpecError(
                "box has no source: give source (stated, set-membership or calibrated), or the file of a calibration.",
                path="box.source",
            )
        return constants, box
    if box:
        raise SpecError("box has a file, which says where it comes from: remove source, level and digest.", path="box")
    calibration = read_calibration(folder / file, where="box.file")
    if not calibration["stands"]:
        raise SpecError(f"{file}: {not_valid(calibration['level'])}", path="box.file")
    options = {
        "source": "calibrated",
        "level": calibration["level"],
        "digest": calibration["log"]["digest"],
        "calibration": calibration["sha256"],
    }
    calibrated = {}
    for name, item in calibration["constants"].items():
        stated = constants.get(name)
        if isinstance(stated, dict) and ("range" in stated or "tolerance" in stated):
            raise SpecError(
                f"{name!r} has a tolerance here, and one in {file}: remove one of them.", path=f"constants.{name}"
            )
        unit = stated.get("unit") if isinstance(stated, dict) else None
        calibrated[name] = _calibrated(name, item, unit or (section.units or {}).get(name), file)
    return constants | calibrated, {**options, "calibrated": tuple(calibrated)}


def _calibrated(name: str, item: Mapping[str, Any], unit: str | None, file: str) -> dict[str, Any]:
    """Return nominal value, range and unit of a calibrated constant, whose unit in the plant is ``unit``, if any."""
    if item["open"]:
        raise SpecError(
            f"The box of {name!r} has an open {item['open'][0]} side: the log does not bound it there. State its "
            "range, or take a log that excites it.",
            path=f"constants.{name}",
        )
    if unit is not None and item["unit"] not in (unit, "1"):
        raise SpecError(
            f"{name!r} is in {unit} here, and in {item['unit']} in {file}: it was calibrated in another unit, or for "
            "another plant.",
            path=f"constants.{name}",
        )
    return {"nominal": item["nominal"], "range": list(item["range"]), "unit": unit or item["unit"]}


def _entry(plant: DescriptorSystem, matrix: str, item: EntrySection) -> Entry:
    if matrix not in UNCERTAIN_MATRICES:
        raise SpecError(
            f"{matrix!r} holds no constants: {', '.join(UNCERTAIN_MATRICES)} may.", path=f"entries.{matrix}"
        )
    rows = plant.output_names if matrix in _OUTPUT_ROWS else plant.state_names
    columns = getattr(plant, _COLUMN_NAMES.get(matrix, "state_names"))
    places = []
    for key, value, names in (("row", item.row, rows), ("column", item.column, columns)):
        if isinstance(value, str):
            places.append(index_of(value, names, what=f"entries.{matrix}"))
        elif 1 <= value <= len(names):
            places.append(value - 1)
        else:
            raise SpecError(f"{matrix} has no {key} {value}: it has {len(names)}.", path=f"entries.{matrix}")
    return places[0], places[1], str(item.value)
