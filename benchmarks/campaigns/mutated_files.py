"""Gain sets, saved states and logs, mutated (with their digests made to fit again), and outputs at impossible places.

A case takes the files of one of five designs, changes one or two of them, and runs `verify`, `run`, `export`, `report`
or `simulate` on them, in this process.  Right is: a documented exit code, a sentence with every code but 0, no
traceback and no words of Python, no file changed but the outputs, nothing left behind.  Columns: the exit code.
"""

from __future__ import annotations

import hashlib
import json
import os
import random
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

from benchmarks.campaigns._commands import make_special, run
from benchmarks.campaigns._mutations import mutate_text, mutate_tree
from benchmarks.campaigns.frame import Outcome

CASES = 1000
LIMIT = 180.0  # s

_DESIGNS = Path(__file__).parents[2] / "designs"
_BASES = ("wang2015/spec", "wang2015/spec", "smib/pd_observer", "filasova/spec", "diode_circuit/spec", "pendulum/spec")
_VERBS = ("verify", "verify", "verify", "run", "run", "run", "export", "simulate", "report")
_ROWS = 12
_CELLS = (
    "", "nan", "NaN", "inf", "-inf", "1e308", "-1e308", "1e400", "1e-320", "x", "1,5", "1;5", '"', '"1', "'1", "0x10",
    "1_000", "\u0661", "True", "2020-01-01T00:00:00", "12:30", "=1+1", "\0", "9" * 400, " 1 ", "1.0.0", "--1",
)  # fmt: skip


