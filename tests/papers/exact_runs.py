"""Exact runs of a continuous plant with its continuous observer: one autonomous system, one matrix exponential."""

from __future__ import annotations

import numpy as np
import scipy.linalg

import obsynth


class Together:
    """Plant, observer, and generators of fault, disturbance and input: ``f = Cf wf, wf' = Sf wf`` and so on.

    The algebraic states are eliminated, so that nothing is differentiated.
    """

    def __init__(self, plant, observer, *, fault, disturbance, known=None) -> None:
        smooth = obsynth.eliminate_algebraic_states(plant)
        self.recovery = smooth.recovery
        p = smooth.plant
        known = (np.zeros((1, 1)), np.zeros((p.nu, 1))) if known is None else known
        sizes = [p.nx, observer.order, *(len(pair[0]) for pair in (fault, disturbance, known))]
        places = np.split(np.arange(sum(sizes)), np.cumsum(sizes)[:-1])
        x, z, wf, wd, wu = places
        total = np.zeros((sum(sizes), sum(sizes)))
        y, u = np.zeros((p.ny, len(total))), np.zeros((p.nu, len(total)))
        f, d = np.zeros((p.nf, len(total))), np.zeros((p.nd, len(total)))
        f[:, wf], d[:, wd], u[:, wu] = fault[1], disturbance[1], known[1]
        state = np.zeros((p.nx, len(total)))
        state[:, x] = np.eye(p.nx)
        y = p.C @ state + p.D @ u + p.Df @ f + p.Dd @ d
        own = np.zeros((observer.order, len(total)))
        own[:, z] = np.eye(observer.order)
        total[x] = p.A @ state + p.B @ u + p.Bf @ f + p.Bd @ d
        total[z] = observer.Az @ own + observer.By @ y + observer.Bu @ u
        for place, generator in ((wf, fault), (wd, disturbance), (wu, known)):
            total[np.ix_(place, place)] = generator[0]
        self.total, self.places = total, places
        self.estimates = observer.Cz @ own + observer.Dy @ y + observer.Du @ u
        self.fault_rows, self.state_rows = observer.fault_rows, observer.state_rows
        self.f, self.x = f, state

    def run(self, start: np.ndarray, step: float, steps: int) -> np.ndarray:
        """Return every state of the whole at ``steps`` samples."""
        transition = scipy.linalg.expm(self.total * step)
        rows = np.empty((steps, len(start)))
        rows[0] = start
        for k in range(1, steps):
            rows[k] = transition @ rows[k - 1]
        return rows


#: Generators: matrix and output row.
RAMP = (np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[1.0, 0.0]]))
ONE = (np.zeros((1, 1)), np.ones((1, 1)))


def sine(frequency: float):
    return np.array([[0.0, frequency], [-frequency, 0.0]]), np.array([[1.0, 0.0]])


def ramp_and_sine(slope: float, amplitude: float, frequency: float):
    """``slope t + amplitude sin(frequency t)``, started from (0, 1, 0, 1)."""
    matrix = scipy.linalg.block_diag(RAMP[0], sine(frequency)[0])
    return matrix, np.array([[slope, 0.0, amplitude, 0.0]])
