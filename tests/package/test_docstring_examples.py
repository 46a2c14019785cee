"""The examples in the docstrings of everything public: each function has one, most results have one, and each prints
what it says."""

from __future__ import annotations

import doctest
import inspect
from pathlib import Path

import pytest

import obsynth
import obsynth.types

ROOT = Path(__file__).parents[2]
PUBLIC = {f"obsynth.{name}": getattr(obsynth, name) for name in obsynth.__all__}
PUBLIC |= {f"obsynth.conditions.{name}": getattr(obsynth.conditions, name) for name in obsynth.conditions.__all__}
PUBLIC |= {f"obsynth.plotting.{name}": getattr(obsynth.plotting, name) for name in obsynth.plotting.__all__}
PUBLIC |= {f"obsynth.types.{name}": getattr(obsynth.types, name) for name in obsynth.types.__all__}
FUNCTIONS = {name: item for name, item in PUBLIC.items() if inspect.isfunction(item)}


def examples_of(item: object, name: str) -> list[doctest.DocTest]:
    """Return the examples of something public, and of the methods of a class."""
    names = dict(vars(inspect.getmodule(inspect.unwrap(item)) or obsynth))  # type: ignore[arg-type]
    parts = doctest.DocTestFinder().find(item, name, globs=names, module=False)  # type: ignore[arg-type]
    return [part for part in parts if part.examples]


WITH_EXAMPLES = {name: item for name, item in PUBLIC.items() if examples_of(item, name)}


def test_every_public_function_has_an_example() -> None:
    assert sorted(set(FUNCTIONS) - set(WITH_EXAMPLES)) == []


def test_every_result_has_an_example() -> None:
    assert set(obsynth.types.__all__) - {name.removeprefix("obsynth.types.") for name in WITH_EXAMPLES} == set()


@pytest.mark.parametrize("name", sorted(WITH_EXAMPLES))
def test_the_example_prints_what_it_says(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    import matplotlib as mpl
    import matplotlib.pyplot as plt

    # Where paths of examples begin: a clone.
    monkeypatch.chdir(ROOT)
    with mpl.rc_context({"backend": "Agg"}):
        told: list[str] = []
        runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE)
        for example in examples_of(WITH_EXAMPLES[name], name):
            runner.run(example, out=told.append)
        plt.close("all")
    assert "".join(told) == ""
