"""Learned thresholds on logs as they are: healthy time in alarm, delays and names, beside a user's own filter.

Eight plants (`_plants_of_logs`), simulated apart from obsynth: constants 3 to 5 % off, coloured noise, outliers,
blanks, drifting and stuck sensors; starts, set points, drifts and the size of the noise are each log's own.
Constants and noise are calibrated on 400 rows of the first normal log, and thresholds are learned from one normal log
of 4,000 rows or from three; then three healthy logs are judged, and one with each fault from the middle on.  A row of
a healthy log counts as in alarm where it is undecided, too.  The user's filter (`users_filter`) has the spec's
constants and the same walks of the faults; its levels are 1.05 times its largest estimates on the same normal logs.
Rows before the 50th count for neither.  Faults found are those with an alarm after their begin; the delay is the median
over faults that both find, and a name is right where the first alarm after the begin has it.  The mean is that of the
healthy time with three normal logs, in %: rows at the start without a decision are 1.3 % of a log.  A healthy
log that is in alarm for more than 10 % of its time, beside three normal ones, is wrong.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from benchmarks.campaigns._plants_of_logs import FAULT_AT, PLANTS, Plant, as_log, simulated, users_filter
from benchmarks.campaigns.frame import Outcome

import obsynth as ob

LIMIT = 1_800.0  # s
#: Numbers of normal logs, and the share of healthy time in alarm that is allowed with each, and in the worst log.
NORMAL_LOGS = {1: 0.05, 3: 0.02}
WORST = 0.1
CASES, FIRST_SEED = len(PLANTS), 200_000
HEALTHY, FAULTY, START, CALIBRATED = 3, 1, 50, 400
#: Faults walk by their size over this in a row; one false alarm in so many rows; the user's margin.
WALK, RATE, MARGIN = 30.0, "1 per 3500 rows", 1.05


def design_of(plant: Plant, u: np.ndarray, y: np.ndarray) -> ob.ObserverDesign:
    """Return the design of a user: calibrated on some rows, faults that walk."""
    model = plant.model
    bounds = {name: (0.8 * plant.constants[name], 1.25 * plant.constants[name]) for name in plant.unknown}
    log = as_log(plant, u[:CALIBRATED], y[:CALIBRATED])
    found = ob.calibrate(model, log, bounds, input_delay=0, starts=1)
    known = model.replace(constants={**model.constants, **found.nominal})
    made = ob.with_noise(known, sensor_noise=found.sensor_noise, offset=found.offset)[0]
    sizes = np.array(plant.sizes)
    return ob.dae_adaptive_observer(
        made, dt=plant.dt, Q=found.Q, R=found.R, integration=found.integration, form="augmented-kalman",
        random_walk=np.diag((sizes / WALK) ** 2), initial_covariance=dict(found.initial_covariance), outliers="gate",
        outlier_sizes=found.outlier_sizes, initial_parameter_covariance=np.diag(sizes**2 / 100),
    )  # fmt: skip


def case(seed: int) -> Outcome:
    """Learn from one normal log of a plant and from three, and judge logs that nothing was learned from."""
    name = list(PLANTS)[seed]
    plant, most = PLANTS[name](), max(NORMAL_LOGS)
    count = len(plant.sizes)
    faults = np.zeros((most + HEALTHY + count * FAULTY, count))
    for j in range(count):
        faults[most + HEALTHY + j * FAULTY : most + HEALTHY + (j + 1) * FAULTY, j] = plant.sizes[j]
    records = simulated(plant, [FIRST_SEED + 1_000 * seed + k for k in range(len(faults))], faults)
    walk = (np.array(plant.sizes) / WALK) ** 2
    users = [np.abs(users_filter(plant, *one, walk)) for one in records]
    design = design_of(plant, *records[0])
    found = {logs: judged(plant, design, records, users, logs) for logs in NORMAL_LOGS}
    within = [
        float(np.median(data["healthy"])) <= NORMAL_LOGS[logs] and max(data["healthy"]) <= WORST
        for logs, data in found.items()
    ]
    worst = max(found[most]["healthy"])
    return Outcome(
        "plants", "within both" if all(within) else "within one" if any(within) else "above both",
        f"a healthy log of {name} is in alarm for {100 * worst:.1f} % of its time" if worst > WORST else "",
        value=100.0 * float(np.mean(found[most]["healthy"])), details=json.dumps({"plant": name, "found": found}),
    )  # fmt: skip


def judged(
    plant: Plant,
    design: ob.ObserverDesign,
    records: Sequence[tuple[np.ndarray, np.ndarray]],
    users: Sequence[np.ndarray],
    logs: int,
) -> dict[str, Any]:
    """Return what thresholds from normal logs, and levels of the user's filter from the same, say of the others."""
    learned = ob.learn_thresholds(design, [as_log(plant, *one) for one in records[:logs]], false_alarms=RATE)
    monitor = ob.online_monitor(design, "learned", normal=learned)
    usual = np.max([one[START:].max(axis=0) for one in users[:logs]], axis=0)
    found: dict[str, Any] = {name: [] for name in ("healthy", "peer", "ours", "users", "named")}
    for number, record in enumerate(records[max(NORMAL_LOGS) :]):
        run = ob.run_on_data(design, as_log(plant, *record), monitor=monitor)
        statistic = run.table["statistic"].to_numpy(dtype=float)
        theirs = (users[max(NORMAL_LOGS) + number] > MARGIN * usual).any(axis=1)
        if number < HEALTHY:
            found["healthy"].append(float(((statistic > 1.0) | np.isnan(statistic))[START:].mean()))
            found["peer"].append(float(theirs[START:].mean()))
            continue
        fault = plant.model.parameter_names[(number - HEALTHY) // FAULTY]
        for key, alarms in (("ours", statistic > 1.0), ("users", theirs)):
            after = alarms[FAULT_AT:]
            found[key].append(int(np.argmax(after)) if after.any() else None)
        named = next((event.fault for event in run.events if event.last_row > FAULT_AT), "")
        found["named"].append(named == fault)
    return {**found, "stated": learned.healthy_time.expected, "holds": learned.holds}


def more_of_table(outcomes: Mapping[int, Outcome]) -> list[str]:
    """Return the lines of a table with healthy time, delays and names."""
    lines = [
        "| plant, normal logs | healthy time in alarm: ours, median (worst) | the user's | ours, as stated "
        "| faults found: ours | the user's | delay in rows: ours | the user's | named right |",
        "|" + " --- |" * 9,
    ]
    rows = [json.loads(outcome.details) for _, outcome in sorted(outcomes.items()) if outcome.details]
    for logs in NORMAL_LOGS:
        of_plants = [(row["plant"], row["found"][str(logs)]) for row in rows]
        keys = ("healthy", "peer", "ours", "users", "named")
        whole = {key: [value for _, data in of_plants for value in data[key]] for key in keys}
        for plant, data in (*of_plants, ("**all**", whole)):
            ours, users = (np.array(data[key], dtype=float) for key in ("ours", "users"))
            both = np.isfinite(ours) & np.isfinite(users)
            shares = [f"{100 * np.median(data[key]):.1f} % ({100 * max(data[key]):.1f} %)" for key in keys[:2]]
            cells = [
                f"{plant}, {logs}", *shares, f"{100 * data['stated']:.2g} %" if "stated" in data else "",
                *(f"{np.isfinite(part).sum()} of {len(part)}" for part in (ours, users)),
                *(f"{np.median(part[both]):.3g}" if both.any() else "" for part in (ours, users)),
                f"{sum(data['named'])} of {len(data['named'])}",
            ]  # fmt: skip
            lines.append("| " + " | ".join(cells) + " |")
    return lines
