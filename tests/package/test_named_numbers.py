"""Numbers that decide something have a name beside their algorithm; those of ranks and signs stand in one module."""

from __future__ import annotations

import ast
import gc
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import obsynth
from obsynth.numerics import ranks

SOURCE = Path(obsynth.__file__).parent
#: What draws: sizes and shades are no tolerances.
DRAWING = frozenset({"alpha", "color", "figsize", "height_ratios", "linewidth", "markersize", "width_ratios"})
#: A number of this size or less, or of that size or more, is a tolerance; the quantiles are of the normal distribution.
SMALL, LARGE, QUANTILES = 0.05, 1e5, (1.28, 1.645, 1.96, 2.33, 2.576)


@pytest.fixture(scope="module")
def modules() -> Iterator[dict[Path, ast.Module]]:
    """The trees of all modules; no rubbish is looked for among their nodes, which takes longer than the tests."""
    gc.disable()
    yield {path: ast.parse(path.read_text()) for path in sorted(SOURCE.rglob("*.py"))}
    gc.enable()


def found_in(
    modules: dict[Path, ast.Module],
    look: Callable[[ast.Module], Iterator[tuple[int, str]]],
    left_out: Callable[[Path], bool],
) -> dict[str, str]:
    """Return what is found in the modules that are not left out, by file and line."""
    return {f"{path.relative_to(SOURCE)}:{line}": text for path, tree in modules.items() if not left_out(path)
            for line, text in look(tree)}  # fmt: skip


def is_tolerance(node: ast.AST) -> bool:
    """Return whether a node is a number that looks like a tolerance, or a power that makes one."""
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Pow):
        right = node.right
        return isinstance(node.left, ast.Constant) and isinstance(right, ast.UnaryOp) and (
            isinstance(right.operand, ast.Constant)
        )  # fmt: skip
    if not isinstance(node, ast.Constant) or not isinstance(node.value, float):
        return False
    size = abs(node.value)
    return 0.0 < size <= SMALL or size >= LARGE or size in QUANTILES


def in_place(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield line and text of tolerances that are typed in the body of a function."""
    every = list(ast.walk(tree))
    numbers = {node for node in every if isinstance(node, (ast.BinOp, ast.Constant)) and is_tolerance(node)}
    if not numbers:
        return
    for node in every:
        if isinstance(node, ast.keyword) and node.arg in DRAWING:
            numbers.difference_update(ast.walk(node))
    for function in every:
        if isinstance(function, (ast.FunctionDef, ast.Lambda)):
            body = function.body if isinstance(function, ast.FunctionDef) else [function.body]
            for node in (inner for statement in body for inner in ast.walk(statement)):
                if node in numbers:
                    yield node.lineno, ast.unparse(node)


def test_no_tolerance_is_typed_in_place(modules: dict[Path, ast.Module]) -> None:
    assert found_in(modules, in_place, lambda path: "plots" in path.parts) == {}


@pytest.mark.parametrize(
    "text", ["if gap < 1e-9: pass", "return max(x, 1e-300)", "rank(a, tol=1e-6)", "x > 2.0**-40 * y", "s = 1.96 * d"]
)
def test_a_tolerance_typed_in_place_is_found(text: str) -> None:
    assert list(in_place(ast.parse(f"def f():\n    {text}\n")))
    assert list(in_place(ast.parse(f"class A:\n    def f(self):\n        {text}\n")))


def own_constants(tree: ast.Module) -> set[str]:
    """Return the constants that a module makes itself."""
    targets = (target for node in tree.body if isinstance(node, ast.Assign) for target in node.targets)
    return {node.id for target in targets for node in ast.walk(target) if isinstance(node, ast.Name)}


def decisions(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield where singular values, or eigenvalues of a symmetric matrix, are held against a constant of the module."""
    own = own_constants(tree)
    for function in (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)):
        inside = list(ast.walk(function))
        values = {
            name.id
            for node in inside
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.Call)
            and ast.unparse(node.value.func).rpartition(".")[2] in SPECTRA
            for target in node.targets
            for name in ast.walk(target)
            if isinstance(name, ast.Name)
        }  # fmt: skip
        for node in (node for node in inside if values and isinstance(node, ast.Compare)):
            names = {name.id for name in ast.walk(node) if isinstance(name, ast.Name)}
            if isinstance(node.left, ast.Name) and node.left.id in values and names & own:
                yield node.lineno, ast.unparse(node)


#: What the values on which a rank or a sign is decided come from.
SPECTRA = ("svd", "svdvals", "eigh", "eigvalsh")


def test_rank_and_sign_decisions_take_their_tolerance_from_one_module(modules: dict[Path, ast.Module]) -> None:
    assert found_in(modules, decisions, lambda path: path == Path(ranks.__file__)) == {}


def test_a_rank_decided_by_a_tolerance_of_the_module_is_found() -> None:
    text = (
        "LEAST = 1e-9\ndef f(a):\n    values = np.linalg.svd(a)[1]\n    _, v, _ = svd(a)\n    return v > LEAST * v[0]\n"
    )
    assert list(decisions(ast.parse(text)))
    assert not list(decisions(ast.parse(text.replace("LEAST = 1e-9", "from obsynth.numerics.ranks import LEAST"))))


def test_names_of_ranks_are_not_made_again(modules: dict[Path, ast.Module]) -> None:
    theirs = {name for name in vars(ranks) if name.isupper()}
    made = {path: theirs & own_constants(tree) for path, tree in modules.items()
            if path != Path(ranks.__file__)}  # fmt: skip
    assert {name: names for name, names in made.items() if names} == {}
