"""The least gain and the least noise of any causal filter that responds to the faults as a given design does.

The response is the design's own: an exact delay, or whatever stable model its fault estimates are of the faults.  Every
other causal filter with that response counts, of any order and structure; what is computed is not proved.
"""

from __future__ import annotations

import warnings
from typing import NamedTuple

import numpy as np

from obsynth.analysis.existence.wang2015 import examine_fault_filter
from obsynth.errors import ObsynthError
from obsynth.methods.fault_estimation_filter.weights import least_by_weight
from obsynth.methods.optimal_filter.delays import in_words
from obsynth.methods.optimal_filter.fault_maps import FaultMap, designed
from obsynth.methods.optimal_filter.realisation import minimal
from obsynth.methods.registry import method_class
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.decoupling_windows import Model
from obsynth.numerics.gramians import gramian
from obsynth.numerics.matrix_equations import continuous_lyapunov
from obsynth.numerics.norms import hinf_norm
from obsynth.numerics.standard_form import cayley
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import ObserverDesign
from obsynth.results.number_texts import number
from obsynth.verification.error_system import ErrorModel

#: A gain below this share of what the disturbances do to the faults' estimates in one step is zero but for rounding.
NOTHING = 1e-7
#: Of a least gain below this share of another gain, the search leaves no digit: it ends at a small number, not at zero.
TINY_SHARE = 1e-4
#: A response is a delay where it differs by less than this.
SAME_RESPONSE = 1e-6
#: With more states nothing is computed: each search takes a second or more.
MOST_STATES = 30
#: Points of the circle at which a response is compared with a delay, beyond twice the order.
MORE_POINTS = 5


class LeastPossible(NamedTuple):
    """What a design lets through, and the least that any causal filter with its response to faults can.

    ``gain``: from the disturbances to the fault estimates, of energies; ``deviation``: root mean square for the stated
    noise as white noise of unit intensity (without any: on each output).  The least deviation is of filters that
    decouple the disturbances where the design does.  ``delay``: of an exact fault map; ``None`` for another response.
    ``later_gain``: the least gain with one sample more.  NaN where a number does not exist or was not found.
    """

    gain: float
    least_gain: float
    deviation: float
    least_deviation: float
    delay: tuple[int, ...] | None
    later_gain: float
    is_noise_stated: bool = True
    is_decoupled: bool = False

    @property
    def gain_share(self) -> float:
        """How many times the least its gain is: 1 at least, infinite where the least is zero and it is not."""
        return _share(self.gain, self.least_gain)

    @property
    def deviation_share(self) -> float:
        """How many times the least its deviation is."""
        return _share(self.deviation, self.least_deviation)

    def sentence(self) -> str:
        """Return both in one line, for who reads the design."""
        said = []
        alike = "with its response to the faults" if self.delay is None else _with_delay(self.delay)
        if self.gain or self.least_gain:
            least, later = (_in_words(gain, self.gain) for gain in (self.least_gain, self.later_gain))
            said.append(f"gain {number(self.gain, digits=5)}; least of any causal filter {alike}: {least}")
            said += [] if np.isnan(self.later_gain) else [f"with one sample more: {later}"]
        if np.isfinite(self.deviation_share):
            assumed = "" if self.is_noise_stated else ", if it is equal on every output (none is stated)"
            others = (
                alike if said else f"of any causal filter {alike}{', decoupled as it is' if self.is_decoupled else ''}"
            )
            said.append(f"noise {self.deviation_share:.3g} times the least {others}{assumed}")
        return "; ".join(said)


def _with_delay(delay: tuple[int, ...]) -> str:
    return f"with delay {in_words(delay)}"


def _in_words(least: float, beside: float) -> str:
    """Return a least gain as a text: of one that is tiny beside another gain, the power of ten that it is below."""
    if np.isnan(least):
        return "not known"
    if 0.0 < least < TINY_SHARE * beside:
        return f"below 1e{int(np.ceil(np.log10(least)))}"
    return number(least, digits=5)


