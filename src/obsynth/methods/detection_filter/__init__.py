"""The detection filter as a method."""
