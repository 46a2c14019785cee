"""Each method is one declaration: what derives from it agrees with it, and each of its paths leads somewhere."""

from __future__ import annotations

import inspect
from dataclasses import fields
from typing import Any

import numpy as np
import pytest

import obsynth
from obsynth.cli.main import main
from obsynth.errors import SpecError
from obsynth.methods.pd_observer.method import PdObserver
from obsynth.methods.registry import REGISTRY, method_class, methods_for
from obsynth.numerics.arguments import Count, ForgettingFactor, Positive, field_types, problem_with


@pytest.mark.parametrize("method", REGISTRY)
def test_a_method_is_one_frozen_class(method: str) -> None:
    found = method_class(method)
    assert found.id == method
    assert found.__dataclass_params__.frozen  # type: ignore[attr-defined]
    function = getattr(obsynth, method.replace("-", "_"))
    given = {name: part.default for name, part in inspect.signature(function).parameters.items()}
    options = {option.name: option.default for option in fields(found)}
    assert {name: given[name] for name in options} == options
    assert set(given) - set(options) <= {"plant", "name", "scenario"}
    assert function.__doc__ == inspect.getdoc(found)


def test_kinds_of_plants_have_their_methods() -> None:
    assert methods_for("time-varying") == ("descriptor-kalman", "adaptive-observer", "guaranteed-test")
    nonlinear = ("dae-adaptive-observer", "extended-kalman", "region-observer")
    assert methods_for("nonlinear") == (*nonlinear, "guaranteed-test")
    assert set(methods_for("time-invariant")) == set(REGISTRY) - set(nonlinear)


@pytest.mark.parametrize(
    ("value", "kind", "problem"),
    [
        (True, Positive | None, "number above 0"), (0.0, Positive, "above 0"), (float("nan"), Positive, "above 0"),
        ("1", Positive, "give a number"), (None, Positive, "missing"), (1.5, ForgettingFactor, "above 0 and at most 1"),
        (2.0, Count, "whole number at least 1"), (True, Count, "whole number"), (1, bool, "True or False"),
        (True, field_types(PdObserver)["theorem"], "use one of 1, 2"),
    ],
)  # fmt: skip
def test_values_out_of_type_or_range_are_named(value: Any, kind: Any, problem: str) -> None:
    assert problem in str(problem_with(value, "option", kind))


def test_values_in_range_pass() -> None:
    for value, kind in ((None, Positive | None), (1, Positive), (1.0, ForgettingFactor), (3, Count), (False, bool)):
        assert problem_with(value, "option", kind) is None


def test_true_is_no_delta() -> None:
    plant = obsynth.DescriptorSystem(None, [[-1.0]], C=[[1.0]], Bf=[[1.0]])
    with pytest.raises(SpecError, match="delta is True: give a number above 0"):
        obsynth.pd_observer(plant, delta=True)


def test_unknown_options_are_listed() -> None:
    plant = obsynth.DescriptorSystem(None, [[-1.0]], C=[[1.0]], Bf=[[1.0]])
    with pytest.raises(SpecError, match=r"pd-observer has no option 'gama'.* There are: adaptation_gain"):
        obsynth.design(plant, "pd-observer", gama=1.0)


def test_gains_of_another_method_are_named() -> None:
    plant = obsynth.DescriptorSystem(None, [[-1.0]], C=[[1.0]], Bf=[[1.0]])
    with pytest.raises(
        SpecError, match=r"pd-observer is given by J, L, M, N \(and adaptation_gain, decay\), not by J, K"
    ):
        obsynth.design_from_gains(plant, "pd-observer", J=[[1.0]], K=[[1.0]])
    with pytest.raises(SpecError, match="no gains: design it instead"):
        obsynth.design_from_gains(plant, "functional-filter", T=[[1.0]])


