"""What can be diagnosed on a plant: detected, told apart, estimated, and with which sensors."""
