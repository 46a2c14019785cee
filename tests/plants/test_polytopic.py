"""Polytopic plants: vertices, weights, points, and what is refused."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

import obsynth
from obsynth import DescriptorSystem, PolytopicSystem, PreconditionError, SpecError
from obsynth.plants.scheduling import MOST_FUNCTIONS


def _pendulum() -> PolytopicSystem:
    return PolytopicSystem(
        plant={"A": [[0, "1 / m"], ["-k - 0.5 * v ** 2", "-2 * v"]], "C": [[1, 0]], "Bd": [[0], ["1 + sin(v)"]]},
        scheduling={"k": [1, 6], "v": {"range": [-1, 2], "rate": 0.1, "unit": "m/s", "column": "speed"}},
        constants={"m": 2.0},
    )


def test_a_point_is_the_plant_of_its_expressions() -> None:
    plant = _pendulum()
    assert plant.count == 16
    rng = np.random.default_rng(0)
    for _ in range(50):
        k, v = rng.uniform(1, 6), rng.uniform(-1, 2)
        found = plant.at({"k": k, "v": v})
        assert pytest.approx(np.array([[0, 0.5], [-k - 0.5 * v**2, -2 * v]]), abs=1e-14) == found.A
        assert found.Bd == pytest.approx(np.array([[0], [1 + np.sin(v)]]), abs=1e-14)
        weights = plant.weights([k, v])
        assert weights.min() >= 0.0
        assert weights.sum() == pytest.approx(1.0, abs=1e-15)


def test_functions_of_parameters_are_enclosed_and_shared() -> None:
    functions = _pendulum().scheduling
    assert functions.functions == ("k", "v", "v ** 2", "sin(v)")
    bounds = dict(zip(functions.functions, functions.bounds.tolist(), strict=True))
    assert bounds["v ** 2"][0] <= 0.0
    assert bounds["v ** 2"][1] == pytest.approx(4.0, rel=1e-3)
    assert bounds["sin(v)"][0] == pytest.approx(-np.sin(1.0))
    assert bounds["sin(v)"][1] == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize(
    ("texts", "functions"),
    [
        (["0.2 * p * sin(q)", "p * (0.3 * sin(q))", "-sin(q) * p / 7"], ("p * sin(q)",)),
        (["(2 * p) ** 2", "p * p", "3 * p ** 2 - q"], ("q", "p ** 2")),
        (["0.2 * p / (3 * q)", "p / q"], ("p / q",)),
        (["p * (1 + q)", "p * q", "p"], ("p", "p * q")),
        (["(1 + 0.2 * p) * sin(q)"], ("(1 + 0.2 * p) * sin(q)",)),
        (["p * (1 + q) - p * q"], ("(1 + q) * p", "p * q")),
        (["-76 / q", "36 / (2 * q)", "3 * (1 / q) + p", "q ** (-1)"], ("p", "1 / q")),
        (["2 / q ** 2 - p", "1 / q / q", "(1 / q) * (3 / q)", "(2 * q) ** (-2)"], ("p", "1 / (q ** 2)")),
        (["2 * p * (1 / q)", "p / (3 * q)", "(1 / q) * p"], ("p / q",)),
        (["2 / (1 + p) + q", "-1 / (1 + p) / 3"], ("q", "1 / (1 + p)")),
        (["0 / (1 + q) + p", "q"], ("p", "q")),
        (["(1 / q) ** 2 + p", "1 / q ** 2", "(2 / q) ** 2 / 3"], ("p", "1 / (q ** 2)")),
        (["p * (1 / q) ** 2", "p / q ** 2", "p / q / q", "(p / q) * (1 / q)"], ("p / (q ** 2)",)),
        (["(p / q) ** 3", "p ** 3 / q ** 3", "(p / q) * (p / q) ** 2"], ("(p ** 3) / (q ** 3)",)),
        (["sqrt(q) + p", "q ** 0.5", "2 * q ** (1 / 2)"], ("p", "sqrt(q)")),
        (["1 / sqrt(q) - p", "q ** (-0.5)", "p / sqrt(q) / p"], ("p", "1 / sqrt(q)", "p / (p * sqrt(q))")),
        (["1 / (1 + 1 / q) + p"], ("p", "1 / (1 + (1 / q))")),
    ],
)
def test_multiples_of_one_function_are_one(texts: list[str], functions: tuple[str, ...]) -> None:
    """Each function doubles the vertices: 0.2 p sin(q) and 0.3 p sin(q) were two."""
    plant = PolytopicSystem(
        plant={"A": np.eye(len(texts)).tolist(), "C": np.eye(len(texts)).tolist(), "Bd": [[text] for text in texts]},
        scheduling={"p": [0.5, 2], "q": [0.25, 3]},
    )
    assert plant.scheduling.functions == functions
    assert plant.count == 2 ** len(functions)
    values = {"p": 1.25, "q": 0.75}
    written = [eval(text, {"sin": np.sin, "sqrt": np.sqrt, **values}) for text in texts]
    assert plant.at(values).Bd.ravel() == pytest.approx(written, abs=1e-14)


def test_what_is_saved_is_the_plant_again() -> None:
    plant = _pendulum()
    for again in (pickle.loads(pickle.dumps(plant)), PolytopicSystem(**plant.as_dict())):
        assert repr(again) == repr(plant)
        assert all(np.array_equal(one.A, other.A) for one, other in zip(again.vertices, plant.vertices, strict=True))
    with pytest.raises(AttributeError, match="cannot be changed"):
        plant.vertices = ()  # type: ignore[misc]


def test_vertices_alone_are_scheduled_by_their_weights() -> None:
    one = DescriptorSystem(A=[[0.5]], C=[[1]], dt=1.0)
    plant = PolytopicSystem([one, one.replace(A=[[0.9]]), one.replace(A=[[0.1]])])
    assert plant.at([0.2, 0.3, 0.5]).A[0, 0] == pytest.approx(0.42)
    with pytest.raises(SpecError, match="outside the region"):
        plant.at([0.2, 0.3, 0.1])
    two = PolytopicSystem([one, one.replace(A=[[0.9]])], scheduling={"v": [10, 20]})
    assert two.at({"v": 15}).A[0, 0] == pytest.approx(0.7)


@pytest.mark.parametrize(
    ("plant", "scheduling", "error", "told"),
    [
        ({"A": [["k"]]}, {"k": [1, 1]}, SpecError, "A parameter that does not change is a constant"),
        ({"A": [["k"]]}, {"k": [2, 1]}, SpecError, "lower one first"),
        ({"A": [["k"]]}, {"k": [1, np.nan]}, SpecError, "both finite"),
        ({"A": [["k"]]}, {"k": {"range": [1, 2], "rate": 0}}, SpecError, "rate of 'k' is 0"),
        ({"A": [["k"]]}, {"k": {"range": [1, 2], "measured": False}}, SpecError, "is not measured"),
        ({"A": [["floor(k)"]]}, {"k": [1, 3]}, PreconditionError, "floor jumps"),
        ({"A": [["where(k < 1, 1, 2)"]]}, {"k": [0, 3]}, SpecError, "chooses between formulas"),
        ({"A": [["1 / k"]]}, {"k": [-1, 2]}, PreconditionError, "can be zero"),
        ({"A": [["sqrt(k)"]]}, {"k": [-1, 2]}, PreconditionError, "argument of sqrt"),
        ({"A": [["k"]], "E": [["k"]]}, {"k": [1, 2]}, PreconditionError, "Solve the equations"),
        ({"A": [["k + j"]]}, {"k": [1, 2]}, SpecError, "'j' is no scheduling parameter"),
        ({"A": [[1.0]]}, {"k": [1, 2]}, SpecError, "No entry depends on 'k'"),
        ({"A": [["0.5 * pi"]]}, {"pi": [1, 2]}, SpecError, "'pi' is a number in expressions"),
        ({"A": [["k"]]}, {}, SpecError, "must name one or more"),
        ({"C": [["k"]]}, {"k": [1, 2]}, SpecError, "no matrix A"),
    ],
)
def test_what_is_no_plant_over_a_region_is_refused_by_name(
    plant: dict[str, object], scheduling: dict[str, object], error: type[Exception], told: str
) -> None:
    with pytest.raises(error, match=told):
        PolytopicSystem(plant=plant, scheduling=scheduling)


def test_no_vertex_and_no_parameter_are_refused() -> None:
    with pytest.raises(SpecError, match="vertices are empty"):
        PolytopicSystem([])
    with pytest.raises(SpecError, match="that are given: none; give k"):
        PolytopicSystem(plant={"A": [["k"]], "C": [[1]]}, scheduling={"k": [0, 1]}).at({})


def test_too_many_functions_are_refused() -> None:
    names = [f"p{i}" for i in range(MOST_FUNCTIONS + 1)]
    with pytest.raises(SpecError, match="at most 12"):
        PolytopicSystem(plant={"A": [[" + ".join(f"{i + 1} * {name}" for i, name in enumerate(names))] ]} ,
                        scheduling={name: [0, 1] for name in names})  # fmt: skip


def test_vertices_must_have_one_e() -> None:
    one = DescriptorSystem(A=[[0.5]], C=[[1]], dt=1.0)
    with pytest.raises(PreconditionError, match="E of vertex 2"):
        PolytopicSystem([one, one.replace(E=[[2.0]])])
    with pytest.raises(SpecError, match="another dt"):
        PolytopicSystem([one, one.replace(dt=2.0)])


@pytest.mark.parametrize(
    "text",
    ["x * (a + sin(b))", "1 / (a * sin(b))", "(a + b) ** 2 * exp(x)", "x - (a - sqrt(b)) ** 3", "2 ** (a * cos(b))"],
)
def test_an_entry_is_what_its_text_says_at_every_point(text: str) -> None:
    ranges = {"x": [1.0, 2.0], "a": [1.0, 2.0], "b": [0.1, 0.5]}
    used = {name: ends for name, ends in ranges.items() if name in text}
    plant = PolytopicSystem(plant={"A": [[text]], "C": [[1]]}, scheduling=used)
    rng = np.random.default_rng(0)
    for _ in range(20):
        point = {name: float(rng.uniform(*ends)) for name, ends in used.items()}
        value = eval(text, {"sin": np.sin, "cos": np.cos, "exp": np.exp, "sqrt": np.sqrt}, point)
        assert plant.at(point).A[0, 0] == pytest.approx(value, rel=1e-12)


def test_a_point_inside_at_which_nothing_shows_a_growing_mode_is_named() -> None:
    hidden = {"A": [[0.9, "a"], [0.0, 1.5]], "C": [[1, 0]], "Bf": [[1], [0]], "dt": 1.0}
    plant = PolytopicSystem(plant=hidden, scheduling={"a": [-1.0, 1.0]})
    with pytest.raises(PreconditionError, match=r"at the middle of the region \(a = 0\)"):
        obsynth.ui_pi_observer(plant)


def test_an_input_that_is_one_in_every_row_is_kept_and_must_be_an_input() -> None:
    given = {"A": [["-k"]], "B": [[1.0]], "C": [[1.0]], "input_names": ["offset"]}
    plant = PolytopicSystem(plant=given, scheduling={"k": {"range": [1, 6], "rate": 0.5}}, shift="offset")
    assert PolytopicSystem.from_dict(plant.as_dict()).shift == "offset"
    assert plant.scheduling.rate_of_weight == pytest.approx(0.1, rel=1e-5)
    assert plant.scheduling.rate_of_weight > 0.1
    with pytest.raises(SpecError, match="no input"):
        PolytopicSystem(plant=given, scheduling={"k": [1, 6]}, shift="other")


@pytest.mark.parametrize(
    ("entry", "path"),
    [
        ({"column": ""}, "scheduling.v.column"),
        ({"column": 3}, "scheduling.v.column"),
        ({"column": ["v"]}, "scheduling.v.column"),
        ({"column": True}, "scheduling.v.column"),
        ({"unit": 3}, "scheduling.v.unit"),
        ({"column": "w"}, "scheduling.w.column"),
    ],
    ids=str,
)
def test_columns_and_units_are_texts_and_every_parameter_has_its_own_column(
    entry: dict[str, object], path: str
) -> None:
    A = [["0.5 + 0.1 * v", "0.1 * w"], [0, 0.4]]
    with pytest.raises(SpecError) as refused:
        PolytopicSystem(
            plant={"A": A, "C": [[1, 0]], "dt": 1.0}, scheduling={"v": {"range": [-1, 1], **entry}, "w": [0, 1]}
        )
    assert refused.value.path == path


def test_a_point_that_is_no_numbers_is_refused() -> None:
    with pytest.raises(SpecError, match="by name or in order"):
        _pendulum().at("v")  # type: ignore[arg-type]


@pytest.mark.parametrize("seed", range(4))
def test_the_order_and_the_units_of_parameters_change_no_point(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b, c, d = rng.standard_normal(4).round(3).tolist()
    factor, point = float(10.0 ** rng.integers(-6, 7)), rng.uniform(0, 1, 2)

    def plant(scheduling: dict[str, list[float]], v: str = "v") -> PolytopicSystem:
        A = [[f"{a} * {v} + {b}", f"sin({v}) * w"], [f"{c} * w", d]]
        return PolytopicSystem(plant={"A": A, "C": [[1, 0]], "dt": 1.0}, scheduling=scheduling)

    expected = plant({"v": [-1, 1], "w": [0, 2]}).at({"v": point[0], "w": point[1]}).A
    for other, v in (
        (plant({"w": [0, 2], "v": [-1, 1]}), point[0]),
        (plant({"v": [-factor, factor], "w": [0, 2]}, f"(v / {factor!r})"), point[0] * factor),
    ):
        assert pytest.approx(expected, rel=1e-12, abs=1e-12) == other.at({"v": v, "w": point[1]}).A


def test_a_point_that_is_not_a_number_is_refused_by_name() -> None:
    """The weights were NaN themselves, beside a refusal by `at`, which called NaN outside the region."""
    with pytest.raises(SpecError, match="weight2 is NaN"):
        PolytopicSystem([_pendulum().vertices[0]] * 2).scheduling.weights([0.5, np.nan])
    pendulum = _pendulum()
    point = {name: np.nan for name in pendulum.scheduling.names}
    with pytest.raises(SpecError, match=f"{pendulum.scheduling.names[0]} is NaN") as refused:
        pendulum.scheduling.weights(point)
    assert refused.value.path == f"scheduling.{pendulum.scheduling.names[0]}"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("0.5 + 0.2 * sign(v)", r"A\[1,2\]: 'sign\(v\)': sign jumps .* Here v in \[-1, 1\]"),
        ("0.2 / v", r"A\[1,2\]: '1 / v': a divisor .* can be zero .* Here v in \[-1, 1\]"),
        ("acos(3 * v)", r"A\[1,2\]: 'acos\(3 \* v\)': the argument of acos lies between -3 and 3"),
        ("floor(v / 8 + 0.5)", r"A\[1,2\]: 'floor\(.*\)' is 0 everywhere in the region: write that number"),
    ],
)
def test_a_function_without_a_range_is_named_with_its_entry_and_parameters(text: str, words: str) -> None:
    with pytest.raises(PreconditionError, match=words):
        PolytopicSystem(plant={"A": [["0.1 * v", text], [0, 0]], "C": [[1, 0]]}, scheduling={"v": [-1, 1]})
