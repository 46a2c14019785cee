"""The adaptive observer of time-varying descriptor plants."""
