"""Plants of index 2 whose unknown inputs or noise are estimated as states: the way back is from all states of the
filter, and the file of a design can be read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import obsynth as ob

PLANT: dict[str, Any] = {
    "E": np.diag([1.0, 1.0, 1.0, 0.0]),
    "A": [[0.5, 0.1, 0, 0], [0, 0.4, 0, 0], [0, 0, 0, 1], [-1, 0.5, 1, 0]],
    "C": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]],
    "dt": 1.0,
}
UNKNOWN: dict[str, Any] = {"Bd": [[0.2], [1], [0], [0]], "Dd": [[0.1], [0], [0]]}
SHARED: dict[str, Any] = {"Bw": [[1.0], [0.2], [0], [0]], "Dw": [[0.1], [0.2], [0.3]]}
FAULT: dict[str, Any] = {"Bf": [[1], [0.5], [0], [0]]}


@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    ("method", "fields", "options"),
    [
        ("descriptor-kalman", UNKNOWN, {"Q": 0.1, "R": 0.1}),
        ("adaptive-observer", UNKNOWN | FAULT, {"Q": 0.1, "R": 0.1}),
        ("descriptor-kalman", SHARED, {}),
    ],
)
def test_the_way_back_is_from_all_states_of_the_filter(
    method: str, fields: dict[str, Any], options: dict[str, Any], tmp_path: Path
) -> None:
    design = ob.design(ob.DescriptorSystem(**PLANT, **fields), method, **options)
    assert design.plant.nx > 2
    loaded = ob.load(design.save(tmp_path / "gains.json"))
    for each in (design, loaded):
        assert each.recovery is not None
        assert each.recovery.from_state.shape == (4, design.plant.nx)
        # Of unknown inputs and noise nothing is taken; x3 = x1 - x2 / 2 is the constraint.
        assert not each.recovery.from_state[:, 2:].any()
        assert np.allclose(each.recovery.from_state[2], [1.0, -0.5] @ each.recovery.from_state[:2])
    assert repr(ob.verify(loaded)) == repr(ob.verify(design))
