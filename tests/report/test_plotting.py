"""Pictures: what is drawn where, with which names; whether they are beautiful is for eyes."""

from __future__ import annotations

import itertools
import subprocess
import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest

mpl.use("Agg")

import matplotlib.pyplot as plt

import obsynth
from obsynth.errors import SpecError
from obsynth.observers.estimates import Estimates
from obsynth.plotting import (
    estimate_gains,
    plot_faults,
    plot_gains,
    plot_poles,
    plot_residuals,
    plot_states,
    plot_trade_off,
)
from obsynth.report.plots.spectra import region_asked_for
from obsynth.specs.loader import load_spec

DESIGNS = Path(__file__).parents[2] / "designs"
STEPS = 30
FAULTS = np.column_stack([np.arange(STEPS) >= 10, np.sin(0.3 * np.arange(STEPS))]).astype(float)


@pytest.fixture(autouse=True)
def _closed_figures():
    yield
    plt.close("all")


def made_estimates(*, residuals: np.ndarray | None = None, delays: tuple[int, ...] = (1, 3)) -> Estimates:
    """Return perfect estimates of `FAULTS` with the given delays."""
    estimated = np.zeros_like(FAULTS)
    for i, delay in enumerate(delays):
        estimated[delay:, i] = FAULTS[: STEPS - delay, i]
    return Estimates(
        np.zeros((STEPS, 1)), estimated, estimated if residuals is None else residuals, ("x",), ("valve", "pump"),
        ("valve", "pump"), (2,), delays,
    )  # fmt: skip


def lines_of(axes) -> dict[str, object]:
    return {line.get_label(): line for line in axes.get_lines()}


def legend_of(axes) -> list[str]:
    return [text.get_text() for text in axes.get_legend().get_texts()]


def test_each_fault_is_delayed_by_its_own_index() -> None:
    panels = plot_faults(made_estimates(), faults=FAULTS, dt=0.5)
    assert len(panels) == 2
    for i, (axes, label) in enumerate(zip(panels, ("1 sample", "3 samples"), strict=True)):
        lines = lines_of(axes)
        assert legend_of(axes) == [f"fault, delayed by {label}", "estimate"]
        true, estimate = lines[f"fault, delayed by {label}"], lines["estimate"]
        delay = (1, 3)[i]
        # A true value at sample k stands at the time of sample k + delay, where the estimate has it too.
        np.testing.assert_allclose(true.get_xdata(), 0.5 * np.arange(delay, STEPS))
        np.testing.assert_array_equal(true.get_ydata(), FAULTS[: STEPS - delay, i])
        np.testing.assert_allclose(estimate.get_xdata(), 0.5 * np.arange(STEPS))
        np.testing.assert_array_equal(estimate.get_ydata()[delay:], true.get_ydata())


def test_axes_say_names_units_and_seconds() -> None:
    panels = plot_faults(made_estimates(), faults=FAULTS, units={"valve": "%"})
    assert [axes.get_ylabel() for axes in panels] == ["valve (%)", "pump"]
    assert [axes.get_xlabel() for axes in panels] == ["", "time (s)"]


