"""A verb of the command line: its help, its arguments, and the function that runs it."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import NamedTuple

from obsynth.report.terminal.arguments import Argument, Group, Settings


class Verb(NamedTuple):
    """A verb; ``run`` imports what it needs when it is called, so that help answers at once."""

    run: Callable[[argparse.Namespace], int]
    help_text: str
    arguments: tuple[Argument | Group | Settings, ...]
    epilog: str | None = None
