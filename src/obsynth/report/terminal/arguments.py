"""Arguments of verbs as data: how they are declared, added to a parser, read and refused."""

from __future__ import annotations

import argparse
import re
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from obsynth.errors import SpecError

#: An item of a list in help texts: its name with two blanks behind it, or nothing such, as in settings.
_ITEM = re.compile(r"  (\S.{0,12}? {2,})?(?=\S)")

#: How far the rest of an item without a name hangs, and the widest lines of help texts.
_HANGING, _WIDEST_HELP = 6, 110

#: In place of a file: standard input, or standard output.
STREAM = "-"

#: Arguments of the command line that are not called as the options that they give.
OPTION_NAMES = {
    "disturbance_bounds": "disturbance", "initial_set": "initial", "disturbance": "disturbance_course",
    "sensor_faults": "no_sensor_faults",
}  # fmt: skip


class Argument(NamedTuple):
    """An argument: its names, and the settings that argparse takes."""

    names: tuple[str, ...]
    settings: dict[str, Any]


class Group(NamedTuple):
    """Arguments under a title in the help; without a title, only one of them may be given."""

    title: str
    arguments: tuple[Argument, ...]
    required: bool = False  # whether one of them must be given


class Settings(NamedTuple):
    """Rare arguments, given as ``--set NAME=VALUE``: listed at the end of the help."""

    arguments: tuple[Argument, ...]


def add_arguments(parser: Any, arguments: Iterable[Argument | Group | Settings]) -> None:
    """Add arguments to a parser, or to a group of one; settings are read by `read_settings`."""
    for item in arguments:
        if isinstance(item, Settings):
            continue
        if isinstance(item, Group):
            one_of = parser.add_mutually_exclusive_group
            group = parser.add_argument_group(item.title) if item.title else one_of(required=item.required)
            add_arguments(group, item.arguments)
        else:
            parser.add_argument(*item.names, **item.settings)


def settings_of(arguments: Iterable[Argument | Group | Settings]) -> tuple[Argument, ...]:
    """Return the arguments that are settings."""
    return tuple(argument for item in arguments if isinstance(item, Settings) for argument in item.arguments)


