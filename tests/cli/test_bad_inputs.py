"""Bad input: each malformed spec, plant or file ends in the right error, exit code and message, and leaves no file.

The table's base is the paper's example, which is good (`test_the_base_is_good`); each case breaks one thing.
"""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io

from obsynth.cli.main import main
from obsynth.errors import InfeasibleError, ObsynthError, PreconditionError, SpecError

BASE: dict[str, Any] = {
    "schema_version": 1,
    "name": "case",
    "plant": {
        "dt": 1.0,
        "E": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 0]],
        "A": [[0.9, 0.005, -0.095, 0], [0.005, 0.995, 0.0997, 0], [0.095, -0.0997, 0.99, 0], [1, 0, 1, 1]],
        "B": [[0.1, 0], [1, 1], [-0.1, 1], [-1, 0]],
        "C": [[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
        "Bf": [[0.1, 0], [1, 1], [-0.1, 1], [-1, 0]],
        "Bd": [[1], [1], [1], [0]],
    },
    "method": {"id": "fault-estimation-filter", "options": {}},
}


@dataclass(frozen=True)
class Case:
    """One bad input: how the base is broken, and what must be said about it."""

    name: str
    change: Callable[[dict[str, Any]], Any]
    fragment: str
    error: type[ObsynthError] = SpecError
    files: Callable[[Path], Any] | None = None
    more: tuple[str, ...] = ()
    details: dict[str, Any] = field(default_factory=dict)


def put(*keys_and_value: Any) -> Callable[[dict[str, Any]], None]:
    """Return a change that sets one entry, such as ``put("plant", "dt", -1)``."""
    *keys, last, value = keys_and_value

    def change(document: dict[str, Any]) -> None:
        place: Any = document
        for key in keys:
            place = place.setdefault(key, {}) if isinstance(place, dict) else place[key]
        place[last] = value

    return change


def drop(*keys: str) -> Callable[[dict[str, Any]], None]:
    """Return a change that removes one entry."""

    def change(document: dict[str, Any]) -> None:
        place = document
        for key in keys[:-1]:
            place = place[key]
        del place[keys[-1]]

    return change


def text(old: str, new: str) -> Callable[[dict[str, Any]], str]:
    """Return a change of the document's text; what it replaces must be there."""

    def change(document: dict[str, Any]) -> str:
        written = yaml_text(document)
        assert old in written
        return written.replace(old, new, 1)

    return change


def whole(content: str) -> Callable[[dict[str, Any]], str]:
    """Return a change that replaces the whole document."""
    return lambda document: content


def plant(**matrices: Any) -> Callable[[dict[str, Any]], None]:
    """Return a change that replaces the whole plant."""

    def change(document: dict[str, Any]) -> None:
        document["plant"] = {"dt": 1.0, **matrices}

    return change


def yaml_text(document: dict[str, Any]) -> str:
    """Return a document as YAML (JSON, with YAML's words for special floats)."""
    return json.dumps(document).replace("NaN", ".nan").replace("-Infinity", "-.inf").replace("Infinity", ".inf")


def zeros(rows: int, columns: int) -> list[list[float]]:
    return np.zeros((rows, columns)).tolist()


def eye(size: int) -> list[list[float]]:
    return np.eye(size).tolist()


def written(name: str, content: str | bytes) -> Callable[[Path], Any]:
    """Return what puts a file beside the spec."""
    return lambda folder: (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)


def saved_npz(folder: Path) -> None:
    np.savez(folder / "two.npz", A=np.eye(4), B=np.eye(4))


def saved_complex(folder: Path) -> None:
    scipy.io.mmwrite(folder / "complex.mtx", np.eye(4) * 1j)


