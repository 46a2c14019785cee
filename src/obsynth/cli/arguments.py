"""Arguments that several verbs have, and the check of where they write to before any work is done."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from obsynth.files.outputs import FileKind, check_output, check_replaceable


def spec_verb(verbs: Any, name: str, told: str) -> argparse.ArgumentParser:
    """Return the parser of a new verb that reads a spec."""
    parser: argparse.ArgumentParser = verbs.add_parser(name, help=told, description=told)
    parser.set_defaults(verb=name)
    add_system(parser)
    return parser


def add_spec_gains(parser: argparse.ArgumentParser) -> None:
    """Add the gain set that a spec's scenario is run with."""
    parser.add_argument(
        "--gains", type=Path, metavar="FILE", help="a gain set for the spec's plant: nothing is designed"
    )


def add_system(parser: argparse.ArgumentParser) -> None:
    """Add the spec."""
    parser.add_argument("--system", type=Path, required=True, metavar="FILE", help="the spec (YAML)")


def add_gains(parser: argparse.ArgumentParser) -> None:
    """Add the gain set that a verb works on."""
    parser.add_argument("--gains", type=Path, required=True, metavar="FILE", help="a gain set (JSON) that design wrote")


def add_json(parser: argparse.ArgumentParser) -> None:
    """Add ``--json``."""
    parser.add_argument("--json", action="store_true", help="print JSON on stdout, for programs; errors too")


def add_verbose(parser: argparse.ArgumentParser, what: str) -> None:
    """Add ``-v``."""
    parser.add_argument("-v", "--verbose", action="store_true", help=f"print {what} as well")


def add_quiet(parser: argparse.ArgumentParser, what: str = "no progress") -> None:
    """Add ``--quiet``."""
    parser.add_argument("--quiet", action="store_true", help=f"print {what}")


def add_force(parser: argparse.ArgumentParser) -> None:
    """Add ``--force`` to a verb that writes files."""
    parser.add_argument("--force", action="store_true", help="replace an existing file whatever it is; never an input")


def output_file(path: str | Path, kind: FileKind | None, options: argparse.Namespace, *, option: str = "--out") -> Path:
    """Return where to write a file of some kind, or raise `SpecError` before any work is done.

    A file that the command has read, under whatever name, is never written; what is read later is checked again when
    the file is put in its place.  An existing file of another kind (of any, if that is `None`) needs ``--force``.
    """
    target = check_output(path, option=option)
    if not options.force:
        check_replaceable(target, kind)
    return target
