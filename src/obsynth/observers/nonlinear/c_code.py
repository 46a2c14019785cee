"""An observer of a DAE as C99 or a shared library: the graph by CasADi, and the loop of Newton around it.

The loop is that of `obsynth.numerics.newton` and `obsynth.plants.implicit_step`; outliers, jumps, bounds of states and
sensors of their own times are those of `obsynth.observers.nonlinear`.
"""

from __future__ import annotations

import ctypes
import os
import re
import shlex
import shutil
import subprocess
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.files.outputs import working_folder
from obsynth.numerics import lazy_casadi as ca
from obsynth.numerics import newton
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import DEPENDENT_BOUND
from obsynth.observers.nonlinear.layouts import initial_memory
from obsynth.observers.nonlinear.step_graph import ObserverGraph
from obsynth.observers.nonlinear.steps import Steps
from obsynth.observers.outliers import COMPARABLE, FAR_OUT, LONGEST_LEFT_OUT, NO_SQUARE, RESET_WINDOW, chi_square_limit
from obsynth.plants import implicit_step as dae
from obsynth.plants.dae_functions import DAEFunctions
from obsynth.plants.implicit_step import PROJECTION_NOTICE, PROJECTION_SHARE, step_graph

#: What ``record.c`` hands out of a batch, in this order.
BATCH_PARTS = ("posterior", "theta", "spread", "innovation", "nis", "residual")

NUMBERS_PER_LINE = 4

#: The beginning of a helper that CasADi writes, `casadi_fmax` say, which it leaves visible to the linker.
_HELPER = re.compile(r"^((?:const )?(?:casadi_real|casadi_int|double|int|void)\*? casadi_\w+ ?\()", re.MULTILINE)

#: A bound that is missed by less, in deviations of its state, is kept.
BOUND_SLACK = 1e-7

#: Tried in turn when the environment does not name one in ``CC``.
COMPILERS = ("cc", "gcc", "clang")

FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-shared", "-fPIC")


def observer_code(steps: Steps) -> str:
    """Return everything static: constants, CasADi's functions, ``struct observer``, ``reset`` and ``advance``."""
    graph = steps.graph
    short = step_graph(DAEFunctions(steps.settings.model), PROJECTION_SHARE * steps.settings.dt, np.inf)
    functions = {"project": short.newton, "newton": graph.step.newton, "first": graph.first, "sample": graph.sample}
    if steps.settings.model.nu:
        functions["unknown"] = graph.unknown
    if steps.settings.outliers != "none":
        functions["forecast"] = graph.forecast
    return "\n".join(
        [
            "#include <math.h>",
            "",
            *_constants(steps, graph, functions.values()),
            *_option_constants(steps),
            "",
            _generated(functions),
            "",
            _template("advance"),
            _template("options"),
        ]
    )


def observer_struct(steps: Steps, name: str) -> Iterator[str]:
    """Return lines of C that declare what an observer remembers as ``struct <name>``."""
    graph, model, timing = steps.graph, steps.settings.model, steps.settings.timing
    inner = name if timing.is_plain else f"{name}_memory"
    yield from (f"struct {inner} {{", f"    double memory[{graph.memory.size}];", f"    double u[{max(model.nu, 1)}];")
    yield "    /* number of the next sample; outliers of each output in a row (negative: below) and at all; resets; how"
    yield "       far off the latest in a row was that was left out, and that was believed */"
    yield from ("    long k;", f"    int in_a_row[{model.ny}];", f"    int refused[{model.ny}];", "    int resets;")
    yield from (f"    double left_out[{model.ny}];", f"    double believed[{model.ny}];")
    yield "    /* of each input: lowest, highest, largest change, samples missing in a row, what these may be off by */"
    yield f"    double inputs[{5 * max(model.nu, 1)}];"
    yield from ("    int watched;", f"    double surprises[{2 * RESET_WINDOW}];", "};")
    if not timing.is_plain:
        rows = timing.longest + 1
        yield from (f"struct {name} {{", f"    struct {inner} before[{rows}];", f"    struct {inner} latest;")
        yield from (f"    double u[{max(rows * model.nu, 1)}];", f"    double y[{rows * model.ny}];", "    int kept;")
        yield "};"


def record_code(steps: Steps) -> str:
    """Return the whole source of a library with functions ``record`` and ``batch``."""
    graph, copies, total = steps.graph, [], 0
    for name in BATCH_PARTS:
        layout, source = (graph.memory, "after") if name in graph.memory.shapes else (graph.row, "said")
        part = layout.slices[name]
        size = part.stop - part.start
        copies.append(f"    copy(out + {total}, {source} + {part.start}, {size});")
        total += size
    loops = _template("record").replace("/* PARTS */", "\n".join(copies)).replace("PARTS_SIZE", str(total))
    return "\n".join([*observer_struct(steps, "observer"), observer_code(steps), loops])


