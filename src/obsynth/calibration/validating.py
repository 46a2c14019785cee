"""Comparing a recorded, fault-free log with a design: the public function."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from obsynth.calibration.diagnostics import SIGNIFICANT, change_of_mean, consistency, consistency_of, whiteness
from obsynth.calibration.logs import Log, LogData, read_log
from obsynth.calibration.noise_ratios import noise_ratios
from obsynth.calibration.recorded_innovations import RecordedInnovations, recorded_innovations
from obsynth.calibration.validation import SensorValidation, Validation
from obsynth.errors import SpecError
from obsynth.numerics.arguments import require_kind
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.observers.dae.observer import DAEObserver
from obsynth.observers.linear.observer import LinearObserver
from obsynth.results.design import ObserverDesign

#: A mean of innovations, or a parameter's deviation from its start, beyond so many standard deviations is told.
OFFSET = 3.0
#: Rows that a log must have at least.
LEAST_ROWS = 20


def validate(
    design: ObserverDesign,
    log: LogData,
    *,
    rows: str | slice | Sequence[int] | None = None,
    columns: Mapping[str, str] | None = None,
    scales: Mapping[str, float] | None = None,
) -> Validation:
    """Ask whether a recorded log without faults agrees with a design.

    Parameters
    ----------
    design : ObserverDesign
        Recursive or nonlinear: one that predicts its outputs with a covariance.
    log : path, pandas.DataFrame or mapping
        CSV or Parquet file, or columns by name: ``time`` in seconds, inputs and outputs.
    rows : str, slice or pair, optional
        ``"a:b"``, as Python counts: the rows without faults; all by default.
    columns : mapping of str to str, optional
        Column of a signal, or of ``time``, where the names differ.
    scales : mapping of str to float, optional
        What a column is multiplied by; those of the plant by default.

    Returns
    -------
    Validation
        NIS per degree of freedom, mean and whiteness of each sensor's innovations, variances that the log contradicts,
        and a verdict with what to change.

    Raises
    ------
    SpecError
        The design has no innovations with a covariance, a name is unknown, or the log cannot be used.
    SolverError
        A step of a nonlinear plant has no solution along the log.
    """
    require_kind(design, ObserverDesign, "design", "an ObserverDesign, such as obsynth.load(path)")
    if isinstance(design.observer, LinearObserver):
        raise SpecError(
            f"The method {design.method} states no covariance of its residual, which a log could contradict: validate "
            "a recursive or nonlinear design, or run the log with a monitor.", path="design",
        )  # fmt: skip
    plant = design.plant
    factors = dict(getattr(plant, "scales", {})) | dict(scales or {})
    found = read_log(log, plant.input_names, plant.output_names, rows=rows, columns=columns, scales=factors,
                     dt=design.observer.dt)  # fmt: skip
    if found.samples < LEAST_ROWS:
        raise SpecError(f"The log has {found.samples} rows here: at least {LEAST_ROWS} are needed.", path="rows",
                        code="too-short")  # fmt: skip
    record = recorded_innovations(design, found)
    sensors = _sensors(record, plant.output_names)
    whole = consistency_of(record.squares, record.degrees)
    place = change_of_mean(record.standardised)
    change = None if place is None else found.rows[0] + place
    ratios = noise_ratios(design.observer, found) if isinstance(design.observer, DAEObserver) else {}
    verdict = [*found.notes, *_sentences(sensors, ratios, whole.value, change, record, design)]
    passed = not verdict[len(found.notes) :] and whole.holds
    if not passed and not whole.holds and not ratios:
        far = "small" if whole.value > whole.high else "large"
        verdict.append(f"Q and R are too {far} together: the innovations are {np.sqrt(whole.value):.2g} times what is "
                       "expected.")  # fmt: skip
    if passed:
        verdict.append("The innovations are as the design expects them: white, without offset, of the stated size.")
    return Validation(
        passed, design.name, whole, sensors, ratios, change, tuple(verdict), read_only(record.innovations),
        read_only(record.deviations), read_only(np.array(found.y)), read_only(found.y - record.innovations),
        record.estimates, _described(found),
    )  # fmt: skip


def _described(log: Log) -> dict[str, object]:
    return {"source": log.source, "rows": list(log.rows), "digest": log.digest, "samples": log.samples, "dt": log.dt}


def _sensors(record: RecordedInnovations, names: Sequence[str]) -> dict[str, SensorValidation]:
    found = {}
    for name, column in zip(names, record.standardised.T, strict=True):
        seen = np.isfinite(column)
        count = int(seen.sum())
        mean = float(column[seen].mean() * np.sqrt(count)) if count else 0.0
        found[name] = SensorValidation(consistency(column, seen), mean, whiteness(column))
    return found


def _sentences(
    sensors: Mapping[str, SensorValidation], ratios: Mapping[str, float], nis: float, change: int | None,
    record: RecordedInnovations, design: ObserverDesign,
) -> list[str]:  # fmt: skip
    found = []
    for name, ratio in ratios.items():
        letter, what = "R" if name in sensors else "Q", "small" if ratio > 1.0 else "large"
        factor = max(ratio, 1.0 / ratio)
        found.append(f"{letter} of {name} is {_times(factor)} too {what}.")
    for name, sensor in sensors.items():
        if abs(sensor.mean) > OFFSET:
            found.append(f"The innovations of {name} have an offset of {sensor.mean:+.1f} deviations of their mean: a "
                         "constant or an offset of the sensor is wrong.")  # fmt: skip
        if sensor.whiteness.probability < SIGNIFICANT:
            found.append(f"The innovations of {name} are not white (p = {sensor.whiteness.probability:.2g}, first "
                         f"autocorrelation {sensor.whiteness.first:+.2f}): Q against R is wrong, or something that "
                         f"moves {name} is not in the model.")  # fmt: skip
    if change is not None:
        found.append(f"The mean of the innovations changes at row {change}: these rows are not free of faults.")
    for name, deviation in _far(record.estimates, design).items():
        found.append(f"The estimate of {name} ends {deviation:.1f} deviations from its nominal value: a constant is "
                     "wrong, or the rows are not free of faults.")  # fmt: skip
    return found


def _far(estimates: Mapping[str, FloatArray], design: ObserverDesign) -> dict[str, float]:
    start = dict(zip(design.observer.fault_names, getattr(design.observer, "initial_parameters", ()), strict=False))
    found = {}
    for name, columns in estimates.items():
        value, deviation = columns[-1]
        if name in start and deviation > 0.0 and abs(value - start[name]) > OFFSET * deviation:
            found[name] = float(abs(value - start[name]) / deviation)
    return found


def _times(factor: float) -> str:
    if factor > 1000.0:
        return "more than a thousand times"
    words = {2: "two", 3: "three", 4: "four", 5: "five", 6: "six", 7: "seven", 8: "eight", 9: "nine", 10: "ten"}
    near = round(factor)
    return f"{words[near]} times" if near in words and abs(factor - near) < 0.25 * near else f"{factor:.3g} times"
