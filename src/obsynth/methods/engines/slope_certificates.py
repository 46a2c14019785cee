"""Gains with a proved certificate for many bounded slopes: one block with a multiplier in place of all corners.

First the least level of the inequality with a diagonal multiplier, then a proof a little above it; what counts is not
the solver's status but whether `obsynth.proofs.slope_blocks` proves it.  The inequality is sufficient, not necessary:
its levels lie above those of the inequalities at all corners.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

import numpy as np

from obsynth.conditions.problem import Conditions
from obsynth.conditions.slope_multipliers import SlopedErrors, slope_inequality
from obsynth.errors import SolverError
from obsynth.methods.engines.fastest_decay import MARGINS, fastest_rate, improved_decays, slower_decays
from obsynth.methods.engines.vertex_certificates import (
    DECAY_ROOM,
    DECAY_SHARES,
    LEVEL_UNITS,
    MOST_RESCALINGS,
    ROOMS,
    has_numbers,
    power_of_two,
)
from obsynth.numerics.arrays import FloatArray
from obsynth.proofs.vertex_inequalities import Witness, prove_decay, prove_gain, prove_mean_square

#: What every failure says: the inequality is sufficient only.
_INCONCLUSIVE = (
    "That is no proof that there is none: the inequality for so many slopes is sufficient only. Give a smaller region, "
    "or write products of one argument as one function of it, so that there are no more than 12 slopes."
)


@dataclass(frozen=True, eq=False)
class SlopeCertificate:
    """A gain that is proved for all slopes.

    Parameters
    ----------
    gain : FloatArray
        ``(n, m)``.
    witness : Witness
        Lyapunov matrices and multipliers of the level.
    of_decay : Witness
        The same matrices with multipliers that prove the decay.
    level : float
        What is proved: an L2 gain or root mean square.
    runs : tuple of mapping
        Records of the solver.
    """

    gain: FloatArray
    witness: Witness
    of_decay: Witness
    level: float
    runs: tuple[Mapping[str, Any], ...]


def certified_slopes(
    errors: SlopedErrors,
    *,
    goal: str,
    margin: float,
    decay: float | None,
    gain: FloatArray | None,
    solver: str,
    settings: Mapping[str, Any] | None,
) -> SlopeCertificate:
    """Return a gain with a certificate that is proved for every course of the slopes.

    Parameters
    ----------
    errors : SlopedErrors
        In units in which it is near one.
    goal : {"gain", "power"}
        What is made small.
    margin : float
        Relative distance to the least level.
    decay : float or None
        Errors decay at least like ``exp(-decay t)``.
    gain : FloatArray or None
        A given gain.
    solver : str
        Any of ``cvxpy.installed_solvers()`` that does semidefinite programmes.
    settings : mapping or None
        Its settings.

    Raises
    ------
    SolverError
        No certificate was found.  That proves nothing: there may be one.
    """
    balanced, factors = _balanced(errors)
    options: dict[str, Any] = {
        "goal": goal,
        "multiplier": "diagonal",
        "decay": None if decay is None else decay * (1.0 + DECAY_ROOM),
        "gain": gain,
    }
    runs: list[dict[str, Any]] = []
    least, unit = _least(balanced, options, solver, settings, runs)
    prover = prove_gain if goal == "gain" else prove_mean_square
    for level in dict.fromkeys((1.0 + max(room, margin)) * least for room in ROOMS):
        problem = slope_inequality(_in_units(balanced, unit), level=level / unit, **options)
        if not has_numbers(problem, solver, settings, runs):
            continue
        L = problem.gains()["L[1]"]
        witness = _witness(problem, errors, factors, goal, unit)
        of_decay = witness if decay is None else _witness(problem, errors, factors, "decay", unit)
        closed = errors.closed(L)
        if prover(closed, witness, level, discrete=False).proved and (
            prove_decay(closed, of_decay, decay or 0.0, discrete=False).proved
        ):
            return SlopeCertificate(L, witness, of_decay, level, tuple(runs))
    raise SolverError(f"A gain was found, but no certificate for its slopes could be proved. {_INCONCLUSIVE}")


def best_decay_of_slopes(
    errors: SlopedErrors, *, gain: FloatArray | None, limit: float
) -> tuple[float, Witness, FloatArray]:
    """Return the fastest decay that is proved, its certificate and a gain.

    Parameters
    ----------
    errors : SlopedErrors
        In units in which it is near one.
    gain : FloatArray or None
        A given gain.
    limit : float
        The fastest rate that is tried, and the largest gain.

    Raises
    ------
    SolverError
        No decay at all is proved.
    """
    balanced, factors = _balanced(errors)

    def solved(rate: float, earlier: Conditions | None) -> tuple[float, Conditions] | None:
        if earlier is not None and rate >= limit:
            return None
        metric = None if earlier is None else earlier.gains()["P"]
        problem = slope_inequality(
            balanced, goal="decay", multiplier="diagonal", decay=rate, gain=gain, gain_limit=limit, decay_metric=metric
        )
        if not has_numbers(problem, "CLARABEL", None, []):
            return None
        reached = _fastest(balanced, problem.gains())
        return None if reached is None else (reached, problem)

    start = solved(0.0, None)
    if start is not None:
        reached = improved_decays(solved, *start, discrete=False)
        near = () if gain is not None else slower_decays(min(reached[-1][0], limit), MARGINS, None)
        for rate, problem in chain(filter(None, (solved(each, None) for each in near)), reversed(reached)):
            L, witness = problem.gains()["L[1]"], _witness(problem, errors, factors, "decay", 1.0)
            for trial in slower_decays(min(rate, limit), DECAY_SHARES, None):
                if prove_decay(errors.closed(L), witness, trial, discrete=False).proved:
                    return trial, witness, L
    raise SolverError(f"No certificate of stability for the slopes was found. {_INCONCLUSIVE}")


def _fastest(errors: SlopedErrors, values: Mapping[str, FloatArray]) -> float | None:
    """Return the fastest decay that Lyapunov matrices and multipliers allow, in floating point."""
    own, G, T, L = errors.nominal, values["G"], np.diag(values["T[decay]"]), values["L[1]"]
    GA, GW = G.T @ (own.A[0] - L @ own.C[0]), G.T @ (errors.W - L @ errors.Wy)
    flow = np.block([[-(GA + GA.T + errors.V.T @ T @ errors.V), -GW], [-GW.T, T]])
    P = np.zeros_like(flow)
    P[: own.order, : own.order] = values["P"]
    return fastest_rate(flow, P)


def _balanced(errors: SlopedErrors) -> tuple[SlopedErrors, FloatArray]:
    """Return the error system with both sides of every slope about equally large, and by what V was divided."""
    into = np.linalg.norm(np.vstack([errors.W, errors.Wy]), axis=0)
    out = np.linalg.norm(errors.V, axis=1)
    both = (into > 0.0) & (out > 0.0)
    ratio = np.sqrt(np.divide(out, into, out=np.ones_like(out), where=both))
    factors = np.exp2(np.round(np.log2(ratio)))
    moved = replace(errors, W=errors.W * factors, Wy=errors.Wy * factors, V=errors.V / factors[:, None])
    return moved, factors


def _in_units(errors: SlopedErrors, unit: float) -> SlopedErrors:
    """Return the error system with z in units of ``unit``."""
    return replace(errors, nominal=replace(errors.nominal, Cz=[z / unit for z in errors.nominal.Cz]))


def _least(
    errors: SlopedErrors, options: Mapping[str, Any], solver: str, settings: Any, runs: list[dict[str, Any]]
) -> tuple[float, float]:
    """Return the least level, and the unit of z in which it is near one."""
    own = errors.nominal
    size = float(np.linalg.norm(own.Cz[0]) * np.linalg.norm(own.B[0]))
    unit, level = power_of_two(size) if size > 0.0 else 1.0, 0.0
    for _ in range(MOST_RESCALINGS):
        problem = slope_inequality(_in_units(errors, unit), **options)
        if not has_numbers(problem, solver, settings, runs):
            if level > 0.0:  # what is proved above it decides, not in which units the solver ends
                return level, unit
            raise SolverError(
                f"No certificate for the slopes was found: the solver ended with {runs[-1]['status']!r}. "
                f"{_INCONCLUSIVE}",
                record=runs[-1],
            )
        squared = problem.variables["gamma_squared" if options["goal"] == "gain" else "mean_square"].value
        least = max(float(np.sqrt(max(float(squared), 0.0))), float(np.finfo(np.float64).eps))
        level = least * unit
        if LEVEL_UNITS[0] <= least <= LEVEL_UNITS[1]:
            return level, unit
        unit *= power_of_two(least)
    return level, unit


def _witness(problem: Conditions, errors: SlopedErrors, factors: FloatArray, name: str, unit: float) -> Witness:
    """Return Lyapunov matrices and multipliers, z in the unit of the plant."""
    values = problem.gains()
    k = errors.nominal.differential or errors.nominal.order
    P, G = values["P"] * unit**2, values["G"] * unit**2
    P = 0.5 * (P + P.T)
    G[:k, :k] = P[:k, :k]
    multipliers = np.maximum(values[f"T[{name}]"], 0.0) * (unit / factors) ** 2
    return Witness([P], [G], differential=k, slopes=multipliers)
