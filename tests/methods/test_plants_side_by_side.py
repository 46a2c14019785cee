"""Two plants that do not touch, as one: what each of them has, both have; and inputs that no equation of T holds."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.linalg

import obsynth
from obsynth.plants.transformations.redundant_outputs import nearly_merged_outputs

#: With an algebraic state, without which two of the three outputs are one.
FIRST: dict[str, Any] = {
    "E": np.diag([1.0, 1.0, 0.0]),
    # Sums, whose last digits leave rounding wherever something is decomposed.
    "A": 0.4 * np.array([[1.5, -1.0, 0.0], [1.5, -1.0, 1.0], [2.0, 0.5, 1.5]]) - np.eye(3),
    "C": [[-1.5, 1.0, 0.5], [-0.5, -0.5, 0.5], [-1.5, -1.0, 1.5]],
    "Bf": [[-1.5], [1.0], [0.0]],
    "Bd": [[0.0], [-0.5], [0.5]],
}
SECOND: dict[str, Any] = {
    "E": np.eye(3),
    "A": 0.4 * np.array([[0.0, 1.5, -1.0], [1.5, 1.0, 1.5], [1.5, 0.0, 0.0]]) - np.eye(3),
    "C": [[-1.5, 2.0, 0.5], [1.0, -1.5, 0.5], [-2.0, 1.0, 0.0]],
    "Bf": [[2.0], [1.5], [1.0]],
    "Bd": np.zeros((3, 0)),
}


def both() -> obsynth.DescriptorSystem:
    return obsynth.DescriptorSystem(
        **{name: scipy.linalg.block_diag(np.array(FIRST[name]), np.array(SECOND[name])) for name in FIRST}
    )


@pytest.mark.one_in(3)
@pytest.mark.parametrize("method", ["ui-pi-observer", "functional-filter", "pd-observer"])
def test_what_each_has_both_have_and_neither_sees_the_other(method: str) -> None:
    design = obsynth.design(both(), method)
    assert design.report.passed
    plant, observer = design.linear
    steady = -np.linalg.solve(plant.A, plant.Bf)
    outputs = plant.C @ steady + plant.Df
    state = -np.linalg.solve(observer.Az, observer.By @ outputs)
    estimates = (observer.Cz @ state + observer.Dy @ outputs)[observer.fault_rows]
    np.testing.assert_allclose(estimates, np.eye(2), atol=1e-6)


def test_nearly_equal_outputs_of_one_plant_are_merged_without_those_of_the_other() -> None:
    copied = np.vstack([both().C, both().C[3] * (1.0 + 1e-9), both().C[0] + 1e-9 * both().C[1]])
    near = nearly_merged_outputs(obsynth.DescriptorSystem(E=both().E, A=both().A, C=copied))
    assert near is not None
    of_first, of_second = (np.any(near.plant.C[:, part] != 0.0, axis=1) for part in (slice(3), slice(3, 6)))
    assert not np.any(of_first & of_second)


@pytest.mark.parametrize("dt", [0.0, 1.0])
def test_rounding_of_t_where_an_unknown_input_enters_is_judged_by_the_size_of_t(dt: float) -> None:
    """T is (1, -1, 0): the second unknown input enters the third equation alone, whose column of T is rounding."""
    A = np.array([[-1.2, -0.4, -0.6], [0.0, -0.8, 0.2], [0.0, -0.2, -0.8]])
    plant = obsynth.DescriptorSystem(
        A=A + dt * np.eye(3),
        C=[[0.5, 0.0, 0.0], [-1.0, 0.5, 1.5], [0.0, -1.0, 0.5]],
        Bf=[[-1.0], [1.0], [0.0]],
        Bd=[[0.5, 0.0], [0.5, 0.0], [-1.5, -2.0]],
        Dw=0.1 * np.eye(3),
        dt=dt,
    )
    assert obsynth.ui_pi_observer(plant).report.passed
