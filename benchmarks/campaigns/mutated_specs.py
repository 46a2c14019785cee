"""Specs, plants and matrix files of every method, mutated: values that are none, missing and foreign keys, broken text.

A case takes one of the designs, changes it in one to three places (structure, text or the files it refers to), and runs
`check`, `design`, `simulate` or `evaluate` on it, in this process, with an output that is sometimes one of the inputs.
Right is: a documented exit code, a sentence with every code but 0, no traceback and no words of Python, no file changed
but the output, nothing left behind.  Columns: the exit code.
"""

from __future__ import annotations

import os
import random
import shutil
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

from benchmarks.campaigns._commands import make_special, run
from benchmarks.campaigns._mutations import mutate_text, mutate_tree, yaml_text
from benchmarks.campaigns.frame import Outcome

CASES = 3000
LIMIT = 180.0  # s

_DESIGNS = Path(__file__).parents[2] / "designs"
_BASES = (
    "wang2015/spec", "wang2015/spec", "wang2015/spec", "filasova/spec", "smib/pd_observer", "smib/spec",
    "diode_circuit/spec", "moussaali2013_dae/spec", "pendulum/spec", "moussaali2013_ltv/two_outputs",
    "sharepasand/spec",
)  # fmt: skip
_VERBS = ("check", "check", "design", "design", "simulate", "evaluate")
_SPECIAL = ("folder", "pipe", "loop", "dangling", "device", "empty")


@cache
def _documents(base: str) -> tuple[tuple[str, Any, str], ...]:
    """Return name, content and text of spec and plant, in one document where they are two files."""
    from ruamel.yaml import YAML

    spec = _DESIGNS / f"{base}.yaml"
    content = YAML(typ="safe", pure=True).load(spec)
    names = [spec.name]
    if "file" in content["plant"]:
        names.append(content["plant"]["file"])
    files = [spec.parent / name for name in names]
    return tuple((file.name, YAML(typ="safe", pure=True).load(file), file.read_text("utf-8")) for file in files)


def case(seed: int) -> Outcome:
    """Mutate one design, run one verb on it."""
    rng = random.Random(f"mutated specs {seed}")
    base, verb = rng.choice(_BASES), rng.choice(_VERBS)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file in (_DESIGNS / base).parent.iterdir():
            shutil.copy(file, folder / file.name)
        (folder / "A.csv").write_text("0.5,0.1\n0.0,0.25\n", "utf-8")
        done = [_mutation(folder, base, rng) for _ in range(rng.choice((1, 1, 2, 3)))]
        spec = f"{base.rpartition('/')[2]}.yaml"
        words, output = _command(verb, spec, folder, rng)
        ran = run(folder, words, may_change=[output] if output else [])
    wrong = f"{ran.wrong} [{verb} {base}: {'; '.join(done)}]" if ran.wrong else ""
    return Outcome(verb, str(ran.code), wrong)


def _mutation(folder: Path, base: str, rng: random.Random) -> str:
    """Change something in the folder; return what."""
    name, content, text = rng.choice(_documents(base))
    kind = rng.random()
    if kind < 0.85 and not (folder / name).is_file():
        return f"{name}: as it is"
    if kind < 0.6:
        changed, what = mutate_tree(content, rng)
        (folder / name).write_text(yaml_text(changed), "utf-8")
    elif kind < 0.85:
        broken, what = mutate_text(text, rng)
        (folder / name).write_bytes(broken)
    else:
        name = rng.choice(sorted(file.name for file in folder.iterdir() if file.suffix in (".yaml", ".mtx", ".json")))
        file = folder / name
        if rng.random() < 0.3 or not file.is_file():
            what = rng.choice(_SPECIAL)
            make_special(file, what)
        else:
            broken, what = mutate_text(file.read_text("utf-8", "replace") or " ", rng)
            file.write_bytes(broken)
    return f"{name}: {what}"


def _command(verb: str, spec: str, folder: Path, rng: random.Random) -> tuple[list[str], str]:
    """Return the words of the command, and the file that it may write."""
    words = [verb, "--system", spec]
    words += ["--json"] if rng.random() < 0.3 else []
    if verb == "evaluate":
        return [*words, "--quiet", "--runs", "2"], ""
    if verb == "check":
        return words, ""
    option = "--output" if verb == "design" else "--out"
    kind = rng.random()
    output = "new.gains.json" if verb == "design" else "new.csv"
    if kind < 0.2:
        # An input, by its name or by a link.
        target = rng.choice([file.name for file in folder.iterdir() if file.is_file()] or [spec])
        output = rng.choice((target, "soft", "hard"))
        if output == "soft":
            os.symlink(target, folder / output)
        elif output == "hard":
            os.link(folder / target, folder / output)
        return [*words, "--quiet", option, output], ""
    return [*words, "--quiet", option, output], output
