"""The public `export` of a design: the kind of file by its suffix, and the options that each kind takes."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from obsynth.errors import SpecError
from obsynth.exporting.alarms import Alarms, ExportedMonitor, Monitor, linear_alarms, scheduled_alarms
from obsynth.exporting.c_precision import in_precision
from obsynth.exporting.c_scheduled import scheduled_c_texts, seconds_between_rows
from obsynth.exporting.c_source import c_identifier, comment, header_text, quoted, source_text, with_c_linkage
from obsynth.exporting.c_window import is_window, require_fixed, window_c_texts
from obsynth.exporting.dae_c_source import dae_alarms, threshold_header, threshold_source, write_dae_c
from obsynth.exporting.float_error import float_error
from obsynth.exporting.independent import copy_checker
from obsynth.exporting.proof_file import write_proof
from obsynth.exporting.realisation import Realisation
from obsynth.exporting.scheduled_arrays import scheduled_arrays
from obsynth.files.inputs import suffix_error
from obsynth.files.outputs import FileKind, write_atomically, write_together
from obsynth.numerics.arguments import arguments_checked
from obsynth.observers.nonlinear.observer import DAEObserver
from obsynth.observers.nonlinear.region_observer import RegionObserver
from obsynth.observers.outliers import Outliers
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.scheduled.observer import ScheduledObserver
from obsynth.observers.sensor_timing import require_plain
from obsynth.results.design import ObserverDesign, require_verified
from obsynth.results.registered import registered
from obsynth.verification.over_tolerances.adaptive_bound import AdaptiveBound

EXPORT_SUFFIXES = (".mat", ".npz", ".c", ".fmu", ".json")

#: What an existing file has to be for another export to take its place.
_C_FILE = FileKind("C code that obsynth has exported", rb"sha256 of the gain set")

EXPORTED = {
    ".mat": FileKind("an observer that obsynth has exported", rb"\AMATLAB 5.0 MAT-file(?s:.*)sha256"),
    ".npz": FileKind("an observer that obsynth has exported", rb"\APK(?s:.*)sha256\.npy"),
    ".c": _C_FILE,
    ".h": _C_FILE,
    ".fmu": FileKind("an observer that obsynth has exported", rb"\APK(?s:.*)sources/observer\.c"),
    ".json": FileKind("a proof file", rb'\A\{"format":"obsynth-proof"'),
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
    checker: bool = False,
    unverified: bool = False,
) -> tuple[Path, ...]:
    """Write the observer of a design for MATLAB, numpy, as C99 or an FMU, or the proof of its claims.

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
        ``.mat`` has the structures ``gains``, by the letters of the method's paper, and ``certificate`` besides.  Of a
        design over a region A, B and ``effectiveness`` have a page for each vertex, ``(nz, nz, N)``; ``functions`` of
        the ``parameters`` have the ends ``bounds (q, 2)`` and the values ``corners (N, q)`` at the vertices, and the
        weights are products of ``(a - low) / (high - low)`` and one minus it.
        ``.c``: a source file and the header beside it, with functions ``<stem>_reset`` and ``<stem>_step`` (of a
        guaranteed test a dot product over its window, with its threshold and its alarm); the only
        one besides ``.fmu`` for an observer of a nonlinear DAE, which holds the implicit step with its homotopy.
        ``.fmu``: a functional mock-up unit for co-simulation with that C inside, and a binary for this machine where
        a compiler is: inputs by the names of the signals, outputs ``xhat[...]``, ``fhat[...]``, ``r[...]`` and
        ``alarm[...]``, parameters ``operating_point[...]``, ``threshold[...]`` and ``warm_up``, with units.
        ``.json``: a proof file in whole numbers, which a program of one file checks without obsynth.
    sample_time : float, optional, seconds
        Samples a continuous-time observer by a first-order hold, one over a region by the steps of implicit Euler that
        it takes on logs; needed for C and an FMU.
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
        ``<stem>_thresholds_step``, for constants that stay the same; for ``.c`` only.  Of a design over a region in
        discrete time its guaranteed threshold (``"pointwise"``), for ``.c`` and ``.fmu``.
    precision : {"double", "float"}, optional
        Of the numbers in C; the header of floats bounds what these change for linear observers, and says what was
        measured for nonlinear ones (which takes a C compiler).
    outliers : {"gate", "huber", "none"}, optional
        Of a nonlinear design: what is done with outliers, in place of what the design states, as for `run_on_data`.
        Where neither states it, they are left out; ``"none"`` uses every sample.
    checker : bool, optional
        Whether the program that checks a proof file is copied beside it (``check_proof.py``); for ``.json``.
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

    Examples
    --------
    >>> import obsynth
    >>> from tempfile import TemporaryDirectory
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> with TemporaryDirectory() as folder:
    ...     print([path.name for path in obsynth.export(design, f"{folder}/filter.c")])
    ['filter.c', 'filter.h']
    """
    target = _checked_target(path)
    suffix = target.suffix.lower()
    require_verified(design, unverified=unverified)
    options = _Options(sample_time, fmi, thresholds, warm_up, monitor, precision, outliers)
    if checker and suffix != ".json":
        raise SpecError("checker is for proof files (.json): others need none.", path="checker")
    if suffix == ".json":
        options.require_fitting(suffix)
        as_designed = sample_time is None and outliers is None and not unverified
        return _write_proof(design, target, checker=checker, as_designed=as_designed)
    _require_writable(design, suffix, outliers)
    options.require_fitting(suffix)
    if isinstance(design.observer, ScheduledObserver):
        return _write_scheduled(design, target, options)
    written: ExportedMonitor | None = None if monitor is None else registered("monitor_in_c")(monitor, design)
    if suffix == ".fmu":
        if monitor is not None and written is None:
            raise SpecError(
                "An FMU holds learned monitors and levels of outputs, not this monitor: write it as C (.c).",
                path="monitor",
            )
        return _write_fmu(design, target, options, written)
    if isinstance(design.observer, DAEObserver):
        if monitor is not None and written is None:
            raise SpecError("Of nonlinear designs, learned monitors are written as C.", path="monitor")
        alarms = dae_alarms(design, thresholds, warm_up, written)
        return write_dae_c(design, target, sample_time, alarms, options.numbers, outliers)
    return _write_linear(design, target, options, written)


@dataclass(frozen=True)
class _Options:
    """What `export` was asked for besides the design and the file."""

    sample_time: float | None  # s
    fmi: str | None
    thresholds: Mapping[str, float] | None
    warm_up: float | None  # s
    monitor: Monitor | None
    precision: Literal["double", "float"] | None
    outliers: Outliers | None

    @property
    def numbers(self) -> str:
        """The type of the numbers in C."""
        return self.precision or "double"

    def require_fitting(self, suffix: str) -> None:
        """Raise `SpecError` for what a file of this suffix does not take."""
        if self.precision is not None and suffix != ".c":
            raise SpecError("precision is for C (.c): other files hold doubles.", path="precision")
        if self.monitor is not None and suffix not in (".c", ".fmu"):
            raise SpecError("A monitor is written as C (.c) or in an FMU (.fmu).", path="monitor")
        if self.fmi is not None and suffix != ".fmu":
            raise SpecError("fmi is the version of an FMU (.fmu): other files have none.", path="fmi")
        if suffix not in (".c", ".fmu") and (self.thresholds or self.warm_up is not None):
            raise SpecError(
                "Thresholds and warm-up are for C (.c) and an FMU (.fmu): other files hold no alarms.",
                path="thresholds",
            )

    def require_own_threshold(self) -> None:
        """Raise `SpecError` where a guaranteed test is given another threshold than its own."""
        if self.monitor is not None or self.thresholds or self.warm_up is not None or self.numbers != "double":
            raise SpecError(
                "A guaranteed test has its own threshold, in doubles: leave monitor, thresholds, warm-up and precision "
                "out.",
                path="monitor",
            )


def _checked_target(path: str | Path) -> Path:
    """Return the file to write, whose suffix is known and whose header hides none of C's own."""
    target = Path(path)
    suffix = target.suffix.lower()
    if suffix not in EXPORT_SUFFIXES:
        raise suffix_error(target, EXPORT_SUFFIXES)
    if suffix == ".c" and _C_HEADERS.fullmatch(target.stem):
        raise SpecError(
            f"{target} comes with a header {target.stem}.h, which a compiler may read in place of C's own: name it "
            "otherwise, such as observer.c.",
            path=str(target),
        )
    return target


