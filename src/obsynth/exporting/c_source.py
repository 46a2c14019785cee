"""What every export holds: one discrete- or continuous-time realisation, its names, and the digest of the gain set.

Alarms of an exported observer: levels of its outputs, and a monitor that was learned from rows without faults.

A sampled observer as C99: one header, one source, no allocation, no library; thresholds over tolerances beside it.

Observers of nonlinear DAEs are templates filled with sizes and tables: CasADi writes the equations, and the loop of
Newton around them, its damping and its homotopy are those of `obsynth.observers.dae.observer`. What the header of one
in single precision says of its error is measured, as steps are solved and no bound follows from the design alone: the C
runs beside the observer in double precision over records that are simulated from the design, with missing samples.
"""

from __future__ import annotations

import ctypes
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from obsynth.data.log_observers import GAP_LEFT_SHARE, LEAST_SHOWN, SETTLING_SLACK, LinearLogObserver
from obsynth.errors import ObsynthError, SpecError
from obsynth.experiments.monitors.learned import LearnedThresholds, as_learned, watched_names
from obsynth.experiments.monitors.learned_levels import (
    AGES,
    DISTINGUISHED,
    FORGETTING,
    HOLD,
    LEAST_ADDED,
    MODEL_SHARE,
    parameter_walk,
)
from obsynth.files.outputs import working_folder, write_together
from obsynth.numerics.arguments import SMALLEST, FloatArray, real_number, require_mapping
from obsynth.numerics.continuous import first_order_hold
from obsynth.observers.dae.observer import (
    FLAGS,
    DAEObserver,
    compiler,
    in_lines,
    observer_code,
    observer_struct,
    shared_library,
)
from obsynth.observers.linear.observer import LinearObserver, checked_warm_up, sample_observer, transient
from obsynth.observers.recursive.gain_schedule import steady_observer
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.running import Estimates, as_run
from obsynth.plants.dae import DAEModel
from obsynth.plants.descriptor import DescriptorSystem, TimeVaryingDescriptorSystem
from obsynth.results.design import ObserverDesign, gain_set_digest, unverified_mark
from obsynth.simulation.dae import simulate_dae
from obsynth.verification.adaptive_bound import THRESHOLD_ROUNDING, AdaptiveBound

#: What a file says about the steady state of a recursion.
STEADY = (
    "The steady state of a recursive design: its estimates are those of the recursion once the covariances have "
    "settled, and where a sample is missing the model alone is used."
)


class GapTables(NamedTuple):
    """What stands in for the sensors where a sample is missing: the model of the plant, as runs have it."""

    faults: int  # of the plant
    told: tuple[int, ...]  # which of them the observer estimates
    kept_inputs: int = 1
    states: int = 0
    seen: int = 0
    exists: bool = False
    solved: bool = False
    tables: Mapping[str, FloatArray] = MappingProxyType({})
    left_share: float = 0.0
    least_shown: int = 0


