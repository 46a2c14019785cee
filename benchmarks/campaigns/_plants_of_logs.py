"""Eight plants and logs of theirs as plants write them: simulated apart from obsynth, in fourth-order steps.

Each log has constants 3 to 5 % off the spec's, noise of which one sensor's is coloured, outliers, blanks, a start that
is not the spec's, set points of its own, a sensor that drifts by up to a deviation over the log, a sensor that is stuck
for a while, and noise of its own size.  Normal and test logs are drawn from the same law, but a log's own drift, start,
set points and size of noise are drawn once for each.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

import obsynth as ob

ROWS, FAULT_AT = 4_000, 2_000
#: Fourth-order steps in a sample.
SUBSTEPS = 4
#: Shares: constants off by 3 to 5 %, set points and starts; the drift of a log in deviations, the size of its noise.
MISMATCH, SET_POINT, START, DRIFT, NOISE = (0.03, 0.05), 0.1, 0.2, 1.0, (0.85, 1.15)
OUTLIERS, OUTLIER_SIZE, BLANKS, STUCK_ROWS, COLOUR = 0.002, 20.0, 0.01, 30, 0.9


@dataclass(frozen=True)
class Plant:
    """A plant twice: as texts for obsynth, and as functions of the states for the simulation and the user's filter."""

    model: ob.DAEModel
    rates: Callable[..., Any]  # of x, u, faults, constants
    outputs: Callable[..., Any]  # of x, faults, constants, u
    dt: float
    inputs: Mapping[str, tuple[float, float, int]]  # mean, half the span, and rows for which it is held
    sizes: tuple[float, ...]  # of the faults
    noise: tuple[float, ...]  # deviations of the sensors
    process: tuple[float, ...]  # deviations that a sample adds to the states
    unknown: tuple[str, ...] = ()  # constants that are calibrated
    start: tuple[float, ...] = ()  # states of the spec that the simulation begins with

    @property
    def constants(self) -> dict[str, float]:
        """Return the constants of the spec."""
        return dict(self.model.constants)


def tanks() -> Plant:
    """Two tanks above each other; the flows are algebraic. The pump wears, the lower tank leaks."""
    model = ob.DAEModel(
        {"upper": "A1 * der(h1) = kp * (1 - worn) * pump - q12", "lower": "A2 * der(h2) = q12 - qout - leak * sqrt(h2)",
         "between": "0 = c1 * sqrt(h1) - q12", "outlet": "0 = c2 * sqrt(h2) - qout"},
        {"level1": "h1", "level2": "h2", "flow": "qout"}, states={"h1": 1.0, "h2": 1.0, "q12": 0.2, "qout": 0.2},
        inputs={"pump": 1.0}, parameters={"worn": 0.0, "leak": 0.0},
        constants={"A1": 4.0, "A2": 6.0, "kp": 0.2, "c1": 0.2, "c2": 0.2},
    )  # fmt: skip

    def rates(x, u, f, c):
        first, second = np.sqrt(np.maximum(x[0], 1e-3)), np.sqrt(np.maximum(x[1], 1e-3))
        return [(c["kp"] * (1 - f[0]) * u[0] - c["c1"] * first) / c["A1"],
                (c["c1"] * first - (c["c2"] + f[1]) * second) / c["A2"]]  # fmt: skip

    return Plant(
        model, rates, lambda x, f, c, u: [x[0], x[1], c["c2"] * np.sqrt(np.maximum(x[1], 1e-3))], 2.0,
        {"pump": (1.0, 0.15, 60)}, (0.06, 0.02), (0.01, 0.01, 0.004), (1e-3, 1e-3), ("kp", "c1", "c2"), (1.0, 1.0),
    )  # fmt: skip


