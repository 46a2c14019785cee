"""Diagnosability of the faults of a plant: whether each can be detected, isolated and estimated, and why not."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obsynth.analysis.diagnosis.candidate_sensors import (
    SENSOR_PAIRS_UP_TO,
    SENSOR_SEARCH_UP_TO,
    Sensor,
    least_additions,
    listed_sets,
    state_sensors,
)
from obsynth.analysis.diagnosis.exact_fault_columns import DecoupledFaults, decided_exactly
from obsynth.analysis.diagnosis.fault_columns import DecoupledFault, Removal, dc_point, others
from obsynth.analysis.diagnosis.hidden_motions import hidden_motion
from obsynth.analysis.diagnosis.margins import fault_margins
from obsynth.analysis.diagnosis.sensor_search import SensorResponses
from obsynth.analysis.diagnosis.verdicts import MOST_PATTERN_FAULTS, Diagnosis, FaultDiagnosis, residual_bank
from obsynth.errors import SpecError
from obsynth.numerics.arguments import arguments_checked, is_finite_number
from obsynth.numerics.arrays import read_only
from obsynth.numerics.libraries import failed_computations, on_one_thread_if_small
from obsynth.numerics.ranks import REST_TOLERANCE
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.faults import Exosystem, exosystem, stated_eigenvalues
from obsynth.plants.pencil import structure_of
from obsynth.plants.transformations.delays import linear_plant
from obsynth.plants.transformations.recovery import Transformation

#: The whole bank of residuals is refused for plants with more faults: it decides 2^12 - 1 = 4095 sets of this many.
MOST_FAULTS_OF_WHOLE_BANK = 12

#: Candidate sensors times faults: above this number no further sensors are suggested.
MOST_ADDITIONS = 300

#: Blocking zeros with a sentence of their own; further ones are only counted.
MOST_ZEROS = 4

_INCOMPLETE_BANK_NOTE = (
    "Of {count} faults, the residuals listed see all faults, all but one, or one alone; others may exist. "
    "diagnose(..., whole_bank=True) and obsynth check --whole-bank list all of up to 12 faults."
)


@arguments_checked
@failed_computations()
@on_one_thread_if_small
def diagnose(
    plant: DescriptorSystem | Transformation,
    *,
    fault_model: Any = "step",
    frequencies: Sequence[float] = (),
    suggest: bool = True,
    whole_bank: bool = False,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Decide for each fault whether it can be detected, isolated from the others and estimated, and explain why not.

    The answers hold for all unknown inputs and initial states, and for descriptor plants of any index in continuous
    and discrete time.  Small plants whose numbers are stated, not computed, are decided in rational arithmetic.  All
    others are decided in floating point, in units that do not depend on those of the data, and each decision reports
    the gap between the singular values that it separates.

    Parameters
    ----------
    plant : DescriptorSystem or Transformation
        ``E, A (nx, nx)``, ``C (ny, nx)``, ``Bf (nx, nf)``, ``Bd (nx, nd)``; ``Df`` and ``Dd`` may be nonzero.  Where
        ``sE - A`` is not regular, the verdicts are about all trajectories that satisfy the equations, and a warning
        says so.
    fault_model : str, mapping or FaultModel, optional
        Model of the faults over time, as for `ui_pi_observer`; it decides `model_estimable`.
    frequencies : sequence of float, optional, rad/s
        Frequencies at which to decide whether a sinusoidal fault shows in a residual.
    suggest : bool, optional
        Search for further sensors where a fault cannot be estimated.
    whole_bank : bool, optional
        List every structured residual that exists, for up to 12 faults; for up to six faults all are always listed.
    progress : callable, optional
        Called with a text at the start of each stage.

    Returns
    -------
    Diagnosis
        ``isolable (nf, nf)``, `FaultDiagnosis` per fault, and the bank of structured residuals.

    Raises
    ------
    SpecError
        ``plant`` is no linear time-invariant plant, the fault model is malformed, a frequency is no number, or the
        whole bank is asked for of more than 12 faults.
    SolverError
        The numbers are beyond double precision.

    References
    ----------
    .. [Varga] A. Varga, Solving Fault Diagnosis Problems, Springer 2017: fault detectability, weak and strong, and
       isolability.  Here one reduction of a pencil decides all of these, exactly where the numbers allow it.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> diagnosis = obsynth.diagnose(plant)
    >>> [(fault.name, fault.detectable) for fault in diagnosis.faults]
    [('f1', True)]
    """
    plant = linear_plant(plant)
    if not all(is_finite_number(value) and value >= 0.0 for value in frequencies):
        raise SpecError(f"frequencies is {list(frequencies)!r}: give numbers in rad/s, 0 or more.", path="frequencies")
    model = exosystem(fault_model, plant.fault_names, plant.dt)
    if whole_bank and plant.nf > MOST_FAULTS_OF_WHOLE_BANK:
        raise SpecError(
            f"The plant has {plant.nf} faults: the whole bank of residuals is listed for up to "
            f"{MOST_FAULTS_OF_WHOLE_BANK}. Leave faults out, or whole_bank.",
            path="whole_bank",
        )
    report_stage = progress or (lambda _: None)
    exactly = decided_exactly(plant)
    report_stage("deciding which faults are detectable")
    decoupled, candidates = DecoupledFaults(plant, exactly), _Candidates(plant) if suggest else None
    for_detection = [decoupled.of((), i) for i in range(plant.nf)]
    for_isolation = [decoupled.of(others(plant, i), i) for i in range(plant.nf)]
    faults = tuple(
        _verdict(plant, own, alone, frequencies, model_points(model, i), candidates)
        for i, (own, alone) in enumerate(zip(for_detection, for_isolation, strict=True))
    )
    report_stage("deciding which faults can be isolated")
    weak, strong, pairs = _isolability(plant, for_detection, decoupled)
    margins = fault_margins(plant, weak, strong)
    faults = tuple(
        replace(
            fault,
            margin=float(margins.all_others[i]),
            least_step=None if margins.least_steps is None else float(margins.least_steps[i]),
            sentences=(*fault.sentences, *filter(None, (margins.sentence(plant.fault_names, i),))),
        )
        for i, fault in enumerate(faults)
    )
    bank = residual_bank(decoupled, whole_bank)
    part = () if whole_bank or plant.nf <= MOST_PATTERN_FAULTS else (_INCOMPLETE_BANK_NOTE.format(count=plant.nf),)
    return Diagnosis(
        faults,
        weak,
        strong,
        bank,
        plant.disturbance_names,
        "; ".join(dict.fromkeys(model.descriptions)),
        exactly,
        (*_warnings(plant, [*for_detection, *for_isolation, *pairs]), *part),
        margins.pairs,
    )


