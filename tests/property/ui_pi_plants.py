"""Random plants with unknown inputs, some with planted obstacles, and a brute-force verdict that shares no code."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import scipy.linalg

from obsynth import DescriptorSystem

#: Singular values, relative to the largest, that count as zero for the brute-force verdict.
ZERO = 1e-9
KINDS = ("generic", "masked", "fixed stable", "fixed unstable", "undecouplable", "direct", "not regular", "index 2")
#: Word, or data, of a fault model, and how often it is drawn.
MODELS = ("step", "ramp", {"sinusoid": 1.3}, {"exponential": 0.4}, {"exponential": -0.4}, {"polynomial": 2})


@dataclass(frozen=True, eq=False)
class Case:
    """A random plant, its fault model, and what was planted."""

    plant: DescriptorSystem
    model: object
    kind: str


@cache
def random_case(seed: int) -> Case:
    """Return the plant of a seed."""
    rng = np.random.default_rng([2026, seed])
    kind = KINDS[seed % len(KINDS)]
    nx, nd, nf = int(rng.integers(3, 7)), int(rng.integers(0, 3)), int(rng.integers(1, 3))
    if kind in ("undecouplable", "direct"):
        nd = max(nd, 1)
    ny = min(nx, nd + nf + int(rng.integers(0, 2)))
    dt = float(rng.choice([0.0, 0.5]))
    deficiency = int(rng.integers(0, min(ny, nx - 1) - nd + 1)) if ny > nd else 0
    left, right = _orthogonal(rng, nx), _orthogonal(rng, nx)
    e = left @ np.diag(np.r_[rng.uniform(0.5, 2.0, nx - deficiency), np.zeros(deficiency)]) @ right
    a, bd, bf = rng.standard_normal((nx, nx)), rng.standard_normal((nx, nd)), rng.standard_normal((nx, nf))
    c, dd, df = rng.standard_normal((ny, nx)), np.zeros((ny, nd)), np.zeros((ny, nf))
    if rng.random() < 0.3:
        df[:, 0] = rng.standard_normal(ny)
    model = MODELS[int(rng.integers(len(MODELS)))]
    parts = {"E": e, "A": a, "Bd": bd, "Bf": bf, "C": c, "Dd": dd, "Df": df}
    _plant(kind, parts, rng, model, dt)
    return Case(DescriptorSystem(**parts, dt=dt), model, kind)


def _plant(kind: str, parts: dict, rng: np.random.Generator, model: object, dt: float) -> None:
    """Put an obstacle, or a peculiarity, into a plant."""
    e, a, c = parts["E"], parts["A"], parts["C"]
    nx = len(a)
    if kind == "masked":
        # Bf such that the fault f1, with some x and d, is invisible at an eigenvalue of the fault model.
        value = eigenvalue_of(model, dt)
        if value.imag:
            return
        hidden = scipy.linalg.null_space(c)
        if hidden.shape[1]:
            x = hidden @ rng.standard_normal(hidden.shape[1])
            d = rng.standard_normal(parts["Bd"].shape[1])
            parts["Df"][:, 0] = 0.0
            parts["Bf"][:, 0] = (value.real * e - a) @ x - parts["Bd"] @ d
    elif kind in ("fixed stable", "fixed unstable"):
        # A mode that no output shows.
        stable = kind == "fixed stable"
        value = (0.4 if stable else 1.2) if dt else (-0.7 if stable else 0.3)
        hidden = scipy.linalg.null_space(c)
        if hidden.shape[1]:
            x = hidden @ rng.standard_normal(hidden.shape[1])
            parts["A"] = a + np.outer((value * e - a) @ x, x) / (x @ x)
    elif kind == "undecouplable":
        # A disturbance that moves a state no output shows at once.
        hidden = scipy.linalg.null_space(c)
        if hidden.shape[1]:
            parts["Bd"][:, 0] = e @ (hidden @ rng.standard_normal(hidden.shape[1]))
    elif kind == "direct":
        parts["Dd"][:, 0] = rng.standard_normal(len(c))
    elif kind == "not regular":
        parts["E"][-1], parts["A"][-1] = 0.0, 0.0
    elif kind == "index 2" and nx >= 4:
        parts["E"][-2:], parts["A"][-2:] = 0.0, 0.0
        parts["E"][-1, 0], parts["A"][-1, 1], parts["A"][-2, 0] = 1.0, 1.0, 1.0


def _orthogonal(rng: np.random.Generator, size: int) -> np.ndarray:
    return np.linalg.qr(rng.standard_normal((size, size)))[0]


def exosystem_of(model: object, nf: int, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Return Phi and Cw, written down anew."""
    if model in ("step", "ramp"):
        model = {"polynomial": ("step", "ramp").index(model)}
    ((kind, number),) = model.items()
    if kind == "polynomial":
        phi = np.diag(np.ones(number), 1) if number else np.zeros((1, 1))
    elif kind == "sinusoid":
        phi = np.array([[0.0, number], [-number, 0.0]])
    else:
        phi = np.array([[number]])
    if dt:
        phi = scipy.linalg.expm(phi * dt)
    row = np.zeros((1, len(phi)))
    row[0, 0] = 1.0
    return scipy.linalg.block_diag(*[phi] * nf), scipy.linalg.block_diag(*[row] * nf)


