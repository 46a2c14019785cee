"""Records for a comparison: runs of random plants on a scenario, or a log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from obsynth.errors import SpecError, counted
from obsynth.methods.fault_figures import on_the_clock
from obsynth.monitoring.logs.log_tables import log_table
from obsynth.monitoring.logs.measured_columns import constant_texts, never_measured
from obsynth.monitoring.logs.signals import TIME_HEADER, missing_columns
from obsynth.monitoring.logs.stuck_sensors import stuck_rows, stuck_texts
from obsynth.monitoring.logs.unpacked_logs import as_frame
from obsynth.numerics.arguments import require_kind
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.linear_recursions import driven
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.simulation.scenario import Scenario
from obsynth.simulation.signals import resolve
from obsynth.verification.assumptions import LogReference
from obsynth.verification.over_tolerances.plants_of_the_box import plant_at

#: Entries of A, B, Bf, Bd that tolerances do not touch: they are kinematics, not parameters.
EXACT_ENTRIES = (0.0, 1.0, -1.0)

#: A log of one row has no time in which an estimate could follow.
LEAST_ROWS = 2


@dataclass(frozen=True, eq=False)
class Record:
    """What observers are run on, ``(.., steps, ..)``: many runs of drawn plants, or a log."""

    times: FloatArray  # ``(steps,)``, seconds
    u: FloatArray
    y: FloatArray
    truth: FloatArray  # ``(steps, nf)``: the faults, zero where a log has no column of one
    known: tuple[str, ...] = ()  # the faults of which a log has a column
    notes: tuple[str, ...] = ()  # what is to be said of a log


def drawn_runs(
    source: DescriptorSystem,
    sampled: DescriptorSystem,
    scenario: Scenario,
    *,
    runs: int,
    tolerance: float,
    seed: int,
    feedback: FloatArray,
) -> tuple[Record, Record]:
    """Return runs ``(runs, steps, ..)`` with the scenario's faults, and without any; plants are drawn before they are
    sampled, and disturbances by a factor between -1 and 1."""
    drive = resolve(sampled, scenario)
    nu, nf = sampled.nu, sampled.nf
    rng = np.random.default_rng(seed)
    seeds = [int(value) for value in rng.integers(0, 2**31, size=runs)]
    random, noise, sensors = drive.drawn(seeds, sampled.nw)
    scales = rng.uniform(-1.0, 1.0, size=(runs, sampled.nd))
    faults = drive.at_begin[:, nu : nu + nf]
    records: list[tuple[list[FloatArray], list[FloatArray]]] = [([], []), ([], [])]
    off = tolerance > 0.0 or (source.uncertainty is not None and bool(source.uncertainty.box.names))
    for run in range(runs):
        plant = on_the_clock(_drawn(source, tolerance, rng), sampled.dt) if off else sampled
        signals = drive.at_begin + random[:, run]
        d = signals[:, nu + nf :] * scales[run]
        shaken = noise[:, run] if noise.shape[2] == plant.nw else np.zeros((drive.steps, plant.nw))
        for (inputs, outputs), f in zip(records, (signals[:, nu : nu + nf], np.zeros((drive.steps, nf))), strict=True):
            measured, known = _outputs(plant, signals[:, :nu], d, f, shaken, feedback)
            inputs.append(known)
            outputs.append(measured + sensors[:, run])
    times = _clock(drive.steps, drive.dt)
    (u, y), (healthy_u, healthy_y) = ((np.array(inputs), np.array(outputs)) for inputs, outputs in records)
    return Record(times, u, y, faults), Record(times, healthy_u, healthy_y, np.zeros_like(faults))


@dataclass(frozen=True)
class ComparedLog:
    """A log on which designs are compared as well, as `obsynth.run_on_data` takes it."""

    data: Any
    columns: Mapping[str, str] | None = None
    scales: Mapping[str, float] | None = None

    @property
    def reference(self) -> dict[str, Any] | None:
        """How a certificate finds it again; ``None`` of what is no file."""
        if not isinstance(self.data, (str, Path)):
            return None
        return LogReference.of(Path(self.data), self.columns, self.scales).as_dict()

    def record(self, plant: DescriptorSystem, input_delay: int = 0) -> Record:
        """Return it on the clock of a sampled plant."""
        import pandas as pd

        data, columns, scales = self.data, self.columns, self.scales

        if not isinstance(data, (str, Path)):
            data = as_frame(data)
            require_kind(data, pd.DataFrame, "data", "a file name or a pandas.DataFrame")
        measured = (*plant.input_names, *plant.output_names)
        column_of = {name: (columns or {}).get(name, name) for name in (*measured, *plant.fault_names)}
        scaled = {*(scales or {}), *plant.scales}
        units = {column: plant.units[name] for name, column in column_of.items() if name in {*plant.units} - scaled}
        time = (columns or {}).get(TIME_HEADER, TIME_HEADER)
        table, header, remarks = log_table(data, list(column_of.values()), time, units=units)
        frame = {name: table[column] for name, column in column_of.items() if column in table}
        shift = None if plant.uncertainty is None else plant.uncertainty.shift
        if shift and frame:
            # The input of a linearised plant that is one in every row has no column.
            frame[shift] = np.ones(max(map(len, frame.values())))
        missing = [column_of[name] for name in measured if name not in frame]
        if missing:
            raise missing_columns(header, missing, {column_of[name]: name for name in measured})
        count = max(map(len, frame.values()), default=0)
        if count < LEAST_ROWS:
            raise SpecError(
                f"The log has {counted(count, 'row')}: a comparison needs {LEAST_ROWS} and more.", path="data"
            )
        for name in (*plant.input_names, *plant.output_names):
            if not np.isfinite(frame[name]).any():
                raise SpecError(never_measured(column_of[name], name), path="data")

        def signals(names: Sequence[str]) -> FloatArray:
            offsets = np.array([plant.operating_point.get(name, 0.0) for name in names])
            factors = np.array([(scales or {}).get(name, plant.scales.get(name, 1.0)) for name in names])
            values = np.column_stack([frame[name] for name in names]) if names else np.zeros((count, 0))
            return np.asarray(values * factors - offsets)

        known_faults = [name for name in plant.fault_names if name in frame]
        truth = np.zeros((count, plant.nf))
        for name in known_faults:
            truth[:, plant.fault_names.index(name)] = frame[name]
        u, y = signals(plant.input_names), signals(plant.output_names)
        u = u[np.clip(np.arange(count) - input_delay, 0, count - 1)]
        stamps = table.get(time)
        stuck = {name: stuck_rows(values) for name, values in zip(plant.output_names, y.T, strict=True)}
        times = _clock(count, plant.dt) if stamps is None else stamps
        ranges = [(name, float(np.nanmin(frame[name])), float(np.nanmax(frame[name]))) for name in plant.output_names]
        notes = [*remarks, *stuck_texts(stuck), *constant_texts(ranges, count)]
        if stamps is None:
            notes.append(f"The log has no column {time!r}: its rows are taken as {plant.dt:g} s apart.")
        return Record(times, u, y, truth, tuple(known_faults), tuple(notes))


def _outputs(
    plant: DescriptorSystem, u: FloatArray, d: FloatArray, f: FloatArray, w: FloatArray, feedback: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return outputs and known inputs ``(steps, ..)`` of a plant at rest, with ``u - feedback x`` as its input."""
    into = u @ plant.B.T + d @ plant.Bd.T + f @ plant.Bf.T + w @ plant.Bw.T
    direct = u @ plant.D.T + d @ plant.Dd.T + f @ plant.Df.T + w @ plant.Dw.T
    closed, measured = plant.A - plant.B @ feedback, plant.C - plant.D @ feedback
    states = driven(closed, np.zeros(plant.nx), into)
    return np.asarray(states @ measured.T + direct), np.asarray(u - states @ feedback.T)


def _drawn(plant: DescriptorSystem, tolerance: float, rng: np.random.Generator) -> DescriptorSystem:
    """Return a plant with its constants within their tolerances, and parameters off by up to one; equal stay equal."""
    if plant.uncertainty is not None:
        box = plant.uncertainty.box
        plant = plant_at(plant, box.values(rng.uniform(-1.0, 1.0, size=len(box.names))))
        if not tolerance:
            return plant
    factors: dict[float, float] = {}

    def off(matrix: FloatArray) -> FloatArray:
        changed = matrix.copy()
        for index, value in np.ndenumerate(matrix):
            if value not in EXACT_ENTRIES:
                factor = factors.setdefault(abs(float(value)), 1.0 + tolerance * rng.uniform(-1.0, 1.0))
                changed[index] = value * factor
        return changed

    return plant.replace(E=off(plant.E), A=off(plant.A), B=off(plant.B), Bf=off(plant.Bf), Bd=off(plant.Bd))


def _clock(samples: int, dt: float) -> FloatArray:
    return np.asarray(np.arange(samples) * float(dt), dtype=np.float64)
