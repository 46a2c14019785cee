"""Simulated plants: exact recursions of discrete descriptor systems."""

from obsynth.simulation.linear import Trajectory, simulate_plant

__all__ = ["Trajectory", "simulate_plant"]
