"""Synthesis of the detection filter: gain and weight that make the transfer function of the unknown inputs co-inner."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from obsynth.analysis.existence.condition import require_all
from obsynth.analysis.existence.ding2000 import reading_outputs, unknown_inputs
from obsynth.errors import SolverError
from obsynth.methods.detection_filter.method import DetectionFilterMethod
from obsynth.methods.method import Synthesis
from obsynth.numerics.arrays import FloatArray, largest_singular_value
from obsynth.numerics.matrix_equations import continuous_lyapunov, continuous_solution
from obsynth.numerics.norms import response
from obsynth.numerics.outward import lower_text, upper_text
from obsynth.numerics.scaling import power_of_two_below
from obsynth.numerics.spectra import abscissa
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.plant_units import PlantUnits
from obsynth.plants.transformations.elimination import eliminate_algebraic_states
from obsynth.results.design import Certificate
from obsynth.verification.error_system import ErrorModel
from obsynth.verification.norm_proofs import Transfer, added_gain, error_transfer, gain_is_proved, sensitivity_is_proved

#: If the band begins at zero, the logarithmic grid of frequencies begins at this share of the largest frequency.
LEAST_FREQUENCY = 1e-6

#: Margins that are tried in turn until the proof is not spoilt by rounding: the proved gain is above one, and the
#: proved sensitivity below the least value on the grid, by one of these.
GAIN_MARGINS, SENSITIVITY_MARGINS = (1e-6, 1e-4, 1e-2), (1e-4, 1e-3, 1e-2, 0.1, 0.5)

#: Share of the slack of a bound that makes the inequality strict; the rest is for rounding.
STRICTNESS = 0.5

#: A state whose variance is less than this share of the largest one counts as not reached by noise.
UNREACHED = 1e-12

#: Number of frequencies of the grid, and of refinements of the least value between its neighbours.
GRID_FREQUENCIES, GRID_REFINEMENTS = 400, 40


def synthesise(plant: DescriptorSystem, method: DetectionFilterMethod, *, progress: Callable[[str], None]) -> Synthesis:
    """Design the filter; see `obsynth.detection_filter` for the options, results and errors."""
    progress("checking the existence conditions")
    require_all(method.existence(plant))
    elimination = eliminate_algebraic_states(plant)
    smooth = elimination.plant if elimination.description else plant
    progress("choosing the gains")
    reading = reading_outputs(smooth)
    designed = smooth.replace(
        **{name: getattr(smooth, name)[reading] for name in ("C", "D", "Dd", "Df", "Dw")},
        output_names=[smooth.output_names[place] for place in reading],
    )
    units = _OwnUnits.of(designed)
    gain, weight = np.zeros((smooth.nx, smooth.ny)), np.zeros((smooth.ny, smooth.ny))
    gain[:, reading], weight[np.ix_(reading, reading)] = units.in_data_units(*_gains(units.scaled(designed)))
    observer = LinearObserver(
        Az=smooth.A - gain @ smooth.C,
        Bu=smooth.B - gain @ smooth.D,
        By=gain,
        Cz=-weight @ smooth.C,
        Du=-weight @ smooth.D,
        Dy=weight,
        dt=0.0,
        input_names=smooth.input_names,
        output_names=smooth.output_names,
        state_names=(),
        fault_names=(),
        residual_names=tuple(f"r{i + 1}" for i in range(smooth.ny)),
        state_delays=(),
        fault_delays=(),
    )
    disturbed = error_transfer(smooth, observer, *unknown_inputs(smooth))
    bound, witness = _proved_gain(disturbed, units)
    if witness is None:
        raise SolverError(
            "The Riccati equation of the detection filter has no solution for which a gain can be proved in double "
            f"precision (the slowest pole is at {abscissa(observer.Az, 0.0):.3g} 1/s, the largest gain is "
            f"{np.max(np.abs(gain), initial=0.0):.3g}): the result is inconclusive. Zeros from the unknown inputs to "
            "the outputs near the imaginary axis do that, and noise that hardly reaches some states: state noise of "
            "the states (Bw)."
        )
    low, high = _band(observer) if method.band is None else (float(value) for value in method.band)
    least, where = _sensitivity(smooth, observer, low, high)
    faulty = error_transfer(smooth, observer, smooth.Bf, smooth.Df)
    levels = [least * (1.0 - margin) for margin in SENSITIVITY_MARGINS]
    claims = {
        "disturbance_gain": bound,
        "fault_sensitivity": _first_proved(levels, lambda level: sensitivity_is_proved(faulty, level, low, high)),
        "band_from": low,
        "band_to": high,
        "frequency": where,
    }
    return Synthesis(
        replace(method, band=[low, high]).as_plain(),
        {"L": gain, "V": weight},
        observer,
        Certificate({"P": witness}, claims),
        notes=_notes(smooth, observer, claims),
        transformation=elimination if elimination.description else None,
    )


def _band(observer: LinearObserver) -> tuple[float, float]:
    """Return the default band, from zero to the fastest mode of the filter; to 1 rad/s if the filter has no states."""
    return 0.0, float(np.max(np.abs(np.linalg.eigvals(observer.Az)), initial=0.0)) or 1.0


def _first_proved(levels: Sequence[float], is_proved: Callable[[float], bool]) -> float:
    """Return the first of falling levels that is proved, or zero if there is none.

    The lowest level is tried second: if it cannot be proved, no other can, and each failure takes seconds.
    """
    if is_proved(levels[0]):
        return levels[0]
    lower = levels[1:] if is_proved(levels[-1]) else ()
    return next((level for level in lower if is_proved(level)), 0.0)


@dataclass(frozen=True, eq=False)
class _OwnUnits:
    """The plant's own units of states and time, and units in which the noise of each output is near one.

    All are powers of two.  The equations are solved in these units, so that success does not depend on the user's.
    """

    states: FloatArray
    outputs: FloatArray
    rate: float

    @classmethod
    def of(cls, plant: DescriptorSystem) -> _OwnUnits:
        """Return the units of a plant with ``E = I``."""
        units, direct = PlantUnits.of(plant).rounded(), unknown_inputs(plant)[1]
        return cls(units.states, 1.0 / power_of_two_below(np.linalg.norm(direct, axis=1)), units.rate)

    def moved(self, a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return dynamics and inputs in these units of states and time."""
        factors = self.rate / self.states[:, None]
        return factors * a * self.states, factors * b

    def scaled(self, plant: DescriptorSystem) -> DescriptorSystem:
        """Return the plant in these units; the unknown inputs, whose size is one, keep theirs."""
        (a, bd), bw = self.moved(plant.A, plant.Bd), self.moved(plant.A, plant.Bw)[1]
        output_factors = self.outputs[:, None]
        return plant.replace(
            A=a,
            Bd=bd,
            Bw=bw,
            C=output_factors * plant.C * self.states,
            Dd=output_factors * plant.Dd,
            Dw=output_factors * plant.Dw,
        )

    def in_data_units(self, gain: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return L and V in the units of the data."""
        return self.states[:, None] * gain * self.outputs / self.rate, weight * self.outputs


def _proved_gain(transfer: Transfer, units: _OwnUnits) -> tuple[float, FloatArray | None]:
    """Return the least proved bound of the gain, and the matrix ``(n, n)`` that proves it."""
    for bound in (1.0 + margin for margin in GAIN_MARGINS):
        for witness in _gain_witnesses(transfer, bound, units):
            if gain_is_proved(transfer, bound, witness):
                return bound, witness
    return np.inf, None


def _gain_witnesses(transfer: Transfer, bound: float, units: _OwnUnits) -> Iterator[FloatArray]:
    """Yield matrices ``(n, n)`` that may prove a bound above one on the gain of a co-inner transfer function.

    The covariance X of its states for unit noise satisfies the bounded real inequality for the bound one with equality.
    For a larger bound, ``X + eps S`` with ``a S + S a' = -Q`` satisfies it strictly.  The entries of Q are proportional
    to the variances of the states, as the rounding errors of X are; states that noise does not reach get a least one.
    """
    parts = transfer.dynamics, transfer.B, transfer.C, transfer.D
    a, b, c, d = (part.midpoint for part in parts)
    if not len(a):
        yield a
        return
    (a, b), c = units.moved(a, b), c * units.states
    gap = bound**2 - largest_singular_value(d) ** 2
    try:
        variances = np.diag(continuous_lyapunov(a, -b @ b.T))
        for least in (1.0, max(UNREACHED * np.max(variances), np.finfo(np.float64).tiny)):
            weight = np.maximum(variances, least)
            size = largest_singular_value(c @ continuous_lyapunov(a, -np.diag(weight)) / np.sqrt(weight))
            room = gap / max(size**2, gap)
            covariance = continuous_lyapunov(a, -b @ b.T - STRICTNESS * room * np.diag(weight))
            yield 0.5 * (covariance + covariance.T) * (units.states[:, None] * units.states / units.rate)
    except (np.linalg.LinAlgError, ValueError):
        return


def _notes(plant: DescriptorSystem, observer: LinearObserver, claims: Mapping[str, float]) -> tuple[str, ...]:
    notes = (
        "Unknown inputs and noise reach the residuals with a gain of at most "
        f"{upper_text(claims['disturbance_gain'], 7)}, the faults with at least "
        f"{lower_text(claims['fault_sensitivity'])} from {claims['band_from']:g} to {claims['band_to']:g} rad/s (least "
        f"at {claims['frequency']:.3g} rad/s).",
    )
    if np.isfinite(added_gain(plant, observer, *unknown_inputs(plant))):
        return notes
    return (
        *notes,
        "The plant is not stable: both norms are those of the error's own equations, and what rounding of the stored "
        "numbers adds has no finite gain. It matters for disturbances that last very long.",
    )


def _gains(plant: DescriptorSystem) -> tuple[FloatArray, FloatArray]:
    """Return L ``(nx, ny)`` and V ``(ny, ny)`` that make the transfer function of the unknown inputs co-inner."""
    b, d = unknown_inputs(plant)
    measured = d @ d.T
    y = continuous_solution(plant.A, plant.C, b @ b.T, measured, b @ d.T)
    gain = None if y is None else np.linalg.solve(measured, (y @ plant.C.T + b @ d.T).T).T
    if gain is None or not np.all(np.isfinite(gain)) or not abscissa(plant.A - gain @ plant.C, 0.0) < 0.0:
        raise SolverError(
            "The Riccati equation of the detection filter has no stabilising solution: a zero from the unknown inputs "
            "to the outputs lies on the imaginary axis, or a mode is unobservable. State noise of the states (Bw)."
        )
    sizes, directions = np.linalg.eigh(measured)
    return np.asarray(gain), np.asarray((directions / np.sqrt(sizes)) @ directions.T)


def _sensitivity(plant: DescriptorSystem, observer: LinearObserver, low: float, high: float) -> tuple[float, float]:
    """Return the least singular value from the faults to the residuals on a band, and its frequency."""
    errors = ErrorModel(plant, observer, np.eye(plant.nx))
    output_map, direct, _, _ = errors.residual_output

    def least(points: FloatArray) -> FloatArray:
        if plant.nf > plant.ny:
            return np.zeros(len(points))
        responses = response(errors.Az, errors.fault, -output_map, direct, np.asarray(1j * points, dtype=np.complex128))
        return np.asarray(np.linalg.svd(responses, compute_uv=False)[:, -1])

    grid = np.unique(
        np.concatenate(
            [
                np.linspace(low, high, GRID_FREQUENCIES),
                np.geomspace(max(low, LEAST_FREQUENCY * high), high, GRID_FREQUENCIES),
            ]
        )
    )
    values = least(grid)
    at = int(np.argmin(values))
    lower, upper = grid[max(at - 1, 0)], grid[min(at + 1, len(grid) - 1)]
    for _ in range(GRID_REFINEMENTS):
        inner = np.linspace(lower, upper, 5)
        best = int(np.argmin(least(inner)))
        lower, upper = inner[max(best - 1, 0)], inner[min(best + 1, 4)]
    place = 0.5 * (lower + upper)
    value = float(least(np.array([place]))[0])
    return (value, float(place)) if value < values[at] else (float(values[at]), float(grid[at]))