@pytest.mark.one_in(4)
@pytest.mark.parametrize(("dt", "unit"), [(1.0, "s"), (30.0, "min"), (600.0, "h"), (14400.0, "d")])
def test_long_times_are_told_in_their_unit(dt: float, unit: str) -> None:
    """Forty samples: their last one is told by a tick at its place, in the unit of the axis."""
    seconds = {"s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}[unit]
    panel = plot_faults(made_estimates(), faults=FAULTS, dt=dt)[-1]
    assert panel.get_xlabel() == f"time ({unit})"
    panel.figure.canvas.draw()
    ticks = [(place, text.get_text()) for place, text in zip(panel.get_xticks(), panel.get_xticklabels(), strict=True)]
    assert len(ticks) > 3
    for place, text in ticks:
        assert float(text.replace("\N{MINUS SIGN}", "-")) == pytest.approx(place / seconds, abs=1e-12)


def test_lines_differ_by_more_than_colour() -> None:
    true, estimate = plot_faults(made_estimates(), faults=FAULTS)[0].get_lines()
    # The estimate is thinner, and drawn on the truth.
    assert true.get_linewidth() > 2 * estimate.get_linewidth()
    assert true.get_zorder() < estimate.get_zorder()
    curves = {"low": 0.1, "middle": 0.2, "high": np.full(STEPS, 5.0)}
    axes = plot_residuals(made_estimates(), threshold=curves)
    styles = {lines_of(axes)[name].get_linestyle() for name in ("norm of the residual", *curves)}
    assert len(styles) == 4
    # The residual stays below 5: two crossings.
    markers = {line.get_marker() for line in axes.get_lines()} - {"None"}
    assert len(markers) == 2


def test_faults_may_be_unknown_and_axes_given() -> None:
    figure, grid = plt.subplots(1, 2)
    panels = plot_faults(made_estimates(), axes=grid)
    assert panels == list(grid)
    assert [axes.figure for axes in panels] == [figure, figure]
    assert [legend_of(axes) for axes in panels] == [["estimate"], ["estimate"]]
    assert len(plt.get_fignums()) == 1


def test_a_truth_that_is_known_in_part_has_gaps_and_equal_legends_are_one() -> None:
    names, steps = ("leak", "drift", "bias"), 20
    zeros, truth = np.zeros((steps, 3)), np.ones((steps, 3))
    truth[5:9, 0], truth[:, 2] = np.nan, np.nan
    run = Estimates(zeros[:, :1], zeros, zeros, ("x",), names, names, (0,), (0, 0, 0))
    panels = plot_faults(run, faults=truth)
    drawn = [panel.get_lines() for panel in panels]
    assert [len(lines) for lines in drawn] == [2, 2, 1]
    np.testing.assert_array_equal(drawn[0][0].get_ydata(), truth[:, 0])
    assert [panel.get_legend() is None for panel in panels] == [False, True, False]
    assert legend_of(panels[2]) == ["estimate"]


def test_the_norm_of_the_residual_and_the_first_crossing() -> None:
    residuals = np.tile([0.3, 0.4], (STEPS, 1))
    residuals[12:] *= 4.0
    residuals[20] = 0.0
    axes = plot_residuals(made_estimates(residuals=residuals), threshold=1.0, dt=0.02)
    lines = lines_of(axes)
    expected = np.where(np.arange(STEPS) < 12, 0.5, 2.0)
    expected[20] = np.nan
    np.testing.assert_allclose(lines["norm of the residual"].get_ydata(), expected)
    np.testing.assert_allclose(lines["threshold"].get_ydata(), np.ones(STEPS))
    mark = lines["first above it at k = 12 (0.24 s)"]
    np.testing.assert_allclose([*mark.get_xdata(), *mark.get_ydata()], [0.24, 2.0])
    assert (axes.get_xlabel(), axes.get_ylabel(), axes.get_yscale()) == (
        "time (s)", "norm of the residual\n(units of the outputs)", "log",
    )  # fmt: skip


def test_a_threshold_that_only_touches_is_not_crossed() -> None:
    residuals = np.tile([3.0, 4.0], (STEPS, 1))
    touching = plot_residuals(made_estimates(residuals=residuals), threshold=5.0)
    assert legend_of(touching) == ["norm of the residual", "threshold"]
    curve = np.full(STEPS, 5.0)
    curve[7] = np.nextafter(5.0, 0.0)
    crossed = plot_residuals(made_estimates(residuals=residuals), threshold=curve)
    assert legend_of(crossed)[-1] == "first above it at k = 7 (7 s)"


def test_several_thresholds_keep_their_names_and_crossings() -> None:
    residuals = np.outer(np.arange(STEPS), [0.6, 0.8])
    axes = plot_residuals(made_estimates(residuals=residuals), threshold={"a": 2.5, "b": np.full(STEPS, 4.0)})
    assert legend_of(axes) == [
        "norm of the residual", "a", "first above it at k = 3 (3 s)", "b", "first above it at k = 5 (5 s)",
    ]  # fmt: skip


def test_residuals_that_are_all_zero_are_drawn_too() -> None:
    axes = plot_residuals(made_estimates(residuals=np.zeros((STEPS, 2))), threshold=0.0)
    np.testing.assert_array_equal(lines_of(axes)["norm of the residual"].get_ydata(), np.zeros(STEPS))
    assert legend_of(axes) == ["norm of the residual", "threshold"]
    axes.figure.canvas.draw()


def test_poles_zeros_and_the_unit_circle() -> None:
    design = obsynth.fault_estimation_filter(load_spec(DESIGNS / "wang2015_printed_psi" / "spec.yaml").plant)
    axes = plot_poles(design)
    lines = lines_of(axes)
    poles = lines["observer eigenvalues (4)"]
    drawn = np.array(poles.get_xdata()) + 1j * np.array(poles.get_ydata())
    np.testing.assert_allclose(np.sort(np.abs(drawn)), np.sort(np.abs(np.linalg.eigvals(design.observer.Az))))
    # The audit: for F = [a1, b2] there is one finite invariant zero, at the origin.
    zeros = lines["fault zeros (1)"]
    np.testing.assert_allclose([*zeros.get_xdata(), *zeros.get_ydata()], [0.0, 0.0], atol=1e-9)
    circle = lines["unit circle"]
    np.testing.assert_allclose(np.hypot(circle.get_xdata(), circle.get_ydata()), 1.0)
    assert axes.get_aspect() == 1.0
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("real part", "imaginary part")


@pytest.fixture(scope="module")
def slow() -> obsynth.ObserverDesign:
    """A continuous design with a region that was asked for."""
    spec = load_spec(DESIGNS / "sharepasand" / "spec.yaml")
    return obsynth.ui_pi_observer(spec.plant, fault_model="step", region={"decay": 1.0, "radius": 8.0, "damping": 0.5})


def test_continuous_poles_have_an_axis_and_no_circle(slow) -> None:
    lines = lines_of(axes := plot_poles(slow))
    assert "unit circle" not in lines
    np.testing.assert_array_equal(lines["limit of stability"].get_xdata(), [0.0, 0.0])
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("real part (1/s)", "imaginary part (1/s)")
    poles = next(line for name, line in lines.items() if name.startswith("observer eigenvalues"))
    assert max(poles.get_xdata()) < 0.0


def test_real_poles_leave_room_for_a_damping_grid_that_can_be_read(slow) -> None:
    _, observer = slow.linear
    real = observer.Az * 0.0 - np.diag(np.linspace(2.0, 200.0, len(observer.Az)))
    axes = plot_poles(slow.replace(observer=type(observer)(**{**observer.as_dict(), "Az": real})))
    bottom, top = axes.get_ylim()
    assert top == -bottom > 50.0
    labels = {text.get_text(): text for text in axes.texts}
    assert {"0.2", "0.4", "0.6", "0.8"} <= labels.keys()
    boxes = [labels[name].get_window_extent() for name in ("0.8", "0.6", "0.4", "0.2")]
    assert not any(left.overlaps(right) for left, right in itertools.pairwise(boxes))


def test_ticks_of_wide_eigenvalues_do_not_overlap_near_zero(slow) -> None:
    _, observer = slow.linear
    wide = observer.Az * 0.0 - np.diag(np.linspace(1.0, 5.0, len(observer.Az)))
    for first, imaginary in ((0, 0.09), (2, 9.0)):
        wide[first, first + 1], wide[first + 1, first] = imaginary, -imaginary
        wide[first + 1, first + 1] = wide[first, first]
    axes = plot_poles(slow.replace(observer=type(observer)(**{**observer.as_dict(), "Az": wide})))
    axes.figure.canvas.draw()
    low, high = axes.get_ylim()
    ticks = [text for text in axes.get_yticklabels() if low <= text.get_position()[1] <= high]
    boxes = [text.get_window_extent() for text in ticks if text.get_text()]
    assert len(boxes) >= 3
    assert not any(one.overlaps(other) for one, other in itertools.combinations(boxes, 2))


def test_labels_of_a_damping_grid_that_would_hide_each_other_are_left_out(slow) -> None:
    _, observer = slow.linear
    flat = observer.Az * 0.0 - np.diag(np.linspace(400.0, 2000.0, len(observer.Az)))
    flat[0, 1], flat[1, 0] = 3.0, -3.0
    flat[1, 1] = flat[0, 0]
    axes = plot_poles(slow.replace(observer=type(observer)(**{**observer.as_dict(), "Az": flat})))
    boxes = [text.get_window_extent() for text in axes.texts if text.get_text() in ("0.2", "0.4", "0.6", "0.8")]
    assert len(boxes) < 4
    assert not any(one.overlaps(other) for one, other in itertools.combinations(boxes, 2))


def test_the_region_asked_for_is_shaded_where_it_is(slow) -> None:
    axes = plot_poles(slow)
    assert "region asked for" in legend_of(axes)
    (shade,) = [item for item in axes.collections if item.get_zorder() == -1]
    corners = np.concatenate([path.vertices for path in shade.get_paths()])
    left, right = axes.get_xlim()
    assert corners[:, 0].min() == pytest.approx(max(left, -8.0), abs=0.02 * (right - left))
    assert corners[:, 0].max() == pytest.approx(-1.0, abs=0.02 * (right - left))
    parts = region_asked_for(slow)
    # Slower than the decay, faster than the radius, less damped than the cone; and one that is none of it.
    points = np.array([-0.9, -8.1, -2 + 4j, -2 + 3j])
    assert list(np.max([part(points) for part in parts], axis=0) < 0.0) == [False, False, False, True]
    unasked = obsynth.fault_estimation_filter(load_spec(DESIGNS / "wang2015" / "spec.yaml").plant)
    assert "region asked for" not in legend_of(plot_poles(unasked))


def test_a_disk_that_was_proved_is_a_region() -> None:
    spec = load_spec(DESIGNS / "filasova" / "spec.yaml")
    design = obsynth.pd_observer(spec.plant)
    claims = {**design.certificate.claims, "disk_centre": 6.0, "disk_radius": 5.0}
    disk = design.replace(certificate=obsynth.Certificate(design.certificate.matrices, claims))
    axes = plot_poles(disk)
    (shade,) = [item for item in axes.collections if item.get_zorder() == -1]
    corners = np.concatenate([path.vertices for path in shade.get_paths()])
    assert (np.hypot(corners[:, 0] + 6.0, corners[:, 1]) < 5.0 * 1.02).all()


def test_widely_spread_poles_are_logarithmic(slow) -> None:
    _, observer = slow.linear
    fast = observer.Az.copy()
    fast[0, 0] -= 5000.0
    stretched = slow.replace(observer=type(observer)(**{**observer.as_dict(), "Az": fast}))
    assert plot_poles(stretched).get_xscale() == "symlog"
    assert plot_poles(slow).get_xscale() == "linear"


def test_states_of_a_linear_observer_lag_as_it_does() -> None:
    estimates = made_estimates()
    (panel,) = plot_states(estimates, states=np.arange(STEPS, dtype=float), dt=0.5, units={"x": "m"})
    true = lines_of(panel)["true, delayed by 2 samples"]
    np.testing.assert_allclose(true.get_xdata(), 0.5 * np.arange(2, STEPS))
    np.testing.assert_array_equal(true.get_ydata(), np.arange(STEPS - 2))
    assert panel.get_ylabel() == "x (m)"
    assert plot_states(estimates, names=[]) == []
    with pytest.raises(SpecError, match="'y'"):
        plot_states(estimates, names=["y"])


def test_gains_to_the_states_are_errors_and_peak_at_their_norm() -> None:
    design = obsynth.fault_estimation_filter(load_spec(DESIGNS / "wang2015" / "spec.yaml").plant)
    found = estimate_gains(design, to="states")
    wanted = design.report["disturbance in the state estimate"].value
    assert wanted * (1.0 - 1e-3) <= found.gains["disturbances"].max() <= wanted * (1.0 + 1e-9)
    assert not found.gains["faults"].any()
    gamma = design.certificate.claims["gamma"]
    (bound,) = [line for label, line in lines_of(plot_gains(design)).items() if label.startswith("proved for dist")]
    assert set(bound.get_ydata()) == {gamma}
    assert estimate_gains(design).gains["disturbances"].max() <= gamma
    with pytest.raises(SpecError, match="faults, states, residuals"):
        plot_gains(design, to="moon")


def test_a_short_axis_of_frequencies_has_plain_numbers_that_do_not_touch() -> None:
    plant = load_spec(DESIGNS / "wang2015" / "spec.yaml").plant
    panel = plot_gains(obsynth.fault_estimation_filter(plant, weight="paper"))
    panel.get_figure().draw_without_rendering()
    low, high = panel.get_xlim()
    for minor in (False, True):
        ticks = zip(panel.get_xticks(minor=minor), panel.get_xticklabels(minor=minor), strict=True)
        texts = [text.get_text() for place, text in ticks if low <= place <= high and text.get_text()]
        assert texts == ([] if minor else ["0.2", "0.5", "1", "2"])


def test_a_factor_of_an_axis_stands_beside_no_legend() -> None:
    (panel,) = plot_states(made_estimates(), states=1e-6 * np.arange(STEPS), dt=1.0)
    panel.get_figure().draw_without_rendering()
    factor = panel.yaxis.get_offset_text()
    assert "1e" in factor.get_text()
    assert not factor.get_window_extent().overlaps(panel.get_legend().get_window_extent())


def test_a_trade_off_is_sorted_and_says_what_is_missing(slow) -> None:
    spec = load_spec(DESIGNS / "sharepasand" / "spec.yaml")
    designs = [obsynth.ui_pi_observer(spec.plant, fault_model="step", region={"decay": d}) for d in (4.0, 0.5, 1.0)]
    (panel,) = plot_trade_off(designs, "decay", "noise_amplification")
    (line,) = panel.get_lines()
    assert list(line.get_xdata()) == sorted(design.certificate.claims["decay"] for design in designs)
    assert list(line.get_ydata()) == sorted(design.certificate.claims["noise_amplification"] for design in designs)
    assert (panel.get_xlabel(), panel.get_ylabel(), panel.get_yscale()) == ("decay (1/s)", "noise amplification", "log")
    with pytest.raises(SpecError, match="its claims are decay, noise_amplification"):
        plot_trade_off(designs, "decay", "gamma")
    with pytest.raises(SpecError, match="at least one"):
        plot_trade_off([], "decay", "gamma")


@pytest.mark.long
def test_legends_hide_nothing() -> None:
    """They stand above their panels."""
    estimates = made_estimates()
    for panel in (*plot_faults(estimates, faults=FAULTS), plot_residuals(estimates, threshold=1.0)):
        panel.figure.canvas.draw()
        assert panel.get_legend().get_window_extent().y0 >= panel.get_window_extent().y1 - 1.0


def test_long_legends_leave_their_panels_as_they_are() -> None:
    curves = {"a threshold with quite a long name and a remark": 0.1, "and another one, which is rigorous": 0.2}
    panel = plot_residuals(made_estimates(), threshold=curves)
    panel.figure.canvas.draw()
    assert panel.get_position().width > 0.75
    legend = panel.get_legend().get_window_extent()
    assert legend.x1 <= panel.figure.bbox.x1
    assert legend.y0 >= panel.get_window_extent().y1 - 1.0


def test_axes_given_for_residuals_and_poles_are_used() -> None:
    _, (left, right) = plt.subplots(1, 2)
    design = obsynth.fault_estimation_filter(load_spec(DESIGNS / "wang2015" / "spec.yaml").plant)
    assert plot_residuals(made_estimates(), axes=left) is left
    assert plot_poles(design, axes=right) is right
    assert not any(name.startswith("fault zeros") for name in lines_of(right))


@pytest.mark.parametrize(
    ("draw", "path"),
    [
        (lambda: plot_faults(made_estimates(), faults=FAULTS[:-1]), "faults"),
        (lambda: plot_faults(made_estimates(), faults=FAULTS[:, 0]), "faults"),
        (lambda: plot_faults(made_estimates(), axes=[plt.figure().add_subplot()]), "axes"),
        (lambda: plot_residuals(made_estimates(), threshold=np.ones(STEPS + 1)), "threshold"),
        (lambda: plot_residuals(made_estimates(), threshold=dict.fromkeys("abcd", 1.0)), "threshold"),
    ],
)
def test_malformed_arguments_are_named(draw, path: str) -> None:
    with pytest.raises(SpecError) as caught:
        draw()
    assert caught.value.path == path


def test_importing_the_room_does_not_load_matplotlib() -> None:
    code = "import sys, obsynth.plotting; print('matplotlib' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_nothing_is_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = []
    monkeypatch.setattr(plt, "show", lambda *args, **kwargs: shown.append(args))
    plot_faults(made_estimates(), faults=FAULTS)
    plot_residuals(made_estimates(), threshold=1.0)
    assert shown == []
    assert len(plt.get_fignums()) == 2
