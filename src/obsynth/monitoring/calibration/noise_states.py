"""A plant of a calibration with states for what disturbs it: coloured noise, offsets of sensors, loads that walk."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from obsynth.monitoring.calibration.linear_plant import FIRST_CORRELATION, LEAST_CORRELATION, LONGEST_SHARE
from obsynth.monitoring.calibration.logs import RecordedLog, roughness
from obsynth.monitoring.calibration.plants import SIZED_SAMPLES, CalibrationPlant, outputs_function
from obsynth.monitoring.calibration.step_graphs import sample_graphs
from obsynth.numerics import lazy_casadi as ca
from obsynth.numerics.arrays import SMALLEST, FloatArray
from obsynth.plants.dae_functions import BUTCHER
from obsynth.plants.noise import UNKNOWN_NUMBER, noise_state, offset_state, seconds
from obsynth.plants.signal_names import index_of

#: An offset may be this many times what a sensor changes from row to row, or as large as it moves.
LARGEST_SENSOR_OFFSET = 10.0


@dataclass(frozen=True)
class NoiseStates:
    """What gets states: coloured noise by output, with its correlation in s or None; offsets by output; loads."""

    correlations: Mapping[str, float | None] = field(default_factory=dict)
    offsets: tuple[str, ...] = ()
    loads: tuple[str, ...] = ()

    @property
    def searched(self) -> tuple[str, ...]:
        """Outputs whose correlation is to be found."""
        return tuple(name for name, value in self.correlations.items() if value is None)

    def __bool__(self) -> bool:
        return bool(self.correlations or self.offsets or self.loads)


def stated_noise_states(
    sensor_noise: Mapping[str, Any] | None, offset: Any, walks: Any, output_names: Sequence[str]
) -> NoiseStates:
    """Return the states that a caller asks for; what is white needs none."""
    correlations = {}
    for name, item in (sensor_noise or {}).items():
        index_of(name, output_names, what="sensor_noise")
        if not isinstance(item, Mapping) or "correlation" not in item:
            continue
        value = item["correlation"]
        correlations[name] = None if value == UNKNOWN_NUMBER else seconds(value, f"sensor_noise.{name}.correlation")
    offsets = () if offset is None else tuple(offset)
    for name in offsets:
        index_of(name, output_names, what="offset")
    return NoiseStates(correlations, offsets, () if walks is None else tuple(walks))


def correlation_name(output: str) -> str:
    """Return what the logarithm of a correlation in s is called among what is sought."""
    return f"correlation of {output}"


class PlantWithNoise(CalibrationPlant):
    """A plant with further states, which follow its own: coloured noise, offsets, loads.

    Coloured noise goes over a sample as the plant's own integration makes it, so that a design finds the same numbers.
    """

    def __init__(self, inner: CalibrationPlant, states: NoiseStates, log: RecordedLog) -> None:
        self.inner, self.states, self._outputs = inner, states, log.output_names
        for name in states.loads:
            index_of(name, list(inner.values), what="walks")
        self.coloured, self.own = tuple(states.correlations), len(inner.state_names)
        added = (
            *(noise_state(name) for name in self.coloured),
            *(offset_state(name) for name in states.offsets),
            *states.loads,
        )
        self.added = added
        self.state_names, self.equation_names = (*inner.state_names, *added), (*inner.equation_names, *added)
        first = np.log(FIRST_CORRELATION * log.dt)
        self.values = {
            **{name: value for name, value in inner.values.items() if name not in states.loads},
            **{correlation_name(name): first for name in states.searched},
        }
        self.unstated = inner.unstated - set(states.loads)
        self.units, self.has_levels, self.own_integration = inner.units, inner.has_levels, inner.own_integration
        self.notes = () if set(inner.unknown_inputs) <= set(states.loads) else inner.notes
        self.unknown_inputs = inner.unknown_inputs
        self.walking = tuple(name for name in inner.walking if name not in states.loads)
        self.nominal_signals = inner.nominal_signals
        means = [float(inner.values[name]) for name in states.loads]
        self.nominal_state = np.concatenate([inner.nominal_state, np.zeros(len(added) - len(means)), means])
        longest = max(LONGEST_SHARE * log.samples, 2.0 * FIRST_CORRELATION)
        span = (float(np.log(LEAST_CORRELATION * log.dt)), float(np.log(longest * log.dt)))
        self.bounds = {correlation_name(name): span for name in states.searched}
        sizes = self._sizes(log)
        self.state_scales = np.concatenate([inner.state_scales, sizes])
        self.state_deviations = np.concatenate([inner.state_deviations, sizes])

    @property
    def noisy(self) -> tuple[str, ...]:
        """Equations of further states that noise drives: all but those of offsets."""
        fixed = {offset_state(name) for name in self.states.offsets}
        return tuple(name for name in self.added if name not in fixed)

    def signals(self, log: RecordedLog) -> FloatArray:
        """Return what steps and outputs take of each row ``(n, ns)``."""
        return self.inner.signals(log)

    def _sizes(self, log: RecordedLog) -> FloatArray:
        """Return how large the further states may be: as sensors move, or as loads that make them move so."""
        rough = roughness(log.y)
        moved = np.nan_to_num(np.nanstd(log.y, axis=0))
        moved = np.maximum(np.where(moved > 0.0, moved, 1.0), rough)
        large = dict(zip(log.output_names, moved, strict=True))
        offsets = dict(zip(log.output_names, np.maximum(moved, LARGEST_SENSOR_OFFSET * rough), strict=True))
        sizes = [large[name] for name in self.coloured] + [offsets[name] for name in self.states.offsets]
        return np.array([*sizes, *self._load_sizes(log, moved)])

    def _load_sizes(self, log: RecordedLog, moved: FloatArray) -> list[float]:
        sizes = []
        for name in self.states.loads:
            graphs = sample_graphs(self.inner, (name,), log.dt, integration=self.inner.integration("auto"), substeps=1)
            x, t = self.inner.nominal_state, np.array([float(self.inner.values[name])])
            signals, reach, effect = self.inner.signals(log), np.zeros((self.own, 1)), 0.0
            for row in signals[:SIZED_SAMPLES]:
                stages = graphs.solve(x, row, t)[0]
                numbers = graphs.sensitivities(x, row, t, stages)
                _, F, G, _ = graphs.local(x, row, t, t, numbers)
                reach = np.array(F) @ reach + np.array(G)
                _, H, L = graphs.outputs(x, row, t)
                effect = max(effect, float(np.nanmax(np.abs(np.array(H) @ reach + np.array(L))[:, 0] / moved)))
            nominal = abs(t[0]) or 1.0
            sizes.append(1.0 / effect if effect > SMALLEST else nominal)
        return sizes

    def _correlation(self, name: str, t: Any, unknown: Sequence[str]) -> Any:
        value = self.states.correlations[name]
        return ca.exp(t[list(unknown).index(correlation_name(name))]) if value is None else ca.SX(value)

    def _inner_constants(self, x: Any, t: Any, unknown: Sequence[str]) -> tuple[tuple[str, ...], Any]:
        """Return what the plant itself takes as unknown, and its values: constants, and loads from their states."""
        searched = {correlation_name(name) for name in self.states.searched}
        constants = [i for i, name in enumerate(unknown) if name not in searched]
        loads = x[x.numel() - len(self.states.loads) :] if self.states.loads else ca.SX(0, 1)
        values = ca.vertcat(*(t[i] for i in constants), loads)
        return (*(unknown[i] for i in constants), *self.states.loads), values if values.numel() else ca.SX(0, 1)

    def step(self, unknown: Sequence[str], integration: str) -> tuple[int, Any]:
        """Return stages, and the function from stages, state before, signals, constants and dt to equations."""
        n, count = self.own, len(self.state_names)
        names, _ = self._inner_constants(ca.SX.sym("x", count), ca.SX.sym("t", len(unknown)), unknown)
        stages, inner = self.inner.step(names, integration)
        X, x, dt = ca.SX.sym("X", count * stages), ca.SX.sym("x", count), ca.SX.sym("dt")
        s, t = ca.SX.sym("s", len(self.nominal_signals)), ca.SX.sym("t", len(unknown))
        parts = ca.reshape(X, count, stages)
        # Loads act as inputs do: during the step that ends with them, of a discrete plant that begins with them.
        _, values = self._inner_constants(parts[:, stages - 1] if integration in BUTCHER else x, t, unknown)
        inner_equations = ca.reshape(inner(ca.vec(parts[:n, :]), x[:n], s, values, dt), n, stages)
        added = self._added(parts[n:, :], x[n:], t, unknown, dt, integration)
        return stages, ca.Function("equations", [X, x, s, t, dt], [ca.vec(ca.vertcat(inner_equations, added))])

    def _added(self, parts: Any, before: Any, t: Any, unknown: Sequence[str], dt: Any, integration: str) -> Any:
        """Return the equations of the further states at each stage, in units of their change over a second."""
        stages = parts.shape[1]
        rows = []
        if integration in BUTCHER:
            weights = np.linalg.inv(BUTCHER[integration])
            for i in range(parts.shape[0]):
                change = parts[i, :] - before[i]
                rate = ca.horzcat(
                    *(sum(float(weights[k, j]) * change[j] for j in range(stages)) / dt for k in range(stages))
                )
                fall = parts[i, :] / self._correlation(self.coloured[i], t, unknown) if i < len(self.coloured) else 0.0
                rows.append(rate + fall)
        else:
            for i in range(parts.shape[0]):
                decay = ca.exp(-dt / self._correlation(self.coloured[i], t, unknown)) if i < len(self.coloured) else 1.0
                rows.append(parts[i, :] - decay * before[i])
        return ca.vertcat(*rows)

    def outputs(self, unknown: Sequence[str]) -> Any:
        """Return the function from state, signals and constants to y, H and L."""
        count = len(self.state_names)
        x, s, t = ca.SX.sym("x", count), ca.SX.sym("s", len(self.nominal_signals)), ca.SX.sym("t", len(unknown))
        names, values = self._inner_constants(x, t, unknown)
        y = self.inner.outputs(names)(x[: self.own], s, values)[0]
        selection = np.zeros((y.numel(), len(self.coloured) + len(self.states.offsets)))
        for column, name in enumerate((*self.coloured, *self.states.offsets)):
            selection[self._outputs.index(name), column] = 1.0
        y = (
            ca.densify(y) + ca.mtimes(ca.DM(selection), x[self.own : self.own + selection.shape[1]])
            if selection.size
            else y
        )
        return outputs_function(x, s, t, y)
