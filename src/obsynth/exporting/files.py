"""Writing a gain set for other programs.

How far an observer in single precision may be from the one in double precision.

Guaranteed tests as C99: a window of samples, a dot product for each test, and its threshold.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np

from obsynth.errors import SpecError
from obsynth.experiments.monitors.learned import LearnedRule, LearnedThresholds
from obsynth.experiments.monitors.monitor import Monitor
from obsynth.exporting.c_source import (
    Alarms,
    Realisation,
    c_identifier,
    comment,
    dae_alarms,
    filled_template,
    header_text,
    in_precision,
    included,
    linear_alarms,
    quoted,
    source_text,
    table_lines,
    threshold_header,
    threshold_source,
    with_c_linkage,
    write_dae_c,
)
from obsynth.files.outputs import FileKind, write_atomically, write_together
from obsynth.methods.guaranteed_test.checks import groups_of, is_bank
from obsynth.methods.guaranteed_test.method import is_guaranteed
from obsynth.methods.guaranteed_test.result import GuaranteedTest
from obsynth.numerics.arguments import FloatArray, arguments_checked
from obsynth.observers.dae.observer import DAEObserver
from obsynth.observers.linear.observer import WindowObserver
from obsynth.observers.outliers import Outliers
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.running import require_plain
from obsynth.results.design import ObserverDesign, gain_set_digest, require_verified
from obsynth.verification.adaptive_bound import AdaptiveBound

#: Relative rounding of a float, and of a double.
UNIT = 2.0**-24
#: Samples whose effects are summed up at most, and what is left of an effect that is over.
MOST_SUMMED_SAMPLES, OVER = 100_000, 1e-9
#: Rounds in which an error that feeds on itself has to settle, and by how much it may still grow.
MOST_ROUNDS, SETTLED_ERROR = 100, 1e-3


def float_bounds(found: Realisation) -> FloatArray | None:
    """Return a bound on the error of each row of estimates ``(rows,)``, for inputs and outputs whose deviations stay
    within one unit, and samples that are complete; `None` where none is found.

    Rounding of n products and of the coefficients is at most ``(n + 2) u`` of the sum of their sizes (Higham 2002,
    lemma 3.1); errors of the state are carried on by ``sum |Az^k|``.
    """
    observer = found.observer
    driven = np.abs(np.hstack(list(found.transition.values())[1:])).sum(axis=1)
    if found.straight:
        # A rise between samples is at most two units.
        driven = driven + np.abs(found.transition["rise"]).sum(axis=1)
    transition, rows = found.transition["z"], np.abs(found.running.Cz)
    through = np.abs(np.hstack([found.running.Du, found.running.Dy])).sum(axis=1)
    gathered = _sum_of_powers(transition)
    if gathered is None:
        return None
    # A sum that is not known of all samples is rounded up.
    size, count = gathered @ driven, observer.order + 2 * len(found.inputs) + 2
    unit = count * UNIT / (1.0 - count * UNIT)
    error = np.zeros(observer.order)
    for _ in range(MOST_ROUNDS):
        local = unit * (np.abs(transition) @ (size + error) + driven)
        after = gathered @ local
        if np.all(after <= error * (1.0 + SETTLED_ERROR)):
            return np.asarray((1.0 + SETTLED_ERROR) * (rows @ error + unit * (rows @ (size + error) + through)))
        error = np.maximum(after, error) * (1.0 + SETTLED_ERROR)
    return None


def _sum_of_powers(matrix: FloatArray) -> FloatArray | None:
    """Return ``sum |A^k|`` over all k >= 0, from above but for rounding; `None` where it does not end."""
    power, total = np.eye(len(matrix)), np.zeros_like(matrix)
    for _ in range(MOST_SUMMED_SAMPLES):
        with np.errstate(over="ignore", invalid="ignore"):  # an observer that is not stable
            total += np.abs(power)
            power = power @ matrix
        left = float(np.abs(power).sum(axis=1).max(initial=0.0))
        if not np.isfinite(left):
            return None
        if left <= OVER:
            # What is left: |A^K| sum |A^k|, which is less than a share OVER of the sum.
            return np.asarray(total * (1.0 + OVER) / (1.0 - OVER) + OVER * np.abs(total).sum())
    return None


def float_error(found: Realisation) -> str:
    """Return what the header of an export in floats says of its error."""
    bounds = float_bounds(found)
    if bounds is None:
        return "Floats: no bound on the error of single precision was found, as its errors decay too slowly."
    names = found.observer.row_names
    listed = ", ".join(f"{name} {bound:.2g}" for name, bound in zip(names, bounds, strict=True))
    return (
        "Floats: a derived bound on the error against double precision, for complete samples whose deviations stay "
        f"within 1 unit each (n times as much for n units): {listed}"
    )


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
    for name, asked in (("exact", design.options.get("exact")), ("missing", design.options.get("missing") == "solve")):
        if asked:
            raise SpecError(
                f"Design {design.name!r} has the option {name!r}: it solves linear programmes at each row, which "
                "exported code does not. Design it without: the fixed test, with its weights and thresholds, can be "
                "exported.",
                path=name,
            )


def is_window(design: ObserverDesign) -> bool:
    """Whether a design is nothing but tests on windows, without an observer of the state beside."""
    return is_guaranteed(design) and not design.linear[1].state_names


def window_c_texts(found: Realisation, prefix: str, header: str) -> tuple[str, str]:
    """Return source and header."""
    test = GuaranteedTest.of(found.design)
    observer, count = found.observer, len(test.tests)
    length = observer.order // count + 1
    nu, ny = len(observer.input_names), len(observer.output_names)
    sizes = {"TESTS": count, "LENGTH": length, "WIDTH": nu + ny, "NU": nu}
    tables = {
        "weights": _weights(found, count, length),
        "limits": np.array([[one.threshold for one in test.tests]]),
        "constants": observer.added[None],
        "rounding": np.array([one.certificate.matrices["rounding"].ravel() for one in test.tests]),
    }
    taken = ([f"const double u[{nu}]"] if nu else []) + [f"const double y[{ny}]"]
    arguments = [f"{prefix}_state *state", *taken, f"double values[{count}]", f"double thresholds[{count}]"]
    signature = f"int {prefix}_step({', '.join(arguments)})"
    upper = prefix.upper()
    names, groups = found.design.linear[0].fault_names, groups_of(test) if is_bank(test) else None
    told = [test.fault] if groups is None else [" or ".join(names[k] for k in group) for group in groups]
    declared = [
        comment(f"Test {quoted(test.name)} by {quoted(test.method)}, written by obsynth."),
        *([comment(quoted(found.mark))] if found.mark else []),
        f"#ifndef {upper}_H",
        f"#define {upper}_H",
        "",
        comment("sha256 of the gain set"),
        f'#define {upper}_SHA256 "{found.digest}"',
        comment("seconds between samples; samples of a window"),
        f"#define {upper}_DT {observer.dt!r}",
        f"#define {upper}_LENGTH {length}",
        "",
        "typedef struct {",
        f"    double window[{length}][{nu + ny}];",
        f"    double largest[{nu + ny}];",
        "    int at;",
        "    int rows;",
        f"}} {prefix}_state;",
        "",
        f"void {prefix}_reset({prefix}_state *state);",
        "",
        comment("Take one sample: deviations from the operating point, NaN where one is missing. A window that is not"),
        comment("complete has no verdict: its values are NaN. Returns the number, from 1, of the test that stands out"),
        comment("above its threshold, or 0. An alarm of a test means, while all bounds hold:"),
        *(comment(f"{number}: {quoted(name)}") for number, name in enumerate(told, 1)),
        *(comment(f"u[{k}]: {quoted(name)}") for k, name in enumerate(observer.input_names)),
        *(comment(f"y[{k}]: {quoted(name)}") for k, name in enumerate(observer.output_names)),
        f"{signature};",
        "",
        "#endif",
    ]
    copied = "for (i = 0; i < NU; i++) {\n        newest[i] = u[i];\n    }" if nu else ""
    body = filled_template("window_test.c", prefix, {"SIGNATURE": signature, "COPY_INPUTS": copied})
    source = [
        comment(f"sha256 of the gain set: {found.digest}"),
        *([comment(quoted(found.mark))] if found.mark else []),
        f'#include "{included(header)}"',
        "",
        "#include <math.h>",
        "",
        "enum { " + ", ".join(f"{name} = {size}" for name, size in sizes.items()) + " };",
        "",
        comment("by test: weights of inputs and outputs, the newest sample first"),
        *(line for name, table in tables.items() for line in table_lines(name, table)),
    ]
    return "\n".join([*source, "", body]), "\n".join(declared) + "\n"


def _weights(found: Realisation, count: int, length: int) -> FloatArray:
    """Return a row for each test: its weights of inputs and outputs at each sample of the window, newest first."""
    observer = found.observer
    newest, older = np.hstack([observer.Du, observer.Dy]), np.hstack([observer.Bu, observer.By])
    each = [np.vstack([newest[[k]], older[k * (length - 1) : (k + 1) * (length - 1)]]) for k in range(count)]
    return np.array([weights.ravel() for weights in each])


EXPORT_SUFFIXES = (".mat", ".npz", ".c", ".fmu")

#: What an existing file has to be for another export to take its place.
_C_FILE = FileKind("C code that obsynth has exported", rb"sha256 of the gain set")
EXPORTED = {
    ".mat": FileKind("an observer that obsynth has exported", rb"\AMATLAB 5.0 MAT-file(?s:.*)sha256"),
    ".npz": FileKind("an observer that obsynth has exported", rb"\APK(?s:.*)sha256\.npy"),
    ".c": _C_FILE,
    ".h": _C_FILE,
    ".fmu": FileKind("an observer that obsynth has exported", rb"\APK(?s:.*)sources/observer\.c"),
}


#: Headers of C11, without their suffix.
_C_HEADERS = re.compile(
    "assert|complex|ctype|errno|fenv|float|inttypes|iso646|limits|locale|math|setjmp|signal|stdalign|stdarg|stdatomic|"
    "stdbool|stddef|stdint|stdio|stdlib|stdnoreturn|string|tgmath|threads|time|uchar|wchar|wctype",
    re.IGNORECASE,
)


@arguments_checked
def export(
    design: ObserverDesign,
    path: str | Path,
    *,
    sample_time: float | None = None,
    fmi: Literal["2.0", "3.0"] | None = None,
    thresholds: Mapping[str, float] | None = None,
    warm_up: float | None = None,
    monitor: Monitor | None = None,
    precision: Literal["double", "float"] | None = None,
    outliers: Outliers | None = None,
    unverified: bool = False,
) -> tuple[Path, ...]:
    """Write the observer of a design for MATLAB and Simulink, for numpy, as C99, or as a functional mock-up unit.

    Parameters
    ----------
    design : ObserverDesign
        Linear, or recursive for a time-invariant plant: then the steady state of its recursion, which is what it is
        once the covariances have settled.
    path : path
        Its suffix says what is written.  ``.mat`` and ``.npz``: ``A (nz, nz)``, ``B (nz, nu + ny)``, ``C``, ``D``,
        ``x0 (nz, 1)`` and ``Ts`` (seconds, 0 for continuous time) of the system from ``[u; y]`` to
        ``[xhat; fhat; r]``, as a State-Space block takes them, with ``input_names``, ``output_names``, ``delays``
        (samples, of states and faults), ``input_point``, ``output_point``, ``name``, ``method`` and ``sha256``; a
        ``.mat`` has the structures ``gains``, by the letters of the method's paper, and ``certificate`` besides.
        ``.c``: a source file and the header beside it, with functions ``<stem>_reset`` and ``<stem>_step`` (of a
        guaranteed test a dot product over its window, with its threshold and its alarm); the only
        one besides ``.fmu`` for an observer of a nonlinear DAE, which holds the implicit step with its homotopy.
        ``.fmu``: a functional mock-up unit for co-simulation with that C inside, and a binary for this machine where
        a compiler is: inputs by the names of the signals, outputs ``xhat[...]``, ``fhat[...]``, ``r[...]`` and
        ``alarm[...]``, parameters ``operating_point[...]``, ``threshold[...]`` and ``warm_up``, with units.
    sample_time : float, optional, seconds
        Samples a continuous-time observer by a first-order hold; needed for C and an FMU.
    fmi : str, optional
        Version of FMI, ``"2.0"`` (the default) or ``"3.0"``; for ``.fmu`` only.
    thresholds : mapping, optional
        Level of the absolute value by output, such as ``fhat[actuator]`` or ``r[speed]`` (of faults with an operating
        point, of the deviation), above which its alarm is raised; for ``.c`` and ``.fmu``, where they can be changed.
    warm_up : float, optional, seconds
        Without alarms after the start; by default until the slowest mode has shrunk to 2 %.  For ``.c``, ``.fmu``.
    monitor : Monitor, optional
        From `online_monitor`: one that was learned from rows without faults (``"learned"``; its statistic and alarms
        are those of a run), for ``.c`` and ``.fmu``; or with ``constants``, its thresholds over the tolerances as
        ``<stem>_thresholds_step``, for constants that stay the same; for ``.c`` only.
    precision : {"double", "float"}, optional
        Of the numbers in C; the header of floats bounds what these change for linear observers, and says what was
        measured for nonlinear ones (which takes a C compiler).
    outliers : {"gate", "huber", "none"}, optional
        Of a nonlinear design: what is done with outliers, in place of what the design states, as for `run_on_data`.
        Where neither states it, they are left out; ``"none"`` uses every sample.
    unverified : bool, optional
        Whether a design whose report fails is written all the same, with a mark in the file that says so.

    Returns
    -------
    tuple of Path
        The files.

    Raises
    ------
    SpecError
        A plant or its noise changes with k, the plant is nonlinear, the suffix is unknown, the sample time is missing
        or does not fit, or a file cannot be written.
    PreconditionError, SolverError
        A recursive design has no stable steady state, or none that is reached.
    VerificationError
        The report of the design fails.

    Notes
    -----
    Every file holds the sha256 digest of the gain set.  Signals are deviations from the operating point,
    except in an FMU, whose signals are absolute: it subtracts the operating point and adds it back.  An FMU takes its
    inputs at the beginning of a communication step, which is a multiple of ``dt``, and shows the estimates of that
    sample at its end.

    C and FMU start as `run_on_data` does, and take a missing sample (NaN) as it does on regular rows: of linear designs
    the model of the plant stands in for the sensors, faults are held and residuals are NaN; nonlinear ones predict.
    ``status`` says what a row was, and alarms are raised in rows that are ``OK`` or ``PARTIAL``.
    """
    target = Path(path)
    suffix = target.suffix.lower()
    if suffix not in EXPORT_SUFFIXES:
        raise SpecError(f"{target} has an unknown suffix: use one of {', '.join(EXPORT_SUFFIXES)}.", path=str(target))
    if suffix == ".c" and _C_HEADERS.fullmatch(target.stem):
        raise SpecError(
            f"{target} comes with a header {target.stem}.h, which a compiler may read in place of C's own: name it "
            "otherwise, such as observer.c.",
            path=str(target),
        )
    require_verified(design, unverified=unverified)
    require_fixed(design, suffix)
    if isinstance(design.observer, RecursiveObserver):
        require_plain(design.observer, "An export")
    _require_fitting_options(
        suffix, fmi=fmi, thresholds=thresholds, warm_up=warm_up, monitor=monitor, precision=precision
    )
    numbers = precision or "double"
    if outliers is not None and not isinstance(design.observer, DAEObserver):
        raise SpecError("outliers is for nonlinear designs: exports of others use every sample.", path="outliers")
    learned = None if monitor is None else _learned_by(monitor, design)
    if suffix == ".fmu":
        from obsynth.exporting.fmu.archive import write_fmu

        if monitor is not None and learned is None:
            raise SpecError(
                "An FMU holds learned monitors and levels of outputs, not this monitor: write it as C (.c).",
                path="monitor",
            )
        made = write_fmu(
            design,
            target,
            version=fmi or "2.0",
            sample_time=sample_time,
            thresholds=thresholds,
            warm_up=warm_up,
            learned=learned,
            outliers=outliers,
        )
        return (made,)
    if isinstance(design.observer, DAEObserver):
        if monitor is not None and learned is None:
            raise SpecError("Of nonlinear designs, learned monitors are written as C.", path="monitor")
        alarms = dae_alarms(design, thresholds, warm_up, learned)
        return write_dae_c(design, target, sample_time, alarms, numbers, outliers)
    found = Realisation.of(design, sample_time, numbers)
    if suffix != ".c":
        return (write_atomically(target, _as_arrays(found, design, suffix)),)
    if is_window(design):
        if monitor is not None or thresholds or warm_up is not None or numbers != "double":
            raise SpecError(
                "A guaranteed test has its own threshold, in doubles: leave monitor, thresholds, warm-up and precision "
                "out.",
                path="monitor",
            )
        return _write_window(found, target, numbers)
    if found.observer.dt == 0.0:
        raise SpecError(
            "The observer is continuous in time: give the sample time, in seconds, for C.", path="sample_time"
        )
    bound = None if monitor is None or learned is not None else _bound_of(monitor, found)
    return _write_c(found, target, linear_alarms(found, thresholds, warm_up, learned), bound)


def _write_window(found: Realisation, target: Path, numbers: str) -> tuple[Path, ...]:
    """Write a guaranteed test as C."""
    prefix, header = c_identifier(target.stem), target.with_suffix(".h")
    source, declared = (in_precision(text, numbers) for text in window_c_texts(found, prefix, header.name))
    return write_together({target: source, header: with_c_linkage(declared, prefix)})


def _require_fitting_options(
    suffix: str,
    *,
    fmi: str | None,
    thresholds: Mapping[str, float] | None,
    warm_up: float | None,
    monitor: Monitor | None,
    precision: str | None,
) -> None:
    """Raise `SpecError` for what a file of this suffix does not take."""
    if precision is not None and suffix != ".c":
        raise SpecError("precision is for C (.c): other files hold doubles.", path="precision")
    if monitor is not None and suffix not in (".c", ".fmu"):
        raise SpecError("A monitor is written as C (.c) or in an FMU (.fmu).", path="monitor")
    if fmi is not None and suffix != ".fmu":
        raise SpecError("fmi is the version of an FMU (.fmu): other files have none.", path="fmi")
    if suffix not in (".c", ".fmu") and (thresholds or warm_up is not None):
        raise SpecError(
            "Thresholds and warm-up are for C (.c) and an FMU (.fmu): other files hold no alarms.", path="thresholds"
        )


def _as_arrays(found: Realisation, design: ObserverDesign, suffix: str) -> bytes:
    """Return the contents of a file of arrays for numpy or MATLAB."""
    buffer, arrays = io.BytesIO(), found.as_arrays()
    if suffix == ".npz":
        np.savez(buffer, **arrays)
        return buffer.getvalue()
    from scipy.io import savemat

    # Cell arrays of texts, and vectors as columns.
    named = {key: np.array(value, dtype=object) if isinstance(value, list) else value for key, value in arrays.items()}
    # Gains by the letters of the method's paper, and the matrices of the certificate, as structures.
    for key, matrices in (("gains", design.gains), ("certificate", design.certificate.matrices)):
        fields = {name: matrix for name, matrix in matrices.items() if name.isidentifier()}
        if fields:
            named[key] = fields
    savemat(buffer, named, oned_as="column", long_field_names=True)
    return buffer.getvalue()


def exported_files(target: Path) -> dict[Path, FileKind | None]:
    """Return the files that an export to ``target`` writes, with their kinds: a C source comes with its header."""
    suffix = target.suffix.lower()
    header = {target.with_suffix(".h"): EXPORTED[".h"]} if suffix == ".c" else {}
    return {target: EXPORTED.get(suffix), **header}


def _bound_of(monitor: Monitor, found: Realisation) -> AdaptiveBound:
    """Return the bound of an adaptive monitor of the design that is written."""
    monitor.require_fit(len(found.observer.residual_names), found.observer.fault_names)
    plan = getattr(monitor.rule, "plan", None)
    bound: AdaptiveBound | None = None if plan is None else plan.bound
    if bound is None:
        raise SpecError("The monitor has no thresholds over tolerances: make it with constants.", path="monitor")
    if bound.first is not None:
        raise SpecError(
            "Thresholds of continuous designs are not written as C: sample the plant first.", path="monitor"
        )
    return bound


def _learned_by(monitor: Monitor, design: ObserverDesign) -> LearnedThresholds | None:
    """Return what a monitor has learned, of this design."""
    if not isinstance(monitor.rule, LearnedRule):
        return None
    learned = monitor.rule.learned
    if learned.gains != gain_set_digest(design):
        raise SpecError("The thresholds were learned with another gain set: learn them again.", path="monitor")
    if isinstance(design.observer, RecursiveObserver):
        raise SpecError(
            "The steady state of a recursive design, which is what is exported, has other innovations than the "
            "recursion that the thresholds were learned from: use levels of its outputs (thresholds).",
            path="monitor",
        )
    return learned


def _write_c(found: Realisation, target: Path, alarms: Alarms, bound: AdaptiveBound | None = None) -> tuple[Path, ...]:
    prefix = c_identifier(target.stem)
    header = target.with_suffix(".h")
    source, declared = source_text(found, prefix, header.name, alarms), header_text(found, prefix, alarms)
    if found.precision != "double":
        declared = f"{comment(quoted(float_error(found)))}\n{declared}"
    source, declared = in_precision(source, found.precision), in_precision(declared, found.precision)
    if bound is not None:
        if found.precision != "double":
            raise SpecError("Thresholds over tolerances are guaranteed in double precision only.", path="precision")
        begin, end = declared.rsplit("#endif", 1)
        declared = begin + threshold_header(bound, prefix) + "#endif" + end
        source += threshold_source(bound, prefix)
    return write_together({target: source, header: with_c_linkage(declared, prefix)})
