"""Unknown-input PI observer: M. M. Share Pasand, M. Aliyari Sh., H. D. Taghirad, (4), (19), procedures 1 and 2.

Unlike the paper: existence by (D1)-(D3); each fault has its own exosystem; ``E#, C#, G`` (10), (11) only on request; K
and the free part of the decoupling (the paper's G) can be designed together; where (D1) fails at index 1, elimination.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from obsynth.analysis.existence.augmented_pencils import number, numbers
from obsynth.analysis.existence.sharepasand import Existence, existence
from obsynth.conditions.lmi import chosen_solver
from obsynth.conditions.options import own_terms
from obsynth.errors import ObsynthError, PreconditionError, SolverError
from obsynth.methods.engines.fewer_sensors import AS_QUIET, left_out, with_fewer_sensors
from obsynth.methods.engines.kalman_problem import NOISE_PRICE, KalmanProblem, compromise
from obsynth.methods.engines.region import region_gain
from obsynth.methods.engines.sensor_noise import error_deviation, fault_deviation
from obsynth.methods.method import Synthesis
from obsynth.methods.refusals import require_all_conditions
from obsynth.methods.ui_pi_observer.assembly import assembled
from obsynth.methods.ui_pi_observer.method import UiPiObserver
from obsynth.methods.ui_pi_observer.placement_problem import PlacementProblem, kalman_problem, placement_problem
from obsynth.numerics.arrays import SMALLEST, FloatArray
from obsynth.numerics.eigenstructure import place
from obsynth.numerics.invariant_zeros import is_outside
from obsynth.numerics.placed_noise import PlacedNoise
from obsynth.numerics.ranks import NEGLIGIBLE_MODE
from obsynth.numerics.regions import NamedRegion
from obsynth.numerics.requested_poles import checked_poles
from obsynth.numerics.spectra import decay_rates, eigenvalues
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.faults import Exosystem, exosystem
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.plants.transformations.redundant_outputs import MergedOutputs, merged_outputs, nearly_merged_outputs
from obsynth.verification.error_system import ErrorModel, contraction_of

#: Least decay rate in 1/s, which avoids a division by zero for an observer that does not settle.
SLOWEST = 1e-300

#: Two filters count as equally fast if their settling times differ by at most this factor.
AS_FAST = 1.001

#: How often the rate of a default observer is halved if its stability is not proved.
MOST_SLOWER = 6

#: A noisier filter is taken only if it is at least so many times as fast as the quieter one.
FAR_SLOWER = 3.0

#: A note is given if the default observer is so many times slower than the plant.
SLOW_DEFAULT = 1000.0

#: For a region with a radius and without a decay, the decay is at most this share of the radius.
RADIUS_SHARE = 0.5

#: Shares of the assumed process noise that are tried in turn for a stated decay, as long as each lowers the noise.  The
#: default of that noise is of the size of all sensors' noise; an additional noisy sensor therefore made the filter
#: faster than necessary, and noisier.
DRIVES = (1.0, 1e-1, 1e-2, 1e-3)

#: Decay rates of placed poles in units of the stated decay: from the first number on, spread over the second one, so
#: that the poles are distinct and none is on the bound.
LEAST_RATE, RATE_SPREAD = 1.1, 1.0


class Choice(NamedTuple):
    """A gain, the stated poles, the claims, the records of solvers, and the decay of a default gain as a share of the
    plant's own rate."""

    gain: FloatArray
    poles: Sequence[complex] | None
    claims: Mapping[str, float]
    runs: tuple[Mapping[str, Any], ...]
    rate_share: float | None = None


def notes(
    known: Existence, problem: PlacementProblem, method: UiPiObserver, claims: Mapping[str, float]
) -> Iterator[str]:
    """Yield notes on eliminated states, fixed poles, a slow default observer and necessary digits."""
    if known.transformation is not None:
        detail = next(condition.detail for condition in known.conditions if condition.name.startswith("(D1)"))
        yield f"(D1) holds only without the algebraic states, which were eliminated: {detail}."
    fixed, dt = problem.fixed_modes, known.plant.dt
    if fixed.size:
        slow, least = method.slowest_asked(dt), np.min(decay_rates(fixed, dt))
        behind = slow is not None and least < slow
        # A pole at z = 0 is computed only up to rounding.
        printed = np.where(np.abs(fixed) > NEGLIGIBLE_MODE, fixed, 0.0) if dt > 0.0 else fixed
        yield (
            f"{fixed.size} of {len(problem.F)} poles are fixed, whatever the gains: {', '.join(numbers(printed))}"
            + (f"; the slowest decays at {least:.3g} 1/s, slower than asked." if behind else ".")
        )
    own, decay = problem.rate / problem.units.time, claims.get("decay")
    default = method.poles is None and method.decay is None and method.region is None
    if default and decay is not None and not fixed.size and decay * SLOW_DEFAULT < own:
        yield (
            f"The slowest pole decays at {decay:.3g} 1/s, against {own:.3g} 1/s of the plant itself: a faster one has "
            f"more than {NOISE_PRICE:g} times the noise of a Kalman filter, or was not found. Parts of the fault "
            f"models that can hardly be distinguished ({', '.join(dict.fromkeys(problem.model.descriptions))}) do "
            "that: leave one out, or give decay or poles."
        )
    if "digits" in claims:
        # Fewer digits than a double has, but more than are commonly printed, keep Ahat stable.
        yield (
            f"Ahat is stable with {claims['digits']:.0f} significant digits and more, and unstable with fewer: in the "
            "coordinates of this plant its entries cancel. Copy the gain set or the exported code, not printed numbers."
        )