SYNTAX = [
    Case("empty file", whole(""), "is empty"),
    Case("only a comment", whole("# nothing\n"), "is empty"),
    Case("list at the top", whole("[1, 2]"), "the top level must be a mapping"),
    Case("text at the top", whole("spec"), "the top level must be a mapping"),
    Case("not YAML", whole("schema_version: [1\nname: x"), "is not valid YAML"),
    Case("tab as indent", whole("schema_version: 1\nplant:\n\tdt: 1\n"), "line 3"),
    Case("two documents", whole("a: 1\n---\nb: 2\n"), "is not valid YAML"),
    Case("another YAML", whole("%YAML 1.1\n---\nschema_version: 1\n"), "%YAML"),
    Case(
        "duplicate key at the top",
        text('"name": "case"', '"name": "case", "name": "other"'),
        'the key "name" is repeated',
    ),
    Case("duplicate key in the plant", text('"dt": 1.0', '"dt": 1.0, "dt": 2.0'), 'the key "dt" is repeated'),
    Case(
        "duplicate key of mappings",
        text('"options": {}', '"options": {}, "options": {"S": 1}'),
        'the key "options" is repeated',
    ),
    Case("code in a tag", text('"case"', "!!python/object/apply:os.getcwd []"), "could not determine a constructor"),
    Case("value YAML cannot read", text('"case"', "2020-13-45"), "a value that YAML cannot read"),
    Case("undefined alias", text('"case"', "*nowhere"), "has no anchor &nowhere"),
    Case("nested too deeply", whole("a: " + "[" * 1000), "nested too deeply"),
]

