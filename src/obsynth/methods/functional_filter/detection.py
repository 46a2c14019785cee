"""Detection against disturbance: the residual filter of largest H-minus over H-infinity, in continuous time.

Where unknown inputs (and noise) reach every output, no residual is free of them; the best there is makes their transfer
to the residual co-inner, and no filter of gain one shows any fault more at any frequency.

The two norms of a detection filter, proved in outward rounding on its stored numbers.

The gain: a bounded real inequality.  The least singular value of ``G(jw) = C (jw - A)^-1 B + D`` is above a level on a
range of frequencies if it is at one of them, and if

    [A - jw, 0, B; -C'C, -A' - jw, -C'D; D'C, B', D'D - level^2]

is singular at none: excluded around a frequency by an approximate inverse, as long as what it misses is below one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from obsynth.analysis.transformations.elimination import eliminate_algebraic_states
from obsynth.analysis.transformations.recovery import Transformation, linear_plant
from obsynth.errors import PreconditionError, SolverError, SpecError
from obsynth.methods.riccati import continuous_solution
from obsynth.numerics.arguments import is_finite_number
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.libraries import on_one_thread_if_small
from obsynth.numerics.norms import response
from obsynth.numerics.ranks import decide_rank
from obsynth.numerics.scaling import balanced_matrix
from obsynth.numerics.spectra import abscissa
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.balls import Ball, rounded_up
from obsynth.proofs.definiteness import prove_positive_definite
from obsynth.proofs.extended_balls import Enclosed, block
from obsynth.results.checks import Check, VerificationReport
from obsynth.verification.identities import Identity, equality

#: Strictness of the equation that proves a gain, relative to what drives it.
STRICTNESS = 1e-9
#: Intervals that a range may take, the share of an interval's reach that is used, and its first guess.
MOST_INTERVALS, REACH, FIRST_SHARE = 20_000, 0.9, 1e-3
#: Intervals this short, relative to where they are, end at a frequency at which the pencil is singular.
SHORTEST = 1e-8
#: A range of frequencies that is shorter begins with intervals as if it had this length.
LEAST_RANGE = 1e-9
#: Weight of the equations that the frequency does not enter: a power of two.
LIGHT = 2.0**-20


@dataclass(frozen=True, eq=False)
class Transfer:
    """``C (s - A)^-1 B + D``, with enclosures of B, C and D: A ``(n, n)`` is stored, the others are products."""

    A: FloatArray
    B: Ball
    C: Ball
    D: Ball

    def balanced(self) -> Transfer:
        """Return it in states of like size, by powers of two: nothing is rounded."""
        if not len(self.A):
            return self
        a, scale = balanced_matrix(self.A)
        return Transfer(
            np.asarray(a), Ball(self.B.midpoint / scale[:, None], self.B.radius / scale[:, None]),
            Ball(self.C.midpoint * scale, self.C.radius * scale), self.D,
        )  # fmt: skip


def gain_is_proved(transfer: Transfer, bound: float) -> bool:
    """Prove that the system is stable and its H-infinity norm at most a bound."""
    a, b, c, d = transfer.A, transfer.B.midpoint, transfer.C.midpoint, transfer.D.midpoint
    if not len(a):
        corner = Ball.exact(bound**2 * np.eye(transfer.D.shape[0])) - transfer.D @ transfer.D.T
        return prove_positive_definite(corner).proved
    gap = bound**2 * np.eye(len(c)) - d @ d.T
    slack = STRICTNESS * max(float(np.linalg.norm(b @ b.T, 2)), np.finfo(np.float64).tiny)
    found = continuous_solution(a, c, b @ b.T + slack * np.eye(len(a)), -gap, b @ d.T)
    if found is None:
        return False
    p = 0.5 * (found + found.T)

    def inequality(kind: type[Enclosed]) -> Enclosed:
        closed, into, out, through = kind.exact(a), kind.of(transfer.B), kind.of(transfer.C), kind.of(transfer.D)
        moved = closed @ kind.exact(p)
        corner = kind.exact(bound**2 * np.eye(len(c))) - through @ through.T
        side = kind.exact(p) @ out.T + into @ through.T
        return block([[-(moved + moved.T) - into @ into.T, -side], [-side.T, corner]])

    return prove_positive_definite(inequality).proved and prove_positive_definite(p).proved


def sensitivity_is_proved(transfer: Transfer, level: float, low: float, high: float) -> bool:
    """Prove that the least singular value is above a level at every frequency (rad/s) from ``low`` to ``high``."""
    if transfer.B.shape[1] > transfer.C.shape[0]:
        return False
    work = transfer.balanced()
    return _is_above_at(work, level, low) and _is_never_singular(_pencil(work, level), len(work.A), low, high)


def _pencil(work: Transfer, level: float) -> Ball:
    a, n, m = Ball.exact(work.A), len(work.A), work.B.shape[1]
    corner = work.D.T @ work.D - Ball.exact(level**2 * np.eye(m))
    return Ball.blocks([
        [a, Ball.exact(np.zeros((n, n))), work.B],
        [-(work.C.T @ work.C), -a.T, -(work.C.T @ work.D)],
        [work.D.T @ work.C, work.B.T, corner],
    ])  # fmt: skip


def _is_never_singular(pencil: Ball, n: int, low: float, high: float) -> bool:
    """Whether ``M - jw diag(I, 0)`` is proved to be regular from ``low`` to ``high``, the identity of order 2 n."""
    covered, length = low, FIRST_SHARE * max(high - low, LEAST_RANGE)
    for _ in range(MOST_INTERVALS):
        if covered >= high:
            return True
        middle = min(covered + 0.5 * length, high)
        reach = _regular_around(pencil, n, middle)
        if max(length, reach) < SHORTEST * max(covered, SHORTEST * high):
            return False
        if middle - reach > covered:
            # Too far: the interval around a nearer point.
            length *= 0.25
            continue
        covered, length = middle + reach, 4.0 * reach
    return False


def _regular_around(pencil: Ball, n: int, frequency: float) -> float:
    """Return how far around a frequency the pencil is proved to be regular; negative where it is not at all."""
    size = pencil.shape[0]
    turning = np.zeros((size, size))
    turning[: 2 * n, : 2 * n] = np.eye(2 * n)
    try:
        inverse = np.linalg.inv(pencil.midpoint - 1j * frequency * turning)
    except np.linalg.LinAlgError:
        return -1.0
    if not np.all(np.isfinite(inverse)):
        return -1.0
    whole = np.block([[inverse.real, -inverse.imag], [inverse.imag, inverse.real]])
    turned = Ball.exact(frequency * turning)
    matrix = Ball.blocks([[pencil, turned], [-turned, pencil]])
    missed = Ball.exact(whole) @ matrix - Ball.exact(np.eye(2 * size))
    # The frequency enters the equations of the states alone: the others count for little in weighted norms.
    states = np.r_[0 : 2 * n, size : size + 2 * n]
    weights = np.full(2 * size, LIGHT)
    weights[states] = 1.0
    left = _row_sum((np.abs(missed.midpoint) + missed.radius) * weights[:, None] / weights)
    speed = _row_sum(np.abs(whole[:, states]) * weights[:, None])
    if not left < 1.0 or not np.isfinite(speed):
        return -1.0
    return REACH * (1.0 - left) / speed if speed > 0.0 else np.inf


def _row_sum(sizes: FloatArray) -> float:
    """Return a bound on the largest row sum."""
    return float(np.max(rounded_up(np.sum(sizes, axis=1), sizes.shape[1] + 1), initial=0.0))


def _is_above_at(work: Transfer, level: float, frequency: float) -> bool:
    """Prove that the least singular value at one frequency is above a level."""
    n, m = work.B.shape
    size = work.C.shape[0]
    into = Ball.blocks([[work.B, Ball.exact(np.zeros((n, m)))], [Ball.exact(np.zeros((n, m))), work.B]])
    out = Ball.blocks([[work.C, Ball.exact(np.zeros((size, n)))], [Ball.exact(np.zeros((size, n))), work.C]])
    zero = Ball.exact(np.zeros((size, m)))
    shown = Ball.blocks([[work.D, zero], [zero, work.D]])
    if n:
        turned = Ball.exact(frequency * np.eye(n))
        matrix = Ball.blocks([[-Ball.exact(work.A), -turned], [turned, -Ball.exact(work.A)]])
        inverse: FloatArray = np.asarray(np.linalg.inv(matrix.midpoint), dtype=np.float64)
        solution = inverse @ into.midpoint
        left = Ball.exact(np.eye(2 * n)) - Ball.exact(inverse) @ matrix
        share = _row_sum(np.abs(left.midpoint) + left.radius)
        missed = into - matrix @ Ball.exact(solution)
        error = _row_sum(np.abs(inverse)) * float(np.max(np.abs(missed.midpoint) + missed.radius, initial=0.0))
        if not share < 1.0:
            return False
        solved = Ball(solution, np.full_like(solution, float(rounded_up(np.array(error / (1.0 - share)), 6))))
        shown = shown + out @ solved
    least: FloatArray = np.asarray(level**2 * np.eye(2 * m), dtype=np.float64)
    return prove_positive_definite(shown.T @ shown - Ball.exact(least)).proved


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
