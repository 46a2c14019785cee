"""The commands that read logs: their arguments and what they do."""
