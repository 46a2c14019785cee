r"""Bounds on the error of a constant fault's estimate by rounding while an observer runs in double precision.

Every sum of products of double precision is right to ``g = n u / (1 - n u)`` of the sum of their sizes, in whatever
order the n products are added (N. J. Higham, Accuracy and Stability of Numerical Algorithms, 2002, section 3.1).  With
y the outputs and z the observer's state under the fault, both enclosed, the state that runs differs from z by e,

.. math::
    |e| \le S (l + g |A_z| |e|), \quad l = g (|A_z| |z| + |B_y| |y|), \quad S = \sum_k |A_z^k|,

and the estimate by ``sum_k |C_z A_z^k| (l + g |Az| |e|) + g (|Cz| (|z| + |e|) + |Dy| |y|)``: at every sample, for ever.
Rounding of the outputs themselves is one of the products.  A continuous observer runs as what a first-order hold makes
of it; of which sample time is said.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.modes import poles_of
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.linear.sampled import sample_observer
from obsynth.proofs.balls import gamma, rounded_up
from obsynth.proofs.contraction import Contraction
from obsynth.proofs.nonnegative_matrices import inverse_bound
from obsynth.proofs.peak_sums import absolute_gains
from obsynth.verification.error_system import contraction_of

#: Sums of which rounding is counted beside those of products: of four terms, and of the rounding of outputs.
OTHER_ROUNDINGS = 5

#: Up to so many states the sums of all of them are found one by one, where the norm that contracts is too coarse.
STATES_FOR_OWN_SUMS = 64

#: A continuous observer is looked at as it runs with a sample for each of its fastest time constants.
SAMPLES_PER_TIME_CONSTANT = 1.0


def as_it_runs(observer: LinearObserver) -> LinearObserver:
    """Return the recursion of an observer: itself, or a continuous one sampled at its fastest time constant."""
    if observer.dt > 0.0:
        return observer
    fastest = float(np.max(np.abs(poles_of(observer)), initial=0.0)) or 1.0
    return sample_observer(observer, SAMPLES_PER_TIME_CONSTANT / fastest)


def rounding_in_operation(observer: LinearObserver, states: np.ndarray, y: FloatArray, z: FloatArray) -> FloatArray:
    """Return bounds on what rounding adds to the fault estimates at any sample, ``(nf, m)``; infinite without a proof.

    ``states``: those that reach a fault estimate; ``y (ny, m)`` and ``z (states, m)``: the sizes of the outputs and of
    these states, at least."""
    rows = observer.fault_rows
    cz, dy = np.abs(observer.Cz[rows][:, states]), np.abs(observer.Dy[rows])
    count = len(states) + dy.shape[1] + observer.Bu.shape[1] + OTHER_ROUNDINGS
    unit = float(gamma(count))
    if not len(states):
        return rounded_up(unit * (dy @ y), 2 * count)
    part = observer
    if len(states) < observer.order:
        parts = {"By": observer.By[states], "Bu": observer.Bu[states], "Cz": observer.Cz[:, states]}
        part = replace(observer, Az=observer.Az[np.ix_(states, states)], **parts)
    az, by = np.abs(part.Az), np.abs(part.By)
    contraction, entries = contraction_of(part), inverse_bound(az)
    unknown = np.full((len(cz), y.shape[1]), np.inf)
    local = rounded_up(unit * (az @ z + by @ y), 2 * count)
    added = _of_the_state(part, contraction, entries, unit, local)
    if added is None:
        return unknown
    own = [] if contraction is None else [absolute_gains(part.Az, part.Cz[rows], contraction)]
    own += [] if entries is None else [rounded_up(cz @ entries, 2 * count)]
    sums = np.minimum.reduce(own)
    driven = rounded_up(local + unit * (az @ added), 2 * count)
    through = rounded_up(unit * (cz @ (z + added) + dy @ y), 2 * count)
    return rounded_up(sums @ driven + through, 2 * count)


def _of_the_state(
    observer: LinearObserver,
    contraction: Contraction | None,
    entries: FloatArray | None,
    unit: float,
    local: FloatArray,
) -> FloatArray | None:
    """Return bounds on what rounding adds to the state ``(n, m)``, which is rounded again; ``None`` without a proof.

    ``entries``: ``sum_k |Az|^k``, where it is finite: of delays in a chain it is exact, and no norm contracts much.
    Either it or the contraction is enough."""
    identity = np.eye(observer.order)

    def bound(sums: FloatArray) -> FloatArray | None:
        again = inverse_bound(rounded_up(unit * (sums @ np.abs(observer.Az)), 2 * len(sums) + 2))
        return None if again is None else rounded_up(again @ (sums @ local), 4 * len(sums) + 4)

    by_norm = None if contraction is None else contraction.gain(identity, identity)
    bounds = [bound(sums) for sums in (by_norm, entries) if sums is not None]
    proved = [each for each in bounds if each is not None]
    if not proved and contraction is not None and observer.order <= STATES_FOR_OWN_SUMS:
        closely = bound(absolute_gains(observer.Az, identity, contraction))
        proved = [] if closely is None else [closely]
    return np.minimum.reduce(proved) if proved else None
