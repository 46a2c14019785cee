"""The optimal filter as a method."""
