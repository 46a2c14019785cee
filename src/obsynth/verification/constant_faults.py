r"""The steady-state estimate of a constant fault, enclosed, for the plant with the stored observer.

With ``lambda = 1`` (0 in continuous time), x the plant's state under a constant fault f, and z the observer's,

.. math::
    (\lambda E - A) x = B_f f, \quad (\lambda - A_z) z = B_y (C x + D_f f), \quad
    \hat f = C_z z + D_y (C x + D_f f),

to be f (whatever the delay), or what the method says.  Rounding of stored numbers has no other bound: an identity holds
to 1e-16 of its terms, and states may be 1e20 times a fault, or an observer's decay 1e-20.

A plant with a pole at ``lambda``, or too near to it for a state that ever settles, has no such x, and an unstable one
does not stay there.  Of these the errors
alone are looked at, ``(lambda - A_z) e = -k``, with k and j what a constant fault leaves of the identities of z and of
the estimates.

Where x and z are known, what rounding adds as the observer runs in double precision (`rounding_in_operation`) counts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import flint
import numpy as np

from obsynth.analysis.time_varying import IntArray
from obsynth.numerics.arrays import ComplexArray, FloatArray, remembered
from obsynth.numerics.invariant_zeros import is_outside
from obsynth.numerics.lapack import eigenvalues
from obsynth.numerics.ranks import HIDDEN_MODE_TOLERANCE
from obsynth.observers.linear.modes import poles_of
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.balls import Ball, rounded_up
from obsynth.proofs.extended_balls import Enclosed, ExtendedBall
from obsynth.proofs.linear_equations import enclosed_solution
from obsynth.proofs.products import as_ball
from obsynth.results.checks import Check, information, upper_bound_check
from obsynth.verification.error_system import PRINTED_SHARE, ErrorModel, natural_scaling
from obsynth.verification.rounding_in_operation import as_it_runs, rounding_in_operation

#: What an estimate may miss of a constant fault in the end, as a share of it, where no option says otherwise.
STEADY_ERROR = 1e-3

#: Digits, in bits, that are tried after double precision; of more states of plant or observer none are.
STEADY_BITS, MOST_STATES_IN_BITS = (212, 848, 3392), 300

#: A state that takes more than one over this samples (or times the slowest decay of the observer) to settle is none
#: that settles: it differs from the one for faults that grow at this rate.
SLOWEST_SETTLING, ALIKE = 1e-7, 0.5

#: What rounding adds as an observer runs counts where the plant's state settles in one over this: slower ones are left,
#: or held, before they are where rounding of their outputs matters.
SLOWEST_COUNTED = 1e-5

#: Outputs and states are known well enough for what rounding adds to them where they are to this share of the largest.
LARGEST_ENCLOSURE = 0.01

#: Name of the row.
CONSTANT_FAULT = "constant fault"


@dataclass(frozen=True, eq=False)
class ConstantFaults:
    """What the estimates of constant faults shall be in the end, by the error model of a linear observer.

    Parameters
    ----------
    model : ErrorModel
        Of the shipped observer.
    gain : FloatArray
        ``(nf, nf)``, over the estimated faults; a column that is NaN says nothing.
    """

    model: ErrorModel
    gain: FloatArray

    @property
    def own(self) -> list[int]:
        """Places of the estimated faults among the plant's that are looked at."""
        names = self.model.observer.fault_names
        looked_at = np.all(np.isfinite(self.gain), axis=0)
        return [self.model.plant.fault_names.index(name) for name, real in zip(names, looked_at, strict=True) if real]


def held_faults(model: ErrorModel) -> FloatArray:
    """Return the gains that constant faults shall have: one, and zero to other estimates; NaN where the fault model
    that the observer holds has no constant."""
    names, plant = model.observer.fault_names, model.plant
    gain = np.eye(len(names))
    if model.Phi is None or model.Cw is None:
        return gain
    for column, name in enumerate(names):
        if _constant(model, plant.fault_names.index(name)) is None:
            gain[:, column] = np.nan
    return gain


