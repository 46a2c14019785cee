"""The stated scenario, many times: disturbances, noise and tolerances drawn; the same draws for every method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.continuous import driven
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.simulation.scenario import Scenario
from obsynth.simulation.signals import resolve
from obsynth.tolerances.exact_plant import plant_at

#: Entries of A, B, Bf, Bd that tolerances do not touch: they are kinematics, not parameters.
EXACT = (0.0, 1.0, -1.0)


@dataclass(frozen=True, eq=False)
class DrawnRuns:
    """Outputs ``(runs, steps, ny)`` of drawn plants with the scenario's faults and without any, and known inputs."""

    faulty: FloatArray
    faulty_u: FloatArray
    healthy: FloatArray
    healthy_u: FloatArray
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
    feedback: FloatArray,
) -> DrawnRuns:
    """Return the runs; plants are drawn before they are sampled, and disturbances by a factor between -1 and 1."""
    from obsynth.methods.fault_figures import on_the_clock

    drive = resolve(sampled, scenario)
    nu, nf = sampled.nu, sampled.nf
    rng = np.random.default_rng(seed)
    seeds = [int(value) for value in rng.integers(0, 2**31, size=runs)]
    random, noise, sensors = drive.drawn(seeds, sampled.nw)
    scales = rng.uniform(-1.0, 1.0, size=(runs, sampled.nd))
    found: dict[str, list[tuple[FloatArray, FloatArray]]] = {"faulty": [], "healthy": []}
    off = tolerance > 0.0 or source.uncertainty is not None
    for run in range(runs):
        plant = on_the_clock(_drawn(source, tolerance, rng), sampled.dt) if off else sampled
        signals = drive.left + random[:, run]
        d = signals[:, nu + nf :] * scales[run]
        shaken = noise[:, run] if noise.shape[2] == plant.nw else np.zeros((drive.steps, plant.nw))
        for name, f in (("faulty", signals[:, nu : nu + nf]), ("healthy", np.zeros((drive.steps, nf)))):
            outputs, known = _outputs(plant, signals[:, :nu], d, f, shaken, feedback)
            found[name].append((outputs + sensors[:, run], known))
    (faulty, faulty_u), (healthy, healthy_u) = (
        [np.array(part) for part in zip(*found[name], strict=True)] for name in ("faulty", "healthy")
    )
    return DrawnRuns(faulty, faulty_u, healthy, healthy_u, drive.left[:, nu : nu + nf], drive.dt)


def estimates(observer: LinearObserver, u: FloatArray, outputs: FloatArray) -> FloatArray:
    """Return fault estimates ``(runs, steps, faults)`` of an observer at rest; u and outputs ``(runs, steps, ...)``."""
    rows, y, known = observer.fault_rows, outputs.swapaxes(0, 1), u.swapaxes(0, 1)
    z = driven(observer.Az, np.zeros(observer.order), y @ observer.By.T + known @ observer.Bu.T)
    with np.errstate(over="ignore", invalid="ignore"):
        found = z @ observer.Cz[rows].T + y @ observer.Dy[rows].T + known @ observer.Du[rows].T
    return np.ascontiguousarray(found.swapaxes(0, 1))


def _outputs(
    plant: DescriptorSystem, u: FloatArray, d: FloatArray, f: FloatArray, w: FloatArray, feedback: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return outputs and known inputs ``(steps, ..)`` of a plant at rest, with ``u - feedback x`` as its input."""
    into = u @ plant.B.T + d @ plant.Bd.T + f @ plant.Bf.T + w @ plant.Bw.T
    direct = u @ plant.D.T + d @ plant.Dd.T + f @ plant.Df.T + w @ plant.Dw.T
    closed, seen = plant.A - plant.B @ feedback, plant.C - plant.D @ feedback
    states = driven(closed, np.zeros(plant.nx), into)
    return np.asarray(states @ seen.T + direct), np.asarray(u - states @ feedback.T)


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
            if value not in EXACT:
                factor = factors.setdefault(abs(float(value)), 1.0 + tolerance * rng.uniform(-1.0, 1.0))
                changed[index] = value * factor
        return changed

    return plant.replace(E=off(plant.E), A=off(plant.A), B=off(plant.B), Bf=off(plant.Bf), Bd=off(plant.Bd))


def alarms(
    found: FloatArray, quiet: FloatArray, fault: FloatArray, response: FloatArray, false_alarms: float, dt: float
) -> tuple[float, float, float]:
    """Return threshold (passed in a share of the fault-free runs), median detection delay (s) and smallest fault found.
    ``found, quiet (runs, steps)``: estimates with and without the fault; ``response (steps,)``: to a unit step."""
    level = float(np.quantile(np.max(np.abs(quiet), axis=1), 1.0 - false_alarms))
    acts = np.flatnonzero(fault)
    if not acts.size:
        return level, float("nan"), float("nan")
    first = int(acts[0])
    above = np.abs(found[:, first:]) > level
    delays = np.where(above.any(axis=1), np.argmax(above, axis=1) * dt, np.inf)
    # The response is computed as far as a step is followed, which may be less than the record.
    length = min(len(fault) - first, len(response))
    shown = np.maximum(response[:length], 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        needed = np.where(shown > 0.0, (level - quiet[:, first : first + length]) / shown, np.inf)
    smallest = np.maximum(np.min(needed, axis=1), 0.0)
    return level, float(np.median(delays)), float(np.median(smallest))


def rms(errors: Sequence[float] | FloatArray) -> float:
    """Return the root of the mean square."""
    values = np.asarray(errors, dtype=np.float64)
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")
