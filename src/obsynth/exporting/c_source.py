"""A sampled observer as C99: one header, one source, no allocation, no library."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from obsynth.exporting.realisation import Realisation
from obsynth.numerics.arrays import FloatArray

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


#: What stands around declarations so that C++ calls functions by their names in C.
_OPENED = '\n\n#ifdef __cplusplus\nextern "C" {\n#endif\n'
_CLOSED = "#ifdef __cplusplus\n}\n#endif\n\n"


def with_c_linkage(header: str, prefix: str) -> str:
    """Return a header, guard and all, that C++ may include too."""
    head, body = header.split(f"#define {prefix.upper()}_H\n", 1)
    declared, end = body.rsplit("#endif", 1)
    return f"{head}#define {prefix.upper()}_H{_OPENED}{declared}{_CLOSED}#endif{end}"


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
        *([comment(found.note)] if found.note else []),
        *([comment(quoted(found.mark))] if found.mark else []),
        f"#ifndef {guard}",
        f"#define {guard}",
        "",
        comment("sha256 of the gain set"),
        f'#define {prefix.upper()}_SHA256 "{found.digest}"',
        comment("seconds between samples"),
        f"#define {prefix.upper()}_DT {observer.dt!r}",
        "",
        "typedef struct {",
        f"    double z[{max(observer.order, 1)}];",
        f"}} {prefix}_state;",
        "",
        comment("Start where the design does." if found.start.any() else "Start at rest."),
        f"void {prefix}_reset({prefix}_state *state);",
        "",
        comment("Take one sample of each signal, write the estimates at that sample, and advance."),
        comment("Signals are deviations from the operating point. Returns 0; or 1 if a sample is not finite:"),
        comment("the state and the estimates are left as they were then."),
        *_signal_comments("u", found.inputs[: len(observer.input_names)], before),
        *_signal_comments("y", observer.output_names, before[len(observer.input_names) :]),
        *_signal_comments("states", observer.state_names, after, observer.state_delays),
        *_signal_comments("faults", observer.fault_names, after[len(observer.state_names) :], observer.fault_delays),
        *_signal_comments("residuals", observer.residual_names, None),
        f"{_step_signature(found, prefix)};",
        "",
        "#endif",
    ]
    return "\n".join(lines) + "\n"


def source_text(found: Realisation, prefix: str, header: str) -> str:
    """Return the source."""
    observer = found.observer
    sizes = {"z": observer.order, "u": len(observer.input_names), "y": len(observer.output_names)}
    groups = {"states": observer.state_rows, "faults": observer.fault_rows, "residuals": observer.residual_rows}
    blocks: dict[str, dict[str, FloatArray]] = {
        target: {"z": observer.Cz[rows], "u": observer.Du[rows], "y": observer.Dy[rows]}
        for target, rows in groups.items()
        if rows.stop > rows.start
    }
    blocks["next"] = {"z": observer.Az, "u": observer.Bu, "y": observer.By}
    tables = [
        line
        for target, parts in blocks.items()
        for signal, matrix in parts.items()
        if matrix.size
        for line in _tables(f"{target}_{signal}", matrix)
    ]
    large = any(_form(matrix) != PLAIN for parts in blocks.values() for matrix in parts.values())
    body = [
        "int i;",
        *(["int j;"] if any(sizes.values()) else []),
        f"double next[{sizes['z']}];" if sizes["z"] else "(void)state;",
    ]
    for signal in "uy":
        if sizes[signal]:
            body += _loop("i", sizes[signal], [f"if (!isfinite({signal}[i])) {{", "    return 1;", "}"])
    for target, parts in blocks.items():
        body += _product(target, parts)
    body += _loop("i", sizes["z"], ["state->z[i] = next[i];"]) if sizes["z"] else []
    return (
        "\n".join(
            [
                comment(f"sha256 of the gain set: {found.digest}"),
                *([comment(quoted(found.mark))] if found.mark else []),
                f'#include "{included(header)}"',
                "",
                "#include <math.h>",
                "",
                *([comment(ADVICE), ""] if large else []),
                *tables,
                *_reset(found, prefix),
                *_function(_step_signature(found, prefix), [*body, "return 0;"]),
            ]
        )
        + "\n"
    )


def _reset(found: Realisation, prefix: str) -> list[str]:
    table, start = [], "0.0"
    if found.start.any():
        table, start = [*table_lines("start", found.start.reshape(1, -1))], "start[0][i]"
    body = ["int i;", *_loop("i", max(found.observer.order, 1), [f"state->z[i] = {start};"])]
    return [*table, *_function(f"void {prefix}_reset({prefix}_state *state)", body), ""]


def _function(signature: str, body: Iterable[str]) -> list[str]:
    return [signature, "{", *(f"    {line}" for line in body), "}"]


def _loop(index: str, end: int | str, body: Iterable[str], *, start: int | str = 0, step: int = 1) -> list[str]:
    """Return the lines of a loop."""
    advance = f"{index}++" if step == 1 else f"{index} += {step}"
    return [f"for ({index} = {start}; {index} < {end}; {advance}) {{", *(f"    {line}" for line in body), "}"]


def _form(matrix: FloatArray) -> str:
    """Return how a matrix is multiplied: small ones plainly, by entries where most are zero, else by columns."""
    if matrix.size < LARGE_TABLE:
        return PLAIN
    return ENTRIES if np.count_nonzero(matrix) <= SPARSE_SHARE * matrix.size else COLUMNS


def _product(target: str, parts: dict[str, FloatArray]) -> list[str]:
    """Return the product of the rows of a target."""
    # Large ones column by column, so that rows are independent and a compiler can use vectors; sums keep their order.
    rows = next(iter(parts.values())).shape[0]
    if not rows:
        return []
    if all(_form(matrix) == PLAIN for matrix in parts.values()):
        sums = [
            line
            for signal, matrix in parts.items()
            if matrix.size
            for line in _row_sum("sum", f"{target}_{signal}", _vector(signal), matrix.shape[1])
        ]
        return _loop("i", rows, ["double sum = 0.0;", *sums, f"{target}[i] = sum;"])
    lines = [f"double sum[{rows}];", *_loop("i", rows, ["sum[i] = 0.0;"])]
    for signal, matrix in parts.items():
        if matrix.size:
            lines += _added(f"{target}_{signal}", _vector(signal), matrix)
    lines += _loop("i", rows, [f"{target}[i] = sum[i];"])
    return ["{", *(f"    {line}" for line in lines), "}"]


def _vector(signal: str) -> str:
    return "state->z" if signal == "z" else signal


def _row_sum(total: str, name: str, vector: str, columns: int) -> list[str]:
    return _loop("j", columns, [f"{total} += {name}[i][j] * {vector}[j];"])


def _added(name: str, vector: str, matrix: FloatArray) -> list[str]:
    """Return the lines that add a matrix times a vector to the sums of all rows."""
    rows, columns = matrix.shape
    form = _form(matrix)
    if form == PLAIN:
        return _loop("i", rows, _row_sum("sum[i]", name, vector, columns))
    if form == ENTRIES:
        entry = f"sum[i] += {name}_value[j] * {vector}[{name}_column[j]];"
        return _loop("i", rows, _loop("j", f"{name}_start[i + 1]", [entry], start=f"{name}_start[i]"))
    whole = columns - columns % UNROLLED
    terms = " + ".join(f"{name}[j + {k}][i] * {vector}[j + {k}]" for k in range(UNROLLED))
    lines = _loop("j", whole, _loop("i", rows, [f"sum[i] = sum[i] + {terms};"]), step=UNROLLED)
    if whole < columns:
        lines += _loop("j", columns, _loop("i", rows, [f"sum[i] += {name}[j][i] * {vector}[j];"]), start=whole)
    return lines


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
    yield f"static const {kind} {name}[{len(texts)}] = {{"
    yield "    " + ",\n    ".join(_in_lines(texts))
    yield from ("};", "")


def table_lines(name: str, matrix: FloatArray) -> Iterator[str]:
    """Yield the lines of a table of constants."""
    yield f"static const double {name}[{matrix.shape[0]}][{matrix.shape[1]}] = {{"
    for row in matrix.tolist():
        # repr gives the shortest text that is read back bit for bit.
        yield "    {" + ",\n     ".join(_in_lines([repr(value) for value in row])) + "},"
    yield from ("};", "")


def _in_lines(texts: list[str]) -> list[str]:
    return [", ".join(texts[i : i + _NUMBERS_PER_LINE]) for i in range(0, len(texts), _NUMBERS_PER_LINE)]


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
