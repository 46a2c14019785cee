"""Words of C: names, comments and paths that a compiler takes, whatever they are made of."""

from __future__ import annotations

import json
import re

_KEYWORDS = frozenset(
    {
        "auto", "break", "case", "char", "const", "continue", "default", "do", "double", "else", "enum", "extern",
        "float", "for", "goto", "if", "inline", "int", "long", "register", "restrict", "return", "short", "signed",
        "sizeof", "static", "struct", "switch", "typedef", "union", "unsigned", "void", "volatile", "while",
    }
)  # fmt: skip


def c_identifier(text: str) -> str:
    """Return a C identifier made of ``text``; one that C reserves, or that begins with a digit, gets a prefix."""
    name = re.sub(r"\W", "_", text, flags=re.ASCII)
    return name if re.match(r"[A-Za-z]", name) and name not in _KEYWORDS else f"obs_{name}"


def quoted(name: str) -> str:
    """Return a name in quotes, in ASCII, that cannot end or begin a comment or form a trigraph."""
    return json.dumps(name).replace("*/", "* /").replace("/*", "/ *").replace("??", "? ?").replace("??", "? ?")


def included(name: str) -> str:
    """Return the name of a header as an include line takes it."""
    return name.replace("\\", "/")


def comment(text: str) -> str:
    """Return a comment of one line."""
    return f"/* {text} */"
