"""Public functions of the method ``pd-observer``."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.analysis.transformations.recovery import Transformation, linear_plant
from obsynth.errors import SpecError, VerificationError
from obsynth.methods.designing import design_from_gains, failed_rows
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.delta_scan import DeltaScan
from obsynth.results.design import ObserverDesign


def apply_adaptation_gain(design: ObserverDesign, adaptation_gain: ArrayLike) -> ObserverDesign:
    """Put a matrix G into the loop of a finished design, and verify it there.

    Parameters
    ----------
    design : ObserverDesign
        Of method ``pd-observer``.
    adaptation_gain : array_like, dimensionless
        G ``(nf, nf)`` of eq. (25): M becomes G M and N becomes G N.  It replaces a G that the design has.

    Returns
    -------
    ObserverDesign
        With a certificate of its own; it claims stability alone.

    Raises
    ------
    SpecError
        A design of another method, or a singular G.
    PreconditionError
        The existence conditions fail.
    VerificationError
        With this G the observer is not stable, or another check fails.

    References
    ----------
    .. [Filasova] Application of descriptor approaches in design of PD observer-based actuator fault estimation,
       eq. (25), whose G is in neither theorem.
    """
    if design.method != "pd-observer":
        raise SpecError(f"A design of method {design.method!r} has no adaptation gain.", path="design")
    gains = design.gains
    letters = {name: gains[name] for name in "JLMN"}
    changed = design_from_gains(
        design.linear[0], design.method, name=design.name, adaptation_gain=adaptation_gain, **letters
    )
    if not changed.report.passed:
        raise VerificationError(
            f"With this adaptation gain the observer fails: {failed_rows(changed.report)}. Give it to pd_observer as "
            "adaptation_gain, so that the design is for it.",
            report=changed.report,
        )
    return changed.replace(recovery=design.recovery)


def pd_delta_scan(
    plant: DescriptorSystem | Transformation,
    delta: ArrayLike,
    *,
    theorem: int = 1,
    decay: float = 0.0,
    solver: str = "CLARABEL",
) -> DeltaScan:
    """Design a PD observer for each delta, and compare decay, gains and noise.

    Parameters
    ----------
    plant : DescriptorSystem or Transformation
        As for `pd_observer`: ``A (nx, nx)``, ``C (ny, nx)``, ``Bf (nx, nf)``.
    delta : array_like, seconds
        Values ``(k,)`` to try.
    theorem : {1, 2}, optional
        As for `pd_observer`.
    decay : float, optional, 1/seconds
        Decay rate imposed for all of them.
    solver : {"CLARABEL", "SCS"}, optional
        Semidefinite solver.

    Returns
    -------
    DeltaScan
        One row per delta, measured on the true error system.

    Raises
    ------
    SpecError
        An option is out of range.
    PreconditionError
        No such observer exists for this plant.

    References
    ----------
    .. [Filasova] Application of descriptor approaches in design of PD observer-based actuator fault estimation,
       Theorems 1 and 2.
    """
    from obsynth.analysis.conditions import require_all
    from obsynth.methods.conic.lmi import chosen_solver
    from obsynth.methods.pd_observer.conditions import explicit_form, pd_observer_conditions
    from obsynth.methods.pd_observer.method import PdObserver
    from obsynth.methods.pd_observer.synthesis import scan_delta

    given: dict[str, Any] = {"theorem": theorem, "decay": decay, "delta_scan": delta, "solver": solver}
    asked = PdObserver(**given)
    chosen_solver(asked.solver, None)
    plant = linear_plant(plant)
    require_all(pd_observer_conditions(plant))
    form = explicit_form(plant)
    return scan_delta(plant if form is None else form.plant, asked, np.ravel(np.asarray(delta)), decay=float(decay))
