r"""Steady estimates of constant faults: whether they equal the fault, for the plant with the stored observer.

Where both settle (`obsynth.verification.settled_faults`) the estimate there is to be f, whatever the delay, or what the
method says; what rounding adds as the observer runs in double precision (`rounding_in_operation`) counts.  Where the
plant does not settle the errors alone are examined, ``(lambda - A_z) e = -k``, with k and j what a constant fault
leaves of the identities of z and of the estimates.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import flint
import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.outward import upper_text
from obsynth.observers.linear.observer import LinearObserver
from obsynth.proofs.balls import Ball, rounded_up
from obsynth.proofs.extended_balls import Enclosed, ExtendedBall
from obsynth.proofs.products import as_ball
from obsynth.results.checks import Check, information, upper_bound_check
from obsynth.verification.error_system import PRINTED_SHARE, ErrorModel, natural_scaling
from obsynth.verification.rounding_in_operation import as_it_runs, rounding_in_operation
from obsynth.verification.settled_faults import (
    MOST_STATES_IN_BITS,
    SLOWEST_SETTLING,
    STEADY_BITS,
    ConstantFaults,
    constant_of_fault_model,
    number_of_unknowns,
    settled_estimates,
    settled_signals,
    settles,
    states_reaching_faults,
    steady_point,
)

#: What an estimate may miss of a constant fault in the end, as a share of it, where no option says otherwise.
STEADY_ERROR = 1e-3

#: What rounding adds as an observer runs counts where the plant's state settles in one over this: slower ones are left,
#: or held, before they are where rounding of their outputs matters.
SLOWEST_COUNTED = 1e-5

#: Outputs and states are known well enough for what rounding adds to them where they are to this share of the largest.
LARGEST_ENCLOSURE = 0.01

#: Name of the row.
CONSTANT_FAULT = "constant fault"

#: Returns what the estimates of constant faults miss, in one kind of arithmetic.
_Missed = Callable[[ConstantFaults, type[Any]], Any]


def held_faults(model: ErrorModel) -> FloatArray:
    """Return the gains that constant faults shall have: one, and zero to other estimates; NaN where the fault model
    that the observer holds has no constant."""
    names, plant = model.observer.fault_names, model.plant
    gain = np.eye(len(names))
    if model.Phi is None or model.Cw is None:
        return gain
    for column, name in enumerate(names):
        if constant_of_fault_model(model, plant.fault_names.index(name)) is None:
            gain[:, column] = np.nan
    return gain


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
    sizes, plant_settles = _sizes(faults), settles(model, SLOWEST_SETTLING)
    missed = _decided(faults, _missed_together, sizes, limit)
    detail = "of plant and observer together, in exact arithmetic"
    if missed is not None and missed <= limit and plant_settles:
        missed, detail = _as_it_runs(faults, sizes, missed)
        if not missed <= limit and number_of_unknowns(model) <= MOST_STATES_IN_BITS:
            # Bounds of double precision were below the limit one by one: those of more digits may be so together.
            closely = _decided(faults, _missed_together, sizes, limit, STEADY_BITS)
            if closely is not None:
                missed, detail = _as_it_runs(faults, sizes, closely, STEADY_BITS)
    elif not plant_settles:
        alone = _decided(faults, _missed_alone, sizes, limit)
        if alone is not None and not (missed is not None and missed <= limit):
            missed, detail = alone, "of the errors alone, in exact arithmetic"
        detail += ": the plant's state does not settle with such a fault, and rounding as it runs is not counted"
    if missed is None:
        if number_of_unknowns(model) > MOST_STATES_IN_BITS:
            return information(CONSTANT_FAULT, claim, np.nan, source=source, status="assumed", detail="not decided")
        missed = np.nan
    return upper_bound_check(CONSTANT_FAULT, claim, missed, limit, source=source, kind="proved", detail=detail)


def _tried_bits(given: ConstantFaults) -> tuple[int, ...]:
    """Return the digits, in bits, that are tried in turn; zero: double precision."""
    return (0,) if number_of_unknowns(given.model) > MOST_STATES_IN_BITS else (0, *STEADY_BITS)


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
            state = np.linalg.solve(steady_point(plant) * plant.E - plant.A, plant.Bf)
        except np.linalg.LinAlgError:
            state = np.zeros((plant.nx, plant.nf))
        outputs = np.abs(plant.C @ state + plant.Df) / natural_scaling(plant).outputs[:, None]
        reach = np.max(outputs, axis=0, initial=0.0)
    usual = np.isfinite(reach) & (reach > 0.0)
    reach = np.where(usual, reach, 1.0) if usual.all() else np.ones(plant.nf)
    rows = [plant.fault_names.index(name) for name in faults.model.observer.fault_names]
    return np.asarray(reach[rows][:, None] / reach[faults.own][None, :])


def _goal(faults: ConstantFaults, kind: type[Enclosed]) -> Enclosed:
    """Return what the estimates shall be, ``(nf, columns)``."""
    return kind.exact(faults.gain[:, np.all(np.isfinite(faults.gain), axis=0)])


def _missed_together(faults: ConstantFaults, kind: type[Enclosed]) -> Enclosed | None:
    """Return what the estimates of plant and observer together miss ``(nf, columns)``."""
    settled = settled_signals(faults, faults.model.observer, kind)
    if settled is None:
        return None
    missed: Enclosed = settled.estimates - _goal(faults, kind)
    return missed


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
        added = rounding_in_operation(observer, states_reaching_faults(observer), outputs, states)
        rounding = float(np.max((added + apart) * sizes, initial=0.0))
    sampled = "" if faults.model.observer.dt > 0.0 else f", sampled every {observer.dt:.3g} s"
    detail = (
        f"of plant and observer together: {missed:.2g} in exact arithmetic, and as it runs in double precision{sampled}"
    )
    if not settles(faults.model, SLOWEST_COUNTED) or _settling_time(observer) > 1.0 / SLOWEST_COUNTED:
        bound = f"adds at most {upper_text(rounding, 2)}" if np.isfinite(rounding) else "has no proved bound"
        slow = "once plant and observer have settled, which takes so long (over 1e5 samples) that it is not counted"
        return missed, f"{detail}, rounding {bound} {slow}"
    detail = f"{detail}, rounding adds at most {upper_text(rounding, 2)}"
    return float(rounded_up(np.asarray(missed + rounding), 1)), detail


def _settling_time(observer: LinearObserver) -> float:
    """Return in how many samples the slowest of the states that reach a fault estimate decays to 1/e."""
    states = states_reaching_faults(observer)
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
            settled = settled_signals(faults, observer, kind)
            exact = (
                settled if observer is faults.model.observer else settled_signals(faults, faults.model.observer, kind)
            )
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
        states = (constant_of_fault_model(model, fault) for fault in own)
        still = np.column_stack([state for state in states if state is not None])
        motion = kind.exact(np.vstack([np.zeros((len(model.E) - len(still), len(own))), still]))
        tracked = kind.exact(model.T) @ (kind.exact(model.E) @ motion)
        ahead = kind.exact(model.T) @ (kind.exact(model.A) @ motion)
        outputs = kind.exact(model.C) @ motion
        driven = kind.exact(observer.Az) @ tracked + by @ outputs - ahead
        direct = kind.exact(observer.Cz[rows]) @ tracked + dy @ outputs - _goal(faults, kind)
        if model.T0 is not None:
            direct = direct + kind.exact(model.T0[rows]) @ (kind.exact(model.A) @ motion)
    estimates = settled_estimates(observer, driven, kind)
    return None if estimates is None else estimates + direct
