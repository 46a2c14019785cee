"""Solvability and index of a DAE, and which of its states and parameters the outputs distinguish."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.numerics.arguments import arguments_checked, require_shape
from obsynth.numerics.arrays import FloatArray, as_matrix, read_only
from obsynth.numerics.newton import ScaledMatrix
from obsynth.numerics.ranks import IDENTIFIABLE_SHARE, NAMED_SHARE, SINGULAR_CONDITION, covariance_factor, is_definite
from obsynth.plants.dae import DAEModel
from obsynth.plants.dae_checks import without_value
from obsynth.plants.dae_functions import DAEFunctions
from obsynth.plants.dae_signals import checked_inputs, finite_vector, step_length
from obsynth.plants.implicit_step import ImplicitStep

#: A start and one step.
FEWEST_SAMPLES = 2

#: The step is shortened by these factors.  Short enough that dF/dx' rules, long enough that index 3 stays countable.
SHORTENINGS = (1e-2, 1e-3)

#: Equations and states with at least this share of the largest entry of a singular vector are named.
LEADING_SHARE = 0.1


@dataclass(frozen=True, eq=False)
class Identifiability:
    """What the outputs say of the initial state and the parameters along a trajectory.

    Parameters
    ----------
    names : tuple of str
        States (at the first sample after the start), then parameters.
    singular_values : FloatArray
        ``(r + nq,)``, falling: sensitivity of the outputs, in standard deviations of the sensors, to one unit of
        `scales` along each direction; r is the number of ways in which a state can move without leaving the
        algebraic equations.
    directions : FloatArray
        ``(r + nq, nx + nq)``: row i belongs to singular value i, in units of `scales`.
    scales : FloatArray
        ``(nx + nq,)``.
    deviations : FloatArray
        ``(nx + nq,)``: Cramer-Rao bounds of the standard deviations, in the signals' units; infinite where a signal
        is not identifiable.
    excitation : float
        Least eigenvalue of the information on the parameters alone (the initial state known), in units of `scales`.
    rank : int
        Number of directions that are seen.

    Examples
    --------
    >>> import obsynth
    >>> import numpy as np
    >>> tank = obsynth.DAEModel(
    ...     {"balance": "der(level) = inflow - c * sqrt(level)"},
    ...     {"gauge": "level"},
    ...     states={"level": 1.0},
    ...     inputs={"inflow": 0.5},
    ...     parameters={"c": 0.5},
    ...     units={"level": "m", "inflow": "m/s", "c": "m0.5/s", "gauge": "m"},
    ... )
    >>> result = obsynth.identifiability(tank, np.full((50, 1), 0.5), dt=1.0, R=1e-4)
    >>> result.names, result.rank
    (('level', 'c'), 2)
    """

    names: tuple[str, ...]
    singular_values: FloatArray
    directions: FloatArray
    scales: FloatArray
    deviations: FloatArray
    excitation: float
    rank: int

    @property
    def unseen(self) -> tuple[dict[str, float], ...]:
        """Each direction that has no effect on the outputs: signal -> share, of entries worth naming."""
        return tuple(self._shares(row) for row in self.directions[self.rank :])

    @property
    def faint(self) -> tuple[dict[str, float], ...]:
        """Each direction, unseen ones included, of which one unit moves the outputs by less than their noise."""
        return tuple(
            self._shares(row) for value, row in zip(self.singular_values, self.directions, strict=True) if value < 1.0
        )

    def __repr__(self) -> str:
        known = zip(self.names, self.deviations, strict=True)
        lines = [f"{n}: deviation {d:.3g} at least" if np.isfinite(d) else f"{n}: not identifiable" for n, d in known]
        shares = [", ".join(f"{share:.3g} {name}" for name, share in direction.items()) for direction in self.unseen]
        return "\n".join([*lines, *(f"no effect on the outputs (in units of scales): {text}" for text in shares)])

    def _shares(self, row: FloatArray) -> dict[str, float]:
        return {name: float(share) for name, share in zip(self.names, row, strict=True) if abs(share) > NAMED_SHARE}

    @property
    def unidentifiable(self) -> tuple[str, ...]:
        """Signals with a share in a direction that is not seen."""
        return tuple(n for n, d in zip(self.names, self.deviations, strict=True) if not np.isfinite(d))


@arguments_checked
def identifiability(
    model: DAEModel,
    u: ArrayLike,
    *,
    dt: float,
    R: ArrayLike,
    method: str = "backward-euler",
    initial_state: ArrayLike | None = None,
    parameters: ArrayLike | None = None,
    state_scales: ArrayLike | None = None,
    parameter_scales: ArrayLike | None = None,
) -> Identifiability:
    r"""Find which initial states and parameters can be distinguished from the outputs along a nominal trajectory.

    Parameters
    ----------
    model : DAEModel
        The plant.
    u : array_like
        Inputs ``(samples, nu)``; the trajectory starts at the first and takes ``samples - 1`` steps.
    dt : float
        Seconds between samples.
    R : array_like
        Sensor noise: covariance ``(ny, ny)``.
    method : {"backward-euler", "radau"}, optional
        Of integration.
    initial_state, parameters : array_like, optional
        ``(nx,)`` and ``(nq,)``; nominal values by default.
    state_scales, parameter_scales : array_like, optional
        What counts as one unit of each, ``(nx,)`` and ``(nq,)``: sizes of nominal values by default, one where
        these are zero.

    Returns
    -------
    Identifiability
        Singular directions in named signals, Cramer-Rao deviations, and the excitation of the parameters.  Process
        noise is not counted: with it, the deviations are larger.

    Raises
    ------
    SpecError
        A shape is wrong, or there are fewer than two samples.
    SolverError
        A step of the trajectory has no solution.

    References
    ----------
    .. [MoussaAliDAE2013] (26) asks for excitation; that the paper's own example has none is our finding.

    Examples
    --------
    >>> import obsynth
    >>> import numpy as np
    >>> tank = obsynth.DAEModel(
    ...     {"balance": "der(level) = inflow - c * sqrt(level)"},
    ...     {"gauge": "level"},
    ...     states={"level": 1.0},
    ...     inputs={"inflow": 0.5},
    ...     parameters={"c": 0.5},
    ...     units={"level": "m", "inflow": "m/s", "c": "m0.5/s", "gauge": "m"},
    ... )
    >>> found = obsynth.identifiability(tank, np.full((50, 1), 0.5), dt=1.0, R=1e-4)
    >>> print(found)
    level: deviation 0.00613 at least
    c: deviation 0.000395 at least
    """
    inputs, noise, length = checked_inputs(model, u), as_matrix(R, "R"), step_length(dt)
    if len(inputs) < FEWEST_SAMPLES:
        raise SpecError(f"u has {len(inputs)} samples: a trajectory needs at least {FEWEST_SAMPLES}.", path="u")
    require_shape(noise.shape, (model.ny, model.ny), "R")
    root = covariance_factor(noise, "R")
    if not is_definite(noise, root):
        raise SpecError("R must be positive definite: a sensor without noise has no likelihood.", path="R")
    x = finite_vector(initial_state, model.state_names, model.nominal_state, "initial_state")
    theta = finite_vector(parameters, model.parameter_names, model.nominal_parameters, "parameters")
    sizes = np.where(theta != 0.0, np.abs(theta), 1.0)
    scales = np.concatenate(
        [
            finite_vector(state_scales, model.state_names, model.state_scales, "state_scales"),
            finite_vector(parameter_scales, model.parameter_names, sizes, "parameter_scales"),
        ]
    )
    if not (scales > 0.0).all():
        raise SpecError("state_scales and parameter_scales must be positive.", path="parameter_scales")
    step = ImplicitStep(DAEFunctions(model, method), length)
    sensitivities, free = _sensitivities(model, step, inputs, x, theta, scales[: model.nx])
    whitened = np.linalg.solve(root, sensitivities).reshape(-1, sensitivities.shape[2])
    r = free.shape[1]
    whitened[:, r:] *= scales[model.nx :]
    to_signals = np.block([[free.T, np.zeros((r, model.nq))], [np.zeros((model.nq, model.nx)), np.eye(model.nq)]])
    _, values, coefficients = np.linalg.svd(whitened, full_matrices=False)
    directions = coefficients @ to_signals
    rank = int(np.sum(values > IDENTIFIABLE_SHARE * values[0]))
    spread = scales * np.sqrt(np.sum((directions[:rank] / values[:rank, None]) ** 2, axis=0))
    hidden = np.abs(directions[rank:]).max(axis=0, initial=0.0) > NAMED_SHARE
    of_parameters = np.linalg.svd(whitened[:, r:], compute_uv=False)
    return Identifiability(
        (*model.state_names, *model.parameter_names),
        read_only(values),
        read_only(directions),
        read_only(scales),
        read_only(np.where(hidden, np.inf, spread)),
        float(of_parameters[-1] ** 2) if model.nq else 0.0,
        rank,
    )


def _sensitivities(
    model: DAEModel, step: ImplicitStep, inputs: FloatArray, x: FloatArray, theta: FloatArray, scales: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return derivatives of all outputs by free directions and parameters, and these directions.
    The first step leads onto the algebraic equations: the range of its F holds the directions that are free there."""
    moved = free = np.zeros((model.nx, 0))
    sensitivities = []
    for k in range(1, len(inputs)):
        solution = step.solve(x, inputs[k], theta, before=inputs[k - 1], k=k)
        F, G, _ = step.sensitivities(solution, x, inputs[k], theta)
        x = solution.x
        if k == 1:
            left_vectors, values, _ = np.linalg.svd(F * scales / scales[:, None])
            free = left_vectors[:, values > IDENTIFIABLE_SHARE * values[0]]
            moved = np.hstack([scales[:, None] * free, np.zeros((model.nx, model.nq))])
        else:
            moved = F @ moved
            moved[:, free.shape[1] :] += G
        _, H, L = step.functions.outputs(x, theta)
        rows = H @ moved
        rows[:, free.shape[1] :] += L
        sensitivities.append(rows)
    return np.array(sensitivities), free


