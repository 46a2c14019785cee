"""Public functions of the method ``pd-observer``."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.analysis.transformations.recovery import Transformation, linear_plant
from obsynth.errors import SpecError, VerificationError
from obsynth.methods.designing import design as design_by_method
from obsynth.methods.designing import design_of_given_gains, failed_rows
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.delta_scan import DeltaScan
from obsynth.results.design import ObserverDesign


def pd_observer(
    plant: DescriptorSystem | Transformation,
    *,
    theorem: int = 1,
    delta: float | None = None,
    decay: float | None = None,
    disk: ArrayLike | None = None,
    gain_bound: float | None = None,
    fault_rate_gain: float | None = None,
    noise_gain: float | None = None,
    adaptation_gain: ArrayLike | None = None,
    adaptation_range: ArrayLike | None = None,
    delta_scan: ArrayLike | None = None,
    engine: str = "auto",
    solver: str = "CLARABEL",
    name: str = "design",
) -> ObserverDesign:
    r"""Design a PD observer that estimates the states and the faults of a continuous-time plant.

    The estimates of states and slowly varying faults converge to them from any start; what is left is the effect of
    the rate of the faults, of noise and of unknown disturbances, which are not decoupled.

    Parameters
    ----------
    plant : DescriptorSystem or Transformation
        Continuous time (``dt == 0``), ``A (nx, nx)``, ``C (ny, nx)``, ``Bf (nx, nf)``; ``E`` may be singular of index
        1 (its algebraic states are eliminated); feedthrough ``D, Df, Dd`` and noise ``Bw, Dw`` allowed.
    theorem : {1, 2}, optional
        2 takes a symmetric P3, which makes the proportional part of the augmented plant stable as well, and costs
        larger gains.
    delta : float, optional, seconds
        Parameter of the theorem.  It decides which gains are found, not whether there are any (Theorem 1).  By default
        the inverse of the plant's fastest mode, well-damped ones far beyond all others left aside; the engine
        ``"riccati"`` may take less.
    decay : float, optional, 1/seconds
        Errors die out at least like ``exp(-decay t)``.  By default nothing is imposed when the smallest gains give a
        tenth of the plant's fastest mode, else that rate, or as much of it as moderate gains allow; 0 imposes nothing.
    disk : array_like, optional, 1/seconds
        ``[c, r]``: every eigenvalue s of the error system has ``|s + c| < r``.
    gain_bound : float, optional
        Bound on the spectral norm of ``[J L; G M, G N]``, in the user's units.
    fault_rate_gain : float, optional, seconds
        Bound on the l2 gain from the rate of the faults to the fault error.
    noise_gain : float, optional
        Bound on the l2 gain from the noise and its derivative (per second), taken as separate inputs, to the fault
        error; unit noise on every output where the plant states none.
    adaptation_gain : array_like, optional, dimensionless
        G ``(nf, nf)`` of (25), nonsingular: the loop integrates ``G (M e + N e')``, and the design is for it.
    adaptation_range : array_like, optional, dimensionless
        ``[low, high]``: one design that is stable for every ``G = g I`` with g in this range.
    delta_scan : array_like, optional, seconds
        Values of delta to try as well; what they give is in ``design.solver["delta_scan"]`` and in the report.
    engine : {"auto", "lmi", "reduced-lmi", "riccati"}, optional
        How the gains are found.  ``"lmi"`` solves the inequality of the theorem for the smallest gains.
        ``"reduced-lmi"`` solves it without Y and Z, for a reduced-order observer of the states that the outputs do not
        show, and puts gains with L = 0 around it in closed form.  ``"riccati"`` takes gains with L = 0 from a Riccati
        equation, and their certificate from a Lyapunov equation.  The last two give stability and a decay rate alone.
        ``"auto"`` takes the first up to 20 unknown states, or where more is asked, and the last above.  The result's
        ``solver["engine"]`` says which ran.
    solver : {"CLARABEL", "SCS"}, optional
        Semidefinite solver.
    name : str, optional
        Name of the design.

    Returns
    -------
    ObserverDesign
        ``gains``: ``J, L (nx, ny)``, ``M, N (nf, ny)`` and, where asked for, ``G (nf, nf)``.  ``observer`` is the same
        in a form without derivatives; `obsynth.sample_observer` makes it run on samples.  ``certificate.claims``:
        ``theorem``, ``delta``, ``decay`` and the bounds asked for.

    Raises
    ------
    SpecError
        An option is out of range.
    PreconditionError
        A discrete plant, a plant that is not regular or of index 2 or more, ``nf > ny``, dependent faults, a mode that
        neither decays nor shows in the outputs, or ``rank [A Bf; C Df] < nx + nf`` (eq. (3)): a zero at s = 0.
    InfeasibleError
        An unobservable mode is slower than ``decay`` or outside ``disk``; ``noise_gain`` is below what reading a
        constant fault takes; delta cannot serve Theorem 2 or the disk.
    SolverError
        Nothing is known.
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
    """
    return design_by_method(
        plant, "pd-observer", name=name, theorem=theorem, delta=delta, decay=decay, disk=disk, gain_bound=gain_bound,
        fault_rate_gain=fault_rate_gain, noise_gain=noise_gain, adaptation_gain=adaptation_gain,
        adaptation_range=adaptation_range, delta_scan=delta_scan, engine=engine, solver=solver,
    )  # fmt: skip


def pd_observer_from_gains(
    plant: DescriptorSystem | Transformation,
    *,
    J: ArrayLike,
    L: ArrayLike,
    M: ArrayLike,
    N: ArrayLike,
    adaptation_gain: ArrayLike | None = None,
    decay: float = 0.0,
    name: str = "design from gains",
) -> ObserverDesign:
    """Put gains from a paper or another program into a design, with its report; nothing is refused.

    Parameters
    ----------
    plant : DescriptorSystem or Transformation
        As for `pd_observer`.
    J, L, M, N : array_like
        ``(nx, ny)``, ``(nx, ny)``, ``(nf, ny)``, ``(nf, ny)`` of eqs. (4), (6); nx after elimination of algebraic
        states.
    adaptation_gain : array_like, optional, dimensionless
        G ``(nf, nf)`` of eq. (25), inside the loop.
    decay : float, optional, 1/seconds
        Claimed rate.
    name : str, optional
        Name of the design.

    Returns
    -------
    ObserverDesign
        Its certificate is computed from the gains.  Its report may hold failed checks: look at ``report.passed``.

    Raises
    ------
    SpecError
        A gain has the wrong shape, G is singular, or ``I + L C`` is.
    PreconditionError
        No such observer exists for this plant.

    References
    ----------
    .. [Filasova] Application of descriptor approaches in design of PD observer-based actuator fault estimation,
       eqs. (4)-(6), (25).
    """
    from obsynth.methods.pd_observer.synthesis import synthesis_from_gains

    synthesis = partial(
        synthesis_from_gains, gains={"J": J, "L": L, "M": M, "N": N}, adaptation_gain=adaptation_gain, decay=decay
    )
    return design_of_given_gains(plant, "pd-observer", synthesis, name=name)


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
    changed = pd_observer_from_gains(
        design.linear[0], J=gains["J"], L=gains["L"], M=gains["M"], N=gains["N"], adaptation_gain=adaptation_gain,
        name=design.name,
    )  # fmt: skip
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
    from obsynth.methods.pd_observer.conditions import explicit_form, pd_observer_conditions
    from obsynth.methods.pd_observer.options import PdOptions
    from obsynth.methods.pd_observer.synthesis import scan_delta

    given: dict[str, Any] = {"theorem": theorem, "decay": decay, "delta_scan": delta, "solver": solver}
    asked = PdOptions(**given)
    plant = linear_plant(plant)
    require_all(pd_observer_conditions(plant))
    form = explicit_form(plant)
    return scan_delta(plant if form is None else form.plant, asked, np.ravel(np.asarray(delta)), decay=float(decay))
