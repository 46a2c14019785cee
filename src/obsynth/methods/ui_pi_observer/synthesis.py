"""Unknown-input PI observer: M. M. Share Pasand, M. Aliyari Sh., H. D. Taghirad, (4), (19), procedures 1 and 2.

Unlike the paper: existence by (D1)-(D3); each fault has its own exosystem; ``E#, C#, G`` (10), (11) only on request; K
and the free part of the decoupling (the paper's G) can be designed together; where (D1) fails at index 1, elimination.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from obsynth.analysis.zeros import is_outside
from obsynth.errors import PreconditionError, SolverError, SpecError
from obsynth.extensions import extension
from obsynth.methods.conic.lmi import chosen_solver
from obsynth.methods.method import Synthesis, plain
from obsynth.methods.own_terms import own_terms
from obsynth.methods.placement.eigenstructure import checked_poles, place
from obsynth.methods.placement.kalman import KalmanProblem, compromise
from obsynth.methods.placement.region import Region, region_gain
from obsynth.methods.refusals import require_all_told
from obsynth.methods.riccati import lyapunov_factor
from obsynth.methods.ui_pi_observer.augmented_plant import ObserverGains, combinations_seen, realise
from obsynth.methods.ui_pi_observer.conditions import existence
from obsynth.methods.ui_pi_observer.method import UiPiObserver
from obsynth.methods.ui_pi_observer.notes import notes
from obsynth.methods.ui_pi_observer.pencils import number
from obsynth.methods.ui_pi_observer.placement_problem import (
    NoiseWeights,
    PlacementProblem,
    kalman_problem,
    placement_problem,
    with_faults,
)
from obsynth.numerics.arrays import ComplexArray, FloatArray, as_matrix
from obsynth.numerics.spectra import (
    PRINTED_DIGITS,
    abscissa,
    as_printed,
    decay_rates,
    digits_needed,
    eigenvalues,
    farthest_pole,
)
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.fault_models import Exosystem, exosystem
from obsynth.proofs.covariances import certain_noise_covariance
from obsynth.proofs.extended_balls import enclosed_eigenvalues, middle_of
from obsynth.results.design import Certificate
from obsynth.verification.certificates import slowest_decay

#: A region with a radius and no decay asks for at most this share of its radius.
RADIUS_SHARE = 0.5
#: Poles of what is shipped that are this close to those asked for, relative to their size, are claimed as asked.
SAME_AS_ASKED = 5e-5


def synthesise(plant: DescriptorSystem, asked: UiPiObserver, *, progress: Callable[[str], None]) -> Synthesis:
    """Design the observer; see `obsynth.ui_pi_observer` for the options, results and errors."""
    solver = chosen_solver(asked.solver, asked.solver_options)
    if own_terms(asked):
        own: Synthesis = extension("UI-PI observer by its inequality")(plant, asked, progress=progress)
        return own
    asked = replace(asked, solver=solver)
    model = exosystem(asked.fault_model, plant.fault_names, plant.dt)
    region = asked.checked_region(plant.dt)
    weights = asked.checked_noise(plant.output_names)
    progress("checking the existence conditions")
    found = existence(plant, model)
    require_all_told(found.conditions)
    working = found.plant
    progress("decoupling the unknown inputs")
    problem = placement_problem(working, model, found.fixed_modes, joint=asked.joint, given=asked.given_decoupling())
    if asked.G is not None:
        _require_stable(problem)
    progress("choosing the gains")
    chosen = _chosen(asked, problem, region, weights, plant.dt)
    progress("building the realisation and its certificate")
    gains = problem.gains(chosen.gain)
    poles = None if chosen.poles is None else np.array([*chosen.poles, *problem.fixed_modes])
    synthesis = _assembled(working, model, gains, poles, dict(chosen.claims), structured=not asked.joint)
    return Synthesis(
        asked.resolved(model, plant.fault_names),
        synthesis.gains,
        synthesis.observer,
        synthesis.certificate,
        {"runs": list(chosen.runs)},
        tuple(notes(found, problem, asked, synthesis.certificate.claims)),
        found.transformation,
    )


@dataclass(frozen=True, eq=False)
class _Chosen:
    """A gain of the observable part, its poles where they were asked for, and what is claimed about the choice."""

    gain: FloatArray
    poles: Sequence[complex] | None
    claims: Mapping[str, float]
    runs: tuple[Mapping[str, Any], ...] = ()


def _placed(problem: PlacementProblem, wanted: Sequence[complex], objective: str) -> _Chosen:
    """Return the gain for given poles; its size is that in the user's units where outputs are not mixed."""
    split, plant, units = problem.split, problem.plant, problem.units
    plain_outputs = problem.free == 0 and np.array_equal(problem.decoupled.seen, np.eye(plant.ny))
    outputs = units.outputs if plain_outputs else np.ones(len(split.C))
    scaled_poles = [units.rate * pole for pole in wanted]
    found = place(
        split.F, split.C / outputs[:, None], scaled_poles, dt=plant.dt, objective=objective,
        weight=units.augmented_states[:, None] * split.lift(np.eye(split.order)),
    )  # fmt: skip
    return _Chosen(found.K / outputs, wanted, {"condition": found.condition})


