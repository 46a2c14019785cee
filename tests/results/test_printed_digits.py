"""Gains from paper: designs rounded to a few decimals keep every identity within what that rounding can do."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from obsynth import DescriptorSystem, ObserverDesign, SpecError, design_from_gains, fault_estimation_filter, verify
from obsynth.results.checks import Check

sys.path.append(str(Path(__file__).parents[1] / "property"))
from plants import build, random_recipe

#: Seed -> longest detectability index of the random plant.
LONGEST = {seed: 1 + seed % 3 for seed in range(24)}
DIGITS = (3, 4, 5, 6)
PERTURBED_DIGITS = 4


@cache
def designed(seed: int) -> ObserverDesign:
    rng = np.random.default_rng(seed)
    kind = {"sensor_faults": 1} if seed % 4 == 0 else {}
    recipe = random_recipe(rng, largest=6, longest_index=LONGEST[seed], feedthrough=bool(seed % 2), **kind)
    # As papers print them: with a free weight an entry of W may hold many values.
    return fault_estimation_filter(build(rng, recipe).plant, weight="paper")


def rounded(seed: int, digits: int) -> dict[str, np.ndarray]:
    return {letter: np.round(designed(seed).gains[letter], digits) for letter in "TNLW"}


def of_gains(seed: int, gains: dict[str, np.ndarray]) -> ObserverDesign:
    """The filter of these gains, with the detectability indexes of the plant."""
    design = designed(seed)
    gamma = design.certificate.claims.get("gamma")
    return design_from_gains(
        design.plant, "fault-estimation-filter", **gains, gamma=gamma, indexes=design.observer.fault_delays
    )


def equalities(design: ObserverDesign, digits: int | None) -> list[Check]:
    return [check for check in verify(design, printed_digits=digits).checks if check.kind == "equality"]


def scattered(part: int) -> list[int]:
    """Return a quarter of the plants, in an order drawn once."""
    return np.random.default_rng(1).permutation(list(LONGEST))[part::4].tolist()


@pytest.mark.long
def test_the_plants_have_short_and_long_indexes(share: Callable[..., Any]) -> None:
    looked_at = [seed for part in range(4) for seed in share(scattered(part), 2, together=True)]
    assert {max(designed(seed).observer.fault_delays) for seed in looked_at} == {1, 2, 3}
    # Feedthrough and sensor faults are among them.
    assert {seed % 4 for seed in looked_at} == {0, 1, 2, 3}


@pytest.mark.one_in(4)
@pytest.mark.parametrize("part", range(4))
def test_every_equality_holds_to_the_printed_digits(part: int, share: Callable[..., Any]) -> None:
    for seed in share(scattered(part), 2):
        # One of the digits for each plant, another for the next.
        for digits in share(np.roll(DIGITS, seed)):
            design = of_gains(seed, rounded(seed, digits))
            assert [check for check in equalities(design, digits) if not check.passed] == []
            assert [check for check in equalities(design, None) if not check.passed] != []


@pytest.mark.parametrize("part", range(4))
def test_without_the_indexes_a_rounded_t_hides_them_and_the_design_says_so(
    part: int, share: Callable[..., Any]
) -> None:
    for seed in share(scattered(part), 2):
        if LONGEST[seed] > 1:
            assert_hidden_indexes_are_told(seed)


def assert_hidden_indexes_are_told(seed: int) -> None:
    design = designed(seed)
    gamma, own = design.certificate.claims.get("gamma"), design.observer.fault_delays
    found = design_from_gains(design.plant, "fault-estimation-filter", **rounded(seed, 4), gamma=gamma)
    lost = found.observer.fault_delays != own
    assert any(f"give indexes={list(own)}" in note for note in found.notes) is lost
    exact = {letter: design.gains[letter] for letter in "TNLW"}
    kept = design_from_gains(design.plant, "fault-estimation-filter", **exact, gamma=gamma)
    assert kept.observer.fault_delays == own
    assert not any("give indexes=" in note for note in kept.notes)


@pytest.mark.one_in(6)
@pytest.mark.parametrize("indexes", [[], [1, 2, 3, 4, 5, 6, 7], [0], "1", [1.0], 1, [99], [True]])
def test_indexes_are_one_whole_number_for_each_fault(indexes: object) -> None:
    plant = DescriptorSystem(None, [[0.5, 1.0], [0.0, 0.4]], C=[[1, 0]], Bf=[[0], [1]], dt=1.0)
    gains = {letter: fault_estimation_filter(plant).gains[letter] for letter in "TNLW"}
    with pytest.raises(SpecError, match="give one whole number from 1 to 2 for each of 'f1'"):
        design_from_gains(plant, "fault-estimation-filter", **gains, indexes=indexes)


def test_an_index_at_which_nothing_shows_is_refused() -> None:
    plant = DescriptorSystem(None, [[0.5, 1.0], [0.0, 0.4]], C=[[1, 0]], Bf=[[0], [1]], dt=1.0)
    gains = {letter: fault_estimation_filter(plant).gains[letter] for letter in "TNLW"}
    with pytest.raises(SpecError, match="the fault 'f1' does not reach the outputs"):
        design_from_gains(plant, "fault-estimation-filter", **gains, indexes=[1])


@pytest.mark.long
def test_an_allowance_relative_to_the_terms_would_refuse_some_of_them() -> None:
    """Roundings of gains are absolute: half a unit in each of nx + ny products may be too little, or far too much."""

    def refused(seed: int) -> bool:
        plant = designed(seed).plant
        relative = 0.5 * 10.0**-PERTURBED_DIGITS * (plant.nx + plant.ny)
        found = equalities(of_gains(seed, rounded(seed, PERTURBED_DIGITS)), PERTURBED_DIGITS)
        return any(check.value > relative for check in found)

    assert any(refused(seed) for seed in LONGEST)


@pytest.mark.long
def test_a_gain_wrong_by_a_hundred_units_fails_in_nearly_all_entries(share: Callable[..., Any]) -> None:
    noticed = total = 0
    for seed in share(scattered(0) + scattered(1) + scattered(2) + scattered(3), 6, together=True):
        rng = np.random.default_rng(100 + seed)
        for letter in "TNLW":
            gains = rounded(seed, PERTURBED_DIGITS)
            entry = tuple(rng.integers(0, size) for size in gains[letter].shape)
            gains[letter][entry] += rng.choice([-100.0, 100.0]) * 10.0**-PERTURBED_DIGITS
            found = equalities(of_gains(seed, gains), PERTURBED_DIGITS)
            noticed += any(not check.passed for check in found)
            total += 1
    # An output in which a fault hardly shows makes little of a wrong entry of L or W.
    assert noticed >= 0.9 * total


def test_the_allowance_is_the_sum_of_the_cofactors() -> None:
    """W Upsilon = 1 of one fault, where the sum can be written down by hand.

    x+ = a x + f, y = x: with T and N = 1 - T, Upsilon = T and the identity is W T - 1, so one row of the gain set may
    miss by half a unit times |T| + |W|, and T E + N C = I by half a unit times two.
    """
    plant = DescriptorSystem([[1.0]], [[0.5]], C=[[1.0]], Bf=[[1.0]], dt=1.0)
    gains = {"T": [[0.3]], "N": [[0.7]], "L": [[0.15]], "W": [[3.333]]}
    report = verify(design_from_gains(plant, "fault-estimation-filter", **gains), printed_digits=3)
    weight, restricted = report["gains: W"], report["gains: T and N"]
    # Sizes of the terms: W T twice (as a term and as a product) and one; T, N twice and one.
    assert weight.value == pytest.approx(1e-4 / (2.0 * 0.9999 + 1.0), rel=1e-9)
    assert weight.bound == pytest.approx(1e-9 + 0.5e-3 * (0.3 + 3.333) / (2.0 * 0.9999 + 1.0), rel=1e-9)
    assert restricted.bound == pytest.approx(1e-9 + 0.5e-3 * 2.0 / 3.0, rel=1e-9)
    assert report.passed
