"""Existence conditions, decided on the numbers of a plant as written: exactly, enclosed or in floating point.

`statements` decides; `condition` is what is reported; one module for each paper's conditions: `wang2015`, `filasova`,
`sharepasand`, `recursive`, `moussaali_dae`, `ding2000`, `functional_filter`.
"""
