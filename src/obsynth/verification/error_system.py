r"""The error system of a shipped observer, from the plant and the realisation alone, with rounding of stored numbers.

If ``Az V E + By C = V A`` and ``Bu + By D = V B``, then ``e = V E x - z`` obeys ``e+ = Az e + (V b - By d) s`` for
every fault, disturbance or noise s with the input matrices b of the plant and d of the outputs.  An output with ``Cz V
E + Dy C = K`` and ``Du + Dy D = 0`` is ``K x - Cz e + Dy d s``.  If estimates lag, past states are appended to x.
Stored numbers satisfy these identities up to rounding: for any T, and T0 with ``T0 E = 0``, ``eps = z - T E x`` obeys

.. math::
    \varepsilon^+ = A_z \varepsilon + K x + U u + \ldots, \qquad
    \text{estimate} - G x = C_z \varepsilon + J x + L u + \ldots

    K = A_z T E + B_y C - T A, \quad U = B_u + B_y D - T B, \quad
    J = C_z T E + D_y C + T_0 A - G, \quad L = D_u + D_y D + T_0 B

where K, U, J, L, which are zero in exact arithmetic, are enclosed in balls; `errors_per_unit` bounds their effects.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Generic, TypeAlias

import flint
import numpy as np

from obsynth.numerics.arrays import FloatArray, Made, remembered
from obsynth.numerics.logarithmic_balance import balance_by_least_squares
from obsynth.numerics.scaling import Scaling
from obsynth.observers.linear.modes import poles_of
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.balls import Ball, rounded_up
from obsynth.proofs.contraction import Contraction, prove_contraction
from obsynth.proofs.extended_balls import ExtendedBall
from obsynth.proofs.peak_sums import absolute_gains
from obsynth.proofs.products import as_ball
from obsynth.results.checks import Check, upper_bound_check

#: With more states of plant or observer the identities are evaluated in balls of double precision.
MOST_EXACT_IDENTITIES = 300

#: Precision in bits in which sums of products of three stored numbers are nearly exact.
EXACT_BITS = 320

#: Largest residual of the identities of an error model, relative to their terms.
IDENTITY_SHARE = 1e-7

#: The same for gains that were printed to some decimals; their effect is judged by the rows of the method.
PRINTED_SHARE = 0.1

#: Rows whose terms are below this share of the largest ones may be rounding of these; they count as rows of that size.
LEAST_ROW = 1e-6

Output: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


@remembered
def natural_scaling(plant: DescriptorSystem) -> Scaling:
    """Return the scaling of a plant's equations, states and outputs that balances E, A and C."""
    return balance_by_least_squares(plant.E, plant.A, outputs=[plant.C])


