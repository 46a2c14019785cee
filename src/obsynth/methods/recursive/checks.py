"""Monte Carlo on the plant's own model: are the errors as large as the covariances say, and the innovations white?

Errors of a linear estimator do not depend on the trajectory: on the one that is zero the *prior mean* is random.  To
draw x(0) and project it onto the constraint would be inconsistent, as mu(k) of an algebraic equation depends on x(k).

What is proved of a recursive observer, in outward rounding: of its gains as they are computed, on the stated plant.

With gains ``[L_k K_k]``, ``H_k = [E_k; C_k]``: ``e_k = L_k A e_(k-1) + ([L_k K_k] H_k - I) x_k`` and noise.  Proved:
the last term is rounding ("unbiased"), products of ``L_k A`` shrink ("contraction"), the covariance is definite.

Checks of a recursive observer: fit, a batch solution, proofs, excitation, and consistency by Monte Carlo.

Source of the claims: Moussa Ali, Zhang 2013, (6), (13), (26) and Lemma 3.1; the residual directions are our finding.

A batch solution is one least-squares problem over the first steps as a whole.  Of the listed gains it is proved, where
plant and noise stay the same, that kept for ever they would make errors of mean zero which decay, and the covariance
that they reach is enclosed: the filter's own, whose gains move on, ends at or below it.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import chain, repeat

import numpy as np
from numpy.typing import ArrayLike

from obsynth.analysis.time_varying import HorizonRanks, horizon_ranks
from obsynth.errors import ObsynthError, SpecError
from obsynth.methods.recursive.conditions import SOURCE, recursive_conditions
from obsynth.numerics.arguments import FloatArray
from obsynth.numerics.matrix_equations import discrete_lyapunov
from obsynth.numerics.norms import spectral_radius
from obsynth.numerics.ranks import KNOWN_SHARE, RANK_TOLERANCE, ROUNDED_BESIDE, numerical_rank
from obsynth.numerics.scaling import LogBalance, balance_by_least_squares, power_of_two_below
from obsynth.numerics.square_root_estimation import LeastSquaresStep, least_squares_step, rank_revealing_step
from obsynth.observers.dae.observer import DAEObserver
from obsynth.observers.recursive.gain_schedule import (
    CLEARLY_STABLE,
    STEPS_TO_CONTRACT,
    Gains,
    GainScheduleSummary,
    GainStep,
    gain_schedule_summary,
    gain_steps,
    gains_once,
    looked_at,
)
from obsynth.observers.recursive.observer import RecursiveObserver, StepMatrices, observer_from_options
from obsynth.observers.running import plain_recursion
from obsynth.plants.descriptor import MatrixSequence, listed
from obsynth.proofs.balls import Ball, prove_positive_definite, rounded_up
from obsynth.proofs.contraction import Contraction, column_norms, prove_contraction, proved_rate
from obsynth.proofs.products import AT_ONCE, logarithm_of_product, product_of_stack, stacked_product
from obsynth.results.checks import Check, fitting_check, information, upper_bound_check
from obsynth.results.design import ObserverDesign
from obsynth.verification.claims import EQUALITY_TOLERANCE, listed_gains
from obsynth.verification.plant import condition_rows

#: Trials and steps: a wrong variance of 10 % is 20 standard deviations away.
CONSISTENCY_TRIALS = 400
CONSISTENCY_STEPS = 60
CONSISTENCY_SEED = 20130703
#: Bands are this many standard deviations of the statistic wide: a sound design fails one time in two million.
BAND_DEVIATIONS = 5.0

_SOURCE = "recomputed, Monte Carlo with a fixed seed"


def consistency(stated: RecursiveObserver, shipped: RecursiveObserver, steps: int) -> Iterator[Check]:
    """Yield NEES, NIS and whiteness of a shipped observer on noise as it is stated."""
    rng = np.random.default_rng(CONSISTENCY_SEED)
    truth = stated.init()
    nq = len(truth.parameters.theta)
    x = rng.standard_normal((CONSISTENCY_TRIALS, truth.factor.shape[1])) @ truth.factor.T
    theta = rng.standard_normal((CONSISTENCY_TRIALS, nq)) @ truth.parameters.spread.T
    model = stated.recursion.model
    first = model.first()
    nis, pairs = [], []
    scores: dict[int, tuple[FloatArray, FloatArray]] = {}
    before = np.zeros((CONSISTENCY_TRIALS, 0))
    count, factor = min(steps, CONSISTENCY_STEPS), truth.factor
    for position, gains in enumerate(gain_steps(shipped, count)):
        k = position if first is None else position - 1
        true = model.at(k) if first is None or position else first
        noise = rng.standard_normal((CONSISTENCY_TRIALS, true.noise.shape[1])) @ true.noise.T
        known = np.zeros_like(noise)
        known[:, : len(true.A)] = x @ gains.step.A.T
        data = known + noise
        innovation = data @ gains.parity.T
        x, theta = data @ gains.gain.T, theta @ gains.retain.T + data @ gains.learn.T
        if innovation.shape[1]:
            nis.append(innovation)
            shared = min(before.shape[1], innovation.shape[1])
            pairs.append(before[:, :shared] * innovation[:, :shared])
        before = innovation
        if position in (0, count // 2, count - 1):
            joint = np.hstack([x + theta @ gains.Upsilon.T if nq else x, theta])
            # Factorisations round relative to the whole noise: a covariance that tends to zero ends there.
            terms = state_terms(gains.step, data_deviations(gains.step, factor))
            parameters = np.linalg.norm(gains.spread, axis=1)
            parameters = parameters + np.abs(gains.learn) @ data_deviations(gains.step, factor)
            # Of states and parameters together: its square is their covariance after the step.
            top = np.hstack([gains.factor, gains.Upsilon @ gains.spread])
            root = np.vstack([top, np.hstack([np.zeros((len(gains.spread), gains.factor.shape[1])), gains.spread])])
            terms = np.concatenate([terms + np.abs(gains.Upsilon) @ parameters, parameters])
            scores[k + 1] = normalised(joint, root, terms)
        factor = gains.factor
    yield from _error_rows(scores)
    squares = np.concatenate([np.zeros(0), *(found.ravel() for found in nis)]) ** 2
    if squares.size:
        yield _band("NIS", "squared whitened innovations per degree of freedom are one", squares)
        products = np.concatenate([found.ravel() for found in pairs])
        if products.size:
            yield _estimated(
                "whiteness",
                "mean product of innovations of successive samples: they are uncorrelated",
                float(products.mean()),
                0.0,
                BAND_DEVIATIONS / float(np.sqrt(products.size)),
                f"{products.size} products",
            )


def data_deviations(step: StepMatrices, factor: FloatArray) -> FloatArray:
    """Return the standard deviations of the data of one step, ``(rows,)``; ``factor (nx, any)``."""
    deviations = np.linalg.norm(step.noise, axis=1)
    deviations[: len(step.A)] = np.hypot(deviations[: len(step.A)], np.linalg.norm(step.A @ factor, axis=1))
    return np.asarray(deviations)


def state_terms(step: StepMatrices, sizes: FloatArray) -> FloatArray:
    """Return how large the terms are that make up the state after a step, for data of these sizes."""
    rows, columns = step.H.shape
    problem = LogBalance(rows + columns)
    problem.add(step.H, range(rows), range(rows, rows + columns))
    # In the units given a part of it may be less than what a pseudoinverse takes for zero.
    units = np.exp2(np.round(problem.solve()))
    left, own = units[:rows], units[rows:]
    inverse = own[:, None] * np.linalg.pinv(left[:, None] * step.H * own) * left
    terms = (np.abs(inverse) @ sizes).T / own
    return np.asarray(((terms + ROUNDED_BESIDE * np.max(terms, axis=-1, keepdims=True)) * own).T)


def normalised(errors: FloatArray, root: FloatArray, terms: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return ``errors (trials, n)`` in units of their covariance ``root root'``, of the rank beside ``terms (n,)``, and
    those that are claimed to be zero in units of the terms."""
    sizes = np.where(terms > 0.0, terms, 1.0)
    left, values, _ = np.linalg.svd(root / sizes[:, None])
    found = (errors / sizes) @ left
    kept = np.flatnonzero(values > KNOWN_SHARE)
    return np.asarray(found[:, kept] / values[kept]), np.delete(found, kept, axis=1)


