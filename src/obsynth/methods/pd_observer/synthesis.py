"""PD observer: A. Filasova, D. Krokavec, V. Serbak, (4)-(6), Theorem 1 (40)-(44), Theorem 2 (61)-(65).

Unlike the paper: P and Q are both variables in Theorem 2; the G of (25), which is in no theorem, acts inside the loop;
what is minimised, ``||[Y Z]||_F + ||P3||_F`` with ``P3 + P3' >= 2 I``, keeps solvers from P3 close to singular.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obsynth.analysis.conditions import require_all
from obsynth.errors import InfeasibleError, SolverError
from obsynth.extensions import extension
from obsynth.methods.conic.lmi import chosen_solver
from obsynth.methods.method import Synthesis
from obsynth.methods.own_terms import own_terms
from obsynth.methods.pd_observer.conditions import explicit_form, pd_observer_conditions
from obsynth.methods.pd_observer.gain_search import design_gains, gains_for
from obsynth.methods.pd_observer.gains import PdGains
from obsynth.methods.pd_observer.method import PdObserver
from obsynth.methods.pd_observer.realisation import (
    PdErrorSystem,
    with_faults_as_states,
    with_sensor_noise,
)
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.continuous import spectral_abscissa
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.delta_scan import DeltaScan
from obsynth.results.design import Certificate


def scan_delta(plant: DescriptorSystem, asked: PdObserver, deltas: NDArray[np.float64], *, decay: float) -> DeltaScan:
    """Return what each delta gives; where it gives nothing, the reason."""
    columns = [_measured(plant, asked, float(delta), decay) for delta in deltas]
    numbers = np.array([numbers for numbers, _ in columns], dtype=np.float64).reshape(len(columns), -1)
    measured = dict(zip(DeltaScan.quantities(), (np.asarray(deltas, dtype=np.float64), *numbers.T), strict=True))
    return DeltaScan.from_dict({**measured, "failures": [text for _, text in columns]})


def _measured(plant: DescriptorSystem, asked: PdObserver, delta: float, decay: float) -> tuple[list[float], str]:
    try:
        gains = gains_for(plant, replace(asked, delta=delta, decay=decay), decay=decay)
    except (InfeasibleError, SolverError) as error:
        return [float("nan")] * (len(DeltaScan.quantities()) - 1), str(error)
    return _quantities(plant, gains), ""


def _quantities(plant: DescriptorSystem, gains: PdGains) -> list[float]:
    errors = PdErrorSystem.of(with_faults_as_states(with_sensor_noise(plant)), gains.observer, plant.nx)
    return [
        -gains.abscissa,
        gains.size,
        errors.fault_norm(errors.rate).value,
        errors.fault_norm(errors.noise).value,
        float(np.linalg.norm(errors.noise[1][plant.nx :], 2)),
        spectral_abscissa(plant.A - gains.J[: plant.nx] @ plant.C),
    ]


#: Gains from sensor noise to a fault estimate above this are worth a note.
WARN_AMPLIFICATION = 50.0


def synthesise(plant: DescriptorSystem, asked: PdObserver, *, progress: Callable[[str], None]) -> Synthesis:
    """Design the observer; see `obsynth.pd_observer` for the options, results and errors."""
    solver_of = chosen_solver(asked.solver, asked.solver_options)
    if own_terms(asked) or asked.region is not None:
        own: Synthesis = extension("PD observer by its inequality")(plant, asked, progress=progress)
        return own
    asked = replace(asked, solver=solver_of)
    progress("checking the existence conditions")
    require_all(pd_observer_conditions(plant))
    form = explicit_form(plant)
    work = plant if form is None else form.plant
    g = asked.gain_matrix(work.nf)
    progress("solving the matrix inequalities")
    gains, records = design_gains(work, asked)
    solver: dict[str, Any] = {"engine": gains.engine, "runs": records}
    if asked.delta_scan is not None:
        progress("scanning delta")
        scan = scan_delta(work, asked, np.ravel(asked.delta_scan), decay=gains.decay)
        solver["delta_scan"] = scan.as_dict()
    shipped = asked.range_numbers and min(max(1.0, asked.range_numbers[0]), asked.range_numbers[1])
    loop = shipped * np.eye(work.nf) if shipped else g
    return Synthesis(
        _resolved(asked, gains, g),
        listed_gains(work, gains.J, gains.L, loop),
        gains.observer,
        _certificate(asked, gains),
        solver,
        notes(work, asked, gains),
        transformation=form,
    )


def _resolved(asked: PdObserver, gains: PdGains, g: FloatArray | None) -> dict[str, Any]:
    return {
        **asked.as_plain(),
        "delta": gains.asked_delta,
        "decay": gains.decay,
        "disk": None if asked.disk_numbers is None else list(asked.disk_numbers),
        "adaptation_gain": None if g is None else g.tolist(),
        "adaptation_range": None if asked.range_numbers is None else list(asked.range_numbers),
        "delta_scan": None if asked.delta_scan is None else np.ravel(asked.delta_scan).tolist(),
    }


def listed_gains(plant: DescriptorSystem, J: FloatArray, L: FloatArray, g: FloatArray | None) -> dict[str, FloatArray]:
    """Return the paper's J, L, M, N (and G) of gains in the loop ``[J; G M]`` and ``[L; G N]``."""
    nx = plant.nx
    inner = np.eye(plant.nf) if g is None else g
    bottom = [np.asarray(np.linalg.solve(inner, part[nx:])) for part in (J, L)]
    gains = {"J": J[:nx], "L": L[:nx], "M": bottom[0], "N": bottom[1]}
    return gains if g is None else {**gains, "G": g}


