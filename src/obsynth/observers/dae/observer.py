"""The observer of states and parameters of a nonlinear DAE that a design ships.

Whole records through an observer of a DAE: in stretches inside CasADi, with single steps where those fail.

An observer of a DAE as C99 or a shared library: CasADi writes its graph, around it stands the loop of Newton.

The loop is that of `obsynth.numerics.newton` and `obsynth.plants.dae`; outliers, jumps, bounds of states and
sensors of their own times are those of `obsynth.observers.dae.observer`.

The steps of an observer of a DAE: sample by sample, or whole stretches inside CasADi.
"""

from __future__ import annotations

import ctypes
import math
import os
import re
import shlex
import shutil
import subprocess
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SolverError, SpecError
from obsynth.files.outputs import working_folder
from obsynth.numerics import lazy_casadi as ca
from obsynth.numerics import newton
from obsynth.numerics.arguments import FloatArray, all_finite, as_given, checked_value, read_only, real_array
from obsynth.numerics.ranks import DEPENDENT_BOUND, SINGULAR_CONDITION, covariance_factor
from obsynth.observers.dae.estimates import DAERow, GatheredRows, SampleEstimates, require_regular
from obsynth.observers.dae.settings import DAESettings, initial_memory
from obsynth.observers.dae.step_graph import ObserverGraph, observer_graph
from obsynth.observers.outliers import (
    COMPARABLE,
    FAR_OUT,
    LONGEST_LEFT_OUT,
    NO_SQUARE,
    RESET_WINDOW,
    checked_limit,
    chi_square_limit,
    has_jumped,
    no_refusals,
    projected,
    robust_advance,
    with_surprise,
)
from obsynth.observers.progress import shown_progress
from obsynth.observers.records import (
    TakenInputs,
    held_inputs,
    measured_record,
    no_inputs,
    over_samples,
    require_inputs,
    taken_inputs,
)
from obsynth.observers.running import Estimates
from obsynth.plants import dae
from obsynth.plants.dae import (
    PROJECTION_NOTICE,
    PROJECTION_SHARE,
    Compiled,
    DAEFunctions,
    ImplicitStep,
    checked_inputs,
    onto_constraint,
    step_graph,
    take_samples,
)


class DAEState(NamedTuple):
    """The state of an observer of a DAE."""

    memory: FloatArray  # laid out as `memory_layout` says
    k: int  # the next sample
    u: FloatArray  # ``(nu,)``: the inputs of the sample before
    informations: tuple[FloatArray, ...]  # ``(nq, nq)`` each: on the parameters, of the latest samples
    refused: FloatArray  # ``(4, ny)``: what `no_refusals` says
    # ``(any, 2)``: normalised squares of the latest innovations, and their degrees of freedom, for resets
    surprises: FloatArray
    resets: int  # how many there were
    inputs: FloatArray  # ``(5, nu)``: what `no_inputs` says


