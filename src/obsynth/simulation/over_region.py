"""Simulation of polytopic plants along trajectories of their scheduling parameters: many runs at once.

Dynamic and algebraic equations are separated once, as E is the same everywhere.  Discrete plants step by their own
equations.  Continuous ones step by the matrix exponential at the middle of short parts of each interval, which is exact
where the parameters rest, for signals that are constant or linear between samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import PreconditionError, SpecError
from obsynth.numerics.arguments import arguments_checked, is_finite_number, real_array, real_vector, shown
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.continuous import first_order_hold
from obsynth.numerics.ranks import decide_rank
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.simulation.linear import PlantRuns
from obsynth.simulation.profiles import Additive
from obsynth.simulation.scenario import Scenario, profiles_of
from obsynth.simulation.signals import ScenarioSignals, signals_of
from obsynth.simulation.trajectory import Trajectory

#: Parts of an interval in which parameters move: the error of each falls with the cube of its length.
PARTS = 8
#: Rounding of a parameter at the edge of its range, relative to it.
EDGE_SLACK = 1e-12


@arguments_checked
def simulate_polytopic(
    plant: PolytopicSystem,
    *,
    scheduling: ArrayLike,
    u: ArrayLike | None = None,
    f: ArrayLike | None = None,
    d: ArrayLike | None = None,
    w: ArrayLike | None = None,
    initial_state: ArrayLike | None = None,
    sample_time: float | None = None,
) -> Trajectory:
    """Simulate a polytopic plant along a course of its scheduling parameters.

    Parameters
    ----------
    plant : PolytopicSystem
        Of index 0 or 1 along the course.
    scheduling : array_like
        ``(samples, p)``, inside the region.
    u, f, d, w : array_like, optional
        Known inputs, faults, disturbances and noise, ``(samples, size)`` each; zero by default.
    initial_state : array_like, optional
        ``(nx,)``; zero by default.
    sample_time : float, optional, seconds
        Between samples of a continuous plant, whose signals and parameters are constant in between.

    Returns
    -------
    Trajectory
        States and outputs, and what drove them.

    Raises
    ------
    SpecError
        Shapes do not fit, a parameter is outside its range, or the sample time is missing or not wanted.
    PreconditionError
        The equations do not determine the state at some sample.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.PolytopicSystem(plant={"A": [["v"]], "C": [[1]], "dt": 1.0}, scheduling={"v": [0.0, 1.0]})
    >>> obsynth.simulate(plant, scheduling=[[0.5], [0.5], [0.0]], initial_state=[1.0]).outputs.ravel().tolist()
    [1.0, 0.5, 0.25]
    """
    parameters = real_array(scheduling, "scheduling")
    parameters = parameters.reshape(-1, 1) if parameters.ndim == 1 and len(plant.scheduling.names) == 1 else parameters
    if parameters.ndim != 2 or parameters.shape[1] != len(plant.scheduling.names):
        raise SpecError(
            f"scheduling is {parameters.shape}: give (samples, {len(plant.scheduling.names)}), the columns those of "
            f"{', '.join(plant.scheduling.names)}.",
            path="scheduling",
        )
    dt = _sample_time(plant, sample_time)
    require_inside(plant, parameters, dt)
    steps = len(parameters)
    signals = signals_of(plant, steps, u=u, f=f, d=d, w=w)
    start = np.zeros(plant.nx) if initial_state is None else real_vector(initial_state, plant.nx, "initial_state")
    drive = np.hstack([signals["u"], signals["f"], signals["d"]])[:, None]
    states, outputs = region_runs(plant, (parameters, parameters), drive, drive, signals["w"][:, None], start, dt)
    return Trajectory(
        states[:, 0],
        outputs[:, 0],
        signals["u"],
        signals["f"],
        signals["d"],
        signals["w"],
        time=dt * np.arange(steps, dtype=np.float64),
        inconsistency=float(np.linalg.norm(states[0, 0] - start)) if steps and initial_state is not None else 0.0,
    )


def _sample_time(plant: PolytopicSystem, sample_time: float | None) -> float:
    if plant.is_discrete:
        if sample_time is not None and sample_time != plant.dt:
            raise SpecError(f"The plant has dt {plant.dt:g} s: leave sample_time out.", path="sample_time")
        return float(plant.dt)
    if sample_time is None or not (is_finite_number(sample_time) and sample_time > 0.0):
        raise SpecError(
            f"sample_time is {shown(sample_time)}: the plant is continuous, give the seconds between samples.",
            path="sample_time",
        )
    return float(sample_time)


def scheduled_parameters(
    plant: PolytopicSystem, scenario: Scenario, steps: int, dt: float
) -> tuple[FloatArray, FloatArray]:
    """Return the parameters ``(steps, p)`` where each interval begins and where it ends: the middle and profiles."""
    names, scheduling = plant.scheduling.names, plant.scheduling
    middle = (
        np.full(len(names), 1.0 / len(names)) if scheduling.gives_weights else 0.5 * (scheduling.low + scheduling.high)
    )
    begin, end = np.tile(middle, (steps, 1)), np.tile(middle, (steps, 1))
    for name, profile in profiles_of(scenario, "scheduling"):
        if not isinstance(profile, Additive):
            raise SpecError(f"A scheduling signal is no {type(profile).__name__.lower()}.", path=f"scheduling.{name}")
        place = names.index(name)
        for ends, values in zip((begin, end), profile.sampled(steps, dt), strict=True):
            ends[:, place] += values
    if plant.is_discrete:
        end = begin
    for ends in (begin, end):
        require_inside(plant, ends, dt)
        if not scheduling.gives_weights:
            np.clip(ends, scheduling.low, scheduling.high, out=ends)
    return begin, end


def require_inside(plant: PolytopicSystem, parameters: FloatArray, dt: float) -> None:
    """Raise `SpecError` where parameters ``(steps, p)`` leave the region, outside which the plant is not known."""
    scheduling = plant.scheduling
    room = EDGE_SLACK * np.maximum(np.abs(scheduling.low), np.abs(scheduling.high))
    outside = ~((parameters >= scheduling.low - room) & (parameters <= scheduling.high + room))
    if outside.any():
        k, place = (int(index[0]) for index in np.nonzero(outside))
        name = scheduling.names[place]
        raise SpecError(
            f"{name} is {parameters[k, place]:.6g} at {k * dt:.6g} s: the plant is known for {scheduling.sentence()}. "
            "Profiles of a parameter are added to the middle of its range.",
            path=f"scheduling.{name}",
        )
    if scheduling.gives_weights and len(parameters) and not all(map(scheduling.is_inside, parameters)):
        raise SpecError("The weights of the vertices must sum to one at every sample.", path="scheduling")


def scenario_runs_over_region(
    plant: PolytopicSystem,
    drive: ScenarioSignals,
    parameters: tuple[FloatArray, FloatArray],
    start: FloatArray,
    seeds: Sequence[int],
) -> PlantRuns:
    """Run a polytopic plant over a scenario; the inputs are known ones, then scheduling parameters."""
    if drive.noise and not plant.is_discrete and plant.nw:
        raise SpecError(
            "Process noise of a continuous plant over a region is not simulated: give sensor_noise, or random "
            "disturbances.",
            path="noise",
        )
    drawn, noise, sensor_noise = drive.drawn(seeds, plant.nw)
    at_begin, at_end = drive.at_begin[:, None] + drawn, drive.at_end[:, None] + drawn
    states, clean = region_runs(plant, parameters, at_begin, at_end, noise, start, drive.dt)
    u, faults, disturbances = np.split(at_begin, (plant.nu, plant.nu + plant.nf), axis=2)
    shared = np.broadcast_to(parameters[0][:, None], (*at_begin.shape[:2], parameters[0].shape[1]))
    return (
        states,
        drive.measured(clean + sensor_noise),
        np.concatenate([u, shared], axis=2),
        faults,
        disturbances,
    )


def region_runs(
    plant: PolytopicSystem,
    parameters: tuple[FloatArray, FloatArray],
    at_begin: FloatArray,
    at_end: FloatArray,
    noise: FloatArray,
    start: FloatArray,
    dt: float,
) -> tuple[FloatArray, FloatArray]:
    """Return states and outputs ``(steps, runs, *)`` for signals ``[u, f, d]`` where intervals begin and end."""
    moving = _Moving.of(plant)
    steps, runs = at_begin.shape[:2]
    states, outputs = np.empty((steps, runs, plant.nx)), np.empty((steps, runs, plant.ny))
    v = np.repeat((moving.E1 @ start)[:, None], runs, axis=1)
    for k in range(steps):
        # A point that stays is not evaluated again.
        if k == 0 or not np.array_equal(parameters[0][k - 1], parameters[0][k]):
            at = moving.at(parameters[0][k])
        s, w = at_begin[k].T, noise[k].T
        x = at.state(v, s, w)
        states[k] = x.T
        outputs[k] = (at.C @ x + at.D @ s + at.Dw @ w).T
        if plant.is_discrete:
            v = moving.U1.T @ (at.A @ x + at.S @ s + at.Bw @ w)
        else:
            v = moving.moved(v, parameters[0][k], parameters[1][k], at_begin[k].T, at_end[k].T, dt)
    finite = np.isfinite(states).reshape(steps, -1).all(axis=1)
    if not finite.all():
        raise SpecError(
            f"The states outgrow double precision at sample {int(np.argmin(finite))}: shorten the record, or give "
            "inputs that keep the plant near its operating point.",
            path="horizon",
        )
    return states, outputs


@dataclass(frozen=True, eq=False)
class _Point:
    """The matrices at one point; S, D: of ``[u, f, d]``."""

    A: FloatArray
    S: FloatArray
    Bw: FloatArray
    C: FloatArray
    D: FloatArray
    Dw: FloatArray
    solve: FloatArray  # the inverse of [U1'E; U2'A]
    algebraic: FloatArray  # U2

    def state(self, v: FloatArray, s: FloatArray, w: FloatArray) -> FloatArray:
        """Return the states of dynamic coordinates ``v = U1' E x`` and signals."""
        return np.asarray(self.solve @ np.vstack([v, -self.algebraic.T @ (self.S @ s + self.Bw @ w)]))


