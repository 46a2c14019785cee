"""Plants made from plants, each with the way back to the original states.

Eliminating algebraic states, sampling, and treating sensor faults as states.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, TypeVar

import numpy as np

from obsynth.analysis.zeros import fault_zeros, leading_names
from obsynth.errors import PreconditionError, SpecError
from obsynth.models.descriptor import DescriptorSystem
from obsynth.models.names import index_of
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.numerics.pencils import pencil_structure
from obsynth.numerics.ranks import CANCELLATION_TOLERANCE, NEGLIGIBLE_INPUT, SLOW_ZERO_RADIUS, decide_rank
from obsynth.numerics.scaling import equilibrate_pencil, power_of_two_below

_Value = TypeVar("_Value")


@dataclass(frozen=True, eq=False)
class StateRecovery:
    """The states of a source plant from the signals of a transformed one.

    ``x_source = from_state x + from_input u + from_fault f + from_disturbance d + from_noise w``

    Parameters
    ----------
    names : tuple of str
        Names of the source states.
    from_state, from_input, from_fault, from_disturbance, from_noise : FloatArray
        ``(nx_source, nx)``, ``(nx_source, nu)`` and so on, read-only.
    noise_kept : FloatArray
        ``(nw_source, nw)``: the noise of the source as far as the transformed plant still has it.
    """

    names: tuple[str, ...]
    from_state: FloatArray
    from_input: FloatArray
    from_fault: FloatArray
    from_disturbance: FloatArray
    from_noise: FloatArray
    noise_kept: FloatArray

    def __post_init__(self) -> None:
        """Make the arrays private and read-only."""
        for field in fields(self)[1:]:
            object.__setattr__(self, field.name, read_only(getattr(self, field.name)))

    def flags(self) -> tuple[str, ...]:
        """Return per source state what an estimate from state and input alone is.

        ``exact``, ``needs the fault estimate`` or ``biased by the disturbance`` (which wins).
        """
        return tuple(
            "biased by the disturbance" if biased.any() else "needs the fault estimate" if faulty.any() else "exact"
            for biased, faulty in zip(self.from_disturbance, self.from_fault, strict=True)
        )

    def then(self, later: StateRecovery) -> StateRecovery:
        """Return the recovery through two transformations, this one first."""
        step = self.from_state
        return StateRecovery(
            names=self.names,
            from_state=step @ later.from_state,
            from_input=step @ later.from_input + self.from_input,
            from_fault=step @ later.from_fault + self.from_fault,
            from_disturbance=step @ later.from_disturbance + self.from_disturbance,
            from_noise=step @ later.from_noise + self.from_noise @ later.noise_kept,
            noise_kept=self.noise_kept @ later.noise_kept,
        )


@dataclass(frozen=True, eq=False)
class Transformation:
    """A plant made from another one.

    Parameters
    ----------
    source, plant : DescriptorSystem
        The plant before and after.
    description : str
        What was done, in words.
    recovery : StateRecovery
        The states of ``source`` from the signals of ``plant``.
    """

    source: DescriptorSystem
    plant: DescriptorSystem
    description: str
    recovery: StateRecovery

    def then(self, later: Transformation) -> Transformation:
        """Return both steps as one, for a ``later`` that starts from this one's plant."""
        description = "; ".join(text for text in (self.description, later.description) if text)
        return Transformation(self.source, later.plant, description, self.recovery.then(later.recovery))


