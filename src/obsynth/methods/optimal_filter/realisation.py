"""The realisation of an optimal filter from u and y, with T and T0, which relate its state to the plant's.

The filter of least gain has the input y alone.  Without faults, disturbances and noise its state follows ``T E x``,
which determines the effect of u.  Decaying modes of the plant that affect the filter are modelled by a copy that only u
drives.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from obsynth.errors import SolverError
from obsynth.methods.optimal_filter.common_numbers import with_common_numbers
from obsynth.methods.optimal_filter.realised_filter import RealisedFilter
from obsynth.methods.optimal_filter.transformation import (
    CLEANED_SHARES,
    FEWEST_ENTRIES,
    IDENTITIES_LEFT,
    MOST_ENTRIES,
    FilterAndPlant,
    by_sylvester,
    holds,
    shows_a_disturbance,
)
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.decoupling_windows import Model
from obsynth.numerics.low_order_models import plainly_truncated
from obsynth.numerics.ranks import RANK_TOLERANCE
from obsynth.numerics.scaling import equilibrating_factors
from obsynth.numerics.standard_form import INFINITE_EIGENVALUE, reachable_basis
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.plant_units import PlantUnits
from obsynth.verification.error_system import IDENTITY_SHARE, ErrorModel, with_past

#: Entries of the filter below this share of the largest one of their matrix are rounding.
ROUNDING_SHARE = 1e-14
#: Entries of the feedthrough below this share of the response by the states are rounding of a difference of products.
PASSED_ROUNDING = 1e-12
#: If a filter has no error system otherwise, entries below this share of the largest count as rounding of many
#: products.
COARSE_ROUNDING = 1e-12
#: Entries of A of a sampled filter below this are rounding, since its states have the size of the outputs.
ROUNDED_MODE = 1e-12
#: Number of sweeps over all states in which their units are balanced.
BALANCING_SWEEPS = 5
#: Number of times that equations are solved, each time for the remaining residual, so that small rows of a filter keep
#: their digits.
SOLUTIONS = 3


def minimal(filter_: Model, *, discrete: bool | None = None) -> Model:
    """Return a filter without unreachable and unobservable states; ``discrete``: the time of a stable one, if known."""
    a, b, c, d = filter_
    # In a filter of finite impulse response the entries of A may be nothing but rounding.
    a = np.where(np.abs(a) > ROUNDED_MODE, a, 0.0) if discrete else a
    basis = reachable_basis(a, b)
    a, b, c = basis.T @ a @ basis, basis.T @ b, c @ basis
    basis = reachable_basis(a.T, c.T)
    a, b, c = basis.T @ a @ basis, basis.T @ b, c @ basis
    # Relative to the static response by the states: in continuous time the entries of b are rates.
    driven = np.linalg.lstsq(a, b, rcond=None)[0] if discrete is False and len(a) else b
    passed = float(np.linalg.norm(d) + np.linalg.norm(c) * np.linalg.norm(driven))
    return _cleaned(a), _cleaned(b), _cleaned(c), np.where(np.abs(d) > PASSED_ROUNDING * passed, d, 0.0)


def realisations(filter_: Model, outputs: FloatArray, *, discrete: bool) -> list[Model]:
    """Return the minimal realisation, and others that are more accurate.

    For a long window the minimal realisation has no correct digits of coefficients of the size of rounding.  In sampled
    time a balanced realisation has these digits, and so has one in which only states are removed that zero entries
    disconnect from inputs or outputs; the first has fewer states.  ``outputs (ny,)`` are units, powers of two, in which
    the outputs are near one and rounding is judged.
    """
    a, b, c, d = filter_
    filter_ = _without_rounding((a, b / outputs, c, d / outputs))
    minimal_ones = [minimal(filter_, discrete=discrete)]
    if discrete:
        minimal_ones.append(_without_small_responses(filter_))
        # Chains of delays with small responses may contain many states that are only reachable by rounding.
        minimal_ones.sort(key=lambda one: len(one[0]))
        a, b, c, d = filter_
        linked = _linked(a != 0.0, np.any(b != 0.0, axis=1)) & _linked(a.T != 0.0, np.any(c != 0.0, axis=0))
        minimal_ones.append(_balanced((a[np.ix_(linked, linked)], b[linked], c[:, linked], d)))
    a, b, c, d = (_cleaned(part, COARSE_ROUNDING) for part in minimal_ones[0])
    if not all(np.array_equal(part, other) for part, other in zip((a, b, c, d), minimal_ones[0], strict=True)):
        minimal_ones.append((a, b, c, d))
    return [(a, b * outputs, c, d * outputs) for a, b, c, d in minimal_ones]


def _without_rounding(filter_: Model) -> Model:
    """Return a filter without entries of B and C whose responses are rounding relative to the feedthrough."""
    a, b, c, d = filter_
    size = ROUNDING_SHARE * float(np.linalg.norm(d))
    input_size, output_size = float(np.linalg.norm(b)), float(np.linalg.norm(c))
    return a, np.where(np.abs(b) * output_size > size, b, 0.0), np.where(np.abs(c) * input_size > size, c, 0.0), d


def _without_small_responses(filter_: Model) -> Model:
    """Return a sampled filter in balanced coordinates, without states whose Hankel singular value is rounding."""
    a, b, c, d = plainly_truncated(filter_, len(filter_[0]), discrete=True)
    return _cleaned(a), _cleaned(b), _cleaned(c), d


def _balanced(filter_: Model) -> Model:
    """Return a filter with balanced units of the states, powers of two: for each state, the norms of its row and of its
    column are about equal."""
    a, b, c, d = filter_
    units = np.ones(len(a))
    for _ in range(BALANCING_SWEEPS):
        for i in range(len(a)):
            off = np.arange(len(a)) != i
            driven = float(np.linalg.norm(a[i, off] * units[off]) + np.linalg.norm(b[i])) / units[i]
            drives = float(np.linalg.norm(a[off, i] / units[off]) + np.linalg.norm(c[:, i])) * units[i]
            if driven > 0.0 and drives > 0.0:
                units[i] *= 2.0 ** round(0.5 * math.log2(driven / drives))
    return a / units[:, None] * units, b / units[:, None], c * units, d


def _linked(link: NDArray[np.bool_], first: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which states are reachable from the ``first`` ones, with ``link[i, j]`` from j to i."""
    linked = first
    for _ in range(len(link)):
        more = linked | (link @ linked)
        if np.array_equal(more, linked):
            break
        linked = more
    return linked


