"""Tests for plants whose constants have tolerances: with an observer of the state, and weights for a scenario.

What tolerances do is linear in the weights: ``(E(q) - E) x(k+1) - (A(q) - A) x(k) - (B(q) - B) u(k)`` at the samples of
a record, where x is what the observer beside says, less its error, which is bounded.  Each such column counts with its
mean over the record, like a disturbance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from obsynth.methods.guaranteed_test.window_columns import Builder
from obsynth.methods.guaranteed_test.windows import Window
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.window.observer import WindowObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.transformations.moving_disturbances import with_moving_disturbances
from obsynth.plants.transformations.uncertain_plant import AffinePlant, affine_plant
from obsynth.results.design import ObserverDesign
from obsynth.verification.over_tolerances.adaptive_bound import Start, adaptive_bound
from obsynth.verification.over_tolerances.adaptive_recursion import Thresholds, thresholds_of_records
from obsynth.verification.over_tolerances.error_structure import ErrorStructure, Tracking, error_structure

#: Windows of the record that count, at most: evenly spread.
MOST_WINDOWS = 40

#: Share of the record that passes before windows count: the observer beside starts at rest.
SETTLING_SHARE = 0.2

#: What other processors may find for a mean threshold, as a share: directions in which constants act are split
#: otherwise there, and each way is a bound (0.5 % on the drive).
MEAN_ROOM = 2e-2

#: Courses of disturbances that do not change between samples.
HELD_BETWEEN_SAMPLES = ("jump", "held")


@dataclass(frozen=True, eq=False)
class Beside:
    """An observer of the full state that follows ``T E x`` and uses the equations ``T0``, and a record without faults.

    ``T (nz, nx)``, ``T0 (nx, nx)``; ``record (steps, nu + ny)``; of its samples the state as told, and bounds of its
    error ``(steps, nx)``, both in the coordinates of ``affine``.
    """

    observer: LinearObserver
    T: FloatArray
    T0: FloatArray
    affine: AffinePlant
    record: FloatArray
    states: FloatArray
    errors: FloatArray

    def longest(self) -> int:
        """Return the most samples of a window of which the record has some."""
        return int((1.0 - SETTLING_SHARE) * len(self.record)) - 1


def settled(steps: int, length: int) -> tuple[int, int]:
    """Return the first samples of the first and of the last window of a record that count."""
    last = max(steps - length, 0)
    return min(int(SETTLING_SHARE * steps), last), last


def side_by_side(test: LinearObserver, beside: LinearObserver) -> LinearObserver:
    """Return both as one observer: states first, then the row of the test."""
    from scipy.linalg import block_diag

    n = len(beside.state_names)
    apart = np.zeros((n, test.order))
    return replace(
        test,
        Az=block_diag(test.Az, beside.Az),
        Bu=np.vstack([test.Bu, beside.Bu]),
        By=np.vstack([test.By, beside.By]),
        Cz=np.vstack([np.hstack([apart, beside.Cz[:n]]), np.hstack([test.Cz, np.zeros((1, beside.order))])]),
        Du=np.vstack([beside.Du[:n], test.Du]),
        Dy=np.vstack([beside.Dy[:n], test.Dy]),
        state_names=beside.state_names,
        state_delays=beside.state_delays,
        constant=np.concatenate([np.zeros(n), test.added]),
    )


def part_beside(joint: LinearObserver, order: int) -> LinearObserver:
    """Return the observer of the state, of this order, out of what `side_by_side` made."""
    n, first = len(joint.state_names), joint.order - order
    return replace(
        joint,
        Az=joint.Az[first:, first:],
        Bu=joint.Bu[first:],
        By=joint.By[first:],
        Cz=joint.Cz[:n, first:],
        Du=joint.Du[:n],
        Dy=joint.Dy[:n],
        fault_names=(),
        fault_delays=(),
        residual_names=(),
        constant=None,
    )


def noisy_as_bounded(window: Window) -> DescriptorSystem:
    """Return the plant with the noise of a test's bounds: each column of it within one."""
    bounds = window.bounds
    return window.plant.replace(
        Bw=bounds.noise_state * bounds.noise, Dw=bounds.noise_output * bounds.noise, noise_names=None
    )