class Steps:
    """The steps of an observer: what follows from it alone, once for all runs."""

    def __init__(self, settings: DAESettings, graph: ObserverGraph | None = None) -> None:
        self.settings, self.graph = settings, observer_graph(settings) if graph is None else graph
        self._compiled: dict[str, Compiled] = {}
        self.limit = checked_limit(settings.outliers, settings.outlier_limit)
        self.implicit = ImplicitStep(self.graph.functions, settings.dt, largest_move=settings.largest_move)
        self._unmoved = read_only(np.zeros(settings.model.nx))
        self._all_there = read_only(np.ones(settings.model.ny))
        self._all_seen = read_only(self._all_there, bool)
        self.first = DAEState(
            initial_memory(settings, settings.initial_state),
            0,
            np.zeros(settings.model.nu),
            (),
            no_refusals(settings.model.ny),
            np.zeros((0, 2)),
            0,
            no_inputs(settings.model.nu),
        )

    def part(self, state: DAEState, name: str) -> FloatArray:
        """Return a part of what is remembered, by its name in `memory_layout`."""
        return self.graph.memory.part(state.memory, name)

    def advance(self, state: DAEState, y: FloatArray, u: FloatArray) -> tuple[DAEState, DAERow]:
        """Return the state after a sample and what is said at it; NaN in ``y (ny,)`` or ``u (nu,)`` is missing."""
        take = self.watched if self.settings.reset else self.plain
        if self.settings.outliers == "none":
            after, row = take(state, y, u)
        else:
            held = held_inputs(state.u, u) if state.k else None
            after, row = robust_advance(
                self.settings.outliers, self.limit, self.settings.outlier_sizes, take, self.predicted, state, y, u,
                held=held,
            )  # fmt: skip
        return (after, row) if self.settings.state_bounds is None else self.within_bounds(after, row)

    def within_bounds(self, state: DAEState, row: DAERow) -> tuple[DAEState, DAERow]:
        """Project the states after a measurement onto their bounds; the next step begins there."""
        bounds = self.settings.state_bounds
        if bounds is None or ((bounds[:, 0] <= row.x) & (row.x <= bounds[:, 1])).all():
            return state, row
        root = covariance_factor(0.5 * (row.covariance + row.covariance.T), "covariance")
        memory, layout = state.memory.copy(), self.graph.memory
        memory[layout.slices["posterior"]] = projected(row.x, root, bounds)
        if self.settings.form == "augmented-kalman":
            memory[layout.slices["x"]] = memory[layout.slices["posterior"]]
        return state._replace(memory=memory), replace(row, memory=memory)

    def watched(self, state: DAEState, y: FloatArray, u: FloatArray) -> tuple[DAEState, DAERow]:
        """Take a sample; where innovations have become too large, again with parameters known no better than at first.
        A jump of a parameter is followed from there at once."""
        after, row = self.plain(state, y, u)
        surprises = with_surprise(state.surprises, float(row.nis), row.degrees) if state.k else state.surprises
        if not has_jumped(surprises, self.settings.reset):
            return after._replace(surprises=surprises), row
        after, row = self.plain(state._replace(memory=self._with_initial_spread(state)), y, u)
        return after._replace(surprises=state.surprises[:0], resets=state.resets + 1), row

    def _with_initial_spread(self, state: DAEState) -> FloatArray:
        """Return what is remembered with the covariance that the parameters had at the start."""
        memory, layout, nq = state.memory.copy(), self.graph.memory, self.settings.model.nq
        spread = np.array(self.settings.initial_parameter_covariance)
        for name in ("S", "spread"):
            if name in layout.shapes:
                memory[layout.slices[name]] = spread.ravel(order="F")
        if "cross" in layout.shapes:
            # A filter of both together carries the old share of the parameters in the state's covariance.
            memory[layout.slices["cross"]] = np.zeros(self.settings.model.nx * nq)
        return memory

    def predicted(self, state: DAEState, received: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return mean ``(ny,)`` and covariance of outputs from what is received of the next sample."""
        after, row = self.plain(state, received, u)
        mean, covariance = self._call("forecast", after.memory, row.said)
        return mean[:, 0], covariance

    def plain(self, state: DAEState, y: FloatArray, u: FloatArray) -> tuple[DAEState, DAERow]:
        """Take a sample as it is."""
        seen, received, arriving, moved = self._all_seen, y, self._all_there, self._unmoved
        if math.isnan(y.dot(y)):
            seen = arriving = ~np.isnan(y)
            received = np.where(seen, y, 0.0)
        known = taken_inputs(state.inputs, state.u, u, is_first=state.k == 0)
        if state.k == 0:
            begun, moved = self.projected(state, u)
            after, said = self._call("first", begun, received, seen)
        elif known.variances is not None:
            after, said = self._carefully(state, received, seen, known)
        else:
            after, said = self._call("whole", state.memory, np.concatenate((u, received, arriving)))
            if said[-1, 0] != 1.0:
                after, said = self._carefully(state, received, seen, known)
        memory = after[:, 0]
        if not all_finite(memory):
            raise SolverError(
                f"The matrix of (7), dF/dx' / dt + dF/dx, is singular at k = {state.k}, or the model is not defined "
                "there: the step has no unique solution.",
                record={"k": state.k},
            )
        row = DAERow(self.graph, state.k, memory, said[:, 0], seen, moved)
        informations = (*state.informations, row.part("information"))[-self.settings.window :]
        return DAEState(memory, state.k + 1, known.u, informations, *state[4:7], known.history), row

    def stretch(
        self, state: DAEState, y: FloatArray, u: FloatArray, run: Callable[..., tuple[FloatArray, ...]]
    ) -> tuple[DAEState, DAERow]:
        """Advance until a step is not solved, by `ObserverGraph.whole` over so many samples; return what is reached."""
        seen = ~np.isnan(y)
        arriving = np.hstack([u, np.where(seen, y, 0.0), seen])
        after, said = (found.T for found in run(state.memory, arriving.ravel()))
        good = (said[:, -1] == 1.0) & np.isfinite(after).all(axis=1)
        taken = len(y) if good.all() else int(np.argmin(good))
        rows = DAERow(self.graph, state.k, after[:taken], said[:taken], seen[:taken], np.zeros(0))
        if taken:
            latest = tuple(rows.part("information")[-self.settings.window :])
            informations = (*state.informations, *latest)[-self.settings.window :]
            state = state._replace(
                memory=after[taken - 1].copy(),
                k=state.k + taken,
                u=u[taken - 1],
                informations=informations,
                inputs=over_samples(state.inputs, state.u, u[:taken]),
            )
        return state, rows

    def projected(self, state: DAEState, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Put the initial state onto the algebraic equations; return the memory and how far it moved."""
        start = self.part(state, "x")
        found = onto_constraint(self.settings.model, start, u, self.part(state, "theta"), self.settings.dt)
        if found is start:
            return state.memory, np.zeros_like(start)
        return initial_memory(self.settings, found), found - start

    def _carefully(
        self, state: DAEState, y: FloatArray, seen: FloatArray, known: TakenInputs
    ) -> tuple[FloatArray, ...]:
        """Take a step that needs damping or a homotopy, or whose inputs are not all known: solved outside the graph,
        and all else in it."""
        posterior, theta = self.part(state, "posterior"), self.part(state, "theta")
        missing = np.zeros(self.settings.model.nx**2)
        if known.variances is None:
            solution = self.implicit.solve_carefully(posterior, known.u, theta, before=state.u, k=state.k)
        else:
            solution = self.implicit.solve(posterior, known.u, theta, before=state.u, k=state.k)
            (found,) = self._call("unknown", state.memory, solution.stages, known.u, known.variances)
            missing = found.ravel(order="F")
        after, said = self._call("sample", state.memory, solution.stages, known.u, y, seen, missing)
        said[-2:, 0] = solution.residual, 1.0
        return after, said

    def _call(self, name: str, *arguments: FloatArray) -> tuple[FloatArray, ...]:
        """Return what a function of the graph gives, compiled when it is first needed."""
        if name not in self._compiled:
            self._compiled[name] = Compiled(getattr(self.graph, name))
        return self._compiled[name](*arguments)


#: What ``record.c`` hands out of a batch, in this order.
BATCH_PARTS = ("posterior", "theta", "spread", "innovation", "nis", "residual")
NUMBERS_PER_LINE = 4
#: The beginning of a helper that CasADi writes, `casadi_fmax` say, which it leaves visible to the linker.
_HELPER = re.compile(r"^((?:const )?(?:casadi_real|casadi_int|double|int|void)\*? casadi_\w+ ?\()", re.MULTILINE)
#: A bound that is missed by less, in deviations of its state, is kept.
BOUND_SLACK = 1e-7


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
    return files("obsynth.observers.dae").joinpath("c", f"{name}.c").read_text(encoding="utf-8")


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
    ends = [(i, sign, float(pair[side])) for side, sign in ((0, 1.0), (1, -1.0)) for i, pair in enumerate(bounds)
            if np.isfinite(pair[side])]  # fmt: skip
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
        after, said = np.zeros((len(y), graph.memory.size)), np.zeros((len(y), graph.row.size))
        taken = self._library.record(state, len(y), *map(_pointer, (_plain(u), _plain(y), after, said)))
        return after[:taken], said[:taken]

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


#: Samples in one call of the C: a tenth of a second or less, so that progress shows and memory stays small.
SAMPLES_PER_CALL = 10_000


def _nothing(steps: Steps) -> DAERow:
    """Return rows of no samples, so that an empty record has estimates of the right shape."""
    graph, model = steps.graph, steps.settings.model
    memory, said = np.zeros((0, graph.memory.size)), np.zeros((0, graph.row.size))
    return DAERow(graph, 0, memory, said, np.zeros((0, model.ny), dtype=bool), np.zeros(model.nx))


def _in_c(
    steps: Steps,
    library: DAELibrary,
    y: FloatArray,
    u: FloatArray,
    keep: Callable[[DAERow], object],
    note: Callable[[int], object],
) -> None:
    moved = np.zeros(0)
    state = library.started()
    for begin in range(0, len(y), SAMPLES_PER_CALL):
        received = y[begin : begin + SAMPLES_PER_CALL]
        after, said = library.record(state, received, u[begin : begin + SAMPLES_PER_CALL])
        if len(after) < len(received):
            # Go there again where the message is written.
            advanced(steps, y, u, bool, note)
            raise SolverError(
                f"The C code stops at k = {begin + len(after)}, but CasADi does not: leave compiled=True out."
            )
        if begin == 0:
            moved = steps.projected(steps.first, u[0])[1]
        keep(DAERow(steps.graph, begin, after, said, ~np.isnan(received[: len(after)]), moved))
        note(begin + len(received))


def advanced(
    steps: Steps,
    y: FloatArray,
    u: FloatArray,
    keep: Callable[[DAERow], object],
    note: Callable[[int], object] = bool,
) -> DAEState:
    """Lead an observer from its start through a record; return its state at the end."""
    calls: dict[int, Compiled] = {}
    state = steps.first

    def alone(k: int) -> None:
        nonlocal state
        state, row = steps.advance(state, y[k], u[k])
        keep(row)

    def together(k: int, length: int) -> int:
        nonlocal state
        if length not in calls:
            calls[length] = Compiled(steps.graph.over(length))
        state, rows = steps.stretch(state, y[k : k + length], u[k : k + length], calls[length])
        keep(rows)
        return len(rows.memory)

    if len(y):
        alone(0)
    take_samples(len(y), together, alone, note)
    return state


def _is_plain(values: ArrayLike, count: int) -> bool:
    """Whether a sample is an array of so many numbers already."""
    return type(values) is np.ndarray and values.dtype == np.float64 and values.shape == (count,)


class DAEObserver(DAESettings):
    """A nonlinear observer: everything that `start` and `run` need, and nothing that depends on data.

    Parameters
    ----------
    model : DAEModel
        The model it runs on.
    dt : float
        Seconds between samples.
    Q : FloatArray
        ``(nx, nx)``: covariance of what is added to the right sides of the equations in each step.
    R : FloatArray
        ``(ny, ny)``: covariance of the sensors, positive definite.
    initial_state, initial_parameters : FloatArray
        ``(nx,)`` and ``(nq,)``.
    initial_covariance, initial_parameter_covariance : FloatArray
        ``P_0 (nx, nx)`` and ``S_0 (nq, nq)``.
    random_walk : FloatArray
        ``(nq, nq)``: covariance of one step of the parameters.
    lower, upper : FloatArray
        ``(nq,)``: bounds of the parameters, infinite where there are none.
    form : {"forgetting", "random-walk", "augmented-kalman"}
        Recursive least squares with a forgetting factor or with parameters that walk; or the extended Kalman filter
        of states and parameters together.
    forgetting : float
        lambda in (0, 1], dimensionless; used by form ``forgetting``.
    guard : {"regularise", "none"}
        Whether S is kept below S_0 where excitation is missing; used by form ``forgetting``.
    weight : {"innovation", "paper"}
        The covariance in (18): of the innovation, or R as printed.
    integration : {"backward-euler", "radau"}
        How F is discretised.
    largest_move : float or None
        In nominal sizes of the states; see `obsynth.plants.dae.ImplicitStep`.
    window : int
        Samples over which excitation is watched.
    outliers, outlier_limit, outlier_sizes, sensors, state_bounds
        As for `RecursiveObserver`.
    reset : float
        Detect and reset: probability, per sample, that innovations which no change has made larger pass the threshold
        above which the covariance of the parameters starts again from S_0.  Zero never resets.

    Raises
    ------
    SpecError
        Something is out of range or has the wrong shape.
    """

    @cached_property
    def steps(self) -> Steps:
        """What follows from the observer alone, made when it is first needed."""
        return Steps(self)

    @property
    def _steps(self) -> Steps:
        return self.steps

    def _trust(self, row: DAERow) -> None:
        if not row.condition <= SINGULAR_CONDITION:
            require_regular(self, row, row.conditions)

    def _sample(self, state: DAEState, y: ArrayLike, u: ArrayLike) -> tuple[FloatArray, FloatArray]:
        outputs = as_given(y, "y", f"y must be {self.model.ny} number(s) at k = {state.k}.")
        # What can be wrong with plain numbers is an infinity: it is told below.
        if not (_is_plain(y, self.model.ny) and (all_finite(outputs) or not np.isinf(outputs).any())):
            outputs = measured_record(np.atleast_2d(outputs), self.model.ny)[0]
        if _is_plain(u, self.model.nu) and all_finite(np.asarray(u)):
            return outputs, np.asarray(u)
        try:
            inputs = np.atleast_1d(real_array(u, "u"))
        except SpecError:
            inputs = np.zeros((0, 0))
        require_inputs(inputs, self.model.input_names, state.k)
        return outputs, inputs

    def _estimates(self, state: DAEState, row: DAERow) -> Estimates:
        return SampleEstimates(self, row, state.informations)

    @property
    def graph(self) -> ObserverGraph:
        """The steps of each sample as CasADi functions, built when they are first needed."""
        return self.steps.graph

    @cached_property
    def library(self) -> DAELibrary:
        """The observer in C, compiled when it is first needed.

        Raises
        ------
        SpecError
            There is no compiler, or it fails.
        """
        return DAELibrary(self.steps)

    def run(
        self,
        y: ArrayLike,
        u: ArrayLike | None = None,
        *,
        compiled: bool | None = None,
        progress: bool | Callable[[int], None] | None = None,
    ) -> Estimates:
        """Run over a whole record.

        Parameters
        ----------
        y : array_like
            Outputs ``(samples, ny)``, the first at k = 0; NaN marks a missing one.
        u : array_like, optional
            Known inputs ``(samples, nu)``; ``u(k)`` holds during the step that ends at k, and ``u(0)`` puts the
            initial state onto its constraint.  May be left out when there are none.
        compiled : bool, optional
            ``None`` runs whole stretches inside CasADi, ``False`` each sample by itself, and ``True`` the observer as C
            (a compiler is needed, which takes about a second once for each observer).  The numbers are the same.
        progress : bool or callable, optional
            ``None`` shows a bar on a terminal in runs of more than two seconds, ``True`` everywhere, ``False`` never; a
            function is called with the number of samples that are done.

        Returns
        -------
        Estimates
            One row per sample.

        Raises
        ------
        SpecError
            Shapes do not fit, or an input is not finite (k is named); there is no compiler, but one is needed.
        SolverError
            A step has no solution; k, iteration and worst equation are named.
        """
        checked_value(compiled, "compiled", bool | None)
        outputs = measured_record(y, self.model.ny)
        inputs = checked_inputs(self.model, u, len(outputs))
        alone = self.outside_graph
        if compiled and not self.is_plain:
            raise SpecError(
                "The C code has neither sensors with their own times nor state_bounds: leave compiled=True out.",
                path="compiled",
            )
        if compiled and alone:
            raise SpecError(
                f"The C code has no {alone}: leave compiled=True out, or leave {alone} out.", path="compiled"
            )
        library = self.library if compiled else None
        found = GatheredRows(self)
        found.add(_nothing(self.steps))
        with shown_progress(progress, len(outputs), "samples") as note:
            if library is not None:
                _in_c(self.steps, library, outputs, inputs, found.add_regular, note)
            elif compiled is None and self.is_plain and not alone:
                advanced(self.steps, outputs, inputs, found.add_regular, note)
            else:
                state = self.init()
                for k in range(len(outputs)):
                    state, row = self.accept(state, outputs[k], inputs[k])
                    found.add(row)
                    note(k + 1)
        return found.estimates()
