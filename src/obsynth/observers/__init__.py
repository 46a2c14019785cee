"""Observers that run: a realisation from measured signals to estimates."""

from obsynth.observers.estimates import Estimates
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.running import RunningObserver

__all__ = ["Estimates", "LinearObserver", "RunningObserver"]
