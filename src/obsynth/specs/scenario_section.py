"""Scenarios from the scenario section of a checked document."""

from __future__ import annotations

from dataclasses import MISSING, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from obsynth.errors import SpecError
from obsynth.plants.dae import DAEModel
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.simulation.profiles import Profile
from obsynth.simulation.scenario import PROFILE_KINDS, Scenario
from obsynth.simulation.signals import check_parameters
from obsynth.specs.documents import DocumentProblems

if TYPE_CHECKING:
    from obsynth.specs.schema import ScenarioSection

_SCENARIO_GROUPS = ("inputs", "faults", "disturbances", "sensors", "scheduling")


def built_scenario(
    section: ScenarioSection | None,
    plant: DescriptorSystem | TimeVaryingDescriptorSystem | PolytopicSystem | DAEModel,
    source: Path,
) -> Scenario | None:
    """Return the scenario of a spec; `None` if it has none."""
    if section is None:
        return None
    problems = DocumentProblems(source, what="spec")
    arguments: dict[str, Any] = {name: getattr(section, name) for name in section.model_fields_set}
    for group in _SCENARIO_GROUPS:
        arguments[group] = {
            name: [
                _profile(item, f"scenario.{group}.{name}", problems)
                for item in (value if isinstance(value, list) else [value])
            ]
            for name, value in getattr(section, group).items()
        }
    problems.raise_if_any()
    try:
        scenario = Scenario(**arguments)
        if isinstance(plant, (DescriptorSystem, PolytopicSystem)):
            scenario.check_names(plant)
            scenario.step_of(plant)
        else:
            check_parameters(plant, scenario)
    except SpecError as error:
        problems.add(f"scenario.{error.path}", str(error))
        problems.raise_if_any()
    return scenario


def _profile(section: Any, where: str, problems: DocumentProblems) -> Profile | None:
    """Return the profile; note what is wrong with it."""
    kind = PROFILE_KINDS[section.kind]
    arguments = {name: getattr(section, name) for name in section.model_fields_set - {"kind"}}
    known = {field.name: field.default is MISSING for field in fields(kind)}
    for name in sorted(arguments.keys() - known.keys()):
        problems.add(f"{where}.{name}", f"a {section.kind} has no {name}: it takes {', '.join(known)}.")
    missing = [name for name, needed in known.items() if needed and name not in arguments]
    for name in missing:
        problems.add(f"{where}.{name}", f"a {section.kind} needs this key.")
    if missing or arguments.keys() - known.keys():
        return None
    try:
        return kind(**arguments)
    except SpecError as error:
        problems.add(f"{where}.{error.path}", str(error))
        return None