def with_tolerances(window: Window, beside: Beside) -> Window:
    """Return a window with a bounded column for each thing that tolerances do, in the mean over the record."""
    affine, builder = beside.affine, Builder()
    length = max(window.equations + 1, window.test_problem.samples)
    starts = np.unique(np.linspace(*settled(len(beside.record), length), MOST_WINDOWS).astype(np.int64))
    nu = window.plant.nu
    spans = 1.0 + np.abs(affine.offsets)
    sizes_of_d = affine.disturbance_bounds(window.bounds.disturbance)

    def put(matrices: tuple[FloatArray, FloatArray, FloatArray], k: int, columns: list[float]) -> None:
        """Enter what multiplies ``x(k)`` in E, A and C, a column each, with these bounds."""
        first = builder.columns([("tolerance", k, i) for i in range(len(columns))], columns)
        for matrix, row in zip(matrices, (k - 1, k, k), strict=True):
            output = matrix is matrices[2]
            if 0 <= row < (window.test_problem.samples if output else window.equations):
                place = window.outputs_at + row * window.plant.ny if output else row * window.plant.nx
                builder.put(place, matrix, first)

    # First order: one column for each constant and window.
    for start in starts:
        x = beside.states[start : start + length]
        u = beside.record[start : start + length, :nu]
        for j, span in enumerate(spans):
            into = x[1 : window.equations + 1] @ affine.E.parts[j].T
            into = into - x[: window.equations] @ affine.A.parts[j].T - u[: window.equations] @ affine.B.parts[j].T
            onto_outputs = x[: window.test_problem.samples] @ affine.C.parts[j].T
            onto_outputs = onto_outputs + u[: window.test_problem.samples] @ affine.D.parts[j].T
            column = builder.columns([("tolerance", start, j)], [span / len(starts)])
            builder.put(0, np.concatenate([into.ravel(), onto_outputs.ravel()])[:, None], column)
    # What multiplies the error of the state, and disturbances; remainders.
    known = np.abs(beside.states) + beside.errors
    for k in range(length):
        errors = beside.errors[starts + k].mean(axis=0)
        for j, span in enumerate(spans):
            matrices = affine.E.parts[j], -affine.A.parts[j], affine.C.parts[j]
            put(matrices, k, (span * errors).tolist())
            put((np.zeros((0, 0)), -affine.Bd.parts[j], affine.Dd.parts[j]), k,
                (span * sizes_of_d).tolist())  # fmt: skip
        sizes = known[starts + k].mean(axis=0)
        inputs = np.abs(beside.record[starts + k, :nu]).mean(axis=0)
        into = affine.A.radius @ sizes + affine.B.radius @ inputs + affine.Bd.radius @ sizes_of_d
        later = known[np.minimum(starts + k + 1, len(known) - 1)].mean(axis=0)
        onto_outputs = affine.C.radius @ sizes + affine.D.radius @ inputs + affine.Dd.radius @ sizes_of_d
        put((np.zeros((0, 0)), np.eye(window.plant.nx), np.zeros((0, 0))), k, (into + affine.E.radius @ later).tolist())
        put((np.zeros((0, 0)), np.zeros((0, 0)), np.eye(window.plant.ny)), k, onto_outputs.tolist())
    return window.with_columns(builder)


def rows_before(design: ObserverDesign) -> int:
    """Return how many rows of a record come before the first verdict of a test: the registers of its window."""
    if isinstance(design.observer, WindowObserver):
        return design.observer.samples
    return design.linear[1].order - len(design.certificate.matrices.get("state_tracking", ()))


def tracked(window: Window, multipliers: FloatArray, T: FloatArray, T0: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return T ``(nz, nx)`` and T0 ``(nx + 1, nx)`` of a test and the observer beside it."""
    registers, row = window.followed(multipliers)
    return np.vstack([registers, T]), np.vstack([T0, row])


def over_the_box(plant: DescriptorSystem, disturbance: str) -> AffinePlant:
    """Return a plant over its box, with disturbances that move between samples unless they are held there."""
    affine = affine_plant(plant)
    return affine if disturbance in HELD_BETWEEN_SAMPLES else with_moving_disturbances(affine)


def mean_over_record(
    window: Window, observer: LinearObserver, multipliers: FloatArray, T: FloatArray, T0: FloatArray, record: FloatArray
) -> float:
    """Return the mean threshold over the tolerances on a record ``(steps, nu + ny)``, once the window is full."""
    thresholds = thresholds_over_tolerances(
        over_the_box(noisy_as_bounded(window), window.test_problem.disturbance),
        observer,
        tracked(window, multipliers, T, T0),
        window.bounds.disturbance,
        record,
    )
    begin, end = settled(len(record), observer.order - len(T) + 1)
    return float(thresholds[len(record) - 1 - (end - begin) :, -1].mean())


def thresholds_over_record(
    structure: ErrorStructure, observer: LinearObserver, record: FloatArray, *, varying: bool
) -> tuple[Thresholds, FloatArray]:
    """Return thresholds on a record ``(steps, nu + ny)`` and what the observer says, as the error system reads it."""
    nu = len(observer.input_names)
    u, y = record[:, :nu], record[:, nu:]
    estimates = observer.run(y, u)
    rows = np.hstack([estimates.states, estimates.faults, estimates.residuals])
    states = rows @ structure.reading.T
    bound = adaptive_bound(structure, observer, Start(observer.order), varying=varying)
    return thresholds_of_records(bound, states[None], u[None], y[None]), states


def thresholds_over_tolerances(
    affine: AffinePlant,
    observer: LinearObserver,
    tracking: tuple[FloatArray, FloatArray],
    bounds: FloatArray,
    record: FloatArray,
) -> FloatArray:
    """Return thresholds ``(steps, rows)`` on a record ``(steps, nu + ny)``; noise columns of the plant within one."""
    structure = error_structure(observer, affine, Tracking(*tracking), affine.disturbance_bounds(bounds), 1.0)
    thresholds, _ = thresholds_over_record(structure, observer, record, varying=affine.box.variation == "varying")
    return np.asarray(thresholds.total[0])
