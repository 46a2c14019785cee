"""Observers that run: a realisation from measured signals to estimates."""

from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.running import Estimates, RunningObserver

__all__ = ["Estimates", "LinearObserver", "RunningObserver"]
