"""Mutations of documents: values that no number is, missing, doubled and foreign keys, broken text."""

from __future__ import annotations

import copy
import json
import random
from collections.abc import Callable, Iterator
from typing import Any

#: Values put in the place of any value.
VALUES: tuple[Any, ...] = (
    None, True, "", " ", "0", "x1", "${", "$x$", "=1+1", "@SUM(A1)", "a" * 5000, "\u202e", "\u00e9", "\ud83d\ude00",
    "nan", ".5", "1e3", "der(x)", "1/0", "((((((((((1))))))))))", "where(1>0,1,2)", 0, 1, -1, 2, 3, 7, 10**400,
    -(10**25), 2**63, 0.0, -0.0, 0.5, -0.5, 1.0, 1e-320, 5e-324, 1e-300, 1e-200, 1e-15, 1e15, 1e100, 1e200,
    1e300, 1e308, -1e308,
    float("nan"), float("inf"), float("-inf"), [], {}, [[]], [[1.0]], [[1.0, 2.0], [3.0]], [[0.0]], [1.0], [[[1.0]]],
    [None], [[None]], [["1"]], [[True]], {"file": "A.csv"}, {"file": ""}, {"file": "../A.csv"}, {"file": "missing.mtx"},
    {"file": "."}, {"file": "A.csv", "variable": "A"}, {"file": "plant.yaml"}, {"file": "spec.yaml"},
    {"outputs": ["x1"]}, {"outputs": []}, {"states": ["x1"]}, {"a": {"a": {"a": {}}}}, [[1e200, 0.0], [0.0, 1e-200]],
)  # fmt: skip
#: Keys that some section knows.
KEYS = (
    "dt", "E", "A", "B", "C", "D", "Bf", "Df", "Bd", "Dd", "Bw", "Dw", "kind", "file", "transform", "sample_time",
    "horizon", "gamma", "poles", "S", "delta", "decay", "Q", "R", "form", "noise", "faults", "inputs", "state_names",
    "fault_names", "operating_point", "scales", "units", "sensor_noise", "options", "id", "name", "scenario", "seed",
    "bounds", "initial_state", "pole_region", "fault_model", "constants", "definitions", "equations", "outputs",
    "\u00e9", "", "__class__", "0", "true", "schema_version", "initial_covariance", "window",
    "eliminate_algebraic_states",
)  # fmt: skip
METHODS = (
    "fault-estimation-filter", "pd-observer", "ui-pi-observer", "adaptive-observer", "descriptor-kalman",
    "dae-adaptive-observer", "functional-filter", "no-such-method",
)  # fmt: skip


