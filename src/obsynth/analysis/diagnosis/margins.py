"""Margins of isolability: the part of a fault's effect that no combination of other faults explains.

At a point s (signals at rest, or a sinusoid) the outputs are ``y = G(s) f + Gd(s) d``, ``G = C (sE - A)^-1 Bf + Df``.
A residual that is blind to the faults j and to d sees of fault i the part of its column that is orthogonal to theirs.
The margin is by how much a fault has to be larger for that part to be as large as the whole: one where it is orthogonal
to the others, 1e4 where it differs from a combination of them by 1e-4 of its effect.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsynth.analysis.diagnosis.fault_columns import dc_point
from obsynth.numerics.arrays import ComplexArray, FloatArray, read_only
from obsynth.numerics.ranks import RANK_TOLERANCE, decide_rank
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.plant_units import PlantUnits

#: Samples over which the mean of the outputs is taken, and how many of its standard deviations a step has to be.
SAMPLES, DEVIATIONS = 100, 3.0

#: A margin above this is worth a sentence: of the effect of the fault a tenth is its own.
NEARLY_ALIKE = 10.0

#: A combination of faults is named in a sentence with those that share this part of it at least.
LEAST_SHARE = 1e-3


@dataclass(frozen=True, eq=False)
class Margins:
    """Margins between faults, in the order of the plant.

    Parameters
    ----------
    pairs : FloatArray
        ``(nf, nf)``, dimensionless: entry (i, j) by how much fault i has to be larger to be distinguished from fault j
        than to be seen without it; infinite where it cannot be.
    all_others : FloatArray
        ``(nf,)``: the same with all other faults of any size.
    alike : FloatArray
        ``(nf, nf)``: sizes of the faults that together look most like fault i of size one (row i), in their units;
        complex ones, of sinusoids, by their absolute value.
    least_steps : FloatArray or None
        ``(nf,)``, in units of the faults: the step that stands out by three standard deviations of the sensors' noise
        in the mean of 100 samples, with all other faults of any size; ``None`` where no noise is stated.
    at_rest : tuple of bool
        Of each fault, whether this is of constants; otherwise of sinusoids at the frequency of the plant.
    frequency : float
        In rad/s.
    """

    pairs: FloatArray
    all_others: FloatArray
    alike: FloatArray
    least_steps: FloatArray | None
    at_rest: tuple[bool, ...]
    frequency: float

    def sentence(self, names: tuple[str, ...], fault: int) -> str:
        """Return what a reader should know of a fault that nearly looks like others; empty where it does not."""
        margin = self.all_others[fault]
        if not NEARLY_ALIKE <= margin < np.inf:
            return ""
        sizes = self.alike[fault]
        shares = [j for j in np.argsort(-sizes) if j != fault and sizes[j] > LEAST_SHARE * sizes.max()]
        lookalikes = " and ".join(f"{sizes[j]:.3g} of {names[j]}" for j in shares)
        kind = "a step" if self.at_rest[fault] else f"a sinusoid at {self.frequency:.3g} rad/s"
        text = (
            f"{names[fault]}: nearly lost. {kind.capitalize()} of one looks like {lookalikes}, but for "
            f"{1.0 / margin:.2g} of its effect: it has to be {margin:.2g} times as large to be distinguished from the "
            "others as to be seen."
        )
        if self.least_steps is None or not self.at_rest[fault]:
            return text
        return (
            f"{text} A step of {self.least_steps[fault]:.3g} stands out by {DEVIATIONS:g} standard deviations of the "
            f"sensors in the mean of {SAMPLES} samples."
        )


def fault_margins(plant: DescriptorSystem, isolable: np.ndarray, at_rest: np.ndarray) -> Margins:
    """Return the margins of a plant; ``isolable``, ``at_rest (nf, nf)``: what was decided, from which faults each is
    distinguished, and as a constant."""
    units = PlantUnits.of(plant).rounded()
    whitening, in_deviations = _whitening(plant, units)
    dc, moving = dc_point(plant.dt), _own_point(plant, units)
    still, sinusoid = (_responses(plant, units, whitening, point) for point in (dc, moving))
    nf = plant.nf
    pairs, alone, alike, least = np.full((nf, nf), np.inf), np.full(nf, np.inf), np.zeros((nf, nf)), np.full(nf, np.inf)
    of_steps = []
    for i in range(nf):
        steps = still is not None and bool(at_rest[i].all())
        responses = still if steps and still is not None else sinusoid
        of_steps.append(steps)
        if responses is None or not isolable[i, i]:
            continue
        faults, unknown = responses
        effect = _remaining_length(faults[:, i], unknown)[0]
        for j in range(nf):
            if isolable[i, j] and j != i:
                pairs[i, j] = _ratio(effect, _remaining_length(faults[:, i], np.hstack([faults[:, [j]], unknown]))[0])
        pairs[i, i] = 1.0
        other_faults = [j for j in range(nf) if j != i]
        own, sizes = _remaining_length(faults[:, i], np.hstack([faults[:, other_faults], unknown]))
        alone[i] = _ratio(effect, own)
        alike[i, other_faults] = np.abs(sizes[: nf - 1])
        if own > 0.0:
            least[i] = DEVIATIONS / (np.sqrt(SAMPLES) * own)
    frequency = abs(np.angle(moving)) / plant.dt if plant.dt else float(abs(moving))
    steps_of = read_only(least) if in_deviations else None
    return Margins(read_only(pairs), read_only(alone), read_only(alike), steps_of, tuple(of_steps), frequency)


def _whitening(plant: DescriptorSystem, units: PlantUnits) -> tuple[FloatArray, bool]:
    """Return what makes outputs comparable: the whitening of the sensors' noise, or the units of the plant."""
    root = units.outputs[:, None] * plant.Dw
    if root.shape[1] and decide_rank(root, expected=plant.ny).full:
        triangle = np.linalg.cholesky(plant.Dw @ plant.Dw.T)
        return np.asarray(np.linalg.inv(triangle)), True
    return np.diag(units.outputs), False


