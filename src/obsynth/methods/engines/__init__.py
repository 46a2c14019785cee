"""Numerical engines that several methods share."""
