"""Random plants as texts of specs, and their simulation in continuous time with numpy and scipy alone.

A plant in continuous time with a known input, a fault, one or two disturbances and sensor noise, some of its constants
within tolerances; sampled by its spec.  Disturbances are bang-bang in many parts of each sample, or held.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import expm

#: Parts of a sample in which a disturbance has one sign.
PARTS = 24
#: Deviations that noise keeps within, and the tolerance of constants.
NOISE_BOUND, TOLERANCE = 3.0, 0.03


class WrittenPlant(NamedTuple):
    """A plant as written: ``x' = A x + B u + Bf f + Bd d, y = C x + Dd d + noise``."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    Bf: np.ndarray
    Bd: np.ndarray
    Dd: np.ndarray
    noise: np.ndarray  # deviations (ny,)
    bounds: np.ndarray  # of the disturbances (nd,)
    dt: float
    uncertain: bool

    @property
    def names(self) -> dict[str, list[str]]:
        """Names of signals, as the spec has them."""
        sizes = {"x": len(self.A), "u": 1, "y": len(self.C), "f": 1, "d": self.Bd.shape[1]}
        return {letter: [f"{letter}{i + 1}" for i in range(size)] for letter, size in sizes.items()}

    def corner(self, rng: np.random.Generator) -> WrittenPlant:
        """Return the plant at a corner of its tolerances."""
        if not self.uncertain:
            return self
        signs = rng.choice([-1.0, 1.0], len(self.A))
        return self._replace(A=self.A + np.diag(TOLERANCE * signs * np.diag(self.A)))

    def spec(self, method: str, options: dict[str, Any], amplitude: float) -> dict[str, Any]:
        """Return the spec of a design for it."""
        n, names = len(self.A), self.names
        a: list[list[Any]] = self.A.tolist()
        plant: dict[str, Any] = {"dt": 0}
        if self.uncertain:
            plant["constants"] = {
                f"p{i}": {"nominal": float(self.A[i, i]), "tolerance": f"{100 * TOLERANCE:g} %"} for i in range(n)
            }
            for i in range(n):
                a[i][i] = f"p{i}"
        plant |= {
            "A": a, "B": self.B.tolist(), "C": self.C.tolist(), "Bf": self.Bf.tolist(), "Bd": self.Bd.tolist(),
            "Dd": self.Dd.tolist(), "state_names": names["x"], "input_names": names["u"], "output_names": names["y"],
            "fault_names": names["f"], "disturbance_names": names["d"],
            "sensor_noise": dict(zip(names["y"], self.noise.tolist(), strict=True)),
            "transform": {"sample_time": self.dt},
        }  # fmt: skip
        limits = dict(zip(names["d"], self.bounds.tolist(), strict=True))
        scenario = {
            "horizon": 80 * self.dt, "seed": 1, "noise": 1,
            "inputs": {"u1": {"kind": "sine", "amplitude": amplitude, "frequency": 0.3 / self.dt}},
            "faults": {"f1": {"kind": "step", "size": 1.0, "start": 60 * self.dt}},
            "disturbances": {name: {"kind": "uniform", "low": -size, "high": size} for name, size in limits.items()},
        }  # fmt: skip
        return {"schema_version": 1, "name": "case", "plant": plant, "method": {"id": method, "options": options},
                "scenario": scenario}  # fmt: skip

    def save(self, path: Path, method: str, options: dict[str, Any], amplitude: float) -> Path:
        """Write the spec (JSON is YAML)."""
        path.write_text(json.dumps(self.spec(method, options, amplitude)), encoding="utf-8")
        return path


