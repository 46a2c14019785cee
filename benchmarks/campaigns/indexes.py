"""Plants of index 0 to 4 in scrambled coordinates, against their minimal forms, which are known by construction.

``E x' = A x + B u + Bf f`` is made from ``z' = a z + b q`` and a nilpotent block ``N v' = v + c q`` of size 1 (index 1)
to 4, by mixing equations and unknowns: with whole numbers ("written", solved in rational arithmetic), or with random
numbers ("computed", in floating point).  Inputs and faults also enter constraints in half of them, where an output that
is shown by them gets a feedthrough.  The index is found; ``eliminate_algebraic_states`` has the transfer functions of
the minimal form at three points to 1e-6; `check` has the same verdict for each method of linear plants on both; and a
functional filter with poles that decay at the same rate has the same order, decay and response to the fault.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from benchmarks.campaigns.frame import Outcome

import obsynth

CASES = 1000
LIMIT = 60.0
SAME = 1e-6
#: No eigenvalue of a matrix of quarters: a mode at the rate itself is of no certain side.
DECAY = 0.5171
POINTS = (0.7, 1.0 + 2.0j, -0.3 + 5.0j)
#: Those whose conditions are about the plant's signals alone, in continuous time.
METHODS = ("ui-pi-observer", "pd-observer", "functional-filter")


def case(seed: int) -> Outcome:
    """Compare a plant with its minimal form."""
    rng = np.random.default_rng([48, seed])
    index, constrained, computed = seed % 5, bool(seed // 5 % 2), bool(seed // 10 % 2)
    plant, minimal = _plants(rng, index, constrained=constrained, computed=computed)
    group = f"index {index}, {'computed' if computed else 'written'}"
    wrong = []
    if (found := obsynth.analyse_structure(plant).index) != index:
        wrong.append(f"index {found}")
    reduced = obsynth.eliminate_algebraic_states(plant).plant
    if reduced.nx != minimal.nx:
        wrong.append(f"{reduced.nx} states, {minimal.nx} are free")
    wrong += [f"{kind} at {s}" for kind in ("B", "Bf") for s in POINTS if not _agree(reduced, minimal, kind, s)]
    one, other = obsynth.check(plant), obsynth.check(minimal)
    wrong += [
        f"{method}: {one[method].passed}, minimal form {other[method].passed}"
        for method in METHODS
        if one[method].passed != other[method].passed
    ]
    if wrong or not other["functional-filter"].passed:
        return Outcome(group, "no filter exists", "; ".join(wrong))
    wrong += _filters(plant, minimal)
    return Outcome(group, "same verdicts and filter", "; ".join(wrong))


def _filters(plant: obsynth.DescriptorSystem, minimal: obsynth.DescriptorSystem) -> list[str]:
    """Return in what the functional filters of both differ."""
    own, known = (obsynth.functional_filter(item, decay=DECAY) for item in (plant, minimal))
    wrong = [] if own.report.passed else ["not verified"]
    if own.observer.order != known.observer.order:
        wrong.append(f"order {own.observer.order}, {known.observer.order}")
    one, other = (_claims(design) for design in (own, known))
    wrong += [
        f"{name} {one.get(name)}, {value}"
        for name, value in other.items()
        if not np.isclose(one.get(name, np.nan), value, rtol=SAME)
    ]
    return wrong


def _claims(design: obsynth.ObserverDesign) -> dict[str, float]:
    return dict(design.certificate.claims)


def _agree(one: Any, other: Any, kind: str, s: complex) -> bool:
    first, second = (_transfer(plant, kind, s) for plant in (one, other))
    return bool(np.abs(first - second).max(initial=0.0) <= SAME * max(1.0, np.abs(second).max(initial=0.0)))


def _transfer(plant: obsynth.DescriptorSystem, kind: str, s: complex) -> Any:
    direct = {"B": plant.D, "Bf": plant.Df}[kind]
    return plant.C @ np.linalg.solve(s * plant.E - plant.A, getattr(plant, kind)) + direct


def _plants(
    rng: np.random.Generator, index: int, *, constrained: bool, computed: bool
) -> tuple[obsynth.DescriptorSystem, obsynth.DescriptorSystem]:
    """Return a plant of an index, and its minimal form."""
    n, ny = int(rng.integers(2, 5)), 2
    # Quarters are the same in decimals and in binary; whole numbers would often have multiple eigenvalues.
    a = rng.integers(-12, 13, (n, n)) / 4.0 - 4.0 * np.eye(n)
    b, c, into, direct = _whole(rng, n, 2), _whole(rng, ny, n), np.zeros((index, 2)), np.zeros((ny, 2))
    shown = _whole(rng, ny, index)
    if constrained and index:
        # In the first equation of the block, v2' = v1 + c q with v2 = 0: v1 takes q without a derivative.
        into[0] = _whole(rng, 2)
        direct = -shown @ into
    e0, a0 = np.eye(n + index), np.eye(n + index)
    e0[n:, n:], a0[:n, :n] = np.eye(index, k=1), a
    left, right = _mixing(rng, n + index, computed=computed), _mixing(rng, n + index, computed=computed)
    driven = left @ np.vstack([b, into])
    whole = np.hstack([c, shown]) @ right
    plant = obsynth.DescriptorSystem(
        left @ e0 @ right, left @ a0 @ right, driven[:, :1], C=whole, Bf=driven[:, 1:], fault_names=["f"]
    )
    minimal = obsynth.DescriptorSystem(
        None, a, b[:, :1], C=c, D=direct[:, :1], Bf=b[:, 1:], Df=direct[:, 1:], fault_names=["f"]
    )
    return plant, minimal


def _whole(rng: np.random.Generator, *shape: int) -> Any:
    return rng.integers(-3, 4, shape).astype(float)


def _mixing(rng: np.random.Generator, n: int, *, computed: bool) -> Any:
    """Return a regular matrix: of whole numbers, with an inverse of whole numbers; or near an orthogonal one."""
    if computed:
        return np.linalg.qr(rng.standard_normal((n, n)))[0] * rng.uniform(0.5, 2.0, n)
    lower, upper = np.tril(rng.integers(-1, 2, (n, n)), -1), np.triu(rng.integers(-1, 2, (n, n)), 1)
    return (lower + np.eye(n)) @ (upper + np.eye(n))
