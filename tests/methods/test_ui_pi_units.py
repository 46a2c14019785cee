"""Unknown-input PI observers in people's units: kilohertz, nanofarads, microseconds; and rods of many states."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import scipy.linalg

from obsynth import DescriptorSystem, ObserverDesign, PreconditionError, SpecError, ui_pi_observer
from obsynth.analysis.existence.sharepasand import existence_conditions
from obsynth.numerics.spectra import spectrum_error
from obsynth.plants.faults import exosystem

#: Two masses, a spring and a damper: positions and velocities.
MASSES = np.array([[0, 1, 0, 0], [-2, -0.1, 2, 0.1], [0, 0, 0, 1], [2, 0.1, -2, -0.1]])


def resonator(frequency: float) -> DescriptorSystem:
    w = 2.0 * np.pi * frequency
    return DescriptorSystem(None, [[0, 1], [-w * w, -0.02 * w]], [[0], [1]], C=[[1, 0]], Bf=[[0], [1]])


def masses(states: list[float], time: float) -> DescriptorSystem:
    """The masses with their states in other units, and ``time`` seconds for each second."""
    size, eye = np.array(states), np.eye(4)
    force = np.array([[0.0], [1.0], [0.0], [0.0]]) / size[:, None]
    return DescriptorSystem(None, MASSES * size / size[:, None] / time, C=eye[[0, 2]] * size, Bf=force / time)


def rod(count: int, sample_time: float = 0.0) -> DescriptorSystem:
    """A heated rod: a fault inside, an unknown source at the end, three thermometers."""
    a = -2.0 * np.eye(count) + np.eye(count, k=1) + np.eye(count, k=-1)
    inputs = np.eye(count)[:, [15, count - 1]]
    if sample_time:
        whole = scipy.linalg.expm(sample_time * np.block([[a, inputs], [np.zeros((2, count + 2))]]))
        a, inputs = whole[:count, :count], whole[:count, count:]
    outputs = np.eye(count)[[7, 15, count - 1]]
    return DescriptorSystem(None, a, C=outputs, Bf=inputs[:, :1], Bd=inputs[:, 1:], dt=sample_time)


@cache
def of_one_hertz() -> ObserverDesign:
    return ui_pi_observer(resonator(1.0))


#: Courses of the fault, by name.
MODELS: dict[str, object] = {"step": "step", "ramp": "ramp", "quartic": {"polynomial": 4}}


@cache
def in_si_units(model: str) -> ObserverDesign:
    return ui_pi_observer(masses([1, 1, 1, 1], 1.0), fault_model=MODELS[model])


@pytest.mark.one_in(6)
@pytest.mark.parametrize("frequency", [1e-4, 1e3, 3e3, 1e4, 1e5, 1e9])
def test_a_resonator_of_any_frequency(frequency: float) -> None:
    slow, fast = of_one_hertz(), ui_pi_observer(resonator(frequency))
    assert fast.report.passed
    poles = frequency * np.linalg.eigvals(slow.observer.Az)
    assert spectrum_error(fast.observer.Az, poles, 0.0) < 1e-6


def test_an_oscillating_circuit_in_farad_and_henry() -> None:
    circuit = DescriptorSystem(np.diag([1e-9, 1e-6]), [[-1 / 50, 1], [-1, -0.1]], [[0], [1]], C=[[1, 0]], Bf=[[1], [0]])
    design = ui_pi_observer(circuit)
    assert design.report.passed
    assert design.certificate.claims["decay"] > 1e5


@pytest.mark.one_in(4)
@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("states", [[1, 1, 1, 1], [1e-2, 1e2, 1e-2, 1e2], [1e3, 1e-3, 1, 1e3]])
@pytest.mark.parametrize("time", [1e-9, 1e-6, 1e6])
def test_two_masses_in_any_units(states: list[float], time: float, model: str) -> None:
    own, other = in_si_units(model), ui_pi_observer(masses(states, time), fault_model=MODELS[model])
    assert other.report.passed
    assert spectrum_error(other.observer.Az, np.linalg.eigvals(own.observer.Az) / time, 0.0) < 1e-5
    assert other.certificate.claims["noise_price"] == pytest.approx(own.certificate.claims["noise_price"], rel=1e-4)


@pytest.mark.one_in(3)
@pytest.mark.parametrize("options", [{"decay": 2.0}, {"region": {"decay": 1.0, "radius": 30.0}}, {"joint": True}])
def test_every_way_to_choose_gains_in_microseconds(options: dict) -> None:
    def in_microseconds(value: object) -> object:
        if isinstance(value, bool):
            return value
        return {k: 1e6 * v for k, v in value.items()} if isinstance(value, dict) else 1e6 * value

    own = ui_pi_observer(masses([1, 1, 1, 1], 1.0), **options)
    quick = {name: in_microseconds(value) for name, value in options.items()}
    other = ui_pi_observer(masses([1e2, 1e-2, 1, 1], 1e-6), **quick)
    assert other.report.passed
    assert spectrum_error(other.observer.Az, 1e6 * np.linalg.eigvals(own.observer.Az), 0.0) < 1e-3


@pytest.mark.one_in(3)
@pytest.mark.parametrize("size", [1e-9, 1e-6, 1e6])
def test_the_unit_of_a_fault_plays_no_role(size: float) -> None:
    plants = [DescriptorSystem(None, [[-1.0, 1], [0, -2]], C=[[1, 0]], Bf=[[0], [unit]]) for unit in (1.0, size)]
    own, other = (ui_pi_observer(plant) for plant in plants)
    assert spectrum_error(other.observer.Az, np.linalg.eigvals(own.observer.Az), 0.0) < 1e-6


def test_stated_noise_in_other_units() -> None:
    """Continuous noise has a unit of time: the same sensor in milliseconds and millimetres."""
    noise = {"Bw": np.zeros((4, 2)), "Dw": np.diag([1e-3, 2e-3])}
    own = ui_pi_observer(masses([1, 1, 1, 1], 1.0).replace(**noise, noise_names=None))
    scaled = masses([1e-3, 1e3, 1, 1], 1e-3)
    other = ui_pi_observer(scaled.replace(Bw=noise["Bw"], Dw=np.sqrt(1e-3) * noise["Dw"], noise_names=None))
    assert spectrum_error(other.observer.Az, 1e3 * np.linalg.eigvals(own.observer.Az), 0.0) < 1e-5


@pytest.mark.long
@pytest.mark.parametrize(("count", "sample_time"), [(30, 0.0), (30, 0.2), (80, 0.2)])
def test_a_rod_with_many_weakly_seen_modes(count: int, sample_time: float) -> None:
    design = ui_pi_observer(rod(count, sample_time))
    assert design.report.passed
    assert design.observer.order == count + 1
    assert design.certificate.claims["decay"] > 0.01


def test_outputs_that_show_nothing_are_refused_by_name() -> None:
    with pytest.raises(PreconditionError) as caught:
        ui_pi_observer(DescriptorSystem(None, [[-2.0]], C=[[0.0]], Bf=[[1.0]], fault_names=["leak"]))
    assert caught.value.condition == "(D3) fault model at 0"
    assert caught.value.signals == ("leak",)
    assert "'leak' is output-nulling: it has no effect on the outputs" in str(caught.value)
    with pytest.raises(PreconditionError) as caught:
        ui_pi_observer(DescriptorSystem(None, [[2.0]], C=[[0.0]]))
    assert (caught.value.condition, caught.value.mode, caught.value.signals) == ("(D2) zeros", 2.0, ("x1",))
    assert ui_pi_observer(DescriptorSystem(None, [[-2.0]], C=[[0.0]])).report.passed


def test_a_course_too_fast_for_the_samples_is_refused() -> None:
    plant = DescriptorSystem(None, [[0.5]], C=[[1.0]], Bf=[[1.0]], dt=0.1, fault_names=["hum"])
    with pytest.raises(SpecError, match=r"'hum' .*40 rad/s.*below 31\.4159 rad/s \(Nyquist\)"):
        ui_pi_observer(plant, fault_model={"sinusoid": 40.0})
    assert ui_pi_observer(plant, fault_model={"sinusoid": 30.0}).report.passed


def test_the_reason_why_nothing_was_eliminated_is_one_sentence() -> None:
    plant = DescriptorSystem([[0.0, 1], [0, 0]], np.eye(2), C=[[0, 1.0]], Bf=[[1.0], [0]])
    with pytest.raises(PreconditionError) as caught:
        ui_pi_observer(plant)
    text = str(caught.value)
    assert "the algebraic states cannot be eliminated (the plant has index 2 or more): the states 'x1'" in text
    assert "which methods take the descriptor form" not in text


def test_given_exosystems_of_any_frequency() -> None:
    w = 2e5
    plant = DescriptorSystem(None, [[-1e5]], C=[[1.0]], Bf=[[1.0]])
    design = ui_pi_observer(plant, fault_model={"Phi": [[0, 1], [-w * w, 0]], "Cw": [[1, 0]]})
    assert design.report.passed
    conditions = [check.name for check in design.report.checks if check.name.startswith("exists: (D3)")]
    assert conditions == ["exists: (D3) fault model at 0 +- 200000j"]


def slow_chain(n: int, pole: float, link: float, measured: list[int], fault: int) -> DescriptorSystem:
    """Return a sampled chain, each state driven by the next one, of which a fault drives one."""
    a, c = pole * np.eye(n) + link * np.eye(n, k=1), np.eye(n)
    return DescriptorSystem(A=a, C=c[measured], Bf=c[:, [fault]], dt=1.0)


@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    ("n", "pole", "link", "measured", "fault"),
    [(10, 0.978, 0.019, [0, 8], 8), (14, 0.988, 0.015, [0, 6, 7], 9), (10, 0.977, 0.25, [0, 9], 8)],
)
def test_a_chain_that_is_sampled_fast_has_an_observer_as_fast_as_in_continuous_time_and_quiet(
    n: int, pole: float, link: float, measured: list[int], fault: int
) -> None:
    # Beside the diagonal of A, nearly one, the link is weak; beside what a step changes of the state it is not.
    plant = slow_chain(n, pole, link, measured, fault)
    design = ui_pi_observer(plant)
    continuous = ui_pi_observer(plant.replace(A=plant.A - np.eye(n), dt=0.0))
    assert design.certificate.claims["decay"] > 0.5 * continuous.certificate.claims["decay"]
    assert design.certificate.claims["noise_amplification"] < 0.02


def test_a_fault_at_the_end_of_a_long_chain_is_not_denied_an_observer() -> None:
    # Units of A made links of 0.03 as large as the diagonal, and the fault of no effect beside rounding.
    plant = slow_chain(39, 0.9969, 0.1015, [0, 32], 6)
    assert all(condition.holds for condition in existence_conditions(plant, exosystem("step", plant.fault_names, 1.0)))


@pytest.mark.parametrize(("dt", "mode"), [(0.0, -40.0), (1.0, 1e-3)])
def test_a_fast_state_that_no_output_shows_does_not_hurry_the_default(dt: float, mode: float) -> None:
    alone = DescriptorSystem(
        A=[[0.4 if dt else -1.0]], Bf=[[1.0]], C=[[1.0]], sensor_noise={"y1": 0.1}, dt=dt,
    )  # fmt: skip
    beside = DescriptorSystem(
        A=[[0.4 if dt else -1.0, 0.0], [0.0, mode]], Bf=[[1.0], [0.0]], C=[[1.0, 0.0]], sensor_noise={"y1": 0.1}, dt=dt,
    )  # fmt: skip
    decays = [ui_pi_observer(plant).certificate.claims["decay"] for plant in (alone, beside)]
    assert decays[1] < 1.3 * decays[0]


@pytest.mark.parametrize(
    ("rows", "turn"),
    [
        # Rows of C that are orthogonal in the plant's own units, and not as written.
        ({"A": -0.4 * np.eye(2), "C": [[1.0, 0.5], [2.0, -1.5]], "Bf": [[2.0], [0.0]], "Df": [[1.5], [1.0]]}, 0.7),
        # All modes end within a few samples.
        (
            {
                "E": np.diag([1.0, 0.0]),
                "A": [[0.0, -0.2], [0.0, 0.2]],
                "C": [[0.5, -1.0], [2.5, 0.5]],
                "Bf": [[-0.5], [0.0]],
            },
            1.2,
        ),
    ],
)
def test_a_default_is_as_fast_in_other_coordinates(rows: dict[str, object], turn: float) -> None:
    given = {name: np.array(value, dtype=float) for name, value in rows.items()}
    change = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ np.diag([0.6, 1.5])
    own = {"E": np.eye(2), **given}
    turned = own | {
        "E": np.linalg.solve(change, own["E"] @ change) if "E" in given else np.eye(2),
        "A": np.linalg.solve(change, own["A"] @ change),
        "C": own["C"] @ change,
        "Bf": np.linalg.solve(change, own["Bf"]),
    }
    decays = [
        ui_pi_observer(DescriptorSystem(**plant, Dw=0.1 * np.eye(2), dt=1.0)).certificate.claims["decay"]
        for plant in (own, turned)
    ]
    assert decays[0] == pytest.approx(decays[1], rel=0.2)


@pytest.mark.parametrize("dt", [0.0, 0.1])
def test_given_poles_are_placed_with_the_same_gains_in_any_units(dt: float) -> None:
    """A search of hundreds of steps decides them: rounding must not send it elsewhere."""
    rng = np.random.default_rng([5, 0])
    a, c, fault = rng.standard_normal((4, 4)) - np.eye(4), rng.standard_normal((2, 4)), rng.standard_normal((4, 1))
    a = scipy.linalg.expm(dt * a) if dt else a
    rates = np.linspace(2.0, 4.0, 5)
    poles = np.exp(-rates * dt) if dt else -rates
    noise = np.diag([0.01, 1.0])
    own = ui_pi_observer(DescriptorSystem(A=a, C=c, Bf=fault, Dw=noise, dt=dt), poles=list(poles)).observer
    states, outputs = 10.0 ** rng.uniform(-3, 3, 4), 10.0 ** rng.uniform(-3, 3, 2)
    time = 1.0 if dt else 60.0
    other = ui_pi_observer(
        DescriptorSystem(
            A=time * a * states / states[:, None], C=outputs[:, None] * c * states, Bf=time * fault / states[:, None],
            Dw=outputs[:, None] * noise, dt=dt,
        ),
        poles=list(poles if dt else time * poles),
    ).observer  # fmt: skip
    # From outputs to the fault, whatever the states of the observer are.
    for s in (0.3 + 0.4j, 0.1j, 1.5):
        (one, many) = (
            o.Cz[4] @ np.linalg.solve(t * s * np.eye(len(o.Az)) - o.Az, o.By) + o.Dy[4]
            for o, t in ((own, 1.0), (other, 1.0 if dt else time))
        )
        np.testing.assert_allclose(many * outputs, one, rtol=1e-5, atol=1e-7 * np.abs(one).max())
