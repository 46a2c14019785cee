"""Matrix inequalities as convex problems, and the solvers that take them."""
