"""Designs for DAEs: saved, refused, and the table of corruptions: every row that decides can fail."""

from __future__ import annotations

import dataclasses
import pickle
from collections.abc import Callable
from functools import cache

import casadi as ca
import numpy as np
import pytest
from corruption_tables import Corruption, claim, failed, shipped
from dae_plants import DESIGNS, ROD, exchanger, linear, pendulum
from test_dae_observer import matrices

import obsynth
from obsynth import DAEObserver, ObserverDesign, PreconditionError, SpecError, dae_adaptive_observer, verify
from obsynth.methods.dae_adaptive_observer import checks
from obsynth.methods.designing import check
from obsynth.observers.batches import run_dae_batch
from obsynth.observers.nonlinear import step_graph as dae_algebra
from obsynth.observers.nonlinear.estimates import DAERow
from obsynth.plants.implicit_step import StepGraph

FITS, CLAIMS, RUNS, NEES, NIS = "fits the plant", "claims", "runs", "NEES", "NIS"
CONTRACTION, DERIVATIVES, RESIDUAL, CONDITION = "contraction", "derivatives", "Newton residual", "condition of (7)"
INDEX = "exists: index"
OPTIONS = {
    "dt": 1.0, "Q": {"mass": 4e-8, "energy": 5625.0, "cell": 1444.0}, "R": {"pressure": 1e4, "temperature": 0.25},
    "initial_covariance": {"p1": 4e6, "p2": 4e6, "T1": 25.0, "T2": 25.0},
    "initial_parameter_covariance": {"phi": 0.01, "psi": 1e6},
}  # fmt: skip


#: What was simulated for a model, and what an observer said of records, by the numbers that these were given.
RECORDS: dict[tuple[int, bytes], tuple[obsynth.DAEModel, obsynth.types.Trajectory]] = {}
ANSWERS: dict[tuple[int, bytes], tuple[obsynth.DAEModel, obsynth.types.Estimates]] = {}


def simulated(model: obsynth.DAEModel, u: np.ndarray, **options) -> obsynth.types.Trajectory:
    """Verification simulates the stated model with stated draws: the same for most corruptions, and done once."""
    key = id(model), pickle.dumps((u, sorted(options.items())))
    if key not in RECORDS:
        # The model is kept, so that its id stays its own.
        RECORDS[key] = model, obsynth.simulate_dae(model, u, **options)
    return RECORDS[key][1]


def answered(observer: DAEObserver, outputs: np.ndarray, u: np.ndarray, **options) -> obsynth.types.Estimates:
    """A corruption that leaves the observer alone leaves what it says of these records alone."""
    settings = {field.name: getattr(observer, field.name) for field in dataclasses.fields(observer)}
    model = settings.pop("model")
    key = id(model), pickle.dumps((settings, outputs, u, sorted(options.items())))
    if key not in ANSWERS:
        ANSWERS[key] = model, run_dae_batch(observer, outputs, u, **options)
    return ANSWERS[key][1]


@pytest.fixture(autouse=True)
def each_record_once(monkeypatch) -> None:
    monkeypatch.setattr(checks, "simulate_dae", simulated)


@cache
def good() -> ObserverDesign:
    return dae_adaptive_observer(exchanger(), **OPTIONS)


def throughout(**changes) -> Corruption:
    """Another plant throughout."""

    def corrupt(design: ObserverDesign) -> ObserverDesign:
        plant = design.plant.replace(**changes)
        return design.replace(plant=plant, observer=dataclasses.replace(design.observer, model=plant))

    return corrupt


def without_parameters(design: ObserverDesign) -> ObserverDesign:
    """The plant alone: what the observer says of parameters is then beside the point."""
    model = exchanger()
    equations = {name: text.replace("phi * Qn", "Qn") for name, text in model.equations.items()}
    units = {name: unit for name, unit in model.units.items() if name not in ("phi", "psi")}
    plant = model.replace(
        equations=equations, outputs={"pressure": "p2", "temperature": "T2"}, parameters={}, units=units
    )
    return design.replace(plant=plant)


EQUATIONS = dict(exchanger().equations)
OTHER = {**EQUATIONS, "cell": EQUATIONS["cell"].replace("Qn / 2", "Qn / 3")}
SINGULAR = {**EQUATIONS, "momentum": EQUATIONS["mass"]}
RENAMED = {"pressure": "p2 + psi", "heat": "T2"}
RENAMED_UNITS = {name.replace("temperature", "heat"): unit for name, unit in exchanger().units.items()}

