"""The checks of a guaranteed test: threshold and witness recomputed from shipped numbers, exactly, without a solver."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from obsynth.errors import ObsynthError
from obsynth.methods.guaranteed_test.options import Asked
from obsynth.methods.guaranteed_test.problem import delay_in_samples, observer_of, rounding_of, window_as_designed
from obsynth.methods.guaranteed_test.proofs import (
    Repaired,
    proved_least,
    proved_threshold,
    repaired_multipliers,
    repaired_point,
)
from obsynth.methods.guaranteed_test.regions import remainder_check, while_inside
from obsynth.methods.guaranteed_test.tolerant import MEAN_ROOM, mean_over_record, part_beside
from obsynth.methods.guaranteed_test.windows import Window
from obsynth.numerics.arrays import FloatArray
from obsynth.proofs.balls import UNIT_ROUNDOFF
from obsynth.results.checks import Check, information, lower_bound_check, nothing_wrong, upper_bound_check
from obsynth.results.design import ObserverDesign

SOURCE = "duality of linear programmes; exact arithmetic on the shipped numbers"


def checks(design: ObserverDesign, read: Callable[[Mapping[str, Any]], Asked]) -> Iterator[Check]:
    """Yield a row for each claim; ``read`` returns options that are checked."""
    try:
        window = window_as_designed(design.linear[0], read(design.options))
        reason = ""
    except (ObsynthError, TypeError, ValueError, AttributeError, OverflowError) as error:
        window, reason = None, str(error)
    yield upper_bound_check(
        "question",
        "the options ask a question about this plant",
        float(window is None),
        0.0,
        source="options",
        detail=reason,
    )
    if window is None:
        return
    if design.options.get("model") is not None:
        yield remainder_check(design, read)
    shipped = design.certificate.matrices
    sizes = {
        "multipliers": window.rows,
        "multiplier_radius": window.rows,
        "rounding": window.plant.nu + window.plant.ny,
    }
    if "witness" in shipped or "witness_radius" in shipped:
        sizes |= {"witness": len(window.bar), "witness_radius": len(window.bar)}
    nx, count = window.plant.nx, 0
    if design.linear[1].state_names or {"state_tracking", "record"} & set(shipped):
        count = len(shipped.get("state_tracking", np.zeros((0, nx))))
        steps = len(shipped.get("record", np.zeros((0, 0))))
        sizes |= {"state_tracking": count * nx, "state_rows": nx**2}
        sizes |= {"record": max(steps, window.question.samples) * (window.plant.nu + window.plant.ny)}
    wrong = [name for name, size in sizes.items() if not fits(shipped.get(name), size, signed="radius" not in name)]
    wrong += [] if len(design.linear[1].state_names) in (0, nx) else ["states"]
    yield nothing_wrong(
        "certificate", "multipliers and witness fit the window of the options", wrong, source="certificate"
    )
    if wrong:
        return
    test = Repaired(_flat(shipped["multipliers"]), _flat(shipped["multiplier_radius"]))
    yield from _of_the_test(design, window, test)
    yield from _of_the_least(design, window)
    if "mean_threshold" in design.certificate.claims:
        yield _over_tolerances(design, window, test)
    delay = delay_in_samples(window, window.weights(test.values)[2]) * window.plant.dt
    claimed = float(design.certificate.claims.get("delay", np.nan))
    yield upper_bound_check(
        "delay",
        "a fault of the size that is surely found alarms after so many seconds at the latest",
        delay,
        claimed,
        source=SOURCE,
    )


def _flat(matrix: FloatArray) -> FloatArray:
    return np.asarray(matrix, dtype=np.float64).ravel()


def fits(matrix: FloatArray | None, size: int, *, signed: bool) -> bool:
    """Whether a matrix is there, of so many finite numbers, none of them negative but for ``signed``."""
    if matrix is None or matrix.size != size or not np.isfinite(matrix).all():
        return False
    return signed or bool(np.all(matrix >= 0.0))


def excess(found: Repaired | None, radius: FloatArray) -> float:
    """Return the largest ratio of what is proved to what is shipped; NaN where nothing is proved."""
    if found is None:
        return np.nan
    outside = found.radius > radius
    return float(np.max(found.radius[outside] / np.maximum(radius[outside], np.finfo(float).tiny), initial=1.0))


def _of_the_test(design: ObserverDesign, window: Window, test: Repaired) -> Iterator[Check]:
    claims, observer = design.certificate.claims, design.linear[1]
    threshold = float(claims.get("threshold", np.nan))
    zero = threshold == 0.0
    exact = repaired_multipliers(window, test.values, refine=False, exact_zero=zero, among=test.radius)
    yield upper_bound_check(
        "multipliers",
        "exact multipliers that weigh the fault with one and every free signal with zero lie within the shipped "
        "distance of the shipped ones",
        excess(exact, test.radius),
        1.0,
        source=SOURCE,
        kind="proved",
        detail="the largest distance as a multiple of the shipped one; one where below",
    )
    yield upper_bound_check(
        "threshold",
        f"without the fault the residual never passes this{while_inside(design)}",
        proved_threshold(window, test, exact_zero=zero),
        threshold,
        source=SOURCE,
        kind="proved",
        detail="sum of all bounds, each times its weight by the exact multipliers",
    )
    found = float(claims.get("surely_found", np.nan))
    yield lower_bound_check(
        "surely found",
        "twice the threshold",
        found,
        2.0 * threshold,
        source=SOURCE,
        kind="proved",
    )
    tracking = design.certificate.matrices.get("state_tracking")
    # The observer beside the test may be any: its error is bounded by what it is.
    beside = None if tracking is None else part_beside(observer, min(len(tracking), observer.order))
    implied = observer_of(window, test.values, beside)
    rounding = rounding_of(window, test.values, test.radius)
    yield upper_bound_check(
        "weights",
        "the weights that run are those of the multipliers",
        _misfit(observer, implied, window, test.values),
        1.0,
        source="shipped realisation",
        kind="equality",
        detail="largest difference, in roundings of the sums that the weights are; a wrong shape or name is infinite",
    )
    shipped = _flat(design.certificate.matrices["rounding"])
    share = float(np.max(rounding / np.maximum(shipped, np.finfo(float).tiny), initial=0.0))
    yield upper_bound_check(
        "rounding",
        "the rounding error of the running test for known signals of size one is at most the shipped one",
        share,
        1.0 + SAME_SUM,
        source=SOURCE,
        kind="computed",
    )


def _over_tolerances(design: ObserverDesign, window: Window, test: Repaired) -> Check:
    shipped, found, reason = design.certificate.matrices, np.nan, ""
    try:
        T, T0, record = (shipped[name] for name in ("state_tracking", "state_rows", "record"))
        found = mean_over_record(window, design.linear[1], test.values, T, T0, record)
    except (ObsynthError, KeyError, ValueError, IndexError) as error:
        reason = str(error)
    return upper_bound_check(
        "mean threshold",
        "mean over the shipped record of the threshold that the residual never passes without a fault, for all "
        f"constants in their tolerances; to {MEAN_ROOM:.0%}, as each processor has its own bound",
        found,
        float(design.certificate.claims["mean_threshold"]) * (1.0 + MEAN_ROOM),
        source="the observer's error over the box of the constants",
        detail=reason,
    )


#: Sums in another order differ by less than this share.
SAME_SUM = 1e-12
#: Roundings that a product of multipliers and inputs may be away from another.
PRODUCT_ROUNDINGS = 4.0


def known_room(window: Window, multipliers: FloatArray) -> float:
    """Return how far weights of known inputs may be from those that the multipliers say, by the order of sums."""
    nx, ne, _, ny = window.model.sizes
    equations = np.abs(multipliers[: window.outputs_at]).reshape(window.equations, ne)
    outputs = np.abs(multipliers[window.outputs_at :][: window.question.samples * ny])
    sizes = [part @ np.abs(window.model.inputs(k)) for k, part in enumerate(equations)]
    size = float(np.max(sizes, initial=0.0))
    size += float(np.max(outputs.reshape(-1, ny) @ np.abs(window.model.D), initial=0.0))
    return PRODUCT_ROUNDINGS * (nx + ny) * UNIT_ROUNDOFF * size


def _misfit(shipped: object, implied: object, window: Window, multipliers: FloatArray) -> float:
    worst = 0.0
    allowed = {"Bu": known_room(window, multipliers), "Du": known_room(window, multipliers)}
    for part in fields(implied):  # type: ignore[arg-type]
        name, wanted, given = part.name, getattr(implied, part.name), getattr(shipped, part.name)
        if (wanted is None) != (given is None):
            worst = np.inf
            continue
        if not isinstance(wanted, np.ndarray):
            worst = worst if given == wanted else np.inf
        elif given.shape != wanted.shape:
            worst = np.inf
        elif given.size:
            away, room = float(np.max(np.abs(given - wanted))), allowed.get(name, 0.0)
            worst = max(worst, 0.0 if away == 0.0 else away / room if room > 0.0 else np.inf)
    return worst


def _of_the_least(design: ObserverDesign, window: Window) -> Iterator[Check]:
    claims, shipped = design.certificate.claims, design.certificate.matrices
    threshold, least = float(claims.get("threshold", np.nan)), claims.get("least")
    if least is None:
        return
    if least == 0.0:
        found = 0.0
    elif "witness" not in shipped:
        found = np.nan
    else:
        witness = Repaired(_flat(shipped["witness"]), _flat(shipped["witness_radius"]))
        exact = repaired_point(window, witness.values, refine=False, among=witness.radius)
        yield upper_bound_check(
            "witness",
            "a course of the fault that satisfies every equation exactly lies within the shipped distance "
            "of the shipped one",
            excess(exact, witness.radius),
            1.0,
            source=SOURCE,
            kind="proved",
        )
        found = proved_least(window, witness)
    yield lower_bound_check(
        "least",
        "no function of these samples has a threshold below this: a fault of twice this size, and none, give "
        "the same samples within all bounds"
        if window.twice_is_hidden
        else "no function of these samples estimates the fault to within less: a fault of this size, and its "
        "opposite, give "
        "the same samples within all bounds",
        found,
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
    if threshold > 0.0:
        yield information(
            "gap", "threshold over least, less one", threshold / least - 1.0 if least > 0.0 else np.inf, source=SOURCE
        )