def written_plant(rng: np.random.Generator, *, uncertain: bool) -> WrittenPlant:
    """Return a random stable plant."""
    n, ny = int(rng.integers(2, 4)), int(rng.choice([1, 2, 2, 3, 3, 3]))
    nd = 1 if rng.random() < 0.7 else 2
    a = rng.standard_normal((n, n))
    if rng.random() < 0.4:
        a = 3.0 * (a - a.T)
    a -= (np.max(np.linalg.eigvals(a).real) + rng.uniform(0.2, 1.0)) * np.eye(n)
    c = np.eye(n)[:ny] if rng.random() < 0.5 else rng.standard_normal((min(ny, n), n))
    direct = rng.choice([0.0, 0.3]) * rng.standard_normal((len(c), nd))
    speed = float(np.median(np.abs(np.linalg.eigvals(a))))
    return WrittenPlant(
        a, rng.standard_normal((n, 1)), c, rng.standard_normal((n, 1)), rng.standard_normal((n, nd)), direct,
        10.0 ** rng.uniform(-3.0, -1.0, len(c)), rng.uniform(0.1, 1.0, nd),
        float(10.0 ** rng.uniform(-1.0, 0.2)) / speed, uncertain,
    )  # fmt: skip


def sampled(plant: WrittenPlant, moving: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the transition over a sample, and what columns ``(n, m)`` that are held over it add."""
    n, m = moving.shape
    whole = expm(np.block([[plant.A, moving], [np.zeros((m, n + m))]]) * plant.dt)
    return whole[:n, :n], whole[:n, n:]


def kernels(plant: WrittenPlant, samples: int, parts: int = PARTS) -> np.ndarray:
    """Return outputs ``(samples, parts + 1, nd, ny)`` for a disturbance at its bound in one part of sample 0 alone.

    The last part is the value at the sample itself, which outputs show at once."""
    n, nd = plant.Bd.shape
    moving = plant.Bd * plant.bounds
    whole = expm(np.block([[plant.A, moving], [np.zeros((nd, n + nd))]]) * plant.dt / parts)
    pushes = [whole[:n, n:]]
    while len(pushes) < parts:
        pushes.append(whole[:n, :n] @ pushes[-1])
    states, moved = np.array(pushes[::-1]), expm(plant.A * plant.dt)
    found = np.zeros((samples, parts + 1, nd, len(plant.C)))
    found[0, parts] = (plant.Dd * plant.bounds).T
    for k in range(1, samples):
        found[k, :parts] = np.einsum("yx,pxd->pdy", plant.C, states)
        states = np.einsum("xz,pzd->pxd", moved, states)
    return found


def effects(kernel: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return what each part of each sample adds to a sum of outputs with ``weights (samples, ny)``."""
    samples = len(weights)
    return np.array([np.einsum("ky,kpdy->pd", weights[at:], kernel[: samples - at]) for at in range(samples)])


def held(effect: np.ndarray) -> np.ndarray:
    """Return the effects of disturbances that do not move between samples: one sign for all parts of each."""
    return effect.sum(axis=1, keepdims=True) * np.full_like(effect, 1.0 / effect.shape[1])


def worst_sum(effect: np.ndarray, weights: np.ndarray, noise: np.ndarray) -> float:
    """Return the largest sum of outputs within the bounds of disturbances and noise."""
    return float(np.abs(effect).sum() + NOISE_BOUND * (np.abs(weights) @ noise).sum())


def record(plant: WrittenPlant, signs: np.ndarray, noise: np.ndarray, u: np.ndarray, f: np.ndarray) -> np.ndarray:
    """Return outputs ``(samples, ny)`` from rest for signs ``(samples, PARTS + 1, nd)``, a held input and fault."""
    kernel, y = kernels(plant, len(u)), noise.copy()
    for k in range(len(u)):
        for first in range(k + 1):
            y[k] += np.einsum("pd,pdy->y", signs[first], kernel[k - first])
    step, push = sampled(plant, np.hstack([plant.B, plant.Bf]))
    x = np.zeros(len(plant.A))
    for k in range(len(u)):
        y[k] += plant.C @ x
        x = step @ x + push @ np.array([u[k], f[k]])
    return y
