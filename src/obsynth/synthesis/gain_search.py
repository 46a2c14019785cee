"""Strategy around the convex core: find the least gain, then gains of least size, and prove what is impossible.

No number of a solver is believed: a gain counts as reached only when the true H-infinity norm of the closed loop
says so, and as impossible only with a dual point that passes our own check.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from obsynth.errors import InfeasibleError, SolverError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.norms import spectral_radius
from obsynth.numerics.ranks import RANK_TOLERANCE
from obsynth.synthesis import gain_design, lmi
from obsynth.synthesis.gain_problem import GainProblem, Injection, NormalisedProblem, normalise

#: The search stops when another pass in better coordinates improves the gain by less than this.
PASS_IMPROVEMENT = 1e-6
MOST_PASSES = 4
#: Gains below this fraction of the starting filter's are treated as zero: the disturbance is decoupled.
NEGLIGIBLE_GAIN = 1e-6
#: A shipped gain is never asked to be smaller than this fraction of the starting filter's.
SMALLEST_USEFUL_GAIN = 1e-3
#: A dual point must be positive definite, and beat the level, by these relative margins.
DUAL_MARGIN = 1e-8
BOUND_MARGIN = 1e-6


@dataclass(frozen=True, eq=False)
class LeastGain:
    """The outcome of the search for the least gain.

    Parameters
    ----------
    gain : float
        True norm of the best filter found (0 without disturbance).
    normalised : NormalisedProblem
        Coordinates made from the best filter.
    injection : Injection
        Its gains, in the original coordinates.
    starting_gain : float
        Norm of the starting (Kalman) filter, the natural scale.
    bracket : tuple of float
        Bisection: the final bracket; direct search: the same number twice.
    records : list
        Solver records.
    """

    gain: float
    normalised: NormalisedProblem
    injection: Injection
    starting_gain: float
    bracket: tuple[float, float]
    records: list[dict[str, Any]] = field(default_factory=list)


def search_least_gain(problem: GainProblem, *, solver: str) -> LeastGain:
    """Minimise the gain directly, improving the coordinates between passes.

    Raises
    ------
    SolverError
        No pass gave a stable filter.
    """
    normalised = normalise(problem)
    best, gain = normalised.start, problem.achieved_gain(normalised.start)
    starting, records = gain, []
    if problem.measured == 0 or gain == 0.0:
        return LeastGain(gain, normalised, best, starting, (gain, gain))
    for _ in range(MOST_PASSES):
        try:
            found = gain_design.least_gain(normalised.problem, solver=solver)
        except (SolverError, np.linalg.LinAlgError) as error:
            records.append(dict(getattr(error, "record", {})) | {"outcome": str(error)})
            break
        records.append(found.record)
        injection = normalised.restore(found.injection)
        reached = problem.achieved_gain(injection)
        improved = reached < gain * (1.0 - PASS_IMPROVEMENT)
        if reached < gain:
            best, gain = injection, reached
            normalised = normalise(problem, start=best)
        if not improved or gain <= NEGLIGIBLE_GAIN * starting:
            break
    return LeastGain(gain, normalised, best, starting, (gain, gain), records)


def search_by_bisection(problem: GainProblem, *, tolerance: float, solver: str) -> LeastGain:
    """Minimise the gain by bisection (the paper's Algorithm 1, made to end)."""
    normalised = normalise(problem)
    gain = problem.achieved_gain(normalised.start)
    if problem.measured == 0 or gain == 0.0:
        return LeastGain(gain, normalised, normalised.start, gain, (gain, gain))
    start = normalised.contracted(normalised.start)
    high, low, found, records = gain_design.bisected_gain(normalised.problem, start, tolerance=tolerance, solver=solver)
    injection = normalised.restore(found)
    better = normalise(problem, start=injection)
    return LeastGain(
        problem.achieved_gain(injection), better, injection, gain, (low * normalised.gain, high * normalised.gain), records
    )


def small_gain_design(
    problem: GainProblem, least: LeastGain, gain: float, *, solver: str
) -> tuple[Injection, list[dict[str, Any]]]:
    """Return gains of least size or least noise whose true norm is at most ``gain``.

    Falls back on the centre of the inequality, and then on the filter of the search, when the solver fails; the
    records say so.

    Parameters
    ----------
    problem : GainProblem
        In the original coordinates.
    least : LeastGain
        Where the search ended.
    gain : float
        Level asked for.
    solver : str
        Name of the solver.

    Raises
    ------
    SolverError
        Nothing reached ``gain``.
    """
    records: list[dict[str, Any]] = []
    if problem.measured == 0:
        return least.injection, records
    nothing = Injection(np.zeros_like(least.injection.R), np.zeros_like(least.injection.V))
    if not np.any(problem.Bn) and not np.any(problem.Zn) and _reaches(problem, nothing, gain):
        # Without a noise model the objective is the size of the gains themselves, and zero is least.
        return nothing, records
    for normalised in (least.normalised, normalise(problem)):
        try:
            found = gain_design.small_gains(_with_scaled_noise(normalised), gain / normalised.gain, solver=solver)
        except SolverError as error:
            records.append(dict(error.record) | {"outcome": str(error)})
            continue
        records.append(found.record)
        injection = normalised.restore(found.injection)
        if _reaches(problem, injection, gain):
            return injection, records
    if problem.disturbances:
        centre = gain_design.feasible_point(least.normalised.problem, gain / least.normalised.gain, solver=solver)
        if centre is not None and _reaches(problem, least.normalised.restore(centre.injection), gain):
            return least.normalised.restore(centre.injection), [*records, centre.record]
    if _reaches(problem, least.injection, gain):
        return least.injection, records
    raise SolverError(f"No filter with gain {gain:.6g} was found: nothing is known.", record=records[-1])


def _reaches(problem: GainProblem, injection: Injection, gain: float) -> bool:
    limit = problem.weight_limit
    if limit is not None and float(np.linalg.norm(limit.fixed + injection.V @ limit.free, 2)) > limit.bound:
        return False
    if problem.disturbances == 0:
        return spectral_radius(problem.closed_loop(injection)[0]) < 1.0
    return problem.achieved_gain(injection) <= gain


def _with_scaled_noise(normalised: NormalisedProblem) -> GainProblem:
    """Return the problem with its noise scaled so that the objective is of size one."""
    work = normalised.problem
    r = normalised.contracted(normalised.start).R
    size = float(np.linalg.norm(np.vstack([work.Bn - r @ work.Dn, work.Zn])))
    size = size if size > 0.0 else max(float(np.linalg.norm(work.Dn)), 1.0)
    return replace(work, Bn=work.Bn / size, Dn=work.Dn / size, Zn=work.Zn / size)


def proved_lower_bound(problem: GainProblem, *, solver: str) -> float:
    """Return a lower bound on the gain of every filter, from a dual point that passes our own check; 0 without one.

    For ``Z1 >= 0`` in the null basis N of [C D] with ``Q = G N Z1 N'G' - Nx Z1 Nx' >= 0`` and, for a fixed weight,
    ``Z2 = [Q, *; *, *] >= 0``: multiplying the two eliminated inequalities by Z1 and Z2 cancels P, and leaves
    ``g^2 (tr Nd Z1 Nd' + tr Z2_22) > tr H N Z1 N'H' + tr H Z2 H'`` (for a free weight without Z2).  The check is in
    floating point with margins, on the normalised data.
    """
    normalised = normalise(problem)
    work = disturbed_part(normalised.problem)
    n, nd = work.order, work.disturbances
    if nd == 0:
        return 0.0
    basis = _null_space(np.hstack([work.C, work.D]))
    top, bottom, image = basis[:n], basis[n:], np.hstack([work.A, work.B]) @ basis
    outputs = np.hstack([work.Z, work.Zd])
    z1 = lmi.symmetric_variable(basis.shape[1])
    corner, last = lmi.matrix_variable(nd, n), lmi.symmetric_variable(nd)
    q = image @ z1 @ image.T - top @ z1 @ top.T
    shown = lmi.trace(outputs @ basis @ z1 @ basis.T @ outputs.T)
    size = lmi.trace(bottom @ z1 @ bottom.T)
    if work.weight_is_free:
        second = q
    else:
        second = lmi.symmetric_blocks([[q], [corner, last]])
        shown, size = shown + lmi.trace(outputs @ second @ outputs.T), size + lmi.trace(last)
    constraints = [lmi.at_least(z1, DUAL_MARGIN * 2), lmi.at_least(second, DUAL_MARGIN * 2), lmi.at_most(lmi.symmetric_blocks([[_square(size)]]), 1.0)]
    try:
        lmi.minimise(-shown, constraints, what="lower bound on the gain", solver=solver)
        point = lmi.value_of(z1)
        corner_value = np.zeros((nd, n)) if work.weight_is_free else lmi.value_of(corner)
        last_value = np.zeros((nd, nd)) if work.weight_is_free else lmi.value_of(last)
    except SolverError:
        return 0.0
    return normalised.gain * _checked_bound(work, basis, point, corner_value, last_value)


def disturbed_part(problem: GainProblem) -> GainProblem:
    """Return the problem on the states that the disturbance reaches whatever the gains.

    That is the least subspace W with ``A x + B d`` in W for every x in W and d with ``C x + D d = 0``.  Outside it
    the dual inequalities have no strict solution; restricted to it they lose nothing.
    """
    n = problem.order
    subspace = np.zeros((n, 0))
    while True:
        hidden = _null_space(np.hstack([problem.C @ subspace, problem.D]))
        image = np.hstack([problem.A @ subspace, problem.B]) @ hidden
        left, values, _ = np.linalg.svd(np.hstack([subspace, image]))
        rank = int(np.sum(values > RANK_TOLERANCE * max(1.0, float(values[0])))) if values.size else 0
        if rank == subspace.shape[1]:
            break
        subspace = left[:, :rank]
    t = subspace.T
    return replace(
        problem, A=t @ problem.A @ subspace, C=problem.C @ subspace, Z=problem.Z @ subspace, B=t @ problem.B,
        Bn=t @ problem.Bn,
    )  # fmt: skip


def _null_space(matrix: FloatArray) -> FloatArray:
    """Return an orthonormal null basis of a matrix of any rank."""
    _, values, right = np.linalg.svd(matrix)
    rank = int(np.sum(values > RANK_TOLERANCE * max(1.0, float(values[0])))) if values.size else 0
    return np.asarray(right[rank:].T)


def _square(expression: Any) -> Any:
    import cvxpy

    return cvxpy.reshape(expression, (1, 1), order="C")


def _checked_bound(
    work: GainProblem, basis: FloatArray, z1: FloatArray, corner: FloatArray, last: FloatArray
) -> float:
    """Recompute the bound of a dual point from the data; 0 unless it is strictly feasible."""
    n = work.order
    top, bottom, image = basis[:n], basis[n:], np.hstack([work.A, work.B]) @ basis
    outputs = np.hstack([work.Z, work.Zd])
    z1 = 0.5 * (z1 + z1.T)
    q = image @ z1 @ image.T - top @ z1 @ top.T
    second = q if work.weight_is_free else np.block([[q, corner.T], [corner, 0.5 * (last + last.T)]])
    for matrix in (z1, second):
        values = np.linalg.eigvalsh(0.5 * (matrix + matrix.T))
        if values[0] < DUAL_MARGIN * min(1.0, float(values[-1])):
            return 0.0
    shown = float(np.trace(outputs @ basis @ z1 @ basis.T @ outputs.T))
    size = float(np.trace(bottom @ z1 @ bottom.T))
    if not work.weight_is_free:
        shown += float(np.trace(outputs @ second @ outputs.T))
        size += float(np.trace(last))
    return float(np.sqrt(max(shown, 0.0) / size)) * (1.0 - BOUND_MARGIN) if size > 0.0 else 0.0


def require_reachable(problem: GainProblem, least: LeastGain, gain: float, *, solver: str) -> None:
    """Raise unless a filter with the asked gain exists.

    Raises
    ------
    InfeasibleError
        A checked lower bound lies above ``gain``.
    SolverError
        Neither a filter nor a proof was found.
    """
    if problem.disturbances == 0 or least.gain <= gain:
        return
    bound = least.gain * (1.0 - BOUND_MARGIN) if problem.measured == 0 else proved_lower_bound(problem, solver=solver)
    choice = "for this T and N" if problem.free_weight else "for this T, N and W"
    if bound > gain:
        raise InfeasibleError(
            f"No filter reaches gamma = {gain:.6g} {choice}: a checked dual certificate proves gamma >= {bound:.6g}, "
            f"and the best filter found has {least.gain:.6g}. Ask for more, leave gamma out for the least, or set "
            "free_residual_weight: true.", necessary=False, lower_bound=bound,
        )  # fmt: skip
    raise SolverError(
        f"gamma = {gain:.6g} was not reached (best found {least.gain:.6g}), and the proved lower bound {bound:.6g} does "
        f"not rule it out: nothing is known {choice}. Ask for a slightly larger gamma.",
        record=least.records[-1] if least.records else None,
    )
