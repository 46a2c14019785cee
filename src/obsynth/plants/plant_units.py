"""Natural units of a plant: states, faults and time are near one in them, whatever units the plant came in.

With ``x = S x'``, ``t = tau t'`` (no tau in discrete time): ``E' = Q E S``, ``A' = tau Q A S``, ``C' = Y C S``,
``Bf' = tau Q Bf Phi_f``, ``Phi' = tau W^-1 Phi W``; the factors are least squares in the logarithms of all entries.
Of plants that are sampled so fast that A is nearly E they are those of ``A - E``, with the tau of one step.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from obsynth.numerics.arrays import ComplexArray, FloatArray, read_only, remembered
from obsynth.numerics.logarithmic_balance import LogBalance
from obsynth.numerics.ranks import RANK_TOLERANCE
from obsynth.numerics.scaling import balanced_matrix
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.faults import Exosystem

#: Given units in which the natural factors differ by more than this are no units to design in.
FAR_UNITS = 256.0

#: Weight of inputs and outputs beside equations and states, which they scale only where A and E leave that open.
SIGNALS_WEIGHT = 1e-3

#: A step that changes an entry by less than this share of it may be rounding of the entry.
STEP_ROUNDING = 64.0 * float(np.finfo(np.float64).eps)

#: A plant whose states change by less than this share in a sample is not sampled fast: its links are far apart.
LEAST_STEP = 1e-5

#: An entry that is a smaller share of the largest of its row and of its column, however the states are scaled, is what
#: rounding left of rounding in an elimination: between a rounding (2^-53) and the square of one.
LEAST_SHARE = float(np.finfo(np.float64).eps) ** 1.5

#: Exponents of integer plants are often half of a whole number, which rounding would take up or down by chance.
OFF_THE_TIES = 1e-3

_SIGNAL_KINDS = ("equations", "states", "outputs", "faults", "disturbances", "model")


@dataclass(frozen=True, eq=False)
class PlantUnits:
    """Factors between a plant as given and the scaled one.
    Equations and outputs are multiplied by theirs; a state, fault, ... is its factor times the scaled one."""

    time: float  # tau, or ``dt``
    equations: FloatArray
    states: FloatArray
    outputs: FloatArray
    faults: FloatArray
    disturbances: FloatArray
    model: FloatArray  # ``(nw,)``: of the states of the fault model
    discrete: bool

    @classmethod
    def of(cls, plant: DescriptorSystem, model: Exosystem | None = None) -> PlantUnits:
        """Return the units that suit a plant and the model of its faults."""
        own, by_steps = _units_of(plant)
        return own if model is None else cls._balanced(plant, model, by_steps=by_steps)

    @classmethod
    def _balanced(cls, plant: DescriptorSystem, model: Exosystem | None, *, by_steps: bool = False) -> PlantUnits:
        """Return the units of a plant, or of what a step changes: of ``A - E`` and its own time, in place of A."""
        nx, ny, order = plant.nx, plant.ny, 0 if model is None else model.order
        ends = np.cumsum([1, nx, nx, ny, plant.nf, plant.nd, order])
        equations, states, outputs, faults, disturbances, fault_model = (
            range(int(start), int(end)) for start, end in pairwise(ends)
        )
        problem = LogBalance(int(ends[-1]))
        time = None if plant.is_discrete and not by_steps else 0
        a = step_change(plant.E, plant.A) if by_steps else plant.A
        # A state and the equation of its derivative belong together, however many others A links them to.
        problem.add(plant.E, equations, states, weight=float(nx))
        problem.add(a if plant.is_discrete else _noticeable(plant.E, a), equations, states, common=time)
        problem.add(plant.Bf, equations, faults, common=time, weight=SIGNALS_WEIGHT)
        problem.add(plant.Bd, equations, disturbances, common=time, weight=SIGNALS_WEIGHT)
        problem.add(plant.C, outputs, states, weight=SIGNALS_WEIGHT)
        if model is not None:
            phi = step_change(np.eye(order), model.Phi) if by_steps else model.Phi
            problem.add(phi, fault_model, fault_model, signs=(-1, 1), common=time)
        for row, size in zip(outputs, np.linalg.norm(plant.Dw, axis=1), strict=True):
            # Parts of a plant that do not touch each other compare by their noise.
            if size > 0.0:
                problem.wish(row, -float(np.log2(size)))
        exponents = problem.solve()
        _fix_sizes(plant, exponents, (equations, outputs), (states, faults, disturbances))
        factors = np.exp2(exponents)
        own, equation_units = factors[states], factors[equations] * (1.0 if time is None else factors[0])
        output_units = _inverse_sizes(plant.C * own, plant.Df, plant.Dd)
        entering = [
            _inverse_sizes((equation_units[:, None] * inner).T, (output_units[:, None] * direct).T)
            for inner, direct in ((plant.Bf, plant.Df), (plant.Bd, plant.Dd))
        ]
        courses = _model_units(model, factors[fault_model], entering[0])
        units = (factors[equations], own, output_units, *entering, courses)
        parts = {kind: read_only(part) for kind, part in zip(_SIGNAL_KINDS, units, strict=True)}
        return cls(time=plant.dt or float(factors[0]), discrete=plant.is_discrete, **parts)

    @property
    def spread(self) -> float:
        """Largest ratio of two factors of the same kind: how far the given units are from these."""
        kinds = (self.equations, self.states, self.outputs)
        return max(float(np.max(part) / np.min(part)) for part in kinds if part.size)

    def apart(self, other: PlantUnits) -> float:
        """Return the largest ratio of ratios of two factors of the same kind in these units and in others."""
        kinds = ((self.equations, other.equations), (self.states, other.states), (self.outputs, other.outputs))
        return float(np.exp2(max(np.ptp(np.log2(own) - np.log2(its)) for own, its in kinds if own.size)))

    @property
    def rate(self) -> float:
        """What eigenvalues are multiplied by: those of sampled plants have no unit."""
        return 1.0 if self.discrete else self.time

    @property
    def augmented_states(self) -> FloatArray:
        """Factors of the state and of that of the fault model, ``(nx + nw,)``."""
        return np.concatenate([self.states, self.model])

    @property
    def augmented_equations(self) -> FloatArray:
        """Factors of the equations, those of the fault model included, ``(nx + nw,)``."""
        return np.concatenate([self.equations, 1.0 / self.model])

    def rounded(self) -> PlantUnits:
        """Return the same with powers of two, with which scaling is exact."""

        powers = {kind: read_only(_power_of_two(getattr(self, kind))) for kind in _SIGNAL_KINDS}
        time = self.time if self.discrete else float(_power_of_two(np.array(self.time)))
        return PlantUnits(time=time, discrete=self.discrete, **powers)

    def for_decoupling(self, plant: DescriptorSystem) -> PlantUnits:
        """Return the same with each equation that holds a derivative scaled by its row of E.
        How much of a state is read and how much integrated then does not depend on how fast it is."""
        rows = np.max(np.abs(plant.E) * self.states, axis=1, initial=0.0)
        moving = rows * self.equations > RANK_TOLERANCE * np.max(rows * self.equations, initial=0.0)
        return replace(self, equations=read_only(np.where(moving, 1.0 / np.where(moving, rows, 1.0), self.equations)))

    def scaled_plant(self, plant: DescriptorSystem) -> DescriptorSystem:
        """Return the plant in these units; known inputs keep theirs, and noise its unit intensity."""
        equations = self.rate * self.equations[:, None]
        outputs = self.outputs[:, None]
        spread = 1.0 if self.discrete else float(np.sqrt(self.time))
        return plant.replace(
            E=self.equations[:, None] * plant.E * self.states,
            A=equations * plant.A * self.states,
            B=equations * plant.B,
            Bf=equations * plant.Bf * self.faults,
            Bd=equations * plant.Bd * self.disturbances,
            Bw=spread * self.equations[:, None] * plant.Bw,
            C=outputs * plant.C * self.states,
            D=outputs * plant.D,
            Df=outputs * plant.Df * self.faults,
            Dd=outputs * plant.Dd * self.disturbances,
            Dw=outputs * plant.Dw / spread,
            dt=1.0 if self.discrete else 0.0,
        )

    def scaled_pencil(
        self, e: FloatArray, a: FloatArray, inputs: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return a system pencil ``(nx + ny, nx + nu)`` with rows and columns in these units, and its own time."""
        rows = np.concatenate([self.equations, self.outputs])[:, None]
        columns = np.concatenate([self.states, np.ones(0) if inputs is None else inputs])
        return rows * e * columns, rows * a * columns

    def scaled_model(self, model: Exosystem) -> Exosystem:
        """Return the fault model in these units."""
        return replace(
            model,
            Phi=read_only(self.rate * model.Phi * self.model / self.model[:, None]),
            Cw=read_only(model.Cw * self.model / self.faults[:, None]),
            eigenvalues=self.rate * model.eigenvalues,
        )

    def eigenvalue(self, scaled: complex) -> complex:
        """Return an eigenvalue or zero in the plant's own time."""
        return complex(scaled) / self.rate

    def eigenvalues(self, scaled: ComplexArray) -> ComplexArray:
        """Return eigenvalues or zeros in the plant's own time."""
        return np.asarray(scaled / self.rate, dtype=np.complex128)