@dataclass(frozen=True, eq=False)
class IndexReport:
    """Index of a DAE at a point, 0 where (7) is always singular; its conditions at short steps, and who is involved."""

    index: int
    conditions: tuple[float, ...]
    equations: tuple[str, ...]
    states: tuple[str, ...]
    undefined: str = ""  # which equations have no value or derivative at the point; the index is 0 then


def index_report(
    model: DAEModel,
    dt: float,
    *,
    x: FloatArray | None = None,
    u: FloatArray | None = None,
    theta: FloatArray | None = None,
) -> IndexReport:
    """Find the index of a model: the condition of (7) grows by ``10^(index - 1)`` when the step falls to a tenth."""
    x = model.nominal_state if x is None else x
    u = model.nominal_input if u is None else u
    theta = model.nominal_parameters if theta is None else theta
    functions = DAEFunctions(model)
    residuals = [functions.residual(x, x, u, theta, np.array([factor * dt])) for factor in SHORTENINGS]
    names = model.equation_names * (len(residuals[0][1]) // model.nx)  # those of each stage
    bad, undefined = without_value(names, residuals[0][0][:, 0], residuals[0][1], where="at the nominal values")
    if undefined:
        return IndexReport(0, (np.inf, np.inf), tuple(bad), (), undefined)
    jacobians = [jacobian for _, jacobian in residuals]
    matrices = [ScaledMatrix.of(jacobian, model.state_scales) for jacobian in jacobians]
    conditions = tuple(matrix.condition for matrix in matrices)
    if not np.isfinite(conditions[0]) or conditions[0] > SINGULAR_CONDITION:
        return IndexReport(0, conditions, *involved(model, matrices[0].matrix))
    decades = np.log10(SHORTENINGS[0] / SHORTENINGS[-1])
    slope = np.log10(min(conditions[-1], 1.0 / np.finfo(np.float64).eps) / conditions[0]) / decades
    index = 1 + max(0, round(float(slope)))
    who = ((), ()) if index == 1 else involved(model, matrices[-1].matrix)
    return IndexReport(index, conditions, *who)


def involved(model: DAEModel, matrix: FloatArray) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return equations and states of the least singular direction of ``matrix (stages * nx, stages * nx)``."""
    if not np.isfinite(matrix).all():
        bad = [i % model.nx for i, row in enumerate(matrix) if not np.isfinite(row).all()]
        return tuple(model.equation_names[i] for i in sorted(set(bad))), ()
    left_vectors, _, right_vectors = np.linalg.svd(matrix)
    return _named(left_vectors[:, -1], model.equation_names), _named(right_vectors[-1], model.state_names)


def _named(vector: FloatArray, names: tuple[str, ...]) -> tuple[str, ...]:
    sizes = np.abs(vector).reshape(-1, len(names)).max(axis=0)
    return tuple(name for name, size in zip(names, sizes, strict=True) if size >= LEADING_SHARE * sizes.max())