def _error_rows(scores: Mapping[int, tuple[FloatArray, FloatArray]]) -> Iterator[Check]:
    """Yield NEES at its worst sample, and the errors in directions without covariance."""
    # Errors at different samples are correlated, fully so without process noise: each has a band of its own.
    rows = [
        _band("NEES", "squared errors per degree of freedom are one", found**2, f" at k = {k}")
        for k, (found, _) in scores.items()
        if found.size
    ]
    if rows:
        yield min(rows, key=lambda row: row.margin / (row.bound - 1.0) * np.sign(row.bound - 1.0))
    exact = [float(np.max(np.abs(known))) for _, known in scores.values() if known.size]
    if exact:
        yield upper_bound_check(
            "known directions",
            "where the covariance is zero, so is the error (in units of what it is made of)",
            float(np.max(exact)),
            BAND_DEVIATIONS * KNOWN_SHARE,
            source=_SOURCE,
            detail=f"{CONSISTENCY_TRIALS} trials",
        )


def _band(name: str, claim: str, squares: FloatArray, where: str = "") -> Check:
    """Return the row that the mean of squares of independent standard normal numbers is one."""
    width = BAND_DEVIATIONS * float(np.sqrt(2.0 / squares.size))
    return _estimated(name, claim, float(squares.mean()), 1.0, width, f"mean of {squares.size}{where}")


