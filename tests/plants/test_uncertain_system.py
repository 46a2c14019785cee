"""Constants with tolerances: what is read, what is refused, and that families of matrices hold every plant."""

from __future__ import annotations

import numpy as np
import pytest
from uncertain_plants import drive, wang

import obsynth
from obsynth.errors import PreconditionError, SpecError
from obsynth.numerics.expressions import parse_expression
from obsynth.plants.transformations.fault_states import augment_faults
from obsynth.plants.transformations.uncertain_plant import affine_plant
from obsynth.plants.uncertainty import UNCERTAIN_MATRICES
from obsynth.proofs.affine import AffineMatrix, affine_exponential, affine_inverse
from obsynth.proofs.affine_numbers import AffineNumber, affine_translation
from obsynth.verification.over_tolerances.plants_of_the_box import drawn_points, plant_at
from obsynth.verification.over_tolerances.subdivision import index_one_on_box

ONE = {"E": None, "A": [["1 - 0.1 * k / m"]], "C": [[1]], "dt": 0.1}


def test_nominal_values_and_ranges() -> None:
    plant = obsynth.uncertain_system(ONE, {"k": {"nominal": 2.0, "tolerance": "5 %", "unit": "N/m"}, "m": (0.9, 1.2)})
    assert pytest.approx(1.0 - 0.2 / 1.05) == plant.A
    box = plant.uncertainty.box
    assert box.names == ("k", "m")
    assert (box.constants["k"].low, box.constants["k"].high) == pytest.approx((1.9, 2.1))
    assert box.constants["k"].unit == "N/m"
    assert box.sentence == "a constant outside its stated tolerance"


@pytest.mark.parametrize(
    ("constants", "words"),
    [
        ({"k": {"nominal": 0.0, "tolerance": "5 %"}, "m": 1.0}, "zero, which has no per cent"),
        ({"k": {"range": [1.0, float("inf")]}, "m": 1.0}, "needs both ends"),
        ({"k": {"range": [1.0]}, "m": 1.0}, "needs both ends"),
        ({"k": {"range": [1.0, None]}, "m": 1.0}, "needs both ends"),
        ({"k": {"nominal": 2.0, "tolerance": 5}, "m": 1.0}, "5 %"),
        ({"k": {"nominal": 2.0, "tolerance": "five"}, "m": 1.0}, "per cent"),
        ({"k": {"nominal": 2.0, "tolerance": "-5 %"}, "m": 1.0}, "per cent"),
        ({"k": 2.0}, "unknown name 'm'"),
        ({"k": 2.0, "m": 1.0, "spring": (1.0, 2.0)}, "'spring' appears in no matrix"),
        ({"k": {"nominal": 3.0, "range": [1.0, 2.0]}, "m": 1.0}, "outside its range"),
        ({"k": {"nominal": 2.0, "tolerance": "5 %", "range": [1.0, 2.0]}, "m": 1.0}, "both"),
        ({"k": {"nominal": 2.0, "spread": 1.0}, "m": 1.0}, "no key 'spread'; there are: nominal"),
    ],
)  # fmt: skip
def test_refused_constants(constants: dict, words: str) -> None:
    with pytest.raises(SpecError, match=words):
        obsynth.uncertain_system(ONE, constants)


def test_a_divisor_that_can_be_zero_is_refused() -> None:
    plant = obsynth.uncertain_system(ONE, {"k": 2.0, "m": {"range": [-0.5, 1.5], "nominal": 1.0}})
    with pytest.raises(PreconditionError, match="can be zero"):
        affine_plant(plant)


def test_entrywise_tolerances_are_unknowns_of_their_own() -> None:
    plant = wang()
    assert len(plant.uncertainty.box.names) == 12
    assert plant.uncertainty.box.names[0] == "A[1,1]"
    family = affine_plant(plant)
    assert np.abs(family.A.parts).sum(axis=0) == pytest.approx(0.02 * np.abs(plant.A))
    with pytest.raises(SpecError, match="is no matrix"):
        obsynth.uncertain_system(plant.replace(uncertainty=None), tolerance={"Q": "2 %"})


