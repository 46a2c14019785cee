"""Every public name is documented: parameters, results, errors, shapes and sources."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import pkgutil
import re

import pytest

import obsynth

SECTION = re.compile(r"^(\w[\w ]*)\n-{3,}$", re.MULTILINE)

#: Modules that cannot be imported without an optional package.
OPTIONAL = {"obsynth.numerics.compiled_steps": "numba"}


def public_modules():
    found = [
        module.name
        for module in pkgutil.walk_packages(obsynth.__path__, "obsynth.")
        if not any(part.startswith("_") for part in module.name.split("."))
    ]
    there = [name for name in found if name not in OPTIONAL or importlib.util.find_spec(OPTIONAL[name]) is not None]
    return [importlib.import_module(name) for name in there]


def public_callables():
    """Yield name and object of every public function, class and method that is defined in the package."""
    for module in public_modules():
        for name, item in vars(module).items():
            if name.startswith("_") or getattr(item, "__module__", None) != module.__name__:
                continue
            if inspect.isfunction(item) or inspect.isclass(item):
                yield f"{module.__name__}.{name}", item
            if inspect.isclass(item):
                for method_name, method in vars(item).items():
                    plain = method.__func__ if isinstance(method, classmethod | staticmethod) else method
                    if not method_name.startswith("_") and inspect.isfunction(plain):
                        yield f"{module.__name__}.{name}.{method_name}", plain


def sections(item) -> dict[str, str]:
    text = inspect.getdoc(item) or ""
    marks = list(SECTION.finditer(text))
    ends = [*(mark.start() for mark in marks[1:]), len(text)][: len(marks)]
    return {mark.group(1): text[mark.end() : end] for mark, end in zip(marks, ends, strict=True)}


def documented_parameters(item) -> set[str]:
    names: set[str] = set()
    for heading in re.findall(r"^(\S[^\n:]*?)(?: :.*)?$", sections(item).get("Parameters", ""), re.MULTILINE):
        names |= {part.strip().lstrip("*") for part in heading.split(",")}
    return names


def public_names():
    every = [(name, getattr(home, name)) for home in (obsynth, obsynth.types) for name in home.__all__]
    return [(name, item) for name, item in every if not inspect.ismodule(item)]


def test_everything_public_has_a_docstring():
    missing = [name for name, item in public_callables() if not (inspect.getdoc(item) or "").strip()]
    assert not missing, f"no docstring: {missing}"


@pytest.mark.parametrize(("name", "item"), public_names(), ids=lambda value: value if isinstance(value, str) else "")
def test_doors_document_every_parameter(name, item):
    ignored = {"self", "cls", "args", "kwargs"}
    wanted = set(inspect.signature(item).parameters) - ignored
    assert wanted <= documented_parameters(item), (
        f"{name} does not document {sorted(wanted - documented_parameters(item))}"
    )


def public_methods():
    for class_name, item in public_names():
        if inspect.isclass(item):
            for name, method in vars(item).items():
                plain = method.__func__ if isinstance(method, classmethod | staticmethod) else method
                if not name.startswith("_") and inspect.isfunction(plain):
                    yield f"{class_name}.{name}", plain


@pytest.mark.parametrize(
    ("name", "item"), list(public_methods()), ids=lambda value: value if isinstance(value, str) else ""
)
def test_methods_of_doors_document_every_parameter(name, item):
    wanted = set(inspect.signature(item).parameters) - {"self", "cls"}
    assert wanted <= documented_parameters(item), (
        f"{name} does not document {sorted(wanted - documented_parameters(item))}"
    )


FUNCTIONS = [(name, item) for name, item in public_names() if inspect.isfunction(item)]


@pytest.mark.parametrize(("name", "item"), FUNCTIONS, ids=lambda value: value if isinstance(value, str) else "")
def test_functions_say_what_they_return_and_raise(name, item):
    found = sections(item)
    assert found.get("Returns", "").strip(), f"{name} does not say what it returns"
    raises = re.findall(r"^(\w+Error)$", found.get("Raises", ""), re.MULTILINE)
    assert raises or name == "analyse_structure", f"{name} does not say what it raises"
    assert all(hasattr(obsynth, error) for error in raises), f"{name} raises undocumented types: {raises}"


@pytest.mark.parametrize(
    "name",
    [
        "fault_estimation_filter",
        "pd_observer",
        "ui_pi_observer",
        "design_from_gains",
        "descriptor_kalman",
        "adaptive_observer",
    ],
)
def test_methods_give_shapes_units_and_source(name):
    text = inspect.getdoc(getattr(obsynth, name)) or ""
    assert re.search(r"\(nx, n[xyf]\)", text), "shapes are missing"
    assert re.search(r"dimensionless|seconds", text), "units are missing"
    assert "References" in sections(getattr(obsynth, name)), "the source is missing"


def test_all_names_resolve_and_are_listed():
    for name in obsynth.__all__:
        assert callable(getattr(obsynth, name)) or name == "conditions"
    assert set(obsynth.__all__) <= set(dir(obsynth))
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = obsynth.nonsense


def test_types_are_in_a_module_of_their_own_and_names_are_few():
    # Each method of obsynth has its function among them.
    assert len(obsynth.__all__) <= 105
    assert not set(obsynth.__all__) & set(obsynth.types.__all__)
    assert set(dir(obsynth.types)) == set(obsynth.types.__all__)
    assert not hasattr(obsynth, "Simulation")
    with pytest.raises(AttributeError, match=r"'obsynth\.types' has no attribute 'nonsense'"):
        _ = obsynth.types.nonsense