SCHEMA = [
    Case(
        "empty mapping",
        whole("{}"),
        "schema_version: this key is missing",
        more=("name: this key", "plant: this key"),
    ),
    Case("unknown schema version", put("schema_version", 2), "schema_version: version 2 is unknown"),
    Case("schema version as text", put("schema_version", "1"), "schema_version: must be a whole number"),
    Case("no name", drop("name"), "name: this key is missing"),
    Case("name that is a path", put("name", "../case"), "name: use letters"),
    Case("unknown key at the top", put("scenarios", {}), "scenarios: unknown key"),
    Case("unknown key in the plant", put("plant", "Cd", [[1]]), "plant.Cd: unknown key"),
    Case(
        "unknown key in the method", put("method", "option", {}), "method.option: unknown key. Did you mean 'options'?"
    ),
    Case("unknown key in the transform", put("plant", "transform", {"ts": 1}), "plant.transform.ts: unknown key"),
    Case("unknown key of a file", put("plant", "A", {"file": "a.csv", "name": "A"}), "plant.A.name: unknown key"),
    Case(
        "unknown option", put("method", "options", "gama", 2), "method.options.gama: unknown key. Did you mean 'gamma'?"
    ),
    Case("no plant", drop("plant"), "plant: this key is missing"),
    Case("plant as list", put("plant", [[1]]), "plant: must be a mapping"),
    Case("no A", drop("plant", "A"), "plant.A: this key is missing"),
    Case("no C", drop("plant", "C"), "plant.C: this key is missing"),
    Case("no dt", drop("plant", "dt"), "plant.dt: this key is missing"),
    Case(
        "unknown method",
        put("method", "id", "kalman"),
        "There are: adaptive-observer, auto, dae-adaptive-observer",
    ),
    Case("dt negative", put("plant", "dt", -0.1), "plant.dt: must be at least 0"),
    Case("dt as text", put("plant", "dt", "1.0"), "plant.dt: must be a number, not the text '1.0'"),
    Case("dt in volts", put("plant", "dt", "10 V"), "plant.dt: must be a number of seconds, or a time in us, "),
    Case("dt below zero with a unit", put("plant", "dt", "-10 ms"), "plant.dt: must be at least 0"),
    Case("dt NaN", put("plant", "dt", math.nan), "plant.dt: must be a finite number"),
    Case("dt infinite", put("plant", "dt", math.inf), "plant.dt: must be a finite number"),
    Case("dt as truth value", put("plant", "dt", True), "plant.dt: must be a number, not the truth value true"),
    Case(
        "text in A",
        put("plant", "A", 1, 2, "0.0997"),
        "plant.A: row 2, column 3 must be a number, not the text '0.0997'",
    ),
    Case("truth value in A", put("plant", "A", 0, 0, True), "plant.A: row 1, column 1 must be a number"),
    Case("null in A", put("plant", "A", 0, 0, None), "plant.A: row 1, column 1 must be a number, not nothing"),
    Case("NaN in A", put("plant", "A", 3, 0, math.nan), "plant.A: row 4, column 1 must be a finite number"),
    Case("infinity in C", put("plant", "C", 0, 0, -math.inf), "plant.C: row 1, column 1 must be a finite number"),
    Case("huge whole number in A", put("plant", "A", 0, 0, 10**400), "plant.A: row 1, column 1 must be a number"),
    Case("ragged A", put("plant", "A", 2, [1, 2]), "plant.A: row 3 has 2 entries, but row 1 has 4"),
    Case("A as one row", put("plant", "A", [1, 2]), "plant.A: must be a list of rows"),
    Case("A as a number", put("plant", "A", 1), "plant.A: must be a list of rows"),
    Case("A with zero rows", put("plant", "A", []), "plant.A: must be a list of rows"),
    Case("A with an empty row", put("plant", "A", [[]]), "plant.A: must be a list of rows"),
    Case("Bf with zero rows", put("plant", "Bf", []), "plant.Bf: must be a list of rows"),
    Case(
        "names that are numbers",
        put("plant", "state_names", ["a", 2, "c", "d"]),
        "plant.state_names: entry 2 must be a text",
    ),
    Case(
        "empty name",
        put("plant", "state_names", ["a", "", "c", "d"]),
        "plant.state_names: entry 2 must be a non-empty text",
    ),
    Case("empty pick", put("plant", "C", {"outputs": []}), "plant.C.outputs: must be a list with at least one entry"),
    Case("pick of outputs for Bf", put("plant", "Bf", {"outputs": ["x1"]}), "plant.Bf.outputs: unknown key"),
    Case("unit that is a number", put("plant", "units", {"x1": 1}), "plant.units.x1: must be a text"),
    Case(
        "operating point as text",
        put("plant", "operating_point", {"x1": "1"}),
        "plant.operating_point.x1: must be a number",
    ),
    Case(
        "sensor noise of zero", put("plant", "sensor_noise", {"y1": 0}), "plant.sensor_noise.y1: must be greater than 0"
    ),
    Case(
        "sample time zero",
        put("plant", "transform", {"sample_time": 0}),
        "plant.transform.sample_time: must be greater than 0",
    ),
    Case(
        "sample time negative",
        put("plant", "transform", {"sample_time": -1}),
        "plant.transform.sample_time: must be greater",
    ),
    Case("elimination as number", put("plant", "transform", "eliminate_algebraic_states", 1), "must be true or false"),
    Case("gamma negative", put("method", "options", "gamma", -1), "method.options.gamma: must be greater than 0"),
    Case(
        "delay too long",
        put("method", {"id": "functional-filter", "options": {"delay": 10**9}}),
        "method.options.delay: must be at most ",
    ),
    Case("gamma zero", put("method", "options", "gamma", 0), "method.options.gamma: must be greater than 0"),
    Case("gamma as text", put("method", "options", "gamma", "2"), "method.options.gamma: must be a number"),
    Case("gamma NaN", put("method", "options", "gamma", math.nan), "method.options.gamma: must be a finite number"),
    Case(
        "margin negative",
        put("method", "options", "gamma_margin", -0.1),
        "method.options.gamma_margin: must be at least 0.01",
    ),
    Case(
        "unknown solver",
        put("method", "options", "solver", "MOSEK"),
        "method.options.solver: there is no solver 'MOSEK' that does semidefinite programmes; installed are: ",
        more=("CLARABEL",),
    ),
    Case(
        "unknown search",
        put("method", "options", "gamma_search", "grid"),
        "method.options.gamma_search: must be one of",
    ),
    Case("tolerance of one", put("method", "options", "tolerance", 1), "method.options.tolerance: must be less than 1"),
    Case("switch as number", put("method", "options", "prove_least", 1), "must be true or false"),
    Case("S ragged", put("method", "options", "S", [[1, 0], [1]]), "method.options.S: row 2 has 1 entry"),
    Case("options as list", put("method", "options", [1]), "method.options: must be a mapping"),
]

