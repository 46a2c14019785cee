"""Zero-order-hold sampling of continuous plants."""

from __future__ import annotations

import math

import flint
import numpy as np
import scipy

from obsynth.errors import PreconditionError, SpecError
from obsynth.numerics.arguments import arguments_checked, real_number
from obsynth.numerics.arrays import LARGEST, FloatArray, require_no_overflow
from obsynth.numerics.continuous import zero_order_hold
from obsynth.numerics.libraries import on_one_thread_if_small
from obsynth.numerics.ranks import CANCELLATION_TOLERANCE
from obsynth.numerics.scaling import balanced_matrix, power_of_two_below
from obsynth.numerics.sparse import dense
from obsynth.numerics.suggestions import quoted_names
from obsynth.plants.descriptor import DescriptorSystem, note_source
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.plants.transformations.delayed_signals import sampled_with_delays
from obsynth.plants.transformations.elimination import columns_of, eliminate_algebraic_states
from obsynth.plants.transformations.exact_elimination import EXACT_ELIMINATION_UP_TO, sampled_exact_numbers
from obsynth.plants.transformations.index_reduction import with_input_derivatives
from obsynth.plants.transformations.recovery import Transformation, unchanged_states
from obsynth.plants.uncertainty import SAMPLED
from obsynth.proofs.extended_balls import arb_matrix
from obsynth.proofs.products import as_ball

#: With so many states and signals, whose exponential takes 10 ms, each entry is rounded once: another machine finds it
#: again, and entries that are small beside those they come from have all their digits.
MOST_ROUNDED_ONCE = 24

#: Digits, in bits: a chain of integrators in large units, whose exponential is squared thirty times, takes over 300.
SQUARING_BITS = 640


@arguments_checked
@on_one_thread_if_small
def discretise(plant: DescriptorSystem | Transformation | PolytopicSystem, sample_time: float) -> Transformation:
    """Sample a continuous plant with a zero-order hold.

    Exact for inputs, faults and disturbances that are constant between samples, and for delays (``plant.delays``) of
    any length: samples on their way become states, and a sample is split where a delayed input changes or a delayed
    output is taken.  Algebraic states are eliminated first.  A derivative of a known input that an output needs becomes
    a known input of its own, ``derivative of u``, which acts at the samples.  A fault that changes within an interval
    acts there like its mean over it, weighted by how much of the effect of each moment is left at the next sample: for
    short intervals the plain mean.

    Parameters
    ----------
    plant : DescriptorSystem
        Continuous and regular.
    sample_time : float, seconds
        Time between samples.

    Returns
    -------
    Transformation
        Process noise (``Bw``, per square root of a second) is integrated over a sample and becomes
        ``process noise 1, 2, ...``, a factor of its covariance; ``Dw`` is per sample and stays.

    Raises
    ------
    SpecError
        ``plant.dt > 0``, or ``sample_time`` is not a positive number, or an unstable mode outgrows double precision
        within it, or a delay is hundreds of samples.
    PreconditionError
        A polytopic plant, whose samples have no vertices; as for `eliminate_algebraic_states`, but for derivatives of
        known inputs; or continuous white noise reaches an output directly.

    References
    ----------
    .. [VanLoan1978] C. Van Loan, "Computing integrals involving the matrix exponential", IEEE TAC 23, 1978.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(A=[[-1.0]], B=[[1.0]], C=[[1.0]])
    >>> sampled = obsynth.discretise(plant, 0.1).plant
    >>> sampled.A.round(4).tolist(), sampled.B.round(4).tolist(), sampled.dt
    ([[0.9048]], [[0.0952]], 0.1)
    """
    if isinstance(plant, PolytopicSystem):
        raise PreconditionError(
            "The samples of a plant over a region have no vertices: exp(A(mu) dt) is no mean of those at the vertices. "
            "obsynth.ui_pi_observer takes the continuous plant as it is, and steps from row to row by implicit Euler "
            "with the same certificate; obsynth.conditions.sampled_polytope samples an error system with a bound on "
            "what is missed.",
            condition="samples over a region",
        )
    if isinstance(plant, Transformation):
        if plant.plant.delays:
            return _sampled(plant.plant, sample_time, before=plant)
        return plant.then(discretise(plant.plant, sample_time))
    return _sampled(plant, sample_time)


