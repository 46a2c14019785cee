"""Healthy time in alarm where logs are not what thresholds were learned from: two tanks with a constant that drifts.

The simulation shares no code with the package: Runge-Kutta steps of two tanks in a row, whose second outflow drifts
by up to 3 % within a log (4 hours), samples that jitter by 10 %, coloured noise, sensors rounded to 2 mm, set points
three times as far apart as in the learning logs.  Ours is calibrated on 400 rows, with faults that walk and
`learn_thresholds` from one log without a drift, and from four logs with drifts of 0 to 3 %.  The yardsticks are a
steady Kalman filter of the linearised tanks whose normalised innovations alarm at three deviations, and their CUSUM
with a threshold of 1.05 times the largest on the learning log.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.linalg import expm, solve_discrete_are

import obsynth as ob

AREA, INFLOW, OUTFLOWS, WEIGHT = 0.05, 2.5e-4, (1.2e-4, 1.0e-4), 2.0 * 9.81
DT, ROWS, FAULT_AT, CALIBRATED, WARM_UP = 5.0, 3000, 1500, 400, 50
JITTER, NOISE, COLOUR_TIME, QUANTUM, SUBSTEPS = 0.1, 0.002, 60.0, 0.002, 8
#: Of the leak (m3/s) and the pump (share), by which faults walk in 30 rows.
SIZES = np.array([2e-5, 0.1])
#: What is judged: the span of set points, the drift, the fault and its size.
CASES: dict[str, tuple[float, float, str, float]] = {
    "as learned": (0.1, 0.0, "", 0.0),
    "set points": (0.3, 0.0, "", 0.0),
    "drift of 3 %": (0.1, 0.03, "", 0.0),
    "both": (0.3, 0.03, "", 0.0),
    "leak": (0.1, 0.0, "leak", 2e-5),
    "half a leak": (0.1, 0.0, "leak", 1e-5),
    "pump": (0.3, 0.0, "pump", 0.1),
    "sensor bias": (0.1, 0.0, "bias", 0.02),
}
LEARNING_DRIFTS = (0.0, 0.02, 0.03, 0.01)


def levels_at(outflows: tuple[float, float]) -> NDArray[np.float64]:
    """Return the levels ``(2,)`` at the usual inflow."""
    return np.array([(INFLOW / c) ** 2 / WEIGHT for c in outflows])


def simulated(seed: int, span: float, drift: float, fault: str = "", size: float = 0.0) -> pd.DataFrame:
    """Return a log with the columns ``time, q, L1, L2``; a fault begins at `FAULT_AT`."""
    rng = np.random.default_rng([5, seed])
    times = DT * np.arange(ROWS) + DT * JITTER * rng.uniform(-1.0, 1.0, ROWS)
    x, q, hold, colour, rows = levels_at(OUTFLOWS), INFLOW, 0, np.zeros(2), []
    for k in range(ROWS):
        if not hold:
            q, hold = INFLOW * (1.0 + span * rng.uniform(-1.0, 1.0)), int(rng.integers(80, 240))
        hold -= 1
        now = size if k >= FAULT_AT else 0.0
        second = OUTFLOWS[1] * (1.0 - drift * k / ROWS)
        pumped = q * (1.0 - now * (fault == "pump")) - now * (fault == "leak")

        def rates(x: NDArray[np.float64], second: float = second, pumped: float = pumped) -> NDArray[np.float64]:
            first_out, second_out = np.array([OUTFLOWS[0], second]) * np.sqrt(WEIGHT * np.maximum(x, 1e-4))
            return np.array([pumped - first_out, first_out - second_out]) / AREA

        h = (times[k] - times[k - 1]) / SUBSTEPS if k else 0.0
        for _ in range(SUBSTEPS):
            a = rates(x)
            b = rates(x + h / 2 * a)
            c = rates(x + h / 2 * b)
            x = x + h / 6 * (a + 2 * b + 2 * c + rates(x + h * c))
        kept = np.exp(-DT / COLOUR_TIME)
        colour = kept * colour + np.sqrt(1.0 - kept**2) * rng.standard_normal(2)
        y = x + NOISE * (rng.standard_normal(2) + colour) + np.array([0.0, now * (fault == "bias")])
        rows.append([times[k], q, *(QUANTUM * np.round(y / QUANTUM))])
    return pd.DataFrame(rows, columns=["time", "q", "L1", "L2"])


def design_of(log: pd.DataFrame) -> tuple[ob.ObserverDesign, dict[str, float]]:
    """Return the design of a user, calibrated on some rows, and its constants."""
    model = ob.DAEModel(
        {"one": f"{AREA} * der(h1) = q * (1 - pump) - a1 * sqrt({WEIGHT} * h1) - leak",
         "two": f"{AREA} * der(h2) = a1 * sqrt({WEIGHT} * h1) - a2 * sqrt({WEIGHT} * h2)"},
        {"L1": "h1", "L2": "h2"}, states=dict(zip(("h1", "h2"), levels_at(OUTFLOWS).tolist(), strict=True)),
        inputs={"q": INFLOW}, constants={"a1": 1.15e-4, "a2": 1.04e-4}, parameters={"leak": 0.0, "pump": 0.0},
    )  # fmt: skip
    found = ob.calibrate(model, log, {"a1": (0.9e-4, 1.5e-4), "a2": (0.8e-4, 1.3e-4)}, input_delay=0, starts=1)
    known = model.replace(constants={**model.constants, **found.nominal})
    made = ob.with_noise(known, sensor_noise=found.sensor_noise, offset=found.offset)[0]
    return ob.dae_adaptive_observer(
        made, dt=DT, Q=found.Q, R=found.R, integration=found.integration, form="augmented-kalman",
        random_walk=np.diag((SIZES / 30.0) ** 2), initial_covariance=dict(found.initial_covariance), outliers="gate",
        outlier_sizes=found.outlier_sizes, initial_parameter_covariance=np.diag(SIZES**2 / 100.0),
    ), dict(found.nominal)  # fmt: skip


class Yardstick:
    """Innovations of a steady Kalman filter at three deviations, and their CUSUM (reference value 0.5)."""

    def __init__(self, constants: dict[str, float], log: pd.DataFrame) -> None:
        outflows = constants["a1"], constants["a2"]
        self.point = levels_at(outflows)
        slopes = np.array(outflows) * np.sqrt(WEIGHT) / 2.0 / np.sqrt(self.point) / AREA
        whole = np.zeros((3, 3))
        whole[:2] = [[-slopes[0], 0.0, 1.0 / AREA], [slopes[0], -slopes[1], 0.0]]
        self.F, self.B = np.split(expm(whole * DT)[:2], [2], axis=1)
        Q, R = 1e-6 * np.eye(2), 1.6e-5 * np.eye(2)
        P = solve_discrete_are(self.F.T, np.eye(2), Q, R)
        self.K = P @ np.linalg.inv(P + R)
        innovations = self.innovations(log)[WARM_UP:]
        self.mean, self.sd = innovations.mean(axis=0), innovations.std(axis=0)
        self.level = 1.05 * self.sums((innovations - self.mean) / self.sd).max(axis=0)

    def innovations(self, log: pd.DataFrame) -> NDArray[np.float64]:
        """Return innovations of a log ``(rows, 2)``."""
        x, before, rows = np.zeros(2), 0.0, []
        for q, *y in log[["q", "L1", "L2"]].to_numpy():
            x = self.F @ x + self.B[:, 0] * before
            rows.append(np.array(y) - self.point - x)
            x, before = x + self.K @ rows[-1], q - INFLOW
        return np.array(rows)

    def sums(self, z: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return sums of normalised innovations, up and down ``(rows, 4)``."""
        rows, sums = [], np.zeros(4)
        for row in z:
            sums = np.maximum(0.0, sums + np.concatenate([row, -row]) - 0.5)
            rows.append(sums)
        return np.array(rows)

    def alarms(self, log: pd.DataFrame) -> dict[str, NDArray[np.bool_]]:
        """Return in which rows each of the two is in alarm."""
        z = (self.innovations(log) - self.mean) / self.sd
        z[:WARM_UP] = 0.0
        return {"three deviations": (np.abs(z) > 3.0).any(axis=1), "CUSUM": (self.sums(z) > self.level).any(axis=1)}


