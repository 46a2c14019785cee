"""What a plant is and what can be known about it: structure, zeros, diagnosis, and plants made from plants."""