def reactor() -> Plant:
    """A stirred tank with a jacket: the jacket fouls, the sensor of the feed's temperature is not there."""
    model = ob.DAEModel(
        {"mass": "der(c) = q * (cf - c) - k0 * exp(-4.0 / T) * c",
         "heat": "der(T) = q * (1.0 - T) + 0.25 * k0 * exp(-4.0 / T) * c - ua * (1 - fouled) * (T - Tj) + heat",
         "jacket": "der(Tj) = qj * (0.95 - Tj) + 2.0 * ua * (1 - fouled) * (T - Tj)"},
        {"conc": "c", "temp": "T", "cool": "Tj"}, states={"c": 0.5, "T": 1.05, "Tj": 0.98},
        inputs={"q": 0.1, "cf": 1.0, "qj": 0.5}, parameters={"fouled": 0.0, "heat": 0.0},
        constants={"k0": 5.0, "ua": 0.15},
    )  # fmt: skip

    def rates(x, u, f, c):
        r, out = c["k0"] * np.exp(-4.0 / x[1]) * x[0], c["ua"] * (1 - f[0]) * (x[1] - x[2])
        return [u[0] * (u[1] - x[0]) - r, u[0] * (1.0 - x[1]) + 0.25 * r - out + f[1],
                u[2] * (0.95 - x[2]) + 2.0 * out]  # fmt: skip

    return Plant(
        model, rates, lambda x, f, c, u: [x[0], x[1], x[2]], 1.0,
        {"q": (0.1, 0.01, 80), "cf": (1.0, 0.05, 120), "qj": (0.5, 0.05, 150)}, (0.15, 0.002), (0.005, 0.002, 0.002),
        (5e-4, 2e-4, 2e-4), ("k0", "ua"), (0.5, 1.05, 0.98),
    )  # fmt: skip


def motor() -> Plant:
    """A motor with a belt: the winding heats up, the bearing rubs."""
    model = ob.DAEModel(
        {"coil": "L * der(i) = v - (R + dR) * i - K * w", "shaft": "J * der(w) = K * i - (b + rub) * w - load"},
        {"current": "i", "speed": "w"}, states={"i": 2.0, "w": 20.0}, inputs={"v": 12.0, "load": 0.3},
        parameters={"dR": 0.0, "rub": 0.0}, constants={"L": 0.02, "R": 1.0, "K": 0.4, "J": 0.02, "b": 0.02},
    )  # fmt: skip

    def rates(x, u, f, c):
        return [(u[0] - (c["R"] + f[0]) * x[0] - c["K"] * x[1]) / c["L"],
                (c["K"] * x[0] - (c["b"] + f[1]) * x[1] - u[1]) / c["J"]]  # fmt: skip

    return Plant(
        model, rates, lambda x, f, c, u: [x[0], x[1]], 0.005,
        {"v": (12.0, 2.0, 50), "load": (0.3, 0.1, 90)}, (0.3, 0.008), (0.03, 0.2), (2e-3, 1e-2), ("R", "K", "b"),
        (2.0, 20.0),
    )  # fmt: skip


def room() -> Plant:
    """A room with a heavy wall and a heater; the heater loses power, a window is open."""
    model = ob.DAEModel(
        {"air": "Ca * der(Ta) = P * (1 - weak) * valve + (Gw) * (Tw - Ta) + (Gi + open) * (out - Ta)",
         "wall": "Cw * der(Tw) = Gw * (Ta - Tw) + Go * (out - Tw)"},
        {"Tair": "Ta", "Twall": "Tw"}, states={"Ta": 20.0, "Tw": 15.0}, inputs={"valve": 0.5, "out": 5.0},
        parameters={"weak": 0.0, "open": 0.0},
        constants={"Ca": 2e5, "Cw": 2e6, "P": 4000.0, "Gw": 150.0, "Go": 80.0, "Gi": 40.0},
    )  # fmt: skip

    def rates(x, u, f, c):
        between = c["Gw"] * (x[1] - x[0])
        return [(c["P"] * (1 - f[0]) * u[0] + between + (c["Gi"] + f[1]) * (u[1] - x[0])) / c["Ca"],
                (c["Go"] * (u[1] - x[1]) - between) / c["Cw"]]  # fmt: skip

    return Plant(
        model, rates, lambda x, f, c, u: [x[0], x[1]], 60.0,
        {"valve": (0.5, 0.3, 90), "out": (5.0, 4.0, 200)}, (0.25, 25.0), (0.05, 0.05), (3e-3, 1e-3),
        ("P", "Gw", "Go", "Gi"), (20.0, 15.0),
    )  # fmt: skip


