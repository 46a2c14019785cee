"""The adaptive observer of nonlinear plants as a method."""
