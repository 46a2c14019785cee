"""Checks of the observer of a DAE: fit, derivatives, solvability along a run, contraction, consistency by Monte Carlo.

Source of the claims: Moussa Ali, Zhang 2013 (DAE), (7)-(9), (26); the bands are ours.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from obsynth.analysis.existence.moussaali_dae import SOURCE, dae_conditions
from obsynth.errors import ObsynthError, SolverError
from obsynth.methods.engines.recursive.checks import CLAIM_TOLERANCE, claims_row, failed_run, refinement_rows
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.newton import LARGEST_RESIDUAL
from obsynth.numerics.outward import lower_text
from obsynth.numerics.ranks import RANK_TOLERANCE, SINGULAR_CONDITION, covariance_factor
from obsynth.observers.batches import run_dae_batch
from obsynth.observers.changed_options import plain_recursion
from obsynth.observers.nonlinear.building import (
    FEWEST_STEPS,
    OPTIONS,
    DAEFacts,
    dae_facts,
    dae_observer_from_options,
    resolved_options,
)
from obsynth.observers.nonlinear.observer import DAEObserver
from obsynth.proofs.balls import Ball
from obsynth.proofs.contraction import proved_rate
from obsynth.proofs.definiteness import prove_positive_definite
from obsynth.proofs.products import logarithm_of_product
from obsynth.results.checks import Check, fitting_check, information, upper_bound_check
from obsynth.results.design import ObserverDesign
from obsynth.simulation.dae import simulate_dae
from obsynth.verification.claims import listed_gains
from obsynth.verification.plant import condition_rows

#: Central differences over this share of a size leave about its square, and rounding over it.
DERIVATIVE_DIFFERENCE = 1e-5

#: So much may be left between differences and derivatives, in sizes of the signals.
DERIVATIVE_TOLERANCE = 1e-6

#: Runs and steps of the Monte Carlo: with one parameter the mean of 48 squares is wrong by the factor below one time in
#: several hundred.
MONTE_CARLO_RUNS = 48

#: So many where those seem to refute the covariances.
MORE_TRIALS = 240

TRIAL_STEPS = 40

#: Starts that have no first step, and of the shortest runs those from which the plant comes to where it has no
#: solution, are drawn again, so many for each trial at most: where most of what is stated is no state of the plant,
#: trials of the rest say nothing of it.
MOST_REDRAWN = 1.0

MONTE_CARLO_SEED = 20130206

#: A mean of normalised squares may be off by this factor: covariances of a nonlinear plant are first-order ones.  Less
#: than this is left to the information in the row.
CONSISTENCY_FACTOR = 2.0

#: Between these probabilities lie 95 %.
TAIL_PROBABILITIES = (0.025, 0.975)


def checks(design: ObserverDesign, printed_digits: int | None) -> Iterator[Check]:
    """Yield every check of ``design``; see `obsynth.verify`."""
    plant, observer = design.nonlinear
    conditions = tuple(dae_conditions(plant, observer.dt))
    yield from condition_rows(conditions)
    if not all(condition.holds for condition in conditions):
        return
    problem = misfit(design)
    yield fitting_check(
        "observer, options and plant hold the same model and numbers",
        fits=not problem,
        source="shipped observer",
        kind="equality",
        detail=problem,
    )
    yield from refinement_rows(observer)
    # What is checked is the recursion; records that no plant made would seem full of outliers.
    observer = plain_recursion(observer)
    try:
        facts = dae_facts(observer)
        yield from _model_rows(observer, facts)
        yield listed_gains(design, {"K": facts.K, "Upsilon": facts.Upsilon}, tolerance=CLAIM_TOLERANCE)
        claims = {
            "index": float(facts.index),
            "condition": facts.condition,
            "contraction": facts.contraction,
            "steps": float(facts.steps),
        }
        yield claims_row(design, claims, rough=claims)
        yield from _consistency_rows(design, observer, min(TRIAL_STEPS, facts.steps))
    except (ObsynthError, np.linalg.LinAlgError, ValueError, KeyError, TypeError) as error:
        yield failed_run(error)


def misfit(design: ObserverDesign) -> str:
    """Return what does not fit between a design's plant, options and shipped observer; empty when all does."""
    plant, observer = design.nonlinear
    try:
        stated = resolved_options(dae_observer_from_options(plant, design.options))
    except (ObsynthError, KeyError, TypeError, ValueError):
        return "the options stand for no observer of this plant"
    shipped = resolved_options(observer)
    for name in OPTIONS:
        if not np.array_equal(np.asarray(stated[name], dtype=object), np.asarray(shipped[name], dtype=object)):
            return name
    if plant is observer.model:
        return ""
    if not (plant.is_data and observer.model.is_data):
        return "model"
    first, second = plant.as_dict(), observer.model.as_dict()
    return next((name for name in first if list(first[name].items()) != list(second[name].items())), "")