SHAPES = [
    Case("A not square", put("plant", "A", zeros(4, 3)), "A is 4 by 3, but it must be square"),
    Case("E too small", put("plant", "E", eye(3)), "E is 3 by 3, but 4 by 4 is needed"),
    Case("B too short", put("plant", "B", zeros(3, 2)), "B is 3 by 2, but 4 by 2 is needed"),
    Case("C too wide", put("plant", "C", zeros(3, 5)), "C is 3 by 5, but 3 by 4 is needed"),
    Case("D too wide", put("plant", "D", zeros(3, 3)), "D is 3 by 3, but 3 by 2 is needed"),
    Case("Bf too short", put("plant", "Bf", eye(2)), "Bf is 2 by 2, but 4 by 2 is needed"),
    Case("Df too wide", put("plant", "Df", zeros(3, 3)), "Df is 3 by 3, but 3 by 2 is needed"),
    Case("Bd too short", put("plant", "Bd", zeros(1, 1)), "Bd is 1 by 1, but 4 by 1 is needed"),
    Case("Dd too long", put("plant", "Dd", zeros(4, 1)), "Dd is 4 by 1, but 3 by 1 is needed"),
    Case("Bw too long", put("plant", "Bw", zeros(5, 1)), "Bw is 5 by 1, but 4 by 1 is needed"),
    Case("Dw too short", put("plant", "Dw", zeros(2, 1)), "Dw is 2 by 1, but 3 by 1 is needed"),
    Case("S of a wrong shape", put("method", "options", "S", eye(4)), "S is 4 by 4"),
    Case("too few names", put("plant", "state_names", ["a"]), "state_names has 1 name, but the plant has 4 states"),
    Case("repeated names", put("plant", "output_names", ["a", "b", "a"]), "output_names repeats 'a'"),
    Case("one state measured twice", put("plant", "C", {"outputs": ["x2", "x2"]}), "repeats 'x2'"),
    Case("unknown output", put("plant", "C", {"outputs": ["x2", "x9"]}), "C has no signal named 'x9'"),
    Case("unknown state of a fault", put("plant", "Bf", {"states": ["torque"]}), "Bf has no signal named 'torque'"),
    Case("unknown state of a disturbance", put("plant", "Bd", {"states": ["x5"]}), "Bd has no signal named 'x5'"),
    Case("unknown noisy sensor", put("plant", "sensor_noise", {"y4": 1}), "sensor_noise has no signal named 'y4'"),
    Case("unknown operating point", put("plant", "operating_point", {"q": 1}), "operating_point names 'q'"),
    Case("unknown unit", put("plant", "units", {"q": "rad"}), "units names 'q'"),
]