def model_points(model: Exosystem, fault: int) -> list[complex]:
    """Return the eigenvalues of the part of the exosystem that drives a fault."""
    reached = model.Cw[fault] != 0.0
    for _ in range(len(reached)):
        reached = reached | np.any(model.Phi[reached] != 0.0, axis=0)
    part = model.Phi[np.ix_(reached, reached)]
    return [complex(value) for value in stated_eigenvalues(part)] if part.size else []


def _verdict(
    plant: DescriptorSystem,
    for_detection: DecoupledFault,
    for_isolation: DecoupledFault,
    frequencies: Sequence[float],
    modes: Sequence[complex],
    candidates: _Candidates | None,
) -> FaultDiagnosis:
    points = [complex(np.exp(1j * w * plant.dt)) if plant.dt > 0.0 else 1j * w for w in frequencies]
    return FaultDiagnosis(
        name=plant.fault_names[for_detection.number],
        detectable=for_detection.visible,
        detectable_at_rest=for_detection.shows_at_rest,
        detectable_at={
            float(w): for_detection.visible and for_detection.shows_at(s)
            for w, s in zip(frequencies, points, strict=True)
        },
        estimable=for_isolation.estimable,
        step_estimable=for_isolation.shows_at_rest,
        model_estimable=for_isolation.visible and all(for_isolation.shows_at(mode) for mode in modes),
        order=for_isolation.derivatives if for_isolation.visible else None,
        residual_order=for_detection.residual_order if for_detection.visible else None,
        filter_order=for_isolation.order,
        zeros=for_isolation.zeros,
        blocking=for_isolation.blocking,
        sentences=tuple(_sentences(plant, for_detection, for_isolation, candidates)),
        exact=for_detection.exactly,
        gap=min(for_detection.gap, for_isolation.gap),
        margin=np.inf,
        least_step=None,
    )


