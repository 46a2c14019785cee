"""The writer under its old path."""

from obsynth.files.outputs import write_atomically

__all__ = ["write_atomically"]
