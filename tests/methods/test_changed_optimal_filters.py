"""Optimal filters that were changed: each change is refused by the row that covers it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import obsynth

TWO_SENSORS = obsynth.DescriptorSystem(
    A=[[0.8]], B=[[1.0]], Bf=[[0]], Bw=[[1, 0, 0]], C=[[1], [1]], Df=[[1], [0]], Dw=[[0, 0.5, 0], [0, 0, 1]], dt=1.0
)
REFERENCE = ([[0.5]], [[1.0]], [[0.5]], [[0.0]])
OPTIONS = {
    "delay": {"delay": 1},
    "reference": {"reference": REFERENCE},
    "matching": {"reference": REFERENCE, "exact": False},
    "mean square": {"delay": 1, "norm": "h2"},
}


@pytest.fixture(scope="module")
def designs():
    made = {name: obsynth.optimal_filter(TWO_SENSORS, **options) for name, options in OPTIONS.items()}
    assert all(design.report.passed for design in made.values())
    return made


def changed(design, *, observer=None, claims=None, matrices=None, options=None, plant=None):
    certificate = obsynth.Certificate(
        {**design.certificate.matrices, **(matrices or {})}, {**design.certificate.claims, **(claims or {})}
    )
    return design.replace(
        plant=plant or design.plant,
        observer=observer or design.observer,
        certificate=certificate,
        options={**design.options, **(options or {})},
    )


def scaled_observer(name, factor):
    return lambda d: {"observer": replace(d.observer, **{name: factor * getattr(d.observer, name)})}


def scaled_claim(name, factor):
    return lambda d: {"claims": {name: factor * d.certificate.claims[name]}}


def scaled_plant(name, factor):
    return lambda d: {"plant": d.plant.replace(**{name: factor * getattr(d.plant, name)})}


def other_reference(d, *, stored: bool):
    """Half of what was to be estimated: in the witnesses alone, or in the options too."""
    half = 0.5 * d.certificate.matrices["reference_C"]
    options = {"reference": {**d.options["reference"], "C": half.tolist()}} if stored else {}
    return {"matrices": {"reference_C": half}, "options": options}


FITS = "observer, certificate, options and plant have matching signals and shapes"
#: Design, change, the row that fails (a part of its claim for the one on shapes).
CHANGES = {
    "gain below": ("delay", scaled_claim("gain", 1.0 - 1e-6), "gain"),
    "gain below, reference": ("reference", scaled_claim("gain", 1.0 - 1e-6), "gain"),
    "gain below, matching": ("matching", scaled_claim("gain", 1.0 - 1e-6), "gain"),
    "least above": ("delay", scaled_claim("least", 1.0 + 1e-6), "least gain"),
    "least above, reference": ("reference", scaled_claim("least", 1.0 + 1e-6), "least gain"),
    "least above, matching": ("matching", scaled_claim("least", 1.0 + 1e-6), "least gain"),
    "limit above": ("delay", scaled_claim("non_causal_limit", 1.0 + 1e-4), "gain at any delay"),
    "deviation below": ("mean square", scaled_claim("deviation", 1.0 - 1e-5), "deviation"),
    "deviation above": ("mean square", scaled_claim("deviation", 1.0 + 1e-5), "deviation"),
    "least deviation above": ("mean square", scaled_claim("least_deviation", 1.0 + 1e-5), "least deviation"),
    "less noise": ("delay", scaled_plant("Dw", 0.999), "least gain"),
    "more noise": ("delay", scaled_plant("Dw", 1.001), "gain"),
    "more noise, mean square": ("mean square", scaled_plant("Dw", 1.001), "deviation"),
    "faults of another size": ("delay", scaled_plant("Df", 1.001), "fault map"),
    "faults of another size, reference": ("reference", scaled_plant("Df", 1.001), "fault map"),
    "another effect of u": ("delay", scaled_plant("B", 1.001), "decoupling"),
    "another plant": ("delay", scaled_plant("A", 1.001), "decoupling"),
    "A of the filter": ("delay", scaled_observer("Az", 1.001), "decoupling"),
    "B of the filter": ("delay", scaled_observer("By", 1.001), "decoupling"),
    "C of the filter": ("delay", scaled_observer("Cz", 1.001), "decoupling"),
    "D of the filter": ("delay", scaled_observer("Dy", 1.001), "decoupling"),
    "u of the filter": ("delay", scaled_observer("Bu", 1.001), "decoupling"),
    "a filter that is not stable": ("delay", scaled_observer("Az", 1e3), "stability"),
    "another reference, in one place": ("reference", lambda d: other_reference(d, stored=False), FITS),
    "another reference": ("reference", lambda d: other_reference(d, stored=True), "fault map"),
    "another reference, matching": ("matching", lambda d: other_reference(d, stored=True), "gain"),
    "matching said to be exact": ("matching", lambda d: {"options": {"exact": True}}, FITS),
    "exact said to be matching": ("delay", lambda d: {"options": {"exact": False}}, FITS),
    "another P": ("delay", lambda d: {"matrices": {"P": 0.9 * d.certificate.matrices["P"]}}, "gain"),
    "another point": (
        "delay", lambda d: {"matrices": {"invisible": d.certificate.matrices["invisible"] * 1.01}}, "least gain",
    ),
    "no point": ("delay", lambda d: {"matrices": {"invisible": np.zeros((0, 2))}}, "least gain"),
    "a frequency inside the circle": (
        "delay", lambda d: {"matrices": {"limit_point": 0.5 * d.certificate.matrices["limit_point"]}},
        "gain at any delay",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CHANGES)
def test_each_change_is_refused_by_its_row(designs, name) -> None:
    design, change, row = CHANGES[name]
    failures = obsynth.verify(changed(designs[design], **change(designs[design]))).failures
    assert row in {text for check in failures for text in (check.name, check.claim)}, failures


def test_points_of_another_delay_prove_no_more_than_is_true(designs) -> None:
    """With a sample more the least gain is lower: its points, in the design of the shorter delay, fall short."""
    late = obsynth.optimal_filter(TWO_SENSORS, delay=2)
    for name in ("invisible", "samples"):
        assert name in late.certificate.matrices
    other = changed(
        designs["delay"],
        matrices={name: late.certificate.matrices[name] for name in ("invisible", "samples")},
        claims={"least": designs["delay"].gain},
    )
    assert "least gain" in {check.name for check in obsynth.verify(other).failures}


@pytest.mark.one_in(2)
@pytest.mark.parametrize("dt", [0.0, 1.0])
def test_a_least_gain_that_is_small_beside_large_effects_of_faults_is_not_zero(dt: float) -> None:
    """Of faults in small units, "the least gain is zero" was printed of a filter of gain .05, of 1e-7 at least."""
    mode = 0.5 if dt else -1.0
    plant = obsynth.DescriptorSystem(
        A=[[mode, 0.2], [0.1, 1.5 * mode]],
        C=[[1, 0], [0, 1], [1, 1]],
        Bf=[[1e6], [-3e6]],
        Bw=np.hstack([0.3 * np.eye(2), np.zeros((2, 3))]),
        Dw=np.hstack([np.zeros((3, 2)), 0.1 * np.eye(3)]),
        dt=dt,
    )
    design = obsynth.optimal_filter(plant, reference={"bandwidth": 0.7}, exact=False)
    assert 5e-8 < design.least <= design.gain
    assert not any("zero" in note or ": 0;" in note for note in design.notes)
