"""The gains of PD observers."""
