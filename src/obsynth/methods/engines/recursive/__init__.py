"""Parts that the recursive methods share: synthesis, steady state, and the checks of their covariances."""
