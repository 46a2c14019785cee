"""A calibrated design against an extended Kalman filter with walking faults, as a user writes it in 30 lines.

    python benchmarks/against_ekf.py [--logs 6] [--seed 1000] [--plant servo]

Three plants: an air-handling unit, a buck converter, a hydraulic servo.  Each is simulated independently
(fourth-order steps, 20 in a sample), with constants 3 % off, noise of one sensor that is AR(.9), outliers in one row of
200, blanks in one of 100.  Both filters get the spec's constants and the deviations of the sensors; each gets the walk
of the faults that suits it best on one faulty log.  Ours calibrates constants and noise on a normal log of 400 rows
(`calibrate`, `with_noise`).  Both learn alarms from 4,000 other normal rows, at one false alarm in 3,500 rows: ours
by `learn_thresholds`, the other one as the largest estimate of each fault there.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pandas as pd

import obsynth as ob

ROWS, START, FAULT_AT, MISMATCH = 400, 50, 250, 0.03
NORMAL_ROWS, EVERY = 4000, 3500
#: Faults walk by their size over one of these in a row.
WALKS = (10.0, 30.0, 100.0)


@dataclass(frozen=True)
class Plant:
    """A plant twice: as texts for obsynth, and as functions for the user's filter and the simulation."""

    model: ob.DAEModel
    rates: Callable[..., np.ndarray]  # of x, u, faults, constants
    outputs: Callable[..., np.ndarray]
    dt: float
    inputs: Callable[[np.random.Generator], np.ndarray]
    sizes: tuple[float, ...]  # of the faults
    noise: tuple[float, ...]  # deviations of the sensors, of the first one coloured
    process: tuple[float, ...]  # what the equations are uncertain by in a sample, in units of the states
    unknown: tuple[str, ...]
    noisy: tuple[str, ...]  # equations that are not exact

    @property
    def constants(self) -> dict[str, float]:
        """Return the constants of the spec."""
        return dict(self.model.constants)


