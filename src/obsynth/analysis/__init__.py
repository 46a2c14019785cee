"""What can be known about a plant before any design.

Structure, invariant zeros, existence of the papers' observers (`existence`), and which faults can be detected and
isolated (`diagnosis`). No gains are computed here.

Main names: `analyse_structure`, `identifiability`, `diagnose`, `Evaluator`, `Condition`.
"""
