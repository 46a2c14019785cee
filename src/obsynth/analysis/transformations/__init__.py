"""Plants made from plants, each with the way back to the original states."""