FILES = [
    Case("missing matrix file", put("plant", "A", {"file": "A.mtx"}), "A.mtx does not exist", more=("plant.A:",)),
    Case(
        "matrix file is a folder",
        put("plant", "A", {"file": "A.mtx"}),
        "is a folder",
        files=lambda d: (d / "A.mtx").mkdir(),
    ),
    Case("matrix file of unknown kind", put("plant", "A", {"file": "A.xlsx"}), "unknown suffix", more=("plant.A:",)),
    Case(
        "mtx damaged",
        put("plant", "A", {"file": "A.mtx"}),
        "cannot be read as a matrix",
        files=written("A.mtx", "%%MatrixMarket matrix array real general\n4 4\n1\n"),
    ),
    Case(
        # scipy's reader crashes the interpreter on this one.
        "mtx cut within a number",
        put("plant", "A", {"file": "A.mtx"}),
        "cannot be read as a matrix",
        files=written("A.mtx", "%%MatrixMarket matrix array real general\n1 1\n3.64E"),
    ),
    Case(
        "mtx index outside",
        put("plant", "A", {"file": "A.mtx"}),
        "an index is outside the matrix",
        files=written("A.mtx", "%%MatrixMarket matrix coordinate real general\n2 2 1\n3 1 1.0\n"),
    ),
    Case("mtx empty", put("plant", "A", {"file": "A.mtx"}), "cannot be read as a matrix", files=written("A.mtx", "")),
    Case("mtx complex", put("plant", "A", {"file": "complex.mtx"}), "complex numbers", files=saved_complex),
    Case(
        "mtx enormous",
        put("plant", "A", {"file": "A.mtx"}),
        "is too large",
        files=written("A.mtx", "%%MatrixMarket matrix coordinate real general\n100000 100000 1\n1 1 1.0\n"),
    ),
    Case("csv with a header", put("plant", "A", {"file": "A.csv"}), "plant.A", files=written("A.csv", "a,b\n1,2\n")),
    Case("csv ragged", put("plant", "A", {"file": "A.csv"}), "plant.A", files=written("A.csv", "1,2\n3\n")),
    Case(
        "csv with nan",
        put("plant", "A", {"file": "A.csv"}),
        "every entry must be finite",
        files=written("A.csv", "nan,2\n3,4\n"),
    ),
    Case("csv empty", put("plant", "A", {"file": "A.csv"}), "plant.A", files=written("A.csv", "")),
    Case("csv not text", put("plant", "A", {"file": "A.csv"}), "plant.A", files=written("A.csv", b"\xff\xfe\x00")),
    Case("npz damaged", put("plant", "A", {"file": "A.npz"}), "plant.A", files=written("A.npz", b"PK\x03\x04 cut off")),
    Case("npz that is none", put("plant", "A", {"file": "A.npz"}), "no .npz archive", files=written("A.npz", b"text")),
    Case("npz with two arrays", put("plant", "A", {"file": "two.npz"}), "which array is meant", files=saved_npz),
    Case(
        "npz without the array",
        put("plant", "A", {"file": "two.npz", "variable": "Q"}),
        "no array 'Q'",
        files=saved_npz,
    ),
    Case("mat damaged", put("plant", "A", {"file": "A.mat"}), "plant.A", files=written("A.mat", b"MATLAB 5.0 cut off")),
    Case("variable of a csv", put("plant", "A", {"file": "A.csv", "variable": "A"}), "remove 'variable'"),
    Case("missing names file", put("plant", "state_names", {"file": "n.json"}), "n.json does not exist"),
    Case(
        "names file not JSON",
        put("plant", "state_names", {"file": "n.json"}),
        "is not a JSON document",
        files=written("n.json", "['a']"),
    ),
    Case(
        "names file with numbers",
        put("plant", "state_names", {"file": "n.json"}),
        "names must be texts",
        files=written("n.json", "[1, 2, 3, 4]"),
    ),
    Case(
        "names file of one text",
        put("plant", "state_names", {"file": "n.json"}),
        "must hold a list of names",
        files=written("n.json", '"abcd"'),
    ),
    Case("names file of another kind", put("plant", "state_names", {"file": "n.txt"}), "unknown suffix"),
    Case(
        "missing plant file",
        put("plant", {"file": "plant.yaml"}),
        "plant.yaml does not exist",
        more=("spec.yaml, line ",),
    ),
    Case("plant file is a folder", put("plant", {"file": "p"}), "is a folder", files=lambda d: (d / "p").mkdir()),
    Case("plant file and more", put("plant", {"file": "plant.yaml", "dt": 1}), "plant.dt: unknown key"),
    Case(
        "plant file without version",
        put("plant", {"file": "p.yaml"}),
        "schema_version: this key is missing",
        files=written("p.yaml", "dt: 1\nA: [[1]]\nC: [[1]]\n"),
    ),
    Case(
        "plant file with a typo",
        put("plant", {"file": "p.yaml"}),
        "A: row 1, column 1 must be a number",
        files=written("p.yaml", "schema_version: 1\ndt: 1\nA: [[one]]\nC: [[1]]\n"),
        more=("p.yaml",),
    ),
    Case("S file missing", put("method", "options", "S", {"file": "S.mtx"}), "method.options.S: "),
]

# One input, one output, one fault, with a zero at -c.
TWO_STATES = {"A": [[0, 1], [-0.1, 0.3]], "B": [[0], [1]], "Bf": [[0], [1]]}


