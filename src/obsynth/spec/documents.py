"""Reading text documents (YAML, JSON) into plain data; every way a file can be bad is a `SpecError`."""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any

from obsynth.errors import SpecError
from obsynth.files.inputs import read_json, read_text


def read_yaml(path: Path, *, where: str | None = None) -> dict[str, Any]:
    """Return the mapping in a YAML 1.2 document; duplicate keys, tags and anchors used twice are refused."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError, YAMLWarning

    place = where or str(path)
    text = read_text(path, where=place)
    if re.search(r"^%YAML\s+(?!1\.2\s*$)", text, flags=re.MULTILINE):
        raise SpecError(f"{path} asks for another YAML than 1.2: remove the %YAML line.", path=place)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", YAMLWarning)
            document = YAML(typ="safe", pure=True).load(text)
    except (YAMLError, YAMLWarning) as error:
        raise SpecError(f"{path} is no valid YAML: {_one_line(error)}", path=place) from error
    except RecursionError as error:
        raise SpecError(f"{path} is no valid spec: it is nested too deeply.", path=place) from error
    except (ValueError, TypeError, OverflowError, AttributeError) as error:
        raise SpecError(f"{path} has a value that YAML cannot read: {error}.", path=place) from error
    if document is None:
        raise SpecError(f"{path} is empty.", path=place)
    if not isinstance(document, dict):
        raise SpecError(
            f"{path} holds {described(document)}: the top level must be a mapping (key: value).", path=place
        )
    return document


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


#: Whole numbers from here on are not printed.
LONGEST_NUMBER = 1e15


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
    return "a list" if isinstance(value, list) else f"a {type(value).__name__}"


def _one_line(error: Exception) -> str:
    """Return what the YAML reader says about the place and the problem, without the quoted source."""
    problem = getattr(error, "problem", None) or str(error).strip().splitlines()[0]
    # The reader adds what it has of the values, which is empty where they are mappings.
    problem = re.sub(r"^(found duplicate key .*?) with value .*", r"\1", str(problem), flags=re.DOTALL)
    mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
    place = f" (line {mark.line + 1}, column {mark.column + 1})" if mark is not None else ""
    return f"{str(problem).strip()}{place}."
