"""What of unknown inputs and other faults reaches the estimates, measured on the plant itself, without T and T0."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from obsynth.analysis.plant_units import PlantUnits
from obsynth.methods.ui_pi_observer.checks.decoupling import UNMOVED, frequency_grid, trajectories_at
from obsynth.numerics.arrays import ComplexArray
from obsynth.numerics.scaling import balancing_factors
from obsynth.numerics.spectra import boundary_points
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.checks import Check, upper_bound_check
from obsynth.results.design import ObserverDesign

#: Estimates at a frequency may miss by this much, relative to terms that pass through the inverse of ``sI - Az``.
LEAK_TOLERANCE = 1e-7


def leak_rows(design: ObserverDesign) -> Iterator[Check]:
    """Yield the measured leaks: of d into everything, of other faults into each estimate or set of residuals."""
    plant, observer = design.linear
    if plant.nd:
        yield _row("unknown inputs", "the unknown inputs reach neither estimates nor residuals", plant, observer)
    for name, rows, blind in _blind_to(design):
        if not blind:
            continue
        columns = [plant.fault_names.index(fault) for fault in blind]
        other = plant.replace(
            Bd=np.hstack([plant.Bd, plant.Bf[:, columns]]), Dd=np.hstack([plant.Dd, plant.Df[:, columns]]),
            disturbance_names=[*plant.disturbance_names, *(f"fault {fault}" for fault in blind)],
        )  # fmt: skip
        claim = f"neither unknown inputs nor {', '.join(blind)} reach it, whatever their course"
        yield _row(f"free of others: {name}", claim, other, _only(observer, rows))


def _row(name: str, claim: str, plant: DescriptorSystem, observer: LinearObserver) -> Check:
    relative, frequency = measured_leak(plant, observer)
    return upper_bound_check(
        name, claim, relative, LEAK_TOLERANCE, source="measured on the plant, without T and T0",
        detail=f"relative to the terms; worst at {frequency:.3g} rad/s",
    )  # fmt: skip


def measured_leak(plant: DescriptorSystem, observer: LinearObserver) -> tuple[float, float]:
    """Return the largest output of any row on trajectories ``(x, d) e^{st}``, relative to its terms, and where."""
    frequencies = frequency_grid(observer)
    units = PlantUnits.of(plant).rounded()
    scaled = units.scaled_plant(plant)
    points = boundary_points(frequencies * (1.0 if units.discrete else units.time), scaled.dt)
    moved = [trajectories_at(np.hstack([point * scaled.E - scaled.A, -scaled.Bd])) for point in points]
    # How many trajectories there are at almost every frequency: where there seem to be more, rounding hides the rest.
    count = min(nullity for _, nullity in moved)
    if count == 0:
        return 0.0, 0.0
    az, by, dy = units.rate * observer.Az, units.rate * observer.By / units.outputs, observer.Dy / units.outputs
    order = len(az)
    system = np.block([[az, by], [observer.Cz, dy]])
    padded = np.zeros((max(system.shape),) * 2)
    padded[: system.shape[0], : system.shape[1]] = system
    states = balancing_factors(padded)[:order]
    az, by, cz = az * states / states[:, None], by / states[:, None], observer.Cz * states
    worst, where = 0.0, 0.0
    for frequency, point, (basis, _) in zip(frequencies, points, moved, strict=True):
        x, d = basis[: plant.nx, -count:], basis[plant.nx :, -count:]
        resolvent = _inverse(point * np.eye(order) - az)
        if resolvent is None:
            return float("inf"), float(frequency)
        y = scaled.C @ x + scaled.Dd @ d
        error = np.max(np.abs(cz @ (resolvent @ (by @ y)) + dy @ y), axis=1)
        passed = np.abs(cz) @ (np.abs(resolvent) @ np.abs(by)) + np.abs(dy)
        size = np.max(passed @ (np.abs(scaled.C) @ np.abs(x) + np.abs(scaled.Dd) @ np.abs(d)), axis=1)
        possible = passed @ (np.sum(np.abs(scaled.C), axis=1) + np.sum(np.abs(scaled.Dd), axis=1))
        terms = np.maximum(size, UNMOVED * possible)
        relative = float(np.max(error / np.where(terms > 0.0, terms, 1.0), initial=0.0))
        if not relative <= worst:
            worst, where = relative, float(frequency)
    return worst, where


def _inverse(matrix: ComplexArray) -> ComplexArray | None:
    try:
        return np.asarray(np.linalg.inv(matrix))
    except np.linalg.LinAlgError:
        return None


def _blind_to(design: ObserverDesign) -> Iterator[tuple[str, list[int], list[str]]]:
    """Yield, for groups of rows, their name, the rows and the faults that must not reach them."""
    plant, observer = design.linear
    options = design.options
    if options.get("residuals") is None:
        others = [name for name in plant.fault_names if name not in observer.fault_names]
        for row, name in enumerate(observer.fault_names):
            beside = [] if options.get("joint") else [other for other in observer.fault_names if other != name]
            yield name, [row], [*others, *beside]
        return
    sets = _sets(options["residuals"], plant)
    for seen in sets:
        label = f"{' '.join(seen)}: "
        rows = [row for row, name in enumerate(observer.residual_names) if len(sets) == 1 or name.startswith(label)]
        yield label.rstrip(": "), rows, [name for name in plant.fault_names if name not in seen]


def _sets(residuals: object, plant: DescriptorSystem) -> list[list[str]]:
    if residuals == "detect":
        return [list(plant.fault_names)]
    if residuals == "isolate":
        return [[name] for name in plant.fault_names]
    given = [residuals] if isinstance(residuals, str) else list(residuals)  # type: ignore[call-overload]
    return [[entry] if isinstance(entry, str) else [n for n in plant.fault_names if n in entry] for entry in given]


def _only(observer: LinearObserver, rows: list[int]) -> LinearObserver:
    """Return the observer with some of its rows, as residuals: a fault estimate that must vanish is one."""
    return replace(
        observer, Cz=observer.Cz[rows], Du=observer.Du[rows], Dy=observer.Dy[rows], fault_names=(), fault_delays=(),
        residual_names=tuple(f"row {row + 1}" for row in rows),
    )  # fmt: skip
