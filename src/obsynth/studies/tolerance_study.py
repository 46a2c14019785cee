"""The tolerance study: false alarms and the least detected fault, with a fixed and with an adaptive threshold."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.files.outputs import write_atomically
from obsynth.files.tables import text_table
from obsynth.methods.verifying import verify
from obsynth.monitoring.thresholds.monitor import Monitor
from obsynth.monitoring.thresholds.residual_monitor import monitor
from obsynth.numerics.arguments import arguments_checked, whole_number
from obsynth.numerics.arrays import FloatArray, freeze
from obsynth.numerics.outward import upper_text
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.constants import deviations_told, shown, tolerance_share
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.certificate_files import RESULT_FILE, SHOWN_DIGITS, result_text
from obsynth.results.design import ObserverDesign, require_verified
from obsynth.results.gain_set_writing import design_as_dict
from obsynth.results.gain_sets import STUDY
from obsynth.simulation.benches import Runs, drawn_designs, make_bench
from obsynth.simulation.profiles import Step
from obsynth.simulation.scenario import Scenario

#: Tolerances that are tried, by default.
TOLERANCES = (0.0, 0.01, 0.02, 0.05)

#: The least fault is found to this share, up to this many times the threshold it is compared with.
FAULT_SHARE, MOST_TIMES = 0.05, 1e4

#: The fault of a search steps up after this share of the scenario.
ONSET = 0.5

#: The two monitors.
FIXED, ADAPTIVE = "fixed bound", "adaptive threshold"


@dataclass(frozen=True, eq=False)
class ToleranceStudy:
    """False alarms and least faults by tolerance; see `obsynth.tolerance_study`.

    Parameters
    ----------
    tolerances : FloatArray
        ``(n,)``: largest tolerance of a constant, as a share; those of others go with it.
    false_alarms : FloatArray
        ``(n, 2)``: share of the runs without a fault that have an alarm: fixed bound, adaptive threshold.
    least_faults : FloatArray
        ``(n, 2)``: least step of the fault that is found in every run, in its unit; infinite where none is.
    fault : str
        Which fault.
    unit : str
        Of it; empty where it is not known.
    runs : int
        For each number, each with a plant of its own from the box, half of them vertices.
    design : ObserverDesign, optional
        Which was studied.
    asked : mapping, optional
        Scenario and options, as plain data.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.uncertain_system(
    ...     {"A": [["a"]], "B": [[1]], "C": [[1]], "Bf": [[1]], "dt": 1.0},
    ...     {"a": {"nominal": 0.5, "tolerance": "5 %"}},
    ... )
    >>> scenario = obsynth.Scenario(
    ...     horizon=20, inputs={"u1": obsynth.Step(size=1.0)}, faults={"f1": obsynth.Step(size=1.0, start=10)}
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> study = obsynth.tolerance_study(design, scenario, tolerances=(0.0, 0.05), runs=4)
    >>> study.fault, study.false_alarms.shape
    ('f1', (2, 2))
    """

    tolerances: FloatArray
    false_alarms: FloatArray
    least_faults: FloatArray
    fault: str
    unit: str
    runs: int
    design: ObserverDesign | None = None
    asked: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        freeze(self, "tolerances", "false_alarms", "least_faults")

    def rows(self) -> list[tuple[str, ...]]:
        """Return a heading, and for each tolerance a row of each monitor, as text."""
        unit = f" ({self.unit})" if self.unit else ""
        body = [
            (
                f"{100.0 * tolerance:.3g} %",
                name,
                f"{100.0 * self.false_alarms[i, j]:.0f} %",
                f"{self.least_faults[i, j]:.3g}" if np.isfinite(self.least_faults[i, j]) else "none",
            )
            for i, tolerance in enumerate(self.tolerances)
            for j, name in enumerate((FIXED, ADAPTIVE))
        ]
        return [("tolerance", "monitor", "false alarms", f"least {self.fault} found{unit}"), *body]

    @property
    def conclusion(self) -> str:
        """Which of the two monitors to take, and from which tolerance on."""
        alarming = [
            tolerance for tolerance, alarms in zip(self.tolerances, self.false_alarms, strict=True) if alarms[0] > 0.0
        ]
        if not alarming:
            return (
                f"The {FIXED} had no false alarm in these runs; the {ADAPTIVE} has none, proved, while constants, "
                "disturbances and noise stay within their bounds."
            )
        blind = [
            tolerance
            for tolerance, least in zip(self.tolerances, self.least_faults, strict=True)
            if not np.isfinite(least[1])
        ]
        return (
            f"Take the {ADAPTIVE}: the {FIXED} has false alarms from {100.0 * min(alarming):.3g} % of tolerance on."
            + (f" It detects no {self.fault} from {100.0 * min(blind):.3g} % on." if blind else "")
        )

    def as_dict(self) -> dict[str, Any]:
        """Return everything as plain data; `None` for a fault that is never told."""
        least = [[float(value) if np.isfinite(value) else None for value in row] for row in self.least_faults]
        return {
            "tolerances": self.tolerances.tolist(),
            "false_alarms": self.false_alarms.tolist(),
            "least_faults": least,
            "fault": self.fault,
            "unit": self.unit,
            "runs": self.runs,
            "monitors": [FIXED, ADAPTIVE],
        }

    @property
    def statement(self) -> str:
        """What was found at the largest tolerance, in one sentence, with everything that it rests on."""
        if self.design is None:
            return ""
        return study_statement(self.as_dict(), self.asked, design_as_dict(self.design)["sha256"])

    def save(self, path: str | Path) -> Path:
        """Write a certificate that `obsynth verify` recomputes, with the gain set inside.

        Parameters
        ----------
        path : str or Path
            Where to write (.json).

        Raises
        ------
        SpecError
            The study does not know its design, or the file cannot be written.
        VerificationError
            The design fails its own verification.
        """
        if self.design is None:
            raise SpecError("The study holds no design: there is nothing to certify.", path="design")
        require_verified(self.design.replace(report=verify(self.design)))
        text = result_text(STUDY, {"design": self.design}, self.asked, self.as_dict(), self.statement)
        return write_atomically(path, text, kind=RESULT_FILE)

    def __repr__(self) -> str:
        return "\n".join([*text_table(self.rows(), left_aligned=2), self.conclusion])


def study_statement(result: Mapping[str, Any], options: Mapping[str, Any], digest: str) -> str:
    """Return what a study found at its largest tolerance; ``digest`` is that of the gain set."""
    last = int(np.argmax(result["tolerances"]))
    unit = f" {result['unit']}" if result["unit"] else ""
    figures = [
        f"the {name} has a false alarm in {100.0 * alarms:.4g} % of them and detects "
        + (
            f"no step of {result['fault']}"
            if least is None
            else f"a step of {result['fault']} from {upper_text(least)}{unit} on"
        )
        for name, alarms, least in zip(
            result["monitors"], result["false_alarms"][last], result["least_faults"][last], strict=True
        )
    ]
    bounds = ", ".join(f"{name} within {shown(value)}" for name, value in (options["disturbance_bounds"] or {}).items())
    noise = "" if options["noise_bound"] is None else f"noise within {deviations_told(options['noise_bound'])}"
    assumptions = "; ".join(part for part in (bounds, noise) if part)
    return (
        f"Of {result['runs']} runs of {shown(options['scenario']['horizon'])} s, "
        f"seeds from {options['scenario']['seed']}, "
        f"each of a plant drawn within {100.0 * result['tolerances'][last]:.4g} % tolerances"
        f"{f' ({assumptions})' if assumptions else ''}: {', and '.join(figures)}. Gain set {digest[:SHOWN_DIGITS]}."
    )


@arguments_checked
def tolerance_study(
    design: ObserverDesign,
    scenario: Scenario,
    *,
    tolerances: Sequence[float | str] = TOLERANCES,
    fault: str | None = None,
    runs: int = 20,
    disturbance_bounds: Mapping[str, float] | None = None,
    noise_bound: float | None = None,
    progress: Callable[[str], None] | None = None,
) -> ToleranceStudy:
    """Compare the fixed bound of the pointwise monitor with the adaptive one, for larger and larger tolerances.

    Parameters
    ----------
    design : ObserverDesign
        Linear, of a plant with tolerances.
    scenario : Scenario
        Inputs, disturbances, noise and start; its faults do not count.
    tolerances : sequence of float or str, optional
        Shares, or texts such as ``"2 %"``: of the constant with the largest tolerance; the others stay in proportion.
    fault : str, optional
        The fault that steps up in the middle of the scenario; the first that the design estimates by default.
    runs : int, optional
        For each tolerance: as many plants of the box, half of them vertices, and seeds.
    disturbance_bounds, noise_bound : optional
        As for `obsynth.monitor`.
    progress : callable, optional
        Called with a text before each tolerance.

    Returns
    -------
    ToleranceStudy
        Print it for a table; `obsynth.plotting.plot_tolerances` draws it.  A fault counts as told in a run where it
        brings an alarm at a sample at which the same run has none without it.

    Raises
    ------
    SpecError
        The plant has no tolerances or no fault, a nominal value is zero, or an option is out of range.
    PreconditionError
        No bound exists over some of the tolerances.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.uncertain_system(
    ...     {"A": [["a"]], "B": [[1]], "C": [[1]], "Bf": [[1]], "dt": 1.0},
    ...     {"a": {"nominal": 0.5, "tolerance": "5 %"}},
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> scenario = obsynth.Scenario(
    ...     horizon=20, inputs={"u1": obsynth.Step(size=1.0)}, faults={"f1": obsynth.Step(size=1.0, start=10)}
    ... )
    >>> study = obsynth.tolerance_study(design, scenario, tolerances=(0.0, 0.05), runs=4)
    >>> study.tolerances.tolist()
    [0.0, 0.05]
    """
    whole_number(runs, "runs")
    if not (isinstance(design.observer, LinearObserver) and isinstance(design.plant, DescriptorSystem)):
        raise SpecError(
            f"Thresholds that adapt to tolerances are those of linear designs of plants with constant matrices, and "
            f"{design.name!r} is by {design.method}: leave tolerances out, or take a linear method (for equations with "
            "transform: {linearise: ...}).",
            path="design",
        )
    plant, observer = design.linear
    box = None if plant.uncertainty is None else plant.uncertainty.box
    if box is None or not box.names:
        raise SpecError(
            "No constant of the plant has a tolerance: state some in the plant, such as constants: {R: {nominal: 2, "
            "tolerance: 5 %}}, and name them in its matrices (in Python obsynth.uncertain_system).",
            path="design",
        )
    zero = [item.name for item in box.uncertain if item.nominal == 0.0]
    if zero:
        raise SpecError(f"The nominal value of {zero[0]!r} is zero, which has no per cent.", path="tolerances")
    known = max(item.half / abs(item.nominal) for item in box.uncertain)
    names = observer.fault_names
    if not names or (fault is not None and fault not in names):
        raise SpecError(f"fault is {fault!r}: the design estimates {', '.join(names) or 'none'}.", path="fault")
    if isinstance(tolerances, str) or not len(tolerances):
        raise SpecError(f"tolerances is {tolerances!r}: give a list, such as [0, '1 %', '2 %'].", path="tolerances")
    shares = [tolerance_share(value, "tolerances") for value in tolerances]
    chosen = names[0] if fault is None else fault
    quiet = scenario.replace(faults={}, sensors={})
    alarms, least = np.empty((len(shares), 2)), np.empty((len(shares), 2))
    for i, share in enumerate(shares):
        if progress is not None:
            progress(f"tolerance {100.0 * share:.3g} %")
        scaled = _scaled(design, share / known)
        without, with_one = _healthy_and_faulty(scaled, quiet, chosen, runs)
        for j, constants in enumerate((None, scaled.linear[0])):
            watched = monitor(
                scaled, quiet, constants=constants, disturbance_bounds=disturbance_bounds, noise_bound=noise_bound
            )
            alarms[i, j], least[i, j] = _counted(watched, without, with_one)
    options = {
        "scenario": scenario.as_dict(),
        "tolerances": shares,
        "fault": chosen,
        "runs": runs,
        "disturbance_bounds": None if disturbance_bounds is None else dict(disturbance_bounds),
        "noise_bound": noise_bound,
    }
    return ToleranceStudy(np.array(shares), alarms, least, chosen, plant.units.get(chosen, ""), runs, design, options)


def _scaled(design: ObserverDesign, factor: float) -> ObserverDesign:
    plant, _ = design.linear
    uncertain = plant.uncertainty
    if uncertain is None:
        return design
    return design.replace(plant=plant.replace(uncertainty=uncertain.with_box(uncertain.box.scaled(factor))))


def _healthy_and_faulty(design: ObserverDesign, scenario: Scenario, fault: str, runs: int) -> tuple[Runs, Runs]:
    """Return the same runs without and with a fault of size 1, each of a plant drawn from the box."""
    faulty = scenario.replace(faults={fault: Step(size=1.0, start=ONSET * scenario.horizon)})
    by_case: list[list[Runs]] = [[], []]
    for i, true in enumerate(drawn_designs(design, runs, scenario.seed)):
        for batch, case in zip(by_case, (scenario, faulty), strict=True):
            batch.append(make_bench(true, case).run([scenario.seed + i]))
    return _joined(by_case[0]), _joined(by_case[1])


def _joined(runs: list[Runs]) -> Runs:
    signals = ("states", "outputs", "inputs", "faults", "disturbances", "rows")
    joined: dict[str, Any] = {name: np.concatenate([getattr(run, name) for run in runs], axis=1) for name in signals}
    return Runs(**joined, observer=runs[0].observer)


def _counted(watched: Monitor, without: Runs, with_one: Runs) -> tuple[float, float]:
    """Return the share of false alarms, and the least size of the fault that is found in every run."""
    false = watched.passed_in(without)

    def alarms_at(size: float) -> bool:
        # Plant and observer are linear: what the fault does goes with its size.
        moved = {}
        for name in ("states", "outputs", "inputs", "faults", "rows"):
            quiet = getattr(without, name)
            moved[name] = quiet + size * (getattr(with_one, name) - quiet)
        passed = watched.passed_in(replace(without, **moved))
        return bool((passed & ~false).any(axis=0).all())

    exact = watched.nominal_threshold
    level = np.abs(exact[np.isfinite(exact)])
    high = float(np.max(level, initial=np.finfo(np.float64).tiny))
    low, most = 0.0, MOST_TIMES * high
    while not alarms_at(high):
        low, high = high, 2.0 * high
        if high > most:
            return float(false.any(axis=0).mean()), float("inf")
    while high - low > FAULT_SHARE * high:
        middle = (low + high) / 2.0
        low, high = (low, middle) if alarms_at(middle) else (middle, high)
    return float(false.any(axis=0).mean()), high
