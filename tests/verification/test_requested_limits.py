"""Numbers that options ask for: multiple poles one by one, modes that are fixed where the plant has them, no text."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import pytest

import obsynth
from obsynth.methods.registry import method_class
from obsynth.numerics.spectra import mean_miss, multiple_miss
from obsynth.results.checks import Check
from obsynth.verification.requested_limits import POLE_TOLERANCE, requested_rows

PLANT = obsynth.DescriptorSystem(A=[[-3.0, 1.0], [1.0, -2.0]], C=[[1.0, 0.0]], dt=0.0)


@cache
def design() -> obsynth.ObserverDesign:
    return obsynth.ui_pi_observer(PLANT, decay=4.0)


def with_poles(poles: Sequence[complex], options: dict[str, Any]) -> obsynth.ObserverDesign:
    """Return a design whose observer has these poles, as blocks of one and two states."""
    matrix, place = np.zeros((len(poles), len(poles))), 0
    for pole in poles:
        if pole.imag > 0.0:
            matrix[place : place + 2, place : place + 2] = [[pole.real, pole.imag], [-pole.imag, pole.real]]
            place += 2
        elif not pole.imag:
            matrix[place, place] = pole.real
            place += 1
    observer = design().observer
    count = len(poles)
    observer = dataclasses.replace(
        observer, Az=matrix, By=np.zeros((count, 1)), Bu=np.zeros((count, 0)), Cz=np.zeros((len(observer.Cz), count))
    )
    return dataclasses.replace(design(), observer=observer, options=options)


def rows_of(of: obsynth.ObserverDesign, fixed: Sequence[complex] = ()) -> list[Check]:
    placed = frozenset({"decay", "region", "poles"})
    return list(requested_rows(of, {}, placed, lambda _: fixed))


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e5])
@pytest.mark.parametrize(
    ("real", "wanted"),
    [
        ((-2.0, -4.0, -7.0), (-3.0, -3.0, -7.0)),
        ((-3.1, -2.9, -7.0), (-3.0, -3.0, -7.0)),
        ((-3.0 + 1j, -3.0 - 1j, -7.0), (-3.0, -3.0, -7.0)),
        ((-1.0, -3.0, -5.0), (-3.0, -3.0, -3.0)),
        ((-1 + 2j, -1 - 2j, -3 + 2j, -3 - 2j), (-2 + 2j, -2 - 2j, -2 + 2j, -2 - 2j)),
    ],
)
def test_equal_poles_are_compared_one_by_one(unit: float, real: Sequence[complex], wanted: Sequence[complex]) -> None:
    listed = [[unit * complex(pole).real, unit * complex(pole).imag] for pole in wanted]
    (row,) = rows_of(with_poles([unit * complex(pole) for pole in real], {"poles": listed}))
    assert row.name == "requested poles"
    assert not row.passed
    # The mean alone has nothing against them.
    assert mean_miss(np.array(real), np.array(wanted), 0.0) < POLE_TOLERANCE


@pytest.mark.parametrize("dt", [0.0, 0.1])
@pytest.mark.parametrize("count", [2, 3, 5, 8])
def test_what_rounding_does_to_a_multiple_pole_is_no_miss(count: int, dt: float) -> None:
    """Of a chain of m equal poles whose corner is moved by a share: the poles are on a circle of its m-th root."""
    for seed in range(4):
        rng = np.random.default_rng([count, seed])
        at = rng.uniform(-5.0, -1.0) if dt == 0.0 else rng.uniform(-0.5, 0.5)
        size = abs(at) if dt == 0.0 else 1.0
        chain = at * np.eye(count) + size * np.eye(count, k=1)
        turn = np.linalg.qr(rng.normal(size=(count, count)))[0]
        missed = multiple_miss(np.linalg.eigvals(turn @ chain @ turn.T), [at] * count, dt)
        assert missed < 1e-2 * POLE_TOLERANCE
        for share, holds in ((0.5 * POLE_TOLERANCE, True), (2.0 * POLE_TOLERANCE, False)):
            chain[-1, 0] = share * size
            assert (multiple_miss(np.linalg.eigvals(chain), [at] * count, dt) <= POLE_TOLERANCE) == holds


@pytest.mark.parametrize("name", ["decay", "region"])
def test_a_mode_counts_as_fixed_only_where_the_plant_has_it(name: str) -> None:
    options: dict[str, Any] = {"decay": {"decay": 4.0}, "region": {"region": {"decay": 4.0}}}[name]
    slow = with_poles([-1.0 + 0j, -5.0 + 0j, -6.0 + 0j], options)
    (row,) = rows_of(slow, [-1.0 * (1.0 + 0.1 * POLE_TOLERANCE)])
    assert row.passed
    for far in (-1.001, -2.0, 1.0, -1.0 + 0.01j, 1e3, -1e-3):
        (row,) = rows_of(slow, [far])
        assert not row.passed, far
    # Two that are fixed together are scattered by rounding, as far as a root of what moves their mean.
    scattered = with_poles([-1.0 + 1e-4j, -1.0 - 1e-4j, -6.0 + 0j], options)
    (row,) = rows_of(scattered, [-1.0, -1.0])
    assert row.passed
    (row,) = rows_of(scattered, [-1.0])
    assert not row.passed


NO_NUMBERS = ["3.0", "3 1/s", "x", float("nan"), float("inf"), -float("inf"), [], [3.0], [None], True, False, {}]


@pytest.mark.parametrize("value", NO_NUMBERS, ids=repr)
def test_a_limit_that_is_no_number_fails(value: Any) -> None:
    """Of every option that bounds a claim of some method, and of those on poles: what is no number holds nowhere."""
    assert not all(row.passed for row in rows_of(with_poles([-5.0 + 0j], {"decay": value})))
    # No poles, of one filter or of one of several, are no request.
    entries = [[value], [[value, 1.0]], [[1.0, value]], *([] if value == [] else [value, [value]])]
    for poles in entries if value != [] else entries[1:]:
        assert not all(row.passed for row in rows_of(with_poles([-5.0 + 0j], {"poles": poles})))
    matrices = ({"L": L, "M": M} for L, M in ((value, [[1.0]]), ([[value]], [[1.0]]), ([[1.0]], [[value]])))
    named = ({"decay": value}, {"damping": value}, {"half_plane": value}, [{"disk": [0.0, value]}])
    for region in (value, *named, *matrices):
        if region == {"half_plane": [3.0]}:
            continue  # a list of its one number
        assert not all(row.passed for row in rows_of(with_poles([-5.0 + 0j], {"region": region})))
    limits = method_class("pd-observer").requested_limits(design())
    claims = {claim: 1.0 for bounds in limits.values() for claim, _ in bounds}
    for name, bounds in limits.items():
        for stored in [value, [value] * len(bounds), [1.0, value][: len(bounds)]]:
            if stored == 1.0 or stored == [1.0]:
                continue
            of = dataclasses.replace(design(), options={name: stored})
            of = dataclasses.replace(of, certificate=dataclasses.replace(of.certificate, claims=claims))
            (row,) = requested_rows(of, limits, frozenset(), lambda _: ())
            assert not row.passed, (name, stored)


def test_poles_are_no_request_of_an_observer_that_changes_with_the_scheduling() -> None:
    plant = obsynth.PolytopicSystem(
        plant={"A": [["0.5 + 0.3 * v", 0.1], [0.0, 0.4]], "C": np.eye(2), "Bf": [[1.0], [0.0]], "dt": 1.0},
        scheduling={"v": [0.0, 1.0]},
    )
    over_region = obsynth.fault_estimation_filter(plant)
    assert obsynth.verify(over_region).passed
    for name, value in (("region", [{"disk": [0.0, 0.1]}]), ("region", "x")):
        edited = dataclasses.replace(over_region, options={**over_region.options, name: value})
        assert not obsynth.verify(edited).passed


def test_the_margin_of_a_condition_is_its_distance_from_its_bound() -> None:
    rows = [row for row in obsynth.verify(design()).checks if row.kind == "condition" and np.isfinite(row.bound)]
    assert any(row.value and row.bound for row in rows)
    assert all(row.margin == abs(row.bound - row.value) for row in rows)