def _cleaned(matrix: FloatArray, share: float = ROUNDING_SHARE) -> FloatArray:
    """Return a matrix without entries below a share of its largest one."""
    return np.where(np.abs(matrix) > share * np.max(np.abs(matrix), initial=0.0), matrix, 0.0)


def filter_with_error_system(
    plant: DescriptorSystem,
    filters: Sequence[Model],
    longest: int,
    *,
    finished: Callable[[RealisedFilter], RealisedFilter],
) -> RealisedFilter:
    """Return the first realisation of a filter that has an error system; raise `SolverError` where none has.

    ``plant`` contains the disturbances that are decoupled. ``longest`` is the largest number of past states that T may
    act on. ``finished`` adjusts the last digits of a realisation.
    """
    follower = _first_with_error_system(plant, filters, longest, finished)
    if follower.lag or _keeps_identities(plant, follower):
        return follower
    return with_common_numbers(plant, follower) or follower


def realised_behind_delay(
    plant: DescriptorSystem, filters: Sequence[Model], longest: int, later: int
) -> RealisedFilter:
    """Return a realisation, behind ``later`` samples of delay, of a filter that looks so many samples ahead in inputs.

    Only behind that delay do its errors have a state equation.  Known inputs must not be needed before they have acted.
    """
    delayed = []
    for a, b, c, d in filters:
        for _ in range(later):
            rows, order = c.shape
            a = np.block([[a, np.zeros((order, rows))], [c, np.zeros((rows, rows))]])
            b, c, d = np.vstack([b, d]), np.hstack([np.zeros((rows, order)), np.eye(rows)]), np.zeros_like(d)
        delayed.append((a, b, c, d))
    found = filter_with_error_system(plant, delayed, longest, finished=lambda follower: follower)
    # Reorder the states: the delay comes after the copies of modes.
    whole = next(len(a) for a, *_ in delayed if np.array_equal(a, found.A[: len(a), : len(a)]))
    own = whole - later * len(found.C)
    order = np.r_[:own, whole : len(found.A), own:whole]
    return found._replace(
        A=found.A[np.ix_(order, order)],
        B=found.B[order],
        C=found.C[:, order],
        T=found.T[order],
        undriven=0,
        later=later,
    )