def eliminate_algebraic_states(plant: DescriptorSystem) -> Transformation:
    """Solve the algebraic equations of an index-1 plant, so that ``E = I``.

    Parameters
    ----------
    plant : DescriptorSystem
        Regular, index 0 or 1, either time.

    Returns
    -------
    Transformation
        Signals in algebraic equations end up in ``D, Df, Dd, Dw``.  Dynamic states keep their names when
        the null space of ``E`` is spanned by whole states; otherwise the new states ``xi 1, xi 2, ...``
        are orthogonal combinations (after scaling by powers of two).

    Raises
    ------
    PreconditionError
        Not regular, index 2 or more, or no dynamic state at all.

    Notes
    -----
    Results so small beside the terms they come from that they are only rounding are set to zero: the
    flags of the recovery depend on what is exactly zero.
    """
    if np.array_equal(plant.E, np.eye(plant.nx)):
        return Transformation(plant, plant, "", _recovery(plant, plant, from_state=np.eye(plant.nx)))
    count = _dynamic_count(plant)
    rows, dynamic, algebraic, names = _coordinates(plant, count)
    sizes = (count, plant.nu, plant.nf, plant.nd, plant.nw)
    signals = np.hstack([plant.B, plant.Bf, plant.Bd, plant.Bw])
    right_sides = rows @ np.hstack([plant.A @ dynamic, signals])
    coupling = rows @ plant.A @ algebraic
    # algebraic coordinates = solution @ [state; u; f; d; w]
    solution = _solved(-coupling[count:], right_sides[count:])
    reduced = _solved(rows[:count] @ plant.E @ dynamic, _sum(right_sides[:count], coupling[:count], solution))
    direct = np.hstack([plant.C @ dynamic, plant.D, plant.Df, plant.Dd, plant.Dw])
    A, B, Bf, Bd, Bw = _columns(reduced, sizes)
    C, D, Df, Dd, Dw = _columns(_sum(direct, plant.C @ algebraic, solution), sizes)
    padded = np.hstack([dynamic, np.zeros((plant.nx, signals.shape[1]))])
    from_state, from_input, from_fault, from_disturbance, from_noise = _columns(
        _sum(padded, algebraic, solution), sizes
    )
    new = _with_states(plant, names, E=None, A=A, B=B, Bf=Bf, Bd=Bd, Bw=Bw, C=C, D=D, Df=Df, Dd=Dd, Dw=Dw)
    recovery = StateRecovery(
        plant.state_names, from_state, from_input, from_fault, from_disturbance, from_noise, np.eye(plant.nw)
    )
    done = f"eliminated {plant.nx - count} algebraic states" if count < plant.nx else "multiplied by the inverse of E"
    return Transformation(plant, new, done, recovery)


def discretise(plant: DescriptorSystem, sample_time: float) -> Transformation:
    """Sample a continuous plant with a zero-order hold.

    Exact for inputs, faults and disturbances that are constant between samples.  Algebraic states are
    eliminated first.

    Parameters
    ----------
    plant : DescriptorSystem
        Continuous, regular, index 0 or 1.
    sample_time : float, seconds
        Time between samples.

    Returns
    -------
    Transformation
        Process noise (``Bw``, per square root of a second) is integrated over a sample and becomes
        ``process noise 1, 2, ...``, a factor of its covariance; ``Dw`` is per sample and stays.

    Raises
    ------
    SpecError
        ``plant.dt > 0``, or ``sample_time`` is not a positive number.
    PreconditionError
        As for `eliminate_algebraic_states`; or continuous white noise reaches an output directly.

    References
    ----------
    .. [VanLoan1978] C. Van Loan, "Computing integrals involving the matrix exponential", IEEE TAC 23, 1978.
    """
    if plant.dt > 0.0:
        raise SpecError(f"The plant is already sampled (dt = {plant.dt:g} s): give a continuous plant.", path="dt")
    if not (math.isfinite(sample_time) and sample_time > 0.0):
        raise SpecError(f"sample_time is {sample_time}: give a positive number of seconds.", path="sample_time")
    first = eliminate_algebraic_states(plant)
    smooth = first.plant
    direct = np.flatnonzero(np.any(smooth.Dw, axis=0))
    process = np.flatnonzero(np.any(plant.Bw, axis=0) | np.any(smooth.Bw, axis=0))
    signals = tuple(smooth.noise_names[i] for i in np.intersect1d(direct, process))
    if signals:
        raise PreconditionError(
            f"Process noise {', '.join(signals)} reaches an output directly, where continuous white noise has "
            "infinite variance: give measurement noise in Dw only, or filter the process noise by a state.",
            condition="noise without a direct path",
            signals=signals,
        )
    transition, held = _zero_order_hold(smooth.A, np.hstack([smooth.B, smooth.Bf, smooth.Bd]), sample_time)
    B, Bf, Bd = _columns(held, (smooth.nu, smooth.nf, smooth.nd))
    factor = _noise_factor(smooth.A, smooth.Bw, sample_time)
    kept = [smooth.noise_names[i] for i in direct]
    noise_names = [*(f"process noise {i + 1}" for i in range(factor.shape[1])), *kept]
    sampled = smooth.replace(
        A=transition, B=B, Bf=Bf, Bd=Bd, dt=float(sample_time), noise_names=noise_names,
        Bw=np.hstack([factor, np.zeros((smooth.nx, len(kept)))]),
        Dw=np.hstack([np.zeros((smooth.ny, factor.shape[1])), smooth.Dw[:, direct]]),
    )  # fmt: skip
    noise_kept = np.hstack([np.zeros((smooth.nw, factor.shape[1])), np.eye(smooth.nw)[:, direct]])
    recovery = _recovery(smooth, sampled, from_state=np.eye(smooth.nx), noise_kept=noise_kept)
    description = f"sampled every {sample_time:g} s (zero-order hold)"
    return first.then(Transformation(smooth, sampled, description, recovery))


