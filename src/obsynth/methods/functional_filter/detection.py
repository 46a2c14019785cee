"""Detection against disturbance: the residual filter of largest H-minus over H-infinity, in continuous time.

Where unknown inputs (and noise) reach every output, no residual is free of them; the best there is makes their transfer
to the residual co-inner, and no filter of gain one shows any fault more at any frequency.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from obsynth.analysis.transformations import eliminate_algebraic_states
from obsynth.analysis.transformations.recovery import Transformation, linear_plant
from obsynth.errors import PreconditionError, SolverError, SpecError
from obsynth.numerics.arguments import is_finite_number
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import decide_rank
from obsynth.numerics.spectra import abscissa, response
from obsynth.numerics.threads import on_one_thread_if_small
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.balls import Enclosed, block
from obsynth.proofs.definiteness import prove_positive_definite

#: The grid of frequencies begins at this share of its end, where the band begins at zero.
LEAST_FREQUENCY = 1e-6
#: The proved gain is this much above one, and the equation that proves it is this strict.
MARGIN, STRICTNESS = 1e-6, 1e-9
#: Frequencies of the grid, and how often the least value is refined between its neighbours.
GRID, REFINEMENTS = 400, 40


@dataclass(frozen=True, eq=False)
class DetectionFilter:
    """A residual filter of least gain from the unknown inputs for what it shows of the faults.

    Parameters
    ----------
    observer : LinearObserver
        Residuals only; continuous time.
    disturbance_gain : float
        Bound on the H-infinity norm from unknown inputs and noise to the residuals.
    proved : bool
        Whether that bound is proved on the stored numbers, rounding included.
    fault_sensitivity : float
        H-minus: least singular value of the transfer from the faults to the residuals on the range of frequencies.
    frequency : float, rad/s
        Where it is least.
    band : tuple of float, rad/s
        The range of frequencies.
    """

    observer: LinearObserver
    disturbance_gain: float
    proved: bool
    fault_sensitivity: float
    frequency: float
    band: tuple[float, float]

    @property
    def ratio(self) -> float:
        """H-minus over H-infinity, the largest that any filter has."""
        return self.fault_sensitivity / self.disturbance_gain


@on_one_thread_if_small
def detection_filter(
    plant: DescriptorSystem | Transformation, *, band: Sequence[float] = (0.0, 1e3)
) -> DetectionFilter:
    """Design the residual filter of largest H-minus over H-infinity.

    Parameters
    ----------
    plant : DescriptorSystem or Transformation
        Continuous time, index 0 or 1, detectable; unknown inputs and noise together reach every output directly
        (``[Dd, Dw]`` of full row rank), noise counting as an unknown input of its deviation.
    band : sequence of float, optional, rad/s
        Lowest and highest frequency at which the faults must show.

    Returns
    -------
    DetectionFilter
        ``observer`` with ``ny`` residuals, its gain from the unknown inputs proved.

    Raises
    ------
    SpecError
        The plant is sampled, has no faults, or the band is no range of frequencies.
    PreconditionError
        ``[Dd, Dw]`` has not full row rank: some residual is free of unknown inputs, see `functional_filter`.
    SolverError
        The Riccati equation has no stabilising solution (a zero from the unknown inputs on the imaginary axis).

    References
    ----------
    .. [Ding] S. X. Ding, T. Jeinsch, P. M. Frank, E. L. Ding, "A unified approach to the optimization of fault
       detection systems", Int. J. Adaptive Control and Signal Processing 14, 2000.
       Ours: the gain is proved on stored numbers.
    """
    plant = linear_plant(plant)
    if plant.dt > 0.0 or plant.nf == 0:
        raise SpecError("Give a continuous plant (dt = 0) with faults.", path="plant")
    listed = list(band)
    if len(listed) != 2 or not all(map(is_finite_number, listed)) or not 0.0 <= listed[0] < listed[1]:
        raise SpecError(f"band is {band!r}: give the lowest and the highest frequency in rad/s.", path="band")
    smooth = eliminate_algebraic_states(plant).plant
    b, d = np.hstack([smooth.Bd, smooth.Bw]), np.hstack([smooth.Dd, smooth.Dw])
    if decide_rank(d, expected=smooth.ny).rank < smooth.ny:
        raise PreconditionError(
            "Unknown inputs and noise do not reach every output directly ([Dd, Dw] lacks row rank): some residual is "
            "free of them at high frequencies. Ask functional_filter for residuals, or state the noise of all sensors.",
            condition="[Dd, Dw] of full row rank", signals=smooth.output_names,
        )  # fmt: skip
    gain, weight = _gains(smooth, b, d)
    observer = LinearObserver(
        Az=smooth.A - gain @ smooth.C, Bu=smooth.B - gain @ smooth.D, By=gain, Cz=-weight @ smooth.C,
        Du=-weight @ smooth.D, Dy=weight, dt=0.0, input_names=smooth.input_names, output_names=smooth.output_names,
        state_names=(), fault_names=(), residual_names=tuple(f"r{i + 1}" for i in range(smooth.ny)), state_delays=(),
        fault_delays=(),
    )  # fmt: skip
    least, where = _sensitivity(smooth, observer, listed[0], listed[1])
    bound = 1.0 + MARGIN
    return DetectionFilter(
        observer, bound, _gain_is_proved(smooth, observer, b, d, bound), least, where, (listed[0], listed[1])
    )


def _gains(plant: DescriptorSystem, b: FloatArray, d: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return L ``(nx, ny)`` and V ``(ny, ny)`` that make the transfer from the unknown inputs co-inner."""
    from scipy.linalg import solve_continuous_are

    measured = d @ d.T
    try:
        with warnings.catch_warnings():
            # What a badly conditioned equation gives is judged by its poles.
            warnings.simplefilter("ignore")
            y = solve_continuous_are(plant.A.T, plant.C.T, b @ b.T, measured, s=b @ d.T)
    except (np.linalg.LinAlgError, ValueError):
        y = np.full((plant.nx, plant.nx), np.nan)
    gain = np.linalg.solve(measured, (y @ plant.C.T + b @ d.T).T).T
    if not np.all(np.isfinite(gain)) or not abscissa(plant.A - gain @ plant.C, 0.0) < 0.0:
        raise SolverError(
            "The Riccati equation of the detection filter has no stabilising solution: a zero from the unknown inputs "
            "to the outputs lies on the imaginary axis, or a mode shows in no output. State noise of the states (Bw)."
        )
    sizes, directions = np.linalg.eigh(measured)
    return np.asarray(gain), np.asarray((directions / np.sqrt(sizes)) @ directions.T)