@dataclass(frozen=True, eq=False)
class _Moving:
    """A polytopic plant with its dynamic equations ``U1'`` and its algebraic ones ``U2'`` apart."""

    plant: PolytopicSystem
    U1: FloatArray
    U2: FloatArray
    E1: FloatArray
    vertices: dict[str, FloatArray]

    @classmethod
    def of(cls, plant: PolytopicSystem) -> _Moving:
        basis, rank = np.linalg.svd(plant.E)[0], decide_rank(plant.E).rank
        U1, U2 = basis[:, :rank], basis[:, rank:]

        def stacked(*names: str) -> FloatArray:
            return np.array([np.hstack([getattr(vertex, name) for name in names]) for vertex in plant.vertices])

        vertices = {
            "A": stacked("A"), "S": stacked("B", "Bf", "Bd"), "Bw": stacked("Bw"),
            "C": stacked("C"), "D": stacked("D", "Df", "Dd"), "Dw": stacked("Dw"),
        }  # fmt: skip
        return cls(plant, U1, U2, U1.T @ plant.E, vertices)

    def at(self, parameters: FloatArray) -> _Point:
        """Return the matrices at parameters."""
        weights = self.plant.scheduling.weights(parameters)
        matrices = {name: np.tensordot(weights, matrix, 1) for name, matrix in self.vertices.items()}
        stacked = np.vstack([self.E1, self.U2.T @ matrices["A"]])
        decision = decide_rank(stacked)
        if not decision.full:
            point = ", ".join(
                f"{name} = {value:.6g}" for name, value in zip(self.plant.scheduling.names, parameters, strict=True)
            )
            raise PreconditionError(
                f"At {point} the equations do not determine the state ({decision.describe()}): the index is 2 or more "
                "there.",
                condition="index one",
            )
        return _Point(**matrices, solve=np.linalg.inv(stacked), algebraic=self.U2)

    def moved(
        self, v: FloatArray, begin: FloatArray, end: FloatArray, at_begin: FloatArray, at_end: FloatArray, dt: float
    ) -> FloatArray:
        """Return the dynamic coordinates at the end of an interval, in continuous time."""
        parts = 1 if np.array_equal(begin, end) else PARTS
        for part in range(parts):
            share = (part + 0.5) / parts
            at = self.at((1.0 - share) * begin + share * end)
            r = len(self.E1)
            a = self.U1.T @ at.A @ at.solve[:, :r]
            b = self.U1.T @ (at.S - at.A @ at.solve[:, r:] @ self.U2.T @ at.S)
            first, last = (at_begin + (part + edge) / parts * (at_end - at_begin) for edge in (0, 1))
            transition, held, ramped = first_order_hold(a, b, dt / parts)
            v = transition @ v + held @ first + ramped @ (last - first)
        return v