def _write_proof(design: ObserverDesign, target: Path, *, checker: bool, as_designed: bool) -> tuple[Path, ...]:
    """Write the proof file of a design, and the program that checks it where it is asked for."""
    if not as_designed:
        raise SpecError(
            "A proof is of the design as it is, and of one that holds: leave sample_time, outliers and unverified out.",
            path="sample_time",
        )
    proof = write_proof(design, target)
    return (proof, copy_checker(proof.parent)) if checker else (proof,)


def _write_linear(
    design: ObserverDesign, target: Path, options: _Options, written: ExportedMonitor | None
) -> tuple[Path, ...]:
    """Write a linear or recursive observer, or a guaranteed test, as C or as matrices."""
    suffix = target.suffix.lower()
    realisation = Realisation.of(design, options.sample_time, options.numbers)
    if suffix != ".c":
        return (write_atomically(target, _array_file(realisation.as_arrays(), design, suffix)),)
    if is_window(design):
        options.require_own_threshold()
        return _write_window(realisation, target, options.numbers)
    if realisation.observer.dt == 0.0:
        raise SpecError(
            "The observer is continuous in time: give the sample time (sample_time, --sample-time), in seconds, for C.",
            path="sample_time",
        )
    bounds = (
        None
        if options.monitor is None or written is not None
        else registered("bound_of_monitor")(options.monitor, realisation.observer)
    )
    alarms = linear_alarms(realisation, options.thresholds, options.warm_up, written)
    return _write_c(realisation, target, alarms, bounds)