def with_past(plant: DescriptorSystem, lag: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return E, A, B, C of a plant with the last ``lag`` states appended: ``[x(k); x(k-1); ...; x(k-lag)]``."""
    if lag == 0:
        return plant.E, plant.A, plant.B, plant.C
    nx, total = plant.nx, plant.nx * (lag + 1)
    e, a = np.eye(total), np.zeros((total, total))
    e[:nx, :nx], a[:nx, :nx] = plant.E, plant.A
    a[nx:, :-nx] = np.eye(total - nx)
    b = np.vstack([plant.B, np.zeros((total - nx, plant.nu))])
    return e, a, b, np.hstack([plant.C, np.zeros((plant.ny, total - nx))])


@dataclass(frozen=True, eq=False)
class ErrorModel:
    """The signals that a linear observer estimates, and its error system, for monitors, tolerances and stored numbers.

    Its state z estimates ``T E xa``, where xa is the plant's state, followed by its last ``lag`` states, or by the
    states of a fault model ``w+ = Phi w`` (w' for dt = 0), ``f = Cw w``.  Without noise, disturbances and faults that
    do not obey the model, and after convergence, its outputs are ``goal xa``: the oldest state, ``Cw w``, and zero for
    residuals.

    Parameters
    ----------
    plant, observer : DescriptorSystem, LinearObserver
        Plant and observer, with the names of their signals.
    T : FloatArray
        ``(nz, na)``.
    T0 : FloatArray, optional
        ``(rows, na)`` with ``T0 E = 0``: multiples of the plant's algebraic equations that are added to the outputs;
        none by default.
    lag : int, optional
        Samples by which the state estimates lag.
    Phi, Cw : FloatArray, optional
        The fault model ``(nw, nw)``, ``(nf, nw)`` of the observer; none by default.
    model_names : tuple of str, optional
        Names of the fault model's states.
    decoupled : bool, optional
        Whether no disturbance affects z or the outputs.
    later : int, optional
        Samples by which the outputs of ``observer`` are later than those of the shipped one.  For a plant of index 2 or
        more, whose outputs depend on inputs of later samples, only delayed outputs have an error system.
    """

    plant: DescriptorSystem
    observer: LinearObserver
    T: FloatArray
    T0: FloatArray | None = None
    lag: int = 0
    Phi: FloatArray | None = None
    Cw: FloatArray | None = None
    model_names: tuple[str, ...] = ()
    decoupled: bool = False
    later: int = 0

    def __post_init__(self) -> None:
        if not self.observer.order:
            # An observer without states has no rows of T.
            object.__setattr__(self, "T", np.zeros((0, self.plant.nx * (self.lag + 1) + self._model_states)))

    @property
    def _model_states(self) -> int:
        return 0 if self.Phi is None else len(self.Phi)

    @cached_property
    def _equations(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        e, a, b, c = with_past(self.plant, self.lag)
        if self.Phi is None or self.Cw is None:
            return e, a, b, c
        nx, count = len(a), len(self.Phi)
        e_augmented, a_augmented = np.eye(nx + count), np.zeros((nx + count, nx + count))
        e_augmented[:nx, :nx], a_augmented[:nx, :nx] = e, a
        a_augmented[: self.plant.nx, nx:], a_augmented[nx:, nx:] = self.plant.Bf @ self.Cw, self.Phi
        c = np.hstack([c, self.plant.Df @ self.Cw])
        return e_augmented, a_augmented, np.vstack([b, np.zeros((count, self.plant.nu))]), c

    @property
    def E(self) -> FloatArray:
        """``(na, na)``."""
        return self._equations[0]

    @property
    def A(self) -> FloatArray:
        """``(na, na)``."""
        return self._equations[1]

    @property
    def B(self) -> FloatArray:
        """``(na, nu)``."""
        return self._equations[2]

    @property
    def C(self) -> FloatArray:
        """``(ny, na)``."""
        return self._equations[3]

    @cached_property
    def Bd(self) -> FloatArray:
        """``(na, nd)`` of the disturbances, if they are decoupled."""
        if not self.decoupled:
            return np.zeros((len(self.E), 0))
        return np.vstack([self.plant.Bd, np.zeros((len(self.E) - self.plant.nx, self.plant.nd))])

    @property
    def Dd(self) -> FloatArray:
        """``(ny, nd)`` of the disturbances, if they are decoupled."""
        return self.plant.Dd if self.decoupled else np.zeros((self.plant.ny, 0))

    @cached_property
    def goal(self) -> FloatArray:
        """``(rows, na)``: the combination of xa that each output of the observer estimates."""
        observer, states = self.observer, self.plant.state_names
        goal = np.zeros((len(observer.Cz), len(self.E)))
        for row, name in enumerate(observer.state_names):
            goal[observer.state_rows.start + row, self.plant.nx * self.lag + states.index(name)] = 1.0
        if self.Cw is not None:
            named = [self.plant.fault_names.index(name) for name in observer.fault_names]
            goal[observer.fault_rows, self.plant.nx * (self.lag + 1) :] = self.Cw[named]
        return goal

    @cached_property
    def state_names(self) -> tuple[str, ...]:
        """Names of xa."""
        ages, own = range(self.lag + 1), self.plant.state_names
        past = (f"{name}(k-{age})" if age else name for age in ages for name in own)
        return (*past, *(self.model_names or (f"w{i + 1}" for i in range(self._model_states))))

    @property
    def fits(self) -> bool:
        """Whether all shapes and names agree with plant and observer."""
        plant, observer, count = self.plant, self.observer, self._model_states
        shapes = [(self.T, (observer.order, plant.nx * (self.lag + 1) + count))]
        shapes += [] if self.T0 is None else [(self.T0, (len(observer.Cz), shapes[0][1][1]))]
        if self.Phi is not None and self.Cw is not None:
            shapes += [(self.Phi, (count, count)), (self.Cw, (plant.nf, count))]
        return bool(
            self.lag >= 0
            and (self.Phi is None) == (self.Cw is None)
            and all(np.shape(matrix) == wanted for matrix, wanted in shapes)
            and set(observer.state_names) <= set(plant.state_names)
            and set(observer.fault_names) <= set(plant.fault_names)
            and not any(delay != self.lag for delay in observer.state_delays)
        )

    @property
    def numbers(self) -> tuple[FloatArray | None, ...]:
        """All numbers except the observer's."""
        return (self.E, self.A, self.B, self.C, self.T, self.T0, self.goal, self.Bd, self.Dd, self.plant.D)

    # The error e = T E x - z of the plant's own states, and its inputs.

    @property
    def own(self) -> FloatArray:
        """The part of T ``(nz, nx)`` that belongs to the newest state."""
        return self.T[:, : self.plant.nx]

    @property
    def Az(self) -> FloatArray:
        """The observer's ``Az (nz, nz)``: e obeys ``e+ = Az e + fault f + disturbance d + noise w``."""
        return self.observer.Az

    @cached_property
    def fault(self) -> FloatArray:
        """``(nz, nf)``: from faults of any profile to e."""
        return self.driven_by(self.plant.Bf, self.plant.Df)

    @cached_property
    def disturbance(self) -> FloatArray:
        """``(nz, nd)``: from disturbances to e."""
        return self.driven_by(self.plant.Bd, self.plant.Dd)

    @cached_property
    def noise(self) -> FloatArray:
        """``(nz, nw)``: from noise to e."""
        return self.driven_by(self.plant.Bw, self.plant.Dw)

    def driven_by(self, b: FloatArray, d: FloatArray) -> FloatArray:
        """Return ``T b - By d (nz, any)``: from a signal with matrices b of the plant and d of its outputs to e."""
        return np.asarray(self.own @ b - self.observer.By @ d)

    def driven_at_most(self, b: FloatArray) -> FloatArray:
        """Return bounds ``(nz, any)`` of the entries of ``T b`` without cancellation, for inputs ``b (nx, any)``.

        The rounding errors of a row of T are relative to its largest entry, so that its entry for an equation in which
        a signal enters may be rounding alone.
        """
        if not self.observer.order:
            return np.zeros((0, b.shape[1]))
        equations = natural_scaling(self.plant).equations
        rows = np.max(np.abs(self.own) / equations, axis=1, initial=0.0, keepdims=True)
        return np.asarray(rows * np.max(equations[:, None] * np.abs(b), axis=0, initial=0.0))

    def output(self, rows: slice) -> Output:
        """Return ``C, Df, Dd, Dw`` of some outputs ``-C e + Df f + Dd d + Dw w``; for estimates this is their error."""
        plant, direct = self.plant, self.observer.Dy[rows]
        added = np.zeros((len(direct), plant.nx)) if self.T0 is None else self.T0[rows, : plant.nx]
        signals = ((plant.Bf, plant.Df), (plant.Bd, plant.Dd), (plant.Bw, plant.Dw))
        fault, disturbance, noise = (direct @ d + added @ b for b, d in signals)
        return self.observer.Cz[rows], fault, disturbance, noise

    @cached_property
    def fault_output(self) -> Output:
        """See `output`."""
        return self.output(self.observer.fault_rows)

    @cached_property
    def residual_output(self) -> Output:
        """See `output`."""
        return self.output(self.observer.residual_rows)

    @cached_property
    def state_output(self) -> Output:
        """See `output`."""
        return self.output(self.observer.state_rows)

    # The residuals of the identities, by rounding of stored numbers.

    @cached_property
    def remainder(self) -> RemainderChannel:
        """The residuals of the identities, in outward rounding."""
        return _remainders_of(self.observer).of(self.numbers, self._new_remainder)

    def _new_remainder(self) -> RemainderChannel:
        if not self.is_evaluated_exactly:
            return self._remainder(Ball)
        with flint.ctx.workprec(EXACT_BITS):
            return self._remainder(ExtendedBall)

    @property
    def is_evaluated_exactly(self) -> bool:
        """Whether the residuals of the identities are the same on every machine, up to one final rounding."""
        return bool(max(self.observer.order, len(self.E), self.plant.ny) <= MOST_EXACT_IDENTITIES)

    def _remainder(self, kind: type[Ball] | type[ExtendedBall]) -> RemainderChannel:
        exact: Callable[[FloatArray], Any] = kind.exact
        observer = self.observer
        az, bu, by, cz, du, dy = (exact(getattr(observer, name)) for name in ("Az", "Bu", "By", "Cz", "Du", "Dy"))
        e, a, b, c, d, t = (exact(part) for part in (self.E, self.A, self.B, self.C, self.plant.D, self.T))
        te, dd, driven = t @ e, exact(self.Dd), None
        j, el, v = cz @ te + dy @ c - exact(self.goal), du + dy @ d, dy @ dd
        if self.T0 is not None and self.T0.any():
            t0 = exact(self.T0)
            j, el, v = j + t0 @ a, el + t0 @ b, v + t0 @ exact(self.Bd)
            driven = t0 @ e
        missed = (az @ te + by @ c - t @ a, bu + by @ d - t @ b, j, el, by @ dd - t @ exact(self.Bd), v)
        remainder = RemainderChannel(*(_as_ball(part) for part in missed))
        if driven is None:
            return remainder
        # A nonzero T0 E multiplies the next state, which has the bounds of x, or in continuous time its derivative,
        # which has none.
        ball = _as_ball(driven)
        leakage = np.where(_is_nonzero(ball), ball.magnitude, 0.0)
        added = leakage if observer.dt > 0.0 else np.where(leakage > 0.0, np.inf, 0.0)
        return (
            replace(remainder, J=Ball(remainder.J.midpoint, remainder.J.radius + added)) if leakage.any() else remainder
        )

    @cached_property
    def _sizes(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Natural units of xa ``(na,)``, and the largest terms of each row of z and of the outputs in these units."""
        size, observer = np.abs, self.observer
        if self.lag or self.Phi is not None:
            units = balance_by_least_squares(self.E, self.A, outputs=[self.C]).states
        else:
            units = natural_scaling(self.plant).states
        te, c = size(self.T) @ size(self.E), size(self.C)
        formed = size(observer.Az) @ te + size(observer.By) @ c + size(self.T) @ size(self.A)
        estimates = size(observer.Cz) @ te + size(observer.Dy) @ c + size(self.goal)
        if self.T0 is not None:
            estimates = estimates + size(self.T0) @ size(self.A)
        state_sizes, output_sizes = (
            np.max(terms * units, axis=1, initial=0.0, keepdims=True) for terms in (formed, estimates)
        )
        return units, np.where(state_sizes > 0.0, state_sizes, 1.0), np.where(output_sizes > 0.0, output_sizes, 1.0)

    def rounding(self) -> float:
        """Return the largest entries of K and J relative to the terms of their rows, in natural units of the states."""
        units, state_sizes, output_sizes = self._sizes
        pairs = ((self.remainder.K.midpoint, state_sizes), (self.remainder.J.midpoint, output_sizes))
        return max(float(np.max(np.abs(missed) * units / rows, initial=0.0)) for missed, rows in pairs)

    def missed(self) -> float:
        """Return the largest residual of the identities relative to their terms, for states, inputs, disturbances and
        ``T0 E``."""
        size, observer, channel = np.abs, self.observer, self.remainder
        t, t0 = size(self.T), np.zeros_like(self.goal) if self.T0 is None else size(self.T0)
        by, dy, dd, d = size(observer.By), size(observer.Dy), size(self.Dd), size(self.plant.D)
        units, *sizes = self._sizes
        rows = [np.maximum(terms, LEAST_ROW * np.max(terms, initial=0.0)) for terms in sizes]
        inputs = size(observer.Bu) + by @ d + t @ size(self.B), size(observer.Du) + dy @ d + t0 @ size(self.B)
        disturbances = by @ dd + t @ size(self.Bd), dy @ dd + t0 @ size(self.Bd)
        shares = [
            float(np.max(size(balls.midpoint) * units / terms, initial=0.0))
            for balls, terms in zip((channel.K, channel.J), rows, strict=True)
        ]
        for balls, terms, b in (
            ((channel.U, channel.L), inputs, self.B),
            ((channel.W, channel.V), disturbances, self.Bd),
        ):
            # Each signal is scaled by its largest effect on a row, relative to the terms of that row.
            missed, moved = (
                np.vstack([part / row for part, row in zip(parts, rows, strict=True)])
                for parts in ([size(part.midpoint) for part in balls], terms)
            )
            possible = self.driven_at_most(b[: self.plant.nx]) / rows[0]
            scale = np.max(np.vstack([moved, LEAST_ROW * possible]), axis=0, initial=0.0)
            shares.append(float(np.max(missed / np.where(scale > 0.0, scale, 1.0), initial=0.0)))
        if self.T0 is not None:
            largest = np.max(t0 @ size(self.E) * units, axis=1, initial=0.0, keepdims=True)
            left_over = size(self.T0 @ self.E) * units / np.where(largest > 0.0, largest, 1.0)
            shares.append(float(np.max(left_over, initial=0.0)))
        return max(shares) if np.all(np.isfinite(shares)) else np.nan


@dataclass(frozen=True, eq=False)
class ByNumbers(Generic[Made]):
    """Results for an observer by the numbers of its error model, which a design and its verification share.

    A result must not refer to the observer, since it is stored with it.
    """

    known: list[tuple[tuple[FloatArray | None, ...], Made]] = field(default_factory=list)

    def of(self, numbers: tuple[FloatArray | None, ...], make: Callable[[], Made]) -> Made:
        """Return the result for the same numbers, or compute it."""
        for others, value in self.known:
            if all(map(_same, numbers, others)):
                return value
        self.known.append((numbers, make()))
        return self.known[-1][1]


def _same(one: FloatArray | None, other: FloatArray | None) -> bool:
    return one is other or (one is not None and other is not None and np.array_equal(one, other))


@remembered
def _remainders_of(_observer: LinearObserver) -> ByNumbers[RemainderChannel]:
    return ByNumbers()


def error_model_row(model: ErrorModel | None, printed_digits: int | None, *, constants_allowed: bool = False) -> Check:
    """Return the row of the report for the identities between a shipped observer and its error model.

    ``constants_allowed``: the method checks constants that the observer adds to its outputs.
    """
    name, claim = "error model", "the observer follows the plant, and its outputs are what they stand for"
    source = "Az T E + By C = T A, Bu + By D = T B, Cz T E + Dy C + T0 A = goal, Du + Dy D + T0 B = 0, T0 E = 0"
    added = model is not None and model.observer.constant is not None and not constants_allowed
    if model is None or not model.fits or added:
        why = "the method gives none" if model is None else "its matrices do not fit plant and observer"
        why = "the observer adds constants to what it estimates" if added else why
        return upper_bound_check(name, claim, np.nan, IDENTITY_SHARE, source=source, kind="equality", detail=why)
    bound = IDENTITY_SHARE if printed_digits is None else PRINTED_SHARE
    return upper_bound_check(
        name,
        claim,
        model.missed(),
        bound,
        source=source,
        kind="equality",
        detail="relative to the size of the terms",
    )


@dataclass(frozen=True, eq=False)
class RemainderChannel:
    """The residuals of the identities, as balls."""

    K: Ball  # (nz, n)
    U: Ball  # (nz, nu)
    J: Ball  # (rows, n)
    L: Ball  # (rows, nu)
    W: Ball  # (nz, nd), of decoupled disturbances
    V: Ball  # (rows, nd)

    def errors_per_unit(
        self, observer: LinearObserver, contraction: Contraction, *, closely: bool = False
    ) -> tuple[FloatArray, ...]:
        """Return upper bounds on the error of each output for each state, input and disturbance of at most one.

        They are ``sum_j |c Az^j k| + |direct|``, rounded outwards, of the shapes ``(rows, n)``, ``(rows, nu)`` and
        ``(rows, nd)``.  With ``closely``, each of them is computed by a sum of its own.
        """
        pairs = ((self.K, self.J), (self.U, self.L), (self.W, self.V))
        rows = observer.fault_rows
        gains = absolute_gains(observer.Az, observer.Cz[rows], contraction)
        errors = []
        for k, direct in pairs:
            bound = (
                absolute_gains(observer.Az, observer.Cz, contraction, k)
                if closely
                else contraction.gain(observer.Cz, k.midpoint, k.radius)
            )
            # Fault estimates, which matter most, get a tighter bound.
            bound[rows] = np.minimum(bound[rows], rounded_up(gains @ k.magnitude, 2 * observer.order + 4))
            # An input with an exact zero in all entries has no effect.
            direct_bound = np.where(_is_nonzero(direct), direct.magnitude, 0.0)
            bound = np.where(np.any(_is_nonzero(k), axis=0), bound, 0.0) + direct_bound
            errors.append(np.where(bound > 0.0, rounded_up(bound, 2), 0.0))
        return tuple(errors)


def _is_nonzero(ball: Ball) -> Any:
    """Return where a ball is not an exact zero."""
    return (ball.midpoint != 0.0) | (ball.radius > 0.0)


def _as_ball(part: Ball | ExtendedBall) -> Ball:
    if isinstance(part, Ball):
        return part
    ball = as_ball(part.content)
    if ball.midpoint.all():
        return ball
    nothing = np.reshape([entry.is_zero() for entry in part.content.entries()], ball.shape)
    return Ball(np.where(nothing, 0.0, ball.midpoint), np.where(nothing, 0.0, ball.radius))


@remembered
def contraction_of(observer: LinearObserver) -> Contraction | None:
    """Return a proved contraction of a shipped observer's state; ``None`` if none is found."""
    poles = poles_of(observer) if np.all(np.isfinite(observer.Az)) else None
    return prove_contraction(observer.Az, discrete=observer.dt > 0.0, poles=poles)
