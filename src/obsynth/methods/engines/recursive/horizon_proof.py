"""Proofs on the computed gains of a recursive observer over a horizon, for the stated plant, in outward rounding.

With gains ``[L_k K_k]``, ``H_k = [E_k; C_k]``: ``e_k = L_k A e_(k-1) + ([L_k K_k] H_k - I) x_k`` and noise.  Proved:
the last term is rounding ("unbiased"), products of ``L_k A`` shrink ("contraction"), the covariance is definite.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain, repeat

import numpy as np
from numpy.typing import ArrayLike

from obsynth.analysis.existence.recursive import SOURCE
from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray, read_only, remembered
from obsynth.numerics.logarithmic_balance import balance_by_least_squares
from obsynth.observers.recursive.gain_schedule import Gains, GainStep, gain_steps
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.recursive.step_model import StepMatrices
from obsynth.proofs.balls import Ball, rounded_up
from obsynth.proofs.definiteness import prove_positive_definite
from obsynth.proofs.products import AT_ONCE, logarithm_of_product, product_of_stack, stacked_product
from obsynth.results.checks import Check, information, upper_bound_check
from obsynth.verification.identities import EQUALITY_TOLERANCE

#: Of more states nothing is proved: work goes with their cube, and bounds grow with them.
MOST_PROVED_STATES = 100

_Stack = tuple[FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class HorizonProof:
    """What is proved along the horizon."""

    steps: int
    bias: float  # largest entry of [L K] H - I, in units of its terms
    contraction: float  # upper bound on the mean factor per step of the product of L A
    span: str  # over which part of the horizon
    with_parameters: float  # of states and parameters together; NaN without
    last: GainStep  # the gains of the last step


def horizon_proof(
    stated: RecursiveObserver, shipped: RecursiveObserver, steps: int, *, gains: Gains = gain_steps
) -> HorizonProof | None:
    """Return what can be proved of the first steps of a shipped observer on the stated plant; `None` for nothing."""
    if stated.plant.nx > MOST_PROVED_STATES or _layout_of_gains(stated) != _layout_of_gains(shipped):
        return None  # the rows on what fits say so
    errors, joint, lengths, bias, last = _followed(stated.without_walk, shipped.without_walk, steps, gains)
    if stated.adaptation is not None and stated.adaptation.form == "random-walk":
        joint, _, _, other_bias, _ = _followed(stated, shipped, steps, gains)
        bias = max(bias, other_bias)
    mean, span = _mean_factor(errors, lengths, last.factor)
    nq, steps = 0 if shipped.adaptation is None else shipped.plant.nq, sum(lengths)
    together = float(np.exp(min(logarithm_of_product(joint) / steps, 0.0))) if nq and joint else np.nan
    return HorizonProof(steps, bias, mean, span, together, last)


def _layout_of_gains(observer: RecursiveObserver) -> tuple[object, ...]:
    """Return what gains of two observers must have in common to be compared."""
    form = None if observer.adaptation is None else observer.adaptation.form == "random-walk"
    plant = observer.plant
    return observer.early_constraints, form, plant.nx, plant.ne, plant.ny, plant.nq


def _followed(
    stated: RecursiveObserver, shipped: RecursiveObserver, steps: int, gains: Gains
) -> tuple[list[Ball], list[Ball], list[int], float, GainStep]:
    """Follow the gains of a shipped observer on the matrices of the stated plant: products of so many steps each, of
    the states and of states with parameters, how many, how far the gains are from unbiased, and the last ones."""
    units = natural_units(stated)
    bias = 0.0
    errors: list[Ball] = []
    joint: list[Ball] = []
    lengths: list[int] = []
    waiting: list[tuple[StepMatrices, GainStep]] = []
    last: GainStep | None = None
    for step, gain_step in zip(_true_steps(stated, shipped, steps), gains(shipped, steps), strict=False):
        step = gain_step.step if step is None else step
        # Steps of another size (corrections of x(0)) are stacks of their own.
        if len(waiting) == AT_ONCE or (waiting and _sizes(*waiting[0]) != _sizes(step, gain_step)):
            bias = max(bias, _product_closed(waiting, errors, joint, lengths, units))
            waiting = []
        waiting.append((step, gain_step))
        last = gain_step
    if last is None:
        raise SpecError("The plant has no steps.", path="horizon")
    bias = max(bias, _product_closed(waiting, errors, joint, lengths, units))
    return errors, joint, lengths, bias, last


@remembered
def natural_units(observer: RecursiveObserver) -> FloatArray:
    """Return sizes of the states that equations and outputs suggest, ``(n,)``; of parameters that walk, one."""
    plant, count = observer.plant, len(observer.recursion.first.x)
    E, A, C = plant.E.at(1), plant.A.at(0), plant.C.at(1)
    return read_only(np.concatenate([balance_by_least_squares(E, A, outputs=[C]).states, np.ones(count - plant.nx)]))


def _true_steps(stated: RecursiveObserver, shipped: RecursiveObserver, steps: int) -> Iterable[StepMatrices | None]:
    """Return the matrices of the stated plant; `None` for those of the shipped observer."""
    if stated.plant is shipped.plant:
        return repeat(None)
    model = stated.recursion.model
    first = model.first()
    return chain([] if first is None else [first], (model.at(k) for k in range(steps)))


def _sizes(step: StepMatrices, gain_step: GainStep) -> tuple[tuple[int, ...], ...]:
    """Return the shapes that steps of one stack share."""
    return step.H.shape, step.A.shape, gain_step.gain.shape, gain_step.learn.shape


def _product_closed(
    pairs: list[tuple[StepMatrices, GainStep]],
    errors: list[Ball],
    joint: list[Ball],
    lengths: list[int],
    units: FloatArray,
) -> float:
    """Multiply some steps, add the products to the lists, and return how far the gains are from unbiased."""
    state, learned = _transitions(pairs)
    errors.append(product_of_stack(*state))
    lengths.append(len(pairs))
    if learned is not None:
        joint.append(product_of_stack(*learned))
    return largest_bias(pairs, units)


def largest_bias(pairs: list[tuple[StepMatrices, GainStep]], units: FloatArray) -> float:
    """Return the largest entry of ``[L K] H - I`` in units of the terms of its row, rounded up."""
    gains, matrices = np.array([gain_step.gain for _, gain_step in pairs]), np.array([step.H for step, _ in pairs])
    middle, radius = _product(gains, matrices)
    identity = np.eye(middle.shape[1])
    missed = rounded_up(np.abs(middle - identity) + radius, 3)
    # An entry is judged by what rounding of its whole row does to it, in natural units of the states.
    sizes = (np.abs(gains) @ np.abs(matrices) + identity) * units
    return float(np.max(missed * units / np.max(sizes, axis=2, keepdims=True), initial=0.0))


def _product(first: ArrayLike, second: FloatArray) -> _Stack:
    """Return balls that hold the products of two stacks of exact matrices."""
    matrices = np.asarray(first, dtype=np.float64)
    return stacked_product((matrices, np.zeros_like(matrices)), (second, np.zeros_like(second)))


def _transitions(pairs: list[tuple[StepMatrices, GainStep]]) -> tuple[_Stack, _Stack | None]:
    """Return balls of ``L A`` and, with parameters, of the transition of both errors."""
    ne = pairs[0][0].A.shape[0]
    a = np.array([step.A for step, _ in pairs])
    middle, radius = _product([gain_step.gain[:, :ne] for _, gain_step in pairs], a)
    nq, nx = pairs[0][1].retain.shape[0], middle.shape[1]
    if not nq:
        return (middle, radius), None
    learned, learned_radius = _product([gain_step.learn[:, :ne] for _, gain_step in pairs], a)
    joint, joint_radius = (np.zeros((len(pairs), nx + nq, nx + nq)) for _ in range(2))
    joint[:, :nx, :nx], joint_radius[:, :nx, :nx] = middle, radius
    joint[:, nx:, :nx], joint_radius[:, nx:, :nx] = learned, learned_radius
    joint[:, nx:, nx:] = np.array([gain_step.retain for _, gain_step in pairs])
    return (middle, radius), (joint, joint_radius)


def _mean_factor(errors: list[Ball], lengths: list[int], factor: FloatArray) -> tuple[float, str]:
    """Return a bound on the mean factor per step, and of what: of the horizon in the units given, or in deviations."""
    bound, steps = logarithm_of_product(errors), sum(lengths)
    if bound < 0.0:
        return float(np.exp(bound / steps)), "from the start"
    units = _deviations(factor)
    bound = logarithm_of_product(errors, units)
    if bound < 0.0:
        return float(np.exp(bound / steps)), "from the start, in units of the last deviations"
    half = len(errors) // 2
    late = logarithm_of_product(errors[half:], units)
    mean = late / sum(lengths[half:])
    return float(np.exp(min(mean, 0.0))), "over the second half, in units of the last deviations"


def _deviations(factor: FloatArray) -> FloatArray:
    """Return the deviations of a covariance ``factor factor'``, to powers of two; one where there is none."""
    sizes = np.sqrt(np.einsum("ij,ij->i", factor, factor))
    return np.exp2(np.round(np.log2(np.where(sizes > 0.0, sizes, 1.0))))


