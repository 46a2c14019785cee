"""The functional filter as a method."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from annotated_types import Ge

from obsynth.analysis.existence.condition import OPTIONS_PATH, Condition
from obsynth.errors import SpecError
from obsynth.methods.functional_filter.filter_models import filter_models, with_noise_of_gains
from obsynth.methods.functional_filter.kalman_gain import FilterModel, require_noise
from obsynth.methods.method import ClaimMeaning, Method, PlantKind, Purpose
from obsynth.numerics.arguments import FewSamples, NonNegative, OpenUnitInterval, WrittenAs, is_finite_number
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.faults import Exosystem, exosystem
from obsynth.results.design import ObserverDesign
from obsynth.verification.constant_faults import STEADY_ERROR
from obsynth.verification.error_system import ErrorModel


@dataclass(frozen=True)
class FunctionalFilter(Method):
    r"""Design a filter that estimates selected faults only, or residuals that they affect.

    First the unknown inputs are removed from the plant, whatever its index.  In the remaining system, with known inputs
    u and y, the faults follow their models driven by noise, and the gain is a Kalman gain for correlated noise.  The
    filter exists for every plant on which the fault can be distinguished from the rest, also where no observer of the
    whole state exists.

    Parameters
    ----------
    plant : DescriptorSystem or Transformation
        Discrete or continuous time, any index; ``C (ny, nx)``, ``Bf (nx, nf)``, ``Bd (nx, nd)``; ``D, Df, Dd`` are
        allowed.
    faults : sequence of str, optional
        Faults to be estimated, all by default.  The other faults are treated like unknown inputs.
    joint : bool, optional
        One filter for all selected faults, with lower order and less noise.  Each estimate is then decoupled from the
        other faults only if these follow their models.  By default each is decoupled from all others, whatever their
        profiles are.
    fault_model : str, mapping or FaultModel, optional
        Model of the faults over time, as for `ui_pi_observer`.
    fault_rate : float or mapping of str to float, optional
        Standard deviation of the random change of each fault per sample (per square root of a second for ``dt == 0``),
        in the fault's unit; the gain weighs it against the noise.  By default the slowest walk with which a step shows
        within the plant's settling time; see the note of the design.
    delay : int, optional, samples
        Fixed lag: the estimate at k is of the fault at ``k - delay``, and uses the samples after that.
    mean : int, optional, samples
        Number of estimates that are averaged; this adds ``(mean - 1) // 2`` to the delay.
    decay : float, optional, 1/s
        Every error decays at this rate or faster.
    poles : sequence, optional, 1/s (dimensionless for ``dt > 0``)
        Poles of the filter in place of a Kalman gain, as for `ui_pi_observer`; for several filters (one for each fault,
        or set of faults) a list of poles for each.
    noise : float or mapping of str to float, optional
        Standard deviation of each output, per sample, for which the gain is designed; by default the plant's noise.
    states : sequence of str, optional
        States to be estimated, decoupled from all unknown inputs and faults; with ``functionals`` of the plant any
        ``K x``.  The observer has the order of Darouach's functional observer where his conditions hold, and as many
        more states as necessary elsewhere; ``decay`` or ``poles`` set its dynamics.  Faults are estimated as well only
        if ``faults`` names them.
    residuals : {"detect", "isolate"} or sequence, optional
        Only residuals, decoupled from the unknown inputs: one set that all faults affect, one set for each fault that
        no other fault affects, or one set for each given list of faults.
    steady_error_limit : float, optional
        Largest steady error of the estimate of a constant fault, as a share of the fault, proved on plant and stored
        numbers; a design with a larger error is refused.
    name : str, optional
        Name of the design.

    Returns
    -------
    ObserverDesign
        An observer with rows of states only for ``states``.  ``gains`` and the certificate hold ``T (nz, nx)`` and
        ``T0 (rows, nx)``, which prove that neither the state, nor u, nor d affects the error of any estimate.

    Raises
    ------
    SpecError
        An option is malformed, or ``delay`` or ``mean`` is given in continuous time.
    PreconditionError
        A fault cannot be distinguished from the rest (the message says what hides it, and which sensors would help), or
        an output has no stated noise.
    SolverError
        The Riccati equation has no usable solution, or poles could not be placed.
    VerificationError
        The shipped realisation fails a check.

    References
    ----------
    .. [Frisk] E. Frisk, M. Nyberg, "A minimal polynomial basis solution to residual generation for fault diagnosis in
       linear systems", Automatica 37, 2001: the null space.  Ours: one state-space reduction for any index, fault
       models and walks on it, delay, and the proof by T and T0 on the shipped numbers.
    .. [Darouach] M. Darouach, "Existence and design of functional observers for linear systems", IEEE Transactions on
       Automatic Control 45(5), 2000: ``states``.  Ours: any index, and unknown inputs and faults taken out first.
    .. [AndersonMoore] B. Anderson, J. Moore, Optimal Filtering, 1979, ch. 7: the fixed lag.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]],
    ...     C=[[1, 0], [0, 1]],
    ...     Bf=[[1], [0]],
    ...     Bd=[[0], [1]],
    ...     dt=1.0,
    ...     sensor_noise={"y1": 0.1, "y2": 0.1},
    ... )
    >>> design = obsynth.functional_filter(plant)
    >>> design.observer.fault_names, design.report.passed
    (('f1',), True)
    """

    id: ClassVar[str] = "functional-filter"
    plants: ClassVar[tuple[PlantKind, ...]] = ("time-invariant",)
    time: ClassVar[str] = "both"
    summary: ClassVar[str] = (
        "estimates of the selected faults alone, decoupled from unknown inputs; the state need not be observable"
    )
    source: ClassVar[str] = "ours, after Frisk, Nyberg 2001 and Anderson, Moore 1979"
    claims: ClassVar[Mapping[str, ClaimMeaning]] = {
        "order": ClaimMeaning("", "states of the filter", "order"),
        "decay": ClaimMeaning("1/s", "slowest decay rate of the estimation error", "decay", side="at least"),
    }
    witnesses: ClassVar[frozenset[str]] = frozenset(
        {"T", "T0", "Phi", "Cw", "walks", "stability", "tracking", "deviations"}
    )
    purposes: ClassVar[frozenset[Purpose]] = frozenset({"faults", "faults under the weakest conditions"})

    recorded: ClassVar[frozenset[str]] = frozenset({"fault_model_in_words", "fault_rate_found"})
    placed: ClassVar[frozenset[str]] = frozenset({"decay", "poles"})

    faults: Annotated[Any, WrittenAs("texts")] = None
    joint: bool = False
    fault_model: Annotated[Any, WrittenAs("fault model")] = "step"
    fault_rate: Annotated[Any, WrittenAs("named numbers")] = None
    delay: FewSamples = 0
    mean: Annotated[FewSamples, Ge(1)] = 1
    decay: NonNegative | None = None
    poles: Annotated[Any, WrittenAs("pole sets")] = None
    noise: Annotated[Any, WrittenAs("named numbers")] = None
    residuals: Annotated[Any, WrittenAs("fault sets")] = None
    states: Annotated[Any, WrittenAs("texts")] = None
    steady_error_limit: OpenUnitInterval = STEADY_ERROR

    def conflicts(self) -> Iterator[str]:
        """Yield a sentence for each rule across options that is broken."""
        if self.poles is not None:
            stated = [name for name in ("fault_rate", "decay", "noise") if getattr(self, name) is not None]
            stated += ["delay"] if self.delay else []
            if stated:
                yield f"{', '.join(stated)} choose gains, and so do poles: give one."
        if self.states is not None and self.faults is None:
            stated = [name for name in ("fault_rate", "noise") if getattr(self, name) is not None]
            stated += [name for name, default in (("delay", 0), ("mean", 1)) if getattr(self, name) != default]
            if stated:
                yield f"{', '.join(stated)} concern estimates of faults: name these (faults), or leave them out."
        if self.states is not None and self.faults is not None and self.poles is not None:
            yield "poles are of one observer: give decay, or design states and faults one at a time."
        if self.residuals is not None:
            stated = [name for name in ("faults", "states", "fault_rate") if getattr(self, name) is not None]
            late = [name for name, default in (("delay", 0), ("mean", 1)) if getattr(self, name) != default]
            if stated or late or self.joint:
                listed = [*stated, *late, *(["joint"] if self.joint else [])]
                yield f"{', '.join(listed)} concern estimates: leave them out if you ask for residuals only."

    def rates(self, plant: DescriptorSystem) -> FloatArray | None:
        """Return the walk of each fault of the plant ``(nf,)``, or ``None`` for the default; faults left out get 0."""
        if self.fault_rate is None:
            return None
        return _by_name(self.fault_rate, plant.fault_names, "fault_rate", missing=0.0)

    def sensor_noise(self, plant: DescriptorSystem) -> FloatArray | None:
        """Return the deviation of each output ``(ny,)``, or ``None`` for what the plant states."""
        if self.noise is None:
            return None
        return _by_name(self.noise, plant.output_names, "noise", missing=None)

    def require_fitting(self, plant: DescriptorSystem) -> None:
        """Raise `SpecError` where noise or rates name signals that a plant does not have."""
        self.sensor_noise(plant)
        self.rates(plant)

    def existence(self, plant: DescriptorSystem, *, exactly: bool = True) -> tuple[Condition, ...]:
        """Return the existence conditions, one or two for each fault asked for."""
        from obsynth.analysis.existence.functional_filter import conditions
        from obsynth.analysis.existence.functional_states import chosen_states, state_conditions

        of_states = state_conditions(plant, chosen_states(self.states, plant), self.decay)
        if self.states is not None and self.faults is None:
            return of_states
        return of_states + conditions(
            plant,
            fault_model=self.fault_model,
            faults=self.faults,
            residuals=self.residuals,
            exactly=None if exactly else False,
        )

    def require_stated(self, plant: DescriptorSystem) -> None:
        """Raise `PreconditionError` where a combination of the outputs that the gain reads has no noise."""
        self.require_samples(plant)
        noisy, _ = with_noise_of_gains(plant, self.sensor_noise(plant), needed=self.has_kalman_gains)
        if self.has_kalman_gains:
            for model in self.filter_models(noisy, exosystem(self.fault_model, plant.fault_names, plant.dt)):
                require_noise(model, noisy.output_names, noisy.Dw)

    def filter_models(self, plant: DescriptorSystem, model: Exosystem) -> list[FilterModel]:
        """Return a filter model for each group of faults that one filter serves; none where only states are named."""
        if self.is_for_states_alone:
            return []
        return filter_models(plant, model, faults=self.faults, residuals=self.residuals, joint=self.joint)

    @property
    def is_for_states_alone(self) -> bool:
        """Whether states are to be estimated, and no faults."""
        return self.states is not None and self.faults is None

    @property
    def has_kalman_gains(self) -> bool:
        """Whether gains of faults or residuals are weighed against noise."""
        return self.poles is None and not self.is_for_states_alone

    def require_samples(self, plant: DescriptorSystem) -> None:
        """Raise `SpecError` where options count samples and the plant is continuous."""
        late = [name for name, default in (("delay", 0), ("mean", 1)) if getattr(self, name) != default]
        if late and not plant.dt > 0.0:
            raise SpecError(
                f"{' and '.join(late)} count samples, but the plant is continuous: sample it (transform: sample_time).",
                path="method.options",
            )

    def is_for_states_as_written(self, plant: DescriptorSystem) -> bool:
        """Whether states are named, which a reduced plant may not have."""
        return self.states is not None

    def for_plant(self, plant: DescriptorSystem) -> Self:
        """Return the method without the faults that a plant no longer has."""
        if self.faults is None or isinstance(self.faults, str):
            return self
        return replace(self, faults=[name for name in self.faults if name in plant.fault_names])

    @classmethod
    def error_model(cls, design: ObserverDesign) -> ErrorModel:
        """Return the plant as it is: without a fault every row is zero, as the equations T0 of the plant prove."""
        (plant, observer), matrices = design.linear, design.certificate.matrices
        return ErrorModel(plant, observer, matrices["T"], -matrices["T0"], decoupled=True)


def _by_name(numbers: Any, names: Sequence[str], option: str, *, missing: float | None) -> FloatArray:
    """Return a number for each name, from one number or a mapping."""
    path = f"{OPTIONS_PATH}.{option}"
    if isinstance(numbers, Mapping):
        unknown = [name for name in numbers if name not in names]
        lacking = [name for name in names if name not in numbers]
        if unknown or (lacking and missing is None):
            raise SpecError(f"{option} must name {', '.join(names)}: unknown {unknown}, missing {lacking}.", path=path)
        values = [numbers.get(name, missing) for name in names]
    else:
        values = [numbers] * len(names)
    if not all(is_finite_number(value) and value >= 0.0 for value in values) or not any(values):
        raise SpecError(f"{option} is {numbers!r}: give positive numbers, one for all or by name.", path=path)
    return np.array(values, dtype=np.float64)
