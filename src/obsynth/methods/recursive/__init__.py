"""What the recursive methods share: conditions, synthesis, checks."""