def test_a_constant_may_have_the_letter_of_a_matrix_where_an_entry_names_it() -> None:
    # A capacitance: taken as a tolerance of the matrix C, its own entry was then an unknown name.
    rows = {"E": [["C"]], "A": [["-1 / R"]], "C": [[1.0]]}
    exact = obsynth.uncertain_system(rows, {"C": 2.0e-4, "R": {"nominal": 5.0, "tolerance": "2 %"}})
    assert exact.E.tolist() == [[2.0e-4]]
    assert exact.uncertainty.box.names == ("R",)
    capacitance = {"nominal": 2.0e-4, "tolerance": "1 %"}
    assert obsynth.uncertain_system(rows, {"C": capacitance, "R": 5.0}).uncertainty.box.names == ("C",)
    # Where no entry names it, it is a tolerance of every entry, as before.
    assert obsynth.uncertain_system({"E": None, "A": [[0.5]], "C": [[1.0]]}, {"C": "2 %"}).uncertainty.box.names == (
        "C[1,1]",
    )


def test_new_tolerances_of_a_plant_keep_its_nominal_values() -> None:
    wider = obsynth.uncertain_system(drive(), {"k": {"tolerance": "10 %"}})
    assert wider.uncertainty.box.constants["k"].high == pytest.approx(22.0)
    assert wider.uncertainty.box.constants["c"].high == pytest.approx(0.21)
    with pytest.raises(SpecError, match="another plant"):
        obsynth.uncertain_system(drive(), {"k": {"nominal": 25.0, "tolerance": "10 %"}})


def test_tolerances_of_entries_are_stated_anew() -> None:
    """The name of an entry, such as A[1,1], is no expression: stating another variation ended in an error of that."""
    plant = obsynth.uncertain_system(wang(), tolerance={"A": "2 %"})
    again = obsynth.uncertain_system(plant, variation="varying")
    assert (again.uncertainty.box.variation, again.uncertainty.used) == ("varying", plant.uncertainty.used)


def test_a_box_says_where_it_comes_from() -> None:
    plant = drive(source="calibrated", level=0.95, digest="ab" * 32)
    assert plant.uncertainty.box.sentence == "a constant outside its 95 % box of the log abababababab"
    with pytest.raises(SpecError, match="probability"):
        drive(source="calibrated")


def test_tolerances_go_through_a_gain_set_and_are_dropped_with_other_matrices(tmp_path) -> None:
    design = obsynth.fault_estimation_filter(drive())
    again = obsynth.load(design.save(tmp_path / "g.json")).plant.uncertainty
    assert again.box.as_dict() == design.plant.uncertainty.box.as_dict()
    assert again.steps == (("eliminate", 0.0), ("sample", 0.02))
    changed = design.plant.replace(A=2.0 * design.plant.A)
    assert changed.uncertainty.lost == "A was changed"
    names = {"disturbance_bounds": changed.disturbance_names, "initial_set": changed.state_names}
    bounds = {option: dict.fromkeys(given, 1.0) for option, given in names.items()}
    for use in (
        affine_plant,
        lambda plant: plant_at(plant, {}),
        index_one_on_box,
        lambda plant: obsynth.robustness(design.replace(plant=plant)),
        lambda plant: obsynth.online_monitor(design.replace(plant=plant), noise_bound=3.0, **bounds),
    ):
        with pytest.raises(PreconditionError, match="not carried over: A was changed"):
            use(changed)


@pytest.mark.parametrize("make", [drive, wang])
def test_every_plant_of_the_box_is_inside_its_family(make) -> None:
    plant = make()
    family, box = affine_plant(plant), plant.uncertainty.box
    points = drawn_points(len(box.names), 60, 3)
    used = 0.0
    for q in points:
        exact = plant_at(plant, box.values(q))
        for name in UNCERTAIN_MATRICES:
            matrix = family.matrices[name]
            wanted = getattr(exact, name)
            wanted = wanted @ family.coordinates if name in ("E", "A", "C") else wanted
            missed = np.abs(wanted - matrix.at(q))
            # The exact plant itself is computed in double precision.
            assert np.all(missed <= matrix.radius + 1e-14 * (1.0 + matrix.magnitude))
            used = max(used, float(np.max(missed / np.maximum(matrix.radius, 1e-9), initial=0.0)))
    # The remainders are not a hundred times too wide: some plant uses most of them.
    assert make is wang or used > 0.3


