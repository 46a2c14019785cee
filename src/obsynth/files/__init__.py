"""Files: how they are read, and the one writer of everything that obsynth writes."""
