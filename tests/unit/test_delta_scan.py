"""A scan of delta: its table, its picture, and gaps where there is nothing."""

from __future__ import annotations

from collections.abc import Iterator
from io import StringIO

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest
from rich.console import Console

import obsynth
from obsynth.plotting import plot_delta_scan
from obsynth.report.designs import delta_scan_table

mpl.use("Agg")

#: An unobservable pair at -0.4 +- 2j: Theorem 2 needs delta < 0.4.
PLANT = obsynth.DescriptorSystem(
    None, [[1, 0, 0], [0, -0.4, 2], [0, -2, -0.4]], C=[[1, 0, 0]], Bf=[[1], [0], [0]]
)  # fmt: skip


@pytest.fixture(scope="module")
def scan() -> obsynth.DeltaScan:
    return obsynth.pd_delta_scan(PLANT, [1.0, 0.1, 0.3], theorem=2)


@pytest.fixture(autouse=True)
def _closed() -> Iterator[None]:
    yield
    plt.close("all")


def test_each_delta_has_its_row_in_the_order_given(scan: obsynth.DeltaScan) -> None:
    rows = list(scan.rows())
    assert [row["delta"] for row in rows] == [1.0, 0.1, 0.3]
    assert "delta < 4 |sigma| / w^2 = 0.4" in str(rows[0]["failure"])
    assert np.isnan(rows[0]["gain"])
    assert rows[1]["failure"] == rows[2]["failure"] == ""


def test_a_row_says_what_a_design_with_that_delta_gives(scan: obsynth.DeltaScan) -> None:
    design = obsynth.pd_observer(PLANT, theorem=2, delta=0.1, decay=0.0)
    report = design.report
    assert scan.decay[1] == pytest.approx(-report["error system"].value)
    assert scan.gain[1] == pytest.approx(report["gain"].value)
    assert scan.proportional_abscissa[1] == pytest.approx(report["P part alone"].value)
    for field, row in (("rate_gain", "fault rate"), ("noise_gain", "noise"), ("fast_noise_gain", "fast noise")):
        assert getattr(scan, field)[1] == pytest.approx(report[f"{row} in the fault estimate"].value, rel=1e-8)


def test_it_survives_a_round_trip_and_is_read_only(scan: obsynth.DeltaScan) -> None:
    again = obsynth.DeltaScan.from_dict(scan.as_dict())
    for name in scan.quantities():
        np.testing.assert_array_equal(getattr(again, name), getattr(scan, name))
        with pytest.raises(ValueError, match="read-only"):
            getattr(scan, name)[0] = 1.0
    assert again.failures == scan.failures


def test_its_decay_rate_is_imposed_on_all() -> None:
    found = obsynth.pd_delta_scan(PLANT, [0.05, 0.2], decay=0.3)
    assert np.all(found.decay > 0.3)


@pytest.mark.parametrize("wrong", [[], [0.0], [-1.0, 1.0], [np.nan], "a", [[1.0, 2.0], [3.0, 4.0]]])
def test_what_is_no_delta(wrong: object) -> None:
    with pytest.raises(obsynth.SpecError, match="delta_scan"):
        obsynth.pd_delta_scan(PLANT, wrong)


def test_the_table_has_a_dash_where_there_is_nothing(scan: obsynth.DeltaScan) -> None:
    text = StringIO()
    Console(file=text, width=120).print(delta_scan_table(scan))
    lines = text.getvalue().splitlines()
    assert lines[0].split()[:2] == ["delta", "(s)"]
    assert lines[2].split() == ["1", "-", "-", "-", "-", "-"]
    assert lines[3].split()[0] == "0.1"


def test_the_picture_shows_the_numbers_in_order_of_delta(scan: obsynth.DeltaScan) -> None:
    panels = plot_delta_scan(scan)
    assert [panel.get_ylabel() for panel in panels] == ["decay (1/s)", "norm", "gain to the fault error"]
    (curve,) = panels[0].get_lines()
    np.testing.assert_array_equal(curve.get_xdata(), [0.1, 0.3, 1.0])
    np.testing.assert_array_equal(curve.get_ydata(), scan.decay[[1, 2, 0]])
    assert len(panels[2].get_lines()) == 3
    styles = {(line.get_linestyle(), line.get_marker()) for line in panels[2].get_lines()}
    assert len(styles) == 3
    assert all(panel.get_xscale() == panel.get_yscale() == "log" for panel in panels)
    assert panels[2].get_xlabel() == "delta (s)"


def test_it_draws_on_given_axes(scan: obsynth.DeltaScan) -> None:
    _, axes = plt.subplots(3)
    assert plot_delta_scan(scan, axes=axes) == list(axes)
    with pytest.raises(obsynth.SpecError, match="3 are needed"):
        plot_delta_scan(scan, axes=axes[:2])
