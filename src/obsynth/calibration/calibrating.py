"""Fitting a model's constants and noise to a log: the public function, and the order in which it asks.

Linear descriptor plants for calibration: constants in their matrices, continuous, discrete, or varying with k.

An algebraic equation of a discrete plant (a row of zeros in E) is taken with the state it constrains, one sample later.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.calibration.diagnostics import STANDS_OUT, BoolArray, standing_out, wrong_samples
from obsynth.calibration.innovations_fit import InnovationsFit, Timing, chosen_timing, innovations_fit
from obsynth.calibration.logs import TOLD_ROWS, Log, LogData, read_log, refused
from obsynth.calibration.noise_proposals import proposed_states
from obsynth.calibration.noise_states import SIZED_SAMPLES, NoiseStates, PlantWithNoise, asked_states, with_states
from obsynth.calibration.plants import CalibrationPlant, NonlinearPlant
from obsynth.calibration.problem import Problem, calibration_problem, require_variation
from obsynth.calibration.reporting import IntegrationError, integration_error, reported
from obsynth.calibration.result import Calibration
from obsynth.calibration.simulation_error import FIRST_ROWS, Fit, SimulationError, simulation_fits, with_seen_start
from obsynth.calibration.wrong_runs import wrong_runs
from obsynth.errors import PreconditionError, SpecError
from obsynth.numerics.arguments import chosen, is_whole, whole_number
from obsynth.numerics.arrays import SMALLEST, FloatArray, read_only
from obsynth.numerics.ranks import rounding_rank
from obsynth.plants.dae.functions import BUTCHER
from obsynth.plants.dae.model import DAEModel
from obsynth.plants.dae.symbols import symbolic_value
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.sequences import INDEX_NAME, MatrixSequence
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem

#: A discrete plant is stepped as it is.
EXACT_STEP = "exact"
#: The least effect of a state on the outputs, as a share of the largest, by which it is sized.
LEAST_EFFECT = 1e-6
#: What the matrices of varying and of invariant plants are called here; G and L are of constant effects.
MATRIX_LETTERS = {"E": "E", "A": "A", "B": "B", "C": "C", "Phi": "G", "Psi": "L"}
INVARIANT = {"E": "E", "A": "A", "B": "B", "C": "C", "D": "D"}
#: Constant effects of an invariant plant: its faults, then its unknown inputs.
EFFECTS = {"G": ("Bf", "Bd"), "L": ("Df", "Dd")}

Known = Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class _Matrix:
    """A matrix ``(rows, columns)``: from values by name and its signals to symbols; from k to its signals, if any."""

    shape: tuple[int, int]
    symbolic: Callable[[Known, Any], Any]
    recorded: Callable[[int], FloatArray] | None = None

    @property
    def width(self) -> int:
        """Number of signals."""
        return self.shape[0] * self.shape[1] if self.recorded is not None else 0


def _of_sequence(matrix: MatrixSequence) -> _Matrix:
    """Return a matrix that may change with k; one without a formula is a signal."""
    import casadi as ca

    if matrix.entries is not None:
        rows = matrix.entries
        return _Matrix(
            matrix.shape,
            lambda known, _: _dense([[symbolic_value(entry, known) for entry in row] for row in rows], matrix.shape),
        )
    if matrix.is_constant:
        return _Matrix(matrix.shape, lambda known, _: ca.SX(ca.DM(matrix.at(0))))
    return _Matrix(
        matrix.shape,
        lambda known, flat: ca.reshape(flat, *matrix.shape),
        lambda k: np.asarray(matrix.at(k)).ravel(order="F"),
    )


def _dense(rows: Sequence[Sequence[Any]], shape: tuple[int, int]) -> Any:
    import casadi as ca

    return ca.vertcat(*(ca.horzcat(*row) for row in rows)) if all(shape) else ca.SX(*shape)


class LinearPlant(CalibrationPlant):
    """A linear plant in one of three forms; its signals are inputs before and at the row, k, and varying matrices."""

    has_levels = False

    def __init__(self, plant: DescriptorSystem | TimeVaryingDescriptorSystem, log: Log) -> None:
        uncertainty = getattr(plant, "uncertainty", None)
        constants = {} if uncertainty is None else uncertainty.box.constants
        if isinstance(plant, TimeVaryingDescriptorSystem):
            self.matrices = {key: _of_sequence(getattr(plant, name)) for name, key in MATRIX_LETTERS.items()}
            values, effects = {name: float(value) for name, value in plant.constants.items()}, plant.parameter_names
            self.continuous = False
        else:
            entries = {} if uncertainty is None else uncertainty.entries
            self.matrices = {
                key: _with_entries(getattr(plant, name), entries.get(name, ()), uncertainty)
                for name, key in INVARIANT.items()
            }
            for key, both in EFFECTS.items():
                self.matrices[key] = _beside(
                    *(_with_entries(getattr(plant, name), entries.get(name, ()), uncertainty) for name in both)
                )
            values = {name: item.nominal for name, item in constants.items()}
            effects = (*plant.fault_names, *(_own_name(name, plant.fault_names) for name in plant.disturbance_names))
            self.continuous = not plant.is_discrete
        self.state_names = self.equation_names = plant.state_names
        self.nx, self.nu, self.ny = len(plant.state_names), plant.nu, plant.ny
        self.effects = tuple(effects)
        self.unstated = frozenset(self.effects)
        self.unknown_inputs = self.effects[len(self.effects) - len(getattr(plant, "disturbance_names", ())) :]
        self.values = {**values, **dict.fromkeys(self.effects, 0.0)}
        self.units = {**{name: item.unit or "1" for name, item in constants.items()}, **plant.units}
        if unknown := getattr(plant, "disturbance_names", ()):
            self.notes = (
                f"Of the unknown inputs ({', '.join(unknown)}) no bounds are known: the noise of the equations "
                "represents them.",
            )
        self.integrations = tuple(BUTCHER) if self.continuous else (EXACT_STEP,)
        if self.matrices["E"].shape != (self.nx, self.nx):
            raise SpecError(
                "The plant has another number of equations than of states: they do not determine a step, "
                "which a calibration needs.",
                path="E",
            )
        self.late = self._algebraic(log)
        point = plant.operating_point
        self.input_point = np.array([point.get(name, 0.0) for name in plant.input_names])
        self.output_point = np.array([point.get(name, 0.0) for name in plant.output_names])
        self.nominal_state = np.zeros(self.nx)
        first = self.signals(log)
        self.nominal_signals = first[min(1, len(first) - 1)]
        # A linear plant says nothing of the size of its states: the outputs do, so that units change no answer.
        self.state_scales = self.state_deviations = self._sizes(log, first)

    def integration(self, asked: str) -> str:
        """Return Radau unless something else is asked for; a discrete plant is stepped as it is."""
        if self.integrations == (EXACT_STEP,):
            return EXACT_STEP
        return "radau" if asked == "auto" else asked

    def _algebraic(self, log: Log) -> list[int]:
        """Return the rows of E that are zero for every k of the log, of a discrete plant."""
        import casadi as ca

        if self.continuous:
            return []
        matrix = self.matrices["E"]
        if matrix.recorded is not None:
            stack = np.array(
                [matrix.recorded(log.rows[0] + i).reshape(self.nx, self.nx, order="F") for i in range(1, log.samples)]
            )
            return np.flatnonzero(~stack.any(axis=(0, 2))).tolist()
        known = {name: ca.SX.sym(name) for name in (*self.values, INDEX_NAME)}
        E = ca.SX(matrix.symbolic(known, None))
        return [i for i in range(self.nx) if all(E[i, j].is_zero() for j in range(self.nx))]

    def signals(self, log: Log) -> FloatArray:
        """Return inputs before and at each row, its k, and the matrices without a formula ``(n, ns)``."""
        u = log.u - self.input_point
        k = log.rows[0] + np.arange(log.samples, dtype=np.float64)
        parts = [np.vstack([u[:1], u[:-1]]), u, k[:, None]]
        for name, later in self._recorded():
            read = self.matrices[name].recorded
            if read is not None:
                start = log.rows[0] + (0 if later else -1)
                rows = [read(max(start + i, 1 if later and name in ("E", "C") else 0)) for i in range(log.samples)]
                parts.append(np.array(rows))
        return np.hstack(parts)

    def _recorded(self) -> list[tuple[str, bool]]:
        """Return matrices that are signals, with whether at the row itself or at the one before."""
        found = []
        for name, matrix in self.matrices.items():
            if matrix.recorded is None:
                continue
            if name in ("E", "C"):
                found.append((name, True))
                continue
            found.append((name, False))
            if self.late and name in ("A", "B", "G"):
                found.append((name, True))
        return found

    def _at(self, s: Any, t: Any, unknown: Sequence[str]) -> Callable[[str, bool], Any]:
        """Return the function from a matrix's name, and whether at the row itself, to its symbols."""
        import casadi as ca

        place = 2 * self.nu + 1
        flats = {}
        for name, later in self._recorded():
            width = self.matrices[name].width
            flats[name, later] = s[place : place + width]
            place += width
        known = {
            **{name: ca.SX(value) for name, value in self.values.items()},
            **{name: t[i] for i, name in enumerate(unknown)},
        }
        k = s[2 * self.nu]

        def matrix(name: str, later: bool) -> Any:
            # A constant of an invariant plant may have the name of the index.
            here = {INDEX_NAME: k if later else k - 1.0} | known
            return self.matrices[name].symbolic(here, flats.get((name, later)))

        return matrix

    def _constant_effects(self, t: Any, unknown: Sequence[str]) -> Any:
        import casadi as ca

        entries = [t[list(unknown).index(name)] if name in unknown else ca.SX(0.0) for name in self.effects]
        return ca.vertcat(*entries) if entries else ca.SX(0, 1)

    def step(self, unknown: Sequence[str], integration: str) -> tuple[int, Any]:
        """Return stages, and the function from stages, state before, signals, constants and dt to equations."""
        import casadi as ca

        stages = len(BUTCHER[integration]) if self.continuous else 1
        X, x, dt = ca.SX.sym("X", self.nx * stages), ca.SX.sym("x", self.nx), ca.SX.sym("dt")
        s, t = ca.SX.sym("s", self._width()), ca.SX.sym("t", len(unknown))
        at, f = self._at(s, t, unknown), self._constant_effects(t, unknown)
        before, now = s[: self.nu], s[self.nu : 2 * self.nu]
        driven = self._product(at("B", False), before) + self._product(at("G", False), f)
        if self.continuous:
            weights, parts = np.linalg.inv(BUTCHER[integration]), ca.reshape(X, self.nx, stages)
            E, A = at("E", True), at("A", False)
            rows = []
            for i in range(stages):
                rate = (
                    sum(
                        (float(weights[i, j]) * (parts[:, j] - x) for j in range(1, stages)),
                        float(weights[i, 0]) * (parts[:, 0] - x),
                    )
                    / dt
                )
                rows.append(E @ rate - A @ parts[:, i] - driven)
            found = ca.vertcat(*rows)
        else:
            found = at("E", True) @ X - at("A", False) @ x - driven
            if self.late:
                held = -(at("A", True) @ X + self._product(at("B", True), now) + self._product(at("G", True), f))
                for i in self.late:
                    found[i] = held[i]
        return stages, ca.Function("equations", [X, x, s, t, dt], [found])

    def _product(self, matrix: Any, column: Any) -> Any:
        """Return a product that is zero where there are no signals."""
        import casadi as ca

        return matrix @ column if column.numel() else ca.SX.zeros(matrix.shape[0])

    def _width(self) -> int:
        return 2 * self.nu + 1 + sum(self.matrices[name].width for name, _ in self._recorded())

    def outputs(self, unknown: Sequence[str]) -> Any:
        """Return the function from state, signals and constants to y, H and L."""
        import casadi as ca

        x, s, t = ca.SX.sym("x", self.nx), ca.SX.sym("s", self._width()), ca.SX.sym("t", len(unknown))
        at, f = self._at(s, t, unknown), self._constant_effects(t, unknown)
        y = at("C", True) @ x + self._product(at("L", False), f) + ca.DM(self.output_point)
        if "D" in self.matrices:
            y = y + self._product(at("D", True), s[self.nu : 2 * self.nu])
        parts = [y, ca.jacobian(y, x), ca.jacobian(y, t)]
        return ca.Function("outputs", [x, s, t], [ca.densify(part) for part in parts])

    def _sizes(self, log: Log, signals: FloatArray) -> FloatArray:
        """Return how large each initial state can be ``(nx,)``: so that alone it makes outputs as large as they are."""
        import casadi as ca

        stages, equations = self.step((), self.integrations[0])
        X, x, s = ca.SX.sym("X", self.nx * stages), ca.SX.sym("x", self.nx), ca.SX.sym("s", signals.shape[1])
        found = equations(X, x, s, ca.SX(0, 1), log.dt)
        both = ca.Function("both", [s], [ca.densify(ca.jacobian(found, X)), ca.densify(ca.jacobian(found, x))])
        outputs = self.outputs(())
        y = log.y - self.output_point
        large = np.sqrt(np.nanmean(y**2, axis=0))
        large = np.where(large > 0.0, large, 1.0)[:, None]
        reach, effects = np.eye(self.nx), np.zeros(self.nx)
        for i, row in enumerate(signals[:SIZED_SAMPLES]):
            if i:
                J, before = (np.array(part) for part in both(row))
                if not np.isfinite(J).all() or rounding_rank(J / np.maximum(np.abs(J).max(), SMALLEST)) < self.nx:
                    raise refused(
                        "undetermined-step",
                        "The equations of a step do not determine the state: a discrete "
                        "plant needs its algebraic equations as rows without x(k+1), and index one. "
                        "Eliminate algebraic states first.",
                        signals=list(self.state_names),
                    )
                reach = -np.linalg.solve(J, before) @ reach
            H = np.array(outputs(np.zeros(self.nx), row, np.zeros(0))[1])
            effects = np.maximum(effects, (np.abs(H @ reach) / large).max(axis=0, initial=0.0))
        effects = np.maximum(
            np.nan_to_num(effects), LEAST_EFFECT * max(float(np.nanmax(effects, initial=0.0)), SMALLEST)
        )
        return np.asarray(1.0 / effects)


