"""Alternative names of arguments and keys, as in books, Simulink and other libraries, for suggestions in errors."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import ParamSpec, TypeVar

from obsynth.numerics.suggestions import keywords_suggested, suggestion

Given = ParamSpec("Given")

Returned = TypeVar("Returned")

#: Attributes of a linear plant that other libraries call otherwise.
_ATTRIBUTES = ("dt", "Bf", "Bd", "Bw", "state_names", "output_names", "input_names", "fault_names")

#: What is meant by each of these names.
OTHER_NAMES = {
    **dict.fromkeys(("Ts", "ts", "T", "h", "sample_time", "sampling_time", "time_step", "step", "period"), "dt"),
    **dict.fromkeys(("F", "Ba", "E_f", "Ef"), "Bf"),
    **dict.fromkeys(("Bv", "Ed", "E_d"), "Bd"),
    **dict.fromkeys(("G", "Gamma"), "Bw"),
    **dict.fromkeys(("states", "x"), "state_names"),
    **dict.fromkeys(("outputs", "sensors", "y"), "output_names"),
    **dict.fromkeys(("inputs", "u"), "input_names"),
    **dict.fromkeys(("faults", "f"), "fault_names"),
    "type": "kind",
    **dict.fromkeys(("begin", "onset", "from"), "start"),
    **dict.fromkeys(("stop", "until"), "end"),
    **dict.fromkeys(("magnitude", "value"), "size"),
}


#: What to write instead of an attribute that a linear plant does not have.
ELSEWHERE = {
    **{other: f"plant.{name}" for other, name in OTHER_NAMES.items() if name in _ATTRIBUTES and other != "step"},
    **dict.fromkeys(
        ("poles", "eigenvalues", "is_stable", "stable", "index", "observable", "is_observable", "detectable"),
        "obsynth.analyse_structure(plant)",
    ),
    **dict.fromkeys(
        ("sample", "discretise", "discretize", "to_discrete", "c2d"), "obsynth.discretise(plant, sample_time)"
    ),
    "simulate": "obsynth.simulate(plant, scenario)",
    "design": "obsynth.design(plant)",
    "check": "obsynth.check(plant)",
    "diagnose": "obsynth.diagnose(plant)",
    **dict.fromkeys(("add_fault", "add_faults", "with_faults"), "plant.replace(Bf=...)"),
}


def name_meant(name: str, known: Iterable[str], present: Iterable[str] = ()) -> str:
    """Return a question with the name that is meant, after a blank: another name of the same, or one that is written
    alike; ``present`` are there already.  Empty where none is close."""
    names, other = list(known), OTHER_NAMES.get(name)
    if other in names and other not in present:
        return f" Did you mean {other!r}?"
    return suggestion(name, names)


def plant_keywords_suggested(function: Callable[Given, Returned]) -> Callable[Given, Returned]:
    """Return a constructor of a plant that suggests names for keyword arguments which it does not have."""
    return keywords_suggested(function, name_meant)