def held(rng: np.random.Generator, low: float, high: float, rows: int) -> np.ndarray:
    """Return a signal that stays for a number of rows."""
    return np.repeat(rng.uniform(low, high, NORMAL_ROWS // rows + 1), rows)[:NORMAL_ROWS]


def air() -> Plant:
    """A coil in an air stream: the valve loses a share of its flow, the air sensor reads too high."""
    model = ob.DAEModel(
        {"coil": "Cw * der(coil) = valve * (1 - stuck) * kw * (water - coil) - ka * (coil - air)",
         "air": "Ca * der(air) = ka * (coil - air) + kf * (mix - air)"},
        {"Tair": "air + bias", "Tcoil": "coil"}, states={"coil": 40.0, "air": 25.0},
        inputs={"valve": 0.5, "water": 60.0, "mix": 15.0}, parameters={"stuck": 0.0, "bias": 0.0},
        constants={"Cw": 3000.0, "Ca": 800.0, "kw": 20.0, "ka": 8.0, "kf": 10.0},
    )  # fmt: skip

    def rates(x, u, f, c):
        return np.array([(u[0] * (1 - f[0]) * c["kw"] * (u[1] - x[0]) - c["ka"] * (x[0] - x[1])) / c["Cw"],
                         (c["ka"] * (x[0] - x[1]) + c["kf"] * (u[2] - x[1])) / c["Ca"]])  # fmt: skip

    return Plant(
        model, rates, lambda x, f: np.array([x[1] + f[1], x[0]]), 60.0,
        lambda rng: np.column_stack([held(rng, 0.2, 0.8, 25), held(rng, 55.0, 65.0, 100), held(rng, 10.0, 20.0, 40)]),
        (0.3, 1.0), (0.15, 0.1), (0.02, 0.02), ("Cw", "kw", "ka"), ("coil", "air"),
    )  # fmt: skip


def buck() -> Plant:
    """A buck converter, averaged over its switching: the switch loses a share, the capacitor dries out."""
    model = ob.DAEModel(
        {"coil": "L * der(i) = duty * source * (1 - switch) - r * i - v",
         "node": "C * (1 - dry) * der(v) = i - v / load"},
        {"vout": "v", "iout": "i"}, states={"i": 3.0, "v": 12.0}, inputs={"duty": 0.5, "load": 4.0},
        parameters={"switch": 0.0, "dry": 0.0}, constants={"L": 1e-4, "C": 1e-4, "r": 0.1, "source": 24.0},
    )  # fmt: skip

    def rates(x, u, f, c):
        return np.array([(u[0] * c["source"] * (1 - f[0]) - c["r"] * x[0] - x[1]) / c["L"],
                         (x[0] - x[1] / u[1]) / (c["C"] * (1 - f[1]))])  # fmt: skip

    return Plant(
        model, rates, lambda x, f: np.array([x[1], x[0]]), 1e-5,
        lambda rng: np.column_stack([held(rng, 0.35, 0.65, 20), held(rng, 3.0, 6.0, 45)]),
        (0.1, 0.4), (0.05, 0.02), (0.01, 0.01), ("L", "C", "source"), ("coil", "node"),
    )  # fmt: skip


def servo() -> Plant:
    """A hydraulic servo: oil leaks past the piston, and the valve loses gain."""
    model = ob.DAEModel(
        {"place": "der(x) = w", "piston": "M * der(w) = A * p - b * w - k * x",
         "oil": "V * der(p) = gain * (1 - worn) * valve - A * w - (leak0 + leak) * p"},
        {"xs": "x", "ps": "p"}, states={"x": 0.1, "w": 0.1, "p": 1.0}, inputs={"valve": 0.0},
        parameters={"leak": 0.0, "worn": 0.0},
        constants={"M": 0.5, "A": 1.0, "b": 8.0, "k": 20.0, "V": 0.05, "gain": 2.0, "leak0": 0.1},
    )  # fmt: skip

    def rates(x, u, f, c):
        push = c["A"] * x[2] - c["b"] * x[1] - c["k"] * x[0]
        flow = c["gain"] * (1 - f[1]) * u[0] - c["A"] * x[1] - (c["leak0"] + f[0]) * x[2]
        return np.array([x[1], push / c["M"], flow / c["V"]])

    return Plant(
        model, rates, lambda x, f: np.array([x[0], x[2]]), 0.02,
        lambda rng: held(rng, -1.0, 1.0, 30)[:, None],
        (0.1, 0.3), (0.01, 0.1), (1e-3, 1e-2, 1e-2), ("k", "gain", "leak0"), ("piston", "oil"),
    )  # fmt: skip


PLANTS = {"air handling": air, "buck": buck, "servo": servo}


def simulated(
    plant: Plant, seed: int, faults: tuple[float, ...], rows: int = ROWS
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return inputs, outputs with all their flaws, and the faults of each row."""
    rng = np.random.default_rng(seed)
    off = np.random.default_rng(7)
    true = {name: value * (1 + MISMATCH * off.choice([-1, 1])) for name, value in plant.constants.items()}
    u, f = plant.inputs(rng)[:rows], np.zeros((rows, len(plant.sizes)))
    f[FAULT_AT:] = faults
    x, y, e = plant.model.nominal_state.copy(), [], rng.standard_normal()
    for k in range(rows):
        for _ in range(20 if k else 0):
            h = plant.dt / 20
            a = plant.rates(x, u[k], f[k], true)
            b = plant.rates(x + h / 2 * a, u[k], f[k], true)
            c = plant.rates(x + h / 2 * b, u[k], f[k], true)
            d = plant.rates(x + h * c, u[k], f[k], true)
            x = x + h / 6 * (a + 2 * b + 2 * c + d)
        e = 0.9 * e + np.sqrt(0.19) * rng.standard_normal()
        noise = np.array(plant.noise) * np.array([e, *rng.standard_normal(len(plant.noise) - 1)])
        y.append(plant.outputs(x, f[k]) + noise)
    y = np.array(y)
    wild = rng.random(y.shape) < 0.005
    y[wild] += (20 * rng.choice([-1, 1], y.shape) * plant.noise)[wild]
    y[rng.random(y.shape) < 0.01] = np.nan
    y[0] = plant.outputs(plant.model.nominal_state, f[0])
    return u, y, f


def users_filter(plant: Plant, u: np.ndarray, y: np.ndarray, walk: np.ndarray) -> np.ndarray:
    """The user's own: states and walking faults, Jacobians by differences, a gate of six deviations."""
    n, c = len(plant.process), plant.constants
    z = np.concatenate([plant.model.nominal_state, np.zeros(len(walk))])
    P = np.diag(np.concatenate([(0.1 * np.abs(z[:n]) + 0.01) ** 2, np.array(plant.sizes) ** 2 / 100]))
    Q = np.diag(np.concatenate([np.array(plant.process) ** 2, walk]))
    R = np.diag(np.array(plant.noise) ** 2)

    def step(z, u):
        x, f = z[:n], z[n:]
        for _ in range(4):
            h = plant.dt / 4
            a = plant.rates(x, u, f, c)
            b = plant.rates(x + h / 2 * a, u, f, c)
            d = plant.rates(x + h / 2 * b, u, f, c)
            x = x + h / 6 * (a + 2 * b + 2 * d + plant.rates(x + h * d, u, f, c))
        return np.concatenate([x, f])

    def jacobian(g, z):
        steps = 1e-6 * np.maximum(np.abs(z), 1.0)
        return np.column_stack([(g(z + s) - g(z - s)) / (2 * s.sum()) for s in np.diag(steps)])

    found = []
    for k in range(len(y)):
        if k:
            F = jacobian(lambda z: step(z, u[k]), z)  # noqa: B023 (used at once)
            z, P = step(z, u[k]), F @ P @ F.T + Q
        H = jacobian(lambda z: plant.outputs(z[:n], z[n:]), z)
        e = y[k] - plant.outputs(z[:n], z[n:])
        spread = np.sqrt(np.diag(H @ P @ H.T + R))
        seen = np.isfinite(e) & ~(np.abs(e) > 6 * spread)
        H, e, Rs = H[seen], e[seen], R[np.ix_(seen, seen)]
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + Rs)
        z, P = z + K @ e, P - K @ H @ P
        found.append(z[n:])
    return np.array(found)


def log_of(plant: Plant, u: np.ndarray, y: np.ndarray) -> pd.DataFrame:
    """Return inputs and outputs as a log."""
    names = [*plant.model.input_names, *plant.model.output_names]
    return pd.DataFrame(np.column_stack([plant.dt * np.arange(len(y)), u, y]), columns=["time", *names])


class Users:
    """The user's filter with a walk, and levels that are the largest estimates of a normal log."""

    def __init__(self, plant: Plant, walk: np.ndarray) -> None:
        self.plant, self.walk, self.levels = plant, walk, np.full(len(walk), np.inf)

    def learn(self, u: np.ndarray, y: np.ndarray) -> None:
        """Take the levels from normal rows."""
        self.levels = np.abs(users_filter(self.plant, u, y, self.walk))[START:].max(axis=0)

    def run(self, u: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return estimates ``(n, nq)`` and alarms ``(n,)``."""
        found = users_filter(self.plant, u, y, self.walk)
        return found, (np.abs(found) > self.levels).any(axis=1)


class Ours:
    """A calibrated design with a walk, and learned thresholds."""

    def __init__(self, plant: Plant, walk: np.ndarray, found: ob.types.Calibration) -> None:
        model = plant.model
        known = model.replace(constants={**model.constants, **found.nominal})
        made = ob.with_noise(known, sensor_noise=found.sensor_noise, offset=found.offset)[0]
        self.plant, self.monitor, self.named = plant, None, ""
        self.design = ob.dae_adaptive_observer(
            made, dt=plant.dt, Q=found.Q, R=found.R, integration=found.integration, form="augmented-kalman",
            random_walk=np.diag(walk), initial_covariance=dict(found.initial_covariance), outliers="gate",
            outlier_sizes=found.outlier_sizes,
            initial_parameter_covariance=np.diag(np.array(plant.sizes) ** 2 / 100),
        )  # fmt: skip

    def learn(self, u: np.ndarray, y: np.ndarray) -> None:
        """Learn thresholds from normal rows."""
        learned = ob.learn_thresholds(
            self.design, log_of(self.plant, u, y), rows=f"{START}:", false_alarms=f"1 per {EVERY} rows"
        )
        print(learned.statement, flush=True)
        self.monitor = ob.online_monitor(self.design, "learned", normal=learned)

    def run(self, u: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return estimates ``(n, nq)`` and alarms ``(n,)``."""
        run = ob.run_on_data(self.design, log_of(self.plant, u, y), monitor=self.monitor)
        self.named = next((event.fault or "none" for event in run.events if event.last_row > FAULT_AT), "")
        table = run.table
        found = table[[f"fhat[{name}]" for name in self.plant.model.parameter_names]].to_numpy()
        return found, np.zeros(len(y), dtype=bool) if self.monitor is None else (table["alarm"] != "").to_numpy()


def calibrated(plant: Plant, u: np.ndarray, y: np.ndarray) -> ob.types.Calibration:
    """Return what a normal log says of the plant."""
    bounds = {name: (0.8 * plant.constants[name], 1.25 * plant.constants[name]) for name in plant.unknown}
    found = ob.calibrate(plant.model, log_of(plant, u, y), bounds, input_delay=0, starts=1, noisy=plant.noisy)
    print(found, flush=True)
    return found


def suited(plant: Plant, made: Callable[[np.ndarray], Users | Ours], seed: int) -> Users | Ours:
    """Return a filter with the walk of the faults that suits it best on one faulty log."""
    u, y, f = simulated(plant, seed, plant.sizes)
    filters = [made((np.array(plant.sizes) / part) ** 2) for part in WALKS]
    costs = [np.mean(((one.run(u, y)[0] - f)[START:] / plant.sizes) ** 2) for one in filters]
    return filters[int(np.argmin(costs))]


def compared(plant: Plant, name: str, seed: int, logs: int) -> list[str]:
    """Return a row of the table for each fault; ``seed``: of the first log."""
    normal = (0.0,) * len(plant.sizes)
    found = calibrated(plant, *simulated(plant, seed, normal)[:2])
    filters = [suited(plant, lambda walk: Ours(plant, walk, found), seed + 1),
               suited(plant, lambda walk: Users(plant, walk), seed + 1)]  # fmt: skip
    u, y, _ = simulated(plant, seed + 2, normal, NORMAL_ROWS)
    for one in filters:
        one.learn(u, y)
    quiet = [0, 0]
    for k in range(2 * logs):
        u, y, _ = simulated(plant, seed + 100 + k, normal)
        for i, one in enumerate(filters):
            quiet[i] += not one.run(u, y)[1][START:].any()
    rows = []
    for j, fault in enumerate(plant.model.parameter_names):
        squares, delays, named = np.zeros((2, logs)), np.zeros((2, logs)), []
        for k in range(logs):
            u, y, f = simulated(plant, seed + 200 + k, tuple(s * (i == j) for i, s in enumerate(plant.sizes)))
            for i, one in enumerate(filters):
                estimates, alarm = one.run(u, y)
                squares[i, k] = np.mean((estimates - f)[START:, j] ** 2)
                later = np.flatnonzero(alarm[FAULT_AT:])
                delays[i, k] = later[0] if len(later) else ROWS - FAULT_AT
            named.append(filters[0].named)
        cells = [f"{value:.3g}" for value in (*np.sqrt(squares.mean(axis=1)), *delays.mean(axis=1))]
        told = f"{quiet[0]} of {2 * logs} | {quiet[1]} of {2 * logs} | {named.count(fault)} of {logs}"
        rows.append(f"| {name}, {fault} | {' | '.join(cells)} | {told} |")
        print(rows[-1], flush=True)
    return rows


def main() -> None:
    """Print a row for each plant and fault."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--logs", type=int, default=6)
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--plant", choices=list(PLANTS), help="one of them (default: all)")
    options = parser.parse_args()
    names = [options.plant] if options.plant else list(PLANTS)
    rows = [row for name in names for row in compared(PLANTS[name](), name, options.seed, options.logs)]
    print(
        "| plant, fault | rms: ours | 30 lines | delay in rows: ours | 30 lines | normal logs quiet: ours | 30 lines "
        "| named right: ours |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    print("\n".join(rows))


if __name__ == "__main__":
    main()
