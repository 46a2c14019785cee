"""Claims against the size of a region and the rate of its parameter."""

from __future__ import annotations

from importlib import import_module
from types import SimpleNamespace

import numpy as np
import pytest
from tests.support.polytopic_plants import wang

import obsynth
from obsynth import PolytopicSystem, SpecError

_TANK = obsynth.DAEModel(
    {"balance": "2.0 * der(level) = inflow - 0.5 * sqrt(level) - leak"}, {"gauge": "level"},
    states={"level": 1.0}, inputs={"inflow": 0.5}, parameters={"leak": 0.0},
)  # fmt: skip


@pytest.mark.long
def test_a_larger_region_costs_and_no_course_passes_the_claim() -> None:
    found = obsynth.region_trade_off(wang(0.3), sizes=[0.1, 0.5, 1.0], weight="paper")
    assert found.claim == "gamma"
    assert np.all(np.diff(found.claims) > 0)
    assert np.all(found.reached <= found.claims)
    # Each is the design over that region.
    alone = obsynth.fault_estimation_filter(wang(0.15), weight="paper")
    assert found.claims[1] == pytest.approx(alone.certificate.claims["gamma"], rel=1e-4)
    table = found.table()
    assert table["size"].tolist() == [0.1, 0.5, 1.0]
    assert (table["ratio"] <= 1.0).all()
    assert found.plot().get_xlabel() == "share of the region"


@pytest.mark.long
def test_a_slower_parameter_costs_less_and_any_course_stands_last() -> None:
    found = obsynth.region_trade_off(wang(0.6, rate=0.05), rates=[0.02, None], weight="paper")
    assert found.claims[0] < found.claims[1]
    axes = found.plot()
    assert [label.get_text() for label in axes.get_xticklabels()] == ["0.02", "any"]


@pytest.mark.parametrize(
    ("dt", "decays", "used"),
    [
        (1.0, (0.9, 0.7, 0.8), (1.0, 0.5, 1.0)),
        (0.0, (0.5, 2.0, 1.0), (1.0, 0.5, 1.0)),
        (0.0, (3.0, 4.0, 2.0), (0.5, 0.5, 1.0)),
    ],
)
def test_a_smaller_region_is_never_worse(
    dt: float, decays: tuple[float, ...], used: tuple[float, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is proved over a larger region stands in the place of less that is proved over a smaller one."""
    gains = {0.1: 3.0, 0.5: 2.5, 1.0: 2.0}
    slower = dict(zip(gains, decays, strict=True))

    def made(_: object, __: str, value: float, *___: object) -> SimpleNamespace:
        claims = {"gamma": gains[value], "region_decay": slower[value]}
        return SimpleNamespace(certificate=SimpleNamespace(claims=claims), observer=SimpleNamespace(dt=dt), plant=None)

    module = import_module("obsynth.studies.region_trade_off")
    monkeypatch.setattr(module, "_designed", made)
    monkeypatch.setattr(module, "ObserverDesign", SimpleNamespace)
    found = obsynth.region_trade_off(wang(), sizes=[0.1, 0.5, 1.0])
    assert found.designed_for == used
    assert np.array_equal(found.claims, [gains[size] for size in used])


def test_a_region_that_is_too_large_is_a_row_with_its_reason() -> None:
    plant = PolytopicSystem(
        plant={"A": [["v"]], "C": [[0]], "Bf": [[0]], "Bd": [[1]], "Df": [[1]], "dt": 1.0}, scheduling={"v": [0.5, 1.5]}
    )
    found = obsynth.region_trade_off(plant, sizes=[0.5, 1.0])
    assert np.isnan(found.claims).all()
    assert "undetectable" in found.designs[1] or "Error" in found.designs[1]
    found.plot()


@pytest.mark.long
def test_regions_of_nonlinear_plants_and_of_vertices_shrink_about_their_middle() -> None:
    options = {"region": {"level": [0.2, 2.0]}, "sample_time": 1.0, "noise": {"gauge": 1e-3, "leak": 1e-4}}
    found = obsynth.region_trade_off(_TANK, sizes=[0.5, 1.0], **options)
    assert found.claim == "region_deviation"
    assert found.designs[0].options["region"] == {"level": pytest.approx([0.65, 1.55])}
    assert found.claims[0] <= found.claims[1] * 1.001
    vertices = PolytopicSystem(list(wang(0.3).vertices))
    assert obsynth.region_trade_off(vertices, sizes=[0.5]).claims[0] == pytest.approx(
        obsynth.region_trade_off(wang(0.3), sizes=[0.5]).claims[0], rel=1e-3
    )


@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"sizes": [0.5], "rates": [1.0]}, "not both"),
        ({"sizes": [0.0]}, "positive numbers"),
        ({"sizes": []}, "empty"),
        ({"rates": [0.1]}, "one scheduling parameter"),
        ({"sizes": [1.0], "claim": "decay"}, "No design claims 'decay'"),
    ],
)
def test_what_does_not_fit_is_refused(options: dict[str, object], told: str) -> None:
    with pytest.raises(SpecError, match=told):
        obsynth.region_trade_off(wang(), **options)
    with pytest.raises(SpecError, match="which a nonlinear plant has none of"):
        obsynth.region_trade_off(_TANK, rates=[1.0])