def _chosen(
    asked: UiPiObserver, problem: PlacementProblem, region: Region | None, weights: NoiseWeights, dt: float
) -> _Chosen:
    split, time = problem.split, problem.units.time
    if asked.poles is not None:
        wanted = checked_poles(asked.poles, split.order, problem.fixed_modes, dt)
        return _placed(problem, wanted, asked.objective)
    kalman = kalman_problem(problem, weights)
    claims: dict[str, float] = {}
    runs: tuple[Mapping[str, Any], ...] = ()
    if region is not None:
        gain, record = _in_region(kalman, region.in_time(time), problem.rate, asked)
        runs = (record,)
    elif asked.decay is not None:
        found = kalman.gain(time * asked.decay, persistent=True)
        if found is None:
            raise SolverError(
                f"The Riccati equation for decay {asked.decay:g} 1/s has no solution that double precision could tell "
                "from rounding, not even by way of slower rates: some mode shows too little for so much speed. Ask for "
                "less, leave decay out, or give poles, which are placed without this equation."
            )
        gain = found
    else:
        fair = compromise(kalman, problem.rate)
        if fair is None:
            raise SolverError("The Riccati equation has no usable solution: give poles= or a slow decay=.")
        gain, claims = fair.K, {"noise_price": fair.price}
    return _Chosen(gain, None, claims, runs)


def _in_region(
    kalman: KalmanProblem, region: Region, rate: float, asked: UiPiObserver
) -> tuple[FloatArray, dict[str, Any]]:
    """Return a gain for the region; without a decay, with that of the default: least noise alone hardly moves."""
    if asked.region.get("decay") is None:
        fair = compromise(kalman, rate)
        most = np.inf if region.radius is None else RADIUS_SHARE * region.radius
        wanted = replace(region, decay=float(min(fair.decay, most)) if fair is not None else 0.0)
        try:
            return region_gain(kalman, wanted, solver=asked.solver)
        except SolverError:
            # What was asked may be possible all the same.
            pass
    return region_gain(kalman, region, solver=asked.solver)


def _require_stable(problem: PlacementProblem) -> None:
    """Raise when a mode that no gain moves is not stable: only a given ``E#`` or ``G`` can bring one in."""
    # On the boundary within rounding is not stable either: an equation that is lost leaves a mode at zero.
    modes = zip(problem.split.fixed_modes, problem.fixed_modes, strict=True)
    unstable = [complex(own) for scaled, own in modes if is_outside(complex(scaled), problem.plant.dt)]
    if unstable:
        raise PreconditionError(
            f"With these E_sharp, C_sharp and G the mode {number(unstable[0])} is fixed and not stable: U has lost "
            "rank and with it equations of the plant. Leave E_sharp, C_sharp and G out.",
            condition="fixed modes",
            mode=unstable[0],
        )


def synthesis_from_gains(plant: DescriptorSystem, *, U: Any, D: Any, K: Any, F: Any, fault_model: Any) -> Synthesis:
    """Return the realisation of given gains; see `obsynth.ui_pi_observer_from_gains`."""
    model = exosystem(fault_model, plant.fault_names, plant.dt)
    nx, ny, count = plant.nx, plant.ny, model.order
    given = {name: as_matrix(value, name) for name, value in (("U", U), ("D", D), ("K", K), ("F", F))}
    shapes = {"U": (nx, nx), "D": (nx, ny), "K": (nx, ny), "F": (count, ny)}
    for name, shape in shapes.items():
        if given[name].shape != shape:
            raise SpecError(f"{name} is {given[name].shape}, but {shape} is needed.", path=name)
    u, d = with_faults(given["U"], given["D"], plant, model)
    gains = ObserverGains(u, d, np.vstack([given["K"], given["F"]]))
    options = {"from_gains": True, "fault_model": plain(fault_model)}
    found = _assembled(plant, model, gains, None, {}, structured=True)
    return Synthesis(options, found.gains, found.observer, found.certificate)


def _assembled(
    plant: DescriptorSystem,
    model: Exosystem,
    gains: ObserverGains,
    poles: ComplexArray | None,
    claims: dict[str, float],
    *,
    structured: bool,
) -> Synthesis:
    """Return realisation and certificate of gains in the plant's units; poles that were not asked for are computed."""
    observer, letters = realise(plant, model, gains, combinations_seen(plant))
    nx = plant.nx
    if structured:
        letters |= {"U": gains.U[:nx, :nx], "D": gains.D[:nx], "K": gains.K[:nx], "F": gains.K[nx:]}
        letters["Hhat"] = letters["U"] @ plant.Bf
    letters |= {"Phi": model.Phi, "Cw": model.Cw}
    poles = _shipped_poles(observer, poles)
    order = np.lexsort((poles.imag, poles.real))
    matrices = {
        "tracking": gains.U,
        "Phi": model.Phi,
        "Cw": model.Cw,
        "poles": np.column_stack([poles.real, poles.imag])[order] if poles.size else np.zeros((0, 2)),
        "stability": lyapunov_factor(observer.Az, plant.dt),
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