def augment_faults(plant: DescriptorSystem, faults: Sequence[str]) -> Transformation:
    """Append the chosen faults that act on the outputs as algebraic states ``phi = f``.

    Parameters
    ----------
    plant : DescriptorSystem
        ``Df (ny, nf)``, either time.
    faults : sequence of str
        Names; those whose column of ``Df`` is zero need no state and are left alone.

    Returns
    -------
    Transformation
        With states ``fault:<name>`` appended and the columns of these faults in ``Df`` zero.

    Raises
    ------
    SpecError
        An unknown fault.
    PreconditionError
        ``rank [E 0; 0 0; C Df] < nx + n``: a combination of sensor faults looks like a state.
    """
    columns = [index_of(name, plant.fault_names, what="The plant") for name in faults]
    chosen = sorted({column for column in columns if plant.Df[:, column].any()})
    nx, count = plant.nx, len(chosen)
    chosen_names = [plant.fault_names[column] for column in chosen]
    names = [f"fault:{name}" for name in chosen_names]
    output = np.hstack([plant.C, plant.Df[:, chosen]])
    E, A = np.zeros((nx + count, nx + count)), -np.eye(nx + count)
    E[:nx, :nx], A[:nx, :nx] = plant.E, plant.A
    _require_visible(np.vstack([E, output]), plant, chosen_names)
    remaining = plant.Df.copy()
    remaining[:, chosen] = 0.0
    below = {name: np.zeros((count, getattr(plant, name).shape[1])) for name in ("B", "Bd", "Bw")}
    below["Bf"] = np.eye(plant.nf)[chosen]
    inputs = {name: np.vstack([getattr(plant, name), rows]) for name, rows in below.items()}
    new = _with_states(plant, (*plant.state_names, *names), E=E, A=A, C=output, Df=remaining, **inputs)
    description = f"appended {', '.join(names)} as states" if names else ""
    return Transformation(plant, new, description, _recovery(plant, new, from_state=np.eye(nx, nx + count)))


def sampling_zero_warnings(plant: DescriptorSystem) -> tuple[str, ...]:
    """Return a text for every fault zero strictly inside, but near, the unit circle of a sampled plant.

    The fault estimate rings for ``dt / -ln abs(z)`` seconds there.

    Parameters
    ----------
    plant : DescriptorSystem
        ``dt > 0``; a continuous plant gets no warnings.
    """
    if not plant.is_discrete:
        return ()
    found = fault_zeros(plant)
    inside = [zero.value for zero in found.zeros if not any(zero is other for other in found.outside)]
    texts = [
        f"Fault zero at {_number(value)} (modulus {abs(value):.6g}): errors of a fault estimate die out there with a "
        f"time constant of {-plant.dt / math.log(abs(value)):.3g} s. Sample more slowly, or measure a signal nearer to "
        "the fault."
        for value in inside
        if value.imag >= 0.0 and SLOW_ZERO_RADIUS < abs(value) < 1.0
    ]
    return tuple(dict.fromkeys(texts))


