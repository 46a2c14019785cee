"""Pictures of data and alarms."""
