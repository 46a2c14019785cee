"""Loading of specs: the plant with its transformations, the method with its options, and the scenario."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from obsynth.errors import SpecError
from obsynth.files.inputs import input_file, path_of
from obsynth.methods.registry import REGISTRY, method_class
from obsynth.numerics.arguments import arguments_checked
from obsynth.numerics.libraries import one_thread_if_small
from obsynth.numerics.suggestions import fields_suggested
from obsynth.plants.dae import DAEModel
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.plants.transformations.delays import absorb_delays
from obsynth.plants.transformations.elimination import eliminate_algebraic_states
from obsynth.plants.transformations.recovery import Transformation
from obsynth.plants.transformations.sampling import discretise
from obsynth.results.design import ObserverDesign
from obsynth.simulation.scenario import Scenario
from obsynth.specs.documents import DocumentProblems, checked_plant, checked_spec, read_yaml
from obsynth.specs.plant_sections import (
    boxed_constants,
    built_plant,
    imported_plant,
    joined,
    noise_model_of,
    noise_needs_states,
    none_of_noise,
    placed,
    read_value,
)
from obsynth.specs.scenario_section import built_scenario

if TYPE_CHECKING:
    from obsynth.specs.schema_plants import TransformSection
    from obsynth.specs.schema_sections import DAESection


@fields_suggested
@dataclass(frozen=True, eq=False)
class Spec:
    """A spec after reading and checking.

    Parameters
    ----------
    name : str
        Name of the design.
    description : str
        Free text; empty if there is none.
    path : Path
        The file of the spec.
    plant : DescriptorSystem, TimeVaryingDescriptorSystem or DAEModel
        The plant that the method designs for, after the transformation.
    transformation : Transformation, optional
        The transformation of the plant as written, with the recovery of its states.
    method : str
        Identifier of the method.
    options : mapping
        Options of the method, checked.
    scenario : Scenario, optional
        The scenario for `obsynth.simulate`.
    model : DAEModel, optional
        The nonlinear plant as written, if the plant is nonlinear or a linearisation.
    calibrate : mapping, optional
        Options of `obsynth.calibrate` as written; the path of the log is relative to the spec's folder.
    inputs : mapping, optional
        When the inputs of a row act: ``hold`` (``begins`` or ``ends``: during the step that begins or ends with the
        row) and ``delay`` (rows).
    noise : mapping, optional
        Sensor noise, offsets and random walks as written, for which the plant has states (`obsynth.with_noise`).

    Examples
    --------
    >>> import obsynth
    >>> spec = obsynth.load_spec("designs/wang2015/spec.yaml")
    >>> spec.name, spec.method, spec.plant.nx
    ('wang2015', 'fault-estimation-filter', 4)
    """

    name: str
    description: str
    path: Path
    plant: DescriptorSystem | TimeVaryingDescriptorSystem | PolytopicSystem | DAEModel
    transformation: Transformation | None
    method: str
    options: Mapping[str, Any]
    scenario: Scenario | None = None
    model: DAEModel | None = None
    calibrate: Mapping[str, Any] | None = None
    noise: Mapping[str, Any] | None = None
    inputs: Mapping[str, Any] | None = None

    def __repr__(self) -> str:
        scenario = "" if self.scenario is None else f", scenario of {self.scenario.horizon:g} s"
        return f"<Spec {self.name!r} ({self.path}): {self.plant!r}, method {self.method}{scenario}>"

    def input_delay(self, plant: Any) -> int | None:
        """Return by how many rows a log's inputs act later than a plant assumes; ``None`` if not stated.

        Nonlinear plants assume that the inputs of a row act during the step that ends there; other plants on samples
        assume the step that begins there.  Without ``inputs.hold`` the delay refers to the convention of the plant that
        the spec designs for.

        Parameters
        ----------
        plant : DescriptorSystem, TimeVaryingDescriptorSystem or DAEModel
            The plant that runs on the log.
        """
        own = _takes_inputs(plant)
        if self.inputs is not None:
            hold = self.inputs["hold"] or _takes_inputs(self.plant)
            return int(self.inputs["delay"]) + (hold == "begins") - (own == "begins")
        delay = (self.calibrate or {}).get("input_delay")
        if not isinstance(delay, int):
            return None
        # A calibrated delay of a nonlinear plant refers to the convention of that plant.
        sampled = isinstance(plant, DescriptorSystem) and plant.is_discrete and self.model is not None
        return delay - int(sampled)


def _takes_inputs(plant: Any) -> str:
    """Return when the inputs of a row act on a plant, as a value of ``inputs.hold``."""
    nonlinear = isinstance(plant, DAEModel) or (isinstance(plant, DescriptorSystem) and not plant.is_discrete)
    return "ends" if nonlinear else "begins"


def load_model(path: str | Path) -> tuple[DAEModel, Spec | None]:
    """Return the nonlinear plant of a spec or of a plant file, and the spec, if there is one."""
    plant, spec = load_plant(path)
    if not isinstance(plant, DAEModel):
        raise SpecError(f"{path} holds no nonlinear plant (kind: dae).", path=str(path))
    return plant, spec


def load_plant(
    path: str | Path,
) -> tuple[DescriptorSystem | TimeVaryingDescriptorSystem | DAEModel, Spec | None]:
    """Return the plant as written of a spec or of a plant file, and the spec, if there is one.

    A plant over a region raises `SpecError`: it cannot be fitted to a log.
    """
    source = Path(path)
    document = read_yaml(source)
    spec = None
    if "method" not in document and "plant" not in document:
        plant = built_plant(checked_plant(document, source), source, "")
    else:
        spec = spec_of(document, source, with_states=False)
        plant = spec.plant if spec.transformation is None else spec.transformation.source
        plant = plant if spec.model is None else spec.model
    if isinstance(plant, PolytopicSystem):
        raise SpecError(
            f"{source} holds a plant over a region (scheduling): this is for one that does not change, with constants.",
            path="plant.scheduling",
        )
    return plant, spec


@arguments_checked
def load_spec(path: str | Path) -> Spec:
    """Read and check a spec, and build its plant with the requested transformations.

    Parameters
    ----------
    path : str or Path
        A YAML 1.2 document.  Paths in it are relative to its folder.

    Returns
    -------
    Spec
        Ready for `obsynth.design`.

    Raises
    ------
    SpecError
        The document, or a file that it refers to, is malformed.  The error lists as many problems as possible, each
        with its path.
    PreconditionError
        A requested transformation does not exist, for example because the plant's index is not one.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> import obsynth
    >>> text = "{schema_version: 1, name: first, plant: {dt: 1, A: [[0.9]], C: [[1]], Bf: [[1]]}}"
    >>> with TemporaryDirectory() as folder:
    ...     file = Path(folder) / "spec.yaml"
    ...     _ = file.write_text(text)
    ...     spec = obsynth.load_spec(file)
    >>> spec.name, spec.plant.fault_names
    ('first', ('f1',))
    """
    source = path_of(path)
    return spec_of(read_yaml(source), source)


def design_of_spec(
    spec: Spec, *, name: str | None = None, progress: Callable[[str], None] | None = None
) -> ObserverDesign:
    """Return the verified design of a spec, with the notes of its transformation and the delay of its inputs."""
    from obsynth.methods.designing import design

    done, late = spec.transformation, spec.input_delay(spec.plant)
    designed = design(
        spec.plant,
        spec.method,
        name=name or spec.name,
        recovery=None if done is None else done.recovery,
        progress=progress,
        scenario=spec.scenario,
        **dict(spec.options),
    )
    notes = () if done is None else done.notes
    return designed.replace(notes=(*notes, *designed.notes), input_delay=late or designed.input_delay)


def spec_of(
    document: Mapping[str, Any],
    source: Path,
    *,
    plant_changes: Mapping[str, Any] | None = None,
    with_states: bool = True,
) -> Spec:
    """Return the spec of a document, as if it were the file ``source``.

    ``plant_changes`` change entries of a plant in a file of its own.  ``with_states``: add states for coloured noise,
    offsets and random walks to the plant.
    """
    checked, raw_options = checked_spec(document, source)
    reference: Any = checked.plant if hasattr(checked.plant, "file") else None
    section, plant_source, prefix, imported = _plant_section(checked.plant, source, plant_changes or {})
    options = _options_as_read(raw_options, source)
    plant = built_plant(section, plant_source, prefix) if imported is None else imported
    transformation: Transformation | None = None
    # A plant may serve several methods: the spec's own transform takes the place of the plant's.
    transform: tuple[TransformSection | None, Path, str] = (getattr(section, "transform", None), plant_source, prefix)
    if reference is not None and reference.transform is not None:
        transform = (reference.transform, source, "plant")
    model = plant if isinstance(plant, DAEModel) else None
    noise = noise_model_of(section)
    states = with_states and noise_needs_states(noise)
    if model is not None:
        linear = _linearised(transform[0], model, section, plant_source.parent, noise if states else {}, *transform[1:])
        if linear is None and with_states and (noise or section.process_noise):
            plant, options = _noisy_model(model, section, noise, checked.method.id, options, plant_source, prefix)
        plant = plant if linear is None else linear
    elif transform[0] is not None and transform[0].linearise is not None:
        raise SpecError(
            f"{transform[1]}: transform.linearise is for nonlinear plants (kind: dae): remove it.",
            path="plant.transform.linearise",
        )
    if isinstance(plant, DescriptorSystem):
        noisy, variances = None, {}
        if states and model is None:
            noisy, variances = _placed_noise(plant, noise, plant_source, prefix)
        transformation = _steps_of_linear_plant(plant, noisy, transform)
        plant = plant if transformation is None else transformation.plant
        if noisy is not None and plant.state_names == noisy.plant.state_names:
            options = _with_options(options, variances, checked.method.id)
    elif model is None and reference is not None and reference.transform is not None:
        raise SpecError(
            f"{source}: plant.transform is for linear plants with constant matrices, which {plant_source.name} is not: "
            "remove it.",
            path="plant.transform",
        )
    return Spec(
        name=checked.name,
        description=checked.description or "",
        path=source,
        plant=plant,
        transformation=transformation,
        method=checked.method.id,
        options=options,
        scenario=built_scenario(checked.scenario, plant, source),
        model=model,
        calibrate=None if checked.calibrate is None else checked.calibrate.model_dump(exclude_none=True),
        noise={**none_of_noise(section), **noise} or None,
        inputs=_checked_inputs(checked.inputs, plant, source),
    )


def _options_as_read(raw_options: Mapping[str, Any], source: Path) -> dict[str, Any]:
    """Return the options of the method, with matrices from the files that they refer to."""
    problems = DocumentProblems(source, what="spec")
    options = {
        name: read_value(value, source.parent, f"method.options.{name}", problems)
        for name, value in raw_options.items()
    }
    problems.raise_if_any()
    return options


def _steps_of_linear_plant(
    plant: DescriptorSystem, noisy: Transformation | None, transform: tuple[TransformSection | None, Path, str]
) -> Transformation | None:
    """Return the addition of noise states and the transformations of the spec as one; ``None`` where there is none."""
    before = plant if noisy is None else noisy.plant
    if transform[0] is None and not before.delays:
        return noisy
    with one_thread_if_small(before.nx):
        later = _transformed(transform[0], before, *transform[1:])
    if later is None or noisy is None:
        return noisy if later is None else later
    return noisy.then(later)


def _plant_section(section: Any, source: Path, changes: Mapping[str, Any]) -> tuple[Any, Path, str, Any]:
    """Return the section of a plant, its file, its path in the file, and the plant if another tool's file holds it."""
    imported = imported_plant(section, source) if hasattr(section, "file") else None
    if imported is not None or not hasattr(section, "file"):
        return section, source, "plant", imported
    place = source.parent / section.file
    placed(lambda: input_file(place), source, "plant.file")
    return checked_plant(changed_document(read_yaml(place, where="plant.file"), changes), place), place, "", None


