"""Matrix inequalities that the papers' conditions share, each with its lemma.

``A, B, C, D`` are those of ``e+ = A e + B w``, ``z = C e + D w`` (``e+`` is e' for ``dt = 0``).  For a gain L that is
still to be found, ``A - L Cy`` and ``B - L Dy``, give the variable ``Y = P L`` with ``Cy`` and ``Dy``: then P A stands
for ``P A - Y Cy`` and P B for ``P B - Y Dy`` and everything stays linear.  C and D may be expressions of variables.

Each function returns a list of `cvxpy` constraints.  They are meant strictly: ``margin`` times the identity is kept.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from obsynth.conditions import lmi
from obsynth.conditions.lmi import MARGIN
from obsynth.errors import SpecError, a_kind
from obsynth.numerics.arguments import arguments_checked, real_array, real_number, require_shape
from obsynth.numerics.arrays import require_no_overflow
from obsynth.numerics.regions import LMIRegion, checked_region
from obsynth.plants.dae import DAEModel

if TYPE_CHECKING:
    import cvxpy


#: The same of inequalities that are homogeneous in P, whose scale is free: a margin below the tolerances of solvers
#: keeps nothing, and a feasible P can be as large as one likes.
HOMOGENEOUS_MARGIN = 1.0

#: The same beside inequalities whose scale is fixed: of the size of theirs, since solvers of first order (SCS) take ten
#: times as many steps for a larger one; 1e7 times the tolerances.
BESIDE_MARGIN = 0.1


@arguments_checked
def bounded_real(
    A: Any,
    B: Any,
    C: Any,
    D: Any,
    P: Any,
    gamma: Any,
    dt: float,
    *,
    Y: Any = None,
    Cy: Any = None,
    Dy: Any = None,
    gamma_squared: Any = None,
    detectable: bool = False,
    margin: float = MARGIN,
) -> list[cvxpy.Constraint]:
    r"""Return the bounded real inequality: A is stable and the H-infinity norm from w to z is below gamma.

    .. math::
        \begin{bmatrix} P & 0 & (PA)^T & C^T \\ 0 & \gamma^2 I & (PB)^T & D^T \\ PA & PB & P & 0 \\ C & D & 0 & I
        \end{bmatrix} > 0
        \qquad\text{or, for } dt = 0, \qquad
        \begin{bmatrix} PA + (PA)^T & PB & C^T \\ (PB)^T & -\gamma^2 I & D^T \\ C & D & -I \end{bmatrix} < 0 .

    Parameters
    ----------
    A, B, C, D : array_like or cvxpy.Expression
        ``(n, n)``, ``(n, nw)``, ``(nz, n)``, ``(nz, nw)``; expressions in C and D.
    P : cvxpy.Variable
        ``(n, n)``, symmetric.
    gamma : float
        The level, in units of z over w; ``None`` where ``gamma_squared`` is given.
    dt : float
        0 for continuous time, else seconds.
    Y, Cy, Dy : optional
        ``(n, ny)``, ``(ny, n)``, ``(ny, nw)``: the gain that is still to be found, ``Y = P L``.
    gamma_squared : cvxpy.Expression, optional
        The square of the level, as a variable or a parameter.
    detectable : bool, optional
        True where A is known to be stable, or with Y the pair ``(A, Cy)`` to be detectable: the constraints that ask it
        are left out then.
    margin : float, optional
        What is kept to the boundary of the cone.

    Returns
    -------
    list of cvxpy.Constraint
        ``P > 0``, the inequality, and the two of a matrix of their own that is free in scale, by which some gain makes
        A stable: z and w fix the scale of P, and where neither has a part in a mode, a P that is nothing there would be
        within the tolerance of any solver.

    Raises
    ------
    SpecError
        Shapes that do not fit, or a gamma that is no positive number.

    References
    ----------
    .. [Hsiung1999] K.-L. Hsiung, L. Lee, IEE Proc. Control Theory Appl. 146 (4), 1999: Lemma 3 of Wang et al. 2015,
       after a Schur complement.
    .. [Boyd1994] S. Boyd et al., Linear matrix inequalities in system and control theory, SIAM 1994, section 2.7.3.

    Examples
    --------
    >>> import cvxpy as cp
    >>> import numpy as np
    >>> from obsynth.conditions import bounded_real
    >>> A, B, C, D = (np.array([[value]]) for value in (0.5, 1.0, 1.0, 0.0))
    >>> P, gamma_squared = cp.Variable((1, 1), symmetric=True), cp.Variable()
    >>> constraints = bounded_real(A, B, C, D, P, None, 1.0, gamma_squared=gamma_squared)
    >>> _ = cp.Problem(cp.Minimize(gamma_squared), constraints).solve()
    >>> round(float(gamma_squared.value) ** 0.5, 2)  # the largest gain of 1 / (z - 0.5)
    2.0
    """
    _require_measured(Y, Cy, Dy)
    n, nw, nz = _sizes(A, B, C, D, P)
    pa, pb = _moved(A, P, Y, Cy), _moved(B, P, Y, Dy)
    level = _square(gamma) if gamma_squared is None else _scalar(gamma_squared, "gamma_squared")
    if dt > 0.0:
        inequality = lmi.symmetric_blocks(
            [
                [P],
                [np.zeros((nw, n)), level * np.eye(nw)],
                [pa, pb, P],
                [C, D, np.zeros((nz, n)), np.eye(nz)],
            ]
        )
    else:
        inequality = -lmi.symmetric_blocks([[pa + pa.T], [pb.T, -level * np.eye(nw)], [C, D, -np.eye(nz)]])
    own = [] if detectable else some_gain_stabilises(A, dt, Cy, margin=BESIDE_MARGIN)
    return [lmi.at_least(P, margin), lmi.at_least(inequality, margin), *own]


@arguments_checked
def h2(
    A: Any,
    B: Any,
    C: Any,
    D: Any,
    P: Any,
    Z: Any,
    dt: float,
    *,
    Y: Any = None,
    Cy: Any = None,
    Dy: Any = None,
    detectable: bool = False,
    margin: float = MARGIN,
) -> list[cvxpy.Constraint]:
    r"""Return the H2 inequalities: A is stable and the squared H2 norm from w to z is below the trace of Z.

    .. math::
        \begin{bmatrix} P & (PA)^T & C^T \\ PA & P & 0 \\ C & 0 & I \end{bmatrix} > 0, \qquad
        \begin{bmatrix} Z & (PB)^T & D^T \\ PB & P & 0 \\ D & 0 & I \end{bmatrix} > 0

    or, for ``dt = 0`` and ``D = 0``,

    .. math::
        \begin{bmatrix} PA + (PA)^T & C^T \\ C & -I \end{bmatrix} < 0, \qquad
        \begin{bmatrix} Z & (PB)^T \\ PB & P \end{bmatrix} > 0 .

    Parameters
    ----------
    A, B, C, D : array_like or cvxpy.Expression
        ``(n, n)``, ``(n, nw)``, ``(nz, n)``, ``(nz, nw)``; in continuous time D must be zero.
    P, Z : cvxpy.Variable
        ``(n, n)`` and ``(nw, nw)``, symmetric; minimise ``cvxpy.trace(Z)`` for the least norm.
    dt : float
        0 for continuous time, else seconds.
    Y, Cy, Dy : optional
        ``(n, ny)``, ``(ny, n)``, ``(ny, nw)``: the gain that is still to be found, ``Y = P L``.
    detectable : bool, optional
        As for `bounded_real`.
    margin : float, optional
        What is kept to the boundary of the cone.

    Returns
    -------
    list of cvxpy.Constraint
        The two inequalities, and those by which some gain makes A stable, see `bounded_real`.

    Raises
    ------
    SpecError
        Shapes that do not fit, or a D in continuous time, where the norm is infinite.

    References
    ----------
    .. [Scherer1997] C. Scherer, P. Gahinet, M. Chilali, IEEE TAC 42 (7), 1997, section III.

    Examples
    --------
    >>> import cvxpy as cp
    >>> import numpy as np
    >>> from obsynth.conditions import h2
    >>> A, B, C, D = (np.array([[value]]) for value in (0.5, 1.0, 1.0, 0.0))
    >>> P, Z = cp.Variable((1, 1), symmetric=True), cp.Variable((1, 1), symmetric=True)
    >>> constraints = h2(A, B, C, D, P, Z, 1.0)
    >>> _ = cp.Problem(cp.Minimize(cp.trace(Z)), constraints).solve()
    >>> round(float(Z.value[0, 0]), 3)  # the sum of 0.25 ** k
    1.333
    """
    _require_measured(Y, Cy, Dy)
    n, nw, nz = _sizes(A, B, C, D, P)
    require_shape(_shape(Z), (nw, nw), "Z")
    pa, pb = _moved(A, P, Y, Cy), _moved(B, P, Y, Dy)
    if dt > 0.0:
        first = lmi.symmetric_blocks([[P], [pa, P], [C, np.zeros((nz, n)), np.eye(nz)]])
        second = lmi.symmetric_blocks([[Z], [pb, P], [D, np.zeros((nz, n)), np.eye(nz)]])
    else:
        if np.any(np.asarray(D) if not hasattr(D, "value") else 1.0):
            raise SpecError("D is not zero: in continuous time the H2 norm is infinite then.", path="D")
        first = -lmi.symmetric_blocks([[pa + pa.T], [C, -np.eye(nz)]])
        second = lmi.symmetric_blocks([[Z], [pb, P]])
    own = [] if detectable else some_gain_stabilises(A, dt, Cy, margin=BESIDE_MARGIN)
    return [lmi.at_least(first, margin), lmi.at_least(second, margin), *own]


def region(A: Any, P: Any, where: Any = None, *, Y: Any = None, Cy: Any = None, **options: Any) -> Any:
    """Return the inequality that puts every eigenvalue of A into a region, `eigenvalue_region`; of a nonlinear plant
    and its operating region the inequalities of an observer, `obsynth.conditions.nonlinear_region`.

    Parameters
    ----------
    A : array_like or DAEModel
        ``(n, n)``, or the plant.
    P : cvxpy.Variable or mapping
        ``(n, n)``, or ranges of signals.
    where, Y, Cy, **options
        As those functions take them.

    Returns
    -------
    list of cvxpy.Constraint or Conditions
        Of the one or the other.

    Raises
    ------
    SpecError
        Shapes that do not fit, or options of the other.

    Examples
    --------
    >>> import cvxpy as cp
    >>> import numpy as np
    >>> from obsynth.conditions import disk, region
    >>> len(region(np.array([[0.5]]), cp.Variable((1, 1), symmetric=True), disk(0, 0.6)))
    2
    """
    if isinstance(A, DAEModel):
        from obsynth.conditions.nonlinear_plants import nonlinear_region

        return nonlinear_region(A, P, **options)
    return eigenvalue_region(A, P, where, Y=Y, Cy=Cy, **options)


@arguments_checked
def eigenvalue_region(
    A: Any, P: Any, where: LMIRegion, *, Y: Any = None, Cy: Any = None, margin: float = HOMOGENEOUS_MARGIN
) -> list[cvxpy.Constraint]:
    r"""Return the inequality that puts every eigenvalue of A into a region: ``L x P + M x (PA) + M' x (PA)' < 0``.

    With an eigenvector v of A for z it gives ``v* P v (L + z M + conj(z) M') < 0``.

    Parameters
    ----------
    A : array_like
        ``(n, n)``.
    P : cvxpy.Variable
        ``(n, n)``, symmetric; the inequality does not fix its scale.
    where : LMIRegion
        See `disk`, `half_plane` and `sector`; joined by ``&``.
    Y, Cy : optional
        ``(n, ny)``, ``(ny, n)``: the gain that is still to be found, ``Y = P L``.
    margin : float, optional
        What is kept to the boundary of the cone: by default the identity, as the scale of P is free.  Beside an
        inequality that fixes it (`bounded_real`, `h2`) give a small one.

    Returns
    -------
    list of cvxpy.Constraint
        The inequality, and ``P > 0``.

    Raises
    ------
    SpecError
        Shapes that do not fit, or ``where`` is no region.

    References
    ----------
    .. [Chilali1996] M. Chilali, P. Gahinet, IEEE TAC 41 (3), 1996, Theorem 2.2.

    Examples
    --------
    >>> import cvxpy as cp
    >>> import numpy as np
    >>> from obsynth.conditions import disk, region
    >>> P = cp.Variable((1, 1), symmetric=True)
    >>> problem = cp.Problem(cp.Minimize(cp.trace(P)), region(np.array([[0.5]]), P, disk(0, 0.6)))
    >>> _ = problem.solve()
    >>> problem.status
    'optimal'
    """
    where = checked_region(where, "where")
    _square_matrix(A, P)
    _require_measured(Y, Cy)
    pa = _moved(A, P, Y, Cy)
    k = len(where.L)
    blocks = [[where.L[i, j] * P + where.M[i, j] * pa + where.M[j, i] * pa.T for j in range(i + 1)] for i in range(k)]
    return [lmi.at_least(P, margin), lmi.at_most(lmi.symmetric_blocks(blocks), -margin)]


@arguments_checked
def admissible(
    E: Any, A: Any, P: Any, dt: float, *, Y: Any = None, Cy: Any = None, margin: float = HOMOGENEOUS_MARGIN
) -> list[cvxpy.Constraint]:
    r"""Return the inequality that makes a pair regular, impulse-free and stable.

    .. math::
        E^T P = P^T E \ge 0, \quad P^T A + A^T P < 0 \qquad\text{or, for } dt > 0 \text{ and symmetric } P, \qquad
        E^T P E \ge 0, \quad A^T P A - E^T P E < 0 .

    Parameters
    ----------
    E, A : array_like
        ``(n, n)``; E may be singular.
    P : cvxpy.Variable
        ``(n, n)``; any matrix in continuous time, symmetric in discrete time (and not definite for singular E).
    dt : float
        0 for continuous time, else seconds.
    Y, Cy : optional
        ``(n, ny)``, ``(ny, n)``: the gain that is still to be found, ``Y = P' L``; continuous time only.
    margin : float, optional
        What is kept to the boundary of the cone, in the strict inequality; see `region`.

    Returns
    -------
    list of cvxpy.Constraint
        The equality and the inequalities.

    Raises
    ------
    SpecError
        Shapes that do not fit, or a Y in discrete time, where the product is not linear.

    References
    ----------
    .. [Masubuchi1997] I. Masubuchi et al., Automatica 33 (4), 1997: Lemma 2 of Filasova et al.
    .. [Xu1999] S. Xu, C. Yang, Stabilization of discrete-time singular systems, Automatica 35 (9), 1999.

    Examples
    --------
    >>> import cvxpy as cp
    >>> import numpy as np
    >>> from obsynth.conditions import admissible
    >>> E, A, P = np.diag([1.0, 0.0]), np.array([[-1.0, 0.5], [0.0, 1.0]]), cp.Variable((2, 2))
    >>> problem = cp.Problem(cp.Minimize(cp.norm(P)), admissible(E, A, P, 0.0))
    >>> _ = problem.solve()
    >>> problem.status
    'optimal'
    """
    _require_measured(Y, Cy)
    _square_matrix(A, P)
    require_shape(_shape(E), _shape(A), "E")
    e, a = np.asarray(E, dtype=np.float64), A
    if dt > 0.0:
        if Y is not None:
            raise SpecError("Y is for continuous time: A' P A is not linear in P and Y.", path="Y")
        energy = e.T @ P @ e
        return [lmi.at_least(energy), lmi.at_most(a.T @ P @ a - energy, -margin)]
    moving = P.T @ a if Y is None else P.T @ a - Y @ Cy
    return [P.T @ e == e.T @ P, lmi.at_least(e.T @ P), lmi.at_most(moving + moving.T, -margin)]


def some_gain_stabilises(A: Any, dt: float, Cy: Any, *, margin: float = HOMOGENEOUS_MARGIN) -> list[cvxpy.Constraint]:
    """Return Lyapunov's inequality with a matrix and a gain of its own; free in scale."""
    n = _shape(A)[0]
    Q = lmi.symmetric_variable(n)
    Y = None if Cy is None else lmi.matrix_variable(n, _shape(Cy)[0])
    moved = _moved(A, Q, Y, Cy)
    inequality = lmi.symmetric_blocks([[Q], [moved, Q]]) if dt > 0.0 else -(moved + moved.T)
    return [lmi.at_least(Q, margin), lmi.at_least(inequality, margin)]


def _moved(matrix: Any, P: Any, Y: Any, measured: Any) -> Any:
    """Return ``P matrix``, or ``P matrix - Y measured`` with a gain that is still to be found."""
    if Y is None:
        return P @ matrix
    if measured is None:
        return P @ matrix
    require_shape(_shape(Y), (_shape(P)[0], _shape(measured)[0]), "Y")
    return P @ matrix - Y @ measured


def _require_measured(Y: Any, Cy: Any, Dy: Any = None) -> None:
    """Raise `TypeError` for a gain without the outputs that it multiplies, or outputs without a gain."""
    if (Y is None) != (Cy is None) or (Y is None and Dy is not None):
        raise TypeError("Y, the gain, belongs to Cy (and Dy), the outputs that it multiplies: give both or neither.")


def _square(gamma: Any) -> float:
    level = real_number(gamma, "gamma", "a positive number, or gamma_squared=", above=0.0)
    require_no_overflow(level, "gamma", "gamma")
    return level**2


def _shape(matrix: Any) -> tuple[int, ...]:
    return tuple(matrix.shape) if hasattr(matrix, "shape") else real_array(matrix, "A matrix").shape


def _scalar(value: Any, name: str) -> Any:
    """Return a number, or a scalar expression of cvxpy as it is."""
    return value if hasattr(value, "is_scalar") and value.is_scalar() else real_number(value, name)


def _square_matrix(A: Any, P: Any) -> int:
    shape = _shape(A)
    if len(shape) != 2 or shape[0] != shape[1]:
        raise SpecError(f"A is {shape}: give a square matrix.", path="A")
    if not hasattr(P, "is_symmetric"):
        raise SpecError(f"P is {a_kind(P)}: give a square variable of cvxpy.", path="P")
    require_shape(_shape(P), shape, "P")
    return shape[0]


def _sizes(A: Any, B: Any, C: Any, D: Any, P: Any) -> tuple[int, int, int]:
    """Return n, nw and nz of shapes that fit."""
    n = _square_matrix(A, P)
    shapes = {name: _shape(part) for name, part in (("B", B), ("C", C), ("D", D))}
    for name, shape in shapes.items():
        if len(shape) != 2:
            raise SpecError(f"{name} is {shape}: give a matrix.", path=name)
    nw, nz = shapes["B"][1], shapes["C"][0]
    for name, expected in (("B", (n, nw)), ("C", (nz, n)), ("D", (nz, nw))):
        require_shape(shapes[name], expected, name)
    return n, nw, nz
