"""What can be diagnosed on a plant: detected, distinguished, estimated, and with which sensors."""
