"""Simulated plants: scenarios and signals, plants in time, and a design on a scenario.

Main names: `Scenario`, `simulate`, `simulate_dae`, `simulate_time_varying`, `Step`, `Drift`, `Stuck`.
"""
