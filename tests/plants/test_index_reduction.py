"""The minimal proper form of plants of index 0 to 4, against forms that are known by construction."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import block_diag

import obsynth
from obsynth.plants.plant_units import PlantUnits
from obsynth.plants.transformations.index_reduction import reduced_index


def transfer(plant, s, kind):
    b, d = {"u": (plant.B, plant.D), "f": (plant.Bf, plant.Df), "d": (plant.Bd, plant.Dd)}[kind]
    return plant.C @ np.linalg.solve(s * plant.E - plant.A, b) + d


def integer(rng, *shape):
    return rng.integers(-3, 4, shape).astype(float)


def regular(rng, n):
    """A product of unit triangular matrices of whole numbers: its inverse holds whole numbers as well."""
    lower, upper = np.tril(rng.integers(-1, 2, (n, n)), -1), np.triu(rng.integers(-1, 2, (n, n)), 1)
    return (lower + np.eye(n)) @ (upper + np.eye(n))


def scrambled(rng, index, *, in_constraints):
    """A plant in Weierstrass form with blocks of this index, in coordinates and equations that are mixed; its minimal
    form ``A, [B Bf], C, [D Df]``. Signals enter the last row of a nilpotent block only (no derivative) or none."""
    n, ny = int(rng.integers(1, 4)), 2
    a, b, c = integer(rng, n, n) - 4 * np.eye(n), integer(rng, n, 2), integer(rng, ny, n)
    nilpotent = np.eye(max(index, 0), k=1)
    m = len(nilpotent)
    into, seen = np.zeros((m, 2)), integer(rng, ny, m)
    if in_constraints and m:
        into[0] = integer(rng, 2)
    e0 = np.block([[np.eye(n), np.zeros((n, m))], [np.zeros((m, n)), nilpotent]])
    a0 = np.block([[a, np.zeros((n, m))], [np.zeros((m, n)), np.eye(m)]])
    left, right = regular(rng, n + m), regular(rng, n + m)
    whole = left @ np.vstack([b, into])
    plant = obsynth.DescriptorSystem(
        E=left @ e0 @ right, A=left @ a0 @ right, B=whole[:, :1], Bf=whole[:, 1:], C=np.hstack([c, seen]) @ right
    )
    # N v' = v + c q with N c = 0: v = -c q.
    return plant, (a, b, c, -seen @ into)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("in_constraints", [False, True])
@pytest.mark.parametrize("index", [0, 1, 2, 3, 4])
@pytest.mark.parametrize("seed", range(6))
def test_the_minimal_form_is_that_of_the_construction(index, in_constraints, seed):
    rng = np.random.default_rng([seed, index, in_constraints])
    plant, (a, b, c, d) = scrambled(rng, index, in_constraints=in_constraints)
    assert obsynth.analyse_structure(plant).index == index
    found = reduced_index(plant)
    assert found.plant.nx == len(a)
    for s in (0.7, 1.0 + 2.0j, -0.3 + 5.0j):
        wanted = c @ np.linalg.solve(s * np.eye(len(a)) - a, b) + d
        assert np.allclose(transfer(found.plant, s, "u"), wanted[:, :1], rtol=1e-9, atol=1e-9)
        assert np.allclose(transfer(found.plant, s, "f"), wanted[:, 1:], rtol=1e-9, atol=1e-9)
    # All states of the plant come back: E x' = A x + B u holds along the reduced plant.
    x, u, f, rate = rng.standard_normal(found.plant.nx), *rng.standard_normal((2, 1)), np.zeros(1)
    back, new = found.recovery, found.plant
    states = back.from_state @ x + back.from_input @ u + back.from_fault @ f
    speed = back.from_state @ (new.A @ x + new.B @ u + new.Bf @ f)
    assert np.allclose(plant.E @ (speed + back.from_input @ rate), plant.A @ states + plant.B @ u + plant.Bf @ f)


@pytest.mark.parametrize("in_constraints", [False, True])
@pytest.mark.parametrize("index", [2, 3, 4])
@pytest.mark.parametrize("seed", range(3))
def test_computed_numbers_are_reduced_in_floating_point(index, in_constraints, seed):
    rng = np.random.default_rng([seed, index, in_constraints, 7])
    plant, (a, b, c, d) = scrambled(rng, index, in_constraints=in_constraints)
    # Equations and unknowns turned, and in units that differ by decades: nothing is exactly singular any more.
    turns = [np.linalg.qr(rng.standard_normal((plant.nx, plant.nx)))[0] for _ in range(2)]
    rows, columns = (
        turns[0] * 10.0 ** rng.uniform(-3, 3, plant.nx)[:, None],
        turns[1] * 10.0 ** rng.uniform(-2, 2, plant.nx),
    )
    turned = obsynth.DescriptorSystem(
        E=rows @ plant.E @ columns, A=rows @ plant.A @ columns, B=rows @ plant.B, Bf=rows @ plant.Bf,
        C=plant.C @ columns,
    )  # fmt: skip
    found = reduced_index(turned)
    assert found.plant.nx == len(a)
    for s in (0.7, 1.0 + 2.0j, -0.3 + 5.0j):
        wanted = c @ np.linalg.solve(s * np.eye(len(a)) - a, b) + d
        assert np.allclose(transfer(found.plant, s, "u"), wanted[:, :1], rtol=1e-7, atol=1e-7)
        assert np.allclose(transfer(found.plant, s, "f"), wanted[:, 1:], rtol=1e-7, atol=1e-7)
    back, new = found.recovery, found.plant
    x, u, f, rate = rng.standard_normal(new.nx), *rng.standard_normal((2, 1)), np.zeros(1)
    states = back.from_state @ x + back.from_input @ u + back.from_fault @ f
    speed = back.from_state @ (new.A @ x + new.B @ u + new.Bf @ f) + back.from_input @ rate
    right = turned.A @ states + turned.B @ u + turned.Bf @ f
    sizes = np.abs(turned.A) @ np.abs(states) + np.abs(turned.E) @ np.abs(speed)
    assert (np.abs(turned.E @ speed - right) <= 1e-8 * sizes).all()


def rounded_sums(seed, *, proper):
    """A plant of index 2 to 4 of which E holds whole numbers and A rounded sums of thirds, and its finite modes; not
    ``proper``: a fault enters every equation."""
    rng = np.random.default_rng([46, seed])
    n, m = int(rng.integers(1, 4)), int(rng.integers(2, 5))
    e0, a0 = np.zeros((n + m, n + m)), np.eye(n + m)
    e0[:n, :n], e0[n:, n:] = np.eye(n), np.eye(m, k=1)
    a0[:n, :n] = np.round(rng.standard_normal((n, n)), 1) / 3.0
    left, right = regular(rng, n + m), regular(rng, n + m)
    acting = np.vstack([integer(rng, n + 1, 2), np.zeros((m - 1, 2))]) / 3.0
    if not proper:
        acting[:, 1] = 1.0 / 3.0
    plant = obsynth.DescriptorSystem(
        E=left @ e0 @ right, A=left @ a0 @ right, C=(1.0 + rng.random((2, n + m))) @ right, dt=1.0,
        B=left @ acting[:, :1], Bf=left @ acting[:, 1:],
    )  # fmt: skip
    return plant, n


@pytest.mark.long
def test_rounding_of_a_does_not_make_algebraic_equations_solvable():
    # Those that only the last digits of A make regular were solved, and the result was another plant.
    for seed in range(12):
        plant, modes = rounded_sums(seed, proper=True)
        reduced = obsynth.eliminate_algebraic_states(plant).plant
        assert reduced.nx == modes
        for s in (1.7, 0.3 + 1.2j):
            for kind in ("u", "f"):
                np.testing.assert_allclose(transfer(reduced, s, kind), transfer(plant, s, kind), rtol=1e-6, atol=1e-6)
        plant, _ = rounded_sums(seed, proper=False)
        with pytest.raises(obsynth.PreconditionError, match="later sample of 'f1'"):
            obsynth.eliminate_algebraic_states(plant)


def test_an_output_that_needs_a_derivative_names_the_signal():
    """The speed is measured of a mass whose position is moved by an unknown signal."""
    plant = obsynth.DescriptorSystem(
        E=np.diag([1.0, 1.0, 0.0]), A=[[0, 1, 0], [-2, -1, 1], [1, 0, 0]], C=[[0, 1, 0]], Bf=[[0], [0], [-1]],
        fault_names=["stroke"], output_names=["speed"],
    )  # fmt: skip
    with pytest.raises(obsynth.PreconditionError, match="output 'speed' needs the derivative of 'stroke'") as caught:
        obsynth.eliminate_algebraic_states(plant)
    assert caught.value.signals == ("speed", "stroke")


@pytest.mark.long
def test_an_output_that_needs_a_derivative_of_an_unknown_input_is_left_out_and_the_rest_works():
    e, a = np.diag([1.0, 1.0, 0.0, 1.0]), np.array([[0.0, 1, 0, 0], [-2, -1, 1, 0], [1, 0, 0, 0], [0, 0, 0, -1]])
    plant = obsynth.DescriptorSystem(
        e, a, C=[[0, 1, 0, 0], [1, 0, 0, 1]], Bf=[[0], [0], [0], [1]], Bd=[[0], [0], [-1], [0]], Dd=[[0], [-1]],
        fault_names=["f"], output_names=["speed", "sum"], disturbance_names=["stroke"],
    )  # fmt: skip
    design = obsynth.pd_observer(plant)
    assert design.plant.output_names == ("sum",)
    assert any("The output 'speed' needs the derivative of 'stroke': it is left out" in note for note in design.notes)
    (row,) = (row for row in obsynth.check(plant)["pd-observer"].checks if row.name == "exists: proper form")
    assert "'speed' needs the derivative of 'stroke'" in row.detail
    # This one takes the plant as it is.
    assert obsynth.functional_filter(plant).plant.output_names == ("speed", "sum")


def test_tolerances_do_not_follow_a_reduced_index():
    given = bar("position")
    rows = given.A.tolist()
    rows[2][0] = "-k"
    plant = obsynth.uncertain_system(
        {"E": given.E, "A": rows, "C": given.C, "Bf": given.Bf}, {"k": {"nominal": 2.0, "range": [1.9, 2.1]}}
    )
    found = obsynth.eliminate_algebraic_states(plant).plant
    assert found.uncertainty.lost == "its index was reduced"
    note = next(note for note in obsynth.ui_pi_observer(plant).notes if "not carried over" in note)
    # It advised an elimination, which reduces the index in the same way.
    assert "Eliminate" not in note


def test_constants_without_tolerances_lose_none_with_the_index():
    """Named constants without tolerances gave the note 'The tolerances of the constants () are not carried over'."""
    given = bar("position")
    rows = given.A.tolist()
    rows[2][0] = "-k"
    plant = obsynth.uncertain_system({"E": given.E, "A": rows, "C": given.C, "Bf": given.Bf}, {"k": 2.0})
    assert obsynth.eliminate_algebraic_states(plant).plant.uncertainty is None
    assert not any("not carried over" in note for note in obsynth.ui_pi_observer(plant).notes)


def bar(level, **more):
    """Two masses joined by a rigid bar; a force on the first is a fault."""
    e, a = np.diag([1.0, 1, 1, 1, 0]), np.zeros((5, 5))
    a[0, 2] = a[1, 3] = 1
    a[2], a[3] = [-2, 0, -0.5, 0, -1], [0, -2, 0, -0.5, 1]
    a[4, {"position": 0, "speed": 2}[level]], a[4, {"position": 1, "speed": 3}[level]] = 1, -1
    names = {"state_names": ["q1", "q2", "v1", "v2", "lambda"], "fault_names": ["force"]}
    return obsynth.DescriptorSystem(E=e, A=a, C=np.eye(5)[:1], Bf=np.eye(5)[:, 2:3], **names, **more)


def test_a_rigid_bar_has_the_minimal_form_of_one_mass():
    found = obsynth.eliminate_algebraic_states(bar("position"))
    assert found.plant.state_names == ("q1", "v1")
    assert np.array_equal(found.plant.A, [[0, 1], [-2, -0.5]])
    assert np.array_equal(found.plant.Bf, [[0], [0.5]])
    # The force in the bar is half of that on the first mass, as the other half moves it.
    assert np.array_equal(found.recovery.from_state, [[1, 0], [1, 0], [0, 1], [0, 1], [0, 0]])
    assert np.array_equal(found.recovery.from_fault, [[0], [0], [0], [0], [0.5]])
    assert found.dropped == ()


@pytest.mark.one_in(3)
@pytest.mark.parametrize("method", ["ui-pi-observer", "pd-observer", "functional-filter"])
def test_methods_take_a_mechanism_at_position_level_as_its_minimal_form(method):
    own = obsynth.design(bar("position"), method)
    minimal = obsynth.design(
        obsynth.DescriptorSystem(
            A=[[0, 1], [-2, -0.5]], C=[[1, 0]], Bf=[[0], [0.5]], state_names=["q1", "v1"], fault_names=["force"]
        ),
        method,
    )
    assert own.report.passed
    assert own.recovery.names == ("q1", "q2", "v1", "v2", "lambda")
    for claim, value in minimal.certificate.claims.items():
        assert np.isclose(own.certificate.claims[claim], value, rtol=1e-6)
    assert obsynth.check(bar("position"))[method].passed


def test_an_output_of_constrained_states_alone_shows_nothing_of_computed_coordinates():
    # x1' = -x1 + f and x2 = x3 = 0 (index 2) in rotated coordinates; the second output shows x2 and x3 alone.
    rng = np.random.default_rng(7)
    left, right = (np.linalg.qr(rng.standard_normal((3, 3)))[0] for _ in range(2))
    e = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, 0, 0]])
    a = np.array([[-1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]])
    for unit in (1.0, 1e9):
        plant = obsynth.DescriptorSystem(
            left @ e @ right,
            left @ a @ right,
            Bf=left @ np.array([[1.0], [0.0], [0.0]]),
            C=np.diag([1.0, unit]) @ np.array([[1.0, 0, 0], [0, 2.0, 3.0]]) @ right,
        )
        reduced = obsynth.eliminate_algebraic_states(plant).plant
        assert reduced.nx == 1
        assert reduced.C[0, 0] != 0.0
        assert reduced.C[1, 0] == 0.0
        assert obsynth.functional_filter(plant, decay=0.5).report.passed


@pytest.mark.one_in(3)
@pytest.mark.parametrize("method", ["pd-observer", "ui-pi-observer", "functional-filter"])
def test_a_refusal_of_a_reduced_plant_names_what_was_left_out_and_states_as_written(method):
    # x1 + f = 0 and x2 = x1': the second output is the derivative of the fault.
    plant = obsynth.DescriptorSystem(
        np.diag([1.0, 0.0, 1.0]),
        [[0, 1.0, 0], [1.0, 0, 0], [0, 1.0, -1.0]],
        [[0.0], [0.0], [1.0]],
        C=[[0, 0, 1.0], [0, 1.0, 0]],
        Bf=[[0.0], [-1.0], [0.0]],
        fault_names=["leak"],
    )
    with pytest.raises(
        obsynth.PreconditionError, match="'y2' needs the derivative of 'leak': it is left out"
    ) as caught:
        obsynth.design(plant, method)
    assert "No observer of this kind exists" not in str(caught.value)
    assert caught.value.add == (("x1",),)
    # The remedy was tried: x1 measured, the design exists.
    measured = plant.replace(
        C=[[0, 0, 1.0], [0, 1.0, 0], [1.0, 0, 0]], D=np.zeros((3, 1)), Df=np.zeros((3, 1)), Dd=np.zeros((3, 0)),
        Dw=np.zeros((3, 0)), output_names=["y1", "y2", "x1 measured"],
    )  # fmt: skip
    assert obsynth.design(measured, method).report.passed


@pytest.mark.parametrize("seed", range(4))
def test_computed_numbers_leave_no_rounding_between_states_that_are_not_linked(seed: int) -> None:
    """Two lags in series of each output drive nothing: the units of the reduced plant were those of rounding, 2^52."""
    rng = np.random.default_rng([47, seed])
    n, ny = 3, 2
    modes = rng.standard_normal((n, n)) - 3.0 * np.eye(n)
    e0, a0 = block_diag(np.eye(n), np.eye(3, k=1)), block_diag(modes, np.eye(3))
    left, right = rng.standard_normal((2, n + 3, n + 3))
    none, lag = np.zeros((ny, ny)), -np.eye(ny)
    states = np.zeros((n + 3, ny))
    plant = obsynth.DescriptorSystem(
        E=block_diag(left @ e0 @ right, np.eye(2 * ny)),
        A=np.block(
            [
                [left @ a0 @ right, states, states],
                [rng.standard_normal((ny, n + 3)), lag, none],
                [states.T, -lag, lag],
            ]
        ),
        C=np.hstack([states.T, none, np.eye(ny)]),
        Bf=np.vstack([rng.standard_normal((n + 3, 1)), np.zeros((2 * ny, 1))]),
        dt=0.0,
    )
    reduced = reduced_index(plant).plant
    for s in (0.4j, 3.0j):
        assert transfer(reduced, s, "f") == pytest.approx(transfer(plant, s, "f"), rel=1e-9)
    first, second = reduced.A[-2 * ny : -ny], reduced.A[-ny:]
    assert not first[:, -ny:].any()
    assert not second[:, : -2 * ny].any()
    assert not reduced.A[: -2 * ny, -2 * ny :].any()
    units = PlantUnits.of(reduced)
    assert units.spread < 1e3
