"""The gain and the weight that make the transfer from the unknown inputs co-inner; how much is left of the faults."""

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

#: The grid of frequencies begins at this share of its end, where the band begins at zero.
LEAST_FREQUENCY = 1e-6

#: The proved gain is the first of these above one, and the proved sensitivity the first below what a grid finds, with
#: which the proof is above the rounding of its numbers.
GAIN_MARGINS, SENSITIVITY_MARGINS = (1e-6, 1e-4, 1e-2), (1e-4, 1e-3, 1e-2, 0.1, 0.5)

#: Share of the room that a bound leaves which strictness of the inequality takes: the other half is for rounding.
STRICTNESS = 0.5

#: A state with less than this share of the largest variance is none that noise reaches, up to rounding.
UNREACHED = 1e-12

#: Frequencies of the grid, and how often the least value is refined between its neighbours.
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
    felt = error_transfer(smooth, observer, *unknown_inputs(smooth))
    bound, witness = _proved_gain(felt, units)
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
    reached = error_transfer(smooth, observer, smooth.Bf, smooth.Df)
    levels = [least * (1.0 - margin) for margin in SENSITIVITY_MARGINS]
    claims = {
        "disturbance_gain": bound,
        "fault_sensitivity": _first_proved(levels, lambda level: sensitivity_is_proved(reached, level, low, high)),
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
    """Return the band from zero to the fastest mode of a filter; where it has none all frequencies are alike."""
    return 0.0, float(np.max(np.abs(np.linalg.eigvals(observer.Az)), initial=0.0)) or 1.0


def _first_proved(levels: Sequence[float], is_proved: Callable[[float], bool]) -> float:
    """Return the first of falling levels that is proved, or zero: where the lowest has no proof none has, and a failure
    takes seconds."""
    if is_proved(levels[0]):
        return levels[0]
    lower = levels[1:] if is_proved(levels[-1]) else ()
    return next((level for level in lower if is_proved(level)), 0.0)


@dataclass(frozen=True, eq=False)
class _OwnUnits:
    """Units of states and time of a plant's own, and of outputs in which each has a noise near one: powers of two.
    Equations are solved in these, so that whether they are solved does not hang on those of the data."""

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
        """Return the plant in these units; unknown inputs keep theirs, in which they are as large as one."""
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
    """Return the least bound of the gain that is proved, and the matrix ``(n, n)`` that does."""
    for bound in (1.0 + margin for margin in GAIN_MARGINS):
        for witness in _gain_witnesses(transfer, bound, units):
            if gain_is_proved(transfer, bound, witness):
                return bound, witness
    return np.inf, None


def _gain_witnesses(transfer: Transfer, bound: float, units: _OwnUnits) -> Iterator[FloatArray]:
    """Yield matrices ``(n, n)`` that may prove a gain above one of a co-inner transfer.

    The covariance X of its states for unit noise solves the bounded real inequality at one, with equality: its other
    blocks vanish.  A larger bound has room for ``X + eps S``, ``a S + S a' = -Q``, which makes it strict.  Q is as
    large as the rounding of X: by the states' own variances, where noise reaches them.
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
    """Return L ``(nx, ny)`` and V ``(ny, ny)`` that make the transfer from the unknown inputs co-inner."""
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
    """Return the least singular value from the faults to the residuals on a band, and where."""
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
