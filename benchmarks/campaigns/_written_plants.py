"""Random plants as texts of specs, and their simulation in continuous time with numpy and scipy alone.

A plant in continuous time with a known input, a fault, one or two disturbances and sensor noise, some of its constants
within tolerances; sampled by its spec.  Inputs may act late and readings be late; outputs may read the derivative of a
combination of states, which makes the plant one of index 2 as it is written.  Disturbances are bang-bang in many parts
of each sample, or held.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import expm

#: Parts of a sample in which a disturbance has one sign.
PARTS = 24
#: Parts of a sample of which delays are multiples: every number of parts here is one of them.
PARTS_OF_DELAYS = 8
#: Deviations that noise keeps within, and the tolerance of constants.
NOISE_BOUND, TOLERANCE = 3.0, 0.03


class WrittenPlant(NamedTuple):
    """A plant as written: ``x' = A x + B u + Bf f + Bd d, y = C x + reads (G x)' + Dd d + noise``, late by delays."""

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
    late: tuple[int, ...] = ()  # of the input and of each output, in eighths of a sample
    G: np.ndarray | None = None  # (1, n)
    reads: np.ndarray | None = None  # (ny, 1)

    @property
    def delays(self) -> tuple[int, ...]:
        """Delays of the input and of the outputs, in eighths of a sample."""
        return self.late or (0,) * (1 + len(self.C))

    @property
    def outputs(self) -> dict[str, np.ndarray]:
        """What outputs read of states and signals, without a constraint."""
        ny = len(self.C)
        read = {"C": self.C, "D": np.zeros((ny, 1)), "Df": np.zeros((ny, 1)), "Dd": self.Dd}
        if self.G is not None:
            moves = {"C": self.A, "D": self.B, "Df": self.Bf, "Dd": self.Bd}
            read = {name: read[name] + self.reads @ self.G @ moves[name] for name in read}
        return read

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
        rows = {"A": a, "C": self.C.tolist(), **{name: getattr(self, name).tolist() for name in ("B", "Bf", "Bd")}}
        states = names["x"]
        if self.G is not None:
            rows, states = self._with_constraint(rows), [*states, "w1", "w2"]
        if self.late:
            late = zip([*names["u"], *names["y"]], self.late, strict=True)
            plant["delays"] = {name: each * self.dt / PARTS_OF_DELAYS for name, each in late if each}
        plant |= {
            **rows, "Dd": self.Dd.tolist(), "state_names": states, "input_names": names["u"],
            "output_names": names["y"], "fault_names": names["f"], "disturbance_names": names["d"],
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

    def _with_constraint(self, rows: dict[str, Any]) -> dict[str, Any]:
        """Return the matrices with ``w1' = w2, 0 = w1 - G x``, of which outputs read w2."""
        n = len(self.A)
        assert self.G is not None
        assert self.reads is not None
        more = {
            "E": np.diag([1.0] * (n + 1) + [0.0]).tolist(),
            "A": [[*row, 0.0, 0.0] for row in rows["A"]]
            + [[0.0] * (n + 1) + [1.0], [*(-self.G[0]).tolist(), 1.0, 0.0]],
            "C": np.hstack([self.C, np.zeros((len(self.C), 1)), self.reads]).tolist(),
        }
        return more | {name: rows[name] + [[0.0] * len(rows[name][0])] * 2 for name in ("B", "Bf", "Bd")}

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


def of_another_form(plant: WrittenPlant, rng: np.random.Generator) -> WrittenPlant:
    """Return the plant with delays, or with outputs that read a derivative (index 2)."""
    ny = len(plant.C)
    if rng.random() < 0.5:
        late = rng.choice([0, 0, 3, PARTS_OF_DELAYS, 13, 2 * PARTS_OF_DELAYS], 1 + ny)
        return plant._replace(late=tuple(late.tolist()))
    reads = (rng.random((ny, 1)) < 0.6) * rng.standard_normal((ny, 1))
    return plant._replace(G=rng.standard_normal((1, len(plant.A))), reads=reads)


