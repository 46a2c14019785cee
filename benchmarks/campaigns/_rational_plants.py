"""Random rational plants for the campaign on existence, and whether an observer exists: by brute force over all minors.

The truth shares no code with the package: greatest common divisors of all full minors of the integer pencil as drawn,
Routh and Schur-Cohn tests in fractions.  What the package is given is that plant in other integer coordinates and units
(powers of two), with its algebraic states eliminated and sampled or not.
"""

from __future__ import annotations

import random
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import combinations, count

import numpy as np
from flint import fmpq, fmpq_mat, fmpq_poly

#: Exponents of the powers of two that signals and equations are multiplied by.
UNITS = 13
#: Methods for plants whose faults are parameters, and which have no unknown inputs.
RECURSIVE = ("descriptor-kalman", "adaptive-observer")
#: Share of the plants in discrete time that are sampled by the package.
SAMPLED = 0.3


@dataclass(frozen=True)
class Drawn:
    """A plant in rational numbers, its truth, and the same plant as the package is given it.

    ``exists`` is ``None`` where nothing is known; with ``step`` the plant is given in continuous time, with algebraic
    states, to be sampled so many seconds apart.
    """

    matrices: dict[str, np.ndarray]
    dt: float
    exists: bool | None
    why: str
    given: dict[str, np.ndarray]
    units: dict[str, np.ndarray] = field(repr=False)
    step: Fraction | None = None


def drawn_plant(method: str, seed: int) -> Drawn:
    """Return the plant of a seed: the first draw that is of the kind that the method takes."""
    return next(found for attempt in count() if (found := _draw(method, f"{seed} {attempt}")) is not None)


def _draw(method: str, seed: str) -> Drawn | None:
    rng = random.Random(f"{method} {seed}")
    matrices = _base(rng, method)
    sampled = ("fault-estimation-filter", *RECURSIVE)
    dt = 0.0 if method == "pd-observer" else 1.0 if method in sampled else rng.choice([0.0, 1.0])
    step = Fraction(1, rng.choice([1, 2])) if dt and rng.random() < SAMPLED else None
    _plant_obstacle(rng, matrices, 0.0 if step else dt)
    true = matrices
    if step:
        _without_poles_but_zero(rng, matrices)
        reduced = _eliminated(matrices)
        if reduced is None:
            return None
        true = _sampled(reduced, step)
    truth = {
        "pd-observer": _pd_truth, "fault-estimation-filter": _filter_truth, "ui-pi-observer": _ui_pi_truth,
        "functional-filter": _functional_truth, "descriptor-kalman": _kalman_truth,
        "adaptive-observer": _adaptive_truth,
    }  # fmt: skip
    verdict = truth[method](true, dt)
    if verdict is None:
        return None
    exists, why = verdict
    given, units = _other_words(rng, matrices)
    return Drawn(true, dt, exists, why, given, units, step)


def _base(rng: random.Random, method: str) -> dict[str, np.ndarray]:
    dynamic, algebraic = rng.choice([2, 3, 3]), rng.choice([0, 0, 1, 2])
    nx, ny, nf = dynamic + algebraic, rng.choice([1, 2, 2]), 1
    nd = rng.choice([0, 1]) if method not in ("pd-observer", *RECURSIVE) and ny == 2 else 0
    if method == "fault-estimation-filter" and ny == 2:
        nf = rng.choice([1, 1, 2])

    def integers(rows: int, columns: int, size: int) -> np.ndarray:
        return np.array([[rng.randint(-size, size) for _ in range(columns)] for _ in range(rows)]).reshape(
            rows, columns
        )

    matrices = {
        "E": np.diag([1] * dynamic + [0] * algebraic), "A": integers(nx, nx, 2), "C": integers(ny, nx, 2),
        "Bf": integers(nx, nf, 2), "Df": np.zeros((ny, nf), int), "Bd": integers(nx, nd, 2),
        "Dd": np.zeros((ny, nd), int),
    }  # fmt: skip
    if rng.random() < 0.2:
        matrices["Df"] = integers(ny, nf, 1)
    return {name: matrix.astype(object) for name, matrix in matrices.items()}