def _first_with_error_system(
    plant: DescriptorSystem,
    filters: Sequence[Model],
    longest: int,
    finished: Callable[[RealisedFilter], RealisedFilter],
) -> RealisedFilter:
    none = np.zeros((0, plant.nx)), np.zeros((0, 0))
    copies = _dying_modes(plant)
    lags = ((0, none), (0, copies), *((lag, none) for lag in range(1, longest + 1)))
    less_exact: RealisedFilter | None = None
    for lag, (rows, moved) in lags:
        if lag == 0 and rows is copies[0] and not len(rows):
            continue
        for filter_ in filters:
            follower, share = _realised_with_lag(plant, filter_, rows, moved, lag)
            if follower is not None and len(rows) and not _keeps_identities(plant, follower):
                # Copies with small effects were left out; in this filter, which contains little else, they matter.
                continue
            if follower is not None and share == IDENTITIES_LEFT[0]:
                return finished(follower)
            less_exact = less_exact or follower
        if lag == 0 and rows is none[0] and less_exact is None:
            for filter_ in filters:
                nearly, _ = _realised_with_lag(plant, filter_, *none, 0, exactly=False)
                follower = None if nearly is None else with_common_numbers(plant, finished(nearly))
                if follower is not None and _keeps_identities(plant, follower):
                    return follower
    if less_exact is not None:
        return finished(less_exact)
    raise SolverError(
        "The filter of least gain reads the plant's state by rounding: the result is inconclusive. Measure with noise "
        "(sensor_noise), or give a longer delay."
    )


def _keeps_identities(plant: DescriptorSystem, follower: RealisedFilter) -> bool:
    """Whether the stored numbers of a filter with its copies satisfy the identities, as in verification."""
    names = tuple(f"estimate {i + 1}" for i in range(len(follower.C)))
    observer = observer_of(plant, follower, names, (0,) * len(names))
    model = ErrorModel(plant, observer, follower.T, -follower.T0, lag=follower.lag, decoupled=True)
    return model.missed() <= IDENTITY_SHARE


def observer_of(
    plant: DescriptorSystem, error_system: RealisedFilter, names: tuple[str, ...], delays: tuple[int, ...]
) -> LinearObserver:
    """Return the observer, with the known inputs as in the plant."""
    t, t0 = error_system.T[:, : plant.nx], error_system.T0[:, : plant.nx]
    named = names == plant.fault_names
    return LinearObserver(
        Az=error_system.A,
        Bu=t @ plant.B - error_system.B @ plant.D,
        By=error_system.B,
        Cz=error_system.C,
        Du=t0 @ plant.B - error_system.D @ plant.D,
        Dy=error_system.D,
        dt=plant.dt,
        input_names=plant.input_names,
        output_names=plant.output_names,
        state_names=(),
        fault_names=names if named else (),
        residual_names=() if named else names,
        state_delays=(),
        fault_delays=delays if named else (),
    )


def without_undriven(
    observer: LinearObserver, follower: RealisedFilter
) -> tuple[LinearObserver, dict[str, FloatArray]]:
    """Return an observer without the copies of modes that no input drives, and the matrices of these in its errors."""
    own = observer.order - follower.undriven
    if own == observer.order:
        return observer, {}
    a, c = observer.Az, observer.Cz
    shipped = replace(observer, Az=a[:own, :own], Bu=observer.Bu[:own], By=observer.By[:own], Cz=c[:, :own])
    return shipped, {"modes_A": a[:, own:], "modes_C": c[:, own:]}


