"""Documents (YAML, JSON) read into plain data and checked: every problem at once, each with its path."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from obsynth.errors import SpecError, a_kind
from obsynth.files.inputs import of_another_kind, read_json, read_text
from obsynth.methods.registry import AUTO, REGISTRY, method_class
from obsynth.numerics.arguments import field_types, is_number, is_whole
from obsynth.numerics.suggestions import suggestion
from obsynth.plants.other_names import name_meant
from obsynth.specs.lines import composed, line_of
from obsynth.specs.remedies import (
    MISSING_KEYS,
    instead_of_kind,
    instead_of_list,
    instead_of_mapping,
    instead_of_matrix,
    instead_of_nothing,
    instead_of_number,
    instead_of_section,
    instead_of_time,
    is_matlab,
)
from obsynth.specs.syntax_errors import syntax_error

if TYPE_CHECKING:
    from pydantic import BaseModel

    from obsynth.specs.schema import SpecDocument
    from obsynth.specs.schema_plants import PlantSection
    from obsynth.specs.schema_sections import DAESection, TimeVaryingSection

    Model = TypeVar("Model", bound=BaseModel)


#: Values that the aliases of a document may repeat it to.
MOST_ALIASED_VALUES = 1_000_000

#: Whole numbers from here on are not printed.
LONGEST_NUMBER = 1e15

#: A document with more problems than this is not read to its end by anybody.
MAXIMUM_PROBLEMS = 25

#: What the checks call a kind of value, in a path to a problem.
_KIND = re.compile(r"<\w+>")

#: Problems of a value that is of another kind, beside those whose names end with `_type`.
_OTHER_KIND = ("missing", "extra_forbidden", "literal_error")

#: What documents of YAML are, for those who give something else.
_WANTED = "a spec (YAML or JSON)"

#: Files of other languages that are given for a spec, by their endings.
_OTHER_LANGUAGES = {".toml": "TOML", ".py": "Python", ".m": "MATLAB", ".ini": "an INI file", ".txt": "a text"}


def read_yaml(path: Path, *, where: str | None = None) -> dict[str, Any]:
    """Return the mapping in a YAML 1.2 document; duplicate keys, tags, anchors set twice, and aliases that
    stand for more than a document can hold, are refused."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError, YAMLWarning

    place = where or str(path)
    text = read_text(path, where=place)
    if re.search(r"^%YAML\s+(?!1\.2\s*$)", text, flags=re.MULTILINE):
        raise SpecError(f"{path} asks for another YAML than 1.2: remove the %YAML line.", path=place)
    try:
        with warnings.catch_warnings(action="error", category=YAMLWarning):
            document = YAML(typ="safe", pure=True).load(text)
        count = _values_in(document, {})
    except (YAMLError, YAMLWarning) as error:
        kind = of_another_kind(path, _WANTED)
        raise SpecError(kind or f"{path} is not valid YAML: {syntax_error(error, text)}", path=place) from error
    except RecursionError as error:
        raise SpecError(f"{path} is not a valid spec: it is nested too deeply.", path=place) from error
    except (ValueError, TypeError, OverflowError, AttributeError) as error:
        raise SpecError(f"{path} has a value that YAML cannot read: {error}.", path=place) from error
    if count > max(len(text), MOST_ALIASED_VALUES):
        raise SpecError(
            f"{path} expands to {count:.3g} values: its aliases (*name) repeat their contents too often. Put such "
            "matrices into files beside it.",
            path=place,
        )
    if document is None:
        raise SpecError(f"{path} is empty.", path=place)
    if not isinstance(document, dict):
        if (problem := of_another_kind(path, _WANTED)) is not None:
            raise SpecError(problem, path=place)
        other = _OTHER_LANGUAGES.get(path.suffix.lower())
        hint = (
            f" {path.name} is {other}, and a spec is YAML or JSON: write key: value, not key = value." if other else ""
        )
        raise SpecError(
            f"{path} holds {described(document)}: the top level must be a mapping (key: value).{hint}", path=place
        )
    return document