def _estimated(name: str, claim: str, mean: float, expected: float, width: float, detail: str) -> Check:
    """Return the row that a mean is within so much of what is expected."""
    low, high = expected - width, expected + width
    return Check(
        name,
        claim,
        mean,
        high if mean >= expected else low,
        width - abs(mean - expected),
        bool(low <= mean <= high),
        _SOURCE,
        "computed",
        f"{detail}; chance alone keeps it within {low:.4g} to {high:.4g}, but one time in two million",
        "estimated",
        (low, high),
    )


#: Of more states nothing is proved: work goes with their cube, and bounds grow with them.
MOST_PROVED_STATES = 100


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
    if stated.plant.nx > MOST_PROVED_STATES or _kind(stated) != _kind(shipped):
        return None  # the rows on what fits say so
    errors, joint, lengths, bias, last = _followed(stated.without_walk, shipped.without_walk, steps, gains)
    if stated.adaptation is not None and stated.adaptation.form == "random-walk":
        joint, _, _, other_bias, _ = _followed(stated, shipped, steps, gains)
        bias = max(bias, other_bias)
    mean, span = _mean_factor(errors, lengths, last.factor)
    nq, steps = 0 if shipped.adaptation is None else shipped.plant.nq, sum(lengths)
    together = float(np.exp(min(logarithm_of_product(joint) / steps, 0.0))) if nq and joint else np.nan
    return HorizonProof(steps, bias, mean, span, together, last)


def _kind(observer: RecursiveObserver) -> tuple[object, ...]:
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
    for step, found in zip(_true_steps(stated, shipped, steps), gains(shipped, steps), strict=False):
        step = found.step if step is None else step
        # Steps of another size (corrections of x(0)) are stacks of their own.
        if len(waiting) == AT_ONCE or (waiting and _sizes(*waiting[0]) != _sizes(step, found)):
            bias = max(bias, _closed(waiting, errors, joint, lengths, units))
            waiting = []
        waiting.append((step, found))
        last = found
    if last is None:
        raise SpecError("The plant has no steps.", path="horizon")
    bias = max(bias, _closed(waiting, errors, joint, lengths, units))
    return errors, joint, lengths, bias, last


def natural_units(observer: RecursiveObserver) -> FloatArray:
    """Return sizes of the states that equations and outputs suggest, ``(n,)``; of parameters that walk, one."""
    plant, count = observer.plant, len(observer.recursion.first.x)
    E, A, C = plant.E.at(1), plant.A.at(0), plant.C.at(1)
    return np.concatenate([balance_by_least_squares(E, A, outputs=[C]).states, np.ones(count - plant.nx)])


def _true_steps(stated: RecursiveObserver, shipped: RecursiveObserver, steps: int) -> Iterable[StepMatrices | None]:
    """Return the matrices of the stated plant; `None` for those of the shipped observer."""
    if stated.plant is shipped.plant:
        return repeat(None)
    model = stated.recursion.model
    first = model.first()
    return chain([] if first is None else [first], (model.at(k) for k in range(steps)))


def _sizes(step: StepMatrices, found: GainStep) -> tuple[tuple[int, ...], ...]:
    """Return the shapes that steps of one stack share."""
    return step.H.shape, step.A.shape, found.gain.shape, found.learn.shape


