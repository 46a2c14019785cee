r"""Observers of nonlinear plants over a region: a copy of the plant with one gain, in steps of implicit Euler.

.. math::
    E \hat z' = A \hat z + B u + c + \sum_k w_k \bar f_k(\hat s) + L (y - \hat y), \qquad
    \bar f(s) = f(\mathrm{clip}\, s) + \sum_j m_j (s_j - \mathrm{clip}\, s_j)

where the nonlinearities are continued beyond the region with slopes :math:`m_j` between their bounds, so that only the
plant must be inside; the estimate may start anywhere.  If errors decay like :math:`e^{-a t}` in the norm of a matrix P
for every slope, steps of implicit Euler shrink them by :math:`(1 + 2 a h)^{-1/2}`, and have exactly one solution.
Where rounding hides it, as after a reading of 1e9, or an input is none of the equations, the row is outside the region,
and the observer begins again.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SolverError, SpecError
from obsynth.numerics import lazy_casadi as ca
from obsynth.numerics.arguments import is_finite_number, is_whole, require_kind, shown
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.observers.estimate_rows import EstimateRows
from obsynth.observers.estimates import Estimates
from obsynth.observers.records import checked_sample, whole_record
from obsynth.observers.running import Observer
from obsynth.plants.dae import DAEModel
from obsynth.plants.dae_equations import symbolic_value
from obsynth.plants.dae_functions import DAEFunctions
from obsynth.plants.implicit_step import ImplicitStep
from obsynth.plants.operating_region import OperatingRegion
from obsynth.plants.transformations.nonlinear_terms import ARGUMENT, NonlinearTerms, nonlinear_terms


class RegionState(NamedTuple):
    """The state of an observer over a region."""

    z: FloatArray  # ``(n,)``: differential states, faults, algebraic states
    k: int  # the next sample
    unclaimed: int  # rows for which nothing is claimed yet


@dataclass(frozen=True, eq=False)
class RegionObserver(EstimateRows, Observer[RegionState, FloatArray]):
    """An observer of a nonlinear plant with a certificate over a region.

    Parameters
    ----------
    model : DAEModel
        The plant, with its equations as texts.
    faults : tuple of str
        Parameters that are estimated, ``nf`` of them.
    region : mapping
        Ranges ``[low, high]`` of signals and linear combinations of them.
    slopes : FloatArray
        ``(q, 2)``: bounds of the slopes of nonlinearities within the region, in the order of
        `obsynth.plants.operating_region.OperatingRegion.slopes`.
    gain : FloatArray
        ``(nd + nf, ny)``: of differential states and faults.
    initial_state : FloatArray
        ``(n,)``: differential states, faults, algebraic states.
    forgetting : int
        Rows for which nothing is claimed after one outside the region.
    dt : float
        Seconds between samples.

    Raises
    ------
    SpecError
        Shapes do not fit together.

    Examples
    --------
    >>> import obsynth
    >>> tank = obsynth.DAEModel(
    ...     {"balance": "2.0 * der(level) = inflow - 0.5 * sqrt(level) - leak"}, {"gauge": "level"},
    ...     states={"level": 1.0}, inputs={"inflow": 0.5}, parameters={"leak": 0.0},
    ... )
    >>> observer = obsynth.region_observer(
    ...     tank, region={"level": [0.2, 2.0]}, sample_time=1.0, noise={"gauge": 1e-3, "leak": 1e-4}
    ... ).observer
    >>> observer.gain.shape, observer.faults
    ((2, 1), ('leak',))
    >>> state, estimates = observer.step(observer.init(), [1.0], [0.5])
    """

    model: DAEModel
    faults: tuple[str, ...]
    region: Mapping[str, Any]
    slopes: FloatArray
    gain: FloatArray
    initial_state: FloatArray
    forgetting: int
    dt: float

    def __post_init__(self) -> None:
        require_kind(self.model, DAEModel, "model", "a DAEModel")
        object.__setattr__(self, "faults", tuple(self.faults))
        plain = {str(text): [float(end) for end in ends] for text, ends in dict(self.region).items()}
        object.__setattr__(self, "region", plain)
        terms = self.terms
        shapes = {
            "slopes": (self._slope_count, 2),
            "gain": (terms.differential, len(terms.output_names)),
            "initial_state": (len(terms.names),),
        }
        for name, shape in shapes.items():
            matrix = np.asarray(getattr(self, name), dtype=np.float64)
            matrix = matrix.reshape(shape) if not matrix.size and 0 in shape else matrix
            if matrix.shape != shape or not np.isfinite(matrix).all():
                raise SpecError(f"{name} of the observer is {matrix.shape}, finite {shape} is needed.", path=name)
            object.__setattr__(self, name, read_only(matrix))
        if not (is_finite_number(self.dt) and self.dt > 0.0):
            raise SpecError(f"dt of an observer over a region is {shown(self.dt)}: give positive seconds.", path="dt")
        if not is_whole(self.forgetting) or self.forgetting < 0:
            raise SpecError("forgetting must be a whole number of rows, 0 or more.", path="forgetting")

    def __getstate__(self) -> dict[str, Any]:
        """Return what makes it again in another process: what follows from it is made there anew."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        for name, value in state.items():
            object.__setattr__(self, name, value)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> RegionObserver:
        """Return the observer that its `as_dict` described.

        Parameters
        ----------
        data : mapping
            Every field by name.
        """
        require_kind(data, Mapping, "data", "what as_dict() returns")
        model = data["model"]
        model = model if isinstance(model, DAEModel) else DAEModel(**model)
        return cls(**{**data, "model": model, "faults": tuple(data["faults"])})

    def as_dict(self) -> dict[str, Any]:
        """Return every field, as the constructor takes it."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {**values, "model": self.model.as_dict(), "faults": list(self.faults), "region": dict(self.region)}

    @cached_property
    def terms(self) -> NonlinearTerms:
        """The plant as matrices beside nonlinearities."""
        return nonlinear_terms(self.model, faults=self.faults)

    @cached_property
    def operating_region(self) -> OperatingRegion:
        """The region with the ranges of all arguments."""
        return OperatingRegion.of(self.terms, self.region)

    @property
    def _slope_count(self) -> int:
        terms = self.terms
        return sum(
            bool(terms.state_parts[j].any()) for nonlinearity in terms.nonlinearities for j in nonlinearity.arguments
        )

    @property
    def input_names(self) -> tuple[str, ...]:
        """Names of the known inputs."""
        return self.model.input_names

    @property
    def output_names(self) -> tuple[str, ...]:
        """Names of the outputs."""
        return self.model.output_names

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states, in the order of the model."""
        return self.model.state_names

    @property
    def fault_names(self) -> tuple[str, ...]:
        """Names of the faults."""
        return self.faults

    @property
    def residual_names(self) -> tuple[str, ...]:
        """Names of the residuals: outputs minus what is expected of them."""
        return self.model.output_names

    @property
    def state_delays(self) -> tuple[int, ...]:
        """Samples by which each state estimate lags: none."""
        return (0,) * len(self.state_names)

    @property
    def fault_delays(self) -> tuple[int, ...]:
        """Samples by which each fault estimate lags: none."""
        return (0,) * len(self.faults)

    @property
    def order(self) -> int:
        """Number of states and faults."""
        return len(self.terms.names)

    @cached_property
    def places(self) -> FloatArray:
        """Where each state of the model, then each fault, stands in z."""
        return np.array([self.terms.names.index(name) for name in (*self.state_names, *self.faults)], dtype=np.intp)

    @cached_property
    def copied_model(self) -> DAEModel:
        """The copy of the plant with continued nonlinearities and the gain; its inputs are u, y, and what each equation
        is short of zero by: zero but on the way to a solution."""
        terms = self.terms

        def equations(rates: Any, z: Any, inputs: Any, _: Any) -> list[Any]:
            state, signals = ca.vertcat(*z), ca.vertcat(*inputs)
            u, y, short = ca.vertsplit(signals, self._places_of_inputs)
            values = self._continued(state, u)
            expected = _times(terms.C, state) + ca.DM(terms.c_y) + _times(terms.Wy, values)
            total = _times(terms.A, state) + _times(terms.B, u) + ca.DM(terms.c) + _times(terms.W, values)
            total[: terms.differential] += _times(self.gain, y - expected)
            moving = [rates[i] if i < terms.differential else 0.0 for i in range(len(terms.names))]
            return [rate - total[i] - short[i] for i, rate in enumerate(moving)]

        def outputs(z: Any, _: Any) -> list[Any]:
            return list(z)

        model = self.model
        nominal = {**model.states, **{name: model.parameters[name] for name in self.faults}}
        return DAEModel(
            equations,
            outputs,
            states={name: nominal[name] for name in terms.names},
            inputs={f"in_{i}": 0.0 for i in range(self._places_of_inputs[-1])},
            equation_names=terms.equations,
            output_names=tuple(f"out_{i}" for i in range(len(terms.names))),
            storage=lambda z, _: [z[i] for i in range(terms.differential)],
        )

    @property
    def _places_of_inputs(self) -> list[int]:
        """Where u, y, and what equations are short by begin among the inputs of the copy, and the number of these."""
        terms = self.terms
        sizes = (len(terms.input_names), len(terms.output_names), len(terms.names))
        return [0, *np.cumsum(sizes).tolist()]

    def _continued(self, z: Any, u: Any) -> Any:
        """Return the nonlinearities at an estimate, continued beyond the region, as a CasADi column."""
        terms, ranges = self.terms, self.operating_region.arguments
        arguments = _times(terms.state_parts, z) + _times(terms.input_parts, u)
        clipped = [ca.fmin(ca.fmax(arguments[j], low), high) for j, (low, high) in enumerate(ranges)]
        middle = iter(0.5 * (self.slopes[:, 0] + self.slopes[:, 1]))
        values = []
        for nonlinearity in terms.nonlinearities:
            argument_values = {
                f"{ARGUMENT}{j}": clipped[j] if terms.state_parts[j].any() else arguments[j]
                for j in nonlinearity.arguments
            }
            value = symbolic_value(nonlinearity.expression, argument_values)
            for j in nonlinearity.arguments:
                if terms.state_parts[j].any():
                    value += next(middle) * (arguments[j] - clipped[j])
            values.append(value)
        return ca.vertcat(*values) if values else ca.SX(0, 1)

    @cached_property
    def _implicit(self) -> ImplicitStep:
        return ImplicitStep(DAEFunctions(self.copied_model), self.dt)

    @cached_property
    def _expected(self) -> Any:
        """The function from z and u to the expected outputs."""
        terms = self.terms
        z, u = ca.SX.sym("z", len(terms.names)), ca.SX.sym("u", len(terms.input_names))
        outputs = _times(terms.C, z) + ca.DM(terms.c_y) + _times(terms.Wy, self._continued(z, u))
        return ca.Function("expected", [z, u], [ca.densify(outputs)])

    @cached_property
    def _limits(self) -> tuple[FloatArray, FloatArray, FloatArray, tuple[tuple[int, int, float], ...]]:
        return (*self.operating_region.matrices(), self.operating_region.measured())

    def is_inside(self, z: FloatArray, u: FloatArray, y: FloatArray) -> bool:
        """Whether inputs, measurements and an estimate are in the region, as far as they tell.

        Parameters
        ----------
        z, u, y : FloatArray
            ``(n,)``, ``(nu,)`` and ``(ny,)``.
        """
        states, inputs, ranges, measured = self._limits
        values = states @ z + inputs @ u
        outputs_inside = all(
            ranges[place, 0] <= y[output] - constant <= ranges[place, 1] for place, output, constant in measured
        )
        return outputs_inside and bool(np.all((values >= ranges[:, 0]) & (values <= ranges[:, 1])))

    def rows_without_claim(self, seconds: float) -> int:
        """Return the rows until a hundredth of an error is left.

        Parameters
        ----------
        seconds : float
            Between rows: those of the design.
        """
        del seconds
        return self.forgetting

    def init(self) -> RegionState:
        """Return the state before the first sample."""
        return RegionState(np.array(self.initial_state), 0, 0)

    def advance(self, state: RegionState, y: FloatArray, u: FloatArray) -> tuple[RegionState, FloatArray]:
        """Return the state after a sample and the row ``[xhat, fhat, r]``, without checking the sample.

        Parameters
        ----------
        state : RegionState
            Before the sample.
        y, u : FloatArray
            ``(ny,)`` and ``(nu,)``.
        """
        found = self._solved(state.z, np.concatenate([u, y, np.zeros(len(state.z))]))
        # Readings of any size are no reason to give up a record: from the start errors decay as from anywhere.
        z = np.array(self.initial_state) if found is None else found
        expected = np.array(self._expected(z, u).full())[:, 0]
        inside = found is not None and self.is_inside(z, u, y)
        unclaimed = max(state.unclaimed - 1, 0) if inside else self.forgetting
        row = np.concatenate([z[self.places], y - expected])
        return RegionState(z, state.k + 1, unclaimed), row

    def _solved(self, z: FloatArray, inputs: FloatArray) -> FloatArray | None:
        """Return the state after a step of implicit Euler; ``None`` where rounding, or an input, leaves none.

        Where Newton does not find it, what equations are short by at the last state is led to zero: the certificate
        says that there is exactly one solution all the way.
        """
        implicit, none = self._implicit, np.zeros(0)
        with suppress(SolverError):
            return np.array(implicit.solve(z, inputs, none).x)
        short = implicit.functions.residual(z, z, inputs, none, np.array([self.dt]))[0][:, 0]
        begun = np.concatenate([inputs[: -len(z)], short])
        if np.isfinite(begun).all():
            with suppress(SolverError):
                return np.array(implicit.solve_carefully(z, inputs, none, before=begun).x)
        return None

    def step(self, state: RegionState, y: ArrayLike, u: ArrayLike = ()) -> tuple[RegionState, Estimates]:
        """Return the state after a sample, and the estimates at it.

        Parameters
        ----------
        state : RegionState
            Before the sample; it is not changed.
        y, u : array_like
            Outputs ``(ny,)`` and known inputs ``(nu,)``.

        Raises
        ------
        SpecError
            A sample has the wrong length, or is not finite.
        """
        require_kind(state, RegionState, "state", "what init() or the step before returned")
        outputs = checked_sample(y, len(self.output_names), "y")
        known_inputs = checked_sample(u, len(self.input_names), "u") if self.input_names else np.zeros(0)
        after, row = self.advance(state, outputs, known_inputs)
        return after, self.split(row[None, :])

    def run(self, y: ArrayLike, u: ArrayLike | None = None) -> Estimates:
        """Run over a whole record.

        Parameters
        ----------
        y : array_like
            Outputs ``(samples, ny)``.
        u : array_like, optional
            Known inputs ``(samples, nu)``; ``u(k)`` holds during the step that ends at k.

        Raises
        ------
        SpecError
            Shapes do not fit, or a number is not finite.
        """
        return self.split(self.record(y, u)[0])

    def record(self, y: ArrayLike, u: ArrayLike | None = None) -> tuple[FloatArray, Any]:
        """Return the rows of a record ``(samples, nx + nf + ny)``, and at which of them something is claimed.

        Parameters
        ----------
        y, u : array_like
            As for `run`.
        """
        outputs, known_inputs = whole_record(y, u, len(self.output_names), len(self.input_names), complete=True)
        state, rows = self.init(), np.empty((len(outputs), len(self.row_names)))
        claimed = np.empty(len(outputs), dtype=bool)
        for k in range(len(outputs)):
            state, rows[k] = self.advance(state, outputs[k], known_inputs[k])
            claimed[k] = not state.unclaimed
        return rows, claimed


def _times(matrix: FloatArray, column: Any) -> Any:
    """Return a product with a CasADi column, also where one of the two is empty."""
    return ca.SX(ca.sparsify(ca.DM(matrix))) @ column if matrix.size else ca.SX.zeros(len(matrix), 1)