def _values_in(value: Any, known: dict[int, float]) -> float:
    """Return how many values a document stands for, each as often as an alias repeats it; infinite in a circle."""
    if not isinstance(value, (dict, list)):
        return 1.0
    if id(value) not in known:
        known[id(value)] = float("inf")
        parts = value.values() if isinstance(value, dict) else value
        known[id(value)] = 1.0 + sum(_values_in(part, known) for part in parts)
    return known[id(value)]


def read_names(path: Path, *, where: str) -> list[str]:
    """Return the names in a JSON file: a list, or a mapping of lists that are concatenated in order."""
    if path.suffix.lower() != ".json":
        raise SpecError(f"{path.name} has an unknown suffix: names are read from .json files.", path=where)
    document = read_json(path, where=where)
    lists = list(document.values()) if isinstance(document, dict) else [document]
    if not lists or not all(isinstance(part, list) for part in lists):
        raise SpecError(f"{path} must hold a list of names, or a mapping of such lists.", path=where)
    names = [name for part in lists for name in part]
    if not all(isinstance(name, str) for name in names):
        raise SpecError(f"{path} holds something that is no text: names must be texts.", path=where)
    return names


def described(value: Any) -> str:
    """Return a short description of ``value`` for a message, such as ``the text '1.0'``."""
    if value is None:
        return "nothing (null)"
    if isinstance(value, bool):
        return f"the truth value {str(value).lower()}"
    if isinstance(value, str):
        return f"the text {value!r}" if len(value) <= 40 else f"the text {value[:37]!r}..."
    if isinstance(value, (int, float)):
        # A long integer cannot even be printed.
        return (
            f"the number {value}" if abs(value) < LONGEST_NUMBER or isinstance(value, float) else "a huge whole number"
        )
    if isinstance(value, dict):
        return "a mapping"
    return "a list" if isinstance(value, list) else a_kind(value)


@dataclass(frozen=True)
class DocumentProblems:
    """Collects path and text of each problem of one document, which is to be a ``what``, to raise them together."""

    source: Path
    what: str
    document: Any = None
    noted: dict[tuple[str, str], Sequence[str | int]] = field(default_factory=dict)

    def add(self, path: str, text: str, location: Sequence[str | int] = ()) -> None:
        """Note that ``text`` is wrong at ``path``; ``location``: its keys, and numbers of entries, one by one."""
        self.noted.setdefault((path, text), location or path.split("."))

    def sort_by_section(self, sections: Sequence[str]) -> None:
        """Put what was noted in the order of the sections of the document, unknown ones last."""
        ordered = sorted(
            self.noted.items(), key=lambda problem: (*sections, key := problem[0][0].partition(".")[0]).index(key)
        )
        self.noted.clear()
        self.noted.update(ordered)

    def raise_if_any(self) -> None:
        """Raise one `SpecError` with everything noted, if anything was."""
        if not self.noted:
            return
        lines = self._lines()
        if len(self.noted) > MAXIMUM_PROBLEMS:
            lines.append(f"and {len(self.noted) - MAXIMUM_PROBLEMS} more")
        head = f"{self.source} is not a valid {self.what}:"
        raise SpecError(head, path=next(iter(self.noted))[0] or str(self.source), problems=lines)

    def _lines(self) -> list[str]:
        """Return the first problems with the line of the file that each is about, unless the document was changed after
        reading it: what is wrong may then be no part of the file."""
        tree = composed(self.source)
        changed = tree is None or (self.document is not None and self.document != read_yaml(self.source))
        lines = []
        for (path, text), location in list(self.noted.items())[:MAXIMUM_PROBLEMS]:
            line = None if changed else line_of(tree, location)
            lines.append((f"{path}: {text}" if path else text) + ("" if line is None else f" [line {line}]"))
        return lines


