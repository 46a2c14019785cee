"""What a picture of a sweep shows where its cases have names and no parameter in common."""

from types import SimpleNamespace

import pytest

from obsynth.report.plots.trade_off import plot_sweep


def cases(*orders: float) -> list[SimpleNamespace]:
    return [
        SimpleNamespace(name=name, parameters={}, claims={"order": order}, facts={}, status="designed")
        for name, order in zip(("net", "net_b", "motor"), orders, strict=False)
    ]


@pytest.fixture(autouse=True)
def figures():
    import matplotlib.pyplot as plt

    yield
    plt.close("all")


def test_cases_with_names_have_them_below_and_no_line_between_them() -> None:
    """Two specs were joined by a line from 'case 1' to 'case 2', through an order of 4.5."""
    panel = plot_sweep(cases(6, 3)).axes[0]
    assert [text.get_text() for text in panel.get_xticklabels()] == ["net", "net_b"]
    assert [line.get_linewidth() for line in panel.get_lines()] == [0.0]
    assert all(float(tick).is_integer() for tick in panel.get_yticks())


def test_values_that_are_no_whole_numbers_keep_their_ticks() -> None:
    panel = plot_sweep(cases(6.5, 3.2)).axes[0]
    assert any(not float(tick).is_integer() for tick in panel.get_yticks())
