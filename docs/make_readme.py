"""Write what the README's first command and first code print into the README, where a test compares it.

Run ``python docs/make_readme.py`` from anywhere.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"


def block(text: str, mark: str) -> str:
    """Return what stands between the fences below a mark."""
    found = re.search(rf"<!-- {mark} -->\n```\w+\n(.*?)```\n<!-- end -->", text, re.DOTALL)
    if found is None:
        raise SystemExit(f"README.md has no block {mark}.")
    return found.group(1)


def printed(command: list[str]) -> str:
    """Return what a command prints in the folder of a clone; what it writes is left elsewhere."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "designs").symlink_to(ROOT / "designs")
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    return "\n".join(line.rstrip() for line in done.stdout.splitlines()) + "\n"


def outputs(text: str) -> dict[str, str]:
    """Return the text of each block of output, by its mark."""
    _, _, first = block(text, "commands").splitlines()[0].partition(" && ")
    program = "import sys; from obsynth.cli.main import design_command; sys.exit(design_command(sys.argv[1:]))"
    return {
        "output": printed([sys.executable, "-c", program, *first.split()[1:]]),
        "python output": printed([sys.executable, "-W", "error", "-c", block(text, "python")]),
    }


def main() -> None:
    """Replace the blocks of output."""
    text = README.read_text(encoding="utf-8")
    for mark, told in outputs(text).items():
        before, after = f"<!-- {mark} -->\n```text\n", "```\n<!-- end -->"
        start = text.index(before) + len(before)
        text = text[:start] + told + text[text.index(after, start) :]
    README.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
