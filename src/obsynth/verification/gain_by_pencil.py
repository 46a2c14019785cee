"""Proved gains of stable systems without a certificate, by a pencil that is regular on the whole unit circle."""

from __future__ import annotations

from typing import Any

import flint
import numpy as np

from obsynth.numerics.gramians import gramian
from obsynth.numerics.standard_form import cayley, cayley_point
from obsynth.proofs.definiteness import DefinitenessProof, unproved
from obsynth.proofs.extended_balls import ExtendedBall, arb_matrix, block, middles, undecided_pivot
from obsynth.proofs.regular_pencils import distance_from_circle
from obsynth.verification.inequalities import NO_GAIN, System

#: States of a system whose pencil is proved to be regular: half a second at 60, three at 105.
MOST_STATES_OF_PENCILS = 150

#: Digits, in bits, in which it is formed: rounding is far below that of its vectors, which are in double precision.
PENCIL_BITS = 128

#: Directions that are reached less, of the most reached one, count as reached so much: coordinates stay regular.
LEAST_REACHED = 1e-16


def prove_norm_by_eigenvalues(system: System, order: int, gain: float, *, dt: float) -> DefinitenessProof:
    """Try to prove that a stable system has an H-infinity norm below ``gain``: no certificate is needed.

    Its gain is not ``gain`` at any frequency, where a pencil is regular all along the unit circle, and below it at one.
    Continuous time is mapped by ``s = alpha (z - 1) / (z + 1)``, which keeps the norm.  Compare Boyd, Balakrishnan,
    Kabamba 1989, whose Hamiltonian matrix needs an inverse that loses all digits where the gain is nearly constant.
    """
    if not gain > 0.0:
        return unproved(NO_GAIN)
    if not 0 < order <= MOST_STATES_OF_PENCILS:
        return unproved("the system has no states, or too many for all eigenvalues to be enclosed")
    with flint.ctx.workprec(PENCIL_BITS):
        try:
            distance = _distance_from_circle(*_in_reached_units(system, dt), gain)
        except (ZeroDivisionError, np.linalg.LinAlgError):
            return unproved("a matrix is singular, or next to it")
    if distance > 0.0:
        return DefinitenessProof(True, distance, 0.0, "ball arithmetic", f"{PENCIL_BITS} bits")
    if distance < 0.0:
        return unproved("the level is not above the gain at a frequency")
    return unproved("an eigenvalue of the pencil is on the unit circle, or cannot be told from one that is")


def _in_reached_units(system: System, dt: float) -> tuple[tuple[Any, Any, Any, Any], float]:
    """Return the matrices in coordinates in which white noise drives each state to one, and alpha, 0 in discrete time.

    Any coordinates give the same proof: in these a nearly is a contraction.
    """
    a, b, c, d = (part.content for part in system(ExtendedBall))
    middle_a, middle_b = middles(a), middles(b)
    alpha = 0.0 if dt > 0.0 else cayley_point(np.linalg.eigvals(middle_a))
    if alpha:
        nothing = np.zeros((0, len(middle_a))), np.zeros((0, middle_b.shape[1]))
        middle_a, middle_b, _, _ = cayley(middle_a, middle_b, *nothing, alpha)
    reached = gramian(middle_a, middle_b @ middle_b.T)
    units = np.sqrt(np.maximum(np.diag(reached), 0.0))
    units = np.where(units > 0.0, units, 1.0)
    shape = reached / units[:, None] / units
    values, turn = np.linalg.eigh(0.5 * (shape + shape.T))
    basis = units[:, None] * turn * np.sqrt(np.maximum(values, LEAST_REACHED))
    if not np.all(np.isfinite(basis)):
        return (a, b, c, d), alpha
    turned = arb_matrix(basis)
    return (turned.solve(a * turned), turned.solve(b), c * turned, d), alpha


def _distance_from_circle(matrices: tuple[Any, Any, Any, Any], alpha: float, gain: float) -> float:
    """Return how far a pencil is from being singular on the circle; 0 for none proved, below for a gain above."""
    a, b, c, d = matrices
    n, nz, nw = a.nrows(), d.nrows(), d.ncols()
    one = arb_matrix(np.eye(n))
    # One frequency: infinite in continuous time, -1 on the circle.
    at_once = d if alpha else d - c * (a + one).solve(b)
    level = arb_matrix(np.eye(nw)) * flint.arb(gain) ** 2
    if undecided_pivot((level - at_once.transpose() * at_once).tolist()) is not None:
        return -1.0

    def joined(rows: list[list[Any]]) -> Any:
        heights, widths = (n, n, nz, nw), (n, n, nz, nw)
        parts = [
            [ExtendedBall.exact(np.zeros((high, wide))) if part is None else ExtendedBall(part) for part, wide in row]
            for row, high in (
                (list(zip(row, widths, strict=True)), high) for row, high in zip(rows, heights, strict=True)
            )
        ]
        return block(parts).content

    # Unknowns: the state, that of the adjoint system, the error, what drives it.
    at, ct = a.transpose(), c.transpose()
    rest = [[-c, None, arb_matrix(np.eye(nz)), -d], [None, b.transpose(), d.transpose(), -level]]
    nothing: list[list[Any]] = [[None] * 4, [None] * 4]
    if alpha:
        rate = one * flint.arb(alpha)
        still = [[-rate - a, None, None, -b], [None, rate - at, -ct, None]]
        moved = [[a - rate, None, None, b], [None, rate + at, ct, None]]
    else:
        still = [[-a, None, None, -b], [None, one, None, None]]
        moved = [[-one, None, None, None], [None, at, ct, None]]
    return distance_from_circle(joined(still + rest), joined(moved + nothing))