def places(document: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the path of everything in a document."""
    if not isinstance(document, (dict, list)):
        return
    for key, value in document.items() if isinstance(document, dict) else enumerate(document):
        yield (*path, key)
        yield from places(value, (*path, key))


def holder_of(document: Any, path: tuple[Any, ...]) -> Any:
    """Return what directly holds the value at a path."""
    for key in path[:-1]:
        document = document[key]
    return document


def mutate_tree(document: dict[str, Any], rng: random.Random) -> tuple[dict[str, Any], str]:
    """Return a mutated copy of a document, and what was done."""
    document = copy.deepcopy(document)
    found = sorted(places(document), key=repr)
    # Entries of matrices are many: half of the mutations go to the keys above them.
    keys = [path for path in found if not isinstance(path[-1], int)]
    path = rng.choice(keys if keys and rng.random() < 0.5 else found)
    holder = holder_of(document, path)
    name, change = rng.choice(_CHANGES)
    change(holder, path[-1], rng)
    return document, f"{name} at {'.'.join(map(str, path))[:60]}"


def _replace(holder: Any, key: Any, rng: random.Random) -> None:
    holder[key] = copy.deepcopy(rng.choice(VALUES))


def _delete(holder: Any, key: Any, rng: random.Random) -> None:
    del holder[key]


def _double(holder: Any, key: Any, rng: random.Random) -> None:
    if isinstance(holder, list):
        holder.insert(key, copy.deepcopy(holder[key]))
    else:
        holder[f"{key}_"] = holder[key]


def _foreign(holder: Any, key: Any, rng: random.Random) -> None:
    if isinstance(holder, dict):
        holder[rng.choice(KEYS)] = copy.deepcopy(rng.choice(VALUES))
    else:
        holder.append(copy.deepcopy(rng.choice(VALUES)))


def _scale(holder: Any, key: Any, rng: random.Random) -> None:
    factor = 10.0 ** rng.choice((-308, -160, -30, -8, 8, 30, 160, 300))
    holder[key] = _mapped(holder[key], lambda value: value * factor)


def _swap(holder: Any, key: Any, rng: random.Random) -> None:
    others = list(holder) if isinstance(holder, dict) else range(len(holder))
    other = rng.choice(list(others))
    holder[key], holder[other] = holder[other], holder[key]


def _transpose(holder: Any, key: Any, rng: random.Random) -> None:
    value = holder[key]
    is_matrix = isinstance(value, list) and value and all(isinstance(row, list) and row for row in value)
    holder[key] = [list(row) for row in zip(*value, strict=False)] if is_matrix else [value]


def _method(holder: Any, key: Any, rng: random.Random) -> None:
    if isinstance(holder, dict) and "id" in holder:
        holder["id"] = rng.choice(METHODS)
    else:
        holder[key] = copy.deepcopy(rng.choice(VALUES))


def _wrap(holder: Any, key: Any, rng: random.Random) -> None:
    for _ in range(rng.choice((1, 2, 60, 150))):
        holder[key] = [holder[key]]


def _mapped(value: Any, change: Callable[[float], float]) -> Any:
    if isinstance(value, bool):
        return value
    if isinstance(value, (int, float)):
        return change(float(value)) if abs(value) < 1e308 else value
    if isinstance(value, list):
        return [_mapped(item, change) for item in value]
    return {key: _mapped(item, change) for key, item in value.items()} if isinstance(value, dict) else value


_CHANGES: tuple[tuple[str, Callable[[Any, Any, random.Random], None]], ...] = (
    ("value", _replace), ("value", _replace), ("value", _replace), ("value", _replace), ("missing", _delete),
    ("missing", _delete), ("double", _double), ("foreign", _foreign), ("foreign", _foreign), ("scale", _scale),
    ("scale", _scale), ("swap", _swap), ("transpose", _transpose), ("method", _method), ("wrap", _wrap),
)  # fmt: skip


def mutate_text(text: str, rng: random.Random) -> tuple[bytes, str]:
    """Return the bytes of a broken text, and what was done."""
    name, change = rng.choice(_BREAKS)
    return change(text, rng), name


def yaml_text(value: Any) -> str:
    """Return a document as JSON, which is YAML; with what YAML writes for special floats."""
    return json.dumps(value).replace("NaN", ".nan").replace("-Infinity", "-.inf").replace("Infinity", ".inf")


def _spliced(extra: str) -> Callable[[str, random.Random], bytes]:
    def change(text: str, rng: random.Random) -> bytes:
        at = rng.randrange(len(text) + 1)
        return (text[:at] + extra + text[at:]).encode("utf-8", "surrogatepass")

    return change


def _cut(text: str, rng: random.Random) -> bytes:
    return text[: rng.randrange(len(text))].encode()


def _dropped(text: str, rng: random.Random) -> bytes:
    at = rng.randrange(len(text))
    return (text[:at] + text[at + rng.choice((1, 2, 10)) :]).encode()


def _garbage(text: str, rng: random.Random) -> bytes:
    content = bytearray(text.encode())
    for _ in range(rng.choice((1, 3, 20))):
        content[rng.randrange(len(content))] = rng.randrange(256)
    return bytes(content)


def _doubled_line(text: str, rng: random.Random) -> bytes:
    lines = text.splitlines()
    lines.insert(rng.randrange(len(lines) + 1), rng.choice(lines))
    return "\n".join(lines).encode()


def _in_front(extra: bytes) -> Callable[[str, random.Random], bytes]:
    return lambda text, rng: extra + text.encode()


_ALIASES = "a0: &a0 [1,1,1,1,1,1,1,1,1]\n" + "".join(
    f"a{i}: &a{i} [{','.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 12)
)
_BREAKS: tuple[tuple[str, Callable[[str, random.Random], bytes]], ...] = (
    ("cut", _cut), ("dropped", _dropped), ("dropped", _dropped), ("garbage", _garbage), ("garbage", _garbage),
    ("doubled line", _doubled_line), ("doubled line", _doubled_line),
    ("CR line ends", lambda text, rng: text.replace("\n", "\r").encode()),
    ("CRLF line ends", lambda text, rng: text.replace("\n", "\r\n").encode()),
    ("byte order mark", _in_front(b"\xef\xbb\xbf")), ("UTF-16", lambda text, rng: text.encode("utf-16")),
    ("Latin-1", lambda text, rng: (text + "\n# \u00e9\n").encode("latin-1", "replace")), ("null", _spliced("\0")),
    ("tab", _spliced("\t")), ("anchor bomb", _in_front(_ALIASES.encode())),
    ("tag", _spliced("!!python/object:os.system ")),
    ("alias", _spliced("*x ")), ("merge", _spliced("\n<<: {a: 1}\n")), ("brackets", _spliced("[" * 5000)),
    ("braces", _spliced("{a: " * 3000)), ("document end", _spliced("\n---\n")),
    ("directive", _in_front(b"%YAML 1.1\n---\n")),
    ("question", _spliced("? [1, 2]\n: 3\n")), ("long number", _spliced("9" * 5000)), ("exponent", _spliced("1e400")),
    ("dollar", _spliced("${HOME}")), ("half pair", _spliced("\ud800")), ("escape", _spliced('"\\ud800"')),
    ("date", _spliced("2020-01-01")), ("sexagesimal", _spliced("1:30")), ("control", _spliced("\x1b[31m")),
)  # fmt: skip