def _own_point(plant: DescriptorSystem, units: PlantUnits) -> complex:
    """Return the point of sinusoids at the plant's own speed, of at most a quarter of a turn in a sample."""
    if plant.dt == 0.0:
        return 1j / units.rate
    return complex(np.exp(0.5j))


def _responses(
    plant: DescriptorSystem, units: PlantUnits, whitening: FloatArray, point: complex
) -> tuple[ComplexArray, ComplexArray] | None:
    """Return the effects of faults and unknown inputs on comparable outputs at a point; ``None`` at an eigenvalue."""
    pencil = units.equations[:, None] * (point * plant.E - plant.A) * units.states
    if plant.nx and not decide_rank(pencil, expected=plant.nx).full:
        return None
    inputs = units.equations[:, None] * np.hstack([plant.Bf, plant.Bd])
    outputs = (plant.C * units.states) @ np.linalg.solve(pencil, inputs) + np.hstack([plant.Df, plant.Dd])
    comparable = whitening @ outputs
    comparable = comparable.real if point.imag == 0.0 else comparable
    return comparable[:, : plant.nf], comparable[:, plant.nf :]


def _remaining_length(column: ComplexArray, beside: ComplexArray) -> tuple[float, ComplexArray]:
    """Return the length of what is left of a column beside others of any size, and the sizes that come nearest."""
    if not beside.shape[1]:
        return float(np.linalg.norm(column)), np.zeros(0, dtype=np.complex128)
    lengths = np.linalg.norm(beside, axis=0)
    scale = np.where(lengths > 0.0, lengths, 1.0)
    sizes = np.asarray(np.linalg.lstsq(beside / scale, column, rcond=RANK_TOLERANCE)[0], dtype=np.complex128)
    return float(np.linalg.norm(column - (beside / scale) @ sizes)), sizes / scale


def _ratio(effect: float, remainder: float) -> float:
    return effect / remainder if remainder > RANK_TOLERANCE * effect else np.inf
