"""The PD observer as a method."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np

from obsynth.analysis.existence.condition import Condition
from obsynth.conditions.options import OwnConstraints, OwnRegion, SolverName, SolverOptions, own_term_conflicts
from obsynth.errors import SpecError
from obsynth.methods.method import ClaimMeaning, Method, PlantKind, Purpose, Synthesis
from obsynth.numerics.arguments import NonNegative, OpenUnitInterval, Positive, WrittenAs, real_array, shown
from obsynth.numerics.arrays import FloatArray, as_matrix
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import ObserverDesign
from obsynth.verification.constant_faults import STEADY_ERROR
from obsynth.verification.error_system import ErrorModel

if TYPE_CHECKING:
    from obsynth.verification.requested_limits import Limits

#: Up to so many unknown states "auto" takes the inequality (a second or two); up to so many it tries it where the
#: closed form does not serve (a minute or two).
LMI_UP_TO = 20

SPARE_LMI_UP_TO = 50


@dataclass(frozen=True)
class PdObserver(Method):
    r"""Design a PD observer that estimates the states and the faults of a continuous-time plant.

    The estimates of states and slowly varying faults converge from any initial error.  The remaining errors are effects
    of the rate of the faults, of noise and of unknown disturbances, which are not decoupled.

    If the plant states sensor noise and has up to ten unknown states, and the only requirement is a decay rate, then an
    additional sensor never increases the noise of the fault estimates at that rate (by more than 1 %).  A sensor for
    which the smallest gains would do so is left out, and a note names it.  Noise is the standard deviation of the fault
    errors, behind a lag as fast as the plant's fastest mode.

    Parameters
    ----------
    plant : DescriptorSystem or Transformation
        Continuous time (``dt == 0``), ``A (nx, nx)``, ``C (ny, nx)``, ``Bf (nx, nf)``; ``E`` may be singular of index
        1 (its algebraic states are eliminated); feedthrough ``D, Df, Dd`` and noise ``Bw, Dw`` are allowed.
    theorem : {1, 2}, optional
        Theorem 2 has a symmetric P3, which also makes the proportional part of the augmented plant stable, at the cost
        of larger gains.
    delta : float, optional, seconds
        Parameter of the theorem.  It affects the gains, but not whether gains exist (Theorem 1).  By default the
        inverse of the plant's fastest mode, not counting well-damped modes far beyond all others; the engine
        ``"riccati"`` may use less.
    decay : float, optional, 1/seconds
        Errors decay at least like ``exp(-decay t)``.  By default no rate is imposed if the smallest gains reach a tenth
        of the plant's fastest mode; otherwise that rate is imposed, or as much of it as moderate gains allow.  With up
        to 20 unknown states these gains are small in the plant's natural units, and hence independent of the given
        ones.  0 imposes no rate.  Then, and with a given rate, gains are small in the given units.
    disk : array_like, optional, 1/seconds
        ``[c, r]``: every eigenvalue s of the error system has ``|s + c| < r``.
    gain_bound : float, optional
        Bound on the spectral norm of ``[J L; G M, G N]``, in the given units.
    fault_rate_gain : float, optional, seconds
        Bound on the l2 gain from the rate of the faults to the fault error.
    noise_gain : float, optional
        Bound on the l2 gain from the noise and its derivative (per second), as separate inputs, to the fault error; for
        unit noise on every output if the plant states none.
    adaptation_gain : array_like, optional, dimensionless
        Nonsingular G ``(nf, nf)`` of (25): the loop integrates ``G (M e + N e')``, as the design assumes.
    adaptation_range : array_like, optional, dimensionless
        ``[low, high]``: one design that is stable for every ``G = g I`` with g in this range.
    engine : {"auto", "lmi", "riccati"}, optional
        How the gains are computed.  ``"lmi"`` solves the inequality of the theorem for the smallest gains.
        ``"riccati"`` computes gains with L = 0 from a Riccati equation, and their certificate from a Lyapunov equation,
        for stability and a decay rate only.  ``"auto"`` is ``"lmi"`` for up to 20 unknown states or further
        requirements, and ``"riccati"`` otherwise.  The result's ``solver["engine"]`` says which ran.
    solver : str, optional
        Semidefinite solver: any of ``cvxpy.installed_solvers()`` for semidefinite programmes.
    solver_options : mapping, optional
        Settings of that solver by its own names.
    constraints : callable, optional
        A function of the variables of `obsynth.conditions.filasova_theorem1` by name that returns cvxpy constraints:
        ``lambda v: [v["Z"] == 0]``.  The theorem is then solved as in the paper, with the safe reading.
    objective : callable, optional
        A function of the variables that returns the objective to be minimised, in place of the size of Y, Z and P3.
    region : LMIRegion, optional
        Region of all eigenvalues of the error system (1/s), such as ``conditions.sector(0.7)``.
    steady_error_limit : float, optional
        Largest steady error of the estimate of a constant fault, as a share of the fault, proved on plant and stored
        numbers; a design with a larger error is refused.
    name : str, optional
        Name of the design.

    Returns
    -------
    ObserverDesign
        ``gains``: ``J, L (nx, ny)``, ``M, N (nf, ny)`` and, if requested, ``G (nf, nf)``.  ``observer`` is a
        realisation without derivatives; `obsynth.sample_observer` makes it run on samples.  ``certificate.claims``:
        ``theorem``, ``delta``, ``decay`` and the requested bounds.

    Raises
    ------
    SpecError
        An option is out of range.
    PreconditionError
        A discrete plant, a plant that is not regular or of index 2 or more, ``nf > ny``, dependent faults, a mode that
        is neither stable nor observable, or ``rank [A Bf; C Df] < nx + nf`` (eq. (3)), that is a zero at s = 0.
    InfeasibleError
        An unobservable mode is slower than ``decay`` or outside ``disk``; ``noise_gain`` is below the least gain of any
        estimate of constant faults; delta excludes Theorem 2 or the disk.
    SolverError
        The result is inconclusive.
    VerificationError
        The shipped realisation fails a check.

    Notes
    -----
    Differs from the paper: the objective (its inequalities alone give gains of 1e9), existence by detectability, G
    inside the loop, decay rate by ``J = J' + alpha L``, further requirements, feedthrough, no derivative of y.

    References
    ----------
    .. [Filasova] A. Filasova, D. Krokavec, V. Serbak, Application of descriptor approaches in design of PD
       observer-based actuator fault estimation, Theorem 1, eqs. (40)-(44), and Theorem 2, eqs. (61)-(65).

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(A=[[-1.0, 0.5], [0.0, -2.0]], C=[[1, 0], [0, 1]], Bf=[[1], [0]])
    >>> design = obsynth.pd_observer(plant, decay=2.0)
    >>> design.certificate.claims["decay"], design.report.passed
    (2.0, True)
    """

    id: ClassVar[str] = "pd-observer"
    plants: ClassVar[tuple[PlantKind, ...]] = ("time-invariant",)
    time: ClassVar[str] = "continuous"
    summary: ClassVar[str] = (
        "estimates of the states and the faults by proportional and derivative action, without differentiating a signal"
    )
    source: ClassVar[str] = "Filasova, Krokavec, Serbak"
    claims: ClassVar[Mapping[str, ClaimMeaning]] = {
        "theorem": ClaimMeaning("", "theorem whose inequality is proved", "LMI"),
        "delta": ClaimMeaning("s", "the theorem's parameter in the certificate", "LMI"),
        "decay": ClaimMeaning(
            "1/s", "rate at which errors decay: imposed, proved (0: stability alone)", "LMI", side="at least"
        ),
        "disk_centre": ClaimMeaning("1/s", "c of the disk |s + c| < r that holds every eigenvalue", "disk"),
        "disk_radius": ClaimMeaning("1/s", "r of that disk", "disk", side="at most"),
        "gain_bound": ClaimMeaning("", "bound on the norm of the gains", "gain bound", side="at most"),
        "fault_rate_gain": ClaimMeaning(
            "s",
            "bound on the l2 gain from the rate of the faults to the fault error: proved",
            "LMI, rate",
            side="at most",
        ),
        "noise_gain": ClaimMeaning(
            "",
            "bound on the l2 gain from noise and its derivative to the fault error: proved",
            "LMI, noise",
            side="at most",
        ),
        "adaptation_low": ClaimMeaning(
            "", "stable for every adaptation gain from here, proved", "adaptation range", side="at most"
        ),
        "adaptation_high": ClaimMeaning("", "to here", "adaptation range", side="at least"),
    }
    witnesses: ClassVar[frozenset[str]] = frozenset({"P1", "P3", "P_rate", "P_noise", "P1_low", "P1_high"})
    imposed: ClassVar[frozenset[str]] = frozenset({"decay"})
    purposes: ClassVar[frozenset[Purpose]] = frozenset({"faults"})
    recorded: ClassVar[frozenset[str]] = frozenset({"from_gains"})
    placed: ClassVar[frozenset[str]] = frozenset({"decay", "region"})

    theorem: Literal[1, 2] = 1
    delta: Positive | None = None
    decay: NonNegative | None = None
    disk: Annotated[Any, WrittenAs("pair")] = None
    gain_bound: Positive | None = None
    fault_rate_gain: Positive | None = None
    noise_gain: Positive | None = None
    adaptation_gain: Annotated[Any, WrittenAs("matrix")] = None
    adaptation_range: Annotated[Any, WrittenAs("pair")] = None
    engine: Literal["auto", "lmi", "riccati"] = "auto"
    solver: SolverName = "CLARABEL"
    solver_options: SolverOptions = None
    constraints: OwnConstraints = None
    objective: Annotated[Any, WrittenAs("function")] = None
    region: OwnRegion = None
    steady_error_limit: OpenUnitInterval = STEADY_ERROR

    def conflicts(self) -> Iterator[str]:
        """Yield a sentence for each rule across options, or for lists of numbers, that is broken."""
        if self.engine == "riccati" and self.further:
            yield (
                f"engine {self.engine!r} gives stability and a decay rate alone: take engine 'lmi', or leave out "
                f"{', '.join(self.further)}."
            )
        pairs = {name: _pair(getattr(self, name)) for name in ("disk", "adaptation_range")}
        for name, numbers in pairs.items():
            if getattr(self, name) is not None and numbers is None:
                yield f"{name} is {getattr(self, name)!r}: give a list of 2 numbers."
        disk, low_high = pairs["disk"], pairs["adaptation_range"]
        if disk is not None and not disk[1] > max(-disk[0], 0.0):
            yield f"disk is {disk}: give [c, r] for |s + c| < r, with r > 0 and part of the disk left of the axis."
        if low_high is not None and not 0.0 < low_high[0] < low_high[1]:
            yield f"adaptation_range is {low_high}: give [low, high] with 0 < low < high."
        if self.objective is not None and not callable(self.objective):
            yield f"objective is {shown(self.objective)}: give a function of the variables."
        beside = ("disk", "gain_bound", "fault_rate_gain", "noise_gain", "adaptation_gain", "adaptation_range")
        yield from own_term_conflicts(self, beside=beside, engines=("riccati",), named_regions=True)
        exclusive = ("disk", "gain_bound", "fault_rate_gain", "noise_gain", "adaptation_gain")
        clash = [name for name in exclusive if getattr(self, name) is not None]
        if self.adaptation_range is not None and clash:
            yield f"adaptation_range cannot be combined with {', '.join(clash)}."

    @property
    def further(self) -> tuple[str, ...]:
        """What is asked besides stability and a decay rate: the whole inequality alone can give it."""
        names = ("disk", "gain_bound", "fault_rate_gain", "noise_gain", "adaptation_range")
        return tuple(name for name in names if getattr(self, name) is not None)

    def engines_for(self, states: int) -> tuple[str, ...]:
        """Return the engine for this many unknown states (of plant and faults), and those to take if it fails."""
        if self.further or self.engine == "lmi" or (self.engine == "auto" and states <= LMI_UP_TO):
            return ("lmi",) if self.further else ("lmi", "riccati")
        if self.engine == "auto":
            return ("riccati", "lmi") if states <= SPARE_LMI_UP_TO else ("riccati",)
        return ("riccati",)

    @property
    def disk_numbers(self) -> tuple[float, float] | None:
        """Centre c and radius r as plain numbers."""
        return None if self.disk is None else (float(self.disk[0]), float(self.disk[1]))

    @property
    def range_numbers(self) -> tuple[float, float] | None:
        """Ends of the range of adaptation gains as plain numbers."""
        if self.adaptation_range is None:
            return None
        return float(self.adaptation_range[0]), float(self.adaptation_range[1])

    def gain_matrix(self, nf: int) -> FloatArray | None:
        """Return G ``(nf, nf)``, nonsingular; ``None`` when none is asked for."""
        from obsynth.methods.pd_observer.given_gains import checked_adaptation_gain

        return None if self.adaptation_gain is None else checked_adaptation_gain(self.adaptation_gain, nf)

    def require_fitting(self, plant: DescriptorSystem) -> None:
        """Raise `SpecError` where the adaptation gain has another size."""
        self.gain_matrix(plant.nf)

    def existence(self, plant: DescriptorSystem, *, exactly: bool = True) -> tuple[Condition, ...]:
        """Return the existence conditions, decided exactly or in floating point; the list ends at the first failure."""
        from obsynth.analysis.existence.filasova import pd_observer_conditions

        return pd_observer_conditions(plant, exactly=exactly)

    @classmethod
    def from_gains(  # type: ignore[override]
        cls, plant: DescriptorSystem, *, J: Any, L: Any, M: Any, N: Any, adaptation_gain: Any = None, decay: float = 0.0
    ) -> Synthesis:
        """Return realisation and certificate of the gains of eqs. (4), (6); see `obsynth.design_from_gains`."""
        from obsynth.methods.pd_observer.given_gains import synthesis_from_gains

        gains = {"J": J, "L": L, "M": M, "N": N}
        return synthesis_from_gains(plant, gains=gains, adaptation_gain=adaptation_gain, decay=decay)

    @classmethod
    def requested_limits(cls, design: ObserverDesign) -> Limits:
        """Return what bounds its claims: rates, the disk, gains, and the range of the adaptation gain."""
        return {
            "decay": (("decay", "at least"),),
            "disk": (("disk_centre", "equal"), ("disk_radius", "at most")),
            "gain_bound": (("gain_bound", "at most"),),
            "fault_rate_gain": (("fault_rate_gain", "at most"),),
            "noise_gain": (("noise_gain", "at most"),),
            "adaptation_range": (("adaptation_low", "at most"), ("adaptation_high", "at least")),
        }

    @classmethod
    def error_model(cls, design: ObserverDesign) -> ErrorModel:
        """Return the plant with its faults as states, which the observer follows as they are."""
        (plant, observer), nf = design.linear, design.linear[0].nf
        return ErrorModel(
            plant, observer, np.eye(plant.nx + nf), Phi=np.zeros((nf, nf)), Cw=np.eye(nf), model_names=plant.fault_names
        )


def _pair(value: Any) -> tuple[float, ...] | None:
    """Return a list of two numbers as floats; ``None`` where it is none."""
    if value is None:
        return None
    try:
        row = as_matrix(np.atleast_2d(real_array(value, "option")), "option")
    except SpecError:
        return None
    return tuple(map(float, row[0])) if row.shape == (1, 2) else None
