"""Logs and streams: where rows come from, time stamps, and observers run on them.

Main names: `run_on_data`, `smooth`, `LogRun`, `Signals`, `Stamps`.
"""
