"""Existence decided on the numbers of a plant as written, before anything is rounded."""