def _constant(model: ErrorModel, fault: int) -> FloatArray | None:
    """Return the state of the fault model, one of its coordinates, in which a fault alone is one and stays."""
    if model.Phi is None or model.Cw is None:
        return None
    still = model.Phi - np.eye(len(model.Phi)) * (model.observer.dt > 0.0)
    for place in np.flatnonzero(~still.any(axis=0)):
        column = model.Cw[:, place]
        if column[fault] != 0.0 and np.count_nonzero(column) == 1:
            return np.asarray(np.eye(len(still))[place] / column[fault])
    return None


def constant_fault_row(faults: ConstantFaults, limit: float, printed_digits: int | None) -> Check | None:
    """Return the row on constant faults; ``None`` where nothing is claimed of any.

    ``limit``: what an estimate may miss, as a share of the fault."""
    model = faults.model
    if not faults.own:
        return None
    if printed_digits is not None:
        limit = max(limit, PRINTED_SHARE)
    claim = "the estimate of a constant fault equals it in the end, up to this share"
    source = "stored numbers and plant together, outward rounded"
    sizes, settles = _sizes(faults), _settles(model, SLOWEST_SETTLING)
    missed = _decided(faults, _missed_together, sizes, limit)
    detail = "of plant and observer together, in exact arithmetic"
    if missed is not None and missed <= limit and settles:
        missed, detail = _as_it_runs(faults, sizes, missed)
        if not missed <= limit and _order(model) <= MOST_STATES_IN_BITS:
            # Bounds of double precision were below the limit one by one: those of more digits may be so together.
            closely = _decided(faults, _missed_together, sizes, limit, STEADY_BITS)
            if closely is not None:
                missed, detail = _as_it_runs(faults, sizes, closely, STEADY_BITS)
    elif not settles:
        alone = _decided(faults, _missed_alone, sizes, limit)
        if alone is not None and not (missed is not None and missed <= limit):
            missed, detail = alone, "of the errors alone, in exact arithmetic"
        detail += ": the plant's state does not settle with such a fault, and rounding as it runs is not counted"
    if missed is None:
        if _order(model) > MOST_STATES_IN_BITS:
            return information(CONSTANT_FAULT, claim, np.nan, source=source, status="assumed", detail="not decided")
        missed = np.nan
    return upper_bound_check(CONSTANT_FAULT, claim, missed, limit, source=source, kind="proved", detail=detail)


def _order(model: ErrorModel) -> int:
    """Return of how many unknowns the larger system of equations is."""
    return max(model.plant.nx, len(_seen_by_faults(model.observer)))


_Missed = Callable[[ConstantFaults, type[Any]], Any]


def _tried_bits(given: ConstantFaults) -> tuple[int, ...]:
    """Return the digits, in bits, that are tried in turn; zero: double precision."""
    return (0,) if _order(given.model) > MOST_STATES_IN_BITS else (0, *STEADY_BITS)


def _decided(
    faults: ConstantFaults, missed: _Missed, sizes: FloatArray, limit: float, tried: Sequence[int] | None = None
) -> float | None:
    """Return a bound on the largest share that is missed, in as many digits as tell it from the limit."""
    value = None
    for bits in _tried_bits(faults) if tried is None else tried:
        miss: Ball | None
        if bits:
            with flint.ctx.workprec(bits):
                exact = missed(faults, ExtendedBall)
                miss = None if exact is None else as_ball(exact.content)
        else:
            miss = missed(faults, Ball)
        if miss is None or not np.all(np.isfinite(miss.magnitude)):
            continue
        value = float(np.max(miss.magnitude * sizes, initial=0.0))
        if value <= limit or np.max((np.abs(miss.midpoint) - miss.radius) * sizes, initial=0.0) > limit:
            break
    return value


