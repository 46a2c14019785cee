"""Tests of a fault on a few samples: the least threshold without false alarms, and the proof that none is smaller."""
