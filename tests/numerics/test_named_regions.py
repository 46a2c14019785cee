"""Regions by name against their inequalities; poles among more than are wanted."""

from __future__ import annotations

import numpy as np
import pytest

from obsynth import SpecError
from obsynth.numerics.regions import NamedRegion
from obsynth.numerics.spectra import mean_miss


@pytest.mark.parametrize("seed", range(20))
def test_a_region_by_name_is_its_inequality(seed: int) -> None:
    rng = np.random.default_rng([46, 55, seed])
    decay = float(rng.choice([0.0, rng.uniform(0.1, 2.0)]))
    radius = None if rng.random() < 0.4 else decay + float(rng.uniform(0.5, 4.0))
    damping = None if rng.random() < 0.4 else float(rng.uniform(0.05, 0.95))
    dt = 0.0 if seed % 4 else 0.3
    region = NamedRegion(decay) if dt else NamedRegion(decay, radius, damping)
    inequality = region.as_inequality(dt)
    for value in rng.uniform(-5.0, 1.5, 300) + 1j * rng.uniform(-4.0, 4.0, 300):
        # Continuous regions without a decay need not say that they are stable, which has a row of its own.
        if value.real < 0.0 or dt:
            assert region.holds([value], dt) == inequality.contains([value])


def test_a_region_of_samples_has_no_radius() -> None:
    with pytest.raises(SpecError, match="give decay alone"):
        NamedRegion.of({"radius": 2.0}, 0.1, path="here")


def test_wanted_poles_are_the_nearest_of_more() -> None:
    values = [-1.0, -2.0, -2.2 + 1j, -2.2 - 1j, -9.0]
    assert mean_miss(values, [-9.0, -2.0], 0.0) == 0.0
    assert mean_miss(values, [-1.1], 0.0) == pytest.approx(0.1 / 1.1)
    assert mean_miss(values, [], 0.0) == 0.0
    assert mean_miss(values[:1], [-1.0, -1.0], 0.0) == np.inf