@dataclass(frozen=True, eq=False)
class Realisation:
    """The observer of a design, sampled if that was asked for, or the steady state of its recursion; from ``z(0)``."""

    design: ObserverDesign
    observer: LinearObserver
    digest: str
    start: FloatArray
    note: str = ""
    precision: str = "double"

    @classmethod
    def of(cls, design: ObserverDesign, sample_time: float | None, precision: str = "double") -> Realisation:
        """Return the realisation of a design."""
        digest = gain_set_digest(design)
        if isinstance(design.observer, RecursiveObserver):
            if design.observer.outliers != "none":
                raise SpecError(
                    f"Design {design.name!r} uses the option 'outliers', which exported code does not know: design it "
                    "without, or run it with obsynth run.",
                    path="outliers",
                )
            found = steady_observer(design.observer)
            if sample_time is not None:
                raise SpecError("A recursive design is sampled already: leave the sample time out.", path="sample_time")
            return cls(design, found.observer, digest, found.start, STEADY, precision)
        if isinstance(design.observer, DAEObserver):
            raise SpecError(
                f"Design {design.name!r} is for a nonlinear plant: it has no constant gains to write. Run it with "
                "obsynth run, or with observer.step.",
                path="observer",
            )
        _, observer = design.linear
        if sample_time is not None:
            if observer.dt > 0.0:
                raise SpecError(
                    f"The design is sampled already (dt = {observer.dt:g} s): leave the sample time out.",
                    path="sample_time",
                )
            observer = sample_observer(observer, sample_time)
        return cls(design, observer, digest, np.zeros(observer.order), precision=precision)

    @property
    def straight(self) -> bool:
        """Whether signals are taken as straight lines between samples, as the design is continuous in time."""
        return isinstance(self.design.observer, LinearObserver) and self.design.observer.dt == 0.0 < self.observer.dt

    @property
    def running(self) -> LinearObserver:
        """The observer whose rows are said: a continuous one as it is, whose state a run starts at zero."""
        return self.design.linear[1] if self.straight else self.observer

    @cached_property
    def transition(self) -> dict[str, FloatArray]:
        """What makes z of a sample from that of the one before: of inputs and outputs there, or of these before and
        their rise, where lines between them are straight."""
        if not self.straight:
            return {"z": self.observer.Az, "u": self.observer.Bu, "y": self.observer.By}
        driven = np.hstack([self.running.Bu, self.running.By])
        return dict(
            zip(("z", "before", "rise"), first_order_hold(self.running.Az, driven, self.observer.dt), strict=True)
        )

    @cached_property
    def gap(self) -> GapTables:
        """The model that goes on where a sample is missing; without one the observer starts again."""
        observer, plant = self.observer, _constant_plant(self.design.plant)
        nothing = GapTables(len(observer.fault_names), tuple(range(len(observer.fault_names))))
        signals = observer.input_names, observer.output_names
        if plant is None or (plant.input_names, plant.output_names) != signals:
            return nothing
        if not set(observer.fault_names) <= set(plant.fault_names):
            return nothing
        running = LinearLogObserver(self.design.replace(plant=plant, observer=self.running))
        model = running.gap_model
        told = tuple(running.told_faults)
        if model is None:
            return GapTables(plant.nf, told)
        moving = model.plant
        if self.straight:
            held = first_order_hold(moving.A, np.hstack([moving.B, moving.Bf]), observer.dt)
            moves: tuple[FloatArray, ...] = (
                held[0],
                held[1][:, : moving.nu],
                held[1][:, moving.nu :],
                held[2][:, : moving.nu],
            )
        else:
            moves = (moving.A, moving.B, moving.Bf)
        tables = dict(zip(("model_A", "model_B", "model_F", "model_R"), moves, strict=False))
        tables |= {"model_C": moving.C, "model_D": moving.D, "model_Df": moving.Df, "model_into": model.into}
        tables |= {"noise_variances": running.noise[None]}
        if running.solver is not None:
            tables |= {"source_D": plant.D, "source_Df": plant.Df, "model_solver": running.solver}
        kept = running.kept_inputs
        return GapTables(
            plant.nf, told, kept, moving.nx, len(running.seen), True, running.solver is not None, tables,
            GAP_LEFT_SHARE, LEAST_SHOWN,
        )  # fmt: skip

    @property
    def mark(self) -> str:
        """What every file says of a design that fails its verification; empty where it holds."""
        return unverified_mark(self.design.report)

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs: known inputs, then outputs of the plant."""
        return self.observer.input_names + self.observer.output_names

    @property
    def operating_point(self) -> tuple[FloatArray, FloatArray]:
        """The operating point of inputs and of outputs: inputs are deviations from it, outputs as well."""
        plant = self.design.plant
        point = {} if isinstance(plant, DAEModel) else plant.operating_point
        biases = getattr(plant, "sensor_faults", ())
        after = [point.get(name, 0.0) for name in self.observer.state_names]
        after += [0.0 if name in biases else point.get(name, 0.0) for name in self.observer.fault_names]
        after += [0.0] * len(self.observer.residual_names)
        return np.array([point.get(name, 0.0) for name in self.inputs]), np.array(after)

    def as_arrays(self) -> dict[str, Any]:
        """Return ``A, B, C, D, x0, Ts`` and everything else by name."""
        observer = self.observer
        before, after = self.operating_point
        return {
            "A": observer.Az,
            "B": np.hstack([observer.Bu, observer.By]),
            "C": observer.Cz,
            "D": np.hstack([observer.Du, observer.Dy]),
            "x0": self.start.reshape(-1, 1),
            "Ts": observer.dt,
            "input_point": before,
            "output_point": after,
            "delays": np.array([*observer.state_delays, *observer.fault_delays], dtype=np.float64),
            "input_names": list(self.inputs),
            "output_names": list(observer.row_names),
            "name": self.design.name,
            "method": self.design.method,
            "sha256": self.digest,
            **({"unverified": self.mark} if self.mark else {}),
        }


def verification_words(design: ObserverDesign) -> str:
    """Return the status of a design's verification, in a sentence."""
    mark = unverified_mark(design.report)
    return mark or f"Verified: all {len(design.report.checks)} checks of obsynth hold."


def _constant_plant(plant: Any) -> DescriptorSystem | None:
    """Return the plant of a linear observer; that of a recursion, if it is one that changes with nothing."""
    if isinstance(plant, DescriptorSystem):
        return plant
    if not isinstance(plant, TimeVaryingDescriptorSystem) or not plant.is_time_invariant:
        return None
    parts = {name: sequence.at(1) for name, sequence in plant.matrices.items()}
    names = ("state_names", "input_names", "output_names", "operating_point", "units")
    try:
        return DescriptorSystem(
            parts["E"], parts["A"], B=parts["B"], C=parts["C"], Bf=parts["Phi"], Df=parts["Psi"], dt=plant.dt,
            fault_names=plant.parameter_names, **{name: getattr(plant, name) for name in names},
        )  # fmt: skip
    except SpecError:
        # More or fewer equations than states.
        return None


#: What the largest statistic of a learned monitor is called, in units of its level.
STATISTIC = "statistic"
#: Seconds, about thirty years.
_NEVER = 1e9


@dataclass(frozen=True, eq=False)
class Alarms:
    """What raises an alarm: ``levels`` by watched output, 0 for none; ``columns``: all outputs that a learned monitor
    may take, fault estimates first; ``warm_up`` in seconds; ``walk (nf, nf)``: by which faults walk between samples."""

    levels: Mapping[str, float]
    columns: tuple[str, ...]
    fault_names: tuple[str, ...]
    warm_up: float
    learned: LearnedThresholds | None = None
    walk: FloatArray | None = None

    @classmethod
    def of(
        cls,
        columns: Sequence[str],
        fault_names: Sequence[str],
        thresholds: Mapping[str, float] | None,
        warm_up: float,
        learned: LearnedThresholds | None,
        more: Sequence[str] = (),
    ) -> Alarms:
        """Return alarms; ``more``: what may be watched besides the columns.  Raise `SpecError` for another name."""
        require_mapping(thresholds, "thresholds")
        watched = [*columns, *more]
        for name, level in (thresholds or {}).items():
            if name not in watched:
                raise SpecError(
                    f"There is no output {name!r} to monitor: there are {', '.join(watched)}.", path="thresholds"
                )
            real_number(level, f"The threshold of {name!r}", "a positive number", above=0.0, path="thresholds")
        levels = {name: float((thresholds or {}).get(name, 0.0)) for name in watched}
        if learned is not None:
            levels[STATISTIC] = 1.0
        return cls(levels, tuple(columns), tuple(fault_names), warm_up, learned)