def impossible(
    name: str, change: Callable[[dict[str, Any]], Any], condition: str, fragment: str, **details: Any
) -> Case:
    """Return a case of a plant that is well formed, but for which an existence condition fails."""
    return Case(name, change, fragment, PreconditionError, details={"condition": condition, **details})


def eliminated(**changes: Any) -> Callable[[dict[str, Any]], None]:
    """Return a change to a continuous plant of which the algebraic states are to be eliminated."""
    return plant(dt=0.0, C=[[1, 0]], Bf=[[1], [0]], transform={"eliminate_algebraic_states": True}, **changes)


PRECONDITIONS = [
    impossible("continuous plant", put("plant", "dt", 0), "discrete time", "a continuous plant. Sample it first"),
    impossible(
        "not regular",
        plant(E=[[1, 0], [0, 0]], A=[[0.5, 0], [0, 0]], C=[[1, 0]], Bf=[[1], [0]]),
        "regularity",
        "det(A - zE)",
    ),
    impossible(
        "rank [E; C]",
        lambda spec: (
            spec["plant"].update(C=[[0, 1, 0, 0], [0, 0, 1, 0]]),
            # What is given for the states as written keeps them.
            spec["method"]["options"].update(S=[[0] * 6] * 4),
        ),
        "rank [E; C]",
        "Needed: rank [E; C] = 4.",
        signals=["x4"],
    ),
    impossible(
        "rank Bf",
        put("plant", "Bf", [[0.1, 0.1], [1, 1], [-0.1, -0.1], [-1, -1]]),
        "rank F",
        "Needed: rank F = 2.",
        signals=["f1", "f2"],
    ),
    impossible(
        "fault without effect",
        put("plant", "Bf", [[0.1, 0], [1, 0], [-0.1, 0], [-1, 0]]),
        "rank F",
        "Needed: rank F = 2.",
        signals=["f2"],
    ),
    impossible("more faults than outputs", put("plant", "Bf", eye(4)), "nf <= ny", "4 faults and 3 outputs"),
    impossible("no fault", drop("plant", "Bf"), "faults", "at least one fault"),
    impossible(
        "zero on the unit circle",
        plant(C=[[1, 1]], **TWO_STATES),
        "fault zeros",
        "zero z = -1",
        mode=[-1, 0],
        signals=["f1"],
    ),
    impossible(
        "zero outside the unit circle",
        plant(C=[[2, 1]], **TWO_STATES),
        "fault zeros",
        "zero z = -2",
        mode=[-2, 0],
        signals=["f1"],
    ),
    impossible(
        "undetectable mode",
        plant(A=[[2, 0], [0, 0.5]], C=[[0, 1]], Bf=[[0], [1]]),
        "fault zeros",
        "mode z = 2",
        mode=[2, 0],
        signals=["x1"],
    ),
    impossible(
        "fault that no output sees",
        plant(A=[[0.5, 0], [0, 0.5]], C=[[1, 0]], Bf=[[0], [1]]),
        "finite detectability indexes",
        "'f1' reaches no output",
        signals=["f1"],
    ),
    impossible(
        "faults that look alike",
        plant(A=(0.5 * np.eye(3)).tolist(), C=[[1, 0, 0], [0, 1, 0]], Bf=[[1, 1], [0, 0], [1, 0]]),
        "rank Upsilon",
        "'f1', 'f2' cannot be distinguished",
    ),
    impossible(
        "fault that looks like a state",
        plant(E=[[1, 0], [0, 0]], A=[[0.5, 1], [1, 0]], C=[[0, 1]], Bf=[[0], [0]], Df=[[1]]),
        "rank [E 0; 0 0; C Df]",
        "f1",
        signals=["f1"],
    ),
    impossible("elimination of index 2", eliminated(E=[[0, 1], [0, 0]], A=eye(2)), "index", "index 2"),
    impossible(
        "elimination, not regular", eliminated(E=[[1, 0], [0, 0]], A=[[1, 1], [0, 0]]), "regularity", "not regular"
    ),
    impossible(
        "elimination of everything", eliminated(E=zeros(2, 2), A=eye(2)), "dynamic states", "Every state is algebraic"
    ),
    Case("sampling of a discrete plant", put("plant", "transform", {"sample_time": 0.1}), "discrete in time already"),
    Case(
        "gamma below the optimum",
        put("method", "options", {"weight": "paper", "gamma": 1.0}),
        "1.46472",
        InfeasibleError,
        details={"necessary": False},
    ),
]

