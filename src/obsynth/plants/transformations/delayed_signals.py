"""Delayed inputs and outputs as states of a sampled plant: samples that are on their way.

With ``tau = (m + phi) h`` a held input acts over a sample as ``u(k - m - 1)`` before ``phi h`` and as ``u(k - m)``
after it; a reading that is late by ``(m - sigma) h``, ``0 <= sigma < 1``, shows what was ``sigma h`` after sample
``k - m``.  A sample is split where an input changes or an output is taken, and each part is stepped by its own matrix
exponential [AstromWittenmark]_.  Nothing is approximated.

.. [AstromWittenmark] K. J. Astrom, B. Wittenmark, "Computer-Controlled Systems", 3rd edition, 1997, section 2.3.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.dead_times import WHOLE_SAMPLES, delays_in_words, in_samples
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.transformations.recovery import StateRecovery, Transformation, with_states

#: More samples on their way than this are a delay in another unit, or a plant that is sampled far too fast.
MOST_DELAY_STATES = 500

#: ``(A, inputs, h) -> exp(A h)`` and its integral times ``inputs``.
Hold: TypeAlias = Callable[[FloatArray, FloatArray, float], tuple[FloatArray, FloatArray]]

#: ``(A, noise, h)`` -> a factor of the covariance that white noise gathers in ``h``.
Gathered: TypeAlias = Callable[[FloatArray, FloatArray, float], FloatArray]


@dataclass(frozen=True, eq=False)
class _Lags:
    """Which samples of the inputs act, and when outputs are taken."""

    inputs: tuple[tuple[int, float], ...]  # of each input: whole samples, and seconds that are left
    outputs: tuple[tuple[int, float], ...]  # of each output: samples that its reading waits, seconds after its sample

    @classmethod
    def of(cls, plant: DescriptorSystem, step: float) -> _Lags:
        moments: list[float] = []

        def moment(time: float) -> float:
            """Return a time within a sample; those that differ by rounding alone are one."""
            same = (other for other in moments if abs(other - time) <= WHOLE_SAMPLES * step)
            moments.append(next(same, time))
            return moments[-1]

        early = [in_samples(plant.delays.get(name, 0.0), step) for name in plant.input_names]
        late = [in_samples(plant.delays.get(name, 0.0), step) for name in plant.output_names]
        inputs = tuple((whole, moment(rest) if rest else 0.0) for whole, rest in early)
        taken = tuple((whole + 1, moment(step - rest)) if rest else (whole, 0.0) for whole, rest in late)
        return cls(inputs, taken)

    @property
    def of_inputs(self) -> tuple[int, ...]:
        """How many past samples of each input act."""
        return tuple(whole + (rest > 0.0) for whole, rest in self.inputs)

    @property
    def count(self) -> int:
        """Number of samples on their way."""
        return sum(self.of_inputs) + sum(wait for wait, _ in self.outputs)

    @property
    def width(self) -> int:
        """Number of samples of inputs, the present ones among them."""
        return sum(count + 1 for count in self.of_inputs)

    def taken_at(self, moment: float) -> list[int]:
        """Return the outputs that are taken at a time after a sample."""
        return [i for i, (_, after) in enumerate(self.outputs) if after == moment]

    def moments(self, step: float) -> list[float]:
        """Return the times within a sample at which an input changes or an output is taken, and both ends."""
        inner = {rest for _, rest in self.inputs} | {after for _, after in self.outputs}
        return sorted({0.0, step, *inner})

    def acting(self, j: int, until: float) -> int:
        """Return which sample of input j acts in the part of a sample that ends at ``until``; 0 is the present one."""
        whole, rest = self.inputs[j]
        return whole + (until <= rest)

    def begun(self, j: int, at: float) -> int:
        """Return which sample of input j acts from the time ``at`` on."""
        whole, rest = self.inputs[j]
        return whole + (at < rest)


@dataclass(frozen=True, eq=False)
class DelayedSamples:
    """A plant with samples on their way among its states, and the inputs that act on the states at each sample."""

    source: DescriptorSystem
    plant: DescriptorSystem
    acting_from_state: FloatArray  # ``(nu, n)``, ``(nu, nu)``: the inputs of the source at a sample
    acting_from_input: FloatArray
    noise_kept: FloatArray  # ``(nw_source, nw)``

    def after(self, first: Transformation, description: str) -> Transformation:
        """Return the way from the plant that ``first`` started from to this one."""
        way = first.recovery
        own = np.eye(self.source.nx, self.plant.nx)
        recovery = StateRecovery(
            way.names,
            way.from_state @ own + way.from_input @ self.acting_from_state,
            way.from_input @ self.acting_from_input,
            way.from_fault,
            way.from_disturbance,
            way.from_noise @ self.noise_kept,
            way.noise_kept @ self.noise_kept,
            way.operating_point,
        )
        count = self.plant.nx - self.source.nx
        of_delays = f"{count} samples of delayed signals are states ({delays_in_words(self.source.delays)})"
        texts = (first.description, description, of_delays)
        return replace(first, plant=self.plant, description="; ".join(filter(None, texts)), recovery=recovery)


def sampled_with_delays(smooth: DescriptorSystem, step: float, hold: Hold, gathered: Gathered) -> DelayedSamples:
    """Return a continuous plant without algebraic states on samples, its delayed signals among the states.

    Faults and unknown inputs are held as inputs are.
    """
    lags = _Lags.of(smooth, step)
    _require_few(lags.count, smooth, step)
    after, readings, noise, noisy = _split_step(smooth, lags, step, hold, gathered)
    size, direct = noise.shape[1], np.flatnonzero(np.any(smooth.Dw, axis=0))
    both = np.hstack([np.vstack([noise, noisy]), np.vstack([np.zeros((smooth.nx, len(direct))), smooth.Dw[:, direct]])])
    names = (*(f"process noise {i + 1}" for i in range(size)), *(smooth.noise_names[i] for i in direct))
    noise_kept = np.hstack([np.zeros((smooth.nw, size)), np.eye(smooth.nw)[:, direct]])
    return _with_chains(smooth, step, lags, np.vstack([after, readings]), both, names, noise_kept)


def whole_samples_late(plant: DescriptorSystem) -> DelayedSamples:
    """Return a plant on samples without algebraic states, its delayed signals among the states.

    Raises
    ------
    SpecError
        A delay is not a whole number of samples.
    """
    lags = _Lags.of(plant, plant.dt)
    broken = {name: delay for name, delay in plant.delays.items() if in_samples(delay, plant.dt)[1]}
    if broken:
        raise SpecError(
            f"The delays {delays_in_words(broken)} are not whole samples of {plant.dt:g} s, and a plant on samples "
            "does not say what is between them: give the continuous plant, and sample it (discretise).",
            path="delays",
        )
    _require_few(lags.count, plant, plant.dt)
    after = np.hstack([plant.A, _inputs_placed(plant.B, lags), plant.Bf, plant.Bd])
    readings = np.hstack([plant.C, _inputs_placed(plant.D, lags), plant.Df, plant.Dd])
    noise = np.vstack([plant.Bw, plant.Dw])
    maps = np.vstack([after, readings])
    return _with_chains(plant, plant.dt, lags, maps, noise, plant.noise_names, np.eye(plant.nw))


def _require_few(count: int, plant: DescriptorSystem, step: float) -> None:
    if count > MOST_DELAY_STATES:
        raise SpecError(
            f"The delays {delays_in_words(plant.delays)} are {count} samples of {step:g} s, and each is a state: at "
            f"most {MOST_DELAY_STATES} are taken. Sample less often, or look at the units.",
            path="delays",
        )


def _inputs_placed(matrix: FloatArray, lags: _Lags, at: float = 0.0) -> FloatArray:
    """Return columns of inputs in the places of their samples that act from a time after a sample on."""
    placed, first = np.zeros((len(matrix), lags.width)), 0
    for j, count in enumerate(lags.of_inputs):
        placed[:, first + lags.begun(j, at)] = matrix[:, j]
        first += count + 1
    return placed


def _split_step(
    plant: DescriptorSystem, lags: _Lags, step: float, hold: Hold, gathered: Gathered
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return states after a sample and readings taken within it, by ``[x, samples of inputs, f, d]``, and by the noise
    that is gathered."""
    nx, signals = plant.nx, np.hstack([plant.B, plant.Bf, plant.Bd])
    now = np.hstack([np.eye(nx), np.zeros((nx, lags.width + plant.nf + plant.nd))])
    noise = np.zeros((nx, 0))
    taken, noisy = np.zeros((plant.ny, now.shape[1])), [noise[:0]] * plant.ny
    moments = lags.moments(step)
    for start, end in zip([0.0, *moments[:-1]], moments, strict=True):
        if end > start:
            transition, held = hold(plant.A, signals, end - start)
            now, first = transition @ now, nx
            for j, count in enumerate(lags.of_inputs):
                now[:, first + lags.acting(j, end)] += held[:, j]
                first += count + 1
            now[:, first:] += held[:, plant.nu :]
            noise = np.hstack([transition @ noise, gathered(plant.A, plant.Bw, end - start)])
        for i in lags.taken_at(end):
            row = slice(i, i + 1)
            taken[row] = plant.C[row] @ now
            taken[row, nx:] += np.hstack([_inputs_placed(plant.D[row], lags, end), plant.Df[row], plant.Dd[row]])
            noisy[i] = plant.C[row] @ noise
    # Noise of later parts of the sample has not reached what was taken before.
    rows = [np.hstack([row, np.zeros((1, noise.shape[1] - row.shape[1]))]) for row in noisy]
    factor = _compressed(np.vstack([noise, *rows]))
    return now, taken, factor[:nx], factor[nx:]