def synthesise(
    plant: DescriptorSystem | PolytopicSystem, method: UiPiObserver, *, progress: Callable[[str], None]
) -> Synthesis:
    """Design the observer; see `obsynth.ui_pi_observer` for the options, results and errors."""
    if isinstance(plant, PolytopicSystem):
        from obsynth.methods.ui_pi_observer.over_region import synthesise_over_region

        return synthesise_over_region(plant, method, progress=progress)
    solver = chosen_solver(method.solver, method.solver_options)
    if own_terms(method):
        from obsynth.methods.engines.own_terms import ui_pi_by_inequality

        return ui_pi_by_inequality(plant, method, progress=progress)
    method = replace(method, solver=solver)
    model = exosystem(method.fault_model, plant.fault_names, plant.dt)
    region = method.checked_region(plant.dt)
    weights = method.checked_noise(plant.output_names)
    progress("checking the existence conditions")
    known = existence(plant, model)
    require_all_conditions(known.conditions)
    working = known.plant
    progress("decoupling the unknown inputs")
    merged, tried = _chosen_outputs(known, model, method, region, weights)
    designed = working if merged is None else merged.plant
    paper_matrices = method.given_decoupling()
    problem = (
        tried[0]
        if tried
        else placement_problem(designed, model, known.fixed_modes, joint=method.joint, paper_matrices=paper_matrices)
    )
    if method.G is not None:
        _require_stable_fixed_modes(problem)
    progress("choosing the gains")
    choice = tried[1] if tried else _chosen(method, problem, region, weights, plant.dt)
    gain, placed_poles, claims, runs = choice[:4]
    if merged is not None and working.Bw.any() and "noise_price" in claims:
        picked = [working.output_names.index(name) for name in designed.output_names]
        single = designed.replace(Dw=working.Dw[picked])
        alone = placement_problem(single, model, known.fixed_modes, joint=method.joint, paper_matrices=None)
        problem, gain, claims = _as_fast_as(alone, designed, (problem, gain, claims), weights)
    progress("building the realisation and its certificate")
    gains = problem.gains(gain)
    if merged is not None:
        gains = gains[0], gains[1] @ merged.weights, gains[2] @ merged.weights
    poles = None if placed_poles is None else np.array([*placed_poles, *problem.fixed_modes])
    synthesis = assembled(working, model, gains, poles, dict(claims), structured=not method.joint)
    unused = left_out(working, *gains[1:]) if method.leaves_freedom_to_us else ""
    more = (f"No use is made of {unused}: with all outputs the gains for these poles are noisier.",) if unused else ()
    by_default = method.poles is None and method.decay is None and region is None
    if by_default and contraction_of(synthesis.linear_observer) is None:
        slower = _slower(plant, method, synthesis, progress=progress)
        if slower is not None:
            return slower
    return Synthesis(
        method.resolved(model, plant.fault_names),
        synthesis.gains,
        synthesis.observer,
        synthesis.certificate,
        {"runs": list(runs)},
        (*notes(known, problem, method, synthesis.certificate.claims), *more),
        known.transformation,
    )


def _chosen_outputs(
    known: Existence, model: Exosystem, method: UiPiObserver, region: NamedRegion | None, weights: Mapping[str, Any]
) -> tuple[MergedOutputs | None, tuple[PlacementProblem, Choice] | None]:
    """Return the outputs to design with, ``None`` for those of the plant, and the gains where these are chosen by then.

    Outputs that show the same are merged, and those that add noise are left out, unless the options name matrices or
    the noise of single outputs.
    """
    if method.given_decoupling() is not None or isinstance(weights.get("measurement"), Mapping):
        return None, None
    merged = merged_outputs(known.plant)
    tried: tuple[PlacementProblem, Choice] | None = None
    if method.decay is None and region is None:
        merged, tried = _without_likeness(known, model, method, merged, weights)
    if method.leaves_freedom_to_us:
        merged, tried = _with_quietest_outputs(known, model, method, merged, tried)
    return merged, tried


