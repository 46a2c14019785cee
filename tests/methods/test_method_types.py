"""Editors and type checkers see the options of each public function: ``functions.pyi`` is written from the classes.

``python tests/methods/test_method_types.py`` writes it again.
"""

from __future__ import annotations

import types
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import obsynth.methods
from obsynth.methods import functions
from obsynth.methods.method import Method
from obsynth.methods.registry import REGISTRY, method_class
from obsynth.numerics.arguments import field_types

STUB = Path(obsynth.methods.__file__).parent / "functions.pyi"
HEAD = """\
# Written by tests/methods/test_method_types.py from the classes of the methods.
from collections.abc import Callable
from typing import Any, Literal, TypeVar

from obsynth.methods.method import Method
from obsynth.methods.registry import Plant
from obsynth.plants.transformations.recovery import Transformation
from obsynth.results.design import ObserverDesign

Made = TypeVar("Made", bound=ObserverDesign)

def design_function(
    method: type[Method], result: type[Made] = ..., *, positional: tuple[str, ...] = ...
) -> Callable[..., Made]: ...
"""


def written(kind: Any) -> str:
    """Return a type as it is written, without its range."""
    if get_origin(kind) is Annotated:
        return written(get_args(kind)[0])
    if get_origin(kind) is Literal:
        return f"Literal[{', '.join(map(repr, get_args(kind)))}]".replace("'", '"')
    if get_origin(kind) in (Union, types.UnionType):
        return " | ".join(written(part) for part in get_args(kind))
    if kind is type(None):
        return "None"
    return getattr(kind, "__name__", "Any") if kind in (int, float, str, bool) else "Any"


def function(method: type[Method]) -> str:
    """Return the declaration of a method's public function."""
    options = [f"    {name}: {written(kind)} = ...," for name, kind in field_types(method).items()]
    name = method.id.replace("-", "_")
    lines = [f"def {name}(", "    plant: Plant | Transformation,", "    *,", *options, "    name: str = ...,"]
    return "\n".join([*lines, ") -> ObserverDesign: ...", ""])


def text() -> str:
    """Return the whole stub."""
    made = [method for method in REGISTRY if hasattr(functions, method.replace("-", "_"))]
    body = "".join(function(method_class(method)) for method in made)
    return HEAD + body


def test_the_types_are_those_of_the_classes() -> None:
    assert STUB.read_text(encoding="utf-8") == text()


if __name__ == "__main__":
    STUB.write_text(text(), encoding="utf-8")
