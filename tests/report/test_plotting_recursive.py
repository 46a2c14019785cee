"""Pictures of recursive runs: what is drawn is what was estimated."""

from __future__ import annotations

from dataclasses import replace

import matplotlib as mpl
import numpy as np
import pytest
from time_varying_plants import observer_for, record, varying

from obsynth import SpecError
from obsynth.monitoring.thresholds.parameter_decisions import decide
from obsynth.observers.estimates import BAND_WIDTH
from obsynth.plotting import plot_decision, plot_parameters, plot_states

mpl.use("Agg")


@pytest.fixture
def run():
    import matplotlib.pyplot as plt

    plant = varying()
    y, u = record(plant, 30)
    y[10] = np.nan
    observer = observer_for(plant, adapt={})
    yield observer, observer.run(y, u)
    plt.close("all")


def test_parameters_and_their_band(run) -> None:
    _, found = run
    true = np.ones((30, 2))
    panels = plot_parameters(found, parameters=true, dt=0.5, units={"theta1": "N m"})
    assert [axes.get_ylabel() for axes in panels] == ["theta1 (N m)", "theta2"]
    for i, axes in enumerate(panels):
        lines = {line.get_label(): line for line in axes.lines}
        np.testing.assert_array_equal(lines["estimate"].get_ydata(), found.parameters[:, i])
        np.testing.assert_array_equal(lines["estimate"].get_xdata(), 0.5 * np.arange(30))
        np.testing.assert_array_equal(lines["true"].get_ydata(), true[:, i])
        corners = axes.collections[0].get_paths()[0].vertices[:, 1]
        half = BAND_WIDTH * found.parameter_deviations[:, i]
        assert corners.max() == pytest.approx((found.parameters[:, i] + half).max())
        held = np.abs(found.parameters[:, i] - 1.0) <= half
        label = f"95 % band while the model holds, contains the truth in {100 * held.mean():.0f} % of samples"
        assert axes.collections[0].get_label() == label
    with pytest.raises(SpecError, match="true signals have shape"):
        plot_parameters(found, parameters=np.ones((29, 2)))


def test_states_have_no_band_where_they_are_undetermined(run) -> None:
    _, found = run
    assert np.isinf(found.state_deviations[10]).any()
    panels = plot_states(found)
    assert len(panels) == 3
    for axes in panels:
        vertices = np.concatenate([path.vertices for path in axes.collections[0].get_paths()])
        assert np.isfinite(vertices).all()
    assert panels[-1].get_xlabel() == "time (s)"


def test_decisions(run) -> None:
    observer, found = run
    decision = decide(observer, found, statistic="nis", nominal=[9.0, 9.0])
    axes = plot_decision(decision, dt=2.0)
    assert decision.alarm is not None
    labels = [line.get_label() for line in axes.lines]
    assert labels[:2] == ["nis", "threshold"]
    assert f"alarm at {2 * decision.alarm.k} s" in labels
    assert f"onset at {2 * decision.alarm.onset} s" in labels
    quiet = plot_decision(decide(observer, found, nominal=found.parameters[-1]), axes=axes)
    assert quiet is axes


def test_axes_may_be_given_and_states_chosen(run) -> None:
    import matplotlib.pyplot as plt

    _, found = run
    _, grid = plt.subplots(1, 2)
    assert plot_parameters(found, axes=grid) == list(grid)
    (panel,) = plot_states(found, names=["x2"])
    assert panel.get_ylabel() == "x2"
    three = plt.subplots(1, 3)[1]
    with pytest.raises(SpecError, match="3 axes were given"):
        plot_parameters(found, axes=three)


def test_a_wide_band_at_the_start_does_not_hide_what_moves(run) -> None:
    """The prior is 1000 times as wide as the estimates in the end: the picture is of these."""
    _, found = run
    steps = len(found.parameters)
    fading = np.where(np.arange(steps) < 3, 1.0, 1e-6)
    quiet = replace(
        found, faults=np.tile([0.1, 0.2], (steps, 1)) + 0.01 * np.sin(np.arange(steps))[:, None],
        fault_covariances=fading[:, None, None] * np.eye(2),
    )  # fmt: skip
    for panel, centre in zip(plot_parameters(quiet), (0.1, 0.2), strict=True):
        low, high = panel.get_ylim()
        assert centre - 0.03 < low < centre - 0.01
        assert centre + 0.01 < high < centre + 0.03