def _closed(
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
    gains, matrices = np.array([found.gain for _, found in pairs]), np.array([step.H for step, _ in pairs])
    middle, radius = _product(gains, matrices)
    one = np.eye(middle.shape[1])
    missed = rounded_up(np.abs(middle - one) + radius, 3)
    # An entry is judged by what rounding of its whole row does to it, in natural units of the states.
    sizes = (np.abs(gains) @ np.abs(matrices) + one) * units
    return float(np.max(missed * units / np.max(sizes, axis=2, keepdims=True), initial=0.0))


_Stack = tuple[FloatArray, FloatArray]


def _product(first: ArrayLike, second: FloatArray) -> _Stack:
    """Return balls that hold the products of two stacks of exact matrices."""
    left = np.asarray(first, dtype=np.float64)
    return stacked_product((left, np.zeros_like(left)), (second, np.zeros_like(second)))


def _transitions(pairs: list[tuple[StepMatrices, GainStep]]) -> tuple[_Stack, _Stack | None]:
    """Return balls of ``L A`` and, with parameters, of the transition of both errors."""
    ne = pairs[0][0].A.shape[0]
    a = np.array([step.A for step, _ in pairs])
    middle, radius = _product([found.gain[:, :ne] for _, found in pairs], a)
    nq, nx = pairs[0][1].retain.shape[0], middle.shape[1]
    if not nq:
        return (middle, radius), None
    taken, taken_radius = _product([found.learn[:, :ne] for _, found in pairs], a)
    whole, whole_radius = (np.zeros((len(pairs), nx + nq, nx + nq)) for _ in range(2))
    whole[:, :nx, :nx], whole_radius[:, :nx, :nx] = middle, radius
    whole[:, nx:, :nx], whole_radius[:, nx:, :nx] = taken, taken_radius
    whole[:, nx:, nx:] = np.array([found.retain for _, found in pairs])
    return (middle, radius), (whole, whole_radius)


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


#: Claims may differ from what is recomputed by this much: they are the same numbers from another run.
CLAIM_TOLERANCE = 1e-6
#: The recursion may differ from the batch solution by this much, relative to standard deviations, times cond H.
BATCH_TOLERANCE = 1e-9


def checks(design: ObserverDesign, printed_digits: int | None) -> Iterator[Check]:
    """Yield every check of ``design``; see `obsynth.verify`."""
    plant, observer = design.recursive
    form = None if observer.adaptation is None else observer.adaptation.form
    yield information(
        "plant: steps", "length of the horizon (0: without end)", float(plant.horizon or 0), source="the plant"
    )
    conditions = tuple(
        recursive_conditions(
            plant, parameters=form is not None, literal=form == "literal", early=observer.early_constraints
        )
    )
    yield from condition_rows(conditions)
    if not all(condition.holds for condition in conditions):
        return
    problem = misfit(design)
    yield fitting_check(
        "observer, options and plant hold the same matrices at every k",
        fits=not problem,
        source="shipped observer",
        kind="equality",
        detail=problem,
    )
    yield from refinement_rows(observer)
    stated = _stated(design)
    if stated is None or observer.plant.nx != plant.nx or observer.plant.ne != plant.ne:
        return
    try:
        # What is checked is the recursion; records that no plant made would seem full of outliers.
        yield from _dynamic_rows(design, plain_recursion(observer), plain_recursion(stated), same=not problem)
    except (ObsynthError, np.linalg.LinAlgError, ValueError) as error:
        yield failed_run(error)


def failed_run(error: Exception) -> Check:
    """Return the row of an observer that does not run."""
    return upper_bound_check(
        "runs",
        "the observer runs on the outputs of its own model",
        1.0,
        0.0,
        source="shipped observer",
        detail=str(error),
    )


def refinement_rows(observer: RecursiveObserver | DAEObserver) -> Iterator[Check]:
    """Yield what holds besides the recursion that is checked: bounds of states, and sensors of their own times."""
    if observer.state_bounds is not None:
        pairs = zip(observer.state_names, observer.state_bounds, strict=True)
        bounded = [name for name, pair in pairs if np.isfinite(pair).any()]
        is_fed_back = isinstance(observer, DAEObserver)
        goes_on = "the next step begins there" if is_fed_back else "the recursion goes on without them"
        yield information(
            "state bounds",
            "estimates are projected onto bounds in the metric of their covariance, which stays that without bounds",
            float(len(bounded)),
            source="options: state_bounds",
            status="assumed",
            detail=f"active for {', '.join(bounded)}; {goes_on}. The true states are assumed to keep the bounds: then "
            "no projection makes a squared error larger in units of the covariance",
        )
    for name, entry in (observer.sensors or {}).items():
        yield information(
            f"sensor {name}",
            "rows between its samples",
            float(entry["every"]),
            source="options: sensors",
            detail=f"its values are delayed by {entry['delay']} row(s); the other rows of this report are about "
            "samples of every sensor at once",
        )


def _dynamic_rows(
    design: ObserverDesign, observer: RecursiveObserver, stated: RecursiveObserver, *, same: bool
) -> Iterator[Check]:
    """Yield the rows on what the observer does; ``same`` says that its matrices are those that are stated."""
    ranks, gains = horizon_ranks(observer.plant, early=observer.early_constraints), gains_once()
    facts = gain_schedule_summary(observer, gains=gains)
    yield information(
        "condition of H",
        "largest condition number of [E_k; C_k]",
        ranks.condition,
        source=f"{SOURCE}, (6)",
        detail=f"at k = {ranks.condition_k}",
    )
    yield information(
        "residual directions",
        "least rank E_k + ny - nx: what (18f) can use",
        float(ranks.directions),
        source="our finding",
        detail=f"at k = {ranks.directions_k}",
    )
    in_batch = batch_steps(stated)
    said = f"{in_batch} steps at once" + (
        ", which the size of the plant allows" if in_batch < min(BATCH_STEPS, looked_at(stated)) else ""
    )
    for name, found in batch_residuals(stated, observer).items():
        yield upper_bound_check(
            f"batch: {name}",
            "the recursion equals the least-squares solution of the whole record",
            found,
            BATCH_TOLERANCE * ranks.condition,
            source=f"{SOURCE}, (6)-(10)",
            kind="equality",
            detail=said,
        )
    # Where both hold the same matrices, they need not be computed twice.
    proof = horizon_proof(observer if same else stated, observer, looked_at(observer), gains=gains)
    yield _contraction_row(facts, proof)
    if proof is not None:
        yield bias_row(proof, ranks.condition)
        yield covariance_row(stated, observer, proof.last)
        yield from parameter_row(proof)
        yield from steady_rows(stated, design.gains, proof.last, ranks.condition)
    if observer.adaptation is not None:
        yield information(
            "excitation",
            "least information on the parameters in a window",
            facts.excitation,
            source=f"{SOURCE}, (26)",
            detail=f"window of {observer.adaptation.window} ends at k = {facts.excitation_k}",
        )
        for name, deviation in zip(observer.fault_names, facts.deviations, strict=True):
            yield information(
                f"noise in fhat[{name}]",
                "standard deviation of the parameter after the last step",
                float(deviation),
                source="recomputed",
                detail=observer.plant.units.get(name, ""),
            )
    yield listed_gains(design, {"L": facts.L, "K": facts.K}, tolerance=CLAIM_TOLERANCE)
    yield _claims(design, facts, ranks)
    yield from consistency(stated, observer, looked_at(observer))


def _contraction_row(facts: GainScheduleSummary, proof: HorizonProof | None) -> Check:
    claim, source = "mean factor per step of the product of L_k A_k", f"{SOURCE}, (13)"
    detail = f"{facts.steps} steps, {facts.span}; an error grows at most by {facts.growth:.3g} on the way"
    proved = proof is not None and proof.contraction < 1.0
    if proof is not None and proved:
        detail = (
            f"at most, in outward rounding of the gains as computed, {proof.span}; computed {facts.contraction:.6g}, "
            f"{detail}"
        )
    value = proof.contraction if proof is not None and proved else facts.contraction
    if facts.steps < STEPS_TO_CONTRACT:
        return information(
            "contraction", claim, value, source=source, detail=detail, status="proved" if proved else "computed twice"
        )
    return upper_bound_check(
        "contraction",
        claim,
        value,
        np.nextafter(1.0, 0.0),
        source=source,
        detail=detail,
        kind="proved" if proved else "computed",
    )


def _claims(design: ObserverDesign, facts: GainScheduleSummary, ranks: HorizonRanks) -> Check:
    claims = design.certificate.claims
    found = {
        "condition": ranks.condition,
        "residual_directions": float(ranks.directions),
        "contraction": facts.contraction,
        "steps": float(facts.steps),
    }
    places = {
        "condition_k": (ranks.condition_k, ranks.condition),
        "excitation_k": (facts.excitation_k, facts.excitation),
    }
    found |= {name: float(k) for name, (k, value) in places.items() if name in claims and not np.isnan(value)}
    if not np.isnan(facts.excitation):
        found["excitation"] = facts.excitation
    # An excitation that is all rounding has no digits to compare.
    return claims_row(design, found, rough=("excitation",))


def claims_row(design: ObserverDesign, found: Mapping[str, float], *, rough: Collection[str]) -> Check:
    """Return the row that claimed numbers are found again, relative to their size; small ``rough`` ones as they are."""
    claims, tiny = design.certificate.claims, float(np.finfo(np.float64).tiny)
    gaps = [
        abs(claims.get(name, np.nan) - value) / max(abs(value), CLAIM_TOLERANCE if name in rough else tiny)
        for name, value in found.items()
    ]
    return upper_bound_check(
        "claims", "every claimed number is found again", float(np.max(gaps)), CLAIM_TOLERANCE, source="certificate"
    )


def _stated(design: ObserverDesign) -> RecursiveObserver | None:
    """Return the observer that plant and options stand for, or ``None`` when they stand for none."""
    try:
        return observer_from_options(design.recursive[0], design.options)
    except (ObsynthError, KeyError, TypeError):
        return None


def misfit(design: ObserverDesign) -> str:
    """Return what does not fit between a design's plant, options and shipped observer; empty when all does."""
    plant, observer = design.recursive
    stated = _stated(design)
    if stated is None:
        return "the options stand for no observer of this plant"
    filters = ("early_constraints", "outliers", "outlier_limit", "outlier_sizes", "sensors", "state_bounds")
    names = ("state_names", "input_names", "output_names", "parameter_names", "dt", "horizon")
    labels = ("units", "scales", "operating_point")
    adaptation = ("form", "forgetting", "guard", "window", "reset", "initial_parameters", "initial_covariance", "walk")
    for ours, theirs, fields in (
        (stated, observer, filters),
        (plant, observer.plant, (*names, *labels)),
        (stated.adaptation, observer.adaptation, adaptation),
        (stated, observer, ("initial_state", "initial_covariance")),
    ):
        if ours is None or theirs is None:
            if ours is not theirs:
                return "adaptation"
            continue
        for field in fields:
            if not np.array_equal(getattr(ours, field), getattr(theirs, field)):
                return field
    pairs: dict[str, tuple[MatrixSequence, MatrixSequence]] = {
        name: (matrix, observer.plant.matrices[name]) for name, matrix in plant.matrices.items()
    }
    pairs |= {"Q": (stated.Q, observer.Q), "R": (stated.R, observer.R)}
    steps = looked_at(stated)
    for name, (first, second) in pairs.items():
        begin = 1 if name in ("E", "C") else 0
        last = begin + 1 if first.is_constant and second.is_constant else begin + steps
        for k in range(begin, last):
            if not np.array_equal(first.at(k), second.at(k)):
                return f"{name}({k})"
    return ""


#: Steps in the batch: enough for every matrix to matter, few enough for one dense problem.
BATCH_STEPS = 6
#: Of many states fewer: as many as keep the problem to this many rows, but two at least.
MOST_BATCH_ROWS = 1500
#: Seed of the record that both are given; the estimators are linear, so any record will do.
RECORD_SEED = 2013


def batch_steps(stated: RecursiveObserver) -> int:
    """Return how many steps the size of a plant allows in one batch."""
    rows = len(stated.recursion.model.at(0).H)
    return min(BATCH_STEPS, looked_at(stated), max(2, (MOST_BATCH_ROWS - stated.plant.nx) // rows))


def batch_residuals(stated: RecursiveObserver, shipped: RecursiveObserver) -> dict[str, float]:
    """Return how far the shipped recursion is from the batch solution of the stated problem."""
    steps = batch_steps(stated)
    y, u = _record(stated, steps + 1)
    running, reference = shipped.init(), stated.init()
    for k in range(steps + 1):
        before = reference.x, reference.factor, reference.Upsilon
        running, _ = shipped.advance(running, y[k], u[k])
        reference, _ = stated.advance(reference, y[k], u[k])
    exact = _solved(stated, y, u)
    made_of = _terms(stated.recursion.model.at(steps - 1), before, (y[-1], u[-2], u[-1]))
    covariance = exact.factor @ exact.factor.T
    size = made_of[:, 0] + np.abs(exact.estimate[:, 0]) + np.finfo(np.float64).tiny
    found = running.factor @ running.factor.T
    gaps = {
        "state": np.abs(running.x - exact.estimate[:, 0]) / size,
        "covariance": np.abs(found - covariance) / np.maximum(np.outer(size, size), np.finfo(np.float64).tiny),
    }
    if running.Upsilon.shape[1]:
        regressor = exact.estimate[:, 1:]
        sizes = np.linalg.norm(regressor, axis=0) + np.linalg.norm(made_of[:, 1:], axis=0) + np.finfo(np.float64).tiny
        gaps["regressor"] = np.abs(running.Upsilon - regressor) / sizes
    return {name: float(np.max(gap)) for name, gap in gaps.items()}


def _terms(
    step: StepMatrices, before: tuple[FloatArray, FloatArray, FloatArray], data: tuple[FloatArray, ...]
) -> FloatArray:
    """Return the terms of deviation and regressor ``(nx, 1 + nq)``: what tends to zero rounds as they do."""
    (x, factor, upsilon), (y, u, after) = before, data
    driven = np.abs(step.A) @ np.abs(x) + np.abs(step.B) @ np.abs(u)
    values = np.concatenate([driven, np.abs(y), np.abs(step.Dn) @ np.abs(after)]) + data_deviations(step, factor)
    nq = upsilon.shape[1]
    regressors = np.vstack([np.abs(step.A) @ np.abs(upsilon) + np.abs(step.Phi[:, :nq]), np.abs(step.Psi[:, :nq])])
    return state_terms(step, np.hstack([values[:, None], regressors]))


def _record(observer: RecursiveObserver, samples: int) -> tuple[FloatArray, FloatArray]:
    """Return a random record, changed as little as is needed where equations without noise would contradict it."""
    from scipy.linalg import qr

    plant, rng = observer.plant, np.random.default_rng(RECORD_SEED)
    y, u = rng.standard_normal((samples, plant.ny)), rng.standard_normal((samples, plant.nu))
    H, S, data = _problem(observer, y, u)
    # Directions without noise, by two factorisations that cost a tenth of the singular values; in no unit.
    rows = _row_sizes(observer, H, S)
    moved = H * np.tile(natural_units(observer), samples)
    triangle = qr((np.hstack([moved, S[:, S.any(axis=0)]]) / rows[:, None]).T, mode="r")[0]
    basis, kept, _ = qr(triangle[: len(H)].T, pivoting=True)
    sizes = np.abs(np.diagonal(kept))
    perfect = basis[:, numerical_rank(sizes) :] / rows[:, None]
    if not perfect.shape[1]:
        return y, u
    # The data are affine in the record: a column of the map is the difference that one sample makes.
    zero = np.zeros(y.size + u.size)
    none = _data(observer, *_split(zero, y, u))[:, 0]
    unit = np.eye(zero.size)
    effect = np.array([perfect.T @ (_data(observer, *_split(one, y, u))[:, 0] - none) for one in unit]).T
    flat = np.concatenate([y.ravel(), u.ravel()])
    return _split(flat - np.linalg.pinv(effect, rcond=RANK_TOLERANCE) @ (perfect.T @ data[:, 0]), y, u)


def _row_sizes(observer: RecursiveObserver, H: FloatArray, S: FloatArray) -> FloatArray:
    """Return the size of each row of ``[H S]`` with the states in natural units, a power of two."""
    units = np.tile(natural_units(observer), H.shape[1] // len(natural_units(observer)))
    return power_of_two_below(np.maximum(*(np.max(np.abs(part), axis=1, initial=0.0) for part in (H * units, S))))


def _split(flat: FloatArray, y: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
    return flat[: y.size].reshape(y.shape), flat[y.size :].reshape(u.shape)


def _solved(observer: RecursiveObserver, y: FloatArray, u: FloatArray) -> LeastSquaresStep:
    """Return the last state of the solution over all states at once; further columns belong to the parameters."""
    H, S, data = _problem(observer, y, u)
    n = H.shape[1] // len(y)
    # A factorisation adds rows: in units in which they are alike, which are powers of two, none loses its digits.
    rows = _row_sizes(observer, H, S)
    H, S, data = (part / rows[:, None] for part in (H, S, data))
    found = least_squares_step(H, S, data) or rank_revealing_step(H, S, data, np.zeros((len(H), 0)))
    return LeastSquaresStep(found.estimate[-n:], found.factor[-n:], found.innovation, found.diffuse[-n:])


def _data(observer: RecursiveObserver, y: FloatArray, u: FloatArray) -> FloatArray:
    """Return the data of `_problem`; further columns belong to the parameters."""
    start, model = observer.init(), observer.recursion.model
    n, nq = len(start.x), start.Upsilon.shape[1]
    parts = [np.hstack([start.x[:, None], np.zeros((n, nq))])]
    for k in range(len(y) - 1):
        step = model.at(k)
        values = np.concatenate([step.B @ u[k], y[k + 1], step.Dn @ u[k + 1]])
        parts.append(np.hstack([values[:, None], np.vstack([step.Phi, -step.Psi])[:, :nq]]))
    if (first := model.first()) is not None:
        parts.append(np.hstack([(first.Dn @ u[0])[:, None], -first.Psi[:, :nq]]))
    return np.vstack(parts)


def _problem(observer: RecursiveObserver, y: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return H, S and data of ``data = H x + S e`` for all states at once."""
    start, model, steps = observer.init(), observer.recursion.model, len(y) - 1
    n, listed = len(start.x), [model.at(k) for k in range(steps)]
    H = np.zeros((n + sum(len(step.H) for step in listed), n * (steps + 1)))
    roots = [start.factor, *(step.noise for step in listed)]
    H[:n, :n] = np.eye(n)
    top = n
    for k, step in enumerate(listed):
        H[top : top + len(step.H), (k + 1) * n : (k + 2) * n] = step.H
        H[top : top + len(step.A), k * n : (k + 1) * n] = -step.A
        top += len(step.H)
    if (first := model.first()) is not None:
        H = np.vstack([H, np.hstack([first.H[n:], np.zeros((len(model.late), n * steps))])])
        roots.append(first.noise[n:])
    S = np.zeros((len(H), max(sum(root.shape[1] for root in roots), len(H))))
    top = left = 0
    for root in roots:
        S[top : top + len(root), left : left + root.shape[1]] = root
        top, left = top + len(root), left + root.shape[1]
    return H, S, _data(observer, y, u)


#: An enclosure of variances that is wider than this share of the filter's says nothing about definiteness.
WIDEST = 0.1
#: So many deviations are listed in a row.
LISTED_DEVIATIONS = 6
#: Both ends are told where the upper one is so many times the lower one.
BOTH_ENDS = 1.001


def steady_rows(
    stated: RecursiveObserver, gains: Mapping[str, FloatArray], recomputed: GainStep, condition: float
) -> Iterator[Check]:
    """Yield the rows on the listed gains, were they kept for ever; of a plant and noise that stay the same."""
    plant = stated.plant
    if not (plant.is_time_invariant and stated.Q.is_constant and stated.R.is_constant) or stated.early_constraints:
        return
    E, A, C, ne = plant.E.at(1), plant.A.at(0), plant.C.at(1), plant.ne
    L, K = gains.get("L", recomputed.gain[:, :ne]), gains.get("K", recomputed.gain[:, ne:])
    if L.shape != (plant.nx, ne) or K.shape != (plant.nx, plant.ny):
        return  # the row on the listed gains says so
    step = StepMatrices(np.vstack([E, C]), A, *recomputed.step[2:])
    listed = recomputed._replace(gain=np.hstack([L, K]))
    yield upper_bound_check(
        "steady state: unbiased",
        "L E + K C = I for the listed gains",
        largest_bias([(step, listed)], natural_units(stated)[: plant.nx]),
        EQUALITY_TOLERANCE * condition,
        source=f"{SOURCE}, (10)-(11)",
        kind="proved",
        detail="in units of its terms, outward rounded",
    )
    transition = Ball.exact(L) @ Ball.exact(A)
    contraction = prove_contraction(transition, discrete=True)
    claim = "errors decay with the listed gains, were they kept: modulus per step in a norm"
    source = f"{SOURCE}, (13); Lyapunov inequality of L A"
    if contraction is None:
        radius = spectral_radius(transition.midpoint)
        if spectral_radius(recomputed.gain[:, :ne] @ A) >= CLEARLY_STABLE:
            yield information(
                "steady state: contraction",
                claim,
                radius,
                source=source,
                detail="the gains of the last step make no steady filter (yet)",
            )
            return
        yield upper_bound_check(
            "steady state: contraction",
            claim,
            radius,
            np.nextafter(1.0, 0.0),
            source=source,
            detail="eigenvalues computed: no inequality was proved",
        )
        return
    rate = proved_rate(transition, contraction)
    yield upper_bound_check(
        "steady state: contraction",
        claim,
        np.nan if rate is None else rate,
        np.nextafter(1.0, 0.0),
        source=source,
        kind="proved",
        detail="outward rounded",
    )
    variances = np.einsum("ij,ij->i", recomputed.factor, recomputed.factor)[: plant.nx]
    yield _steady_covariance(stated, transition, (L, K), contraction, variances)


def _steady_covariance(
    stated: RecursiveObserver,
    transition: Ball,
    gains: tuple[FloatArray, FloatArray],
    contraction: Contraction,
    variances: FloatArray,
) -> Check:
    """Return the row on the covariance that errors reach with kept gains; ``variances (nx,)`` after the last step.

    Of X, with ``D = F X F' + L Q L' + K R K' - X``, the true one is ``X + sum F^j D F'^j``; the sum is at most
    ``|Q D Q'| / (1 - rate^2)`` in the norm of the contraction.
    """

    claim = "covariance of the errors that the listed gains lead to, enclosed: positive definite"
    L, K = (Ball.exact(part) for part in gains)
    noise = L @ Ball.exact(stated.Q.at(0)) @ L.T + K @ Ball.exact(stated.R.at(0)) @ K.T
    with warnings.catch_warnings(action="ignore"):
        # The enclosure says what an ill-conditioned equation costs.
        found = discrete_lyapunov(transition.midpoint, noise.midpoint)
    X = Ball.exact((found + found.T) / 2.0)
    norm = Ball.exact(contraction.Q)
    gap = norm @ (transition @ X @ transition.T + noise - X) @ norm.T
    # One minus the rate squared, in a form that does not cancel: three roundings, which the radius below covers.
    share = (1.0 - contraction.rate) * (1.0 + contraction.rate)
    # Every row of the inverse is seen on its own.
    seen = rounded_up(column_norms(Ball.exact(contraction.inverse).T) / (1.0 - contraction.defect), 4)
    radius = rounded_up(np.outer(seen, seen) * gap.frobenius_norm / share, 8)
    enclosed = Ball(X.midpoint, radius)
    middle, spread = np.diag(X.midpoint), np.diag(radius)
    low, high = np.sqrt(np.maximum(middle - spread, 0.0)), np.sqrt(rounded_up(np.abs(middle) + spread, 4))
    proof = prove_positive_definite(enclosed)
    certain = bool(np.all(spread <= WIDEST * variances))
    deviations = [
        f"{name} {low[i]:.4g} to {high[i]:.4g}" if high[i] > low[i] * BOTH_ENDS else f"{name} {high[i]:.4g}"
        for i, name in enumerate(stated.plant.state_names)
    ]
    detail = (
        f"standard deviations {listed(deviations, most=LISTED_DEVIATIONS)}; the filter itself, whose gains change, "
        "ends at or below these"
    )
    source = "P = L A P A' L' + L Q L' + K R K', outward rounded"
    if proof.proved:
        return Check(
            "steady state: covariance", claim, proof.lower_bound, 0.0, proof.lower_bound, True, source, "proved", detail
        )
    if certain and noise_is_definite(stated):
        plant = stated.plant
        H = np.vstack([plant.E.at(1), plant.C.at(1)])
        row = definite_by_its_noise("steady state: covariance", claim, np.hstack(gains), H, natural_units(stated))
        return replace(row, detail=f"{detail}; {row.detail}")
    return information(
        "steady state: covariance",
        "largest standard deviation that the listed gains lead to, enclosed",
        float(np.max(high, initial=0.0)),
        source=source,
        status="proved",
        detail=detail,
    )