def _sensitivity(plant: DescriptorSystem, observer: LinearObserver, low: float, high: float) -> tuple[float, float]:
    """Return the least singular value from the faults to the residuals on a band, and where."""
    entering = plant.Bf - observer.By @ plant.Df
    shown, direct = -observer.Cz, observer.Dy @ plant.Df

    def least(points: FloatArray) -> FloatArray:
        if plant.nf > plant.ny:
            return np.zeros(len(points))
        found = response(observer.Az, entering, shown, direct, np.asarray(1j * points, dtype=np.complex128))
        return np.asarray(np.linalg.svd(found, compute_uv=False)[:, -1])

    grid = np.unique(
        np.concatenate([np.linspace(low, high, GRID), np.geomspace(max(low, LEAST_FREQUENCY * high), high, GRID)])
    )
    values = least(grid)
    at = int(np.argmin(values))
    left, right = grid[max(at - 1, 0)], grid[min(at + 1, len(grid) - 1)]
    for _ in range(REFINEMENTS):
        inner = np.linspace(left, right, 5)
        best = int(np.argmin(least(inner)))
        left, right = inner[max(best - 1, 0)], inner[min(best + 1, 4)]
    place = 0.5 * (left + right)
    value = float(least(np.array([place]))[0])
    return (value, float(place)) if value < values[at] else (float(values[at]), float(grid[at]))


def _gain_is_proved(
    plant: DescriptorSystem, observer: LinearObserver, b: FloatArray, d: FloatArray, bound: float
) -> bool:
    """Prove the H-infinity norm from the unknown inputs to the residuals, errors of stored gains included."""
    from scipy.linalg import solve_continuous_are

    a, gain, weight = observer.Az, observer.By, observer.Dy
    entering, direct, shown = b - gain @ d, weight @ d, weight @ plant.C
    gap = bound**2 * np.eye(len(shown)) - direct @ direct.T
    cross = entering @ direct.T
    slack = STRICTNESS * max(float(np.linalg.norm(entering @ entering.T, 2)), np.finfo(np.float64).tiny)
    try:
        with warnings.catch_warnings():
            # What a badly conditioned equation gives is judged by whether it proves anything.
            warnings.simplefilter("ignore")
            p = solve_continuous_are(a.T, shown.T, entering @ entering.T + slack * np.eye(len(a)), -gap, s=cross)
    except (np.linalg.LinAlgError, ValueError):
        return False
    p = 0.5 * (p + p.T)
    if not np.all(np.isfinite(p)):
        return False

    def inequality(kind: type[Enclosed]) -> Enclosed:
        exact = kind.exact
        closed = exact(plant.A) - exact(gain) @ exact(plant.C)
        into = exact(b) - exact(gain) @ exact(d)
        through, out = exact(weight) @ exact(d), exact(weight) @ exact(plant.C)
        moved = closed @ exact(p)
        corner = exact(bound**2 * np.eye(len(shown))) - through @ through.T
        side = exact(p) @ out.T + into @ through.T
        return block([[-(moved + moved.T) - into @ into.T, -side], [-side.T, corner]])

    return prove_positive_definite(inequality).proved and prove_positive_definite(p).proved
