"""Command-line parsing: an `argparse` parser whose messages suggest the option that is meant."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NoReturn

from obsynth.errors import SpecError

#: How alike a word must be to what may be meant, as `difflib` measures it.
ALIKE = 0.6
#: How many words are suggested.
MOST_SUGGESTIONS = 3

#: Shells whose completion scripts shtab writes.
SHELLS = ("bash", "zsh", "tcsh")


class Parser(argparse.ArgumentParser):
    """An argument parser that names the command or option that a misspelt one may mean."""

    #: Printed where the program is called without any argument; empty: the usage, as by `argparse`.
    first_steps: str = ""
    _words: Sequence[str] = ()

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse as `argparse` does, and store the words, which the messages of refusals name."""
        self._words = list(args) if args is not None else []
        return super().parse_known_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        """End the program with its usage, the message, and what may be meant."""
        if self.first_steps and not self._words:
            self.exit(SpecError.exit_code, self.first_steps)
        choice = re.match(r"argument (\S+): invalid choice: '([^']*)'", message)
        if choice is not None and choice.group(1) == "COMMAND":
            commands = next(item.choices for item in self._actions if isinstance(item, argparse._SubParsersAction))
            word = choice.group(2)
            message = f"there is no command {word!r}.{meant(word, list(commands))} {self.prog} --help lists them all."
        elif (number := re.match(r"argument (\S+): invalid (int|float) value: ('.*')", message)) is not None:
            wanted = "whole number" if number.group(2) == "int" else "number"
            message = f"argument {number.group(1)}: {number.group(3)} is no {wanted}."
        elif message.startswith("the following arguments are required"):
            known = list(self._option_string_actions)
            wrong = [word.partition("=")[0] for word in self._words if word.startswith("--")]
            close = [(word, meant(word, known)) for word in wrong if word not in known]
            suggestions = "".join(f" There is no option {word}.{suggested}" for word, suggested in close if suggested)
            suggestions += self._meant_file(message)
            message += f".{suggestions}" if suggestions else ""
        super().error(message)

    def _meant_file(self, message: str) -> str:
        """Return the option that a file without one may belong to: ``obsynth design spec.yaml``."""
        needed = message.partition(": ")[2].split(",")[0].split("/")[0].strip()
        loose = [word for word in self._words if Path(word).suffix and not word.startswith("-")]
        plain = [word for word in loose if self._words.index(word) == 0]
        return f" Did you mean {needed} {plain[0]}?" if needed.startswith("--") and plain else ""


class PrintCompletion(argparse.Action):
    """Print a script that completes commands and options in a shell, and end the program."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        """Print the script of the whole program, whatever words stand beside the option."""
        from obsynth.numerics.libraries import imported

        print(imported("shtab", extra="completion", what="Completion").complete(parser, shell=values))
        parser.exit()


def meant(word: str, known: Sequence[str]) -> str:
    """Return a question that begins with a blank, "Did you mean ...?", or nothing."""
    close = get_close_matches(word, known, n=MOST_SUGGESTIONS, cutoff=ALIKE)
    return f" Did you mean {' or '.join(close)}?" if close else ""
