"""The alarm of a guaranteed test, proved by one number for each equation of its window.

Each equation of the window is multiplied by its number, and all are added up.  States and free faults then cancel, to
the last digit; what is left says that a sum of disturbances and noise is a number which bounds do not allow.  The
numbers are fractions, so that nothing is rounded: an auditor needs no solver, and no trust in one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from fractions import Fraction
from typing import Any

import numpy as np

from obsynth.methods.guaranteed_test.exact import Programmes
from obsynth.methods.guaranteed_test.proofs import (
    columns_of_exact,
    down,
    exact_multipliers,
    exact_right_sides,
    sum_in_ellipsoids,
)
from obsynth.methods.guaranteed_test.regions import while_inside
from obsynth.methods.guaranteed_test.result import GuaranteedTest
from obsynth.methods.guaranteed_test.windows import Window, disturbances_in_words
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.constants import MOST_LISTED, shown
from obsynth.results.certificate_files import SHOWN_DIGITS
from obsynth.results.design import ObserverDesign
from obsynth.verification.assumptions import LogReference


def rows_of_test(test: GuaranteedTest) -> int:
    """Return the rows that a test looks at."""
    return test.linear[1].order + 1 - len(test.certificate.matrices.get("state_tracking", ()))


def refuted(design: ObserverDesign, u: FloatArray, y: FloatArray) -> tuple[int, int, dict[str, Any]] | None:
    """Return the proof with the largest margin of any test of a design, for the end of a record; ``None``: none.

    It is the number of the test, the rows that it looks at, and the numbers as plain data: fractions in words that
    Python's ``Fraction`` reads."""
    best: tuple[int, int, dict[str, Any]] | None = None
    largest = 0.0
    for place, test in enumerate(GuaranteedTest.of(design).tests):
        rows = rows_of_test(test)
        if len(y) < rows:
            continue
        programmes = Programmes.of(test)
        for guess in programmes.refuting(y[-rows:], u[-rows:]):
            values = exact_multipliers(programmes.window.outer, guess)
            margin = np.nan if values is None else margin_of(programmes.window.outer, values, y[-rows:], u[-rows:])
            if values is not None and margin > largest:
                largest, numbers = margin, [str(value) for value in values]
                best = place, rows, {"test": test.fault, "multipliers": numbers, "margin": margin}
    return best


def margin_of(window: Window, values: list[Fraction], y: FloatArray, u: FloatArray) -> float:
    """Return by which share all bounds would have to be exceeded, at least; NaN where a free column is seen.

    All sums are exact, and the share is rounded down.
    """
    combined = columns_of_exact(window, values)
    if any(combined[j] for j in np.flatnonzero(window.free).tolist()):
        return np.nan
    right = exact_right_sides(window, y, u)
    total = abs(sum((value * side for value, side in zip(values, right, strict=True)), start=Fraction(0)))
    bounded = np.flatnonzero(window.bounded).tolist()
    parts = [Fraction(float(window.bar[j])) * abs(combined[j]) for j in bounded]
    allowed = sum(parts, start=Fraction(0))
    if window.test_problem.ellipsoid:
        allowed = Fraction(sum_in_ellipsoids(window, parts))
    if allowed == 0:
        # No disturbance and no noise at all: the rounding of the samples themselves would be a proof.
        return 0.0
    return down(total / allowed - 1)


def statement_of(
    test: GuaranteedTest, group: tuple[str, ...], row: int, log: LogReference | None, gain_set: str
) -> str:
    """Return what a proof says, with everything it rests on."""
    window = Programmes.of(test).window
    plant, test_problem = window.plant, window.test_problem
    source = "a record" if log is None else f"{log.name} (sha256 {log.sha256[:SHOWN_DIGITS]})"
    free_faults = [plant.fault_names[k] for k in test_problem.free]
    besides = f", whatever {' and '.join(free_faults)} does" if free_faults else ""
    fault, bounds = " or ".join(group), window.bounds
    noise = np.abs(bounds.noise_output) @ bounds.noise
    d_middle = bounds.disturbance_middle
    v_middle = None if bounds.noise_middle is None else bounds.noise_output @ bounds.noise_middle
    parts = [
        _listed(plant.disturbance_names, bounds.disturbance, plant.units, "within", "disturbances", d_middle),
        _listed(plant.output_names, noise, plant.units, "noise of", "sensors", v_middle),
        "process noise within its bounds" if bounds.noise_state.any() else "",
        _listed(plant.state_names, bounds.state, plant.units, "within", "states"),
        _listed(plant.state_names, bounds.first, plant.units, "at first within", "states"),
        disturbances_in_words(window),
    ]
    assumed = ", ".join(part for part in parts if part) or "any disturbances and noise"
    return (
        f"Proved: rows {row - rows_of_test(test) + 1} to {row} of {source} cannot occur without "
        f"{fault}{besides}{while_inside(test)}, with {assumed}: {fault} is present, or the model is not exact. "
        f"Gain set {gain_set[:SHOWN_DIGITS]}."
    )


def _listed(
    names: tuple[str, ...],
    sizes: FloatArray,
    units: Mapping[str, str],
    word: str,
    kind: str,
    middles: FloatArray | None = None,
) -> str:
    about = np.zeros(len(sizes)) if middles is None else middles
    bounded = [
        (name, size, middle)
        for name, size, middle in zip(names, sizes.tolist(), about.tolist(), strict=True)
        if np.isfinite(size) and (size > 0.0 or middle)
    ]
    if len(bounded) > MOST_LISTED:
        return f"{len(bounded)} {kind} {word} their bounds"
    return ", ".join(_bound_text(name, size, middle, units.get(name, ""), word) for name, size, middle in bounded)


def _bound_text(name: str, size: float, middle: float, unit: str, word: str) -> str:
    noise = word == "noise of"
    if middle:
        # Ends are reported as they were given, which half width and middle are to some digits.
        low, high = (float(f"{end:.12g}") for end in (middle - size, middle + size))
        within = f"{shown(low)} to {shown(high, unit)}"
    else:
        within = shown(float(f"{size:.6g}") if noise else size, unit)
    return f"noise of {name} within {within}" if noise else f"{name} {word} {within}"


def checked(design: ObserverDesign, body: Mapping[str, Any], u: FloatArray, y: FloatArray) -> Iterator[Any]:
    """Yield the test of a certificate, the group of faults, and the margin that is proved again."""
    bank = GuaranteedTest.of(design)
    place = [test.fault for test in bank.tests].index(body["test"])
    test = bank.tests[place]
    window = Programmes.of(test).window.outer
    values = [Fraction(text) for text in body["multipliers"]]
    fits = len(values) == window.rows and len(y) == len(u) == rows_of_test(test)
    yield test, bank.groups[place], margin_of(window, values, y, u) if fits else np.nan
