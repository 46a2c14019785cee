"""Synthesis of an observer over a region: inequalities at the corners of the slopes' ranges, and their proof."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.analysis.existence.condition import require_all
from obsynth.analysis.existence.nonlinear_region import MOST_CORNER_SLOPES
from obsynth.conditions.lmi import chosen_solver
from obsynth.conditions.slope_multipliers import SlopedErrors
from obsynth.errors import SolverError, SpecError, counted
from obsynth.methods.engines.fastest_decay import fastest_rate
from obsynth.methods.engines.needed_vertices import lack_of_decay, lack_of_level, solved_at_needed
from obsynth.methods.engines.slope_certificates import best_decay_of_slopes, certified_slopes
from obsynth.methods.engines.vertex_certificates import best_decay, certified
from obsynth.methods.method import Synthesis
from obsynth.methods.region_observer.method import RegionObserverMethod
from obsynth.numerics.arrays import FloatArray, as_matrix
from obsynth.numerics.gain_levels import is_positive
from obsynth.numerics.matrix_equations import continuous_solution
from obsynth.observers.nonlinear.region_observer import RegionObserver
from obsynth.observers.records import named_vector
from obsynth.plants.dae import DAEModel
from obsynth.plants.operating_region import OperatingRegion, Slope
from obsynth.plants.transformations.nonlinear_terms import NonlinearTerms, nonlinear_terms
from obsynth.proofs.balls import Ball
from obsynth.proofs.slope_blocks import SlopeBlock
from obsynth.proofs.vertex_inequalities import Proved, Witness, prove_decay, prove_gain, prove_mean_square
from obsynth.results.design import Certificate
from obsynth.verification.error_polytope import ErrorPolytope
from obsynth.verification.nonlinear_drive import drive_of, wanted_of
from obsynth.verification.nonlinear_region import (
    corner_errors,
    corners_of,
    directions,
    fastest_decay,
    middle_and_half,
    whole_gain,
)
from obsynth.verification.over_region import GAIN_WITNESSES, rows_of_euler, stored_witness

#: The stored bounds of slopes are wider by this share, since elementary functions of another processor may differ in
#: the last digit.
SLOPE_ROOM = 1e-9
#: Margin above the least level with which a gain is designed, since gains near the least level are large.
DESIGN_MARGIN = 2e-2
#: Largest gain, and fastest rate, of a design for the fastest decay, in the plant's own units.
DECAY_LIMIT = 1e2
#: The search for a proved rate begins at this factor times the rate that a certificate allows at one corner, which is
#: computed in floating point.
FASTEST_ROOM = 1.01
#: Assumed noise on states without noise, relative to that on the others, where sizes of errors are estimated.
LEAST_DRIVE = 1e-3
#: Shares by which a level is raised in turn until it can be proved for the shipped numbers.
PROOF_ROOMS = (0.0, 1e-6, 1e-4, 1e-3, 1e-2)


def synthesise(plant: DAEModel, options: RegionObserverMethod, *, progress: Callable[[str], None]) -> Synthesis:
    """Return an observer over a region with its certificate; see `obsynth.region_observer`."""
    options.require_stated(plant)
    solver = chosen_solver(options.solver, options.solver_options)
    faults = options.fault_names(plant)
    step = options.sample_time or 0.0
    progress("enclosing the slopes of the nonlinearities over the region")
    require_all(options.existence(plant))
    terms = nonlinear_terms(plant, faults=faults)
    region = OperatingRegion.of(terms, options.region)
    slopes = region.slopes()
    bounds = _stored_bounds(slopes)
    drive = _drive(terms, region, options, step)
    given_gain = _given_gain(terms, options.gains)
    progress("solving the inequalities for the slopes")
    problem = _Scaled.of(terms, region, slopes, bounds, drive, options.goal)
    solution = problem.solved(options, given_gain, solver, progress)
    progress("proving the shipped numbers")
    claims, matrices = _proved(terms, slopes, bounds, drive, solution, options, problem, progress)
    gain = solution.gain
    start = named_vector(options.initial_state, (*plant.state_names, *faults), _nominal(plant, faults), "initial_state")
    places = [(*plant.state_names, *faults).index(name) for name in terms.names]
    observer = RegionObserver(
        plant,
        faults,
        dict(options.region),
        bounds,
        gain,
        start[places],
        rows_of_euler(claims["region_decay"], step),
        step,
    )
    return Synthesis(
        options.as_plain(),
        {"L": gain},
        observer,
        Certificate(matrices, claims),
        {"engine": "lmi", "runs": solution.runs},
        (*_notes(region, observer, options), *_noise_notes(terms, slopes, bounds, gain, options)),
    )


def _stored_bounds(slopes: tuple[Slope, ...]) -> FloatArray:
    ends = np.array([[each.low, each.high] for each in slopes]).reshape(len(slopes), 2)
    room = SLOPE_ROOM * np.abs(ends).max(axis=1, initial=0.0, keepdims=True)
    return np.asarray(ends + room * np.array([[-1.0, 1.0]]))


def _drive(
    terms: NonlinearTerms, region: OperatingRegion, options: RegionObserverMethod, step: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    wanted = wanted_of(terms, region, options.wanted)
    if options.goal == "decay" and options.noise is None:
        return np.zeros((len(terms.names), 0)), np.zeros((len(terms.output_names), 0)), wanted
    return (*drive_of(terms, options.noise, step), wanted)


def _given_gain(terms: NonlinearTerms, gains: Any) -> FloatArray | None:
    if gains is None:
        return None
    gain, shape = as_matrix(gains, "gains"), (terms.differential, len(terms.output_names))
    if gain.shape != shape:
        moving = ", ".join(terms.names[: terms.differential])
        raise SpecError(f"gains are {gain.shape}: give {shape}, the rows those of {moving}.", path="gains")
    return gain


def _nominal(plant: DAEModel, faults: tuple[str, ...]) -> FloatArray:
    return np.array([*plant.states.values(), *(plant.parameters[name] for name in faults)])


@dataclass(frozen=True, eq=False)
class _Solution:
    """A gain with its Lyapunov matrices, in the plant's units."""

    gain: FloatArray
    witness: Witness
    of_decay: Witness
    level: float | None
    runs: tuple[Mapping[str, Any], ...]