def linear_alarms(
    found: Realisation,
    thresholds: Mapping[str, float] | None,
    warm_up: float | None,
    learned: LearnedThresholds | None,
) -> Alarms:
    """Return the alarms of a linear observer."""
    observer = found.observer
    columns = (*observer.row_names[observer.fault_rows], *observer.row_names[observer.residual_rows])
    # That of the design itself, as runs have it: sampling changes no mode.
    seconds = checked_warm_up(warm_up, transient(found.running))
    # A file may hold finite numbers alone: an observer that never settles raises no alarm.
    seconds = seconds if math.isfinite(seconds) else _NEVER
    return Alarms.of(columns, observer.fault_names, thresholds, seconds, learned)


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


def status_lines(prefix: str) -> list[str]:
    """Return the declaration of what a row is."""
    upper = prefix.upper()
    listed = ", ".join(f"{upper}_{name}" for name in ROW_STATUSES)
    return [
        comment("What a row is: alarms are raised in rows that are OK or PARTIAL, and where levels are passed by more"),
        comment("than a gap can have left in rows that are RECOVERING."),
        f"enum {{ {listed} }};",
    ]


def header_text(found: Realisation, prefix: str, alarms: Alarms) -> str:
    """Return the header."""
    observer, upper = found.observer, prefix.upper()
    before, after = found.operating_point
    units: Mapping[str, str] = found.design.plant.units
    lines = [
        comment(f"Observer {quoted(found.design.name)} by {quoted(found.design.method)}, written by obsynth."),
        *([comment(found.note)] if found.note else []),
        comment(quoted(verification_words(found.design))),
        *(comment(line) for line in alarm_comments(alarms)),
        f"#ifndef {upper}_H",
        f"#define {upper}_H",
        "",
        comment("sha256 of the gain set"),
        f'#define {upper}_SHA256 "{found.digest}"',
        comment("seconds between samples"),
        f"#define {upper}_DT {observer.dt!r}",
        comment("outputs that may be watched"),
        f"#define {upper}_WATCHED {len(alarms.levels)}",
        "",
        *status_lines(prefix),
        "",
        *_state_struct(found, prefix, alarms),
        "",
        comment("Start where the design does." if found.start.any() else "Start at rest."),
        f"void {prefix}_reset({prefix}_state *state);",
        "",
        comment("Take one sample of each signal, write the estimates at that sample, and advance."),
        comment("Signals are deviations from the operating point; a missing one is NaN. Returns 0; or 1 if a sample"),
        comment("is missing: the model of the plant replaces it, fault estimates are held, and residuals are NaN."),
        *_signal_comments("u", "", found.inputs[: len(observer.input_names)], before, units),
        *_signal_comments("y", "", observer.output_names, before[len(observer.input_names) :], units),
        *_signal_comments("states", "xhat", observer.state_names, after, units, observer.state_delays),
        *_signal_comments(
            "faults", "fhat", observer.fault_names, after[len(observer.state_names) :], units, observer.fault_delays
        ),
        *_signal_comments("residuals", "r", observer.residual_names, None, units),
        f"{_step_signature(found, prefix)};",
        "",
        comment("The same with signals and estimates as they are, not as deviations."),
        f"{_step_signature(found, prefix, 'take')};",
        "",
        "#endif",
    ]
    return "\n".join(lines) + "\n"


def alarm_comments(alarms: Alarms) -> list[str]:
    """Return what C says of alarms."""
    found = [f"alarm[{i}]: {quoted(name)}" for i, name in enumerate(alarms.levels)]
    if alarms.learned is not None:
        found += [f"Monitor: {quoted(alarms.learned.statement)}"]
        found += [f"monitor.fault {i}: {quoted(name)}" for i, name in enumerate(alarms.fault_names)]
    return found


def monitor_struct(alarms: Alarms, prefix: str) -> list[str]:
    """Return the declaration of the learned monitor, if there is one."""
    if alarms.learned is None:
        return []
    model = alarms.learned.statistics.model
    m, width = model.channels, max(len(alarms.learned.statistics.estimates), 1)
    return [
        "typedef struct {",
        "    /* Read these after a step: the largest statistic in units of its level (NaN where nothing is",
        "     * decided), whether it passes 1, which fault it points to (-1: none, or not distinguished yet), and an",
        "     * alarm that lasts. */",
        "    REAL statistic;",
        "    int alarm, fault, event;",
        "    /* Everything else is the monitor's own. */",
        f"    REAL past[{max(model.order * m, 1)}];",
        f"    REAL white[{max(AGES) * m}];",
        f"    REAL means[{len(FORGETTING) * m}];",
        f"    REAL before[{(1 + width) * width}];",
        f"    REAL scores[{max(AGES) * 2 * width}];",
        "    int at, quiet, to_wait;",
        "    long taken;",
        f"}} {prefix}_monitor;",
        "",
    ]