def _sentences(
    plant: DescriptorSystem,
    for_detection: DecoupledFault,
    for_isolation: DecoupledFault,
    candidates: _Candidates | None,
) -> list[str]:
    """Return sentences that say what hides a fault, at which point of the plane, and which sensors would help."""
    name, at_rest = plant.fault_names[for_detection.number], dc_point(plant.dt)
    letter = "z" if plant.dt > 0.0 else "s"
    step, texts = for_isolation.shows_at_rest, []
    if not for_detection.visible:
        unknown = ", ".join(plant.disturbance_names)
        texts.append(
            f"{name}: not detectable by any residual" + (f" that is decoupled from {unknown}." if unknown else ".")
        )
    elif not for_isolation.visible:
        other_names = ", ".join(plant.fault_names[j] for j in for_isolation.removed)
        texts.append(f"{name}: detectable, but not distinguishable from {other_names} and the unknown inputs together.")
    if not step:
        motion = hidden_motion(
            plant, for_detection.number, at_rest, () if not for_detection.visible else for_isolation.removed
        )
        if motion is not None:
            leaves_trace = for_detection.visible and (for_isolation.visible or not for_detection.shows_at_rest)
            then = " It cannot be estimated; residuals respond only while it changes." if leaves_trace else ""
            texts.append(f"{name}: {motion} ({letter} = {_number(at_rest)}).{then}")
    hiding = [zero for zero in for_isolation.blocking if abs(zero - at_rest) > REST_TOLERANCE and zero.imag >= 0.0]
    for zero in hiding[:MOST_ZEROS]:
        motion = hidden_motion(plant, for_detection.number, complex(zero), for_isolation.removed)
        at = f"{letter} = {_number(zero)}"
        how = f"output-nulling at {at}" if motion is None else f"{motion} ({at})"
        texts.append(f"{name}: {how}. A fault with this time course cannot be estimated.")
    if len(hiding) > MOST_ZEROS:
        texts.append(f"{name}: output-nulling at {len(hiding) - MOST_ZEROS} more points.")
    if for_isolation.visible and for_isolation.derivatives and for_isolation.estimable:
        more = "s" if for_isolation.derivatives > 1 else ""
        needed = f"sample{more} of delay" if plant.dt > 0.0 else f"derivative{more} of the outputs"
        texts.append(
            f"{name}: the estimate needs {for_isolation.derivatives} {needed}"
            f"{'; that of a step needs none' if step else ''}."
        )
    if candidates is not None and not (step and for_isolation.estimable):
        texts += _suggestion(candidates, name, for_detection, step=step)
    return texts


