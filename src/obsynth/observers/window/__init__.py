"""Observers that are finite windows of samples."""
