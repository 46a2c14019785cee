r"""The steady state of a recursive observer of a time-invariant plant, as a linear observer.

Once the covariances have settled, every gain of the recursion is constant.  With ``z(k) = A x(k-1) + B u(k-1)`` and the
gains ``[L K M]`` of the rows ``[z; y; Dn u]`` (the last ones with early constraints only),

.. math::
    \bar x(k) = L z(k) + K y(k) + M D_n u(k), \qquad z(k+1) = A \bar x(k) + B u(k)

and parameters that are learnt by least squares follow ``theta(k) = F theta(k-1) + learn [z; y; Dn u]``, with
``x = \bar x + \Upsilon \theta``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsynth.errors import PreconditionError, SolverError, SpecError
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.numerics.spectra import abscissa
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.recursive.gain_schedule import GainStep, gain_steps
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.sensor_timing import require_plain

#: The gains have settled when what is left of their way is below this share of them.
SETTLED = 1e-13
#: Steps of the recursion before it is held to settle nowhere.
MOST_STEPS = 20_000
#: Steps in a row that must have settled: at a turning point gains stand still, too.
STILL_STEPS = 5


@dataclass(frozen=True, eq=False)
class SteadyObserver:
    """A recursive observer whose gains have settled."""

    # from ``[u; y]`` to states, parameters, and the whitened innovation at the parameters of one sample before
    observer: LinearObserver
    start: FloatArray  # ``z(0)``, from the state and the parameters that the recursion starts with; read-only
    steps: int  # after how many steps the gains had settled

    def __post_init__(self) -> None:
        object.__setattr__(self, "start", read_only(self.start))


def steady_observer(observer: RecursiveObserver) -> SteadyObserver:
    """Return the steady state of a recursive observer."""
    require_plain(observer, "A steady filter")
    _require_constant(observer)
    settled, steps = _settled(observer)
    realisation, start = _realised(observer, settled)
    radius = abscissa(realisation.Az, observer.dt)
    if not radius < 1.0:
        raise PreconditionError(
            f"The steady filter is not stable (spectral radius {radius:.6g}): a mode is neither seen by the outputs "
            "nor damped, or parameters are not excited by a plant at rest. Run the recursion itself (obsynth run).",
            condition="stable steady filter",
        )  # fmt: skip
    return SteadyObserver(realisation, start, steps)


def _require_constant(observer: RecursiveObserver) -> None:
    sequences = {**observer.plant.matrices, "Q": observer.Q, "R": observer.R}
    moving = [name for name, sequence in sequences.items() if not sequence.is_constant]
    if moving:
        raise SpecError(
            f"{', '.join(moving)} may change with k (given as more than constants), so the gains do too and there is "
            "no constant realisation to hand on: use the recursion itself, obsynth run or observer.step.", path="plant",
        )  # fmt: skip
    if observer.adaptation is not None and observer.adaptation.reset:
        raise SpecError(
            "This design resets its gains when the data ask for it, so there is no constant realisation to hand on: "
            "use the recursion itself (obsynth run), or design without reset.", path="reset",
        )  # fmt: skip


def _settled(observer: RecursiveObserver) -> tuple[GainStep, int]:
    """Return the first step whose gains have settled."""
    last: GainStep | None = None
    still, before = 0, np.inf
    for k, found in enumerate(gain_steps(observer, MOST_STEPS)):
        # The correction of the start, which comes first with early constraints, has other rows.
        if last is not None and last.gain.shape == found.gain.shape:
            moved = max(_distance(now, then) for now, then in zip(_parts(found), _parts(last), strict=True))
            # What is left of a geometric series, from two of its terms.
            rate = min(moved / before, 1.0) if 0.0 < before < np.inf else 1.0
            left = moved / max(1.0 - rate, np.finfo(np.float64).eps) * rate
            quiet = moved == 0.0 or (moved <= SETTLED and left <= SETTLED) or moved <= 4.0 * np.finfo(np.float64).eps
            still, before = still + 1 if quiet else 0, moved
            if still == STILL_STEPS:
                return found, k
        last = found
    raise SolverError(
        f"The gains do not settle within {MOST_STEPS} steps: a mode is hardly seen, or hardly driven by noise. Run the "
        "recursion itself (obsynth run), or state more noise in Q.", record={"steps": MOST_STEPS},
    )  # fmt: skip


def _parts(found: GainStep) -> tuple[FloatArray, ...]:
    # The sign of a direction of the innovation is free, its square is not.
    return found.gain, found.Upsilon, found.learn, found.forget, found.parity.T @ found.parity, found.G.T @ found.G


def _distance(now: FloatArray, then: FloatArray) -> float:
    size = float(np.abs(now).max(initial=0.0))
    return float(np.abs(now - then).max(initial=0.0)) / size if size else 0.0


def _realised(observer: RecursiveObserver, found: GainStep) -> tuple[LinearObserver, FloatArray]:
    step, plant = found.step, observer.plant
    ne, ny, nx = len(step.A), plant.ny, plant.nx
    early, width = step.Dn, found.gain.shape[1]
    parts = slice(0, ne), slice(ne, ne + ny), slice(ne + ny, width)
    gain, parity = [found.gain[:, part] for part in parts], [found.parity[:, part] for part in parts]
    learn, q = [found.learn[:, part] for part in parts], len(found.forget)
    random_walk = found.gain.shape[0] - nx
    # States: z, then the parameters of one sample before.
    state = np.hstack([gain[0], np.zeros((len(gain[0]), q))])
    theta = np.hstack([learn[0], found.forget])
    az = np.vstack([step.A @ state, theta])
    by = np.vstack([step.A @ gain[1], learn[1]])
    bu = np.vstack([step.B + step.A @ gain[2] @ early, learn[2] @ early])
    # Rows of output: x (with Upsilon theta), theta, innovation less its regressor times theta of before.
    upsilon = found.Upsilon[:nx]
    shown = [state[:nx] + upsilon @ theta, np.vstack([state[nx:], theta]), np.hstack([parity[0], -found.G])]
    seen = [gain[1][:nx] + upsilon @ learn[1], np.vstack([gain[1][nx:], learn[1]]), parity[1]]
    fed = [(gain[2][:nx] + upsilon @ learn[2]) @ early, np.vstack([gain[2][nx:], learn[2]]) @ early, parity[2] @ early]
    residuals = tuple(f"innovation {i + 1}" for i in range(len(found.parity)))
    names = observer.fault_names if random_walk or q else ()
    realisation = LinearObserver(
        Az=az, Bu=bu, By=by, Cz=np.vstack(shown), Du=np.vstack(fed), Dy=np.vstack(seen), dt=observer.dt,
        input_names=plant.input_names, output_names=plant.output_names, state_names=plant.state_names,
        fault_names=names, residual_names=residuals, state_delays=(0,) * nx, fault_delays=(0,) * len(names),
    )  # fmt: skip
    begin = observer.init()
    # z = E x gives back x, as [L K] [E; C] = I, where the first outputs agree with it.
    return realisation, np.concatenate([step.H[:ne] @ begin.x, begin.parameters.theta])
