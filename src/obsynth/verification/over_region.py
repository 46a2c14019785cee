"""Checks of scheduled designs: claims for every point of a region and every trajectory of the parameters.

The plant and the observer are both means of vertices with the same weights, so that what is linear in both is checked
at the vertices; what is proved there in balls is true for every course of the weights (`obsynth.proofs.
vertex_inequalities`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.scheduled.observer import FORGOTTEN_SHARE, ScheduledObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.plants.scheduling import Scheduling
from obsynth.proofs.balls import Ball
from obsynth.proofs.extended_balls import Enclosed
from obsynth.proofs.rated_inequalities import prove_rated_gain
from obsynth.proofs.vertex_inequalities import (
    Pair,
    Proved,
    Vertex,
    VertexProof,
    Witness,
    prove_decay,
    prove_gain,
    prove_mean_square,
)
from obsynth.results.checks import Check, fitting_check, information, nothing_wrong, upper_bound_check
from obsynth.results.design import ObserverDesign
from obsynth.verification.error_system import ErrorModel
from obsynth.verification.identities import Identity, equality, tracking_identities, worst

#: Names of the rows.
GAIN_ROW, DECAY_ROW, DECOUPLING_ROW = "LMI", "decay over the region", "fault decoupled for every scheduling"
REGION_GAIN_ROW, DEVIATION_ROW = "gain over the region", "mean square over the region"
SWITCHING_ROW, FROZEN_ROW = "worst switching found", "worst corner at rest"
#: Lyapunov matrices and slacks of a certificate over a region, each ``(1 or N, n, n)``.
WITNESSES = ("P_region", "G_region")
#: The same of a gain, where it has its own.
GAIN_WITNESSES = ("P_gain", "G_gain")
#: The courses that are tried for the row that informs: a search of a tenth of a second.
SWITCHING_HORIZON, SWITCHING_STARTS = 16, 1
#: With more vertices or errors only courses that stay at a vertex are tried.
MOST_SWITCHED = 8
#: Rows without a claim are not counted further.
MOST_UNCLAIMED_ROWS = 2_000_000_000
MOST_UNCLAIMED_SECONDS = 1e9
#: What a logarithm and a quotient may be rounded by.
_ROUNDING = 4.0 * float(np.finfo(np.float64).eps)


def courses(scheduling: Scheduling, steps: float | None) -> str:
    """Return in words for which courses of the parameters something is claimed."""
    if steps is None:
        return f"for every course of {', '.join(scheduling.names)}, jumps among them"
    return f"for every course of {scheduling.names[0]} that changes by at most {scheduling.rates[0]:.6g} in a second"


def scheduled_pair(design: ObserverDesign) -> tuple[PolytopicSystem, ScheduledObserver] | None:
    """Return the plant and the observer of a design over a region; ``None`` where they are of other kinds."""
    plant, observer = design.plant, design.observer
    if isinstance(plant, PolytopicSystem) and isinstance(observer, ScheduledObserver):
        return plant, observer
    return None


def wrong_kinds_row() -> Check:
    """Return the failing row of a design that `scheduled_pair` has none of."""
    return fitting_check("a scheduled observer for a polytopic plant", fits=False)


def share_signals(plant: PolytopicSystem, observer: ScheduledObserver) -> bool:
    """Return whether an observer has the vertices, the sample time, and the inputs, outputs and states of a plant."""
    return (
        observer.count == plant.count
        and observer.dt == plant.dt
        and observer.input_names[: observer.inputs] == plant.input_names
        and observer.output_names == plant.output_names
        and observer.state_names == plant.state_names
    )


def vertex_errors(
    plant: PolytopicSystem, observers: Iterable[LinearObserver], tracking: FloatArray
) -> list[ErrorModel]:
    """Return the error system at each vertex, of the observers there."""
    return [ErrorModel(vertex, own, tracking) for vertex, own in zip(plant.vertices, observers, strict=True)]


def same_scheduling_row(plant: PolytopicSystem, observer: ScheduledObserver) -> Check:
    """Return the row that plant and observer read the same parameters in the same way."""
    one, other = plant.scheduling, observer.scheduling
    wrong = [name for name in ("names", "functions", "rates") if getattr(one, name) != getattr(other, name)]
    wrong += [
        name for name in ("low", "high", "corners") if not np.array_equal(getattr(one, name), getattr(other, name))
    ]
    read = tuple(one.columns.get(name, name) for name in one.names)
    wrong += [] if observer.input_names[observer.inputs :] == read else ["columns"]
    return nothing_wrong(
        "scheduling",
        f"the observer is scheduled as the plant is, over {one.sentence()}",
        wrong,
        source="shipped realisation",
    )


def tracking_rows(
    models: Sequence[ErrorModel], scheduling: Scheduling, words: Mapping[str, tuple[str, str, str]]
) -> Iterator[Check]:
    """Yield the rows that the observer is unbiased at every vertex, each for the vertex where it misses most."""
    each_vertex = [tracking_identities(model) for model in models]
    for key, (name, claim, source) in words.items():
        residuals = [identities[key].residual(None) for identities in each_vertex]
        place = residuals.index(worst(residuals))
        row = equality(name, f"{claim}, at every vertex", residuals[place], source)
        yield replace(row, detail=f"{row.detail}, at {scheduling.vertex_name(place)}")


def worst_of_vertices(reports: Iterable[Iterable[Check]], scheduling: Scheduling) -> Iterator[Check]:
    """Yield each row of reports at the vertices once, that of the vertex where its margin is least beside its bound."""
    worst: dict[str, tuple[float, int, Check]] = {}
    for place, report in enumerate(reports):
        for row in report:
            share = row.margin / abs(row.bound) if row.bound else row.margin
            rank = -np.inf if not row.passed or np.isnan(share) else share
            if row.name not in worst or rank < worst[row.name][0]:
                worst[row.name] = (rank, place, row)
    for _, place, row in worst.values():
        yield replace(
            row, claim=f"{row.claim}, at every vertex", detail=f"{row.detail}, at {scheduling.vertex_name(place)}"
        )


def listed_gains_row(
    gains: Mapping[str, FloatArray],
    shapes: Mapping[str, tuple[int, ...]],
    identities: Callable[[], Iterable[Identity]],
) -> Iterator[Check]:
    """Yield the row on the listed gains by their letters; nothing where none are listed, as the realisation stands for
    itself."""
    if not gains:
        return
    wrong = sorted(shapes.keys() ^ gains.keys())
    wrong += [letter for letter, shape in shapes.items() if letter in gains and gains[letter].shape != shape]
    claim = "the listed gains are those of the realisation and of the certificate, at every vertex"
    if wrong:
        yield nothing_wrong("gains", claim, wrong, source="gain set")
        return
    yield equality("gains", claim, worst([identity.residual() for identity in identities()]), "gain set")


def by_vertex(letter: str, count: int) -> tuple[str, ...]:
    """Return the names of a gain that each vertex has one of."""
    return tuple(f"{letter}[{place + 1}]" for place in range(count))


def fault_error_vertices(
    plants: Sequence[DescriptorSystem], observers: Sequence[LinearObserver], tracking: FloatArray
) -> list[Vertex]:
    """Return how the system from the disturbances to the fault errors is formed at each vertex.

    ``e = T E x - z`` obeys ``e+ = Az e + (T Bd - By Dd) d``, and the fault estimate misses by ``Cz e - Dy Dd d``.
    """

    def vertex_of(plant: DescriptorSystem, observer: LinearObserver) -> Vertex:
        def vertex(kind: type[Enclosed]) -> tuple[Enclosed, Enclosed, Enclosed, Enclosed]:
            exact, rows = kind.exact, observer.fault_rows
            b = exact(tracking) @ exact(plant.Bd) - exact(observer.By) @ exact(plant.Dd)
            return exact(observer.Az), b, exact(observer.Cz[rows]), -(exact(observer.Dy[rows]) @ exact(plant.Dd))

        return vertex

    return [vertex_of(plant, observer) for plant, observer in zip(plants, observers, strict=True)]


def witness_of_certificate(
    matrices: Mapping[str, FloatArray], pairs: Sequence[Pair] | None, names: tuple[str, str] = WITNESSES
) -> Witness | None:
    """Return the Lyapunov matrices in a certificate, by their names; ``None`` without any."""
    P, G = (matrices.get(name) for name in names)
    if P is None or any(each is not None and (each.ndim != 3 or each.shape[1:] != P.shape[1:]) for each in (P, G)):
        return None
    if not len(P) or P.shape[1] != P.shape[2]:
        return None
    return Witness(list(P), None if G is None else list(G), None if G is None else pairs)


def stored_witness(witness: Witness, names: tuple[str, str] = WITNESSES) -> dict[str, FloatArray]:
    """Return the matrices of a certificate from which `witness_of_certificate` makes a witness again."""
    stored = {names[0]: np.array(witness.P)}
    if witness.slopes is not None:
        stored[slope_name(names)] = witness.slopes
    return stored if witness.G is None else {**stored, names[1]: np.array(witness.G)}


def slope_name(names: tuple[str, str]) -> str:
    """Return the name of the multipliers of slopes beside Lyapunov matrices of these names."""
    return f"T{names[0].removeprefix('P')}"


def region_gain_row(
    name: str, claim: str, vertices: Proved, witness: Witness | None, level: float, *, discrete: bool
) -> Check:
    """Return the row that a gain over the region is below ``level``, with words of its own."""
    sound = witness is not None and np.isfinite(level) and level > 0.0
    proof = prove_gain(vertices, witness, level, discrete=discrete) if sound and witness else _no_certificate()
    return _proof_row(name, claim, level, proof)


def rated_gain_row(
    name: str, claim: str, vertices: Sequence[Vertex], P: Sequence[FloatArray], rate: float, level: float
) -> Check:
    """Return the row that a gain is below ``level`` in continuous time while the weight moves by at most ``rate``."""
    sound = np.isfinite(level) and level > 0.0
    proof = prove_rated_gain(vertices, P, rate, level) if sound else _no_certificate()
    return _proof_row(name, claim, level, proof)


def deviation_row(
    claim: str, vertices: Proved, witness: Witness | None, level: float, *, discrete: bool = False
) -> Check:
    """Return the row that the root mean square of errors is below ``level``."""
    sound = witness is not None and np.isfinite(level) and level > 0.0
    proof = prove_mean_square(vertices, witness, level, discrete=discrete) if sound and witness else _no_certificate()
    return _proof_row(DEVIATION_ROW, claim, level, proof)


def gain_row(
    vertices: Sequence[Vertex], witness: Witness | None, level: float, claimed: float, *, discrete: bool, words: str
) -> Check:
    """Return the row that the gain over the region is below ``claimed``; proved at ``level``."""
    proof = _no_certificate() if witness is None else prove_gain(vertices, witness, level, discrete=discrete)
    return _proof_row(
        GAIN_ROW,
        f"gain over the region: the l2 gain from the disturbances to the fault errors is below gamma, {words}",
        claimed,
        proof,
    )


def switching_row(vertices: Sequence[Vertex], level: float) -> Check:
    """Return the row on the worst course of the weights that was found, beside what is proved: it informs."""
    gain = worst_switching([tuple(part.midpoint for part in vertex(Ball)) for vertex in vertices])
    return information(
        SWITCHING_ROW,
        "a gain that some course of the parameters reaches: no claim below it can be true",
        gain,
        source="coordinate ascent over courses between vertices",
        detail=f"{gain / level:.3f} of what is proved" if level > 0.0 else "",
    )


def worst_switching(
    closed: Sequence[tuple[FloatArray, ...]], *, horizon: int = SWITCHING_HORIZON, starts: int = SWITCHING_STARTS
) -> float:
    """Return the largest l2 gain over a horizon that is found along courses of vertices: a lower bound of every claim.

    Parameters
    ----------
    closed : sequence of tuple of FloatArray
        M, B, Cz and Dz at each vertex, in discrete time.
    horizon : int, optional
        Samples.
    starts : int, optional
        Random courses from which a coordinate ascent starts, besides every vertex alone.
    """
    rng, count, best = np.random.default_rng(0), len(closed), 0.0
    courses = [[place] * horizon for place in range(count)]
    few = count <= MOST_SWITCHED
    courses += [list(map(int, rng.integers(0, count, horizon))) for _ in range(starts if few and count > 1 else 0)]
    for course in courses:
        value = _gain_along(closed, course)
        for k in map(int, rng.permutation(horizon)) if few and count > 1 else ():
            for other in range(count):
                before = course[k]
                if other == before:
                    continue
                course[k] = other
                trial = _gain_along(closed, course)
                if trial > value:
                    value = trial
                else:
                    course[k] = before
        best = max(best, value)
    return best


def _gain_along(closed: Sequence[tuple[FloatArray, ...]], course: Sequence[int]) -> float:
    """Return the l2 gain over a finite course of vertices."""
    n, (q, p), length = len(closed[0][0]), closed[0][3].shape, len(course)
    whole, reached = np.zeros((length * q, length * p)), np.zeros((n, length * p))
    for k, place in enumerate(course):
        M, B, Cz, Dz = closed[place]
        rows, columns = slice(k * q, (k + 1) * q), slice(k * p, (k + 1) * p)
        whole[rows] = Cz @ reached
        whole[rows, columns] += Dz
        reached = M @ reached
        reached[:, columns] += B
    return float(np.linalg.norm(whole, 2)) if whole.size else 0.0


def decay_row(vertices: Proved, witness: Witness | None, rate: float, *, discrete: bool, words: str) -> Check:
    """Return the row that errors decay."""
    sound = witness is not None and (0.0 <= rate < 1.0 if discrete else rate > 0.0)
    proof = prove_decay(vertices, witness, rate, discrete=discrete) if sound and witness else _no_certificate()
    how = "by this factor a sample" if discrete else "like exp(-rate t)"
    return _proof_row(DECAY_ROW, f"decay rate over the region: errors decay at least {how}, {words}", rate, proof)


def _no_certificate() -> VertexProof:
    return VertexProof(False, -np.inf, 0, "no certificate, or a number that claims nothing")


def _proof_row(name: str, claim: str, value: float, proof: VertexProof) -> Check:
    detail = f"{proof.count} matrices positive definite" if proof.proved else f"not proved: {proof.reason}"
    row = upper_bound_check(
        name,
        claim,
        value,
        value if proof.proved else -np.inf,
        source="vertex inequalities, proved in balls",
        kind="proved",
        detail=detail,
    )
    return replace(row, margin=proof.margin, passed=proof.proved)


def rows_to_forget(decay: float) -> int:
    """Return after how many samples a hundredth of an error is left at most, in the norm of the certificate."""
    return int(min(_rows_to_forget(decay), MOST_UNCLAIMED_ROWS))


def _rows_to_forget(decay: float) -> float:
    """Return the same without an end: infinite where nothing decays."""
    if not 0.0 < decay < 1.0:
        return 1.0 if decay == 0.0 else np.inf
    return 1.0 + float(np.ceil(np.log(FORGOTTEN_SHARE) / np.log(decay)))


def seconds_to_forget(rate: float) -> float:
    """Return after how many seconds a hundredth of an error is left at most, for a decay in 1/s."""
    return float(-np.log(FORGOTTEN_SHARE) / rate) * (1.0 + _ROUNDING) if rate > 0.0 else float(MOST_UNCLAIMED_SECONDS)


def forgetting_of(decay: float, *, discrete: bool) -> float:
    """Return for how long nothing is claimed after a row outside the region: rows, or seconds."""
    return rows_to_forget(decay) if discrete else seconds_to_forget(decay)


def forgetting_row(decay: float, forgetting: float, *, discrete: bool) -> Check:
    """Return the row that an observer waits long enough after a row outside the region."""
    return upper_bound_check(
        "rows without a claim",
        "after a row outside the region nothing is claimed until a hundredth of its error is left"
        + ("" if discrete else " (seconds)"),
        _rows_to_forget(decay) if discrete else seconds_to_forget(decay) * (1.0 - _ROUNDING),
        float(forgetting),
        source="decay over the region",
    )


def rows_of_euler(rate: float, step: float) -> int:
    """Return after how many steps of implicit Euler a hundredth of an error is left, for a decay ``rate`` in 1/s."""
    return rows_to_forget(float(1.0 / np.sqrt(1.0 + 2.0 * rate * step)) if rate > 0.0 else 1.0)