@dataclass(frozen=True, eq=False)
class _Candidates:
    """Candidate sensors, one for each state, with their responses at generic points, which rule out most sets."""

    plant: DescriptorSystem

    @cached_property
    def sensors(self) -> tuple[Sensor, ...]:
        return state_sensors(self.plant)

    @property
    def search_scope(self) -> str:
        """Which additions are searched, in words; empty where a search for each fault would take too long."""
        if self.plant.nx > SENSOR_SEARCH_UP_TO or len(self.sensors) * self.plant.nf > MOST_ADDITIONS:
            return ""
        return "state" if self.plant.nx > SENSOR_PAIRS_UP_TO else "state or pair of states"

    @cached_property
    def responses(self) -> SensorResponses | None:
        return SensorResponses.of(self.plant, self.sensors)

    def additions(
        self, fault: int, decoupled: Sequence[int], is_enough: Callable[[DescriptorSystem], bool]
    ) -> tuple[tuple[str, ...], ...]:
        """Return the smallest sets of sensors with which the plant passes the test ``is_enough``.

        The plant passes only if the fault shows in residuals that are decoupled from the faults ``decoupled``.
        """

        def promising(sets: NDArray[np.int64]) -> NDArray[np.bool_]:
            return np.ones(len(sets), bool) if responses is None else responses.shows(sets, fault, decoupled) > 0.0

        if not self.search_scope:
            return ()
        responses = self.responses
        return least_additions(self.plant, self.sensors, is_enough, promising=promising)


def _suggestion(candidates: _Candidates, name: str, for_detection: DecoupledFault, *, step: bool) -> list[str]:
    """Return sentences that name the states to measure, and those with which the fault is detectable only."""
    plant, fault = candidates.plant, for_detection.number
    other_faults = others(plant, fault)
    cached: dict[tuple[str, ...], DecoupledFault] = {}

    def isolated(changed: DescriptorSystem) -> DecoupledFault:
        added = changed.output_names[plant.ny :]
        return cached.setdefault(added, DecoupledFault(Removal(changed, other_faults), fault))

    full = candidates.additions(fault, other_faults, lambda changed: isolated(changed).estimable)
    constant = (
        () if step else candidates.additions(fault, other_faults, lambda changed: isolated(changed).shows_at_rest)
    )
    texts = []
    if full:
        texts.append(f"{name}: Measure one of: {listed_sets(full)}.")
    elif constant:
        texts.append(f"{name}: Measure one of: {listed_sets(constant)} (then a step of it can be estimated).")
    if not for_detection.visible:
        showing = candidates.additions(fault, (), lambda changed: DecoupledFault(Removal(changed, ()), fault).visible)
        more = [names for names in showing if names not in (*full, *constant)]
        if more:
            texts.append(f"{name}: {listed_sets(more)} would make it detectable, but not estimable.")
    if not candidates.search_scope:
        texts.append(f"{name}: obsynth.sensor_sets searches which sensors would help.")
    elif not texts and plant.nx:
        texts.append(f"{name}: no further {candidates.search_scope} makes it estimable.")
    return texts


def _isolability(
    plant: DescriptorSystem, for_detection: Sequence[DecoupledFault], faults: DecoupledFaults
) -> tuple[np.ndarray, np.ndarray, list[DecoupledFault]]:
    weak, strong = np.zeros((2, plant.nf, plant.nf), dtype=bool)
    pairs = {(i, j): faults.of((j,), i) for i in range(plant.nf) for j in others(plant, i)}
    for place, pair in {**pairs, **{(i, i): own for i, own in enumerate(for_detection)}}.items():
        weak[place], strong[place] = pair.visible, pair.shows_at_rest
    return read_only(weak, bool), read_only(strong, bool), list(pairs.values())


def _warnings(plant: DescriptorSystem, faults: Sequence[DecoupledFault]) -> tuple[str, ...]:
    texts = []
    if not structure_of(plant).regular:
        texts.append(
            "sE - A is not regular: the equations leave states open or bind the inputs. The verdicts are about all "
            "trajectories that satisfy them."
        )
    unclear = [fault for fault in faults if not fault.clear]
    if unclear:
        worst = min(unclear, key=lambda fault: fault.gap)
        texts.append(
            f"{plant.fault_names[worst.number]}: the least clear decision has a gap of {worst.gap:.2g} only; orders, "
            "and in the worst case a verdict, may depend on the last digits of the data."
        )
    return tuple(texts)


def _number(value: complex) -> str:
    value = complex(value)
    if value.imag == 0.0:
        return f"{value.real:.4g}"
    return f"{value.real:.4g} +- {abs(value.imag):.4g}j" if value.real else f"+- {abs(value.imag):.4g}j"