def _sizes(faults: ConstantFaults) -> FloatArray:
    """Return how large one fault is beside another, ``(nf, columns)``: faults are as large as what they make of the
    outputs in their natural units."""
    plant = faults.model.plant
    with np.errstate(all="ignore"):
        try:
            state = np.linalg.solve(_pencil(plant, _point(plant)), plant.Bf)
        except np.linalg.LinAlgError:
            state = np.zeros((plant.nx, plant.nf))
        outputs = np.abs(plant.C @ state + plant.Df) / natural_scaling(plant).outputs[:, None]
        reach = np.max(outputs, axis=0, initial=0.0)
    usual = np.isfinite(reach) & (reach > 0.0)
    reach = np.where(usual, reach, 1.0) if usual.all() else np.ones(plant.nf)
    rows = [plant.fault_names.index(name) for name in faults.model.observer.fault_names]
    return np.asarray(reach[rows][:, None] / reach[faults.own][None, :])


def _point(plant: DescriptorSystem) -> float:
    return 1.0 if plant.dt > 0.0 else 0.0


def _pencil(plant: DescriptorSystem, point: float) -> FloatArray:
    return np.asarray(point * plant.E - plant.A)


def _goal(faults: ConstantFaults, kind: type[Enclosed]) -> Enclosed:
    """Return what the estimates shall be, ``(nf, columns)``."""
    return kind.exact(faults.gain[:, np.all(np.isfinite(faults.gain), axis=0)])


def _missed_together(faults: ConstantFaults, kind: type[Enclosed]) -> Enclosed | None:
    """Return what the estimates of plant and observer together miss ``(nf, columns)``."""
    settled = _settled(faults, faults.model.observer, kind)
    if settled is None:
        return None
    missed: Enclosed = settled.estimates - _goal(faults, kind)
    return missed


class _Settled(NamedTuple):
    """Enclosed outputs, observer's states that reach a fault estimate, and fault estimates under constant faults."""

    outputs: Any
    states: Any
    estimates: Any


def _settled(faults: ConstantFaults, observer: LinearObserver, kind: type[Enclosed]) -> _Settled | None:
    """Return where plant and an observer settle; ``None`` where no such state is enclosed."""
    plant, own, rows = faults.model.plant, faults.own, observer.fault_rows
    e, a, c = (kind.exact(part) for part in (plant.E, plant.A, plant.C))
    state = enclosed_solution(e - a if plant.dt > 0.0 else -a, kind.exact(plant.Bf[:, own]))
    if state is None:
        return None
    outputs = c @ state + kind.exact(plant.Df[:, own])
    inner = _driven(observer, kind.exact(observer.By) @ outputs, kind)
    if inner is None:
        return None
    states = _seen_by_faults(observer)
    estimates = kind.exact(observer.Cz[rows][:, states]) @ inner + kind.exact(observer.Dy[rows]) @ outputs
    return _Settled(outputs, inner, estimates)


def _as_it_runs(
    faults: ConstantFaults, sizes: FloatArray, missed: float, tried: Sequence[int] | None = None
) -> tuple[float, str]:
    """Return what the estimates miss at most as the observer runs in double precision, and how that was found."""
    try:
        observer = as_it_runs(faults.model.observer)
    except (ValueError, np.linalg.LinAlgError):  # Numbers that are none.
        return np.nan, "of plant and observer together: the observer cannot be sampled"
    known = _magnitudes(faults, observer, _tried_bits(faults) if tried is None else tried)
    if known is None:
        return np.nan, "of plant and observer together, in exact arithmetic: rounding as it runs is not enclosed"
    outputs, states, apart = known
    with np.errstate(all="ignore"):
        added = rounding_in_operation(observer, _seen_by_faults(observer), outputs, states)
        rounding = float(np.max((added + apart) * sizes, initial=0.0))
    sampled = "" if faults.model.observer.dt > 0.0 else f", sampled every {observer.dt:.3g} s"
    detail = (
        f"of plant and observer together: {missed:.2g} in exact arithmetic, and as it runs in double precision{sampled}"
    )
    if not _settles(faults.model, SLOWEST_COUNTED) or _settling_time(observer) > 1.0 / SLOWEST_COUNTED:
        bound = f"adds at most {rounding:.2g}" if np.isfinite(rounding) else "has no proved bound"
        slow = "once plant and observer have settled, which takes so long (over 1e5 samples) that it is not counted"
        return missed, f"{detail}, rounding {bound} {slow}"
    return float(rounded_up(np.asarray(missed + rounding), 1)), f"{detail}, rounding adds at most {rounding:.2g}"


