"""The weights of a window as an observer, its delay, and what rounding does to what it computes."""

from __future__ import annotations

import numpy as np

from obsynth.methods.guaranteed_test.problem import WindowProblem, WindowProgrammes
from obsynth.methods.guaranteed_test.tolerant import side_by_side
from obsynth.methods.guaranteed_test.windows import Window
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.window.observer import WindowObserver


def delay_in_samples(window: Window, delay: int) -> int:
    """Return after how many samples at the latest a fault of twice the threshold alarms."""
    test_problem = window.test_problem
    if test_problem.course == "step":
        return test_problem.samples - 1 - test_problem.before + delay
    # The fault must have followed its course over the whole window; one of any time course needs only its own sample.
    return (test_problem.lag if test_problem.course == "any" else test_problem.samples - 1) + delay


def observer_of(window: Window, multipliers: FloatArray, beside: LinearObserver | None = None) -> LinearObserver:
    """Return the weights of multipliers as a linear observer with one register for each sample but the last.

    ``beside``: an observer of the state, which runs along where constants have tolerances.
    """
    on_y, on_u, delay = window.weights(multipliers)
    plant, count = window.plant, len(on_y) - 1
    name = (plant.fault_names[window.test_problem.fault],)
    estimated = window.test_problem.course != "step"
    late = (window.test_problem.lag + delay,) if estimated else ()
    first = np.zeros((1, count))
    first[0, :1] = 1.0
    test = LinearObserver(
        Az=np.eye(count, k=1),
        Bu=on_u[1:],
        By=on_y[1:],
        Cz=first,
        Du=on_u[:1],
        Dy=on_y[:1],
        dt=plant.dt,
        input_names=plant.input_names,
        output_names=plant.output_names,
        state_names=(),
        fault_names=name if estimated else (),
        residual_names=() if estimated else name,
        state_delays=(),
        fault_delays=late,
        constant=np.array([window.constant(multipliers)]),
    )
    return test if beside is None else side_by_side(test, beside)


def observer_of_rows(
    problem: WindowProblem, programmes: WindowProgrammes, tested: np.ndarray, multipliers: list[FloatArray]
) -> WindowObserver:
    """Return the weights of all rows; ``tested``: which programmes have a test."""
    plant, test_problem = problem.plant, programmes.windows[0].test_problem
    weights = []
    for window, values, has_test in zip(programmes.windows, multipliers, tested, strict=True):
        on_y, on_u, _ = window.weights(values)
        row_weights = np.hstack([on_u, on_y]).ravel()
        weights.append(row_weights if has_test else np.zeros_like(row_weights))
    constants = [
        window.constant(values) if has_test else 0.0
        for window, values, has_test in zip(programmes.windows, multipliers, tested, strict=True)
    ]
    estimated = test_problem.course != "step"
    name = (problem.fault,)
    return WindowObserver(
        weights=np.array(weights),
        programmes=np.where(tested[programmes.of_row], programmes.of_row, -1).astype(np.float64),
        samples=test_problem.samples,
        horizon=problem.horizon,
        dt=plant.dt,
        input_names=plant.input_names,
        output_names=plant.output_names,
        fault_names=name if estimated else (),
        residual_names=() if estimated else name,
        fault_delays=(test_problem.lag,) if estimated else (),
        constants=np.array(constants),
    )


def rounding_of(window: Window, multipliers: FloatArray, radius: FloatArray) -> FloatArray:
    """Return what shipped weights may err for known signals of at most one ``(nu + ny,)``; the threshold lacks it."""
    return window.known_sizes(window.errors(multipliers, radius))
