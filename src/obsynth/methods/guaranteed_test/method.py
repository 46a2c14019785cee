"""The guaranteed test as a method."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from obsynth.analysis.existence.condition import Condition
from obsynth.methods.guaranteed_test.options import TestOptions
from obsynth.methods.method import ClaimMeaning, Method, PlantKind
from obsynth.plants.dae import DAEModel
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.results.checks import Check
from obsynth.results.design import ObserverDesign
from obsynth.simulation.scenario import Scenario
from obsynth.verification.error_system import ErrorModel

#: Note of a bank on tolerances, with the alternative.
NOMINAL_BANK = (
    "The thresholds are those of the nominal plant: tolerances are not in them. Design each test alone, with its "
    "fault, the others free and this scenario, for thresholds over them."
)


@dataclass(frozen=True)
class GuaranteedTestMethod(TestOptions, Method):
    r"""Design the test of a fault on the last samples that has the least threshold without false alarms.

    The residual is a weighted sum of the last outputs and known inputs.  Without the fault it never exceeds the
    threshold, as long as disturbances and noise keep their bounds.  No function of these samples does better: the
    design contains a fault profile of twice the size that gives the same samples as no fault.

    Parameters
    ----------
    plant : DescriptorSystem, TimeVaryingDescriptorSystem, DAEModel or Transformation
        Discrete time (``transform: sample_time``), any index; ``C (ny, nx)``, ``Bf (nx, nf)``, ``Bd (nx, nd)``; ``D``,
        ``Df``, ``Dd``, ``Bw``, ``Dw`` are allowed.  A time-varying plant has a separate test for each row.  Its
        parameters are faults; the value at k acts on the step to sample k + 1.  Its disturbances are ``mu1``, ``mu2``,
        ..., one in each equation.  Claims are for the worst row with a test, and ``limits`` has those of each row.
    fault : str, optional
        The fault to be detected; may be left out if there is only one.
    samples : int or "auto", optional
        Number of samples in the window.  By default the least number with a threshold within 5 % of that of the longest
        window tried; the certificate has all of them as ``trade_off``.
    course : {"step", "constant", "any", "ramp", "rate"}, optional
        Profile of the fault.  ``step``: zero for ``before`` samples, then constant (residuals fade once the step fills
        the window, so latch alarms).  ``constant``: over the whole window.  ``any``: arbitrary; the fault is estimated
        for one sample, ``lag`` samples back.  ``ramp``: a straight line.  ``rate``: changes of at most ``fault_rate``
        per sample.
    lag : int, optional, samples
        The fault is estimated for the sample this many before the last one (``any``, ``ramp``, ``rate``).  By default
        0; for ``any`` the least for which there is a test.
    before, after : int, optional, samples
        For a step: number of healthy samples before it, and of samples from it on, in place of ``samples``.
    disturbance_bounds : float or mapping of str to float or [low, high]
        Largest absolute value of every disturbance, or its interval by name; the middle of an interval is then a known
        constant, and half its width is the bound.
    noise_bound : float or mapping of str to float or [low, high]
        Number of standard deviations that no component of the stated noise exceeds; or, by output, the bound or the
        interval of its noise (for time-varying plants always by output).
    disturbance : {"any", "jump", "held", "rate"}, optional
        Profile of the disturbances within their bounds.  ``any``: arbitrary, for a sampled continuous plant also
        between samples; ``jump``: arbitrary from sample to sample, held in between; ``held``: constant over the window;
        ``rate``: changes by at most ``disturbance_rate``.  Every value but ``any`` is an assumption, which all results
        repeat.  For a plant given in discrete time, or with delays, ``any`` is ``jump``.
    disturbance_rate : float or mapping of str to float, optional
        Largest change of each disturbance within the time of a sample.
    fault_rate : float, optional
        Largest change of the fault from sample to sample.
    state_bounds, initial_bounds : mapping of str to float, optional
        Largest absolute values of states, at every sample or at the first one of the window; none by default.  With
        ``state_bounds`` the claim ``least`` is about intervals: a fault of that size and the opposite one give the same
        samples.  A fault of twice that size need not look like none, since the states may leave their bounds.
    free : "others", "none" or sequence of str, optional
        Faults that the test is decoupled from, so that an alarm isolates its fault.
    free_course : {"any", "constant"}, optional
        Profile of these faults.
    norm : {"box", "ellipsoid"}, optional
        Whether each component has its own bound, or disturbances and noise of a sample lie in ellipsoids with these
        half axes.
    scenario : Scenario, optional
        For plants whose constants have tolerances: expected signals, without faults.  An observer of the state then
        runs beside the test, and the threshold over the tolerances follows the signals
        (``online_monitor(design, constants=plant)``).  Weights and samples minimise its mean over the scenario.
    isolate : bool, optional
        A bank of tests: one row for each fault, decoupled from all others.  Where that is impossible, an alarm of a row
        means some fault of the smallest group that can be isolated, which is proved.  Without ``fault`` and ``free``.
    exact : bool, optional
        On data: in place of the fixed threshold, the least interval of the fault that the samples of each row allow, by
        two linear programmes with proved ends.  It detects faults that the fixed test does not.  If no fault profile
        explains a window, such as the one in which the fault begins, there is an alarm without an interval.
    missing : {"wait", "solve"}, optional
        On data, after a missing sample: no result until the window is complete again, or the test of least threshold
        without the missing rows, solved and proved for each window.
    region : mapping of str to [low, high], optional
        For a nonlinear plant: ranges, in units, of each state, input, fault and unknown input, also between samples.
        The error of the linear model in this region is bounded and counts as a disturbance, so that ``threshold`` holds
        for the nonlinear plant; ``least`` is not claimed.
    sample_time : float, optional, seconds
        For a nonlinear plant: the time between samples.
    given : mapping of str to float, optional
        For a nonlinear plant: known values at the equilibrium at which it is linearised, as for `linearise`.
    model : mapping, optional
        In the options of a finished design: the nonlinear plant.  Leave it out.
    name : str, optional
        Name of the design.

    Returns
    -------
    GuaranteedTest
        An `ObserverDesign`.  Its row is the residual (``step``, ``isolate``) or the estimate of the fault, which lies
        within the threshold of it.

    Raises
    ------
    SpecError
        A bound is missing or out of range, a signal is unknown, or the course does not fit in the window.
    PreconditionError
        No window tells the fault: what hides it is shown, by numbers that satisfy every equation exactly.
    SolverError
        No usable answer: the result is inconclusive.
    VerificationError
        The shipped realisation fails a check.

    References
    ----------
    Ours: duality of linear programmes, proved on the stored numbers.

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
    >>> test = obsynth.guaranteed_test(plant, disturbance_bounds=0.1, noise_bound=3)
    >>> test.report.passed, test.least <= test.threshold
    (True, True)
    """

    id: ClassVar[str] = "guaranteed-test"
    plants: ClassVar[tuple[PlantKind, ...]] = ("time-invariant", "time-varying", "nonlinear")
    time: ClassVar[str] = "discrete, time-varying"
    summary: ClassVar[str] = "a test of one fault with the least threshold of all tests on these samples"
    source: ClassVar[str] = "ours, by duality of linear programmes"
    claims: ClassVar[Mapping[str, ClaimMeaning]] = {
        "threshold": ClaimMeaning(
            "", "never passed without the fault, in the fault's unit", "threshold", side="at most"
        ),
        "least": ClaimMeaning(
            "", "no function of these samples estimates the fault to within less", "least", side="at least"
        ),
        "surely_found": ClaimMeaning(
            "",
            "a fault of this size and course, from a sample on, is certain to alarm, on the nominal plant",
            "surely found",
            side="at most",
        ),
        "delay": ClaimMeaning("s", "after which it does so at the latest", "delay", side="at most"),
        "mean_threshold": ClaimMeaning(
            "",
            "mean over the shipped record of the threshold that holds for all constants in their tolerances",
            "mean threshold",
            side="at most",
        ),
    }
    over_scenario: ClassVar[bool] = True
    adds_constants: ClassVar[bool] = True
    witnesses: ClassVar[frozenset[str]] = frozenset(
        {"multipliers", "multiplier_radius", "witness", "witness_radius", "rounding", "trade_off"}
        | {"state_tracking", "state_rows", "record"}
        | {"groups", "pairs", "pair_multipliers", "pair_radius"}
        | {"thresholds", "leasts", "programmes"}
    )

    def conflicts(self) -> Iterator[str]:
        """Yield a sentence for each rule across options that is broken."""
        if self.fault_rate is None and self.course == "rate":
            yield "The course rate needs fault_rate, the largest change of the fault from sample to sample."
        if self.fault_rate is not None and self.course != "rate":
            yield f"fault_rate is for course rate, not {self.course}."
        if (self.disturbance_rate is None) == (self.disturbance == "rate"):
            yield "disturbance_rate belongs to disturbance: rate. Give both or neither."
        if self.after is not None and self.course != "step":
            yield f"after is for course step, not {self.course}: give samples."
        if self.lag and self.course in ("step", "constant"):
            yield f"lag is for the courses any, ramp and rate: a {self.course} uses all samples of the window."
        if self.isolate and (self.fault is not None or self.free != "others"):
            yield "isolate makes a test for each fault: leave fault and free out."
        for name, is_chosen in (("exact", self.exact), ("missing solve", self.missing == "solve")):
            if is_chosen and self.norm != "box":
                yield f"{name} is for norm box: in ellipsoids the programmes of a row are no linear ones."
        if self.samples == "auto":
            return
        least = self.before if self.course == "step" else (self.lag or 0)
        if self.samples <= least:
            yield (
                f"course {self.course} does not fit in {self.samples} samples: "
                f"{'before' if self.course == 'step' else 'lag'} is {least}; give more samples."
            )
        if self.after is not None and self.samples != self.before + self.after:
            yield f"samples is {self.samples}, but before + after is {self.before + self.after}: leave one out."

    def existence(
        self, plant: DescriptorSystem | TimeVaryingDescriptorSystem | DAEModel, *, exactly: bool = True
    ) -> tuple[Condition, ...]:
        """Return the existence conditions: bounds are stated, and something tells the fault."""
        if isinstance(plant, DAEModel):
            from obsynth.methods.guaranteed_test.nonlinear import nonlinear_conditions

            return nonlinear_conditions(plant, self)
        from obsynth.methods.guaranteed_test.existence import conditions

        return conditions(plant, self)

    def synthesise(
        self,
        plant: DescriptorSystem | TimeVaryingDescriptorSystem | DAEModel,
        *,
        progress: Callable[[str], None],
        scenario: Scenario | None = None,
    ) -> Any:
        """Return weights, observer and certificate, not yet verified; ``scenario``: see the synthesis."""
        if isinstance(plant, DAEModel):
            from obsynth.methods.guaranteed_test.nonlinear import synthesise_nonlinear

            return synthesise_nonlinear(plant, self, progress=progress)
        from obsynth.methods.guaranteed_test.problem import require_linear_options

        require_linear_options(self)
        if self.isolate and isinstance(plant, DescriptorSystem):
            from obsynth.methods.guaranteed_test.bank_synthesis import synthesise_bank

            bank = synthesise_bank(plant, self, progress=progress)
            return bank if scenario is None else replace(bank, notes=(*bank.notes, NOMINAL_BANK))
        from obsynth.methods.guaranteed_test.synthesis import synthesise

        return synthesise(plant, self, progress=progress, scenario=scenario)

    @classmethod
    def checks(cls, design: ObserverDesign, printed_digits: int | None) -> Iterator[Check]:
        """Yield a row for each claim, from the plant and the shipped numbers alone."""
        from obsynth.methods.guaranteed_test.bank import bank_checks, is_bank
        from obsynth.methods.guaranteed_test.checks import checks

        del printed_digits
        bank = is_bank(design) and isinstance(design.plant, DescriptorSystem)
        return (bank_checks if bank else checks)(design, cls.of)

    @classmethod
    def has_error_model(cls, design: ObserverDesign) -> bool:
        """Whether the registers follow the state whatever it is: not where bounds of states are used."""
        if isinstance(design.plant, TimeVaryingDescriptorSystem):
            return False
        return not any(design.options.get(name) for name in ("state_bounds", "initial_bounds"))

    @classmethod
    def error_model(cls, design: ObserverDesign) -> ErrorModel | None:
        """Return what the registers follow: the multipliers of one equation each; without a fault the row is zero."""
        from obsynth.methods.guaranteed_test.bank import is_bank, tests_of
        from obsynth.methods.guaranteed_test.problem import window_as_designed
        from obsynth.methods.guaranteed_test.tolerant import tracked

        if not cls.has_error_model(design):
            return None
        plant, observer = design.linear
        if is_bank(design):
            own = [model for test in tests_of(design, cls.of) if (model := cls.error_model(test)) is not None]
            registers = observer.order // len(own)
            T = np.vstack([np.pad(model.T, ((0, registers - len(model.T)), (0, 0))) for model in own])
            T0 = np.vstack([np.zeros((1, plant.nx)) if model.T0 is None else model.T0 for model in own])
            return ErrorModel(plant, observer, T, T0)
        shipped = design.certificate.matrices
        window = window_as_designed(plant, cls.of(design.options))
        if "state_tracking" not in shipped:
            return ErrorModel(plant, observer, *window.followed(shipped["multipliers"].ravel()))
        maps = tracked(window, shipped["multipliers"].ravel(), shipped["state_tracking"], shipped["state_rows"])
        return ErrorModel(plant, observer, *maps)


def is_guaranteed(design: ObserverDesign) -> bool:
    """Whether a design brings its own threshold."""
    return design.method == GuaranteedTestMethod.id
