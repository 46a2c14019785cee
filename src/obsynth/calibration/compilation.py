"""CasADi functions as machine code, where a C compiler is there and the work is long enough to wait for it."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from obsynth.observers.dae.compiled_library import compiler

#: Optimisation costs more than it gains on straight code of thousands of lines.
FLAGS = ("-std=c99", "-O1", "-ffp-contract=off", "-shared", "-fPIC")


def compiled(functions: Sequence[Any]) -> list[Any]:
    """Return the same functions as machine code; as they are where there is no compiler or it fails."""
    import casadi as ca

    command = compiler()
    if command is None:
        return list(functions)
    with tempfile.TemporaryDirectory(prefix="obsynth-") as folder:
        generator = ca.CodeGenerator("calibration.c")
        for function in functions:
            generator.add(function)
        generator.generate(f"{folder}/")
        source, library = Path(folder) / "calibration.c", Path(folder) / "calibration.so"
        done = subprocess.run(
            [*command, *FLAGS, str(source), "-o", str(library), "-lm"], capture_output=True, text=True, check=False
        )
        if done.returncode != 0:
            return list(functions)
        # What is loaded stays when the file is gone.
        return [ca.external(function.name(), str(library)) for function in functions]