def monitor_source(alarms: Alarms, prefix: str) -> str:
    """Return the tables and functions of the learned monitor, if there is one."""
    if alarms.learned is None:
        return ""
    found, model = alarms.learned, alarms.learned.statistics.model
    shapes, slopes = found.statistics.responses()
    order, shares, faults_watched = model.order, np.array(FORGETTING), len(found.statistics.estimates)
    straight = shapes[:, -1:] + (np.arange(order + 1) - order)[:, None] * slopes[:, None, :]
    rows = np.concatenate([shapes, shapes[:, -1:] + np.arange(1, max(AGES))[:, None] * slopes[:, None, :]], axis=1)
    powers = np.cumsum(np.sum(rows**2, axis=2), axis=1)[:, np.array(AGES) - 1]
    sizes = {
        "CHANNELS": model.channels,
        "ORDER": order,
        "OLDEST": max(AGES),
        "AGES": len(AGES),
        "MEANS": len(shares),
        "SHAPES": len(shapes),
        "MONITOR_FAULTS": len(found.scales),
        "MONITOR_ESTIMATES": faults_watched,
        "MONITOR_WIDTH": max(faults_watched, 1),
        "MONITOR_SETTLING": found.settling,
        "MONITOR_HOLD": HOLD,
        "MONITOR_WATCHED": sum(name.startswith(("fhat[", "r[")) for name in alarms.columns),
    }
    tables: dict[str, Any] = {
        "monitor_mean": model.mean[None],
        "monitor_offset": model.offset[None],
        "monitor_A": model.A.reshape(-1, model.channels),
        "monitor_whitener": model.whitener,
        "monitor_precision": model.whitener.T @ model.whitener,
        "monitor_shares": shares[None],
        "monitor_sizes": ((2.0 - shares) / shares)[None],
        "monitor_levels": found.levels[None],
        "monitor_flat": straight[:, 0],
        "monitor_slopes": slopes,
        "monitor_early": (shapes - straight).reshape(-1, model.channels),
        "monitor_weights": 1.0 / (np.maximum(powers, SMALLEST) * found.statistics.levels_by_age),
        "monitor_centres": found.centres[None],
        "monitor_scales": found.scales[None],
        "monitor_walk": np.zeros((0, 0)) if alarms.walk is None else alarms.walk,
        "monitor_innovation": np.array([[found.innovation]]),
    }
    faults = {f"fhat[{name}]": i for i, name in enumerate(alarms.fault_names)}
    faults |= {f"fault {name}": i for i, name in enumerate(alarms.fault_names)}
    listed = ", ".join(f"{name} = {value}" for name, value in sizes.items())
    lines = [
        f"enum {{ {listed} }};",
        f"#define MONITOR_LEAST ((REAL){LEAST_ADDED!r})",
        f"#define MONITOR_APART ((REAL){DISTINGUISHED!r})",
        f"#define MONITOR_SHARE ((REAL){MODEL_SHARE!r})",
        *(line for name, table in tables.items() for line in table_lines(name, filled_table(table))),
        *integer_table("monitor_ages", AGES),
        *integer_table("monitor_places", [alarms.columns.index(name) for name in found.columns]),
        *integer_table("monitor_seldom", [int(name in found.seldom) for name in alarms.columns]),
        *integer_table("monitor_told", [faults.get(name, -1) for name in found.statistics.told]),
    ]
    return "\n".join(lines) + filled_template("learned.c", prefix, {})


def _state_struct(found: Realisation, prefix: str, alarms: Alarms) -> list[str]:
    """Return what the observer remembers, as C declares it."""
    observer, gap = found.observer, found.gap
    nz, nu, ny = observer.order, len(observer.input_names), len(observer.output_names)
    shown = len(observer.fault_names) + len(observer.residual_names)
    sizes = {
        "z": nz,
        "v": nu + ny,
        "measured": nu + ny,
        "inputs": gap.kept_inputs * nu,
        "fault": gap.faults,
        "shown": shown,
        "seen": gap.seen,
        "model": gap.states,
        "left": nz * (nu + ny),
        "held": nu,
        "moves": 4 * nu,
        "reach": nu,
        "changes": shown,
        "excess": nz * (nu + ny),
        "carried": shown,
        "grown": shown,
    }
    watched = max(len(alarms.levels), 1)
    return [
        *monitor_struct(alarms, prefix),
        "typedef struct {",
        comment("Read these after a step: what the row was, and which outputs passed their levels."),
        "    int status;",
        f"    int alarm[{watched}];",
        "    int any_alarm;",
        comment("Set these after the reset: levels (0 for none), and seconds without alarms after the start."),
        f"    REAL level[{watched}];",
        "    double warm_up;",
        *(f"    {prefix}_monitor monitor;" for _ in ("monitor",) if alarms.learned is not None),
        comment("Everything else is the observer's own."),
        *(f"    REAL {name}[{max(size, 1)}];" for name, size in sizes.items()),
        "    double time, from, waiting;",
        "    long k, counted;",
        "    int kept, is_started, is_gap, phase;",
        f"}} {prefix}_state;",
    ]


def source_text(found: Realisation, prefix: str, header: str, alarms: Alarms) -> str:
    """Return the source."""
    observer, gap = found.observer, found.gap
    groups = {"states": observer.state_rows, "faults": observer.fault_rows, "residuals": observer.residual_rows}
    said: dict[str, dict[str, FloatArray]] = {
        target: {"z": found.running.Cz[rows], "u": found.running.Du[rows], "y": found.running.Dy[rows]}
        for target, rows in groups.items()
        if rows.stop > rows.start
    }
    moved: dict[str, dict[str, FloatArray]] = {"next": found.transition}
    large = any(_form(matrix) != PLAIN for parts in (*said.values(), *moved.values()) for matrix in parts.values())
    tables = [
        line
        for target, parts in {**said, **moved}.items()
        for signal, matrix in parts.items()
        if matrix.size
        for line in _tables(f"{target}_{signal}", matrix)
    ]
    before, after = found.operating_point
    constants = {
        "start": found.start.reshape(1, -1),
        "point_before": before.reshape(1, -1),
        **({"point_after": after.reshape(1, -1)} if len(observer.state_names) + len(observer.fault_names) else {}),
        "levels": np.array([list(alarms.levels.values())]),
        **gap.tables,
    }
    return (
        "\n".join(
            [
                comment(f"sha256 of the gain set: {found.digest}"),
                comment(quoted(verification_words(found.design))),
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
                f"#define STRAIGHT {int(found.straight)}",
                f"#define WARM_UP_SECONDS {alarms.warm_up!r}",
                f"#define SETTLING_SLACK {SETTLING_SLACK!r}",
                f"#define LEFT_SHARE ((REAL){gap.left_share!r})",
                "enum {",
                *(f"    {name} = {value}," for name, value in _sizes(found).items()),
                "};",
                "",
                *([comment(ADVICE), ""] if large else []),
                *tables,
                *(line for name, table in constants.items() for line in table_lines(name, filled_table(table))),
                *integer_table("told", gap.told),
                *integer_table("watched", range(len(alarms.levels))),
                "",
                template("products.c"),
                *_products("say", ("z", "u", "y"), said, tuple(groups)),
                *_products("next_of", tuple(found.transition), moved, ("next",)),
                monitor_source(alarms, prefix),
                _step_text(found, prefix, alarms),
            ]
        )
        + "\n"
    )


