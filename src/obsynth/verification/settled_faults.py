r"""Enclosed steady state of a plant and its observer under constant faults.

With ``lambda = 1`` (0 in continuous time), x the plant's state under a constant fault f, and z the observer's,

.. math::
    (\lambda E - A) x = B_f f, \quad (\lambda - A_z) z = B_y (C x + D_f f), \quad
    \hat f = C_z z + D_y (C x + D_f f).

Nothing else bounds what rounding of stored numbers does: an identity holds to 1e-16 of its terms, and states may be
1e20 times a fault, or an observer's decay 1e-20.  A plant with a pole at ``lambda``, or too near to it for a state that
ever settles, has no such x, and an unstable one does not stay there.
"""

from __future__ import annotations

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
from obsynth.proofs.balls import Ball
from obsynth.proofs.extended_balls import Enclosed, ExtendedBall
from obsynth.proofs.linear_equations import enclosed_solution
from obsynth.proofs.products import as_ball
from obsynth.verification.error_system import ErrorModel, natural_scaling

#: Digits, in bits, that are tried after double precision; of more states of plant or observer none are.
STEADY_BITS, MOST_STATES_IN_BITS = (212, 848, 3392), 300

#: Whether the state of a plant settles is told in the last of these digits, in bits.  Of a plant of more than a few
#: states it is asked in fewer first (none: double precision), which nearly always tell, at a tenth of the time.
FEW_STATES_IN_BITS, FIRST_BITS, LAST_BITS = 40, (0, STEADY_BITS[0]), STEADY_BITS[1]

#: A state that takes more than one over this samples (or times the slowest decay of the observer) to settle is none
#: that settles: it differs from the one for faults that grow at this rate.
SLOWEST_SETTLING, ALIKE = 1e-7, 0.5


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


def constant_of_fault_model(model: ErrorModel, fault: int) -> FloatArray | None:
    """Return the state of the fault model, one of its coordinates, in which a fault alone is one and stays."""
    if model.Phi is None or model.Cw is None:
        return None
    still = model.Phi - np.eye(len(model.Phi)) * (model.observer.dt > 0.0)
    for place in np.flatnonzero(~still.any(axis=0)):
        column = model.Cw[:, place]
        if column[fault] != 0.0 and np.count_nonzero(column) == 1:
            return np.asarray(np.eye(len(still))[place] / column[fault])
    return None


def number_of_unknowns(model: ErrorModel) -> int:
    """Return of how many unknowns the larger system of equations is."""
    return max(model.plant.nx, len(states_reaching_faults(model.observer)))


def steady_point(plant: DescriptorSystem) -> float:
    """Return the point of the pencil at which signals are constant."""
    return 1.0 if plant.dt > 0.0 else 0.0


class Settled(NamedTuple):
    """Enclosed outputs, observer's states that reach a fault estimate, and fault estimates under constant faults."""

    outputs: Any
    states: Any
    estimates: Any


def settled_signals(faults: ConstantFaults, observer: LinearObserver, kind: type[Enclosed]) -> Settled | None:
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
    states = states_reaching_faults(observer)
    estimates = kind.exact(observer.Cz[rows][:, states]) @ inner + kind.exact(observer.Dy[rows]) @ outputs
    return Settled(outputs, inner, estimates)


def settled_estimates(observer: LinearObserver, driven: Enclosed, kind: type[Enclosed]) -> Enclosed | None:
    """Return what the fault estimates show in the end of what drives the observer's state all the time."""
    state = _driven(observer, driven, kind)
    states = states_reaching_faults(observer)
    return None if state is None else kind.exact(observer.Cz[observer.fault_rows][:, states]) @ state


def _driven(observer: LinearObserver, driven: Enclosed, kind: type[Enclosed]) -> Enclosed | None:
    """Return where the observer's states that reach a fault estimate settle under what drives all of them."""
    states = states_reaching_faults(observer)
    taking = kind.exact(np.eye(observer.order)[states])
    az = kind.exact(observer.Az[np.ix_(states, states)])
    pencil = kind.exact(np.eye(len(states))) - az if observer.dt > 0.0 else -az
    return enclosed_solution(pencil, taking @ driven)


