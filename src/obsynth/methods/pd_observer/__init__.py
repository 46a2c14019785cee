"""The PD observer as a method."""
