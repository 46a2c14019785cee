"""Identities between plant and observer, and the residuals of stored numbers in them.

An identity is a sum of terms that vanishes.  Its residual is judged entry by entry against what double precision can
do to the terms, and, for gains that were printed to some decimals, against what that rounding can do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from obsynth.numerics.arrays import FloatArray, remembered
from obsynth.numerics.logarithmic_balance import balance_by_least_squares
from obsynth.numerics.scaling import Scaling
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.checks import Check, upper_bound_check
from obsynth.verification.error_system import ErrorModel, natural_scaling

#: Equalities may miss by this much, relative to the terms they are made of.
EQUALITY_TOLERANCE = 1e-9

#: Sizes of states that follow from what drives them alone are known to within this factor.
STATE_SCALE_FACTOR = 4.0

#: What an observer of the plant's own states has in common with it.
ALIKE = ("input_names", "output_names", "state_names", "fault_names", "dt")

#: Identities whose columns are states.
_OF_STATES = ("dynamics", "state estimate", "fault estimate", "residual")


def are_residual_names(names: Sequence[str], outputs: Sequence[str]) -> bool:
    """Whether residuals have the names of the outputs that they are of, or numbers where they are of combinations."""
    return tuple(names) in (tuple(outputs), tuple(f"r{i + 1}" for i in range(len(names))))


@dataclass(frozen=True, eq=False)
class Residual:
    """Error and scale (size of terms) of an identity at its worst entry, and what rounding of printed gains allows."""

    error: float
    scale: float
    allowance: float = 0.0

    @property
    def relative(self) -> float:
        """The error in units of its terms."""
        return self._in_terms(self.error)

    @property
    def bound(self) -> float:
        """What ``relative`` may be."""
        return EQUALITY_TOLERANCE + self._in_terms(self.allowance)

    @property
    def severity(self) -> float:
        """The error in units of what is allowed."""
        return self.relative / self.bound

    def _in_terms(self, size: float) -> float:
        return size / self.scale if self.scale > 0.0 else size


@dataclass(frozen=True, eq=False)
class Identity:
    """A sum of terms of one shape that must vanish."""

    terms: tuple[FloatArray, ...]
    factors: tuple[tuple[FloatArray, ...], ...] = ()  # products in the terms: what rounding can do
    units: FloatArray | None = None  # of the columns, in which entries of a row compare
    entrywise: bool = False  # each entry judged by its own terms
    rough: float = 1.0  # units are known to within this factor
    also: Identity | None = None  # the same with other units; both must hold

    @property
    def total(self) -> FloatArray:
        """The sum of the terms."""
        return np.asarray(sum(self.terms[1:], start=self.terms[0].copy()))

    def residual(self, allowance: FloatArray | None = None) -> Residual:
        """Return the residual at the entry that is worst beside what is allowed there."""
        total = self.total
        if total.size == 0:
            return Residual(0.0, 1.0)
        size = np.abs(self.terms[0])
        for term in self.terms[1:]:
            size += np.abs(term)
        for product in self.factors:
            bound = np.abs(product[0])
            for factor in product[1:]:
                bound = bound @ np.abs(factor)
            size = size + bound
        # Where the sizes are finite, the sum is.
        if not np.isfinite(size).all() or (allowance is not None and not np.isfinite(allowance).all()):
            return Residual(float("nan"), 1.0)
        scale, missed = self.rough * self._scale(size), np.abs(total)
        allowed = EQUALITY_TOLERANCE * scale if allowance is None else EQUALITY_TOLERANCE * scale + allowance
        worst = divmod(int((missed / allowed).argmax()), total.shape[1])
        more = 0.0 if allowance is None else float(allowance[worst])
        own = Residual(float(missed[worst]), float(scale[worst]), more)
        if self.also is None:
            return own
        return max(own, self.also.residual(allowance), key=lambda item: item.severity)

    def _scale(self, size: FloatArray) -> FloatArray:
        if self.entrywise:
            # Nothing is a sum of nothing but zero itself: the least number makes any miss there a large one.
            return np.where(size > 0.0, size, np.finfo(np.float64).tiny)
        columns = np.ones(size.shape[1]) if self.units is None else self.units
        rows = np.max(size * columns, axis=1, keepdims=True)
        return np.asarray(np.where(rows > 0.0, rows, 1.0) / columns)


def residual(
    *terms: FloatArray, factors: tuple[tuple[FloatArray, ...], ...] = (), units: FloatArray | None = None
) -> Residual:
    """Return the residual of ``terms[0] + terms[1] + ... = 0``; see `Identity`."""
    return Identity(terms, factors, units).residual()


def worst(found: list[Residual]) -> Residual:
    """Return the residual that misses most of what it is allowed; one that is no number outdoes them all."""
    for item in found:
        if np.isnan(item.relative):
            return item
    return max(found, key=lambda item: item.severity)


def relative_tolerance(printed_digits: int | None, products: int) -> float:
    """Return what an equality may miss by, relative to its terms."""
    return EQUALITY_TOLERANCE if printed_digits is None else 0.5 * 10.0 ** (-printed_digits) * products


def equality(name: str, claim: str, found: Residual, source: str, *, bound: float | None = None) -> Check:
    """Return the row of a report for an identity; without a bound of the caller's, the residual knows its own."""
    printed = f"; printed digits allow {found.allowance:.1e}" if found.allowance else ""
    return upper_bound_check(
        name,
        claim,
        found.relative,
        found.bound if bound is None else bound,
        source=source,
        kind="equality",
        detail=f"residual {_size(found.error)} (terms of size {_size(found.scale)}){printed}",
    )