def _certificate(asked: PdObserver, gains: PdGains) -> Certificate:
    claims = {"theorem": float(gains.theorem), "delta": gains.delta, "decay": gains.decay}
    bounds: dict[str, float | None] = {
        "gain_bound": asked.gain_bound,
        "fault_rate_gain": asked.fault_rate_gain,
        "noise_gain": asked.noise_gain,
    }
    claims |= {name: float(bound) for name, bound in bounds.items() if bound is not None}
    matrices = {"P1": gains.P1, "P3": gains.P3, **gains.gain_certificates}
    if asked.disk_numbers is not None:
        claims |= {"disk_centre": asked.disk_numbers[0], "disk_radius": asked.disk_numbers[1]}
    if asked.range_numbers is not None:
        claims |= {"adaptation_low": asked.range_numbers[0], "adaptation_high": asked.range_numbers[1]}
        matrices |= {"P1_low": gains.ends[0], "P1_high": gains.ends[1]}
    return Certificate(matrices, claims)


def notes(plant: DescriptorSystem, asked: PdObserver, gains: PdGains) -> tuple[str, ...]:
    """Return what a user should know: how delta and the decay rate were chosen, slow or noisy estimates."""
    found = []
    if asked.delta is None:
        less = ", or as much of it as the closed form serves" if gains.engine == "riccati" else ""
        found.append(f"delta = {gains.asked_delta:.4g} s was chosen, from the plant's fastest mode{less}.")
    if asked.decay is None and gains.decay > 0.0:
        found.append(
            f"A decay rate of {gains.decay:.4g} 1/s was imposed: a tenth of the plant's fastest mode, or what of it is "
            "reachable with moderate gains; without it errors would die out more slowly. decay: 0 takes the smallest "
            "gains."
        )
    found += _engine_notes(asked, gains, plant.nx + plant.nf)
    return (*found, *_noise_notes(plant, gains))


_ENGINES = {"lmi": "the whole inequality", "reduced-lmi": "the smaller inequality", "riccati": "a Riccati equation"}


def _engine_notes(asked: PdObserver, gains: PdGains, states: int) -> list[str]:
    wanted = asked.engines_for(states)[0]
    if gains.engine != wanted:
        return [
            f"The engine {wanted!r} failed: these gains come from {_ENGINES[gains.engine]} (engine {gains.engine!r}), "
            "with L = 0 and N = 0."
        ]
    if asked.engine == "auto" and wanted != "lmi":
        return [
            f"With {states} unknown states the gains come from {_ENGINES[wanted]} (engine {wanted!r}), with L = 0 and "
            "N = 0; engine 'lmi' may find smaller ones."
        ]
    return []


def _noise_notes(plant: DescriptorSystem, gains: PdGains) -> list[str]:
    direct = gains.observer.Dy[gains.observer.fault_rows]
    return [
        f"The estimate of {name!r} multiplies fast errors of the measurements by up to {np.linalg.norm(row):.3g}."
        for name, row in zip(plant.fault_names, direct, strict=True)
        if np.linalg.norm(row) > WARN_AMPLIFICATION
    ]
