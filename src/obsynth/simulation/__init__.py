"""Simulated plants: exact recursions of discrete descriptor systems."""

from obsynth.simulation.linear import simulate_plant
from obsynth.simulation.scenario import Trajectory

__all__ = ["Trajectory", "simulate_plant"]
