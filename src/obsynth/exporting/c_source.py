"""A sampled observer as C99: one header, one source, no allocation, no library.

Words of C: names, comments and paths that a compiler takes, whatever they are made of.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence

import numpy as np

from obsynth.exporting.realisation import Realisation
from obsynth.numerics.arrays import FloatArray

_KEYWORDS = frozenset(
    {
        "auto", "break", "case", "char", "const", "continue", "default", "do", "double", "else", "enum", "extern",
        "float", "for", "goto", "if", "inline", "int", "long", "register", "restrict", "return", "short", "signed",
        "sizeof", "static", "struct", "switch", "typedef", "union", "unsigned", "void", "volatile", "while",
    }
)  # fmt: skip


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


_NUMBERS_PER_LINE = 4
#: Matrices with fewer entries are multiplied row by row: nothing is gained by more.
LARGE_TABLE = 1024
#: At most this share of entries that are not zero makes a matrix sparse.
SPARSE_SHARE = 0.25
#: Columns that are added in one pass over the rows.
UNROLLED = 4
PLAIN, ENTRIES, COLUMNS = "plain", "entries", "columns"
ADVICE = (
    "Compile with -O3, and with -march=native where it runs on the same machine: the products are written so that rows "
    "are independent, and sums keep their order."
)


def header_text(found: Realisation, prefix: str) -> str:
    """Return the header."""
    observer = found.observer
    guard = f"{prefix.upper()}_H"
    before, after = found.operating_point
    lines = [
        comment(f"Observer {quoted(found.design.name)} by {quoted(found.design.method)}, written by obsynth."),
        *([comment(found.note)] if found.note else []), f"#ifndef {guard}", f"#define {guard}", "",
        comment("sha256 of the gain set"), f'#define {prefix.upper()}_SHA256 "{found.digest}"',
        comment("seconds between samples"), f"#define {prefix.upper()}_DT {observer.dt!r}",
        "", "typedef struct {", f"    double z[{max(observer.order, 1)}];", f"}} {prefix}_state;", "",
        comment("Start where the design does." if found.start.any() else "Start at rest."),
        f"void {prefix}_reset({prefix}_state *state);", "",
        comment("Take one sample of each signal, write the estimates at that sample, and advance."),
        comment("Signals are deviations from the operating point. Returns 0; or 1 if a sample is not finite:"),
        comment("the state and the estimates are left as they were then."),
        *_signal_comments("u", found.inputs[: len(observer.input_names)], before),
        *_signal_comments("y", observer.output_names, before[len(observer.input_names) :]),
        *_signal_comments("states", observer.state_names, after, observer.state_delays),
        *_signal_comments("faults", observer.fault_names, after[len(observer.state_names) :], observer.fault_delays),
        *_signal_comments("residuals", observer.residual_names, None),
        f"{_step_signature(found, prefix)};", "", "#endif",
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


def source_text(found: Realisation, prefix: str, header: str) -> str:
    """Return the source."""
    observer = found.observer
    sizes = {"z": observer.order, "u": len(observer.input_names), "y": len(observer.output_names)}
    groups = (
        ("states", observer.state_rows), ("faults", observer.fault_rows), ("residuals", observer.residual_rows),
    )  # fmt: skip
    blocks: list[tuple[str, str, dict[str, FloatArray]]] = [
        (target, f"{target}[i]", {"z": observer.Cz[rows], "u": observer.Du[rows], "y": observer.Dy[rows]})
        for target, rows in groups
        if rows.stop > rows.start
    ]
    blocks.append(("next", "next[i]", {"z": observer.Az, "u": observer.Bu, "y": observer.By}))
    tables = [
        line for target, _, parts in blocks for signal, matrix in parts.items() if matrix.size
        for line in _tables(f"{target}_{signal}", matrix)
    ]  # fmt: skip
    large = any(_form(matrix) != PLAIN for _, _, parts in blocks for matrix in parts.values())
    advice = [comment(ADVICE), ""] if large else []
    body = [line for target, _, parts in blocks for line in _product(target, parts)]
    copy = [f"    for (i = 0; i < {sizes['z']}; i++) {{", "        state->z[i] = next[i];", "    }"]
    return "\n".join([
        comment(f"sha256 of the gain set: {found.digest}"), f'#include "{included(header)}"', "", "#include <math.h>",
        "", *advice, *tables, *_reset(found, prefix),
        _step_signature(found, prefix), "{", "    int i;", *(["    int j;"] if any(sizes.values()) else []),
        *([f"    double next[{sizes['z']}];"] if sizes["z"] else []),
        *([] if sizes["z"] else ["    (void)state;"]),
        *_guards(sizes), *body, *(copy if sizes["z"] else []), "    return 0;", "}",
    ]) + "\n"  # fmt: skip


def _reset(found: Realisation, prefix: str) -> Iterator[str]:
    start = "0.0"
    if found.start.any():
        yield from table_lines("start", found.start.reshape(1, -1))
        start = "start[0][i]"
    yield f"void {prefix}_reset({prefix}_state *state)"
    yield from ("{", "    int i;", f"    for (i = 0; i < {max(found.observer.order, 1)}; i++) {{")
    yield from (f"        state->z[i] = {start};", "    }", "}", "")


def _guards(sizes: dict[str, int]) -> Iterator[str]:
    for signal in "uy":
        if sizes[signal]:
            yield f"    for (i = 0; i < {sizes[signal]}; i++) {{"
            yield f"        if (!isfinite({signal}[i])) {{"
            yield "            return 1;"
            yield "        }"
            yield "    }"


def _form(matrix: FloatArray) -> str:
    """Return how a matrix is multiplied: small ones plainly, by entries where most are zero, else by columns."""
    if matrix.size < LARGE_TABLE:
        return PLAIN
    return ENTRIES if np.count_nonzero(matrix) <= SPARSE_SHARE * matrix.size else COLUMNS


def _product(target: str, parts: dict[str, FloatArray]) -> Iterator[str]:
    rows = next(iter(parts.values())).shape[0]
    if not rows:
        return
    if any(_form(matrix) != PLAIN for matrix in parts.values()):
        yield from _large_product(target, parts, rows)
        return
    yield f"    for (i = 0; i < {rows}; i++) {{"
    yield "        double sum = 0.0;"
    for signal, matrix in parts.items():
        if matrix.size:
            yield f"        for (j = 0; j < {matrix.shape[1]}; j++) {{"
            yield f"            sum += {target}_{signal}[i][j] * {_vector(signal)}[j];"
            yield "        }"
    yield f"        {target}[i] = sum;"
    yield "    }"


def _vector(signal: str) -> str:
    return "state->z" if signal == "z" else signal


def _large_product(target: str, parts: dict[str, FloatArray], rows: int) -> Iterator[str]:
    """Add column by column, so that rows are independent and a compiler can use vectors; the sums keep their order."""
    yield "    {"
    yield f"        double sum[{rows}];"
    yield f"        for (i = 0; i < {rows}; i++) {{"
    yield "            sum[i] = 0.0;"
    yield "        }"
    for signal, matrix in parts.items():
        if not matrix.size:
            continue
        name, vector, columns = f"{target}_{signal}", _vector(signal), matrix.shape[1]
        form = _form(matrix)
        if form == ENTRIES:
            yield f"        for (i = 0; i < {rows}; i++) {{"
            yield f"            for (j = {name}_start[i]; j < {name}_start[i + 1]; j++) {{"
            yield f"                sum[i] += {name}_value[j] * {vector}[{name}_column[j]];"
            yield "            }"
            yield "        }"
        elif form == PLAIN:
            yield f"        for (i = 0; i < {rows}; i++) {{"
            yield f"            for (j = 0; j < {columns}; j++) {{"
            yield f"                sum[i] += {name}[i][j] * {vector}[j];"
            yield "            }"
            yield "        }"
        else:
            whole = columns - columns % UNROLLED
            yield f"        for (j = 0; j < {whole}; j += {UNROLLED}) {{"
            terms = " + ".join(f"{name}[j + {k}][i] * {vector}[j + {k}]" for k in range(UNROLLED))
            yield from (f"            for (i = 0; i < {rows}; i++) {{", f"                sum[i] = sum[i] + {terms};")
            yield from ("            }", "        }")
            if whole < columns:
                yield f"        for (j = {whole}; j < {columns}; j++) {{"
                yield f"            for (i = 0; i < {rows}; i++) {{"
                yield f"                sum[i] += {name}[j][i] * {vector}[j];"
                yield from ("            }", "        }")
    yield f"        for (i = 0; i < {rows}; i++) {{"
    yield f"            {target}[i] = sum[i];"
    yield from ("        }", "    }")


def _tables(name: str, matrix: FloatArray) -> Iterator[str]:
    """Return the constants of a matrix, in the form in which it is multiplied."""
    form = _form(matrix)
    if form == PLAIN:
        yield from table_lines(name, matrix)
    elif form == COLUMNS:
        yield comment("by columns")
        yield from table_lines(name, matrix.T)
    else:
        yield comment("the entries that are not zero, row by row")
        rows, columns = np.nonzero(matrix)
        starts = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=len(matrix)))])
        yield from _list("int", f"{name}_start", [str(int(start)) for start in starts])
        yield from _list("int", f"{name}_column", [str(int(column)) for column in columns] or ["0"])
        yield from _list(
            "double", f"{name}_value", [repr(value) for value in matrix[rows, columns].tolist()] or ["0.0"]
        )


def _list(kind: str, name: str, texts: list[str]) -> Iterator[str]:
    lines = [", ".join(texts[i : i + _NUMBERS_PER_LINE]) for i in range(0, len(texts), _NUMBERS_PER_LINE)]
    yield f"static const {kind} {name}[{len(texts)}] = {{"
    yield "    " + ",\n    ".join(lines)
    yield from ("};", "")


def table_lines(name: str, matrix: FloatArray) -> Iterator[str]:
    """Yield the lines of a table of constants."""
    yield f"static const double {name}[{matrix.shape[0]}][{matrix.shape[1]}] = {{"
    for row in matrix.tolist():
        # repr gives the shortest text that is read back bit for bit.
        texts = [repr(value) for value in row]
        lines = [", ".join(texts[i : i + _NUMBERS_PER_LINE]) for i in range(0, len(texts), _NUMBERS_PER_LINE)]
        yield "    {" + ",\n     ".join(lines) + "},"
    yield "};"
    yield ""


def _step_signature(found: Realisation, prefix: str) -> str:
    observer = found.observer
    inputs = {"u": observer.input_names, "y": observer.output_names}
    outputs = {"states": observer.state_names, "faults": observer.fault_names, "residuals": observer.residual_names}
    arguments = [
        f"{prefix}_state *state",
        *(f"const double {name}[{len(names)}]" for name, names in inputs.items() if names),
        *(f"double {name}[{len(names)}]" for name, names in outputs.items() if names),
    ]
    return f"int {prefix}_step({', '.join(arguments)})"


def _signal_comments(
    array: str, names: Sequence[str], point: FloatArray | None, delays: Sequence[int] = ()
) -> Iterator[str]:
    for i, name in enumerate(names):
        at = f", operating point {float(point[i])!r}" if point is not None and point[i] else ""
        late = f", {delays[i]} sample(s) late" if delays and delays[i] else ""
        yield comment(f"{array}[{i}]: {quoted(name)}{at}{late}")