CASES = [*SYNTAX, *SCHEMA, *SHAPES, *FILES, *PRECONDITIONS]


def files_in(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


def test_the_table_is_long_and_its_names_are_unique() -> None:
    assert len({case.name for case in CASES}) == len(CASES)
    assert len(CASES) >= 40


def test_the_base_is_good(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "spec.yaml").write_text(yaml_text(BASE), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    assert main(["design", "--system", "spec.yaml", "--json", "--quiet"]) == 0
    assert json.loads(capsys.readouterr().out)["passed"] is True
    assert files_in(tmp_path) == {"spec.yaml", "case.gains.json"}


@pytest.mark.one_in(4)
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_bad_spec(
    case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    document = copy.deepcopy(BASE)
    changed = case.change(document)
    (tmp_path / "spec.yaml").write_text(changed if isinstance(changed, str) else yaml_text(document), encoding="utf-8")
    if case.files is not None:
        case.files(tmp_path)
    before = files_in(tmp_path)
    monkeypatch.chdir(tmp_path)

    code = main(["design", "--system", "spec.yaml", "--json", "--quiet"])

    printed = capsys.readouterr()
    error = json.loads(printed.out)
    assert (error["error"], error["exit_code"], code) == (
        case.error.__name__,
        case.error.exit_code,
        case.error.exit_code,
    )
    for fragment in (case.fragment, *case.more):
        assert fragment in error["message"]
    for name, value in case.details.items():
        assert error[name] == (pytest.approx(value, abs=1e-6) if name == "mode" else value)
    assert error["message"] in printed.err
    assert "Traceback" not in printed.err
    assert files_in(tmp_path) == before


class TestSpecFileItself:
    @pytest.mark.parametrize("verb", ["design", "check"])
    @pytest.mark.parametrize(
        ("prepare", "fragment"),
        [
            (lambda path: None, "spec.yaml does not exist"),
            (lambda path: path.mkdir(), "spec.yaml is a folder"),
            (lambda path: path.write_bytes(b"# one\nname: \xff\n"), "is no UTF-8 text (line 2): save it as UTF-8"),
        ],
        ids=["missing", "a folder", "not UTF-8"],
    )
    def test_unreadable(
        self, prepare: Any, fragment: str, verb: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        prepare(tmp_path / "spec.yaml")
        assert main([verb, "--system", str(tmp_path / "spec.yaml")]) == 2
        printed = capsys.readouterr()
        assert printed.out == ""
        assert fragment in printed.err


class TestOutput:
    @pytest.mark.parametrize(
        ("output", "fragment"),
        [
            ("missing/gains.json", "The folder missing does not exist"),
            (".", "is a folder"),
            ("spec.yaml", "is the spec itself"),
        ],
    )
    def test_bad_place(
        self, output: str, fragment: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str],
    ) -> None:  # fmt: skip
        content = yaml_text(BASE)
        (tmp_path / "spec.yaml").write_text(content, encoding="utf-8")
        monkeypatch.chdir(tmp_path)
        assert main(["design", "--system", "spec.yaml", "--output", output, "--quiet"]) == 2
        assert fragment in capsys.readouterr().err
        assert files_in(tmp_path) == {"spec.yaml"}
        assert (tmp_path / "spec.yaml").read_text(encoding="utf-8") == content


@pytest.fixture(scope="module")
def good_gains(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return the text of a good gain set."""
    folder = tmp_path_factory.mktemp("good")
    (folder / "spec.yaml").write_text(yaml_text(BASE), encoding="utf-8")
    target = folder / "gains.json"
    assert main(["design", "--system", str(folder / "spec.yaml"), "--output", str(target), "--quiet"]) == 0
    assert main(["verify", str(target)]) == 0
    return target.read_text(encoding="utf-8")


def tampered(content: str, change: Callable[[dict[str, Any]], Any], *, mend_digest: bool = False) -> str:
    """Return a gain set with something changed, and its digest made to fit again if asked."""
    from obsynth.results.gain_set_writing import digest_of

    document = json.loads(content)
    change(document)
    if mend_digest:
        document["sha256"] = digest_of(document["design"])
    return json.dumps(document)


def nudged_gain(document: dict[str, Any]) -> None:
    document["design"]["observer"]["By"]["data"][0] += 1e-3


BAD_GAINS: list[tuple[str, Callable[[str], str], str]] = [
    ("empty", lambda good: "", "is not a JSON document"),
    ("not JSON", lambda good: "gains: 1", "is not a JSON document"),
    ("truncated", lambda good: good[: len(good) // 2], "is not a JSON document"),
    ("a list", lambda good: "[]", "is no gain set"),
    ("another document", lambda good: '{"kind": "recipe"}', "is no gain set"),
    ("nested too deeply", lambda good: "[" * 100_000, "is not a JSON document"),
    ("another version", lambda good: tampered(good, put("schema_version", 99)), "schema version 99"),
    (
        "NaN as a gain",
        lambda good: tampered(good, put("design", "observer", "By", "data", 0, float("nan"))),
        "gains.json",
    ),
    ("a changed gain", lambda good: tampered(good, nudged_gain), "digest does not match"),
    ("a changed name", lambda good: tampered(good, put("design", "name", "other")), "digest does not match"),
    ("no digest", lambda good: tampered(good, drop("sha256")), "digest does not match"),
    ("no plant", lambda good: tampered(good, drop("design", "plant"), mend_digest=True), "incomplete"),
    ("no observer", lambda good: tampered(good, drop("design", "observer", "Az"), mend_digest=True), "incomplete"),
    ("observer as list", lambda good: tampered(good, put("design", "observer", []), mend_digest=True), "incomplete"),
    (
        "certificate as null",
        lambda good: tampered(good, put("design", "certificate", None), mend_digest=True),
        "incomplete",
    ),
    ("report as text", lambda good: tampered(good, put("design", "report", "fine"), mend_digest=True), "incomplete"),
]


class TestGainSets:
    @pytest.mark.parametrize(("name", "damage", "fragment"), BAD_GAINS, ids=[name for name, _, _ in BAD_GAINS])
    def test_damaged(
        self, name: str, damage: Callable[[str], str], fragment: str, good_gains: str, tmp_path: Path,
        capsys: pytest.CaptureFixture[str],
    ) -> None:  # fmt: skip
        path = tmp_path / "gains.json"
        path.write_text(damage(good_gains), encoding="utf-8")
        assert main(["verify", str(path), "--json"]) == 2
        printed = capsys.readouterr()
        error = json.loads(printed.out)
        assert error["error"] == "SpecError"
        assert fragment in error["message"]
        assert str(path) in error["message"]
        assert files_in(tmp_path) == {"gains.json"}

    @pytest.mark.parametrize(
        ("prepare", "fragment"),
        [(lambda path: None, "does not exist"), (lambda path: path.mkdir(), "is a folder: give the name of a file")],
        ids=["missing", "a folder"],
    )
    def test_unreadable(self, prepare: Any, fragment: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        prepare(tmp_path / "gains.json")
        assert main(["verify", str(tmp_path / "gains.json")]) == 2
        assert fragment in capsys.readouterr().err

    def test_a_changed_gain_with_a_mended_digest_is_caught_by_verification(
        self, good_gains: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        path = tmp_path / "gains.json"
        path.write_text(tampered(good_gains, nudged_gain, mend_digest=True), encoding="utf-8")
        assert main(["verify", str(path), "--json"]) == 6
        found = json.loads(capsys.readouterr().out)
        assert found["passed"] is False
        assert not all(check["passed"] for check in found["report"]["checks"])