def _with_entries(matrix: FloatArray, entries: Sequence[tuple[int, int, str]], uncertainty: Any) -> _Matrix:
    import casadi as ca

    def symbolic(known: Known, _: Any) -> Any:
        found = ca.SX(ca.DM(np.asarray(matrix, dtype=np.float64)))
        for row, column, text in entries:
            found[row, column] = known[text] if text in known else symbolic_value(uncertainty.parsed(text), known)
        return found

    return _Matrix((matrix.shape[0], matrix.shape[1]), symbolic)


def _beside(one: _Matrix, two: _Matrix) -> _Matrix:
    """Return two matrices with as many rows side by side."""
    import casadi as ca

    shape = (one.shape[0], one.shape[1] + two.shape[1])
    return _Matrix(shape, lambda known, _: ca.horzcat(one.symbolic(known, None), two.symbolic(known, None)))


def _own_name(name: str, taken: Sequence[str]) -> str:
    """Return the name of an unknown input, which a fault may have too."""
    return f"unknown input {name}" if name in taken else name


def plant_as_written(given: Any) -> Any:
    """Return the plant whose matrices hold the constants: that before elimination and sampling, if there were any."""
    plant = getattr(given, "source", given)
    uncertainty = getattr(plant, "uncertainty", None)
    if uncertainty is None or not uncertainty.steps:
        return plant
    made = getattr(plant, "_made_from", None)
    if made is None:
        raise SpecError(
            "Elimination or sampling has mixed the constants of this plant: give the plant as it was written.",
            path="model",
        )
    return made[0]


