"""Designs that know their tolerances: what a model's error does counts as noise, where thresholds get smaller by it.

Directions to blame, rows of the plant and constants, are tried as noise, and as unknown inputs where the faults can be
told from them; the smallest mean threshold over a scenario without its faults is shipped, for the plant itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from obsynth.analysis.transformations.uncertain_plant import AffinePlant, affine_plant
from obsynth.errors import ObsynthError, SpecError
from obsynth.experiments.benches import make_bench
from obsynth.experiments.monitors.residual_monitor import monitor
from obsynth.methods.verifying import verify
from obsynth.numerics.arrays import SMALLEST, FloatArray
from obsynth.numerics.ranks import ACTING_TOLERANCE
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import ObserverDesign
from obsynth.simulation.scenario import Scenario
from obsynth.tolerances.exact_plant import told_from_faults
from obsynth.tolerances.robustness import robustness

#: Rows of the plant and constants whose directions are tried, those most to blame.
MOST_ROWS, MOST_CONSTANTS = 3, 2
#: Weights of the best direction that are tried after 1, in sizes of the largest disturbance or noise column.
FINER = (0.03, 0.1, 0.3, 3.0)
#: A design is better where its thresholds are smaller by this share.
CLEARLY = 0.01
#: Samples of the scenario over which thresholds are compared, at most.
MOST_SAMPLES = 500
#: Share of the scenario that passes before thresholds are averaged.
SETTLING_SHARE = 0.2
#: Noise without a stated bound counts as within so many standard deviations.
NOISE_BOUND = 3.0


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A plant to design for: what is added to it, and in words."""

    what: str
    plant: DescriptorSystem
    direction: FloatArray | None = None
    weight: float = 0.0


def with_model_error(
    plant: DescriptorSystem,
    scenario: Scenario | None,
    made: Callable[[DescriptorSystem], ObserverDesign],
    progress: Callable[[str], None],
) -> ObserverDesign:
    """Return the design with the smallest mean threshold over a scenario; ``made`` designs for a plant."""
    if plant.uncertainty is None or not plant.uncertainty.box.names:
        raise SpecError(
            "model_error: columns is for plants whose constants have tolerances: state constants, or leave it out.",
            path="method.options.model_error",
        )
    if scenario is None:
        raise SpecError(
            "model_error: columns compares thresholds over a scenario: give one (scenario).", path="scenario"
        )
    quiet = scenario.replace(faults={}, horizon=min(scenario.horizon, MOST_SAMPLES * plant.dt))
    progress("designing without regard to tolerances")
    first = made(plant)
    begin = mean_thresholds(first, quiet)
    found = robustness(first)
    affine = affine_plant(plant)
    # Noise of the size of the largest disturbance or noise column; of one where there is none.
    columns = np.hstack([plant.Bd, plant.Bw])
    size = float(np.linalg.norm(columns, axis=0).max()) if columns.any() else float(np.sqrt(plant.nx))
    chosen: _Candidate | None = None
    design, score, tried, refined = first, 1.0, 1, False
    todo = [_with_noise(plant, what, at, size) for what, at in _directions(affine, plant, found.rows, found.blame)]
    todo += list(_unknown_inputs(affine, plant, found.blame))
    while todo:
        item = todo.pop(0)
        progress(f"designing with {item.what} ({len(todo)} more)")
        tried += 1
        new = _scored(item, plant, made, quiet, begin)
        if new is not None and new[1] < score * (1.0 - CLEARLY):
            chosen, design, score = item, *new
        if not todo and not refined and chosen is not None and chosen.direction is not None:
            refined = True
            base = chosen.what.partition(", weight")[0]
            todo = [_with_noise(plant, base, chosen.direction, step * chosen.weight) for step in FINER]
    text = (
        "no direction of the model's error makes thresholds smaller"
        if chosen is None
        else (f"{chosen.what}: mean thresholds {_listed(begin)} become {_listed(mean_thresholds(design, quiet))}")
    )
    note = f"model_error: columns: {tried} designs tried over the scenario without its faults; {text}."
    return design.replace(options={**design.options, "model_error": "columns"}, notes=(*design.notes, note))


