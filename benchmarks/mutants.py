"""Run the mutants of `mutants.md`: each replaces one text in a copy of the sources, and its named test must fail.

    python benchmarks/mutants.py                     every mutant of the table; exits 1 where one is not killed
    python benchmarks/mutants.py --only alarm_proof  those whose file, text or test has this in it
    python benchmarks/mutants.py --survivors         those of the last table, with the nearest tests of their file

Texts stand in one line in the table, so that white space is matched freely and kept where a text stays.
"""

from __future__ import annotations

import argparse
import ast
import os
import re
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from difflib import SequenceMatcher
from pathlib import Path

ROOT = Path(__file__).parents[1]
TABLE = ROOT / "benchmarks/mutants.md"
#: A test that takes longer than this many seconds has met a mutant that does not end: that kills it.
LONGEST = 600.0
#: What pytest ends with where a test failed.
TESTS_FAILED = 1


@dataclass(frozen=True)
class Mutant:
    """A text of one file, what takes its place, and the test that sees it."""

    file: str
    was: str
    became: str
    test: str

    def source(self, text: str) -> str:
        """Return a file's text with this mutant in it; ValueError where its text is not there."""
        words, others = self.was.split(), self.became.split()
        found = re.search(r"\s+".join(map(re.escape, words)), text)
        if found is None:
            raise ValueError("its text is not in the file")
        spaces = [*re.findall(r"\s+", found.group()), ""]
        pieces: list[str] = []
        for _, first, last, begin, end in SequenceMatcher(None, words, others, autojunk=False).get_opcodes():
            kept = spaces[first:last] if last - first == end - begin else [" "] * (end - begin)
            if kept and last > first:
                kept[-1] = spaces[last - 1]
            pieces += [word + space for word, space in zip(others[begin:end], kept, strict=True)]
        return text[: found.start()] + "".join(pieces).rstrip() + text[found.end() :]


def mutants(heading: str | None = None) -> list[Mutant]:
    """Return the rows of the first table, or of the one below a heading."""
    text = TABLE.read_text(encoding="utf-8")
    part = text.split("\n## ")[0] if heading is None else text.split(f"\n## {heading}\n")[1]
    rows = re.findall(r"^\| ([\w/]+\.(?:py|c)) \| `(.+?)` \| `(.+?)` \| (.*) \|$", part, re.MULTILINE)
    return [Mutant(file, was.replace("\\|", "|"), became.replace("\\|", "|"), test) for file, was, became, test in rows]


def verdict(mutant: Mutant, tests: list[str], work: Path) -> str:
    """Return ``killed``, ``survives``, or why nothing is known, of one mutant in a copy of the sources."""
    file = work / (mutant.file if mutant.file.startswith("checker/") else f"src/obsynth/{mutant.file}")
    original = file.read_text(encoding="utf-8")
    try:
        changed = mutant.source(original)
        if file.suffix == ".py":
            ast.parse(changed)
    except (ValueError, SyntaxError) as error:
        return f"does not apply: {error}"
    file.write_text(changed, encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *tests]
    environment = {**os.environ, "PYTHONPATH": str(work / "src"), "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        code = subprocess.run(command, cwd=work, env=environment, capture_output=True, timeout=LONGEST).returncode
    except subprocess.TimeoutExpired:
        return "killed"
    finally:
        file.write_text(original, encoding="utf-8")
    return {0: "survives", TESTS_FAILED: "killed"}.get(code, f"pytest ended with {code}")


def nearest(file: str) -> list[str]:
    """Return the test files that import a module."""
    module = "obsynth." + file.removesuffix(".py").replace("/", ".")
    found = [test for test in (ROOT / "tests").rglob("test_*.py") if module in test.read_text(encoding="utf-8")]
    return [str(test.relative_to(ROOT)) for test in sorted(found)]


def main() -> int:
    """Run what was asked for and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="mutants whose row holds this text")
    parser.add_argument("--survivors", action="store_true", help="those that the nearest tests did not kill")
    arguments = parser.parse_args()
    listed = mutants("Not killed by the nearest tests" if arguments.survivors else None)
    asked = [one for one in listed if arguments.only in f"{one.file} {one.was} {one.became} {one.test}"]
    alive = 0
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        for name in ("src", "tests", "designs", "docs", "notebooks", "benchmarks", "checker"):
            shutil.copytree(ROOT / name, work / name, ignore=shutil.ignore_patterns("__pycache__"))
        for name in ("pyproject.toml", "README.md", "CHANGELOG.md", "CONTRIBUTING.md"):
            shutil.copy(ROOT / name, work / name)
        for mutant in asked:
            tests = nearest(mutant.file) if arguments.survivors else [f"tests/{mutant.test}"]
            found = verdict(mutant, tests, work)
            alive += found != "killed"
            print(f"{found:10} {mutant.file}: {mutant.was[:60]!r} ({', '.join(tests)[:120]})", flush=True)
    print(f"{len(asked) - alive} of {len(asked)} killed")
    return int(alive > 0)


if __name__ == "__main__":
    sys.exit(main())
