"""The stated scenario, many times: disturbances, noise and tolerances drawn; the same draws for every method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.holds import driven
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.simulation.scenario import Scenario
from obsynth.simulation.scenario_signals import resolve

#: Entries of A, B, Bf, Bd that tolerances do not touch: they are kinematics, not parameters.
EXACT = (0.0, 1.0, -1.0)


@dataclass(frozen=True, eq=False)
class DrawnRuns:
    """Outputs of drawn plants: with the scenario's faults and without any, for the same draws otherwise.

    Fields: u ``(steps, nu)``; faulty, healthy ``(runs, steps, ny)``; faults ``(steps, nf)``; dt.
    """

    u: FloatArray
    faulty: FloatArray
    healthy: FloatArray
    faults: FloatArray
    dt: float


def drawn_runs(
    source: DescriptorSystem,
    sampled: DescriptorSystem,
    scenario: Scenario,
    *,
    runs: int,
    tolerance: float,
    seed: int,
) -> DrawnRuns:
    """Return the runs; plants are drawn before they are sampled, and disturbances by a factor between -1 and 1."""
    from obsynth.methods.choosing.figures import on_the_clock

    drive = resolve(sampled, scenario)
    nu, nf = sampled.nu, sampled.nf
    rng = np.random.default_rng(seed)
    seeds = [int(value) for value in rng.integers(0, 2**31, size=runs)]
    random, noise, sensors = drive.drawn(seeds, sampled.nw)
    scales = rng.uniform(-1.0, 1.0, size=(runs, sampled.nd))
    faulty: list[FloatArray] = []
    healthy: list[FloatArray] = []
    for run in range(runs):
        plant = on_the_clock(_drawn(source, tolerance, rng), sampled.dt) if tolerance else sampled
        signals = drive.left + random[:, run]
        d = signals[:, nu + nf :] * scales[run]
        shaken = noise[:, run] if noise.shape[2] == plant.nw else np.zeros((drive.steps, plant.nw))
        for f, kept in ((signals[:, nu : nu + nf], faulty), (np.zeros((drive.steps, nf)), healthy)):
            kept.append(_outputs(plant, signals[:, :nu], d, f, shaken) + sensors[:, run])
    return DrawnRuns(drive.left[:, :nu], np.array(faulty), np.array(healthy), drive.left[:, nu : nu + nf], drive.dt)


def estimates(observer: LinearObserver, u: FloatArray, outputs: FloatArray) -> FloatArray:
    """Return fault estimates ``(runs, steps, faults)`` of an observer at rest on outputs ``(runs, steps, ny)``."""
    rows, y = observer.fault_rows, outputs.swapaxes(0, 1)
    z = driven(observer.Az, np.zeros(observer.order), y @ observer.By.T + (u @ observer.Bu.T)[:, None])
    with np.errstate(over="ignore", invalid="ignore"):
        found = z @ observer.Cz[rows].T + y @ observer.Dy[rows].T + (u @ observer.Du[rows].T)[:, None]
    return np.ascontiguousarray(found.swapaxes(0, 1))


def _outputs(plant: DescriptorSystem, u: FloatArray, d: FloatArray, f: FloatArray, w: FloatArray) -> FloatArray:
    into = u @ plant.B.T + d @ plant.Bd.T + f @ plant.Bf.T + w @ plant.Bw.T
    direct = u @ plant.D.T + d @ plant.Dd.T + f @ plant.Df.T + w @ plant.Dw.T
    states = driven(plant.A, np.zeros(plant.nx), into)
    return np.asarray(states @ plant.C.T + direct)


def _drawn(plant: DescriptorSystem, tolerance: float, rng: np.random.Generator) -> DescriptorSystem:
    """Return a plant whose parameters are off by up to the tolerance, each by itself; equal entries stay equal."""
    factors: dict[float, float] = {}

    def off(matrix: FloatArray) -> FloatArray:
        changed = matrix.copy()
        for index, value in np.ndenumerate(matrix):
            if value not in EXACT:
                factor = factors.setdefault(abs(float(value)), 1.0 + tolerance * rng.uniform(-1.0, 1.0))
                changed[index] = value * factor
        return changed

    return plant.replace(E=off(plant.E), A=off(plant.A), B=off(plant.B), Bf=off(plant.Bf), Bd=off(plant.Bd))


def alarms(
    found: FloatArray, quiet: FloatArray, fault: FloatArray, response: FloatArray, false_alarms: float, dt: float
) -> tuple[float, float, float]:
    """Return threshold, median detection delay (s) and smallest fault found in half of the runs.

    ``found``, ``quiet`` ``(runs, steps)``: estimates with and without the fault; ``response (steps,)``: to a unit step.
    The threshold is passed in a share ``false_alarms`` of the fault-free runs.
    """
    level = float(np.quantile(np.max(np.abs(quiet), axis=1), 1.0 - false_alarms))
    acts = np.flatnonzero(fault)
    if not acts.size:
        return level, float("nan"), float("nan")
    first = int(acts[0])
    above = np.abs(found[:, first:]) > level
    delays = np.where(above.any(axis=1), np.argmax(above, axis=1) * dt, np.inf)
    length = len(fault) - first
    shown = np.maximum(response[:length], 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        needed = np.where(shown > 0.0, (level - quiet[:, first : first + length]) / shown, np.inf)
    smallest = np.maximum(np.min(needed, axis=1), 0.0)
    return level, float(np.median(delays)), float(np.median(smallest))


def rms(errors: Sequence[float] | FloatArray) -> float:
    """Return the root of the mean square."""
    values = np.asarray(errors, dtype=np.float64)
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")