def _recovery(
    source: DescriptorSystem, new: DescriptorSystem, *, from_state: FloatArray, noise_kept: FloatArray | None = None
) -> StateRecovery:
    return StateRecovery(
        source.state_names,
        from_state,
        from_input=np.zeros((source.nx, new.nu)),
        from_fault=np.zeros((source.nx, new.nf)),
        from_disturbance=np.zeros((source.nx, new.nd)),
        from_noise=np.zeros((source.nx, new.nw)),
        noise_kept=np.eye(source.nw) if noise_kept is None else noise_kept,
    )


def _dynamic_count(plant: DescriptorSystem) -> int:
    pencil = pencil_structure(plant.E, plant.A)
    if pencil.index is None:
        raise PreconditionError(
            "The plant is not regular: det(A - zE) is zero for every z, so its equations do not determine the "
            "states. Check for a missing or repeated equation.",
            condition="regularity",
        )
    if pencil.index > 1:
        raise PreconditionError(
            f"The plant has index {pencil.index}: its algebraic equations cannot be solved for the algebraic states "
            "without differentiating. Differentiate the constraints, or use a method that takes the descriptor form.",
            condition="index",
        )
    count = plant.nx - len(pencil.infinite_block_sizes)
    if count == 0:
        raise PreconditionError(
            "Every state is algebraic: nothing is left after elimination. Solve the equations directly.",
            condition="dynamic states",
        )
    return count


def _coordinates(plant: DescriptorSystem, count: int) -> tuple[FloatArray, FloatArray, FloatArray, tuple[str, ...]]:
    """Return row transformation, bases of dynamic and algebraic states, names of the dynamic ones."""
    pencil = equilibrate_pencil(plant.E, plant.A)
    left, _, right = np.linalg.svd(pencil.E)
    moving_rows, moving = plant.E.any(axis=1), plant.E.any(axis=0)
    rows = left.T
    if np.sum(moving_rows) == count:
        rows = np.eye(plant.nx)[np.argsort(~moving_rows, kind="stable")]
    rows = rows * pencil.rows
    if np.sum(moving) == count:
        order = np.argsort(~moving, kind="stable")
        basis, names = np.eye(plant.nx)[:, order], tuple(plant.state_names[i] for i in order[:count])
    else:
        basis, names = pencil.columns[:, None] * right.T, tuple(f"xi {i + 1}" for i in range(count))
    return rows, basis[:, :count], basis[:, count:], names