#: How often samples that stand out are left out: each time the others are known better.
OUTLIER_ROUNDS = 3
#: What is said of an offset without which the model follows nothing.
OFFSET_TAKEN = "Without an offset of the sensor {} the model does not follow the log: a state stands for it."
METHODS = ("innovations", "simulation")
INTEGRATIONS = ("auto", "backward-euler", "radau")
#: Two sample times are the same within this share.
SAME_TIME = 1e-6


def calibrate(
    model: DAEModel | DescriptorSystem | TimeVaryingDescriptorSystem,
    log: LogData,
    unknown: Mapping[str, Sequence[float]],
    *,
    priors: Mapping[str, Sequence[float]] | None = None,
    noisy: Sequence[str] | None = None,
    R: Mapping[str, float | None] | None = None,
    Q: Mapping[str, float | None] | None = None,
    initial_state: ArrayLike | Mapping[str, float] | None = None,
    initial_covariance: ArrayLike | Mapping[str, float] | None = None,
    rows: str | slice | Sequence[int] | None = None,
    columns: Mapping[str, str] | None = None,
    scales: Mapping[str, float] | None = None,
    dt: float | None = None,
    input_delay: int | str = "auto",
    method: str = "innovations",
    integration: str = "auto",
    substeps: int = 1,
    level: float = 0.95,
    starts: int = 3,
    seed: int = 0,
    sensor_noise: Mapping[str, Any] | None = None,
    offset: Mapping[str, Any] | Sequence[str] | None = None,
    walks: Mapping[str, Any] | Sequence[str] | None = None,
    progress: Callable[[str], object] | None = None,
) -> Calibration:
    r"""Fit constants and noise covariances of a plant to a log of rows without faults.

    The start is a least-squares fit of simulations.  Then the likelihood of the innovations is made greatest,

    .. math::
        -\log p = \tfrac12 \sum_k e_k^T S_k^{-1} e_k + \log\det 2 \pi S_k , \qquad
        S_k = H_k P_k^- H_k^T + R ,

    over constants, Q and R, by the recursion that the observers run, with exact gradients.

    Parameters
    ----------
    model : DAEModel, DescriptorSystem or TimeVaryingDescriptorSystem
        ``nx`` states, ``nu`` inputs, ``ny`` outputs.  Linear plants hold their constants in entries that are
        expressions (`obsynth.uncertain_system`, or texts of a time-varying plant); constant faults and parameters may
        be unknown too.  Their signals are deviations from the operating point, of which logs know nothing; ``k`` is
        the row of the log.
    log : path, pandas.DataFrame or mapping
        CSV or Parquet file, or columns by name: ``time`` in seconds, every input and every output; NaN where an output
        is missing.  Single outputs a hundred times further off than the others count as missing, which is told.
    unknown : mapping of str to (low, high)
        Constants and parameters that are to be found, with finite bounds around their nominal values; none (``{}``)
        to find the noise alone.
    priors : mapping of str to (mean, deviation), optional
        What is known of them besides, as normal distributions.
    noisy : list of str, optional
        Equations to whose right sides noise is added in each step; all by default.
    R, Q : mapping of str to float, optional
        Variances that are known, by sensor and by noisy equation; the others are found.
    initial_state : array_like or mapping, optional
        ``(nx,)``, or values by name; by default nominal values, of linear plants zero.
    initial_covariance : array_like or mapping, optional
        ``(nx, nx)``, one variance, or variances by name.  By default deviations are 10 % of the nominal
        sizes, or as far as the log begins elsewhere (which is told); of linear plants, what alone would make outputs as
        large as they are.
    rows : str, slice or pair, optional
        ``"a:b"``: the rows that are free of faults, as Python counts; all by default.
    columns : mapping of str to str, optional
        Column of a signal, or of ``time``, where the names differ.
    scales : mapping of str to float, optional
        What a column is multiplied by to be in the signal's unit.
    dt : float, optional
        Seconds between rows; the median of the stamps by default.
    input_delay : int or "auto", optional
        Rows by which the log's inputs act later than the convention says: ``u(k)`` during the step that ends at k, of
        linear plants during the one that begins there.  ``"auto"`` takes the delay of which the likelihood is clearly
        better, such as 1 of a log that writes what is sent at k: up to 3 are tried, and more while the last is best.
    method : {"innovations", "simulation"}, optional
        The second one stops at the fit of simulations, whose boxes are too small where its residuals are not white.
    integration : {"auto", "backward-euler", "radau"}, optional
        ``"auto"`` takes backward Euler unless its error of one step exceeds a quarter of a sensor's deviation, or exact
        steps would move a constant by half of its deviation; for linear plants in continuous time Radau.  Discrete
        plants are stepped as they are.
    substeps : int, optional
        Steps in a sample.
    level : float, optional
        Probability of the box, for all constants at once.
    starts : int, optional
        Fits of simulations, from the nominal constants and from random ones.
    seed : int, optional
        Of those.
    sensor_noise : mapping, optional
        ``{y: {"correlation": seconds or "unknown"}}``: outputs whose noise is coloured, as in `with_noise`; white
        noise is found beside it.  ``{}`` says that all noise is white.  By default coloured noise is taken where the
        innovations ask for it and the likelihood says so, which is told.
    offset : mapping or list of str, optional
        Outputs with an offset that is not known; ``{}`` says that there is none.  By default as for ``sensor_noise``.
    walks : mapping or list of str, optional
        Unknown inputs, faults and parameters that walk at random; inputs of a nonlinear plant that no log holds.
        Unknown inputs of linear plants by default as for ``sensor_noise``.
    progress : callable, optional
        Called with the name of each stage.

    Returns
    -------
    Calibration
        Nominal values, box, undetermined directions, Q and R, checks of the innovations, and a verdict.

    Raises
    ------
    SpecError
        A name, a bound or an option is wrong; or the log is (``code``: ``irregular``, ``time``, ``nan``,
        ``too-short``).
    PreconditionError
        ``not-exciting``: nothing moves.  ``explains-nothing``: the model cannot follow the log, for example as units
        are off by 1000.  ``cannot-simulate``: it has no solution along the log's inputs.  ``undetermined-step``: a
        step of a linear plant does not determine its state.

    References
    ----------
    .. [Ljung1999] L. Ljung, System Identification, 2nd ed., 1999, 7.2 and 10.1: prediction errors and their gradients.
    .. [Chung2013] Y. Chung et al., "A nondegenerate penalized likelihood estimator for variance parameters",
       Psychometrika 78, 2013: the weight that keeps variances from zero, which we give only to those that the log
       cannot distinguish from it.
    """
    chosen(method, "method", METHODS)
    chosen(integration, "integration", INTEGRATIONS)
    if not isinstance(level, (int, float)) or not 0.0 < level < 1.0:
        raise SpecError(f"level is {level!r}: give a probability, such as 0.95.", path="level")
    starts = whole_number(starts, "starts")
    if input_delay != "auto" and not is_whole(input_delay):
        raise SpecError(f"input_delay is {input_delay!r}: give whole rows, or 'auto'.", path="input_delay")
    note = progress or (lambda text: None)
    model = _loads_as_parameters(require_plant(model), walks)
    factors = dict(getattr(model, "scales", {})) | dict(scales or {})
    whole = read_log(
        log,
        model.input_names,
        model.output_names,
        rows=rows,
        columns=columns,
        scales=factors,
        dt=_sample_time(model, dt, substeps),
    )
    digest = whole.digest
    whole = whole.without(wrong_samples(whole.y))
    whole = whole.shifted(input_delay) if isinstance(input_delay, int) else whole
    plant = NonlinearPlant(model) if isinstance(model, DAEModel) else LinearPlant(model, whole)
    asked = asked_states(sensor_noise, offset, walks, model.output_names)

    def problem_with(states: NoiseStates, log: Log) -> Problem:
        extended = with_states(plant, states, log)
        return calibration_problem(
            extended,
            log,
            unknown=unknown,
            priors=priors,
            noisy=_noisy(extended, noisy),
            Q=Q,
            R=R,
            initial_state=_by_name(initial_state, plant.state_names),
            initial_covariance=_by_name(initial_covariance, plant.state_names),
            substeps=substeps,
            integration=plant.integration(integration),
        )

    problem = problem_with(asked, whole)
    require_variation(problem)
    fitting = _Fitting(
        plant, starts, seed, level, note, integration == "auto", initial_covariance is None, method == "innovations"
    )
    timing = Timing(input_delay if isinstance(input_delay, int) else 0, {})
    search = method == "innovations" and input_delay == "auto" and bool(model.input_names)
    offsets: tuple[str, ...] = ()
    try:
        found = fitting.fitted(problem, timing, search=search)
    except PreconditionError as error:
        # An offset as large as what a sensor does looks like a model that explains nothing.
        if offset is not None or method != "innovations" or error.condition != "explains-nothing":
            raise
        offsets = tuple(model.output_names)
        asked = replace(asked, offsets=offsets)
        try:
            found = fitting.fitted(problem_with(asked, whole), timing, search=search)
        except PreconditionError:
            raise error from None
        found = replace(found, problem=found.problem.with_notes(*map(OFFSET_TAKEN.format, offsets)))
    found = fitting.without_outliers(found)
    open_kinds = tuple(
        kind for kind, given in (("coloured", sensor_noise), ("offset", offset), ("walk", walks)) if given is None
    )
    if found.fit is not None and open_kinds:
        states, told = proposed_states(
            found.problem, found.fit, asked, open_kinds, lambda states: problem_with(states, found.problem.log), note
        )
        if told:
            told = [*map(OFFSET_TAKEN.format, offsets), *told]
            found = fitting.fitted(problem_with(states, found.problem.log), found.timing, search=False)
            # What is white beside coloured noise is less than both: more samples stand out.
            found = fitting.without_outliers(replace(found, problem=found.problem.with_notes(*told)))
    return reported(
        found.problem, found.fits[0], found.fit, level=level, timing=found.timing, error=found.error, digest=digest
    )