def eigenvalue_of(model: object, dt: float) -> complex:
    """Return an eigenvalue of the model of one fault."""
    phi, _ = exosystem_of(model, 1, dt)
    return complex(phi[0, 0]) if not np.any(np.tril(phi, -1)) else complex(np.linalg.eigvals(phi)[0])


@cache
def brute_force(case: Case) -> tuple[bool, np.ndarray]:
    """Return whether an observer exists, and all drops of the augmented pencil.

    Drops are found as common generalised eigenvalues of random square compressions of the tall pencil, and by testing
    every eigenvalue of the model; each is confirmed by the smallest singular value of the pencil itself.
    """
    plant = case.plant
    phi, cw = exosystem_of(case.model, plant.nf, plant.dt)
    nx, nd, ny, nw = plant.nx, plant.nd, plant.ny, len(phi)
    big_e, big_a = scipy.linalg.block_diag(plant.E, np.eye(nw)), scipy.linalg.block_diag(plant.A, phi)
    big_a[:nx, nx:] = plant.Bf @ cw
    bd, c = np.vstack([plant.Bd, np.zeros((nw, nd))]), np.hstack([plant.C, plant.Df @ cw])
    wide_e = np.zeros((nx + nw + ny, nx + nw + nd))
    wide_e[: nx + nw, : nx + nw] = big_e
    wide_a = np.block([[big_a, bd], [-c, -plant.Dd]])
    solvable = _solvable(plant)
    candidates = [*_eigenvalues(phi)]
    rng = np.random.default_rng(1)
    rows, columns = wide_e.shape
    if rows < columns:
        return False, np.zeros(0, dtype=complex)
    compress = np.linalg.qr(rng.standard_normal((rows, rows)))[0][:columns]
    values = scipy.linalg.eigvals(compress @ wide_a, compress @ wide_e)
    candidates += [value for value in values if np.isfinite(value) and abs(value) < 1e6]

    def smallest(point: complex) -> float:
        found = np.linalg.svd(wide_a - point * wide_e, compute_uv=False)
        return float(found[-1] / found[0])

    if smallest(complex(*rng.standard_normal(2))) < ZERO:
        return False, np.zeros(0, dtype=complex)
    drops = np.array([value for value in candidates if smallest(value) < ZERO], dtype=complex)
    unstable = np.abs(drops) >= 1.0 - 1e-6 if plant.dt else drops.real >= -1e-6
    return solvable and not np.any(unstable), drops


def _eigenvalues(phi: np.ndarray) -> list[complex]:
    # Those of a Jordan block stand on its diagonal; computed ones would scatter.
    return list(np.diag(phi)) if not np.any(np.tril(phi, -1)) else list(np.linalg.eigvals(phi))


def _solvable(plant: DescriptorSystem) -> bool:
    """Whether ``U E + D C = I, D Dd = 0, U Bd + X Dd = 0`` has a solution, by least squares; or after elimination.

    Elimination is allowed where the plant is regular of index 1; it is done here by a generalised Schur form.
    """
    if _least_squares(plant.E, plant.C, plant.Bd, plant.Dd):
        return True
    left, values, right = np.linalg.svd(plant.E)
    rank = int(np.sum(values > ZERO * values[0]))
    if rank == plant.nx or rank == 0:
        return False
    a = left.T @ plant.A @ right.T
    corner = a[rank:, rank:]
    singular = np.linalg.svd(corner, compute_uv=False)
    if singular[-1] < ZERO * singular[0]:
        return False
    bd, c = left.T @ plant.Bd, plant.C @ right.T
    solved = -np.linalg.solve(corner, np.hstack([a[rank:, :rank], bd[rank:]]))
    c_new, dd_new = c[:, :rank] + c[:, rank:] @ solved[:, :rank], plant.Dd + c[:, rank:] @ solved[:, rank:]
    bd_new = bd[:rank] + a[:rank, rank:] @ solved[:, rank:]
    return _least_squares(np.diag(values[:rank]), c_new, bd_new, dd_new)


def _least_squares(e: np.ndarray, c: np.ndarray, bd: np.ndarray, dd: np.ndarray) -> bool:
    nx, ny, nd = len(e), len(c), bd.shape[1]
    unknowns = np.block([
        [e, np.zeros((nx, nd)), bd], [c, dd, np.zeros((ny, nd))], [np.zeros((ny, nx + nd)), dd],
    ])  # fmt: skip
    goal = np.hstack([np.eye(nx), np.zeros((nx, 2 * nd))])
    solution = np.linalg.lstsq(unknowns.T, goal.T, rcond=ZERO)[0].T
    return bool(np.max(np.abs(solution @ unknowns - goal)) < 1e-6)
