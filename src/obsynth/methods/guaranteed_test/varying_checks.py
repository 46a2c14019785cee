"""The checks of guaranteed tests of plants that change with k: each different window recomputed, exactly."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from obsynth.errors import ObsynthError
from obsynth.methods.guaranteed_test.checks import SAME_SUM, SOURCE, excess, fits, known_room
from obsynth.methods.guaranteed_test.problem import delay_in_samples, rounding_of
from obsynth.methods.guaranteed_test.proofs import (
    Repaired,
    proved_least,
    proved_threshold,
    repaired_multipliers,
    repaired_point,
)
from obsynth.methods.guaranteed_test.varying import Programmes, VaryingProblem, observer_of_rows, programmes_as_designed
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.windows import WindowObserver
from obsynth.results.checks import Check, lower_bound_check, upper_bound_check
from obsynth.results.design import ObserverDesign

#: Certificates hold these by programme, as wide as the widest.
BY_PROGRAMME = ("multipliers", "multiplier_radius", "witness", "witness_radius", "rounding", "thresholds", "leasts")


def varying_checks(design: ObserverDesign, read: Callable[[Mapping[str, Any]], Any]) -> Iterator[Check]:
    """Yield a row for each claim; ``read`` returns options that are checked."""
    plant: Any = design.plant
    try:
        problem, programmes = programmes_as_designed(plant, read(design.options))
        reason = "" if _well_formed(design, problem, programmes) else "matrices of the certificate do not fit"
    except (ObsynthError, TypeError, ValueError, AttributeError, ArithmeticError, LookupError) as error:
        reason = str(error) or type(error).__name__
    yield upper_bound_check(
        "question",
        "the options ask a question about this plant, and the certificate has an answer for each different window",
        float(bool(reason)),
        0.0,
        source="options",
        detail=reason,
    )
    if reason:
        return
    shipped, claims = design.certificate.matrices, design.certificate.claims
    of_row = shipped["programmes"].ravel().astype(np.int64)
    used = sorted(set(of_row[of_row >= 0].tolist()))
    wrong = int(np.sum((of_row >= 0) & (of_row != programmes.of_row)))
    yield upper_bound_check(
        "rows",
        "each row with a verdict has the programme of its own window",
        float(wrong) if used else np.inf,
        0.0,
        source=SOURCE,
        kind="proved",
    )
    if wrong or not used:
        return
    tests = {k: _test(shipped, programmes, k) for k in used}
    yield from _of_the_tests(claims, shipped, programmes, tests)
    yield from _of_what_runs(design, problem, programmes, tests)
    yield from _of_the_least(claims, shipped, problem, programmes, used)
    window = programmes.windows[used[0]]
    yield upper_bound_check(
        "delay",
        "samples after which a fault of that size alarms at the latest, in seconds, at rows with a verdict",
        delay_in_samples(window, 0) * plant.dt,
        float(claims.get("delay", np.nan)),
        source=SOURCE,
    )


def _well_formed(design: ObserverDesign, problem: VaryingProblem, programmes: Programmes) -> bool:
    shipped, count = design.certificate.matrices, len(programmes.windows)
    _, _, nu, ny = programmes.windows[0].model.sizes
    widths = {name: shipped[name].shape[1] for name in BY_PROGRAMME}
    good = all(shipped[name].shape == (count, widths[name]) for name in BY_PROGRAMME)
    good = good and widths["multipliers"] == max(window.rows for window in programmes.windows)
    good = good and widths["multiplier_radius"] == widths["multipliers"] and widths["rounding"] == nu + ny
    good = good and widths["witness_radius"] == widths["witness"] and widths["thresholds"] == widths["leasts"] == 1
    good = good and shipped["programmes"].shape == (len(programmes.of_row), 1)
    finite = ("multipliers", "multiplier_radius", "witness", "witness_radius", "rounding", "programmes")
    good = good and all(np.isfinite(shipped[name]).all() for name in finite)
    good = good and all(bool(np.all(shipped[name] >= 0.0)) for name in ("multiplier_radius", "witness_radius"))
    whole = shipped["programmes"] == np.round(shipped["programmes"])
    return bool(good and whole.all() and shipped["programmes"].max(initial=-1.0) < count)


def _test(shipped: Mapping[str, FloatArray], programmes: Programmes, k: int) -> Repaired:
    rows = programmes.windows[k].rows
    return Repaired(shipped["multipliers"][k][:rows], shipped["multiplier_radius"][k][:rows])


def _of_the_tests(
    claims: Mapping[str, float],
    shipped: Mapping[str, FloatArray],
    programmes: Programmes,
    tests: Mapping[int, Repaired],
) -> Iterator[Check]:
    away, over, rounding, most = 0.0, 0.0, 0.0, 0.0
    for k, test in tests.items():
        window, claimed = programmes.windows[k], float(shipped["thresholds"][k, 0])
        zero = claimed == 0.0
        exact = repaired_multipliers(window, test.values, refine=False, exact_zero=zero, among=test.radius)
        found = proved_threshold(window, test, exact_zero=zero)
        away = np.fmax(away, _worst(excess(exact, test.radius)))
        over = np.fmax(over, 0.0 if found <= claimed else _worst(found / claimed if claimed > 0.0 else np.inf))
        sizes = rounding_of(window, test.values, test.radius)
        share = sizes / np.maximum(shipped["rounding"][k], np.finfo(float).tiny)
        rounding = np.fmax(rounding, float(np.max(share, initial=0.0)))
        most = np.fmax(most, _worst(claimed))
    yield upper_bound_check(
        "multipliers",
        "at each row exact multipliers that weigh the fault with one and every free signal with zero lie within the "
        "shipped distance of the shipped ones",
        away,
        1.0,
        source=SOURCE,
        kind="proved",
        detail="the largest distance of all rows as a multiple of the shipped one; one where below",
    )
    yield upper_bound_check(
        "thresholds",
        "at each row, without the fault, the residual never passes the threshold of the row",
        over,
        1.0,
        source=SOURCE,
        kind="proved",
        detail="the largest ratio of what is proved to what is shipped; 0 where none is above",
    )
    yield upper_bound_check(
        "threshold",
        "no row has a threshold above this",
        most,
        float(claims.get("threshold", np.nan)),
        source=SOURCE,
        kind="proved",
    )
    yield lower_bound_check(
        "surely found",
        "twice the threshold",
        float(claims.get("surely_found", np.nan)),
        2.0 * float(claims.get("threshold", np.nan)),
        source=SOURCE,
        kind="proved",
    )
    yield upper_bound_check(
        "rounding",
        "the rounding error of the running tests for known signals of size one is at most the shipped one",
        rounding,
        1.0 + SAME_SUM,
        source=SOURCE,
        kind="computed",
    )


def _worst(value: float) -> float:
    """Return a number that every comparison takes into account: what is not known is infinite."""
    return np.inf if np.isnan(value) else float(value)


def _of_what_runs(
    design: ObserverDesign, problem: VaryingProblem, programmes: Programmes, tests: Mapping[int, Repaired]
) -> Iterator[Check]:
    shipped: Any = design.observer
    told = np.isin(np.arange(len(programmes.windows)), list(tests))
    multipliers = [
        tests[k].values if k in tests else np.zeros(window.rows) for k, window in enumerate(programmes.windows)
    ]
    implied = observer_of_rows(problem, programmes, told, multipliers)
    worst = 0.0 if isinstance(shipped, WindowObserver) else np.inf
    kept = design.certificate.matrices["programmes"].ravel()
    for name, wanted in implied.as_dict().items() if worst == 0.0 else ():
        given = getattr(shipped, name)
        if name == "weights":
            worst = max(worst, _misfit(given, wanted, programmes, multipliers))
        elif name == "programmes":
            # Rows whose programme has a test may be left without a verdict.
            worst = worst if np.array_equal(given, kept) else np.inf
        elif name == "constants":
            worst = worst if np.array_equal(given, wanted) else np.inf
        elif given != wanted:
            worst = np.inf
    yield upper_bound_check(
        "weights",
        "the weights that run are those of the multipliers, each at its rows",
        worst,
        1.0,
        source="shipped realisation",
        kind="equality",
        detail="largest difference, in roundings of the sums that the weights are; a wrong shape or name is infinite",
    )


def _misfit(given: FloatArray, wanted: FloatArray, programmes: Programmes, multipliers: list[FloatArray]) -> float:
    if given.shape != wanted.shape:
        return np.inf
    worst = 0.0
    for row, (one, other) in enumerate(zip(given, wanted, strict=True)):
        away = float(np.max(np.abs(one - other), initial=0.0))
        room = known_room(programmes.windows[row], multipliers[row])
        worst = max(worst, 0.0 if away == 0.0 else away / room if room > 0.0 else np.inf)
    return worst


def _of_the_least(
    claims: Mapping[str, float],
    shipped: Mapping[str, FloatArray],
    problem: VaryingProblem,
    programmes: Programmes,
    used: list[int],
) -> Iterator[Check]:
    claimed = claims.get("least")
    if claimed is None:
        return
    best, away = 0.0, 0.0
    for k in used:
        window, size = programmes.windows[k], float(shipped["leasts"][k, 0])
        if np.isnan(size) or size == 0.0:
            continue
        if not problem.continues(window, programmes.first[k]) or not fits(
            shipped["witness"][k][: len(window.bar)], len(window.bar), signed=True
        ):
            best = away = np.nan
            break
        columns = len(window.bar)
        witness = Repaired(shipped["witness"][k][:columns], shipped["witness_radius"][k][:columns])
        exact = repaired_point(window, witness.values, refine=False, among=witness.radius)
        away = max(away, _worst(excess(exact, witness.radius)))
        found = proved_least(window, witness)
        best = max(best, size) if found >= size else np.nan
        if np.isnan(best):
            break
    yield upper_bound_check(
        "witness",
        "courses of the fault that satisfy every equation exactly lie within the shipped distances of the shipped ones",
        _worst(away),
        1.0,
        source=SOURCE,
        kind="proved",
    )
    yield lower_bound_check(
        "least",
        "at some row no function of its samples has a threshold below this: by a time course of the fault that these "
        "do not distinguish from another",
        best,
        float(claimed),
        source=SOURCE,
        kind="proved",
    )
    yield upper_bound_check(
        "order",
        "the least threshold is not above the shipped one",
        float(claimed),
        float(claims.get("threshold", np.nan)),
        source=SOURCE,
        kind="proved",
    )
