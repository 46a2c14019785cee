r"""The Kalman filter over the region of a polytopic plant: steady gains at the vertices, one proved mean square.

Two steps, each an inequality at the vertices (`obsynth.conditions.polytope`, V2): first the constant gains L, K of
:math:`\hat x^+ = L (A(\mu) \hat x + B(\mu) u) + K y^+`, ``L E + K C = I``, then what is injected besides from the
innovation, which changes with the parameters:

.. math::
    z^+ = L (A(\mu) \hat x + B(\mu) u) + S(\mu) (y - D u - C \hat x), \qquad \hat x = z + K (y - D u)

At one vertex the first step is the steady Kalman filter, and S is zero.  *The second step is no worse:* with S = 0 and
the same P its mean square is at most that of the first, as ``M'PM + I < P``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress

import numpy as np

from obsynth.analysis.existence.condition import require_all
from obsynth.analysis.existence.kalman import without_unknown_inputs
from obsynth.analysis.existence.kalman_over_region import free_equations, kalman_conditions_over_region
from obsynth.errors import PreconditionError, SolverError, SpecError
from obsynth.methods.descriptor_kalman.noise_over_region import NoiseOverRegion
from obsynth.methods.descriptor_kalman.options_over_region import not_over_region
from obsynth.methods.engines.region_notes import by_product_notes, certificate_note, unused_rate_notes
from obsynth.methods.engines.vertex_certificates import VertexCertificate, analysed, certified
from obsynth.methods.method import Method, Synthesis
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.recursive.steady_filter import steady_state_filter
from obsynth.observers.scheduled.observer import ScheduledObserver
from obsynth.plants.plant_units import PlantUnits
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.results.design import Certificate
from obsynth.verification.error_polytope import ErrorPolytope
from obsynth.verification.over_region import GAIN_WITNESSES, rows_to_forget, stored_witness

#: Relative distance of the mean square to the least one: the bare optimum is badly conditioned.
MARGIN = 1e-3
#: A state whose deviation is below this share of the largest is as good as known, and counts as if it were that.
EXACT_STATE = 1e-9
#: Entries below this share of the terms that they are the difference of are rounding, some hundred times that of one.
ROUNDING_SHARE = 1e-13


def synthesise_over_region(plant: PolytopicSystem, method: Method, *, progress: Callable[[str], None]) -> Synthesis:
    """Return a scheduled Kalman filter with its certificate; see `obsynth.descriptor_kalman`."""
    options = method.as_given()
    unsupported = not_over_region(options)
    if unsupported:
        raise SpecError(
            f"A Kalman filter over a region has no {', '.join(unsupported)}: leave it out. It takes Q and R.",
            path=f"method.options.{unsupported[0]}",
        )
    progress("checking the existence conditions over the region")
    require_all(kalman_conditions_over_region(plant))
    noise = NoiseOverRegion.of(plant, options["Q"], options["R"])
    steps = plant.scheduling.usable_step_of(plant.dt)
    progress("solving the inequalities at the vertices")
    sizes = _sizes(plant, noise)
    T, N = _constant_gains(plant, noise, sizes)
    errors = _errors(plant, noise, T, N)
    certificate, claim = _certified(errors, sizes, steps)
    gains = certificate.gains_at_each(plant.count)
    decay = certificate.decay
    used = claim.witness.G is not None or certificate.witness.G is not None
    progress("building the realisation and its certificate")
    letters = {"L": T, "K": N} | {f"S[{i + 1}]": S for i, S in enumerate(gains)}
    return Synthesis(
        options={**method.as_plain(), **noise.stated()},
        gains=letters,
        observer=_observer(plant, T, N, gains, decay),
        certificate=Certificate(
            {
                "tracking": T,
                **stored_witness(certificate.witness),
                **stored_witness(claim.witness, GAIN_WITNESSES),
            },
            {"region_deviation": claim.level, "region_decay": decay},
        ),
        solver={"engine": "lmi", "runs": [*certificate.runs, *claim.runs]},
        notes=(*_notes(plant, decay, steps if used else None, noise), *by_product_notes(certificate)),
    )


def _certified(
    errors: ErrorPolytope, sizes: FloatArray, steps: float | None
) -> tuple[VertexCertificate, VertexCertificate]:
    """Return gains with their decay, and the claim of their deviation: for small steps where that is the lower one."""
    weighted = _with_outputs(errors, 1.0 / sizes)

    def claimed(made: VertexCertificate) -> VertexCertificate:
        return analysed(errors, made.gains, steps=steps, goal="power")

    try:
        common = certified(weighted, goal="power", margin=MARGIN)
    except SolverError:
        if steps is None:
            raise
        slow = certified(weighted, goal="power", margin=MARGIN, lyapunov="vertex", steps=steps)
        return slow, claimed(slow)
    claim = claimed(common)
    if steps is None:
        return common, claim
    with suppress(SolverError):
        slow = certified(weighted, goal="power", margin=MARGIN, decay=common.decay, lyapunov="vertex", steps=steps)
        better = claimed(slow)
        return (slow, better) if better.level < claim.level else (common, claim)
    return common, claim


def _constant_gains(plant: PolytopicSystem, noise: NoiseOverRegion, sizes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return L ``(nx, nx)`` and K ``(nx, ny)`` that are the best for all vertices, or those of the middle."""
    rows, C = free_equations(plant), plant.vertices[0].C
    H = np.vstack([rows @ plant.E, C])
    inverse, null = _without_rounding(np.linalg.pinv(H), H, sizes), np.linalg.svd(H)[0][:, plant.nx :].T
    ne = len(rows)
    L0, K0, N1, N2 = inverse[:, :ne] @ rows, inverse[:, ne:], null[:, :ne] @ rows, null[:, ne:]
    V, p = noise.sensor, noise.sensor.shape[1]

    def problem(places: Sequence[int]) -> ErrorPolytope:
        vertices = [plant.vertices[i] for i in places] if places else [plant.center]
        drives = [noise.process[i] for i in places] if places else [noise.middle]
        q = drives[0].shape[1]
        return ErrorPolytope(
            [L0 @ vertex.A for vertex in vertices],
            [-N1 @ vertex.A for vertex in vertices],
            B=[np.hstack([L0 @ W, -K0 @ V]) for W in drives],
            D=[np.hstack([-N1 @ W, N2 @ V]) for W in drives],
            Cz=np.eye(plant.nx),
            Dz=np.zeros((plant.nx, q + p)),
            dt=plant.dt,
        )

    for places in (range(plant.count), ()):
        try:
            certificate = certified(
                _with_outputs(problem(places), 1.0 / sizes), goal="power", gain="constant", fast_decay=False
            )
        except SolverError:
            continue
        return L0 + certificate.gains[0] @ N1, K0 + certificate.gains[0] @ N2
    raise SolverError(
        "No Kalman filter of the middle of the region was found by its inequality. State Q and R in the units of "
        "equations and outputs, or take a smaller region."
    )


