"""Detection of designs that rounding makes useless: bounds on its effect on the estimates.

Outputs ``y = G f`` right to the last digit change an estimate by up to ``u (|Cz| |(s - Az)^-1| |By| + |Dy|) |G| |f|``,
u the unit roundoff, in any units; the observer's own numbers, with z its state, by up to
``u (|Cz| |(s - Az)^-1| (|Az| |z| + |By| |y|) + |Cz| |z| + |Dy| |y|)``.
"""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction

import numpy as np

from obsynth.analysis.existence.witnesses import EntryChange, Unclear, Witness
from obsynth.errors import PreconditionError
from obsynth.numerics.arrays import ComplexArray, FloatArray
from obsynth.numerics.spectra import pole_text
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.balls import UNIT_ROUNDOFF
from obsynth.results.number_texts import number
from obsynth.verification.constant_faults import STEADY_ERROR
from obsynth.verification.settled_faults import SLOWEST_SETTLING, has_steady_state

#: Share of a unit fault that rounding of the outputs may be of its estimate.
LARGEST_ROUNDED_SHARE = 0.1

#: Share of a unit fault from which on rounding of the observer's own numbers is reported.
TOLD_ROUNDING = 1e-6

#: Share of a constant fault from which on rounding while the observer runs is reported: what its estimate may miss.
TOLD_STEADY_ROUNDING = STEADY_ERROR

#: Observers of more states are not examined under constant faults: one inverse of this size takes 20 ms.
MOST_STEADY_STATES = 400

#: Observers of more states are not examined: their certificates bound what rounding of their numbers does.
MOST_OBSERVER_STATES = 150

#: Points at which that is judged, in continuous time in units of the plant's own rate.
ROUNDING_POINTS = (0.0, 1e-2, 1e-1, 1.0)


def require_above_rounding(plant: DescriptorSystem, observer: LinearObserver) -> tuple[str, ...]:
    """Return what rounding of the observer's own numbers may do to an estimate, where that matters.

    Raise `PreconditionError` (unclear) where rounding of the outputs hides the estimate of a unit fault."""
    steady = tuple(_under_constant_faults(plant, observer))
    shares = _least(plant, observer)
    if shares is None:
        return steady
    least, own = shares
    worst = int(np.argmax(least))
    if least[worst] >= LARGEST_ROUNDED_SHARE:
        name = plant.fault_names[worst]
        raise PreconditionError(
            "Unclear: gains were found, but they are so large that rounding of the outputs to double "
            f"precision alone moves the estimate of {name!r} by {least[worst]:.2g} of the fault at every frequency "
            f"tried. {_deciding_digit(plant, observer, worst).described(plant)}",
            condition="gains against rounding",
            signals=(name,),
            unclear=True,
        )
    cancelling = tuple(
        f"The entries of the observer cancel: their last digits alone may change the estimate of {name!r}"
        f" by {share:.2g} of the fault, and by more at some frequencies. State the noise of the sensors, or ask "
        "for a larger gamma."
        for name, share in zip(plant.fault_names, own, strict=True)
        if share >= TOLD_ROUNDING
    )
    return (*cancelling, *steady)


def _under_constant_faults(plant: DescriptorSystem, observer: LinearObserver) -> Iterator[str]:
    """Yield a note for each fault whose estimate, while it stays constant, running in double precision may move."""
    if not _is_examined(plant, observer, MOST_STEADY_STATES):
        return
    with np.errstate(all="ignore"):
        shares = rounding_shares(plant, observer, _points(plant)[0])[1]
    told = [
        (name, share) for name, share in zip(plant.fault_names, shares, strict=True) if share >= TOLD_STEADY_ROUNDING
    ]
    # Of a plant that integrates a fault, which never stays anywhere, the shares are those of rounding in its pole.
    if told and has_steady_state(plant, observer, SLOWEST_SETTLING):
        for name, share in told:
            yield (
                f"While {name!r} is constant, rounding as the observer runs in double precision may move its estimate "
                f"by about {number(share, digits=2)} times the fault (every rounding at its worst, to first order): "
                "what is proved of the estimate in the end is for exact arithmetic. Compare with another method "
                "(obsynth.compare)."
            )


def _deciding_digit(plant: DescriptorSystem, observer: LinearObserver, fault: int) -> Unclear:
    """Return the last digit of a number of the plant, or else of the observer, that moves an estimate most."""
    worst_witness = max(
        (witness for point in _points(plant) for witness in last_digits(plant, observer, fault, point)),
        key=lambda witness: (
            witness.changes[0].matrix in ("C", "Df") and witness.size >= LARGEST_ROUNDED_SHARE,
            witness.size,
        ),
        default=None,
    )
    size, place = (0.0, 0j) if worst_witness is None else (worst_witness.size, worst_witness.point or 0j)
    where = pole_text(place)
    return Unclear(
        UNIT_ROUNDOFF,
        worst_witness,
        f"has an estimate of {plant.fault_names[fault]!r} that differs by {size:.2g} of the fault at "
        f"{'z' if plant.is_discrete else 's'} = {where}",
        "A slower decay, a larger gamma, or an output that is more sensitive to the fault would decide it.",
    )


