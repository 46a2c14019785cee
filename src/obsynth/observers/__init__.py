"""Observers that run: a realisation from measured signals to estimates, sample by sample.

An observer is ``init() -> state`` and ``step(state, y, u) -> (state, estimates)``: `linear`, `window`, `recursive` and
`nonlinear`; beside them smoothing, missing and delayed samples, outliers. Thresholds stand in `monitoring`.

Main names: `LinearObserver`, `WindowObserver`, `RecursiveObserver`, `DAEObserver`, `Estimates`.
"""
