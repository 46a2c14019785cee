"""Directives that run what a page shows and put the real output below it; a build ends where one of them fails.

``{shown}`` runs commands, one a line, and ``{shown-python}`` code, both in a folder that a page has for itself, so that what
one writes the next one reads.  ``:files:`` copies files of the repository into that folder first, which a line
above the block says; ``{shown-file}`` writes one that stands on the page.  With ``:root:`` code runs in the folder of the repository, which it only reads.
"""

from __future__ import annotations

import contextlib
import io
import os
import runpy
import shlex
import shutil
import tempfile
import time
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

from docutils import nodes
from docutils.parsers.rst import directives
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError
from sphinx.util import logging
from sphinx.util.docutils import SphinxDirective

LOGGER = logging.getLogger(__name__)
#: Width of the texts that are shown, in characters: a page on a desk has room for them, a phone breaks them.
WIDTH = 96
#: Seconds above which a block is named in the log of the build: pages are made at every build.
SLOW = 5.0

#: What is removed at the end, the folder of each page in it, and the names of each page's code.
_ROOTS: list[Path] = []
_FOLDERS: dict[str, Path] = {}
_NAMES: dict[str, dict[str, Any]] = {}


class _Failed(Exception):
    """What was run did not end as the page says."""


class Shown(SphinxDirective):
    """Run commands and show their output below each of them."""

    has_content = True
    option_spec: ClassVar[dict[str, Any]] = {
        "files": directives.unchanged,
        "code": directives.nonnegative_int,
        "first": directives.positive_int,
        "last": directives.positive_int,
        "silent": directives.flag,
        "errors": directives.flag,
    }

    def run(self) -> list[nodes.Node]:
        """Return a block for each command and one for its output."""
        folder = _folder(self)
        found: list[nodes.Node] = _files_needed(self)
        waiting: list[str] = []
        began = time.monotonic()
        for line in "\n".join(self.content).replace("\\\n", " ").splitlines():
            if not line.strip() or line.startswith("#"):
                continue
            waiting.append(line)
            try:
                output = _command(line, folder, self.options.get("code", 0), errors="errors" in self.options)
            except _Failed as problem:
                raise self._refusal(line, str(problem)) from None
            if "silent" in self.options or not output.strip():
                continue
            found += [_block("\n".join(waiting), "sh"), _output(self._part(output))]
            waiting = []
        if waiting:
            found.append(_block("\n".join(waiting), "sh"))
        _tell(self, began)
        return found

    def _part(self, output: str) -> str:
        lines = output.rstrip().splitlines()
        if first := self.options.get("first"):
            lines = [*lines[:first], *(["..."] if len(lines) > first else [])]
        if last := self.options.get("last"):
            lines = [*(["..."] if len(lines) > last else []), *lines[-last:]]
        return "\n".join(lines)

    def _refusal(self, what: str, why: str) -> ExtensionError:
        return ExtensionError(f"{self.env.docname}, line {self.lineno}: {what}\n{why}")


class ShownPython(SphinxDirective):
    """Run code, with the names of the page's earlier code, and show what it prints."""

    has_content = True
    option_spec: ClassVar[dict[str, Any]] = {
        "files": directives.unchanged,
        "silent": directives.flag,
        "root": directives.flag,
    }

    def run(self) -> list[nodes.Node]:
        """Return the code and a block for what it has printed."""
        folder = Path(self.env.srcdir).parent if "root" in self.options else _folder(self)
        code = "\n".join(self.content)
        began = time.monotonic()
        output = io.StringIO()
        try:
            with _within(folder), contextlib.redirect_stdout(output):
                exec(compile(code, self.env.docname, "exec"), _NAMES.setdefault(self.env.docname, {}))
        except Exception:  # noqa: BLE001 - whatever ends a page's code ends the build
            text = f"{self.env.docname}, line {self.lineno}\n{traceback.format_exc()}"
            raise ExtensionError(text) from None
        _tell(self, began)
        shown = [*_files_needed(self), _block(code, "python")]
        if output.getvalue().strip() and "silent" not in self.options:
            shown.append(_output(output.getvalue().rstrip()))
        return shown


class ShownFile(SphinxDirective):
    """Write a file into the page's folder, and show it."""

    has_content = True
    required_arguments = 1
    option_spec: ClassVar[dict[str, Any]] = {"language": directives.unchanged}

    def run(self) -> list[nodes.Node]:
        """Return what is written as a block, with the name of the file above it."""
        text = "\n".join(self.content)
        (_folder(self) / self.arguments[0]).write_text(text + "\n", encoding="utf-8")
        block = _block(text, self.options.get("language", "yaml"))
        shown = nodes.container("", literal_block=True, classes=["literal-block-wrapper"])
        shown += nodes.caption(self.arguments[0], self.arguments[0])
        shown += block
        return [shown]


