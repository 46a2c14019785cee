"""Plants made from plants, each with the way back to the original states.

Main names: `eliminate_algebraic_states`, `discretise`, `linearise`, `with_noise`, `Transformation`.
"""
