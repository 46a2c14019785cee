"""The arrows between modules: none in a circle, none that runs up, whether written as an import or as a text."""

from __future__ import annotations

import ast
import gc
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from graphlib import CycleError, TopologicalSorter
from importlib import import_module
from pathlib import Path

import pytest

import obsynth

SOURCE = Path(obsynth.__file__).parent
ROOT, COMMANDS = "obsynth", "obsynth.cli"


@pytest.fixture(autouse=True, scope="module")
def no_rubbish() -> Iterator[None]:
    """No rubbish is looked for among the nodes of the sources, which takes as long as reading them."""
    gc.disable()
    yield
    gc.enable()


def module_name(path: Path) -> str:
    """Return the name of the module in a file."""
    return ".".join((ROOT, *path.relative_to(SOURCE).with_suffix("").parts)).removesuffix(".__init__")


FILES = {module_name(path): path for path in sorted(SOURCE.rglob("*.py"))}


@cache
def nodes_of(name: str) -> tuple[ast.AST, ...]:
    """Return the imports and texts of a module of ours, which is read once."""
    return arrows(FILES[name].read_text())


def arrows(text: str) -> tuple[ast.AST, ...]:
    kinds = ast.Import | ast.ImportFrom | ast.Constant
    return tuple(node for node in ast.walk(ast.parse(text)) if isinstance(node, kinds))


def imports(nodes: Iterable[ast.AST], modules: Mapping[str, object]) -> Iterator[str]:
    """Yield the modules that a module imports: at once, late, or for types only."""
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == ROOT:
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                yield inner if inner in modules else str(node.module)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in modules)


def circle(graph: Mapping[str, set[str]]) -> list[str]:
    """Return modules that import each other in a circle; empty where there is none."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def levels() -> list[tuple[str, ...]]:
    """Return the packages of each level as the contract says, the uppermost first."""
    tool = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["tool"]["importlinter"]
    (layers,) = (contract["layers"] for contract in tool["contracts"] if contract["type"] == "layers")
    return [tuple(part.strip(" ()") for part in re.split("[|:]", layer)) for layer in layers]


def package_of(name: str) -> str:
    """Return the package directly below the root."""
    return ".".join(name.split(".")[:2])


def texts_that_name_modules(nodes: Iterable[ast.AST], modules: Mapping[str, object]) -> Iterator[str]:
    """Yield the modules that texts name, such as ``"obsynth.cli.main:run"``."""
    for node in nodes:
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.startswith(f"{ROOT}."):
            found = node.value.partition(":")[0]
            if found in modules:
                yield found


HEIGHT = {name: level for level, names in enumerate(levels()) for name in names}


def runs_up(nodes: Iterable[ast.AST], package: str, modules: Mapping[str, object]) -> list[str]:
    """Return the modules of upper packages that a module names, for types only or as a text."""
    named = {*imports(nodes, modules), *texts_that_name_modules(nodes, modules)}
    if package == COMMANDS:
        # The command line calls what the package exports, as its other users do.
        named.discard(ROOT)
    return sorted(name for name in named if HEIGHT.get(package_of(name), -1) < HEIGHT[package])


def test_no_modules_import_each_other_in_a_circle() -> None:
    graph = {name: set(imports(nodes_of(name), FILES)) - {name} for name in FILES if name != ROOT}
    assert circle(graph) == []


def test_a_circle_is_found_also_through_imports_for_types() -> None:
    late = arrows("def f():\n    from obsynth.b import g\n")
    typed = arrows("if TYPE_CHECKING:\n    from obsynth.a import f\n")
    modules = {"obsynth.a": late, "obsynth.b": typed}
    assert circle({name: set(imports(nodes, modules)) for name, nodes in modules.items()})


def test_every_package_has_a_level() -> None:
    assert {package_of(name) for name in FILES} - {ROOT, f"{ROOT}.__main__"} <= set(HEIGHT)


def test_no_arrow_runs_up() -> None:
    inner = (name for name in FILES if name not in (ROOT, f"{ROOT}.__main__"))
    found = {name: runs_up(nodes_of(name), package_of(name), FILES) for name in inner}
    assert {name: up for name, up in found.items() if up} == {}


def test_nothing_that_the_package_exports_is_of_the_command_line() -> None:
    named = {*imports(nodes_of(ROOT), FILES), *texts_that_name_modules(nodes_of(ROOT), FILES)}
    homes = {*named, *obsynth._PUBLIC_HOMES.values(), *(f"{ROOT}.{name}" for name in obsynth._PUBLIC_PACKAGES)}
    assert COMMANDS not in {package_of(home) for home in homes}
    assert runs_up(arrows("import obsynth"), "obsynth.report", FILES) == [ROOT]


def test_an_arrow_in_a_text_is_found() -> None:
    nodes = arrows('WAY = "obsynth.report.summary:summary"')
    assert runs_up(nodes, "obsynth.results", FILES) == ["obsynth.report.summary"]


def test_types_are_told_of_every_public_name() -> None:
    for stub, public in (("__init__.pyi", obsynth), ("types.pyi", obsynth.types)):
        lines = [node for node in ast.parse((SOURCE / stub).read_text()).body if isinstance(node, ast.ImportFrom)]
        told = {alias.asname: (str(node.module), alias.name) for node in lines for alias in node.names
                if alias.name not in ("__version__", "conditions", "plotting", "types")}  # fmt: skip
        assert set(told) == set(public.__all__) - {"conditions"}
        for name, (module, there) in told.items():
            assert getattr(import_module(module), there) is getattr(public, name), name