def _checked_inputs(section: Any, plant: object, source: Path) -> dict[str, Any] | None:
    """Return the section ``inputs`` as plain data, checked; ``None`` where the spec has none."""
    inputs: dict[str, Any] | None = None if section is None else section.model_dump()
    if inputs is not None and inputs["hold"] and isinstance(plant, DescriptorSystem) and not plant.is_discrete:
        raise SpecError(
            f"{source}: inputs.hold is for plants on samples, and a continuous design takes inputs as straight lines "
            "between rows: sample the plant (transform: sample_time).",
            path="inputs.hold",
        )
    return inputs


def _placed_noise(plant: Any, noise: Mapping[str, Any], source: Path, prefix: str, **more: Any) -> Any:
    """Return the result of `with_noise` for a plant; an error gets its place in the document."""
    from obsynth.plants.transformations.noise_states import with_noise

    try:
        return with_noise(plant, **noise, **more)
    except SpecError as error:
        raise SpecError(f"{source}: {error.args[0]}", path=joined(prefix, error.path or "")) from error


def _noisy_model(
    model: DAEModel,
    section: DAESection,
    noise: Mapping[str, Any],
    method: str,
    options: Mapping[str, Any],
    source: Path,
    prefix: str,
) -> tuple[DAEModel, dict[str, Any]]:
    """Return a nonlinear plant with states for its noise, and the method's options with the resulting variances."""
    steps = {"integration": options["integration"]} if options.get("integration") == "radau" else {}
    arguments = {"process_noise": section.process_noise, "dt": options.get("dt"), **steps}
    made, more = _placed_noise(model, noise, source, prefix, **arguments)
    return made, _with_options(options, more, method)


