"""Public functions of the method ``ui-pi-observer``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from numpy.typing import ArrayLike

from obsynth.analysis.transformations.recovery import Transformation
from obsynth.methods.designing import design, design_of_given_gains
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import ObserverDesign


def ui_pi_observer(
    plant: DescriptorSystem | Transformation,
    *,
    fault_model: Any = "step",
    poles: Sequence[Any] | None = None,
    decay: float | None = None,
    region: Mapping[str, float] | None = None,
    noise: Mapping[str, Any] | None = None,
    objective: str = "conditioning",
    joint: bool = False,
    E_sharp: ArrayLike | None = None,
    C_sharp: ArrayLike | None = None,
    G: ArrayLike | None = None,
    solver: str = "CLARABEL",
    name: str = "design",
) -> ObserverDesign:
    r"""Design an unknown-input PI observer: state and faults, untouched by any unknown input.

    The estimates converge to the state and to every fault that follows its model, whatever the unknown inputs do.
    Without poles, decay or region: the fastest Kalman gain, up to the median speed of the plant's own modes, that
    costs no fault estimate more than ten times the noise of the quietest one.  The units of the data play no role: they
    are chosen by the plant itself, and undone in the gains.

    Parameters
    ----------
    plant : DescriptorSystem or Transformation
        Either time, ``E (nx, nx)``, ``C (ny, nx)``, ``Bf (nx, nf)``, ``Bd (nx, nd)``, ``Df, Dd, D`` allowed; it need
        be neither regular nor of index 1.
    fault_model : str, mapping or FaultModel, optional
        How faults run: ``"step"``, ``"ramp"``, ``"parabola"``, ``{"polynomial": order}``, ``{"sinusoid": rad/s}``,
        ``{"exponential": 1/s}``, ``{"Phi": ..., "Cw": ...}``, ``{"sum": [...]}``; one for all, or by fault name.
    poles : sequence, optional, 1/s (dimensionless for ``dt > 0``)
        Movable poles: numbers, complex numbers or ``[re, im]``; any multiplicity.  Fixed ones are not listed.
    decay : float, optional, 1/s
        A Kalman gain all of whose movable poles decay at this rate or faster; 0 is the plain Kalman gain.
    region : mapping, optional
        ``decay`` (1/s), ``radius`` (1/s), ``damping`` (ratio): movable poles by a matrix inequality, with little noise;
        where there are many (20), those that a Kalman gain of this rate has inside already stay there.  Without
        ``decay``: that of the default, where it can be had (at most half the radius).
    noise : mapping, optional
        Weights of the Kalman gain: ``measurement`` (standard deviation: one, a list, or by output; the plant's own
        noise by default), ``process`` and ``fault`` (drive of states and fault models, relative to the default,
        dimensionless).
    objective : {"conditioning", "gain"}, optional
        What to make of the freedom that ``poles`` leaves.
    joint : bool, optional
        Design K and the free part of the decoupling (the paper's G) together; the fault estimates may then see the
        outputs directly.
    E_sharp, C_sharp, G : array_like, optional
        The paper's ``(nx, nx)``, ``(nx, ny)``, ``(nx, ny)`` of (10), (11), instead of our decoupling.
    solver : {"CLARABEL", "SCS"}, optional
        Semidefinite solver, for ``region``.
    name : str, optional
        Name of the design.

    Returns
    -------
    ObserverDesign
        ``gains``: ``U_a, D_a, K_a, Ahat, Bhat, Jhat`` of the augmented plant, ``Phi, Cw`` of the fault model and,
        unless ``joint``, ``U (nx, nx)``, ``D (nx, ny)``, ``K (nx, ny)``, ``F (nw, ny)``, ``Hhat (nx, nf)``.  Where
        algebraic states had to be eliminated, ``plant`` is the plant without them and ``recovery`` the way back.

    Raises
    ------
    SpecError
        A malformed option or fault model, or one too fast for the samples; poles of the wrong count, not stable, or
        not closed under conjugation.
    PreconditionError
        (D1), (D2) or (D3) fails: the eigenvalue, and the fault and disturbance that mask each other, are named.
    SolverError
        Poles could not be placed, or the solver found nothing: nothing is known.
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
    """
    return design(
        plant,
        "ui-pi-observer",
        name=name,
        fault_model=fault_model,
        poles=poles,
        decay=decay,
        region=region,
        noise=noise,
        objective=objective,
        joint=joint,
        E_sharp=E_sharp,
        C_sharp=C_sharp,
        G=G,
        solver=solver,
    )


def ui_pi_observer_from_gains(
    plant: DescriptorSystem | Transformation,
    *,
    U: ArrayLike,
    D: ArrayLike,
    K: ArrayLike,
    F: ArrayLike,
    fault_model: Any = "step",
    name: str = "design from gains",
) -> ObserverDesign:
    """Put gains from a paper or another program into a design, with its report; nothing is refused.

    Parameters
    ----------
    plant : DescriptorSystem or Transformation
        As for `ui_pi_observer`.
    U, D, K, F : array_like
        ``(nx, nx)``, ``(nx, ny)``, ``(nx, ny)`` of eqs. (11), (12), and ``(nw, ny)`` of (23).
    fault_model : str, mapping or FaultModel, optional
        As for `ui_pi_observer`.
    name : str, optional
        Name of the design.

    Returns
    -------
    ObserverDesign
        Its report may hold failed checks: look at ``report.passed``, or call `obsynth.verify` with the number of
        printed digits (dimensionless).

    Raises
    ------
    SpecError
        A gain has the wrong shape, or the fault model is malformed.

    References
    ----------
    .. [SharePasand] Unknown Input-Proportional Integral Observer for Singular Systems, eqs. (4), (19)-(23).
    """
    from obsynth.methods.ui_pi_observer.synthesis import synthesis_from_gains

    synthesis = partial(synthesis_from_gains, U=U, D=D, K=K, F=F, fault_model=fault_model)
    return design_of_given_gains(plant, "ui-pi-observer", synthesis, name=name)
