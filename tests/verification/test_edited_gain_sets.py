"""Every field of a stored gain set is covered by a row, or is one of the fields here, with the reason why it is not.

A file is edited in one place, a number by a tenth or in sign, a name by a letter, and its digest made to fit.  What is
then read and verified may claim less than the file before, never more.
"""

from __future__ import annotations

import copy
import dataclasses
import json
from collections.abc import Callable, Iterator
from fnmatch import fnmatch
from functools import cache
from typing import Any

import numpy as np
import pytest
from test_every_method import CONTINUOUS, DISCRETE, OWN
from test_every_method import design_of as first_design

import obsynth
from obsynth.results.gain_set_writing import design_as_dict, digest_of
from obsynth.results.gain_sets import loaded
from obsynth.verification.requested_limits import requested_rows

WORDS = "words about how the design was made, which no claim rests on"
SEARCH = "how the search went; what it found is proved on its own"
NAMES_HERE = "a name that this file holds in one place alone: it is what the signal is called"
NO_CLAIM = "what is made of residuals under faults is no claim"
WITNESS = "a witness: with any number with which the proof succeeds, the claim is proved"
WEAKER = "a bound: what is edited claims less, and holds"
FUNCTIONS = "functions, of which only names are stored"
DESIGN_NOISE = "noise that the gain was chosen for; no claim rests on it"
LIMIT = "a limit that the design meets; a smaller one than it reaches is refused"

#: Fields that may be edited, by method and path, with the reason.  ``weaker``: only towards a weaker claim, which the
#: campaign `tampered_claims` compares with the truth.
ALLOWED: dict[str, dict[str, str]] = {
    "*": {
        "name": WORDS,
        "notes.*": WORDS,
        "solver.*": SEARCH,
        "report.*": "made again by verify",
        "options.solver_options": SEARCH,
        "options.engine": SEARCH,
        "options.constraints": FUNCTIONS,
        "options.objective": FUNCTIONS,
        "options.steady_error_limit": LIMIT,
        "certificate.matrices.state_error.*": WEAKER,
        "certificate.matrices.input_error.*": WEAKER,
        "certificate.matrices.disturbance_error.*": WEAKER,
        "certificate.matrices.stability.*": WITNESS,
        "certificate.matrices.P*": WITNESS,
        "plant.state_names.*": NAMES_HERE,
        "plant.noise_names.*": NAMES_HERE,
        "observer.residual_names.*": NAMES_HERE,
    },
    "fault-estimation-filter": {
        "options.gamma": "a bound that the filter meets; one that it does not meet is refused",
        "options.gamma_margin": SEARCH,
        "options.gamma_search": SEARCH,
        "options.tolerance": SEARCH,
        "options.prove_least": "whether a proof is sought; the row 'least gain' says whether there is one",
        "options.S": "the free matrix of T and N, which have rows of their own",
        "options.decay": LIMIT,
        "options.residual_weight_limit": "a bound of the weight, which the filter of this plant meets",
        "certificate.claims.gamma*": WEAKER,
    },
    "pd-observer": {
        "options.theorem": "of the inequality that was solved; which theorem proves the gains is a claim",
        "options.delta": "the number with which the search began",
        "certificate.claims.delta": "a number of the witness",
        "certificate.claims.decay": WEAKER,
        "options.decay": LIMIT,
        "options.adaptation_gain": "G, which the row on gains compares with the realisation",
    },
    "ui-pi-observer": {
        "options.noise": DESIGN_NOISE,
        "options.joint": SEARCH,
        "options.decay": LIMIT,
        "certificate.claims.decay": WEAKER,
        "certificate.claims.noise_amplification": WEAKER,
        "certificate.claims.noise_price": "stated by the search, and the report says that it is assumed",
    },
    "functional-filter": {
        "options.noise": DESIGN_NOISE,
        "options.joint": "the rows on decoupling follow it: joint claims less",
        "options.decay": LIMIT,
        "plant.Dw.*": WEAKER,
        "observer.Cz.data.*": NO_CLAIM,
        "certificate.claims.decay": WEAKER,
        "certificate.matrices.deviations.*": WEAKER,
    },
    "optimal-filter": {
        "plant.C.data.*": "an output that this filter does not read: what it reads is that of the plant",
        "plant.D.data.*": "an output that this filter does not read",
        "plant.Df.data.*": "an output that this filter does not read",
        "certificate.claims.gain": "zero with exact numbers: what is claimed is a bound of rounding",
    },
    "detection-filter": {
        "plant.Bf.*": WEAKER,
        "plant.Df.*": WEAKER,
        "plant.Dw.*": WEAKER,
        "plant.fault_names.*": NAMES_HERE,
        "plant.disturbance_names.*": NAMES_HERE,
        "certificate.claims.*": WEAKER,
    },
    "region-observer": {
        "options.noise.*": WEAKER,
        "options.goal": SEARCH,
        "options.decay": LIMIT,
        "observer.forgetting": WEAKER,
        "certificate.claims.*": WEAKER,
    },
    "guaranteed-test": {
        "options.before": "how many rows before the window are used in the proof of the least threshold",
        "options.disturbance_bounds": "bounds of disturbances that this plant does not have",
        "options.exact": "how the test runs on data",
        "certificate.matrices.multiplier_radius.*": WITNESS,
        "certificate.matrices.witness_radius.*": WITNESS,
        "certificate.matrices.rounding.*": WEAKER,
        "certificate.matrices.trade_off.*": SEARCH,
        "certificate.claims.*": WEAKER,
    },
}