def _slower(
    plant: DescriptorSystem, method: UiPiObserver, synthesis: Synthesis, *, progress: Callable[[str], None]
) -> Synthesis | None:
    """Return a slower observer whose stability is proved, or ``None``.

    The gains of the default observer are too large to prove its stability in double precision.
    """
    decay = synthesis.certificate.claims.get("decay", 0.0)
    for halvings in range(1, MOST_SLOWER + 1 if decay > 0.0 else 1):
        rate = decay * 2.0**-halvings
        progress("choosing slower gains, as the stability of these cannot be proved")
        try:
            found = synthesise(plant, replace(method, decay=rate), progress=progress)
        except SolverError:
            continue
        if contraction_of(found.linear_observer) is not None:
            why = (
                f"decay = {rate:.3g} 1/s was taken: twice the rate, which the noise allows, has gains with which "
                "stability is not proved in double precision."
            )
            return replace(found, notes=(why, *found.notes))
    return None


def _require_stable_fixed_modes(problem: PlacementProblem) -> None:
    """Raise `PreconditionError` if E_sharp, C_sharp and G of the options fix a mode that is not stable."""
    # A mode on the boundary up to rounding is not stable either: a lost equation leaves a mode at zero.
    modes = zip(problem.split.fixed_modes, problem.fixed_modes, strict=True)
    unstable = [complex(own) for scaled, own in modes if is_outside(complex(scaled), problem.plant.dt)]
    if unstable:
        raise PreconditionError(
            f"With these E_sharp, C_sharp and G the mode {number(unstable[0])} is fixed and not stable: U has lost "
            "rank, and equations of the plant are lost with it. Leave E_sharp, C_sharp and G out.",
            condition="fixed modes",
            mode=unstable[0],
        )


def _without_likeness(
    known: Existence, model: Exosystem, method: UiPiObserver, merged: MergedOutputs | None, weights: Mapping[str, Any]
) -> tuple[MergedOutputs | None, tuple[PlacementProblem, Choice] | None]:
    """Return the outputs to merge if some nearly depend on others, with the problem and its gain if both were computed.

    The design with merged outputs is compared with the one without.  For given poles the quieter one is taken.  For
    default gains, the merged outputs are taken if they give a filter that is at least as fast, or a quieter one that is
    not much slower (`FAR_SLOWER`).
    """
    near = nearly_merged_outputs(known.plant)
    if near is None:
        return merged, None
    own = _compared(known, model, method, merged, weights)
    like = None if own is None else own.result[1].rate_share
    other = _compared(known, model, method, near, weights, like=like)
    if other is None:
        return merged, own and own.result
    if own is None:
        return near, other.result
    if method.poles is not None:
        takes_near = other.noise <= AS_FAST * own.noise
    else:
        quieter = other.noise * AS_FAST < own.noise and other.settling < FAR_SLOWER * own.settling
        takes_near = other.settling <= AS_FAST * own.settling or quieter
    return (near, other.result) if takes_near else (merged, own.result)


class _Compared(NamedTuple):
    """A choice of outputs to merge: deviation of the fault estimates, settling time, and the problem with its gain."""

    noise: float
    settling: float
    result: tuple[PlacementProblem, Choice]


def _with_quietest_outputs(
    known: Existence,
    model: Exosystem,
    method: UiPiObserver,
    merged: MergedOutputs | None,
    tried: tuple[PlacementProblem, Choice] | None,
) -> tuple[MergedOutputs | None, tuple[PlacementProblem, Choice] | None]:
    """Return the choice of outputs with the least noise for given poles, with the problem and its gain.

    The search for gains with these poles starts from well-conditioned gains, which do not depend on the noise, so that
    an additional sensor may add noise.
    """

    def designed(some: MergedOutputs) -> tuple[MergedOutputs, _Compared]:
        alone = existence(some.plant, model)
        require_all_conditions(alone.conditions)
        compared = _compared(known, model, method, some, {}) if alone.transformation is None else None
        if compared is None:
            raise SolverError("Poles could not be placed with these outputs.")
        return some, compared

    fewer = [*with_fewer_sensors(known.plant, designed, lambda pair: pair[1].noise)]
    quietest = min(fewer, key=lambda pair: pair[1].noise, default=None)
    if quietest is None:
        return merged, tried
    own = _compared(known, model, method, merged, {}, chosen=tried)
    if own is not None and own.noise <= AS_QUIET * quietest[1].noise:
        return merged, own.result
    return quietest[0], quietest[1].result


