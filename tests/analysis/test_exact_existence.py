"""Existence decided on numbers as written, through elimination and sampling; the three answers."""

import json

import numpy as np
import pytest
from benchmarks.campaigns._rational_plants import drawn_plant

from obsynth import (
    DescriptorSystem,
    PreconditionError,
    SpecError,
    analyse_structure,
    discretise,
    eliminate_algebraic_states,
    fault_estimation_filter,
    ui_pi_observer,
)
from obsynth.analysis.existence.plant_numbers import numbers_of
from obsynth.analysis.existence.statements import ROUNDING_LEVEL, settled_rank
from obsynth.methods.designing import check
from obsynth.methods.registry import method_class
from obsynth.numerics.ranks import decide_rank
from obsynth.results.gain_set_writing import plain, restored

E = np.array([[1, 0, 0], [1, 1, 1], [0, 0, 0]])
A = np.array([[-1, 2, 2], [-1, 0, -1], [0, 0, 3]])
C = np.array([[0, 1, 1]])
MASKED, SHOWN = np.array([[0], [-1], [3]]), np.array([[0], [-1], [2]])


def with_zero(zero):
    """One fault, one output, one zero."""
    return DescriptorSystem(np.eye(2), [[0, 1], [0, 0.1]], C=[[-zero, 1]], Bf=[[0], [1]], dt=0.1)


def test_elimination_leaves_no_trace_of_a_fault_that_never_shows():
    reduced = eliminate_algebraic_states(DescriptorSystem(E, A, C=C, Bf=MASKED)).plant
    assert not reduced.Df.any()
    assert not np.any(reduced.Bf)
    assert reduced.exact is not None


def test_what_elimination_knows_is_kept_by_changes_that_do_not_matter():
    reduced = eliminate_algebraic_states(DescriptorSystem(E, A, C=C, Bf=SHOWN)).plant
    assert reduced.replace(B=np.ones((2, 1)), D=[[0]]).exact is reduced.exact
    assert reduced.replace(C=2 * reduced.C).exact is None


#: Plants of the campaign, eliminated and sampled, of which an answer was another when their matrices alone were kept.
CHANGED = [12, 47, 346, 370, 428, 432, 500, 567, 596]


@pytest.mark.one_in(4)
@pytest.mark.parametrize("seed", CHANGED)
def test_a_plant_made_again_from_its_data_gets_the_same_answers(seed):
    methods = ("fault-estimation-filter", "pd-observer", "ui-pi-observer", "functional-filter")
    drawn = drawn_plant(methods[seed % len(methods)], seed)
    g = drawn.given
    dt = drawn.dt if drawn.step is None else 0.0
    plant = DescriptorSystem(g["E"], g["A"], C=g["C"], Bf=g["Bf"], Df=g["Df"], Bd=g["Bd"], Dd=g["Dd"], dt=dt)
    plant = eliminate_algebraic_states(plant).plant
    plant = plant if drawn.step is None else discretise(plant, float(drawn.step)).plant
    again = DescriptorSystem(**restored(json.loads(json.dumps(plain(plant.as_dict())))))
    assert again.exact.content == plant.exact.content
    without = plant.replace(exact=None)
    changed = 0
    for method in ("fault-estimation-filter", "ui-pi-observer", "functional-filter", "adaptive-observer"):
        kind = method_class(method)
        asked = kind.of(dict(kind.placeholders))
        found, kept, lost = (answers(asked, which) for which in (plant, again, without))
        assert kept == found
        changed += lost != found
    assert changed


def answers(asked, plant):
    """What is said of each condition, with the witness."""
    return [(row.name, row.holds, row.unclear, row.detail) for row in asked.existence(plant)]


def test_what_was_tried_in_floating_point_leaves_no_trace():
    """A mode at zero that floating point puts at 1.2e-16: it was kept by whoever had asked first."""
    g = drawn_plant("pd-observer", 353).given
    first, second = (DescriptorSystem(g["E"], g["A"], C=g["C"], Bf=g["Bf"], Df=g["Df"]) for _ in range(2))
    asked = method_class("pd-observer").of({})
    tried = asked.existence(first, exactly=False)
    assert [row.holds for row in tried] == [row.holds for row in asked.existence(first)]
    assert analyse_structure(first).undetectable_modes == analyse_structure(second).undetectable_modes == (0,)


def test_exact_numbers_of_another_plant_are_refused():
    whole = np.diag([1, 1, 0])
    reduced = eliminate_algebraic_states(DescriptorSystem(whole, A, C=C, Bf=SHOWN)).plant
    other = eliminate_algebraic_states(DescriptorSystem(whole, A, C=2 * C, Bf=SHOWN)).plant
    with pytest.raises(SpecError, match="exact does not round to C of the plant"):
        DescriptorSystem(**{**reduced.as_dict(), "exact": other.exact.as_dict()})
    larger = DescriptorSystem(None, np.eye(3), C=np.eye(3)).as_dict()
    with pytest.raises(SpecError, match="exact has another size of E"):
        DescriptorSystem(**{**larger, "exact": other.exact.as_dict()})


@pytest.mark.parametrize("sample_time", [0.1, 1.0])
def test_sampled_plants_are_decided_as_sampled(sample_time):
    masked = discretise(DescriptorSystem(E, A, C=C, Bf=MASKED), sample_time).plant
    shown = discretise(DescriptorSystem(E, A, C=C, Bf=SHOWN), sample_time).plant
    with pytest.raises(PreconditionError, match=r"^No observer of this kind exists"):
        ui_pi_observer(masked)
    assert ui_pi_observer(shown).report.passed