def bias_row(proof: HorizonProof, condition: float) -> Check:
    """Return the row that the gains leave an exact estimate exact."""
    return upper_bound_check(
        "unbiased",
        "[L_k K_k] [E_k; C_k] = I at every step: without noise and start error there is no error",
        proof.bias,
        EQUALITY_TOLERANCE * condition,
        source=f"{SOURCE}, (10)-(11)",
        kind="proved",
        detail=f"largest entry in units of its terms, of the gains as computed, outward rounded; {proof.steps} steps",
    )


def parameter_row(proof: HorizonProof) -> Iterator[Check]:
    """Yield the row on errors of states and parameters together, where there are parameters."""
    if np.isnan(proof.with_parameters):
        return
    proved = proof.with_parameters < 1.0
    yield information(
        "contraction with parameters",
        "bound on the mean factor per step of errors of states and constant parameters together",
        proof.with_parameters,
        source=f"{SOURCE}, Theorem 3.1",
        status="proved" if proved else "assumed",
        detail="of the gains as computed, in outward rounding"
        if proved
        else "not proved: errors of parameters that are not excited do not decay, and slow ones too little",
    )


def covariance_row(stated: RecursiveObserver, shipped: RecursiveObserver, last: GainStep) -> Check:
    """Return the row that the covariance of the state after the last step is definite, as it is with definite noise."""
    factor = last.factor[: stated.plant.nx]
    root = Ball.exact(factor / _deviations(factor)[:, None])
    proof = prove_positive_definite(root @ root.T)
    claim = "the covariance of the states after the last step is positive definite, in units of their deviations"
    definite = proof.proved or noise_is_definite(stated)
    if definite and not proof.proved and noise_is_definite(shipped):
        return definite_by_its_noise("covariance", claim, last.gain, last.step.H, natural_units(stated))
    if definite:
        return Check(
            "covariance",
            claim,
            proof.lower_bound,
            0.0,
            proof.lower_bound,
            proof.proved,
            "recomputed, the square root as computed",
            "proved",
            proof.text,
        )
    return information(
        "covariance",
        claim,
        proof.lower_bound,
        source="recomputed",
        detail="not definite, or not proved to be: Q or R is singular, and what they hold exact is known exactly",
    )