def _write_scheduled(design: ObserverDesign, target: Path, options: _Options) -> tuple[Path, ...]:
    """Write a scheduled observer as C or an FMU, or its matrices at the vertices."""
    suffix = target.suffix.lower()
    if suffix not in (".c", ".fmu"):
        if options.sample_time is not None:
            raise SpecError(
                "The matrices at the vertices are those of the design: leave sample_time out.", path="sample_time"
            )
        return (write_atomically(target, _array_file(scheduled_arrays(design), design, suffix)),)
    if options.numbers != "double":
        raise SpecError("A design over a region is written in doubles: leave precision out.", path="precision")
    seconds = seconds_between_rows(design.scheduled[1], options.sample_time)
    written = None if options.monitor is None else registered("monitor_in_c")(options.monitor, design, seconds)
    if suffix == ".fmu":
        return _write_fmu(design, target, options, written)
    alarms = scheduled_alarms(design.scheduled[1], options.thresholds, options.warm_up, written)
    prefix, header = c_identifier(target.stem), target.with_suffix(".h")
    texts = scheduled_c_texts(design, prefix, header.name, alarms, seconds)
    source, declared = (in_precision(text, options.numbers) for text in texts)
    return write_together({target: source, header: with_c_linkage(declared, prefix)})


def _write_fmu(
    design: ObserverDesign, target: Path, options: _Options, written: ExportedMonitor | None
) -> tuple[Path, ...]:
    """Write an observer with its monitor as an FMU."""
    from obsynth.exporting.fmu.archive import write_fmu

    made = write_fmu(
        design,
        target,
        version=options.fmi or "2.0",
        sample_time=options.sample_time,
        thresholds=options.thresholds,
        warm_up=options.warm_up,
        monitor=written,
        outliers=options.outliers,
    )
    return (made,)


def _write_window(realisation: Realisation, target: Path, numbers: str) -> tuple[Path, ...]:
    """Write a guaranteed test as C."""
    prefix, header = c_identifier(target.stem), target.with_suffix(".h")
    source, declared = (in_precision(text, numbers) for text in window_c_texts(realisation, prefix, header.name))
    return write_together({target: source, header: with_c_linkage(declared, prefix)})


def _require_writable(design: ObserverDesign, suffix: str, outliers: Outliers | None) -> None:
    """Raise `SpecError` where no file of this kind can hold a design, or what is done with its outliers."""
    require_fixed(design, suffix)
    if isinstance(design.observer, RecursiveObserver):
        require_plain(design.observer, "An export")
    if outliers is not None and not isinstance(design.observer, DAEObserver):
        raise SpecError("outliers is for nonlinear designs: exports of others use every sample.", path="outliers")
    if isinstance(design.observer, RegionObserver):
        raise SpecError(
            f"Design {design.name!r} is for a region of a nonlinear plant, whose steps are not written as files yet: "
            "it runs in Python (design.observer) and on logs (obsynth.run_on_data).",
            path="path",
        )


def _array_file(arrays: Mapping[str, Any], design: ObserverDesign, suffix: str) -> bytes:
    """Return the contents of a file of arrays for numpy or MATLAB."""
    buffer = io.BytesIO()
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


def _write_c(
    realisation: Realisation,
    target: Path,
    alarms: Alarms,
    bounds: tuple[AdaptiveBound, AdaptiveBound] | None = None,
) -> tuple[Path, ...]:
    prefix = c_identifier(target.stem)
    header = target.with_suffix(".h")
    source, declared = source_text(realisation, prefix, header.name, alarms), header_text(realisation, prefix, alarms)
    if realisation.precision != "double":
        declared = f"{comment(quoted(float_error(realisation)))}\n{declared}"
    source, declared = in_precision(source, realisation.precision), in_precision(declared, realisation.precision)
    if bounds is not None:
        if realisation.precision != "double":
            raise SpecError("Thresholds over tolerances are guaranteed in double precision only.", path="precision")
        begin, end = declared.rsplit("#endif", 1)
        declared = begin + threshold_header(bounds[0], prefix) + "#endif" + end
        source += threshold_source(*bounds, prefix)
    return write_together({target: source, header: with_c_linkage(declared, prefix)})