def _model_rows(observer: DAEObserver, facts: DAEFacts) -> Iterator[Check]:
    names, priors = observer.fault_names, np.sqrt(np.diag(observer.initial_parameter_covariance))
    yield upper_bound_check(
        "condition of (7)",
        "dF/dx' / dt + dF/dx is far from singular along the nominal run",
        facts.condition,
        SINGULAR_CONDITION,
        source=f"{SOURCE}, (7)",
        detail=f"worst at k = {facts.condition_k}",
    )
    yield upper_bound_check(
        "Newton residual",
        "every step of the nominal run solves its equations",
        facts.residual,
        LARGEST_RESIDUAL,
        source="recomputed",
        kind="equality",
    )
    yield upper_bound_check(
        "derivatives",
        "F, G, H and L equal central differences of converged steps",
        _derivative_gap(observer),
        DERIVATIVE_TOLERANCE,
        source=f"{SOURCE}, (8), (9)",
        kind="equality",
    )
    yield from _proved_rows(observer, facts)
    deviations = facts.identifiable.deviations[observer.model.nx :]
    for name, prior, bound, deviation in zip(names, priors, deviations, facts.deviations, strict=True):
        unit = observer.model.units.get(name, "")
        detail = (
            "from these outputs alone, with the start unknown and no process noise, the least deviation is "
            f"{lower_text(bound, 3)} {unit} (Cramer-Rao)"
            if np.isfinite(bound)
            else "the outputs alone do not determine it"
        )
        yield information(
            f"excitation: {name}",
            "information in the outputs of the nominal run, in prior deviations to the power -2",
            float((prior / bound) ** 2),
            source=f"{SOURCE}, (26)",
            detail=detail,
        )
        yield information(
            f"noise in fhat[{name}]",
            "standard deviation after the nominal run",
            float(deviation),
            source="recomputed",
            detail=unit,
        )
    if len(names) > 1:
        off = np.abs(facts.correlations - np.diag(np.diag(facts.correlations)))
        i, j = np.unravel_index(int(np.argmax(off)), off.shape)
        yield information(
            "crosstalk",
            "largest correlation between errors of parameters",
            float(off[i, j]),
            source="recomputed",
            detail=f"{names[int(i)]}, {names[int(j)]}",
        )