def _sampled(plant: DescriptorSystem, sample_time: float, *, before: Transformation | None = None) -> Transformation:
    """Return a plant on samples; ``before``: what was done to it, of which delayed inputs are a part."""
    if plant.dt > 0.0:
        raise SpecError(f"The plant is already sampled (dt = {plant.dt:g} s): give a continuous plant.", path="dt")
    real_number(sample_time, "sample_time", "a positive number of seconds", above=0.0)
    require_no_overflow(sample_time, "sample_time", "sample_time")
    first = _proper(plant)
    smooth = first.plant
    direct = np.flatnonzero(np.any(smooth.Dw, axis=0))
    process = np.flatnonzero(np.any(dense(plant.Bw), axis=0) | np.any(smooth.Bw, axis=0))
    signals = tuple(smooth.noise_names[i] for i in np.intersect1d(direct, process))
    if signals:
        raise PreconditionError(
            f"Process noise {quoted_names(signals)} reaches an output directly, where continuous white noise has "
            "infinite variance: give measurement noise in Dw only, or filter the process noise by a state.",
            condition="noise without a direct path",
            signals=signals,
        )
    _require_bounded_growth(smooth.A, float(sample_time))
    if smooth.delays:
        made = sampled_with_delays(smooth, float(sample_time), _held, gathered_noise)
        note_source(smooth, made.plant, sample_time=float(sample_time))
        return made.after(first if before is None else before.then(first), _described(sample_time))
    signals_in = np.hstack([smooth.B, smooth.Bf, smooth.Bd])
    transition, held = _held(smooth.A, signals_in, sample_time)
    B, Bf, Bd = columns_of(held, (smooth.nu, smooth.nf, smooth.nd))
    factor = gathered_noise(smooth.A, smooth.Bw, sample_time)
    direct_names = [smooth.noise_names[i] for i in direct]
    noise_names = [*(f"process noise {i + 1}" for i in range(factor.shape[1])), *direct_names]
    Bw = np.hstack([factor, np.zeros((smooth.nx, len(direct_names)))])
    Dw = np.hstack([np.zeros((smooth.ny, factor.shape[1])), smooth.Dw[:, direct]])
    changes = {"A": transition, "B": B, "Bf": Bf, "Bd": Bd, "Bw": Bw, "Dw": Dw}
    exact = sampled_exact_numbers(smooth, sample_time) if smooth.nx <= EXACT_ELIMINATION_UP_TO else None
    sampled = smooth.replace(**changes, dt=float(sample_time), noise_names=noise_names, exact=exact)
    noise_kept = np.hstack([np.zeros((smooth.nw, factor.shape[1])), np.eye(smooth.nw)[:, direct]])
    recovery = unchanged_states(smooth, sampled, from_state=np.eye(smooth.nx), noise_kept=noise_kept)
    note_source(smooth, sampled, sample_time=float(sample_time))
    step = Transformation(smooth, sampled, _described(sample_time), recovery)
    return first.then(step.with_tolerances(SAMPLED, sample_time))


def _proper(plant: DescriptorSystem) -> Transformation:
    """Return a plant without algebraic states; derivatives of known inputs that its outputs need are inputs then."""
    try:
        return eliminate_algebraic_states(plant)
    except PreconditionError as refusal:
        reduced = with_input_derivatives(plant) if refusal.condition == "index" else None
        if reduced is None:
            raise
        return reduced[0]


def _described(sample_time: float) -> str:
    return f"sampled every {sample_time:g} s (zero-order hold)"


def _held(A: FloatArray, signals: FloatArray, step: float) -> tuple[FloatArray, FloatArray]:
    """Return ``exp(A h)`` and its integral times ``signals``; of few entries each rounded once."""
    few = sum(signals.shape) <= MOST_ROUNDED_ONCE
    return zero_order_hold(A, signals, step, exponential=_rounded_once if few else None)


def _rounded_once(block: FloatArray, step: float) -> FloatArray | None:
    """Return ``exp(A h)`` in which every entry is rounded once; ``None`` where its balls are too wide."""
    with flint.ctx.workprec(SQUARING_BITS):
        exponential = as_ball((arb_matrix(block) * flint.arb(float(step))).exp())
    size = np.abs(exponential.midpoint)
    if not np.max(exponential.radius, initial=0.0) <= CANCELLATION_TOLERANCE * np.max(size, initial=0.0):
        return None
    return np.where(size > exponential.radius, exponential.midpoint, 0.0)


def _require_bounded_growth(A: FloatArray, sample_time: float) -> None:
    """Raise `SpecError` where the fastest unstable mode of ``A`` leaves the range of numbers within a sample."""
    rate = float(np.linalg.eigvals(balanced_matrix(A)[0]).real.max(initial=0.0))
    if rate * sample_time > math.log(LARGEST):
        raise SpecError(
            f"In one sample of {sample_time:g} s an unstable mode (eigenvalue {rate:.3g} 1/s) grows beyond "
            f"{LARGEST:g}: sample more often than every {math.log(LARGEST) / rate:.2g} s, or look at the signs and "
            "units of A.",
            path="sample_time",
        )
    require_no_overflow(float(np.abs(A).max(initial=0.0)) * sample_time, "A times sample_time", "sample_time")


def gathered_noise(A: FloatArray, noise: FloatArray, step: float) -> FloatArray:
    """Return a factor of the covariance that unit white noise through ``noise`` gathers in ``step``."""
    nx = A.shape[0]
    if not noise.any():
        return np.zeros((nx, 0))
    balanced, scale = balanced_matrix(A)
    scaled = noise / scale[:, None]
    # Van Loan's block grows like exp(-A h): integrate a short step, then double it.
    doublings = math.ceil(math.log2(max(float(np.linalg.norm(balanced, 1)) * step, 1.0)))
    block = np.block([[-balanced, scaled @ scaled.T], [np.zeros((nx, nx)), balanced.T]])
    result = scipy.linalg.expm(block * (step / 2.0**doublings))
    transition = result[nx:, nx:].T
    covariance = transition @ result[:nx, nx:]
    for _ in range(doublings):
        covariance = covariance + transition @ covariance @ transition.T
        transition = transition @ transition
    # An integrated state gathers far less noise than its derivative: compare like with like.
    spread = power_of_two_below(np.sqrt(np.abs(np.diag(covariance))))
    correlation = covariance / spread / spread[:, None]
    sizes, directions = np.linalg.eigh((correlation + correlation.T) / 2.0)
    significant = sizes > CANCELLATION_TOLERANCE * sizes[-1]
    return np.asarray((scale * spread)[:, None] * directions[:, significant] * np.sqrt(sizes[significant]))