def last_digits(plant: DescriptorSystem, observer: LinearObserver, fault: int, point: complex) -> Iterator[Witness]:
    """Yield the entry of each matrix whose last digit moves the estimate of a unit fault most at a point."""
    responses = _responses(plant, observer, point)
    if responses is None:
        return
    outputs, resolvent = responses
    row = range(len(observer.Cz))[observer.fault_rows][fault]
    states = np.linalg.solve(point * plant.E - plant.A, plant.Bf)[:, fault]
    row_response, output = observer.Cz[row] @ resolvent, outputs[:, fault]
    gain = row_response @ observer.By + observer.Dy[row]
    effects = {
        "C": np.outer(np.abs(gain), np.abs(states)),
        "Df": np.outer(np.abs(gain), np.eye(plant.nf)[fault]),
        "By": np.outer(np.abs(row_response), np.abs(output)),
        "Dy": np.outer(np.arange(len(observer.Dy)) == row, np.abs(output)),
    }
    for name, effect in effects.items():
        matrix = getattr(plant if name in ("C", "Df") else observer, name)
        moved = effect * np.where(matrix != 0.0, np.spacing(np.abs(matrix)), 0.0)
        if not moved.size or not np.all(np.isfinite(moved)) or not moved.any():
            continue
        i, j = (int(k) for k in np.unravel_index(np.argmax(moved), moved.shape))
        before = float(matrix[i, j])
        after = before + float(np.copysign(np.spacing(abs(before)), before))
        change = EntryChange(name, i, j, Fraction(before), Fraction(after))
        yield Witness((change,), float(moved[i, j]), point)


def _least(plant: DescriptorSystem, observer: LinearObserver) -> FloatArray | None:
    """Return the least of `rounding_shares` over the points ``(2, nf)``, NaN where none is a number; ``None`` where it
    is not examined."""
    if not _is_examined(plant, observer, MOST_OBSERVER_STATES):
        return None
    with np.errstate(all="ignore"):
        shares = [rounding_shares(plant, observer, point) for point in _points(plant)]
        return np.asarray(np.fmin.reduce(shares, axis=0))


def _is_examined(plant: DescriptorSystem, observer: LinearObserver, most: int) -> bool:
    return bool(plant.nf) and observer.order <= most and not plant.is_sparse and len(observer.fault_names) == plant.nf


def _points(plant: DescriptorSystem) -> list[complex]:
    if plant.is_discrete:
        return [complex(np.exp(1j * point)) for point in ROUNDING_POINTS]
    sizes = np.linalg.norm(plant.E), np.linalg.norm(plant.A)
    rate = float(sizes[1] / sizes[0]) if all(sizes) else 1.0
    return [complex(0.0, rate * point) for point in ROUNDING_POINTS]


def _responses(
    plant: DescriptorSystem, observer: LinearObserver, point: complex
) -> tuple[ComplexArray, ComplexArray] | None:
    """Return the outputs for each fault and the observer's resolvent at one point; ``None`` at a pole of either."""
    try:
        states = np.linalg.solve(point * plant.E - plant.A, plant.Bf)
        resolvent = np.linalg.inv(point * np.eye(observer.order) - observer.Az)
    except np.linalg.LinAlgError:
        return None
    return np.asarray(plant.C @ states + plant.Df, dtype=np.complex128), np.asarray(resolvent)


def rounding_shares(plant: DescriptorSystem, observer: LinearObserver, point: complex) -> FloatArray:
    """Return the shares of each fault that rounding may be ``(2, nf)``: of the outputs, and of the observer's own
    numbers; NaN where one is no number."""
    responses = _responses(plant, observer, point)
    if responses is None:
        return np.full((2, plant.nf), np.nan)
    outputs, resolvent = responses
    rows, output_sizes, size = observer.fault_rows, np.abs(outputs), np.abs(resolvent)
    driving, state = np.abs(observer.By) @ output_sizes, np.abs(resolvent @ observer.By @ outputs)
    of_outputs = size @ driving
    moved = np.stack((of_outputs, of_outputs + size @ (np.abs(observer.Az) @ state) + state))
    shares = np.abs(observer.Cz[rows]) @ moved + np.abs(observer.Dy[rows]) @ output_sizes
    rounded = UNIT_ROUNDOFF * np.diagonal(shares, axis1=1, axis2=2)
    return np.asarray(np.where(np.isfinite(rounded).all(axis=1, keepdims=True), rounded, np.nan))