def main() -> None:
    """Print the table."""
    logs = [simulated(seed, 0.1, drift) for seed, drift in enumerate(LEARNING_DRIFTS)]
    design, constants = design_of(logs[0].iloc[:CALIBRATED])
    yardstick = Yardstick(constants, logs[0])
    learned = {n: ob.learn_thresholds(design, logs[:n], false_alarms="1 per 3500 rows") for n in (1, len(logs))}
    print("| log | one log | four logs | three deviations | CUSUM |\n| --- | --- | --- | --- | --- |")
    for seed, (name, (span, drift, fault, size)) in enumerate(CASES.items(), 10):
        log, cells = simulated(seed, span, drift, fault, size), []
        healthy = FAULT_AT if fault else ROWS
        verdicts = {}
        for n, thresholds in learned.items():
            run = ob.run_on_data(design, log, monitor=ob.online_monitor(design, "learned", normal=thresholds))
            verdicts[str(n)] = (run.table["alarm"] != "").to_numpy(), run.table["alarm"].to_numpy()
        verdicts |= {kind: (rows, None) for kind, rows in yardstick.alarms(log).items()}
        for rows, texts in verdicts.values():
            text, after = f"{100.0 * rows[:healthy].mean():.1f} %", np.flatnonzero(rows[healthy:])
            if fault:
                text += f", {after[0]} rows" if len(after) else ", none"
            if fault and len(after) and texts is not None:
                text += f": {texts[healthy + after[0]].partition(': ')[2] or 'no name'}"
            cells.append(text)
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