def _power_of_two(factors: FloatArray) -> FloatArray:
    return np.asarray(np.exp2(np.round(np.log2(factors) + OFF_THE_TIES)))


def _fix_sizes(
    plant: DescriptorSystem, exponents: FloatArray, rows: tuple[range, range], columns: tuple[range, range, range]
) -> None:
    """Make the exponent of the first state of each part of a plant a whole number.

    Rows times a number and columns over it are the same part: which number is taken would hang on the given units, and
    with it how the exponents are rounded.
    """
    nothing = np.zeros((plant.ny, plant.nf + plant.nd), dtype=bool)
    moved = np.hstack([(plant.E != 0.0) | (plant.A != 0.0), plant.Bf != 0.0, plant.Bd != 0.0])
    linked = np.vstack([moved, np.hstack([plant.C != 0.0, nothing])])
    row_places, column_places = (
        np.concatenate([np.array(part, dtype=np.int64) for part in parts]) for parts in (rows, columns)
    )
    waiting = np.ones(linked.shape[1], dtype=bool)
    free = np.ones(linked.shape[0], dtype=bool)
    for state in range(plant.nx):
        if not waiting[state]:
            continue
        place = column_places[state]
        step, reached = float(np.round(exponents[place]) - exponents[place]), np.array([state])
        while reached.size:
            waiting[reached] = False
            exponents[column_places[reached]] += step
            touched = np.flatnonzero(free & np.any(linked[:, reached], axis=1))
            free[touched] = False
            exponents[row_places[touched]] -= step
            reached = np.flatnonzero(waiting & np.any(linked[touched], axis=0))


