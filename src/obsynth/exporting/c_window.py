"""Guaranteed tests as C99: a window of samples, a dot product for each test, and its threshold."""

from __future__ import annotations

import numpy as np

from obsynth.errors import SpecError
from obsynth.exporting.c_source import comment, filled_template, included, quoted, table_lines
from obsynth.exporting.realisation import Realisation
from obsynth.methods.guaranteed_test.bank import groups_of, is_bank
from obsynth.methods.guaranteed_test.method import is_guaranteed
from obsynth.methods.guaranteed_test.result import GuaranteedTest
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.window.observer import WindowObserver
from obsynth.results.design import ObserverDesign


def require_fixed(design: ObserverDesign, suffix: str) -> None:
    """Raise `SpecError` for tests that solve programmes at each row, which no export holds."""
    if not is_guaranteed(design):
        return
    if isinstance(design.observer, WindowObserver):
        raise SpecError(
            f"Design {design.name!r} is for a plant that changes with k: its weights change from row to row, which no "
            "export holds. Run it with obsynth run, or with observer.step; gains and thresholds by row are in the gain "
            "set.",
            path="observer",
        )
    if (not is_window(design) or suffix != ".c") and design.linear[1].constant is not None:
        # Other formats have no place for the middle of such bounds.
        raise SpecError(
            f"Design {design.name!r} has bounds that do not lie about zero, so that its row has a constant part, which "
            "is exported as C (.c) only, without tolerances.",
            path="disturbance_bounds",
        )
    for name, is_on in (("exact", design.options.get("exact")), ("missing", design.options.get("missing") == "solve")):
        if is_on:
            raise SpecError(
                f"Design {design.name!r} has the option {name!r}: it solves linear programmes at each row, which "
                "exported code does not. Design it without: the fixed test, with its weights and thresholds, can be "
                "exported.",
                path=name,
            )


def is_window(design: ObserverDesign) -> bool:
    """Whether a design is nothing but tests on windows, without an observer of the state beside."""
    return is_guaranteed(design) and not design.linear[1].state_names


def window_c_texts(realisation: Realisation, prefix: str, header: str) -> tuple[str, str]:
    """Return source and header."""
    test = GuaranteedTest.of(realisation.design)
    count = len(test.tests)
    length = realisation.observer.order // count + 1
    nu, ny = len(realisation.observer.input_names), len(realisation.observer.output_names)
    taken = ([f"const double u[{nu}]"] if nu else []) + [f"const double y[{ny}]"]
    arguments = [f"{prefix}_state *state", *taken, f"double values[{count}]", f"double thresholds[{count}]"]
    signature = f"int {prefix}_step({', '.join(arguments)})"
    source = _window_source(realisation, test, prefix, header, signature, length)
    return source, _window_header(realisation, test, prefix, signature, length)


def _window_header(realisation: Realisation, test: GuaranteedTest, prefix: str, signature: str, length: int) -> str:
    """Return the header: what the file is, the state, and the step with its tests and signals by number."""
    observer, upper = realisation.observer, prefix.upper()
    width = len(observer.input_names) + len(observer.output_names)
    names, groups = realisation.design.linear[0].fault_names, groups_of(test) if is_bank(test) else None
    group_texts = [test.fault] if groups is None else [" or ".join(names[k] for k in group) for group in groups]
    lines = [
        comment(f"Test {quoted(test.name)} by {quoted(test.method)}, written by obsynth."),
        *([comment(quoted(realisation.mark))] if realisation.mark else []),
        f"#ifndef {upper}_H",
        f"#define {upper}_H",
        "",
        comment("sha256 of the gain set"),
        f'#define {upper}_SHA256 "{realisation.digest}"',
        comment("seconds between samples; samples of a window"),
        f"#define {upper}_DT {observer.dt!r}",
        f"#define {upper}_LENGTH {length}",
        "",
        "typedef struct {",
        f"    double window[{length}][{width}];",
        f"    double largest[{width}];",
        "    int at;",
        "    int rows;",
        f"}} {prefix}_state;",
        "",
        f"void {prefix}_reset({prefix}_state *state);",
        "",
        comment("Take one sample: deviations from the operating point, NaN where one is missing. A window that is not"),
        comment("complete has no verdict: its values are NaN. Returns the number, from 1, of the test that stands out"),
        comment("above its threshold, or 0. An alarm of a test means, while all bounds hold:"),
        *(comment(f"{number}: {quoted(name)}") for number, name in enumerate(group_texts, 1)),
        *(comment(f"u[{k}]: {quoted(name)}") for k, name in enumerate(observer.input_names)),
        *(comment(f"y[{k}]: {quoted(name)}") for k, name in enumerate(observer.output_names)),
        f"{signature};",
        "",
        "#endif",
    ]
    return "\n".join(lines) + "\n"


def _window_source(
    realisation: Realisation, test: GuaranteedTest, prefix: str, header: str, signature: str, length: int
) -> str:
    """Return the source: sizes, tables of weights, thresholds and rounding, and the step from its template."""
    observer, count = realisation.observer, len(test.tests)
    nu, ny = len(observer.input_names), len(observer.output_names)
    sizes = {"TESTS": count, "LENGTH": length, "WIDTH": nu + ny, "NU": nu}
    tables = {
        "weights": _weights(realisation, count, length),
        "limits": np.array([[row_test.threshold for row_test in test.tests]]),
        "constants": observer.added[None],
        "rounding": np.array([row_test.certificate.matrices["rounding"].ravel() for row_test in test.tests]),
    }
    copied = "for (i = 0; i < NU; i++) {\n        newest[i] = u[i];\n    }" if nu else ""
    body = filled_template("window_test.c", prefix, {"SIGNATURE": signature, "COPY_INPUTS": copied})
    lines = [
        comment(f"sha256 of the gain set: {realisation.digest}"),
        *([comment(quoted(realisation.mark))] if realisation.mark else []),
        f'#include "{included(header)}"',
        "",
        "#include <math.h>",
        "",
        "enum { " + ", ".join(f"{name} = {size}" for name, size in sizes.items()) + " };",
        "",
        comment("by test: weights of inputs and outputs, the newest sample first"),
        *(line for name, table in tables.items() for line in table_lines(name, table)),
        "",
        body,
    ]
    return "\n".join(lines)


def _weights(realisation: Realisation, count: int, length: int) -> FloatArray:
    """Return a row for each test: its weights of inputs and outputs at each sample of the window, newest first."""
    observer = realisation.observer
    newest, older = np.hstack([observer.Du, observer.Dy]), np.hstack([observer.Bu, observer.By])
    by_test = [np.vstack([newest[[k]], older[k * (length - 1) : (k + 1) * (length - 1)]]) for k in range(count)]
    return np.array([weights.ravel() for weights in by_test])