def _compared(
    known: Existence,
    model: Exosystem,
    method: UiPiObserver,
    merged: MergedOutputs | None,
    weights: Mapping[str, Any],
    *,
    chosen: tuple[PlacementProblem, Choice] | None = None,
    like: float | None = None,
) -> _Compared | None:
    """Return noise, settling time and gain for a choice of outputs; ``None`` if there is no gain.

    ``chosen`` is the problem with its gain if they are known.  ``like`` is the decay of the default gain with other
    outputs, as a share of the plant's rate.
    """
    try:
        problem, choice = chosen or _problem_and_choice(known, model, method, merged, weights, like=like)
    except (ObsynthError, np.linalg.LinAlgError):
        return None
    U, D, K = problem.gains(choice[0])
    means = np.eye(known.plant.ny) if merged is None else merged.weights
    synthesis = assembled(known.plant, model, (U, D @ means, K @ means), None, {}, structured=not method.joint)
    observer = synthesis.linear_observer
    poles = np.linalg.eigvals(observer.Az).astype(np.complex128)
    settling = 1.0 / max(float(np.min(decay_rates(poles, observer.dt))), SLOWEST)
    noise = fault_deviation(known.plant, observer)
    if method.leaves_freedom_to_us and known.plant.Dw.any():
        tracking, phi, cw = (synthesis.certificate.matrices[name] for name in ("tracking", "Phi", "Cw"))
        noise = error_deviation(ErrorModel(known.plant, observer, tracking, Phi=phi, Cw=cw, decoupled=True))
    return _Compared(noise, settling, (problem, choice))


def _problem_and_choice(
    known: Existence,
    model: Exosystem,
    method: UiPiObserver,
    merged: MergedOutputs | None,
    weights: Mapping[str, Any],
    *,
    like: float | None,
) -> tuple[PlacementProblem, Choice]:
    plant = known.plant if merged is None else merged.plant
    problem = placement_problem(plant, model, known.fixed_modes, joint=method.joint, paper_matrices=None)
    return problem, _chosen(method, problem, None, weights, known.plant.dt, like=like)


def _placed(
    problem: PlacementProblem, poles: Sequence[complex], objective: str, noise: KalmanProblem | None = None
) -> Choice:
    """Return the gain for given poles.

    If the gains should be small, their size is measured in the user's units, unless outputs are mixed.  With ``noise``
    the freedom that remains is used to reduce the noise, and the user's units do not matter.
    """
    split, plant, units = problem.split, problem.plant, problem.units
    plain_outputs = problem.free == 0 and np.array_equal(problem.decoupled.undisturbed, np.eye(plant.ny))
    plain_outputs = plain_outputs and noise is None
    outputs = units.outputs if plain_outputs else np.ones(len(split.C))
    scaled_poles = [units.rate * pole for pole in poles]
    placed_noise = None
    if noise is not None:
        of_outputs = noise.D / outputs[:, None]
        placed_noise = PlacedNoise(split.F, split.C / outputs[:, None], noise.B, of_outputs, noise.estimates, plant.dt)
    gain, condition = place(
        split.F,
        split.C / outputs[:, None],
        scaled_poles,
        dt=plant.dt,
        objective=objective,
        weight=units.augmented_states[:, None] * split.lift(np.eye(split.order)),
        noise=placed_noise,
    )
    return Choice(gain / outputs, poles, {"condition": condition}, ())


def _chosen(
    method: UiPiObserver,
    problem: PlacementProblem,
    region: NamedRegion | None,
    weights: Mapping[str, Any],
    dt: float,
    *,
    like: float | None = None,
) -> Choice:
    """Return a gain of the observable part, with its poles if they are stated, its claims and its records."""
    split, time = problem.split, problem.units.time
    if method.poles is not None:
        poles = checked_poles(method.poles, split.order, problem.fixed_modes, dt)
        spends = method.leaves_freedom_to_us and not method.joint and problem.plant.Dw.any()
        return _placed(problem, poles, method.objective, kalman_problem(problem, weights) if spends else None)
    kalman = kalman_problem(problem, weights)
    claims: dict[str, float] = {}
    share: float | None = None
    runs: tuple[Mapping[str, Any], ...] = ()
    if region is not None:
        gain, record = _in_region(kalman, region.in_time(time), problem.rate, method)
        runs = (record,)
    elif method.decay is not None:
        # A process noise that the user states is not changed, nor is it reduced if the decay is zero, since then only
        # this noise makes errors decay.
        own = method.decay > 0.0 and weights.keys().isdisjoint(("process", "fault"))
        drives = DRIVES if own else DRIVES[:1]
        gain = _for_decay(problem, kalman, method.decay, method.objective, dt, drives=drives)
    elif (fair := compromise(kalman, problem.rate, like=like)) is not None:
        gain, claims, share = fair[0], {"noise_price": fair[2]}, fair[1] / problem.rate or None
    else:
        gain = _for_decay(problem, kalman, problem.rate / time, method.objective, dt)
    return Choice(gain, None, claims, runs, share)