def definite_by_its_noise(name: str, claim: str, gain: FloatArray, H: FloatArray, units: FloatArray) -> Check:
    """Return the row ``P >= [L K] diag(Q, R) [L K]'``: errors are never less than the last noise makes them.

    Where Q, R are definite, that is definite if ``[L K]`` has full row rank, as it has with ``[L K] H`` near I.
    """
    units = units[: len(gain)]
    missed = Ball.exact(gain) @ Ball.exact(H) - Ball.exact(np.eye(len(gain)))
    scale = units[None, :] / units[:, None]  # powers of two
    least = 1.0 - Ball(missed.midpoint * scale, rounded_up(missed.radius * scale, 1)).frobenius_norm
    return Check(
        name,
        claim,
        least,
        0.0,
        least,
        least > 0.0,
        "P >= L Q L' + K R K' with definite Q and R, outward rounded",
        "proved",
        "value: least singular value of [L K] [E; C] in natural units, which is to be "
        "above zero; the computed covariance is too near a singular one to decide",
    )


def noise_is_definite(stated: RecursiveObserver) -> bool:
    """Whether Q(0) and R(0) are proved positive definite, and stay as they are."""
    constant = stated.Q.is_constant and stated.R.is_constant
    return constant and all(prove_positive_definite(part.at(0)).proved for part in (stated.Q, stated.R))
