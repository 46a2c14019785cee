"""The reference of a spec's keys, made from its schema, and that of the command line, made from its parser."""

from __future__ import annotations

import argparse
import re
import types
from dataclasses import MISSING, fields
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt
from numpydoc.docscrape import NumpyDocString
from pydantic.fields import FieldInfo
from spec_keys import KEYS, OPTION_SECTIONS, SECTIONS

from obsynth.cli import main as command_line
from obsynth.cli.examples import EXAMPLES
from obsynth.methods.installed import REGISTRY
from obsynth.methods.registry import method_class
from obsynth.numerics.arguments import WrittenAs, field_types
from obsynth.report.terminal.arguments import settings_of
from obsynth.specs import schema, schema_options, schema_plants, schema_sections, schema_values

_SCHEMA = (schema_values, schema_options, schema_plants, schema_sections, schema)


def _of(name: str) -> Any:
    """Return a type of the schema by its name."""
    return getattr(next(part for part in _SCHEMA if hasattr(part, name)), name)


#: What types of the schema are called.
_CALLED: tuple[tuple[Any, str], ...] = (
    (_of("Matrix"), "matrix"),
    (_of("EquationMatrix"), "matrix, or `{states: [...]}`"),
    (_of("OutputMatrix"), "matrix, or `{outputs: [...]}`"),
    (_of("VaryingMatrix"), "matrix of numbers and expressions, list of matrices, or file"),
    (_of("Covariance"), "number, or matrix"),
    (_of("VaryingCovariance"), "number, or matrix of numbers and expressions"),
    (_of("Names"), "list of names, or `{file: names.json}`"),
    (_of("SensorNoises"), "mapping of names to numbers or coloured noise"),
    (_of("Profiles"), "profile, or list of profiles"),
    (_of("Range"), "`[low, high]`"),
    (_of("PoleRegion"), "pole region"),
    (_of("NoiseSection"), "noise weights"),
)
_CONSTANTS = {"nominal": "number", "tolerance": "text or number", "range": "`[low, high]`", "unit": "text"}
_PLAIN = {float: "number", int: "integer", str: "text", bool: "`true` or `false`", Any: "any", type(None): "null"}
_SIGNS = {Gt: ">", Ge: ">=", Lt: "<", Le: "<="}


def spec_reference() -> str:
    """Return the page of all keys of a spec."""
    lines = ["# Reference of spec.yaml", "", _OPENING]
    for title, name, words in (*SECTIONS, *OPTION_SECTIONS):
        if name == "MethodSection":
            continue
        lines += _section(title, name, words)
    lines += _section(*next(item for item in SECTIONS if item[1] == "MethodSection"))
    for method in REGISTRY:
        lines += _options(method)
    return "\n".join(lines)


_OPENING = """\
Made from the schema that checks every spec. `dt`, `sample_time` and `horizon` are in seconds,
or texts with a unit (`10 ms`, `5 min`); other times are in seconds, other units are yours, as long as they fit together.
A key in **bold** must be given. An entry that is left out has its default.
"""


def _section(title: str, name: str, words: str) -> list[str]:
    rows = []
    known = _of(name).model_fields if name != "Constant" else dict.fromkeys(KEYS[name])
    for key, field in known.items():
        unit, meaning, example = KEYS[name][key]
        if field is None:
            rows.append((f"`{key}`", _CONSTANTS[key], unit, "", meaning, f"`{example}`"))
            continue
        default = "" if field.is_required() else _default(field.get_default(call_default_factory=True))
        shown = f"**`{key}`**" if field.is_required() else f"`{key}`"
        kind = "section" if field.annotation is Any else type_text(_annotation(field))
        rows.append((shown, kind, unit, default, meaning, f"`{example}`"))
    return [f"## {title}", "", words, "", *_table(("key", "type", "unit", "default", "meaning", "example"), rows)]


def _options(method: str) -> list[str]:
    """Return the table of a method's options: types and defaults from its fields, the rest from its docstring."""
    options: Any = method_class(method)
    told = {
        name.strip(): (item.type, " ".join(item.desc))
        for item in NumpyDocString(_dedented(options.__doc__ or ""))["Parameters"]
        for name in item.name.split(",")
    }
    kinds, rows = field_types(options), []
    for field in fields(options):
        if field.name not in kinds:
            continue
        kind, text = told.get(field.name, ("", ""))
        marks = get_args(kinds[field.name])[1:]
        written = [_of("OPTION_KINDS")[mark.kind] for mark in marks if isinstance(mark, WrittenAs)]
        if written == [type(None)]:
            continue  # a function of Python: a document cannot hold it
        default = "" if field.default is MISSING else _default(field.default)
        unit = kind.rpartition(", ")[2] if re.search(r", (1/s|s|sec|dimensionless|samples|rad)", kind) else ""
        rows.append((f"`{field.name}`", type_text((written or [kinds[field.name]])[0]), unit, default, _markdown(text)))
    return [f"### Options of {method}", "", *_table(("option", "type", "unit", "default", "meaning"), rows)]


def _dedented(text: str) -> str:
    first, _, rest = text.partition("\n")
    indents = [len(line) - len(line.lstrip()) for line in rest.splitlines() if line.strip()]
    return "\n".join([first, *(line[min(indents, default=0) :] for line in rest.splitlines())])


def _annotation(field: FieldInfo) -> Any:
    """Return the type of a field with the marks that pydantic has taken off it."""
    marks = [mark for mark in field.metadata if isinstance(mark, tuple(_SIGNS))]
    return Annotated[field.annotation, *marks] if marks else field.annotation