@dataclass(frozen=True, eq=False)
class _Scaled:
    """The error system at the corners, in units of states, equations, outputs and time in which its entries are near
    one."""

    errors: ErrorPolytope | SlopedErrors
    states: FloatArray
    rows: FloatArray  # of algebraic equations
    outputs: FloatArray
    time: float
    differential: int

    @classmethod
    def of(
        cls,
        terms: NonlinearTerms,
        region: OperatingRegion,
        slopes: tuple[Slope, ...],
        bounds: FloatArray,
        drive: tuple[FloatArray, FloatArray, FloatArray],
        goal: str,
    ) -> _Scaled:
        """Return the error system at every corner; for many slopes, that at the middle, with the slopes beside it."""
        W, Wy, V = directions(terms, slopes)
        nd = terms.differential
        few = len(slopes) <= MOST_CORNER_SLOPES
        middle, half = middle_and_half(bounds)
        places = corners_of(bounds) if few else [middle]
        A = [terms.A + W @ np.diag(place) @ V for place in places]
        C = [terms.C + Wy @ np.diag(place) @ V for place in places]
        beside = (0.0, 0.0) if few else (np.abs(W) @ np.diag(half) @ np.abs(V), np.abs(Wy) @ np.diag(half) @ np.abs(V))
        B, D, Cz = drive
        states = _powers(_errors_of_kalman(np.mean(A, axis=0), np.mean(C, axis=0), B, D, nd, _sizes(terms, region)))
        largest = np.max(np.abs(A), axis=0) + beside[0]
        time = 1.0 / _power(float(np.max((largest * states)[:nd] / states[:nd, None], initial=0.0)) or 1.0)
        noisy = np.sqrt(time) if goal == "power" else 1.0
        rows = 1.0 / _powers(np.max(largest[nd:] * states, axis=1, initial=0.0))
        sizes = np.max((np.max(np.abs(C), axis=0) + beside[1]) * states, axis=1, initial=0.0)
        outputs = 1.0 / _powers(sizes)
        row_units = np.concatenate([time / states[:nd], rows])[:, None]
        errors = ErrorPolytope(
            [row_units * a * states for a in A],
            [outputs[:, None] * c * states for c in C],
            B=row_units * B / noisy,
            D=outputs[:, None] * D / noisy,
            Cz=Cz * states,
            dt=0.0,
            differential=nd if nd < len(states) else None,
        )
        sloped = SlopedErrors(errors, row_units * W * half, outputs[:, None] * Wy * half, V * states)
        return cls(errors if few else sloped, states, rows, outputs, time, nd)

    def solved(
        self, options: RegionObserverMethod, given: FloatArray | None, solver: str, progress: Callable[[str], None]
    ) -> _Solution:
        """Return a gain with its certificate."""
        own = None if given is None else self._gain_in(given)
        decay = None if not options.decay else options.decay * self.time
        if options.goal == "decay":
            if decay is not None:
                raise SpecError("goal: decay finds the fastest decay: leave decay out.", path="decay")
            witness, gain = self._fastest(own, progress)
            outside = self._witness_out(witness)
            return _Solution(self._gain_out(gain, given), outside, outside, None, ())
        arguments: dict[str, Any] = {
            "goal": options.goal,
            "margin": DESIGN_MARGIN if given is None else 0.0,
            "decay": decay,
            "solver": solver,
            "settings": options.solver_options,
        }
        if isinstance(self.errors, SlopedErrors):
            block = certified_slopes(self.errors, gain=own, **arguments)
            of_level, of_decay = self._witness_out(block.witness), self._witness_out(block.of_decay)
            return _Solution(self._gain_out(block.gain, given), of_level, of_decay, block.level, block.runs)
        corners, gains = self.errors, None if own is None else [own]
        made = solved_at_needed(
            corners,
            lambda some: certified(some, gain="constant", gains=gains, **arguments),
            lambda found: lack_of_level(corners, found, options.goal, decay),
            progress,
        )
        witness = self._witness_out(made.witness)
        return _Solution(self._gain_out(made.gains[0], given), witness, witness, made.level, made.runs)

    def decay_of(self, gain: FloatArray, progress: Callable[[str], None]) -> Witness | None:
        """Return Lyapunov matrices for the fastest decay of a gain; ``None`` if the search has no result."""
        try:
            return self._witness_out(self._fastest(self._gain_in(gain), progress)[0])
        except SolverError:
            return None

    def _fastest(self, gain: FloatArray | None, progress: Callable[[str], None]) -> tuple[Witness, FloatArray]:
        """Return Lyapunov matrices for the fastest decay, and the gain: the given one, or by default the best one."""
        if isinstance(self.errors, SlopedErrors):
            _, witness, best = best_decay_of_slopes(self.errors, gain=gain, limit=DECAY_LIMIT)
            return witness, best
        corners, gains = self.errors, None if gain is None else [gain]
        _, witness, own = solved_at_needed(
            corners,
            lambda some: best_decay(some, gains=gains, gain="constant", limit=DECAY_LIMIT),
            lambda found: lack_of_decay(corners, *found),
            progress,
        )
        return witness, own[0]

    def _gain_in(self, gain: FloatArray) -> FloatArray:
        scaled = gain * self.time / self.states[: self.differential, None] / self.outputs
        return np.vstack([scaled, np.zeros((len(self.states) - self.differential, scaled.shape[1]))])

    def _gain_out(self, gain: FloatArray, given: FloatArray | None) -> FloatArray:
        if given is not None:
            return given
        nd = self.differential
        return np.asarray(gain[:nd] * self.states[:nd, None] * self.outputs / self.time)

    def _witness_out(self, witness: Witness) -> Witness:
        nd, s = self.differential, self.states
        columns = np.concatenate([self.time / s[:nd], self.rows])
        P = witness.P[0] / s[:, None] * columns
        P = 0.5 * (P + P.T)
        P[nd:], P[:, nd:] = 0.0, 0.0
        G = witness.P[0] if witness.G is None else witness.G[0]
        # G' multiplies the equations: its columns belong to equations, and its rows to states.
        G = (G.T / s[:, None] * columns).T
        G[:nd, :nd] = P[:nd, :nd]
        G[:nd, nd:] = 0.0
        # The multipliers of slopes need no scaling: they relate V e and its products with the slopes, in equal units.
        return Witness([P], [G], differential=nd, slopes=witness.slopes)


