"""Public functions of the method ``pd-observer``."""

from __future__ import annotations

from numpy.typing import ArrayLike

from obsynth.errors import SpecError, VerificationError
from obsynth.methods.designing import design_from_gains
from obsynth.numerics.arguments import arguments_checked
from obsynth.results.design import ObserverDesign
from obsynth.results.verification_report import failed_rows


@arguments_checked
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

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(A=[[-1.0, 0.5], [0.0, -2.0]], C=[[1, 0], [0, 1]], Bf=[[1], [0]])
    >>> design = obsynth.pd_observer(plant, decay=2.0)
    >>> obsynth.apply_adaptation_gain(design, [[1.2]]).report.passed
    True
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
