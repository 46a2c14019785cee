"""Numbers that decide something have a name beside their algorithm; those of ranks and signs stand in one module."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import obsynth
from obsynth.numerics import ranks

SOURCE = Path(obsynth.__file__).parent
#: What draws: sizes and shades are no tolerances.
DRAWING = frozenset({"alpha", "color", "figsize", "height_ratios", "linewidth", "markersize", "width_ratios"})
#: A number of this size or less, or of that size or more, is a tolerance; the quantiles are of the normal distribution.
SMALL, LARGE, QUANTILES = 0.05, 1e5, (1.28, 1.645, 1.96, 2.33, 2.576)


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
    drawn = {
        inner
        for node in ast.walk(tree)
        if isinstance(node, ast.keyword) and node.arg in DRAWING
        for inner in ast.walk(node)
    }
    for function in ast.walk(tree):
        if isinstance(function, (ast.FunctionDef, ast.Lambda)):
            body = function.body if isinstance(function, ast.FunctionDef) else [function.body]
            for node in (inner for statement in body for inner in ast.walk(statement)):
                if is_tolerance(node) and node not in drawn:
                    yield node.lineno, ast.unparse(node)


def test_no_tolerance_is_typed_in_place() -> None:
    files = [path for path in sorted(SOURCE.rglob("*.py")) if "plotting" not in path.parts]
    found = {f"{path.relative_to(SOURCE)}:{line}": text for path in files
             for line, text in in_place(ast.parse(path.read_text()))}  # fmt: skip
    assert found == {}


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
        values = {
            name.id
            for node in ast.walk(function)
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.Call)
            and ast.unparse(node.value.func).rpartition(".")[2] in SPECTRA
            for target in node.targets
            for name in ast.walk(target)
            if isinstance(name, ast.Name)
        }  # fmt: skip
        for node in (node for node in ast.walk(function) if isinstance(node, ast.Compare)):
            names = {name.id for name in ast.walk(node) if isinstance(name, ast.Name)}
            if isinstance(node.left, ast.Name) and node.left.id in values and names & own:
                yield node.lineno, ast.unparse(node)


#: What the values on which a rank or a sign is decided come from.
SPECTRA = ("svd", "svdvals", "eigh", "eigvalsh")


def test_rank_and_sign_decisions_take_their_tolerance_from_one_module() -> None:
    found = {f"{path.relative_to(SOURCE)}:{line}": text for path in sorted(SOURCE.rglob("*.py"))
             if path != Path(ranks.__file__) for line, text in decisions(ast.parse(path.read_text()))}  # fmt: skip
    assert found == {}


def test_a_rank_decided_by_a_tolerance_of_the_module_is_found() -> None:
    text = (
        "LEAST = 1e-9\ndef f(a):\n    values = np.linalg.svd(a)[1]\n    _, v, _ = svd(a)\n    return v > LEAST * v[0]\n"
    )
    assert list(decisions(ast.parse(text)))
    assert not list(decisions(ast.parse(text.replace("LEAST = 1e-9", "from obsynth.numerics.ranks import LEAST"))))


def test_names_of_ranks_are_not_made_again() -> None:
    theirs = {name for name in vars(ranks) if name.isupper()}
    made = {path.name: theirs & own_constants(ast.parse(path.read_text())) for path in sorted(SOURCE.rglob("*.py"))
            if path != Path(ranks.__file__)}  # fmt: skip
    assert {name: names for name, names in made.items() if names} == {}