@cache
def document_of(method: str) -> dict[str, Any]:
    """Return the file of a design of a method."""
    return json.loads(json.dumps(design_as_dict(first_design(method))))


def places(tree: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the path of every number, name and gap; of an array, of two entries and of one that is zero."""
    if isinstance(tree, dict) and tree.keys() == {"shape", "data"}:
        draw = np.random.default_rng(len(path))
        entries = [[i for i, x in enumerate(tree["data"]) if bool(x) is kind] for kind in (True, False)]
        for indices, count in zip(entries, (2, 1), strict=True):
            yield from ((*path, "data", int(i)) for i in draw.permutation(indices)[:count])
    elif isinstance(tree, (dict, list)):
        for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree):
            yield from places(value, (*path, key))
    else:
        yield path


def edits_of(value: Any) -> list[Any]:
    """Return what is written in the place of a value."""
    if isinstance(value, bool):
        return [not value]
    if isinstance(value, int):
        return [value + 1, value - 1, -value] if value else [1]
    if isinstance(value, float):
        return [1.1 * value, 0.9 * value, -value] if value else [0.1]
    return [f"{value}x"] if isinstance(value, str) else [0.1, "x"]


def passes(document: dict[str, Any], path: tuple[Any, ...], edit: Any) -> bool:
    """Whether a file with one edit is read and verified."""
    edited = copy.deepcopy(document)
    holder = edited["design"]
    for key in path[:-1]:
        holder = holder[key]
    holder[path[-1]] = edit
    edited["sha256"] = digest_of(edited["design"])
    try:
        return obsynth.verify(loaded(json.dumps(edited).encode())).passed
    except obsynth.ObsynthError:
        return False


@pytest.mark.long
@pytest.mark.parametrize("method", OWN)
def test_every_field_is_covered_or_has_a_reason(method: str) -> None:
    document = document_of(method)
    reasons = ALLOWED["*"] | ALLOWED.get(method, {})
    uncovered = []
    for path in places(document["design"]):
        name, value = ".".join(map(str, path)), document["design"]
        if any(fnmatch(name, pattern) for pattern in reasons):
            continue
        for key in path:
            value = value[key]
        uncovered += [f"{name}: {value!r} -> {edit!r}" for edit in edits_of(value) if passes(document, path, edit)]
    assert uncovered == []


DISTURBED = obsynth.DescriptorSystem(
    None, DISCRETE.A, DISCRETE.B, DISCRETE.C, Bf=DISCRETE.Bf, Bd=[[0.1], [0.0], [0.3]], dt=0.1
)


@cache
def asked(name: str) -> dict[str, Any]:
    makers: dict[str, Callable[[], obsynth.ObserverDesign]] = {
        "filter, decay": lambda: obsynth.fault_estimation_filter(DISTURBED, decay=0.5),
        "filter, region": lambda: obsynth.fault_estimation_filter(DISTURBED, region={"disk": [0.0, 0.9]}),
        "filter, gamma": lambda: obsynth.fault_estimation_filter(DISTURBED, gamma=5.0),
        "UI-PI, decay": lambda: obsynth.ui_pi_observer(CONTINUOUS, decay=1.5),
        "UI-PI, region": lambda: obsynth.ui_pi_observer(CONTINUOUS, region={"decay": 0.8, "radius": 9, "damping": 0.5}),
        "UI-PI, poles": lambda: obsynth.ui_pi_observer(CONTINUOUS, poles=[-3, -4, [-5, 1], [-5, -1]]),
        "PD, decay": lambda: obsynth.pd_observer(CONTINUOUS, decay=0.3),
        "PD, gain": lambda: obsynth.pd_observer(CONTINUOUS, gain_bound=50.0),
        "functional, decay": lambda: obsynth.functional_filter(CONTINUOUS, decay=1.5),
        "functional, poles": lambda: obsynth.functional_filter(CONTINUOUS, poles=[-3, -4, -5, -6]),
        "functional, mean": lambda: obsynth.functional_filter(DISCRETE, mean=3),
    }
    design = makers[name]()
    assert obsynth.verify(design).passed
    return json.loads(json.dumps(design_as_dict(design)))


@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    ("name", "option", "edit"),
    [
        ("filter, decay", "decay", 6.0),
        ("filter, region", "region", [{"disk": [0.0, 0.3]}]),
        ("filter, gamma", "gamma", 1e-9),
        ("UI-PI, decay", "decay", 15.0),
        ("UI-PI, region", "region", {"decay": 8.0, "radius": 9, "damping": 0.5}),
        ("UI-PI, region", "region", {"decay": 0.8, "radius": 0.9, "damping": 0.5}),
        ("UI-PI, region", "region", {"decay": 0.8, "radius": 9, "damping": 0.999999}),
        ("UI-PI, poles", "poles", [[-3, 0], [-4, 0], [-5.5, 1], [-5.5, -1]]),
        ("UI-PI, poles", "poles", "x"),
        ("PD, decay", "decay", 3.0),
        ("PD, decay", "disk", [1.0, 2.0]),
        ("PD, decay", "noise_gain", 1e-3),
        ("PD, gain", "gain_bound", 5.0),
        ("functional, decay", "decay", 15.0),
        ("functional, poles", "poles", [-3, -4, -5, -7]),
        ("functional, mean", "mean", 4),
        ("functional, mean", "mean", 1),
    ],
)
def test_what_the_options_ask_for_is_reached(name: str, option: str, edit: Any) -> None:
    document = asked(name)
    assert document["design"]["options"][option] != edit
    assert not passes(document, ("options", option), edit)


@pytest.mark.one_in(4)
@pytest.mark.parametrize(
    ("option", "edit"),
    [("region", {"h2": [0.1, 0.9], "h1 - h2": [0.02, 0.55]}), ("region", "x"), ("sample_time", 1.0), ("faults", []),
     ("initial_state", {"h1": 0.1}), ("gains", [[0.0]]), ("faults", 3)],
)  # fmt: skip
def test_options_of_a_region_observer_are_those_that_it_runs_with(option: str, edit: Any) -> None:
    document = document_of("region-observer")
    assert passes(document, ("options", option), document["design"]["options"][option])
    assert not passes(document, ("options", option), edit)


@pytest.mark.one_in(3)
@pytest.mark.parametrize("method", OWN)
def test_an_option_that_the_method_does_not_have_is_refused(method: str) -> None:
    document = document_of(method)
    assert passes(document, ("name",), "another name")
    assert not passes(document, ("options", "colour"), "red")


@pytest.mark.parametrize(
    ("method", "path", "edit"),
    [
        ("fault-estimation-filter", ("options", "solver"), "CLARABELx"),
        ("fault-estimation-filter", ("options", "engine"), "magic"),
        ("fault-estimation-filter", ("options", "S"), [[1.0]]),
        ("fault-estimation-filter", ("options", "S"), "x"),
        ("fault-estimation-filter", ("options", "constraints"), "x"),
        ("fault-estimation-filter", ("options", "objective"), 1.5),
        ("fault-estimation-filter", ("solver", "engine"), "magic"),
        ("pd-observer", ("options", "solver"), "HIGHS"),
        ("pd-observer", ("options", "adaptation_gain"), "x"),
        ("pd-observer", ("solver", "runs", 0, "solver"), "CLARABELx"),
        ("ui-pi-observer", ("options", "solver"), ""),
        ("ui-pi-observer", ("options", "objective"), "beauty"),
        ("ui-pi-observer", ("options", "noise"), {"measurement": {"y3": 1.0}}),
        ("functional-filter", ("options", "noise"), {"y1": 1.0, "y3": 1.0}),
        ("region-observer", ("options", "goal"), "beauty"),
        ("region-observer", ("options", "solver"), "CLARABELx"),
    ],
)
@pytest.mark.one_in(4)
def test_options_that_nobody_claims_are_those_that_a_design_can_have(method: str, path: tuple[Any], edit: Any) -> None:
    """A reader is shown with which options and by which solver a design was made."""
    document = document_of(method)
    assert passes(document, ("name",), "another name")
    assert not passes(document, path, edit)


def test_names_of_constraints_and_of_functions_may_stand_for_them() -> None:
    document = document_of("fault-estimation-filter")
    assert passes(document, ("options", "constraints"), ["small"])
    assert passes(document, ("options", "objective"), "a function, trace_of_P")
    assert passes(document, ("options", "solver"), "MOSEK")


def test_modes_that_no_gain_moves_are_computed_only_where_a_row_fails_without_them() -> None:
    plant = obsynth.DescriptorSystem(A=[[-3.0, 1.0], [1.0, -2.0]], C=[[1.0, 0.0]], dt=0.0)
    design = obsynth.ui_pi_observer(plant, decay=4.0)
    calls = list[float]()

    def fixed_modes(of: obsynth.ObserverDesign) -> list[complex]:
        calls.append(of.options["decay"])
        return list(np.linalg.eigvals(design.observer.Az))

    for rate, count in ((3.9, 0), (1e3, 1)):
        asked = dataclasses.replace(design, options={**design.options, "decay": rate, "region": {"decay": rate}})
        rows = list(requested_rows(asked, {}, frozenset({"decay", "region"}), fixed_modes))
        assert [row.name for row in rows] == ["requested decay", "requested region"]
        assert all(row.passed for row in rows)
        assert len(calls) == count


@pytest.mark.parametrize("method", ["fault-estimation-filter", "guaranteed-test"])
def test_shapes_of_arrays_are_counts(method: str) -> None:
    """A length that is filled in by whoever reads the file, or that is no whole number, is none."""
    for path in places_of_arrays(document_of(method)["design"]):
        edited = copy.deepcopy(document_of(method))
        holder = edited["design"]
        for key in path:
            holder = holder[key]
        shape = holder["shape"]
        for place, length in enumerate(shape):
            for other in (-1, float(length), True if length == 1 else str(length)):
                holder["shape"] = [*shape[:place], other, *shape[place + 1 :]]
                edited["sha256"] = digest_of(edited["design"])
                with pytest.raises(obsynth.SpecError):
                    loaded(json.dumps(edited).encode())


def places_of_arrays(tree: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    if isinstance(tree, dict) and tree.keys() == {"shape", "data"}:
        yield path
    elif isinstance(tree, (dict, list)):
        for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree):
            yield from places_of_arrays(value, (*path, key))


@pytest.fixture(scope="module")
def sampled() -> dict[str, Any]:
    plant = obsynth.discretise(CONTINUOUS, 0.1).plant
    return json.loads(json.dumps(design_as_dict(obsynth.fault_estimation_filter(plant))))


@pytest.mark.parametrize(
    ("name", "edit"),
    [("rows", -1), ("rows", 1.5), ("rows", 99), ("rows", True), ("columns", -1), ("size", -2), ("size", 2.5)],
)
def test_entries_of_the_plant_as_written_have_one_place(sampled: dict[str, Any], name: str, edit: Any) -> None:
    """An index of -1 was that of the last row, 1.5 that of row 1; whoever else reads the file may take another."""
    document = copy.deepcopy(sampled)
    assert obsynth.verify(loaded(json.dumps(document).encode())).passed
    holder = document["design"]["source"]["matrices"]["A"][name]
    holder[-1] = edit
    document["sha256"] = digest_of(document["design"])
    with pytest.raises(obsynth.SpecError):
        loaded(json.dumps(document).encode())


def test_no_entry_of_the_plant_as_written_is_stored_twice(sampled: dict[str, Any]) -> None:
    """The last one counted, so that another value stood before it."""
    document = copy.deepcopy(sampled)
    entries = document["design"]["source"]["matrices"]["A"]
    for name, value in (("rows", entries["rows"][0]), ("columns", entries["columns"][0]), ("values", 7.0)):
        entries[name].insert(0, value)
    document["sha256"] = digest_of(document["design"])
    with pytest.raises(obsynth.SpecError, match="stored twice"):
        loaded(json.dumps(document).encode())
