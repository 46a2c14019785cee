"""The fault-estimation filter of least gain over all causal filters, for a delay or a reference model."""