def _folder(directive: SphinxDirective) -> Path:
    """Return the folder of a page, with the files in it that the block asks for."""
    name = directive.env.docname
    if name not in _FOLDERS:
        _FOLDERS[name] = Path(tempfile.mkdtemp(dir=_ROOTS[0]))
    folder = _FOLDERS[name]
    for path in _files(directive):
        directive.env.note_dependency(str(path))
        shutil.copy(path, folder / path.name)
    return folder


def _files(directive: SphinxDirective) -> list[Path]:
    """Return the files that a block asks for."""
    source, found = Path(directive.env.srcdir), []
    for pattern in directive.options.get("files", "").split():
        files = [path for path in sorted(source.glob(pattern)) or sorted(source.parent.glob(pattern)) if path.is_file()]
        if not files:
            raise ExtensionError(f"{directive.env.docname}, line {directive.lineno}: there is no file {pattern}")
        found += files
    return found


def _files_needed(directive: SphinxDirective) -> list[nodes.Node]:
    """Return a line that says which files of the repository a reader needs in his folder; none without files."""
    if "root" in directive.options:
        text = "In the folder of the repository:"
        return [nodes.paragraph(text, text, classes=["shown-files"])]
    names: dict[str, list[str]] = {}
    for path in _files(directive):
        names.setdefault(str(path.parent.relative_to(Path(directive.env.srcdir).parent)), []).append(path.name)
    if not names:
        return []
    line = nodes.paragraph("", "", nodes.Text("With "), classes=["shown-files"])
    for i, (folder, files) in enumerate(names.items()):
        for j, name in enumerate(files):
            line += [nodes.Text(", " if i or j else ""), nodes.literal(name, name)]
        line += [nodes.Text(" from "), nodes.literal(folder, folder)]
    line += nodes.Text(" of the repository, copied into a folder of your own:")
    return [line]


@contextlib.contextmanager
def _within(folder: Path) -> Iterator[None]:
    """Work in a folder, with lines of `WIDTH` characters."""
    columns = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = str(WIDTH)
    try:
        with contextlib.chdir(folder):
            yield
    finally:
        os.environ.pop("COLUMNS")
        if columns is not None:
            os.environ["COLUMNS"] = columns


def _command(line: str, folder: Path, code: int, *, errors: bool) -> str:
    """Return what a command prints; `_Failed` if its exit code is another one.

    Commands of obsynth and scripts of Python run in this process: a new one would import everything again each time.
    """
    from obsynth.cli.main import design_command, main

    words = shlex.split(line, comments=True)
    output, problems = io.StringIO(), io.StringIO()
    with _within(folder), contextlib.redirect_stdout(output), contextlib.redirect_stderr(problems):
        try:
            if words[0] == "obsynth":
                ended = main(words[1:])
            elif words[0] == "design":
                ended = design_command(words[1:])
            elif words[0] == "python":
                runpy.run_path(words[1], run_name="__main__")
                ended = 0
            else:
                raise _Failed(f"{words[0]} is no command that a page may run")
        except SystemExit as left:
            ended = int(left.code or 0)
        except Exception:  # noqa: BLE001 - whatever ends a page's code ends the build
            raise _Failed(traceback.format_exc()) from None
    if ended != code:
        raise _Failed(f"exit code {ended} instead of {code}\n{output.getvalue()}{problems.getvalue()}")
    return output.getvalue() + (problems.getvalue() if errors else "")


def _block(text: str, language: str) -> nodes.Node:
    return nodes.literal_block(text, text, language=language, classes=["shown-input"])


def _output(text: str) -> nodes.Node:
    return nodes.literal_block(text, text, language="text", classes=["shown-output"])


def _tell(directive: SphinxDirective, began: float) -> None:
    if (seconds := time.monotonic() - began) > SLOW:
        LOGGER.info("%s, line %d: %.1f s", directive.env.docname, directive.lineno, seconds)


def _begin(_: Sphinx) -> None:
    """Make the folder of all pages before processes are forked, whose own are forgotten with them."""
    _ROOTS.append(Path(tempfile.mkdtemp(prefix="shown-")))


def _remove(_: Sphinx, __: Exception | None) -> None:
    while _ROOTS:
        shutil.rmtree(_ROOTS.pop(), ignore_errors=True)
    _FOLDERS.clear()
    _NAMES.clear()


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directives."""
    app.add_directive("shown", Shown)
    app.add_directive("shown-python", ShownPython)
    app.add_directive("shown-file", ShownFile)
    app.connect("builder-inited", _begin)
    app.connect("build-finished", _remove)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
