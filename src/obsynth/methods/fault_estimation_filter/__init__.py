"""The fault-estimation filter as a method."""
