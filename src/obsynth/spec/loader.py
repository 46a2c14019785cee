"""From a spec file to a plant that a method can use."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from obsynth.errors import SpecError
from obsynth.plants.dae.model import DAEModel
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.spec.checking import DocumentProblems, checked_plant, checked_spec
from obsynth.spec.documents import read_yaml
from obsynth.spec.plants import built_plant, read_value, transformed
from obsynth.spec.scenarios import built_scenario

if TYPE_CHECKING:
    from obsynth.analysis.transformations import Transformation
    from obsynth.simulation.scenario import Scenario


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
        name: read_value(value, source.parent, f"method.options.{name}", problems)
        for name, value in raw_options.items()
    }
    problems.raise_if_any()
    plant, transformation = built_plant(section, plant_source, prefix), None
    if isinstance(plant, DescriptorSystem):
        if reference is not None and reference.transform is not None:
            # A plant may serve several methods: the spec's own transform takes the place of the plant's.
            transformation = transformed(reference.transform, plant, source, "plant")
        else:
            transformation = transformed(section.transform, plant, plant_source, prefix)
        plant = plant.dense() if transformation is None else transformation.plant
    elif reference is not None and reference.transform is not None:
        raise SpecError(
            f"{source}: plant.transform is for linear plants with constant matrices, which {plant_source.name} is not: "
            "remove it.", path="plant.transform",
        )  # fmt: skip
    return Spec(
        name=checked.name, description=checked.description or "", path=source, plant=plant,
        transformation=transformation, method=checked.method.id, options=options,
        scenario=built_scenario(checked.scenario, plant, source),
    )  # fmt: skip