def moved(plant: WrittenPlant, moving: np.ndarray, time: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the transition over a time, and what columns ``(n, m)`` that are held over it add."""
    n, m = moving.shape
    whole = expm(np.block([[plant.A, moving], [np.zeros((m, n + m))]]) * time)
    return whole[:n, :n], whole[:n, n:]


class Sampled(NamedTuple):
    """The plant on samples, with faults and disturbances that are held: each sample on its way is a state."""

    A: np.ndarray
    Bf: np.ndarray
    Bd: np.ndarray
    C: np.ndarray
    Df: np.ndarray
    Dd: np.ndarray


def sampled(plant: WrittenPlant) -> Sampled:
    """Return the plant on samples; of a known input nothing, whose effect every observer takes off."""
    n, ny, read = len(plant.A), len(plant.C), plant.outputs
    both, direct = np.hstack([plant.Bf, plant.Bd]), np.hstack([read["Df"], read["Dd"]])
    step, push = moved(plant, both, plant.dt)
    late = [-(-each // PARTS_OF_DELAYS) for each in plant.delays[1:]]
    count = n + sum(late)
    A, B = np.zeros((count, count)), np.zeros((count, both.shape[1]))
    C, D = np.zeros((ny, count)), np.zeros((ny, both.shape[1]))
    A[:n, :n], B[:n], at = step, push, n
    for j, samples in enumerate(late):
        # A reading that is late by 1.25 samples is that of three quarters after the sample before the last.
        after = plant.dt * (samples - plant.delays[1 + j] / PARTS_OF_DELAYS)
        free, driven = moved(plant, both, after)
        row, fed = read["C"][j] @ free, read["C"][j] @ driven + direct[j]
        if not samples:
            C[j, :n], D[j] = row, fed
            continue
        A[at, :n], B[at] = row, fed
        A[at + 1 : at + samples, at : at + samples - 1] = np.eye(samples - 1)
        C[j, at + samples - 1] = 1.0
        at += samples
    return Sampled(A, B[:, :1], B[:, 1:], C, D[:, :1], D[:, 1:])


def kernels(plant: WrittenPlant, samples: int, parts: int = PARTS) -> np.ndarray:
    """Return outputs ``(samples, parts + moments, nd, ny)`` for a disturbance at its bound in one part of sample 0.

    After the parts come values at single moments, which outputs show at once: those at which readings are taken."""
    each = parts // PARTS_OF_DELAYS
    late = [each * delay for delay in plant.delays[1:]]
    read, moments = plant.outputs, sorted({-delay % parts for delay in late})
    free, push = moved(plant, plant.Bd * plant.bounds, plant.dt / parts)
    states = np.zeros((samples * parts, *push.shape))
    for r in range(samples * parts):
        states[r] = push if r == 0 else free @ states[r - 1]
    kernel = np.zeros((samples, parts + len(moments), len(plant.bounds), len(plant.C)))
    for j, delay in enumerate(late):
        shown = np.einsum("x,rxd->rd", read["C"][j], states)
        since = parts * np.arange(samples)[:, None] - delay - np.arange(parts) - 1
        kernel[:, :parts, :, j] = np.where(since[..., None] >= 0, shown[since], 0.0)
        first = -(-delay // parts)
        if first < samples:
            kernel[first, parts + moments.index(-delay % parts), :, j] = read["Dd"][j] * plant.bounds
    return kernel


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
    kernel, y = kernels(plant, len(u)), noise + outputs(plant, u, f, np.zeros((len(u), len(plant.bounds))))
    for k in range(len(u)):
        for first in range(k + 1):
            y[k] += np.einsum("pd,pdy->y", signs[first], kernel[k - first])
    return y


def outputs(plant: WrittenPlant, u: np.ndarray, f: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Return outputs ``(samples, ny)`` from rest for signals that are held, without noise."""
    parts = PARTS_OF_DELAYS if plant.late else 1
    late = plant.delays if plant.late else (0,) * (1 + len(plant.C))
    read, n = plant.outputs, len(plant.A)
    free, push = moved(plant, np.hstack([plant.B, plant.Bf, plant.Bd]), plant.dt / parts)
    fine = np.arange(len(u) * parts)
    acting = np.where(fine >= late[0], u[(fine - late[0]) // parts], 0.0)
    driven = np.column_stack([acting, f[fine // parts], d[fine // parts]])
    states = np.zeros((len(fine), n))
    for i in range(1, len(fine)):
        states[i] = free @ states[i - 1] + push @ driven[i - 1]
    shown = states @ read["C"].T + driven @ np.hstack([read["D"], read["Df"], read["Dd"]]).T
    at = parts * np.arange(len(u))[:, None] - np.array(late[1:])
    return np.where(at >= 0, np.take_along_axis(shown, np.maximum(at, 0), axis=0), 0.0)
