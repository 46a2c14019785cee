"""From a spec file to a plant that a method can use, transformed as asked, and a scenario that can be simulated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from obsynth.errors import SpecError
from obsynth.numerics.libraries import one_thread_if_small
from obsynth.plants.dae.model import DAEModel
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.simulation.profiles import KINDS, Profile
from obsynth.simulation.scenario import Scenario
from obsynth.simulation.signals import check_parameters
from obsynth.spec.documents import DocumentProblems, checked_plant, checked_spec, read_yaml
from obsynth.spec.plants import boxed_constants, built_plant, joined, matlab_plant, read_value

if TYPE_CHECKING:
    from obsynth.analysis.transformations.recovery import Transformation
    from obsynth.spec.schema import DAESection, ProfileSection, ScenarioSection, TransformSection


_GROUPS = ("inputs", "faults", "disturbances", "sensors")


def built_scenario(
    section: ScenarioSection | None, plant: DescriptorSystem | TimeVaryingDescriptorSystem | DAEModel, source: Path
) -> Scenario | None:
    """Return the scenario of a spec; `None` if it has none."""
    if section is None:
        return None
    problems = DocumentProblems(source, what="spec")
    given: dict[str, Any] = {name: getattr(section, name) for name in section.model_fields_set}
    for group in _GROUPS:
        given[group] = {
            name: [_profile(item, f"scenario.{group}.{name}", problems)
                   for item in (value if isinstance(value, list) else [value])]
            for name, value in getattr(section, group).items()
        }  # fmt: skip
    problems.raise_if_any()
    try:
        scenario = Scenario(**given)
        if isinstance(plant, DescriptorSystem):
            scenario.check_names(plant)
            scenario.step_of(plant)
        else:
            check_parameters(plant, scenario)
    except SpecError as error:
        problems.add(f"scenario.{error.path}", str(error))
        problems.raise_if_any()
    return scenario


def _profile(section: ProfileSection, where: str, problems: DocumentProblems) -> Profile | None:
    """Return the profile; note what is wrong with it."""
    kind = KINDS[section.kind]
    given = {name: getattr(section, name) for name in section.model_fields_set - {"kind"}}
    known = {field.name: field.default is MISSING for field in fields(kind)}
    for name in sorted(given.keys() - known.keys()):
        problems.add(f"{where}.{name}", f"a {section.kind} has no {name}: it takes {', '.join(known)}.")
    missing = [name for name, needed in known.items() if needed and name not in given]
    for name in missing:
        problems.add(f"{where}.{name}", f"a {section.kind} needs this key.")
    if missing or given.keys() - known.keys():
        return None
    try:
        return kind(**given)
    except SpecError as error:
        problems.add(f"{where}.{error.path}", str(error))
        return None


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
    model : DAEModel, optional
        The nonlinear plant as written, where the plant is one, or is linearised from one.
    calibrate : mapping, optional
        What `obsynth.calibrate` is asked to find, as written; its log is looked up beside the spec.
    """

    name: str
    description: str
    path: Path
    plant: DescriptorSystem | TimeVaryingDescriptorSystem | DAEModel
    transformation: Transformation | None
    method: str
    options: Mapping[str, Any]
    scenario: Scenario | None = None
    model: DAEModel | None = None
    calibrate: Mapping[str, Any] | None = None


def load_model(path: str | Path) -> tuple[DAEModel, Spec | None]:
    """Return the nonlinear plant of a spec, with the spec, or of a file that holds a plant alone."""
    plant, spec = load_plant(path)
    if not isinstance(plant, DAEModel):
        raise SpecError(f"{path} holds no nonlinear plant (kind: dae).", path=str(path))
    return plant, spec


def load_plant(
    path: str | Path,
) -> tuple[DescriptorSystem | TimeVaryingDescriptorSystem | DAEModel, Spec | None]:
    """Return the plant of a spec as it was written, with the spec, or that of a file that holds a plant alone."""
    source = Path(path)
    document = read_yaml(source)
    if "method" not in document and "plant" not in document:
        return built_plant(checked_plant(document, source), source, ""), None
    spec = load_spec(source)
    if spec.model is not None:
        return spec.model, spec
    return spec.plant if spec.transformation is None else spec.transformation.source, spec


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
    return spec_of(read_yaml(source), source)