def _errors_of_kalman(
    A: FloatArray, C: FloatArray, B: FloatArray, D: FloatArray, differential: int, sizes: FloatArray
) -> FloatArray:
    """Return the sizes of the errors of a Kalman filter for the mean of the corners.

    In units of these sizes, P is near a multiple of the identity.
    """
    k = differential
    if not D.any() or not B.any():
        return sizes
    with suppress(np.linalg.LinAlgError):
        below = np.linalg.solve(A[k:, k:], A[k:, :k]) if k < len(A) else np.zeros((0, k))
        a, c = A[:k, :k] - A[:k, k:] @ below, C[:, :k] - C[:, k:] @ below
        s = sizes[:k]
        # A little noise on all states, so that none is without noise.
        drive = B[:k] / s[:, None]
        least = LEAST_DRIVE * np.linalg.norm(drive) * np.eye(k)
        scaled = a * s / s[:, None]
        covariance = continuous_solution(scaled, c * s, drive @ drive.T + least @ least, D @ D.T)
        if covariance is not None and is_positive(covariance):
            deviations = s * np.sqrt(np.diag(covariance))
            return np.concatenate([deviations, np.maximum(np.abs(below) @ deviations, LEAST_DRIVE * sizes[k:])])
    return sizes


def _sizes(terms: NonlinearTerms, region: OperatingRegion) -> FloatArray:
    """Return the size of each state and fault: the width of its range, or of ranges of sums that contain it."""
    sizes = np.zeros(len(terms.names))
    for each in region.ranges:
        for name, factor in each.combination.parts:
            if name in terms.names:
                place = terms.names.index(name)
                sizes[place] = max(sizes[place], (each.high - each.low) / abs(float(factor)))
    return np.where(sizes > 0.0, sizes, 1.0)


