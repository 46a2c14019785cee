"""Many designs, and many runs of designs on data: one list of cases, any executor, one table."""
