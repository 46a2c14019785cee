"""Campaign: wrong designs, wrong refusals and unclear answers on rational plants whose truth is known.

    python benchmarks/campaigns/existence.py [--count 3000] [--first 0] [--method NAME ...]

A wrong design is one for a plant that has none, or one whose estimates of constant faults do not settle at the faults
(in rational numbers, from the plant as drawn).  A wrong refusal says that none exists where one does.
"""

from __future__ import annotations

import argparse
import warnings
from collections import Counter
from dataclasses import dataclass

import numpy as np
from flint import fmpq, fmpq_mat
from rational_plants import Drawn, draw

import obsynth as ob

METHODS = {
    "fault-estimation-filter": ob.fault_estimation_filter,
    "pd-observer": ob.pd_observer,
    "ui-pi-observer": ob.ui_pi_observer,
}
#: Relative error of a settled estimate above which a design is wrong.
TOLERANCE = 1e-6


@dataclass(frozen=True)
class Outcome:
    """What became of one plant: 'right', or what is wrong; and the words."""

    verdict: str
    said: str


def outcome(method: str, drawn: Drawn) -> Outcome:
    """Design for a drawn plant and judge the answer."""
    g = drawn.given
    plant = ob.DescriptorSystem(g["E"], g["A"], C=g["C"], Bf=g["Bf"], Df=g["Df"], Bd=g["Bd"], Dd=g["Dd"], dt=drawn.dt)
    try:
        if method == "fault-estimation-filter":
            plant = ob.eliminate_algebraic_states(plant).plant
        design = METHODS[method](plant)
    except ob.PreconditionError as error:
        said = str(error)
        if said.startswith("Unclear:"):
            return Outcome("unclear", said)
        return Outcome("wrong refusal" if drawn.exists else "right", f"{error.condition}: {said}")
    except ob.ObsynthError as error:
        return Outcome(f"no design: {type(error).__name__}", str(error))
    if not drawn.exists:
        return Outcome("wrong design", drawn.why)
    error = settling_error(drawn, design.observer)
    right = design.report.passed and error < TOLERANCE
    return Outcome("right" if right else "wrong design", f"settles with an error of {error:.1e}")


def settling_error(drawn: Drawn, observer: ob.LinearObserver) -> float:
    """Return the relative error of the fault estimates once all faults have stayed at their unit, all else at zero."""
    m, units = drawn.matrices, drawn.units
    discrete = drawn.dt > 0
    still = (_exact(m["E"]) if discrete else 0 * _exact(m["E"])) - _exact(m["A"])
    nf = m["Bf"].shape[1]
    if still.det() == 0:
        return 0.0  # no steady state: nothing settles
    faults = _exact(np.ones((nf, 1)))
    y = _exact(m["C"]) * still.solve(_exact(m["Bf"]) * faults) + _exact(m["Df"]) * faults
    y = _exact(np.diag(units["output"])) * y
    rest = _exact(np.eye(observer.order) if discrete else np.zeros((observer.order, observer.order)))
    z = (rest - _exact(observer.Az)).solve(_exact(observer.By) * y)
    found = _exact(observer.Cz) * z + _exact(observer.Dy) * y
    values = np.array([int(v.p) / int(v.q) for v in found.entries()])[observer.fault_rows]
    return float(np.max(np.abs(values * units["fault"] - 1.0)))


def _exact(matrix: np.ndarray) -> fmpq_mat:
    rows, columns = matrix.shape
    return fmpq_mat(rows, columns, [fmpq(*_ratio(value)) for value in matrix.ravel()])


def _ratio(value: object) -> tuple[int, int]:
    return value.as_integer_ratio() if hasattr(value, "as_integer_ratio") else (int(value), 1)


def campaign(method: str, count: int, *, first: int = 0) -> tuple[Counter[str], list[tuple[int, Outcome]]]:
    """Return how often each verdict came for so many plants, and all that were not right."""
    found: Counter[str] = Counter()
    others: list[tuple[int, Outcome]] = []
    seed = first
    while found.total() < count:
        drawn = draw(method, seed)
        if drawn is not None:
            result = outcome(method, drawn)
            kind = (
                f"right: {'designed' if drawn.exists else 'refused'}" if result.verdict == "right" else result.verdict
            )
            found[kind] += 1
            if result.verdict != "right":
                others.append((seed, result))
        seed += 1
    return found, others


def main() -> None:
    """Run the campaign and print its table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=3000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--method", nargs="*", default=list(METHODS))
    asked = parser.parse_args()
    warnings.simplefilter("ignore")
    for method in asked.method:
        found, others = campaign(method, asked.count, first=asked.first)
        print(f"{method}: {found.total()} plants")
        for kind, number in sorted(found.items()):
            print(f"   {kind}: {number}")
        for seed, result in others[:40]:
            print(f"      seed {seed}: {result.verdict}: {result.said[:300]}")


if __name__ == "__main__":
    main()
