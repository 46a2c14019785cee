"""Pages of HTML that stand alone, in one style."""

from __future__ import annotations

from collections.abc import Iterable
from importlib.resources import files


def standing_page(title: str, body: Iterable[str], *, generator: str = "obsynth") -> str:
    """Return a page that stands alone, in the style of the reports; title and lines of the body are HTML."""
    style = files("obsynth.files").joinpath("page.css").read_text(encoding="utf-8")
    parts = [
        "<!DOCTYPE html>",
        '<html lang="en">',
        "<head>",
        '<meta charset="utf-8">',
        f'<meta name="generator" content="{generator}">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{title}</title>",
        f"<style>{style}</style>",
        "</head>",
        "<body>",
        f"<h1>{title}</h1>",
        *body,
        "</body>",
        "</html>",
    ]
    return "\n".join(parts) + "\n"