def _without_rounding(inverse: FloatArray, H: FloatArray, sizes: FloatArray) -> FloatArray:
    """Return an inverse without the entries that are only rounding: where an output alone determines a state, nothing
    of the equations enters it, and identities are compared with terms that count."""
    shares = np.abs(inverse) * np.linalg.norm(H * sizes, axis=1)
    return np.where(shares <= ROUNDING_SHARE * np.max(shares, axis=1, keepdims=True), 0.0, inverse)


def _unread(C: FloatArray, N: FloatArray) -> FloatArray:
    """Return ``I - C N``, without the entries that are only rounding."""
    rest = np.eye(len(C)) - C @ N
    return np.where(np.abs(rest) <= ROUNDING_SHARE * (np.eye(len(C)) + np.abs(C) @ np.abs(N)), 0.0, rest)


def _sizes(plant: PolytopicSystem, noise: NoiseOverRegion) -> FloatArray:
    """Return the deviation of each state in the middle of the region, in which errors are compared with each other.

    Powers of two: no unit of a state then decides which one is estimated well.
    """
    reduced = without_unknown_inputs(plant.center)
    Q = reduced.process_covariance(noise.middle @ noise.middle.T)
    try:
        P = steady_state_filter(reduced.plant, Q=Q, R=noise.sensor @ noise.sensor.T).P  # type: ignore[arg-type]
    except (PreconditionError, SolverError):
        return PlantUnits.of(plant.center).rounded().states
    deviations = np.sqrt(np.maximum(np.diag(P), 0.0))
    least = float(np.max(deviations)) * EXACT_STATE
    return np.exp2(np.round(np.log2(np.maximum(deviations, least)))) if least > 0.0 else np.ones(plant.nx)


