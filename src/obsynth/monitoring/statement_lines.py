"""The statement of a threshold as lines: a statement of many clauses is printed as a list."""

from __future__ import annotations

import re

#: Clauses up to which a statement is one line: it then says what the threshold means and for which model.
CLAUSES_OF_A_LINE = 2


def statement_lines(head: str, statement: str) -> list[str]:
    """Return a statement behind a ``head``: one sentence, or its first clause and a line for each further one."""
    first, *more = re.split(r"(?:; |\. (?=[A-Z]))(?![^()]*\))", statement)  # not within parentheses
    if len(more) < CLAUSES_OF_A_LINE:
        return [f"{head}{statement}."]
    return [f"{head}{first}.", *(f"  - {clause}" for clause in more)]