def cell() -> Plant:
    """A battery cell with two time constants: its contact ages, the current sensor reads too much."""
    model = ob.DAEModel(
        {"charge": "cap * der(s) = -(current + shift)", "fast": "t1 * der(v1) = r1 * (current + shift) - v1",
         "slow": "t2 * der(v2) = r2 * (current + shift) - v2",
         "sum": "0 = 3.2 + 0.8 * s - v1 - v2 - (r0 + aged) * (current + shift) - v"},
        {"volt": "v"}, states={"s": 0.6, "v1": 0.0, "v2": 0.0, "v": 3.68}, inputs={"current": 0.0},
        parameters={"aged": 0.0, "shift": 0.0},
        constants={"cap": 36000.0, "t1": 20.0, "t2": 200.0, "r0": 0.02, "r1": 0.01, "r2": 0.015},
    )  # fmt: skip

    def rates(x, u, f, c):
        i = u[0] + f[1]
        return [-i / c["cap"], (c["r1"] * i - x[1]) / c["t1"], (c["r2"] * i - x[2]) / c["t2"]]

    return Plant(
        model, rates,
        lambda x, f, c, u: [3.2 + 0.8 * x[0] - x[1] - x[2] - (c["r0"] + f[0]) * (u[0] + f[1])], 2.0,
        {"current": (0.0, 5.0, 25)}, (0.006, 0.5), (0.003,), (1e-6, 1e-4, 1e-4), ("r0", "r1"), (0.6, 0.0, 0.0),
    )  # fmt: skip


def exchanger() -> Plant:
    """A heat exchanger in two cells on both sides: it fouls, and the hot flow is less than the meter says."""
    model = ob.DAEModel(
        {"hot1": "m * der(a1) = wh * (1 - slip) * (Th - a1) - h * (1 - foul) * (a1 - b2)",
         "hot2": "m * der(a2) = wh * (1 - slip) * (a1 - a2) - h * (1 - foul) * (a2 - b1)",
         "cold1": "m * der(b1) = wc * (Tc - b1) + h * (1 - foul) * (a2 - b1)",
         "cold2": "m * der(b2) = wc * (b1 - b2) + h * (1 - foul) * (a1 - b2)"},
        {"hotout": "a2", "coldout": "b2", "middle": "a1"}, states={"a1": 60.0, "a2": 50.0, "b1": 30.0, "b2": 38.0},
        inputs={"wh": 1.0, "wc": 1.2, "Th": 80.0, "Tc": 20.0}, parameters={"slip": 0.0, "foul": 0.0},
        constants={"m": 10.0, "h": 0.8},
    )  # fmt: skip

    def rates(x, u, f, c):
        hot, h = u[0] * (1 - f[0]), c["h"] * (1 - f[1])
        return [(hot * (u[2] - x[0]) - h * (x[0] - x[3])) / c["m"], (hot * (x[0] - x[1]) - h * (x[1] - x[2])) / c["m"],
                (u[1] * (u[3] - x[2]) + h * (x[1] - x[2])) / c["m"],
                (u[1] * (x[2] - x[3]) + h * (x[0] - x[3])) / c["m"]]  # fmt: skip

    return Plant(
        model, rates, lambda x, f, c, u: [x[1], x[3], x[0]], 2.0,
        {"wh": (1.0, 0.1, 70), "wc": (1.2, 0.1, 110), "Th": (80.0, 3.0, 150), "Tc": (20.0, 1.0, 300)}, (0.1, 0.15),
        (0.15, 0.15, 0.15), (2e-2, 2e-2, 2e-2, 2e-2), ("m", "h"), (60.0, 50.0, 30.0, 38.0),
    )  # fmt: skip


