"""The gains of fault-estimation filters: Riccati equations, matrix inequalities, and what is shipped."""