def _template(name: str) -> str:
    """Return the C that stands around the functions that CasADi writes: ``advance`` or ``record``."""
    return files("obsynth.observers.nonlinear").joinpath("c", f"{name}.c").read_text(encoding="utf-8")


def _constants(steps: Steps, graph: ObserverGraph, functions: Iterable[Any]) -> list[str]:
    """Return sizes, settings and tables."""
    model, move = steps.settings.model, steps.settings.largest_move
    listed = list(functions)
    work = {
        name: max(max(getattr(function, f"sz_{name}")() for function in listed), 1)
        for name in ("arg", "res", "iw", "w")
    }
    numbers = {
        "NX": model.nx,
        "NU": model.nu,
        "NY": model.ny,
        "NQ": model.nq,
        "STAGES": graph.functions.stages,
        "MEMORY": graph.memory.size,
        "ROW": graph.row.size,
        "AT_POSTERIOR": graph.memory.slices["posterior"].start,
        "AT_X": graph.memory.slices["x"].start,
        "AT_THETA": graph.memory.slices["theta"].start,
        "AT_SPREAD": graph.memory.slices["spread"].start,
        "AT_INNOVATION": graph.row.slices["innovation"].start,
        "AT_COVARIANCE": graph.row.slices["covariance"].start,
        "AT_NIS": graph.row.slices["nis"].start,
        "AT_RESIDUAL": graph.row.slices["residual"].start,
        "MOST_ITERATIONS": newton.MOST_ITERATIONS,
        "MOST_HALVINGS": newton.MOST_HALVINGS,
        "MOST_SUBSOLVES": dae.MOST_SUBSOLVES,
        "LAST_STEP": newton.LAST_STEP,
        "LARGEST_RESIDUAL": newton.LARGEST_RESIDUAL,
        "FIRST_FRACTION": dae.FIRST_FRACTION,
        "LEAST_FRACTION": dae.LEAST_FRACTION,
        "PROJECTION_NOTICE": PROJECTION_NOTICE,
        "LARGEST_MOVE": "HUGE_VAL" if move is None else float(move),
        **{f"WORK_{name.upper()}": size for name, size in work.items()},
    }
    return [
        *(
            f"#define {name} {value!r}" if not isinstance(value, str) else f"#define {name} {value}"
            for name, value in numbers.items()
        ),
        "/* Arrays of no length are none in C. */",
        "#define LENGTH(n) ((n) > 0 ? (n) : 1)",
        "",
        *c_table("SIZES", np.asarray(model.state_scales)),
        *c_table("START", initial_memory(steps.settings, steps.settings.initial_state)),
    ]


def _option_constants(steps: Steps) -> list[str]:
    """Return what the options of an observer are in C."""
    settings, memory = steps.settings, steps.graph.memory
    bounds = np.zeros((0, 2)) if settings.state_bounds is None else settings.state_bounds
    ends = [
        (i, sign, float(pair[side]))
        for side, sign in ((0, 1.0), (1, -1.0))
        for i, pair in enumerate(bounds)
        if np.isfinite(pair[side])
    ]
    most = RESET_WINDOW * settings.model.ny
    limits = [0.0, *(chi_square_limit(n, settings.reset) for n in range(1, most + 1))] if settings.reset else []
    timing = settings.timing
    numbers = {
        "AT_S": memory.slices["S"].start if "S" in memory.shapes else -1,
        "AT_CROSS": memory.slices["cross"].start if "cross" in memory.shapes else -1,
        "OUTLIERS": int(settings.outliers != "none"),
        "GATE": int(settings.outliers == "gate"),
        "OUTLIER_LIMIT": steps.limit if np.isfinite(steps.limit) else 0.0,
        "OVERFLOW_LIMIT": NO_SQUARE,
        "LONGEST_REFUSAL": LONGEST_LEFT_OUT,
        "COMPARABLE": COMPARABLE,
        "FAR_OUT": FAR_OUT,
        "RESETS": int(bool(settings.reset)),
        "RESET_WINDOW": RESET_WINDOW,
        "BOUNDS": len(ends),
        "DEPENDENT": DEPENDENT_BOUND,
        "SLACK": BOUND_SLACK,
        "WAITS": int(not timing.is_plain),
        "LATEST": timing.longest,
    }
    lines = [f"#define {name} {value!r}" for name, value in numbers.items()]
    if settings.outliers != "none":
        least = settings.outlier_sizes
        lines += c_table("OUTLIER_SIZES", np.zeros(settings.model.ny) if least is None else least)
    if limits:
        lines += c_table("RESET_LIMITS", np.array(limits))
    if ends:
        lines += [
            *_integers("BOUND_STATES", [i for i, _, _ in ends]),
            *c_table("BOUND_SIGNS", np.array([sign for _, sign, _ in ends])),
            *c_table("BOUND_ENDS", np.array([end for _, _, end in ends])),
        ]
    if not timing.is_plain:
        lines += [*_integers("EVERY", timing.every.tolist()), *_integers("DELAYS", timing.delays.tolist())]
    return lines


