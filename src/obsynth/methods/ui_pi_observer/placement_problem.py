"""The pair behind an unknown-input PI observer: what is decoupled, what can be placed, and the noise on it.

Share Pasand, Aliyari, Taghirad, Lemma 5, procedure 1; ours are the weights and the joint design over K and Z: their
free matrix G is itself an output injection, from the rows ``N_U A`` that the decoupling leaves over.

The pair is split into its observable part and the modes that no gain moves (procedure 1, step 7): Lemma 6 (always
observable) is false.  A staircase of rank decisions loses its way on large stiff pairs; the fixed modes are known from
the zeros of the plant's pencil, so they are peeled off one eigenspace at a time.

Realisation and certificate of the gains of an unknown-input PI observer, found or given.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.analysis.plant_units import PlantUnits
from obsynth.analysis.zeros import is_outside, structure_of
from obsynth.errors import PreconditionError, SpecError
from obsynth.methods.method import Synthesis, plain
from obsynth.methods.placement.region import KalmanProblem
from obsynth.methods.ui_pi_observer.augmented_plant import (
    AugmentedPlant,
    Decoupled,
    combinations_seen,
    decouple,
    direct_part,
    paper_decoupling,
    realise,
)
from obsynth.numerics.arguments import ComplexArray, FloatArray, as_matrix, largest_singular_value, require_shape
from obsynth.numerics.pencils import finite_zeros
from obsynth.numerics.ranks import CANCELLATION_TOLERANCE, HIDDEN_MODE_TOLERANCE, RANK_TOLERANCE, product_but_rounding
from obsynth.numerics.scaling import LogBalance
from obsynth.numerics.spectra import (
    DEAD_BEAT,
    PRINTED_DIGITS,
    abscissa,
    as_printed,
    decay_rates,
    digits_needed,
    eigenvalues,
    farthest_pole,
    moving_speeds,
    rounding_of_eigenvalues,
)
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.fault_models import Exosystem, exosystem
from obsynth.proofs.balls import enclosed_eigenvalues, middle_of
from obsynth.proofs.products import certain_noise_covariance
from obsynth.results.design import Certificate
from obsynth.verification.claims import slowest_decay, stability_factor

#: Where all modes are slower than this share of the pair's size, they are integrators that rounding has scattered.
INTEGRATOR_SCATTER = 3e-5
#: Poles of sampled plants are not asked to decay by more than this exponent in one sample: nearer to zero they cannot
#: be distinguished, and printed gains miss them.
MOST_PER_SAMPLE = 2.0


@dataclass(frozen=True, eq=False)
class PlacementProblem:
    """A decoupled plant in units of its own, and the pair whose poles are to be placed."""

    plant: DescriptorSystem
    model: Exosystem  # of its faults, scaled
    units: PlantUnits  # between the user's plant and the scaled one
    decoupled: Decoupled
    U: FloatArray  # (na, na), of the scaled augmented plant, without the free part
    D: FloatArray  # (na, ny)
    F: FloatArray  # (na, na)
    C: FloatArray  # (rows, na); its first ``free`` rows are those of the free part Z
    free: int  # 0 unless K and Z are designed together
    split: ObservableSplit  # of the pair
    rate: float  # median of abs(s) over the plant's modes, in scaled time

    def gains(self, placed: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return U, D and K in the user's units for one of the observable part ``(no, rows)``."""
        k = self.split.lift(placed)
        u, d, k = _completed(self, k)
        states, outputs = self.units.augmented_states[:, None], self.units.outputs
        return states * u * self.units.augmented_equations, states * d * outputs, states * k * outputs / self.units.rate

    @property
    def fixed_modes(self) -> ComplexArray:
        """Poles that no gain moves, in the user's time."""
        return self.units.eigenvalues(self.split.fixed_modes)