def cart() -> Plant:
    """A cart on a spring with a damper: the damper loses oil, the drive has lost force."""
    model = ob.DAEModel(
        {"place": "der(x) = w", "force": "M * der(w) = g * (1 - lost) * drive - (d - oil) * w - k * x"},
        {"xs": "x", "ws": "w"}, states={"x": 0.2, "w": 0.0}, inputs={"drive": 1.0},
        parameters={"lost": 0.0, "oil": 0.0}, constants={"M": 1.0, "g": 2.0, "d": 1.5, "k": 10.0},
    )  # fmt: skip

    def rates(x, u, f, c):
        return [x[1], (c["g"] * (1 - f[0]) * u[0] - (c["d"] - f[1]) * x[1] - c["k"] * x[0]) / c["M"]]

    return Plant(
        model, rates, lambda x, f, c, u: [x[0], x[1]], 0.02,
        {"drive": (1.0, 0.8, 40)}, (0.15, 0.5), (0.004, 0.02), (2e-4, 3e-3), ("g", "d", "k"), (0.2, 0.0),
    )  # fmt: skip


def receiver() -> Plant:
    """A compressor that fills a vessel through a cooler: a valve passes, the thermometer reads too much."""
    model = ob.DAEModel(
        {"mass": "V * der(p) = kc * speed - (kv + pass) * valve * p",
         "metal": "tm * der(Tm) = 20.0 + kT * speed * p - Tm"},
        {"press": "p", "tempm": "Tm + bias"}, states={"p": 5.0, "Tm": 40.0}, inputs={"speed": 1.0, "valve": 1.0},
        parameters={"pass": 0.0, "bias": 0.0}, constants={"V": 20.0, "kc": 1.0, "kv": 0.2, "tm": 40.0, "kT": 4.0},
    )  # fmt: skip

    def rates(x, u, f, c):
        return [(c["kc"] * u[0] - (c["kv"] + f[0]) * u[1] * x[0]) / c["V"],
                (20.0 + c["kT"] * u[0] * x[0] - x[1]) / c["tm"]]  # fmt: skip

    return Plant(
        model, rates, lambda x, f, c, u: [x[0], x[1] + f[1]], 1.0,
        {"speed": (1.0, 0.1, 60), "valve": (1.0, 0.1, 100)}, (0.02, 1.5), (0.03, 0.2), (3e-3, 1e-2),
        ("kc", "kv", "kT"), (5.0, 40.0),
    )  # fmt: skip


PLANTS = {"tanks": tanks, "reactor": reactor, "motor": motor, "room": room, "cell": cell, "exchanger": exchanger,
          "cart": cart, "receiver": receiver}  # fmt: skip


