"""One sample of a nonlinear plant as CasADi functions of state, input and unknown constants, with derivatives.

Newton's iterations are not differentiated: the solved stages and their first derivatives enter as numbers, and the
implicit function theorem does the rest.  Machine code where a C compiler is there and the work is long enough.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.files.outputs import working_folder
from obsynth.monitoring.calibration.plants import CalibrationPlant
from obsynth.numerics import lazy_casadi as ca
from obsynth.numerics.arrays import SMALLEST, FloatArray
from obsynth.numerics.graph_equations import largest_entries
from obsynth.observers.nonlinear.c_code import compiler, shared_library

#: Optimisation costs more than it gains on straight code of thousands of lines.
STRAIGHT_CODE_FLAGS = ("-std=c99", "-O1", "-ffp-contract=off", "-shared", "-fPIC")

#: Newton iterations of every step, from the last sample's state, and further ones where the residual is above
#: `SOLVED_STEP`.
ITERATIONS, FURTHER_ITERATIONS = 3, 8

SOLVED_STEP = 1e-11

#: Operations in one evaluation above which functions are compiled: a second or so, before a thousand evaluations.
COMPILED_OPERATIONS = 200_000

#: Libraries that are held: a calibration tries some twenty models of two each, and chooses one of them at last.
HELD_LIBRARIES = 64


def compiled(functions: Sequence[Any]) -> list[Any]:
    """Return the same functions as machine code; as they are where there is no compiler or it fails."""
    command = compiler()
    if command is None:
        return list(functions)
    generator = ca.CodeGenerator("calibration.c")
    for function in functions:
        generator.add(function)
    try:
        return list(
            _loaded(
                generator.dump(), tuple(function.name() for function in functions), (*command, *STRAIGHT_CODE_FLAGS)
            )
        )
    except (SpecError, RuntimeError):  # CasADi, of a folder from which nothing is loaded
        return list(functions)


@lru_cache(maxsize=HELD_LIBRARIES)
def _loaded(code: str, names: tuple[str, ...], command: tuple[str, ...]) -> tuple[Any, ...]:
    """Return functions of C code; the same code is compiled once."""
    with working_folder() as folder:
        library = shared_library(folder, {"calibration.c": code}, command, path="calibrate")
        # What is loaded stays when the file is gone; Windows keeps the file.
        return tuple(ca.external(name, str(library)) for name in names)


@dataclass(frozen=True, eq=False)
class SampleGraphs:
    """The functions of one sample; ``u (nu,)`` are the signals, ``t (nt,)`` the unknown constants."""

    written_solve: Any  # `solve` and `sensitivities` as graphs
    written_sensitivities: Any
    local: Any  # from x, u, t, t and those numbers to the state after, F, G by t, and the noise's way
    outputs: Any  # from x, u, t to y, H and L by t
    nx: int
    nu: int
    ny: int
    nt: int
    numbers: int
    in_c: bool  # whether functions are machine code
    made: dict[Any, Any] = field(default_factory=dict, repr=False)

    @cached_property
    def _solved(self) -> list[Any]:
        # Compiled when it is needed: of a model that is then integrated in another way it is not.
        functions = [self.written_solve, self.written_sensitivities]
        return compiled(functions) if self.in_c else functions

    @property
    def solve(self) -> Any:
        """From x, u, t to the stages of all substeps and the scaled residual that is left."""
        return self._solved[0]

    @property
    def sensitivities(self) -> Any:
        """From x, u, t, stages to what `local` takes as numbers: stages and their derivatives."""
        return self._solved[1]

    @cached_property
    def fast(self) -> Any:
        """`local`, to be evaluated and not to be differentiated."""
        return compiled([self.local])[0] if self.in_c else self.local


def sample_graphs(
    plant: CalibrationPlant, unknown: Sequence[str], dt: float, *, integration: str, substeps: int, samples: int = 1
) -> SampleGraphs:
    """Return the functions of one sample of ``dt`` seconds, in C where there are many."""
    base = _Substep(plant, unknown, dt / substeps, integration)
    nx, nu, nt, n = len(plant.state_scales), len(plant.nominal_signals), len(unknown), base.size
    x, u, t = ca.MX.sym("x", nx), ca.MX.sym("u", nu), ca.MX.sym("t", nt)
    stages: list[Any] = []
    state, residual = x, ca.MX(0.0)
    for _ in range(substeps):
        X, of_substep = base.solve(ca.repmat(state, base.stages, 1), state, u, t)
        stages, state, residual = [*stages, X], X[n - nx :], ca.fmax(residual, of_substep)
    solve = ca.Function("solve", [x, u, t], [ca.vertcat(*stages), residual])

    Z, numbers, state = ca.MX.sym("Z", n * substeps), [x], x
    for i in range(substeps):
        X = Z[n * i : n * (i + 1)]
        numbers += [X, *(ca.vec(part) for part in base.derivatives(X, state, u, t))]
        state = X[n - nx :]
    packed = ca.vertcat(*numbers)
    sensitivities = ca.Function("sensitivities", [x, u, t, Z], [packed])
    outputs = plant.outputs(unknown)
    local = _local(base, substeps, nx, nu, nt)
    return SampleGraphs(
        written_solve=solve,
        written_sensitivities=sensitivities,
        local=local,
        outputs=outputs,
        nx=nx,
        nu=nu,
        ny=outputs.size1_out(0),
        nt=nt,
        numbers=packed.shape[0],
        in_c=8 * samples * local.n_instructions() > COMPILED_OPERATIONS,
    )


def _local(base: _Substep, substeps: int, nx: int, nu: int, nt: int) -> Any:
    """Return the differentiable part: values from the numbers, derivatives from the equations at them."""
    n = base.size
    x, u, t, tc = (ca.SX.sym(name, size) for name, size in (("x", nx), ("u", nu), ("t", nt), ("tc", nt)))
    length = nx + substeps * n * (1 + nx + nt)
    packed = ca.SX.sym("numbers", length)
    before, state, place = packed[:nx], x, nx
    F, G, noise = ca.SX.eye(nx), ca.SX.zeros(nx, nt), ca.SX.zeros(nx, nx)
    for _ in range(substeps):
        X = packed[place : place + n]
        by_x = ca.reshape(packed[place + n : place + n * (1 + nx)], n, nx)
        by_t = ca.reshape(packed[place + n * (1 + nx) : place + n * (1 + nx + nt)], n, nt)
        moved = X + by_x @ (state - before) + by_t @ (t - tc)
        by_x, by_t, way = base.symbolic(moved, state, u, t)
        # What is added to the equations is added during the whole sample, in every substep.
        noise = by_x[n - nx :, :] @ noise + way
        F, G = by_x[n - nx :, :] @ F, by_x[n - nx :, :] @ G + by_t[n - nx :, :]
        state, before, place = moved[n - nx :], X[n - nx :], place + n * (1 + nx + nt)
    return ca.Function("local", [x, u, t, tc, packed], [state, ca.densify(F), ca.densify(G), ca.densify(noise)])


class _Substep:
    """One implicit step: its Newton iteration and its derivatives, by elimination in an order that is fixed."""

    def __init__(self, plant: CalibrationPlant, unknown: Sequence[str], dt: float, integration: str) -> None:
        self.nx, self.dt = len(plant.state_scales), dt
        self.stages, self.function = plant.step(unknown, integration)
        self.size = self.stages * self.nx
        X, x = ca.SX.sym("X", self.size), ca.SX.sym("x", self.nx)
        u, t = ca.SX.sym("u", len(plant.nominal_signals)), ca.SX.sym("t", len(unknown))
        sizes = ca.DM(np.tile(plant.state_scales, self.stages))
        equations = self.function(X, x, u, t, self.dt)
        J = ca.jacobian(equations, X)
        values = np.array([plant.values[name] for name in unknown])
        self.order = _pivots(ca.Function("J", [X, x, u, t], [ca.densify(J)]), plant, self.stages, values)
        step = eliminated(J, -equations, self.order)
        weights = 1.0 / ca.fmax(largest_entries(ca.densify(J) @ ca.diag(sizes)), SMALLEST)
        residual = ca.mmax(ca.fabs(weights * equations)) if self.size > 1 else ca.fabs(weights * equations)
        # The residual is that before the iteration, so that the last one is better than it says.
        self.newton = ca.Function("newton", [X, x, u, t], [X + step, residual])
        self.solve = self._solve()
        derivatives = [ca.densify(part) for part in self.symbolic(X, x, u, t)[:2]]
        self.derivatives = ca.Function("derivatives", [X, x, u, t], derivatives)

    def _solve(self) -> Any:
        """Return the solution of the stages from a start, in as many iterations as it takes."""
        start = [ca.MX.sym(name, self.newton.size1_in(i)) for i, name in enumerate(("X", "x", "u", "t"))]
        X, before = start[0], start[1:]
        for _ in range(ITERATIONS):
            X, residual = self.newton(X, *before)
        X, residual = self.newton(X, *before)
        more, later_residual = start[0], ca.MX(0.0)
        for _ in range(FURTHER_ITERATIONS):
            more, later_residual = self.newton(more, *before)
        further = ca.Function("iterate", start, [more, later_residual])
        done = ca.Function("done", start, [start[0], ca.MX(0.0)])
        choice = ca.Function.if_else("choice", further, done)
        unsolved = ca.logic_not(residual <= SOLVED_STEP)
        after, later_residual = choice(unsolved, X, *before)
        return ca.Function("solution", start, [after, ca.if_else(unsolved, later_residual, residual)])

    def symbolic(self, X: Any, x: Any, u: Any, t: Any) -> tuple[Any, Any, Any]:
        """Return the derivatives of the stages by x and by t, and of the state after by what is added."""
        Xs, xs, us, ts = (ca.SX.sym(name, part.numel()) for name, part in zip("Xxut", (X, x, u, t), strict=True))
        equations, nx, nt = self.function(Xs, xs, us, ts, self.dt), self.nx, ts.numel()
        right = ca.horzcat(
            -ca.jacobian(equations, xs), -ca.jacobian(equations, ts), ca.repmat(ca.SX.eye(nx), self.stages, 1)
        )
        derivatives = eliminated(ca.jacobian(equations, Xs), right, self.order)
        derivatives = ca.Function("found", [Xs, xs, us, ts], [derivatives])(X, x, u, t)
        return derivatives[:, :nx], derivatives[:, nx : nx + nt], derivatives[self.size - nx :, nx + nt :]


def _pivots(jacobian: Any, plant: CalibrationPlant, stages: int, values: FloatArray) -> list[int]:
    """Return the order of rows in which elimination goes at the nominal point."""
    from scipy.linalg import lu_factor

    x = plant.nominal_state
    J = np.array(jacobian(np.tile(x, stages), x, plant.nominal_signals, values))
    J = np.nan_to_num(J * np.tile(plant.state_scales, stages))
    peaks = np.abs(J).max(axis=1)
    _, exchanges = lu_factor(J / np.where(peaks > 0.0, peaks, 1.0)[:, None], check_finite=False)
    order = list(range(len(J)))
    for i, j in enumerate(exchanges):
        order[i], order[j] = order[j], order[i]
    return order


def eliminated(matrix: Any, right: Any, order: Sequence[int]) -> Any:
    """Return ``matrix^-1 right`` by scalar operations, rows in a given order; structural zeros cost nothing."""
    n, m = matrix.shape[0], right.shape[1]
    rows = [[matrix[i, j] for j in range(n)] + [right[i, j] for j in range(m)] for i in order]
    for j in range(n):
        for i in range(j + 1, n):
            if rows[i][j].is_zero():
                continue
            factor = rows[i][j] / rows[j][j]
            for c in range(j + 1, n + m):
                if not rows[j][c].is_zero():
                    rows[i][c] = rows[i][c] - factor * rows[j][c]
    solved: list[list[Any]] = [[]] * n
    for j in reversed(range(n)):
        solution = []
        for c in range(m):
            remainder = rows[j][n + c]
            for i in range(j + 1, n):
                if not (rows[j][i].is_zero() or solved[i][c].is_zero()):
                    remainder = remainder - rows[j][i] * solved[i][c]
            solution.append(remainder if remainder.is_zero() else remainder / rows[j][j])
        solved[j] = solution
    return ca.vertcat(*(ca.horzcat(*row) for row in solved))