@pytest.mark.parametrize(
    "text",
    ["a*b + 1", "a / b", "sqrt(a) * sin(b)", "exp(-a) + cos(a*b)", "a**3 - b**-2", "log(a + b)", "tanh(a) + atan(b)",
     "abs(a*b - 5)", "min(a*a, 10)", "max(a, b*b)", "where(a > 0, b*b, 1/a)", "a**0.5 * log10(b)", "tan(a/4)",
     "asin(a/4) + acos(b/4)", "cosh(a) - sinh(b)", "2**a"],
)  # fmt: skip
def test_expressions_enclose_their_values(text: str) -> None:
    a = AffineNumber(1.0, np.array([0.1, 0.0]), 0.01)
    b = AffineNumber(1.3, np.array([0.05, 0.1]), 0.0)
    expression = parse_expression(text)
    found = expression.translated({"a": a, "b": b}, affine_translation(2))
    generator = np.random.default_rng(1)
    widest = 0.0
    for _ in range(400):
        q = generator.choice([-1.0, 1.0], 2) if generator.random() < 0.5 else generator.uniform(-1.0, 1.0, 2)
        values = {"a": 1.0 + 0.1 * q[0] + generator.uniform(-0.01, 0.01), "b": 1.3 + q @ b.parts}
        missed = abs(float(expression(values)) - (found.center + q @ found.parts))
        assert missed <= found.radius + 1e-14
        widest = max(widest, missed)
    assert widest >= 0.05 * found.radius


def test_inverse_and_exponential_hold_those_of_members() -> None:
    generator = np.random.default_rng(5)
    matrix = AffineMatrix(
        generator.normal(size=(4, 4)) + 4.0 * np.eye(4), 0.05 * generator.normal(size=(3, 4, 4)), np.full((4, 4), 1e-3)
    )
    from scipy.linalg import expm

    inverse, exponential = affine_inverse(matrix), affine_exponential(matrix.scaled(0.3))
    for _ in range(200):
        q = generator.choice([-1.0, 1.0], 3)
        member = matrix.at(q) + 1e-3 * generator.choice([-1.0, 1.0], (4, 4))
        assert np.all(np.abs(np.linalg.inv(member) - inverse.at(q)) <= inverse.radius)
        assert np.all(np.abs(expm(0.3 * member) - exponential.at(q)) <= exponential.radius)
    with pytest.raises(PreconditionError, match="not proved regular"):
        affine_inverse(AffineMatrix(np.eye(2), np.ones((1, 2, 2)), np.zeros((2, 2))))


def test_a_method_that_eliminates_by_itself_keeps_the_tolerances() -> None:
    """What the method eliminates in its own units is the plant that is eliminated first: its tolerances go along."""
    plant = obsynth.uncertain_system(
        {
            "E": [[1, 0, 0], [0, 1, 0], [0, 0, 0]], "A": [["0.5 * p", 0.1, 0.2], [0.1, 0.4, 0.3], [1.0, 0.5, 2.0]],
            "Bf": [[1], [0], [0]], "Bd": [[0], [1], [1]], "C": [[1, 0, 0], [0, 1, 0]], "dt": 1.0,
        },
        {"p": {"nominal": 1.0, "tolerance": "5 %"}},
    )  # fmt: skip
    design = obsynth.ui_pi_observer(plant)
    assert design.plant.uncertainty.steps == (("eliminate", 0.0),)
    assert not design.plant.uncertainty.lost
    assert not any("not carried over" in note for note in design.notes)
    kept = obsynth.ui_pi_observer(obsynth.eliminate_algebraic_states(plant).plant)
    assert kept.plant.uncertainty.box.names == ("p",)
    assert obsynth.robustness(kept).finite_for_ever


