"""The plant that a method designs for: the given plant, or a form of it with fewer algebraic states or lower index."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from obsynth.analysis.existence.condition import Condition
from obsynth.errors import PreconditionError
from obsynth.methods.method import Method
from obsynth.methods.options_as_written import method_for_proper_form
from obsynth.methods.registry import Plant
from obsynth.numerics.ranks import decide_rank
from obsynth.numerics.suggestions import quoted_names
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.pencil import structure_of
from obsynth.plants.transformations.elimination import MANY_VARIABLES, eliminate_algebraic_states
from obsynth.plants.transformations.exact_elimination import EXACT_ELIMINATION_UP_TO
from obsynth.plants.transformations.index_reduction import improper_outputs, with_input_derivatives
from obsynth.plants.transformations.recovery import StateRecovery, Transformation

if TYPE_CHECKING:
    from obsynth.analysis.diagnosis.candidate_sensors import Sensor

#: Options whose values belong to the states and equations as written.
_OF_STATES_AS_WRITTEN = ("Q", "initial_state", "initial_covariance", "state_bounds")

#: Conditions of methods that every state is dynamic or measured.  Elimination of algebraic states removes the need.
_DYNAMIC_OR_MEASURED = ("rank [E; C]", "rank [N E; C]", "rank [E 0; 0 0; C Df]")


@dataclass(frozen=True, eq=False)
class WorkingPlant:
    """A plant that a method designs for, with the recovery of the given plant's states.

    Parameters
    ----------
    plant : Plant
        The given plant or a transformed one.
    recovery : StateRecovery or None
        The given plant's states as functions of this plant's; ``None`` where they are the same.
    notes : tuple of str
        Notes on the transformation, for the user.
    reduced : str
        What was done to a plant of index 2 or more, or with algebraic states that the method does not take; else "".
    dropped : tuple of str
        States of the given plant that cannot be recovered.
    method : Method or None
        The method with its options restated for this plant; ``None`` where they are unchanged.
    """

    plant: Plant
    recovery: StateRecovery | None
    notes: tuple[str, ...] = ()
    reduced: str = ""
    dropped: tuple[str, ...] = ()
    method: Method | None = None

    def sensors(self) -> tuple[Sensor, ...] | None:
        """Return a sensor for each recoverable state of the given plant; ``None`` where it was not reduced."""
        from obsynth.analysis.diagnosis.candidate_sensors import recovered_sensors

        if not self.reduced or self.recovery is None or not isinstance(self.plant, DescriptorSystem):
            return None
        return recovered_sensors(self.plant, self.recovery, self.dropped)

    def conditions(self) -> tuple[Condition, ...]:
        """Return one condition, which states how the plant was reduced; none where it was not."""
        if not self.reduced:
            return ()
        source = "Dai 1989, section 1.2"
        return (Condition("proper form", "a proper form of the plant", True, 1.0, 1.0, source, self.reduced),)


def working_plant(
    plant: Plant, recovery: StateRecovery | None, progress: Callable[[str], None], method: Method | None
) -> WorkingPlant:
    """Return the plant that a method designs for; the method and its options decide whether the index is reduced."""
    if not isinstance(plant, DescriptorSystem):
        return WorkingPlant(plant, recovery)
    if plant.nx < MANY_VARIABLES:
        plant = plant.dense()
        transformation, notes = _of_low_index(plant, method)
        if transformation is None:
            return WorkingPlant(plant, recovery)
        progress("reducing the index")
        return _in_proper_form(plant, recovery, method, transformation, notes)
    if not plant.is_sparse:
        return WorkingPlant(plant, recovery)
    progress("eliminating the algebraic states")
    transformation = eliminate_algebraic_states(plant)
    return WorkingPlant(transformation.plant, _composed_recovery(recovery, transformation), transformation.notes)


def with_derivatives_as_inputs(
    plant: Plant, recovery: StateRecovery | None, method: Method, working: WorkingPlant
) -> WorkingPlant | None:
    """Return the proper form of a plant in which derivatives of known inputs are further inputs.

    ``None`` where the plant was reduced already or needs no derivatives, or the method does not exist for that form.
    """
    if not isinstance(plant, DescriptorSystem) or working.reduced or plant.nx > EXACT_ELIMINATION_UP_TO:
        return None
    if (structure_of(plant).index or 0) < 2 or method.is_for_states_as_written(plant):
        return None
    proper = _with_input_derivatives(plant.dense())
    if proper is None or not _exists(proper[0].plant, method):
        return None
    return _in_proper_form(plant, recovery, method, *proper)


def _in_proper_form(
    plant: DescriptorSystem,
    recovery: StateRecovery | None,
    method: Method | None,
    transformation: Transformation,
    notes: tuple[str, ...],
) -> WorkingPlant:
    notes = (f"{_reason(plant)}: {transformation.description}.", *notes)
    if method is not None:
        method, more = method_for_proper_form(plant, transformation, method)
        notes = (*notes, *more)
    return WorkingPlant(
        transformation.plant,
        _composed_recovery(recovery, transformation),
        notes,
        " ".join(notes),
        transformation.dropped,
        method,
    )


def _composed_recovery(recovery: StateRecovery | None, transformation: Transformation) -> StateRecovery:
    return transformation.recovery if recovery is None else recovery.then(transformation.recovery)


def _of_low_index(plant: DescriptorSystem, method: Method | None) -> tuple[Transformation | None, tuple[str, ...]]:
    """Return the transformation to a minimal proper form, with notes on outputs that were left out or changed.

    The plant has index 2 or more, or index 1 and the method does not take its algebraic states.  ``None`` for all
    other plants, and where the method takes the plant as written.
    """
    index = structure_of(plant).index or 0
    if plant.nx > EXACT_ELIMINATION_UP_TO or index == 0:
        return None, ()
    if method is not None and method.is_for_states_as_written(plant):
        return None, ()
    if index == 1:
        return _without_algebraic_states(plant, method), ()
    try:
        return eliminate_algebraic_states(plant), ()
    except PreconditionError as error:
        if error.condition != "index" or method is None or _exists(plant, method):
            return None, ()
    return _with_input_derivatives(plant) or _without_improper_outputs(plant)


def _reason(plant: DescriptorSystem) -> str:
    if structure_of(plant).index == 1:
        return "The method takes algebraic states only where they are measured"
    return "The plant has index 2 or more"


def _without_algebraic_states(plant: DescriptorSystem, method: Method | None) -> Transformation | None:
    """Return a plant of index 1 without its algebraic states if the method exists for that form only, else ``None``."""
    if method is None or any(getattr(method, name, None) is not None for name in _OF_STATES_AS_WRITTEN):
        return None
    if _is_dynamic_or_measured(plant):
        return None
    try:
        failed = [condition for condition in method.existence(plant) if not condition.holds]
    except PreconditionError:
        return None
    if not failed or failed[0].unclear or failed[0].name not in _DYNAMIC_OR_MEASURED:
        return None
    try:
        eliminated = eliminate_algebraic_states(plant)
    except PreconditionError:
        return None
    return eliminated if _exists(eliminated.plant, method) else None


def _is_dynamic_or_measured(plant: DescriptorSystem) -> bool:
    """Whether ``[E 0; C Df]`` has full column rank: every state, and every sensor fault, is dynamic or measured."""
    sensor_faults = plant.Df[:, np.any(plant.Df != 0.0, axis=0)]
    stacked = np.block([[plant.E, np.zeros((plant.nx, sensor_faults.shape[1]))], [plant.C, sensor_faults]])
    return bool(decide_rank(stacked).rank == stacked.shape[1])


def _with_input_derivatives(plant: DescriptorSystem) -> tuple[Transformation, tuple[str, ...]] | None:
    """Return the proper form of a plant with derivatives of known inputs as further inputs, and a note for the user."""
    reduced = with_input_derivatives(plant)
    if reduced is None:
        return None
    transformation, names = reduced
    outputs, signals = improper_outputs(plant)
    one = len(outputs) == 1
    note = (
        f"The output{'' if one else 's'} {quoted_names(outputs)} need{'s' if one else ''} the derivative of "
        f"{quoted_names(signals)}: a run on a log forms {quoted_names(names)} by differences from row to row "
        "where the log has no column of that name; C code and FMUs take it as an input."
    )
    return transformation, (note,)


def _exists(plant: DescriptorSystem, method: Method) -> bool:
    try:
        return all(condition.holds for condition in method.existence(plant))
    except PreconditionError:
        return False


def _without_improper_outputs(plant: DescriptorSystem) -> tuple[Transformation | None, tuple[str, ...]]:
    """Return the proper form of a plant without the outputs that need derivatives, and a note.

    ``None`` where no output needs one, or no other output is left.
    """
    outputs, signals = improper_outputs(plant)
    proper_rows = [row for row, name in enumerate(plant.output_names) if name not in outputs]
    if not outputs or not proper_rows:
        return None, ()
    rows = {name: getattr(plant, name)[proper_rows] for name in ("C", "D", "Df", "Dd", "Dw")}
    fewer = plant.replace(output_names=[plant.output_names[row] for row in proper_rows], **rows)
    needs = f"a later sample of {quoted_names(signals)}" if plant.dt else f"the derivative of {quoted_names(signals)}"
    single = len(outputs) == 1
    note = (
        f"The output{'' if single else 's'} {quoted_names(outputs)} need{'s' if single else ''} {needs}: "
        f"{'it is' if single else 'they are'} left out, and the design is for the others."
    )
    try:
        return eliminate_algebraic_states(fewer), (note,)
    except PreconditionError:
        return None, ()
