"""The version of obsynth, where every package can see it."""

__version__ = "0.1.0"