def _plant_obstacle(rng: random.Random, m: dict[str, np.ndarray], dt: float) -> None:
    """Hide a mode, or mask a fault, or leave the plant as it is; modes are slowed for sampled plants."""
    nx, kind = len(m["A"]), rng.choice(["none", "none", "mode", "weak", "masked", "algebraic"])
    if dt:
        m["A"] = np.array([[Fraction(int(value), 4) for value in row] for row in m["A"]], dtype=object)
    if kind in ("mode", "weak"):
        # The first state is in no output, or hardly, and no other equation sees it but by its own pace.
        pace = rng.choice([Fraction(-1), Fraction(-1, 2), Fraction(1, 2), Fraction(1), Fraction(0), Fraction(5, 4)])
        m["C"][:, 0] = 0
        m["A"][1:, 0] = 0
        m["A"][0, 0] = pace
        if kind == "weak":
            m["C"][rng.randrange(len(m["C"])), 0] = Fraction(1, 2 ** rng.choice([8, 14, 20]))
    elif kind == "masked":
        # x = v f, constant, solves the plant with y = 0 (continuous: A v + Bf = 0; sampled: A v + Bf = E v).
        hidden = [v for v in _small_vectors(nx) if not any(m["C"] @ v) and any(v)]
        if hidden:
            v = rng.choice(hidden)
            m["Bf"][:, 0] = (m["E"] @ v if dt else 0 * v) - m["A"] @ v
            m["Df"][:, 0] = 0
    elif kind == "algebraic" and not any(m["E"][:, -1]):
        # Only the sum of the last state and the fault enters, and no output sees that state.
        m["C"][:, -1] = 0
        m["Df"][:, 0] = 0
        m["Bf"][:, 0] = m["A"][:, -1]


def _without_poles_but_zero(rng: random.Random, m: dict[str, np.ndarray]) -> None:
    """Make the dynamics nilpotent, whose exponential is rational: integrators, and algebraic states on one side."""
    nx, n = len(m["A"]), int(sum(m["E"].diagonal()))
    for i in range(n):
        m["A"][i, : i + 1] = 0
    if rng.random() < 0.5:
        m["A"][:n, n:] = 0
    else:
        m["A"][n:nx, :n] = 0


def _sampled(m: dict[str, np.ndarray], step: Fraction) -> dict[str, np.ndarray]:
    """Return a plant with ``E = I`` and nilpotent A under inputs that are held: the series ends."""
    n = len(m["A"])
    power, moved, driven = np.eye(n, dtype=int).astype(object), m["A"] * 0, m["A"] * 0
    for k in range(n + 1):
        moved, driven = moved + power, driven + power * step / (k + 1)
        power = power @ m["A"] * step / (k + 1)
    return {**m, "A": moved, "Bf": driven @ m["Bf"], "Bd": driven @ m["Bd"]}


def _small_vectors(n: int) -> list[np.ndarray]:
    found = [np.zeros(n, dtype=object)]
    for i in range(n):
        found = [np.array([*v[:i], k, *v[i + 1 :]], dtype=object) for v in found for k in (-1, 0, 1)]
    return found


