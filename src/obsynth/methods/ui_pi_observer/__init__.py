"""The gains of unknown-input PI observers."""
