"""The commands that run scenarios and sweeps: their arguments and what they do."""
