"""Proof files of designs over a region: the claims at all vertices, with one Lyapunov matrix or one for each vertex.

What is written here is what section 5 of ``checker/check_proof.py`` asks for.  Lyapunov matrices are those of the
certificate.  What they do not prove for every course, as parameters change slowly, is claimed for such courses
(`obsynth.exporting.proof_for_slow_courses`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.exporting.exact_error_system import (
    CONTRACTION_SHARES,
    ESTIMATE_SHARE,
    NORM_ROOM,
    OBSERVER_MATRICES,
    PLANT_MATRICES,
    RATE_SHARE,
    ExactContraction,
    ExactErrorSystem,
    exact,
    identities_claim,
    matrix_data,
    rows_of,
)
from obsynth.exporting.proof_claims import ProofClaims
from obsynth.exporting.proof_for_slow_courses import SlowCourses, SlowFlow
from obsynth.methods.descriptor_kalman.noise_over_region import NoiseOverRegion
from obsynth.observers.scheduled.observer import ScheduledObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.proofs.witnesses import Dyadic, blocks, definite_witness, inverse_above, number_data, root_above
from obsynth.results.design import ObserverDesign
from obsynth.verification.error_system import ErrorModel
from obsynth.verification.over_region import GAIN_WITNESSES, WITNESSES

#: Matrices that a file has at each vertex.
SCHEDULED_OF_PLANT, SCHEDULED_OF_OBSERVER = ("A", "B", "Bf", "Bd", "Bw"), ("Az", "Bu", "By")
#: What the inverse of a mean of Lyapunov matrices is multiplied by, to be above the inverse of each.
COVERING_FACTORS = (1.0, 2.0, 4.0, 16.0, 256.0, 65536.0)
#: For which courses of the parameters something is claimed.
EVERY_COURSE, SLOW_COURSES = "over the region", "for slow courses"
#: What every file of a region leaves to `obsynth.verify`.
ALWAYS_LEFT = (
    "that the plant with its parameters is a mean of these vertices, and how fast its weights move: `obsynth verify` "
    "forms them from the ranges and rates",
    "rows whose parameters are outside their ranges or missing",
)
#: Claims of the methods that the file may prove: name, Lyapunov matrix and slack, signal and kind of rows.
GAINS = {
    "fault-estimation-filter": ("gamma", WITNESSES, "disturbances", "fault"),
    "ui-pi-observer": ("region_gain", GAIN_WITNESSES, "fault model", "fault"),
}


def refusal_over_region(design: ObserverDesign) -> str:
    """Return why a design over a region has no proof file; empty where it has one."""
    if not isinstance(design.plant, PolytopicSystem) or not isinstance(design.observer, ScheduledObserver):
        return "its observer is not scheduled"
    if design.observer.correction is not None:
        return "its faults turn their directions, and it corrects its state by its residuals"
    if not design.plant.is_constant("E", "C", "D", "Df", "Dd", "Dw"):
        return "its outputs change with the parameters"
    return ""


@dataclass
class RegionProof(ProofClaims):
    """Collects the claims of a scheduled design, and the names of those that are left out."""

    def __post_init__(self) -> None:
        if reason := refusal_over_region(self.design):
            raise SpecError(
                f"Design {self.design.name!r} has no proof file: {reason}. `obsynth verify` checks it.", path="design"
            )

    @cached_property
    def observer(self) -> ScheduledObserver:
        """The observer, of which fault rows are not divided by their effectiveness."""
        return self.design.scheduled[1]

    @cached_property
    def plants(self) -> list[DescriptorSystem]:
        """The plant at the vertices; of a Kalman filter with the noise that it is for."""
        plant = self.design.scheduled[0]
        if self.design.method != "descriptor-kalman":
            return list(plant.vertices)
        options = self.design.options
        noise = NoiseOverRegion.of(plant, options.get("Q"), options.get("R"))
        V = noise.sensor
        return [
            vertex.replace(
                Bw=np.hstack([W, np.zeros((plant.nx, V.shape[1]))]),
                Dw=np.hstack([np.zeros((plant.ny, W.shape[1])), V]),
                noise_names=None,
            )
            for vertex, W in zip(plant.vertices, noise.process, strict=True)
        ]

    @cached_property
    def systems(self) -> list[ExactErrorSystem]:
        """The error system at each vertex, in exact numbers."""
        matrices = self.design.certificate.matrices
        decoupled = self.design.method != "fault-estimation-filter"
        systems = []
        for place, plant in enumerate(self.plants):
            own = self.observer.before_division(place)
            model = ErrorModel(
                plant, own, matrices["tracking"], Phi=matrices.get("Phi"), Cw=matrices.get("Cw"), decoupled=decoupled
            )
            systems.append(ExactErrorSystem.of(plant, own, model))
        return systems

    @property
    def discrete(self) -> bool:
        """Whether the plant is sampled."""
        return self.observer.dt > 0.0

    def data(self) -> dict[str, Any]:
        """Return plant, observer and claims as data of the file, without what every proof file has."""
        first, (plant, _) = self.systems[0], self.design.scheduled
        model = first.model
        follows = {
            "T": model.T,
            "T0": np.zeros((len(first.observer.Cz), len(model.E))),
            "Phi": np.zeros((0, 0)) if model.Phi is None else model.Phi,
            "Cw": np.zeros((plant.nf, 0)) if model.Cw is None else model.Cw,
        }
        names = {"states": plant.state_names, "faults": plant.fault_names, "disturbances": plant.disturbance_names}
        fixed = [name for name in PLANT_MATRICES if name not in SCHEDULED_OF_PLANT]
        rows = [name for name in OBSERVER_MATRICES if name not in SCHEDULED_OF_OBSERVER]
        return {
            "plant": {
                **{name: matrix_data(getattr(first.plant, name)) for name in fixed},
                "sample_time": number_data(plant.dt),
                "names": {kind: list(each) for kind, each in names.items()},
            },
            "observer": {
                **{name: matrix_data(getattr(first.observer, name)) for name in rows},
                "rows": [list(row) for row in rows_of(first.observer)],
            },
            "vertices": [
                {
                    "plant": {name: matrix_data(getattr(system.plant, name)) for name in SCHEDULED_OF_PLANT},
                    "observer": {name: matrix_data(getattr(system.observer, name)) for name in SCHEDULED_OF_OBSERVER},
                }
                for system in self.systems
            ],
            "follows": {
                **{name: matrix_data(value) for name, value in follows.items()},
                "lag": 0,
                "decoupled": model.decoupled,
            },
            "contraction": self.witness,
            "claims": self.claims,
            "not_covered": self.not_covered,
        }

    def collect(self) -> None:
        """Write every claim that can be proved, and name the others."""
        missed = [(name, part) for system in self.systems for name, part in system.missed.items()]
        self.add(
            "the identities hold to less than a thousandth of their terms",
            identities_claim("identities over the region", missed),
        )
        self._add_decay()
        if self.design.method == "descriptor-kalman":
            self._add_mean_square()
        if self.observer.effectiveness_is_one:
            self._add_gain()
        else:
            self.not_covered.append(
                "the gain and the faults' own estimates: fault rows in the file are those before they are divided by "
                "an effectiveness that changes"
            )
        self.not_covered += ALWAYS_LEFT
        if not self.discrete:
            self.not_covered.append("the steps of implicit Euler by which the observer runs")
        self.leave_the_source()

    def _lyapunov_matrices(self, name: str) -> list[Dyadic] | None:
        """Return the Lyapunov matrices of the certificate: one, or one for each vertex of a sampled plant."""
        stored = self.design.certificate.matrices.get(name)
        order = self.observer.order
        if stored is None or stored.ndim != 3 or stored.shape[1:] != (order, order):
            return None
        if len(stored) not in (1, self.observer.count if self.discrete else 1):
            return None
        return [exact(0.5 * (P + P.T)) for P in stored]

    def _at_all_pairs(
        self, matrices: Sequence[Dyadic], form: Callable[[ExactErrorSystem, Dyadic, Dyadic], Dyadic]
    ) -> list[dict[str, Any]] | None:
        """Return witnesses that a form is positive definite at each vertex, for each Lyapunov matrix of the next."""
        witnesses = []
        for i, system in enumerate(self.systems):
            for after in matrices:
                own = matrices[i] if len(matrices) > 1 else matrices[0]
                if (witness := definite_witness(form(system, own, after))) is None:
                    return None
                witnesses.append(witness)
        return witnesses

    def _of_matrices(self, matrices: Sequence[Dyadic]) -> dict[str, Any] | None:
        positive = [definite_witness(P) for P in matrices]
        return None if None in positive else {"P": [P.data() for P in matrices], "P_positive": positive}

    def _decaying(self, matrices: Sequence[Dyadic], rate: float) -> dict[str, Any] | None:
        def form(system: ExactErrorSystem, p: Dyadic, after: Dyadic) -> Dyadic:
            if self.discrete:
                return p.scaled(rate).scaled(rate) - system.az.T @ after @ system.az
            half = system.az.T @ p + p.scaled(rate)
            return -(half + half.T)

        witnesses, stated = self._at_all_pairs(matrices, form), self._of_matrices(matrices)
        if witnesses is None or stated is None:
            return None
        return {"rate": number_data(rate), **stated, "decreases": witnesses}

    def _add_decay(self) -> None:
        matrices, decay = self._lyapunov_matrices(WITNESSES[0]), self.design.certificate.claims.get("region_decay", 0.0)
        slow, slowness = self._slow_courses(WITNESSES), 1.0 - decay if self.discrete else decay
        found: dict[str, Any] | None = None
        for share in (1.0, 1.0 - RATE_SHARE) if matrices is not None and slowness > 0.0 else ():
            rate = self._rate(share, slowness)
            found = found or self._named("decay", EVERY_COURSE, self._decaying(matrices or [], rate))
            found = found or self._named("decay", SLOW_COURSES, None if slow is None else slow.decay(rate))
        self.add("decay over the region", found)
        contraction = None if matrices is None else self._contraction(matrices, slow, slowness)
        if contraction is None:
            self.not_covered.append("what rounding of stored numbers adds: no contraction was found")
            return
        self.add("what rounding of stored numbers adds: too much for an estimate", self._rounding(contraction))
        if self.design.method == "fault-estimation-filter" and self.observer.effectiveness_is_one:
            self.add("each fault's own estimate: rounding may hide it", self._faults(contraction))

    def _rate(self, share: float, slowness: float) -> float:
        return 1.0 - share * slowness if self.discrete else share * slowness

    @staticmethod
    def _named(claim: str, courses: str, proved: dict[str, Any] | None) -> dict[str, Any] | None:
        """Return what is proved with the name of its claim."""
        return None if proved is None else {"claim": f"{claim} {courses}", **proved}

    def _slow_courses(self, names: tuple[str, str]) -> SlowCourses | None:
        """Return what the certificate has for slow courses of a sampled plant."""
        return SlowCourses.of(self.systems, self.design.scheduled[0], self.design.certificate.matrices, names)

    def _contraction(
        self, matrices: Sequence[Dyadic], slow: SlowCourses | None, slowness: float
    ) -> ExactContraction | None:
        """Return a contraction with the Lyapunov matrices of the decay, and write its data."""
        for share in CONTRACTION_SHARES if slowness > 0.0 else ():
            rate = self._rate(share, slowness)
            witness = self._decaying(matrices, rate) or (None if slow is None else slow.decay(rate))
            covering = None if witness is None else _above_inverses(matrices)
            if witness is None or covering is None:
                continue
            G, covers = covering
            self.witness = {**witness, "G": G.data(), "G_covers": covers}
            own = 1 - Fraction(rate) if self.discrete else Fraction(rate)
            return ExactContraction(self.systems[0].cz, matrices, G, own)
        return None

    @property
    def _courses_of_contraction(self) -> str:
        return SLOW_COURSES if self.witness is not None and "step" in self.witness else EVERY_COURSE

    def _rounding(self, contraction: ExactContraction) -> dict[str, Any] | None:
        missed = [system.missed for system in self.systems]
        pairs = {"states": ("K", "J"), "inputs": ("U", "L")}
        pairs |= {"disturbances": ("V", "W")} if self.systems[0].model.decoupled else {}
        bounds = {
            kind: contraction.bounds([each[moved][0] for each in missed], [each[seen][0].absolute() for each in missed])
            for kind, (moved, seen) in pairs.items()
        }
        model, rows = self.systems[0].model, self.observer.fault_rows
        if model.Phi is not None and len(model.Phi):
            goal = np.abs(model.goal[rows, -len(model.Phi) :])
            if np.any((goal > 0.0) & (bounds["states"][rows, -len(model.Phi) :] > ESTIMATE_SHARE * goal)):
                return None
        return {
            "claim": f"rounding {self._courses_of_contraction}",
            "bounds": {kind: matrix_data(bound) for kind, bound in bounds.items()},
        }

    def _faults(self, contraction: ExactContraction) -> dict[str, Any] | None:
        """Return that each fault shows in its own estimate a sample later, and nowhere else."""
        first, names = self.systems[0], self.design.scheduled[0].fault_names
        rows = rows_of(first.observer)
        if not names or {delay for kind, _, delay in rows if kind == "fault"} != {1}:
            return None
        wanted = np.zeros((len(rows), len(names)))
        for i, (kind, name, _) in enumerate(rows):
            if kind != "state" and name in names:
                wanted[i, names.index(name)] = 1.0
        moved, own = [], []
        for system in self.systems:
            b, d = system.driven("faults")
            own.append(d.absolute() + (first.cz @ b + exact(wanted)).absolute())
            moved += [other.az @ b for other in self.systems]
        bounds = contraction.bounds(moved, own)
        estimates = [bounds[i, names.index(name)] for i, (kind, name, _) in enumerate(rows) if kind == "fault"]
        if max(estimates) > ESTIMATE_SHARE:
            return None
        return {"claim": f"faults {self._courses_of_contraction}", "bounds": matrix_data(bounds)}

    def _add_gain(self) -> None:
        claims, plant = self.design.certificate.claims, self.design.scheduled[0]
        name, letters, signal, kind = GAINS.get(self.design.method, ("", WITNESSES, "", ""))
        if name not in claims or not plant.nf or (signal == "disturbances" and not plant.nd):
            return
        rows = [i for i, (own, _, _) in enumerate(rows_of(self.systems[0].observer)) if own == kind]
        slow: SlowCourses | SlowFlow | None = self._slow_courses(letters)
        if slow is None:
            slow = SlowFlow.of(self.systems, plant, self.design.certificate.matrices, letters[0])
        matrices = self._lyapunov_matrices(letters[0])
        found: dict[str, Any] | None = None
        for room in NORM_ROOM:
            gamma = claims[name] * room
            if matrices is not None:
                found = self._named("gain", EVERY_COURSE, self._gain(matrices, gamma, signal, rows))
            if slow is not None:
                found = found or self._named("gain", SLOW_COURSES, slow.gain(gamma, signal, rows))
            if found is not None:
                found |= {"signal": signal, "rows": [kind]}
                break
        self.add(f"the l2 gain {claims[name]:.6g} from the {signal}", found)

    def _gain(
        self, matrices: Sequence[Dyadic], gamma: float, signal: str, rows: Sequence[int]
    ) -> dict[str, Any] | None:
        def form(system: ExactErrorSystem, p: Dyadic, after: Dyadic) -> Dyadic:
            b, d = system.driven(signal)
            return system.bounded_real_form(gamma, p, after, system.az, b, -system.cz.rows_at(rows), d.rows_at(rows))

        witnesses, stated = self._at_all_pairs(matrices, form), self._of_matrices(matrices)
        if witnesses is None or stated is None:
            return None
        return {"gamma": number_data(gamma), **stated, "bounded_real": witnesses}

    def _add_mean_square(self) -> None:
        claims, matrices = self.design.certificate.claims, self._lyapunov_matrices(GAIN_WITNESSES[0])
        if "region_deviation" not in claims:
            return
        rows = [i for i, (kind, _, _) in enumerate(rows_of(self.systems[0].observer)) if kind == "state"]
        directs = [system.driven("noise")[1].rows_at(rows) for system in self.systems]
        direct, found = max(_trace(d.T @ d) for d in directs), None
        slow = self._slow_courses(GAIN_WITNESSES)
        proofs = [] if matrices is None or not self.discrete else [(EVERY_COURSE, self._mean_square(matrices, rows))]
        proofs += [] if slow is None else [(SLOW_COURSES, slow.mean_square(rows))]
        for courses, proof in proofs:
            if proof is None or found is not None:
                continue
            proved, bounds = proof
            level = max(root_above(max(map(_trace, bounds)) + direct), claims["region_deviation"])
            if level <= claims["region_deviation"] * NORM_ROOM[-1]:
                found = self._named("mean square", courses, {"rows": ["state"], "level": number_data(level), **proved})
        self.add("the mean square of the errors", found)

    def _mean_square(
        self, matrices: Sequence[Dyadic], rows: Sequence[int]
    ) -> tuple[dict[str, Any], list[Dyadic]] | None:
        """Return what proves a mean square for every course, and matrices one of which has the trace of what the noise
        puts into the errors."""
        c = self.systems[0].cz.rows_at(rows)

        def form(system: ExactErrorSystem, p: Dyadic, after: Dyadic) -> Dyadic:
            return p - system.az.T @ after @ system.az - c.T @ c

        witnesses, stated = self._at_all_pairs(matrices, form), self._of_matrices(matrices)
        if witnesses is None or stated is None:
            return None
        driven = [system.driven("noise")[0] for system in self.systems]
        return {**stated, "decreases": witnesses}, [b.T @ after @ b for b in driven for after in matrices]


def _above_inverses(matrices: Sequence[Dyadic]) -> tuple[Dyadic, list[dict[str, Any]]] | None:
    """Return G with ``[P, I; I, G] > 0`` for each P: a multiple of the inverse of their mean."""
    mean = matrices[0]
    for P in matrices[1:]:
        mean = mean + P
    inverted = inverse_above(mean.scaled(1.0 / len(matrices)))
    identity = Dyadic.identity(mean.shape[0])
    for factor in COVERING_FACTORS if inverted is not None else ():
        G = inverted[0].scaled(factor)  # type: ignore[index]
        covers = [witness for P in matrices if (witness := definite_witness(blocks([[P, identity], [identity, G]])))]
        if len(covers) == len(matrices):
            return G, covers
    return None


def _trace(matrix: Dyadic) -> Fraction:
    return sum((matrix.fraction(i, i) for i in range(matrix.shape[0])), Fraction(0))
