"""Mathematics on arrays, without plants or names of signals.

Ranks with their gap, matrix pencils, Riccati and Lyapunov equations, norms, spectra, regions of the complex plane,
pole placement, sparse structure; checks of arguments. What needs a guarantee on its rounding stands in `proofs`.

Main names: `decide_rank`, `PencilPoints`, `hinf_norm`, `discrete_solution`, `LMIRegion`, `arguments_checked`.
"""