@cache
def _files(base: str) -> dict[str, str]:
    """Return the gain set of a design, a log, its continuation and the state between them, as texts by name."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        spec = str(_DESIGNS / f"{base}.yaml")
        _made(folder, ["design", "--system", spec, "--output", "g.json", "--quiet"], "g.json")
        plant = json.loads((folder / "g.json").read_text("utf-8"))["design"]["plant"]
        dt = json.loads((folder / "g.json").read_text("utf-8"))["design"]["observer"].get("dt") or 0.01
        columns = _signals(plant)
        for file, first in (("log.csv", 0), ("next.csv", _ROWS)):
            rows = [",".join([repr((first + k) * dt), *["0.1"] * len(columns)]) for k in range(_ROWS)]
            (folder / file).write_text("\n".join([",".join(["time", *columns]), *rows]) + "\n", "utf-8")
        words = ["run", "--gains", "g.json", "--data", "log.csv", "--out", "e.csv", "--state", "s.json", "--quiet"]
        _made(folder, words, "e.csv", "s.json")
        return {
            file: (folder / file).read_text("utf-8") for file in ("g.json", "s.json", "log.csv", "next.csv", "e.csv")
        }


def _made(folder: Path, words: list[str], *files: str) -> None:
    ran = run(folder, words, may_change=files)
    if ran.code or ran.wrong:
        raise RuntimeError(f"{' '.join(words)}: exit code {ran.code}, {ran.wrong or ran.errors}")


def _signals(plant: dict[str, Any]) -> list[str]:
    if "input_names" in plant:
        return [*plant["input_names"], *plant["output_names"]]
    names = [plant.get("inputs") or {}, plant["outputs"]]
    return [name.get("mapping", name) and key for name in names for key in name.get("mapping", name)]


def case(seed: int) -> Outcome:
    """Mutate the files of one design, run one verb on them."""
    rng = random.Random(f"mutated files {seed}")
    base, verb = rng.choice(_BASES), rng.choice(_VERBS)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file, text in _files(base).items():
            (folder / file).write_text(text, "utf-8")
        uses = {"run": ("g.json", "s.json", "next.csv", "next.csv")}.get(verb, ("g.json",))
        done = [_mutation(folder / rng.choice(uses), rng) for _ in range(rng.choice((1, 1, 2)))]
        words, outputs, feed = _command(verb, base, folder, rng)
        # What has left on a stream cannot be taken back: its state is saved however it ends.
        ran = run(folder, words, may_change=outputs, feed=feed, changes_anyway=["s.json"] if "-" in words[5:] else [])
    wrong = f"{ran.wrong} [{' '.join(words)} ({base}): {'; '.join(done)}]" if ran.wrong else ""
    return Outcome(verb, str(ran.code), wrong)


def _mutation(file: Path, rng: random.Random) -> str:
    """Change a file; return what was done."""
    if not file.is_file():
        return "as it is"
    text = file.read_text("utf-8", "replace")
    kind = rng.random()
    if kind < 0.05:
        what = rng.choice(("folder", "pipe", "loop", "dangling", "device", "empty"))
        make_special(file, what)
        return f"{file.name}: {what}"
    if kind < 0.2 or not text.strip():
        broken, what = mutate_text(text or " ", rng)
        file.write_bytes(broken)
    elif file.suffix == ".csv":
        what = _changed_cell(file, text, rng)
    else:
        try:
            document = json.loads(text)
        except ValueError:
            return "as it is"
        changed, what = mutate_tree(document, rng)
        file.write_text(_with_digest(changed), "utf-8")
    return f"{file.name}: {what}"


def _with_digest(document: dict[str, Any]) -> str:
    """Return a document whose digest fits its content, whatever that is."""
    part = next((key for key in ("design", "run") if key in document), None)
    if part is not None and "sha256" in document:
        text = json.dumps(document[part], sort_keys=True, separators=(",", ":"))
        document["sha256"] = hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()
    return json.dumps(document)


def _changed_cell(file: Path, text: str, rng: random.Random) -> str:
    lines = text.splitlines()
    row = rng.randrange(len(lines))
    cells = lines[row].split(",")
    column, cell = rng.randrange(len(cells)), rng.choice(_CELLS)
    kind = rng.random()
    if kind < 0.7:
        cells[column] = cell
    elif kind < 0.8:
        cells.insert(column, cell)
    elif kind < 0.9:
        del cells[column]
    else:
        cells = [cell] * len(cells)
    lines[row] = ",".join(cells)
    file.write_bytes(rng.choice(("\n", "\r\n", "\r")).join(lines).encode("utf-8", "surrogatepass"))
    return f"{cell[:20]!r} in row {row}, column {column}"


def _command(verb: str, base: str, folder: Path, rng: random.Random) -> tuple[list[str], list[str], str | None]:
    """Return the words of the command, the files that it may write, and what is on standard input."""
    spec = str(_DESIGNS / f"{base}.yaml")
    if verb == "verify":
        return ["verify", "g.json", *(["--json"] if rng.random() < 0.3 else [])], [], None
    new = {"run": "new.csv", "export": rng.choice(("new.c", "new.mat", "new.npz")), "simulate": "new.csv"}
    output, allowed = _place(folder, new.get(verb, "new.html"), rng)
    if verb == "export":
        also = [str(Path(output).with_suffix(".h"))] if output.endswith(".c") else []
        words = ["export", "--gains", "g.json", "--to", output]
        return [*words, *(["--sample-time", "0.01"] if rng.random() < 0.5 else [])], [*allowed, *also], None
    if verb == "simulate":
        return ["simulate", "--system", spec, "--gains", "g.json", "--out", output, "--quiet"], allowed, None
    if verb == "report":
        return ["report", "--gains", "g.json", "--out", output], allowed, None
    words, feed, data = ["run", "--gains", "g.json", "--quiet"], None, "next.csv"
    if rng.random() < 0.3 and (folder / data).is_file():
        feed, data = (folder / data).read_bytes().decode("utf-8", "replace"), "-"
    if rng.random() < 0.3:
        output, allowed = "-", []
    words += ["--data", data, "--out", output]
    if rng.random() < 0.7:
        words += ["--state", "s.json"]
        allowed = [*allowed, "s.json"]
    return words, allowed, feed


def _place(folder: Path, new: str, rng: random.Random) -> tuple[str, list[str]]:
    """Return an output: a new one most of the time, else an input, a link to one, or a place that cannot be."""
    kind = rng.random()
    if kind < 0.7:
        return new, [new]
    if kind < 0.8:
        return rng.choice(("missing/" + new, ".", "g.json/" + new, "x" * 300 + Path(new).suffix)), []
    target = rng.choice([file.name for file in folder.iterdir() if file.is_file()] or ["g.json"])
    if kind < 0.9 or not (folder / target).is_file():
        return target, [target] if target == "e.csv" and new == "new.csv" else []
    output = f"link{Path(new).suffix}"
    if rng.random() < 0.5:
        os.symlink(target, folder / output)
    else:
        os.link(folder / target, folder / output)
    return output, ["e.csv", output] if target == "e.csv" and new == "new.csv" else []