def _sizes(found: Realisation) -> dict[str, int]:
    """Return the sizes that the C text has as names."""
    observer, gap = found.observer, found.gap
    nu, ny = len(observer.input_names), len(observer.output_names)
    shown = len(observer.fault_names) + len(observer.residual_names)
    return {
        "Z_COUNT": observer.order,
        "U_COUNT": nu,
        "Y_COUNT": ny,
        "V_COUNT": nu + ny,
        "STATE_COUNT": len(observer.state_names),
        "FAULT_COUNT": len(observer.fault_names),
        "SHOWN_COUNT": shown,
        "WATCHED_COUNT": shown + 1,
        "MODEL_STATES": gap.states,
        "SEEN_COUNT": gap.seen,
        "PLANT_FAULTS": gap.faults,
        "KEPT_INPUTS": gap.kept_inputs,
        "LEAST_SHOWN": gap.least_shown,
    }


def _products(
    name: str, given: Sequence[str], blocks: dict[str, dict[str, FloatArray]], targets: Sequence[str]
) -> list[str]:
    """Return a function that writes products of vectors into its targets, by the macros of ``products.c``."""
    arguments = [f"const REAL *{signal}" for signal in given] + [f"REAL *{target}" for target in targets]
    body = ["int i;", "int j;", *(f"(void){word};" for word in ("i", "j", *given, *targets))]
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


