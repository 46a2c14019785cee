"""Checks of the errors that rounding of a linear design's stored numbers adds to its estimates.

With stored numbers the identities of an observer hold only to rounding.  The checks bound the errors per unit of
states, known inputs and disturbances, and compare the gain from disturbances (`obsynth.verification.disturbance_gains`)
with the claimed one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from obsynth.numerics.arrays import FloatArray, remembered
from obsynth.observers.linear.modes import poles_of
from obsynth.observers.linear.observer import LinearObserver
from obsynth.proofs.balls import rounded_up
from obsynth.proofs.contraction import proved_contractions
from obsynth.proofs.peak_sums import REMAINDER_OF_SUM
from obsynth.results.checks import Check, information, upper_bound_check
from obsynth.results.design import ObserverDesign
from obsynth.verification.disturbance_gains import (
    MOST_DISTANCE,
    SLOWEST_CLAIMED,
    PlantWithStoredObserver,
    duration_limit,
)
from obsynth.verification.error_system import ByNumbers, ErrorModel, RemainderChannel, contraction_of

#: Claimed bounds are enlarged for the rounding of the contraction on another machine, at most by this share.
MOST_ROOM = 1.0

#: Factor of claimed bounds from balls of double precision: the ball of another machine contains the same number, and so
#: lies within three times the radius of this one.
BOTH_BALLS = 3.0

#: Observers with at most so many states get a separate sum for each bound when claimed bounds are recomputed.
OWN_SUMS_UP_TO = 40

#: Largest rounding errors of stored numbers in an identity, relative to its terms, that no better storage could avoid.
IDENTITY_ROUNDING = 1e-11

#: Without a claimed gain stored numbers matter when a unit disturbance causes an error of this size.
NOTICED = 1e-3

#: Tolerance of the comparison of gains that are computed in double precision.
GAIN_TOLERANCE = 1e-9

_WITNESS_SIGNALS = ("states", "inputs", "disturbances")

_ERROR_WITNESSES = ("state_error", "input_error", "disturbance_error")


@dataclass(frozen=True, eq=False)
class StoredErrors:
    """Upper bounds on the error of each output row, per unit of states, inputs and decoupled disturbances.

    Parameters
    ----------
    channel : RemainderChannel
        How remainders of the identities enter the errors.
    bounds : tuple of FloatArray
        Bounds per unit of states, inputs and disturbances, each ``(rows, signals)``.
    room : FloatArray
        Factors ``(rows, 1)``, one or more, by which claimed bounds exceed these.
    """

    channel: RemainderChannel
    bounds: tuple[FloatArray, ...]
    room: FloatArray

    @classmethod
    def of(cls, model: ErrorModel) -> StoredErrors | None:
        """Return the bounds; ``None`` where no contraction of the observer can be proved."""
        return _bounds_of(model.observer).of(model.numbers, lambda: cls._computed(model))

    @classmethod
    def _computed(cls, model: ErrorModel) -> StoredErrors | None:
        contraction = contraction_of(model.observer)
        if contraction is None:
            return None
        bounds = model.remainder.errors_per_unit(model.observer, contraction)
        if contraction.roundings > MOST_ROOM:
            # Rounding decides which contraction is proved first, so claim the largest bounds over all of them.
            bounds = cls(model.remainder, bounds, np.ones(1))._by_all(model.observer, np.fmax).bounds
        if not all(np.all(np.isfinite(bound)) for bound in bounds):
            return None
        room = np.full((len(model.observer.Cz), 1), 1.0 + min(contraction.roundings, MOST_ROOM))
        # The sums of another machine may end at a later term, and be larger by this remainder.
        room[model.observer.fault_rows] *= 1.0 + REMAINDER_OF_SUM
        return cls(model.remainder, bounds, room if model.is_evaluated_exactly else BOTH_BALLS * room)

    def witnesses(self) -> dict[str, FloatArray]:
        """Return the bounds that a certificate claims, by name: enlarged so that every machine can prove them again.

        Kinds of signals that the plant does not have are left out.
        """
        return {
            name: np.where(bound > 0.0, rounded_up(self.room * bound, 2), 0.0)
            for name, bound in zip(_ERROR_WITNESSES, self.bounds, strict=True)
            if bound.shape[1]
        }

    def least(self, observer: LinearObserver) -> StoredErrors:
        """Return the least bounds over all contractions that can be proved, each of which is a proof."""
        return self._by_all(observer, np.fmin, closely=observer.order <= OWN_SUMS_UP_TO)

    def _by_all(self, observer: LinearObserver, chosen: np.ufunc, *, closely: bool = False) -> StoredErrors:
        """Return the bounds that ``chosen`` (minimum or maximum) selects over all contractions.

        With ``closely`` the first contraction gets a separate sum for each bound.
        """
        bounds = self.bounds
        contractions = proved_contractions(observer.Az, discrete=observer.dt > 0.0, poles=poles_of(observer))
        for i, contraction in enumerate(contractions):
            others = self.channel.errors_per_unit(observer, contraction, closely=closely and not i)
            known = (np.where(np.isfinite(other), other, np.nan) for other in others)
            bounds = tuple(chosen(one, other) for one, other in zip(bounds, known, strict=True))
        return replace(self, bounds=bounds)


@remembered
def _bounds_of(_observer: LinearObserver) -> ByNumbers[StoredErrors | None]:
    return ByNumbers()


def stored_number_rows(design: ObserverDesign, model: ErrorModel, gamma: float | None = None) -> Iterator[Check]:
    """Yield the checks of stored numbers; ``gamma`` is the claimed gain from the disturbances, if any."""
    plant, observer = design.linear
    errors = StoredErrors.of(model)
    claimed = {name: design.certificate.matrices.get(name) for name in _ERROR_WITNESSES}
    if errors is None:
        yield information(
            "stored numbers",
            "what rounding of the stored numbers adds to the errors: no bound was found",
            np.nan,
            source="stored numbers",
            status="assumed",
        )
        if any(value is not None for value in claimed.values()):
            yield upper_bound_check(
                "stored numbers: states", "the claimed bounds are found again", np.nan, 0.0, source="stored numbers"
            )
        return
    pairs = [(bound, claimed[name]) for name, bound in zip(_ERROR_WITNESSES, errors.bounds, strict=True)]
    if any(
        shipped is not None and shipped.shape == bound.shape and np.any(bound > shipped) for bound, shipped in pairs
    ):
        errors = errors.least(observer)
    columns = (model.state_names, plant.input_names, plant.disturbance_names)
    for kind, name, bound, labels in zip(_WITNESS_SIGNALS, _ERROR_WITNESSES, errors.bounds, columns, strict=True):
        if bound.size:
            yield _per_unit(observer, kind, bound, claimed[name], labels)
        elif claimed[name] is not None:
            yield upper_bound_check(
                f"stored numbers: {kind}", "there is something to claim", 1.0, 0.0, source="certificate"
            )
    yield from _gain_rows(design, model, gamma)


def _per_unit(
    observer: LinearObserver, kind: str, bound: FloatArray, claimed: FloatArray | None, labels: tuple[str, ...]
) -> Check:
    """Return the check of the errors per unit of one kind of signal against the claimed bound."""
    outputs = bound[observer.fault_rows] if observer.fault_names else bound
    first = observer.fault_rows.start if observer.fault_names else 0
    i, j = np.unravel_index(int(np.argmax(outputs)), outputs.shape)
    text = f"largest to {observer.row_names[first + int(i)]}: {outputs[i, j]:.2g} per unit of {labels[int(j)]}"
    what = f"error of an estimate per unit of the plant's {kind}, from rounding of the stored numbers"
    name, source = f"stored numbers: {kind}", "the residuals of the identities, outward rounded"
    if claimed is None:
        row = information(name, what, float(outputs[i, j]), source=source, detail=f"{text}; no bound is claimed")
        return Check(**{**row.__dict__, "status": "proved"})
    if claimed.shape != bound.shape or not np.all(np.isfinite(claimed)):
        return upper_bound_check(name, what, np.nan, 0.0, source=source, detail="the claimed bound has another shape")
    allowed = claimed
    # A claimed bound of zero allows no error at all.
    shares = np.where(allowed > 0.0, bound / np.where(allowed > 0.0, allowed, 1.0), np.inf)
    ratios = np.where(bound > allowed, shares, 0.0)
    largest_row, column = divmod(int(np.argmax(ratios)), ratios.shape[1])
    if not ratios[largest_row, column] > 0.0:
        largest_row, column = first + int(i), int(j)
    return upper_bound_check(
        name,
        f"{what}: at most as claimed",
        float(bound[largest_row, column]),
        float(allowed[largest_row, column]),
        source=source,
        kind="proved",
        detail=text,
    )


def _gain_rows(design: ObserverDesign, model: ErrorModel, gamma: float | None) -> Iterator[Check]:
    """Yield the checks of the gain from disturbances to the fault errors of plant and stored observer together."""
    plant, observer = design.linear
    if not plant.nd or not observer.fault_names:
        return
    # The disturbances that a design lets through are no effect of rounding: they count where their gain is claimed or
    # should be zero.
    system = PlantWithStoredObserver(model, of_rounding=gamma is None and not model.decoupled)
    unit = 1.0 if plant.dt > 0.0 else system.fastest
    level = NOTICED if gamma is None else float(gamma) * (1.0 + GAIN_TOLERANCE)
    if gamma is None and system.is_plant_stable:
        # The size of the gain affects no check in this case.
        frequencies = gains = nearest = np.zeros(0)
    else:
        frequencies, gains, nearest = system.swept(unit, level)
    verdict, seconds = duration_limit(system, level, unit, float(np.max(nearest, initial=0.0)))
    if gamma is not None:
        worst = int(np.argmax(gains))
        text = (
            f"gain d -> fault error of the plant and the stored observer, from {SLOWEST_CLAIMED:.0e} rad per sample up"
        )
        detail = f"largest of {len(frequencies)} frequencies at {frequencies[worst]:.2g} rad per sample; {verdict}"
        drifting = np.isfinite(seconds) and np.all(nearest <= MOST_DISTANCE)
        if nearest.size and drifting and model.rounding() <= IDENTITY_ROUNDING:
            # The numbers could not be stored more accurately, and no finite gain exists: report how long it holds.
            yield information(
                "gain with stored numbers",
                f"{text}; above gamma by rounding alone",
                float(gains[worst]),
                source="recomputed, plant included",
                detail=detail,
            )
        else:
            yield upper_bound_check(
                "gain with stored numbers",
                text,
                float(gains[worst]),
                level,
                source="recomputed, plant included",
                detail=detail,
            )
    yield information(
        "stored numbers: horizon",
        "seconds for which a unit disturbance may last before rounding of the stored numbers "
        + ("reaches the claimed gain" if gamma is not None else f"makes an error of {NOTICED:g} of it"),
        seconds,
        source="recomputed, plant included",
        detail=verdict,
    )