def _loads_as_parameters(model: Any, walks: Mapping[str, Any] | Sequence[str] | None) -> Any:
    """Return a nonlinear plant whose inputs that walk are parameters: no log holds them."""
    if not isinstance(model, DAEModel) or not (loads := [name for name in walks or () if name in model.inputs]):
        return model
    inputs = {name: value for name, value in model.inputs.items() if name not in loads}
    return model.replace(inputs=inputs, parameters={**model.parameters, **{name: model.inputs[name] for name in loads}})


def _noisy(plant: CalibrationPlant, asked: Sequence[str] | None) -> Sequence[str] | None:
    """Return the noisy equations: those asked for, and those of further states that noise drives."""
    if not isinstance(plant, PlantWithNoise):
        return asked
    own = plant.inner.equation_names if asked is None else tuple(asked)
    return (*own, *plant.noisy)


def _by_name(value: Any, names: Sequence[str]) -> Any:
    """Return what is said of the plant's own states by their names, where it is an array: others may follow."""
    if value is None or isinstance(value, Mapping) or np.ndim(value) == 0:
        return value
    array = np.asarray(value, dtype=np.float64)
    if array.shape == (len(names),):
        return dict(zip(names, array.tolist(), strict=True))
    if array.shape == (len(names), len(names)) and not np.any(array - np.diag(np.diag(array))):
        return dict(zip(names, np.diag(array).tolist(), strict=True))
    return value


