"""Guaranteed tests in proof files: multipliers and hidden faults as fractions, exact to the last digit.

Shipped doubles lie next to exact solutions.  Here these are solved for in fractions: a square part of the window's
equations, chosen in double precision, by lifting.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from fractions import Fraction
from typing import Any

import numpy as np

from obsynth.methods.guaranteed_test.bank import is_bank, tests_of
from obsynth.methods.guaranteed_test.method import GuaranteedTestMethod
from obsynth.methods.guaranteed_test.problem import window_as_designed
from obsynth.methods.guaranteed_test.windows import Window
from obsynth.numerics.arrays import FloatArray
from obsynth.proofs.exact_doubles import rounded_outward
from obsynth.proofs.nearby_solutions import independent_part, solved_by_lifting
from obsynth.proofs.witnesses import Dyadic, number_data, root_above, written
from obsynth.results.design import ObserverDesign

#: Windows with more equations have no exact fractions in a file: their numerators have as many words.
MOST_EQUATIONS = 400
#: Share of a bound that an entry at it counts for when those to correct are chosen.
LEAST_ROOM = 1e-4
#: Weights below this share of the largest count as if they were as large.
LEAST_WEIGHT = 1e-3
#: Room of a stated bound of rounding above what it is computed as.
ROUNDING_ROOM = 1.0 + 2.0**-20


def test_claims(design: ObserverDesign) -> Iterator[tuple[str, dict[str, Any] | None]]:
    """Yield the claims of each test of a design: its name, and the claim or ``None`` where it is not exported."""
    bank = is_bank(design)
    tests = tests_of(design, GuaranteedTestMethod.of) if bank else (design,)
    for place, test in enumerate(tests):
        of = f" of the test of {test.options['fault']}" if bank else ""
        window = window_of_test(test)
        row = len(design.linear[1].state_names) + place
        yield f"the threshold{of}: its window has too many equations", _threshold(design, test, window, row)
        if test.certificate.claims.get("least"):
            yield f"the least threshold{of}: its window has too many equations", _least(test, window)


def _threshold(design: ObserverDesign, test: ObserverDesign, window: Window, row: int) -> dict[str, Any] | None:
    threshold = float(test.certificate.claims["threshold"])
    window = window.outer
    exact = exact_test(window, test.certificate.matrices["multipliers"].ravel(), all_columns=threshold == 0.0)
    if exact is None:
        return None
    parts = _transposed_product(window, exact)
    proved = _largest(window, parts)
    # The exact multipliers are next to the shipped ones: their own threshold may be larger by rounding.
    stated = max(threshold, rounded_outward(proved)) if threshold else 0.0
    rounding, constant = _rounding(design, window, exact, row)
    return {
        "claim": "threshold",
        "window": window_as_data(window),
        "multipliers": fractions_data(exact),
        "threshold": number_data(stated),
        "row": row,
        "rounding": [number_data(value) for value in rounding],
        "constant": number_data(float(design.linear[1].added[row])),
        "constant_rounding": number_data(constant),
    }


def _least(test: ObserverDesign, window: Window) -> dict[str, Any] | None:
    shipped, window = test.certificate.matrices.get("witness"), window.inner
    point = None if shipped is None else exact_point(window, shipped.ravel()[: len(window.bar)])
    if point is None:
        return None
    worst = max(Fraction(1), _excess(window, point))
    least = -rounded_outward(-(point[0] / worst))
    if not least > 0.0:
        return None
    share = Fraction(least) / point[0]
    return {
        "claim": "least",
        "window": window_as_data(window),
        "point": fractions_data([value * share for value in point]),
        "least": number_data(least),
    }


def window_of_test(test: ObserverDesign) -> Window:
    """Return the equations that a test was designed on."""
    return window_as_designed(test.linear[0], GuaranteedTestMethod.of(test.options))


def window_as_data(window: Window) -> dict[str, Any]:
    """Return what the checker forms the same equations from."""
    test_problem, bounds = window.test_problem, window.bounds
    middles = {
        "disturbances": bounds.disturbance_middle,
        "noise": bounds.noise_middle,
    }
    counts = {"disturbances": len(bounds.disturbance), "noise": len(bounds.noise)}
    rates = test_problem.disturbance_rate if len(test_problem.disturbance_rate) else np.zeros(counts["disturbances"])
    return {
        "samples": test_problem.samples,
        "prior": 0,
        "equations": window.equations,
        "fault": test_problem.fault,
        "course": test_problem.course,
        "lag": test_problem.lag,
        "before": test_problem.before,
        "free": list(test_problem.free),
        "free_course": test_problem.free_course,
        "disturbance": test_problem.disturbance,
        "between_samples": _between_samples(window),
        "norm": "ellipsoid" if test_problem.ellipsoid else "box",
        "noise_state": Dyadic.of(bounds.noise_state).data(),
        "noise_output": Dyadic.of(bounds.noise_output).data(),
        "bounds": {
            "disturbances": [_bound(value) for value in bounds.disturbance],
            "noise": [_bound(value) for value in bounds.noise],
            "states": [_bound(value) for value in bounds.state],
            "first": [_bound(value) for value in bounds.first],
            "rates": [_bound(value) for value in rates],
            "fault_rate": [_bound(test_problem.fault_rate)],
        },
        "middles": {
            kind: [number_data(float(value)) for value in (np.zeros(counts[kind]) if middle is None else middle)]
            for kind, middle in middles.items()
        },
    }


def _between_samples(window: Window) -> dict[str, Any] | None:
    """Return the columns by which disturbances that move between samples enter each equation, with their bounds."""
    if not (columns := window.moving_columns):
        return None
    return {
        "columns": Dyadic.of(np.column_stack([column for _, column, _, _ in columns])).data(),
        "bounds": [number_data(bound) for _, _, bound, _ in columns],
        "groups": [block for _, _, _, block in columns],
        "replaced": window.replaced,
    }


def exact_test(window: Window, multipliers: FloatArray, *, all_columns: bool = False) -> list[Fraction] | None:
    """Return fractions next to multipliers: theta has weight one, every free column zero; ``None``: not found."""
    chosen = [0, *(range(1, len(window.bar)) if all_columns else np.flatnonzero(window.free).tolist())]
    products = _transposed_product(window, [Fraction(float(value)) for value in multipliers])
    missing = [Fraction(int(column == 0)) - products[column] for column in chosen]
    return _next_to(window.matrix[:, chosen].toarray().T, multipliers, missing, _entries(window, chosen, columns=True))


def exact_point(window: Window, point: FloatArray) -> list[Fraction] | None:
    """Return fractions next to a hidden fault that satisfy every equation; ``None``: not found."""
    rows = list(range(window.rows))
    values = [Fraction(float(value)) for value in point]
    missing = [Fraction(0)] * window.rows
    for i, j, entry in _exact_entries(window):
        missing[i] -= entry * values[j]
    # What has room may move: free numbers, and those inside of their bounds; theta stays.
    bar, sizes = np.where(window.bounded, window.bar, 0.0), np.abs(point)
    room = np.where(window.bounded, np.maximum(bar - sizes, LEAST_ROOM * bar), np.maximum(1.0, sizes))
    room[0] = 0.0
    return _next_to(window.matrix.toarray(), point, missing, _entries(window, rows, columns=False), weight=room)


def _next_to(
    matrix: FloatArray,
    values: FloatArray,
    missing: list[Fraction],
    exact: Mapping[tuple[int, int], Fraction],
    *,
    weight: FloatArray | None = None,
) -> list[Fraction] | None:
    """Return ``values + step`` with ``matrix step = missing``, of as few entries as there are independent rows."""
    if len(matrix) > MOST_EQUATIONS:
        return None
    heavy = np.abs(values) if weight is None else weight
    heavy = heavy if weight is not None else np.maximum(heavy, LEAST_WEIGHT * float(np.max(heavy, initial=0.0)))
    rows, columns = independent_part(matrix, heavy)
    entries = [exact.get((i, j), Fraction(0)) for i in rows for j in columns]
    step = solved_by_lifting(entries, [missing[i] for i in rows])
    if step is None:
        return None
    fractions = [Fraction(float(value)) for value in values]
    added = dict(zip(columns, step, strict=True))
    solved_rows = set(rows)
    sums = [Fraction(0)] * len(matrix)
    for (i, j), entry in exact.items():
        if i not in solved_rows and j in added:
            sums[i] += entry * added[j]
    if any(sums[i] != missing[i] for i in range(len(matrix)) if i not in solved_rows):
        return None
    for column, value in added.items():
        fractions[column] += value
    return fractions


def _exact_entries(window: Window) -> Iterator[tuple[int, int, Fraction]]:
    entries = (window.i.tolist(), window.j.tolist(), window.value.tolist(), window.times.tolist())
    for i, j, value, times in zip(*entries, strict=True):
        yield i, j, Fraction(value) * times


def _entries(window: Window, chosen: list[int], *, columns: bool) -> dict[tuple[int, int], Fraction]:
    """Return exact entries: of some columns, transposed, or of some rows."""
    place = {number: k for k, number in enumerate(chosen)}
    entries: dict[tuple[int, int], Fraction] = {}
    for i, j, entry in _exact_entries(window):
        key = (place.get(j), i) if columns else (place.get(i), j)
        if key[0] is not None:
            entries[key[0], key[1]] = entries.get((key[0], key[1]), Fraction(0)) + entry
    return entries


def _transposed_product(window: Window, multipliers: list[Fraction]) -> list[Fraction]:
    product = [Fraction(0)] * len(window.bar)
    for i, j, entry in _exact_entries(window):
        if multipliers[i]:
            product[j] += entry * multipliers[i]
    return product


def _largest(window: Window, parts: list[Fraction]) -> Fraction:
    """Return the threshold, as the checker sums it."""
    alone, groups = Fraction(0), dict[int, Fraction]()
    for j in np.flatnonzero(window.bounded).tolist():
        part, group = Fraction(float(window.bar[j])) * abs(parts[j]), int(window.group[j])
        if window.test_problem.ellipsoid and group >= 0:
            groups[group] = groups.get(group, Fraction(0)) + part**2
        else:
            alone += part
    return alone + sum((Fraction(root_above(value)) for value in groups.values()), start=Fraction(0))


def _excess(window: Window, point: list[Fraction]) -> Fraction:
    """Return by which factor a point exceeds its bounds."""
    worst, groups = Fraction(0), dict[int, Fraction]()
    for j in np.flatnonzero(window.bounded).tolist():
        bar, group = Fraction(float(window.bar[j])), int(window.group[j])
        if not bar:
            continue
        share = abs(point[j]) / bar
        worst = max(worst, share)
        if window.test_problem.ellipsoid and group >= 0:
            groups[group] = groups.get(group, Fraction(0)) + share**2
    return max([worst, *(Fraction(root_above(value)) for value in groups.values())])


def _rounding(
    design: ObserverDesign, window: Window, multipliers: list[Fraction], row: int
) -> tuple[FloatArray, float]:
    """Return how far the weights that run are from exact ones, summed over samples, and the constant from its own."""
    observer, plant = design.linear[1], window.plant
    exact = _Weights(window, multipliers)
    response = [Dyadic.of(observer.Du[[row]]), Dyadic.of(observer.Dy[[row]])]
    state, (az, bu, by) = Dyadic.of(observer.Cz[[row]]), (Dyadic.of(m) for m in (observer.Az, observer.Bu, observer.By))
    missed = [Fraction(0)] * (plant.nu + plant.ny)
    for k in range(exact.last, -1, -1):
        entries = [part.fraction(0, j) for part in response for j in range(part.shape[1])]
        missed = [m + abs(a - b) for m, a, b in zip(missed, exact.at(k), entries, strict=True)]
        response, state = [state @ bu, state @ by], state @ az
    constant = -sum((m * side for m, side in zip(multipliers, window.standing or (), strict=False)), start=Fraction(0))
    away = rounded_outward(abs(Fraction(float(observer.added[row])) - constant))
    return np.array([rounded_outward(value) * ROUNDING_ROOM for value in missed]), away * ROUNDING_ROOM


class _Weights:
    """What exact multipliers make of known inputs and outputs, by sample."""

    def __init__(self, window: Window, multipliers: list[Fraction]) -> None:
        self.window, self.multipliers = window, multipliers
        length = max(window.equations, window.test_problem.samples)
        used = [k for k in range(length) if any(self.at(k))]
        self.last = max([*used, window.test_problem.samples - 1])

    def at(self, k: int) -> list[Fraction]:
        """Return the weights of u and y at sample k."""
        window, plant = self.window, self.window.plant
        nx, ny, zero = plant.nx, plant.ny, [Fraction(0)] * plant.ny
        first = window.outputs_at + k * ny
        of_y = self.multipliers[first : first + ny] if k < window.test_problem.samples else zero
        of_x = self.multipliers[k * nx : (k + 1) * nx] if k < window.equations else [Fraction(0)] * nx
        on_u = [
            sum((w * Fraction(float(plant.B[r, j])) for r, w in enumerate(of_x)), start=Fraction(0))
            - sum((w * Fraction(float(plant.D[r, j])) for r, w in enumerate(of_y)), start=Fraction(0))
            for j in range(plant.nu)
        ]
        return [*on_u, *of_y]


def fractions_data(values: list[Fraction]) -> dict[str, Any]:
    """Return fractions as data of a proof file, with one denominator."""
    denominator = math.lcm(*(value.denominator for value in values)) if values else 1
    numerators = [value.numerator * (denominator // value.denominator) for value in values]
    return {"denominator": written(denominator), "numerators": [written(value) for value in numerators]}


def _bound(value: float) -> dict[str, Any] | None:
    return number_data(float(value)) if np.isfinite(value) else None
