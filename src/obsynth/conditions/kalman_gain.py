r"""Nikoukhah, Willsky, Levy 1992; Moussa Ali, Zhang 2013: the steady descriptor Kalman gain as an H2 inequality.

``E x(k+1) = A x(k) + B u(k) + w(k)``, ``y(k) = C x(k) + v(k)`` with covariances Q and R of w and v (4); the filter is
``xhat(k+1) = L (A xhat(k) + B u(k)) + K y(k+1)`` with ``L E + K C = I`` (10), (12), and its error (13)

.. math::
    e(k+1) = L A\, e(k) + L w(k) - K v(k+1) .

Every such ``[L K]`` is ``[L0 K0] + S [N1 N2]``, with ``[L0 K0]`` the pseudo-inverse of ``[E; C]`` and ``[N1 N2]`` a
basis of its left null space.  S is an output injection from ``N1 A e + N1 w - N2 v``, and the trace of the steady
covariance of e is a squared H2 norm: least at the Kalman gain (11), and linear matrix inequalities in P, ``Y = P S``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.analysis.existence.condition import Condition
from obsynth.analysis.existence.kalman import kalman_conditions, with_stated_noise, without_unknown_inputs
from obsynth.analysis.existence.shared_noise import shared_noise
from obsynth.analysis.time_varying import as_time_varying
from obsynth.conditions import atoms, lmi
from obsynth.conditions import lazy_cvxpy as cp
from obsynth.conditions.problem import Conditions, Values, design_of, require_data
from obsynth.errors import ObsynthError
from obsynth.numerics.arguments import arguments_checked, require_shape
from obsynth.numerics.arrays import SMALLEST, FloatArray, matrix_or_multiple_of_identity
from obsynth.numerics.norms import output_covariance
from obsynth.numerics.ranks import CANCELLATION_TOLERANCE, covariance_factor
from obsynth.observers.recursive.steady_filter import steady_state_filter
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.plants.transformations.delays import linear_plant
from obsynth.plants.transformations.recovery import Transformation
from obsynth.results.design import ObserverDesign


@arguments_checked
def kalman(
    plant: DescriptorSystem | Transformation,
    *,
    Q: ArrayLike | None = None,
    R: ArrayLike | None = None,
    margin: float = lmi.MARGIN,
) -> Conditions:
    """Return the steady descriptor Kalman gain as the H2 inequalities in P, Y and Z.

    Parameters
    ----------
    plant : DescriptorSystem or Transformation
        Discrete time, no feedthrough of inputs: ``E (ne, nx)``, ``A``, ``C (ny, nx)``; its faults are taken as zero,
        and of its unknown inputs nothing is assumed, as by `obsynth.descriptor_kalman`.
    Q, R : array_like, optional
        Covariances ``(ne, ne)`` and ``(ny, ny)``, or numbers; ``Bw Bw'`` and ``Dw Dw'`` by default, else identities.
    margin : float, optional
        What the inequalities keep to the boundary of the cone.

    Returns
    -------
    Conditions
        Variables ``P (nx, nx)``, ``Y``, ``Z``; the minimum is the trace of the steady covariance; constraints
        ``"(13) stable"`` and ``"(13) covariance"``; data ``L0, K0, N1, N2``, and ``LA, N1A`` in the coordinates ``X``
        of P and Y, in which the covariance of a Kalman filter is the identity: ``S = X P^-1 Y``; gains
        ``L (nx, ne)``, ``K (nx, ny)`` and the ``covariance (nx, nx)`` of the error with them.

    Raises
    ------
    SpecError
        A covariance is malformed, or depends on k.
    PreconditionError
        ``rank [E; C] < nx``, or a plant of another kind.

    Notes
    -----
    ``design`` returns the recursive filter of `obsynth.descriptor_kalman`, whose gains tend to these; where they do
    not, a `VerificationError` says so.

    References
    ----------
    .. [MoussaAli2013] Fault diagnosis for linear time-varying descriptor systems, IFAC ALCOSP 2013, eqs. (4)-(16).
    .. [Nikoukhah1992] Kalman filtering and Riccati equations for descriptor systems, IEEE TAC 37 (9), Lemma 2.4.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(A=[[0.5]], C=[[1.0]], dt=1.0)
    >>> paper = obsynth.conditions.kalman(plant, Q=[[1.0]], R=[[1.0]])
    >>> _ = paper.problem.solve()
    >>> paper.problem.status, sorted(paper.gains())
    ('optimal', ['K', 'L', 'covariance'])
    """
    own = linear_plant(plant).dense()
    conditions = tuple(kalman_conditions(own))
    require_data(conditions, solvers=("detectability",))
    varying, process, sensor = _noisy_plant(own, Q, R)

    design = design_of("kalman", plant, Q, R, (varying, process, sensor))
    return steady_gain(varying, process, sensor, margin=margin, conditions=conditions, design=design)


def steady_gain(
    varying: TimeVaryingDescriptorSystem,
    process: FloatArray,
    sensor: FloatArray,
    *,
    margin: float,
    conditions: Sequence[Condition],
    design: Callable[[dict[str, FloatArray], str], ObserverDesign],
) -> Conditions:
    """Return the inequalities of a plant without unknown inputs, constant matrices, with its covariances."""
    data = _gain_data(varying, process, sensor)
    A, L0, K0, N1, N2, W, V, X = (data[letter] for letter in ("A", "L0", "K0", "N1", "N2", "W", "V", "X"))
    n, nw = len(X), W.shape[1] + V.shape[1]

    P, Z = cp.Variable((n, n), symmetric=True, name="P"), cp.Variable((nw, nw), symmetric=True, name="Z")
    Y = cp.Variable((n, len(N1)), name="Y")
    stable, covariance = atoms.h2(
        data["LA"],
        np.linalg.solve(X, np.hstack([L0 @ W, -K0 @ V])),
        X,
        np.zeros((n, nw)),
        P,
        Z,
        varying.dt,
        Y=Y,
        Cy=-data["N1A"],
        Dy=np.hstack([-N1 @ W, N2 @ V]),
        detectable=True,
        margin=margin,
    )
    constraints = {"(13) stable": stable, "(13) covariance": covariance}

    def gains(values: Values) -> dict[str, FloatArray]:
        S = X @ np.linalg.solve(values["P"], values["Y"])
        L, K = L0 + S @ N1, K0 + S @ N2
        driven = np.hstack([L @ W, -K @ V])
        return {"L": L, "K": K, "covariance": output_covariance(L @ A, driven, np.eye(n), np.zeros((n, nw)))}

    return Conditions(
        "Moussa Ali, Zhang 2013, (10)-(13): steady Kalman gain as an H2 inequality",
        lmi.semidefinite_problem(cp.Minimize(cp.trace(Z)), list(constraints.values())),
        {"P": P, "Y": Y, "Z": Z},
        {},
        data,
        constraints,
        lambda: conditions,
        gains,
        design,
    )


def _gain_data(varying: TimeVaryingDescriptorSystem, process: FloatArray, sensor: FloatArray) -> dict[str, FloatArray]:
    """Return the data of the inequalities: all ``[L K]`` with (12), and the error system in coordinates X."""
    E, A, C = varying.E.at(1), varying.A.at(0), varying.C.at(1)
    ne, n = E.shape
    H = np.vstack([E, C])
    inverse, null = np.linalg.pinv(H), np.linalg.svd(H)[0][:, n:].T
    L0, K0, N1, N2 = inverse[:, :ne], inverse[:, ne:], null[:, :ne], null[:, ne:]
    X = _coordinates(varying, process, sensor)
    data = {"E": E, "A": A, "C": C, "L0": L0, "K0": K0, "N1": N1, "N2": N2}
    data |= {"LA": np.linalg.solve(X, L0 @ A @ X), "N1A": N1 @ A @ X, "X": X, "Q": process, "R": sensor}
    return data | {"W": covariance_factor(process, "Q"), "V": covariance_factor(sensor, "R")}


def _noisy_plant(own: DescriptorSystem, Q: Any, R: Any) -> tuple[TimeVaryingDescriptorSystem, FloatArray, FloatArray]:
    """Return the plant without unknown inputs, with covariances of its equations and of its outputs."""
    shared = shared_noise(own, Q=Q, R=R)
    own = own if shared is None else shared.plant
    options = with_stated_noise(own, {"Q": Q, "R": R})
    q = 1.0 if options["Q"] is None else options["Q"]
    if own.nd:
        reduced = without_unknown_inputs(own)
        varying, q = reduced.plant, reduced.process_covariance(q)
    else:
        varying = as_time_varying(own)
    process = _covariance(q, varying.ne, "Q")
    return varying, process, _covariance(1.0 if options["R"] is None else options["R"], varying.ny, "R")


def _covariance(covariance: Any, size: int, name: str) -> FloatArray:
    matrix = matrix_or_multiple_of_identity(covariance, size, name)
    require_shape(matrix.shape, (size, size), name)
    return matrix


def _coordinates(varying: TimeVaryingDescriptorSystem, process: FloatArray, sensor: FloatArray) -> FloatArray:
    """Return a state change ``(nx, nx)`` in which solvers do not stall: a square root of a Riccati solution."""
    try:
        values, vectors = np.linalg.eigh(steady_state_filter(varying, Q=process, R=sensor).P)
    except (ObsynthError, np.linalg.LinAlgError):
        return np.eye(varying.nx)
    if not values[-1] > SMALLEST:
        return np.eye(varying.nx)
    return np.asarray(vectors * np.sqrt(np.maximum(values, CANCELLATION_TOLERANCE * values[-1])))