def _proved_rows(observer: DAEObserver, facts: DAEFacts) -> Iterator[Check]:
    """Yield what is proved of the linearisation along the nominal run, for all derivatives that the row allows."""
    units = observer.model.state_scales
    scaled = np.abs(facts.transitions) * units[None, None, :] / units[None, :, None]
    sizes = np.maximum(1.0, scaled.max(axis=(1, 2), keepdims=True, initial=0.0))
    allowed = DERIVATIVE_TOLERANCE * sizes * (units[:, None] / units[None, :])[None]
    last = Ball(facts.transitions[-1], allowed[-1])
    rate = proved_rate(last)
    claim = (
        "where the parameters are known, F (I - K H) at the end of the nominal run makes errors smaller: its spectral "
        "radius"
    )
    source, decay = f"{SOURCE}, convergence", f"decay in {facts.decay_time:.3g} steps"
    scope = f"for all derivatives within {DERIVATIVE_TOLERANCE:g} of the computed ones, in sizes of the signals"
    if rate is None:
        yield upper_bound_check(
            "contraction",
            claim,
            facts.contraction,
            np.nextafter(1.0, 0.0),
            source=source,
            detail=f"eigenvalues computed, no inequality was proved; {decay}",
        )
    else:
        yield upper_bound_check(
            "contraction",
            f"{claim} is at most",
            rate,
            np.nextafter(1.0, 0.0),
            source=source,
            kind="proved",
            detail=f"Lyapunov inequality {scope}; computed {facts.contraction:.6g}, {decay}",
        )
    powers = np.exp2(np.round(np.log2(units)))
    pairs = zip(facts.transitions, allowed, strict=True)
    mean = float(np.exp(logarithm_of_product([Ball(*pair) for pair in pairs], powers) / len(facts.transitions)))
    proved = mean < 1.0
    yield information(
        "contraction along the run",
        "bound on the mean factor per step of the product of F (I - K H), in sizes of the states",
        mean,
        source=source,
        status="proved" if proved else "assumed",
        detail=f"{len(facts.transitions)} steps, outward rounding, {scope}" if proved else "not proved to be below one",
    )
    if not len(facts.deviations):
        return
    deviations = np.where(facts.deviations > 0.0, facts.deviations, 1.0)
    inverse = np.diag(np.exp2(-np.round(np.log2(deviations))))
    proof = prove_positive_definite(inverse @ facts.parameter_covariance @ inverse)
    yield information(
        "covariance",
        "the covariance of the parameters after the nominal run is positive definite, in units of their "
        "deviations: lower bound on its smallest eigenvalue",
        proof.lower_bound,
        source="recomputed",
        status="proved" if proof.proved else "recomputed",
        detail=proof.text,
    )


def _derivative_gap(observer: DAEObserver) -> float:
    """Return the largest gap between derivatives and differences, in sizes of the signals."""
    model, running = observer.model, observer.start()
    u, nothing = np.array(model.nominal_input), np.full(model.ny, np.nan)
    x, theta = running.raw_step(nothing, u).part("posterior"), np.array(observer.initial_parameters)
    solved = running.raw_step(nothing, u)
    H, L = solved.part("H"), solved.part("L")
    exact = np.vstack([np.hstack([solved.part("F"), solved.part("G")]), np.hstack([H, L])])
    priors = np.sqrt(np.diag(observer.initial_parameter_covariance))
    sizes = np.concatenate([model.state_scales, priors])
    output_sizes = np.abs(H) @ model.state_scales + np.abs(L) @ priors
    rows = np.concatenate([model.state_scales, np.where(output_sizes > 0.0, output_sizes, 1.0)])
    step, end = observer.steps.implicit, solved.part("posterior") - x

    def step_and_outputs(point: FloatArray) -> FloatArray:
        """Return the end of a step from a point, and the outputs of the point moved to where the step ends."""
        x_moved, theta_moved = point[: model.nx], point[model.nx :]
        reached = step.solve_carefully(x_moved, u, theta_moved).x
        return np.concatenate([reached, step.functions.outputs(x_moved + end, theta_moved)[0]])

    centre, worst = np.concatenate([x, theta]), 0.0
    for j, size in enumerate(sizes):
        moved = np.zeros(len(sizes))
        moved[j] = DERIVATIVE_DIFFERENCE * size
        slope = (step_and_outputs(centre + moved) - step_and_outputs(centre - moved)) / (2.0 * DERIVATIVE_DIFFERENCE)
        gap = np.abs(slope - exact[:, j] * size) / rows
        worst = float(np.maximum(worst, gap.max() / max(1.0, float(np.abs(exact[:, j] * size / rows).max()))))
    return worst