def checked_spec(document: Mapping[str, Any], source: Path) -> tuple[SpecDocument, dict[str, Any]]:
    """Check a whole spec, and the options of its method."""
    from obsynth.specs.schema_options import options_schema

    problems = DocumentProblems(source, what="spec", document=document)
    _check_version(document, problems)
    checked = _checked_sections(document, problems)
    method = document.get("method", {"id": AUTO})
    raw_options: Any = {}
    identifier = None
    if isinstance(method, dict):
        identifier, raw_options = method.get("id", AUTO), method.get("options", {})
    options = None
    if identifier == AUTO and isinstance(raw_options, dict) and checked is not None:
        problems.raise_if_any()
        return checked, _options_of_any(raw_options, source)
    if isinstance(identifier, str) and identifier != AUTO and identifier not in REGISTRY:
        close = suggestion(identifier, list(REGISTRY))
        known = ", ".join(sorted([*REGISTRY, AUTO]))
        install = f" If it is that of a plug-in, install the package that provides {identifier}."
        problems.add("method.id", f"unknown method {identifier!r}.{close or install} There are: {known}.")
    elif isinstance(identifier, str) and identifier != AUTO and isinstance(raw_options, dict):
        options = _validated(options_schema(identifier), raw_options, problems, prefix="method.options")
    problems.raise_if_any()
    if checked is None or options is None:
        raise SpecError(f"{source} is not a valid spec.", path=str(source))
    return checked, {name: getattr(options, name) for name in options.model_fields_set}


def _checked_sections(document: Mapping[str, Any], problems: DocumentProblems) -> SpecDocument | None:
    """Return a whole spec but for the options of its method; ``None`` where it has problems, which are noted."""
    from obsynth.specs.schema import CHECKED_APART, SpecDocument, section_of

    checked = _validated(SpecDocument, document, problems)
    sections: dict[str, BaseModel | None] = {}
    for name in CHECKED_APART:
        value = document.get(name)
        if value is not None or (name == "plant" and name in document):
            sections[name] = _validated(section_of(name, value), value, problems, prefix=name)
    # As if all had been checked at once: in the order of the keys of a spec, unknown ones last.
    problems.sort_by_section(list(SpecDocument.model_fields))
    if checked is None or None in sections.values():
        return None
    return checked.model_copy(update=sections)


def _options_of_any(raw_options: dict[str, Any], source: Path) -> dict[str, Any]:
    """Return options as the first method reads them that has them all; `auto` decides between those that do."""
    from obsynth.specs.schema_options import options_schema

    if not raw_options:
        return {}
    unknown = [name for name in raw_options if not _methods_with(name)]
    if unknown:
        known = {name for method in REGISTRY for name in field_types(method_class(method))}
        problems = DocumentProblems(source, what="spec")
        for name in unknown:
            problems.add(f"method.options.{name}", f"no method has this option.{suggestion(name, sorted(known))}")
        problems.raise_if_any()
    for method in REGISTRY:
        problems = DocumentProblems(source, what="spec")
        options = _validated(options_schema(method), raw_options, problems, prefix="method.options")
        if not problems.noted and options is not None:
            return {name: getattr(options, name) for name in options.model_fields_set}
    raise SpecError(
        f"{source}: no single method has the options {', '.join(sorted(raw_options))} with these values: "
        "name the method that they are for.",
        path="method.options",
    )


def checked_plant(document: Mapping[str, Any], source: Path) -> PlantSection | TimeVaryingSection | DAESection:
    """Check a plant in a file of its own."""
    from obsynth.specs.schema import RARE_KINDS, plant_document

    problems = DocumentProblems(source, what="plant", document=document)
    _check_version(document, problems)
    kind = document.get("kind")
    known = plant_document(kind if kind in RARE_KINDS else None)
    checked: Any = _validated(known, document, problems)
    problems.raise_if_any()
    section: PlantSection | TimeVaryingSection | DAESection = checked
    return section