def _powers(values: FloatArray) -> FloatArray:
    positive = np.where(values > 0.0, values, 1.0)
    return np.asarray(np.exp2(np.round(np.log2(positive))))


def _power(value: float) -> float:
    return float(_powers(np.array([value]))[0])


def _proved(
    terms: NonlinearTerms,
    slopes: tuple[Slope, ...],
    bounds: FloatArray,
    drive: tuple[FloatArray, FloatArray, FloatArray],
    solution: _Solution,
    options: RegionObserverMethod,
    problem: _Scaled,
    progress: Callable[[str], None],
) -> tuple[dict[str, float], dict[str, FloatArray]]:
    """Return the decay and the level that are proved for the shipped numbers, each with its Lyapunov matrices."""
    vertices = corner_errors(terms, slopes, bounds, solution.gain, drive)
    wanted = options.decay or 0.0
    witness = problem.decay_of(solution.gain, progress) or solution.of_decay
    rate = fastest_decay(vertices, witness, _fastest(vertices, witness))
    if rate < wanted and prove_decay(vertices, solution.of_decay, wanted, discrete=False).proved:
        rate, witness = wanted, solution.of_decay
    matrices = stored_witness(witness)
    if rate <= 0.0 or rate < wanted:
        raise SolverError(
            "A gain was found, but no decay of the errors could be proved for it over the region. That is no proof "
            "that there is none: give a smaller region, or a smaller decay."
        )
    claims = {"region_decay": rate}
    if solution.level is None:
        return claims, matrices
    matrices |= stored_witness(solution.witness, GAIN_WITNESSES)
    prover, name = (prove_mean_square, "region_deviation") if options.goal == "power" else (prove_gain, "region_gain")
    for room in PROOF_ROOMS:
        level = solution.level * (1.0 + room)
        if prover(vertices, solution.witness, level, discrete=False).proved:
            return {**claims, name: level}, matrices
    raise SolverError(
        "A gain was found, but its certificate could not be proved for the shipped numbers. That is no proof that "
        "there is none: give a smaller region."
    )


