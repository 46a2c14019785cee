"""Side by side: which method, and which sensors."""
