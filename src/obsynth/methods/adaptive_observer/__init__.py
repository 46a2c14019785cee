"""The adaptive observer as a method."""