def _consistency_rows(design: ObserverDesign, shipped: DAEObserver, steps: int) -> Iterator[Check]:
    """Run the shipped observer on noise, starts and parameters as they are stated in the options: over so many steps,
    or half of them where one of these runs comes to where the plant has no solution; an unstable one may do so in any
    number of steps."""
    shortest = steps < 2 * FEWEST_STEPS
    try:
        errors, squares, degrees, redrawn = _squared_errors(design, shipped, steps, to_the_end=shortest)
    except SolverError:
        if shortest:
            raise
        yield from _consistency_rows(design, shipped, steps // 2)
        return
    without = f"no solution over {steps} steps" if shortest else "no first step"
    again = f"; starts that have {without} were drawn again: {redrawn}" if redrawn else ""
    plant = design.nonlinear[0]
    of = "parameters" if plant.nq else "states"
    for name, claim, mean, count in (
        (
            "NEES",
            f"squared errors of the {of} per degree of freedom are one, within a factor of {CONSISTENCY_FACTOR:g}",
            float(np.mean(errors)),
            float(errors.size * (plant.nq or plant.nx)),
        ),
        (
            "NIS",
            f"squared innovations per degree of freedom are one, within a factor of {CONSISTENCY_FACTOR:g}",
            squares / degrees,
            degrees,
        ),
    ):
        low, high = _band(count)
        bound = CONSISTENCY_FACTOR if mean >= 1.0 else 1.0 / CONSISTENCY_FACTOR
        yield Check(
            name,
            claim,
            mean,
            bound,
            bound - mean if mean >= 1.0 else mean - bound,
            bool(_ratio(mean) <= CONSISTENCY_FACTOR),
            "recomputed, Monte Carlo with a fixed seed",
            "computed",
            f"mean of {errors.size} runs of {steps} steps at nominal inputs{again}; by chance alone, with exact "
            f"covariances, it lies within {low:.3f} to {high:.3f} in 95 % of such samples",
            "estimated",
            (low, high),
        )


def _squared_errors(
    design: ObserverDesign, shipped: DAEObserver, steps: int, *, to_the_end: bool
) -> tuple[FloatArray, float, float, int]:
    """Return squared errors of the parameters (of the states, where there are none) per degree of freedom of each run,
    the sum of squared innovations of all with their number, and how many starts were drawn again, see `_simulated`."""
    stated = dae_observer_from_options(design.nonlinear[0], design.options)
    rng = np.random.default_rng(MONTE_CARLO_SEED)
    errors, squares, degrees, redrawn = np.zeros(0), 0.0, 0.0, 0
    # What a few runs seem to refute, more of them decide: a right filter is not refused for its draws.
    for trials in (range(MONTE_CARLO_RUNS), range(MONTE_CARLO_RUNS, MORE_TRIALS)):
        records, failed = _simulated(stated, rng, trials, steps, to_the_end=to_the_end)
        more, nis, counted = _errors_of(stated, shipped, records)
        errors, squares, degrees = np.concatenate([errors, more]), squares + nis, degrees + counted
        redrawn += failed
        if max(_ratio(float(np.mean(errors))), _ratio(squares / degrees)) <= CONSISTENCY_FACTOR:
            break
    return errors, squares, degrees, redrawn


def _ratio(mean: float) -> float:
    """Return how far a mean is from one, as a factor above one."""
    return float(np.exp(abs(np.log(mean))))


def _simulated(
    stated: DAEObserver, rng: np.random.Generator, trials: range, steps: int, *, to_the_end: bool
) -> tuple[list[tuple[FloatArray, FloatArray, FloatArray]], int]:
    """Return the last parameters and states and the outputs of each trial; and how many starts were drawn again: those
    without a first step, or (``to_the_end``) without any of the steps."""
    records: list[tuple[FloatArray, FloatArray, FloatArray]] = []
    redrawn = 0
    while len(records) < len(trials):
        try:
            records.append(_record(stated, rng, MONTE_CARLO_SEED + trials[len(records)], steps))
        except SolverError as error:
            redrawn += 1
            if (error.record.get("k") != 1 and not to_the_end) or redrawn > MOST_REDRAWN * len(trials):
                raise
    return records, redrawn


def _record(
    stated: DAEObserver, rng: np.random.Generator, seed: int, steps: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the last parameters and states, and the outputs, of a plant whose start and parameters are as stated."""
    spread = covariance_factor(stated.initial_parameter_covariance, "initial_parameter_covariance")
    theta = stated.initial_parameters + spread @ rng.standard_normal(stated.model.nq)
    path = np.tile(theta, (steps + 1, 1))
    walk = np.zeros((stated.model.nq, stated.model.nq))
    if stated.form != "forgetting":
        walk = covariance_factor(stated.random_walk, "random_walk")
    if walk.any():
        # Where a walk is stated, the parameters walk.
        path[1:] += np.cumsum(rng.standard_normal((steps, stated.model.nq)) @ walk.T, axis=0)
    path = np.clip(path, stated.lower, stated.upper)
    root = covariance_factor(stated.initial_covariance, "initial_covariance")
    truth = simulate_dae(
        stated.model,
        np.tile(stated.model.nominal_input, (steps + 1, 1)),
        dt=stated.dt,
        parameters=path,
        initial_state=stated.initial_state + root @ rng.standard_normal(stated.model.nx),
        Q=stated.Q,
        R=stated.R,
        integration=stated.integration,
        seed=seed,
    )
    return path[-1], truth.states[-1], truth.outputs


def _errors_of(
    stated: DAEObserver, shipped: DAEObserver, records: Sequence[tuple[FloatArray, FloatArray, FloatArray]]
) -> tuple[FloatArray, float, float]:
    """Return squared errors of the parameters (of the states, where there are none) per degree of freedom of each
    record, and squared innovations with their number."""
    parameters, states, outputs = (np.array(part) for part in zip(*records, strict=True))
    u = np.tile(stated.model.nominal_input, (outputs.shape[1], 1))
    # As C it would be faster, but the compiler takes longer than all of this.
    batch = run_dae_batch(shipped, outputs, u, compiled=False, progress=False)
    if stated.model.nq:
        gaps = batch.parameters[:, -1] - parameters
        weighted = np.linalg.solve(batch.parameter_covariances[:, -1], gaps[:, :, None])[:, :, 0]
        errors = np.sum(gaps * weighted, axis=1) / gaps.shape[1]
    else:
        ends = [shipped.run(y, u, progress=False).state_covariances[-1] for y in outputs]
        errors = _state_errors(batch.states[:, -1] - states, ends, stated)
    return errors, float(batch.nis[:, 1:].sum()), float(batch.nis_degrees[:, 1:].sum())


def _state_errors(gaps: FloatArray, covariances: Sequence[FloatArray], stated: DAEObserver) -> FloatArray:
    """Return squared errors of states per degree of freedom ``(trials,)``: in the directions that are uncertain, as
    algebraic equations without noise leave none in others."""
    units, errors = stated.model.state_scales, np.zeros(len(gaps))
    for trial, (gap, covariance) in enumerate(zip(gaps / units, covariances, strict=True)):
        values, vectors = np.linalg.eigh(covariance / np.outer(units, units))
        uncertain = values > RANK_TOLERANCE * values[-1]
        errors[trial] = np.mean((vectors[:, uncertain].T @ gap) ** 2 / values[uncertain])
    return errors


def _band(count: float) -> tuple[float, float]:
    """Return where the mean of so many squares of standard normal numbers lies with 95 % (chi squared)."""
    from scipy.special import gammaincinv

    low, high = (2.0 * float(gammaincinv(count / 2.0, share)) / count for share in TAIL_PROBABILITIES)
    return low, high