@pytest.mark.parametrize("number", [float, np.float64])
@pytest.mark.parametrize(("operation", "exact"), [(np.minimum, min), (np.maximum, max)])
def test_the_smaller_and_the_larger_of_two_numbers_whatever_their_floats_are(number, operation, exact) -> None:
    low = AffineNumber(number(1.0), np.array([0.1]), number(0.0))
    for other in (AffineNumber(number(2.0), np.array([0.1]), 0.0), AffineNumber(number(1.05), np.array([-0.1]), 0.0)):
        for one, two in ((low, other), (other, low)):
            found = affine_translation(1)(operation)(one, two)
            for q in np.linspace(-1.0, 1.0, 21):
                truth = exact(one.center + one.parts[0] * q, two.center + two.parts[0] * q)
                assert abs(truth - found.center - found.parts[0] * q) <= found.radius + 1e-15


def varying(**more) -> obsynth.DescriptorSystem:
    """A sampled plant whose inertia m stands in E and A, with an algebraic output."""
    return obsynth.uncertain_system(
        {
            "E": [["m", 0.0], [0.0, 0.0]], "A": [["0.9 * m", 0.1], ["m", -1.0]], "B": [[1.0], [0.5]],
            "C": [[0.0, 1.0]], "Bf": [[1.0], [0.0]], "dt": 1.0,
        },
        {"m": {"nominal": 1.0, "tolerance": "10 %"}}, **more,
    )  # fmt: skip


def test_varying_constants_in_e_keep_their_meaning_when_algebraic_states_are_eliminated() -> None:
    """E(p) of sample k + 1 and A(p) of sample k are different matrices: none of them is inverted for the other."""
    plant, rng = varying(variation="varying"), np.random.default_rng(0)
    reduced = obsynth.eliminate_algebraic_states(plant).plant
    family, box = affine_plant(reduced), reduced.uncertainty.box
    x, q = 3.0, rng.uniform(-1.0, 1.0, 41)
    for k in range(40):
        now, then = (box.values(q[[i]])["m"] for i in (k, k + 1))
        u = rng.standard_normal()
        inner = now * x + 0.5 * u
        after = (0.9 * now * x + 0.1 * inner + u) / then
        a, b, c, d, e = (getattr(family, name).at(q[[k]]) for name in ("A", "B", "C", "D", "E"))
        ahead = family.E.at(q[[k + 1]])
        assert (ahead * after)[0, 0] == pytest.approx((a * x + b * u)[0, 0], rel=1e-12)
        assert (c * x + d * u)[0, 0] == pytest.approx(inner, rel=1e-12)
        assert e[0, 0] == pytest.approx(now, rel=1e-12)
        x = after
    # Constants that stay the same leave the equation of x(k+1), and thresholds are smaller for it.
    same = affine_plant(obsynth.eliminate_algebraic_states(varying()).plant)
    assert not same.E.parts.any()
    assert family.E.parts.any()


def test_faults_that_become_states_take_the_tolerances_along() -> None:
    written = {"E": None, "A": [["0.5 * p"]], "C": [[1.0]], "Bf": [[0.0]], "Df": [["p"]], "dt": 1.0}
    plant = obsynth.uncertain_system(written, {"p": {"nominal": 1.0, "tolerance": "10 %"}})
    more = augment_faults(plant, plant.fault_names).plant
    assert dict(more.uncertainty.entries) == {"A": ((0, 0, "0.5 * p"),), "C": ((0, 1, "p"),)}
    at = plant_at(more, {"p": 1.1})
    assert at.A[0, 0] == pytest.approx(0.55)
    assert at.C.tolist() == [[1.0, 1.1]]
    other = obsynth.eliminate_algebraic_states(varying()).plant
    other = other.replace(Df=[[1.0]], uncertainty=other.uncertainty)
    assert "appended" in augment_faults(other, other.fault_names).plant.uncertainty.lost