def _fastest(vertices: Proved, witness: Witness) -> float:
    """Return an upper bound of the provable rates: that of the certificate at one corner, or in the middle."""
    vertex = vertices.nominal if isinstance(vertices, SlopeBlock) else vertices[0]
    P, G = witness.P[0], witness.P[0] if witness.G is None else witness.G[0]
    GM = G.T @ vertex(Ball)[0].midpoint
    rate = fastest_rate(-(GM + GM.T), P)
    return 0.0 if rate is None else FASTEST_ROOM * rate


def _notes(region: OperatingRegion, observer: RegionObserver, options: RegionObserverMethod) -> list[str]:
    measured = {place for place, _, _ in region.measured()}
    states, _, _ = region.matrices()
    assumed = [
        each.text for place, each in enumerate(region.ranges) if place not in measured and bool(states[place].any())
    ]
    count = len(observer.slopes)
    kind = (
        f"at {counted(2**count, 'corner')} of {counted(count, 'slope')}"
        if count <= MOST_CORNER_SLOPES
        else f"in one block with a multiplier for each of {count} slopes (sufficient: a tighter claim may be true)"
    )
    notes = [
        f"One certificate {kind}, for the region "
        f"{region.sentence()}. A row in which an input, a measurement or an estimate leaves it is out: nothing is "
        f"claimed for {observer.forgetting} rows from the last such row on."
    ]
    if assumed:
        notes.append(
            f"That {', '.join(assumed)} of the plant stay in their ranges is seen by the estimates alone: until these "
            "have settled it is an assumption."
        )
    notes.append(
        "The observer takes steps of implicit Euler, for which the same certificate is proved. The claims do not count "
        "what such a step misses of the plant's own motion: try a shorter sample_time, and simulate, where samples are "
        "not close beside it."
    )
    return notes


def _noise_notes(
    terms: NonlinearTerms,
    slopes: tuple[Slope, ...],
    bounds: FloatArray,
    gain: FloatArray,
    options: RegionObserverMethod,
) -> list[str]:
    """Return a note on the effect of noise on a design for the fastest decay, which does not take noise into account.

    The effect is that of one sample from rest, with the slopes in the middle of their bounds.
    """
    if options.goal != "decay" or options.gains is not None or not gain.size:
        return []
    W, Wy, V = directions(terms, slopes)
    middle, _ = middle_and_half(bounds)
    nd, step = terms.differential, options.sample_time or 0.0
    corrected = whole_gain(terms, gain)
    A = terms.A + W @ np.diag(middle) @ V - corrected @ (terms.C + Wy @ np.diag(middle) @ V)
    moved = np.diag(np.arange(len(A)) < nd) - step * A
    try:
        effects = np.linalg.solve(moved, step * corrected)
    except np.linalg.LinAlgError:
        return []
    place, output = np.unravel_index(int(np.argmax(np.abs(effects))), effects.shape)
    return [
        f"The fastest decay weighs no noise, and its gains are large where a plant allows it: a deviation of 1 in "
        f"{terms.output_names[output]} moves the estimate of {terms.names[place]} by "
        f"{abs(effects[place, output]):.3g} within a sample. For gains that weigh noise state it, with goal: power and "
        "the least decay that you need."
    ]