def _settling_time(observer: LinearObserver) -> float:
    """Return in how many samples the slowest of the states that reach a fault estimate decays to 1/e."""
    states = _seen_by_faults(observer)
    slowest = float(np.max(np.abs(np.linalg.eigvals(observer.Az[np.ix_(states, states)])), initial=0.0))
    return 1.0 / (1.0 - slowest) if slowest < 1.0 else np.inf


def _magnitudes(
    faults: ConstantFaults, observer: LinearObserver, tried: Sequence[int]
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Return bounds on the outputs, on the states and on what sampling changes of the estimates; ``None`` without."""
    known = None
    for bits in tried:
        kind: type[Any] = ExtendedBall if bits else Ball
        with flint.ctx.workprec(bits or STEADY_BITS[0]):
            settled = _settled(faults, observer, kind)
            exact = settled if observer is faults.model.observer else _settled(faults, faults.model.observer, kind)
            if settled is None or exact is None:
                continue
            parts: list[Any] = [settled.outputs, settled.states, settled.estimates - exact.estimates]
            balls = [part if isinstance(part, Ball) else as_ball(part.content) for part in parts]
        if observer is faults.model.observer:
            balls[2] = Ball.exact(np.zeros(balls[2].midpoint.shape))
        outputs, states, apart = (ball.magnitude for ball in balls)
        if all(np.all(np.isfinite(size)) for size in (outputs, states, apart)):
            known = outputs, states, apart
            if all(_is_narrow(ball) for ball in balls[:2]):
                break
    return known


def _is_narrow(ball: Ball) -> bool:
    """Return whether each column is known to a share of its largest entry; one that may be zero is not."""
    return bool(np.all(ball.radius <= LARGEST_ENCLOSURE * np.max(np.abs(ball.midpoint), axis=0, initial=0.0)))


def _missed_alone(faults: ConstantFaults, kind: type[Enclosed]) -> Enclosed | None:
    """Return what the estimates miss where the plant's states meet the identities ``(nf, columns)``."""
    model, own = faults.model, faults.own
    plant, observer, rows = model.plant, model.observer, model.observer.fault_rows
    bf, df, by, dy = (kind.exact(part) for part in (plant.Bf[:, own], plant.Df[:, own], observer.By, observer.Dy[rows]))
    if model.Phi is None:
        driven = by @ df - kind.exact(model.own) @ bf
        direct = dy @ df - _goal(faults, kind)
        if model.T0 is not None:
            direct = direct + kind.exact(model.T0[rows, : plant.nx]) @ bf
    else:
        states = (_constant(model, fault) for fault in own)
        still = np.column_stack([state for state in states if state is not None])
        motion = kind.exact(np.vstack([np.zeros((len(model.E) - len(still), len(own))), still]))
        tracked = kind.exact(model.T) @ (kind.exact(model.E) @ motion)
        ahead = kind.exact(model.T) @ (kind.exact(model.A) @ motion)
        outputs = kind.exact(model.C) @ motion
        driven = kind.exact(observer.Az) @ tracked + by @ outputs - ahead
        direct = kind.exact(observer.Cz[rows]) @ tracked + dy @ outputs - _goal(faults, kind)
        if model.T0 is not None:
            direct = direct + kind.exact(model.T0[rows]) @ (kind.exact(model.A) @ motion)
    estimates = _settled_estimates(observer, driven, kind)
    return None if estimates is None else estimates + direct


def _settled_estimates(observer: LinearObserver, driven: Enclosed, kind: type[Enclosed]) -> Enclosed | None:
    """Return what the fault estimates show in the end of what drives the observer's state all the time."""
    state = _driven(observer, driven, kind)
    states = _seen_by_faults(observer)
    return None if state is None else kind.exact(observer.Cz[observer.fault_rows][:, states]) @ state


def _driven(observer: LinearObserver, driven: Enclosed, kind: type[Enclosed]) -> Enclosed | None:
    """Return where the observer's states that reach a fault estimate settle under what drives all of them."""
    states = _seen_by_faults(observer)
    taking = kind.exact(np.eye(observer.order)[states])
    az = kind.exact(observer.Az[np.ix_(states, states)])
    pencil = kind.exact(np.eye(len(states))) - az if observer.dt > 0.0 else -az
    return enclosed_solution(pencil, taking @ driven)


@remembered
def _seen_by_faults(observer: LinearObserver) -> IntArray:
    """Return the observer's states that reach a fault estimate, at once or later: not the registers of past states."""
    reaching = np.any(observer.Cz[observer.fault_rows] != 0.0, axis=0)
    while np.any(more := np.any(observer.Az[reaching] != 0.0, axis=0) & ~reaching):
        reaching |= more
    return np.flatnonzero(reaching)


def _settles(model: ErrorModel, rate: float) -> bool:
    """Return whether the plant's state under constant faults settles: in one over a rate, in samples or as above."""
    plant, observer = model.plant, model.observer
    if _grows(plant):
        return False
    slowest = 1.0
    if plant.dt == 0.0 and observer.order:
        slowest = float(np.min(np.abs(poles_of(observer).real)))
    held, growing = (_state_at(plant, _point(plant) + growth) for growth in (0.0, rate * slowest))
    if held is None or growing is None:
        return False
    with np.errstate(all="ignore"):
        units = natural_scaling(plant).states[:, None]
        apart = np.max(np.abs(held - growing) / units, axis=0, initial=0.0)
        size = np.max(np.maximum(np.abs(held), np.abs(growing)) / units, axis=0, initial=0.0)
    return bool(np.all(apart <= ALIKE * size))


def _grows(plant: DescriptorSystem) -> bool:
    """Return whether faults drive an unstable mode of the plant: its state leaves the one at which it would stay."""
    scaling = natural_scaling(plant)
    e, a, bf = scaling.scale_dynamics(plant.E), scaling.scale_dynamics(plant.A), scaling.scale_input(plant.Bf)
    if not any(_unstable(eigenvalues(a, e), plant.dt)):
        return False
    from scipy.linalg import eig

    with np.errstate(all="ignore"):
        poles, left_vectors = eig(a, e, left=True, right=False)
    unstable = _unstable(poles, plant.dt)
    driven = np.abs(left_vectors[:, unstable].conj().T @ bf)
    return bool(np.any(driven > HIDDEN_MODE_TOLERANCE * np.linalg.norm(bf, axis=0)))


def _unstable(poles: ComplexArray, dt: float) -> list[bool]:
    """Return which of the poles are finite and do not decay."""
    return [bool(np.isfinite(pole)) and is_outside(complex(pole), dt) for pole in poles]


def _state_at(plant: DescriptorSystem, point: float) -> FloatArray | None:
    """Return the state under faults that grow as ``lambda^k`` (e^(lambda t)), one in the beginning."""
    with flint.ctx.workprec(STEADY_BITS[1]):
        kind: type[Any] = ExtendedBall if plant.nx <= MOST_STATES_IN_BITS else Ball
        pencil = kind.exact(plant.E).scaled(point) - kind.exact(plant.A)
        solution = enclosed_solution(pencil, kind.exact(plant.Bf))
        if solution is None:
            return None
        return (solution if isinstance(solution, Ball) else as_ball(solution.content)).midpoint