def with_modes(observer: LinearObserver, matrices: Mapping[str, FloatArray]) -> LinearObserver:
    """Return an observer beside the modes of the plant that its errors hold: copies that nothing drives."""
    if "modes_A" not in matrices:
        return observer
    modes, own = matrices["modes_A"], observer.order
    count = modes.shape[1]
    return replace(
        observer,
        Az=np.hstack([np.vstack([observer.Az, np.zeros((count, own))]), modes]),
        Bu=np.vstack([observer.Bu, np.zeros((count, observer.Bu.shape[1]))]),
        By=np.vstack([observer.By, np.zeros((count, observer.By.shape[1]))]),
        Cz=np.hstack([observer.Cz, matrices["modes_C"]]),
    )


def _dying_modes(plant: DescriptorSystem) -> tuple[FloatArray, FloatArray]:
    """Return ``U (k, nx)`` and ``M (k, k)`` with ``U A = M U E``: finite modes that decay, where d does not drive them.

    ``plant``: with the disturbances that are decoupled: a copy, which u alone drives, follows no mode that they drive.
    """

    def dies(alpha: FloatArray, beta: FloatArray) -> FloatArray:
        finite = np.abs(beta) * INFINITE_EIGENVALUE > np.abs(alpha)
        ratio = alpha / np.where(beta == 0.0, 1.0, beta)
        return np.asarray(finite & ((np.abs(ratio) < 1.0) if plant.is_discrete else (ratio.real < 0.0)))

    units = PlantUnits.of(plant).rounded()
    equations, states = units.equations[:, None], units.states
    own_a, own_e = equations * plant.A * states, equations * plant.E * states
    a, e, alpha, beta, _, right = scipy.linalg.ordqz(own_a.T, own_e.T, sort=dies, output="real")
    count = int(np.sum(dies(alpha, beta)))
    moved = np.linalg.solve(e[:count, :count], a[:count, :count]).T if count else np.zeros((0, 0))
    rows = right[:, :count].T * units.equations
    driven = reachable_basis(moved, rows @ (plant.Bd * units.disturbances))
    if driven.shape[1]:
        free = scipy.linalg.null_space(driven.T)
        rows, moved = free.T @ rows, free.T @ moved @ free
    return rows, moved


def _realised_with_lag(
    plant: DescriptorSystem,
    filter_: Model,
    copied: FloatArray,
    moved: FloatArray,
    lag: int,
    *,
    exactly: bool = True,
) -> tuple[RealisedFilter | None, float]:
    """Return a filter beside copies ``copied`` of modes, with T and T0, and the share of `IDENTITIES_LEFT` to which
    every equation holds; ``None`` where one misses all of them, ``exactly`` or beside the largest of all terms."""
    a, b, c, d = filter_
    e, own, _, dd_past = with_past(plant, lag)
    nz, rows, na, count = len(a), len(c), len(e), len(copied)
    bd = np.vstack([plant.Bd, np.zeros((na - plant.nx, plant.nd))])
    left_kernel = left_kernel_of(e)
    if exactly and not count and nz * na >= FEWEST_ENTRIES:
        of = FilterAndPlant(a, b, c, d, e, own, dd_past, bd, plant.Dd, left_kernel)
        found, single = by_sylvester(of, np.tile(PlantUnits.of(plant).rounded().equations, 1 + lag))
        # All equations together have the smallest rest, which not many unknowns are worth.
        many = nz * na > MOST_ENTRIES
        if found is not None and (found.share == IDENTITIES_LEFT[0] or many):
            return RealisedFilter(a, b, c, d, found.T, found.S @ left_kernel, lag, 0), found.share
        if single and many:
            return None, IDENTITIES_LEFT[-1]
    shadow = np.hstack([copied @ plant.E, np.zeros((count, na - plant.nx))])
    system, sizes = _identities(a, c, (e, own, bd), shadow, left_kernel)
    products = ((-b, dd_past), (b, plant.Dd), (-d, dd_past), (d, plant.Dd))
    wanted = np.concatenate([(one @ other).ravel() for one, other in products])
    terms_wanted = np.concatenate([(np.abs(one) @ np.abs(other)).ravel() for one, other in products])
    heights = nz * na, nz * plant.nd, rows * na
    if exactly:
        solution, share = _cleaned_solution(system, (wanted, terms_wanted), heights, na, plant.nd)
    else:
        solution, share = _nearly_a_solution(system, (wanted, terms_wanted)), IDENTITIES_LEFT[-1]
    if solution is None:
        return None, share
    t, into, s, c_past = (
        part.reshape(shape)
        for part, shape in zip(
            np.split(solution, np.cumsum(sizes)[:-1]),
            ((nz, na), (nz, count), (rows, len(left_kernel)), (rows, count)),
            strict=True,
        )
    )
    return _with_copies(plant, filter_, (copied, moved), (into, c_past), (t, s @ left_kernel, lag)), share