def mean_thresholds(design: ObserverDesign, scenario: Scenario) -> FloatArray:
    """Return the mean threshold of each fault estimate (or residual, without faults) over a scenario, once settled."""
    plant, observer = design.linear
    noisy = bool(plant.nw and scenario.noise) or bool(scenario.sensor_noise)
    watched = monitor(design, scenario, constants=plant, noise_bound=NOISE_BOUND if noisy else None)
    runs = make_bench(design, scenario).run([scenario.seed])
    total, _ = watched.bounds(runs)  # type: ignore[attr-defined]
    settled = total[:, int(SETTLING_SHARE * total.shape[1]) :].mean(axis=(0, 1))
    return np.asarray(settled[: len(observer.fault_names)] if observer.fault_names else settled)


def _scored(
    item: _Candidate,
    plant: DescriptorSystem,
    made: Callable[[DescriptorSystem], ObserverDesign],
    scenario: Scenario,
    begin: FloatArray,
) -> tuple[ObserverDesign, float] | None:
    """Return the design of the plant itself and its mean threshold against the first; `None` where there is none."""
    try:
        draft = made(item.plant).replace(plant=plant)
        report = verify(draft)
        if not report.passed:
            return None
        design = draft.replace(report=report)
        return design, float(np.mean(mean_thresholds(design, scenario) / begin))
    except ObsynthError:
        return None


def _directions(
    affine: AffinePlant, plant: DescriptorSystem, rows: Mapping[str, float], blamed: Mapping[str, float]
) -> Iterator[tuple[str, FloatArray]]:
    """Yield the directions to blame, unit columns of the plant's equations."""
    chosen = sorted(rows, key=lambda name: -rows[name])[:MOST_ROWS]
    for name in chosen:
        yield f"noise in the equation of {name}", np.eye(plant.nx)[:, [plant.state_names.index(name)]]
    for name, _, columns in _most_blamed(affine, blamed):
        if columns.shape[1] == 1 and np.count_nonzero(columns) > 1:
            yield f"noise where {name} acts", columns
    if len(chosen) > 1:
        columns = np.eye(plant.nx)[:, [plant.state_names.index(name) for name in chosen]]
        yield f"noise in the equations of {', '.join(chosen)}", columns


def _most_blamed(affine: AffinePlant, blamed: Mapping[str, float]) -> Iterator[tuple[str, int, FloatArray]]:
    """Yield name and place of the constants most to blame, and where each acts to first order: unit columns."""
    for name in sorted(filter(blamed.get, affine.box.names), key=lambda name: -blamed[name])[:MOST_CONSTANTS]:
        i = affine.box.names.index(name)
        left, values, _ = np.linalg.svd(np.hstack([affine.A.parts[i], affine.E.parts[i]]))
        yield name, i, left[:, : int(np.sum(values > ACTING_TOLERANCE * max(values[0], SMALLEST)))]


def _with_noise(plant: DescriptorSystem, what: str, columns: FloatArray, weight: float) -> _Candidate:
    extra = plant.replace(
        Bw=np.hstack([plant.Bw, weight * columns]),
        Dw=np.hstack([plant.Dw, np.zeros((plant.ny, columns.shape[1]))]),
        noise_names=None,
    )
    return _Candidate(f"{what}, weight {weight:.3g}", extra, columns, weight)


def _unknown_inputs(affine: AffinePlant, plant: DescriptorSystem, blamed: Mapping[str, float]) -> Iterator[_Candidate]:
    """Yield plants with a constant's direction as an unknown input, where the exact test allows that."""
    told = told_from_faults(plant)
    for name, i, columns in _most_blamed(affine, blamed):
        if told[name].separable and columns.shape[1] == 1 and not affine.C.parts[i].any():
            more = plant.replace(
                Bd=np.hstack([plant.Bd, columns]),
                Dd=np.hstack([plant.Dd, np.zeros((plant.ny, 1))]),
                disturbance_names=(*plant.disturbance_names, f"error of {name}"),
                uncertainty=None,
            )
            yield _Candidate(f"the error of {name} as an unknown input", more)


def _listed(values: FloatArray) -> str:
    return ", ".join(f"{value:.3g}" for value in values)