def _as_fast_as(
    alone: PlacementProblem,
    designed: DescriptorSystem,
    default: tuple[PlacementProblem, FloatArray, Mapping[str, float]],
    weights: Mapping[str, Any],
) -> tuple[PlacementProblem, FloatArray, Mapping[str, float]]:
    """Return the problem, a default gain and its claims: those of ``default``, or faster ones.

    ``alone`` is the problem with one sensor of each kind.  If process noise is stated and sensors are repeated, the
    least noise is smaller, so that the same ratio to the least noise gives a slower filter.  The gain for one sensor,
    applied to the mean of several, has the same poles and less noise than with that sensor alone.
    """
    problem, gain, claims = default
    single = kalman_problem(alone, weights)
    fair = compromise(single, alone.rate)
    if fair is None:
        return default
    own, wanted = (
        float(np.min(decay_rates(eigenvalues(pair.split.F - k @ pair.split.C), pair.plant.dt), initial=np.inf))
        for pair, k in ((problem, gain), (alone, fair[0]))
    )
    if not own / problem.units.time < wanted / alone.units.time < np.inf:
        return default
    both = replace(alone, plant=alone.units.scaled_plant(designed))
    kalman, plain = kalman_problem(both, weights), np.eye(alone.split.order)
    best, quieter = fair[0], kalman.quietest_gain(wanted)
    noise = kalman.deviations(best, plain)
    if quieter is not None and np.all(kalman.deviations(quieter, plain) <= noise):
        best, noise = quieter, kalman.deviations(quieter, plain)
    least = kalman.solved(0.0, plain)[0]
    price = claims["noise_price"]
    if least is not None:
        ratios = noise / np.maximum(kalman.deviations(least, plain), SMALLEST)
        price = float(np.max(ratios[np.isfinite(ratios)], initial=price))
    return both, best, {"noise_price": price}


def _for_decay(
    problem: PlacementProblem,
    kalman: KalmanProblem,
    decay: float,
    objective: str,
    dt: float,
    *,
    drives: Sequence[float] = DRIVES[:1],
) -> FloatArray:
    """Return a gain ``(n, ny)`` whose poles all decay faster than ``decay`` (1/s): of a Kalman filter, or by placement.

    Near the fastest possible rate, the Riccati equation of the filter can be solved on one processor and not on
    another, because of rounding; poles are placed then.
    """
    rate = problem.units.time * decay
    gain = kalman.quietest_gain(rate, drives=drives)
    if gain is None:
        gain = kalman.gain(rate, persistent=True)
    if gain is not None:
        return gain
    order = problem.split.order
    rates = decay * (LEAST_RATE + RATE_SPREAD * np.arange(order) / max(order, 1))
    poles = np.exp(-rates * dt) if dt > 0.0 else -rates
    try:
        return _placed(problem, [complex(pole) for pole in poles], objective)[0]
    except SolverError:
        raise SolverError(
            f"The Riccati equation for decay {decay:g} 1/s has no solution that double precision could tell from "
            "rounding, not even by way of slower rates, and poles for it could not be placed: some mode is too weakly "
            "observable for this rate. Ask for a lower one, leave decay out, or give poles."
        ) from None


def _in_region(
    kalman: KalmanProblem, region: NamedRegion, rate: float, method: UiPiObserver
) -> tuple[FloatArray, dict[str, Any]]:
    """Return a gain for the region; if that has no decay, with the default decay, since a filter of least noise alone
    may be very slow."""
    if method.region.get("decay") is None:
        fair = compromise(kalman, rate)
        most = np.inf if region.radius is None else RADIUS_SHARE * region.radius
        tried = replace(region, decay=float(min(fair[1], most)) if fair is not None else 0.0)
        try:
            return region_gain(kalman, tried, solver=method.solver)
        except SolverError:
            # The region without that decay may still be possible.
            pass
    return region_gain(kalman, region, solver=method.solver)