def _identities(
    a: FloatArray,
    c: FloatArray,
    past: tuple[FloatArray, FloatArray, FloatArray],
    shadow: FloatArray,
    left_kernel: FloatArray,
) -> tuple[FloatArray, list[int]]:
    """Return the equations of T, of the copies in the state, of S with ``T0 = S left_kernel`` and of the copies in the
    rows, as one matrix on all entries, and the number of entries of each.

    ``past``: E, A and Bd of the plant with its last samples; ``shadow``: the copied modes as rows on its states.
    """
    (e, own, bd), nz, rows, count = past, len(a), len(c), len(shadow)
    sizes = [nz * len(e), nz * count, rows * len(left_kernel), rows * count]

    def equations(*parts: Any) -> Any:
        height = next(len(part) for part in parts if part is not None)
        return np.hstack(
            [np.zeros((height, size)) if part is None else part for size, part in zip(sizes, parts, strict=True)]
        )

    states, outputs = np.eye(nz), np.eye(rows)
    system = np.vstack(
        [
            equations(np.kron(a, e.T) - np.kron(states, own.T), np.kron(states, shadow.T), None, None),
            equations(np.kron(states, bd.T), None, None, None),
            equations(np.kron(c, e.T), None, -np.kron(outputs, (left_kernel @ own).T), np.kron(outputs, shadow.T)),
            equations(None, None, np.kron(outputs, (left_kernel @ bd).T), None),
        ]
    )
    return system, sizes


def _with_copies(
    plant: DescriptorSystem,
    filter_: Model,
    modes: tuple[FloatArray, FloatArray],
    read: tuple[FloatArray, FloatArray],
    tracking: tuple[FloatArray, FloatArray, int],
) -> RealisedFilter:
    """Return a filter beside those copies of modes that it reads.

    ``modes``: rows that copy them, and their matrix; ``read``: how state and rows read them; ``tracking``: T, T0, lag.
    """
    (a, b, c, d), (copied, moved), (into, c_past), (t, t0, lag) = filter_, modes, read, tracking
    basis = reachable_basis(moved.T, np.vstack([into, c_past]).T) if len(copied) else np.zeros((0, 0))
    basis, driven_count = _driven_first(basis, moved, copied @ (plant.B / _sizes_of_columns(plant.B)))
    into, c_past, moved = into @ basis, c_past @ basis, basis.T @ moved @ basis
    moved[driven_count:, :driven_count] = 0.0
    copy_count = basis.shape[1]
    copies = np.hstack([basis.T @ copied, np.zeros((copy_count, t.shape[1] - plant.nx))])
    return RealisedFilter(
        np.block([[a, into], [np.zeros((copy_count, len(a))), moved]]),
        np.vstack([b, np.zeros((copy_count, plant.ny))]),
        np.hstack([c, c_past]),
        d,
        np.vstack([t, copies]),
        t0,
        lag,
        copy_count - driven_count,
    )


def modes_that_inputs_drive(plant: DescriptorSystem) -> int:
    """Return how many of the modes that die out known inputs drive: no filter that reads them has fewer copies."""
    rows, moved = _dying_modes(plant)
    return reachable_basis(moved, rows @ (plant.B / _sizes_of_columns(plant.B))).shape[1] if plant.B.any() else 0


