"""Notebooks: the ``.py`` is the source, the ``.ipynb`` is its run; both stay together, and run from scratch.

After a change of a source: ``cd notebooks && python -m jupytext --to ipynb --execute NAME.py``.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import jupytext
import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).parents[2]
SOURCES = sorted((ROOT / "notebooks").glob("*.py"))
EACH = pytest.mark.parametrize("source", SOURCES, ids=[path.stem for path in SOURCES])


def cells_of(notebook: Any) -> list[tuple[str, str]]:
    return [(cell.cell_type, cell.source.strip()) for cell in notebook.cells]


def problems_in_outputs(notebook: Any) -> list[str]:
    """Return what a clean run must not leave: errors, warnings on stderr, cells that were not run in order."""
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    problems = [
        f"cell {i} has count {cell.execution_count}" for i, cell in enumerate(code, 1) if cell.execution_count != i
    ]
    for cell in code:
        for output in cell.outputs:
            if output.output_type == "error":
                problems.append(f"{output.ename}: {output.evalue}")
            elif output.output_type == "stream" and output.name == "stderr":
                problems.append(output.text)
    return problems


def test_there_are_notebooks_and_no_orphans() -> None:
    runs = sorted(path.stem for path in (ROOT / "notebooks").glob("*.ipynb"))
    assert runs == [path.stem for path in SOURCES]
    assert runs


@EACH
def test_the_run_belongs_to_the_source(source: Path) -> None:
    run = nbformat.read(source.with_suffix(".ipynb"), as_version=4)
    assert cells_of(run) == cells_of(jupytext.read(source))
    assert problems_in_outputs(run) == []


@EACH
def test_it_runs_from_scratch(source: Path, tmp_path: Path) -> None:
    """In a copy of the two folders it may use, so that nothing else is needed and nothing is written here."""
    shutil.copytree(ROOT / "designs", tmp_path / "designs")
    folder = tmp_path / "notebooks"
    folder.mkdir()
    notebook = jupytext.read(source)
    resources = {"metadata": {"path": str(folder)}}
    done = NotebookClient(notebook, timeout=300, kernel_name="python3", resources=resources).execute()
    assert problems_in_outputs(done) == []
    kinds = {output.output_type for cell in done.cells for output in cell.get("outputs", [])}
    assert {"stream", "display_data"} <= kinds


def test_a_broken_run_is_seen() -> None:
    cell = nbformat.v4.new_code_cell("1 / 0")
    cell.execution_count = 1
    cell.outputs = [nbformat.v4.new_output("error", ename="ZeroDivisionError", evalue="division by zero", traceback=[])]
    warned = nbformat.v4.new_code_cell("...")
    warned.execution_count = 3
    warned.outputs = [nbformat.v4.new_output("stream", name="stderr", text="careful")]
    notebook = nbformat.v4.new_notebook(cells=[cell, warned])
    assert problems_in_outputs(notebook) == ["cell 2 has count 3", "ZeroDivisionError: division by zero", "careful"]
