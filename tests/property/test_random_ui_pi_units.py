"""Random plants in random units of signals and time: the same verdict and, in these units, the same observer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from ui_pi_plants import Case, random_case

from obsynth import DescriptorSystem, ObserverDesign, PreconditionError, ui_pi_observer
from obsynth.numerics.spectra import spectrum_error

BATCHES, SIZE = 3, 20
#: Poles may differ by this, relative to their size, or by this multiple of the effect of rounding the data.
SAME, ROUNDINGS = 1e-6, 100.0


@dataclass(frozen=True)
class Rescaled:
    """A case in other units; ``time`` is the factor of its rates."""

    case: Case
    time: float


def in_other_units(case: Case, seed: int) -> Rescaled:
    """Return a case with states, equations and signals scaled by 1e-3 to 1e3, and time by 1e-9 to 1e6."""
    rng = np.random.default_rng([7, seed])
    plant = case.plant

    def factors(count: int) -> np.ndarray:
        return 10.0 ** rng.integers(-3, 4, count)

    states, faults, disturbances = factors(plant.nx), factors(plant.nf), factors(plant.nd)
    equations, outputs = factors(plant.nx)[:, None], factors(plant.ny)[:, None]
    time = 10.0 ** rng.integers(-9, 7)
    rate = 1.0 if plant.dt else time
    other = DescriptorSystem(
        E=equations * plant.E * states, A=rate * equations * plant.A * states,
        Bf=rate * equations * plant.Bf * faults, Bd=rate * equations * plant.Bd * disturbances,
        C=outputs * plant.C * states, Df=outputs * plant.Df * faults, Dd=outputs * plant.Dd * disturbances,
        dt=plant.dt * (1.0 / time),
    )  # fmt: skip
    model = case.model
    if isinstance(model, dict) and "polynomial" not in model:
        model = {kind: value * time for kind, value in model.items()}
    return Rescaled(Case(other, model, case.kind), time)


def outcome(case: Case, **options: object) -> ObserverDesign | PreconditionError:
    """Return the design or its refusal; any other error, and any warning, fails the test."""
    try:
        return ui_pi_observer(case.plant, fault_model=case.model, **options)
    except PreconditionError as error:
        return error


def moved_by_rounding(case: Case, poles: np.ndarray) -> float:
    """Return how far the poles move when the data change in the last digits: poles in clusters near zero move far."""
    rng = np.random.default_rng(1)
    changed = case.plant.replace(A=case.plant.A * (1.0 + 1e-15 * rng.standard_normal(case.plant.A.shape)))
    return spectrum_error(ui_pi_observer(changed, fault_model=case.model).observer.Az, poles, case.plant.dt)


@pytest.mark.long
@pytest.mark.parametrize("number", range(BATCHES))
def test_units_change_neither_verdict_nor_observer(number: int, share: Callable[..., Sequence[Any]]) -> None:
    # Eight kinds of plants come in turn: an odd number of parts leaves each of them in a share.
    refused, seeds = 0, share(range(number * SIZE, (number + 1) * SIZE), 3)
    for seed in seeds:
        case = random_case(seed)
        rescaled = in_other_units(case, seed)
        own, other = outcome(case), outcome(rescaled.case)
        rate = 1.0 if case.plant.dt else rescaled.time
        if isinstance(own, PreconditionError) or isinstance(other, PreconditionError):
            assert isinstance(own, PreconditionError), (seed, other)
            assert isinstance(other, PreconditionError), (seed, own)
            assert (own.condition or "").split(" at ")[0] == (other.condition or "").split(" at ")[0], seed
            states = set(case.plant.state_names)
            assert set(own.signals) - states == set(other.signals) - states, seed
            refused += 1
            if own.mode is not None:
                assert other.mode == pytest.approx(rate * own.mode, rel=1e-5, abs=1e-7 * rate), seed
            continue
        assert own.report.passed, seed
        assert other.report.passed, seed
        poles = np.linalg.eigvals(own.observer.Az)
        miss = spectrum_error(other.observer.Az, rate * poles, case.plant.dt)
        assert miss < SAME or miss < ROUNDINGS * moved_by_rounding(case, poles), (seed, miss)
        assert other.certificate.claims["noise_price"] == pytest.approx(
            own.certificate.claims["noise_price"], rel=1e-3
        ), seed
    assert 0 < refused < len(seeds)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("seed", [1000, 1002, 1018, 1024, 1028])
def test_poles_are_placed_in_any_units(seed: int) -> None:
    case = random_case(seed)
    own = outcome(case)
    assert isinstance(own, ObserverDesign)
    rescaled, dt = in_other_units(case, seed), case.plant.dt
    count = own.observer.order - int(own.report["fixed modes"].value)
    rates = np.random.default_rng(seed).uniform(0.5, 2.0, count)
    poles = np.exp(-rates * dt) if dt else -rates * rescaled.time
    design = ui_pi_observer(rescaled.case.plant, fault_model=rescaled.case.model, poles=list(poles))
    assert design.report["poles"].value < 1e-6
