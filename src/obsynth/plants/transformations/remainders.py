r"""The sampled linear model of a nonlinear plant, with a bound on its error over a region.

The equations are evaluated in affine arithmetic over the region, which bounds their nonlinear part and all rounding.
Between samples the nonlinear part may take any value within its bound:

.. math::
    \xi_{k+1} = A \xi_k + B u_k + B_f f_k + \rho_k, \qquad
    |\rho| \le \int_0^h |e^{A s}| \, ds \; r .
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from obsynth.errors import PreconditionError, SpecError
from obsynth.numerics import lazy_casadi as ca
from obsynth.numerics.arguments import is_finite_number
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.dae import DAEModel
from obsynth.plants.dae_equations import equation_of, symbols_of
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.transformations.elimination import eliminate_algebraic_states
from obsynth.plants.transformations.linearisation import linearise
from obsynth.plants.transformations.sampling import discretise
from obsynth.plants.transformations.uncertain_plant import reduced_matrices
from obsynth.plants.uncertainty import matrices_of
from obsynth.proofs.affine import AffineMatrix, affine_block, affine_exponential, affine_zero_order_hold
from obsynth.proofs.affine_numbers import AffineNumber, affine_translation
from obsynth.proofs.balls import UNIT_ROUNDOFF, gamma, rounded_up

#: Parts of a sampling interval in which the motion between samples is bounded.
PARTS_OF_SAMPLE = 32

#: Rounding errors of the coefficients of derivatives, which CasADi computes.
COEFFICIENT_ROUNDINGS = 16.0


def bounded_model(
    model: DAEModel,
    region: Mapping[str, Sequence[float]],
    sample_time: float,
    *,
    faults: Sequence[str],
    disturbances: Sequence[str],
    given: Mapping[str, float] | None = None,
    shipped: DescriptorSystem | None = None,
) -> tuple[DescriptorSystem, Mapping[str, float]]:
    """Return the sampled linear model at an equilibrium, and bounds on its remainders by name.

    The last disturbances of the model are the remainders.  ``shipped``: the model to bound, instead of a new one.
    ``region``: ``[low, high]`` of every state, input and fault; all else has its nominal value.
    """
    if not model.is_data or callable(model.outputs):
        raise SpecError("The model is given as functions: its remainder needs equations as texts.", path="plant")
    require_linear_rates(model)
    linear = linearise(model, given=given, faults=list(faults), disturbances=list(disturbances))
    signals = (*model.state_names, *linear.input_names, *linear.fault_names, *linear.disturbance_names)
    middles, halves = _region(model, linear, signals, region)
    several = np.sum(linear.E != 0.0, axis=1) > 1
    if np.any(linear.E[several] != np.round(linear.E[several])):
        raise PreconditionError(
            "An equation has several derivatives whose coefficients are no whole numbers: their rounding has no bound "
            "here. Write one derivative in each equation.",
            condition="remainder",
        )
    equations, outputs = _remainders(model, linear, signals, middles, halves, given or {})
    sampled = discretise(linear, sample_time).plant
    if any(name.startswith("xi ") for name in sampled.state_names):
        raise PreconditionError(
            "The equations hold derivatives of algebraic states, so that the dynamic states are combinations of "
            "states: write the equations with derivatives of the dynamic states alone.",
            condition="remainder",
        )
    at = np.maximum(np.abs(middles - halves), np.abs(middles + halves))
    own = sampled if shipped is None else shipped
    bounds = _sampled(linear, own, sample_time, (equations, outputs), dict(zip(signals, at.tolist(), strict=True)))
    if shipped is not None:
        return shipped, bounds
    nx, ny = sampled.nx, sampled.ny
    with_remainders = sampled.replace(
        Bd=np.hstack([sampled.Bd, np.eye(nx), np.zeros((nx, ny))]),
        Dd=np.hstack([sampled.Dd, np.zeros((ny, nx)), np.eye(ny)]),
        disturbance_names=[*sampled.disturbance_names, *remainder_names(sampled)],
    )
    return with_remainders, bounds


def continuous_model(
    plant: DescriptorSystem, model: Mapping[str, Any], given: Mapping[str, float] | None
) -> DescriptorSystem | None:
    """Return the linear model in continuous time, without algebraic states, that `bounded_model` sampled, for the
    ``model`` as plain data; ``None`` where it has no unknown inputs."""
    unknown = [name for name in plant.disturbance_names if name in model["inputs"]]
    if not unknown:
        return None
    linear = linearise(DAEModel(**model), given=given, faults=list(plant.fault_names), disturbances=unknown)
    smooth = eliminate_algebraic_states(linear).plant
    return smooth if smooth.nx == plant.nx else None


def remainder_names(plant: DescriptorSystem) -> list[str]:
    """Return the names of the remainders of all states and outputs."""
    into = [f"remainder of {name}" for name in plant.state_names]
    return [*into, *(f"remainder in {name}" for name in plant.output_names)]


def require_linear_rates(model: DAEModel) -> None:
    """Raise `PreconditionError` where the coefficient of a derivative is not constant."""
    s = symbols_of(model)
    into, stored = ca.jacobian(s.equations, s.rates), ca.jacobian(s.stored, s.x)
    moved = ca.depends_on(s.stored, ca.vertcat(s.theta, s.u)) if s.stored.numel() else False
    if not (into.is_constant() and stored.is_constant()) or moved:
        raise PreconditionError(
            "A derivative is taken of a nonlinear expression, or multiplied by a signal: its remainder has no bound "
            "here. Write the equations with derivatives of states times constants.",
            condition="remainder",
        )


def _region(
    model: DAEModel, linear: DescriptorSystem, signals: Sequence[str], region: Mapping[str, Sequence[float]]
) -> tuple[FloatArray, FloatArray]:
    """Return middles and half widths of the region, as deviations from the point of the linear model."""
    lacking = [name for name in signals if name not in region]
    unknown = [name for name in region if name not in signals]
    if lacking or unknown:
        problem = f"it lacks {', '.join(lacking)}" if lacking else f"{', '.join(unknown)} is none of them"
        raise SpecError(
            f"region must give [low, high] of each of {', '.join(signals)}, in their units: {problem}.",
            path="method.options.region",
        )
    point = dict(zip(signals, _point(model, linear, signals), strict=True))
    low, high = [], []
    for name in signals:
        ends = region[name]
        good = len(ends) == 2 and all(map(is_finite_number, ends)) and ends[0] <= ends[1]
        if not good or not ends[0] <= point[name] <= ends[1]:
            raise SpecError(
                f"region of {name} is {list(ends)!r}: give two finite numbers, low first, around "
                f"{point[name]:.6g}, where the model is linearised.",
                path="method.options.region",
            )
        low.append(float(ends[0]) - point[name])
        high.append(float(ends[1]) - point[name])
    middles = 0.5 * (np.array(low) + np.array(high))
    widths = np.maximum(np.array(high) - middles, middles - np.array(low))
    return middles, rounded_up(
        widths + 4.0 * UNIT_ROUNDOFF * (np.abs(middles) + np.abs(np.array(list(point.values())))), 4
    )


def _point(model: DAEModel, linear: DescriptorSystem, signals: Sequence[str]) -> list[float]:
    """Return the values of signals at the point of the linear model."""
    at = linear.operating_point
    named = dict(zip(model.state_names, linear.state_names, strict=True))
    return [float(at[named.get(name, name)]) for name in signals]


def _remainders(
    model: DAEModel,
    linear: DescriptorSystem,
    signals: Sequence[str],
    middles: FloatArray,
    halves: FloatArray,
    given: Mapping[str, float],
) -> tuple[FloatArray, FloatArray]:
    """Return bounds on the remainders of the equations ``(nx,)`` and of the outputs ``(ny,)``."""
    count = len(signals)
    translation, zero = affine_translation(count), AffineNumber(0.0, np.zeros(count), 0.0)
    known: dict[str, Any] = {name: zero.lifted(value) for name, value in model.constants.items()}
    known |= {name: zero.lifted(given.get(name, value)) for name, value in model.parameters.items()}
    for i, (name, value) in enumerate(zip(signals, _point(model, linear, signals), strict=True)):
        known[name] = AffineNumber(value + middles[i], halves[i] * np.eye(count)[i], 0.0)
    for name, text in model.definitions.items():
        known[name] = zero.lifted(equation_of(text, f"definitions.{name}").translated(known, translation))
    texts: Any = model.equations
    parsed = [equation_of(text, f"equations.{name}") for name, text in texts.items()]
    still = {key: zero for expression in parsed for key in expression.rates}
    residuals = [zero.lifted(expression.translated({**known, **still}, translation)) for expression in parsed]
    seen_texts: Any = model.outputs
    output_values = [
        zero.lifted(equation_of(text, f"outputs.{name}").translated(known, translation))
        for name, text in seen_texts.items()
    ]
    # E x' = -F(0, x, u, theta), of which the linear model has A, B, Bf and Bd.
    into = np.hstack([linear.A, linear.B, linear.Bf, linear.Bd])
    out = np.hstack([linear.C, linear.D, linear.Df, linear.Dd])
    point = np.array([linear.operating_point.get(name, 0.0) for name in linear.output_names])
    equations = [_missed(-value, row, 0.0, middles, halves) for value, row in zip(residuals, into, strict=True)]
    rates = [COEFFICIENT_ROUNDINGS * UNIT_ROUNDOFF * value.magnitude for value in residuals]
    outputs = [_missed(value, row, y, middles, halves) for value, row, y in zip(output_values, out, point, strict=True)]
    return np.array(equations) + np.array(rates), np.array(outputs)


def _missed(value: AffineNumber, row: FloatArray, offset: float, middles: FloatArray, halves: FloatArray) -> float:
    """Return an upper bound on the distance of a value from ``offset + row (middles + halves q)``."""
    constant, parts = value.center - offset - row @ middles, value.parts - row * halves
    size = abs(value.center) + abs(offset) + np.abs(row) @ (np.abs(middles) + halves) + np.abs(value.parts).sum()
    total = abs(constant) + np.abs(parts).sum() + value.radius + gamma(len(row) + 8) * size
    return float(rounded_up(np.array(total), len(row) + 8))


def _sampled(
    linear: DescriptorSystem,
    shipped: DescriptorSystem,
    step: float,
    left_out: tuple[FloatArray, FloatArray],
    sizes: Mapping[str, float],
) -> dict[str, float]:
    """Return bounds on the remainders of a shipped sampled model, by name; ``sizes``: of all deviations."""
    equations, outputs = left_out
    nx, nu, nf, nd = linear.nx, linear.nu, linear.nf, linear.nd
    written = {**matrices_of(linear)}
    written["Bd"] = np.hstack([linear.Bd, np.eye(nx)])
    written["Dd"] = np.hstack([linear.Dd, np.zeros((linear.ny, nx))])
    reduced = reduced_matrices(written, {name: AffineMatrix.exact(part, 0) for name, part in written.items()}, None)
    inputs = affine_block([[reduced["B"], reduced["Bf"], reduced["Bd"][:, :nd]]])
    a, held = affine_zero_order_hold(reduced["A"], inputs, step)
    states = np.array([sizes[name.removesuffix(" (state)")] for name in shipped.state_names])
    known = np.array([sizes[name] for name in (*linear.input_names, *linear.fault_names, *linear.disturbance_names)])
    own = np.hstack([shipped.B, shipped.Bf, shipped.Bd[:, :nd]])
    inside = _away(a, shipped.A) @ states + _away(held, own) @ known
    inside = inside + _moving(reduced["A"], reduced["Bd"][:, nd:].magnitude @ equations, step)
    through = affine_block([[reduced["D"], reduced["Df"], reduced["Dd"][:, :nd]]])
    direct = np.hstack([shipped.D, shipped.Df, shipped.Dd[:, :nd]])
    output_bounds = _away(reduced["C"], shipped.C) @ states + _away(through, direct) @ known
    output_bounds = output_bounds + reduced["Dd"][:, nd:].magnitude @ equations + outputs
    terms = 4 * (nx + nu + nf + nd + 4)
    bounds = np.concatenate([rounded_up(inside, terms), rounded_up(output_bounds, terms)])
    return dict(zip(remainder_names(shipped), bounds.tolist(), strict=True))


def _away(enclosure: AffineMatrix, shipped: FloatArray) -> FloatArray:
    """Return an entrywise upper bound on the distance of an enclosed matrix from a shipped one."""
    return rounded_up(np.abs(enclosure.center - shipped) + enclosure.radius + UNIT_ROUNDOFF * np.abs(shipped), 4)


def _moving(a: AffineMatrix, sizes: FloatArray, step: float) -> FloatArray:
    """Return a bound on the states after a sample for disturbances of these sizes and any course within it."""
    piece = step / PARTS_OF_SAMPLE
    # Within a piece e^(A s) differs from its value at the start by at most e^(|A| s) - 1 times that value.
    spread = affine_exponential(AffineMatrix.exact(a.magnitude * (piece * (1.0 + 4.0 * UNIT_ROUNDOFF)), 0)).magnitude
    over = affine_exponential(a.scaled(piece))
    here, total = AffineMatrix.exact(np.eye(len(sizes)), 0), np.zeros(len(sizes))
    for _ in range(PARTS_OF_SAMPLE):
        total = total + here.magnitude @ (spread @ sizes)
        here = here @ over
    return rounded_up(total * piece, PARTS_OF_SAMPLE * (2 * len(sizes) + 4) + 8)