def spec_of(document: Mapping[str, Any], source: Path, *, plant_changes: Mapping[str, Any] | None = None) -> Spec:
    """Return the spec that a document stands for, as if it were in ``source``; a plant in a file may be changed."""
    checked, raw_options = checked_spec(document, source)
    section: Any = checked.plant
    plant_source, prefix = source, "plant"
    reference = section if hasattr(section, "file") else None
    from_mat = None if reference is None else matlab_plant(reference, source)
    if reference is not None and from_mat is None:
        plant_source, prefix = source.parent / reference.file, ""
        plant_document = changed_document(read_yaml(plant_source, where="plant.file"), plant_changes or {})
        section = checked_plant(plant_document, plant_source)
    problems = DocumentProblems(source, what="spec")
    options = {
        name: read_value(value, source.parent, f"method.options.{name}", problems)
        for name, value in raw_options.items()
    }
    problems.raise_if_any()
    plant, transformation = built_plant(section, plant_source, prefix) if from_mat is None else from_mat, None
    # A plant may serve several methods: the spec's own transform takes the place of the plant's.
    asked: tuple[TransformSection | None, Path, str] = (getattr(section, "transform", None), plant_source, prefix)
    if reference is not None and reference.transform is not None:
        asked = (reference.transform, source, "plant")
    model = plant if isinstance(plant, DAEModel) else None
    if model is not None:
        linear = _linearised(asked[0], model, section, plant_source.parent, *asked[1:])
        plant = plant if linear is None else linear
    elif asked[0] is not None and asked[0].linearise is not None:
        raise SpecError(f"{asked[1]}: transform.linearise is for nonlinear plants (kind: dae): remove it.",
                        path="plant.transform.linearise")  # fmt: skip
    if isinstance(plant, DescriptorSystem):
        if asked[0] is not None:
            with one_thread_if_small(plant.nx):
                transformation = _transformed(asked[0], plant, *asked[1:])
        plant = plant if transformation is None else transformation.plant
    elif model is None and reference is not None and reference.transform is not None:
        raise SpecError(
            f"{source}: plant.transform is for linear plants with constant matrices, which {plant_source.name} is not: "
            "remove it.", path="plant.transform",
        )  # fmt: skip
    return Spec(
        name=checked.name, description=checked.description or "", path=source, plant=plant,
        transformation=transformation, method=checked.method.id, options=options,
        scenario=built_scenario(checked.scenario, plant, source), model=model,
        calibrate=None if checked.calibrate is None else checked.calibrate.model_dump(exclude_none=True),
    )  # fmt: skip


def _linearised(
    wanted: TransformSection | None, model: DAEModel, section: DAESection, folder: Path, source: Path, prefix: str
) -> DescriptorSystem | None:
    """Return the linear model of a nonlinear plant where a spec asks for one; ``folder``: of the plant's file."""
    constants, box = boxed_constants(section, folder)
    tolerances = {name: item for name, item in constants.items() if not isinstance(item, (int, float))}
    if wanted is None:
        if tolerances or section.variation is not None or section.box is not None:
            raise SpecError(
                f"{source}: {joined(prefix, 'constants')}: tolerances are for the linear model of a nonlinear plant: "
                "add transform: {linearise: {at: equilibrium}}, or write numbers.", path=joined(prefix, "constants"),
            )  # fmt: skip
        return None
    where = joined(prefix, "transform")
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
        raise SpecError(f"{source}: {joined(prefix, 'variation')} and box are for constants with tolerances: give "
                        "some.", path=joined(prefix, "constants"))  # fmt: skip
    try:
        if tolerances:
            given = arguments.get("given", {})
            arguments["constants"] = box_of_model(model, tolerances, given, variation=section.variation, **box)
        return linearise(model, **arguments)
    except SpecError as error:
        raise SpecError(f"{source}: {where}.linearise: {error}", path=f"{where}.linearise") from error


def _transformed(
    wanted: TransformSection | None, plant: DescriptorSystem, source: Path, prefix: str
) -> Transformation | None:
    """Return a plant without its algebraic states, sampled, or both, as asked; ``None`` where nothing is."""
    if wanted is None or not (wanted.eliminate_algebraic_states or wanted.sample_time is not None):
        return None
    where = joined(prefix, "transform")
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


def changed_document(document: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return a document with values at dotted paths put in place of those there; mappings on the way are made."""
    changed = dict(document)
    for path, value in changes.items():
        first, _, rest = path.partition(".")
        if not rest:
            changed[first] = value
            continue
        inner = changed.get(first)
        if inner is not None and not isinstance(inner, Mapping):
            raise SpecError(f"{path} cannot be set: {first} is no section with entries of its own.", path=path)
        changed[first] = changed_document(inner or {}, {rest: value})
    return changed