def simulated(
    plant: Plant, seeds: list[int], faults: np.ndarray, *, rows: int = ROWS
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return inputs ``(rows, nu)`` and outputs ``(rows, ny)`` of a log for each seed, all at once; ``faults
    (logs, nf)`` begin at `FAULT_AT`."""
    logs, off = len(seeds), np.random.default_rng(7)
    rngs = [np.random.default_rng([8, seed]) for seed in seeds]
    true = {name: value * (1 + off.choice([-1, 1]) * off.uniform(*MISMATCH)) for name, value in plant.constants.items()}
    u = np.stack([_inputs(plant, rng, rows) for rng in rngs])
    x = np.array([np.array(plant.start) * (1 + START * rng.uniform(-1, 1)) for rng in rngs]).T
    process = np.stack([rng.standard_normal((rows, len(plant.process))) for rng in rngs])
    y = np.empty((logs, rows, len(plant.noise)))
    h = plant.dt / SUBSTEPS
    for k in range(rows):
        f = faults.T * float(k >= FAULT_AT)
        now = u[:, k].T
        for _ in range(SUBSTEPS if k else 0):
            a = np.array(plant.rates(x, now, f, true))
            b = np.array(plant.rates(x + h / 2 * a, now, f, true))
            c = np.array(plant.rates(x + h / 2 * b, now, f, true))
            d = np.array(plant.rates(x + h * c, now, f, true))
            x = x + h / 6 * (a + 2 * b + 2 * c + d)
        x = x + (np.array(plant.process) * process[:, k]).T
        y[:, k] = np.array(plant.outputs(x, f, true, now)).T
    return [(u[i], _measured(plant, y[i], rng)) for i, rng in enumerate(rngs)]


def _inputs(plant: Plant, rng: np.random.Generator, count: int) -> np.ndarray:
    """Return inputs of a log ``(rows, nu)``, around set points of its own."""
    found = []
    for mean, half, rows in plant.inputs.values():
        centre = mean + SET_POINT * (abs(mean) or half) * rng.uniform(-1, 1)
        found.append(np.repeat(centre + half * rng.uniform(-1, 1, count // rows + 1), rows)[:count])
    return np.column_stack(found)


def _measured(plant: Plant, y: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return outputs ``(rows, ny)`` as sensors give them."""
    from scipy.signal import lfilter

    rows, ny = y.shape
    white, sizes = rng.standard_normal((rows, ny)), np.array(plant.noise) * rng.uniform(*NOISE)
    white[:, 0] = lfilter([np.sqrt(1 - COLOUR**2)], [1.0, -COLOUR], white[:, 0])
    drift = np.zeros((rows, ny))
    drift[:, rng.integers(ny)] = DRIFT * rng.uniform(-1, 1) * np.arange(rows) / rows
    found = y + sizes * (white + drift)
    wild = rng.random(y.shape) < OUTLIERS
    found[wild] += (OUTLIER_SIZE * rng.choice([-1, 1], y.shape) * plant.noise)[wild]
    first, sensor = int(rng.integers(rows // 20, rows - rows // 20)), int(rng.integers(ny))
    found[first : first + STUCK_ROWS, sensor] = found[first, sensor]
    found[rng.random(y.shape) < BLANKS] = np.nan
    return found


def as_log(plant: Plant, u: np.ndarray, y: np.ndarray) -> pd.DataFrame:
    """Return inputs and outputs as a log."""
    names = [*plant.model.input_names, *plant.model.output_names]
    return pd.DataFrame(np.column_stack([plant.dt * np.arange(len(y)), u, y]), columns=["time", *names])


def users_filter(plant: Plant, u: np.ndarray, y: np.ndarray, walk: np.ndarray) -> np.ndarray:
    """Return the fault estimates ``(rows, nf)`` of what a user writes: an extended Kalman filter of states and walking
    faults, Jacobians by differences, a gate of six deviations."""
    n, c = len(plant.process), plant.constants
    z = np.concatenate([np.array(plant.start), np.zeros(len(walk))])
    P = np.diag(np.concatenate([(0.1 * np.abs(z[:n]) + 0.01) ** 2, np.array(plant.sizes) ** 2 / 100]))
    Q = np.diag(np.concatenate([np.array(plant.process) ** 2, walk]))
    R = np.diag(np.array(plant.noise) ** 2)
    widths, found = 1e-6 * np.eye(len(z)), []

    def step(z: np.ndarray, u: np.ndarray) -> np.ndarray:
        x, f = z[:n], z[n:]
        h = plant.dt / 2
        for _ in range(2):
            a = np.array(plant.rates(x, u, f, c))
            b = np.array(plant.rates(x + h / 2 * a, u, f, c))
            d = np.array(plant.rates(x + h / 2 * b, u, f, c))
            x = x + h / 6 * (a + 2 * b + 2 * d + np.array(plant.rates(x + h * d, u, f, c)))
        return np.concatenate([x, f])

    for k in range(len(y)):
        # All columns of a Jacobian at once: the functions take arrays.
        scale = np.maximum(np.abs(z), 1.0)
        both = np.hstack([z[:, None] + widths * scale, z[:, None] - widths * scale])
        if k:
            now = u[k][:, None] * np.ones(both.shape[1])
            moved = step(both, now)
            F = (moved[:, : len(z)] - moved[:, len(z) :]) / (2e-6 * scale)
            z, P = step(z, u[k]), F @ P @ F.T + Q
            both = np.hstack([z[:, None] + widths * scale, z[:, None] - widths * scale])
        now = u[k][:, None] * np.ones(both.shape[1])
        shown = np.array(plant.outputs(both[:n], both[n:], c, now))
        H = (shown[:, : len(z)] - shown[:, len(z) :]) / (2e-6 * scale)
        e = y[k] - np.array(plant.outputs(z[:n], z[n:], c, u[k]))
        spread = np.sqrt(np.diag(H @ P @ H.T + R))
        seen = np.isfinite(e) & ~(np.abs(e) > 6 * spread)
        H, e, Rs = H[seen], e[seen], R[np.ix_(seen, seen)]
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + Rs)
        z, P = z + K @ e, P - K @ H @ P
        found.append(z[n:])
    return np.array(found)
