"""A sampled observer as C99: one header, one source, no allocation, no library."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from importlib.resources import files

import numpy as np

from obsynth.errors import counted
from obsynth.exporting.alarms import Alarms
from obsynth.exporting.realisation import Realisation, verification_words
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.modes import SETTLING_SLACK
from obsynth.observers.nonlinear.c_code import in_lines

_KEYWORDS = frozenset(
    {
        "auto",
        "break",
        "case",
        "char",
        "const",
        "continue",
        "default",
        "do",
        "double",
        "else",
        "enum",
        "extern",
        "float",
        "for",
        "goto",
        "if",
        "inline",
        "int",
        "long",
        "register",
        "restrict",
        "return",
        "short",
        "signed",
        "sizeof",
        "static",
        "struct",
        "switch",
        "typedef",
        "union",
        "unsigned",
        "void",
        "volatile",
        "while",
    }
)

#: What stands around declarations so that C++ calls functions by their names in C.
_OPENED = '\n\n#ifdef __cplusplus\nextern "C" {\n#endif\n'

_CLOSED = "#ifdef __cplusplus\n}\n#endif\n\n"

#: Matrices with fewer entries are multiplied row by row: nothing is gained by more.
LARGE_TABLE = 1024

#: At most this share of entries that are not zero makes a matrix sparse.
SPARSE_C_SHARE = 0.25

#: Forms of tables, by the names of the macros that add them.
PLAIN, ENTRIES, COLUMNS_MACRO = "plain", "entries", "columns"

ADVICE = (
    "Compile with -O3, and with -march=native where it runs on the same machine: the products are written so that rows "
    "are independent, and sums keep their order."
)

#: What a row is called in C, as runs call it.
ROW_STATUSES = ("OK", "WARM_UP", "GAP", "RECOVERING", "PARTIAL")


def c_identifier(text: str) -> str:
    """Return a C identifier made of ``text``; one that C reserves, or that begins with a digit, gets a prefix."""
    name = re.sub(r"\W", "_", text, flags=re.ASCII)
    return name if re.match(r"[A-Za-z]", name) and name not in _KEYWORDS else f"obs_{name}"


def quoted(name: str) -> str:
    """Return a name in quotes, in ASCII, that cannot end or begin a comment or form a trigraph."""
    return json.dumps(name).replace("*/", "* /").replace("/*", "/ *").replace("??", "? ?").replace("??", "? ?")


def included(name: str) -> str:
    """Return the name of a header as an include line takes it."""
    return name.replace("\\", "/")


def comment(text: str) -> str:
    """Return a comment of one line."""
    return f"/* {text} */"


def with_c_linkage(header: str, prefix: str) -> str:
    """Return a header, guard and all, that C++ may include too."""
    head, body = header.split(f"#define {prefix.upper()}_H\n", 1)
    declared, end = body.rsplit("#endif", 1)
    return f"{head}#define {prefix.upper()}_H{_OPENED}{declared}{_CLOSED}#endif{end}"


def status_lines(prefix: str) -> list[str]:
    """Return the declaration of what a row is."""
    upper = prefix.upper()
    listed = ", ".join(f"{upper}_{name}" for name in ROW_STATUSES)
    return [
        comment("What a row is: alarms are raised in rows that are OK or PARTIAL, and where levels are passed by more"),
        comment("than a gap can have left in rows that are RECOVERING."),
        f"enum {{ {listed} }};",
    ]


def header_text(realisation: Realisation, prefix: str, alarms: Alarms) -> str:
    """Return the header."""
    observer, upper = realisation.observer, prefix.upper()
    before, after = realisation.operating_point
    units: Mapping[str, str] = realisation.design.plant.units
    lines = [
        comment(
            f"Observer {quoted(realisation.design.name)} by {quoted(realisation.design.method)}, written by obsynth."
        ),
        *([comment(realisation.note)] if realisation.note else []),
        comment(quoted(verification_words(realisation.design))),
        *(comment(line) for line in alarm_comments(alarms)),
        f"#ifndef {upper}_H",
        f"#define {upper}_H",
        "",
        comment("sha256 of the gain set"),
        f'#define {upper}_SHA256 "{realisation.digest}"',
        comment("seconds between samples"),
        f"#define {upper}_DT {observer.dt!r}",
        comment("outputs that may be watched"),
        f"#define {upper}_WATCHED {len(alarms.levels)}",
        "",
        *status_lines(prefix),
        "",
        *_state_struct(realisation, prefix, alarms),
        "",
        comment("Start where the design does." if realisation.start.any() else "Start at rest."),
        f"void {prefix}_reset({prefix}_state *state);",
        "",
        comment("Take one sample of each signal, write the estimates at that sample, and advance."),
        comment("Signals are deviations from the operating point; a missing one is NaN. Returns 0; or 1 if a sample"),
        comment("is missing: the model of the plant replaces it, fault estimates are held, and residuals are NaN."),
        *signal_comments("u", "", realisation.inputs[: len(observer.input_names)], before, units),
        *signal_comments("y", "", observer.output_names, before[len(observer.input_names) :], units),
        *signal_comments("states", "xhat", observer.state_names, after, units, observer.state_delays),
        *signal_comments(
            "faults", "fhat", observer.fault_names, after[len(observer.state_names) :], units, observer.fault_delays
        ),
        *signal_comments("residuals", "r", observer.residual_names, None, units),
        f"{_step_signature(realisation, prefix)};",
        "",
        comment("The same with signals and estimates as they are, not as deviations."),
        f"{_step_signature(realisation, prefix, 'take')};",
        "",
        "#endif",
    ]
    return "\n".join(lines) + "\n"


def alarm_comments(alarms: Alarms) -> list[str]:
    """Return what C says of alarms."""
    lines = [f"alarm[{i}]: {quoted(name)}" for i, name in enumerate(alarms.levels)]
    if alarms.monitor is not None:
        lines += [f"Monitor: {quoted(alarms.monitor.statement)}"]
        lines += [f"monitor.fault {i}: {quoted(name)}" for i, name in enumerate(alarms.fault_names)]
    return lines


def alarm_fields(alarms: Alarms, prefix: str) -> list[str]:
    """Return what a state says of a row and its alarms, as C declares it."""
    watched = max(len(alarms.levels), 1)
    return [
        "    int status;",
        f"    int alarm[{watched}];",
        "    int any_alarm;",
        comment("Set these after the reset: levels (0 for none), and seconds without alarms after the start."),
        f"    REAL level[{watched}];",
        "    double warm_up;",
        *([] if alarms.monitor is None else [f"    {prefix}_monitor monitor;"]),
    ]


def _state_struct(realisation: Realisation, prefix: str, alarms: Alarms) -> list[str]:
    """Return what the observer remembers, as C declares it."""
    observer, gap = realisation.observer, realisation.gap
    nz, nu, ny = observer.order, len(observer.input_names), len(observer.output_names)
    compared = len(observer.fault_names) + len(observer.residual_names)
    sizes = {
        "z": nz,
        "v": nu + ny,
        "measured": nu + ny,
        "inputs": gap.kept_inputs * nu,
        "fault": gap.faults,
        "shown": compared,
        "seen": gap.known_states,
        "model": gap.states,
        "left": nz * (nu + ny),
        "held": nu,
        "moves": 4 * nu,
        "reach": nu,
        "changes": compared,
        "excess": nz * (nu + ny),
        "carried": compared,
        "grown": compared,
    }
    return [
        *alarms.struct_lines(prefix),
        "typedef struct {",
        comment("Read these after a step: what the row was, and which outputs passed their levels."),
        *alarm_fields(alarms, prefix),
        comment("Everything else is the observer's own."),
        *(f"    REAL {name}[{max(size, 1)}];" for name, size in sizes.items()),
        "    double time, from, waiting;",
        "    long k, counted;",
        "    int kept, is_started, is_gap, phase;",
        f"}} {prefix}_state;",
    ]


def source_text(realisation: Realisation, prefix: str, header: str, alarms: Alarms) -> str:
    """Return the source."""
    groups, output_products = _output_products(realisation)
    step_products: dict[str, dict[str, FloatArray]] = {"next": realisation.transition}
    products = {**output_products, **step_products}
    large = any(_form(matrix) != PLAIN for parts in products.values() for matrix in parts.values())
    lines = [
        *_source_head(realisation, header, alarms),
        *([comment(ADVICE), ""] if large else []),
        *_product_tables(products),
        *_constant_tables(realisation, alarms),
        "",
        template("products.c"),
        *_products("say", ("z", "u", "y"), output_products, groups),
        *_products("next_of", tuple(realisation.transition), step_products, ("next",)),
        alarms.source(prefix),
        _step_text(realisation, prefix, alarms),
    ]
    return "\n".join(lines) + "\n"


def _output_products(realisation: Realisation) -> tuple[tuple[str, ...], dict[str, dict[str, FloatArray]]]:
    """Return the groups of output rows, and for each that has rows its matrices on the state, inputs and outputs."""
    observer, running = realisation.observer, realisation.running
    groups = {"states": observer.state_rows, "faults": observer.fault_rows, "residuals": observer.residual_rows}
    products = {
        group: {"z": running.Cz[rows], "u": running.Du[rows], "y": running.Dy[rows]}
        for group, rows in groups.items()
        if rows.stop > rows.start
    }
    return tuple(groups), products


def _source_head(realisation: Realisation, header: str, alarms: Alarms) -> list[str]:
    """Return what precedes the tables: what the file is, includes, macros and sizes."""
    gap = realisation.gap
    return [
        comment(f"sha256 of the gain set: {realisation.digest}"),
        comment(quoted(verification_words(realisation.design))),
        f'#include "{included(header)}"',
        "",
        "#include <math.h>",
        "#include <stddef.h>",
        "",
        "#if defined(__FAST_MATH__)",
        "#error a missing sample is NaN, which -ffast-math does not know",
        "#endif",
        "#define LENGTH(n) ((n) > 0 ? (n) : 1)",
        "#define ABS(x) ((x) < 0 ? -(x) : (x))",
        f"#define MODEL {int(gap.exists)}",
        f"#define SOLVED {int(gap.solved)}",
        f"#define STRAIGHT {int(realisation.straight)}",
        f"#define WARM_UP_SECONDS {alarms.warm_up!r}",
        f"#define SETTLING_SLACK {SETTLING_SLACK!r}",
        f"#define LEFT_SHARE ((REAL){gap.left_share!r})",
        "enum {",
        *(f"    {name} = {value}," for name, value in _sizes(realisation).items()),
        "};",
        "",
    ]


def _product_tables(products: Mapping[str, Mapping[str, FloatArray]]) -> Iterator[str]:
    """Yield the tables of the matrices of products, by target and signal."""
    for target, parts in products.items():
        for signal, matrix in parts.items():
            if matrix.size:
                yield from _tables(f"{target}_{signal}", matrix)


def _constant_tables(realisation: Realisation, alarms: Alarms) -> Iterator[str]:
    """Yield the tables of the first state, the operating point, levels of alarms, and the model for missing samples."""
    observer, gap = realisation.observer, realisation.gap
    before, after = realisation.operating_point
    constants = {
        "start": realisation.start.reshape(1, -1),
        "point_before": before.reshape(1, -1),
        **({"point_after": after.reshape(1, -1)} if len(observer.state_names) + len(observer.fault_names) else {}),
        "levels": np.array([list(alarms.levels.values())]),
        **gap.tables,
    }
    for name, table in constants.items():
        yield from table_lines(name, filled_table(table))
    yield from integer_table("told", gap.estimated)
    yield from integer_table("watched", range(len(alarms.levels)))


def _sizes(realisation: Realisation) -> dict[str, int]:
    """Return the sizes that the C text has as names."""
    observer, gap = realisation.observer, realisation.gap
    nu, ny = len(observer.input_names), len(observer.output_names)
    compared = len(observer.fault_names) + len(observer.residual_names)
    return {
        "Z_COUNT": observer.order,
        "U_COUNT": nu,
        "Y_COUNT": ny,
        "V_COUNT": nu + ny,
        "STATE_COUNT": len(observer.state_names),
        "FAULT_COUNT": len(observer.fault_names),
        "SHOWN_COUNT": compared,
        "WATCHED_COUNT": compared + 1,
        "MODEL_STATES": gap.states,
        "SEEN_COUNT": gap.known_states,
        "PLANT_FAULTS": gap.faults,
        "KEPT_INPUTS": gap.kept_inputs,
        "LEAST_SHOWN": gap.least_shown,
    }


def _products(
    name: str, signals: Sequence[str], blocks: dict[str, dict[str, FloatArray]], targets: Sequence[str]
) -> list[str]:
    """Return a function that writes products of vectors into its targets, by the macros of ``products.c``."""
    arguments = [f"const REAL *{signal}" for signal in signals] + [f"REAL *{target}" for target in targets]
    body = ["int i;", "int j;", *(f"(void){word};" for word in ("i", "j", *signals, *targets))]
    for target in (target for target in targets if target in blocks):
        rows = max(map(len, blocks[target].values()))
        parts = [(signal, _form(matrix), matrix.shape[1]) for signal, matrix in blocks[target].items() if matrix.size]
        if all(form == PLAIN for _, form, _ in parts):
            added = [f"    ADD_ROW({target}_{signal}, {signal}, {columns})" for signal, _, columns in parts]
            loop = f"for (i = 0; i < {rows}; i++) {{"
            body += [loop, "    REAL sum = 0;", *added, f"    {target}[i] = sum;", "}"]
        else:
            added = [f"    ADD_{form}({target}_{signal}, {signal}, {rows}, {n})" for signal, form, n in parts]
            body += ["{", f"    REAL sum[{rows}] = {{0}};", *added, f"    SET({target}, {rows})", "}"]
    return [f"static void {name}({', '.join(arguments)})", "{", *(f"    {line}" for line in body), "}", ""]


def _step_text(realisation: Realisation, prefix: str, alarms: Alarms) -> str:
    """Return everything that follows the tables: start, step, and the step of signals as they are."""
    observer = realisation.observer
    nu, ny = len(observer.input_names), len(observer.output_names)
    nx, nf, nr = len(observer.state_names), len(observer.fault_names), len(observer.residual_names)
    watched = alarms.monitor is not None
    arguments = ", ".join(_step_arguments(realisation, prefix))
    taken = (("v", "u", nu, 0), ("v + U_COUNT", "y", ny, nu))
    copied_out = (("faults", "shown", nf), ("residuals", "shown + FAULT_COUNT", nr))
    estimates = (("states", nx, 0), ("faults", nf, nx))
    signals = [("deviation", nu), ("deviation + U_COUNT", ny), ("states", nx), ("faults", nf), ("residuals", nr)]
    return filled_template(
        "linear_step.c",
        prefix,
        {
            "STATES_SCRATCH": "" if nx else "REAL states[1] = {0};",
            "COPY_IN": " ".join(f"copied({to}, {of}, {n});" for to, of, n, _ in taken if n),
            "COPY_OUT": " ".join(f"copied({to}, {of}, {n});" for to, of, n in copied_out if n),
            "MONITOR_RESET": "monitor_reset(&s->monitor);" if watched else "",
            "MONITOR_UNREPEAT": "monitor_range(&s->monitor, v);\n    monitor_unrepeat(&s->monitor, v + U_COUNT);"
            if watched
            else "",
            "MONITOR_STEP": (
                f"monitor_take(&s->monitor, shown, NULL, s->status == {prefix.upper()}_OK,\n"
                f"                 s->status == {prefix.upper()}_GAP, -1);\n"
                "    shown[SHOWN_COUNT] = s->monitor.statistic;"
                if watched
                else ""
            ),
            "STEP_ARGUMENTS": arguments.replace("*state", "*s", 1),
            "TAKE_ARGUMENTS": arguments,
            "TAKEN_SIGNALS": ", ".join(["state", *(name for name, n in signals if n)]),
            "LESS_POINT": " ".join(
                f"shifted(deviation + {at}, {of}, point_before[0] + {at}, -1, {n});" for _, of, n, at in taken if n
            ),
            "MORE_POINT": " ".join(
                f"shifted({of}, {of}, point_after[0] + {at}, 1, {n});" for of, n, at in estimates if n
            ),
        },
    )


def _form(matrix: FloatArray) -> str:
    """Return how a matrix is multiplied: small ones plainly, by entries where most are zero, else by columns."""
    if matrix.size < LARGE_TABLE:
        return PLAIN
    return ENTRIES if np.count_nonzero(matrix) <= SPARSE_C_SHARE * matrix.size else COLUMNS_MACRO


def _tables(name: str, matrix: FloatArray) -> Iterator[str]:
    """Return the constants of a matrix, in the form in which it is multiplied."""
    form = _form(matrix)
    if form == PLAIN:
        yield from table_lines(name, matrix)
    elif form == COLUMNS_MACRO:
        yield comment("by columns")
        yield from table_lines(name, matrix.T)
    else:
        yield comment("the entries that are not zero, row by row")
        rows, columns = np.nonzero(matrix)
        starts = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=len(matrix)))])
        yield from _list("int", f"{name}_start", [str(int(start)) for start in starts])
        yield from _list("int", f"{name}_column", [str(int(column)) for column in columns] or ["0"])
        yield from _list("REAL", f"{name}_value", [repr(value) for value in matrix[rows, columns].tolist()] or ["0.0"])


def _list(kind: str, name: str, texts: list[str]) -> Iterator[str]:
    yield f"static const {kind} {name}[{len(texts)}] = {{"
    yield "    " + ",\n    ".join(in_lines(texts))
    yield from ("};", "")


def table_lines(name: str, matrix: FloatArray) -> Iterator[str]:
    """Yield the lines of a table of constants."""
    yield f"static const REAL {name}[{matrix.shape[0]}][{matrix.shape[1]}] = {{"
    for row in matrix.tolist():
        # repr gives the shortest text that is read back bit for bit.
        yield "    {" + ",\n     ".join(in_lines([repr(value) for value in row])) + "},"
    yield from ("};", "")


def _step_arguments(realisation: Realisation, prefix: str) -> list[str]:
    observer = realisation.observer
    inputs = {"u": observer.input_names, "y": observer.output_names}
    outputs = {"states": observer.state_names, "faults": observer.fault_names, "residuals": observer.residual_names}
    return [
        f"{prefix}_state *state",
        *(f"const REAL {name}[{len(names)}]" for name, names in inputs.items() if names),
        *(f"REAL {name}[{len(names)}]" for name, names in outputs.items() if names),
    ]


def _step_signature(realisation: Realisation, prefix: str, name: str = "step") -> str:
    return f"int {prefix}_{name}({', '.join(_step_arguments(realisation, prefix))})"


def signal_comments(
    array: str,
    column: str,
    names: Sequence[str],
    point: FloatArray | None,
    units: Mapping[str, str],
    delays: Sequence[int] = (),
) -> Iterator[str]:
    """Return the comments that name the signals of an array."""
    for i, name in enumerate(names):
        at = f", operating point {float(point[i])!r}" if point is not None and point[i] else ""
        late = f", delayed by {counted(delays[i], 'sample')}" if delays and delays[i] else ""
        unit = f", {quoted(units[name])}" if units.get(name) else ""
        yield comment(f"{array}[{i}]: {quoted(f'{column}[{name}]' if column else name)}{unit}{at}{late}")


def filled_table(table: FloatArray) -> FloatArray:
    """Return a table without an empty side, which C has not."""
    filled = np.zeros(tuple(max(size, 1) for size in table.shape))
    filled[: table.shape[0], : table.shape[1]] = table
    return filled


def integer_table(name: str, values: Sequence[object], kind: str = "int") -> list[str]:
    """Return a constant table of whole numbers, or of texts of another kind of numbers."""
    return [f"static const {kind} {name}[{max(len(values), 1)}] = {{{', '.join(map(str, values)) or '0'}}};"]


def template(name: str, package: str = "obsynth.exporting") -> str:
    """Return the text of a file of C that is written around tables, from the templates of a package."""
    return files(package).joinpath("templates", name).read_text(encoding="utf-8")


def filled_template(name: str, prefix: str, words: Mapping[str, str], package: str = "obsynth.exporting") -> str:
    """Return a file of C with its prefix and other words put in, each once; a line that holds an empty one goes."""
    text = template(name, package)
    for word in (word for word, value in words.items() if not value):
        text = re.sub(rf"^ *{word}\n", "", text, flags=re.MULTILINE)
    replacements = {**words, "PREFIX": prefix, "UPPER": prefix.upper()}
    return re.sub(
        "|".join(sorted(replacements, key=len, reverse=True)), lambda match: replacements[match.group()], text
    )
