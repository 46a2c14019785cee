"""What can be diagnosed on random integer plants, decided exactly and in floating point in other units.

Descriptor plants of 1 to 7 states with sparse entries from -2 to 2, singular E in most, both times, up to three faults,
two unknown inputs and three outputs.  For each fault, free of the unknown inputs alone and of all other faults too: the
verdict, the number of zeros and of those that block an estimate, the derivatives needed, the least order of a residual
and the order of the decoupled plant, by exact reduction; the fault polynomial again by determinants of pencils; and
everything in floating point on the same plant in other units (1e+-4 per signal and equation, time 1e+-3).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from benchmarks.campaigns.frame import Outcome

from obsynth import DescriptorSystem
from obsynth.analysis.diagnosis.exact_fault_columns import ExactDecoupledFault
from obsynth.analysis.diagnosis.fault_columns import DecoupledFault, Removal

CASES = 500
LIMIT = 60.0


def case(seed: int) -> Outcome:
    """Decide one plant three times."""
    rng = np.random.default_rng([18, seed])
    plant = _plant(rng)
    other = _in_other_units(plant, rng)
    verdicts, wrong = [], []
    for fault in range(plant.nf):
        for removed in ((), tuple(j for j in range(plant.nf) if j != fault)):
            exact = ExactDecoupledFault(Removal(plant, removed), fault)
            pencil = ExactDecoupledFault(Removal(plant, removed), fault, reduced=False)
            if exact.polynomial not in (pencil.polynomial, -pencil.polynomial):
                wrong.append(f"{removed}, {fault}: polynomials differ")
            rounded = DecoupledFault(Removal(other, removed), fault)
            facts, found = _facts(exact, exact.order), _facts(rounded, rounded.order)
            if facts != found:
                wrong.append(f"{removed}, {fault}: {facts} exactly, {found} in other units")
        verdicts.append("estimable" if exact.visible and not exact.blocking.size else
                        "as a step" if exact.visible and exact.shows_at(1.0 if plant.dt else 0.0) else
                        "seen" if exact.visible else "hidden")  # fmt: skip
    kind = "sampled" if plant.dt else "continuous"
    return Outcome(kind, ", ".join(sorted(set(verdicts))), "; ".join(wrong))


def _facts(found: Any, order: int) -> tuple[Any, ...]:
    if not found.visible:
        return (False, order)
    return True, len(found.zeros), len(found.blocking), found.derivatives, found.residual_order, order


def _plant(rng: np.random.Generator) -> DescriptorSystem:
    n, ny, nd, nf = (int(rng.integers(low, high)) for low, high in ((1, 8), (1, 4), (0, 3), (1, 4)))

    def sparse(rows: int, columns: int, share: float = 0.5) -> np.ndarray:
        return rng.integers(-2, 3, (rows, columns)) * (rng.random((rows, columns)) < share)

    e = np.diag((rng.random(n) < 0.7).astype(int)) if rng.random() < 0.5 else sparse(n, n)
    return DescriptorSystem(
        e, sparse(n, n), sparse(n, 1), sparse(ny, n), Bf=sparse(n, nf), Df=sparse(ny, nf, 0.2),
        Bd=sparse(n, nd) if nd else None, Dd=sparse(ny, nd, 0.2) if nd else None, dt=float(rng.integers(0, 2)),
    )  # fmt: skip


def _in_other_units(plant: DescriptorSystem, rng: np.random.Generator) -> DescriptorSystem:
    x, e, u, y, f, d = (
        10.0 ** rng.uniform(-4, 4, size=n) for n in (plant.nx, plant.nx, plant.nu, plant.ny, plant.nf, plant.nd)
    )
    time = 1.0 if plant.dt else 10.0 ** rng.uniform(-3, 3)
    return plant.replace(
        E=e[:, None] * plant.E * x * time, A=e[:, None] * plant.A * x, B=e[:, None] * plant.B * u,
        C=y[:, None] * plant.C * x, D=y[:, None] * plant.D * u, Bf=e[:, None] * plant.Bf * f,
        Df=y[:, None] * plant.Df * f, Bd=e[:, None] * plant.Bd * d, Dd=y[:, None] * plant.Dd * d,
    )  # fmt: skip
