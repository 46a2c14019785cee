"""Checks of the plant: its properties, existence conditions, and a repetition of elimination and sampling."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from types import SimpleNamespace

import numpy as np

from obsynth.analysis.existence.condition import Condition
from obsynth.analysis.zeros import unstable_poles
from obsynth.errors import ObsynthError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.norms import hinf_norm
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.exact_numbers import DECISIVE, ExactNumbers
from obsynth.plants.given_matrices import SIGNAL_NAMES
from obsynth.plants.pencil import structure_of
from obsynth.plants.signal_names import listed
from obsynth.plants.transformations.recovery import StateRecovery
from obsynth.proofs.balls import Ball
from obsynth.proofs.contraction import column_norms
from obsynth.proofs.peak_sums import gathered, interval_pieces, peak_sums
from obsynth.proofs.products import energy
from obsynth.results.checks import Check, information, nothing_wrong, upper_bound_check
from obsynth.results.design import ObserverDesign
from obsynth.results.plant_source import PlantSource
from obsynth.verification.error_system import ErrorModel, contraction_of

#: Imaginary parts below this are not shown.
PRINTED_AS_REAL = 1e-12

#: Eigenvalues that are listed; the others are counted.
MOST_EIGENVALUES = 6

#: Matrices found again may differ by this share of the largest entry of their row or column: another order of
#: sums.
DERIVED_TOLERANCE = 1e-9

PLANT_MATRICES = ("E", "A", "B", "C", "D", "Bf", "Df", "Bd", "Dd")

_STORED_MAPS = ("from_state", "from_input", "from_fault", "from_disturbance")

_SOURCE = "the plant as written, eliminated and sampled again"

_INTERVAL_PARTS = ("midpoint", "radius")

#: Terms that are summed up for a row that only informs: the bound on all that follow holds, and is many times wider for
#: an observer that is slower than that.
STEPS_OF_INFORMATION = 8_192

_OF_HELD_DISTURBANCES = "what the design claims is of disturbances that are held between samples"

#: The middle plant of the family and the plant of the design differ by rounding: this share of their largest entries.
FAMILY_TOLERANCE = 1e-9

STORED_TWICE = "the gain set: what is stored twice is compared"

#: Names of signals that neither elimination nor sampling touches: both plants have the same.
_SHARED_NAMES = tuple(name for name in SIGNAL_NAMES if name not in ("state_names", "noise_names"))


def plant_information(plant: DescriptorSystem) -> Iterator[Check]:
    """Yield rows on regularity, index, eigenvalues and stability of the plant; they inform and never fail."""
    structure = structure_of(plant)
    blocks = structure.infinite_block_sizes
    rows = [
        (
            "regular",
            "det(A - zE) is not identically zero",
            float(structure.regular),
            "yes" if structure.regular else "no",
        )
    ]
    if structure.regular:
        admissible = not unstable_poles(plant) and (structure.index or 0) <= 1
        verdict = "admissible" if admissible else "not admissible: an observer may exist all the same"
        ordered = sorted((complex(value) for value in structure.finite_eigenvalues), key=abs, reverse=True)
        texts = [f"{v.real:.4g}" if abs(v.imag) < PRINTED_AS_REAL else f"{v.real:.4g}{v.imag:+.4g}j" for v in ordered]
        rows += [
            ("index", "index of the pencil (0: E nonsingular)", float(structure.index or 0), ""),
            (
                "finite eigenvalues",
                "number of dynamic modes",
                float(len(structure.finite_eigenvalues)),
                listed(texts, most=MOST_EIGENVALUES),
            ),
            (
                "infinite eigenvalues",
                "number of infinite eigenvalues",
                float(sum(blocks)),
                f"block sizes {list(blocks)}" if blocks else "",
            ),
            ("admissible", "regular, impulse-free and stable", float(admissible), verdict),
        ]
    for name, claim, value, detail in rows:
        yield information(f"plant: {name}", claim, value, source="the plant", detail=detail)


def condition_rows(conditions: Iterable[Condition]) -> Iterator[Check]:
    """Yield one row per existence condition."""
    for condition in conditions:
        yield Check(
            f"exists: {condition.name}",
            condition.claim,
            condition.value,
            condition.bound,
            abs(condition.bound - condition.value),
            condition.holds,
            condition.source,
            "condition",
            f"Unclear: {condition.detail}" if condition.unclear else condition.detail,
            unclear=bool(condition.unclear),
            of_the_method=condition.of_the_method and not condition.holds,
        )


def derivation_rows(design: ObserverDesign, model: ErrorModel) -> Iterator[Check]:
    """Yield the rows on the way from the plant as written to the one that the design is for."""
    plant, observer = design.linear
    source = design.source
    if source is None:
        if design.recovery is not None:
            yield assumed_recovery_row()
        return
    try:
        derived = source.derived
    except ObsynthError as error:
        yield upper_bound_check(
            "plant as written", "it can be eliminated and sampled again", 1.0, 0.0, source=_SOURCE, detail=str(error)
        )
        return
    missed = _numbers_missed(source, derived.plant.exact, plant.exact)
    description = derived.description or "nothing had to be done"
    follows = upper_bound_check(
        "plant as written",
        "the plant of the design follows from it",
        float(np.max([missed, _difference(derived.plant, plant, PLANT_MATRICES)])),
        DERIVED_TOLERANCE,
        source=_SOURCE,
        kind="equality",
        detail="the exact numbers are others" if missed > DERIVED_TOLERANCE else description,
    )
    yield follows
    if not follows.passed:
        return
    if design.recovery is not None:
        yield recovery_as_written_row(derived.recovery, design.recovery)
    if source.sample_time is not None and observer.fault_names:
        yield from _sampling_rows(source.smooth, source.sample_time, plant, observer, model)


def assumed_recovery_row() -> Check:
    """Return the row of a design with a way back to a plant as written that it does not hold."""
    return information(
        "plant as written",
        "elimination, sampling and recovery are those of the plant as written: assumed, as the design does not hold it",
        np.nan,
        source="given by hand",
        status="assumed",
    )


def recovery_as_written_row(derived: StateRecovery, own: StateRecovery) -> Check:
    """Return the row that the states as written are recovered as they are by the steps done again: under their names
    and about their operating point, as they are printed.  States that a step before these has added have no row."""
    wrong = [name for name in own.names if name not in derived.names]
    difference = np.inf
    if not wrong:
        rows = [derived.names.index(name) for name in own.names]
        kept = SimpleNamespace(**{label: getattr(derived, label)[rows] for label in _STORED_MAPS})
        difference = _difference(kept, own, _STORED_MAPS)
        points = [name for name in own.names if own.operating_point.get(name) != derived.operating_point.get(name)]
        wrong = [f"operating point of {name}" for name in points]
    return upper_bound_check(
        "recovery as written",
        "the states as written follow from those of the design as its recovery says",
        np.inf if wrong else difference,
        DERIVED_TOLERANCE,
        source=_SOURCE,
        kind="equality",
        detail=f"not of the plant as written: {', '.join(wrong)}" if wrong else "",
    )


def _numbers_missed(source: PlantSource, known: ExactNumbers | None, own: ExactNumbers | None) -> float:
    """Return how far the exact numbers of a plant are from those found again; infinite for rational ones that differ.

    Those of a plant from which floating point has eliminated states are known to rounding, which is another one on
    another processor."""
    if own is None or (known is not None and known.content == own.content):
        return 0.0
    if known is None or not known.computed or not own.computed or known.sample_time != own.sample_time:
        return np.inf
    eliminated = source.smooth.nx < source.plant.nx
    if source.sample_time is None or not eliminated or source.smooth.exact is not None:
        return np.inf
    return _difference(_doubles(known), _doubles(own), DECISIVE)


def _doubles(numbers: ExactNumbers) -> SimpleNamespace:
    rows = {name: np.array(part, dtype=np.float64) for name, part in numbers.matrices.items()}
    return SimpleNamespace(**{name: part.reshape(len(part), -1) for name, part in rows.items()})


def _difference(first: object, second: object, names: tuple[str, ...]) -> float:
    """Return the largest relative difference between matrices of the same name; infinite for another shape."""
    pairs = [(np.asarray(getattr(first, name)), np.asarray(getattr(second, name))) for name in names]
    return float(np.max([relative_difference(one, other) for one, other in pairs]))


def relative_difference(one: FloatArray, other: FloatArray, radius: FloatArray | float = 0.0) -> float:
    """Return by how much matrices differ beyond a radius, relative to the largest entry of row or column; infinite for
    another shape, NaN where a number is not finite."""
    if one.shape != other.shape:
        return np.inf
    if not one.size:
        return 0.0
    size, missed = np.maximum(np.abs(one), np.abs(other)), np.maximum(np.abs(one - other) - radius, 0.0)
    scale = np.minimum(np.max(size, axis=1, keepdims=True), np.max(size, axis=0, keepdims=True))
    worst = float(np.max(missed / np.where(scale > 0.0, scale, 1.0)))
    return worst if np.isfinite(worst) else np.nan


def _sampling_rows(
    smooth: DescriptorSystem, dt: float, plant: DescriptorSystem, observer: LinearObserver, model: ErrorModel
) -> Iterator[Check]:
    """Yield what the hold between samples means for delays, and the gain over disturbances of any time course."""
    delays = ", ".join(f"{delay}" for delay in observer.fault_delays)
    yield information(
        "sampling: delay",
        "samples by which the fault estimates lag, for faults that are held between samples; of a "
        "fault that moves they show its mean over a sample, half a sample later",
        float(max(observer.fault_delays)),
        source="zero-order hold",
        detail=f"delays {delays}",
    )
    if not plant.nd or smooth.delays:
        return
    t = model.own
    rows = observer.fault_rows
    direct = observer.Dy[rows] @ plant.Dd
    if not plant.Dd.any():
        enclosed = energy(smooth.A, smooth.Bd, dt)
        middle = (enclosed.midpoint + enclosed.midpoint.T) / 2.0
        values, vectors = np.linalg.eigh(middle)
        # The enclosure's radius enters as a larger energy in every direction.
        slack = float(np.linalg.norm(enclosed.radius)) + 4.0 * np.finfo(np.float64).eps * float(np.max(np.abs(values)))
        root = vectors * np.sqrt(np.maximum(values, 0.0) + slack)
        norm = hinf_norm(observer.Az, t @ root, observer.Cz[rows], np.zeros((len(observer.Cz[rows]), plant.nx)))
        yield information(
            "gain over all d(t)",
            "bound on the l2 gain from disturbances of any time course to the fault error, in the norm h sum r^2 "
            f"over the integral of d^2; {_OF_HELD_DISTURBANCES}",
            float(np.sqrt(dt) * norm.upper),
            source="lifted system, from an enclosure of its energy",
            detail=f"largest at {norm.frequency:.4g} rad per sample",
        )
        return
    peak = _peak_gain(smooth, dt, observer, t, direct)
    yield information(
        "gain over all d(t)",
        "bound on the peak gain from disturbances of any time course to a fault error, |d(t)| <= 1 at all times: a "
        f"disturbance reaches a sample at once, so that its l2 gain is infinite; {_OF_HELD_DISTURBANCES}",
        peak,
        source="sums over all samples, outward rounded",
    )


def _peak_gain(
    smooth: DescriptorSystem, dt: float, observer: LinearObserver, t: FloatArray, direct: FloatArray
) -> float:
    """Return the largest fault error for ``|d(t)| <= 1`` at all times; NaN where no contraction is proved.

    ``t``: from errors of the plant's states to those of the observer's; ``direct``: of the disturbances at a sample."""
    contraction = contraction_of(observer)
    if contraction is None:
        return np.nan
    rows = observer.Cz[observer.fault_rows]
    pieces = interval_pieces(smooth.A, smooth.Bd, Ball.exact(-t), dt)
    az = Ball.exact(observer.Az)
    at_samples, count = Ball.exact(observer.By) @ Ball.exact(smooth.Dd), pieces.columns.shape[1]
    both = Ball(
        *(np.hstack([getattr(part, name) for part in (pieces.columns, at_samples)]) for name in _INTERVAL_PARTS)
    )
    _, sums = peak_sums(az, rows, both, contraction, most=STEPS_OF_INFORMATION)
    between, sampled = gathered(pieces, sums[..., :count], smooth.nd), sums[..., count:]
    return float(np.sum(between + sampled + column_norms(Ball.exact(direct))))


def stored_twice_rows(design: ObserverDesign) -> Iterator[Check]:
    """Yield the row on names, units and operating points that plant, observer and plant as written all hold."""
    plant, observer, source = design.plant, design.observer, design.source
    if not isinstance(plant, DescriptorSystem):
        return
    wrong = [
        f"{name} of the observer"
        for name in ("input_names", "output_names")
        if tuple(getattr(observer, name)) != tuple(getattr(plant, name))
    ]
    if source is not None:
        wrong += [f"{name} as written" for name in _SHARED_NAMES if getattr(source.plant, name) != getattr(plant, name)]
        signals = {name for field in _SHARED_NAMES for name in getattr(plant, field)}
        signals |= set(plant.state_names) & set(source.plant.state_names)
        for label in ("units", "scales", "operating_point"):
            one, other = getattr(source.plant, label), getattr(plant, label)
            if any(one.get(name) != other.get(name) for name in signals):
                wrong.append(f"{label} as written")
        if plant.dt != (source.plant.dt if source.sample_time is None else source.sample_time):
            wrong.append("sample time")
        wrong += _wrong_noise(source, plant, design.recovery)
    if source is None and not wrong:
        return
    yield nothing_wrong(
        "stored twice",
        "names, units, operating point, sample time and noise agree wherever they are stored",
        wrong,
        source=STORED_TWICE,
    )


def _wrong_noise(source: PlantSource, plant: DescriptorSystem, recovery: StateRecovery | None) -> list[str]:
    """Return covariances of the noise, in the plant and in the states as written, that do not follow from the plant as
    written: factors are not unique."""
    try:
        derived = source.derived
    except ObsynthError:
        return ["plant as written"]
    made = derived.plant
    if not source.plant.nw:
        return []  # none, or stated for the plant of the design
    if made.nx != plant.nx or made.ny != plant.ny:
        return ["size of the plant as written"]
    one, other = (np.vstack([item.Bw, item.Dw]) for item in (made, plant))
    if recovery is not None and recovery.names == derived.recovery.names and recovery.by_operator is None:
        pairs = ((one, derived.recovery), (other, recovery))
        one, other = (np.vstack([rows, back.from_noise, back.noise_kept]) for rows, back in pairs)
    first, second = one @ one.T, other @ other.T
    if first.shape != second.shape:
        return ["size of the noise as written"]
    size = np.sqrt(np.maximum(np.diag(first), np.diag(second)))
    missed = np.abs(first - second) > FAMILY_TOLERANCE * np.outer(size, size)
    return ["covariance of the noise"] if missed.any() else []
