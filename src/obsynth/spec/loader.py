"""From a spec file to a plant that a method can use."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.models.dae import DAEModel
from obsynth.models.descriptor import DescriptorSystem
from obsynth.models.names import index_of
from obsynth.models.time_varying import TimeVaryingDescriptorSystem
from obsynth.spec.checking import DocumentProblems, checked_plant, checked_spec
from obsynth.spec.documents import read_names, read_yaml
from obsynth.spec.matrices import read_matrices, read_matrix
from obsynth.spec.scenarios import built_scenario

if TYPE_CHECKING:
    from obsynth.analysis.transformations import Transformation
    from obsynth.simulation.scenario import Scenario
    from obsynth.spec.schema import DAESection, PlantSection, TimeVaryingSection, TransformSection

_MATRICES = ("E", "A", "B", "C", "D", "Bf", "Df", "Bd", "Dd", "Bw", "Dw")
_NAME_LISTS = ("state_names", "input_names", "output_names", "fault_names", "disturbance_names", "noise_names")
# Equations picked by name also name the signal that enters there.
_SIGNAL_OF_PICK = {"B": "input_names", "Bw": "noise_names"}


@dataclass(frozen=True, eq=False)
class Spec:
    """A spec, read and checked.

    Parameters
    ----------
    name : str
        Name of the design.
    description : str
        Free text; empty if there is none.
    path : Path
        The file it was read from.
    plant : DescriptorSystem, TimeVaryingDescriptorSystem or DAEModel
        The plant as the method sees it, after the transformation.
    transformation : Transformation, optional
        What was done to the plant as written, and the way back.
    method : str
        Identifier of the method.
    options : mapping
        The options of the method that the spec gives, checked.
    scenario : Scenario, optional
        What `obsynth.simulate` is asked to let happen.
    """

    name: str
    description: str
    path: Path
    plant: DescriptorSystem | TimeVaryingDescriptorSystem | DAEModel
    transformation: Transformation | None
    method: str
    options: Mapping[str, Any]
    scenario: Scenario | None = None


def load_spec(path: str | Path) -> Spec:
    """Read a spec; check it strictly; build its plant and transform it as asked.

    Parameters
    ----------
    path : str or Path
        A YAML 1.2 document.  Files it refers to are looked up in its own folder.

    Returns
    -------
    Spec
        Ready for `obsynth.design`.

    Raises
    ------
    SpecError
        The document or a file it refers to is malformed; as many problems as can be found at once, each
        with its path.
    PreconditionError
        The plant cannot be transformed as asked, for example because its index is not one.
    """
    source = Path(path)
    checked, raw_options = checked_spec(read_yaml(source), source)
    section: Any = checked.plant
    plant_source, prefix = source, "plant"
    reference = section if hasattr(section, "file") else None
    if reference is not None:
        plant_source, prefix = source.parent / reference.file, ""
        section = checked_plant(read_yaml(plant_source, where="plant.file"), plant_source)
    problems = DocumentProblems(source, what="spec")
    options = {
        name: _matrix(value, source.parent, f"method.options.{name}", problems) for name, value in raw_options.items()
    }
    problems.raise_if_any()
    if hasattr(section, "kind"):
        make: Any = _nonlinear_plant if section.kind == "dae" else _varying_plant
        varying = make(section, plant_source, prefix)
        return Spec(
            name=checked.name, description=checked.description or "", path=source, plant=varying, transformation=None,
            method=checked.method.id, options=options, scenario=built_scenario(checked.scenario, varying, source),
        )  # fmt: skip
    as_written = _built_plant(section, plant_source, prefix)
    if reference is not None and reference.transform is not None:
        # A plant may serve several methods: the spec's own transform takes the place of the plant's.
        transformation = _transformed(reference.transform, as_written, source, "plant")
    else:
        transformation = _transformed(section.transform, as_written, plant_source, prefix)
    plant = as_written if transformation is None else transformation.plant
    return Spec(
        name=checked.name, description=checked.description or "", path=source, plant=plant,
        transformation=transformation, method=checked.method.id, options=options,
        scenario=built_scenario(checked.scenario, plant, source),
    )  # fmt: skip


def _joined(prefix: str, name: str) -> str:
    return f"{prefix}.{name}" if prefix and name else prefix or name


def _matrix(value: Any, folder: Path, where: str, problems: DocumentProblems) -> Any:
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
            return read_matrix(path, variable=value.variable, where=where)
        except SpecError as error:
            problems.add(where, str(error))
            return None
    if hasattr(value, "outputs") or hasattr(value, "states"):
        return getattr(value, "outputs", getattr(value, "states", None))
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
        arguments[name] = _matrix(getattr(section, name), source.parent, _joined(prefix, name), problems)
    for name in ("state_names", "input_names", "output_names", "parameter_names"):
        arguments[name] = _names(getattr(section, name), source.parent, _joined(prefix, name), problems)
    problems.raise_if_any()
    try:
        return TimeVaryingDescriptorSystem(**arguments)
    except SpecError as error:
        raise SpecError(
            f"{source}: {error.args[0].splitlines()[0]}",
            path=_joined(prefix, error.path or ""),
            problems=error.problems,
        ) from error


def _nonlinear_plant(section: DAESection, source: Path, prefix: str) -> DAEModel:
    arguments = section.model_dump(exclude={"kind", "schema_version"}, exclude_none=True)
    try:
        return DAEModel(**arguments)
    except SpecError as error:
        raise SpecError(
            f"{source}: {error.args[0].splitlines()[0]}",
            path=_joined(prefix, error.path or ""),
            problems=error.problems,
        ) from error


def _built_plant(section: PlantSection, source: Path, prefix: str) -> DescriptorSystem:
    problems = DocumentProblems(source, what="plant" if not prefix else "spec")
    arguments: dict[str, Any] = {
        "dt": section.dt,
        "operating_point": section.operating_point,
        "scales": section.scales,
        "units": section.units,
    }
    for name in _MATRICES:
        arguments[name] = _matrix(getattr(section, name), source.parent, _joined(prefix, name), problems)
    for name in _NAME_LISTS:
        arguments[name] = _names(getattr(section, name), source.parent, _joined(prefix, name), problems)
    problems.raise_if_any()
    for matrix, names in _SIGNAL_OF_PICK.items():
        if isinstance(arguments[matrix], list) and arguments[names] is None:
            arguments[names] = arguments[matrix]
    try:
        # The operating point may name noise that is appended below, so it is checked with the whole plant.
        bare = DescriptorSystem(**{**arguments, "operating_point": None, "scales": None, "units": None})
        noisy = _noise_arguments(bare, section.sensor_noise)
        return DescriptorSystem(**{**bare.as_dict(), **noisy, **_labels(arguments)})
    except SpecError as error:
        raise SpecError(
            f"{source}: {error.args[0].splitlines()[0]}",
            path=_joined(prefix, error.path or ""),
            problems=error.problems,
        ) from error


def _labels(arguments: Mapping[str, Any]) -> dict[str, Any]:
    return {name: arguments[name] for name in ("operating_point", "scales", "units")}


def _noise_arguments(plant: DescriptorSystem, sensor_noise: Mapping[str, float] | None) -> dict[str, Any]:
    """Return the noise matrices with one column appended for each noisy sensor."""
    if not sensor_noise:
        return {}
    columns = np.zeros((plant.ny, len(sensor_noise)))
    for column, (name, deviation) in enumerate(sensor_noise.items()):
        columns[index_of(name, plant.output_names, what="sensor_noise"), column] = deviation
    return {
        "Bw": np.hstack([plant.Bw, np.zeros((plant.nx, len(sensor_noise)))]),
        "Dw": np.hstack([plant.Dw, columns]),
        "noise_names": (*plant.noise_names, *(f"noise {name}" for name in sensor_noise)),
    }


def _transformed(
    wanted: TransformSection | None, plant: DescriptorSystem, source: Path, prefix: str
) -> Transformation | None:
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
