"""Smoothers: estimates of each sample from those after it as well."""
