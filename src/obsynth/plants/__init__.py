"""Plants: what is known about the process, with named signals."""

from obsynth.plants.descriptor import DescriptorSystem

__all__ = ["DescriptorSystem"]
