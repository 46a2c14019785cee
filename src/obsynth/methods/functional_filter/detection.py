"""Detection against disturbance: the residual filter of largest H-minus over H-infinity, in continuous time.

Where unknown inputs (and noise) reach every output, no residual is free of them; the best there is makes their transfer
to the residual co-inner, and no filter of gain one shows any fault more at any frequency.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from obsynth.analysis.transformations.elimination import eliminate_algebraic_states
from obsynth.analysis.transformations.recovery import Transformation, linear_plant
from obsynth.errors import PreconditionError, SolverError, SpecError
from obsynth.methods.functional_filter.detection_proofs import Transfer, gain_is_proved, sensitivity_is_proved
from obsynth.methods.riccati import continuous_solution
from obsynth.numerics.arguments import is_finite_number
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.libraries import on_one_thread_if_small
from obsynth.numerics.norms import response
from obsynth.numerics.ranks import decide_rank
from obsynth.numerics.spectra import abscissa
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.balls import Ball
from obsynth.results.checks import Check, VerificationReport
from obsynth.verification.identities import Identity, equality

#: The grid of frequencies begins at this share of its end, where the band begins at zero.
LEAST_FREQUENCY = 1e-6
#: The proved gain is this much above one, and the proved sensitivity this much below what a grid finds.
MARGIN, SENSITIVITY_MARGIN = 1e-6, 1e-4
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
        Whether both norms are proved on the stored numbers, rounding included: every row of the report holds.
    fault_sensitivity : float
        H-minus: the least singular value of the transfer from the faults to the residuals on the range of frequencies
        is at least this.
    frequency : float, rad/s
        Where it is least.
    band : tuple of float, rad/s
        The range of frequencies.
    plant : DescriptorSystem
        What it is for.
    report : VerificationReport
        What `verify` found when it was made.
    """

    observer: LinearObserver
    disturbance_gain: float
    proved: bool
    fault_sensitivity: float
    frequency: float
    band: tuple[float, float]
    plant: DescriptorSystem
    report: VerificationReport

    def verify(self) -> VerificationReport:
        """Prove both norms again, from the plant and the shipped observer alone; every row is a claim of its own."""
        claims = self.disturbance_gain, self.fault_sensitivity
        return _verified(eliminate_algebraic_states(self.plant).plant, self.observer, *claims, self.band)

    @property
    def ratio(self) -> float:
        """H-minus over H-infinity: the largest that any filter has, but for the margins of the proofs."""
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
        ``observer`` with ``ny`` residuals; both norms are proved, see ``report``.

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
       Ours: both norms are proved on the stored numbers, at every frequency of the range.
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
    range_of = listed[0], listed[1]
    least, where = _sensitivity(smooth, observer, *range_of)
    claims = 1.0 + MARGIN, least * (1.0 - SENSITIVITY_MARGIN)
    report = _verified(smooth, observer, *claims, range_of)
    return DetectionFilter(observer, claims[0], report.passed, claims[1], where, range_of, plant, report)


def _verified(
    smooth: DescriptorSystem, observer: LinearObserver, gain: float, sensitivity: float, band: tuple[float, float]
) -> VerificationReport:
    """Return the rows that prove a detection filter on a plant without algebraic states."""
    source = "Ding et al. 2000; proofs ours"
    weight, injected = observer.Dy, observer.By

    def transfer(b: FloatArray, d: FloatArray) -> Transfer:
        direct, out = Ball.exact(d), Ball.exact(weight)
        return Transfer(
            observer.Az, Ball.exact(b) - Ball.exact(injected) @ direct, out @ Ball.exact(smooth.C), out @ direct
        )

    felt = transfer(np.hstack([smooth.Bd, smooth.Bw]), np.hstack([smooth.Dd, smooth.Dw]))
    proved = gain_is_proved(felt, gain)
    sensed = sensitivity == 0.0 or sensitivity_is_proved(transfer(smooth.Bf, smooth.Df), sensitivity, *band)
    identities = (
        ("state in the error", "Az = A - By C", (observer.Az, injected @ smooth.C, -smooth.A),
         ((observer.Az,), (injected, smooth.C), (smooth.A,))),
        ("inputs in the error", "Bu = B - By D", (observer.Bu, injected @ smooth.D, -smooth.B),
         ((injected, smooth.D), (smooth.B,))),
        ("state in the residuals", "Cz = -Dy C", (observer.Cz, weight @ smooth.C), ((weight, smooth.C),)),
        ("inputs in the residuals", "Du = -Dy D", (observer.Du, weight @ smooth.D), ((weight, smooth.D),)),
    )  # fmt: skip
    return VerificationReport.of([
        *(equality(name, claim, Identity(parts, terms).residual(), source) for name, claim, parts, terms in identities),
        Check(
            "disturbance gain", "the error dies out, and the H-infinity norm from unknown inputs and noise to the "
            "residuals is at most the claimed one", gain, gain, 0.0, proved, source, "proved",
        ),
        Check(
            "fault sensitivity", "the least singular value from the faults to the residuals is at least the claimed "
            f"one from {band[0]:g} to {band[1]:g} rad/s", sensitivity, sensitivity, 0.0, sensed, source, "proved",
        ),
    ])  # fmt: skip


def _gains(plant: DescriptorSystem, b: FloatArray, d: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return L ``(nx, ny)`` and V ``(ny, ny)`` that make the transfer from the unknown inputs co-inner."""
    measured = d @ d.T
    y = continuous_solution(plant.A, plant.C, b @ b.T, measured, b @ d.T)
    gain = None if y is None else np.linalg.solve(measured, (y @ plant.C.T + b @ d.T).T).T
    if gain is None or not np.all(np.isfinite(gain)) or not abscissa(plant.A - gain @ plant.C, 0.0) < 0.0:
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
