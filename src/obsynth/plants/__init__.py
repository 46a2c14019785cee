"""Plants: what is known about the process, with named signals."""