def _check_version(document: Mapping[str, Any], problems: DocumentProblems) -> None:
    """Raise at once for another version: the other keys would then mean something else."""
    from obsynth.specs.schema import SPEC_VERSION

    version = document.get("schema_version")
    if "sha256" in document and "design" in document:
        problems.add("", "This is a gain set: give the spec that it was made from.")
        problems.raise_if_any()
    if is_whole(version) and version != SPEC_VERSION:
        text = f"version {version} is unknown; this obsynth reads version {SPEC_VERSION}."
        problems.add("schema_version", text)
        problems.raise_if_any()


def _validated(model: type[Model], document: Any, problems: DocumentProblems, *, prefix: str = "") -> Model | None:
    from pydantic import ValidationError

    try:
        return model.model_validate(document)
    except ValidationError as error:
        for item in _of_likely_kinds(error.errors(include_url=False), document):
            problems.add(*_explained(item, model, prefix, document, problems.source.parent))
        return None


def _of_likely_kinds(items: Sequence[Any], document: Any) -> list[Any]:
    """Return pydantic's errors without those of kinds that a value was not meant to be: of a value that may be of
    several, a number or a mapping, each kind adds its own errors, below a name of this kind that no document has."""
    likely_errors, groups = [], dict[tuple[Any, ...], dict[str, list[Any]]]()
    for item in items:
        loc = item["loc"]
        place = _kind_in(loc, document, item["type"])
        if place is None:
            likely_errors.append(item)
        else:
            inner = {**item, "loc": (*loc[:place], *loc[place + 1 :])}
            groups.setdefault(loc[:place], {}).setdefault(str(loc[place]), []).append(inner)
    for path, kinds in groups.items():
        by_kind = [_of_likely_kinds(errors, document) for errors in kinds.values()]
        least = min(_wrong_kinds(errors, path) for errors in by_kind)
        likely = [errors for errors in by_kind if _wrong_kinds(errors, path) == least]
        if len(likely) > 1 and all(len(errors) == 1 for errors in likely):
            kinds_wanted = list(dict.fromkeys(_kind_wanted(errors[0]) for errors in likely))
            likely_errors.append(
                {**likely[0][0], "loc": path, "type": "kinds", "ctx": {"wanted": ", or ".join(kinds_wanted)}}
            )
        else:
            likely_errors.extend(likely[0])
    return likely_errors


def _kind_in(loc: Sequence[Any], document: Any, problem: str) -> int | None:
    """Return the place in a path of the first name that is a kind of value, and no key of the document."""
    value = document
    for i, part in enumerate(loc):
        if isinstance(part, str) and (_KIND.fullmatch(part) or part == "[key]"):
            continue
        known = part in value if isinstance(value, dict) else isinstance(part, int) and isinstance(value, list)
        if not known:
            return None if isinstance(part, int) or (problem == "missing" and i == len(loc) - 1) else i
        value = value[part]
    return None


def _wrong_kinds(items: Sequence[Any], path: Sequence[Any]) -> tuple[int, int]:
    """Return how many errors say that a value at a path is of another kind, and how many there are."""
    at_once = 0
    for item in items:
        below = [part for part in item["loc"][len(path) :] if not (isinstance(part, str) and _KIND.fullmatch(part))]
        other = item["type"] in (*_OTHER_KIND, "kinds") or item["type"].endswith("_type")
        at_once += other and len(below) <= (item["type"] in _OTHER_KIND)
    return at_once, len(items)


def _kind_wanted(item: Any) -> str:
    """Return what a value should have been, by an error that says that it is of another kind."""
    if "<rows>" in item["loc"]:
        return "a list of rows, such as [[1, 0], [0, 1]]"
    return _wanted_in_words(item["type"], item.get("ctx", {})).removeprefix("one of ")


