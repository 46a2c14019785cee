"""Notebooks: the ``.py`` is the source, the ``.ipynb`` is its run; both stay together, and run from scratch.

After a change of a source: ``cd notebooks && python -m jupytext --to ipynb --execute NAME.py``.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jupytext
import nbformat
import pytest
from jupyter_client.manager import KernelManager, start_new_kernel
from nbclient import NotebookClient

import obsynth

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


@pytest.fixture(scope="module")
def kernel() -> Iterator[KernelManager]:
    """One process for all notebooks: most of the time of a new one is the loading of libraries."""
    manager, client = start_new_kernel(kernel_name="python3")
    client.stop_channels()
    yield manager
    manager.shutdown_kernel(now=True)


def begin_anew(kernel: KernelManager, folder: Path) -> None:
    """Forget all names and counts, go to a folder, and draw each picture once: to cut its margins it is drawn twice."""
    client = kernel.client()
    client.start_channels()
    client.wait_for_ready(timeout=60)
    code = (
        "get_ipython().run_line_magic('config', 'InlineBackend.print_figure_kwargs = {\"bbox_inches\": None}');"
        f"__import__('os').chdir({str(folder)!r}); get_ipython().reset(new_session=True)"
    )
    done = client.execute_interactive(code, store_history=False, timeout=60)
    client.stop_channels()
    assert done["content"]["status"] == "ok"


def run_in(kernel: KernelManager, notebook: Any, folder: Path) -> Any:
    begin_anew(kernel, folder)
    client = NotebookClient(notebook, km=kernel, timeout=300)
    try:
        return client.execute()
    finally:
        client.kc.stop_channels()


@pytest.mark.long
def test_names_of_one_notebook_are_gone_in_the_next(kernel: KernelManager, tmp_path: Path) -> None:
    cells = ["import os; left = os.getcwd(); print(left)", "print('left' in globals(), 'os' in globals())"]
    first, second = (nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(cell)]) for cell in cells)
    assert run_in(kernel, first, tmp_path).cells[0].outputs[0].text == f"{tmp_path}\n"
    (cell,) = run_in(kernel, second, tmp_path).cells
    assert (cell.execution_count, cell.outputs[0].text) == (1, "False False\n")


@pytest.mark.one_in(9)
@EACH
def test_it_runs_from_scratch(source: Path, kernel: KernelManager, tmp_path: Path) -> None:
    """In a copy of the two folders it may use, so that nothing else is needed and nothing is written here."""
    shutil.copytree(ROOT / "designs", tmp_path / "designs")
    folder = tmp_path / "notebooks"
    folder.mkdir()
    notebook = jupytext.read(source)
    done = run_in(kernel, notebook, folder)
    assert problems_in_outputs(done) == []
    kinds = {output.output_type for cell in done.cells for output in cell.get("outputs", [])}
    assert {"stream", "display_data"} <= kinds


#: What a notebook may import of obsynth: all that is public comes with it.
PUBLIC = {"obsynth"}
OURS = re.compile(r"^\s*(?:import|from)\s+(obsynth[\w.]*)", re.MULTILINE)


@EACH
def test_nothing_private_is_imported(source: Path) -> None:
    text = source.read_text(encoding="utf-8")
    assert set(OURS.findall(text)) == PUBLIC
    reached = set(re.findall(r"\bobsynth\.(\w+)", text)) - set(dir(obsynth))
    assert not reached, f"not public: {sorted(reached)}"


def test_a_private_import_is_found() -> None:
    text = "import numpy\nfrom obsynth.methods.conic import lmi\n    import obsynth.specs\n"
    assert OURS.findall(text) == ["obsynth.methods.conic", "obsynth.specs"]


PAPERS = [source for source in SOURCES if source.stem[:2] in ("01", "02", "03", "04", "05")]


@pytest.mark.parametrize("source", PAPERS, ids=[path.stem for path in PAPERS])
def test_the_first_notebooks_begin_with_the_paper_s_problem(source: Path) -> None:
    """Within the first cells: conditions, two solvers; later a design, and where it ends, with the reason."""
    cells = [cell.source for cell in jupytext.read(source).cells if cell.cell_type == "code"]
    first = "\n".join(cells[:4])
    assert "obsynth.conditions." in first
    assert "CLARABEL" in first
    assert "SCS" in first
    whole = "\n".join(cells)
    assert ".existence" in whole
    assert "docs/papers.md" in source.read_text(encoding="utf-8")


@pytest.mark.long
def test_a_broken_run_is_seen() -> None:
    cell = nbformat.v4.new_code_cell("1 / 0")
    cell.execution_count = 1
    cell.outputs = [nbformat.v4.new_output("error", ename="ZeroDivisionError", evalue="division by zero", traceback=[])]
    warned = nbformat.v4.new_code_cell("...")
    warned.execution_count = 3
    warned.outputs = [nbformat.v4.new_output("stream", name="stderr", text="careful")]
    notebook = nbformat.v4.new_notebook(cells=[cell, warned])
    assert problems_in_outputs(notebook) == ["cell 2 has count 3", "ZeroDivisionError: division by zero", "careful"]