def placement_problem(
    plant: DescriptorSystem,
    model: Exosystem,
    fixed_modes: ComplexArray,
    *,
    joint: bool = False,
    given: Mapping[str, Any] | None = None,
) -> PlacementProblem:
    """Return the pair to place; the existence conditions must hold."""
    units = PlantUnits.of(plant, model).for_decoupling(plant)
    if given is not None:
        # Powers of two: the given numbers come back as they are.
        units = units.rounded()
    scaled, model = units.scaled_plant(plant), units.scaled_model(model)
    decoupled = decouple(scaled) if given is None else _given_decoupling(plant, units, given)
    u, d = with_faults(decoupled.U, decoupled.Dhat, scaled, model)
    augmented = AugmentedPlant.of(scaled, model)
    injection = np.vstack([decoupled.injection, np.zeros((model.order, plant.ny))])
    injected = product_but_rounding(-injection, augmented.C, augmented.A)
    f, c = product_but_rounding(u, injected), product_but_rounding(decoupled.seen, augmented.C)
    fixed_modes = units.rate * fixed_modes
    free = 0
    if joint:
        more, _ = _free_part(decoupled, scaled, model)
        c, free = np.vstack([more @ injected, c]), len(more)
    if given is not None:
        # Another U may have other unobservable modes than the plant's pencil.
        n = len(f)
        fixed_modes = finite_zeros(np.vstack([np.eye(n), np.zeros((len(c), n))]), np.vstack([f, c])).values
    split = observable_split(f, c, fixed_modes, dt=scaled.dt)
    return PlacementProblem(scaled, model, units, decoupled, u, d, f, c, free, split, _own_rate(scaled, split.F))


def with_faults(
    u: FloatArray, d: FloatArray, plant: DescriptorSystem, model: Exosystem
) -> tuple[FloatArray, FloatArray]:
    """Return ``U_a = [U, -Dhat Df Cw; 0, I]`` and ``D_a = [Dhat; 0]``: the faults are never read from y directly."""
    nx, count = plant.nx, model.order
    whole = np.eye(nx + count)
    whole[:nx, :nx], whole[:nx, nx:] = u, -d @ plant.Df @ model.Cw
    return whole, np.vstack([d, np.zeros((count, plant.ny))])


def _free_part(decoupled: Decoupled, plant: DescriptorSystem, model: Exosystem) -> tuple[FloatArray, FloatArray]:
    return np.hstack([decoupled.free_U, -decoupled.free_D @ plant.Df @ model.Cw]), decoupled.free_D


