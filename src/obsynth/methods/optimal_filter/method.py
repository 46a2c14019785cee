"""The optimal filter as a method."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import numpy as np

from obsynth.analysis.existence.condition import OPTIONS_PATH, Condition
from obsynth.errors import SpecError
from obsynth.methods.method import ClaimMeaning, Method, PlantKind, Purpose, plain
from obsynth.methods.optimal_filter.delays import is_auto
from obsynth.numerics.arguments import Count, OpenUnitInterval, WrittenAs
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.signal_names import require_known
from obsynth.results.design import ObserverDesign
from obsynth.verification.constant_faults import STEADY_ERROR, held_faults
from obsynth.verification.error_system import ErrorModel


@dataclass(frozen=True)
class OptimalFilterMethod(Method):
    r"""Design the fault-estimation filter of least gain among all causal filters, linear or not.

    Known inputs never reach the error, nor do disturbances that are decoupled; the others count as noise.  Either the
    fault map is exact, :math:`\hat f_k = f_{k - L}` (or a reference model of f) but for noise, and the gain is that
    from noise to the error; or faults and noise together drive the error from a reference model (``exact=False``,
    model matching).

    Parameters
    ----------
    plant : DescriptorSystem or Transformation
        Either time, a regular pencil of any index; ``Bw, Dw`` (or ``sensor_noise``) and ``Bd, Dd`` are what the gain
        is from: signals of unit energy, or white of unit intensity for ``norm="h2"``.
    delay : int, "auto", or one of these for each fault, optional, samples
        Discrete time: L of the exact fault map, also as a sequence or as a mapping from names of faults.  By default
        the first delay whose least gain is within 5 % of that of the later ones; ``trade_off`` has what each delay
        gives.  Where each fault has its own, ``"auto"`` is as short as that gain allows.
    reference : mapping, sequence of matrices or linear system, optional
        What the estimate shall be of the faults: ``{"bandwidth": 10}`` in rad/s (a lag for each fault, of ``"order"``
        1), ``{"num": [5], "den": [1, 5]}``, a transfer function for each fault, or ``A, B, C, D`` of a stable model
        with nf inputs, as a mapping, in this order, or as a system of python-control or scipy.signal.  In continuous
        time the default is the lag of least order that has an exact fault map (with ``norm="h2"`` also a finite mean
        square), as fast as the plant's own poles that its outputs show.
    norm : {"hinf", "h2"}, optional
        Least largest gain (of energies), or least mean square for white noise of unit intensity.
    exact : bool, optional
        Whether faults pass exactly by the fault map; otherwise they drive the error beside the noise.
    decoupled : str or sequence of str, optional
        Disturbances that never reach the error, whatever their time course; none by default.
    weights : mapping, optional
        ``{"errors": {"fault": weight}, "inputs": {"noise": weight}}``: what errors count, and the model that forms a
        disturbance or a noise (with ``exact=False`` also a fault) from a signal of unit energy.  Each weight is a
        number or a stable model of one input and one output, such as ``control.tf([1, 1], [1, 0.1])`` or
        ``{"num": [1, 1], "den": [1, 0.1]}`` (highest power of s, or of z, first).  One for all of a group is that of
        each, or a square model that couples them, in their order: disturbances that are not decoupled come before the
        noise (with ``exact=False`` for errors alone).  Weights of errors pass at once and have strictly stable zeros.
        All claims are then of the weighted problem.
    order_limit : int, optional
        Most states of the filter, for small processors.  Where the filter of least gain has more, one of that order
        with the same fault map and decoupling is searched; its own gain is claimed beside ``least``, which is of
        filters of any order.  It is a local minimum: no claim says that it is the best of its order.  Neither the
        plant's state nor known inputs drive its error.  In model matching the plant's state may, where its modes decay
        and no disturbance is decoupled: balanced truncation of the filter of least gain is tried as well, and a
        search from there; the best filter is taken, and a note says whether its errors hold modes of the plant.
    steady_error_limit : float, optional
        Largest share of a constant fault that its estimate may miss in the end, proved on plant and stored numbers: a
        design beyond it is refused.  Not with ``exact=False``, which leaves such an error.
    name : str, optional
        Name of the design.

    Returns
    -------
    OptimalFilter
        An `ObserverDesign` with ``gain`` (of this filter, proved), ``least`` (no causal filter has less with this
        fault map, proved), ``non_causal_limit`` (nor at any delay), ``delay`` and ``trade_off``.

    Raises
    ------
    SpecError
        An option is malformed, or the reference model is unstable, improper or of other sizes.
    PreconditionError
        No causal filter has this fault map: the delay is too short, the faults have an unstable zero, or disturbances
        cannot be decoupled.
    InfeasibleError
        No filter of ``order_limit`` states has this fault map and follows the plant; the message has the least order.
    SolverError
        The Riccati equations have no usable solution, no level near the gain is proved, or no stable filter of
        ``order_limit`` states was found.
    VerificationError
        The shipped realisation fails a check.

    References
    ----------
    .. [Hassibi] B. Hassibi, A. Sayed, T. Kailath, Indefinite-Quadratic Estimation and Control, SIAM 1999, chapter 4:
       the filtering Riccati equation.  Ours: the reduction of exact fault maps to one problem of estimation for any
       index, and the signals that no output shows, which bound every causal filter.
    .. [Varga] A. Varga, Solving Fault Diagnosis Problems, 2017, sections 5.2 and 7.4 to 7.9: the null-space method.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.5]], C=[[1], [1]], Bf=[[0]], Df=[[1], [1]], Bw=[[0, 0]], Dw=[[1, 0], [0, 1]], dt=1.0
    ... )
    >>> design = obsynth.optimal_filter(plant, delay=0)
    >>> print(f"{design.least:.6f} <= {design.gain:.6f}")
    0.707107 <= 0.707107
    """

    id: ClassVar[str] = "optimal-filter"
    plants: ClassVar[tuple[PlantKind, ...]] = ("time-invariant",)
    time: ClassVar[str] = "both"
    summary: ClassVar[str] = "the least gain over all causal filters, with a bound that no filter beats"
    source: ClassVar[str] = "ours, after Hassibi, Sayed, Kailath 1999 and Varga 2017"
    claims: ClassVar[Mapping[str, ClaimMeaning]] = {
        "gain": ClaimMeaning("", "largest gain of this filter from the noise to the error", "gain", side="at most"),
        "least": ClaimMeaning(
            "", "no causal filter with this fault map has a smaller gain", "least gain", side="at least"
        ),
        "non_causal_limit": ClaimMeaning(
            "", "no delay brings the gain below this", "gain at any delay", side="at least"
        ),
        "answer_limit": ClaimMeaning(
            "",
            "gain of a filter from outputs that are others but for rounding, up to which least holds",
            "least gain",
            side="at least",
        ),
        "deviation": ClaimMeaning("", "root mean square of the error for white noise of unit intensity", "deviation"),
        "least_deviation": ClaimMeaning(
            "", "no causal linear filter with this fault map and errors that decay has less", "least deviation"
        ),
        "delay": ClaimMeaning("samples", "by which the fault map is late, at most", "fault map"),
        "order": ClaimMeaning("", "states of the filter", "order"),
    }
    witnesses: ClassVar[frozenset[str]] = frozenset(
        {"T", "T0", "stability", "modes_A", "modes_C", "P", "invisible", "samples", "limit_point", "dependent", "later"}
        | {f"reference_{name}" for name in "ABCD"}
    )
    # Its estimates are of the faults, but which noise counts is the caller's choice: only who names it gets it.
    purposes: ClassVar[frozenset[Purpose]] = frozenset()

    delay: Annotated[Any, WrittenAs("delay")] = "auto"
    reference: Annotated[Any, WrittenAs("reference model")] = None
    norm: Literal["hinf", "h2"] = "hinf"
    exact: bool = True
    decoupled: Annotated[Any, WrittenAs("texts")] = None
    weights: Annotated[Any, WrittenAs("weights")] = None
    order_limit: Count | None = None
    steady_error_limit: OpenUnitInterval = STEADY_ERROR

    def conflicts(self) -> Iterator[str]:
        """Yield a sentence for each rule across options that is broken."""
        if not is_auto(self.delay) and self.reference is not None:
            yield "delay and reference both say what the estimate shall be of the faults: give one."
        if not self.exact and self.reference is None:
            yield "exact is False: model matching needs a reference model."
        if not self.exact and self.steady_error_limit != STEADY_ERROR:
            yield (
                "steady_error_limit is for exact fault maps: model matching (exact is False) leaves an error of "
                "constant faults, and proves no limit of it."
            )

    def decoupled_names(self, plant: DescriptorSystem) -> tuple[str, ...]:
        """Return the disturbances that are decoupled; raise `SpecError` for names that the plant does not have."""
        none: tuple[str, ...] = ()
        names = none if self.decoupled is None else self.decoupled
        names = (names,) if isinstance(names, str) else tuple(names)
        require_known(names, plant.disturbance_names, what=f"{OPTIONS_PATH}.decoupled", kind="disturbance")
        return tuple(name for name in plant.disturbance_names if name in names)

    def as_plain(self) -> dict[str, Any]:
        """Return every option by name, as lists, mappings, numbers and texts."""
        options = super().as_plain()
        return options | {"reference": _as_matrices(self.reference), "weights": _as_matrices(self.weights)}

    def existence(self, plant: DescriptorSystem, *, exactly: bool = True) -> tuple[Condition, ...]:
        """Return whether any causal filter has the fault map that is asked for, in floating point."""
        del exactly
        from obsynth.methods.optimal_filter.fault_maps import conditions

        return conditions(plant, self)

    def require_stated(self, plant: DescriptorSystem) -> None:
        """Raise `SpecError` for a delay in samples where the plant is continuous."""
        if not is_auto(self.delay) and not plant.is_discrete:
            raise SpecError(
                "A delay in samples is for discrete time: give a reference model.", path=f"{OPTIONS_PATH}.delay"
            )

    @classmethod
    def error_model(cls, design: ObserverDesign) -> ErrorModel:
        """Return the plant as it is: without faults and noise every row is zero, as T and T0 prove.

        Modes of the plant that the errors hold are states of the observer here, which nothing drives.  Of outputs that
        show inputs of later samples it is the observer behind a delay."""
        from obsynth.methods.optimal_filter.realisation import with_modes
        from obsynth.methods.optimal_filter.realised_filter import behind_delay

        (plant, observer), matrices = design.linear, design.certificate.matrices
        later = int(matrices["later"][0, 0]) if "later" in matrices else 0
        observer = behind_delay(with_modes(observer, matrices), later)
        return ErrorModel(
            plant,
            observer,
            matrices["T"],
            -matrices["T0"],
            lag=matrices["T0"].shape[1] // plant.nx - 1,
            decoupled=set(design.options["decoupled"]) == set(plant.disturbance_names),
            later=later,
        )

    @classmethod
    def constant_fault_gain(cls, design: ObserverDesign, model: ErrorModel) -> FloatArray:
        """Return that of the reference model, else one; of model matching, which leaves an error, nothing is said."""
        from obsynth.methods.optimal_filter.reference import constant_gain, stored_reference

        names = model.observer.fault_names
        if not design.options["exact"] or not set(names) <= set(model.plant.fault_names):
            return np.full((len(names), len(names)), np.nan)
        reference = stored_reference(design.certificate.matrices)
        return held_faults(model) if reference is None else constant_gain(reference, model.plant.dt)


def _as_matrices(value: Any) -> Any:
    """Return an option in which systems of other packages are mappings of their matrices."""
    if hasattr(value, "dt"):
        from obsynth.methods.optimal_filter.stated_models import system_matrices

        return {name: matrix.tolist() for name, matrix in zip("ABCD", system_matrices(value), strict=True)}
    return {name: _as_matrices(part) for name, part in value.items()} if isinstance(value, Mapping) else plain(value)
