"""The unknown-input PI observer as a method."""
