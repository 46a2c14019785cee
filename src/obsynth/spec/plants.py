"""From the sections of a checked document to plants.

Constants with tolerances in the plant of a spec: expressions in its matrices, entry by entry.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from obsynth.errors import SpecError
from obsynth.plants.dae.model import DAEModel
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.names import index_of
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.plants.uncertain_system import uncertain_system, with_expressions
from obsynth.plants.uncertainty import UNCERTAIN_MATRICES, Entry
from obsynth.spec.checking import DocumentProblems
from obsynth.spec.documents import read_names
from obsynth.spec.matrices import read_matrices, read_matrix
from obsynth.spec.schema import EntrySection, PlantSection

if TYPE_CHECKING:
    from obsynth.analysis.transformations import Transformation
    from obsynth.spec.schema import DAESection, PlantReference, PlantSection, TimeVaryingSection, TransformSection


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


_Plant = TypeVar("_Plant", DescriptorSystem, TimeVaryingDescriptorSystem, DAEModel)


_MATRICES = ("E", "A", "B", "C", "D", "Bf", "Df", "Bd", "Dd", "Bw", "Dw")


_NAME_LISTS = ("state_names", "input_names", "output_names", "fault_names", "disturbance_names", "noise_names")


# Equations picked by name also name the signal that enters there.
_SIGNAL_OF_PICK = {"B": "input_names", "Bw": "noise_names"}


_LABELS = ("operating_point", "scales", "units")


def built_plant(
    section: PlantSection | TimeVaryingSection | DAESection, source: Path, prefix: str
) -> DescriptorSystem | TimeVaryingDescriptorSystem | DAEModel:
    """Return the plant of a section, as written."""
    kind = getattr(section, "kind", None)
    make: Any = _invariant_plant if kind is None else _nonlinear_plant if kind == "dae" else _varying_plant
    plant: DescriptorSystem | TimeVaryingDescriptorSystem | DAEModel = make(section, source, prefix)
    return plant


def _placed(make: Callable[[], _Plant], source: Path, prefix: str) -> _Plant:
    """Return the plant that is made; an error gets its place in the document."""
    try:
        return make()
    except SpecError as error:
        raise SpecError(
            f"{source}: {error.args[0].splitlines()[0]}",
            path=_joined(prefix, error.path or ""),
            problems=error.problems,
        ) from error


def _joined(prefix: str, name: str) -> str:
    return f"{prefix}.{name}" if prefix and name else prefix or name


def read_value(value: Any, folder: Path, where: str, problems: DocumentProblems, *, keep_sparse: bool = False) -> Any:
    """Return rows as an array, files read, picks as lists of names, sections as mappings, all else as it is."""
    if isinstance(value, list) and any(isinstance(entry, str) for row in value for entry in _listed(row)):
        return value
    if isinstance(value, list):
        return np.array(value, dtype=np.float64) if all(isinstance(row, list) for row in value) else value
    if hasattr(value, "file"):
        path = folder / value.file
        try:
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


def _names(value: Any, folder: Path, where: str, problems: DocumentProblems) -> list[str] | None:
    if hasattr(value, "file"):
        try:
            return read_names(folder / value.file, where=where)
        except SpecError as error:
            problems.add(where, str(error))
            return None
    return None if value is None else list(value)


def _listed(row: Any) -> list[Any]:
    return row if isinstance(row, list) else [row]


def _varying_plant(section: TimeVaryingSection, source: Path, prefix: str) -> TimeVaryingDescriptorSystem:
    problems = DocumentProblems(source, what="plant" if not prefix else "spec")
    kept = ("dt", "horizon", "constants", "operating_point", "scales", "units")
    arguments: dict[str, Any] = {name: getattr(section, name) for name in kept}
    for name in ("E", "A", "B", "C", "Phi", "Psi"):
        arguments[name] = read_value(getattr(section, name), source.parent, _joined(prefix, name), problems)
    for name in ("state_names", "input_names", "output_names", "parameter_names"):
        arguments[name] = _names(getattr(section, name), source.parent, _joined(prefix, name), problems)
    problems.raise_if_any()
    return _placed(lambda: TimeVaryingDescriptorSystem(**arguments), source, prefix)


def _nonlinear_plant(section: DAESection, source: Path, prefix: str) -> DAEModel:
    arguments = section.model_dump(exclude={"kind", "schema_version", "transform"}, exclude_none=True)
    return _placed(lambda: DAEModel(**arguments), source, prefix)


def _invariant_plant(section: PlantSection, source: Path, prefix: str) -> DescriptorSystem:
    problems = DocumentProblems(source, what="plant" if not prefix else "spec")
    arguments: dict[str, Any] = {name: getattr(section, name) for name in ("dt", "sensor_noise", *_LABELS)}
    for name in _MATRICES:
        value, where = getattr(section, name), _joined(prefix, name)
        arguments[name] = read_value(value, source.parent, where, problems, keep_sparse=True)
    for name in _NAME_LISTS:
        arguments[name] = _names(getattr(section, name), source.parent, _joined(prefix, name), problems)
    problems.raise_if_any()
    for matrix, names in _SIGNAL_OF_PICK.items():
        if isinstance(arguments[matrix], list) and arguments[names] is None:
            arguments[names] = arguments[matrix]

    return _placed(lambda: with_constants(DescriptorSystem(**arguments), section), source, prefix)


def matlab_plant(reference: PlantReference, spec: Path) -> DescriptorSystem | None:
    """Return the plant in a ``.mat`` file that a spec refers to; `None` where it refers to another kind of file."""
    arguments = reference.model_dump(exclude={"file", "transform"}, exclude_none=True)
    if Path(reference.file).suffix.lower() == ".mat":
        from obsynth.importing.matlab import from_matlab

        return _placed(lambda: from_matlab(spec.parent / reference.file, **arguments), spec, "plant")
    if arguments:
        raise SpecError(
            f"{spec}: plant.{next(iter(arguments))}: unknown key beside a file that is no .mat file: it belongs "
            f"into {reference.file}.", path=f"plant.{next(iter(arguments))}",
        )  # fmt: skip
    return None


def linearised(wanted: TransformSection | None, model: DAEModel, source: Path, prefix: str) -> DescriptorSystem | None:
    """Return the linear model of a nonlinear plant where a section asks for one."""
    if wanted is None:
        return None
    where = _joined(prefix, "transform")
    if wanted.linearise is None:
        raise SpecError(
            f"{source}: {where} is for linear plants: say where this one is linearised, such as linearise: {{at: "
            "equilibrium}, or remove it.", path=where,
        )  # fmt: skip
    from obsynth.analysis.transformations.linearisation import linearise

    arguments = wanted.linearise.model_dump(exclude_none=True)
    try:
        return linearise(model, **arguments)
    except SpecError as error:
        raise SpecError(f"{source}: {where}.linearise: {error}", path=f"{where}.linearise") from error


def transformed(
    wanted: TransformSection | None, plant: DescriptorSystem, source: Path, prefix: str
) -> Transformation | None:
    """Return a plant without its algebraic states, sampled, or both, as asked; ``None`` where nothing is."""
    if wanted is None or not (wanted.eliminate_algebraic_states or wanted.sample_time is not None):
        return None
    where = _joined(prefix, "transform")
    if wanted.sample_time is not None and plant.is_discrete:
        raise SpecError(
            f"{source}: {where}.sample_time is given, but the plant is discrete in time already "
            f"(dt = {plant.dt:g} s): remove it, or set dt to 0.",
            path=f"{where}.sample_time",
        )
    from obsynth.analysis.transformations import discretise, eliminate_algebraic_states

    try:
        if wanted.sample_time is None:
            return eliminate_algebraic_states(plant)
        if not wanted.eliminate_algebraic_states:
            return discretise(plant, wanted.sample_time)
        reduced = eliminate_algebraic_states(plant)
        return reduced.then(discretise(reduced.plant, wanted.sample_time))
    except SpecError as error:
        raise SpecError(f"{source}: {where}: {error}", path=where) from error