def least_possible(design: ObserverDesign, *, later: bool = False) -> LeastPossible | None:
    """Return what no filter beats, beside a design; ``None`` where it estimates no faults of a linear plant.

    Parameters
    ----------
    design : ObserverDesign
        By any method whose error model is known.
    later : bool, optional
        Whether the least gain with one sample more is computed as well.
    """
    model = _error_model(design)
    if model is None or (model.Az.size and not _is_stable(model.Az, model.plant.dt)):
        return None
    plant = model.plant.dense()
    c, through, disturbed, noisy = model.fault_output
    response = minimal((model.Az, model.fault, -c, through))
    white = (model.noise, noisy) if plant.nw else (-model.observer.By, model.observer.Dy[model.observer.fault_rows])
    gain = _gain((model.Az, model.disturbance, -c, disturbed), plant.dt)
    gain = 0.0 if gain <= NOTHING * _effect_of_disturbances(model) else gain
    deviation = _deviation((model.Az, white[0], -c, white[1]), plant.dt)
    delay = _delay_of(response, model.observer, plant)
    fault_map = FaultMap(None, response, True) if delay is None else _map_of(delay)
    bounded, measured = _driven_by_disturbances(plant), _driven_by_noise(plant, decoupled=gain == 0.0)
    after = None if delay is None or not later else _map_of(delay, more=1)
    return LeastPossible(
        gain,
        _least(bounded, fault_map, "hinf") if gain else 0.0,
        deviation,
        _least(measured, fault_map, "h2") if np.isfinite(deviation) else np.nan,
        delay,
        np.nan if after is None else _least(bounded, after, "hinf"),
        bool(plant.nw),
        bool(plant.nd) and gain == 0.0,
    )


def least_possible_of(plant: DescriptorSystem) -> str:
    """Return how little of the disturbances fault estimates of a sampled plant can show, in one line; or nothing.

    With the delays of Wang et al. 2015: the least gamma with the paper's W and with a free one, the least gain of any
    causal filter, and that with one sample more.
    """
    plant = plant.dense()
    if not (plant.is_discrete and plant.nd and plant.nf and plant.nx <= MOST_STATES):
        return ""
    held, prepared = examine_fault_filter(plant, exactly=False)
    if prepared is None or not all(condition.holds for condition in held):
        return ""
    delay = tuple(int(index or 0) for index in prepared.detectability.indexes)
    paper, free, *_ = least_by_weight(prepared)
    bounded = _driven_by_disturbances(plant)
    here, later = (_least(bounded, _map_of(delay, more=more), "hinf") for more in (0, 1))
    return (
        f"Least gain from the disturbances, held over each sample, to the fault estimates {_with_delay(delay)}, if the "
        f"model is exact: {paper:.5g} with the paper's W (Wang 2015), {_in_words(free, paper)} with a free W, "
        f"{_in_words(here, paper)} of any causal filter; with one sample more: {_in_words(later, paper)}."
    )


def _error_model(design: ObserverDesign) -> ErrorModel | None:
    """Return the error model of a design that estimates every fault of a linear plant; ``None`` for others."""
    if not isinstance(design.plant, DescriptorSystem) or not isinstance(design.observer, LinearObserver):
        return None
    if set(design.observer.fault_names) != set(design.plant.fault_names) or not design.plant.nf:
        return None
    model = method_class(design.method).error_model(design)
    if (
        model is None
        or model.later
        or max(model.plant.nx, model.observer.order) > MOST_STATES
        or model.observer.fault_names != model.plant.fault_names
    ):
        return None
    return model


def _effect_of_disturbances(model: ErrorModel) -> float:
    """Return what disturbances could do to the estimates in a step, whatever cancels."""
    plant, observer = model.plant, model.observer
    direct = observer.Dy[observer.fault_rows]
    driven = np.abs(model.own) @ np.abs(plant.Bd) + np.abs(observer.By) @ np.abs(plant.Dd)
    through = np.abs(direct) @ np.abs(plant.Dd)
    if model.T0 is not None:
        through = through + np.abs(model.T0[observer.fault_rows, : plant.nx]) @ np.abs(plant.Bd)
    return float(np.linalg.norm(model.fault_output[0]) * np.linalg.norm(driven) + np.linalg.norm(through))