def _integers(name: str, values: Sequence[int]) -> list[str]:
    return [f"static const long {name}[{len(values)}] = {{{', '.join(map(str, values))}}};"]


def c_table(name: str, values: FloatArray) -> list[str]:
    """Return a constant table of C; numbers are read back bit for bit (``values (n,)``)."""
    texts = [repr(value) for value in values.tolist()] or ["0.0"]
    return [f"static const double {name}[{len(texts)}] = {{", "    " + ",\n    ".join(in_lines(texts)) + "};"]


def in_lines(texts: list[str]) -> list[str]:
    """Return the lines of a table of these numbers."""
    return [", ".join(texts[i : i + NUMBERS_PER_LINE]) for i in range(0, len(texts), NUMBERS_PER_LINE)]


def _generated(functions: dict[str, Any]) -> str:
    """Return CasADi's functions, all of them static, so that two observers can be linked into one program."""
    options: Any = {"with_header": False, "with_mem": False, "casadi_int": "int", "main": False, "verbose": False}
    generator = ca.CodeGenerator("observer", options)
    for name, function in functions.items():
        inputs = function.sx_in() if function.is_a("SXFunction") else function.mx_in()
        is_named = function.name() == name
        generator.add(function if is_named else ca.Function(name, inputs, function.call(inputs)))
    return "\n".join(
        [
            "/* What follows was written by CasADi, with parameters and functions that are not used. */",
            "#if defined(__GNUC__)",
            "#pragma GCC diagnostic push",
            *(
                f'#pragma GCC diagnostic ignored "-W{name}"'
                for name in ("unused-parameter", "unused-function", "unused-const-variable")
            ),
            "#if !defined(__clang__)",
            '#pragma GCC diagnostic ignored "-Wmaybe-uninitialized"',
            "#endif",
            "#endif",
            "#define CASADI_SYMBOL_EXPORT static",
            _HELPER.sub(r"static \1", generator.dump().rstrip()),
            "#if defined(__GNUC__)",
            "#pragma GCC diagnostic pop",
            "#endif",
        ]
    )


def compiler() -> list[str] | None:
    """Return the command of the C compiler, ``CC`` of the environment first; ``None`` where there is none."""
    if os.name != "posix":
        return None
    named = shlex.split(os.environ.get("CC", ""))
    if named:
        return named if shutil.which(named[0]) else None
    command = next((name for name in COMPILERS if shutil.which(name)), None)
    return None if command is None else [command]


@lru_cache(maxsize=16)
def _loaded(code: str, command: tuple[str, ...]) -> ctypes.CDLL:
    """Return C code as a library; the same code is compiled once."""
    with working_folder() as folder:
        # It stays loaded when the file is gone; Windows keeps the file.
        return ctypes.CDLL(str(shared_library(folder, {"observer.c": code}, command, path="compiled")))


def shared_library(folder: Path, texts: Mapping[str, str], command: Sequence[str], *, path: str) -> Path:
    """Write C and headers by name into a folder, compile the C, and return the library; `SpecError` at ``path`` says
    why the compiler fails."""
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8", newline="\n")
    library = folder / "library.so"
    sources = [str(folder / name) for name in texts if name.endswith(".c")]
    done = subprocess.run(
        [*command, *sources, "-o", str(library), "-lm"],
        capture_output=True,
        encoding="utf-8",
        errors="replace",
        check=False,
    )
    if done.returncode != 0:
        raise SpecError(f"The C compiler {command[0]!r} fails: {done.stderr.strip()[:500]}", path=path)
    return library


class DAELibrary:
    """An observer in C."""

    def __init__(self, steps: Steps) -> None:
        self.steps = steps
        command = compiler()
        if command is None:
            raise SpecError(
                "There is no C compiler (cc, gcc or clang, or what CC in the environment names): install one, or leave "
                "compiled=True out.",
                path="compiled",
            )
        self._library = _loaded(record_code(steps), (*command, *FLAGS))
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
        """Go on over some samples; return memory and row of each that could be taken."""
        graph = self.steps.graph
        after, rows = np.zeros((len(y), graph.memory.size)), np.zeros((len(y), graph.row.size))
        taken = self._library.record(state, len(y), *map(_pointer, (_plain(u), _plain(y), after, rows)))
        return after[:taken], rows[:taken]

    def batch(self, y: FloatArray, u: FloatArray) -> tuple[int, dict[str, FloatArray]]:
        """Run over records; return how many could be finished, and what is said by name."""
        graph, (runs, samples, _) = self.steps.graph, y.shape
        layouts = [graph.memory if name in graph.memory.shapes else graph.row for name in BATCH_PARTS]
        sizes = [
            layout.shapes[name][0] * layout.shapes[name][1] for layout, name in zip(layouts, BATCH_PARTS, strict=True)
        ]
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
