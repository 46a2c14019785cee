"""Gains of an observer over a polytope, with Lyapunov matrices that prove a gain, a mean square or a decay.

A first problem finds the least level.  Its P proves nothing, since the inequality is singular there.  A second problem
fixes a level a little above and maximises the slack.  A solution is accepted if `obsynth.proofs.vertex_inequalities`
proves it, whatever the solver's status is.  Both problems are scaled by powers of two, without rounding, to states and
levels near one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

import numpy as np

from obsynth.conditions.lmi import USABLE_STATUSES
from obsynth.conditions.polytope import vertex_inequalities, witness_of
from obsynth.errors import SolverError
from obsynth.methods.engines.extreme_vertices import ExtremeVertices
from obsynth.methods.engines.fastest_decay import MARGINS, fastest_allowed_decay, improved_decays, slower_decays
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.norms import state_units
from obsynth.numerics.ranks import decide_rank
from obsynth.proofs.balls import rounded_up
from obsynth.proofs.vertex_inequalities import VertexProof, Witness, prove_decay, prove_gain, prove_mean_square
from obsynth.verification.error_polytope import ErrorPolytope

#: Relative distances above the least level at which a proof is tried, in turn; 200 of 200 random certificates passed at
#: the first one.
ROOMS = (5e-4, 2e-3, 1e-2, 5e-2)
#: Further distances, for the case that none of these has a proof: a large claim is better than none.
WIDE_ROOMS = (0.2, 1.0, 4.0, 20.0, 100.0)
#: A requested decay enters the inequalities faster by this share, for the tolerances of the solver.
DECAY_ROOM = 1e-3
#: A least level outside this range is computed again in units of the level.
LEVEL_UNITS = (2.0**-4, 2.0**4)
#: Most such computations; a level that is wrong by 1e-10 is near one after the second.
MOST_RESCALINGS = 4
#: Levels, relative to the size of the errors, that count as zero.  If errors can be decoupled, the least level is zero
#: up to rounding, and the first of these levels with a proof is claimed.
NEGLIGIBLE = (1e-4, 1e-3, 1e-2, 1e-1, 1.0)
#: Shares of the distance to one by which a shipped decay is slower than the fastest one, whose P proves nothing.
DECAY_MARGINS = (0.02, 0.1, 0.3)
#: Limits of cubed states times vertices, and of vertices, for the search of the fastest decay.  At the limits (8 states
#: with 8 vertices, 4 with 32) it takes about five seconds; with 16 states and two vertices it would take twenty.
MOST_FAST, MOST_FAST_VERTICES = 4096, 32
#: Shares by which a decay without a proof is slowed down, towards no decay.
DECAY_SHARES = (1e-6, 1e-3, 1e-2, 1e-1, 0.3, 0.6, 0.8, 0.9, 0.95, 0.99, 0.999)
#: Number of roundings that a claimed gain covers: those of its product with a bound and of the quotient in its check,
#: and a few more.
CLAIM_ROUNDINGS = 6


@dataclass(frozen=True, eq=False)
class VertexCertificate:
    """Gains with a proved certificate.

    Parameters
    ----------
    gains : list of FloatArray
        One for each vertex, or one for all.
    witness : Witness
        Lyapunov matrices.
    level : float
        The proved l2 gain or root mean square.
    least : float
        The least level of the first problem, without a proof.
    decay : float
        The decay that the same P proves.
    proof : VertexProof
        The proof of the level.
    runs : tuple of mapping
        Records of the solver.
    output : FloatArray, optional
        V, the gain from the innovation to z, where it was free.
    is_negligible : bool
        Whether the least level is zero up to rounding, and ``level`` is one of the `NEGLIGIBLE` shares.
    is_fastest : bool
        False where the problem is too large for the search of the fastest decay.
    """

    gains: list[FloatArray]
    witness: Witness
    level: float
    least: float
    decay: float
    proof: VertexProof
    runs: tuple[Mapping[str, Any], ...]
    output: FloatArray | None = None
    is_negligible: bool = False
    is_fastest: bool = True

    def gains_at_each(self, count: int) -> list[FloatArray]:
        """Return the gains at each of ``count`` vertices, also where one is for all."""
        return list(self.gains) * (count if len(self.gains) == 1 else 1)

    def gain_times(self, reach: float) -> float:
        """Return the level times a bound ``reach``, rounded up so that the claim covers its own rounding errors."""
        return float(rounded_up(np.asarray(self.level * reach), CLAIM_ROUNDINGS))


def certified(
    errors: ErrorPolytope,
    *,
    goal: str = "gain",
    level: float | None = None,
    margin: float = 0.0,
    decay: float | None = None,
    lyapunov: str = "common",
    steps: float | None = None,
    gain: str = "scheduled",
    gains: Sequence[FloatArray] | None = None,
    free_output: bool = False,
    fast_decay: bool = True,
    solver: str = "CLARABEL",
    settings: Mapping[str, Any] | None = None,
) -> VertexCertificate:
    """Return gains with a certificate that is proved at every vertex.

    Parameters
    ----------
    errors : ErrorPolytope
        The vertices; with inputs w.
    goal : {"gain", "power"}, optional
        Minimise the l2 gain or the mean square.
    level : float, optional
        A required level; by default ``1 + margin`` times the least one.
    margin : float, optional
        Relative distance to the least level.
    decay, lyapunov, steps, gain, gains, free_output : optional
        As for `obsynth.conditions.vertex_inequalities`.
    fast_decay : bool, optional
        In discrete time, without ``decay``: look for gains with nearly the fastest decay that the level allows.
    solver : str, optional
        Any of ``cvxpy.installed_solvers()`` for semidefinite programmes.
    settings : mapping, optional
        Settings of the solver.

    Raises
    ------
    SolverError
        The search found no certificate.  That is no proof that none exists.
    """
    extreme = ExtremeVertices.of(errors, gains) if lyapunov == "common" and steps is None else None
    whole = errors if extreme is None else extreme.errors
    options = {"goal": goal, "lyapunov": lyapunov, "steps": steps, "gain": gain, "free_output": free_output}
    search = _Search(errors, extreme, ErrorUnits.of(whole), options, gains, solver, settings, [])
    try:
        return _found(search, level, margin, decay, fast_decay=fast_decay)
    except SolverError as error:
        if level is not None or error.record.get("status") == "infeasible" or not whole.constant_output:
            raise
    # A solver may end without numbers in one set of coordinates and with them in another.
    search = replace(search, units=ErrorUnits.of(whole, combined=False))
    return _found(search, level, margin, decay, fast_decay=fast_decay)


def _found(
    search: _Search, level: float | None, margin: float, decay: float | None, *, fast_decay: bool
) -> VertexCertificate:
    """Return the certificate that a search finds at the required level, or near the least one; see `certified`."""
    errors, solver, settings = search.errors, search.solver, search.settings
    least, z_unit, size = _least(search.units, search.options_with(decay), search.given, solver, settings, search.runs)
    levels = [level] if level is not None else [(1.0 + max(room, margin)) * least for room in ROOMS + WIDE_ROOMS]
    if level is None and least < NEGLIGIBLE[0] * size:
        levels = [share * size for share in NEGLIGIBLE]
    for target in dict.fromkeys(levels):
        z_unit = z_unit if target == level or least >= NEGLIGIBLE[0] * size else power_of_two(target)
        made = search.at(target, z_unit, decay, least)
        if made is not None:
            made = _with_fast_decay(search, made, z_unit) if fast_decay and decay is None else made
            return replace(made, is_negligible=least < NEGLIGIBLE[0] * size)
    if level is not None and level < least:
        raise SolverError(
            f"No observer with one certificate over the region was found at {level:.6g}: the least level found for "
            f"the inequalities at the vertices is {least:.6g}. Give more than that, {_remedy(errors)}."
        )
    raise SolverError(
        "A gain was found, but no certificate at the vertices could be proved. That is no proof that there is none: "
        "give a smaller region, or a larger margin.",
    )


def certified_for_steps(
    errors: ErrorPolytope, *, steps: float | None, decay: float | None = None, **options: Any
) -> VertexCertificate:
    """Return a certificate for small steps of the weights if it proves a lower level, else one for arbitrary changes.

    Neither level nor decay is worse than for arbitrary changes, since a common P is also a P at each vertex.

    Parameters
    ----------
    errors : ErrorPolytope
        The vertices; with inputs w.
    steps : float or None
        As for `certified`.
    decay : float, optional
        As for `certified`.
    **options
        Further options of `certified`, except ``lyapunov``.

    Raises
    ------
    SolverError
        The search found no certificate.
    """
    if steps is None:
        return certified(errors, decay=decay, **options)
    try:
        common = certified(errors, decay=decay, **options)
    except SolverError:  # no P serves all vertices
        return certified(errors, decay=decay, lyapunov="vertex", steps=steps, **options)
    try:
        slow = certified(errors, decay=common.decay, lyapunov="vertex", steps=steps, **options)
    except SolverError:
        return common
    # The least level for arbitrary changes is an upper bound of the least level for slow ones.
    slow = replace(slow, is_negligible=slow.is_negligible or common.is_negligible)
    return slow if slow.level < common.level else common


def analysed(
    errors: ErrorPolytope, gains: Sequence[FloatArray], *, steps: float | None, **options: Any
) -> VertexCertificate:
    """Return the lowest proved level of given gains, for arbitrary changes or, with ``steps``, small steps of weights.

    Parameters
    ----------
    errors : ErrorPolytope
        The vertices; with inputs w.
    gains : sequence of FloatArray
        One common gain, or one at each vertex.
    steps : float or None
        As for `certified`.
    **options
        Further options of `certified`, except ``lyapunov``.

    Raises
    ------
    SolverError
        The search found no certificate.
    """
    courses: list[dict[str, Any]] = [{}] if steps is None else [{}, {"lyapunov": "vertex", "steps": steps}]
    made, failures = [], []
    for course in courses:
        try:
            made.append(certified(errors, gains=gains, **course, **options))
        except SolverError as error:
            failures.append(error)
    if not made:
        raise failures[-1]
    return min(made, key=lambda each: each.level)


@dataclass(frozen=True, eq=False)
class _Search:
    """The search for a certificate of an error system: its options, and the records of the solver so far."""

    errors: ErrorPolytope
    extreme: ExtremeVertices | None  # None: inequalities at every vertex
    units: ErrorUnits
    options: dict[str, Any]
    gains: Sequence[FloatArray] | None
    solver: str
    settings: Mapping[str, Any] | None
    runs: list[dict[str, Any]]

    @property
    def given(self) -> Sequence[FloatArray] | None:
        """The given gains at the vertices with an inequality."""
        return self.gains if self.extreme is None else self.extreme.given

    def options_with(self, decay: float | None) -> dict[str, Any]:
        """Return the options with a slightly faster decay: solvers violate constraints by their tolerances."""
        if decay is None:
            return self.options
        room = min(decay, abs(1.0 - decay)) if self.errors.dt > 0.0 else -decay
        return {**self.options, "decay": decay - DECAY_ROOM * room}

    def at(self, level: float, z_unit: float, decay: float | None, least: float) -> VertexCertificate | None:
        """Return the certificate with the largest slack at a level; ``None`` where it is not proved."""
        errors, units, gains, steps = self.errors, self.units, self.gains, self.options["steps"]
        moved = units.moved(z_unit)
        problem = vertex_inequalities(
            moved, level=level / z_unit, gains=units.gains_in(self.given), **self.options_with(decay)
        )
        if not has_numbers(problem, self.solver, self.settings, self.runs):
            return None
        inner, own = witness_of(moved, problem, steps=steps)
        candidates = [own]
        if self.options["goal"] == "gain" and gains is None and _one_gain_is_enough(moved):
            # Try the best gain for this P first; a decay may need the solver's own gain instead.
            candidates = [[_best_gain(moved, inner.P[0], level / z_unit)], own]
        witness = units.witness_out(inner, z_unit)
        V = problem.variables["V"].value * z_unit @ units.into_outputs if "V" in problem.variables else None
        whole = errors if V is None else errors.with_innovation(V)
        for each in candidates:
            made = self._shipped(each) if gains is None else [np.asarray(L, np.float64) for L in gains]
            proof = self._proof(whole, made, witness, level)
            rate = proved_decay(errors, made, witness, required=decay) if proof.proved else None
            if rate is not None and (decay is None or (rate <= decay if errors.dt > 0.0 else rate >= decay)):
                return VertexCertificate(made, witness, level, least, rate, proof, tuple(self.runs), V)
        return None

    def _shipped(self, gains: Sequence[FloatArray]) -> list[FloatArray]:
        """Return gains in the units of the plant, at every vertex."""
        made = [self.units.gain_out(L) for L in gains]
        return made if self.extreme is None else self.extreme.gains(made)

    def _proof(self, whole: ErrorPolytope, gains: list[FloatArray], witness: Witness, level: float) -> VertexProof:
        vertices, discrete = whole.closed(gains), whole.dt > 0.0
        if self.options["goal"] == "gain":
            return prove_gain(vertices, witness, level, discrete=discrete, ball=whole.ball)
        return prove_mean_square(vertices, witness, level, discrete=discrete)


def _with_fast_decay(search: _Search, first: VertexCertificate, z_unit: float) -> VertexCertificate:
    """Return gains of the same level with nearly the fastest decay, in discrete time.

    Unlike the decay that comes with the largest slack, the fastest decay does not depend on coordinates of the plant.
    """
    errors, units = search.errors, search.units
    if errors.dt <= 0.0 or search.gains is not None or errors.ball:
        return first
    if errors.order**3 * units.errors.count > MOST_FAST or units.errors.count > MOST_FAST_VERTICES:
        return replace(first, is_fastest=False)
    moved, steps, s = units.moved(z_unit), search.options["steps"], units.states / z_unit
    start = fastest_allowed_decay(errors, first.gains, first.witness)
    if start is None:
        return first

    def solved(rate: float, metric: list[FloatArray]) -> tuple[float, list[FloatArray]] | None:
        problem = vertex_inequalities(
            moved, level=first.level / z_unit, decay=rate, decay_metric=metric, **search.options
        )
        if not has_numbers(problem, search.solver, search.settings, search.runs):
            return None
        witness, gains = witness_of(moved, problem, steps=steps)
        reached = fastest_allowed_decay(moved, gains, witness)
        return None if reached is None else (reached, list(witness.P))

    fastest, _ = improved_decays(solved, start, [P * s * s[:, None] for P in first.witness.P], discrete=True)[-1]
    for decay in slower_decays(fastest, DECAY_MARGINS, 1.0):
        made = search.at(first.level, z_unit, decay, first.least)
        if made is not None:
            return made
    return replace(first, runs=tuple(search.runs))


def _remedy(errors: ErrorPolytope) -> str:
    """Return what helps where there is no common Lyapunov matrix."""
    slow = errors.dt > 0.0 and errors.count == 2
    return "a smaller region, or (where the parameter is slow) its rate" if slow else "a smaller region"


def _one_gain_is_enough(errors: ErrorPolytope) -> bool:
    """Whether in continuous time the best gain does not change: C, D and B D' are constant, D D' is nonsingular.

    *Proof:* with w in terms of the innovation, L enters the inequality by the term of e and the innovation alone, which
    ``L = P^-1 C' (D D')^-1 gamma^2 + B D^+`` makes zero, the best for every weight.
    """
    if errors.dt > 0.0 or errors.differential is not None or any(d.any() for d in errors.Dz):
        return False
    cross = [b @ errors.D[0].T for b in errors.B]
    same = errors.constant_output and all(np.array_equal(each, cross[0]) for each in cross)
    return same and decide_rank(errors.D[0], expected=errors.outputs).full


def _best_gain(errors: ErrorPolytope, P: FloatArray, level: float) -> FloatArray:
    """Return the gain of `_one_gain_is_enough`."""
    D, C = errors.D[0], errors.C[0]
    inverse = np.linalg.inv(D @ D.T)
    return np.asarray(level**2 * np.linalg.solve(P, C.T @ inverse) + errors.B[0] @ D.T @ inverse)


def best_decay(
    errors: ErrorPolytope,
    *,
    gains: Sequence[FloatArray] | None = None,
    limit: float = 1e3,
    slowest: float = 1.0,
    margins: Sequence[float] | None = None,
    **options: Any,
) -> tuple[float, Witness, list[FloatArray]]:
    """Return the fastest decay that is proved, its certificate and gains.

    Parameters
    ----------
    errors : ErrorPolytope
        The vertices.
    gains : sequence of FloatArray, optional
        Given gains.
    limit : float, optional
        In continuous time the fastest rate that is tried, and the largest gain: rates alone run away.

    slowest : float, optional
        In discrete time the slowest decay (above 1: growth) that is tried.
    margins : sequence of float, optional
        Shares by which what ships is slower, in turn, with the largest slack; by default a few of gains that are
        sought, none of given ones.
    **options
        ``lyapunov``, ``steps`` and ``gain`` as for `obsynth.conditions.vertex_inequalities`.

    Raises
    ------
    SolverError
        No decay at all is proved.
    """
    discrete, steps = errors.dt > 0.0, options.get("steps")
    common = options.get("lyapunov", "common") == "common" and steps is None
    extreme = ExtremeVertices.of(errors, gains) if common else None
    units = ErrorUnits.of(errors if extreme is None else extreme.errors)
    moved, own = units.moved(1.0), units.gains_in(gains if extreme is None else extreme.given)
    Solution = tuple[Witness, list[FloatArray]]

    def solved(rate: float, earlier: Solution | None) -> tuple[float, Solution] | None:
        if earlier is not None and not discrete and rate >= limit:
            return None
        more: dict[str, Any] = {} if earlier is None else {"decay_metric": earlier[0].P}
        problem = vertex_inequalities(
            moved, goal="decay", decay=rate, gains=own, gain_limit=None if gains else limit, **options, **more
        )
        if not has_numbers(problem, "CLARABEL", None, []):
            return None
        solution = witness_of(moved, problem, steps=steps)
        reached = fastest_allowed_decay(moved, solution[1], solution[0])
        return None if reached is None else (reached, solution)

    start = solved(slowest if discrete else 0.0, None)
    if start is not None:
        reached = improved_decays(solved, *start, discrete=discrete)
        shares = margins if margins is not None else () if gains else MARGINS
        fastest_sought = reached[-1][0] if discrete else min(reached[-1][0], limit)
        near = slower_decays(fastest_sought, shares, 1.0 if discrete else None)
        for rate, (inner, scaled) in chain(filter(None, (solved(each, None) for each in near)), reversed(reached)):
            sought = [units.gain_out(L) for L in scaled] if gains is None else list(gains)
            made = sought if extreme is None or gains is not None else extreme.gains(sought)
            witness = units.witness_out(inner, 1.0)
            fastest, end = (min(rate, slowest), slowest) if discrete else (min(rate, limit), None)
            for trial in slower_decays(fastest, DECAY_SHARES, end):
                if prove_decay(errors.closed(made), witness, trial, discrete=discrete, ball=errors.ball).proved:
                    return trial, witness, made
    raise SolverError(
        "No certificate of stability at the vertices was found. That is no proof that there is none: give "
        f"{_remedy(errors)}."
    )


def proved_decay(
    errors: ErrorPolytope, gains: Sequence[FloatArray], witness: Witness, *, required: float | None = None
) -> float:
    """Return a decay that a given certificate proves: ``required`` where it does, else near the fastest it can."""
    vertices, discrete = errors.closed(gains), errors.dt > 0.0
    fastest = fastest_allowed_decay(errors, gains, witness)
    if fastest is None:
        fastest = 0.0
    fastest = min(fastest, 1.0) if discrete else fastest
    tries = [] if required is None else [required]
    tries += slower_decays(fastest, DECAY_SHARES, 1.0 if discrete else None)
    for rate in tries:
        if prove_decay(vertices, witness, rate, discrete=discrete, ball=errors.ball).proved:
            return rate
    return 1.0 if discrete else 0.0


def _least(
    units: ErrorUnits, options: Mapping[str, Any], gains: Any, solver: str, settings: Any, runs: list[dict[str, Any]]
) -> tuple[float, float, float]:
    """Return the least level, the unit of z in which it is near one, and what a level is about without any gain."""
    plain = units.moved(1.0)
    size = level_without_gains(plain)
    unit, known = power_of_two(size) if size > 0.0 else 1.0, None
    for _ in range(MOST_RESCALINGS):
        moved = units.moved(unit)
        problem = vertex_inequalities(moved, gains=units.gains_in(gains), **options)
        if not has_numbers(problem, solver, settings, runs):
            if known is not None:  # what is proved above it decides, not in which units the solver ends
                return known
            raise SolverError(
                "No common Lyapunov matrix was found for the vertices: the solver ended with "
                f"{runs[-1]['status']!r}. That is no proof that there is none. Give a slower decay, or "
                f"{_remedy(plain)}.",
                record=runs[-1],
            )
        squared = problem.variables["gamma_squared" if options["goal"] == "gain" else "mean_square"].value
        least = float(np.sqrt(max(float(squared), 0.0)))
        if least == 0.0 or LEVEL_UNITS[0] <= least <= LEVEL_UNITS[1]:
            return max(least, float(np.finfo(np.float64).eps)) * unit, unit, size
        level = least * unit
        if level < NEGLIGIBLE[0] * size:
            return level, unit, size
        known = level, unit, size
        unit *= power_of_two(least)
    return level, unit, size


def level_without_gains(errors: ErrorPolytope) -> float:
    """Return what a level is about without any gain: the largest ``|Cz| |B| + |Dz|`` of the vertices."""
    vertices = zip(errors.Cz, errors.B, errors.Dz, strict=True)
    return max(float(np.linalg.norm(z) * np.linalg.norm(b) + np.linalg.norm(d)) for z, b, d in vertices)


def power_of_two(value: float) -> float:
    """Return the power of two that is nearest by ratio."""
    return float(np.exp2(np.round(np.log2(value))))


def has_numbers(problem: Any, solver: str, settings: Mapping[str, Any] | None, runs: list[dict[str, Any]]) -> bool:
    """Solve, and return whether there are numbers to look at."""
    record = {"what": problem.source, "solver": str(solver), "settings": dict(settings or {})}
    try:
        problem.solve(solver=solver, settings=settings)
    except SolverError:
        runs.append({**record, "status": "crashed"})
        return False
    status = str(problem.problem.status)
    runs.append({**record, "status": status})
    if status not in USABLE_STATUSES:
        return False
    return all(
        variable.value is not None and np.isfinite(variable.value).all() for variable in problem.problem.variables()
    )


@dataclass(frozen=True, eq=False)
class ErrorUnits:
    """Powers of two for states, and coordinates of measurements, in which the vertices are balanced."""

    errors: ErrorPolytope
    states: FloatArray
    into_outputs: FloatArray  # y' = into_outputs y
    out_of_outputs: FloatArray  # its inverse

    @classmethod
    def of(cls, errors: ErrorPolytope, *, combined: bool = True) -> ErrorUnits:
        """Return units that suit all vertices; ``combined``: measurements that say nearly the same are combined to ones
        that say different things."""
        n, m = errors.order, errors.outputs
        if errors.ball or (errors.differential is not None and errors.differential < n):
            # A remainder is a norm in the given units; algebraic equations have rows of their own.
            return cls(errors, np.ones(n), np.eye(m), np.eye(m))
        largest = [
            np.max([np.abs(matrix) for matrix in each], axis=0) for each in (errors.A, errors.B, errors.C, errors.Cz)
        ]
        a, b, c, z = largest
        states = state_units(a, b, np.vstack([c, z]))
        # All states in a unit in which the inputs are near one: P is then as large as the level, whatever that is.
        driven = float(np.linalg.norm(b / states[:, None]))
        states = states * float(np.exp2(np.round(np.log2(driven)))) if driven > 0.0 else states
        if combined and errors.constant_output and m:
            directions, sizes, _ = np.linalg.svd(np.hstack([errors.C[0] * states, errors.D[0]]), full_matrices=True)
            sizes = np.concatenate([sizes, np.zeros(m - len(sizes))])
            sizes = np.where(sizes > 0.0, sizes, 1.0)
            return cls(errors, states, directions.T / sizes[:, None], directions * sizes)
        sizes = np.linalg.norm(c * states, axis=1)
        outputs = np.exp2(np.round(np.log2(np.where(sizes > 0.0, sizes, 1.0))))
        return cls(errors, states, np.diag(1.0 / outputs), np.diag(outputs))

    def moved(self, level: float) -> ErrorPolytope:
        """Return the vertices in these units, z in units of ``level``."""
        s, o = self.states, self.into_outputs
        return replace(
            self.errors,
            A=[a * s / s[:, None] for a in self.errors.A],
            B=[b / s[:, None] for b in self.errors.B],
            C=[o @ c * s for c in self.errors.C],
            D=[o @ d for d in self.errors.D],
            Cz=[z * s / level for z in self.errors.Cz],
            Dz=[z / level for z in self.errors.Dz],
        )

    def gains_in(self, gains: Sequence[FloatArray] | None) -> list[FloatArray] | None:
        """Return gains in these units."""
        if gains is None:
            return None
        return [np.asarray(L) @ self.out_of_outputs / self.states[:, None] for L in gains]

    def gain_out(self, L: FloatArray) -> FloatArray:
        """Return a gain in the units of the plant."""
        return np.asarray(L * self.states[:, None] @ self.into_outputs)

    def witness_out(self, witness: Witness, level: float) -> Witness:
        """Return Lyapunov matrices in the units of the plant: P of ``e = S e'``, z in units of ``level``, becomes
        ``level ** 2 S^-1 P' S^-1``."""
        return replace(witness.in_units(self.states / level), multiplier=witness.multiplier * level**2)