#: Corruption -> what must fail, at least.
TABLE: dict[str, tuple[Corruption, set[str]]] = {
    "a listed gain": (lambda d: d.replace(gains={**d.gains, "K": 1.001 * d.gains["K"]}), {"gains"}),
    "a gain that is left out": (lambda d: d.replace(gains={"Upsilon": d.gains["Upsilon"]}), {"gains"}),
    "claim: a gain": (claim("gamma", 1e-9), {"claims covered"}),
    "another model": (shipped(model=exchanger(equations=OTHER)), {FITS, CLAIMS}),
    "another name": (shipped(model=exchanger(outputs=RENAMED, units=RENAMED_UNITS)), {FITS}),
    "another dt": (shipped(dt=2.0), {FITS, CLAIMS}),
    "far too little R": (shipped(R=np.diag([1.0, 1e-4])), {FITS, CLAIMS, NIS, NEES}),
    "far too much R": (shipped(R=np.diag([1e6, 25.0])), {FITS, CLAIMS, NIS}),
    "another Q": (shipped(Q=np.diag([4e-8, 5625.0, 1444.0, 1.0])), {FITS, CLAIMS}),
    "another P0": (shipped(initial_covariance=np.eye(4)), {FITS}),
    "another S0": (shipped(initial_parameter_covariance=np.diag([1e-8, 1.0])), {FITS, NEES}),
    "another start": (shipped(initial_state=1.01 * exchanger().nominal_state), {FITS}),
    "another lambda": (shipped(forgetting=0.9), {FITS}),
    "another guard": (shipped(guard="none"), {FITS}),
    "another weight": (shipped(weight="paper"), {FITS}),
    "another form": (shipped(form="augmented-kalman"), {FITS}),
    "another integration": (shipped(integration="radau"), {FITS, CLAIMS}),
    "another walk": (shipped(random_walk=np.eye(2)), {FITS}),
    "delayed sensors": (shipped(sensors={"pressure": {"every": 3}}), {FITS}),
    "bounds on states": (shipped(state_bounds=np.tile([-1e9, 1e9], (4, 1))), {FITS}),
    "other bounds": (shipped(upper=np.array([1.0, 1.0])), {FITS, NEES}),
    "another move": (shipped(largest_move=1.0), {FITS}),
    "another window": (shipped(window=7), {FITS}),
    "an option is lost": (
        lambda d: d.replace(options={k: v for k, v in d.options.items() if k != "Q"}), {FITS, RUNS},
    ),
    "a redundant equation": (throughout(equations=SINGULAR), {INDEX}),
    # A plant without parameters has an observer of its states, but not this one.
    "no parameters": (without_parameters, {FITS, RUNS}),
    "claim: index": (claim("index", 2.0), {CLAIMS}),
    "claim: condition": (claim("condition", 3.0), {CLAIMS}),
    "claim: contraction": (claim("contraction", 0.5), {CLAIMS}),
    "claim: steps": (claim("steps", 1.0), {CLAIMS}),
    "claim: not a number": (claim("condition", np.nan), {CLAIMS}),
}  # fmt: skip


@pytest.mark.long
def test_the_good_design_passes() -> None:
    assert failed(good()) == set()
    names = [check.name for check in good().report.checks]
    assert len(set(names)) == len(names)


@pytest.mark.one_in(8)
@pytest.mark.parametrize("name", TABLE)
def test_a_corrupted_design_fails(name: str, monkeypatch) -> None:
    corrupt, expected = TABLE[name]
    monkeypatch.setattr(checks, "run_dae_batch", answered)
    found = failed(corrupt(good()))
    assert expected <= found, (expected - found, found)
    if name.startswith("claim"):
        assert found == expected


def with_graph(monkeypatch, change: Callable[[StepGraph], StepGraph]) -> ObserverDesign:
    """The good design, as an implementation would run it whose implicit step is changed."""
    right, design = dae_algebra.step_graph, good()
    monkeypatch.setattr(dae_algebra, "step_graph", lambda *arguments: change(right(*arguments)))
    return design.replace(observer=dataclasses.replace(design.observer))


def replaced(function: ca.Function, change: Callable[..., list]) -> ca.Function:
    inputs = function.mx_in()
    return ca.Function(function.name(), inputs, change(*function(*inputs)))


def test_wrong_derivatives_are_found(monkeypatch) -> None:
    """A step whose G has lost a part of its dt, as the paper's step of one second would hide."""

    def wrong(graph: StepGraph) -> StepGraph:
        lost = replaced(graph.sensitivities, lambda F, G, noise, scaled: [F, 1.01 * G, noise, scaled])
        return dataclasses.replace(graph, sensitivities=lost, small=False)

    assert {DERIVATIVES} <= failed(with_graph(monkeypatch, wrong))


def test_steps_that_are_not_solved_are_found(monkeypatch) -> None:
    def wrong(graph: StepGraph) -> StepGraph:
        return dataclasses.replace(graph, step=replaced(graph.step, lambda X, residual, _: [X, 1e-6, 1.0]))

    assert failed(with_graph(monkeypatch, wrong)) == {RESIDUAL}