def _sizes_of_columns(matrix: FloatArray) -> FloatArray:
    sizes = np.linalg.norm(matrix, axis=0)
    return np.where(sizes > 0.0, sizes, 1.0)


def _driven_first(basis: FloatArray, moved: FloatArray, driving: FloatArray) -> tuple[FloatArray, int]:
    """Return columns of the same span, those that known inputs drive first, and how many these are."""
    if not basis.shape[1]:
        return basis, 0
    driven = reachable_basis(basis.T @ moved @ basis, basis.T @ driving)
    if not driven.shape[1]:
        return basis, 0
    return basis @ np.hstack([driven, scipy.linalg.null_space(driven.T)]), driven.shape[1]


def _cleaned_solution(
    system: FloatArray, wanted: tuple[FloatArray, FloatArray], heights: tuple[int, ...], width: int, disturbances: int
) -> tuple[FloatArray | None, float]:
    """Return the solution without entries that are rounding, and the share to which it holds; ``None`` for none."""
    exact, units = _solved(system, wanted[0])
    sizes = np.abs(exact) / units
    # Where all of the right side cancels, what is left of it makes nothing but rounding.
    rows = np.max(np.abs(system), axis=1, initial=0.0)
    own = rows > RANK_TOLERANCE * np.max(rows, initial=0.0)
    largest = max(np.max(sizes, initial=0.0), np.max(wanted[1][own] / rows[own], initial=0.0))
    for share in IDENTITIES_LEFT:
        for cleaned in CLEANED_SHARES:
            solution = np.where(sizes > cleaned * largest, exact, 0.0)
            missed, terms = np.abs(system @ solution - wanted[0]), np.abs(system) @ np.abs(solution) + wanted[1]
            if not holds(missed, terms, heights, width, share):
                break
            if not shows_a_disturbance(missed, terms, heights, disturbances):
                return solution, share
        else:
            return solution, share
    return None, IDENTITIES_LEFT[-1]


def _nearly_a_solution(system: FloatArray, wanted: tuple[FloatArray, FloatArray]) -> FloatArray | None:
    """Return the solution that misses no equation by more than a share of the largest term of all."""
    solution, _ = _solved(system, wanted[0])
    largest = np.max(np.abs(system) @ np.abs(solution) + wanted[1], initial=0.0)
    missed = np.max(np.abs(system @ solution - wanted[0]), initial=0.0)
    return solution if missed <= IDENTITIES_LEFT[-1] * (1.0 + largest) else None


def _solved(system: FloatArray, wanted: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the least squares solution, each equation and each unknown in its own unit, refined, and the unknowns'."""
    sizes = np.maximum(np.max(np.abs(system), axis=1, initial=0.0), np.abs(wanted))
    scale = 1.0 / np.where(sizes > 0.0, sizes, 1.0)
    scaled = scale[:, None] * system
    largest = np.max(np.abs(scaled), axis=0, initial=0.0)
    units = 1.0 / np.where(largest > 0.0, largest, 1.0)
    scaled *= units
    solution = np.zeros(system.shape[1])
    for _ in range(SOLUTIONS):
        missed = scale * (wanted - system @ solution)
        solution = solution + units * scipy.linalg.lstsq(scaled, missed, lapack_driver="gelsy", cond=RANK_TOLERANCE)[0]
    return solution, units


def left_kernel_of(e: FloatArray) -> FloatArray:
    """Return rows N with ``N E = 0``: exactly, where equations of E are empty."""
    empty = ~e.any(axis=1)
    units = np.eye(len(e))[empty]
    others = e[~empty]
    if not len(others):
        return units
    # Equations and states in units of their own: beside large entries of E small ones are no zeros.
    rows, columns = equilibrating_factors(np.abs(others))
    kernel = scipy.linalg.null_space((rows[:, None] * others * columns).T, rcond=RANK_TOLERANCE).T
    whole = np.zeros((len(kernel), len(e)))
    whole[:, ~empty] = kernel * rows
    return np.vstack([units, whole])
