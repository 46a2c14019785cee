"""Checks of a guaranteed test: threshold and witness are recomputed exactly from shipped numbers, without a solver."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obsynth.errors import ObsynthError
from obsynth.methods.guaranteed_test.options import TestOptions
from obsynth.methods.guaranteed_test.problem import (
    WindowProblem,
    WindowProgrammes,
    problem_as_designed,
    require_linear_options,
)
from obsynth.methods.guaranteed_test.proofs import proved_least, proved_threshold, repaired_multipliers, repaired_point
from obsynth.methods.guaranteed_test.regions import remainder_check, while_inside
from obsynth.methods.guaranteed_test.tolerant import MEAN_ROOM, mean_over_record, part_beside
from obsynth.methods.guaranteed_test.window_observers import (
    delay_in_samples,
    observer_of,
    observer_of_rows,
    rounding_of,
)
from obsynth.methods.guaranteed_test.windows import Window, disturbances_in_words
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.window.observer import WindowObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.balls import UNIT_ROUNDOFF
from obsynth.proofs.nearby_solutions import NearbySolution
from obsynth.results.checks import Check, information, lower_bound_check, nothing_wrong, upper_bound_check
from obsynth.results.design import ObserverDesign
from obsynth.verification.claims import listed_gains

SOURCE = "duality of linear programmes; exact arithmetic on the shipped numbers"

#: Matrices of a certificate with a row for each linear programme; for a plant with constant matrices, one row.
BY_PROGRAMME = ("multipliers", "multiplier_radius", "witness", "witness_radius", "rounding", "thresholds", "leasts")

#: Relative difference of sums of the same terms in another order, at most.
SAME_SUM = 1e-12

#: Share by which an optimum of the linear programmes may be beyond the proved bounds: ten times the solver's tolerance.
TABLE_ROOM = 1e-6

#: Difference of two computed products of multipliers and inputs, in units of rounding, at most.
PRODUCT_ROUNDINGS = 4.0


def checks(design: ObserverDesign, read: Callable[[Mapping[str, Any]], TestOptions]) -> Iterator[Check]:
    """Yield a row for each claim; ``read`` returns options that are checked."""
    constant = isinstance(design.plant, DescriptorSystem)
    problem, programmes, reason = _problem_of_options(design, read, constant=constant)
    yield upper_bound_check(
        "question",
        "the options ask a question about this plant",
        float(programmes is None),
        0.0,
        source="options",
        detail=reason,
    )
    if programmes is None or problem is None:
        return
    if design.options.get("model") is not None:
        yield remainder_check(design, read)
    shipped = _by_programme(design, constant=constant)
    wrong = _what_does_not_fit(design, shipped, programmes, constant=constant)
    yield nothing_wrong(
        "certificate", "multipliers and witness fit the window of the options", wrong, source="certificate"
    )
    if wrong:
        return
    of_row = shipped["programmes"].ravel().astype(np.int64)
    used = sorted(set(of_row[of_row >= 0].tolist()))
    if not constant:
        placed = _placed_row(of_row, programmes)
        yield placed
        if not placed.passed:
            return
    tests = _shipped_tests(shipped, programmes, used)
    yield from _of_the_tests(design, shipped, programmes, tests, constant=constant)
    yield from _of_what_runs(design, shipped, problem, programmes, tests)
    yield from _of_the_least(design, shipped, problem, programmes, used, constant=constant)
    if constant and not _table_fits(design):
        claim = "thresholds of other numbers of samples do not contradict the proved ones"
        yield nothing_wrong("table of samples", claim, ["trade_off"], source="certificate")
    if "mean_threshold" in design.certificate.claims:
        yield _over_tolerances(design, programmes.windows[0], tests[0])
    delay = _delay(programmes.windows[used[0]], tests[used[0]]) * problem.plant.dt
    yield upper_bound_check(
        "delay",
        "a fault of the size that is certain to be detected raises an alarm after at most so many seconds"
        f"{'' if constant else ', at rows with a verdict'}",
        delay,
        float(design.certificate.claims.get("delay", np.nan)),
        source=SOURCE,
    )


def _problem_of_options(
    design: ObserverDesign, read: Callable[[Mapping[str, Any]], TestOptions], *, constant: bool
) -> tuple[WindowProblem | None, WindowProgrammes | None, str]:
    """Return the problem of the options for the plant, and its programmes; or the reason why there are none."""
    try:
        plant: Any = design.linear[0] if constant else design.plant
        options = read(design.options)
        if options.model is None:
            require_linear_options(options)
        problem = problem_as_designed(plant, options)
        return problem, WindowProgrammes.of(problem, int(options.samples)), ""
    except (ObsynthError, TypeError, ValueError, AttributeError, ArithmeticError, LookupError) as error:
        return None, None, str(error) or type(error).__name__


def _placed_row(of_row: NDArray[np.int64], programmes: WindowProgrammes) -> Check:
    """Return the check that each row of a record has the programme of its own window; -1 stands for none."""
    misplaced = int(np.sum((of_row >= 0) & (of_row != programmes.of_row)))
    return upper_bound_check(
        "rows",
        "each row with a verdict has the programme of its own window",
        float(misplaced) if np.any(of_row >= 0) else np.inf,
        0.0,
        source=SOURCE,
        kind="proved",
    )


def _shipped_tests(
    shipped: Mapping[str, FloatArray], programmes: WindowProgrammes, used: Sequence[int]
) -> dict[int, NearbySolution]:
    """Return the shipped multipliers of each used programme, with the bounds of their distance from exact ones."""
    tests = {}
    for k in used:
        rows = programmes.windows[k].rows
        tests[k] = NearbySolution(shipped["multipliers"][k][:rows], shipped["multiplier_radius"][k][:rows])
    return tests


def _delay(window: Window, test: NearbySolution) -> int:
    """Return the number of samples until a fault of the size that is certain to be detected raises an alarm."""
    return delay_in_samples(window, window.weights(test.values)[2])


def _by_programme(design: ObserverDesign, *, constant: bool) -> dict[str, FloatArray]:
    """Return the matrices of a certificate with a row for each programme, also if there is only one."""
    shipped, claims = dict(design.certificate.matrices), design.certificate.claims
    if not constant:
        return shipped
    matrices = {name: np.asarray(part, dtype=np.float64) for name, part in shipped.items()}
    matrices |= {name: matrices[name].reshape(1, -1) for name in BY_PROGRAMME if name in matrices}
    own = {"thresholds": claims.get("threshold", np.nan), "leasts": claims.get("least", np.nan)}
    return matrices | {name: np.array([[value]]) for name, value in own.items()} | {"programmes": np.zeros((1, 1))}


def _what_does_not_fit(
    design: ObserverDesign, shipped: Mapping[str, FloatArray], programmes: WindowProgrammes, *, constant: bool
) -> list[str]:
    """Return the names of matrices that are missing, or have a wrong shape or sign."""
    count, windows, plant = len(programmes.windows), programmes.windows, programmes.windows[0].model.plant
    rows, columns = max(window.rows for window in windows), sorted(len(window.inner.bar) for window in windows)
    least = max((shipped[name].shape[-1] for name in ("witness", "witness_radius") if name in shipped), default=1)
    shapes = {name: (count, rows) for name in ("multipliers", "multiplier_radius")}
    shapes |= {"rounding": (count, plant.nu + plant.ny), "programmes": (len(programmes.of_row), 1)}
    if not constant or {"witness", "witness_radius"} & set(shipped):
        # The windows with the most columns need not be those that have a witness.
        width = columns[0] if constant else least if least in columns else 1
        shapes |= {name: (count, width) for name in ("witness", "witness_radius")}
    wrong = [
        name
        for name, shape in shapes.items()
        if name not in shipped
        or shipped[name].shape != shape
        or not np.isfinite(shipped[name]).all()
        or ("radius" in name and bool(np.any(shipped[name] < 0.0)))
    ]
    if not constant:
        wrong += [name for name in ("thresholds", "leasts") if shipped.get(name, np.zeros(0)).shape != (count, 1)]
        numbers = shipped.get("programmes", np.zeros(0))
        wrong += (
            ["numbers of programmes"]
            if np.any(numbers != np.round(numbers)) or numbers.max(initial=-1.0) >= count
            else []
        )
        return wrong
    nx, names = plant.nx, design.linear[1].state_names
    if names or {"state_tracking", "record"} & set(shipped):
        order, steps = (len(shipped.get(name, ())) for name in ("state_tracking", "record"))
        known = max(steps, windows[0].test_problem.samples) * (plant.nu + plant.ny)
        sizes = {"state_tracking": order * nx, "state_rows": nx**2, "record": known}
        parts = ((name, size, shipped.get(name)) for name, size in sizes.items())
        wrong += [name for name, size, m in parts if m is None or m.size != size or not np.isfinite(m).all()]
    return wrong if len(names) in (0, nx) else [*wrong, "states"]


def excess(proved: NearbySolution | None, radius: FloatArray) -> float:
    """Return the largest ratio of a proved radius to the shipped one; NaN without a proof."""
    if proved is None:
        return np.nan
    outside = proved.radius > radius
    return float(np.max(proved.radius[outside] / np.maximum(radius[outside], np.finfo(float).tiny), initial=1.0))


def _table_fits(design: ObserverDesign) -> bool:
    """Return whether the thresholds for other numbers of samples agree with the proofs for the chosen number.

    More samples never raise the least threshold.  It is at most the proved threshold for as many or more samples, and
    at least the proved lower bound for as many or fewer.  Otherwise the table has the results of linear programmes.
    """
    table, claims = design.certificate.matrices.get("trade_off"), design.certificate.claims
    if table is None:
        return True
    samples, threshold = float(design.options["samples"]), float(claims.get("threshold", np.nan))
    if table.ndim != 2 or table.shape[1] < 2 or not np.any(table[:, 0] == samples):
        return False
    long, short = table[table[:, 0] >= samples, 1], table[table[:, 0] <= samples, 1]
    return bool(
        np.all(long <= threshold * (1.0 + TABLE_ROOM))
        and np.all(short >= float(claims.get("least", 0.0)) * (1.0 - TABLE_ROOM))
    )


def _worst(value: float) -> float:
    """Return a number, or infinity for NaN, which comparisons would ignore."""
    return np.inf if np.isnan(value) else float(value)


def _judged(
    window: Window, test: NearbySolution, shipped: Mapping[str, FloatArray], k: int, *, constant: bool
) -> tuple[float, float, float, float]:
    """Return four numbers on one test: the distance of exact multipliers relative to the shipped bound, the ratio of
    the proved threshold to the shipped one if it is larger, the threshold, and the rounding error relative to the
    shipped one."""
    claimed = float(shipped["thresholds"][k, 0])
    zero = claimed == 0.0
    examined = window.outer if zero else window
    exact = repaired_multipliers(examined, test.values, refine=False, exact_zero=zero, among=test.radius)
    proved = proved_threshold(window.outer, test, exact_zero=zero)
    over = 0.0 if proved <= claimed else proved / claimed if claimed > 0.0 else np.inf
    sizes = rounding_of(window, test.values, test.radius)
    share = sizes / np.maximum(shipped["rounding"][k], np.finfo(float).tiny)
    return excess(exact, test.radius), over, proved if constant else claimed, float(np.max(share, initial=0.0))


def _of_the_tests(
    design: ObserverDesign,
    shipped: Mapping[str, FloatArray],
    programmes: WindowProgrammes,
    tests: Mapping[int, NearbySolution],
    *,
    constant: bool,
) -> Iterator[Check]:
    claims, each = design.certificate.claims, "" if constant else "at each row "
    judged = [_judged(programmes.windows[k], test, shipped, k, constant=constant) for k, test in tests.items()]
    away, over, largest, rounding = (max(map(_worst, worst)) for worst in zip(*judged, strict=True))
    yield upper_bound_check(
        "multipliers",
        f"{each}exact multipliers that weigh the fault with one and every free signal with zero lie within the shipped "
        "distance of the shipped ones",
        away,
        1.0,
        source=SOURCE,
        kind="proved",
        detail="the largest distance as a multiple of the shipped one; one where below",
    )
    if not constant:
        yield upper_bound_check(
            "thresholds",
            "at each row, without the fault, the residual never passes the threshold of the row",
            over,
            1.0,
            source=SOURCE,
            kind="proved",
            detail="the largest ratio of what is proved to what is shipped; 0 where none is above",
        )
    threshold = float(claims.get("threshold", np.nan))
    yield upper_bound_check(
        "threshold",
        f"without the fault the residual never passes this{while_inside(design)}{_moving(programmes.windows[0])}"
        if constant
        else "no row has a threshold above this",
        largest,
        threshold,
        source=SOURCE,
        kind="proved",
        detail="sum of all bounds, each times its weight by the exact multipliers" if constant else "",
    )
    yield lower_bound_check(
        "surely found",
        "twice the threshold",
        float(claims.get("surely_found", np.nan)),
        2.0 * threshold,
        source=SOURCE,
        kind="proved",
    )
    yield upper_bound_check(
        "rounding",
        "the rounding error of the running test for known signals of size one is at most the shipped one",
        rounding,
        1.0 + SAME_SUM,
        source=SOURCE,
        kind="computed",
    )


def _moving(window: Window) -> str:
    """Return a text on the assumptions on disturbances other than their bounds, to be added to the row."""
    words = disturbances_in_words(window)
    return f", for {words}" if words else ""


def _of_what_runs(
    design: ObserverDesign,
    shipped: Mapping[str, FloatArray],
    problem: WindowProblem,
    programmes: WindowProgrammes,
    tests: Mapping[int, NearbySolution],
) -> Iterator[Check]:
    windows, rooms = programmes.windows, {}
    implied: LinearObserver | WindowObserver | None = None
    gains: dict[str, FloatArray] = {}
    multipliers = [tests[k].values if k in tests else np.zeros(window.rows) for k, window in enumerate(windows)]
    room = np.array([[known_room(*pair)] for pair in zip(windows, multipliers, strict=True)])
    if isinstance(problem.plant, DescriptorSystem):
        observer, tracking = design.linear[1], shipped.get("state_tracking")
        # No condition on the observer beside the test: its error is bounded from its own numbers.
        beside = None if tracking is None else part_beside(observer, min(len(tracking), observer.order))
        implied, rooms = observer_of(windows[0], multipliers[0], beside), {"Bu": room, "Du": room}
        gains = dict(zip("hg", windows[0].weights(multipliers[0])[:2], strict=True))
    elif isinstance(design.observer, WindowObserver):
        has_test = np.isin(np.arange(len(windows)), list(tests))
        # A row may be without a verdict although its programme has a test.
        of_row = shipped["programmes"].ravel()
        implied = replace(observer_of_rows(problem, programmes, has_test, multipliers), programmes=of_row)
        rooms, gains = {"weights": room}, {"weights": design.observer.weights}
    yield upper_bound_check(
        "weights",
        "the weights that run are those of the multipliers",
        np.inf if implied is None else _misfit(design.observer, implied, rooms),
        1.0,
        source="shipped realisation",
        kind="equality",
        detail="largest difference, in roundings of the sums that the weights are; a wrong shape or name is infinite",
    )
    yield listed_gains(design, gains)


def _over_tolerances(design: ObserverDesign, window: Window, test: NearbySolution) -> Check:
    shipped, mean, reason = design.certificate.matrices, np.nan, ""
    try:
        T, T0, record = (shipped[name] for name in ("state_tracking", "state_rows", "record"))
        mean = mean_over_record(window, design.linear[1], test.values, T, T0, record)
    except (ObsynthError, KeyError, ValueError, IndexError) as error:
        reason = str(error)
    return upper_bound_check(
        "mean threshold",
        "mean over the shipped record of the threshold that the residual never passes without a fault, for all "
        f"constants in their tolerances; to {MEAN_ROOM:.0%}, as each processor has its own bound",
        mean,
        float(design.certificate.claims["mean_threshold"]) * (1.0 + MEAN_ROOM),
        source="the observer's error over the box of the constants",
        detail=reason,
    )


def known_room(window: Window, multipliers: FloatArray) -> float:
    """Return a bound on the rounding of the weights of known inputs, which are sums over the multipliers."""
    nx, ne, _, ny = window.model.sizes
    equations = np.abs(multipliers[: window.outputs_at]).reshape(window.equations, ne)
    outputs = np.abs(multipliers[window.outputs_at :][: window.test_problem.samples * ny])
    sizes = [part @ np.abs(inputs) for part, (_, _, inputs) in zip(equations, window.model.equations, strict=True)]
    size = float(np.max(sizes, initial=0.0))
    size += float(np.max(outputs.reshape(-1, ny) @ np.abs(window.model.D), initial=0.0))
    return PRODUCT_ROUNDINGS * (nx + ny) * UNIT_ROUNDOFF * size


def _misfit(shipped: object, implied: Any, rooms: Mapping[str, FloatArray]) -> float:
    """Return the largest difference between two observers relative to the tolerance of each number.

    It is infinite for a difference without a tolerance.
    """
    worst = 0.0
    for part in fields(implied):
        name, implied_part, shipped_part = part.name, getattr(implied, part.name), getattr(shipped, part.name)
        if not isinstance(implied_part, np.ndarray):
            worst = worst if shipped_part == implied_part else np.inf
        elif shipped_part is None or shipped_part.shape != implied_part.shape:
            worst = np.inf
        elif shipped_part.size:
            away = np.abs(shipped_part - implied_part)
            room = np.broadcast_to(rooms.get(name, np.zeros(1)), away.shape)
            shares = np.divide(away, room, out=np.where(away == 0.0, 0.0, np.inf), where=(away > 0.0) & (room > 0.0))
            worst = max(worst, _worst(float(np.max(shares))))
    return worst


def _proved_witness(
    window: Window, shipped: Mapping[str, FloatArray], k: int, *, constant: bool
) -> tuple[float, float]:
    """Return the distance of an exact point relative to the shipped bound, and the size that the witness proves.

    With several programmes, the size is NaN if it is below the shipped one of this row; with one programme the claim
    itself is compared later.
    """
    window = window.inner
    columns, size = len(window.bar), float(shipped["leasts"][k, 0])
    if "witness" not in shipped or shipped["witness"].shape[1] < columns:
        return np.nan, np.nan
    witness = NearbySolution(shipped["witness"][k][:columns], shipped["witness_radius"][k][:columns])
    exact = repaired_point(window, witness.values, refine=False, among=witness.radius)
    least = proved_least(window, witness)
    return excess(exact, witness.radius), least if constant or least >= size else np.nan


def _is_lasting(
    problem: WindowProblem, programmes: WindowProgrammes, shipped: Mapping[str, FloatArray], k: int
) -> bool:
    """Whether the shipped witness of a programme is a trajectory of a plant that runs before and after the window."""
    window = programmes.windows[k].inner
    columns = len(window.bar)
    if "witness" not in shipped or shipped["witness"].shape[1] < columns:
        return False
    point, radius = (shipped[name][k][:columns] for name in ("witness", "witness_radius"))
    return problem.is_of_a_running_plant(window, programmes.first[k], point, radius)


def _of_the_least(
    design: ObserverDesign,
    shipped: Mapping[str, FloatArray],
    problem: WindowProblem,
    programmes: WindowProgrammes,
    used: list[int],
    *,
    constant: bool,
) -> Iterator[Check]:
    claims = design.certificate.claims
    threshold, least = float(claims.get("threshold", np.nan)), claims.get("least")
    if least is None:
        return
    # A lower bound of zero needs no witness.
    with_witness = [k for k in used if not np.isnan(shipped["leasts"][k, 0]) and shipped["leasts"][k, 0] != 0.0]
    proofs = [_proved_witness(programmes.windows[k], shipped, k, constant=constant) for k in with_witness]
    away = max((_worst(distance) for distance, _ in proofs), default=0.0)
    sizes = [size for _, size in proofs]
    going_on = all(_is_lasting(problem, programmes, shipped, k) for k in with_witness)
    best = np.nan if not going_on or np.isnan(sizes).any() else max(sizes, default=0.0)
    if away != 0.0:
        yield upper_bound_check(
            "witness",
            "a course of the fault that satisfies every equation exactly lies within the shipped distance of the "
            f"shipped one{'' if constant else ', at each row that has one'}",
            away,
            1.0,
            source=SOURCE,
            kind="proved",
        )
    yield lower_bound_check(
        "least",
        _least_in_words(programmes.windows[0], constant=constant),
        best,
        float(least),
        source=SOURCE,
        kind="proved",
    )
    yield upper_bound_check(
        "order",
        "the least threshold is not above the shipped one",
        float(least),
        threshold,
        source=SOURCE,
        kind="proved",
    )
    if constant and threshold > 0.0:
        yield information(
            "gap", "threshold over least, less one", threshold / least - 1.0 if least > 0.0 else np.inf, source=SOURCE
        )


def _least_in_words(window: Window, *, constant: bool) -> str:
    if not constant:
        return (
            "at some row no function of its samples has a threshold below this: by a time course of the fault that "
            "these do not distinguish from another"
        )
    if window.twice_is_hidden:
        return (
            "no function of these samples has a threshold below this: a fault of twice this size, and none, give the "
            "same samples within all bounds"
        )
    return (
        "no function of these samples estimates the fault to within less: a fault of this size, and its opposite, give "
        "the same samples within all bounds"
    )
