"""The adaptive observer as a method."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

from obsynth.analysis.existence.condition import Condition
from obsynth.methods.descriptor_kalman.method import DescriptorKalman
from obsynth.methods.engines.recursive.claims import RECURSIVE_CLAIMS
from obsynth.methods.method import ClaimMeaning, PlantKind, Purpose
from obsynth.numerics.arguments import Count, ForgettingFactor, Probability, WrittenAs
from obsynth.observers.recursive.settings import Form, Guard
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem


@dataclass(frozen=True)
class AdaptiveObserver(DescriptorKalman):
    r"""Design an observer of states and parameters of a descriptor plant, time-varying or not.

    While the parameters are constant and excited, their estimates are unbiased and the effect of their initial values
    decays at the rate of the forgetting factor; a change is followed with a lag of about ``lambda / (1 - lambda)``
    samples.

    Parameters
    ----------
    plant : TimeVaryingDescriptorSystem or DescriptorSystem
        ``E (ne, nx)``, ``C (ny, nx)``, ``Phi (ne, nq)``, ``Psi (ny, nq)``; the faults of a DescriptorSystem are taken
        as parameters (it must be discrete in time).  Nothing is assumed about its unknown inputs, which are treated
        as by `descriptor_kalman`.
    Q, R : MatrixLike, optional
        As for `descriptor_kalman`.
    forgetting : float, optional, dimensionless
        lambda in (0, 1].
    form : {"innovation", "literal", "random-walk"}, optional
        Least squares on the whitened parity innovation (default); (18) as printed; or the parameters as states that
        walk randomly (the augmented Kalman filter), which ``forgetting`` and ``guard`` do not concern.
    guard : {"regularise", "directional", "none"}, optional
        Against wind-up: ``(1 - lambda) S_0^-1`` added to the information, so that S never exceeds S_0 (default);
        forgetting only in directions that are excited; or nothing, as printed (default of form ``literal``).
    random_walk : array_like, optional
        Covariance of one step of the walk: ``(nq, nq)``, or a variance for all, in parameter units squared.
    initial_parameters : array_like, optional
        ``(nq,)``; zeros by default.
    initial_parameter_covariance : array_like, optional
        ``S_0 (nq, nq)``, or a variance for all; the identity by default.
    initial_state, initial_covariance, early_constraints
        As for `descriptor_kalman`.
    window : int, optional
        Samples over which excitation is watched.
    reset : float, optional, dimensionless
        Detect and reset: when the innovations of 20 samples pass a threshold (with this probability per sample where
        nothing has changed, such as 1e-6), S and the covariance of theta start again from S_0.  0, the default, never.
    outliers, outlier_limit, outlier_sizes, sensors, state_bounds
        As for `descriptor_kalman`.
    name : str, optional
        Name of the design.

    Returns
    -------
    ObserverDesign
        ``observer`` is a `RecursiveObserver`; ``gains``: ``L (nx, ne)``, ``K (nx, ny)`` of the last step.
        ``certificate.claims``: ``condition``, ``contraction``, ``residual_directions``, ``excitation`` (least in any
        window, parameter units to the power -2) and the sample at which it is least.

    Raises
    ------
    SpecError
        lambda outside (0, 1], a covariance that is not symmetric or indefinite, or an option of the wrong shape.
    PreconditionError
        As for `descriptor_kalman`; no parameters; parameters that the outputs cannot distinguish from each other or
        from the state (of a time-invariant plant: ``rank [A - E, Phi; C, Psi] < nx + nq``), which are named with the
        ratio in which they have no effect on the outputs; or form ``literal`` where ``rank E + ny - nx`` is zero, so
        that it would never learn.
    VerificationError
        The observer fails a check.

    Notes
    -----
    Differs from (18): by default it learns from the whitened parity innovation, all ``rank`` directions of it, where
    (18f) sees only ``rank E + ny - nx`` (none in the paper's own example; the paper does not state this condition); as
    printed it is form ``literal``, refused where it has no residual direction.  States are those after the correction
    ``xhat + Upsilon (theta(k+1) - theta(k))``, as (18a) lags by one update.  The covariance of theta is carried besides
    S, which is none.  S is a triangle, bounded where excitation ends.  Parameters may walk randomly (the augmented
    Kalman filter).  Those that have no effect on the outputs, or none of their own, are refused: (26) cannot hold for
    them.

    References
    ----------
    .. [MoussaAli2013] Fault diagnosis for linear time-varying descriptor systems, IFAC ALCOSP 2013, eqs. (17)-(26).

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.TimeVaryingDescriptorSystem(
    ...     E=None,
    ...     A=[["0.9 + 0.05 * sin(k)"]],
    ...     C=[[1.0]],
    ...     Phi=[[1.0]],
    ...     dt=1.0,
    ...     horizon=100,
    ...     parameter_names=["leak"],
    ... )
    >>> design = obsynth.adaptive_observer(plant, Q=1e-4, R=1e-2, forgetting=0.98)
    >>> design.observer.fault_names, design.report.passed
    (('leak',), True)
    """

    id: ClassVar[str] = "adaptive-observer"
    plants: ClassVar[tuple[PlantKind, ...]] = ("time-invariant", "time-varying")
    time: ClassVar[str] = "discrete, time-varying"
    summary: ClassVar[str] = "states and parameters with deviations from Q and R"
    source: ClassVar[str] = "Moussa Ali, Zhang 2013"
    claims: ClassVar[Mapping[str, ClaimMeaning]] = {
        **RECURSIVE_CLAIMS,
        "excitation": ClaimMeaning(
            "", "least information on the parameters in a window, per parameter unit squared", "claims"
        ),
        "excitation_k": ClaimMeaning("samples", "sample that ends that window", "claims"),
    }
    purposes: ClassVar[frozenset[Purpose]] = frozenset({"parameters"})

    forgetting: ForgettingFactor = 0.98
    form: Form = "innovation"
    guard: Guard | None = None
    random_walk: Annotated[Any, WrittenAs("covariance")] = None
    initial_parameters: Annotated[Any, WrittenAs("vector")] = None
    initial_parameter_covariance: Annotated[Any, WrittenAs("covariance")] = None
    window: Count = 50
    reset: Probability = 0.0

    def conflicts(self) -> Iterator[str]:
        """Yield a sentence for each rule across options that is broken."""
        if self.form == "random-walk" and self.random_walk is None:
            yield "form 'random-walk' needs random_walk, the variance of one step of each parameter."
        if self.form != "random-walk" and self.random_walk is not None:
            yield "random_walk belongs to form 'random-walk': the other forms have a forgetting factor instead."
        if self.form == "random-walk" and self.reset:
            yield "reset is for the forms with a forgetting factor."

    def existence(  # type: ignore[override]
        self, plant: DescriptorSystem | TimeVaryingDescriptorSystem, *, exactly: bool = True
    ) -> tuple[Condition, ...]:
        """Return the existence conditions; the list ends at the first failure."""
        from obsynth.analysis.existence.kalman import kalman_conditions

        return kalman_conditions(plant, parameters=True, literal=self.form == "literal", early=self.early_constraints)
