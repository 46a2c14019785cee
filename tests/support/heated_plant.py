"""A plant with two heated states and a fault, whose thresholds are learned from logs in several tests."""

from __future__ import annotations

import functools

import numpy as np

import obsynth

DT = 0.1


@functools.cache
def heated() -> obsynth.ObserverDesign:
    plant = obsynth.DescriptorSystem(
        E=np.eye(2), A=[[0.95, 0.02], [0.01, 0.96]], B=[[0.1], [0.0]], C=np.eye(2), Bf=[[0.1], [0.0]], dt=DT,
        state_names=["a", "b"], output_names=["ya", "yb"], input_names=["u"], fault_names=["f"],
        sensor_noise={"ya": 0.01, "yb": 0.01},
    )  # fmt: skip
    return obsynth.design(plant, "fault-estimation-filter")
