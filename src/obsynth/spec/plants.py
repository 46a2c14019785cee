"""From the sections of a checked document to plants."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from obsynth.errors import SpecError
from obsynth.plants.constants import constant_of
from obsynth.plants.dae.model import DAEModel
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.spec.checking import DocumentProblems
from obsynth.spec.constants import boxed_constants, with_constants
from obsynth.spec.documents import read_names
from obsynth.spec.matrices import read_matrices, read_matrix
from obsynth.spec.schema import PlantSection

if TYPE_CHECKING:
    from obsynth.analysis.transformations.recovery import Transformation
    from obsynth.spec.schema import DAESection, PlantReference, PlantSection, TimeVaryingSection, TransformSection


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
    left_out = {"kind", "schema_version", "transform", "variation", "box"}
    arguments = section.model_dump(exclude=left_out, exclude_none=True)

    def made() -> DAEModel:
        units = arguments.get("units")
        for name, item in boxed_constants(section, source.parent)[0].items():
            found = constant_of(name, item)
            arguments["constants"][name] = found.nominal
            if found.unit and units is not None:
                units.setdefault(name, found.unit)
        return DAEModel(**arguments)

    return _placed(made, source, prefix)


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

    return _placed(lambda: with_constants(DescriptorSystem(**arguments), section, source.parent), source, prefix)


def matlab_plant(reference: PlantReference, spec: Path) -> DescriptorSystem | None:
    """Return the plant in a ``.mat`` file that a spec refers to; `None` where it refers to another kind of file."""
    arguments = reference.model_dump(exclude={"file", "transform"}, exclude_none=True)
    if Path(reference.file).suffix.lower() == ".mat":
        from obsynth.importing.model_files import from_matlab

        return _placed(lambda: from_matlab(spec.parent / reference.file, **arguments), spec, "plant")
    if arguments:
        raise SpecError(
            f"{spec}: plant.{next(iter(arguments))}: unknown key beside a file that is no .mat file: it belongs "
            f"into {reference.file}.", path=f"plant.{next(iter(arguments))}",
        )  # fmt: skip
    return None


def linearised(
    wanted: TransformSection | None, model: DAEModel, section: DAESection, folder: Path, source: Path, prefix: str
) -> DescriptorSystem | None:
    """Return the linear model of a nonlinear plant where a spec asks for one; ``folder``: of the plant's file."""
    constants, box = boxed_constants(section, folder)
    tolerances = {name: item for name, item in constants.items() if not isinstance(item, (int, float))}
    if wanted is None:
        if tolerances or section.variation is not None or section.box is not None:
            raise SpecError(
                f"{source}: {_joined(prefix, 'constants')}: tolerances are for the linear model of a nonlinear plant: "
                "add transform: {linearise: {at: equilibrium}}, or write numbers.", path=_joined(prefix, "constants"),
            )  # fmt: skip
        return None
    where = _joined(prefix, "transform")
    if wanted.linearise is None:
        raise SpecError(
            f"{source}: {where} is for linear plants: say where this one is linearised, such as linearise: {{at: "
            "equilibrium}, or remove it.", path=where,
        )  # fmt: skip
    from obsynth.analysis.transformations.entries_in_constants import box_of_model
    from obsynth.analysis.transformations.linearisation import linearise

    arguments = wanted.linearise.model_dump(exclude_none=True)
    tolerances |= arguments.pop("constants", {})
    if not tolerances and (box or section.variation is not None):
        raise SpecError(f"{source}: {_joined(prefix, 'variation')} and box are for constants with tolerances: give "
                        "some.", path=_joined(prefix, "constants"))  # fmt: skip
    try:
        if tolerances:
            given = arguments.get("given", {})
            arguments["constants"] = box_of_model(model, tolerances, given, variation=section.variation, **box)
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
    from obsynth.analysis.transformations.elimination import eliminate_algebraic_states
    from obsynth.analysis.transformations.sampling import discretise

    try:
        if wanted.sample_time is None:
            return eliminate_algebraic_states(plant)
        if not wanted.eliminate_algebraic_states:
            return discretise(plant, wanted.sample_time)
        reduced = eliminate_algebraic_states(plant)
        return reduced.then(discretise(reduced.plant, wanted.sample_time))
    except SpecError as error:
        raise SpecError(f"{source}: {where}: {error}", path=where) from error