def _with_outputs(errors: ErrorPolytope, factors: FloatArray) -> ErrorPolytope:
    """Return the error system with rows of z times factors."""
    return ErrorPolytope(
        errors.A,
        list(errors.C),
        B=list(errors.B),
        D=list(errors.D),
        Cz=[factors[:, None] * z for z in errors.Cz],
        Dz=[factors[:, None] * z for z in errors.Dz],
        dt=errors.dt,
    )


def _errors(plant: PolytopicSystem, noise: NoiseOverRegion, T: FloatArray, N: FloatArray) -> ErrorPolytope:
    """Return the error system of ``T E x - z``, in S."""
    C, V, n = plant.vertices[0].C, noise.sensor, plant.nx
    q = noise.process[0].shape[1]
    return ErrorPolytope(
        [T @ vertex.A for vertex in plant.vertices],
        C,
        B=[
            np.hstack([T @ W, -(T @ vertex.A) @ (N @ V)])
            for vertex, W in zip(plant.vertices, noise.process, strict=True)
        ],
        D=np.hstack([np.zeros((plant.ny, q)), _unread(C, N) @ V]),
        Cz=np.eye(n),
        Dz=np.hstack([np.zeros((n, q)), -N @ V]),
        dt=plant.dt,
    )


def _observer(
    plant: PolytopicSystem, T: FloatArray, N: FloatArray, gains: Sequence[FloatArray], decay: float
) -> ScheduledObserver:
    """Return the observer of states, with innovations as residuals."""
    first, unseen = plant.vertices[0], _unread(plant.vertices[0].C, N)
    By = [T @ vertex.A @ N + S @ unseen for vertex, S in zip(plant.vertices, gains, strict=True)]
    Dy = np.vstack([N, unseen])
    return ScheduledObserver(
        Az=np.array([T @ vertex.A - S @ vertex.C for vertex, S in zip(plant.vertices, gains, strict=True)]),
        Bu=np.array([T @ vertex.B - by @ vertex.D for vertex, by in zip(plant.vertices, By, strict=True)]),
        By=np.array(By),
        Cz=np.vstack([np.eye(plant.nx), -first.C]),
        Du=-Dy @ first.D,
        Dy=Dy,
        effectiveness=np.zeros((plant.count, 0, 0)),
        forgetting=rows_to_forget(decay),
        **ScheduledObserver.names_of(plant),
        fault_names=(),
        residual_names=plant.output_names,
        state_delays=(0,) * plant.nx,
        fault_delays=(),
    )


def _notes(plant: PolytopicSystem, decay: float, steps: float | None, noise: NoiseOverRegion) -> tuple[str, ...]:
    notes = [certificate_note(plant, f"{rows_to_forget(decay)} rows")]
    if noise.missing:
        notes.append(f"{' and '.join(noise.missing)} = identity, as neither the plant nor the options state the noise.")
    notes += unused_rate_notes(plant, steps)
    if plant.nd:
        notes.append("Equations that an unknown input enters are left out: nothing is assumed about it.")
    if plant.nf:
        notes.append("Faults are taken as zero: they show in the innovations.")
    return tuple(notes)