def test_a_nearly_singular_step_is_found(monkeypatch) -> None:
    design = good()
    monkeypatch.setattr(DAERow, "conditions", property(lambda self: np.full(len(self.several.memory), 1e14)))
    assert failed(design) == {CONDITION, CLAIMS}


def growing() -> obsynth.DAEModel:
    """A state that grows and that no sensor sees."""
    return obsynth.DAEModel(
        {"seen": "der(a) = -a + c", "grows": "der(b) = 0.5 * b"}, {"y": "a"}, states={"a": 1.0, "b": 0.0},
        parameters={"c": 1.0}, units=dict.fromkeys(["a", "b", "c", "y"], "1"),
    )  # fmt: skip


def test_an_invisible_growing_state_is_found() -> None:
    with pytest.raises(obsynth.VerificationError, match="contraction"):
        dae_adaptive_observer(growing(), dt=0.1, Q=1e-4, R=1e-2)


def test_every_row_that_decides_has_a_corruption() -> None:
    broken = set().union(*(expected for _, expected in TABLE.values()))
    broken |= {DERIVATIVES, RESIDUAL, CONDITION, CONTRACTION}
    # It counts parameters and says which are determined: a plant without any is estimated as well.
    broken |= {"exists: parameters"}
    assert {check.name for check in good().report.checks if check.kind != "information"} <= broken


@pytest.mark.long
def test_saved_and_loaded_it_is_the_same(tmp_path) -> None:
    loaded = obsynth.load(good().save(tmp_path / "gains.json"))
    assert isinstance(loaded.observer, DAEObserver)
    assert loaded.plant.as_dict() == good().plant.as_dict()
    assert repr(verify(loaded)) == repr(verify(good()))
    assert repr(loaded.report) == repr(good().report)


@pytest.mark.long
def test_python_functions_are_designed_for_and_not_saved(tmp_path) -> None:
    design = dae_adaptive_observer(
        linear(matrices()), dt=0.25, Q=0.01, R=0.04, initial_parameter_covariance=1.0, initial_covariance=1.0
    )
    assert design.report.passed
    with pytest.raises(SpecError, match="Python functions"):
        design.save(tmp_path / "gains.json")


@pytest.mark.parametrize("index", [2, 3])
def test_a_higher_index_is_refused_with_the_equations(index) -> None:
    with pytest.raises(PreconditionError, match=f"index {index}, because of the equations .*'rod'"):
        dae_adaptive_observer(pendulum(ROD[index]), dt=0.01, Q=1e-6, R=1e-4)


@pytest.mark.long
def test_the_designs_are_made_from_their_specs() -> None:
    from obsynth.specs.loader import load_spec

    spec = load_spec(DESIGNS / "moussaali2013_dae" / "spec.yaml")
    design = obsynth.design(spec.plant, spec.method, name=spec.name, **spec.options)
    assert repr(design.report) == repr(good().report)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"dt": None}, "dt is missing"), ({"Q": None}, "Q is missing"), ({"R": {"pressure": 1e4}}, "positive definite"),
        ({"R": {"presure": 1e4}}, "Did you mean 'pressure'"), ({"bounds": {"phi": [1.0]}}, "bounds.phi"),
        ({"random_walk": 1.0, "form": "forgetting"}, "random_walk belongs"),
        ({"initial_parameter_covariance": None}, "'psi' is zero"),
        ({"bounds": [[0.0, 1.0]]}, "bounds must be 2 pairs"), ({"initial_state": "x"}, "initial_state"),
    ],
)  # fmt: skip
def test_bad_options_are_named(changes, words) -> None:
    with pytest.raises(SpecError, match=words):
        dae_adaptive_observer(exchanger(), **{**OPTIONS, **changes})


def test_other_plants_and_methods_are_refused_by_kind() -> None:
    with pytest.raises(PreconditionError, match="needs a linear plant"):
        obsynth.design(exchanger(), "adaptive-observer")
    plain = obsynth.DescriptorSystem(E=None, A=[[0.5]], C=[[1.0]], dt=1.0)
    with pytest.raises(PreconditionError, match="nonlinear DAEModel"):
        dae_adaptive_observer(plain, dt=1.0, Q=1.0, R=1.0)
    found = check(exchanger(), {"dae-adaptive-observer": OPTIONS})
    assert {method for method, report in found.items() if report.passed} == {"dae-adaptive-observer"}


@pytest.mark.long
def test_notes_say_what_is_not_told_and_what_is_slow() -> None:
    units = {name: unit for name, unit in exchanger().units.items() if name != "temperature"}
    model = exchanger(outputs={"pressure": "p2 + psi"}, units=units)
    design = dae_adaptive_observer(model, **{**OPTIONS, "R": {"pressure": 1e4}, "forgetting": 0.5})
    assert any("do not distinguish this direction" in note and "psi" in note for note in design.notes)
    assert any("decay in" in note for note in design.notes)
