"""Pictures of designs and simulations, readable without colour; public as ``obsynth.plotting``."""