@dataclass(frozen=True, eq=False)
class _Found:
    """A problem as it was fitted at last, with its fits, its timing, and what backward Euler errs."""

    problem: Problem
    fits: list[Fit]
    fit: InnovationsFit | None
    timing: Timing
    error: IntegrationError | None


@dataclass(frozen=True, eq=False)
class _Fitting:
    """How a problem is fitted: simulations first, steps that are exact enough, timing, then the innovations."""

    plant: CalibrationPlant
    starts: int
    seed: int
    level: float
    note: Callable[[str], object]
    choose_steps: bool
    widen_start: bool
    innovations: bool

    def fitted(self, problem: Problem, timing: Timing, *, search: bool) -> _Found:
        """Return the fit of a problem; the timing is searched for where asked."""
        fits = simulation_fits(problem, self.starts, self.seed, self.note)
        if self.widen_start and (seen := with_seen_start(problem, fits[0])) is not problem:
            problem, fits = seen, simulation_fits(seen, 1, self.seed, self.note, start=fits[0].t)
        error = None
        if self.choose_steps and isinstance(self.plant, NonlinearPlant):
            error = _step_error(problem, self.plant, fits[0])
            if error is not None and error.matters:
                self.note("integrating by Radau")
                problem = problem.integrated("radau", problem.substeps)
                fits = simulation_fits(problem, self.starts, self.seed, self.note)
        if search:
            problem, fits, timing = chosen_timing(problem, fits, self.seed, self.note, any_start=self.widen_start)
        fit = None
        if self.innovations:
            before = problem, error
            problem, fit, error = _innovations(problem, fits, self.level, self.note, error)
            if self.widen_start and fit is not None:
                seen = with_seen_start(before[0], fits[0], first=fit.whitened[:FIRST_ROWS])
                if seen is not before[0]:
                    fits = simulation_fits(seen, 1, self.seed, self.note, start=fits[0].t)
                    problem, fit, error = _innovations(seen, fits, self.level, self.note, before[1])
        return _Found(problem, fits, fit, timing, error)

    def without_outliers(self, found: _Found) -> _Found:
        """Return the fit again without samples that stand out alone or a few in a row: they would make R a multiple of
        what it is."""
        for _ in range(OUTLIER_ROUNDS):
            if found.fit is None:
                break
            problem = found.problem
            alone = standing_out(np.where(np.isfinite(problem.y), found.fit.whitened, np.nan))
            wrong = alone | wrong_runs(problem, found.fit)
            off = np.abs(found.fit.innovations).T
            if not wrong.any():
                break
            self.note("without samples that stand out")
            names, log = problem.output_names, problem.log
            told = [
                f"Samples of {name} stand out by more than {STANDS_OUT:g} deviations ({_rows(log, wrong[:, i])}): they "
                "count as not measured."
                for i, name in enumerate(names)
                if wrong[:, i].any()
            ]
            kept = replace(
                log,
                y=read_only(np.where(wrong, np.nan, problem.y)),
                notes=(*log.notes, *told),
                outliers=tuple(
                    np.concatenate([before, off[i, alone[:, i]]])
                    for i, before in enumerate(log.outliers or [np.zeros(0)] * len(names))
                ),
            )
            found = self.refitted(replace(found, problem=problem.with_log(kept)))
        return found

    def refitted(self, found: _Found) -> _Found:
        """Return the innovations fitted again, from the constants that were found."""
        problem = found.problem
        fits = simulation_fits(problem, 1, self.seed, self.note, start=None if found.fit is None else found.fit.t)
        problem, fit, error = _innovations(problem, fits, self.level, self.note, found.error)
        return _Found(problem, fits, fit, found.timing, error)


