"""The command line: ``design`` and ``obsynth``."""
