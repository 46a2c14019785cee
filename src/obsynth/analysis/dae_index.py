"""Solvability and index of a DAE, from the condition of (7) as the step gets shorter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.newton import ScaledMatrix
from obsynth.numerics.ranks import SINGULAR_CONDITION
from obsynth.plants.dae.functions import DAEFunctions
from obsynth.plants.dae.model import DAEModel

#: The step is shortened by these factors.  Short enough that dF/dx' rules, long enough that index 3 stays countable.
SHORTENINGS = (1e-2, 1e-3)
#: Equations and states with at least this share of the largest entry of a singular vector are named.
LEADING_SHARE = 0.1


@dataclass(frozen=True, eq=False)
class IndexReport:
    """Index of a DAE at one point.

    Fields: index: 1, 2, 3, ...; 0 where the matrix of (7) is singular for every step; conditions: Equilibrated
    condition numbers of (7) at the shortened steps; equations, states: Those that are involved where the index is not
    1.
    """

    index: int
    conditions: tuple[float, ...]
    equations: tuple[str, ...]
    states: tuple[str, ...]


def index_report(
    model: DAEModel, dt: float, *, x: FloatArray | None = None, u: FloatArray | None = None,
    theta: FloatArray | None = None,
) -> IndexReport:  # fmt: skip
    """Find the index of a model: the condition of (7) grows by ``10^(index - 1)`` when the step falls to a tenth.

    Shapes: ``x (nx,)``, ``u (nu,)``, ``theta (nq,)``.
    """
    x = model.nominal_state if x is None else x
    u = model.nominal_input if u is None else u
    theta = model.nominal_parameters if theta is None else theta
    functions = DAEFunctions(model)
    matrices = []
    for factor in SHORTENINGS:
        _, jacobian = functions.residual(x, x, u, theta, np.array([factor * dt]))
        matrices.append(ScaledMatrix.of(jacobian, model.state_scales))
    conditions = tuple(matrix.condition for matrix in matrices)
    if not np.isfinite(conditions[0]) or conditions[0] > SINGULAR_CONDITION:
        return IndexReport(0, conditions, *involved(model, matrices[0].matrix))
    decades = np.log10(SHORTENINGS[0] / SHORTENINGS[-1])
    slope = np.log10(min(conditions[-1], 1.0 / np.finfo(np.float64).eps) / conditions[0]) / decades
    index = 1 + max(0, round(float(slope)))
    found = ((), ()) if index == 1 else involved(model, matrices[-1].matrix)
    return IndexReport(index, conditions, *found)


def involved(model: DAEModel, matrix: FloatArray) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return equations and states of the least singular direction.

    Shapes: ``matrix (stages * nx, stages * nx)``.
    """
    if not np.isfinite(matrix).all():
        bad = [i % model.nx for i, row in enumerate(matrix) if not np.isfinite(row).all()]
        return tuple(model.equation_names[i] for i in sorted(set(bad))), ()
    left, _, right = np.linalg.svd(matrix)
    return _named(left[:, -1], model.equation_names), _named(right[-1], model.state_names)


def _named(vector: FloatArray, names: tuple[str, ...]) -> tuple[str, ...]:
    sizes = np.abs(vector).reshape(-1, len(names)).max(axis=0)
    return tuple(name for name, size in zip(names, sizes, strict=True) if size >= LEADING_SHARE * sizes.max())
