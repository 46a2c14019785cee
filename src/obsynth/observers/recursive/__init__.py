"""Recursive observers of time-varying plants: `observer` with its `settings`, `recursion` and `compiled_run`; `options`
makes one; the gains ahead of data (`gain_schedule`, `steady_observer`, `steady_filter`).
"""
