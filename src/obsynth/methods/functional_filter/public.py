"""Public function of the method ``functional-filter``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from obsynth.analysis.transformations.recovery import Transformation
from obsynth.methods.designing import design
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import ObserverDesign


def functional_filter(
    plant: DescriptorSystem | Transformation,
    *,
    faults: Sequence[str] | None = None,
    joint: bool = False,
    fault_model: Any = "step",
    fault_rate: float | Mapping[str, float] | None = None,
    delay: int = 0,
    mean: int = 1,
    decay: float | None = None,
    poles: Sequence[Any] | None = None,
    noise: float | Mapping[str, float] | None = None,
    residuals: str | Sequence[Any] | None = None,
    name: str = "design",
) -> ObserverDesign:
    r"""Design a filter that estimates the faults asked for and nothing else, or residuals that show them.

    The unknown inputs are taken out of the plant first, whatever its index; on what is left, whose known inputs are u
    and y, faults are walks of their models and a Kalman gain with correlated noise is chosen.  It exists for every
    plant on which the fault can be told from the rest, also where no observer of the whole state does.

    Parameters
    ----------
    plant : DescriptorSystem or Transformation
        Either time, any index; ``C (ny, nx)``, ``Bf (nx, nf)``, ``Bd (nx, nd)``, ``D, Df, Dd`` allowed.
    faults : sequence of str, optional
        Faults to estimate, all by default.  The others are treated like unknown inputs: no estimate sees them.
    joint : bool, optional
        One filter for all faults asked for: of lower order, and less noisy, but each estimate is free of the other
        faults only where these follow their models.  By default each is free of all others whatever their course.
    fault_model : str, mapping or FaultModel, optional
        How faults run, as for `ui_pi_observer`.
    fault_rate : float or mapping of str to float, optional
        How far each fault walks per sample (per square root of a second for ``dt == 0``), a standard deviation in the
        fault's unit: what noise is weighed against.  By default the slowest walk that shows a step in about the
        plant's own time; see the note of the design.
    delay : int, optional, samples
        Fixed lag: the estimate at k is of the fault at ``k - delay``, with what came after it taken into account.
    mean : int, optional, samples
        How many estimates are averaged; adds ``(mean - 1) // 2`` to the delay.
    decay : float, optional, 1/s
        Every error decays at this rate or faster.
    poles : sequence, optional, 1/s (dimensionless for ``dt > 0``)
        Poles of the filter instead of a Kalman gain, as for `ui_pi_observer`; where several filters are asked for
        (one for each fault, or set of faults), a list of poles for each.
    noise : float or mapping of str to float, optional
        Standard deviation of each output that the gain is for, per sample; what the plant states by default.
    residuals : {"detect", "isolate"} or sequence, optional
        Only residuals, blind to the unknown inputs: one set that sees every fault, one set for each fault that is
        blind to all others, or one for each list of faults to see.
    name : str, optional
        Name of the design.

    Returns
    -------
    ObserverDesign
        An observer without state rows; ``gains`` and the certificate hold ``T (nz, nx)`` and ``T0 (rows, nx)``, which
        prove that neither state, nor u, nor d reaches any estimate.

    Raises
    ------
    SpecError
        An option is malformed, or ``delay`` or ``mean`` are asked for in continuous time.
    PreconditionError
        A fault cannot be told from the rest: what hides it, and which sensors would help, is said.  Or an output has
        no stated noise.
    SolverError
        The Riccati equation has no usable solution, or poles could not be placed.
    VerificationError
        The shipped realisation fails a check.

    References
    ----------
    .. [Frisk] E. Frisk, M. Nyberg, "A minimal polynomial basis solution to residual generation for fault diagnosis in
       linear systems", Automatica 37, 2001: the null space.  Ours: one state-space reduction for any index, fault
       models and walks on it, delay, and the proof by T and T0 on the shipped numbers.
    .. [AndersonMoore] B. Anderson, J. Moore, Optimal Filtering, 1979, ch. 7: the fixed lag.
    """
    return design(
        plant,
        "functional-filter",
        name=name,
        faults=faults,
        joint=joint,
        fault_model=fault_model,
        fault_rate=fault_rate,
        delay=delay,
        mean=mean,
        decay=decay,
        poles=poles,
        noise=noise,
        residuals=residuals,
    )
