r"""A plant without its unknown inputs, for the descriptor Kalman filter; and when that exists.

With ``[V1 V2]`` orthonormal and ``Dd V2 = 0``, ``d1 = V1' d`` becomes a state without an equation of its own, and
``d2 = V2' d`` is removed with an orthonormal N, ``N Bd V2 = 0``:

.. math::
    N [E \; 0] [x; d_1]^+ = N [A \; B_d V_1] [x; d_1] + N B u + N \mu, \qquad y = [C \; D_d V_1] [x; d_1] + \nu.

Nothing else is known about d, so nothing is lost.  It exists when ``[N E 0; C Dd V1]`` has full column rank: (D1).
Constant parameters of a plant (its faults) enter the equations that are left by ``N Bf``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from obsynth.analysis.existence.condition import Condition
from obsynth.analysis.existence.first_states import extended_covariance, extended_mean, stated_covariance
from obsynth.analysis.existence.recursive import recursive_conditions
from obsynth.analysis.time_varying import as_time_varying
from obsynth.errors import SpecError
from obsynth.numerics.arguments import require_shape
from obsynth.numerics.arrays import FloatArray, as_matrix, dimensions_of, remembered
from obsynth.numerics.ranks import covariance_factor, numerical_rank, product_but_rounding
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.plant_units import PlantUnits
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem

#: Prior deviation of an unknown input at the first sample, relative to the one that moves a state by its own prior
#: deviation: as good as none, and its square far from overflow.
UNKNOWN_INPUT_PRIOR = 1e4

#: How names of conditions on E begin, and how they do where unknown inputs were removed with equations.
_GIVEN, _LEFT = "rank [E; C", "rank [N E; C"
_WHAT_IS_LEFT = "N combines the equations to those without unknown inputs"


@dataclass(frozen=True, eq=False)
class WithoutUnknownInputs:
    """A plant whose unknown inputs are states, or removed with equations."""

    plant: TimeVaryingDescriptorSystem
    equations: FloatArray  # N (ne, nx)
    names: tuple[str, ...]  # of the states d1
    scale: FloatArray  # of the prior deviations of d1, (n1,)
    note: str

    @property
    def outputs_alone(self) -> bool:
        """Whether no equation is left: the estimate then follows from the outputs of its sample."""
        return not self.equations.any()

    def process_covariance(self, covariance: object) -> object:
        """Return the covariance of the equations that are left, from that of all: a number or a constant matrix."""
        if self.outputs_alone:
            return np.zeros((1, 1))
        dimensions = 3 if callable(covariance) else dimensions_of(covariance, "Q")
        if dimensions == 0:
            return covariance
        if dimensions != 2:
            raise SpecError(
                "Q changes with k, which is not known how to be combined with unknown inputs: give a constant "
                "covariance.",
                path="Q",
            )
        matrix = as_matrix(covariance, "Q")
        count = self.equations.shape[1]
        require_shape(matrix.shape, (count, count), "Q")
        # By a factor: what cancels in a combination of equations has no variance, rather than one of rounding.
        factor = product_but_rounding(self.equations, covariance_factor(matrix, "Q"))
        return factor @ factor.T

    def initial_state(self, state: object) -> FloatArray:
        """Return the mean of the first state: unknown inputs are as likely to be of either sign."""
        return extended_mean(state, self.equations.shape[1], len(self.names))

    def initial_covariance(self, covariance: object) -> FloatArray:
        """Return the covariance of the first state, in which unknown inputs may have any size."""
        own = stated_covariance(covariance, self.equations.shape[1])
        deviation = UNKNOWN_INPUT_PRIOR * self.scale * max(float(np.sqrt(np.max(np.diag(own)))), 1.0)
        return extended_covariance(own, deviation**2)


@dataclass(frozen=True, eq=False)
class _ScaledInputs:
    """Unknown inputs in units in which each has the same effect, with factors that bring the plant near one.

    No unit of the plant then decides what an output shows.
    """

    Bd: FloatArray
    Dd: FloatArray
    equations: FloatArray
    outputs: FloatArray


@remembered
def without_unknown_inputs(plant: DescriptorSystem) -> WithoutUnknownInputs:
    """Return a plant without its unknown inputs; `SpecError` for what else these methods do not take."""
    nothing = {name: None for name in ("Bd", "Dd", "disturbance_names")}
    known = as_time_varying(plant.replace(**nothing))
    scaled = _scaled_inputs(plant)
    names, V1, V2 = _direct_inputs(plant, scaled)
    equations = _equations_without(plant, scaled, V2)
    removed = plant.nx - int(np.count_nonzero(equations.any(axis=1)))
    # All of them as states: in their own units again, with their own names.
    Bd, Dd = (plant.Bd, plant.Dd) if len(names) == plant.nd else (scaled.Bd, scaled.Dd)
    process_d1, direct_d1 = product_but_rounding(equations, Bd) @ V1, Dd @ V1
    scale = 1.0 / np.linalg.norm(np.vstack([Bd, Dd]) @ V1, axis=0)
    reduced = TimeVaryingDescriptorSystem(
        np.hstack([product_but_rounding(equations, plant.E), np.zeros((len(equations), len(names)))]),
        np.hstack([product_but_rounding(equations, plant.A), process_d1]),
        product_but_rounding(equations, plant.B),
        np.hstack([plant.C, direct_d1]),
        Phi=product_but_rounding(equations, plant.Bf),
        Psi=plant.Df,
        D=plant.D,
        dt=plant.dt,
        state_names=(*plant.state_names, *names),
        input_names=plant.input_names,
        output_names=plant.output_names,
        parameter_names=plant.fault_names,
        operating_point=known.operating_point,
        scales=known.scales,
        units={**known.units, **{name: plant.units[name] for name in names if name in plant.units}},
    )
    return WithoutUnknownInputs(reduced, equations, names, scale, _note(plant, names, removed))


def _scaled_inputs(plant: DescriptorSystem) -> _ScaledInputs:
    factors = PlantUnits.of(plant).rounded()
    equations, outputs = factors.equations[:, None], factors.outputs[:, None]
    sizes = np.linalg.norm(np.vstack([equations * plant.Bd, outputs * plant.Dd]), axis=0)
    units = 1.0 / np.where(sizes > 0.0, sizes, 1.0)
    return _ScaledInputs(plant.Bd * units, plant.Dd * units, equations, outputs)


def _direct_inputs(plant: DescriptorSystem, scaled: _ScaledInputs) -> tuple[tuple[str, ...], FloatArray, FloatArray]:
    """Return the names of the unknown inputs that outputs show directly, V1, and V2."""
    dd = scaled.Dd
    _, values, right = np.linalg.svd(scaled.outputs * dd) if dd.size else (None, np.zeros(0), np.eye(plant.nd))
    rank = numerical_rank(values, scale=1.0)
    if rank == plant.nd:
        return plant.disturbance_names, np.eye(plant.nd), right[rank:].T
    return tuple(f"unknown input {i + 1}" for i in range(rank)), right[:rank].T, right[rank:].T


def _equations_without(plant: DescriptorSystem, scaled: _ScaledInputs, V2: FloatArray) -> FloatArray:
    """Return ``N`` with ``N Bd V2 = 0``: the equations that are left, or ``0 = 0`` where there are none."""
    # Equations that no hidden input enters stay as they are: what is exact in them (delays) stays exact.
    hidden_effect = scaled.equations * scaled.Bd @ V2
    reached = np.flatnonzero(np.any(hidden_effect != 0.0, axis=1))
    left_vectors, singular_values, _ = np.linalg.svd(hidden_effect[reached])
    removed = numerical_rank(singular_values, scale=1.0)
    if removed == plant.nx:
        return np.zeros((1, plant.nx))
    equations = np.eye(plant.nx)
    if not removed:
        return equations
    combined = np.zeros((len(reached) - removed, plant.nx))
    combined[:, reached] = left_vectors[:, removed:].T * scaled.equations[reached, 0]
    return np.vstack([combined, np.delete(equations, reached, axis=0)])


def _note(plant: DescriptorSystem, names: Sequence[str], removed: int) -> str:
    """Return what becomes of the unknown inputs, in words."""
    parts = []
    if names:
        parts.append(f"{', '.join(map(repr, names))} {'is' if len(names) == 1 else 'are'} estimated with the states")
    if removed == plant.nx:
        parts.append("no equation is left beside them, and each estimate follows from the outputs of its sample alone")
    elif removed:
        parts.append(
            f"{removed} of {plant.nx} equations were removed with the unknown inputs that reach no output directly"
        )
    note = f"Nothing is assumed about the unknown inputs {', '.join(map(repr, plant.disturbance_names))}: "
    return note + ("; ".join(parts) or "they have no effect") + "."


def kalman_conditions(
    plant: DescriptorSystem | TimeVaryingDescriptorSystem,
    *,
    parameters: bool = False,
    literal: bool = False,
    early: bool = False,
) -> tuple[Condition, ...]:
    """Return the existence conditions, those of the ``parameters`` too; the list ends at the first failure."""
    if not isinstance(plant, DescriptorSystem) or not plant.nd:
        return tuple(recursive_conditions(plant, parameters=parameters, literal=literal, early=early))
    try:
        reduced: DescriptorSystem | TimeVaryingDescriptorSystem = without_unknown_inputs(plant).plant
    except SpecError:
        # What it is says why it is not taken.
        reduced = plant.replace(Bd=None, Dd=None, disturbance_names=None)
    found = recursive_conditions(reduced, parameters=parameters, literal=literal, early=early)
    return tuple(map(_of_equations_left, found))


def _of_equations_left(condition: Condition) -> Condition:
    """Return a condition on ``E`` as one on ``N E``: the E of the plant as given may have full rank."""
    if not condition.name.startswith(_GIVEN):
        return condition
    name, claim = (text.replace(_GIVEN, _LEFT) for text in (condition.name, condition.claim))
    return replace(condition, name=name, claim=f"{claim} ({_WHAT_IS_LEFT})")


def with_stated_noise(
    plant: DescriptorSystem | TimeVaryingDescriptorSystem, options: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the options with Q and R from the noise that a time-invariant plant states, where none are given."""
    resolved = dict(options)
    missing = [name for name in ("Q", "R") if resolved[name] is None]
    if not isinstance(plant, DescriptorSystem) or not plant.nw or not missing:
        return resolved
    if np.any(product_but_rounding(plant.Bw, plant.Dw.T)):
        raise SpecError(
            f"{missing[0]} is not stated, and cannot be taken from the plant's noise alone, which drives equations and "
            "outputs at once (Bw Dw' is not zero): state neither Q nor R, or both.",
            path=missing[0],
        )
    for name, matrix in (("Q", plant.Bw), ("R", plant.Dw)):
        if resolved[name] is None:
            resolved[name] = matrix @ matrix.T
    return resolved