def _rows(log: Log, wrong: BoolArray) -> str:
    rows = log.rows[0] + np.flatnonzero(wrong)
    return f"row {', '.join(map(str, rows[:TOLD_ROWS]))}{', ...' if len(rows) > TOLD_ROWS else ''}"


def _step_error(problem: Problem, plant: NonlinearPlant, fit: Fit) -> IntegrationError | None:
    """Return what backward Euler errs along the best simulation."""
    names, own = problem.names, len(plant.state_names)
    states = SimulationError(problem).states(fit)[:, :own]
    theta = np.array(plant.theta(names, fit.t), dtype=np.float64)
    return integration_error(plant.promoted(names), states, problem.u, theta, fit.deviations, problem.log.dt)


def _innovations(
    problem: Problem, fits: list[Fit], level: float, note: Callable[[str], object], error: IntegrationError | None
) -> tuple[Problem, InnovationsFit | None, IntegrationError | None]:
    """Return the fit, with the steps that it needs: errors of single steps that are small may move constants still."""
    chosen = error is not None and not error.matters
    exact = problem.integrated("radau", problem.substeps) if chosen else None
    fit, moved = innovations_fit(problem, fits, level, note, exact=exact)
    if error is None or exact is None:
        return problem, fit, error
    if fit is None:
        note("integrating by Radau")
        problem, (fit, _) = exact, innovations_fit(exact, fits, level, note)
    return problem, fit, replace(error, moved=moved)


def require_plant(given: Any) -> DAEModel | DescriptorSystem | TimeVaryingDescriptorSystem:
    """Return a plant as written; of a transformation its source."""
    plant = plant_as_written(given)
    if not isinstance(plant, (DAEModel, DescriptorSystem, TimeVaryingDescriptorSystem)):
        raise SpecError(
            f"model is {type(given).__name__}: give a DAEModel, a DescriptorSystem or a TimeVaryingDescriptorSystem.",
            path="model",
        )
    return plant


def _sample_time(model: Any, dt: float | None, substeps: int) -> float | None:
    """Return the time between rows: that of a discrete plant is its own."""
    own = 0.0 if isinstance(model, DAEModel) else float(model.dt)
    if not own:
        return dt
    if dt is not None and abs(dt - own) > SAME_TIME * own:
        raise SpecError(f"dt is {dt:g} s, but a step of this plant takes {own:g} s: leave dt out.", path="dt")
    if substeps != 1:
        raise SpecError(
            "substeps divides the steps of continuous plants, and this one is discrete: leave it out.", path="substeps"
        )
    return own