def _explained(
    item: Any, model: type[BaseModel], prefix: str, document: Any, folder: Path
) -> tuple[str, str, tuple[str | int, ...]]:
    """Return the path, the message and the location of one of pydantic's errors in a document, or in the part of it at
    ``prefix``; ``folder`` is that of the file."""
    location = [part for part in item["loc"] if not (isinstance(part, str) and re.fullmatch(r"<\w+>", part))]
    names = [str(part) for part in location if isinstance(part, str) and part != "[key]"]
    numbers = [part + 1 for part in location if isinstance(part, int)]
    kind, value, context = item["type"], item["input"], item.get("ctx", {})
    in_stack = "<stack>" in item["loc"]
    in_rows = in_stack or "<rows>" in item["loc"]
    key = names[-1] if names else ""
    if kind == "extra_forbidden" and not key:
        text, names = "a key is empty: write its name, or remove it.", names[:-1]
    elif kind == "invalid_key" or "[key]" in location:
        text, numbers = f"a key must be a non-empty text, not {described(value)}.", []
    elif kind == "extra_forbidden":
        known = _known_keys((prefix, *item["loc"])) if len(names) > 1 else list(model.model_fields)
        beside = _value_at(document, location[:-1])
        known = _keys_of_profile(beside, known)
        beside = list(beside) if isinstance(beside, dict) else []
        meant = name_meant(key, known, beside) or _option_hint(key, prefix, names, known)
        text = f"unknown key.{meant or _plant_hint(key, prefix, names) or instead_of_section(value, known)}"
    elif kind == "missing":
        needed = f": {MISSING_KEYS[key]}" if key in MISSING_KEYS else ""
        text = f"this key is missing{needed}."
    elif kind in ("ragged_rows", "stack_shapes"):
        text = f"{item['msg']}."
    elif kind == "stated":
        text = item["msg"]
    elif kind == "finite_number":
        text = f"must be a finite number, not {value}.{' Write 0 for no coupling.' if in_rows else ''}"
    elif kind == "entry_of_k":
        text = f"{item['msg']}, not {described(value)}."
    elif kind == "time":
        text = f"{item['msg']}, not {described(value)}.{instead_of_time(value)}"
    elif kind == "string_pattern_mismatch":
        possible = re.sub("[^A-Za-z0-9._-]+", "-", value).strip("-._")[:100]
        text = (
            f"use letters, digits, '.', '_' and '-' only (at most 100), not {described(value)}"
            f"{f': {possible!r}, for example; description takes any text' if possible else ''}."
        )
    else:
        expected = (
            "a list of numbers" if in_rows and kind in ("list_type", "too_short") else _wanted_in_words(kind, context)
        )
        expected = "a list of rows, such as [[1, 0], [0, 1]]" if in_rows and not numbers else expected
        actual = "an empty one" if kind in ("too_short", "string_too_short") else described(value)
        if kind == "list_of_no_rows":
            actual = "a list of empty rows" if [] in value else "a list of numbers"
        text = f"must be {expected}, not {actual}."
        text += _remedy(kind, key, value, folder, expected, in_rows=in_rows, is_entry=bool(numbers))
    words = ("matrix", "row", "column") if in_stack else ("row", "column") if in_rows else ("entry",)
    place = ", ".join(f"{word} {number}" for word, number in zip(words, numbers, strict=False))
    path = ".".join([*([prefix] if prefix else []), *names])
    return path, f"{place} {text}" if place else text, (*filter(None, prefix.split(".")), *location)


def _remedy(kind: str, key: str, value: Any, folder: Path, expected: str, *, in_rows: bool, is_entry: bool) -> str:
    """Return what to write instead of a value of a wrong kind, as a sentence after a blank; empty where none is known.

    ``expected``: what the value must be; ``in_rows``: it is a matrix, or with ``is_entry`` a row or an entry of one.
    """
    if value is None and not is_entry:
        return instead_of_nothing(key)
    if key == "method":
        return f" Write method: {{id: {value}}}." if isinstance(value, str) else ""
    if kind == "literal_error":
        other = instead_of_kind(value) if key == "kind" else ""
        return other or suggestion(str(value), re.findall(r"'([^']*)'", expected))
    if kind in ("dict_type", "model_type"):
        return instead_of_mapping(key, value)
    if kind == "string_type":
        return f" Write '{value}', in quotes." if is_number(value) else ""
    if in_rows and not (is_entry and kind == "float_type"):
        return instead_of_matrix(key, value, folder) if not is_entry or is_matlab(value) else ""
    if kind in ("float_type", "int_type"):
        return instead_of_number(value, whole=kind == "int_type")
    return instead_of_list(key, value) if kind == "list_type" else ""


