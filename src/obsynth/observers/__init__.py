"""Observers that run: a realisation from measured signals to estimates."""

from obsynth.observers.linear import Estimates, LinearObserver, RunningObserver

__all__ = ["Estimates", "LinearObserver", "RunningObserver"]
