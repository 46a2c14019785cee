"""Observers that run: a realisation from measured signals to estimates."""

from obsynth.observers.linear.observer import Estimates, LinearObserver, RunningObserver

__all__ = ["Estimates", "LinearObserver", "RunningObserver"]
