"""The functional filter as a method."""
