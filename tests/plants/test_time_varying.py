"""Time-varying plants: three ways to give matrices, and every way to give them wrongly."""

from __future__ import annotations

import numpy as np
import pytest

from obsynth import DescriptorSystem, SpecError
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem

EXPRESSIONS = {
    "E": [[0, 0], [-1, "(k - 1) / k"]],
    "A": [[1, "-(k + 1) / (k + half)"], [0, "1 / (k + 1)"]],
    "B": [[1, 0], [0, 1]],
    "C": [[0, 1]],
    "Phi": [["1 - exp(-k / 30) * sin(0.1 * k)"], [1]],
}
STEPS = 12


def functions():
    return {
        "E": lambda k: [[0, 0], [-1, (k - 1) / k]],
        "A": lambda k: [[1, -(k + 1) / (k + 0.5)], [0, 1 / (k + 1)]],
        "B": lambda k: np.eye(2),
        "C": lambda k: [[0, 1]],
        "Phi": lambda k: [[1 - np.exp(-k / 30) * np.sin(0.1 * k)], [1]],
    }


def stacks():
    late = {"E", "C"}
    return {
        name: np.array([make(max(k, 1) if name in late else k) for k in range(STEPS + (name in late))], dtype=float)
        for name, make in functions().items()
    }


def by_expressions(**changes):
    return TimeVaryingDescriptorSystem(**{**EXPRESSIONS, "dt": 1.0, "constants": {"half": 0.5}, **changes})


def test_the_three_ways_agree() -> None:
    written = by_expressions(horizon=STEPS)
    called = TimeVaryingDescriptorSystem(**functions(), dt=1.0, horizon=STEPS)
    stacked = TimeVaryingDescriptorSystem(**stacks(), dt=1.0)
    assert (stacked.horizon, written.horizon) == (STEPS, STEPS)
    for name, sequence in written.matrices.items():
        first = 1 if name in ("E", "C") else 0
        for k in range(first, STEPS + first):
            np.testing.assert_array_equal(stacked.matrices[name].at(k), called.matrices[name].at(k))
            np.testing.assert_allclose(sequence.at(k), called.matrices[name].at(k), rtol=1e-15)


def test_shapes_names_and_defaults() -> None:
    plant = by_expressions(state_names=["a", "b"], units={"a": "m"})
    assert (plant.ne, plant.nx, plant.nu, plant.ny, plant.nq) == (2, 2, 2, 1, 1)
    assert plant.parameter_names == ("theta1",)
    assert plant.horizon is None
    assert not plant.is_time_invariant
    np.testing.assert_array_equal(plant.Psi.at(7), np.zeros((1, 1)))
    assert "no horizon" in repr(plant)


def test_rectangular_and_identity() -> None:
    plant = TimeVaryingDescriptorSystem([[1, 0, 0], [0, 1, 0]], np.ones((2, 3)), C=np.eye(3), dt=0.1)
    assert (plant.ne, plant.nx, plant.nq, plant.is_time_invariant) == (2, 3, 0, True)
    assert plant.Phi.at(0).shape == (2, 0)
    assert plant.Psi.at(0).shape == (3, 0)
    explicit = TimeVaryingDescriptorSystem(None, np.eye(2), C=np.eye(2), dt=0.1)
    np.testing.assert_array_equal(explicit.E.at(5), np.eye(2))


def test_as_dict_is_data_and_comes_back() -> None:
    plant = by_expressions(horizon=STEPS, units={"y1": "V"})
    again = TimeVaryingDescriptorSystem(**plant.as_dict())
    assert (again.horizon, again.units, again.constants) == (STEPS, {"y1": "V"}, {"half": 0.5})
    assert again.as_dict()["A"] == [["1.0", "-(k + 1) / (k + half)"], ["0.0", "1 / (k + 1)"]]
    for name in plant.matrices:
        np.testing.assert_array_equal(again.matrices[name].at(5), plant.matrices[name].at(5))
    with pytest.raises(SpecError, match="E is a Python function, and only data can be saved"):
        TimeVaryingDescriptorSystem(**functions(), dt=1.0).as_dict()


def test_replace_checks_again() -> None:
    plant = by_expressions(horizon=STEPS)
    assert plant.replace(C=np.eye(2), Psi=np.ones((2, 1)), output_names=["a", "b"]).ny == 2
    with pytest.raises(SpecError, match="Psi is 2 by 2, but 1 by 1 is needed"):
        plant.replace(Psi=np.eye(2))