def test_a_triple_integrator_has_no_zero_before_it_is_sampled_and_an_unstable_one_after():
    plant = DescriptorSystem(None, np.eye(3, k=1), C=[[1, 0, 0]], Bf=[[0], [0], [1]])
    numbers = numbers_of(discretise(plant, 0.1).plant)
    facts = numbers.system(numbers.matrices["Bf"], numbers.matrices["Df"])
    assert not facts.exact
    assert facts.outside[0] == pytest.approx(-2 - np.sqrt(3))
    own = numbers_of(plant)
    assert own.system(own.matrices["Bf"], own.matrices["Df"]).zeros == ()


@pytest.mark.parametrize(("zero", "stable"), [(1 - 1e-9, True), (1.0, False), (1 + 1e-9, False), (-1.0, False)])
def test_a_zero_is_on_its_side_of_the_boundary_however_close(zero, stable):
    assert check(with_zero(zero))["fault-estimation-filter"].passed == stable


def test_an_answer_that_rounding_could_change_is_unclear():
    plant = DescriptorSystem(np.eye(2), [[0.5, 0], [0, 2]], C=[[1, 1], [1, 1 + 2e-15]], Bf=[[1], [0]], dt=0.1)
    with pytest.raises(PreconditionError, match=r"^Unclear: .*rounding") as error:
        fault_estimation_filter(plant)
    assert error.value.exit_code == 3


def test_a_rank_lost_only_exactly_says_so():
    plant = DescriptorSystem(np.eye(2), [[0.5, 0], [0, 0.2]], C=np.eye(2), Bf=[[1, 2], [0.1, 0.2]], dt=0.1)
    with pytest.raises(PreconditionError, match=r"rank 1 of 2 \(exactly, on the numbers as written; .*1e16"):
        fault_estimation_filter(plant)


@pytest.mark.parametrize(
    ("smallest", "exact", "means", "rank"),
    [(1e-3, 2, "exact", 2), (1e-12, 2, "exact", 2), (ROUNDING_LEVEL / 4, 2, "unclear", 1), (1e-3, 1, "exact", 1)],
)
def test_three_answers_for_a_rank(smallest, exact, means, rank):
    decision = settled_rank(decide_rank(np.diag([1.0, smallest]), equilibrated=False), exact)
    assert (decision.means, decision.rank) == (means, rank)
    assert ("exactly" in decision.describe()) == (exact == 1 or means == "exact" or means == "unclear")


def test_computed_data_keep_the_judgement_of_floating_point():
    """A mode that is hidden but for rounding is hidden, and a far zero that rounding made is none."""
    rng = np.random.default_rng(3)
    q = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    plant = DescriptorSystem(None, q @ np.diag([0.5, 0.2, 1.5]) @ q.T, C=np.eye(3)[:2] @ q.T, Bf=q[:, :1], dt=1.0)
    assert analyse_structure(plant).undetectable_modes == pytest.approx((1.5,))


#: What enters the algebraic equation and the dynamic one, whose difference is what is left of a fault: 1e-15 as it was
#: written, and the rounding of a sum that is taken for zero.
CANCELLING = {"as written": (1 - 1e-15, 1.0), "computed": (0.1 + 0.2, 0.3)}


@pytest.mark.parametrize("kind", CANCELLING)
@pytest.mark.parametrize(
    ("method", "dt", "eliminated", "condition"),
    [
        ("pd-observer", 0.0, False, "rank F"),
        ("fault-estimation-filter", 1.0, True, "rank F"),
        ("ui-pi-observer", 0.0, False, "(D3) fault model at 0"),
        ("ui-pi-observer", 0.0, True, "(D3) fault model at 0"),
    ],
)
def test_a_fault_of_which_rounding_is_left_is_unclear(method, dt, eliminated, condition, kind):
    through, beside = CANCELLING[kind]
    a = [[0.5 if dt else -1, 1], [0, 1]]
    plant = DescriptorSystem(np.diag([1, 0]), a, C=[[1, 0]], Bf=[[beside], [through]], dt=dt)
    plant = eliminate_algebraic_states(plant).plant if eliminated else plant
    failed = [row for row in method_class(method).of({}).existence(plant) if not row.holds]
    assert [row.name for row in failed] == [condition]
    assert failed[0].unclear
    # In floating point the sum that was taken for zero is a fault that acts nowhere.
    tried = [row for row in method_class(method).of({}).existence(plant, exactly=False) if not row.holds]
    assert not [row for row in tried if row.unclear]


def test_two_faults_that_cancel_are_called_a_combination():
    """It said "the fault 'leak', 'pump wear' is output-nulling", though each alone is visible."""
    tanks = DescriptorSystem(
        E=[[0.5, 0, 0], [0, 0.5, 0], [0, 0, 4]],
        A=[[-0.005, 0, 1], [0.005, -0.005, 0], [0, 0, -1]],
        C=[[1, 0, 0], [0, 1, 0]],
        Bf=[[-1, 0], [0, 0], [0, -1]],
        fault_names=["leak", "pump wear"],
    )
    report = check(discretise(tanks, 5.0).plant)["fault-estimation-filter"]
    assert "a combination of the faults 'leak', 'pump wear' is output-nulling" in report["exists: fault zeros"].detail


def test_a_real_mode_is_written_as_one():
    """The detection filter named 'the mode s = 0+0j'."""
    plant = DescriptorSystem(A=[[0, 0], [0, -1]], C=[[0, 1]], Bf=[[0], [1]], Bd=[[0], [1]], Dd=[[1]])
    report = check(plant)["detection-filter"]
    assert any("the mode s = 0 is undetectable" in row.detail for row in report.checks)