def _other_words(rng: random.Random, m: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return the plant in other integer coordinates and in units that are powers of two, as doubles."""
    nx = len(m["A"])
    rows, states = np.eye(nx, dtype=int).astype(object), np.eye(nx, dtype=int).astype(object)
    for matrix in (rows, states):
        for _ in range(rng.choice([0, 2, 4])):
            i, j = rng.sample(range(nx), 2)
            matrix[i] = matrix[i] + rng.choice([-1, 1]) * matrix[j]
    size = rng.choice([0, UNITS])
    counts = {"row": nx, "state": nx, "output": len(m["C"]), "fault": m["Bf"].shape[1], "disturbance": m["Bd"].shape[1]}
    powers = {name: np.array([float(2.0 ** rng.randint(-size, size)) for _ in range(n)]) for name, n in counts.items()}
    sides = {
        "E": ("row", "state"), "A": ("row", "state"), "C": ("output", "state"), "Bf": ("row", "fault"),
        "Df": ("output", "fault"), "Bd": ("row", "disturbance"), "Dd": ("output", "disturbance"),
    }  # fmt: skip
    given = {}
    for name, (left, right) in sides.items():
        mixed = m[name]
        mixed = rows @ mixed if left == "row" else mixed
        mixed = mixed @ states if right == "state" else mixed
        given[name] = powers[left][:, None] * mixed.astype(float) * powers[right]
    return given, powers


def _matrix(entries: np.ndarray) -> fmpq_mat:
    rows, columns = entries.shape
    return fmpq_mat(rows, columns, [fmpq(Fraction(v).numerator, Fraction(v).denominator) for v in entries.ravel()])


def _rank(*parts: list[np.ndarray]) -> int:
    return int(_matrix(np.block([list(row) for row in parts])).rank())


def _pencil(m: dict[str, np.ndarray], inputs: np.ndarray, direct: np.ndarray) -> list[list[fmpq_poly]]:
    """Return ``[A - s E, inputs; C, direct]`` as polynomials."""
    nx, ny = len(m["A"]), len(m["C"])
    constant = np.block([[m["A"], inputs], [m["C"], direct]])
    slope = np.zeros_like(constant)
    slope[:nx, :nx] = m["E"]

    def entry(value: object, rate: object) -> fmpq_poly:
        pair = [Fraction(value), -Fraction(rate)]
        return fmpq_poly([fmpq(part.numerator, part.denominator) for part in pair])

    return [[entry(constant[i, j], slope[i, j]) for j in range(constant.shape[1])] for i in range(nx + ny)]


def _determinant(rows: list[list[fmpq_poly]]) -> fmpq_poly:
    """Return a determinant by expansion along the first row."""
    if not rows:
        return fmpq_poly([1])
    total = fmpq_poly([0])
    for j, value in enumerate(rows[0]):
        if value != 0:
            rest = [row[:j] + row[j + 1 :] for row in rows[1:]]
            total = total + (-1) ** j * value * _determinant(rest)
    return total


def divisor(pencil: list[list[fmpq_poly]]) -> fmpq_poly:
    """Return the greatest common divisor of all full minors: zero where the normal rank is not that of the columns."""
    width, found = len(pencil[0]), fmpq_poly([0])
    for chosen in combinations(pencil, width):
        found = found.gcd(_determinant(list(chosen)))
    return found


def is_stable(polynomial: fmpq_poly, discrete: bool) -> bool:
    """Whether all roots are strictly stable: Schur-Cohn, by way of the disk for the half plane, in fractions."""
    p = [Fraction(int(c.p), int(c.q)) for c in polynomial.coeffs()]
    if not discrete:
        # s = (z + 1) / (z - 1) maps the left half plane to the disk; a root at infinity in z is one at s = 1.
        degree, total = len(p) - 1, [Fraction(0)] * len(p)
        for k, c in enumerate(p):
            term = [Fraction(1)]
            for factor in [[1, 1]] * k + [[-1, 1]] * (degree - k):
                term = [
                    (term[i] if i < len(term) else 0) * factor[0] + (term[i - 1] * factor[1] if i else 0)
                    for i in range(len(term) + 1)
                ]
            total = [a + c * b for a, b in zip(total, term, strict=True)]
        if total[-1] == 0:
            return False
        p = total
    while len(p) > 1:
        if abs(p[0]) >= abs(p[-1]):
            return False
        p = [p[-1] * p[i] - p[0] * p[-1 - i] for i in range(1, len(p))]
    return True


def _eliminated(m: dict[str, np.ndarray]) -> dict[str, np.ndarray] | None:
    """Return the plant without its last states, which are algebraic; ``None`` unless it has index 0 or 1."""
    nx, n = len(m["A"]), int(sum(m["E"].diagonal()))
    if n == nx:
        return m
    inner = _matrix(m["A"][n:, n:])
    if inner.det() == 0:
        return None

    def solved(right: np.ndarray) -> np.ndarray:
        if not right.shape[1]:
            return right
        found = inner.solve(_matrix(right))
        return np.array([[Fraction(int(v.p), int(v.q)) for v in row] for row in found.tolist()], dtype=object)

    states, f, d = solved(m["A"][n:, :n]), solved(m["Bf"][n:]), solved(m["Bd"][n:])
    up, shown = m["A"][:n, n:], m["C"][:, n:]
    return {
        "E": np.eye(n, dtype=int).astype(object), "A": m["A"][:n, :n] - up @ states, "Bf": m["Bf"][:n] - up @ f,
        "Bd": m["Bd"][:n] - up @ d, "C": m["C"][:, :n] - shown @ states, "Df": m["Df"] - shown @ f,
        "Dd": m["Dd"] - shown @ d,
    }  # fmt: skip


def _nothing(m: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    return np.zeros((len(m["A"]), 0), object), np.zeros((len(m["C"]), 0), object)


def _pd_truth(m: dict[str, np.ndarray], dt: float) -> tuple[bool, str] | None:
    reduced = _eliminated(m)
    if reduced is None:
        return None
    if not is_stable(divisor(_pencil(reduced, *_nothing(reduced))), discrete=False):
        return False, "a mode that does not decay is hidden"
    n = len(reduced["A"]) + reduced["Bf"].shape[1]
    full = _rank([reduced["A"], reduced["Bf"]], [reduced["C"], reduced["Df"]]) == n
    return full, "exists" if full else "a constant fault is hidden"


def _kalman_truth(m: dict[str, np.ndarray], dt: float) -> tuple[bool, str]:
    if _rank([m["E"]], [m["C"]]) < len(m["A"]):
        return False, "a state is neither dynamic nor measured"
    zeros = divisor(_pencil(m, *_nothing(m)))
    stable = zeros != 0 and is_stable(zeros, discrete=True)
    return stable, "exists" if stable else "a mode that does not decay is hidden"


def _adaptive_truth(m: dict[str, np.ndarray], dt: float) -> tuple[bool, str]:
    found = _kalman_truth(m, dt)
    if not found[0]:
        return found
    full = _rank([m["A"] - m["E"], m["Bf"]], [m["C"], m["Df"]]) == len(m["A"]) + m["Bf"].shape[1]
    return full, "exists" if full else "a parameter leaves no trace"


def _filter_truth(m: dict[str, np.ndarray], dt: float) -> tuple[bool, str] | None:
    reduced = _eliminated(m)
    if reduced is None or reduced["Df"].any() or _rank([reduced["C"]]) < len(reduced["C"]):
        return None
    if reduced["Bf"].shape[1] > len(reduced["C"]):
        return None
    zeros = divisor(_pencil(reduced, reduced["Bf"], reduced["Df"]))
    if zeros == 0:
        return False, "faults never show"
    columns = []
    for j in range(reduced["Bf"].shape[1]):
        vector = reduced["Bf"][:, j]
        while not any(reduced["C"] @ vector):
            vector = reduced["A"] @ vector
        columns.append(reduced["C"] @ vector)
    if _rank([np.column_stack(columns)]) < len(columns):
        return False, "rank Upsilon"
    stable = is_stable(zeros, discrete=True)
    return stable, "exists" if stable else "a zero outside the unit circle"


def _ui_pi_truth(m: dict[str, np.ndarray], dt: float) -> tuple[bool | None, str] | None:
    if not _decoupled(m):
        reduced = _eliminated(m)
        if reduced is None:
            # What is not decoupled may be a state that no other equation needs; estimates that are found are judged.
            return None, "the algebraic states cannot be eliminated"
        if not _decoupled(reduced):
            return False, "the unknown input cannot be decoupled"
        m = reduced
    nd, n = m["Bd"].shape[1], len(m["A"])
    if nd and _rank([m["Bd"]], [m["Dd"]]) < nd:
        return None
    zeros = divisor(_pencil(m, m["Bd"], m["Dd"]))
    if zeros == 0 or not is_stable(zeros, discrete=dt > 0):
        return False, "a mode that does not decay is hidden"
    still = m["A"] - m["E"] if dt else m["A"]
    full = _rank([still, m["Bf"], m["Bd"]], [m["C"], m["Df"], m["Dd"]]) == n + m["Bf"].shape[1] + nd
    return full, "exists" if full else "a constant fault is hidden"


def _decoupled(m: dict[str, np.ndarray]) -> bool:
    nx, ny, nd = len(m["A"]), len(m["C"]), m["Bd"].shape[1]
    whole = _rank(
        [m["E"], np.zeros((nx, nd), object), m["Bd"]], [m["C"], m["Dd"], np.zeros((ny, nd), object)],
        [np.zeros((ny, nx + nd), object), m["Dd"]],
    )  # fmt: skip
    direct = _rank([m["Dd"]]) if nd else 0
    return whole == nx + direct + (_rank([m["Bd"]], [m["Dd"]]) if nd else 0)


def _functional_truth(m: dict[str, np.ndarray], dt: float) -> tuple[bool | None, str] | None:
    """Return what is known: an observer of the whole state is one, and no filter sees a constant that nothing shows."""
    if m["Bf"].shape[1] != 1:
        return None
    still = m["A"] - m["E"] if dt else m["A"]
    known = [still, m["Bd"]], [m["C"], m["Dd"]]
    if _rank(*known) == _rank([*known[0], m["Bf"]], [*known[1], m["Df"]]):
        return False, "a constant fault is hidden"
    whole = _ui_pi_truth(m, dt)
    return (True, "exists") if whole is not None and whole[0] else (None, "not known")