def _compressed(factor: FloatArray) -> FloatArray:
    """Return a factor of the same covariance with no more columns than rows."""
    if factor.shape[1] <= len(factor):
        return factor
    triangle: FloatArray = np.asarray(np.linalg.qr(factor.T, mode="r"))
    return triangle.T


def _with_chains(
    source: DescriptorSystem,
    step: float,
    lags: _Lags,
    maps: FloatArray,
    noise: FloatArray,
    noise_names: Sequence[str],
    noise_kept: FloatArray,
) -> DelayedSamples:
    """Return the plant whose states are those of ``source`` and the samples on their way.

    ``maps`` and ``noise``: states and readings after a sample, by ``[x, samples of inputs, f, d]`` and by noise.
    """
    nx, nf = source.nx, source.nf
    past, present, moved, entering = _input_chains(lags)
    first, shift, last = _reading_chains(lags)
    inner, width, read = len(moved), lags.width, len(shift)
    x, samples, faults, unknown = np.split(maps, np.cumsum([nx, width, nf]), axis=1)
    states, inputs = np.hstack([x, samples @ past]), samples @ present
    late = np.array([wait > 0 for wait, _ in lags.outputs])[:, None]

    def columns(whole: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return columns of the states and of the outputs of signals that enter by themselves."""
        counted = counted_at_reading(source, whole)
        chained = first @ np.where(counted, 0.0, whole[nx:])
        rows = np.vstack([whole[:nx], np.zeros((inner, whole.shape[1])), chained])
        return rows, np.where(late & ~counted, 0.0, whole[nx:])

    still = np.zeros((nx + inner, read))
    A = np.vstack(
        [
            np.hstack([np.vstack([states[:nx], np.hstack([np.zeros((inner, nx)), moved])]), still]),
            np.hstack([first @ states[nx:], shift]),
        ]
    )
    B = np.vstack([inputs[:nx], entering, first @ inputs[nx:]])
    C = np.hstack([np.where(late, 0.0, states[nx:]), last])
    (Bf, Df), (Bd, Dd), (Bw, Dw) = columns(faults), columns(unknown), columns(noise)
    changes = {"A": A, "B": B, "C": C, "D": np.where(late, 0.0, inputs[nx:]), "Bf": Bf, "Df": Df, "Bd": Bd, "Dd": Dd}
    labels, names = _labels(source, lags)
    made = with_states(source, names, E=None, Bw=Bw, Dw=Dw, noise_names=noise_names, dt=step, delays=None, **changes)
    made = made.replace(**{key: {**getattr(made, key), **value} for key, value in labels.items()})
    if source.uncertainty is not None:
        made = made.replace(uncertainty=source.uncertainty.left_behind("delays became states"))
    placed = _inputs_placed(np.eye(source.nu), lags)
    from_state = np.hstack([np.zeros((source.nu, nx)), placed @ past, np.zeros((source.nu, read))])
    return DelayedSamples(source, made, from_state, placed @ present, noise_kept)


def _input_chains(lags: _Lags) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the samples of inputs as ``past z + present u``, and how past ones move: ``z+ = moved z + entering u``."""
    inner, nu = sum(lags.of_inputs), len(lags.inputs)
    past, present = np.zeros((lags.width, inner)), np.zeros((lags.width, nu))
    moved, entering = np.zeros((inner, inner)), np.zeros((inner, nu))
    sample = place = 0
    for j, count in enumerate(lags.of_inputs):
        present[sample, j] = 1.0
        for lag in range(count):
            past[sample + lag + 1, place + lag] = 1.0
            # What is one sample old is the input of the sample before.
            moved[place + lag], entering[place + lag] = past[sample + lag], present[sample + lag]
        sample, place = sample + count + 1, place + count
    return past, present, moved, entering


def _reading_chains(lags: _Lags) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return where readings enter, how they move, and where they come out."""
    waits = [wait for wait, _ in lags.outputs]
    read, ny = sum(waits), len(waits)
    first, shift, last = np.zeros((read, ny)), np.zeros((read, read)), np.zeros((ny, read))
    place = 0
    for i, wait in enumerate(waits):
        if wait:
            first[place, i] = last[i, place + wait - 1] = 1.0
            shift[place + 1 : place + wait, place : place + wait - 1] = np.eye(wait - 1)
        place += wait
    return first, shift, last


def counted_at_reading(source: DescriptorSystem, columns: FloatArray) -> NDArray[np.bool_]:
    """Whether signals ``(nx + ny, n)`` act on outputs only that are all late by one time: theirs is counted from the
    reading, which needs no states."""
    late = [source.delays.get(name, 0.0) for name in source.output_names]
    reached = [{delay for delay, entry in zip(late, column, strict=True) if entry} for column in columns[source.nx :].T]
    single = np.array([len(delays) <= 1 for delays in reached], dtype=bool)
    return single & ~columns[: source.nx].any(axis=0)


def _labels(source: DescriptorSystem, lags: _Lags) -> tuple[dict[str, dict[str, Any]], tuple[str, ...]]:
    """Return operating point and units of the samples on their way, and the names of all states."""
    names, labels = list(source.state_names), {"operating_point": dict[str, Any](), "units": dict[str, Any]()}
    waits = [(name, name, count) for name, count in zip(source.input_names, lags.of_inputs, strict=True)]
    waits += [
        (name, f"reading of {name}", wait) for name, (wait, _) in zip(source.output_names, lags.outputs, strict=True)
    ]
    for name, signal, count in waits:
        for lag in range(1, count + 1):
            names.append(f"{signal}, {lag} sample{'s' if lag > 1 else ''} ago")
            for label, values in labels.items():
                if name in getattr(source, label):
                    values[names[-1]] = getattr(source, label)[name]
    return labels, tuple(names)
