"""Alarms as events, and proofs that the data of an alarm cannot be without a fault.

Main names: `AlarmEvent`, `prove_alarm`, `verify_alarm`.
"""