def _completed(problem: PlacementProblem, k: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return U_a, D_a, K_a of the scaled plant: the gain of the pair is ``[-Z K]``."""
    decoupled, plant, model = problem.decoupled, problem.plant, problem.model
    u, d = problem.U, problem.D
    if problem.free:
        more_u, more_d = _free_part(decoupled, plant, model)
        z = -k[:, : problem.free]
        u, d = u + z @ more_u, d + z @ more_d
    injection = np.vstack([decoupled.injection, np.zeros((model.order, plant.ny))])
    return u, d, k[:, problem.free :] @ decoupled.seen + u @ injection


def _given_decoupling(plant: DescriptorSystem, units: PlantUnits, given: Mapping[str, Any]) -> Decoupled:
    if plant.Dd.any():
        raise SpecError("E_sharp, C_sharp and G are for plants without Dd: leave them out.", path="E_sharp")
    matrices = [as_matrix(given[name], name) for name in ("E_sharp", "C_sharp", "G")]
    _, u, d = paper_decoupling(plant, e_sharp=matrices[0], c_sharp=matrices[1], g=matrices[2])
    seen, injection, _ = direct_part(plant)
    u = u / units.states[:, None] / units.equations
    d = d / units.states[:, None] / units.outputs
    return Decoupled(u, d, np.zeros((0, plant.nx)), np.zeros((0, plant.ny)), seen, injection)


def _own_rate(plant: DescriptorSystem, f: FloatArray) -> float:
    """Return the median speed of the plant's modes; of the pair's where it has none; or its size."""
    structure = structure_of(plant)
    size = largest_singular_value(f)
    for values in (structure.finite_eigenvalues, eigenvalues(f)):
        found = moving_speeds(values, plant.dt, 1.0 / plant.dt if plant.dt > 0.0 else 0.0)
        found = found[found > DEAD_BEAT]
        if found.size and (plant.dt > 0.0 or np.max(found) > INTEGRATOR_SCATTER * size):
            median = float(np.median(found))
            return min(median, MOST_PER_SAMPLE / plant.dt) if plant.dt > 0.0 else median
    return 1.0 / plant.dt if plant.dt > 0.0 else size or 1.0


#: How strongly states are driven by default, beside fault models: a plant is better known than the course of a fault.
PROCESS_SHARE = 0.1
#: Noise on innovations that have none of their own, relative to the outputs' noise.
INNOVATION_NOISE = 0.1


def kalman_problem(problem: PlacementProblem, weights: Mapping[str, Any]) -> KalmanProblem:
    """Return the observable part of the pair with its noise, in the coordinates of the split.

    ``weights``: what the Kalman filter believes beside what the plant states: ``measurement``, the deviation of each
    output's noise (a number or by name; continuous time: times the root of a second), and ``process`` and ``fault``,
    relative to the default.
    """
    plant, split = problem.plant, problem.split
    order = problem.model.order
    bw, dw = _noise(problem, weights)
    augmented_bw = np.vstack([bw, np.zeros((order, bw.shape[1]))])
    injection = np.vstack([problem.decoupled.injection, np.zeros((order, plant.ny))])
    entering = problem.U @ augmented_bw - problem.F @ problem.D @ dw - problem.U @ injection @ dw
    shown = np.eye(plant.ny) - AugmentedPlant.of(plant, problem.model).C @ problem.D
    measured = problem.decoupled.seen @ shown @ dw
    size = float(np.sqrt(np.mean(np.sum(dw**2, axis=1)))) if dw.any() else 1.0
    if problem.free:
        # The free outputs carry the noise of derivatives; as a stand-in they get the size of the others.
        entering = np.hstack([entering, np.zeros((len(entering), problem.free))])
        measured = np.block(
            [
                [np.zeros((problem.free, measured.shape[1])), size * np.eye(problem.free)],
                [measured, np.zeros((len(measured), problem.free))],
            ]
        )
    per_step = problem.rate * (plant.dt if plant.dt > 0.0 else 1.0)
    strength = np.concatenate(
        [np.full(plant.nx, PROCESS_SHARE * weights.get("process", 1.0)), np.full(order, weights.get("fault", 1.0))]
    )
    faults = np.hstack([np.zeros((plant.nf, plant.nx)), problem.model.Cw])
    return KalmanProblem(
        F=split.F,
        C=split.C,
        B=split.lower(entering),
        D=measured,
        drive=split.basis[:, : split.order].T @ np.diag(per_step * size * strength),
        background=INNOVATION_NOISE * size * np.eye(len(problem.C)),
        estimates=split.shown(faults),
        dt=plant.dt,
    )


def _noise(problem: PlacementProblem, weights: Mapping[str, Any]) -> tuple[FloatArray, FloatArray]:
    """Return the noise inputs of the scaled plant."""
    plant, units = problem.plant, problem.units
    given = weights.get("measurement")
    if given is None and plant.Dw.any():
        return plant.Bw, plant.Dw
    deviations, stated = np.ones(plant.ny), np.zeros((plant.ny, plant.nw))
    if given is not None:
        listed = [given[name] if isinstance(given, Mapping) else given for name in plant.output_names]
        deviations = np.array(listed) * units.outputs / (1.0 if units.discrete else np.sqrt(units.time))
    return np.hstack([plant.Bw, np.zeros((plant.nx, plant.ny))]), np.hstack([stated, np.diag(deviations)])


#: Fixed modes closer than this, relative to their size, are peeled off together, at their mean: a double one that
#: rounding split lies at about the square root of the unit roundoff from it.
SAME_MODE = 1e-5


@dataclass(frozen=True, eq=False)
class ObservableSplit:
    """``x = units * basis @ [observable; hidden]``: ``F = [F_o 0; F_ho F_h]`` and ``C = [C_o 0]``."""

    basis: FloatArray  # (n, n), orthogonal
    units: FloatArray  # (n,): the states are balanced first
    F: FloatArray  # F_o (no, no)
    C: FloatArray  # C_o (ny, no)
    fixed_modes: ComplexArray  # of the hidden part

    @property
    def order(self) -> int:
        """Number of observable states."""
        return int(self.F.shape[0])

    def lift(self, gain: FloatArray) -> FloatArray:
        """Return the gain ``(n, ny)`` of the whole pair for one of the observable part ``(no, ny)``."""
        return np.asarray(self.units[:, None] * (self.basis[:, : self.order] @ gain))

    def lower(self, matrix: FloatArray) -> FloatArray:
        """Return the observable rows of an input matrix ``(n, *)`` of the whole pair."""
        return np.asarray(self.basis[:, : self.order].T @ (matrix / self.units[:, None]))

    def shown(self, matrix: FloatArray) -> FloatArray:
        """Return the observable columns of an output matrix ``(*, n)`` of the whole pair."""
        return np.asarray((matrix * self.units) @ self.basis[:, : self.order])


def observable_split(f: FloatArray, c: FloatArray, fixed_modes: ComplexArray, *, dt: float) -> ObservableSplit:
    """Split the pair ``(F, C)`` at its fixed modes; ``f (n, n)``, ``c (ny, n)``.

    A stable mode that is fixed by the zeros of the plant's pencil, but that the pair shows, is left where it shows: it
    decays with or without a gain.  An unstable one cannot be left, and is refused."""
    n = f.shape[0]
    units = _balancing(f, c)
    work_f, work_c, basis = f * units / units[:, None], c * units, np.eye(n)
    size = max(largest_singular_value(work_f), largest_singular_value(work_c)) if n else 1.0
    waiting: list[complex] = []
    for mode in map(complex, fixed_modes):
        if 0.0 < abs(mode.imag) <= SAME_MODE * max(1.0, abs(mode)):
            waiting.append(complex(mode.real, 0.0))
        elif mode.imag >= 0.0:
            waiting.append(mode)
    seen = n
    while waiting:
        value = waiting[0]
        cluster = [other for other in waiting if abs(other - value) <= SAME_MODE * max(1.0, abs(value))]
        kernel = _hidden_directions(work_f[:seen, :seen], work_c[:, :seen], sum(cluster) / len(cluster), size)
        found = kernel.shape[1] // (2 if value.imag > 0.0 else 1)
        if found == 0 and not any(is_outside(other, dt) for other in cluster):
            waiting = [other for other in waiting if other not in cluster]
            continue
        if found == 0 or (found > len(cluster) and is_outside(value, dt)):
            raise PreconditionError(
                f"By the zeros of plant and fault model {value:.6g} is a fixed mode, but it is observable in the pair "
                "(U A, C): double precision cannot decide. Lower the order of the fault model, or rescale the plant.",
                condition="fixed modes",
                mode=value,
            )
        turn = np.eye(n)
        # Observable directions first, the hidden ones behind them.
        left = np.linalg.svd(kernel)[0]
        turn[:seen, :seen] = np.hstack([left[:, kernel.shape[1] :], left[:, : kernel.shape[1]]])
        work_f, work_c, basis = turn.T @ work_f @ turn, work_c @ turn, basis @ turn
        seen -= kernel.shape[1]
        for other in cluster[:found]:
            waiting.remove(other)
    hidden = eigenvalues(work_f[seen:, seen:])
    return ObservableSplit(basis, units, work_f[:seen, :seen], work_c[:, :seen], hidden)


def _hidden_directions(f: FloatArray, c: FloatArray, value: complex, size: float) -> FloatArray:
    """Return a real orthonormal basis of the states that stay invisible at the mode, and at its conjugate."""
    shifted = f - (value if value.imag else value.real) * np.eye(f.shape[0])
    _, values, right = np.linalg.svd(np.vstack([shifted, c]))
    kernel = right[values <= HIDDEN_MODE_TOLERANCE * max(size, abs(value))].conj().T
    if value.imag == 0.0:
        return np.asarray(kernel.real)
    both = np.hstack([kernel.real, kernel.imag])
    if both.shape[1] == 0:
        return both
    left, lengths, _ = np.linalg.svd(both, full_matrices=False)
    return np.asarray(left[:, lengths > RANK_TOLERANCE])


def _balancing(f: FloatArray, c: FloatArray) -> FloatArray:
    """Return state factors that make entries of F, and of C, alike; F's size is free, as it may be reducible."""
    n = f.shape[0]
    problem = LogBalance(n + 2)
    states = range(n)
    links = np.where(np.eye(n, dtype=bool), 0.0, f)
    # All outputs together: which combinations of them are looked at must not matter.
    shown = np.linalg.norm(c, axis=0, keepdims=True)
    floor_f, floor_c = (CANCELLATION_TOLERANCE * float(np.max(np.abs(part), initial=0.0)) for part in (f, shown))
    problem.add(np.where(np.abs(links) > floor_f, f, 0.0), states, states, signs=(-1, 1), common=n)
    problem.add(np.where(shown > floor_c, shown, 0.0), range(n + 1, n + 2), states)
    for state in states:
        problem.wish(state, 0.0)
    return np.asarray(np.exp2(problem.solve()[:n]))


#: Poles of what is shipped that are this close to those asked for, relative to their size, are claimed as asked.
SAME_AS_ASKED = 5e-5
#: Poles that a rounding of Ahat moves by more than this, relative to their size, are claimed as they are enclosed: what
#: an algorithm finds of them another processor does not find again to the share that is allowed.
KNOWN_POLES = 1e-6


def synthesis_from_gains(plant: DescriptorSystem, *, U: Any, D: Any, K: Any, F: Any, fault_model: Any) -> Synthesis:
    """Return the realisation of given gains; see `obsynth.design_from_gains`."""
    model = exosystem(fault_model, plant.fault_names, plant.dt)
    nx, ny, count = plant.nx, plant.ny, model.order
    given = {name: as_matrix(value, name) for name, value in (("U", U), ("D", D), ("K", K), ("F", F))}
    shapes = {"U": (nx, nx), "D": (nx, ny), "K": (nx, ny), "F": (count, ny)}
    for name, shape in shapes.items():
        require_shape(given[name].shape, shape, name)
    u, d = with_faults(given["U"], given["D"], plant, model)
    gains = u, d, np.vstack([given["K"], given["F"]])
    options = {"from_gains": True, "fault_model": plain(fault_model)}
    found = assembled(plant, model, gains, None, {}, structured=True)
    return Synthesis(options, found.gains, found.observer, found.certificate)


def assembled(
    plant: DescriptorSystem,
    model: Exosystem,
    gains: tuple[FloatArray, FloatArray, FloatArray],
    poles: ComplexArray | None,
    claims: dict[str, float],
    *,
    structured: bool,
) -> Synthesis:
    """Return realisation and certificate of gains in the plant's units; poles that were not asked for are computed."""
    observer, letters = realise(plant, model, gains, combinations_seen(plant))
    nx, (u, d, k) = plant.nx, gains
    if structured:
        letters |= {"U": u[:nx, :nx], "D": d[:nx], "K": k[:nx], "F": k[nx:]}
        letters["Hhat"] = letters["U"] @ plant.Bf
    letters |= {"Phi": model.Phi, "Cw": model.Cw}
    poles = _shipped_poles(observer, poles)
    order = np.lexsort((poles.imag, poles.real))
    matrices = {
        "tracking": u,
        "Phi": model.Phi,
        "Cw": model.Cw,
        "poles": np.column_stack([poles.real, poles.imag])[order] if poles.size else np.zeros((0, 2)),
        "stability": stability_factor(observer),
    }
    slowest = slowest_decay(observer.Az, plant.dt)
    claims = {"decay": slowest, "noise_amplification": noise_amplification(observer), **claims}
    if not abscissa(as_printed(observer.Az, PRINTED_DIGITS), plant.dt) < (1.0 if plant.dt > 0.0 else 0.0):
        claims["digits"] = float(digits_needed(observer.Az, plant.dt))
    finite = {name: value for name, value in claims.items() if np.isfinite(value)}
    return Synthesis({}, letters, observer, Certificate(matrices, finite))


def _shipped_poles(observer: LinearObserver, asked: ComplexArray | None) -> ComplexArray:
    """Return the poles as asked for where the stored numbers have them, else those that they have: what is shipped."""
    found = eigenvalues(observer.Az)
    if asked is not None and farthest_pole(found, asked, observer.dt) <= SAME_AS_ASKED:
        return asked
    if (
        asked is None
        and len(found)
        and rounding_of_eigenvalues(observer.Az) <= KNOWN_POLES
        and slowest_decay(observer.Az, observer.dt) == np.min(decay_rates(found, observer.dt), initial=np.inf)
    ):
        return found
    enclosed = enclosed_eigenvalues(observer.Az)
    if enclosed is None:
        return found
    exact = np.array([middle_of(ball) for ball in enclosed])
    return asked if asked is not None and farthest_pole(exact, asked, observer.dt) <= SAME_AS_ASKED else exact


def noise_amplification(observer: LinearObserver) -> float:
    """Return the largest H2 norm from unit white noise on every output to a fault estimate, the direct part left out.

    NaN where rounding leaves no digit of it.  For dt = 0 times the root of the time for which noise is held.
    """
    rows = observer.Cz[observer.fault_rows]
    direct = observer.Dy[observer.fault_rows] * (observer.dt > 0.0)
    stable = abscissa(observer.Az, observer.dt) < (1.0 if observer.dt > 0.0 else 0.0)
    if not len(rows) or not stable:
        return 0.0 if not len(rows) else float("inf")
    covariance = certain_noise_covariance(observer.Az, observer.By, rows, direct, observer.dt)
    return float(np.sqrt(np.max(np.maximum(np.diag(covariance), 0.0))))