def _size(value: float) -> str:
    """Return a size to two digits; an exact zero is 0."""
    return f"{value:.2g}"


def tracking_identities(model: ErrorModel) -> dict[str, Identity]:
    """Return the identities that make the observer unbiased without faults and disturbances."""
    plain = _tracking_identities(model)
    balanced, others = (_in_units(plain, model, scaling) for scaling in _balances(model.plant))
    return {
        name: identity
        if identity.units is None
        else replace(identity, also=replace(others[name], rough=STATE_SCALE_FACTOR))
        for name, identity in balanced.items()
    }


def tracking_totals(model: ErrorModel) -> dict[str, FloatArray]:
    """Return what is left of the same identities, whatever they are judged by."""
    return {name: identity.total for name, identity in _tracking_identities(model).items()}


@remembered
def _balances(plant: DescriptorSystem) -> tuple[Scaling, Scaling]:
    """Return the sizes of a plant's states without what drives them, and with it."""
    # A state in small units must not hide behind one in large units.
    alone = natural_scaling(plant)
    # States that do not touch each other have sizes beside each other only by what drives both.
    driven = balance_by_least_squares(plant.E, plant.A, inputs=[plant.B, plant.Bf, plant.Bd], outputs=[plant.C])
    return alone, driven


def _tracking_identities(model: ErrorModel) -> dict[str, Identity]:
    """Return the identities without units of the states."""
    plant, observer, tracking = model.plant, model.observer, model.T
    ve = tracking @ model.E
    states, cz, dy, du = observer.state_rows, observer.Cz, observer.Dy, observer.Du
    # An observer state that tracks nothing but a sensor fault cancels what it is formed of down to rounding.
    formed = np.abs(tracking) @ np.abs(model.A) + np.abs(observer.By) @ np.abs(model.C)

    def unseen(rows: slice) -> Identity:
        factors = ((cz[rows], tracking, model.E), (dy[rows], model.C), (cz[rows], formed))
        return Identity((cz[rows] @ ve, dy[rows] @ model.C), factors)

    return {
        "dynamics": Identity(
            (observer.Az @ ve, observer.By @ model.C, -tracking @ model.A),
            ((observer.Az, tracking, model.E), (tracking, model.A)),
        ),
        "inputs": Identity(
            (observer.Bu, observer.By @ plant.D, -tracking @ model.B),
            ((observer.By, plant.D), (tracking, model.B)),
        ),
        "state estimate": Identity(
            (cz[states] @ ve, dy[states] @ model.C, -model.goal[states]),
            ((cz[states], tracking, model.E), (dy[states], model.C)),
        ),
        "fault estimate": unseen(observer.fault_rows),
        "residual": unseen(observer.residual_rows),
        "input feedthrough": Identity((du, dy @ plant.D), ((dy, plant.D),)),
    }


def _in_units(identities: dict[str, Identity], model: ErrorModel, scaling: Scaling) -> dict[str, Identity]:
    """Return the same identities where those of the states are judged in some units."""
    units, by = np.tile(scaling.states, model.lag + 1), np.abs(model.observer.By)
    scaled = {
        name: replace(identity, units=units) if name in _OF_STATES else identity
        for name, identity in identities.items()
    }
    # Outputs that see no state may be all it takes; the others are then rounding errors of those.
    taken = np.max(by / scaling.outputs, axis=1, keepdims=True)
    output_sizes = np.sum(scaling.outputs[:, None] * np.abs(model.C), axis=0, keepdims=True)
    first, last = identities["dynamics"].factors
    scaled["dynamics"] = replace(scaled["dynamics"], factors=(first, (taken, output_sizes), last))
    return scaled
