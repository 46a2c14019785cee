"""Shared parts of the command line for the verbs of all rooms: arguments, output, files."""
