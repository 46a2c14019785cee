"""Finding a certificate for gains in hand: a Lyapunov matrix with which the shipped inequality can be proved.

The shipped realisation of a fault-estimation filter, from T, N, L and W: those of synthesis, or given ones.

Source: Wang 2015, eqs. (19), (20), (23).  Differences: ``D u`` is subtracted from the outputs; the state estimate,
which the paper leaves biased by Psi under a constant fault, is corrected by the fault estimate: max(rho) - 1 late.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice, product
from typing import Any

import numpy as np

from obsynth.analysis.conditions import require_all
from obsynth.analysis.transformations.linear_plants import SLOW_ZERO_RADIUS, sampling_zero_warnings
from obsynth.errors import SpecError
from obsynth.methods.fault_estimation_filter.conditions import (
    WARN_DETECTABILITY_CONDITION,
    FaultDetectability,
    fault_detectability,
    fault_filter_conditions,
    prepare,
    with_sensor_faults_as_states,
)
from obsynth.methods.method import WARN_AMPLIFICATION, Synthesis
from obsynth.numerics import lapack
from obsynth.numerics.arguments import FloatArray, as_matrix, is_whole, largest_singular_value, require_shape
from obsynth.numerics.doubling import FEWEST_STATES
from obsynth.numerics.matrix_equations import bounded_real_matrix, normalising_change
from obsynth.numerics.norms import output_covariance, state_units
from obsynth.numerics.ranks import decide_rank
from obsynth.observers.linear.observer import LinearObserver, poles_of
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import Certificate
from obsynth.verification.claims import prove_bounded_real
from obsynth.verification.error_system import ErrorModel

#: Levels, relative to the claimed one, at which coordinates are improved on the way to it.
APPROACHES = ((1.05,), (1.5, 1.05, 1.001))
#: Weights of what the output does not show, relative to the output's, tried in turn.
TAIL_WEIGHTS = (1e-2, 1e-4, 1e-6, 1e-9, 1e-12, 1e-16, 1e-20)
#: Slack of the Riccati equation relative to the output weight, largest first: the first that proves is taken.
FILTER_SLACKS = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10)
#: What A and B are enlarged by, and noise on every state besides the disturbance, squared, as a share of that, which
#: keeps states that it hardly moves from getting lost: most first.  The first leaves a hundred times the rounding of
#: matrices of order 2,000; that one exceeds the level shows in part of a solution.
ROOMS = ((1e-4, 1e-7), (1e-5, 1e-8))
#: Steps towards coordinates in which the norm of the error dynamics is near one: how many, and down to which power.
MOST_CONTRACTIONS = 60
STEP_POWER = 0.75
GAMMA_ABOVE_ONE = 1.05


def bounded_real_certificate(
    plant: DescriptorSystem,
    observer: LinearObserver,
    tracking: FloatArray,
    gain: float,
    *,
    core: int,
    lag: int,
    tries: int | None = None,
) -> tuple[FloatArray, bool]:
    """Return Q ``(core, core)``, upper triangular with P = Q'Q, at level ``gain``, and whether it proves.

    The Riccati solution with the largest slack that does, else the last try; at most ``tries`` coordinates are tried.
    """
    errors = ErrorModel(plant, observer, tracking, lag=lag)
    a, b = observer.Az[:core, :core], errors.disturbance[:core] / gain
    c, d = -errors.fault_output[0][:, :core], errors.fault_output[2] / gain
    best, spare = np.eye(core), None
    # Of many states, one solution without other coordinates has room enough, and takes a fifth of the time.
    for more, noise in ROOMS if core >= FEWEST_STATES and 0 < len(c) <= b.shape[1] else ():
        found = _with_room(a, b, c, d, 1.0 + more, noise)
        if found is None:
            continue
        if prove_bounded_real(plant, observer, tracking, found, gain).in_double_precision:
            return found, True
    for change in islice(_changes(a, b, c, d), tries):
        inverse = np.asarray(np.linalg.inv(change))
        moved_a, moved_b, moved_c = inverse @ a @ change, inverse @ b, c @ change
        weight = max(1.0, largest_singular_value(moved_c) ** 2)
        for slack in FILTER_SLACKS:
            p = bounded_real_matrix(moved_a, moved_b, moved_c, d, 1.0, slack=slack * weight)
            if p is None:
                continue
            best = np.asarray(np.triu(np.linalg.qr(np.asarray(np.linalg.cholesky(p)).T @ inverse, mode="r")))
            proof = prove_bounded_real(plant, observer, tracking, best, gain)
            if proof.in_double_precision:
                return best, True
            spare = best if proof.proved and spare is None else spare
    return (best, False) if spare is None else (spare, True)


def _with_room(
    a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, more: float, noise: float
) -> FloatArray | None:
    """Return Q, upper triangular, from the transposed system with noise on every state; of no more outputs than inputs.

    Where ``Y = A Y A' + B B' + r I + (A Y C' + B D')(I - D D' - C Y C')^-1 (.)'``, the inverse of Y is a P of the
    bounded real inequality, as strictly as r is large.  With A and B ``more`` times as large it has a share of each
    direction's own size left, however slow the states are.
    """
    scale = state_units(a, b, c)
    a, b, c = a * scale / scale[:, None], b / scale[:, None], c * scale
    y = bounded_real_matrix(more * a.T, c.T, more * b.T, d.T, 1.0, slack=noise * largest_singular_value(b) ** 2)
    if y is None:
        return None
    # From the last state to the first: Y = U U', U upper triangular.
    factor, failed = lapack.dpotrf(y[::-1, ::-1], lower=1, clean=1)
    inverse, singular = (factor, failed) if failed else lapack.dtrtri(factor, lower=1)
    return None if singular else np.asarray(inverse[::-1, ::-1] / scale)


def _changes(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> Iterator[FloatArray]:
    """Yield state changes in which a Riccati solution may prove something, the cheapest first."""
    for begin in (_balanced, _contracted, _unchanged):
        start = begin(a, b, c)
        inverse = np.asarray(np.linalg.inv(start))
        moved = (inverse @ a @ start, inverse @ b, c @ start)
        for path, tail in product(APPROACHES, TAIL_WEIGHTS):
            change = _coordinates(*moved, d, path=path, tail=tail)
            if change is not None:
                yield start @ change


def _balanced(a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    """Return a diagonal state change, powers of two, in which units cost no digits."""
    return np.diag(state_units(a, b, c))


def _unchanged(a: FloatArray, _b: FloatArray, _c: FloatArray) -> FloatArray:
    """Return no change: at the edge of what can be proved in double precision, other rounding errors may do."""
    return np.eye(a.shape[0])


def _contracted(a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    """Return a state change in which the norm of ``a``, far above its spectral radius, is at most about one.

    Where the Lyapunov matrix of ``a / s`` is the identity it is below s; s shrinks in steps, each well conditioned.
    """
    change, identity = _balanced(a, b, c), np.eye(a.shape[0])
    moved = np.linalg.solve(change, a @ change)
    norm = largest_singular_value(moved)
    for _ in range(MOST_CONTRACTIONS):
        level = max(min(0.5 * norm, norm**STEP_POWER), 1.0)
        p = output_covariance(moved.T / level, identity, identity, np.zeros_like(a))  # the sum of A'^k A^k
        if norm <= GAMMA_ABOVE_ONE or not np.all(np.isfinite(p)):
            break
        change = change @ normalising_change(p)
        moved = np.linalg.solve(change, a @ change)
        norm = largest_singular_value(moved)
    return change


def _coordinates(
    a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, *, path: tuple[float, ...], tail: float
) -> FloatArray | None:
    """Return a change in which a rough Riccati solution is the identity, over the levels of ``path``; else ``None``.

    ``tail`` weighs states that the output does not show: as much as possible, short of what d does to them.
    """
    change = np.eye(a.shape[0])
    for level in path:
        inverse = np.asarray(np.linalg.inv(change))
        shown = c @ change
        size = max(largest_singular_value(shown) ** 2, np.finfo(np.float64).tiny)
        p = bounded_real_matrix(inverse @ a @ change, inverse @ b, shown, d, level, slack=tail * size)
        if p is None:
            return None
        change = change @ normalising_change(p)
    return change


def realise_filter(
    plant: DescriptorSystem,
    work: DescriptorSystem,
    gains: dict[str, FloatArray],
    detectability: FaultDetectability,
) -> tuple[LinearObserver, FloatArray, int]:
    """Return the observer, its tracking map ``(nz, nx (lag + 1))`` and the lag of its state estimates."""
    t, n, feedback, w = (gains[letter] for letter in "TNLW")
    nx, na, nf = plant.nx, work.nx, plant.nf
    indexes = [int(index or 1) for index in detectability.indexes]
    lag = max(indexes) - 1
    ta, tf = t @ work.A, t @ work.Bf
    m = ta - feedback @ work.C
    core_y = m @ n + feedback
    residual_z, residual_y = -w @ work.C, w @ (np.eye(plant.ny) - work.C @ n)
    powers = detectability.chain(ta, tf)

    def correction(age: int) -> FloatArray:
        """Columns ``(TA)^(rho_i - 1 - age) T f_i`` of the faults that become known for the state of this age."""
        columns = np.zeros((nx, nf))
        for i, index in enumerate(indexes):
            if index - 1 - age >= 0:
                columns[:, i] = powers[index - 1 - age][:nx, i]
        return columns

    nz = na + lag * nx
    az, by = np.zeros((nz, nz)), np.zeros((nz, plant.ny))
    az[:na, :na], by[:na] = m, core_y
    # Row block of the state of age 0, then each older one: what was known, plus what the newest residual adds.
    shown_z = np.zeros((nx, nz))
    shown_z[:, :na] = np.eye(nx, na) + correction(0) @ residual_z
    shown_y = n[:nx] + correction(0) @ residual_y
    for age in range(1, lag + 1):
        block = slice(na + (age - 1) * nx, na + age * nx)
        az[block], by[block] = shown_z, shown_y
        shown_z = np.zeros((nx, nz))
        shown_z[:, block] = np.eye(nx)
        shown_z[:, :na] += correction(age) @ residual_z
        shown_y = correction(age) @ residual_y
    fault_z = np.hstack([residual_z, np.zeros((nf, nz - na))])
    cz, dy = np.vstack([shown_z, fault_z, fault_z]), np.vstack([shown_y, residual_y, residual_y])
    bu = -by @ plant.D
    bu[:na] += t @ work.B
    observer = LinearObserver(
        Az=az,
        Bu=bu,
        By=by,
        Cz=cz,
        Du=-dy @ plant.D,
        Dy=dy,
        dt=plant.dt,
        input_names=plant.input_names,
        output_names=plant.output_names,
        state_names=plant.state_names,
        fault_names=plant.fault_names,
        residual_names=plant.fault_names,
        state_delays=(lag,) * nx,
        fault_delays=tuple(indexes),
    )
    tracking = np.zeros((nz, nx * (lag + 1)))
    tracking[:na, :nx] = t[:, :nx]
    tracking[na:, nx:] = np.eye(lag * nx)
    return observer, tracking, lag


#: Spectral radii above this are worth a note.
SLOW_FILTER = 0.98


def notes(
    plant: DescriptorSystem,
    detectability: FaultDetectability,
    observer: LinearObserver,
    *,
    largest_zero: float = np.inf,
) -> tuple[str, ...]:
    """Return what a user should know; ``largest_zero`` is the largest modulus of a fault zero, where known already."""
    found = list(sampling_zero_warnings(plant)) if largest_zero > SLOW_ZERO_RADIUS else []
    if detectability.condition_number > WARN_DETECTABILITY_CONDITION:
        found.append(
            f"Upsilon has condition number {detectability.condition_number:.3g}: some combination of faults is "
            "estimated with a much larger standard deviation than the others."
        )
    for name, row in zip(plant.fault_names, observer.Dy[observer.fault_rows], strict=True):
        amplification = float(np.linalg.norm(row))
        if amplification > WARN_AMPLIFICATION:
            found.append(
                f"The estimate of {name!r} amplifies errors of the newest measurement by up to {amplification:.3g}: "
                "the outputs respond little to the fault within its delay."
            )
    radius = float(np.max(np.abs(poles_of(observer)), initial=0.0))
    if radius >= 1.0:
        found.append(
            f"The filter's initial-condition response does not decay: its spectral radius is {radius:.6g}, not below 1."
        )
    elif radius > SLOW_FILTER:
        found.append(
            f"The filter settles slowly: spectral radius {radius:.6g}, time constant "
            f"{-plant.dt / np.log(radius):.3g} s."
        )
    return tuple(found)


def synthesis_from_gains(
    plant: DescriptorSystem, *, T: Any, N: Any, L: Any, W: Any, gamma: float | None, indexes: Sequence[int] | None
) -> Synthesis:
    """Return the realisation and certificate of given gains; see `obsynth.design_from_gains`."""
    require_all(fault_filter_conditions(plant))
    work = with_sensor_faults_as_states(plant)
    gains = {name: as_matrix(value, name) for name, value in (("T", T), ("N", N), ("L", L), ("W", W))}
    shapes = {"T": (work.nx, work.nx), "N": (work.nx, work.ny), "L": (work.nx, work.ny), "W": (work.nf, work.ny)}
    for name, shape in shapes.items():
        require_shape(gains[name].shape, shape, name)
    detectability = _detectability(work, gains["T"], _checked(indexes, work))
    if not detectability.finite:
        raise SpecError("With this T some fault never reaches the outputs.", path="T")
    gains |= {"Psi": detectability.Psi, "Upsilon": detectability.Upsilon}
    observer, tracking, lag = realise_filter(plant, work, gains, detectability)
    level = 1.0 if gamma is None else gamma
    factor, _ = bounded_real_certificate(plant, observer, tracking, level, core=work.nx, lag=lag)
    claims = {"state_lag": float(lag)} | ({"gamma": level} if plant.nd else {})
    doubts = () if indexes is not None else _lost_indexes(plant, detectability)
    return Synthesis(
        {"from_gains": True, "gamma": gamma, "indexes": None if indexes is None else list(detectability.indexes)},
        gains,
        observer,
        Certificate({"P_factor": factor, "tracking": tracking}, claims),
        {"runs": []},
        (*doubts, *notes(plant, detectability, observer)),
    )


def _checked(indexes: Sequence[int] | None, work: DescriptorSystem) -> tuple[int, ...] | None:
    if indexes is None:
        return None
    listed: list[Any] = list(indexes) if isinstance(indexes, (list, tuple, np.ndarray)) else []
    whole = all(is_whole(index) for index in listed)
    if len(listed) != work.nf or not whole or not all(1 <= index <= work.nx for index in listed):
        raise SpecError(
            f"indexes is {indexes!r}: give one whole number from 1 to {work.nx} for each of "
            f"{', '.join(map(repr, work.fault_names))}.",
            path="indexes",
        )
    return tuple(int(index) for index in listed)


def _detectability(work: DescriptorSystem, t: FloatArray, indexes: tuple[int, ...] | None) -> FaultDetectability:
    """Return the detectability matrices of given gains, with given indexes where there are any."""
    ta, tf = t @ work.A, t @ work.Bf
    found = fault_detectability(ta, work.C, tf, plant=work)
    if indexes is None:
        return found
    powers = replace(found, indexes=indexes).chain(ta, tf)
    psi = np.column_stack([powers[index - 1][:, i] for i, index in enumerate(indexes)])
    upsilon = work.C @ psi
    lengths = np.linalg.norm(upsilon, axis=0)
    if not lengths.all():
        hidden = work.fault_names[int(np.argmin(lengths))]
        raise SpecError(
            f"With this T and these indexes the fault {hidden!r} does not reach the outputs.", path="indexes"
        )
    unit = upsilon / lengths
    return FaultDetectability(indexes, psi, upsilon, decide_rank(unit, expected=work.nf), float(np.linalg.cond(unit)))


def _lost_indexes(plant: DescriptorSystem, found: FaultDetectability) -> tuple[str, ...]:
    """Return a note for faults that show earlier with the given T than the plant's own equations let them."""
    own = prepare(plant).detectability.indexes
    early = [
        (name, given, index)
        for name, given, index in zip(plant.fault_names, found.indexes, own, strict=True)
        if index is not None and given is not None and given < index
    ]
    if not early:
        return ()
    told = ", ".join(f"{name!r} {given} instead of {index}" for name, given, index in early)
    return (
        f"With this T the detectability indexes are lower than the plant's own: {told}. If T was rounded, C T f no "
        f"longer vanishes where it should: give indexes={list(own)}, or T with all of its digits.",
    )
