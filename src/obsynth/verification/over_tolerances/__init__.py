"""Claims that are proved for every plant within the tolerances of its constants.

`error_structure` is the error system over the box, `responses` bounds its sums over all time, `adaptive_bound` the
residual along a record.
"""