def _value_at(document: Any, location: Sequence[str | int]) -> Any:
    """Return what is at a location of a document; ``None`` where nothing is."""
    value = document
    for part in location:
        value = value.get(part) if isinstance(value, dict) else None
    return value


def _plant_hint(key: str, prefix: str, names: Sequence[str]) -> str:
    """Return where a key belongs that is one of a plant, but is written beside it."""
    from obsynth.specs.schema_plants import PlantSection

    return " It belongs below plant." if not prefix and len(names) == 1 and key in PlantSection.model_fields else ""


def _option_hint(key: str, prefix: str, names: Sequence[str], known: Sequence[str]) -> str:
    """Return what helps with a wrong key of a method, as a sentence after a blank: where an option belongs, which
    methods have it, or which options there are."""
    if names[:-1] == ["method"]:
        return f" Write options below method.options, as options: {{{key}: ...}}." if _methods_with(key) else ""
    if prefix != "method.options" or len(names) != 1:
        return ""
    takes = _methods_with(key)
    return f" It is an option of {', '.join(takes)}." if takes else f" The options are {', '.join(known)}."


def _methods_with(option: str) -> list[str]:
    """Return the methods that have an option of this name."""
    return [method for method in REGISTRY if option in field_types(method_class(method))]


def _wanted_in_words(kind: str, context: Mapping[str, Any]) -> str:
    if kind == "kinds":
        return str(context["wanted"])
    if kind == "literal_error":
        return f"one of {context['expected']}"
    limits = {
        "greater_than": "greater than",
        "greater_than_equal": "at least",
        "less_than": "less than",
        "less_than_equal": "at most",
    }
    if kind in limits:
        limit = next(iter(context.values()))
        return f"{limits[kind]} {limit:g}"
    plain = {
        "float_type": "a number",
        "int_type": "a whole number",
        "string_type": "a text",
        "bool_type": "true or false",
        "string_too_short": "a non-empty text",
        "list_type": "a list",
        "dict_type": "a mapping (key: value)",
        "model_type": "a mapping (key: value)",
        "too_short": "a list with at least one entry",
        "list_of_no_rows": "a list of rows",
    }
    return plain.get(kind, f"valid ({kind.replace('_', ' ')})")


def _keys_of_profile(section: Any, known: list[str]) -> list[str]:
    """Return of the keys of any profile of a scenario those that its kind has; other keys as they are."""
    from obsynth.simulation.scenario import PROFILE_KINDS
    from obsynth.specs import schema

    kind = section.get("kind") if isinstance(section, dict) else None
    if known != list(schema.ProfileSection.model_fields) or not isinstance(kind, str) or kind not in PROFILE_KINDS:
        return known
    return ["kind", *(part.name for part in fields(PROFILE_KINDS[kind]))]


def _known_keys(location: Sequence[str | int]) -> list[str]:
    """Return the keys that the section around the last part of ``location`` may have."""
    from obsynth.specs import schema, schema_plants, schema_values

    sections: dict[str, type[BaseModel]] = {
        "<file>": schema_values.MatrixFile,
        "<one>": schema.ProfileSection,
        "method": schema.MethodSection,
        "transform": schema_plants.TransformSection,
    }
    if "<pick>" in location:
        return ["outputs" if {"C", "Df", "Dd"} & set(location) else "states", "file"]
    if "<list>" in location and location[0] == "scenario":
        return list(schema.ProfileSection.model_fields)
    section = sections.get(str(location[-2]))
    return list(section.model_fields) if section is not None else []
