"""Default random-walk intensity of a fault: the smallest with which a step is estimated within the settling time.

The deviation as a function of the delay needs one Riccati equation for each intensity: smoothing over L samples reduces
the error covariance by ``sum_j G_j C M_j``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from obsynth.errors import ObsynthError, SolverError
from obsynth.methods.engines.sensor_noise import stationary_deviation
from obsynth.methods.functional_filter.kalman_gain import (
    ASKED_AT,
    LEAST_SAMPLES,
    RATE_REACHED,
    STEP_TIME_CONSTANTS,
    FilterModel,
    KalmanGain,
    filter_model,
    kalman_gain,
)
from obsynth.numerics.arrays import SMALLEST, FloatArray
from obsynth.numerics.ranks import decide_rank
from obsynth.numerics.spectra import moving_speeds
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.faults import exosystem
from obsynth.plants.pencil import shown_modes, structure_of
from obsynth.plants.plant_units import PlantUnits
from obsynth.verification.inequalities import slowest_decay

#: If no intensity estimates a step in time, those whose error is larger than the least one by at most this are as good.
AS_CLOSE = 0.05

#: An intensity counts as estimating nothing of a step in time if its error is above the first number; the size of the
#: error beyond that depends on rounding.  If this is so for all intensities, the time is multiplied by the second
#: number, at most so many times.  The slowest intensity of all is then taken only if rounding hides the estimates of
#: faster ones.
NOTHING_SHOWN, LONGER, MOST_LONGER = 0.5, 2.0, 55

#: An intensity that estimates a step in time may cause at most so many times the noise of the slowest one that
#: estimates half of it: the rest may depend on small differences between sensors, and is not worth more noise.
MOST_NOISE = 20.0

#: Default gains move poles whose errors last longer than so many settling times of the plant; if no gain does so, those
#: whose errors would remain in any run.
TOO_SLOW = (20.0, 1e5)

#: Decades of the search to both sides of an intensity of the size of the noise, and number of bisections in a decade.
DECADES, RATE_BISECTIONS = 8, 9

#: From so many states on the intensity is searched with gains that are only as accurate as necessary: for the 150
#: states of ieee39 this takes a third of the time.
ROUGH_FROM = 40

#: If five samples of delay reduce the deviation by less than this share, the sentence has no numbers.
WORTH_A_DELAY = 0.01

#: Start of a search with gains of low accuracy.
NO_GAIN = KalmanGain(np.zeros((0, 0)), (), np.zeros((0, 0)))


#: Lags in samples, and intensities relative to the middle one.
TRIED_LAGS, FACTORS = (0, 1, 2, 5, 10, 25), (0.3, 1.0, 3.0)


def settling_time(plant: DescriptorSystem) -> float:
    """Return the time in seconds after which a step of a fault should be estimated, from the observable modes."""
    own = 1.0 / (plant.dt or PlantUnits.of(plant).time)
    shown = shown_modes(plant)
    alive = np.sort(moving_speeds(shown if shown.size else structure_of(plant).finite_eigenvalues, plant.dt, own))
    # The median, for which numpy would load its masked arrays.
    middle = 0.5 * (alive[(alive.size - 1) // 2] + alive[alive.size // 2]) if alive.size else 0.0
    seconds = STEP_TIME_CONSTANTS / float(middle) if alive.size else max(plant.dt, 1.0) * 10.0
    return max(seconds, LEAST_SAMPLES * plant.dt)


def default_rates(
    model: FilterModel, seconds: float, *, lag: int, longer: int = MOST_LONGER
) -> tuple[FloatArray, KalmanGain]:
    """Return the smallest random-walk intensities with which steps are estimated in time, and their gain."""
    states = model.drive.shape[1]
    natural = np.max(np.abs(model.estimate[:, model.order :]), axis=0, initial=0.0)
    sizes = np.ones(states)
    for row, size in zip(model.estimate[:, model.order :], model.fault_sizes, strict=True):
        sizes[row != 0.0] = max(float(size), np.finfo(np.float64).tiny)
    noise = max(float(np.max(np.abs(model.M), initial=0.0)), float(np.max(np.abs(model.N), initial=0.0)))
    noise = noise or 1.0  # for a fault that noise-free equations determine
    unit = np.where(natural > 0.0, noise / sizes, noise / float(np.max(sizes, initial=1.0)))
    exactly = _TriedGains(model, unit, lag, roughly=False)
    if model.order >= ROUGH_FROM:
        try:
            found = _slowest_walk(_TriedGains(model, unit, 0, roughly=True), seconds, longer)
        except SolverError:
            found = None
        if found is not None and exactly.missed(found.exponent, found.seconds) <= found.most:
            gain = _required_gain(exactly.gain(found.exponent))
            return _at(model, 10.0**found.exponent * unit, gain, found, lag)
    found = _slowest_walk(exactly, seconds, longer)
    return _at(model, 10.0**found.exponent * unit, _required_gain(exactly.gain(found.exponent)), found, lag)


class _TriedGains:
    """The gains for random walks of some powers of ten, each computed once.

    With ``roughly`` they are only as accurate as a search needs, starting from the share of noise that worked last.
    """

    def __init__(self, model: FilterModel, unit: FloatArray, lag: int, *, roughly: bool) -> None:
        self.model, self.unit, self.lag, self.roughly = model, unit, lag, roughly
        self.gains: dict[float, KalmanGain | None] = {}

    def gain(self, exponent: float) -> KalmanGain | None:
        """Return the gain, or ``None`` if there is none."""
        if exponent not in self.gains:
            like = None
            if self.roughly:
                like = next((gain for gain in reversed(self.gains.values()) if gain is not None), NO_GAIN)
            try:
                gain = kalman_gain(self.model, 10.0**exponent * self.unit, lag=self.lag, like=like)
            except SolverError:
                gain = None
            self.gains[exponent] = gain
        return self.gains[exponent]

    def noise(self, exponent: float) -> float:
        """Return the largest deviation of an estimate by noise, in units of the sizes of the faults.

        The result is NaN, which satisfies no comparison, if errors hardly decay.
        """
        model, gain = self.model, _required_gain(self.gain(exponent))
        driven = model.N - gain.K @ model.M
        read = model.estimate / np.maximum(model.fault_sizes, SMALLEST)[:, None]
        direct = np.zeros((len(read), driven.shape[1]))
        worst = stationary_deviation(model.A - gain.K @ model.C, driven, read, direct, model.dt)
        return worst if np.isfinite(worst) else np.nan

    def missed(self, exponent: float, seconds: float) -> float:
        """Return the error of the estimates of a unit step after a time, infinite without a gain."""
        gain = self.gain(exponent)
        return np.inf if gain is None else step_misses(self.model, gain, seconds)


class _Walk(NamedTuple):
    """An intensity of a random walk, and the time and the error with which it estimates a unit step."""

    exponent: float  # of ten
    seconds: float  # time after which the step is estimated
    most: float  # largest error of the estimate then
    noisier: bool = False  # whether larger intensities have smaller errors, but too much noise


def _slowest_walk(gains: _TriedGains, seconds: float, longer: int) -> _Walk:
    """Return the smallest intensity with which steps are estimated in time, or in a multiple of that (``longer``)."""
    exponents = [float(e) for e in range(-DECADES, DECADES + 1)]
    for waited in range(longer + 1):
        seconds *= LONGER if waited else 1.0
        misses: list[float] = []
        for exponent in exponents:
            misses.append(gains.missed(exponent, seconds))
            if misses[-1] <= RATE_REACHED:
                break
        least = min(misses)
        if least <= NOTHING_SHOWN:
            break
    if not any(gain is not None for gain in gains.gains.values()):
        raise SolverError("No random-walk intensity of the fault gives a stable filter: give fault_rate, or poles.")
    high = exponents[len(misses) - 1]
    if least > RATE_REACHED:
        # Because of a zero every estimate of a step is slow: take the smallest intensity with about the least error.
        close = np.inf if least > NOTHING_SHOWN else least + AS_CLOSE
        high = next(e for e, miss in zip(exponents, misses, strict=True) if gains.gain(e) is not None and miss <= close)
        return _Walk(high, seconds, close)
    half = next(e for e, miss in zip(exponents, misses, strict=False) if miss <= NOTHING_SHOWN)
    if gains.noise(high) > MOST_NOISE * gains.noise(half):
        return _Walk(half, seconds, NOTHING_SHOWN, noisier=True)
    if gains.roughly and len(misses) > 1:
        return _Walk(_by_interpolation(gains, high, seconds), seconds, RATE_REACHED)
    low = high - 1.0
    for _ in range(RATE_BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if gains.missed(middle, seconds) <= RATE_REACHED else (middle, high)
    return _Walk(high, seconds, RATE_REACHED)


def _by_interpolation(gains: _TriedGains, exponent: float, seconds: float) -> float:
    """Return the same intensity as bisection of the decade below would, with fewer gains."""
    steps = 2**RATE_BISECTIONS

    def excess(step: int) -> float:
        """Return the logarithm of the error at a step of the grid, relative to the allowed one."""
        return float(np.log(max(gains.missed(step / steps, seconds), SMALLEST) / RATE_REACHED))

    high = round(exponent) * steps
    low, last_was_high = high - steps, True
    above, below = excess(low), excess(high)
    while high - low > 1:
        middle, room = (low + high) // 2, high - low
        if np.isfinite(above) and room > 2:
            # One grid step beyond the zero of the line, on the side that was not evaluated last, so that both ends
            # move.
            crossing = low + room * above / (above - below)
            middle = int(np.floor(crossing)) - 1 if last_was_high else int(np.ceil(crossing)) + 1
            middle = min(max(middle, low + 1), high - 1)
        value = excess(middle)
        last_was_high = value <= 0.0
        low, above, high, below = (low, above, middle, value) if last_was_high else (middle, value, high, below)
    return float(high / steps)


def _at(
    model: FilterModel, walks: FloatArray, gain: KalmanGain, found: _Walk, lag: int
) -> tuple[FloatArray, KalmanGain]:
    """Return the intensities, and their gain with the time and the error of its estimate of a step."""
    slow_gain = _forgetting_gain(model, walks, gain, found.seconds, lag)
    shown = (found.seconds, step_misses(model, slow_gain, found.seconds))
    return walks, replace(slow_gain, step_time_and_miss=shown, noisier_if_faster=found.noisier)


def _forgetting_gain(model: FilterModel, walks: FloatArray, gain: KalmanGain, seconds: float, lag: int) -> KalmanGain:
    """Return the gain, or if its errors last too long, one for the same intensities with faster errors if it exists."""
    speed = slowest_decay(model.A - gain.K @ model.C, model.dt)
    for times in TOO_SLOW:
        slowest = 1.0 / (times * seconds)
        if not speed < slowest:
            break
        try:
            return kalman_gain(model, walks, lag=lag, decay=slowest)
        except SolverError:
            continue
    return gain


def step_misses(model: FilterModel, gain: KalmanGain, seconds: float) -> float:
    """Return the largest error of the estimates of a unit step of each fault, at and after a time."""
    a = model.A - gain.K @ model.C
    worst = 0.0
    start = model.drive @ np.linalg.pinv(model.estimate[:, model.order :])
    for share in ASKED_AT:
        error = model.estimate @ _transition_after(a, share * seconds, model.dt) @ start
        worst = max(worst, float(np.max(np.abs(error), initial=0.0)))
    return worst


def _transition_after(a: FloatArray, seconds: float, dt: float) -> FloatArray:
    from scipy.linalg import expm

    if dt > 0.0:
        return np.asarray(np.linalg.matrix_power(a, max(round(seconds / dt), 1)))
    return np.asarray(expm(a * seconds))


def _required_gain(gain: KalmanGain | None) -> KalmanGain:
    if gain is None:
        raise SolverError("The Riccati equation of the filter has no stable solution: give fault_rate, or poles.")
    return gain


@dataclass(frozen=True, eq=False)
class DelayCurve:
    """Standard deviations ``(rates, lags)`` of delayed estimates of a fault, in its ``unit`` (empty: unknown).

    ``rates`` are random-walk intensities of the fault, the deviations of its steps in that unit per sample.  ``lags``
    are delays in samples.
    """

    fault: str
    rates: tuple[float, ...]
    lags: tuple[int, ...]
    deviations: FloatArray
    unit: str = ""

    @property
    def title(self) -> str:
        """The quantity with its unit: the deviation of a Kalman filter for each random walk, whatever the design is."""
        unit = f" ({self.unit})" if self.unit else ""
        return f"Least standard deviation of an estimate of {self.fault}{unit} that walks, by its delay in samples"

    @property
    def sentence(self) -> str:
        """The effect of one sample of delay, and of five samples, for the middle intensity."""
        row = self.deviations[len(self.rates) // 2]
        rate = self.rates[len(self.rates) // 2]
        at = {lag: float(value) for lag, value in zip(self.lags, row, strict=True)}
        unit = f" {self.unit}" if self.unit else ""
        walk = f"{self.fault}: for a random walk by {rate:.3g}{unit} per sample"
        if at[5] > (1.0 - WORTH_A_DELAY) * at[0]:
            return f"{walk} five samples of delay change the deviation by less than {100.0 * WORTH_A_DELAY:g} %."
        return (
            f"{walk} one sample of delay takes the deviation from {at[0]:.3g} to {at[1]:.3g}{unit}, five samples to "
            f"{at[5]:.3g}{unit}."
        )


def delay_curve(plant: DescriptorSystem, fault: int, rate: float | None = None) -> DelayCurve | None:
    """Return the curve for a fault of a sampled plant with all others decoupled; ``None`` if it is not estimable."""
    if not plant.dt > 0.0 or not plant.nw:
        return None
    removed = [j for j in range(plant.nf) if j != fault]
    model = filter_model(plant, exosystem("step", plant.fault_names, plant.dt), removed=removed, faults=[fault])
    if not len(model.M) or decide_rank(model.M, expected=len(model.M)).rank < len(model.M):
        return None
    try:
        middle = float(default_rates(model, settling_time(plant), lag=0)[0][0]) if rate is None else rate
        rows = []
        for factor in FACTORS:
            gain = kalman_gain(model, np.array([factor * middle]), lag=max(TRIED_LAGS))
            if gain.covariance is None:
                return None
            closed = model.A - gain.K @ model.C
            rows.append(_smoothed(gain.covariance, model.C, closed, model.estimate, gain.lag))
    except ObsynthError:
        return None
    rates = tuple(factor * middle for factor in FACTORS)
    name = plant.fault_names[fault]
    unit = plant.units.get(name, "")
    return DelayCurve(name, rates, TRIED_LAGS, np.array(rows), "" if unit == "1" else unit)


def _smoothed(
    p: FloatArray, c: FloatArray, closed: FloatArray, estimate: FloatArray, gains: Sequence[FloatArray]
) -> list[float]:
    """Return the deviation of the estimate at each of `TRIED_LAGS`."""
    known, moved, deviations = np.zeros_like(p), p.copy(), []
    for gain in gains[: max(TRIED_LAGS) + 1]:
        known = known + gain @ c @ moved
        moved = closed @ moved
        deviations.append(float(np.sqrt(max((estimate @ (p - known) @ estimate.T)[0, 0], 0.0))))
    return [deviations[lag] for lag in TRIED_LAGS]
