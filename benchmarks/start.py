"""How long the program takes to start: processor time of ``import obsynth``, ``obsynth --help`` and what is near them.

``python benchmarks/start.py [runs]`` prints the table of ``benchmarks/README.md``; each number is the median of so many
processes of their own (15 by default; ``--small``: one).  Python itself is the first row, and is in all others.
"""

from __future__ import annotations

import resource
import statistics
import subprocess
import sys

COMMANDS = {
    "python alone": "pass",
    "import obsynth": "import obsynth",
    "obsynth --help": "import sys; sys.argv = ['obsynth', '--help']; from obsynth.cli.main import main; main()",
    "obsynth --version": "import sys; sys.argv = ['obsynth', '--version']; from obsynth.cli.main import main; main()",
    "obsynth.DescriptorSystem": "import obsynth; obsynth.DescriptorSystem",
    "obsynth.load": "import obsynth; obsynth.load",
}


def seconds(program: str) -> float:
    """Return the processor time of one process, its children's included."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-c", program], stdout=subprocess.DEVNULL, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main(arguments: list[str]) -> None:
    """Print the table."""
    runs = 1 if "--small" in arguments else int(arguments[0]) if arguments else 15
    print("| what | processor time, s | least, s |")
    print("| --- | --- | --- |")
    for what, program in COMMANDS.items():
        times = [seconds(program) for _ in range(runs)]
        print(f"| `{what}` | {statistics.median(times):.3f} | {min(times):.3f} |")


if __name__ == "__main__":
    main(sys.argv[1:])
