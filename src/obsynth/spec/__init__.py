"""Specs: a plant and a method as a document, read strictly and never executed."""

from obsynth.spec.loader import Spec, load_spec

__all__ = ["Spec", "load_spec"]