def _map_of(delay: tuple[int, ...], *, more: int = 0) -> FaultMap:
    return FaultMap(tuple(samples + more for samples in delay), None, True)


def _least(plant: DescriptorSystem, fault_map: FaultMap, norm: str) -> float:
    """Return the least norm; NaN where none is found."""
    try:
        least = designed(plant, fault_map, norm)
    except (ObsynthError, np.linalg.LinAlgError):
        return float("nan")
    return 0.0 if least.is_nothing else least.gain


def _driven_by_disturbances(plant: DescriptorSystem) -> DescriptorSystem:
    """Return the plant with its disturbances as bounded signals, and no noise."""
    return plant.replace(
        Bd=plant.Bd[:, :0],
        Dd=plant.Dd[:, :0],
        disturbance_names=(),
        Bw=plant.Bd,
        Dw=plant.Dd,
        noise_names=plant.disturbance_names,
    )


def _driven_by_noise(plant: DescriptorSystem, *, decoupled: bool) -> DescriptorSystem:
    """Return the plant with its noise, unit noise on every output without any, and disturbances only if decoupled."""
    if not plant.nw:
        names = tuple(f"noise {i + 1}" for i in range(plant.ny))
        plant = plant.replace(Bw=np.zeros((plant.nx, plant.ny)), Dw=np.eye(plant.ny), noise_names=names)
    if decoupled:
        return plant
    return plant.replace(Bd=plant.Bd[:, :0], Dd=plant.Dd[:, :0], disturbance_names=())


def _delay_of(response: Model, observer: LinearObserver, plant: DescriptorSystem) -> tuple[int, ...] | None:
    """Return the delays of an exact fault map; ``None`` where the response is another one."""
    if not plant.is_discrete:
        return None
    delays = tuple(int(delay) for delay in observer.fault_delays)
    a, b, c, d = response
    count = 2 * len(a) + max(delays, default=0) + MORE_POINTS
    for point in np.exp(1j * (np.arange(count) + 0.5) * np.pi / count):
        transfer = c @ np.linalg.solve(point * np.eye(len(a)) - a, b) + d
        if np.max(np.abs(transfer - np.diag([point**-delay for delay in delays]))) > SAME_RESPONSE:
            return None
    return delays


def _is_stable(a: FloatArray, dt: float) -> bool:
    modes = np.linalg.eigvals(a)
    return bool(np.all(np.abs(modes) < 1.0) if dt > 0.0 else np.all(modes.real < 0.0))


def _gain(system: Model, dt: float) -> float:
    a, b, c, d = system
    if not b.shape[1]:
        return 0.0
    if dt == 0.0 and len(a):
        alpha = float(np.exp(np.mean(np.log(np.abs(np.linalg.eigvals(a))))))
        a, b, c, d = cayley(a, b, c, d, alpha)
    return float(hinf_norm(a, b, c, d).upper)


def _deviation(system: Model, dt: float) -> float:
    a, b, c, d = system
    if dt == 0.0 and np.linalg.norm(d) > NOTHING * (np.linalg.norm(d) + np.linalg.norm(c) * np.linalg.norm(b)):
        return float("inf")
    if dt > 0.0:
        return float(np.sqrt(max(np.trace(d @ d.T + c @ gramian(a, b @ b.T) @ c.T), 0.0)))
    with warnings.catch_warnings(action="ignore"):
        covariance = continuous_lyapunov(a, -b @ b.T) if len(a) else np.zeros((0, 0))
    return float(np.sqrt(max(np.trace(c @ covariance @ c.T), 0.0)))


def _share(own: float, least: float) -> float:
    if not own:
        return 1.0
    return own / least if least > 0.0 else float("inf") if least == 0.0 else float("nan")
