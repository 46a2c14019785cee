"""Plants with tolerances that several tests share, and their exact matrices at a point of the box."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import obsynth
from obsynth.specs.loader import load_spec

DESIGNS = Path(__file__).parents[2] / "designs"
DRIVE = {"J1": 0.5, "J2": 1.0, "k": 20.0, "c": 0.2, "b": 0.3}


def drive(tolerance: str = "5 %", *, dt: float = 0.02, **options: Any) -> obsynth.DescriptorSystem:
    """Return two masses on a shaft, sampled, with sensor noise of 0.002 as a bound at three deviations over root 3."""
    constants: Mapping[str, Any] = {name: {"nominal": value, "tolerance": tolerance} for name, value in DRIVE.items()}
    plant = obsynth.uncertain_system(
        {
            "E": [["J1", 0, 0], [0, "J2", 0], [0, 0, 1]],
            "A": [["-c-b", "c", "-k"], ["c", "-c-b", "k"], [1, -1, 0]],
            "B": [[1], [0], [0]], "Bf": [[1], [0], [0]], "Bd": [[0], [1], [0]], "C": [[1, 0, 0], [0, 1, 0]],
            "fault_names": ["motor"], "disturbance_names": ["load"],
        },
        constants, **options,
    )  # fmt: skip
    sampled = obsynth.discretise(plant, dt).plant
    return sampled.replace(Bw=np.zeros((3, 2)), Dw=0.002 * np.eye(2), noise_names=None)


def wang(share: str = "2 %", **options: Any) -> obsynth.DescriptorSystem:
    """Return the plant of Wang et al. 2015 with a tolerance of each entry of A."""
    plant = load_spec(DESIGNS / "wang2015" / "spec.yaml").plant
    return obsynth.uncertain_system(plant.replace(uncertainty=None), tolerance={"A": share}, **options)


def two_masses() -> obsynth.DescriptorSystem:
    """Return two masses in absolute positions, sampled: no constant acts on the position of both."""
    plant = obsynth.uncertain_system(
        {
            "E": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, "m", 0], [0, 0, 0, 1]],
            "A": [[0, 0, 1, 0], [0, 0, 0, 1], ["-k", "k", -1, 0], ["k", "-k", 0, -1]],
            "C": [[1, 0, 0, 0], [0, 1, 0, 0]], "Bf": [[0], [0], [1], [0]],
        },
        {"k": {"nominal": 10.0, "tolerance": "5 %"}, "m": {"nominal": 1.0, "tolerance": "5 %"}},
    )  # fmt: skip
    return obsynth.discretise(plant, 0.05).plant
