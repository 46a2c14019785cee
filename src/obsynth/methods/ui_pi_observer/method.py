"""The unknown-input PI observer as a method."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np

from obsynth.analysis.existence.condition import OPTIONS_PATH, Condition
from obsynth.conditions.options import OwnConstraints, SolverName, SolverOptions, own_term_conflicts
from obsynth.errors import SpecError
from obsynth.methods.method import ClaimMeaning, Method, PlantKind, Purpose, Synthesis
from obsynth.numerics.arguments import NonNegative, OpenUnitInterval, Positive, WrittenAs, problem_with, shown
from obsynth.numerics.regions import NamedRegion
from obsynth.numerics.spectra import decay_rates
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.faults import Exosystem, exosystem
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.results.design import ObserverDesign
from obsynth.verification.claims import STATED_BY_SEARCH
from obsynth.verification.constant_faults import STEADY_ERROR
from obsynth.verification.error_system import ErrorModel
from obsynth.verification.over_region import DECAY_ROW, GAIN_WITNESSES, REGION_GAIN_ROW, WITNESSES

if TYPE_CHECKING:
    from obsynth.verification.requested_limits import Limits


#: Objectives for the freedom that given poles leave in the gain.
OBJECTIVES = ("conditioning", "gain")

#: Name of the row on the noise of an observer over a region.
NOISE_AT_REST_ROW = "noise amplification at rest"


@dataclass(frozen=True)
class UiPiObserver(Method):
    r"""Design an unknown-input PI observer: estimates of state and faults, decoupled from all unknown inputs.

    The estimates converge to the state and to every fault that follows its model, for arbitrary unknown inputs.
    Without poles, decay or region the gain is the fastest Kalman gain, up to the median rate of the plant's modes, with
    which no fault estimate has more than ten times the noise of the quietest gain.  The design does not depend on the
    units of the data: it is computed in natural units of the plant.

    Parameters
    ----------
    plant : DescriptorSystem, PolytopicSystem or Transformation
        Discrete or continuous time, ``E (nx, nx)``, ``C (ny, nx)``, ``Bf (nx, nf)``, ``Bd (nx, nd)``; ``Df, Dd, D`` are
        allowed.  The plant need not be regular or of index 1.  For a PolytopicSystem a scheduled observer is designed,
        with proofs for all parameter trajectories.  Its outputs have to be constant, while faults and unknown inputs
        may change.  Options are then fault_model, decay, noise, solver and solver_options.
    fault_model : str, mapping or FaultModel, optional
        Model of the faults over time: ``"step"``, ``"ramp"``, ``"parabola"``, ``{"polynomial": order}``,
        ``{"sinusoid": rad/s}``, ``{"exponential": 1/s}``, ``{"Phi": ..., "Cw": ...}``, ``{"sum": [...]}``; one for all
        faults, or by fault name.
    poles : sequence, optional, 1/s (dimensionless for ``dt > 0``)
        Movable poles: numbers, complex numbers or ``[re, im]`` of any multiplicity, without the fixed ones.  If the
        plant states sensor noise, outputs that increase the noise of the fault estimates (standard deviation of their
        errors, by more than 1 %) with these poles are left out, and a note names them.
    decay : float, optional, 1/s
        All movable poles decay at this rate or faster.  The gain is the Kalman gain of the least prescribed rate
        (Anderson, Moore 1971) for which they do; that of the rate itself is faster and noisier.  0 is the plain Kalman
        gain.
    region : mapping or LMIRegion, optional
        ``decay`` (1/s), ``radius`` (1/s), ``damping`` (ratio): movable poles are placed in this region by a matrix
        inequality, with little noise.  Of more than 20, those stay that a Kalman gain of this rate places inside.
        Without ``decay`` the default rate is used if it is at most half the radius.
    noise : mapping, optional
        Weights of the Kalman gain: ``measurement`` (standard deviation: one, a list, or by output; the plant's own
        noise by default), ``process`` and ``fault`` (drive of states and fault models, relative to the default,
        dimensionless).
    objective : {"conditioning", "gain"} or callable, optional
        Objective for the freedom that ``poles`` leaves in the gain, or a function of the variables of the inequality
        that returns the objective to be minimised.  With ``conditioning``, if the plant states sensor noise, a gain
        near the best conditioned one with less noise in the fault estimates is chosen; its eigenvectors have at most 30
        times the condition.
    joint : bool, optional
        Design K and the free part of the decoupling (the paper's G) together; the fault estimates may then depend on
        the outputs directly.
    E_sharp, C_sharp, G : array_like, optional
        The paper's ``(nx, nx)``, ``(nx, ny)``, ``(nx, ny)`` of (10), (11), in place of the default decoupling.
    solver : str, optional
        Semidefinite solver for ``region``: any of ``cvxpy.installed_solvers()`` for semidefinite programmes.
    solver_options : mapping, optional
        Settings of that solver by its own names.
    constraints : callable, optional
        A function of the variables of `obsynth.conditions.sharepasand` by name that returns cvxpy constraints.  That
        inequality is then solved unchanged, as it is for a region of `obsynth.conditions`.
    steady_error_limit : float, optional
        Largest steady error of the estimate of a constant fault, as a share of the fault, proved on plant and stored
        numbers; a design with a larger error is refused.
    name : str, optional
        Name of the design.

    Returns
    -------
    ObserverDesign
        ``gains``: ``U_a, D_a, K_a, Ahat, Bhat, Jhat`` of the augmented plant, ``Phi, Cw`` of the fault model and,
        unless ``joint``, ``U (nx, nx)``, ``D (nx, ny)``, ``K (nx, ny)``, ``F (nw, ny)``, ``Hhat (nx, nf)``.  If
        algebraic states had to be eliminated, ``plant`` is the plant without them, and ``recovery`` recovers them.

    Raises
    ------
    SpecError
        A malformed option or fault model, or one too fast for the samples; poles of the wrong count, not stable, or
        not closed under conjugation.
    PreconditionError
        (D1), (D2) or (D3) fails: the eigenvalue, and the fault and disturbance that mask each other, are named.
    SolverError
        Poles could not be placed, or the solver found no gain: the result is inconclusive.
    VerificationError
        The shipped realisation fails a check.

    Notes
    -----
    Differs from the paper: existence by (D1)-(D3), as Theorems 1 and 2 and Lemma 6 are false as printed; vector
    faults; faults and disturbances in outputs; a U of full rank by construction; fixed modes kept and named; repeated
    poles by Jordan chains; the defaults.

    References
    ----------
    .. [SharePasand] M. M. Share Pasand, M. Aliyari Sh., H. D. Taghirad, Unknown Input-Proportional Integral Observer
       for Singular Systems: Application to fault detection, eqs. (4), (13), (19), procedures 1 and 2.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.ui_pi_observer(plant, decay=0.5)
    >>> design.certificate.claims["decay"] >= 0.5, design.report.passed
    (True, True)
    """

    id: ClassVar[str] = "ui-pi-observer"
    plants: ClassVar[tuple[PlantKind, ...]] = ("time-invariant", "polytopic")
    time: ClassVar[str] = "both"
    summary: ClassVar[str] = "estimates of the state and the faults, decoupled from every unknown input"
    source: ClassVar[str] = "Share Pasand, Aliyari, Taghirad"
    claims: ClassVar[Mapping[str, ClaimMeaning]] = {
        "decay": ClaimMeaning("1/s", "slowest decay rate of the estimation error", "decay", side="at least"),
        "noise_amplification": ClaimMeaning(
            "", "H2 norm from unit white noise on every output to the noisiest fault estimate", "noise amplification"
        ),
        "noise_price": ClaimMeaning(
            "",
            "noise of the fault estimates against the Kalman filter of the search without a least decay",
            STATED_BY_SEARCH,
        ),
        "digits": ClaimMeaning(
            "",
            "significant digits in which Ahat has to be kept, where more than 9 are needed",
            "stable with the claimed digits",
        ),
        "condition": ClaimMeaning("", "condition number of the (generalised) eigenvectors", STATED_BY_SEARCH),
        "region_decay": ClaimMeaning(
            "", "decay of the errors over a region: a factor a sample, or a rate in 1/s", DECAY_ROW
        ),
        "region_gain": ClaimMeaning(
            "",
            "l2 gain over a region from what drives the fault models to the fault errors",
            REGION_GAIN_ROW,
            side="at most",
        ),
    }
    witnesses: ClassVar[frozenset[str]] = frozenset(
        {"tracking", "Phi", "Cw", "poles", "stability", *WITNESSES, *GAIN_WITNESSES}
    )
    purposes: ClassVar[frozenset[Purpose]] = frozenset({"faults", "state despite unknown inputs"})

    recorded: ClassVar[frozenset[str]] = frozenset({"fault_model_in_words", "from_gains"})
    placed: ClassVar[frozenset[str]] = frozenset({"decay", "region", "poles"})

    fault_model: Annotated[Any, WrittenAs("fault model")] = "step"
    poles: Annotated[Any, WrittenAs("poles")] = None
    decay: NonNegative | None = None
    region: Annotated[Any, WrittenAs("pole region")] = None
    noise: Annotated[Any, WrittenAs("noise weights")] = None
    objective: Annotated[Any, WrittenAs("placement objective")] = "conditioning"
    joint: bool = False
    E_sharp: Annotated[Any, WrittenAs("matrix")] = None
    C_sharp: Annotated[Any, WrittenAs("matrix")] = None
    G: Annotated[Any, WrittenAs("matrix")] = None
    solver: SolverName = "CLARABEL"
    solver_options: SolverOptions = None
    constraints: OwnConstraints = None
    steady_error_limit: OpenUnitInterval = STEADY_ERROR

    @property
    def leaves_freedom_to_us(self) -> bool:
        """Whether poles are given with the default objective and decoupling."""
        return self.poles is not None and self.objective == "conditioning" and self.G is None

    def conflicts(self) -> Iterator[str]:
        """Yield a sentence for each pair of options that exclude each other."""
        placements = [name for name in ("poles", "decay", "region") if getattr(self, name) is not None]
        if len(placements) > 1:
            yield f"{' and '.join(placements)} are given: use one of them."
        if self.poles is not None and self.noise is not None:
            yield "noise weights do not act on given poles: leave one of the two out."
        stated = [getattr(self, name) is not None for name in ("E_sharp", "C_sharp", "G")]
        if any(stated) and not all(stated):
            yield "E_sharp, C_sharp and G come together: give all three, or none."
        if any(stated) and self.joint:
            yield "joint designs what E_sharp, C_sharp and G would fix: leave one of the two out."
        if not callable(self.objective) and not (isinstance(self.objective, str) and self.objective in OBJECTIVES):
            listed = ", ".join(OBJECTIVES)
            yield f"objective is {shown(self.objective)}: use one of {listed}, or a function of the variables."
        yield from own_term_conflicts(self, beside=("poles", "noise", "joint"))

    def is_for_states_as_written(self, plant: DescriptorSystem) -> bool:
        """Whether the paper's matrices are given, or as many poles as the observer of the plant as written has."""
        if self.G is not None:
            return True
        return self.poles is not None and all(condition.holds for condition in self.existence(plant))

    def given_decoupling(self) -> dict[str, Any] | None:
        """Return the paper's matrices, or ``None`` for our own decoupling."""
        if self.G is None:
            return None
        return {"E_sharp": self.E_sharp, "C_sharp": self.C_sharp, "G": self.G}

    def checked_region(self, dt: float) -> NamedRegion | None:
        """Return the region asked for."""
        if self.region is None:
            return None
        if not isinstance(self.region, Mapping):
            raise SpecError(
                f"region is {self.region!r}: give decay, radius, damping by name.", path=f"{OPTIONS_PATH}.region"
            )
        stated = {key: value for key, value in self.region.items() if value is not None}
        return NamedRegion.of(stated, dt, path=f"{OPTIONS_PATH}.region")

    def checked_noise(self, output_names: Sequence[str]) -> dict[str, Any]:
        """Return the noise weights asked for, by name."""
        if self.noise is None:
            return {}
        if not isinstance(self.noise, Mapping):
            message = f"noise is {self.noise!r}: give measurement, process, fault by name."
            raise SpecError(message, path=f"{OPTIONS_PATH}.noise")
        weights = {key: value for key, value in self.noise.items() if value is not None}
        problems = [f"unknown key {key!r}." for key in weights if key not in ("measurement", "process", "fault")]
        sizes = {key: weights[key] for key in ("process", "fault") if key in weights}
        problems += [text for key, size in sizes.items() if (text := problem_with(size, key, Positive))]
        measurement = weights.get("measurement")
        if isinstance(measurement, (list, tuple, np.ndarray)):
            if np.shape(measurement) != (len(output_names),):
                problems.append(f"measurement has shape {np.shape(measurement)}: give one number for each output.")
                measurement = None
            else:
                measurement = weights["measurement"] = dict(zip(output_names, measurement, strict=True))
        if isinstance(measurement, Mapping):
            missing = [name for name in output_names if name not in measurement]
            unknown = [name for name in measurement if name not in output_names]
            if missing or unknown:
                problems.append(f"measurement must name each output once: missing {missing}, unknown {unknown}.")
            values = list(measurement.values())
        else:
            values = [] if measurement is None else [measurement]
        if any(problem_with(value, "measurement", Positive) for value in values):
            problems.append("measurement must be positive standard deviations: one number, a list, or by output.")
        if problems:
            raise SpecError("Option noise of ui-pi-observer:", path=f"{OPTIONS_PATH}.noise", problems=problems)
        return weights

    def slowest_asked(self, dt: float) -> float | None:
        """Return the least rate of decay that was asked for, in 1/s."""
        from obsynth.numerics.requested_poles import as_pole

        if self.decay is not None:
            return self.decay
        if isinstance(self.region, Mapping):
            return float(self.region.get("decay") or 0.0)
        if self.poles is not None:
            return float(np.min(decay_rates([as_pole(pole) for pole in self.poles], dt), initial=np.inf))
        return None

    def resolved(self, model: Exosystem, fault_names: Sequence[str]) -> dict[str, Any]:
        """Return the options as plain data, for the gain set."""
        from obsynth.numerics.requested_poles import as_pole

        listed = None if self.poles is None else [as_pole(pole) for pole in self.poles]
        return {
            "fault_model": None,
            "fault_model_in_words": dict(zip(fault_names, model.descriptions, strict=True)),
            **self.as_plain(),
            "poles": None if listed is None else [[pole.real, pole.imag] for pole in listed],
        }

    def require_fitting(self, plant: DescriptorSystem | PolytopicSystem) -> None:
        """Raise `SpecError` where noise weights name outputs that a plant does not have."""
        self.checked_noise(plant.output_names)

    def existence(self, plant: DescriptorSystem | PolytopicSystem, *, exactly: bool = True) -> tuple[Condition, ...]:
        """Return the existence conditions, decided exactly or in floating point; several may fail."""
        from obsynth.analysis.existence.sharepasand import existence
        from obsynth.analysis.existence.sharepasand_over_region import pi_conditions_over_region

        model = exosystem(self.fault_model, plant.fault_names, plant.dt)
        if isinstance(plant, PolytopicSystem):
            return pi_conditions_over_region(plant, model, exactly=exactly)
        return existence(plant, model, exactly=exactly).conditions

    @classmethod
    def from_gains(  # type: ignore[override]
        cls, plant: DescriptorSystem, *, U: Any, D: Any, K: Any, F: Any, fault_model: Any = "step"
    ) -> Synthesis:
        """Return realisation and certificate of the gains of eqs. (11), (12), (23); see `obsynth.design_from_gains`."""
        from obsynth.methods.ui_pi_observer.assembly import synthesis_from_gains

        return synthesis_from_gains(plant, U=U, D=D, K=K, F=F, fault_model=fault_model)

    @classmethod
    def requested_limits(cls, design: ObserverDesign) -> Limits:
        """Return that decay bounds what is claimed over a region."""
        if "region_decay" not in design.certificate.claims:
            return {}
        return {"decay": (("region_decay", "factor" if design.observer.dt > 0.0 else "at least"),)}

    @classmethod
    def fixed_modes(cls, design: ObserverDesign) -> tuple[complex, ...]:
        """Return the eigenvalues that no gain moves: zeros of the plant from the unknown inputs to the outputs."""
        from obsynth.analysis.existence.augmented_pencils import shipped_model
        from obsynth.analysis.existence.sharepasand import existence

        plant, _ = design.linear
        model = shipped_model(design.certificate.matrices, plant.nf)
        return tuple(complex(mode) for mode in existence(plant, model).fixed_modes)

    @classmethod
    def error_model(cls, design: ObserverDesign) -> ErrorModel | None:
        """Return the plant with the fault model, decoupled from the disturbances; ``None`` without a tracking map."""
        if isinstance(design.plant, PolytopicSystem):
            return None  # one for each vertex: its checks have them
        (plant, observer), matrices = design.linear, design.certificate.matrices
        if "tracking" not in matrices:
            return None
        return ErrorModel(plant, observer, matrices["tracking"], Phi=matrices["Phi"], Cw=matrices["Cw"], decoupled=True)
