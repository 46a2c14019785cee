"""What can be diagnosed on a plant: which faults are detectable and isolable, and with which sensors."""