@remembered
def _units_of(plant: DescriptorSystem) -> tuple[PlantUnits, bool]:
    """Return the units of a plant, and whether they are those of what a step changes: where it is sampled so fast that
    A is nearly E, beside which the weakest link of two states would count as a strong one."""
    units = PlantUnits._balanced(plant, None)
    if plant.is_discrete:
        by_steps = PlantUnits._balanced(plant, None, by_steps=True)
        change = step_change(plant.E, plant.A)
        if moves_by_steps(plant.E, change, by_steps.equations, by_steps.states) and units.apart(by_steps) > FAR_UNITS:
            return by_steps, True
    return units, False


def step_change(before: FloatArray, after: FloatArray) -> FloatArray:
    """Return ``after - before``, without what is only their rounding."""
    change = after - before
    return np.where(np.abs(change) > STEP_ROUNDING * np.abs(before), change, 0.0)


def moves_by_steps(E: FloatArray, change: FloatArray, rows: FloatArray, columns: FloatArray) -> bool:
    """Return whether what a step changes ``(m, n)``, in units of rows and columns in which all of it is alike, is a
    share of the states that a sampling time would make of them; rows without E are no steps."""
    steps = (rows[:, None] * change * columns)[E.any(axis=1)]
    return bool(np.max(np.abs(steps), initial=0.0) > LEAST_STEP)


def sized_plant(plant: DescriptorSystem) -> DescriptorSystem | None:
    """Return the plant with the sizes of the terms of its entries in their place; ``None`` where there are none."""
    exact = plant.exact
    return None if exact is None or exact.sizes is None else plant.replace(**exact.sizes)


def _noticeable(E: FloatArray, A: FloatArray) -> FloatArray:
    """Return A ``(n, n)`` without the entries that are less than rounding of rounding, where each equation has the
    derivative of a state of its own: their logarithms would count as much as those of true links.

    A network of 565 states had units of 1e38 by 1,158 of its 33,898 entries.
    """
    derivatives = np.diag(E)
    if np.any(derivatives == 0.0) or np.count_nonzero(E) > len(E):
        return A
    sizes = np.abs(balanced_matrix(A / derivatives[:, None])[0])
    least = LEAST_SHARE * np.minimum(sizes.max(axis=1, keepdims=True, initial=0.0), sizes.max(axis=0, initial=0.0))
    return np.where(sizes >= least, A, 0.0)


def _inverse_sizes(*parts: FloatArray) -> FloatArray:
    """Return the inverse length of each row of the first part in which it is not zero; 1 where it is in none."""
    lengths = np.zeros(len(parts[0]))
    for part in parts:
        lengths = np.where(lengths > 0.0, lengths, np.linalg.norm(part, axis=1))
    return np.asarray(1.0 / np.where(lengths > 0.0, lengths, 1.0))


def _model_units(model: Exosystem | None, factors: FloatArray, faults: FloatArray) -> FloatArray:
    """Return the factors of the states of the fault model, such that the rows of Cw have unit length for each fault."""
    if model is None:
        return factors
    units, links = factors.copy(), model.Phi != 0.0
    for fault, row in zip(faults, model.Cw, strict=True):
        linked = row != 0.0
        for _ in range(model.order):
            linked = linked | np.any(links[linked], axis=0) | np.any(links[:, linked], axis=1)
        size = float(np.linalg.norm(row * factors))
        units[linked] = factors[linked] * (fault / size if size > 0.0 else 1.0)
    return units


def noise_inputs(plant: DescriptorSystem, units: PlantUnits, measurement: Any) -> tuple[FloatArray, FloatArray]:
    """Return Bw and Dw of a scaled plant: with noise of its outputs as ``measurement`` says (one number, or numbers by
    name, in the units of the plant as given), or else as the plant states, or else of one on each output."""
    if measurement is None and plant.Dw.any():
        return plant.Bw, plant.Dw
    deviations = np.ones(plant.ny)
    if measurement is not None:
        listed = [measurement[name] if isinstance(measurement, Mapping) else measurement for name in plant.output_names]
        deviations = np.array(listed) * units.outputs / (1.0 if units.discrete else np.sqrt(units.time))
    stated = np.zeros((plant.ny, plant.nw))
    return np.hstack([plant.Bw, np.zeros((plant.nx, plant.ny))]), np.hstack([stated, np.diag(deviations)])