def _step_text(found: Realisation, prefix: str, alarms: Alarms) -> str:
    """Return everything that follows the tables: start, step, and the step of signals as they are."""
    observer = found.observer
    nu, ny = len(observer.input_names), len(observer.output_names)
    nx, nf, nr = len(observer.state_names), len(observer.fault_names), len(observer.residual_names)
    learned = alarms.learned is not None
    arguments = ", ".join(_step_arguments(found, prefix))
    taken = (("v", "u", nu, 0), ("v + U_COUNT", "y", ny, nu))
    shown = (("faults", "shown", nf), ("residuals", "shown + FAULT_COUNT", nr))
    estimates = (("states", nx, 0), ("faults", nf, nx))
    signals = [("deviation", nu), ("deviation + U_COUNT", ny), ("states", nx), ("faults", nf), ("residuals", nr)]
    return filled_template(
        "linear_step.c",
        prefix,
        {
            "STATES_SCRATCH": "" if nx else "REAL states[1] = {0};",
            "COPY_IN": " ".join(f"copied({to}, {of}, {n});" for to, of, n, _ in taken if n),
            "COPY_OUT": " ".join(f"copied({to}, {of}, {n});" for to, of, n in shown if n),
            "MONITOR_RESET": "monitor_reset(&s->monitor);" if learned else "",
            "MONITOR_STEP": (
                f"monitor_take(&s->monitor, shown, NULL, s->status == {prefix.upper()}_OK, -1);\n"
                "    shown[SHOWN_COUNT] = s->monitor.statistic;"
                if learned
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


def _step_arguments(found: Realisation, prefix: str) -> list[str]:
    observer = found.observer
    inputs = {"u": observer.input_names, "y": observer.output_names}
    outputs = {"states": observer.state_names, "faults": observer.fault_names, "residuals": observer.residual_names}
    return [
        f"{prefix}_state *state",
        *(f"const REAL {name}[{len(names)}]" for name, names in inputs.items() if names),
        *(f"REAL {name}[{len(names)}]" for name, names in outputs.items() if names),
    ]


def _step_signature(found: Realisation, prefix: str, name: str = "step") -> str:
    return f"int {prefix}_{name}({', '.join(_step_arguments(found, prefix))})"


def _signal_comments(
    array: str,
    column: str,
    names: Sequence[str],
    point: FloatArray | None,
    units: Mapping[str, str],
    delays: Sequence[int] = (),
) -> Iterator[str]:
    for i, name in enumerate(names):
        at = f", operating point {float(point[i])!r}" if point is not None and point[i] else ""
        late = f", delayed by {delays[i]} sample(s)" if delays and delays[i] else ""
        unit = f", {quoted(units[name])}" if units.get(name) else ""
        yield comment(f"{array}[{i}]: {quoted(f'{column}[{name}]' if column else name)}{unit}{at}{late}")


def filled_table(table: FloatArray) -> FloatArray:
    """Return a table without an empty side, which C has not."""
    found = np.zeros(tuple(max(size, 1) for size in table.shape))
    found[: table.shape[0], : table.shape[1]] = table
    return found


def integer_table(name: str, values: Sequence[object], kind: str = "int") -> list[str]:
    """Return a constant table of whole numbers, or of texts of another kind of numbers."""
    return [f"static const {kind} {name}[{max(len(values), 1)}] = {{{', '.join(map(str, values)) or '0'}}};"]


def template(name: str) -> str:
    """Return the text of a file of C that is written around tables."""
    return files("obsynth.exporting").joinpath("templates", name).read_text(encoding="utf-8")


def filled_template(name: str, prefix: str, words: Mapping[str, str]) -> str:
    """Return a file of C with its prefix and other words put in, each once; a line that holds an empty one goes."""
    text = template(name)
    for word in (word for word, value in words.items() if not value):
        text = re.sub(rf"^ *{word}\n", "", text, flags=re.MULTILINE)
    known = {**words, "PREFIX": prefix, "UPPER": prefix.upper()}
    return re.sub("|".join(sorted(known, key=len, reverse=True)), lambda found: known[found.group()], text)


#: A number of a table, or of a line that a macro names.
_WRITTEN_NUMBER = re.compile(r"(?<![\w.\"])-?\d+(?:\.\d+(?:e[+-]?\d+)?|e[+-]?\d+)(?![\w.\"])")


def in_precision(text: str, precision: str) -> str:
    """Return C in which numbers of signals are doubles, or floats as near to these as they can be."""
    if precision == "double":
        return re.sub(r"\bREAL\b", "double", text)
    rounded = []
    for line in re.sub(r"\bREAL\b", "float", text).split("\n"):
        plain = line.startswith(("#define", "/*", " *"))
        rounded.append(line if plain else _WRITTEN_NUMBER.sub(_as_float, line))
    return "\n".join(rounded)


def _as_float(found: re.Match[str]) -> str:
    value = np.float32(found.group())
    if not np.isfinite(value):
        raise SpecError(
            f"{found.group()} is beyond the largest number of precision 'float': scale the signals, or export doubles.",
            path="precision",
        )
    return f"{value}f"


def write_dae_c(
    design: ObserverDesign,
    target: Path,
    sample_time: float | None,
    alarms: Alarms,
    precision: str,
    outliers: str | None,
) -> tuple[Path, ...]:
    """Write source and header."""
    if target.suffix.lower() != ".c":
        raise SpecError(
            f"{target}: the observer of a nonlinear plant is no matrices; it is exported as C (.c).", path=str(target)
        )
    require_no_sample_time(design, sample_time)
    prefix, header = c_identifier(target.stem), target.with_suffix(".h")
    source, declarations, _ = dae_c_texts(design, prefix, header.name, alarms, outliers)
    if precision == "float":
        source, declarations = in_floats(source), in_floats(declarations)
        said = float_error(design, prefix, source, declarations)
        declarations = f"{comment(quoted(said))}\n{declarations}"
    return write_together({target: source, header: with_c_linkage(declarations, prefix)})


def require_no_sample_time(design: ObserverDesign, sample_time: float | None) -> None:
    """Raise `SpecError` where a sample time is given for an observer that is sampled."""
    if sample_time is not None:
        dt = design.nonlinear[1].dt
        raise SpecError(
            f"The design is sampled already (dt = {dt:g} s): leave the sample time out.", path="sample_time"
        )


def dae_alarms(
    design: ObserverDesign,
    thresholds: Mapping[str, float] | None,
    warm_up: float | None,
    learned: LearnedThresholds | None,
) -> Alarms:
    """Return the alarms of a nonlinear design."""
    model, observer = design.nonlinear
    columns = (*(f"fhat[{name}]" for name in model.parameter_names), *(f"r[{name}]" for name in model.output_names))
    seconds = checked_warm_up(warm_up, 0.0)
    found = Alarms.of(columns, model.parameter_names, thresholds, seconds, learned, more=("nis",))
    if learned is not None:
        # A run numbers innovations of any kind.
        found = replace(found, columns=watched_names(design), walk=parameter_walk(observer))
    return found


def dae_c_texts(
    design: ObserverDesign, prefix: str, header: str, alarms: Alarms, outliers: str | None = None
) -> tuple[str, str, str]:
    """Return source, header and the digest of the gain set. Outliers are left out where neither the design nor
    ``outliers`` says anything of them, as `run` leaves them out."""
    model, observer = design.nonlinear
    digest = gain_set_digest(design)
    observer = as_run(observer, outliers)
    if alarms.learned is not None:
        observer = as_learned(observer, alarms.learned)
    inner = f"{prefix}_observer" if observer.timing.is_plain else f"{prefix}_observer_memory"
    source = "\n".join(
        [
            comment(f"sha256 of the gain set: {digest}"),
            f'#include "{included(header)}"',
            "",
            f"#define observer {inner}",
            *([f"#define waiting {prefix}_observer"] if inner != f"{prefix}_observer" else []),
            f"#define WARM_UP_SECONDS {alarms.warm_up!r}",
            f"#define SETTLING_SLACK {SETTLING_SLACK!r}",
            "",
            observer_code(observer.steps),
            "#include <stddef.h>",
            "#define ABS fabs",
            *table_lines("levels", np.array([list(alarms.levels.values())])),
            monitor_source(alarms, prefix),
            _dae_step_text(prefix, model, alarms),
        ]
    )
    declared = _dae_header(design, prefix, digest, alarms)
    return in_precision(source, "double"), in_precision(declared, "double"), digest


def _dae_step_text(prefix: str, model: DAEModel, alarms: Alarms) -> str:
    """Return the two functions of the header; without inputs, C has no array for them."""
    learned = alarms.learned is not None
    waiting = (
        f"double shown[{prefix.upper()}_WATCHED];\n"
        f"    for (i = 0; i < {prefix.upper()}_WATCHED; i++) {{\n"
        "        shown[i] = NAN;\n"
        "    }\n"
        "    monitor_take(&s->monitor, shown, NULL, 0, -1);"
    )
    taking = (
        "monitor_take(&s->monitor, shown, MONITOR_ESTIMATES > 0 ? after + AT_SPREAD : NULL, is_deciding,\n"
        "                 sqrt(estimates->nis));\n"
        "    shown[NQ + NY + 1] = s->monitor.statistic;"
    )
    return filled_template(
        "dae_step.c",
        prefix,
        {
            "ARGUMENTS": "const double u[NU], " if model.nu else "",
            "INPUT": "u" if model.nu else "s->u",
            "MONITOR_RESET": "monitor_reset(&s->monitor);" if learned else "",
            "WAITING_STEP": waiting if learned else "",
            "MONITOR_STEP": taking if learned else "",
        },
    )


def _dae_header(design: ObserverDesign, prefix: str, digest: str, alarms: Alarms) -> str:
    """Return the header of the observer of a nonlinear plant."""
    model, observer = design.nonlinear
    signals = (
        ("u", "", model.input_names),
        ("y", "", model.output_names),
        ("states", "xhat", model.state_names),
        ("faults", "fhat", model.parameter_names),
        ("state_deviations", "sd xhat", model.state_names),
        ("fault_deviations", "sd fhat", model.parameter_names),
        ("residuals", "r", model.output_names),
    )
    listed = [
        line for array, column, names in signals for line in _signal_comments(array, column, names, None, model.units)
    ]
    structs = [*observer_struct(observer.steps, f"{prefix}_observer"), *monitor_struct(alarms, prefix)]
    words = {
        "OBSERVER": f"Observer {quoted(design.name)} by {quoted(design.method)}, written by obsynth.",
        "VERIFIED": quoted(verification_words(design)),
        "ALARMS": "\n".join(map(comment, alarm_comments(alarms))),
        "DIGEST": digest,
        "SECONDS": repr(observer.dt),
        "COUNT_OF_LEVELS": str(len(alarms.levels)),
        "SOME_LEVELS": str(max(len(alarms.levels), 1)),
        "STATUSES": "\n".join(status_lines(prefix)),
        "STRUCTS": "\n".join(structs),
        "MONITOR": f"{prefix}_monitor monitor;" if alarms.learned is not None else "",
        "INPUTS": f"const double u[{model.nu}], " if model.nu else "",
        "SIGNALS": "\n".join(listed),
        **{word: str(size) for word, size in (("NX", model.nx), ("NY", model.ny))},
        **{word: str(max(size, 1)) for word, size in (("SOME_NU", model.nu), ("SOME_NQ", model.nq))},
    }
    return filled_template("dae.h", prefix, words)


def threshold_header(bound: AdaptiveBound, prefix: str) -> str:
    """Return the declarations, for the end of the header."""
    p, nz, *_ = bound.counts
    no = bound.counts[4]
    sizes = (max(p * nz, 1), bound.length * bound.width, bound.length * nz, bound.rounding.shape[1])
    lines = [
        comment("Thresholds over the tolerances of the plant: of the faults, then of the residuals."),
        "typedef struct {",
        *(f"    double {name}[{size}];" for name, size in zip(("psi", "ring", "eps", "largest"), sizes, strict=True)),
        "    int at;",
        "    long k;",
        f"}} {prefix}_thresholds;",
        "",
        f"void {prefix}_thresholds_reset({prefix}_thresholds *state);",
        "",
        comment("After each step of the observer: u, y, and its states, faults and residuals one after the other;"),
        comment(f"total gets {no} numbers."),
        f"void {prefix}_thresholds_step({prefix}_thresholds *state, const double *u, const double *y,",
        "                               const double *rows, double *total);",
        "",
    ]
    return "\n".join(lines) + "\n"


def threshold_source(bound: AdaptiveBound, prefix: str) -> str:
    """Return tables and functions, for the end of the source; `SpecError` for constants that vary."""
    if bound.varying:
        raise SpecError(
            "Thresholds are written as C for constants that stay the same (variation: constant).", path="monitor"
        )
    p, nz, rows, m, no = bound.counts
    structure = bound.structure
    n, out = structure.reading.shape
    nv = bound.drive.shape[2]
    ny = bound.rounding.shape[1] - 1 - nv
    theta, later = bound.start_later
    sizes = {
        "P": p,
        "NZ": nz,
        "ROWS": rows,
        "M": m,
        "NO": no,
        "N": n,
        "NU": nv - n,
        "NY": ny,
        "NV": nv,
        "OUT": out,
        "W": bound.width,
        "L": bound.length,
        "NR": bound.rounding.shape[1],
        "SINGLE": structure.single,
        "OWN": len(structure.owner),
        "DRIVEN": len(bound.remainder_inputs),
        "START": len(bound.start),
    }
    tables = {
        "Az": structure.Az,
        "reading": structure.reading,
        "drive": bound.drive.reshape(-1, nv),
        "shown": bound.shown,
        "offsets": structure.offsets[None],
        "channels": structure.channel_rows,
        "kernels": bound.kernels,
        "same": bound.same,
        "solved": bound.solved,
        "tail": bound.tail,
        "nominal": bound.nominal[None],
        "rounding": bound.rounding,
        "start": bound.start,
        "later": later[None],
        "driven": np.array([bound.remainder_inputs], dtype=np.float64),
    }
    enumerated = ", ".join(f"{name} = {value}" for name, value in sizes.items())
    lines = [
        "",
        f"enum {{ {enumerated} }};",
        f"static const double THETA = {theta!r};",
        f"static const double ROUNDED = {THRESHOLD_ROUNDING!r};",
        "",
        *(line for name, table in tables.items() for line in table_lines(f"thresholds_{name}", filled_table(table))),
    ]
    return in_precision("\n".join(lines) + "\n" + filled_template("adaptive_threshold.c", prefix, {}), "double")


#: Newton in floats: a last step whose square is rounding, and a residual of some roundings of its terms.
FLOAT_LAST_STEP, FLOAT_RESIDUAL = 3e-4, 1e-5
#: A projection that moves no state by more than rounding moves none, and bounds that dependent rows miss are kept.
FLOAT_PROJECTION_NOTICE, FLOAT_DEPENDENT, FLOAT_SLACK = 1e-4, 1e-5, 1e-4
#: What a sample adds to the information on faults is a difference of inverses of covariances.
FLOAT_LEAST_ADDED = 1e-5
#: What is larger has no square in a float.
FLOAT_OVERFLOW = 1e18
#: Samples of each record that errors are measured on, their seeds, and the samples without outputs.
RECORD_SAMPLES, SEEDS = 400, (1, 2)
MISSING_SAMPLES = slice(200, 205)
#: Errors beyond this share of an estimate's own deviation: single precision does not carry the observer.
LARGEST_ERROR_SHARE = 0.5
_FLOAT_CONSTANTS = {
    "LAST_STEP": FLOAT_LAST_STEP,
    "LARGEST_RESIDUAL": FLOAT_RESIDUAL,
    "PROJECTION_NOTICE": FLOAT_PROJECTION_NOTICE,
    "DEPENDENT": FLOAT_DEPENDENT,
    "SLACK": FLOAT_SLACK,
    "OVERFLOW_LIMIT": FLOAT_OVERFLOW,
    "MONITOR_LEAST": FLOAT_LEAST_ADDED,
}


def in_floats(text: str) -> str:
    """Return C with floats in place of doubles; seconds stay doubles, as they are counted up."""
    for name, value in _FLOAT_CONSTANTS.items():
        text = re.sub(rf"^#define {name} .*$", f"#define {name} {value!r}f", text, flags=re.MULTILINE)
    lines = [
        line if re.search(r"\b(time|warm_up)\b", line) else re.sub(r"\bdouble\b", "float", line)
        for line in text.split("\n")
    ]
    return in_precision("\n".join(lines), "float")


def float_error(design: ObserverDesign, prefix: str, source: str, declared: str) -> str:
    """Return what the header of an export in floats says of its error; raise `SpecError` where it is too large."""
    model = design.nonlinear[0]
    names = [*(f"xhat[{name}]" for name in model.state_names), *(f"fhat[{name}]" for name in model.parameter_names)]
    worst, shares = np.zeros(len(names)), np.zeros(len(names))
    with working_folder() as folder:
        library = _compiled(folder, prefix, source, declared, model.nu, model.ny, (model.nx, model.nq))
        for seed in SEEDS:
            u, y, expected = _record(design, seed)
            wanted = np.hstack([expected.states, expected.faults])
            deviations = np.hstack([expected.state_deviations, expected.fault_deviations])
            found = _taken(library, u, y, wanted.shape[1])
            error = np.abs(found - wanted)
            worst = np.maximum(worst, error.max(axis=0))
            with np.errstate(divide="ignore", invalid="ignore"):
                share = np.where(error > 0.0, error / deviations, 0.0)[1:]
            shares = np.maximum(shares, share.max(axis=0))
    if not (np.isfinite(worst).all() and (shares <= LARGEST_ERROR_SHARE).all()):
        at = int(np.argmax(np.where(np.isfinite(shares), shares, np.inf)))
        raise SpecError(
            f"Single precision does not carry this observer: {names[at]} is off by {worst[at]:.2g}, "
            f"{shares[at]:.2g} of its own standard deviation. Leave precision at double.",
            path="precision",
        )
    listed = ", ".join(f"{name} {error:.2g}" for name, error in zip(names, worst, strict=True))
    return (
        f"Floats: measured, not proved: the largest error against double precision in {len(SEEDS)} records of "
        f"{RECORD_SAMPLES} samples simulated from the design (5 of them missing): {listed}; at most "
        f"{shares.max(initial=0.0):.2g} of an estimate's own standard deviation"
    )


def _record(design: ObserverDesign, seed: int) -> tuple[FloatArray, FloatArray, Estimates]:
    """Return inputs and outputs, as floats hold them, of the plant with the noise that the observer assumes, and what
    the observer says of them in doubles."""
    model, observer = design.nonlinear
    u = np.tile(model.nominal_input, (RECORD_SAMPLES, 1)).reshape(RECORD_SAMPLES, model.nu)
    try:
        found = simulate_dae(
            model,
            u,
            dt=observer.dt,
            parameters=observer.initial_parameters,
            initial_state=observer.initial_state,
            Q=observer.Q,
            R=observer.R,
            integration=observer.integration,
            seed=seed,
        )
        y = np.array(found.outputs)
        y[MISSING_SAMPLES] = np.nan
        u, y = (given.astype(np.float32).astype(np.float64) for given in (u, y))
        return u, y, observer.run(y, u)
    except ObsynthError as error:
        raise SpecError(
            "The error of single precision is measured on a record that is simulated from the design, which fails: "
            f"{error} Leave precision at double.",
            path="precision",
        ) from error


def _compiled(
    folder: Path, prefix: str, source: str, declared: str, nu: int, ny: int, counts: tuple[int, int]
) -> ctypes.CDLL:
    command = compiler()
    if command is None:
        raise SpecError(
            "The error of a nonlinear observer in floats is measured by running it: this needs a C compiler (cc, gcc "
            "or clang, or what CC in the environment names). Install one, or leave precision at double.",
            path="precision",
        )
    given = f"in, in + {nu}" if nu else "in"
    sizes = {"STATES": str(counts[0]), "FAULTS": str(counts[1]), "TAKEN": str(nu + ny)}
    harness = filled_template("run_floats.c", prefix, {"ARGUMENTS": given, **sizes})
    own = re.sub(r'^#include ".*"$', '#include "observer.h"', source, count=1, flags=re.MULTILINE)
    texts = {"observer.h": declared, "observer.c": own, "run.c": harness}
    return ctypes.CDLL(str(shared_library(folder, texts, [*command, *FLAGS], path="precision")))


def _taken(library: ctypes.CDLL, u: FloatArray, y: FloatArray, width: int) -> FloatArray:
    given = np.ascontiguousarray(np.hstack([u, y]), dtype=np.float32)
    out = np.zeros((len(y), width))
    count = library.run(
        given.ctypes.data_as(ctypes.POINTER(ctypes.c_float)),
        out.ctypes.data_as(ctypes.POINTER(ctypes.c_double)),
        len(y),
    )
    if count < len(y):
        raise SpecError(
            f"Single precision does not carry this observer: its step {count} has no solution there. Leave precision "
            "at double.",
            path="precision",
        )
    return out