def test_from_a_time_invariant_plant() -> None:
    plant = DescriptorSystem(
        np.diag([1.0, 0]), np.eye(2), [[1], [0]], np.eye(2), Bf=[[1], [2]], Df=[[0], [3]], dt=0.5,
        fault_names=["leak"], units={"leak": "kg/s"},
    )  # fmt: skip
    found = TimeVaryingDescriptorSystem.from_descriptor(plant)
    assert (found.parameter_names, found.dt, found.units) == (("leak",), 0.5, {"leak": "kg/s"})
    np.testing.assert_array_equal(found.Psi.at(3), [[0], [3]])
    direct = TimeVaryingDescriptorSystem.from_descriptor(plant.replace(D=[[1], [0]]))
    np.testing.assert_array_equal(direct.D.at(2), [[1], [0]])
    assert TimeVaryingDescriptorSystem(**direct.as_dict()).D.at(1).tolist() == [[1], [0]]
    for changes, part in (
        ({"dt": 0.0}, "continuous"),
        ({"Bd": [[1], [1]], "Dd": [[0], [0]]}, "disturbances"),
    ):
        with pytest.raises(SpecError, match=part):
            TimeVaryingDescriptorSystem.from_descriptor(plant.replace(**changes))


def growing(k):
    return np.eye(2) if k < 3 else np.eye(3)


def nan_at_5(k):
    return [[1.0, np.nan if k == 5 else 0.0], [0.0, 1.0]]


@pytest.mark.parametrize(
    ("changes", "part", "path"),
    [
        ({"A": growing, "horizon": 9}, r"A\(3\) is 3 by 3, but A was 2 by 2 before", "A(3)"),
        ({"A": nan_at_5, "horizon": 9}, r"A\(5\) has nan in row 1, column 2", "A(5)"),
        ({"A": lambda k: "text", "horizon": 9}, "At k = 0: A holds text", "A(0)"),
        ({"A": lambda k: 1j * np.eye(2)}, "complex numbers", "A(0)"),
        ({"E": [[1, "1 / (k - 4)"], [0, 1]], "horizon": 9}, r"E\(4\) has inf", "E(4)"),
        ({"E": [[1, "1 / k"], [0, "log(3 - k)"]], "horizon": 9}, r"At k = 3: E\(3\) has -inf", "E(3)"),
        ({"A": [[1, "j"], [0, 1]]}, "row 1, column 2: 'j' is unknown; the known names are: half, k, pi", "A"),
        ({"A": [[1, "1 +"], [0, 1]]}, "A, row 1, column 2: .*is not a valid expression", "A"),
        ({"A": [[1, "k"], [0]]}, "different lengths", "A"),
        ({"A": [[1, None], [0, "k"]]}, "row 1, column 2: None is neither", "A"),
        ({"A": [np.eye(2), np.eye(3)]}, "shapes must not change with k", "A"),
        ({"A": np.where(np.arange(5) == 3, np.nan, 1.0)[:, None, None] * np.eye(2)}, r"A\(3\) has nan", "A(3)"),
        ({"A": np.zeros((0, 2, 2))}, "at least 1 are needed", "A"),
        ({"C": np.zeros((1, 1, 2))}, "at least 2 are needed", "C"),
        ({"A": np.ones((3, 2)), "C": np.eye(2)}, "E is 2 by 2, but 3 by 2 is needed", "E"),
        ({"A": None}, "A is missing", "A"),
        ({"C": None}, "C is missing", "C"),
        ({"dt": 0.0}, "dt is 0", "dt"),
        ({"dt": -1.0}, "dt is -1", "dt"),
        ({"horizon": 0}, "horizon is 0", "horizon"),
        ({"horizon": True}, "horizon is True", "horizon"),
        ({"horizon": 10**9}, "1000000000 steps is too long for .*Leave the horizon out", "horizon"),
        ({"constants": {"k": 1.0}}, "constants names 'k'", "constants"),
        ({"constants": {"half": float("nan")}}, "'half' is nan", "constants.half"),
        ({"state_names": ["a"]}, r"1 name, but the plant has 2 states", "state_names"),
        ({"units": {"zz": "m"}}, "'zz', which is no signal", "units"),
    ],
)
def test_bad_input(changes: dict, part: str, path: str) -> None:
    with pytest.raises(SpecError, match=part) as caught:
        by_expressions(**changes)
    assert caught.value.path == path


def test_stacks_of_different_lengths() -> None:
    given = stacks()
    with pytest.raises(SpecError, match="E for 12, A for 11"):
        TimeVaryingDescriptorSystem(**{**given, "A": given["A"][:-1]}, dt=1.0)
    assert TimeVaryingDescriptorSystem(**{**given, "A": given["A"][:-1]}, dt=1.0, horizon=11).horizon == 11
    with pytest.raises(SpecError, match="horizon is 12, but the stack A is good for 11"):
        TimeVaryingDescriptorSystem(**{**given, "A": given["A"][:-1]}, dt=1.0, horizon=12)
    with pytest.raises(SpecError, match=r"A\(12\) is asked for, but the stack ends at 11"):
        TimeVaryingDescriptorSystem(**given, dt=1.0).A.at(12)


def test_several_problems_at_once() -> None:
    with pytest.raises(SpecError) as caught:
        by_expressions(B=np.ones((3, 1)), Psi=np.ones((2, 1)))
    assert len(caught.value.problems) == 2
