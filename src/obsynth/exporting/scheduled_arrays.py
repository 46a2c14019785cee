"""Scheduled observers as arrays for numpy and MATLAB: a page for each vertex, and the data of the weights."""

from __future__ import annotations

from typing import Any

import numpy as np

from obsynth.results.design import ObserverDesign, unverified_mark
from obsynth.results.gain_set_writing import gain_set_digest


def scheduled_arrays(design: ObserverDesign) -> dict[str, Any]:
    """Return the observer of a design over a region by name; the last axis of A, B and effectiveness is the vertex."""
    plant, observer = design.scheduled
    held, point = observer.scheduling, dict(plant.operating_point)
    known = observer.input_names[: observer.inputs]
    mark = unverified_mark(design.report)
    rates = [np.inf if rate is None else rate for rate in held.rates]
    return {
        "A": np.moveaxis(observer.Az, 0, -1),
        "B": np.moveaxis(np.concatenate([observer.Bu, observer.By], axis=2), 0, -1),
        "C": observer.Cz,
        "D": np.hstack([observer.Du, observer.Dy]),
        "effectiveness": np.moveaxis(observer.effectiveness, 0, -1),
        **({} if observer.correction is None else {"correction": np.moveaxis(observer.correction, 0, -1)}),
        "x0": np.zeros((observer.order, 1)),
        "Ts": observer.dt,
        "parameters": list(held.names),
        "range": np.column_stack([held.low, held.high]),
        "rates": np.array(rates, dtype=np.float64),
        "functions": list(held.functions),
        "bounds": np.zeros((0, 2)) if held.gives_weights else held.bounds,
        "corners": held.corners,
        "forgetting": float(observer.forgetting),
        "input_point": np.array([point.get(name, 0.0) for name in (*known, *observer.output_names)]),
        "output_point": np.array([point.get(name, 0.0) for name in (*observer.state_names, *observer.fault_names)]),
        "delays": np.array([*observer.state_delays, *observer.fault_delays], dtype=np.float64),
        "input_names": [*known, *observer.output_names],
        "output_names": list(observer.row_names),
        "name": design.name,
        "method": design.method,
        "sha256": gain_set_digest(design),
        **({"unverified": mark} if mark else {}),
    }
