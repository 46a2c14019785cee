"""Results: the design, its certificate and report, and the gain set as a file.

Main names: `ObserverDesign`, `Certificate`, `VerificationReport`, `Check`, `load`.
"""
