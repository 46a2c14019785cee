"""What a result says in numbers it says in Python's own: ``is True`` holds, and JSON and exit codes take them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import pytest
from test_every_method import CONTINUOUS, DISCRETE, EACH, NOISY, design_of, log_of, plant_of, registered
from uncertain_plants import drive

import obsynth

__all__ = ["registered"]


def numpy_scalars(value: Any, place: str, seen: dict[int, Any]) -> Iterator[str]:
    """Yield where a result holds a scalar of NumPy: its fields and properties, and the keys and values of mappings."""
    if isinstance(value, np.generic):
        yield f"{place}: {type(value).__name__}"
    if isinstance(value, (str, bytes, int, float, complex, np.ndarray, np.generic)) or id(value) in seen:
        return
    seen[id(value)] = value
    parts: Iterator[tuple[str, Any]] = iter(())
    if isinstance(value, Mapping):
        parts = ((f"{place}[{key!r}]", part) for key, own in value.items() for part in (key, own))
    elif isinstance(value, (list, tuple, set, frozenset)):
        parts = ((f"{place}[{number}]", part) for number, part in enumerate(value))
    elif type(value).__module__.partition(".")[0] == "obsynth" and not isinstance(value, type):
        parts = ((f"{place}.{name}", getattr(value, name)) for name in _public_names(value))
    for name, part in parts:
        yield from numpy_scalars(part, name, seen)


#: Properties that only some designs have, or that warn that they have another name now.
NOT_ASKED = {"linear", "recursive", "nonlinear", "over_region", "scheduled", "leak"}


def _public_names(value: Any) -> Iterator[str]:
    names = {field.name for field in fields(value)} if is_dataclass(value) else set(getattr(value, "__dict__", ()))
    for kind in type(value).__mro__:
        names |= {name for name, part in vars(kind).items() if type(part).__name__ in ("property", "cached_property")}
    return (name for name in sorted(names - NOT_ASKED) if not name.startswith("_"))


def found_in(**results: Any) -> list[str]:
    return [place for name, result in results.items() for place in numpy_scalars(result, name, {})]


@pytest.mark.one_in(4)
@EACH
def test_designs_hold_plain_numbers(method: str) -> None:
    plant, design = plant_of(method), design_of(method)
    table = obsynth.run_on_data(design, log_of(design))
    assert found_in(design=design, report=obsynth.verify(design), check=obsynth.check(plant), run=table) == []


@pytest.mark.parametrize("plant", [DISCRETE, CONTINUOUS, NOISY])
def test_what_is_said_of_a_plant_are_plain_numbers(plant: obsynth.DescriptorSystem) -> None:
    asked: dict[str, Callable[[Any], Any]] = {
        "structure": obsynth.analyse_structure,
        "diagnosis": obsynth.diagnose,
        "sets": obsynth.sensor_sets,
    }
    assert found_in(**{name: ask(plant) for name, ask in asked.items()}) == []


@pytest.mark.long
def test_a_comparison_holds_plain_numbers() -> None:
    assert found_in(comparison=obsynth.compare(DISCRETE)) == []


@pytest.mark.long
def test_tolerances_and_runs_hold_plain_numbers() -> None:
    design = obsynth.fault_estimation_filter(drive())
    scenario = obsynth.Scenario(horizon=3.0, faults={"motor": obsynth.Step(size=1.0, start=1.0)}, noise=1.0)
    asked = {
        "robustness": obsynth.robustness(design),
        "study": obsynth.tolerance_study(design, scenario, runs=2, noise_bound=3.0),
        "evaluation": obsynth.evaluate(design, scenario, runs=3),
        "simulation": obsynth.simulate(design, scenario),
    }
    assert found_in(**asked) == []