def type_text(kind: Any) -> str:
    """Return the type of a key in words."""
    for known, text in _CALLED:
        if kind == known or _bare(kind) == _bare(known):
            return text
    origin, parts = get_origin(kind), get_args(kind)
    if kind in _PLAIN:
        return _PLAIN[kind]
    if origin is Annotated:
        limits = [f"{_SIGNS[type(mark)]} {_limit(mark):g}" for mark in parts[1:] if type(mark) in _SIGNS]
        # A stricter limit beside a weaker one is all that counts.
        limits = limits[-2:] if len(limits) > 2 else limits
        return " ".join([type_text(parts[0]), " and ".join(limits)]).strip()
    if origin in (Union, types.UnionType):
        texts = [type_text(part) for part in parts if part is not type(None)]
        return " or ".join(dict.fromkeys(texts))
    if origin is Literal:
        return " or ".join(f"`{part}`" for part in parts)
    if origin is dict:
        values = type_text(parts[1])
        return "mapping" if values == "any" else f"mapping of names to {_plural(values)}"
    if origin is list:
        return f"list of {_plural(type_text(parts[0]))}"
    if isinstance(kind, type) and issubclass(kind, _of("Section")):
        return f"{kind.__name__.removesuffix('Section').lower()} section"
    return "any"


def _bare(kind: Any) -> Any:
    return get_args(kind)[0] if get_origin(kind) is Annotated else kind


def _limit(mark: Any) -> float:
    return float(next(getattr(mark, name) for name in ("gt", "ge", "lt", "le") if hasattr(mark, name)))


def _plural(text: str) -> str:
    for one, many in (
        ("number", "numbers"),
        ("text", "texts"),
        ("integer", "integers"),
        ("profile,", "profiles,"),
        ("entry section", "entry sections"),
    ):
        text = re.sub(rf"^{one}(?=[ ,]|$)", many, text)
    return text


def _default(value: Any) -> str:
    if value is None or (isinstance(value, dict) and not value) or isinstance(value, _of("Section")):
        return ""
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    return f"`{value:g}`" if isinstance(value, float) else f"`{value}`"


def _markdown(text: str) -> str:
    """Return the text of a docstring with its code and names of functions as code."""
    return re.sub(r"``([^`]+)``|`([^`]+)`", lambda hit: f"`{hit.group(1) or hit.group(2)}`", text)


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> list[str]:
    """Return a table without the columns in which nothing stands."""
    used = [i for i in range(len(head)) if any(row[i] for row in rows)]
    head = tuple(head[i] for i in used)
    cells = [[row[i].replace("|", "\\|").replace("\n", " ") for i in used] for row in rows]
    return [
        "```{rst-class} reference",
        "```",
        "",
        "| " + " | ".join(head) + " |",
        "|" + " --- |" * len(head),
        *("| " + " | ".join(row) + " |" for row in cells),
        "",
    ]


def command_reference() -> str:
    """Return the page of all commands."""
    lines = ["# Reference of the command line", "", _COMMANDS]
    lines += _exit_codes()
    for name, verb in command_line.VERBS.items():
        lines += _command(name, verb)
    return "\n".join(lines)


_COMMANDS = """\
Made from the parser. `design` alone is short for `obsynth design`. Rare arguments are settings: `--set NAME=VALUE` and
`--NAME VALUE` mean the same. Every command has `--help`, and prints its result as JSON with `--json`.

Completion in a shell (`pip install '.[completion]'`): `obsynth --print-completion bash > ~/.local/share/bash-completion/completions/obsynth`,
and the like for zsh and tcsh.
"""


def _exit_codes() -> list[str]:
    rows = [tuple(line.split(maxsplit=1)) for line in command_line.EXIT_CODES.splitlines()[1:]]
    return ["## Exit codes", "", *_table(("code", "meaning"), [(f"`{code}`", text) for code, text in rows])]


def _command(name: str, verb: Any) -> list[str]:
    parser = command_line._with_verb(name, argparse.ArgumentParser(prog=f"obsynth {name}"))
    lines = [f"## obsynth {name}", "", _text(verb.help_text), ""]
    lines += ["```sh", EXAMPLES[name], "```", ""]
    rows = []
    for action in parser._actions:
        if isinstance(action, argparse._HelpAction) or action.help == argparse.SUPPRESS or action.dest == "set":
            continue
        rows.append((_names(action), "yes" if action.required else "", _help(action)))
    lines += _table(("argument", "required", "meaning"), rows)
    settings = [
        (_setting(item.names[0], item.settings), _text(item.settings.get("help", "")))
        for item in settings_of(verb.arguments)
    ]
    if settings:
        lines += ["Settings:", "", *_table(("setting", "meaning"), settings)]
    if verb.epilog:
        lines += ["```text", *verb.epilog.replace("\\\n", "").splitlines(), "```", ""]
    return lines


def _names(action: argparse.Action) -> str:
    metavar = action.metavar or ("|".join(map(str, action.choices)) if action.choices else "")
    names = ", ".join(action.option_strings) or str(action.metavar or action.dest)
    takes = action.nargs != 0 and action.option_strings
    return f"`{names}{' ' + str(metavar) if takes and metavar else ''}`"


def _setting(name: str, settings: dict[str, Any]) -> str:
    value = settings.get("metavar") or "|".join(map(str, settings.get("choices") or ()))
    return f"`{name}{' ' + value if value else ''}`"


def _help(action: argparse.Action) -> str:
    return _text(action.help or "")


def _text(text: str) -> str:
    """Return a help text as Markdown: percent signs are doubled there, `<...>` would be HTML and `--` a dash."""
    text = text.replace("%%", "%").replace("*", r"\*")
    return re.sub(r"`[^`]*`|<[^>]*>|--[a-z][\w-]*", lambda hit: hit[0] if hit[0][0] == "`" else f"`{hit[0]}`", text)