class Folded(argparse.RawDescriptionHelpFormatter):
    """Help whose lines stay lines, folded to the terminal: the rest of an item hangs below its text."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        lines = list[str]()
        for line in text.splitlines():
            item = _ITEM.match(line)
            hang = "" if item is None else " " * (len(item.group()) if item.group(1) else _HANGING)
            folded = textwrap.wrap(
                line, min(width, _WIDEST_HELP), subsequent_indent=indent + hang, break_on_hyphens=False
            )
            lines += folded or [""]
        return "\n".join(lines)


def add_settings(parser: argparse.ArgumentParser, settings: Sequence[Argument]) -> None:
    """Let a parser take ``--set`` and know the defaults of settings; its help lists them at the end."""
    parser.add_argument(
        "--set",
        dest="settings",
        metavar="NAME=VALUE",
        type=setting,
        action="append",
        default=[],
        help="one of the settings below; may be repeated",
    )
    own = _settings_parser("", settings)
    parser.set_defaults(**vars(own.parse_args([])))
    lines = ["settings, each by --set NAME=VALUE (or --NAME VALUE):"]
    for action in own._actions:
        name = action.option_strings[0].removeprefix("--")
        value = action.metavar or ("true" if action.const else "|".join(map(str, action.choices or ("VALUE",))))
        help_text = (action.help or "") % {"default": action.default}
        lines.append(f"  {name}={value}: {help_text}")
    parser.epilog = "\n".join([*([parser.epilog, ""] if parser.epilog else []), *lines])
    parser.formatter_class = Folded


def _settings_parser(prog: str, settings: Sequence[Argument]) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog=prog, usage="%(prog)s --set NAME=VALUE (see %(prog)s --help)", add_help=False)
    add_arguments(parser, settings)
    return parser


def read_settings(
    prog: str, arguments: Iterable[Argument | Group | Settings], options: argparse.Namespace, rest: Sequence[str]
) -> list[str]:
    """Put the settings of a command line into its options, and return what is no setting of the verb."""
    parser = _settings_parser(prog, settings_of(arguments))
    words = []
    for name, value in getattr(options, "settings", ()):
        known = parser._option_string_actions.get(f"--{name}")
        if known is not None and known.nargs == 0:
            words += [f"--{name}"] if value.casefold() in ("true", "yes", "1") else []
        else:
            words.append(f"--{name}={value}")
    return parser.parse_known_args([*words, *rest], namespace=options)[1]


def setting(text: str) -> tuple[str, str]:
    """Return name and value of NAME=VALUE, whose value may hold equals signs."""
    name, mark, value = text.partition("=")
    if not mark or not name:
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form NAME=VALUE")
    return name.strip().replace("_", "-"), value


def option(name: str, metavar: str | None, help_text: str, **settings: Any) -> Argument:
    """Return an argument with a value; one of the form ``NAME=VALUE`` may be given several times."""
    pairs = {"type": pair, "action": "append", "default": []} if "=" in (metavar or "") and not settings else {}
    return Argument((name,), {"metavar": metavar, "help": help_text, **pairs, **settings})


def flag(name: str, help_text: str) -> Argument:
    """Return an argument without a value."""
    return Argument((name,), {"action": "store_true", "help": help_text})


def verbose(what: str) -> Argument:
    """Return ``-v``."""
    return Argument(("-v", "--verbose"), {"action": "store_true", "help": f"print {what} as well"})


def pair(text: str) -> tuple[str, str]:
    """Return the two sides of NAME=VALUE."""
    # A column of the output, such as fhat[a=b], may hold an equals sign; a number or a plain column does not.
    name, mark, value = text.rpartition("=")
    if not mark or not name or not value:
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form NAME=VALUE")
    return name, value


def number_type(
    name: str, read: Callable[[str], float], fits: Callable[[float], bool], wrong: str
) -> Callable[[str], float]:
    """Return a type of arguments: numbers that fit. argparse tells its name where a text is no number, and what is
    ``wrong`` where it is another one."""

    def checked(text: str) -> float:
        """Return the number in a text, where it fits."""
        value = read(text)
        if not fits(value):
            raise argparse.ArgumentTypeError(f"{text} {wrong}")
        return value

    checked.__name__ = name
    return checked


def refuse_given(options: argparse.Namespace, names: Iterable[str], meant: str) -> None:
    """Refuse arguments that would do nothing; ``meant`` says what they are for."""
    for name in names:
        if name not in ("verb", "settings", "command") and getattr(options, name, None) not in (None, False, []):
            flag = f"--{name.replace('_', '-')}"
            raise SpecError(f"{flag} is for {meant}. Otherwise leave it out.", path=flag)


def columns_of(options: argparse.Namespace) -> dict[str, str]:
    """Return the columns of signals, and of the time, that the command line names."""
    named = dict(options.map)
    return {**named, "time": options.time_column} if options.time_column else named


def number_of(name: str, text: str) -> float:
    """Return the value of an argument of the form NAME=VALUE."""
    try:
        return float(text)
    except ValueError:
        first, _, unit = text.strip().partition(" ")
        if unit and _is_number(first):
            raise SpecError(
                f"{name}={text}: values are in the unit of their signal, which is not written. Give {name}={first}.",
                path=name,
            ) from None
        raise SpecError(f"{name}={text}: {text!r} is no number.", path=name) from None


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def numbers_of(pairs: list[tuple[str, str]]) -> Mapping[str, float]:
    """Return values by name, from arguments of the form NAME=VALUE."""
    return {name: number_of(name, text) for name, text in pairs}


def ranges_of(pairs: list[tuple[str, str]]) -> dict[str, float | tuple[float, float]]:
    """Return bounds by name, from arguments of the form NAME=BOUND or NAME=LOW:HIGH."""
    ranges: dict[str, float | tuple[float, float]] = {}
    for name, text in pairs:
        low, colon, high = text.partition(":")
        ranges[name] = (number_of(name, low), number_of(name, high)) if colon else number_of(name, text)
    return ranges


def flag_of(name: str) -> str:
    """Return what an option of a function is called on the command line."""
    return f"--{OPTION_NAMES.get(name, name).replace('_', '-')}"
