"""A nonlinear plant of index above one is refused by that name over a region, and the way out of the message works."""

from __future__ import annotations

import pytest

import obsynth


def test_a_rod_in_coordinates_of_its_end_is_refused_and_by_its_angle_designed() -> None:
    rod = obsynth.DAEModel(
        {
            "px": "der(x) = vx", "py": "der(y) = vy", "vx": "der(vx) = -force*x", "vy": "der(vy) = -force*y - 9.81",
            "rod": "0 = x**2 + y**2 - 1",
        },
        {"mx": "x", "my": "y"},
        states={"x": 0.6, "y": -0.8, "vx": 0.0, "vy": 0.0, "force": 7.8},
    )  # fmt: skip
    region = {"x": (-0.7, 0.7), "y": (-1.0, -0.6), "vx": (-2, 2), "vy": (-2, 2), "force": (5, 15)}
    for options in ({"goal": "decay"}, {"noise": {"mx": 0.01, "my": 0.01}}):
        with pytest.raises(obsynth.PreconditionError, match=r"index 3 .*'rod'.*'force'.*the angle of a rod") as refused:
            obsynth.region_observer(rod, region=region, sample_time=0.01, **options)
        assert refused.value.condition == "index"
    angle = obsynth.DAEModel(
        {"angle": "der(phi) = w", "speed": "der(w) = -9.81*sin(phi) - 0.1*w"},
        {"encoder": "phi"},
        states={"phi": 0.6, "w": 0.0},
    )
    own = obsynth.region_observer(angle, region={"phi": (-0.7, 0.7), "w": (-3, 3)}, sample_time=0.01, goal="decay")
    assert own.report.passed
