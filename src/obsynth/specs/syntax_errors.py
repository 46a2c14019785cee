"""Messages about documents with invalid YAML: the place, the line, and a correction."""

from __future__ import annotations

import re
from collections.abc import Sequence

#: Of a long line so many characters are shown around the place of an error.
SHOWN_COLUMNS = 100

#: What the reader parses, in its words -> what is not closed, and what closes it.
_BRACKETS = {
    "while parsing a flow sequence": ("list", "]"),
    "while parsing a flow mapping": ("mapping", "}"),
}


def syntax_error(error: Exception, text: str) -> str:
    """Return the problem and its place, the line with a caret below the column, and what may be meant."""
    return f"{_one_line(error, text)}{_quoted(error, text)}"


def _one_line(error: Exception, text: str) -> str:
    """Return what the YAML reader says about the place and the problem, without the quoted source."""
    said = str(getattr(error, "problem", None) or str(error).strip().splitlines()[0])
    mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
    place = f" (line {mark.line + 1}, column {mark.column + 1})" if mark is not None else ""
    return f"{_problem(said, error, text.splitlines())}{place}."


def _problem(said: str, error: Exception, lines: Sequence[str]) -> str:
    """Return the problem that a reader ``said``, and what mends it; in its own words where no others are known."""
    begin, stop = getattr(error, "context_mark", None), getattr(error, "problem_mark", None)
    context = getattr(error, "context", None)
    if "'\\t' that cannot start any token" in said:
        return "a line is indented by a tab, and YAML takes blanks only: write two blanks instead"
    if "found another document" in said:
        return "a second document begins, and a spec is one: put it into a file of its own"
    duplicate = re.match(r"found duplicate key (\".*?\"|\S+)", said)
    if duplicate is not None:
        # The reader adds what it has of the values, which is empty where they are mappings.
        return f"the key {duplicate[1]} is repeated in one mapping: write each key once"
    alias = re.match(r"found undefined alias '(.*)'", said)
    if alias is not None:
        return f"the alias *{alias[1]} has no anchor &{alias[1]} before it: write the value, or the anchor"
    if context in _BRACKETS and begin is not None and said.startswith("expected"):
        kind, bracket = _BRACKETS[context]
        return f"the {kind} that begins in line {begin.line + 1} lacks a comma, or {bracket} at its end"
    if said.startswith("expected <block end>") and begin is not None and stop is not None:
        blanks = f"{begin.column} blank{'' if begin.column == 1 else 's'}"
        if stop.column != begin.column and stop.line < len(lines):
            return f"keys of one section begin in one column: indent this line by {blanks}, as line {begin.line + 1}"
    return re.sub(r"\bbut got\b", "but found", said).strip()


def _quoted(error: Exception, text: str) -> str:
    """Return the line in which the YAML reader stopped, with a caret below the column; nothing where it says none."""
    mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
    lines = text.splitlines()
    if mark is None or mark.line >= len(lines):
        return ""
    number = str(mark.line + 1)
    line, column = lines[mark.line].expandtabs(1), mark.column
    start = max(column - SHOWN_COLUMNS // 2, 0) if len(line) > SHOWN_COLUMNS else 0
    excerpt = line[start : start + SHOWN_COLUMNS]
    quoted = f"\n  {number} | {excerpt}\n  {' ' * len(number)} | {' ' * (column - start)}^"
    return quoted + _missing_colon(lines, mark.line)


def _missing_colon(lines: Sequence[str], stop: int) -> str:
    """Return a question about the line before the one at which the YAML reader stopped, where it is a key without a
    colon, or without a blank after it."""
    before = next((i for i in range(stop - 1, -1, -1) if lines[i].partition("#")[0].strip()), None)
    if before is None:
        return ""
    text = lines[before].partition("#")[0].strip()
    if re.match(r"[A-Za-z_]\w*( |$)", text) and ":" not in text:
        return f"\nIs a colon missing in line {before + 1}: {text!r}?"
    joined = re.fullmatch(r"([A-Za-z_]\w*):(\S.*)", text)
    if joined is not None:
        return f"\nIs a blank missing in line {before + 1}? Write {joined[1]}: {joined[2]}"
    return ""