def _solved(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Return ``matrix^-1 right`` with entries that are only rounding set to zero."""
    scale = 1.0 / power_of_two_below(np.max(np.abs(matrix), axis=1, initial=0.0))[:, None]
    scaled = scale * matrix
    solution: FloatArray = np.asarray(np.linalg.solve(scaled, scale * right), dtype=np.float64)
    inverse = np.abs(np.linalg.inv(scaled))
    return _cleaned(solution, inverse @ (np.abs(scaled) @ np.abs(solution)))


def _sum(direct: FloatArray, factor: FloatArray, solution: FloatArray) -> FloatArray:
    """Return ``direct + factor solution`` with entries that are only rounding set to zero."""
    return _cleaned(direct + factor @ solution, np.abs(direct) + np.abs(factor) @ np.abs(solution))


def _cleaned(result: FloatArray, size_of_terms: FloatArray) -> FloatArray:
    return np.where(np.abs(result) > CANCELLATION_TOLERANCE * size_of_terms, result, 0.0)


def _columns(matrix: FloatArray, sizes: Sequence[int]) -> list[FloatArray]:
    return np.split(matrix, np.cumsum(sizes)[:-1], axis=1)


def _with_states(plant: DescriptorSystem, names: Sequence[str], **changes: Any) -> DescriptorSystem:
    """Replace matrices and states, dropping operating points and units of states that are gone."""
    gone = set(plant.state_names) - set(names)

    def surviving(table: Mapping[str, _Value]) -> dict[str, _Value]:
        return {name: value for name, value in table.items() if name not in gone}

    point, units = surviving(plant.operating_point), surviving(plant.units)
    return plant.replace(state_names=names, operating_point=point, units=units, **changes)


def _zero_order_hold(A: FloatArray, inputs: FloatArray, step: float) -> tuple[FloatArray, FloatArray]:
    """Return ``exp(A h)`` and its integral times ``inputs``, from one balanced block exponential."""
    from scipy.linalg import expm, matrix_balance

    nx, width = inputs.shape
    balanced, (scale, _) = matrix_balance(A, permute=False, separate=True)
    scaled = inputs / scale[:, None]
    # Large inputs would make the exponential square more often than its dynamics need.
    sizes = power_of_two_below(np.max(np.abs(scaled), axis=0, initial=0.0))
    block = np.zeros((nx + width, nx + width))
    block[:nx, :nx], block[:nx, nx:] = balanced, scaled / sizes
    result = expm(block * step)
    return scale[:, None] * result[:nx, :nx] / scale, scale[:, None] * result[:nx, nx:] * sizes


def _noise_factor(A: FloatArray, noise: FloatArray, step: float) -> FloatArray:
    """Return a factor of the covariance that unit white noise through ``noise`` gathers in ``step``."""
    from scipy.linalg import expm, matrix_balance

    nx = A.shape[0]
    if not noise.any():
        return np.zeros((nx, 0))
    balanced, (scale, _) = matrix_balance(A, permute=False, separate=True)
    scaled = noise / scale[:, None]
    # Van Loan's block grows like exp(-A h): integrate a short step, then double it.
    doublings = math.ceil(math.log2(max(float(np.linalg.norm(balanced, 1)) * step, 1.0)))
    block = np.block([[-balanced, scaled @ scaled.T], [np.zeros((nx, nx)), balanced.T]])
    result = expm(block * (step / 2.0**doublings))
    transition = result[nx:, nx:].T
    covariance = transition @ result[:nx, nx:]
    for _ in range(doublings):
        covariance = covariance + transition @ covariance @ transition.T
        transition = transition @ transition
    # An integrated state gathers far less noise than its derivative: compare like with like.
    spread = power_of_two_below(np.sqrt(np.abs(np.diag(covariance))))
    correlation = covariance / spread / spread[:, None]
    sizes, directions = np.linalg.eigh((correlation + correlation.T) / 2.0)
    kept = sizes > CANCELLATION_TOLERANCE * sizes[-1]
    return np.asarray((scale * spread)[:, None] * directions[:, kept] * np.sqrt(sizes[kept]))


def _require_visible(stacked: FloatArray, plant: DescriptorSystem, faults: Sequence[str]) -> None:
    decision = decide_rank(stacked, expected=stacked.shape[1])
    if decision.full or not faults:
        return
    scaled = equilibrate_pencil(np.zeros_like(stacked), stacked).A
    shares = np.linalg.norm(np.linalg.svd(scaled)[2][decision.rank :], axis=0)
    if np.max(shares[plant.nx :]) > NEGLIGIBLE_INPUT:
        signals = leading_names(shares[plant.nx :], faults)
        culprit = f"Faults {', '.join(signals)} look like algebraic states, or like each other, in the outputs."
    else:
        signals = leading_names(shares[: plant.nx], plant.state_names)
        culprit = f"States {', '.join(signals)} show neither in E nor in the outputs."
    raise PreconditionError(
        f"Faults cannot be appended as states: {decision.describe()}. {culprit} Leave faults out, or add an output.",
        condition="rank [E 0; 0 0; C Df]",
        signals=signals,
    )


def _number(value: complex) -> str:
    return f"{value.real:.6g}" if value.imag == 0.0 else f"{value.real:.6g} +- {abs(value.imag):.6g}j"
