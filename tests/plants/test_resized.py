"""Plants with matrices of another size: what has no entries and numbered names follow, names of users do not."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

import obsynth
from obsynth.errors import SpecError

PLANT = obsynth.DescriptorSystem(A=0.5 * np.eye(2), B=[[1], [0]], C=np.eye(2), Bf=[[1], [0]], dt=1.0)

CHANGES = {
    "an unknown input": ({"Bd": [[1], [0]]}, (1, 2, 1, 1, 0)),
    "two faults": ({"Bf": np.eye(2)}, (1, 2, 2, 0, 0)),
    "no fault": ({"Bf": None}, (1, 2, 0, 0, 0)),
    "no input": ({"B": None}, (0, 2, 1, 0, 0)),
    "noise of sensors": ({"Dw": np.eye(2)}, (1, 2, 1, 0, 2)),
    "one sensor": ({"C": [[1, 0]]}, (1, 1, 1, 0, 0)),
    "faults of states by name": ({"Bf": ["x1", "x2"]}, (1, 2, 2, 0, 0)),
    "three states": (
        {"A": 0.5 * np.eye(3), "B": np.ones((3, 2)), "C": np.eye(3), "Bf": np.ones((3, 1))},
        (2, 3, 1, 0, 0),
    ),
}


@pytest.mark.parametrize("name", CHANGES)
def test_what_has_no_entries_and_numbered_names_follow(name: str) -> None:
    changes, sizes = CHANGES[name]
    plant = PLANT.replace(**changes)
    assert (plant.nu, plant.ny, plant.nf, plant.nd, plant.nw) == sizes
    np.testing.assert_array_equal(plant.E, np.eye(plant.nx))
    assert plant.input_names == tuple(f"u{i + 1}" for i in range(plant.nu))
    for matrix, given in changes.items():
        if given is not None and not isinstance(given[0], str):
            np.testing.assert_array_equal(getattr(plant, matrix), given)


def test_sparse_matrices_follow_as_dense_ones_do() -> None:
    sparse = PLANT.replace(A=scipy.sparse.csr_array(PLANT.A), C=scipy.sparse.csr_array(PLANT.C))
    for changes, sizes in CHANGES.values():
        plant = sparse.replace(**changes)
        assert (plant.nu, plant.ny, plant.nf, plant.nd, plant.nw) == sizes


def test_names_that_a_user_gave_stay_with_their_signals_or_are_asked_for() -> None:
    named = PLANT.replace(input_names=["pump"], fault_names=["leak"], units={"leak": "kg/s"})
    assert named.replace(Bf=[[1], [1]]).fault_names == ("leak",)
    assert named.replace(Bd=[[1], [0]]).input_names == ("pump",)
    gone = named.replace(Bf=None)
    assert gone.fault_names == ()
    assert "leak" not in gone.units
    with pytest.raises(SpecError, match="input_names has 1 name, but the plant has 2 known inputs"):
        named.replace(B=np.eye(2))


def test_what_has_entries_is_not_resized() -> None:
    with_feedthrough = PLANT.replace(D=[[1], [0]])
    with pytest.raises(SpecError, match="D is 2 by 1, but 2 by 2 is needed"):
        with_feedthrough.replace(B=np.eye(2))
    # The sensors' part of a fault stays when that of the dynamics goes.
    assert PLANT.replace(Df=[[0], [1]]).replace(Bf=None).nf == 1


def test_faults_of_sensors_are_added_to_those_of_the_dynamics() -> None:
    assert PLANT.replace(Df=["y2"]).fault_names == ("f1", "y2")


NOISY = obsynth.DescriptorSystem(
    A=-np.eye(2), C=np.eye(2), Bf=[[1], [0]], Bw=[[0.1], [0.0]], Dw=[[0.0], [0.3]],
    noise_names=["wind"], output_names=["speed", "angle"], sensor_noise={"speed": 0.1, "angle": 0.2},
)  # fmt: skip


@pytest.mark.parametrize(
    ("stated", "names", "Dw"),
    [
        ({"speed": 0.5}, ("wind", "noise angle", "noise speed"), [[0.0, 0.0, 0.5], [0.3, 0.2, 0.0]]),
        ({"angle": 0.5, "speed": 0.4}, ("wind", "noise angle", "noise speed"), [[0.0, 0.0, 0.4], [0.3, 0.5, 0.0]]),
        (None, ("wind",), [[0.0], [0.3]]),
    ],
)
def test_noise_of_sensors_takes_the_place_of_what_was_stated_of_them(stated, names, Dw) -> None:
    plant = NOISY.replace(sensor_noise=stated)
    assert plant.noise_names == names
    np.testing.assert_array_equal(plant.Dw, Dw)
    np.testing.assert_array_equal(plant.Bw[:, 0], [0.1, 0.0])
    assert not plant.Bw[:, 1:].any()


def test_noise_with_a_colour_takes_the_place_of_the_white_one() -> None:
    made, _ = obsynth.with_noise(NOISY, sensor_noise={"speed": {"deviation": 0.1, "correlation": 2.0}})
    new = made.plant
    assert new.noise_names.count("noise speed") == 1
    white = new.Dw[0, new.noise_names.index("noise speed")]
    assert white == pytest.approx(0.001)  # a hundredth beside it, and no longer 0.1
    assert new.Dw[1, new.noise_names.index("noise angle")] == 0.2


def test_names_of_sensor_noise_follow_other_columns() -> None:
    plant = PLANT.replace(sensor_noise={"y1": 0.1, "y2": 0.2}).replace(Dw=[[0.5], [0.0]])
    assert plant.noise_names == ("w1",)
