"""The C of an observer as a shared library of this process, where a compiler is there."""

from __future__ import annotations

import ctypes
import os
import shlex
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.dae.c_code import BATCH_PARTS, record_code
from obsynth.observers.dae.steps import Steps

#: Tried in turn when the environment does not name one in ``CC``.
COMPILERS = ("cc", "gcc", "clang")
FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-shared", "-fPIC")


def compiler() -> list[str] | None:
    """Return the command of the C compiler, ``CC`` of the environment first; ``None`` where there is none."""
    if os.name != "posix":
        return None
    named = shlex.split(os.environ.get("CC", ""))
    if named:
        return named if shutil.which(named[0]) else None
    found = next((name for name in COMPILERS if shutil.which(name)), None)
    return None if found is None else [found]


class DAELibrary:
    """An observer in C. Fields: steps: Of the observer."""

    def __init__(self, steps: Steps) -> None:
        self.steps = steps
        command = compiler()
        if command is None:
            raise SpecError(
                "There is no C compiler (cc, gcc or clang, or what CC in the environment names): install one, or leave "
                "compiled=True out.", path="compiled",
            )  # fmt: skip
        with tempfile.TemporaryDirectory(prefix="obsynth-") as folder:
            source, library = Path(folder) / "observer.c", Path(folder) / "observer.so"
            source.write_text(record_code(steps), encoding="utf-8")
            done = subprocess.run(
                [*command, *FLAGS, str(source), "-o", str(library), "-lm"], capture_output=True, text=True, check=False
            )
            if done.returncode != 0:
                raise SpecError(f"The C compiler {command[0]!r} fails: {done.stderr.strip()[:500]}", path="compiled")
            # It stays loaded when the file is gone.
            self._library = ctypes.CDLL(str(library))
        pointer = ctypes.POINTER(ctypes.c_double)
        self._library.state_bytes.restype = ctypes.c_long
        self._library.start.argtypes = [ctypes.c_char_p]
        self._library.record.argtypes = [ctypes.c_char_p, ctypes.c_int, *[pointer] * 4]
        self._library.batch.argtypes = [ctypes.c_int, ctypes.c_int, ctypes.c_long, *[pointer] * 3]

    def started(self) -> ctypes.Array[ctypes.c_char]:
        """Return the memory of an observer at k = 0, for `record`."""
        state = ctypes.create_string_buffer(self._library.state_bytes())
        self._library.start(state)
        return state

    def record(self, state: ctypes.Array[ctypes.c_char], y: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Go on over some samples; return memory and row of each that could be taken: ``y (samples, ny)``, ``u
        (samples, nu)``."""
        graph = self.steps.graph
        after, said = np.zeros((len(y), graph.memory.size)), np.zeros((len(y), graph.row.size))
        taken = self._library.record(state, len(y), *map(_pointer, (_plain(u), _plain(y), after, said)))
        return after[:taken], said[:taken]

    def batch(self, y: FloatArray, u: FloatArray) -> tuple[int, dict[str, FloatArray]]:
        """Run over records; return how many could be finished, and what is said by name."""
        graph, (runs, samples, _) = self.steps.graph, y.shape
        layouts = [graph.memory if name in graph.memory.shapes else graph.row for name in BATCH_PARTS]
        sizes = [layout.shapes[name][0] * layout.shapes[name][1] for layout, name in
                 zip(layouts, BATCH_PARTS, strict=True)]  # fmt: skip
        out = np.zeros((runs, samples, sum(sizes)))
        inputs, outputs = _plain(u), _plain(y)
        apart = 0 if u.ndim == 2 else samples * self.steps.settings.model.nu
        taken = self._library.batch(runs, samples, apart, *map(_pointer, (inputs, outputs, out)))
        flat = np.split(out, np.cumsum(sizes)[:-1], axis=2)
        return taken, {
            name: layout.shaped(part, name) for name, layout, part in zip(BATCH_PARTS, layouts, flat, strict=True)
        }


def _plain(array: FloatArray) -> FloatArray:
    return np.ascontiguousarray(array, dtype=np.float64)


def _pointer(array: FloatArray) -> ctypes._Pointer[ctypes.c_double]:
    return array.ctypes.data_as(ctypes.POINTER(ctypes.c_double))