@remembered
def states_reaching_faults(observer: LinearObserver) -> IntArray:
    """Return the observer's states that reach a fault estimate, at once or later: not the registers of past states."""
    reaching = np.any(observer.Cz[observer.fault_rows] != 0.0, axis=0)
    while np.any(more := np.any(observer.Az[reaching] != 0.0, axis=0) & ~reaching):
        reaching |= more
    return np.flatnonzero(reaching)


def settles(model: ErrorModel, rate: float) -> bool:
    """Return whether the plant's state under constant faults settles: in one over a rate, in samples, or in
    continuous time in decay times of the observer."""
    return not _grows(model.plant) and has_steady_state(model.plant, model.observer, rate)


def has_steady_state(plant: DescriptorSystem, observer: LinearObserver, rate: float) -> bool:
    """Return whether there is a state in which the plant stays under constant faults, if an unstable one only where it
    is held: one with an integrator that a fault drives has none.  ``rate``: as of `settles`."""
    slowest = 1.0
    if plant.dt == 0.0 and observer.order:
        slowest = float(np.min(np.abs(poles_of(observer).real)))
    points = steady_point(plant), steady_point(plant) + rate * slowest
    if FEW_STATES_IN_BITS < plant.nx <= MOST_STATES_IN_BITS:
        for bits in FIRST_BITS:
            alike = _certainly_alike(plant, *(_state_at(plant, point, bits) for point in points))
            if alike is not None:
                return alike
    bits = LAST_BITS if plant.nx <= MOST_STATES_IN_BITS else 0
    held, growing = (_state_at(plant, point, bits) for point in points)
    if held is None or growing is None:
        return False
    with np.errstate(all="ignore"):
        apart, size = _apart_and_size(plant, held, growing)
        return bool(np.all(np.max(apart, axis=0, initial=0.0) <= ALIKE * np.max(size, axis=0, initial=0.0)))


def _certainly_alike(plant: DescriptorSystem, held: Ball | None, growing: Ball | None) -> bool | None:
    """Return whether all members of two states are alike, or none are; ``None`` where that is open."""
    if held is None or growing is None:
        return None
    with np.errstate(all="ignore"):
        apart, size = _apart_and_size(plant, held, growing)
        doubt = (held.radius + growing.radius) / natural_scaling(plant).states[:, None]
        most, least = np.max(apart + doubt, axis=0), np.max(apart - doubt, axis=0)
        if np.all(most <= ALIKE * np.max(size - doubt, axis=0)):
            return True
        return False if np.any(least > ALIKE * np.max(size + doubt, axis=0)) else None


def _apart_and_size(plant: DescriptorSystem, held: Ball, growing: Ball) -> tuple[FloatArray, FloatArray]:
    """Return by how much the midpoints of two states differ, and how large they are, in the states' own units."""
    units = natural_scaling(plant).states[:, None]
    first, second = held.midpoint, growing.midpoint
    return np.abs(first - second) / units, np.maximum(np.abs(first), np.abs(second)) / units


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


def _state_at(plant: DescriptorSystem, point: float, bits: int) -> Ball | None:
    """Return the enclosed state under faults that grow as ``lambda^k`` (e^(lambda t)), one in the beginning.

    ``bits``: digits of the arithmetic, none of them for double precision."""
    kind: type[Any] = ExtendedBall if bits else Ball
    with flint.ctx.workprec(bits or STEADY_BITS[0]):
        pencil = kind.exact(plant.E).scaled(point) - kind.exact(plant.A)
        solution = enclosed_solution(pencil, kind.exact(plant.Bf))
        if solution is None:
            return None
        return solution if isinstance(solution, Ball) else as_ball(solution.content)