@pytest.mark.parametrize(
    ("noise", "told"),
    [
        ("{level: -1}", ["method.options.R.level: must be at least 0, not the number -1. [line 12]"]),
        ("{level: one}", ["method.options.R.level: must be a number, not the text 'one'. [line 12]"]),
        ("[[1, 2], [3]]", ["method.options.R: row 2 has 1 entry, but row 1 has 2. [line 12]"]),
        ("one", ["method.options.R: must be a number, or a list of rows, such as [[1, 0], [0, 1]], or a mapping (key: "
                 "value), not the text 'one'. [line 12]"]),
    ],
)  # fmt: skip
def test_a_value_of_several_kinds_is_told_what_is_wrong_with_the_kind_that_it_is(tmp_path, noise, told):
    """A negative variance was told nine problems, of 'constrained-float' and 'tagged-union[...]'."""
    path = tmp_path / "spec.yaml"
    path.write_text(
        "schema_version: 1\nname: tank\nplant:\n  kind: dae\n  equations: {balance: der(h) = q - c * h}\n"
        "  outputs: {level: h}\n  states: {h: 1.0}\n  inputs: {q: 0.1}\n  parameters: {c: 0.1}\n"
        f"method:\n  id: dae-adaptive-observer\n  options: {{dt: 1.0, Q: 1.0e-6, R: {noise}}}\n"
    )
    with pytest.raises(SpecError) as caught:
        obsynth.load_spec(path)
    assert [line.strip().removeprefix("- ") for line in str(caught.value).splitlines()[1:]] == told


@pytest.mark.long
def test_a_gain_set_for_other_constants_than_those_of_the_spec_is_told(tmp_path, capsys):
    """After a calibration the gain set of the plant before it was evaluated on that plant, without a word."""
    text = (
        "schema_version: 1\nname: tank\nplant:\n  kind: dae\n  constants: {c: 0.1}\n"
        "  equations: {balance: der(h) = q - c * h - leak}\n  outputs: {level: h}\n  states: {h: 1.0}\n"
        "  inputs: {q: 0.1}\n  parameters: {leak: 0.0}\nscenario: {horizon: 20, noise: 1}\n"
        "method:\n  id: dae-adaptive-observer\n"
        "  options: {dt: 1.0, Q: 1.0e-6, R: 1.0e-4, initial_parameter_covariance: 1.0e-4}\n"
    )
    before, after, gains = (str(tmp_path / name) for name in ("before.yaml", "after.yaml", "g.json"))
    (tmp_path / "before.yaml").write_text(text)
    (tmp_path / "after.yaml").write_text(text.replace("{c: 0.1}", "{c: 0.125}"))
    assert main(["design", "--system", before, "--output", gains, "--quiet"]) == 0
    for spec, told in ((before, False), (after, True)):
        capsys.readouterr()
        assert main(["evaluate", "--system", spec, "--gains", gains, "--runs", "2", "--quiet"]) == 0
        assert ("(c 0.1 for 0.125): the plant of the gain set is used" in capsys.readouterr().err) is told


def test_an_array_without_axes_is_the_number_that_it_holds() -> None:
    plant = obsynth.DescriptorSystem(A=[[0.5]], C=[[1.0]], Bf=[[1.0]], Bd=[[0.1]], dt=1.0)
    assert obsynth.fault_estimation_filter(plant, gamma=np.array(0.9)).options["gamma"] == 0.9
    noisy = plant.replace(Bw=[[0.0]], Dw=[[0.1]])
    bounds = {"d1": np.array(0.1)}
    test = obsynth.guaranteed_test(noisy, samples=np.array(8), before=1, disturbance_bounds=bounds, noise_bound=3)
    assert test.samples == 8
    with pytest.raises(obsynth.SpecError, match=r"delay is 2\.0"):
        obsynth.optimal_filter(plant, delay=np.array(2.0))
    with pytest.raises(obsynth.SpecError, match=r"band is 2\.0"):
        obsynth.detection_filter(plant, band=np.array(2.0))