def _with_options(options: Mapping[str, Any], more: Mapping[str, Any], method: str) -> dict[str, Any]:
    """Return options with defaults ``more`` for those that the method has; mappings by name are merged."""
    known = {field.name for field in fields(method_class(method))} if method in REGISTRY else set()
    merged = dict(options)
    for name, value in more.items():
        if name not in known:
            continue
        if name not in merged:
            merged[name] = value
        elif isinstance(value, dict) and isinstance(merged[name], dict):
            merged[name] = {**value, **merged[name]}
    return merged


def _linearised(
    transform: TransformSection | None,
    model: DAEModel,
    section: DAESection,
    folder: Path,
    noise: Mapping[str, Any],
    source: Path,
    prefix: str,
) -> DescriptorSystem | None:
    """Return the linear model of a nonlinear plant if the spec requests one; ``folder``: the folder of its file."""
    constants, box = boxed_constants(section, folder)
    tolerances = {name: item for name, item in constants.items() if not isinstance(item, (int, float))}
    if transform is None:
        if tolerances or section.variation is not None or section.box is not None:
            raise SpecError(
                f"{source}: {joined(prefix, 'constants')}: tolerances are for the linear model of a nonlinear plant: "
                "add transform: {linearise: {at: equilibrium}}, or write numbers.",
                path=joined(prefix, "constants"),
            )
        return None
    where = joined(prefix, "transform")
    if transform.linearise is None:
        raise SpecError(
            f"{source}: {where} is for linear plants: say where this one is linearised, such as linearise: {{at: "
            "equilibrium}, or remove it.",
            path=where,
        )
    from obsynth.plants.transformations.entries_in_constants import box_of_model
    from obsynth.plants.transformations.linearisation import linearise

    arguments = transform.linearise.model_dump(exclude_none=True)
    if noise:
        model, more = _placed_noise(model, noise, source, prefix, process_noise=section.process_noise)
    else:
        white = {name: item for name, item in (section.sensor_noise or {}).items() if isinstance(item, (int, float))}
        more = {"sensor_noise": white or None, "process_noise": section.process_noise}
    arguments["given"] = more.pop("given", {}) | arguments.get("given", {})
    arguments |= more
    tolerances |= arguments.pop("constants", {})
    if not tolerances and (box or section.variation is not None):
        raise SpecError(
            f"{source}: {joined(prefix, 'variation')} and box are for constants with tolerances: give some.",
            path=joined(prefix, "constants"),
        )
    try:
        if tolerances:
            point = arguments.get("given", {})
            arguments["constants"] = box_of_model(model, tolerances, point, variation=section.variation, **box)
        linear: DescriptorSystem = linearise(model, **arguments)
        return linear
    except SpecError as error:
        raise SpecError(f"{source}: {where}.linearise: {error}", path=f"{where}.linearise") from error


def _transformed(
    transform: TransformSection | None, plant: DescriptorSystem, source: Path, prefix: str
) -> Transformation | None:
    """Return the requested elimination of algebraic states, sampling, or both; ``None`` where neither is requested."""
    late = plant.is_discrete and bool(plant.delays)
    if transform is None or not (
        transform.eliminate_algebraic_states or transform.sample_time is not None or transform.pade
    ):
        return absorb_delays(plant) if late else None
    where = joined(prefix, "transform")
    if transform.sample_time is not None and plant.is_discrete:
        raise SpecError(
            f"{source}: {where}.sample_time is given, but the plant is discrete in time already "
            f"(dt = {plant.dt:g} s): remove it, or set dt to 0.",
            path=f"{where}.sample_time",
        )

    if transform.pade and (transform.sample_time is not None or not plant.delays):
        why = "the delays of a plant on samples are exact" if plant.delays else "the plant has no delays"
        raise SpecError(f"{source}: {where}.pade is given, but {why}: remove it.", path=f"{where}.pade")
    try:
        if late:
            return absorb_delays(plant, transform.pade)
        if transform.pade:
            made = absorb_delays(plant, transform.pade)
            return eliminate_algebraic_states(made) if transform.eliminate_algebraic_states else made
        if transform.sample_time is None:
            return eliminate_algebraic_states(plant)
        if not transform.eliminate_algebraic_states:
            return discretise(plant, transform.sample_time)
        return discretise(eliminate_algebraic_states(plant), transform.sample_time)
    except SpecError as error:
        raise SpecError(f"{source}: {where}: {error}", path=where) from error


def changed_document(document: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return a document with values at dotted paths replaced; missing mappings on the way are created."""
    changed = dict(document)
    for path, value in changes.items():
        first, _, below = path.partition(".")
        if not below:
            changed[first] = value
            continue
        inner = changed.get(first)
        if inner is not None and not isinstance(inner, Mapping):
            raise SpecError(f"{path} cannot be set: {first} is no section with entries of its own.", path=path)
        changed[first] = changed_document(inner or {}, {below: value})
    return changed
